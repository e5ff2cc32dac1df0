//! One identified parameter at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_finite, check_range};
use crate::name::Name;

/// An equal-tailed credible interval of a parameter or a loss.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CredibleInterval {
    /// Probability that the interval contains the quantity, such as 0.95.
    pub level: f64,
    /// Lower end: ratio to nominal for a parameter, share of the reference for a loss.
    pub low: f64,
    /// Upper end, in the same unit.
    pub high: f64,
}

/// Mean, standard deviation and probability of loss of one parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterDisplay {
    /// The structure.
    pub structure: Name,
    /// The parameter.
    pub parameter: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Mean, ratio to nominal.
    pub mean: f64,
    /// Standard deviation, ratio to nominal.
    pub std: f64,
    /// The credible interval.
    pub interval: CredibleInterval,
    /// Probability that the loss exceeds `loss`.
    pub probability_of_loss: f64,
    /// Loss for which the probability is stated, a share of the reference (0.1 = 10 %).
    pub loss: f64,
    /// Reference for the loss, ratio to nominal.
    pub reference: f64,
}

impl ParameterDisplay {
    /// Level of the displayed interval, and its half-width in standard deviations of a Gaussian.
    const INTERVAL: (f64, f64) = (0.95, 1.959_963_984_540_054);

    /// Creates the display of a Gaussian estimate.
    ///
    /// - `mean`, `reference`: ratios to nominal; `variance`: square of this unit
    /// - `loss`: share of `reference` for which the probability is computed
    #[must_use]
    pub fn of_gaussian(
        (structure, parameter): (&Name, &Name),
        time_ns: i64,
        (mean, variance): (f64, f64),
        (loss, reference): (f64, f64),
    ) -> Self {
        let std = variance.max(0.0).sqrt();
        let (level, half_width) = Self::INTERVAL;
        Self {
            structure: structure.clone(),
            parameter: parameter.clone(),
            time_ns,
            mean,
            std,
            interval: CredibleInterval {
                level,
                low: mean - half_width * std,
                high: mean + half_width * std,
            },
            probability_of_loss: probability_below((1.0 - loss) * reference, mean, std),
            loss,
            reference,
        }
    }
}

/// Returns the probability that a Gaussian variable lies below a threshold.
pub(super) fn probability_below(threshold: f64, mean: f64, std: f64) -> f64 {
    if std > 0.0 {
        0.5 * libm::erfc((mean - threshold) / (std * std::f64::consts::SQRT_2))
    } else if mean < threshold {
        1.0
    } else {
        0.0
    }
}

impl Message for ParameterDisplay {
    const TYPE: &'static str = "parameter";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        let finite = [
            ("mean", self.mean),
            ("interval low", self.interval.low),
            ("interval high", self.interval.high),
            ("reference", self.reference),
        ];
        for (what, value) in finite {
            check_finite(what, value)?;
        }
        check_range("std", self.std, 0.0, f64::MAX)?;
        check_range("interval level", self.interval.level, 0.0, 1.0)?;
        check_range("probability of loss", self.probability_of_loss, 0.0, 1.0)?;
        check_range("loss", self.loss, 0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    #[test]
    fn probability_is_that_of_the_gaussian_tables() {
        assert!((probability_below(0.95, 0.95, 0.1) - 0.5).abs() < 1e-15);
        // Φ(−1.959964) = 0.025 and Φ(−6) = 9.865876e-10
        assert!((probability_below(0.0, 1.959_963_984_540_054, 1.0) - 0.025).abs() < 1e-12);
        assert!((probability_below(0.0, 6.0, 1.0) / 9.865_876_450e-10 - 1.0).abs() < 1e-8);
        assert_eq!(probability_below(0.95, 0.90, 0.0), 1.0);
    }
}
