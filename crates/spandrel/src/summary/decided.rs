//! For how much of the time alerts were decided.

use super::fit::percent;
use serde::Serialize;
use spandrel_alert::DecidedFrames;
use spandrel_bus::UndecidedBecause;
use std::collections::BTreeMap;

/// Shares of the frames of one parameter since its reference was known.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DecidedSummary {
    /// Share of the frames that were decided on.
    pub share: f64,
    /// Share of the frames that were not, by reason; reasons without a frame are left out.
    pub undecided: BTreeMap<UndecidedBecause, f64>,
}

impl DecidedSummary {
    /// Takes the frames of a parameter; `None` before its reference was known.
    pub(super) fn of(frames: &DecidedFrames) -> Option<Self> {
        let share = frames.share()?;
        let of_all = |count: u64| count as f64 / frames.frames() as f64;
        let undecided = frames.undecided().map(|(because, count)| (because, of_all(count))).collect();
        Some(Self { share, undecided })
    }

    /// The shares in words: `decided 98.2 % of the time; undecided 1.8 %: the data contradict the model`.
    pub(super) fn words(&self) -> String {
        let mut text = format!("decided {} of the time", percent(self.share));
        for (index, (because, share)) in self.undecided.iter().enumerate() {
            let separator = if index == 0 { "; undecided " } else { ", " };
            text.push_str(&format!("{separator}{}: {}", percent(*share), because.words()));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_told_with_their_reasons() {
        let undecided = [(UndecidedBecause::NothingLearnt, 0.1), (UndecidedBecause::FitContradicted, 0.018)].into();
        let summary = DecidedSummary { share: 0.882, undecided };
        assert_eq!(
            summary.words(),
            "decided 88.2 % of the time; undecided 1.8 %: the data contradict the model, 10 %: the estimate is too \
             uncertain to show a loss of twice the rule's"
        );
        assert_eq!(DecidedSummary::of(&DecidedFrames::default()), None);
    }
}
