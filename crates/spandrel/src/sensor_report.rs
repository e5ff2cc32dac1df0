//! The report of `spandrel check --record` and `--live`: whether the sensors agree with each other.

use crate::error::AppError;
use serde_json::json;
use spandrel_earthquake::motion::GRAVITY;
use spandrel_faults::{ChannelHealth, Fault, SensorCheck, Soundness};
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::{Channel, Structure};
use std::fmt;
use std::path::PathBuf;

/// Largest ratio of a factor to the factor between two units that suggests a wrong unit.
const NEAR_UNIT: f64 = 1.3;

/// Largest difference of the delays of sound sensors, in fundamental periods.
///
/// Each sensor is compared with the mean of the others. If half of them is late, no single one
/// stands out.
const APART: f64 = 0.1;

/// What recordings or live data show of each sensor.
#[derive(Debug)]
pub struct SensorPage {
    structure: String,
    /// Name and result of each channel of a frame. `None` for a channel that is not checked.
    channels: Vec<(String, Option<ChannelHealth>)>,
    /// Length of data (s) that some unchecked channels require and did not have.
    required_s: Option<f64>,
    /// Whether the data of an unchecked channel were long enough.
    lacks_motion: bool,
    /// Difference of the delays of sound sensors (s) if it is large.
    apart_s: Option<f64>,
    /// Names of the channels that were judged, and have no samples at the end of the data.
    ended: Vec<String>,
}

/// The last judgement of each channel of a frame.
///
/// [`SensorCheck`] discards the judgement of a channel as soon as it has no samples. The channels
/// of a recording rarely end together, so that the end alone would leave a long recording
/// unchecked.
struct Judgements {
    health: Vec<Option<ChannelHealth>>,
    /// As [`SensorCheck::required_s`]. `None` once the data were long enough.
    required_s: Vec<Option<f64>>,
}

impl SensorPage {
    /// Compares the sensors in the recordings, one after the other. `check` has no frames yet.
    ///
    /// # Errors
    /// Returns an error if a recording cannot be read.
    pub fn of_records(
        structure: &Structure,
        mut check: SensorCheck,
        records: &[PathBuf],
    ) -> Result<Self, AppError> {
        let mut last = Judgements::of(&check);
        for path in records {
            check.forget_motion();
            for row in recorded_rows(open_record(structure, path)?, 0) {
                check.take(&row?.values);
                last.update(&check);
            }
        }
        let at_end = Judgements::of(&check);
        let names = structure.channels().map(Channel::name);
        let ended = names
            .zip(last.health.iter().zip(&at_end.health))
            .filter(|(_, (last, at_end))| is_unchecked(at_end) && !is_unchecked(last))
            .map(|(name, _)| name.to_owned())
            .collect();
        Ok(Self {
            ended,
            ..Self::new(structure, last)
        })
    }

    /// Reports what a check of the structure's sensors has found.
    pub fn of_check(structure: &Structure, check: &SensorCheck) -> Self {
        Self::new(structure, Judgements::of(check))
    }

    fn new(structure: &Structure, judgements: Judgements) -> Self {
        let Judgements { health, required_s } = judgements;
        let names = structure
            .channels()
            .map(|channel| channel.name().to_owned());
        let required = health.iter().zip(required_s);
        let required: Vec<Option<f64>> = required
            .filter(|(health, _)| is_unchecked(health))
            .map(|(_, required_s)| required_s)
            .collect();
        Self {
            structure: structure.name().to_owned(),
            required_s: required.iter().copied().flatten().reduce(f64::max),
            lacks_motion: required.contains(&None),
            apart_s: apart_s(&health, APART * structure.fundamental_period_s()),
            channels: names.zip(health).collect(),
            ended: Vec::new(),
        }
    }

    /// Returns the report as one JSON object.
    pub fn json(&self) -> String {
        let sensor = |(name, health): &(String, Option<ChannelHealth>)| match health {
            None => json!({ "channel": name, "state": null }),
            Some(health) => json!({
                "channel": name,
                "state": word(health.soundness),
                "probability": health.probability,
                "factor": health.gain,
                "delay_s": health.delay_s,
                "coherence": health.coherence,
                "fault": health.fault.map(Fault::words),
                "advice": health.fault.map(advice),
            }),
        };
        let sensors: Vec<_> = self.channels.iter().map(sensor).collect();
        let page = json!({
            "structure": self.structure,
            "sensors": sensors,
            "delays_apart_s": self.apart_s,
        });
        page.to_string() + "\n"
    }
}

