//! The bench frame on a shake table: two states of known stiffness with three motions each.
//!
//! Source of the records and of the known values: the mini shake table of STAIRlab, and
//! docs/laboratory-frame.md.

use super::course::{Course, Hindrance, Point, Recorded};
use super::pairs::{Level, differences, share_up_to};
use super::{RecordsError, Row, replaced};
use spandrel_alert::{Baseline, BetweenRecords, LossEstimate, ParameterEstimate};
use spandrel_structure::Structure;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const STIFF: &str = include_str!("../../../../../docs/examples/shake-table-stiff.toml");
const FLEXIBLE: &str = include_str!("../../../../../docs/examples/shake-table-flexible.toml");
pub(super) const MOTIONS: [&str; 3] = ["sine1.0", "sine2.0", "northridge"];

/// Floor acceleration above which the frame counts as moving (m/s²), as in
/// docs/laboratory-frame.md.
pub(super) const MOTION: f64 = 0.5;

/// Start of each record that `spandrel baseline` skips by default (s).
const SKIP_S: f64 = 10.0;

/// Loss from the stiff to the flexible walls.
const LOSS: f64 = 0.83;

/// Nominal stiffnesses of the two files (N/m).
const STIFFNESSES: [[f64; 3]; 2] = [[2720.0, 2300.0, 2360.0], [437.0, 392.0, 398.0]];

/// Lighter masses with the flexible walls. The walls are thinner and every floor carries less
/// steel, which an owner who replaced them knows.
const LIGHTER: (&str, &str) = (
    "masses-kg = [0.2335, 0.2335, 0.1788]",
    "masses-kg = [0.1602, 0.1602, 0.1421]",
);

pub(super) fn folder(data: &Path) -> PathBuf {
    data.join("mini-shake-table/aligned")
}

/// Returns the stiff frame's file with some of its text replaced.
pub(super) fn stiff(changes: &[(&str, &str)]) -> Result<Structure, RecordsError> {
    Ok(Structure::parse(
        &replaced(STIFF, changes)?,
        Path::new("shake-table-stiff.toml"),
    )?)
}

/// Reads the records of a state.
pub(super) fn records(
    structure: &Structure,
    data: &Path,
    state: &str,
) -> Result<Vec<Recorded>, RecordsError> {
    let path = |motion| folder(data).join(format!("{state}-{motion}.csv"));
    MOTIONS
        .iter()
        .map(|motion| Recorded::read(structure, &path(motion)))
        .collect()
}

/// Runs records without a baseline.
pub(super) fn courses(
    structure: &Structure,
    records: &[Recorded],
    baseline: Option<&Baseline>,
) -> Result<Vec<Course>, RecordsError> {
    records
        .iter()
        .map(|record| Course::run(structure, &record.rows, baseline, MOTION))
        .collect()
}

/// Returns the rows of the shake table.
pub(super) fn rows(data: &Path) -> Result<Vec<Row>, RecordsError> {
    if !folder(data).is_dir() {
        return Ok(vec![Row::skipped(
            "shake table",
            "",
            format!("no records in {}", folder(data).display()),
        )]);
    }
    let stiff = stiff(&[])?;
    let flexible = Structure::parse(FLEXIBLE, Path::new("shake-table-flexible.toml"))?;
    let (stiff_records, flexible_records) = (
        records(&stiff, data, "stiff")?,
        records(&flexible, data, "flexible")?,
    );
    let own = [
        courses(&stiff, &stiff_records, None)?,
        courses(&flexible, &flexible_records, None)?,
    ];
    let all = [
        baseline(&stiff, &own[0], None)?,
        baseline(&flexible, &own[1], None)?,
    ];
    let mut rows = vec![
        pairs(
            "shake table: pairs of motions of one state, at the end",
            &own,
            &all,
            Course::end,
        ),
        pairs(
            "shake table: pairs of motions of one state, last moment in motion",
            &own,
            &all,
            Course::last_moving,
        ),
        sound("stiff", &stiff, &stiff_records, &own[0])?,
        sound("flexible", &flexible, &flexible_records, &own[1])?,
    ];
    let [baseline, _] = all;
    rows.push(changed("", &stiff, &flexible_records, &baseline)?);
    let lighter = self::stiff(&[LIGHTER])?;
    rows.push(changed(
        " with the masses of the flexible walls",
        &lighter,
        &flexible_records,
        &baseline,
    )?);
    let screened = self::stiff(&[("[filter]", "[outliers]\n\n[filter]")])?;
    rows.push(changed(
        " with [outliers]",
        &screened,
        &flexible_records,
        &baseline,
    )?);
    rows.push(known_loss(&own, &baseline));
    Ok(rows)
}

