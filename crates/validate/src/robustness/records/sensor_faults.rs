//! Records of real structures with one faulty sensor.

use super::batch_fit::Replay;
use super::course::{Course, Recorded};
use super::{RecordsError, Row, bridge, replaced, shake_table};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Normal};
use spandrel_alert::Baseline;
use spandrel_bus::EventKind;
use spandrel_faults::SensorCheck;
use spandrel_structure::Structure;
use std::path::Path;

/// Time after the start of a fault within which it must be named (s of the record).
const NAMED_WITHIN_S: f64 = 60.0;

/// Start of a fault within a record (s).
const STARTS_S: [f64; 2] = [0.0, 30.0];

/// Simulated loss of the bridge.
const SIMULATED_LOSS: f64 = 0.4;

/// A fault of one channel.
#[derive(Debug, Clone, Copy, PartialEq)]
enum SensorFault {
    Gain(f64),
    Zero,
    /// Noise with this standard deviation (SI) and nothing else.
    Noise(f64),
    Stuck,
    /// Late by this time (s).
    Late(f64),
    /// Exchanged with another channel.
    Exchanged(usize),
    /// Slope (SI per s).
    Drift(f64),
}

impl SensorFault {
    fn words(self) -> String {
        match self {
            Self::Gain(factor) if factor < 0.0 => "wrong sign".to_owned(),
            Self::Gain(factor) => format!("gain {:+.0} %", 100.0 * (factor - 1.0)),
            Self::Zero => "dead with zeros".to_owned(),
            Self::Noise(_) => "dead with noise".to_owned(),
            Self::Stuck => "stuck".to_owned(),
            Self::Late(delay_s) => format!("{:.0} ms late", 1e3 * delay_s),
            Self::Exchanged(_) => "exchanged".to_owned(),
            Self::Drift(_) => "drift".to_owned(),
        }
    }

    /// Returns `true` if the channel must be named.
    fn is_named(self) -> bool {
        match self {
            Self::Gain(factor) => (factor - 1.0).abs() > 0.19,
            Self::Zero
            | Self::Noise(_)
            | Self::Stuck
            | Self::Late(_)
            | Self::Exchanged(_)
            | Self::Drift(_) => true,
        }
    }

    /// Applies the fault to a channel from a time (s since the first row) on.
    fn apply(
        self,
        rows: &[spandrel_sensor::Row],
        channel: usize,
        from_s: f64,
        rate_hz: f64,
    ) -> Vec<spandrel_sensor::Row> {
        let mut changed = rows.to_vec();
        let from = (from_s * rate_hz).round() as usize;
        let value = |row: usize| rows[row].values[channel];
        let mut random = ChaCha8Rng::seed_from_u64(20);
        let noise = match self {
            Self::Noise(std) => Normal::new(0.0, std).ok(),
            _ => None,
        };
        for (number, row) in changed.iter_mut().enumerate().skip(from) {
            let own = &mut row.values[channel];
            match self {
                Self::Gain(factor) => *own *= factor,
                Self::Zero => *own = 0.0,
                Self::Noise(_) => {
                    *own = noise.map_or(0.0, |noise| noise.sample(&mut random));
                }
                Self::Stuck => *own = value(from),
                Self::Late(delay_s) => {
                    let place = (number as f64 - delay_s * rate_hz).max(0.0);
                    let (before, part) = (place.floor() as usize, place.fract());
                    *own = value(before) * (1.0 - part) + value(before + 1) * part;
                }
                Self::Exchanged(other) => row.values.swap(channel, other),
                Self::Drift(slope) => *own += slope * (number - from) as f64 / rate_hz,
            }
        }
        changed
    }
}

/// Results of one kind of fault.
#[derive(Debug, Default)]
struct Tally {
    runs: usize,
    raised: usize,
    named: usize,
    wrong: usize,
    /// Delays until the channel was named (s).
    delays_s: Vec<f64>,
    remarks: String,
}

