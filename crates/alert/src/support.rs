//! Determines whether the data support a decision, and counts how often they did.
//!
//! Notation as in [`credibility`](crate::credibility): r mean of the reference, L loss of the rule.

use serde::{Deserialize, Serialize};
use spandrel_bus::{EstimateFlags, FitVerdict, UndecidedBecause};

use crate::{ParameterEstimate, Reference, Rule, probability_of_loss};

/// Time for which a change between decided and undecided must last, ns of measurement time.
const PERSISTS_NS: i64 = 1_000_000_000;
/// Factor on the standard deviation while a parameter counts as too uncertain. It prevents flapping
/// between decided and undecided.
const LEARNT_AGAIN: f64 = 1.1;

/// Whether alerts of a parameter are decided.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Support {
    because: Option<UndecidedBecause>,
    /// Time since which the frames have indicated a different state, ns.
    otherwise_since_ns: Option<i64>,
}

impl Support {
    /// Returns the reason why no decision is possible. `None` while alerts are decided.
    pub(crate) fn undecided_because(&self) -> Option<UndecidedBecause> {
        self.because
    }

    /// Returns `true` if the last frame permits a decision.
    pub(crate) fn decides(&self) -> bool {
        self.because.is_none() && self.otherwise_since_ns.is_none()
    }

    /// Records the reason that prevents a decision on the frame at `time_ns`, if any.
    pub(crate) fn take(&mut self, found: Option<UndecidedBecause>, time_ns: i64) {
        if found == self.because {
            self.otherwise_since_ns = None;
            return;
        }
        // A replayed record starts at an earlier time.
        let since_ns = self
            .otherwise_since_ns
            .filter(|since_ns| *since_ns <= time_ns)
            .unwrap_or(time_ns);
        let is_lasting = time_ns.saturating_sub(since_ns) >= PERSISTS_NS;
        *self = match is_lasting {
            true => Self {
                because: found,
                otherwise_since_ns: None,
            },
            false => Self {
                otherwise_since_ns: Some(since_ns),
                ..*self
            },
        };
    }

    /// Returns `true` if a loss of twice the rule's loss would raise an alert.
    ///
    /// With a loss of 2L, the estimate has the mean (1 − 2L)·r. The probability that it exceeds L
    /// is Φ(L·r/√(s² + (1 − L)²·s_r²)). If the rule's loss exceeds one half, a total loss replaces
    /// 2L. The test does not apply to a rule with a loss of 0 or 1.
    pub(crate) fn shows_losses(
        &self,
        estimate: &ParameterEstimate,
        reference: &Reference,
        rule: &Rule,
    ) -> bool {
        let loss = rule.loss();
        if loss <= 0.0 || loss >= 1.0 {
            return true;
        }
        let mean = (1.0 - twice(rule)) * reference.mean();
        let of_twice_the_loss = ParameterEstimate {
            mean,
            ..self.cautious(estimate)
        };
        probability_of_loss(&of_twice_the_loss, reference, loss) >= rule.credibility()
    }

    /// Returns `true` if the estimate excludes a loss of twice the rule's loss: its probability is
    /// at most 1 minus the credibility.
    ///
    /// The distance from a sound structure to a loss of 2L exceeds the distance from that loss to
    /// L. An estimate can therefore exclude the loss although it is too uncertain to raise an
    /// alert.
    pub(crate) fn excludes_losses(
        &self,
        estimate: &ParameterEstimate,
        reference: &Reference,
        rule: &Rule,
    ) -> bool {
        probability_of_loss(&self.cautious(estimate), reference, twice(rule))
            <= 1.0 - rule.credibility()
    }

    /// Returns the estimate, with a larger deviation while the parameter counts as too uncertain.
    fn cautious(&self, estimate: &ParameterEstimate) -> ParameterEstimate {
        let slack = if self.because == Some(UndecidedBecause::NothingLearnt) {
            LEARNT_AGAIN
        } else {
            1.0
        };
        ParameterEstimate {
            std: slack * estimate.std,
            ..*estimate
        }
    }
}

