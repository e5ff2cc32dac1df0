//! Mistakes in a structure file, and the fit verdict on each with real records.

use super::course::Course;
use super::pairs::{Level, differences, share_up_to};
use super::shake_table::{courses, folder, records, stiff, summarise};
use super::{RecordsError, Row};
use std::path::Path;

/// A wrong file.
struct Mistake {
    what: &'static str,
    changes: &'static [(&'static str, &'static str)],
    shows: Shows,
}

/// Effect of a mistake that records can show.
#[derive(Clone, Copy, PartialEq)]
enum Shows {
    /// Model that explains nothing or almost nothing.
    Contradiction,
    /// Model that fits at values far from the file, so that a loss relative to a learnt reference
    /// is meaningful.
    Doubt,
    /// Linear model that fits as well as without the mistake, with the same values.
    Nothing,
}

const MISTAKES: [Mistake; 5] = [
    Mistake {
        what: "floors 1 and 3 swapped",
        changes: &[
            ("floor1_mps2", "floor?"),
            ("floor3_mps2", "floor1_mps2"),
            ("floor?", "floor3_mps2"),
        ],
        shows: Shows::Contradiction,
    },
    Mistake {
        what: "stiffnesses ten times too high",
        changes: &[(
            "stiffnesses-n-per-m = [2720, 2300, 2360]",
            "stiffnesses-n-per-m = [27200, 23000, 23600]",
        )],
        shows: Shows::Doubt,
    },
    Mistake {
        what: "all channels in g taken for m/s2",
        changes: &[("unit = \"m/s2\" }", "unit = \"m/s2\", scale = 0.10197 }")],
        shows: Shows::Nothing,
    },
    Mistake {
        what: "the table in g taken for m/s2",
        changes: &[(
            "ground_mps2\", unit = \"m/s2\" }",
            "ground_mps2\", unit = \"m/s2\", scale = 0.10197 }",
        )],
        shows: Shows::Contradiction,
    },
    Mistake {
        what: "floor 2 in g taken for m/s2",
        changes: &[(
            "floor2_mps2\", unit = \"m/s2\" }",
            "floor2_mps2\", unit = \"m/s2\", scale = 0.10197 }",
        )],
        shows: Shows::Contradiction,
    },
];

/// Share of the motion in which a mistake must show.
const TOLD: f64 = 0.8;

/// Returns the rows of the mistakes.
pub(super) fn rows(data: &Path) -> Result<Vec<Row>, RecordsError> {
    if !folder(data).is_dir() {
        return Ok(vec![Row::skipped(
            "mistakes",
            "",
            format!("no records in {}", folder(data).display()),
        )]);
    }
    let right = stiff(&[])?;
    let records = records(&right, data, "stiff")?;
    let right = courses(&right, &records, None)?;
    MISTAKES
        .iter()
        .map(|mistake| row(mistake, data, &right))
        .collect()
}

fn row(mistake: &Mistake, data: &Path, right: &[Course]) -> Result<Row, RecordsError> {
    let required = match mistake.shows {
        Shows::Contradiction => {
            "contradicted, or nothing decided, in at least 80 % of the motion; no alert"
        }
        Shows::Doubt => {
            "doubtful, contradicted or undecided in at least 80 % of the motion; no alert"
        }
        Shows::Nothing => {
            "no alert; the values at the end as without the mistake, within two deviations"
        }
    };
    let mut row = Row::new(format!("mistake: {} (stiff frame)", mistake.what), required);
    let structure = stiff(mistake.changes)?;
    let courses = courses(&structure, &records(&structure, data, "stiff")?, None)?;
    summarise(&mut row, &courses);
    row.false_alerts = Some(
        courses
            .iter()
            .filter(|course| course.raised().next().is_some())
            .count(),
    );
    let mut apart = Vec::new();
    for (course, right) in courses.iter().zip(right) {
        let (Some(end), Some(right)) = (course.end(), right.end()) else {
            continue;
        };
        let told: Vec<String> = end
            .mean
            .iter()
            .zip(&end.std)
            .map(|(m, s)| format!("{m:.3}±{s:.3}"))
            .collect();
        row.seen += &format!("end {}; ", told.join(" "));
        let levels = |parameter| {
            [
                Level::within(end, parameter),
                Level::within(right, parameter),
            ]
        };
        apart.extend((0..end.mean.len()).flat_map(|parameter| differences(&levels(parameter))));
    }
    let [_, doubtful, contradicted] = row.verdicts.unwrap_or_default();
    let undecided = 1.0 - row.decided_share.unwrap_or(0.0);
    let is_told = match mistake.shows {
        Shows::Contradiction => contradicted.max(undecided) >= TOLD,
        Shows::Doubt => (doubtful + contradicted).max(undecided) >= TOLD,
        Shows::Nothing => {
            row.coverage = share_up_to(2.0, &apart);
            row.coverage == Some(1.0)
        }
    };
    row.passed = Some(row.false_alerts == Some(0) && is_told);
    Ok(row)
}
