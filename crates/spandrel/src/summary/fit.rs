//! The verdict on the fit, at the end and over the whole run.

use serde::Serialize;
use spandrel_bus::{EstimateFlags, FitReasons, FitVerdict, fit_in_words};
use std::collections::BTreeMap;

/// Verdict on the fit at the end of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FitSummary {
    /// Verdict after the last frame.
    pub verdict: FitVerdict,
    /// Reasons why the fit is not supported.
    pub reasons: FitReasons,
    /// Share of the frames with each verdict, without verdicts that have no frame.
    pub shares: BTreeMap<FitVerdict, f64>,
}

/// Collects the verdict of each frame.
#[derive(Debug, Clone, Default)]
pub(super) struct FitCollector {
    last: Option<(FitVerdict, FitReasons)>,
    frames: BTreeMap<FitVerdict, u64>,
}

impl FitCollector {
    pub(super) fn take(&mut self, flags: &EstimateFlags) {
        if let Some(verdict) = flags.fit {
            self.last = Some((verdict, flags.fit_reasons));
            *self.frames.entry(verdict).or_default() += 1;
        }
    }

    pub(super) fn finish(&self) -> Option<FitSummary> {
        let (verdict, reasons) = self.last?;
        let all: u64 = self.frames.values().sum();
        let shares = self
            .frames
            .iter()
            .map(|(verdict, frames)| (*verdict, *frames as f64 / all as f64));
        Some(FitSummary {
            verdict,
            reasons,
            shares: shares.collect(),
        })
    }
}

impl FitSummary {
    /// Returns the warning that the estimates have no meaning, if the data contradict the model at
    /// the end, or that they had none for more than a fifth of the time.
    ///
    /// The line of the verdict states the reasons.
    pub(super) fn warning(&self) -> Option<String> {
        let words = FitVerdict::Contradicted.words();
        if self.verdict == FitVerdict::Contradicted {
            return Some(format!("{words}; the estimates have no meaning"));
        }
        let share = *self.shares.get(&FitVerdict::Contradicted)?;
        (share > LARGEST_CONTRADICTED).then(|| {
            format!(
                "for {} of the time, {words}; the estimates can still be wrong",
                percent(share)
            )
        })
    }

    /// Returns the verdict with its reasons and the share of each verdict: `doubtful at the end
    /// (…); supported 90 % of the time`.
    pub fn words(&self) -> String {
        let shares = self
            .shares
            .iter()
            .map(|(verdict, share)| format!("{} {}", verdict.as_str(), percent(*share)));
        let shares: Vec<String> = shares.collect();
        let words = fit_in_words(self.verdict, self.reasons);
        format!(
            "{} at the end ({words}); {} of the time",
            self.verdict.as_str(),
            shares.join(", ")
        )
    }
}

/// Formats a share in per cent with one decimal, or with none if it is whole.
///
/// A share above 0 never reads as 0 %, and a share below 1 never as 100 %.
pub(super) fn percent(share: f64) -> String {
    let text = format!("{:.1}", 100.0 * share);
    match text.as_str() {
        "0.0" if share > 0.0 => return "below 0.1 %".to_owned(),
        "100.0" if share < 1.0 => return "above 99.9 %".to_owned(),
        _ => {}
    }
    format!("{} %", text.strip_suffix(".0").unwrap_or(&text))
}

/// Share of the time with a contradicted fit above which a summary warns of it.
const LARGEST_CONTRADICTED: f64 = 0.2;

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::FitReason;

    #[test]
    fn small_and_large_shares_are_not_rounded_to_0_and_100_percent() {
        assert_eq!(
            [0.0, 0.0004, 0.0006, 0.5, 0.9996, 1.0].map(percent),
            [
                "0 %",
                "below 0.1 %",
                "0.1 %",
                "50 %",
                "above 99.9 %",
                "100 %"
            ]
        );
    }

    #[test]
    fn summary_has_the_final_verdict_and_the_share_of_each() {
        let mut collector = FitCollector::default();
        assert_eq!(collector.finish(), None);
        let flags = |verdict, reasons: &[FitReason]| EstimateFlags {
            fit: Some(verdict),
            fit_reasons: reasons.iter().copied().collect(),
            ..EstimateFlags::working()
        };
        (0..3).for_each(|_| collector.take(&flags(FitVerdict::Supported, &[])));
        collector.take(&flags(FitVerdict::Contradicted, &[FitReason::ExcessNoise]));
        let summary = collector.finish().unwrap();
        assert_eq!(
            summary.words(),
            "contradicted at the end (the data contradict the model: the estimated noise is much \
             larger than the stated noise); supported 75 %, contradicted 25 % of the time"
        );
        let warning = "the data contradict the model; the estimates have no meaning";
        assert_eq!(summary.warning().as_deref(), Some(warning));
        let later = FitSummary {
            verdict: FitVerdict::Doubtful,
            ..summary.clone()
        };
        assert_eq!(
            later.warning().unwrap(),
            "for 25 % of the time, the data contradict the model; the estimates can still be wrong"
        );
        let json = serde_json::to_string(&summary).unwrap();
        assert_eq!(
            json,
            r#"{"verdict":"contradicted","reasons":["excess-noise"],"shares":{"supported":0.75,"contradicted":0.25}}"#
        );
    }
}
