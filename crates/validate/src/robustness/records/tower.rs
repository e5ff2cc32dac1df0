//! A five-storey steel test tower under a mass damper: three records of the undamaged tower.
//!
//! The model is a shear chain, unlike the real tower. The estimates of storeys 4 and 5 are
//! inconsistent with every record.

use super::course::{Course, Recorded};
use super::pairs::{Level, differences, share_up_to};
use super::shake_table::summarise;
use super::{RecordsError, Row};
use spandrel_structure::Structure;
use std::path::Path;

const COMMON: &str = include_str!("tower.toml");
const FIVE: &str = include_str!("tower-five-parameters.toml");
const ONE: &str = include_str!("tower-one-parameter.toml");
const RECORDS: [&str; 3] = ["wn_01.dat", "wn_02.dat", "wn_03.dat"];

/// Floor acceleration above which the tower counts as moving (m/s²), three times the stated noise.
const MOTION: f64 = 0.015;

/// Returns the rows of the tower.
pub(super) fn rows(data: &Path) -> Result<Vec<Row>, RecordsError> {
    let folder = data.join("unison-tower");
    if !folder.is_dir() {
        return Ok(vec![Row::skipped(
            "test tower",
            "",
            format!("no records in {}", folder.display()),
        )]);
    }
    let five = run(&folder, FIVE)?;
    let one = run(&folder, ONE)?;
    let mut first = Row::new(
        "test tower: five parameters",
        "no alert, or undecided with the reason",
    );
    summarise(&mut first, &five);
    tell(&mut first, &five);
    first.passed = Some(first.false_alerts == Some(0));
    let mut second = Row::new(
        "test tower: one parameter",
        "no alert; the three records within two deviations",
    );
    summarise(&mut second, &one);
    tell(&mut second, &one);
    let ends: Vec<Level> = one
        .iter()
        .filter_map(Course::end)
        .map(|end| Level {
            mean: end.mean[0],
            std: end.std[0],
        })
        .collect();
    second.coverage = share_up_to(2.0, &differences(&ends));
    second.passed = Some(second.false_alerts == Some(0) && second.coverage == Some(1.0));
    Ok(vec![first, second])
}

fn run(folder: &Path, parameters: &str) -> Result<Vec<Course>, RecordsError> {
    let structure = Structure::parse(&format!("{COMMON}\n{parameters}"), Path::new("tower.toml"))?;
    let read = |name| Recorded::read(&structure, &folder.join(name));
    RECORDS
        .iter()
        .map(|name| Course::run(&structure, &read(name)?.rows, None, MOTION))
        .collect()
}

fn tell(row: &mut Row, courses: &[Course]) {
    row.false_alerts = Some(
        courses
            .iter()
            .filter(|course| course.raised().next().is_some())
            .count(),
    );
    for (name, course) in RECORDS.iter().zip(courses) {
        let Some(end) = course.end() else { continue };
        let told: Vec<String> = end
            .mean
            .iter()
            .zip(&end.std)
            .map(|(m, s)| format!("{m:.3}±{s:.3}"))
            .collect();
        row.seen += &format!(
            "{name} end {} raised {}; ",
            told.join(" "),
            course.raised().count()
        );
    }
}
