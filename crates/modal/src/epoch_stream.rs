//! Frames with gaps, cut into epochs. A live stream and a recording use the same rule.

use crate::ladder::{BandLadder, LadderEpoch};
use crate::{ModalError, ModalSettings};
use serde::{Deserialize, Serialize};

/// Duration without any sample after which a new epoch starts (s). Shorter gaps repeat the last
/// values.
pub const LONGEST_GAP_S: f64 = 1.0;

/// Cuts frames into epochs, and starts a new epoch after a long gap.
///
/// The state can be serialised at any frame and continues bit-identically.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpochStream {
    ladder: BandLadder,
    /// Number of frames without any sample that is a long gap.
    longest_gap: u64,
    /// Number of frames without any sample up to now, at most `longest_gap`.
    missing: u64,
}

impl EpochStream {
    /// Cuts frames at `rate_hz` (Hz) into the epochs of a ladder without frames.
    #[must_use]
    pub fn new(ladder: BandLadder, rate_hz: f64) -> Self {
        Self {
            ladder,
            longest_gap: ((LONGEST_GAP_S * rate_hz).round() as u64).max(1),
            missing: 0,
        }
    }

    /// Returns the settings of each band, from the highest to the lowest.
    pub fn settings(&self) -> impl Iterator<Item = &ModalSettings> {
        self.ladder.settings()
    }

    /// Returns the number of frames without any sample that is a long gap. Further frames without a
    /// sample change nothing.
    #[must_use]
    pub fn longest_gap(&self) -> u64 {
        self.longest_gap
    }

    /// Adds a frame: one value per channel, `NaN` if missing. Returns an epoch if one is complete.
    ///
    /// # Errors
    /// Returns an error if the frame has another number of values than the settings have channels.
    pub fn push(&mut self, frame: &[f64]) -> Result<Option<LadderEpoch>, ModalError> {
        if frame.iter().any(|value| !value.is_nan()) {
            self.missing = 0;
            return self.ladder.push(frame);
        }
        if self.missing >= self.longest_gap {
            return Ok(None);
        }
        self.missing += 1;
        if self.missing == self.longest_gap {
            self.ladder.gap();
            return Ok(None);
        }
        self.ladder.push(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 20.0;

    fn stream() -> EpochStream {
        let settings = ModalSettings {
            epoch_s: 160.0,
            ..ModalSettings::new(2, RATE_HZ)
        };
        EpochStream::new(BandLadder::single(&settings).unwrap(), RATE_HZ)
    }

    /// Pushes frames of noise until one completes an epoch, and returns their number.
    fn frames_until_epoch(stream: &mut EpochStream, before: impl Fn(u64) -> bool) -> u64 {
        let mut noise = 1_u32;
        for frame in 1..100_000 {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let value = f64::from(noise) / f64::from(u32::MAX);
            let frame_values = match before(frame) {
                true => [f64::NAN; 2],
                false => [value, -value * value],
            };
            if stream.push(&frame_values).unwrap().is_some() {
                return frame;
            }
        }
        panic!("no epoch");
    }

    #[test]
    fn a_gap_of_a_second_starts_a_new_epoch_and_a_shorter_one_does_not() {
        let whole = frames_until_epoch(&mut stream(), |_| false);
        let short = frames_until_epoch(&mut stream(), |frame| (1000..1019).contains(&frame));
        assert_eq!(short, whole);
        let long = frames_until_epoch(&mut stream(), |frame| (1000..1500).contains(&frame));
        assert_eq!(long, 1499 + whole);
    }
}
