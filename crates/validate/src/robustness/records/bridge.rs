//! A highway overpass: weak and strong earthquakes of four decades.
//!
//! Source of the records: docs/highway-bridge.md. The bridge is undamaged in weak shaking. In
//! strong shaking it really softens, and its stiffness returns within a minute or two.

use super::batch_fit::Replay;
use super::course::{Course, Point, Recorded};
use super::pairs::{Level, differences, median, share_up_to};
use super::shake_table::summarise;
use super::{RecordsError, Row, replaced};
use spandrel_alert::{Baseline, BetweenRecords};
use spandrel_structure::Structure;
use std::path::Path;

pub(crate) const FILE: &str =
    include_str!("../../../../../docs/examples/earthquake/highway-bridge.toml");

/// Deck acceleration above which the bridge counts as moving (m/s²), three times the stated noise.
pub(super) const MOTION: f64 = 0.06;

/// Peak acceleration at the base of the bent below which an event is weak (m/s²).
const WEAK: f64 = 1.0;

/// Start of each record that `spandrel baseline` skips (s), because the recorder starts half a
/// minute before the motion.
pub(super) const SKIP_S: f64 = 30.0;

/// What the title of a row with outlier screening adds.
const SCREENED: &str = " with [outliers]";

/// Archives with the four channels, in order of time. Three more archives of the folder lack the
/// base of the bent.
pub(crate) const EVENTS: [&str; 18] = [
    "capemendocino_21nov1986_ce89324p",
    "capemendocinoaftershock_21nov1986_ce89324p",
    "petrolia_25apr1992_ce89324p",
    "petroliaaftershock1_26apr1992_ce89324p",
    "RioDell_14Sep2012_71842255_ce89324p",
    "bayview_11oct2013_72086051_ce89324p",
    "riodell_19oct2014_72330211_ce89324p",
    "ferndale_28jan2015_72387946_ce89324p",
    "petrolia_05dec2016_72733405_ce89324p",
    "ferndaleoffshore_08dec2016_us20007z6r_ce89324p",
    "nc73666231_ce89324p",
    "nc73667866_ce89324p",
    "nc73821036_ce89324p",
    "nc73821636_ce89324p",
    "nc73827571_ce89324p",
    "nc73925281_ce89324p",
    "nc73943821_ce89324p",
    "nc73943846_ce89324p",
];

/// First event that may have changed the bridge permanently. The baseline is learnt from earlier
/// weak events.
pub(crate) const FIRST_STRONG: &str = "nc73821036_ce89324p";

/// Parameter of the file.
pub(super) const PARAMETER: &str = "supports";

/// One event with its results.
pub(super) struct Event {
    pub(super) record: Recorded,
    pub(super) is_weak: bool,
    /// Whether the event precedes the strong earthquake of 2022.
    pub(super) is_early: bool,
    /// Results without a baseline.
    pub(super) course: Course,
    /// Batch fit to the whole record: the ratio, and the unexplained share of the variance.
    batch: (f64, f64),
}

/// Returns the rows of the bridge.
pub(super) fn rows(data: &Path) -> Result<Vec<Row>, RecordsError> {
    let folder = data.join("painter-street-bridge");
    if !folder.is_dir() {
        return Ok(vec![Row::skipped(
            "highway bridge",
            "",
            format!("no records in {}", folder.display()),
        )]);
    }
    let structure = Structure::parse(FILE, Path::new("bridge.toml"))?;
    let screened = Structure::parse(
        &replaced(FILE, &[("[filter]", "[outliers]\n\n[filter]")])?,
        Path::new("bridge.toml"),
    )?;
    let events = events(&structure, &folder)?;
    let baselines = (0..events.len())
        .map(|own| baseline(&structure, &events, own))
        .collect::<Result<Vec<_>, _>>()?;
    Ok(vec![
        pairs(
            "highway bridge: pairs of weak events, at the end",
            &events,
            &baselines,
            Course::end,
        ),
        pairs(
            "highway bridge: pairs of weak events, last moment in motion",
            &events,
            &baselines,
            Course::last_moving,
        ),
        batch(&events),
        sound(&structure, &events, &baselines)?,
        strong(&structure, &events, &baselines)?,
        damaged(0.4, "", &structure, &events, &baselines)?,
        damaged(0.4, SCREENED, &screened, &events, &baselines)?,
        damaged(0.6, SCREENED, &screened, &events, &baselines)?,
    ])
}

