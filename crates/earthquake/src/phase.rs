//! Divides a record into windows, and classifies them: strong motion, recovery or weak motion.
//!
//! A window lasts 10 fundamental periods, and at least 3 s. The stiffness of a structure depends on
//! the amplitude, so only weak motion shows whether it has changed permanently. Three limits
//! decide:
//!
//! - above `weak_peak`, the window is shaking
//! - for `settling_s` after shaking, stiffness and estimates still recover: settling
//! - below three times the level before the event, the window is quiet
//!
//! All other windows are weak motion.

use crate::error::{EarthquakeError, require};
use serde::Serialize;

/// Number of fundamental periods in a window.
const PERIODS: f64 = 10.0;
/// Minimum length of a window (s).
const SHORTEST_S: f64 = 3.0;
/// Ratio to the level before the event below which a window is quiet.
const QUIET_RATIO: f64 = 3.0;

/// Phase of the motion in a window of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Phase {
    /// Hardly more motion than before the event.
    Quiet,
    /// Strong motion: the stiffness depends on the amplitude.
    Shaking,
    /// Weak motion soon after strong motion, while the stiffness recovers.
    Settling,
    /// Weak motion: the only one that can show a lasting change.
    Weak,
}

impl Phase {
    /// Returns the word for people.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Quiet => "quiet",
            Self::Shaking => "shaking",
            Self::Settling => "settling",
            Self::Weak => "weak motion",
        }
    }

    /// Returns `true` if the phase can show a lasting change.
    #[must_use]
    pub fn is_weak(self) -> bool {
        matches!(self, Self::Quiet | Self::Weak)
    }
}

/// Limits of the phases.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhaseSettings {
    /// Sampling rate (Hz).
    pub rate_hz: f64,
    /// Fundamental frequency of the structure (Hz).
    pub fundamental_hz: f64,
    /// Peak of the response above which motion is strong (unit of the channels).
    pub weak_peak: f64,
    /// Time for which the stiffness and its estimates recover after shaking (s).
    pub settling_s: f64,
    /// Time since the first frame until which an earlier event is still settling (s). 0 or less for
    /// none.
    pub unsettled_s: f64,
}

/// One window of a record.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Window {
    /// Index of the first frame of the window, from 0.
    pub first: usize,
    /// Index of the frame after the last frame of the window.
    pub end: usize,
    /// Start of the window, since the first frame of the record (s).
    pub start_s: f64,
    /// End of the window, since the first frame of the record (s).
    pub end_s: f64,
    /// Root mean square of all response channels (unit of the channels).
    pub rms: f64,
    /// Largest absolute value of any response channel (unit of the channels).
    pub peak: f64,
    /// Phase of the motion in the window: quiet, shaking, settling or weak.
    pub phase: Phase,
}

/// Returns the length of a window (s) for a fundamental frequency (Hz).
#[must_use]
pub fn window_s(fundamental_hz: f64) -> f64 {
    (PERIODS / fundamental_hz).max(SHORTEST_S)
}

/// Divides the responses into windows. The mean of each channel counts as its offset.
///
/// Each element of `responses` is one channel, frame by frame, `NaN` where a sample is missing. All
/// have the same unit. A window without any sample is quiet. The last window has up to twice the
/// length.
///
/// # Errors
/// Returns an error if a setting is not positive.
pub fn windows(
    responses: &[&[f64]],
    settings: &PhaseSettings,
) -> Result<Vec<Window>, EarthquakeError> {
    let PhaseSettings {
        rate_hz,
        fundamental_hz,
        weak_peak,
        settling_s,
        unsettled_s,
    } = *settings;
    for (setting, found) in [
        ("sampling rate", rate_hz),
        ("fundamental frequency", fundamental_hz),
        ("limit of weak motion", weak_peak),
    ] {
        require(found > 0.0 && found.is_finite(), setting, found, "above 0")?;
    }
    require(
        settling_s >= 0.0,
        "settling time",
        settling_s,
        "at least 0 s",
    )?;
    let frames = responses.iter().map(|channel| channel.len()).max();
    let frames = frames.unwrap_or(0);
    let length = (window_s(fundamental_hz) * rate_hz).round() as usize;
    let count = (frames / length.max(1)).max(usize::from(frames > 0));
    let means: Vec<f64> = responses
        .iter()
        .map(|channel| crate::motion::mean(channel).unwrap_or(0.0))
        .collect();
    let mut windows: Vec<Window> = (0..count)
        .map(|index| {
            let first = index * length;
            let end = if index + 1 == count {
                frames
            } else {
                first + length
            };
            let (mut sum, mut samples, mut peak) = (0.0, 0_usize, 0.0_f64);
            for (channel, mean) in responses.iter().zip(&means) {
                let part = channel.get(first..end.min(channel.len())).unwrap_or(&[]);
                for value in part.iter().filter(|value| value.is_finite()) {
                    let deviation = value - mean;
                    sum += deviation * deviation;
                    samples += 1;
                    peak = peak.max(deviation.abs());
                }
            }
            Window {
                first,
                end,
                start_s: first as f64 / rate_hz,
                end_s: end as f64 / rate_hz,
                rms: (sum / samples.max(1) as f64).sqrt(),
                peak,
                phase: Phase::Quiet,
            }
        })
        .collect();
    let quiet = QUIET_RATIO * level_before(&windows);
    let mut settled_s = unsettled_s;
    for window in &mut windows {
        window.phase = if window.peak > weak_peak {
            settled_s = window.end_s + settling_s;
            Phase::Shaking
        } else if window.start_s < settled_s {
            Phase::Settling
        } else if window.rms <= quiet {
            Phase::Quiet
        } else {
            Phase::Weak
        };
    }
    Ok(windows)
}

