//! Shares of the time with each verdict.

use spandrel_bus::{FitReason, FitReasons, FitVerdict};

/// Numbers of frames in normal operation, by the state of the fit.
#[derive(Debug, Clone, Default)]
pub(super) struct Shares {
    working: u64,
    /// Frames with a verdict that no measure supports.
    unmeasured: u64,
    /// Frames with each verdict, outside the time after a change and within it.
    settled: [u64; 3],
    after_a_change: [u64; 3],
    /// Frames with each reason, outside the time after a change.
    reasons: [u64; FitReason::ALL.len()],
    /// Intervals outside the time after a change that contain the truth, and all of them. The first
    /// entry counts frames with a supported fit, the second all others.
    held: [(u64, u64); 2],
}

/// Fit of one frame in normal operation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Judgement {
    pub(super) verdict: Option<FitVerdict>,
    pub(super) reasons: FitReasons,
    pub(super) is_measured: bool,
    pub(super) follows_a_change: bool,
    /// Number of parameters whose 95 % interval contains the truth, and of all parameters.
    pub(super) held: (u64, u64),
}

impl Shares {
    /// Adds one frame of normal operation.
    pub(super) fn take(&mut self, judgement: Judgement) {
        self.working += 1;
        let Some(verdict) = judgement.verdict else {
            return;
        };
        if !judgement.is_measured {
            self.unmeasured += 1;
        } else if judgement.follows_a_change {
            self.after_a_change[verdict as usize] += 1;
        } else {
            self.settled[verdict as usize] += 1;
            judgement
                .reasons
                .iter()
                .for_each(|reason| self.reasons[reason as usize] += 1);
            let held = &mut self.held[usize::from(verdict != FitVerdict::Supported)];
            *held = (held.0 + judgement.held.0, held.1 + judgement.held.1);
        }
    }

    /// Returns the share of the frames with a verdict that no measure supports.
    pub(super) fn unmeasured(&self) -> f64 {
        self.unmeasured as f64 / self.working as f64
    }

    /// Returns the share of the judged time with a verdict, outside the time after a change.
    pub(super) fn settled(&self, verdict: FitVerdict) -> f64 {
        share(&self.settled, verdict)
    }

    /// Returns `true` if a parameter changed while the fit was judged.
    pub(super) fn changes(&self) -> bool {
        self.after_a_change.iter().any(|frames| *frames > 0)
    }

    /// Returns the share of the time after a change with a verdict.
    pub(super) fn after_a_change(&self, verdict: FitVerdict) -> f64 {
        share(&self.after_a_change, verdict)
    }

    /// Returns the share of the 95 % intervals that contain the truth: with a supported fit, and
    /// otherwise.
    pub(super) fn held(&self) -> [f64; 2] {
        self.held.map(|(held, all)| held as f64 / all as f64)
    }

    /// Returns each reason given outside the time after a change, with its share of the judged
    /// time.
    pub(super) fn reasons(&self) -> impl Iterator<Item = (FitReason, f64)> {
        let judged = self.settled.iter().sum::<u64>() as f64;
        let share =
            move |reason: FitReason| (reason, self.reasons[reason as usize] as f64 / judged);
        FitReason::ALL
            .into_iter()
            .map(share)
            .filter(|(_, share)| *share > 0.0)
    }
}

/// Returns the share of the frames with a verdict, NaN without frames.
fn share(frames: &[u64; 3], verdict: FitVerdict) -> f64 {
    frames[verdict as usize] as f64 / frames.iter().sum::<u64>() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn judgements_without_data_and_after_a_change_do_not_count() {
        let mut shares = Shares::default();
        let judgement = Judgement {
            verdict: Some(FitVerdict::Supported),
            reasons: FitReasons::default(),
            is_measured: false,
            follows_a_change: false,
            held: (1, 2),
        };
        let doubt = Judgement {
            verdict: Some(FitVerdict::Doubtful),
            reasons: [FitReason::ExcessNoise].into_iter().collect(),
            is_measured: true,
            ..judgement
        };
        shares.take(judgement);
        assert!(
            shares.settled(FitVerdict::Supported).is_nan(),
            "nothing is judged yet"
        );
        shares.take(Judgement {
            follows_a_change: true,
            ..doubt
        });
        shares.take(doubt);
        shares.take(Judgement {
            is_measured: true,
            ..judgement
        });
        assert_eq!(shares.unmeasured(), 0.25);
        assert_eq!(
            VERDICTS.map(|verdict| shares.settled(verdict)),
            [0.5, 0.5, 0.0]
        );
        assert_eq!(shares.after_a_change(FitVerdict::Doubtful), 1.0);
        assert_eq!(shares.held(), [0.5, 0.5]);
        assert_eq!(
            shares.reasons().collect::<Vec<_>>(),
            [(FitReason::ExcessNoise, 0.5)]
        );
    }

    const VERDICTS: [FitVerdict; 3] = super::super::VERDICTS;
}