pub(super) fn events(structure: &Structure, folder: &Path) -> Result<Vec<Event>, RecordsError> {
    let ground = structure
        .excitation_channels()
        .first()
        .copied()
        .flatten()
        .unwrap_or(0);
    let strong_from = EVENTS
        .iter()
        .position(|name| *name == FIRST_STRONG)
        .unwrap_or(EVENTS.len());
    let replay = Replay::new(structure);
    let mut events = Vec::new();
    for (number, name) in EVENTS.iter().enumerate() {
        let record = Recorded::read(structure, &folder.join(format!("{name}.zip")))?;
        let course = Course::run(structure, &record.rows, None, MOTION)?;
        let batch = replay.fit(&record.rows, 0);
        let is_weak = record.peak(ground) < WEAK;
        events.push(Event {
            is_weak,
            is_early: number < strong_from,
            course,
            batch,
            record,
        });
    }
    Ok(events)
}

/// Learns the baseline for an event from all other weak events before the strong earthquake of
/// 2022.
pub(super) fn baseline(
    structure: &Structure,
    events: &[Event],
    own: usize,
) -> Result<Baseline, RecordsError> {
    let names: Vec<&str> = structure
        .parameters()
        .iter()
        .map(|parameter| parameter.name())
        .collect();
    let used = events
        .iter()
        .enumerate()
        .filter(|(index, event)| *index != own && event.is_weak && event.is_early);
    let records = used.map(|(_, event)| {
        let nothing = || RecordsError::NothingLearnt {
            record: event.record.name.clone(),
        };
        event.course.summary(SKIP_S).ok_or_else(nothing)
    });
    let records = records.collect::<Result<Vec<_>, _>>()?;
    Ok(Baseline::from_records(
        structure.name(),
        &names,
        &records,
        BetweenRecords::Estimated,
    )?)
}

/// Compares pairs of weak events, with the scatter between records from the other events.
fn pairs(
    condition: &str,
    events: &[Event],
    baselines: &[Baseline],
    at: impl Fn(&Course) -> Option<&Point>,
) -> Row {
    let mut row = Row::new(
        condition,
        "at least 90 % of the pairs within two deviations for this structure",
    );
    let (mut within, mut levels) = (Vec::new(), Vec::new());
    for (event, baseline) in events
        .iter()
        .zip(baselines)
        .filter(|(event, _)| event.is_weak)
    {
        let Some(point) = at(&event.course) else {
            continue;
        };
        let level = Level::within(point, 0);
        let wide = level.for_structure(baseline, PARAMETER);
        row.seen += &format!(
            "{}: {:.3}±{:.4}, for the structure ±{:.3}; ",
            event.record.name, level.mean, level.std, wide.std
        );
        within.push(level);
        levels.push(wide);
    }
    let (alone, found) = (differences(&within), differences(&levels));
    row.seen += &format!(
        "within the records {:.0} % within two deviations, median of |z| {:.1}",
        100.0 * share_up_to(2.0, &alone).unwrap_or(f64::NAN),
        median(&alone)
    );
    row.runs = levels.len();
    row.coverage = share_up_to(2.0, &found);
    row.passed = row.coverage.map(|share| share >= 0.9);
    row
}

/// Compares the estimate at the last moment in motion with the batch fit.
fn batch(events: &[Event]) -> Row {
    let mut row = Row::new(
        "highway bridge: weak events against a batch fit, last moment in motion",
        "",
    );
    let mut found = Vec::new();
    for event in events.iter().filter(|event| event.is_weak) {
        let Some(point) = event.course.last_moving() else {
            continue;
        };
        let (ratio, left) = event.batch;
        found.push((point.mean[0] - ratio).abs() / point.std[0]);
        row.seen += &format!(
            "{}: batch {ratio:.3} leaves {left:.2}, found {:.3}; ",
            event.record.name, point.mean[0]
        );
    }
    row.runs = found.len();
    row.coverage = share_up_to(2.0, &found);
    row
}

/// Compares weak events with the baseline of the others.
fn sound(
    structure: &Structure,
    events: &[Event],
    baselines: &[Baseline],
) -> Result<Row, RecordsError> {
    let required = "no alert; a decision in at least 70 % of the motion";
    let mut row = Row::new("highway bridge: weak events against the others", required);
    let mut courses = Vec::new();
    for (event, baseline) in events
        .iter()
        .zip(baselines)
        .filter(|(event, _)| event.is_weak)
    {
        let course = Course::run(structure, &event.record.rows, Some(baseline), MOTION)?;
        row.seen += &told(event, &course);
        courses.push(course);
    }
    summarise(&mut row, &courses);
    row.false_alerts = Some(
        courses
            .iter()
            .filter(|course| course.raised().next().is_some())
            .count(),
    );
    row.passed = Some(row.false_alerts == Some(0) && row.decided_share >= Some(0.7));
    Ok(row)
}