/// Returns the rows of both structures, and calls `done` with each as soon as it is complete.
pub(super) fn rows(data: &Path, done: &mut impl FnMut(&Row)) -> Result<Vec<Row>, RecordsError> {
    let mut rows = Vec::new();
    if shake_table::folder(data).is_dir() {
        rows.extend(table_rows(data, done)?);
    }
    if data.join("painter-street-bridge").is_dir() {
        rows.extend(bridge_rows(data, done)?);
    }
    if rows.is_empty() {
        let why = format!("no records in {}", data.display());
        let row = Row::skipped("faulty sensors", "", why);
        done(&row);
        rows.push(row);
    }
    Ok(rows)
}

fn table_rows(data: &Path, done: &mut impl FnMut(&Row)) -> Result<Vec<Row>, RecordsError> {
    let rules = (
        "[record]\n",
        "[[alert]]\nparameters = \"all\"\nloss = 0.15\ncredibility = 0.99\nsustain-s = 5\n\
         reference = { learn-s = 30 }\n\n[record]\n",
    );
    let structure = shake_table::stiff(&[rules])?;
    let records = shake_table::records(&structure, data, "stiff")?;
    let courses = shake_table::courses(&structure, &records, None)?;
    let baseline = shake_table::baseline(&structure, &courses, None)?;
    let learnt: Vec<(&Recorded, &Course)> = records.iter().zip(&courses).collect();
    let baseline = with_sensors(baseline, &structure, &learnt, shake_table::MOTION, 10.0)?;
    let cases: Vec<(&Recorded, &Baseline)> = records.iter().map(|one| (one, &baseline)).collect();
    let mut rows = table(
        "shake table",
        &structure,
        &cases,
        shake_table::MOTION,
        0.02,
        done,
    )?;
    let flexible = shake_table::records(&structure, data, "flexible")?;
    let changed: Vec<(Vec<spandrel_sensor::Row>, &Baseline)> = flexible
        .into_iter()
        .map(|record| (record.rows, &baseline))
        .collect();
    let what = "shake table: flexible frame under the stiff file";
    rows.extend(losses(
        what,
        &structure,
        &changed,
        shake_table::MOTION,
        done,
    )?);
    Ok(rows)
}

fn bridge_rows(data: &Path, done: &mut impl FnMut(&Row)) -> Result<Vec<Row>, RecordsError> {
    let rule = (
        "[[alert]]\n",
        "[[alert]]\nparameters = [\"supports\"]\nloss = 0.3\ncredibility = 0.99\nsustain-s = 5\n\
         reference = { learn-s = 60 }\n\n[[alert]]\n",
    );
    let text = replaced(
        &replaced(bridge::FILE, &[rule])?,
        &[("loss = 0.2\n", "loss = 0.15\n")],
    )?;
    let structure = Structure::parse(&text, Path::new("bridge.toml"))?;
    let events = bridge::events(&structure, &data.join("painter-street-bridge"))?;
    let tested = events.iter().enumerate().filter(|(_, event)| event.is_weak);
    let tested: Vec<(usize, &bridge::Event)> = tested.step_by(2).take(5).collect();
    let baselines = tested
        .iter()
        .map(|(own, _)| {
            let baseline = bridge::baseline(&structure, &events, *own)?;
            let others = events
                .iter()
                .enumerate()
                .filter(|(index, event)| index != own && event.is_weak && event.is_early);
            let learnt: Vec<(&Recorded, &Course)> = others
                .map(|(_, event)| (&event.record, &event.course))
                .collect();
            with_sensors(
                baseline,
                &structure,
                &learnt,
                bridge::MOTION,
                bridge::SKIP_S,
            )
        })
        .collect::<Result<Vec<_>, RecordsError>>()?;
    let cases: Vec<(&Recorded, &Baseline)> = tested
        .iter()
        .zip(&baselines)
        .map(|((_, event), baseline)| (&event.record, baseline))
        .collect();
    let mut rows = table(
        "highway bridge",
        &structure,
        &cases,
        bridge::MOTION,
        0.06,
        done,
    )?;
    let replay = Replay::new(&structure);
    let damaged = |(_, event): &(usize, &bridge::Event), baseline: &Baseline| {
        let sound = baseline.parameter(bridge::PARAMETER);
        let left = sound.map_or(1.0, |sound| sound.mean) * (1.0 - SIMULATED_LOSS);
        bridge::with_loss(&replay, &structure, event, left)
    };
    let changed: Vec<(Vec<spandrel_sensor::Row>, &Baseline)> = tested
        .iter()
        .zip(&baselines)
        .map(|(event, baseline)| (damaged(event, baseline), baseline))
        .collect();
    let what = "highway bridge: simulated loss of 40 %";
    rows.extend(losses(what, &structure, &changed, bridge::MOTION, done)?);
    Ok(rows)
}