impl fmt::Display for SensorPage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "sensors of {}", self.structure)?;
        writeln!(
            f,
            "  {:<20} {:<10} {:>8} {:>11} {:>10}",
            "channel", "state", "factor", "delay (ms)", "coherence"
        )?;
        for (name, health) in &self.channels {
            let Some(health) = health else {
                writeln!(
                    f,
                    "  {name:<20} not checked: no measured ground motion in its direction"
                )?;
                continue;
            };
            let number = |value: Option<f64>, digits: usize| {
                value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
            };
            writeln!(
                f,
                "  {name:<20} {:<10} {:>8} {:>11} {:>10}",
                word(health.soundness),
                number(health.gain, 2),
                number(health.delay_s.map(|delay_s| 1e3 * delay_s), 0),
                number(health.coherence, 3),
            )?;
        }
        let faults = self.channels.iter().filter_map(|(name, health)| {
            let fault = health.as_ref()?.fault?;
            Some((name, fault))
        });
        for (name, fault) in faults {
            writeln!(f, "{name} {}: {}", fault.words(), advice(fault))?;
        }
        if !self.ended.is_empty() {
            writeln!(
                f,
                "without samples at the end of the data, judged before it: {}",
                self.ended.join(", ")
            )?;
        }
        if let Some(apart_s) = self.apart_s {
            writeln!(
                f,
                "the delays of sound sensors differ by {:.0} ms: sensors of different loggers may \
                 have different clocks or filters",
                1e3 * apart_s
            )?;
        }
        if let Some(required_s) = self.required_s {
            writeln!(
                f,
                "unchecked: the data are too short, must be at least {:.0} s without a gap",
                required_s.ceil()
            )?;
        }
        if self.lacks_motion {
            writeln!(
                f,
                "unchecked: the data contain too little motion of the ground far below the first \
                 natural frequency"
            )?;
        }
        Ok(())
    }
}

impl Judgements {
    fn of(check: &SensorCheck) -> Self {
        let health = check.health().to_vec();
        Self {
            required_s: (0..health.len())
                .map(|channel| check.required_s(channel))
                .collect(),
            health,
        }
    }

    /// Replaces the judgement of each channel that the check judges now.
    fn update(&mut self, check: &SensorCheck) {
        for (channel, health) in check.health().iter().enumerate() {
            if !is_unchecked(health) {
                self.health[channel] = *health;
            } else if self.required_s[channel].is_some() {
                self.required_s[channel] = check.required_s(channel);
            }
        }
    }
}

/// Returns `true` if a channel is checked, but was not compared yet.
fn is_unchecked(health: &Option<ChannelHealth>) -> bool {
    health.is_some_and(|health| health.soundness == Soundness::Unchecked)
}

/// Returns the largest difference of the delays of sound sensors (s). `None` up to `limit_s`.
fn apart_s(health: &[Option<ChannelHealth>], limit_s: f64) -> Option<f64> {
    let sound = health.iter().flatten();
    let sound = sound.filter(|health| health.soundness == Soundness::Sound);
    let delays: Vec<f64> = sound.filter_map(|health| health.delay_s).collect();
    let latest = delays.iter().copied().reduce(f64::max)?;
    let earliest = delays.iter().copied().reduce(f64::min)?;
    // Relative to the mean of the n − 1 others, a delay is n/(n − 1) times that to the mean of all.
    let count = delays.len() as f64;
    let apart_s = (latest - earliest) * (count - 1.0) / count;
    Some(apart_s).filter(|apart_s| *apart_s > limit_s)
}

/// Returns the word for people.
pub fn word(soundness: Soundness) -> &'static str {
    match soundness {
        Soundness::Unchecked => "unchecked",
        Soundness::Sound => "sound",
        Soundness::InDoubt => "in doubt",
        Soundness::Faulty => "faulty",
    }
}