/// Compares pairs of motions of one state, with the scatter between records from the other state.
fn pairs(
    condition: &str,
    states: &[Vec<Course>; 2],
    baselines: &[Baseline; 2],
    at: impl Fn(&Course) -> Option<&Point>,
) -> Row {
    let mut row = Row::new(
        condition,
        "at least 90 % within two deviations for this structure",
    );
    let (mut all, mut within) = (Vec::new(), Vec::new());
    for (state, courses) in states.iter().enumerate() {
        for parameter in 0..3 {
            let name = format!("storey-{}", parameter + 1);
            let points = courses.iter().filter_map(&at);
            let levels: Vec<Level> = points
                .map(|point| Level::within(point, parameter))
                .collect();
            let wide = levels
                .iter()
                .map(|level| level.for_structure(&baselines[1 - state], &name));
            let wide: Vec<Level> = wide.collect();
            let told = levels
                .iter()
                .zip(&wide)
                .map(|(a, b)| format!("{:.3}±{:.3} (±{:.3})", a.mean, a.std, b.std));
            row.seen += &format!(
                "{} {name}: {}; ",
                ["stiff", "flexible"][state],
                told.collect::<Vec<_>>().join(" ")
            );
            within.extend(differences(&levels));
            all.extend(differences(&wide));
        }
    }
    let alone = share_up_to(2.0, &within).unwrap_or(f64::NAN);
    row.seen += &format!(
        "within the records {:.0} % within two deviations",
        100.0 * alone
    );
    row.runs = states.iter().map(Vec::len).sum();
    row.coverage = share_up_to(2.0, &all);
    row.passed = row.coverage.map(|share| share >= 0.9);
    row
}

/// Learns the baseline of all courses except one.
pub(super) fn baseline(
    structure: &Structure,
    courses: &[Course],
    without: Option<usize>,
) -> Result<Baseline, RecordsError> {
    let names: Vec<&str> = structure
        .parameters()
        .iter()
        .map(|parameter| parameter.name())
        .collect();
    let used = courses
        .iter()
        .enumerate()
        .filter(|(index, _)| Some(*index) != without);
    let records = used.map(|(index, course)| {
        course
            .summary(SKIP_S)
            .ok_or_else(|| RecordsError::NothingLearnt {
                record: MOTIONS[index].to_owned(),
            })
    });
    let records = records.collect::<Result<Vec<_>, _>>()?;
    Ok(Baseline::from_records(
        structure.name(),
        &names,
        &records,
        BetweenRecords::Estimated,
    )?)
}

/// Compares each motion of a state with the baseline of its other motions.
fn sound(
    state: &str,
    structure: &Structure,
    records: &[Recorded],
    own: &[Course],
) -> Result<Row, RecordsError> {
    let required = "no alert; a decision in at least 80 % of the motion";
    let mut row = Row::new(
        format!("shake table: {state} motions against the other two"),
        required,
    );
    let mut courses = Vec::new();
    for (index, record) in records.iter().enumerate() {
        match baseline(structure, own, Some(index)) {
            Ok(baseline) => courses.push(Course::run(
                structure,
                &record.rows,
                Some(&baseline),
                MOTION,
            )?),
            Err(error) => {
                row.seen += &format!("{}: no baseline: {}; ", MOTIONS[index], with_source(&error))
            }
        }
    }
    summarise(&mut row, &courses);
    row.false_alerts = Some(
        courses
            .iter()
            .filter(|course| course.raised().next().is_some())
            .count(),
    );
    row.passed = Some(row.false_alerts == Some(0) && row.decided_share >= Some(0.8));
    Ok(row)
}

/// Formats an error with its causes.
fn with_source(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes
        .map(ToString::to_string)
        .collect::<Vec<_>>()
        .join(": ")
}