/// Returns the level before the event: the quietest window before the strongest one.
///
/// Some recorders start with the motion. The level is then that of the quietest window of all.
fn level_before(windows: &[Window]) -> f64 {
    let quietest = |windows: &[Window]| {
        let all = windows.iter().map(|window| window.rms);
        all.fold(f64::INFINITY, f64::min)
    };
    let by_rms = |a: &(usize, &Window), b: &(usize, &Window)| a.1.rms.total_cmp(&b.1.rms);
    let strongest = windows.iter().enumerate().max_by(by_rms);
    match strongest {
        Some((index, _)) if index > 0 => quietest(&windows[..index]),
        _ => quietest(windows),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SETTINGS: PhaseSettings = PhaseSettings {
        rate_hz: 100.0,
        fundamental_hz: 5.0,
        weak_peak: 1.0,
        settling_s: 12.0,
        unsettled_s: 0.0,
    };

    /// Noise of 0.001 with a burst of this amplitude between 15 and 21 s, and of a tenth of it
    /// until 60 s.
    fn record(amplitude: f64) -> Vec<f64> {
        (0..9000_u32)
            .map(|i| {
                let time_s = 0.01 * f64::from(i);
                let level = match time_s {
                    t if t < 15.0 => 0.001,
                    t if t < 21.0 => amplitude,
                    t if t < 60.0 => 0.1 * amplitude,
                    _ => 0.001,
                };
                4.0 + level * (31.4 * time_s).sin()
            })
            .collect()
    }

    fn phases(amplitude: f64) -> Vec<(f64, Phase)> {
        let record = record(amplitude);
        let windows = windows(&[&record], &SETTINGS).unwrap();
        windows
            .iter()
            .map(|window| (window.start_s, window.phase))
            .collect()
    }

    #[test]
    fn strong_event_is_quiet_then_shaking_then_settling_then_weak() {
        for (start_s, phase) in phases(5.0) {
            let expected = match start_s {
                t if t < 15.0 => Phase::Quiet,
                t if t < 21.0 => Phase::Shaking,
                t if t < 33.0 => Phase::Settling,
                t if t < 60.0 => Phase::Weak,
                _ => Phase::Quiet,
            };
            assert_eq!(phase, expected, "{start_s}");
        }
    }

    #[test]
    fn weak_event_is_weak_motion_from_its_first_window() {
        let weak = phases(0.5);
        assert!(weak.iter().all(|(_, phase)| *phase != Phase::Shaking));
        assert_eq!(weak[5], (15.0, Phase::Weak));
    }

    #[test]
    fn weak_event_soon_after_a_strong_one_is_settling() {
        let settings = PhaseSettings {
            unsettled_s: 30.0,
            ..SETTINGS
        };
        let record = record(0.5);
        let windows = windows(&[&record], &settings).unwrap();
        let settling = |window: &&Window| window.phase == Phase::Settling;
        assert_eq!(windows.iter().filter(settling).count(), 10);
    }

    #[test]
    fn window_has_ten_periods_and_at_least_three_seconds() {
        let record = record(1.0);
        let at = |fundamental_hz| {
            let settings = PhaseSettings {
                fundamental_hz,
                ..SETTINGS
            };
            windows(&[&record], &settings).unwrap()[0].end_s
        };
        assert_eq!([at(5.0), at(2.0), at(0.5)], [3.0, 5.0, 20.0]);
    }

    proptest! {
        #[test]
        fn windows_cover_every_frame_once(
            frames in 0_usize..4000,
            fundamental_hz in 0.1..50.0_f64,
        ) {
            let record = vec![0.0; frames];
            let settings = PhaseSettings { fundamental_hz, ..SETTINGS };
            let windows = windows(&[&record], &settings).unwrap();
            let mut next = 0;
            for window in &windows {
                prop_assert_eq!(window.first, next);
                prop_assert!(window.end > window.first);
                next = window.end;
            }
            prop_assert_eq!(next, frames);
        }
    }
}