/// Returns what to look at first.
pub fn advice(fault: Fault) -> &'static str {
    let is_near = |factor: f64, unit: f64| (factor / unit).ln().abs() < NEAR_UNIT.ln();
    match fault {
        Fault::Gain(factor) if is_near(factor, GRAVITY) || is_near(factor, GRAVITY.recip()) => {
            "the unit is probably wrong, g in place of m/s2 or the reverse"
        }
        Fault::Gain(_) => "check its sensitivity, its range and its unit",
        Fault::Sign(_) => "check its orientation and the polarity of its cable",
        Fault::Delay(_) => "check the clock of its node and the filter delay of its recorder",
        Fault::Dead => "check its power, cable and mounting",
        Fault::Disturbed => "check its cable and mounting, and whether it measures another place",
        Fault::Drift(_) => "check its mounting, its temperature and its supply voltage",
        Fault::Clipped(_) => "check its range and the range of its recorder",
        Fault::Exchanged => "check which cable is connected to which channel",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const TABLE: &str = include_str!("../../../docs/examples/shake-table-stiff.toml");

    /// Returns the page of a recording of the simulated frame, whose second floor has this scale.
    fn page(scale: f64) -> SensorPage {
        page_of(60, scale)
    }

    fn page_of(length_s: usize, scale: f64) -> SensorPage {
        page_with_delay(length_s, scale, 0)
    }

    /// The second and the third floor are late by a number of frames.
    fn page_with_delay(length_s: usize, scale: f64, late: usize) -> SensorPage {
        page_without_end(length_s, scale, late, 0)
    }

    /// The ground has no samples in the last seconds.
    fn page_without_end(length_s: usize, scale: f64, late: usize, end_s: usize) -> SensorPage {
        let structure = Structure::parse(TABLE, Path::new("table.toml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record.csv");
        let mut text = "time_s,ground_mps2,floor1_mps2,floor2_mps2,floor3_mps2\n".to_owned();
        let frames = structure.simulator(3).take(length_s * 120);
        let frames: Vec<Vec<f64>> = frames.map(|frame| frame.values.clone()).collect();
        for (number, values) in frames.iter().enumerate() {
            let before = &frames[number.saturating_sub(late)];
            let time_s = number as f64 / 120.0;
            let ground = match number < (length_s - end_s) * 120 {
                true => values[0].to_string(),
                false => String::new(),
            };
            text += &format!(
                "{time_s:.6},{ground},{},{},{}\n",
                values[1],
                scale * before[2],
                before[3]
            );
        }
        std::fs::write(&path, text).unwrap();
        let check = SensorCheck::new(&structure);
        SensorPage::of_records(&structure, check, &[path]).unwrap()
    }

    #[test]
    fn sound_sensors_are_listed_without_advice() {
        let text = page(1.0).to_string();
        assert_eq!(text.matches(" sound ").count(), 4, "{text}");
        assert_eq!(text.lines().count(), 6, "{text}");
    }

    #[test]
    fn two_loggers_with_different_clocks_are_noticed_although_each_sensor_is_sound() {
        let page = page_with_delay(60, 1.0, 3);
        let text = page.to_string();
        assert_eq!(text.matches(" sound   ").count(), 4, "{text}");
        assert!(
            text.contains("the delays of sound sensors differ"),
            "{text}"
        );
        let json: serde_json::Value = serde_json::from_str(&page.json()).unwrap();
        let apart_s = json["delays_apart_s"].as_f64().unwrap();
        assert!((apart_s - 3.0 / 120.0).abs() < 0.01, "{json}");
    }

    #[test]
    fn short_data_leave_the_sensors_unchecked_for_this_reason() {
        let text = page_of(1, 1.0).to_string();
        let (short, motion) = ("the data are too short", "too little motion");
        assert!(text.contains(short) && !text.contains(motion), "{text}");
    }

    #[test]
    fn channel_that_ends_early_is_judged_by_the_data_before() {
        let page = page_without_end(60, 1.0, 0, 3);
        let text = page.to_string();
        assert_eq!(text.matches(" sound ").count(), 4, "{text}");
        let note = "without samples at the end of the data, judged before it: ground";
        assert!(text.contains(note), "{text}");
        assert!(!text.contains("too short"), "{text}");
        let faulty = page_without_end(60, GRAVITY.recip(), 0, 3).to_string();
        assert!(faulty.contains("the unit is probably wrong"), "{faulty}");
    }

    #[test]
    fn wrong_unit_is_named_with_its_channel() {
        let page = page(GRAVITY.recip());
        let text = page.to_string();
        assert!(
            text.contains("floor-2") && text.contains("the unit is probably wrong"),
            "{text}"
        );
        let json: serde_json::Value = serde_json::from_str(&page.json()).unwrap();
        assert_eq!(json["sensors"][2]["state"], "faulty", "{json}");
        assert_eq!(json["sensors"][1]["state"], "sound", "{json}");
    }
}
