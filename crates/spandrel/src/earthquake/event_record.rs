//! A recording of an earthquake, as the structure file describes it.

use crate::error::AppError;
use jiff::Timestamp;
use serde::Serialize;
use spandrel_bus::is_without_date;
use spandrel_earthquake::{
    IntensityFigures, MotionFigures, intensity_figures, motion_figures, spectral_acceleration,
};
use spandrel_faults::{ChannelHealth, SensorCheck};
use spandrel_record::{ColumnMapping, CsvReader, ReadOptions, RecordedChannel, RecordedFile};
use spandrel_sensor::{Row, open_record, recorded_rows};
use spandrel_structure::{Channel, Quantity, Structure};
use std::path::{Path, PathBuf};

/// Damping ratio of all spectral values.
pub const DAMPING: f64 = 0.05;
/// Periods of the table of spectral values (s), beside the fundamental period of the structure.
pub const PERIODS_S: [f64; 5] = [0.1, 0.2, 0.5, 1.0, 2.0];

/// All samples of a recording.
#[derive(Debug)]
pub struct EventRecord {
    /// Path of the recording.
    pub path: PathBuf,
    /// Time of the first row (ns since 1970-01-01 UTC, or since itself if the recording has no
    /// dates).
    pub start_ns: i64,
    /// Time of the earthquake (ns since 1970-01-01 UTC), if the recording states no other date.
    pub event_ns: Option<i64>,
    /// The rows, for the identification.
    pub rows: Vec<Row>,
    /// Samples of each channel, frame by frame, `NaN` where one is missing (SI).
    pub channels: Vec<Vec<f64>>,
    /// Health of each channel. `None` for a channel that cannot be checked.
    pub health: Vec<Option<ChannelHealth>>,
}

/// Figures of one sensor.
#[derive(Debug, Clone, Serialize)]
pub struct SensorFigures {
    /// Name of the channel.
    pub channel: String,
    /// Measured quantity.
    pub quantity: Quantity,
    /// SI unit.
    pub unit: &'static str,
    /// Whether the channel measures the excitation.
    pub is_excitation: bool,
    /// Peak and rms. `None` without samples.
    pub motion: Option<MotionFigures>,
    /// Intensity of an acceleration.
    pub intensity: Option<IntensityFigures>,
    /// Spectral accelerations of an acceleration.
    pub spectrum: Vec<SpectralValue>,
}

/// Spectral acceleration at a period.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SpectralValue {
    /// Period (s).
    pub period_s: f64,
    /// Pseudo-acceleration (m/s²), damping ratio 0.05.
    pub sa_m_per_s2: f64,
}

/// Largest number of frames per row of a recording, so that a wrong time cannot exhaust the memory.
const MOST_FRAMES_PER_ROW: usize = 100;

/// Returns the time of the earthquake that a recording states (ns since 1970-01-01 UTC).
///
/// A table, which may be unreadable without a mapping, states none.
fn event_ns(path: &Path) -> Option<i64> {
    let file = RecordedFile::read(path, &ReadOptions::default()).ok()?;
    file.channels().iter().find_map(RecordedChannel::event_ns)
}

impl EventRecord {
    /// Reads a recording.
    ///
    /// # Errors
    /// Returns an error if the recording does not match the structure file, or has too few samples
    /// for its length.
    pub fn read(structure: &Structure, path: &Path) -> Result<Self, AppError> {
        let rows = recorded_rows(open_record(structure, path)?, 0);
        Self::from_rows(structure, path, rows.collect::<Result<_, _>>()?)
    }

    /// Reads a recording of frames: a table with a column `time` (s since 1970-01-01 UTC) and one
    /// column per channel (SI).
    ///
    /// # Errors
    /// Returns the same errors as [`EventRecord::read`].
    pub fn read_frames(structure: &Structure, path: &Path) -> Result<Self, AppError> {
        let mapping = ColumnMapping::by_name(structure.channels().map(Channel::name));
        let rows = recorded_rows(CsvReader::open(path, &mapping)?, 0);
        Self::from_rows(structure, path, rows.collect::<Result<_, _>>()?)
    }

    fn from_rows(structure: &Structure, path: &Path, rows: Vec<Row>) -> Result<Self, AppError> {
        let start_ns = rows.first().map_or(0, |row| row.time_ns);
        let rate_hz = structure.sampling_rate_hz();
        let frame = |row: &Row| {
            let elapsed_ns = row.time_ns.saturating_sub(start_ns);
            (elapsed_ns as f64 * rate_hz / 1e9).round() as usize
        };
        let frames = rows.iter().map(frame).max().map_or(0, |last| last + 1);
        if frames > MOST_FRAMES_PER_ROW.saturating_mul(rows.len()) {
            return Err(AppError::TooSparse {
                path: path.to_owned(),
                samples: rows.len(),
                steps: frames,
            });
        }
        let mut channels = vec![vec![f64::NAN; frames]; structure.channel_count()];
        let mut check = SensorCheck::new(structure);
        for row in &rows {
            check.take(&row.values);
            for (channel, value) in channels.iter_mut().zip(&row.values) {
                channel[frame(row)] = *value;
            }
        }
        let event_ns = match is_without_date(start_ns) {
            true => event_ns(path),
            false => None,
        };
        Ok(Self {
            path: path.to_owned(),
            start_ns,
            event_ns,
            health: check.health().to_vec(),
            rows,
            channels,
        })
    }

