//! Credibility of a loss.
//!
//! Estimate and reference are independent, and the estimate is normal. The reference is normal too,
//! unless its scatter was estimated from few records. It is then the sum of a normal and a Student
//! variable (`scatter`).
//!
//! Notation:
//!
//! - m, s: mean and standard deviation of the parameter, as ratios to nominal
//! - r, s_r: mean and standard deviation of the reference, as ratios to nominal
//! - L: loss, 1 − parameter/reference
//! - Φ: standard normal distribution function
//!
//! Source of the interval of a quotient: E. C. Fieller, *Some problems in interval estimation*, J.
//! R. Stat. Soc. B 16 (1954), 175-185. Independence errs on the safe side if the reference was
//! learnt from the same filter, because common errors would cancel.

use serde::{Deserialize, Serialize};
use spandrel_bus::{CredibleInterval, LossDisplay, Name};
use spandrel_modal::normal_cdf;

use crate::Reference;
use crate::scatter::{NormalPlusStudent, root};

/// Mean and standard deviation of a parameter at one time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ParameterEstimate {
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Mean, ratio to nominal.
    pub mean: f64,
    /// Standard deviation, ratio to nominal.
    pub std: f64,
}

impl ParameterEstimate {
    /// Returns the 95 % interval of the parameter, m ± 1.96 s, as a ratio to nominal. It contains
    /// the uncertainty of this record only, not the scatter between records.
    pub fn interval(&self) -> CredibleInterval {
        CredibleInterval::of_normal(self.mean, self.std)
    }
}

/// A loss and its 95 % interval, as shares of the reference (0.1 = 10 %).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LossEstimate {
    /// The loss at the means, 1 − m/r.
    pub loss: f64,
    /// The loss is more than this with probability 0.975.
    pub low: f64,
    /// The loss is less than this with probability 0.975.
    pub high: f64,
}

impl LossEstimate {
    /// Returns the interval for a message. No stiffness is negative, so that a loss is at most 1.
    pub(crate) fn interval(&self) -> CredibleInterval {
        CredibleInterval {
            level: 0.95,
            low: self.low,
            high: self.high.min(1.0),
        }
    }
}

/// The loss of one parameter under one rule at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterLoss {
    /// Index of the parameter in state order.
    pub parameter: usize,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The loss with its interval.
    pub loss: LossEstimate,
    /// Probability that the loss exceeds that of the rule.
    pub probability: f64,
    /// Loss of the rule, as a share of the reference.
    pub rule_loss: f64,
    /// Probability of the loss at and above which the rule raises an alert, 0 to 1.
    pub rule_credibility: f64,
    /// The reference.
    pub reference: Reference,
}

impl ParameterLoss {
    /// Returns the display message. `parameter` is the name of the parameter.
    pub fn to_message(&self, structure: &Name, parameter: &Name) -> LossDisplay {
        LossDisplay {
            structure: structure.clone(),
            parameter: parameter.clone(),
            time_ns: self.time_ns,
            loss: self.loss.loss,
            interval: self.loss.interval(),
            probability_of_loss: self.probability,
            rule_loss: self.rule_loss,
            rule_credibility: self.rule_credibility,
            reference: self.reference.mean(),
            reference_std: self.reference.std(),
        }
    }
}

/// Returns the probability that the parameter has lost more than `loss` (L, share of the reference,
/// 0 to 1).
///
/// P = Φ(((1 − L)·r − m) / √(s² + (1 − L)²·s_r²)), because the parameter minus (1 − L) times the
/// reference is normal. The symbols m and s are the mean and the standard deviation of `estimate`,
/// r and s_r those of `reference`. The function Φ is the standard normal distribution function.
///
/// If the scatter between records was estimated ([`Reference::scatter`]), the reference is the sum
/// of a normal and a Student t variable. The distribution function of the sum then replaces Φ.
pub fn probability_of_loss(estimate: &ParameterEstimate, reference: &Reference, loss: f64) -> f64 {
    let kept = 1.0 - loss;
    let margin = kept * reference.mean() - estimate.mean;
    if let Some(sum) = reference
        .deviation(estimate.std, kept)
        .filter(NormalPlusStudent::is_wide)
    {
        return sum.cdf(margin);
    }
    let std = estimate.std.hypot(kept * reference.std());
    if std == 0.0 {
        return if margin > 0.0 { 1.0 } else { 0.0 };
    }
    normal_cdf(margin / std)
}

