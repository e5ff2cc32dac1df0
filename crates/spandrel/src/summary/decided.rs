//! Share of the time in which alerts were decided.

use super::fit::percent;
use serde::Serialize;
use spandrel_alert::DecidedFrames;
use spandrel_bus::UndecidedBecause;
use std::collections::BTreeMap;

/// Share of the time with decisions below which a summary warns.
const LEAST_DECIDED: f64 = 0.5;

/// Shares of the frames of one parameter since its reference was known.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DecidedSummary {
    /// Share of frames with a decision, 0 to 1.
    pub share: f64,
    /// Share of undecided frames by reason, without reasons that have no frame.
    pub undecided: BTreeMap<UndecidedBecause, f64>,
}

impl DecidedSummary {
    /// Returns the warning about parameters that were decided for less than half of the time.
    pub(super) fn warning<'a>(all: impl Iterator<Item = (&'a str, &'a Self)>) -> Option<String> {
        let (names, shares): (Vec<&str>, Vec<f64>) = all
            .filter(|(_, summary)| summary.share < LEAST_DECIDED)
            .map(|(name, summary)| (name, summary.share))
            .unzip();
        (!names.is_empty()).then(|| {
            format!(
                "alerts of {} were decided for only {} of the time, so that a loss can be missed",
                names.join(", "),
                range(shares.into_iter())
            )
        })
    }

    /// Returns the shares of a parameter, or `None` if its reference never became known.
    pub(super) fn of(frames: &DecidedFrames) -> Option<Self> {
        let share = frames.share()?;
        let of_all = |count: u64| count as f64 / frames.frames() as f64;
        let undecided = frames
            .undecided()
            .map(|(because, count)| (because, of_all(count)))
            .collect();
        Some(Self { share, undecided })
    }

    /// Returns the shares in words: `decided 98.2 % of the time; undecided 1.8 %: the data
    /// contradict the model`.
    pub(super) fn words(&self) -> String {
        Self::words_of(std::slice::from_ref(self)).unwrap_or_default()
    }

    /// Returns the lowest and highest shares of several parameters with the same reasons, in words.
    /// Returns `None` if the reasons differ.
    pub(super) fn words_of(all: &[Self]) -> Option<String> {
        let first = all.first()?;
        if !all
            .iter()
            .all(|summary| summary.undecided.keys().eq(first.undecided.keys()))
        {
            return None;
        }
        let mut text = format!(
            "decided {} of the time",
            range(all.iter().map(|summary| summary.share))
        );
        for (index, because) in first.undecided.keys().enumerate() {
            let separator = if index == 0 { "; undecided " } else { ", " };
            let shares = range(
                all.iter()
                    .filter_map(|summary| summary.undecided.get(because))
                    .copied(),
            );
            text.push_str(&format!("{separator}{shares}: {}", because.words()));
        }
        Some(text)
    }
}

/// Returns the lowest and the highest share: `93.7 to 97.3 %`.
fn range(shares: impl Iterator<Item = f64>) -> String {
    let (low, high) = shares.fold((1.0, 0.0), |(low, high): (f64, f64), share| {
        (low.min(share), high.max(share))
    });
    let (low, high) = (percent(low), percent(high));
    if low == high {
        return low;
    }
    format!("{} to {high}", low.strip_suffix(" %").unwrap_or(&low))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn little_decided_time_is_a_warning() {
        let of = |share| DecidedSummary {
            share,
            undecided: BTreeMap::new(),
        };
        let all = [
            ("storey-1".to_owned(), of(0.12)),
            ("storey-2".to_owned(), of(0.9)),
            ("storey-3".to_owned(), of(0.25)),
        ];
        let warning = |all: &[(String, DecidedSummary)]| {
            DecidedSummary::warning(all.iter().map(|(name, summary)| (name.as_str(), summary)))
        };
        assert_eq!(
            warning(&all).unwrap(),
            "alerts of storey-1, storey-3 were decided for only 12 to 25 % of the time, so that a \
             loss can be missed"
        );
        assert_eq!(warning(&all[1..2]), None);
    }

    #[test]
    fn summary_lists_shares_with_their_reasons() {
        let undecided = [
            (UndecidedBecause::NothingLearnt, 0.1),
            (UndecidedBecause::FitContradicted, 0.018),
        ]
        .into();
        let summary = DecidedSummary {
            share: 0.882,
            undecided,
        };
        assert_eq!(
            summary.words(),
            "decided 88.2 % of the time; undecided 1.8 %: the data contradict the model, 10 %: \
             the estimate or its reference is too uncertain to reveal even twice the loss of the \
             rule"
        );
        assert_eq!(DecidedSummary::of(&DecidedFrames::default()), None);
    }

    #[test]
    fn parameters_with_the_same_reasons_share_a_sentence() {
        let summary = |share, because| DecidedSummary {
            share,
            undecided: [(because, 1.0 - share)].into(),
        };
        let training = UndecidedBecause::NoiseTraining;
        let alike = [summary(0.95, training), summary(0.935, training)];
        assert_eq!(
            DecidedSummary::words_of(&alike).as_deref(),
            Some(
                "decided 93.5 to 95 % of the time; undecided 5 to 6.5 %: the filter is still \
                 learning its noise levels"
            )
        );
        let differing = [
            summary(0.95, training),
            summary(0.95, UndecidedBecause::FitContradicted),
        ];
        assert_eq!(DecidedSummary::words_of(&differing), None);
    }
}