/// Adds to a baseline what the sensors have shown in its records, and the effect of each of them.
fn with_sensors(
    baseline: Baseline,
    structure: &Structure,
    records: &[(&Recorded, &Course)],
    motion: f64,
    skip_s: f64,
) -> Result<Baseline, RecordsError> {
    let names: Vec<&str> = structure.channels().map(|one| one.name()).collect();
    let observed: Vec<_> = records
        .iter()
        .map(|(_, course)| course.observed.clone())
        .collect();
    let sensors = SensorCheck::new(structure).learn(&names, &observed);
    let summaries: Option<Vec<_>> = records
        .iter()
        .map(|(_, course)| course.summary(skip_s))
        .collect();
    let summaries = summaries.unwrap_or_default();
    let mut baseline = baseline.with_sensors(sensors);
    for channel in structure.observation_channels() {
        let without = |(record, _): &(&Recorded, &Course)| {
            let left_out = Some(names[*channel]);
            let course = Course::run_without(structure, &record.rows, None, motion, left_out)?;
            Ok(course.summary(skip_s))
        };
        let without = records
            .iter()
            .map(without)
            .collect::<Result<Vec<_>, RecordsError>>()?;
        baseline = baseline.with_left_out(names[*channel], &summaries, &without);
    }
    Ok(baseline)
}

/// Runs all faults of all channels on all records.
fn table(
    of: &str,
    structure: &Structure,
    cases: &[(&Recorded, &Baseline)],
    motion: f64,
    late_s: f64,
    done: &mut impl FnMut(&Row),
) -> Result<Vec<Row>, RecordsError> {
    let mut rows = Vec::new();
    let kinds = [
        SensorFault::Gain(0.7),
        SensorFault::Gain(0.8),
        SensorFault::Gain(1.2),
        SensorFault::Gain(1.1),
        SensorFault::Gain(-1.0),
        SensorFault::Zero,
        SensorFault::Noise(0.005),
        SensorFault::Stuck,
        SensorFault::Late(late_s),
        SensorFault::Exchanged(0),
        SensorFault::Drift(0.02),
    ];
    let mut sound = Row::new(
        format!("{of}: sound sensors"),
        "no alert, and no channel in doubt",
    );
    for (record, baseline) in cases {
        let course = Course::run(structure, &record.rows, Some(baseline), motion)?;
        sound.runs += 1;
        sound.seen += &format!("{}: {}; ", record.name, told(&course));
        let is_alarm = !course.sensors.is_empty() || course.raised().next().is_some();
        *sound.false_alerts.get_or_insert(0) += usize::from(is_alarm);
    }
    sound.passed = Some(sound.false_alerts == Some(0));
    done(&sound);
    rows.push(sound);
    let names: Vec<String> = structure
        .channels()
        .map(|one| one.name().to_owned())
        .collect();
    for kind in kinds {
        for (channel, name) in names.iter().enumerate() {
            let kind = match kind {
                SensorFault::Exchanged(_) => SensorFault::Exchanged((channel + 1) % names.len()),
                other => other,
            };
            let mut tally = Tally::default();
            for (record, baseline) in cases {
                for from_s in STARTS_S {
                    let rate_hz = structure.sampling_rate_hz();
                    if record.rows.len() as f64 <= (from_s + 10.0) * rate_hz {
                        continue;
                    }
                    let changed = kind.apply(&record.rows, channel, from_s, rate_hz);
                    let course = Course::run(structure, &changed, Some(baseline), motion)?;
                    tally.take(&course, name, from_s, &record.name);
                }
            }
            let row = tally.row(of, kind, name);
            done(&row);
            rows.push(row);
        }
    }
    Ok(rows)
}