/// Runs the strong events. An alert must be cleared if the coda shows the former stiffness.
fn strong(
    structure: &Structure,
    events: &[Event],
    baselines: &[Baseline],
) -> Result<Row, RecordsError> {
    let required = "no alert remains at the end of a record that recovers";
    let mut row = Row::new("highway bridge: strong events", required);
    let (mut courses, mut lasting) = (Vec::new(), 0);
    let replay = Replay::new(structure);
    for (event, baseline) in events
        .iter()
        .zip(baselines)
        .filter(|(event, _)| !event.is_weak)
    {
        let course = Course::run(structure, &event.record.rows, Some(baseline), MOTION)?;
        let (ratio, left) = replay.fit(&event.record.rows, coda(&course));
        row.seen += &format!("{}coda {ratio:.2} leaves {left:.2}; ", told(event, &course));
        lasting += usize::from(course.standing > 0 && ratio > RECOVERED);
        courses.push(course);
    }
    summarise(&mut row, &courses);
    row.false_alerts = Some(lasting);
    row.passed = Some(lasting == 0);
    Ok(row)
}

/// Ratio of a batch fit to the coda above which the bridge has recovered.
const RECOVERED: f64 = 0.85;

/// Length of the coda, the end of the motion (s).
const CODA_S: f64 = 15.0;

/// Returns the index of the first frame of the coda.
fn coda(course: &Course) -> usize {
    let end_s = course
        .points
        .iter()
        .rev()
        .find(|point| point.moves)
        .map_or(0.0, |point| point.time_s);
    course
        .points
        .iter()
        .position(|point| point.time_s >= end_s - CODA_S)
        .unwrap_or(0)
}

/// Runs weak events of a bridge whose supports have lost this share, including the unexplained part
/// of the real record.
fn damaged(
    loss: f64,
    what: &str,
    structure: &Structure,
    events: &[Event],
    baselines: &[Baseline],
) -> Result<Row, RecordsError> {
    let mut row = Row::new(
        format!(
            "highway bridge: simulated loss of {:.0} % with the residual of each weak event{what}",
            100.0 * loss
        ),
        "raised in every weak event; the interval at the raise holds the loss",
    );
    let replay = Replay::new(structure);
    let (mut courses, mut held) = (Vec::new(), 0);
    for (event, baseline) in events
        .iter()
        .zip(baselines)
        .filter(|(event, _)| event.is_weak)
    {
        let sound = baseline
            .parameter(PARAMETER)
            .map_or(1.0, |parameter| parameter.mean);
        let rows = with_loss(&replay, structure, event, sound * (1.0 - loss));
        let course = Course::run(structure, &rows, Some(baseline), MOTION)?;
        let interval = course.raised().next().and_then(|(_, alert)| alert.loss);
        held += usize::from(interval.is_some_and(|found| (found.low..=found.high).contains(&loss)));
        row.seen += &told(event, &course);
        courses.push(course);
    }
    summarise(&mut row, &courses);
    let raised = courses
        .iter()
        .filter(|course| course.raised().next().is_some())
        .count();
    row.seen += &format!("raised {raised} of {}", courses.len());
    row.coverage = Some(held as f64 / raised.max(1) as f64);
    row.passed = Some(raised == courses.len());
    Ok(row)
}

/// Returns the model response at the stiffness `left` plus the unexplained part of an event.
///
/// The unexplained part is the record minus the response at its own batch fit. The stiffness is
/// therefore the same in each event, and the event contributes only the model error.
pub(super) fn with_loss(
    replay: &Replay<'_>,
    structure: &Structure,
    event: &Event,
    left: f64,
) -> Vec<spandrel_sensor::Row> {
    let parameters = structure.parameters().len();
    let own = replay.response(&event.record.rows, &vec![event.batch.0; parameters]);
    let soft = replay.response(&event.record.rows, &vec![left; parameters]);
    let mut rows = event.record.rows.clone();
    for ((row, own), soft) in rows.iter_mut().zip(&own).zip(&soft) {
        for ((channel, own), soft) in structure
            .observation_channels()
            .iter()
            .zip(own.iter())
            .zip(soft.iter())
        {
            row.values[*channel] += soft - own;
        }
    }
    rows
}

/// Describes an event: its estimates, and the alerts raised and cleared with their times.
fn told(event: &Event, course: &Course) -> String {
    let level = |point: Option<&Point>| {
        point.map_or("-".to_owned(), |p| {
            format!("{:.3}±{:.4}", p.mean[0], p.std[0])
        })
    };
    let alerts: Vec<String> = course
        .alerts
        .iter()
        .map(|(time_s, alert)| {
            let loss = alert.loss.map_or(f64::NAN, |loss| loss.loss);
            format!("{:?} {time_s:.1} s loss {loss:.2}", alert.state).to_lowercase()
        })
        .collect();
    let (moving, end) = (level(course.last_moving()), level(course.end()));
    format!(
        "{}: batch {:.3} moving {moving} end {end} [{}]; ",
        event.record.name,
        event.batch.0,
        alerts.join(", ")
    )
}