/// Returns the loss against the reference with its 95 % interval.
///
/// The interval refers to the structure, so it contains the error of the model. It
/// increases s² by (0.05·(r − m))². The rules compare losses as the model measures them, so
/// [`probability_of_loss`] does not contain it.
///
/// The ends are the values of L for which [`probability_of_loss`], with this s, is 0.975 and 0.025
/// (Fieller 1954). They are the roots q = 1 − L of (r² − z²·s_r²)·q² − 2·m·r·q + m² − z²·s² = 0. A
/// [`Reference`] is at least three standard deviations from zero. The first coefficient is
/// therefore positive and the interval finite. With scatter from few records, the function finds
/// the ends numerically.
pub fn loss_estimate(estimate: &ParameterEstimate, reference: &Reference) -> LossEstimate {
    loss_as_modelled(&with_model_error(estimate, reference), reference)
}

/// Returns the loss against the reference with its 95 % interval, as the model measures it.
///
/// The error of the model is the same in two losses of one parameter. Two such losses are therefore
/// compared without it.
pub(crate) fn loss_as_modelled(
    estimate: &ParameterEstimate,
    reference: &Reference,
) -> LossEstimate {
    if reference.scatter().is_some() {
        return loss_of_any_distribution(estimate, reference);
    }
    let (m, r) = (estimate.mean, reference.mean());
    let zs = CredibleInterval::HALF_WIDTH_95 * estimate.std;
    let zs_r = CredibleInterval::HALF_WIDTH_95 * reference.std();
    let a = r * r - zs_r * zs_r;
    let half_b = m * r;
    // half_b² − a·c, without the terms that cancel.
    let discriminant = (zs * r).powi(2) + (zs_r * m).powi(2) - (zs * zs_r).powi(2);
    let root = discriminant.max(0.0).sqrt();
    LossEstimate {
        loss: 1.0 - m / r,
        low: 1.0 - (half_b + root) / a,
        high: 1.0 - (half_b - root) / a,
    }
}

/// Standard deviation of a change as the model measures it, as a share of the change.
///
/// A model whose masses or damping are wrong misstates by how much a stiffness has changed. If each
/// mass is off by up to 10 %, their standard deviation is 6 %, and the misstatement is of the same
/// order.
const MODEL_ERROR: f64 = 0.05;

/// Returns the estimate with the error of the model in its deviation.
fn with_model_error(estimate: &ParameterEstimate, reference: &Reference) -> ParameterEstimate {
    let of_model = MODEL_ERROR * (reference.mean() - estimate.mean);
    ParameterEstimate {
        std: estimate.std.hypot(of_model),
        ..*estimate
    }
}

/// Returns the loss against the mean of the reference, with the 95 % interval of the estimate
/// alone.
pub(crate) fn loss_within_record(
    estimate: &ParameterEstimate,
    reference: &Reference,
) -> LossEstimate {
    let CredibleInterval { low, high, .. } = estimate.interval();
    let loss = |value: f64| 1.0 - value / reference.mean();
    LossEstimate {
        loss: loss(estimate.mean),
        low: loss(high),
        high: loss(low),
    }
}

