//! Restart of a filter that has lost the structure and does not return.
//!
//! A motion that the model does not describe can move the parameters very far, for example yielding
//! in an earthquake. The linearised filter then stays at a wrong solution, although the structure
//! behaves like its model again. A restart from the prior finds the parameters.

use serde::{Deserialize, Serialize};
use spandrel_bus::{FitReason, FitVerdict};

use super::fit::Judged;

/// Half-lives of the filter for which the fit must be contradicted.
///
/// The measures of fit cover several half-lives themselves. A filter that returns by itself needs
/// about as long.
const HALF_LIVES: f64 = 6.0;

/// Maximum number of doublings of the time until the next restart, so that a wrong model does not
/// restart the filter for ever.
const MOST_DOUBLINGS: u32 = 10;

/// Counts how long the filter has been lost.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Recovery {
    /// Frames with a lost filter since the last frame with an acceptable fit.
    lost: u64,
    /// Successive frames with an acceptable fit.
    sound: u64,
    /// Restarts since the fit was acceptable for long.
    restarts: u32,
}

impl Recovery {
    /// Processes the verdict of a frame. Returns `true` if the filter must restart.
    ///
    /// `half_life` is that of the filter in frames. In strong motion, a contradicted fit shows
    /// nothing about the time after it.
    pub(super) fn take(&mut self, judged: Option<Judged>, is_strong: bool, half_life: f64) -> bool {
        let Some(judged) = judged else { return false };
        let patience = (HALF_LIVES * half_life) as u64;
        if judged.verdict != FitVerdict::Contradicted {
            self.lost = 0;
            self.sound += 1;
            if self.sound >= patience {
                self.restarts = 0;
            }
            return false;
        }
        self.sound = 0;
        let left_its_prior = [FitReason::ParameterAtBound, FitReason::FarFromPrior]
            .into_iter()
            .any(|reason| judged.reasons.contains(reason));
        if is_strong || !left_its_prior {
            return false;
        }
        self.lost += 1;
        let must_restart = self.lost >= patience << self.restarts;
        if must_restart {
            self.lost = 0;
            self.restarts = (self.restarts + 1).min(MOST_DOUBLINGS);
        }
        must_restart
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(verdict: FitVerdict, reasons: &[FitReason]) -> Option<Judged> {
        Some(Judged {
            verdict,
            reasons: reasons.iter().copied().collect(),
            follows_jump: false,
        })
    }

    fn restarts(recovery: &mut Recovery, frames: u64, judged: Option<Judged>) -> Vec<u64> {
        let mut take = |_: &u64| recovery.take(judged, false, 10.0);
        (1..=frames).filter(|frame| take(frame)).collect()
    }

    #[test]
    fn lost_filter_restarts_less_and_less_often_until_the_fit_is_acceptable() {
        let lost = judged(FitVerdict::Contradicted, &[FitReason::FarFromPrior]);
        let mut recovery = Recovery::default();
        assert_eq!(restarts(&mut recovery, 500, lost), [60, 180, 420]);
        let doubtful = judged(FitVerdict::Doubtful, &[]);
        assert!(restarts(&mut recovery, 60, doubtful).is_empty());
        assert_eq!(restarts(&mut recovery, 100, lost), [60]);
    }

    #[test]
    fn strong_motion_and_parameters_within_their_prior_restart_nothing() {
        let mut recovery = Recovery::default();
        let noisy = judged(FitVerdict::Contradicted, &[FitReason::ExcessNoise]);
        assert!(restarts(&mut recovery, 500, noisy).is_empty());
        let lost = judged(FitVerdict::Contradicted, &[FitReason::ParameterAtBound]);
        assert!((0..500).all(|_| !recovery.take(lost, true, 10.0)));
        assert!(restarts(&mut recovery, 500, None).is_empty());
    }
}
