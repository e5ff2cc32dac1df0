//! One identified parameter at display rate.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_finite, check_range};
use crate::name::Name;

/// An equal-tailed credible interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CredibleInterval {
    /// Probability that it holds the parameter, such as 0.95.
    pub level: f64,
    /// Lower end, ratio to nominal.
    pub low: f64,
    /// Upper end, ratio to nominal.
    pub high: f64,
}

/// Mean, spread and probability of loss of one parameter.
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
    /// Probability that more than `loss` of the reference is gone.
    pub probability_of_loss: f64,
    /// The loss asked about, a share of the reference (0.1 = 10 %).
    pub loss: f64,
    /// What the loss is measured against, ratio to nominal.
    pub reference: f64,
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