    /// Returns the time of the first sample, or about a minute before it, that of the earthquake
    /// (ns since 1970-01-01 UTC). `None` if the recording states neither.
    pub fn time_ns(&self) -> Option<i64> {
        let start_ns = (!is_without_date(self.start_ns)).then_some(self.start_ns);
        start_ns.or(self.event_ns)
    }

    /// Returns date and time (UTC) of the first sample to the second, or of the earthquake to the
    /// minute. `None` if the recording states neither.
    pub fn date(&self) -> Option<String> {
        let time = Timestamp::from_nanosecond(self.time_ns()?.into()).unwrap_or_default();
        let format = match self.event_ns {
            None => "%Y-%m-%dT%H:%M:%SZ",
            Some(_) => "%Y-%m-%dT%H:%MZ",
        };
        Some(time.strftime(format).to_string())
    }

    /// Returns the length (s).
    pub fn length_s(&self, rate_hz: f64) -> f64 {
        self.channels.first().map_or(0, Vec::len) as f64 / rate_hz
    }

    /// Returns the channels that distinguish weak from strong motion: accelerations of the
    /// structure, or else of the ground.
    ///
    /// # Errors
    /// Returns an error if the structure has no acceleration.
    pub fn amplitude_channels(&self, structure: &Structure) -> Result<Vec<&[f64]>, AppError> {
        let accelerations = |is_excitation: bool| -> Vec<&[f64]> {
            let all = structure.channels().zip(&self.channels);
            all.filter(|(channel, _)| {
                is_acceleration(channel.quantity())
                    && channel.quantity().is_excitation() == is_excitation
            })
            .map(|(_, samples)| samples.as_slice())
            .collect()
        };
        let (of_structure, of_ground) = (accelerations(false), accelerations(true));
        match (of_structure.is_empty(), of_ground.is_empty()) {
            (false, _) => Ok(of_structure),
            (true, false) => Ok(of_ground),
            (true, true) => Err(AppError::NoAccelerations {
                structure: structure.name().to_owned(),
            }),
        }
    }

    /// Returns the figures of all sensors, in the order of the structure file.
    pub fn figures(&self, structure: &Structure) -> Result<Vec<SensorFigures>, AppError> {
        let step_s = structure.step_s();
        let fundamental = fundamental_hz(structure).recip();
        let periods = periods_s(fundamental);
        let of_channel = |(channel, samples): (&Channel, &Vec<f64>)| -> Result<_, AppError> {
            let quantity = channel.quantity();
            let (intensity, spectrum) = match is_acceleration(quantity) {
                true => (
                    intensity_figures(samples, step_s),
                    spectrum(samples, step_s, &periods)?,
                ),
                false => (None, Vec::new()),
            };
            Ok(SensorFigures {
                channel: channel.name().to_owned(),
                quantity,
                unit: quantity.unit(),
                is_excitation: quantity.is_excitation(),
                motion: motion_figures(samples, step_s),
                intensity,
                spectrum,
            })
        };
        structure
            .channels()
            .zip(&self.channels)
            .map(of_channel)
            .collect()
    }
}

/// Returns the periods of the table (s), rising, with the fundamental period unless it is one of
/// them.
fn periods_s(fundamental_s: f64) -> Vec<f64> {
    let mut periods = PERIODS_S.to_vec();
    if !PERIODS_S
        .iter()
        .any(|one| is_same_period(*one, fundamental_s))
    {
        periods.push(fundamental_s);
    }
    periods.sort_by(f64::total_cmp);
    periods
}

/// Returns `true` if two periods (s) are equal as the table writes them.
pub fn is_same_period(a: f64, b: f64) -> bool {
    (a - b).abs() < 0.005
}

/// Returns the spectral accelerations of a channel. Its mean counts as an offset. A channel without
/// samples has none.
pub fn spectrum(
    samples: &[f64],
    step_s: f64,
    periods_s: &[f64],
) -> Result<Vec<SpectralValue>, AppError> {
    let Some(mean) = spandrel_earthquake::motion::mean(samples) else {
        return Ok(Vec::new());
    };
    let centred: Vec<f64> = samples.iter().map(|value| value - mean).collect();
    let value = |period_s: &f64| -> Result<SpectralValue, AppError> {
        let sa_m_per_s2 = spectral_acceleration(&centred, step_s, *period_s, DAMPING)?;
        Ok(SpectralValue {
            period_s: *period_s,
            sa_m_per_s2,
        })
    };
    periods_s.iter().map(value).collect()
}

/// Returns `true` for every kind of acceleration.
pub fn is_acceleration(quantity: Quantity) -> bool {
    match quantity {
        Quantity::AbsoluteAcceleration
        | Quantity::RelativeAcceleration
        | Quantity::RestoringAcceleration
        | Quantity::GroundAcceleration => true,
        Quantity::Force | Quantity::Velocity | Quantity::Displacement | Quantity::Strain => false,
    }
}

/// Returns the lowest natural frequency as designed (Hz), without rigid motion.
pub fn fundamental_hz(structure: &Structure) -> f64 {
    let frequencies = structure.natural_frequencies_hz();
    let lowest = frequencies.into_iter().find(|frequency| *frequency > 0.0);
    lowest.unwrap_or(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_has_no_period_twice() {
        assert_eq!(periods_s(1.0 + 1e-12), PERIODS_S);
        assert_eq!(periods_s(1.1), [0.1, 0.2, 0.5, 1.0, 1.1, 2.0]);
    }
}
