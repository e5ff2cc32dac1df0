//! The report of `spandrel check --record` and `--live`: whether the sensors agree with each other.

use crate::error::AppError;
use serde_json::json;
use spandrel_faults::{ChannelHealth, Fault, SensorCheck, Soundness};
use spandrel_sensor::{open_record, recorded_rows};
use spandrel_structure::Structure;
use std::fmt;
use std::path::PathBuf;

/// Standard gravity (m/s²), the factor between g and m/s².
const GRAVITY: f64 = 9.806_65;

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
}

impl SensorPage {
    /// Compares the sensors in the recordings, one after the other.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn of_records(structure: &Structure, records: &[PathBuf]) -> Result<Self, AppError> {
        let mut check = SensorCheck::new(structure);
        for path in records {
            check.forget_motion();
            for row in recorded_rows(open_record(structure, path)?, 0) {
                check.take(&row?.values);
            }
        }
        Ok(Self::of_check(structure, &check))
    }

    /// Reports what a check of the structure's sensors has found.
    pub fn of_check(structure: &Structure, check: &SensorCheck) -> Self {
        let names = structure
            .channels()
            .map(|channel| channel.name().to_owned());
        let unchecked = |(channel, health): (usize, &Option<ChannelHealth>)| {
            let is_unchecked = health.is_some_and(|one| one.soundness == Soundness::Unchecked);
            is_unchecked.then(|| check.required_s(channel))
        };
        let required = check.health().iter().enumerate().filter_map(unchecked);
        let required: Vec<Option<f64>> = required.collect();
        Self {
            structure: structure.name().to_owned(),
            required_s: required.iter().copied().flatten().reduce(f64::max),
            lacks_motion: required.contains(&None),
            apart_s: apart_s(check, APART * structure.fundamental_period_s()),
            channels: names.zip(check.health().iter().copied()).collect(),
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
                    "  {name:<20} not checked: no measured ground motion along it"
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

/// Returns the largest difference of the delays of sound sensors (s). `None` up to `limit_s`.
fn apart_s(check: &SensorCheck, limit_s: f64) -> Option<f64> {
    let sound = check.health().iter().flatten();
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
        let structure = Structure::parse(TABLE, Path::new("table.toml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record.csv");
        let mut text = "time_s,ground_mps2,floor1_mps2,floor2_mps2,floor3_mps2\n".to_owned();
        let frames = structure.simulator(3).take(length_s * 120);
        let frames: Vec<Vec<f64>> = frames.map(|frame| frame.values.clone()).collect();
        for (number, values) in frames.iter().enumerate() {
            let before = &frames[number.saturating_sub(late)];
            let time_s = number as f64 / 120.0;
            text += &format!(
                "{time_s:.6},{},{},{},{}\n",
                values[0],
                values[1],
                scale * before[2],
                before[3]
            );
        }
        std::fs::write(&path, text).unwrap();
        SensorPage::of_records(&structure, &[path]).unwrap()
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
