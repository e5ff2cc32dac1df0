//! Mistakes of a structure file, each on real records: what the verdict says of them.

use super::shake_table::{courses, folder, records, stiff, summarise};
use super::{RecordsError, Row};
use spandrel_structure::Structure;
use std::path::Path;

/// One wrong file.
struct Mistake {
    what: &'static str,
    changes: &'static [(&'static str, &'static str)],
}

const MISTAKES: [Mistake; 3] = [
    Mistake {
        what: "floors 1 and 3 swapped",
        changes: &[("floor1_mps2", "floor?"), ("floor3_mps2", "floor1_mps2"), ("floor?", "floor3_mps2")],
    },
    Mistake {
        what: "stiffnesses ten times too high",
        changes: &[("stiffnesses-n-per-m = [2720, 2300, 2360]", "stiffnesses-n-per-m = [27200, 23000, 23600]")],
    },
    Mistake {
        what: "a record in g taken for m/s2",
        changes: &[("unit = \"m/s2\" }", "unit = \"m/s2\", scale = 0.10197 }")],
    },
];

/// The rows of the mistakes.
pub(super) fn rows(data: &Path) -> Result<Vec<Row>, RecordsError> {
    if !folder(data).is_dir() {
        return Ok(vec![Row::skipped("mistakes", "", format!("no records in {}", folder(data).display()))]);
    }
    MISTAKES
        .iter()
        .map(|mistake| {
            let structure = stiff(mistake.changes)?;
            row(mistake.what, &structure, data)
        })
        .collect()
}

fn row(what: &str, structure: &Structure, data: &Path) -> Result<Row, RecordsError> {
    let required = "contradicted, or nothing decided, in at least 80 % of the motion; no alert";
    let mut row = Row::new(format!("mistake: {what} (stiff frame)"), required);
    let courses = courses(structure, &records(structure, data, "stiff")?, None)?;
    summarise(&mut row, &courses);
    row.false_alerts = Some(courses.iter().filter(|course| course.raised().next().is_some()).count());
    for course in &courses {
        let Some(end) = course.end() else { continue };
        let told: Vec<String> = end.mean.iter().zip(&end.std).map(|(m, s)| format!("{m:.3}±{s:.3}")).collect();
        row.seen += &format!("end {}; ", told.join(" "));
    }
    let rejected = row.verdicts.map_or(0.0, |[_, _, contradicted]| contradicted);
    let undecided = 1.0 - row.decided_share.unwrap_or(0.0);
    row.passed = Some(row.false_alerts == Some(0) && rejected.max(undecided) >= 0.8);
    Ok(row)
}