/// Returns twice the loss of a rule, limited to a total loss.
fn twice(rule: &Rule) -> f64 {
    (2.0 * rule.loss()).min(1.0)
}

/// Returns `true` if an estimate lies at one of the bounds (ratios to nominal) of its parameter.
///
/// The filter moves an estimate outside the bounds to the nearest bound. The next steps then shift
/// it by a fraction of its standard deviation. An estimate within one standard deviation therefore
/// still counts as at the bound.
pub(crate) fn is_on_bound(estimate: &ParameterEstimate, bounds: (f64, f64)) -> bool {
    estimate.mean - bounds.0 <= estimate.std || bounds.1 - estimate.mean <= estimate.std
}

/// A sudden change that the filter follows, including further jumps shortly afterwards.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Jump {
    first: Option<FirstJump>,
    /// Time of the last frame whose fit was supported, ns.
    supported_ns: Option<i64>,
    /// Start of the last jump, ns.
    last_ns: i64,
    /// End of the last jump, ns. `None` while the filter follows it.
    over_since_ns: Option<i64>,
}

/// The first of several jumps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct FirstJump {
    start_ns: i64,
    /// Whether the fit was supported until the jump. The verdict can change before the filter
    /// follows the jump.
    was_supported: bool,
}

/// Time without new alerts after the start of a jump, ns of measurement time.
///
/// After a loss of 60 % in one of five storeys, the estimates of sound storeys were wrong for up to
/// 6 s. The fit was already supported again.
const HELD_NS: i64 = 8_000_000_000;

/// Maximum time without new alerts after the first jump, ns of measurement time.
///
/// It applies while the verdict on the fit is worse than before the jump. If the fit remained
/// doubtful after a loss of 60 %, the estimates of sound storeys were up to 35 % too low for 20 s.
/// Their intervals were narrow.
const LONGEST_HELD_NS: i64 = 30_000_000_000;

impl Jump {
    /// Processes a frame. A jump that restarts within a second counts as the same jump.
    pub(crate) fn take(&mut self, flags: &EstimateFlags, time_ns: i64) {
        let is_recent = |since_ns: Option<i64>| {
            since_ns.is_some_and(|since_ns| is_within(PERSISTS_NS, since_ns, time_ns))
        };
        if flags.follows_jump {
            let first = self.first.filter(|first| first.start_ns <= time_ns);
            if first.is_none() || (self.over_since_ns.is_some() && !is_recent(self.over_since_ns)) {
                self.last_ns = time_ns;
            }
            let was_supported = is_recent(self.supported_ns);
            self.first = first.or(Some(FirstJump {
                start_ns: time_ns,
                was_supported,
            }));
            self.over_since_ns = None;
        } else if self.first.is_some() {
            self.over_since_ns = self.over_since_ns.or(Some(time_ns));
            if !is_recent(self.over_since_ns) && !self.holds(flags.fit, time_ns) {
                (self.first, self.over_since_ns) = (None, None);
            }
        }
        if flags.fit == Some(FitVerdict::Supported) {
            self.supported_ns = Some(time_ns);
        }
    }

    /// Returns `true` while the jump prevents new alerts. `fit` is the verdict at the frame.
    pub(crate) fn holds(&self, fit: Option<FitVerdict>, time_ns: i64) -> bool {
        self.first.is_some_and(|first| {
            let is_worse =
                first.was_supported && fit.is_some_and(|fit| fit > FitVerdict::Supported);
            is_within(HELD_NS, self.last_ns, time_ns)
                || (is_worse && is_within(LONGEST_HELD_NS, first.start_ns, time_ns))
        })
    }
}

/// Returns `true` if `time_ns` lies within `span_ns` from `since_ns`, end excluded.
fn is_within(span_ns: i64, since_ns: i64, time_ns: i64) -> bool {
    (0..span_ns).contains(&time_ns.saturating_sub(since_ns))
}

/// Number of frames since the reference was known, and how many of them had no decision.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DecidedFrames {
    frames: u64,
    undecided: [u64; UndecidedBecause::ALL.len()],
}

