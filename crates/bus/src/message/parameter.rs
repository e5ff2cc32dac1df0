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

impl CredibleInterval {
    /// Half-width of the 95 % interval of a normal variable, in standard deviations: the 97.5 %
    /// quantile.
    pub const HALF_WIDTH_95: f64 = 1.959_963_984_540_054;

    /// Returns `true` if a value lies within the interval or on one of its ends.
    #[must_use]
    pub fn contains(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// Returns the 95 % interval of a normal variable.
    #[must_use]
    pub fn of_normal(mean: f64, std: f64) -> Self {
        let half_width = Self::HALF_WIDTH_95 * std;
        Self {
            level: 0.95,
            low: mean - half_width,
            high: mean + half_width,
        }
    }
}

/// Mean, standard deviation and credible interval of one parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the parameter.
    pub parameter: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Mean, ratio to nominal.
    pub mean: f64,
    /// Standard deviation, ratio to nominal.
    pub std: f64,
    /// The credible interval.
    pub interval: CredibleInterval,
}

impl ParameterDisplay {
    /// Creates the display of a normal estimate.
    ///
    /// `mean` is a ratio to nominal, `variance` is its square. A negative variance counts as zero.
    #[must_use]
    pub fn of_normal(
        structure: &Name,
        parameter: &Name,
        time_ns: i64,
        mean: f64,
        variance: f64,
    ) -> Self {
        let std = variance.max(0.0).sqrt();
        Self {
            structure: structure.clone(),
            parameter: parameter.clone(),
            time_ns,
            mean,
            std,
            interval: CredibleInterval::of_normal(mean, std),
        }
    }
}

impl Message for ParameterDisplay {
    const TYPE: &'static str = "parameter";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        let finite = [
            ("mean", self.mean),
            ("interval low", self.interval.low),
            ("interval high", self.interval.high),
        ];
        for (what, value) in finite {
            check_finite(what, value)?;
        }
        check_range("std", self.std, 0.0, f64::MAX)?;
        check_range("interval level", self.interval.level, 0.0, 1.0)
    }
}
