//! The alert of one parameter.

use serde::{Deserialize, Serialize};

use super::{CredibleInterval, Format, Malformed, Message, check_finite, check_range, check_text};
use crate::name::Name;

/// Where the alert of a parameter stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlertState {
    /// The baseline is being learnt; no decision yet.
    Learning,
    /// No loss with the credibility asked for.
    Normal,
    /// Loss with the credibility asked for, but not yet for the sustain time.
    Pending,
    /// Loss with the credibility asked for, for the sustain time.
    Raised,
    /// Raised, and someone has seen it.
    Acknowledged,
    /// Was raised; the loss is gone with the credibility asked for clearing.
    Cleared,
}

impl AlertState {
    /// The state in one word, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Learning => "learning",
            Self::Normal => "normal",
            Self::Pending => "pending",
            Self::Raised => "raised",
            Self::Acknowledged => "acknowledged",
            Self::Cleared => "cleared",
        }
    }
}

/// The state of the alert of one parameter, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlertMessage {
    /// The structure.
    pub structure: Name,
    /// The parameter.
    pub parameter: Name,
    /// Time of the frame that decided, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// The state from now on.
    pub state: AlertState,
    /// Since when the loss has been credible, ns since the Unix epoch, UTC; none while it is not.
    pub since_ns: Option<i64>,
    /// Loss that the rule asks about, a share of the reference (0.1 = 10 %).
    pub rule_loss: f64,
    /// Credibility that the rule asks for (0.95 = 95 %).
    pub rule_credibility: f64,
    /// Credibility found: the probability that more than `rule_loss` is gone; 0 while the reference is learnt.
    pub credibility: f64,
    /// Loss found, a share of the reference; none while the reference is learnt.
    pub loss: Option<f64>,
    /// Interval of the loss found.
    pub loss_interval: Option<CredibleInterval>,
    /// Mean of the parameter, ratio to nominal.
    pub mean: f64,
    /// Standard deviation of the parameter, ratio to nominal.
    pub std: f64,
    /// What the loss is measured against, ratio to nominal; none while it is learnt.
    pub reference: Option<f64>,
    /// Standard deviation of the reference.
    pub reference_std: Option<f64>,
    /// Who acknowledged, if someone did.
    pub acknowledged_by: Option<String>,
    /// The decision in words.
    pub why: String,
}

impl Message for AlertMessage {
    const TYPE: &'static str = "alert";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_finite("mean", self.mean)?;
        check_range("std", self.std, 0.0, f64::MAX)?;
        check_range("rule loss", self.rule_loss, 0.0, 1.0)?;
        check_range("rule credibility", self.rule_credibility, 0.0, 1.0)?;
        check_range("credibility", self.credibility, 0.0, 1.0)?;
        let optional = [
            ("loss", self.loss),
            ("loss interval low", self.loss_interval.map(|interval| interval.low)),
            ("loss interval high", self.loss_interval.map(|interval| interval.high)),
            ("reference", self.reference),
            ("reference std", self.reference_std),
        ];
        for (what, value) in optional {
            check_finite(what, value.unwrap_or(0.0))?;
        }
        if let Some(who) = &self.acknowledged_by {
            check_text("acknowledged by", who)?;
        }
        check_text("why", &self.why)
    }
}