impl DecidedFrames {
    /// Counts a frame.
    pub(crate) fn count(&mut self, undecided_because: Option<UndecidedBecause>) {
        self.frames += 1;
        if let Some(count) =
            undecided_because.and_then(|because| self.undecided.get_mut(because as usize))
        {
            *count += 1;
        }
    }

    /// Returns the sum of both counts.
    #[must_use]
    pub fn plus(mut self, other: &Self) -> Self {
        self.frames += other.frames;
        self.undecided
            .iter_mut()
            .zip(other.undecided)
            .for_each(|(count, others)| *count += others);
        self
    }

    /// Returns the number of frames.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Returns the number of frames without a decision, by reason. Reasons that did not occur are
    /// omitted.
    pub fn undecided(&self) -> impl Iterator<Item = (UndecidedBecause, u64)> {
        UndecidedBecause::ALL
            .into_iter()
            .zip(self.undecided)
            .filter(|(_, count)| *count > 0)
    }

    /// Returns the share of frames with a decision, 0 to 1. `None` if there are no frames.
    #[must_use]
    pub fn share(&self) -> Option<f64> {
        let undecided: u64 = self.undecided.iter().sum();
        (self.frames > 0).then(|| 1.0 - undecided as f64 / self.frames as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn estimate(mean: f64, std: f64) -> ParameterEstimate {
        ParameterEstimate {
            time_ns: 0,
            mean,
            std,
        }
    }

    #[test]
    fn change_counts_after_one_second() {
        let mut support = Support::default();
        let contradicted = Some(UndecidedBecause::FitContradicted);
        support.take(contradicted, 0);
        assert!(!support.decides() && support.undecided_because().is_none());
        support.take(None, S / 2);
        assert!(support.decides(), "half a second is no change");
        support.take(contradicted, S);
        support.take(contradicted, 2 * S - 1);
        assert_eq!(support.undecided_because(), None);
        support.take(contradicted, 2 * S);
        assert_eq!(support.undecided_because(), contradicted);
        support.take(None, 3 * S);
        assert_eq!(
            (support.undecided_because(), support.decides()),
            (contradicted, false)
        );
        support.take(None, 4 * S);
        assert!(support.decides());
    }

    #[test]
    fn loss_is_detectable_if_twice_the_rule_would_be_raised() {
        // 5 % with 95 %: Φ⁻¹(0.95) = 1.644854 (Abramowitz & Stegun, table 26.5), so s =
        // 0.05/1.644854 = 0.030398.
        let rule = Rule::new(0.05, 0.95, 0.5, 10.0).unwrap();
        let shows = |support: &Support, std: f64| {
            support.shows_losses(&estimate(1.0, std), &Reference::DESIGN, &rule)
        };
        let decided = Support::default();
        assert!(shows(&decided, 0.0303) && !shows(&decided, 0.0305));
        let undecided = Support {
            because: Some(UndecidedBecause::NothingLearnt),
            otherwise_since_ns: None,
        };
        assert!(
            !shows(&undecided, 0.0303) && shows(&undecided, 0.0303 / 1.1),
            "what was not learnt has to be learnt well"
        );
        // (1 − L)·s_r = 0.95·0.03 = 0.0285; with s = 0.0105 the hypotenuse is 0.03037, with 0.0110
        // it is 0.03055.
        let learnt = Reference::new(1.0, 0.03).unwrap();
        let shows = |std: f64| decided.shows_losses(&estimate(1.0, std), &learnt, &rule);
        assert!(shows(0.0105) && !shows(0.0110));
    }

    #[test]
    fn sound_estimate_can_exclude_twice_the_rule_without_being_able_to_show_it() {
        // A loss of 10 % differs from the sound value by 0.1: s = 0.1/1.644854 = 0.060796.
        let rule = Rule::new(0.05, 0.95, 0.5, 10.0).unwrap();
        let excludes = |support: &Support, std: f64| {
            support.excludes_losses(&estimate(1.0, std), &Reference::DESIGN, &rule)
        };
        let decided = Support::default();
        assert!(excludes(&decided, 0.0607) && !excludes(&decided, 0.0609));
        assert!(!decided.shows_losses(&estimate(1.0, 0.0607), &Reference::DESIGN, &rule));
        let undecided = Support {
            because: Some(UndecidedBecause::NothingLearnt),
            otherwise_since_ns: None,
        };
        assert!(!excludes(&undecided, 0.0607) && excludes(&undecided, 0.0607 / 1.1));
    }

    #[test]
    fn rule_above_half_requires_that_a_total_loss_is_detectable() {
        // 70 % with 95 %: s = 0.3/1.644854 = 0.18239.
        let rule = Rule::new(0.7, 0.95, 0.5, 10.0).unwrap();
        let shows = |std: f64| {
            Support::default().shows_losses(&estimate(1.0, std), &Reference::DESIGN, &rule)
        };
        assert!(shows(0.182) && !shows(0.183));
        let nothing = Rule::new(0.0, 0.95, 0.5, 10.0).unwrap();
        assert!(Support::default().shows_losses(&estimate(1.0, 0.3), &Reference::DESIGN, &nothing));
    }

    #[test]
    fn estimate_within_one_deviation_of_a_bound_is_on_the_bound() {
        let bounds = (0.1, 2.0);
        assert!(
            is_on_bound(&estimate(0.1, 0.0), bounds) && is_on_bound(&estimate(1.995, 0.01), bounds)
        );
        assert!(!is_on_bound(&estimate(0.12, 0.01), bounds));
    }

    /// Processes half-second jumps at `jumps` (s). Returns the last time (s) at which alerts are
    /// held.
    fn held_until(jumps: &[i64], fit_after: FitVerdict) -> f64 {
        let (mut jump, mut last) = (Jump::default(), 0.0);
        for tenth in 0..1000 {
            let time_ns = tenth * S / 10;
            let follows_jump = jumps
                .iter()
                .any(|start| (0..5).contains(&(tenth - 10 * start)));
            // The verdict changes half a second before the filter follows the jump.
            let is_after = jumps.iter().any(|start| tenth > 10 * start - 5);
            let fit = Some(if is_after {
                fit_after
            } else {
                FitVerdict::Supported
            });
            jump.take(
                &EstimateFlags {
                    follows_jump,
                    fit,
                    ..EstimateFlags::working()
                },
                time_ns,
            );
            if jump.holds(fit, time_ns) {
                last = tenth as f64 / 10.0;
            }
        }
        last
    }

    #[test]
    fn jump_holds_alerts_for_eight_seconds() {
        assert_eq!(held_until(&[10], FitVerdict::Supported), 17.9);
        assert_eq!(held_until(&[10, 15], FitVerdict::Supported), 22.9);
    }

    #[test]
    fn jump_with_a_doubtful_fit_holds_alerts_for_thirty_seconds() {
        assert_eq!(held_until(&[10], FitVerdict::Doubtful), 39.9);
        assert_eq!(
            held_until(&[10, 30], FitVerdict::Doubtful),
            39.9,
            "later jumps do not prolong it"
        );
        assert_eq!(
            held_until(&[10, 35], FitVerdict::Doubtful),
            42.9,
            "but for their own eight seconds"
        );
    }

    #[test]
    fn earlier_doubtful_fit_does_not_prolong_the_hold() {
        let mut jump = Jump::default();
        let doubtful = EstimateFlags {
            fit: Some(FitVerdict::Doubtful),
            ..EstimateFlags::working()
        };
        jump.take(
            &EstimateFlags {
                follows_jump: true,
                ..doubtful
            },
            0,
        );
        assert!(jump.holds(doubtful.fit, 8 * S - 1) && !jump.holds(doubtful.fit, 8 * S));
    }

    #[test]
    fn share_is_the_fraction_of_decided_frames() {
        let mut decided = DecidedFrames::default();
        assert_eq!(decided.share(), None);
        for frame in 0..8 {
            decided.count((frame < 2).then_some(UndecidedBecause::NothingLearnt));
        }
        assert_eq!((decided.frames(), decided.share()), (8, Some(0.75)));
        let both = decided.plus(&decided);
        assert_eq!(
            both.undecided().collect::<Vec<_>>(),
            [(UndecidedBecause::NothingLearnt, 4)]
        );
    }
}