/// Compares the flexible frame, read with the stiff frame's file, with the baseline.
fn changed(
    what: &str,
    structure: &Structure,
    records: &[Recorded],
    baseline: &Baseline,
) -> Result<Row, RecordsError> {
    let required = "every storey raised in every motion; the interval at the end holds 83 %";
    let mut row = Row::new(
        format!("shake table: flexible frame under the stiff file{what}"),
        required,
    );
    let courses = courses(structure, records, Some(baseline))?;
    summarise(&mut row, &courses);
    let (mut raised, mut held, mut intervals) = (0, 0, 0);
    for (motion, course) in MOTIONS.iter().zip(&courses) {
        let mut parameters: Vec<usize> =
            course.raised().map(|(_, alert)| alert.parameter).collect();
        parameters.sort_unstable();
        parameters.dedup();
        raised += parameters.len();
        for (index, parameter) in structure.parameters().iter().enumerate() {
            let (Some(point), Some(reference)) =
                (course.end(), baseline.reference(parameter.name()))
            else {
                continue;
            };
            let Level { mean, std } = Level::within(point, index);
            let estimate = ParameterEstimate {
                time_ns: 0,
                mean,
                std,
            };
            let loss = spandrel_alert::loss_estimate(&estimate, &reference);
            intervals += 1;
            held += usize::from((loss.low..=loss.high).contains(&LOSS));
            row.seen += &format!("{motion} storey-{}: {}; ", index + 1, told(&loss));
        }
    }
    row.seen += &format!("raised {raised} of {intervals}");
    row.coverage = Some(held as f64 / intervals.max(1) as f64);
    row.passed = Some(raised == intervals && held == intervals);
    Ok(row)
}

/// Estimates the loss between the two states, each identified with its own file and masses. The
/// stiff motions are the baseline.
fn known_loss(own: &[Vec<Course>; 2], baseline: &Baseline) -> Row {
    let mut row = Row::new(
        "shake table: loss between the states, each by its own file",
        "the interval holds 83 %",
    );
    let (mut held, mut intervals) = (0, 0);
    for (motion, flexible) in MOTIONS.iter().zip(&own[1]) {
        for parameter in 0..3 {
            let reference = baseline.reference(&format!("storey-{}", parameter + 1));
            let (Some(end), Some(reference)) = (flexible.end(), reference) else {
                continue;
            };
            let Level { mean, std } = Level::within(end, parameter);
            let in_stiff = STIFFNESSES[1][parameter] / STIFFNESSES[0][parameter];
            let estimate = ParameterEstimate {
                time_ns: 0,
                mean: mean * in_stiff,
                std: std * in_stiff,
            };
            let loss = spandrel_alert::loss_estimate(&estimate, &reference);
            intervals += 1;
            held += usize::from((loss.low..=loss.high).contains(&LOSS));
            row.seen += &format!("{motion} storey-{}: {}; ", parameter + 1, told(&loss));
        }
    }
    row.runs = MOTIONS.len();
    row.coverage = Some(held as f64 / intervals.max(1) as f64);
    row.passed = Some(held == intervals && intervals > 0);
    row
}

/// Describes a loss in words.
fn told(loss: &LossEstimate) -> String {
    format!("lost {:.3} [{:.3}, {:.3}]", loss.loss, loss.low, loss.high)
}

/// Adds the results that every row has of its courses.
pub(super) fn summarise(row: &mut Row, courses: &[Course]) {
    row.runs = courses.len();
    let mean = |of: &dyn Fn(&Course) -> f64| {
        courses.iter().map(of).sum::<f64>() / courses.len().max(1) as f64
    };
    row.verdicts = Some([0, 1, 2].map(|verdict| mean(&|course| course.verdict_shares()[verdict])));
    row.decided_share = Some(mean(&Course::decided_share));
    let mut undecided: BTreeMap<Hindrance, f64> = BTreeMap::new();
    for (hindrance, share) in courses.iter().flat_map(Course::hindrance_shares) {
        *undecided.entry(hindrance).or_default() += share / courses.len() as f64;
    }
    row.undecided = undecided
        .into_iter()
        .map(|(hindrance, share)| (hindrance.to_string(), share))
        .collect();
}