/// Runs records of a changed structure with one faulty channel of the response.
fn losses(
    of: &str,
    structure: &Structure,
    cases: &[(Vec<spandrel_sensor::Row>, &Baseline)],
    motion: f64,
    done: &mut impl FnMut(&Row),
) -> Result<Vec<Row>, RecordsError> {
    let names: Vec<String> = structure
        .channels()
        .map(|one| one.name().to_owned())
        .collect();
    let mut rows = Vec::new();
    for kind in [
        SensorFault::Gain(0.7),
        SensorFault::Gain(-1.0),
        SensorFault::Noise(0.005),
    ] {
        for channel in structure.observation_channels() {
            let name = &names[*channel];
            let what = format!("{of}, {name} {}", kind.words());
            let mut row = Row::new(what, "a loss raised in every run");
            let mut raised = 0;
            for (record, baseline) in cases {
                let rate_hz = structure.sampling_rate_hz();
                let changed = kind.apply(record, *channel, 0.0, rate_hz);
                let course = Course::run(structure, &changed, Some(baseline), motion)?;
                raised += usize::from(course.raised().next().is_some());
                row.seen += &format!("{}; ", told(&course));
            }
            row.runs = cases.len();
            row.seen += &format!("raised {raised} of {}", cases.len());
            row.passed = Some(raised == cases.len());
            done(&row);
            rows.push(row);
        }
    }
    Ok(rows)
}

impl Tally {
    fn take(&mut self, course: &Course, name: &str, from_s: f64, record: &str) {
        self.runs += 1;
        let is_raised = course.raised().any(|(time_s, _)| *time_s > from_s);
        self.raised += usize::from(is_raised);
        let excluded = || {
            let all = course.sensors.iter();
            all.filter(|(_, kind, _)| *kind == EventKind::ChannelExcluded)
        };
        let own = excluded().find(|(time_s, _, one)| one == name && *time_s > from_s);
        if let Some((time_s, _, _)) = own
            && time_s - from_s <= NAMED_WITHIN_S
        {
            self.named += 1;
            self.delays_s.push(time_s - from_s);
        }
        let is_wrong = excluded().any(|(_, _, one)| one != name);
        self.wrong += usize::from(is_wrong);
        if is_raised || is_wrong {
            self.remarks += &format!("{record} from {from_s:.0} s: {}; ", told(course));
        }
    }

    fn row(mut self, of: &str, kind: SensorFault, name: &str) -> Row {
        self.delays_s.sort_by(f64::total_cmp);
        let median = self.delays_s.get(self.delays_s.len() / 2);
        let median = median.map_or(String::new(), |s| format!(", median after {s:.0} s"));
        let required = match kind.is_named() {
            true => "no stiffness alert; the channel named in 90 % of the runs",
            false => "no stiffness alert",
        };
        Row {
            runs: self.runs,
            false_alerts: Some(self.raised),
            seen: format!(
                "named {} of {}{median}; another named {}; {}",
                self.named, self.runs, self.wrong, self.remarks
            ),
            passed: Some(
                self.raised == 0
                    && (!kind.is_named() || self.named as f64 >= 0.9 * self.runs as f64),
            ),
            ..Row::new(format!("{of}: {name} {}", kind.words()), required)
        }
    }
}

/// Describes the alerts and the events of the sensors.
fn told(course: &Course) -> String {
    let alerts = course.alerts.iter().map(|(time_s, alert)| {
        let state = format!("{:?}", alert.state).to_lowercase();
        let loss = alert.loss.map_or(f64::NAN, |loss| loss.loss);
        format!("{state} {} by {loss:.2} {time_s:.1} s", alert.parameter)
    });
    let sensors = course.sensors.iter().map(|(time_s, kind, name)| {
        let what = match kind {
            EventKind::ChannelExcluded => "excluded",
            EventKind::ChannelInDoubt => "doubts",
            _ => "uses",
        };
        format!("{what} {name} {time_s:.1} s")
    });
    alerts.chain(sensors).collect::<Vec<_>>().join(", ")
}