/// Computes [`loss_as_modelled`] for any distribution. The probability of a loss decreases as that
/// loss grows.
fn loss_of_any_distribution(estimate: &ParameterEstimate, reference: &Reference) -> LossEstimate {
    let loss = 1.0 - estimate.mean / reference.mean();
    let excess =
        |level: f64| move |loss: f64| level - probability_of_loss(estimate, reference, loss);
    // The usual width of the interval determines the steps of the search for a bracket.
    let std = estimate.std.hypot((1.0 - loss) * reference.std()) / reference.mean();
    let first_step = (CredibleInterval::HALF_WIDTH_95 * std).max(LEAST_STEP);
    let end = |level: f64, side: f64| {
        let (mut near, mut far, mut step) = (loss, loss + side * first_step, first_step);
        while side * excess(level)(far) < 0.0 && step < LARGEST_STEP {
            near = far;
            step *= 2.0;
            far += side * step;
        }
        root(near, far, ACCURACY, excess(level))
    };
    LossEstimate {
        loss,
        low: end(0.975, -1.0),
        high: end(0.025, 1.0),
    }
}

/// Accuracy of an end of the interval, as a share of the reference.
const ACCURACY: f64 = 1e-12;
/// First step of the search for that end if both deviations are zero, as a share of the reference.
const LEAST_STEP: f64 = 1e-9;
/// Last step of that search, as a share of the reference.
const LARGEST_STEP: f64 = 1e6;

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(mean: f64, std: f64) -> ParameterEstimate {
        ParameterEstimate {
            time_ns: 0,
            mean,
            std,
        }
    }

    #[test]
    fn loss_of_the_mean_itself_has_probability_one_half() {
        let reference = Reference::new(0.9, 0.02).unwrap();
        assert_eq!(
            probability_of_loss(&estimate(0.9 * 0.75, 0.03), &reference, 0.25),
            0.5
        );
    }

    #[test]
    fn uncertain_reference_lowers_the_probability_of_a_loss() {
        // (0.95 - 0.90)/0.02 = 2.5; with s_r = 0.04: 0.05/√(0.02² + 0.038²) = 1.164 37.
        // Φ(2.5) = 0.993 790 (A&S table 26.1); Φ(1.16) = 0.876 976, Φ(1.17) = 0.879 000.
        let sharp = probability_of_loss(&estimate(0.9, 0.02), &Reference::DESIGN, 0.05);
        assert!((sharp - 0.993_790).abs() < 1e-6, "{sharp}");
        let learnt = Reference::new(1.0, 0.04).unwrap();
        let blurred = probability_of_loss(&estimate(0.9, 0.02), &learnt, 0.05);
        assert!((0.876_976..0.879_000).contains(&blurred), "{blurred}");
    }

    #[test]
    fn certain_estimate_gives_certainty() {
        assert_eq!(
            probability_of_loss(&estimate(0.9, 0.0), &Reference::DESIGN, 0.05),
            1.0
        );
        assert_eq!(
            probability_of_loss(&estimate(0.96, 0.0), &Reference::DESIGN, 0.05),
            0.0
        );
    }

    #[test]
    fn ends_of_the_interval_are_where_the_probability_is_0_975_and_0_025() {
        for (mean, std, r, s_r) in [
            (0.85, 0.01, 1.0, 0.0),
            (0.7, 0.05, 0.95, 0.1),
            (1.2, 0.3, 1.0, 0.3),
        ] {
            let reference = Reference::new(r, s_r).unwrap();
            let interval = loss_as_modelled(&estimate(mean, std), &reference);
            let at_low = probability_of_loss(&estimate(mean, std), &reference, interval.low);
            let at_high = probability_of_loss(&estimate(mean, std), &reference, interval.high);
            assert!(
                (at_low - 0.975).abs() < 1e-12 && (at_high - 0.025).abs() < 1e-12,
                "{at_low} {at_high}"
            );
            assert!(interval.low < interval.loss && interval.loss < interval.high);
        }
    }

    #[test]
    fn interval_of_an_exact_estimate_contains_the_error_of_the_model() {
        let interval = loss_estimate(&estimate(0.6, 0.0), &Reference::DESIGN);
        // One standard deviation is 5 % of 0.4, that is 0.02, and 1.96 of them are 0.0392.
        assert!(
            (interval.low - 0.3608).abs() < 1e-5 && (interval.high - 0.4392).abs() < 1e-5,
            "{interval:?}"
        );
    }
}
