//! The alert of one parameter.

use serde::{Deserialize, Serialize};

use super::text::{mend_label, mend_text};
use super::{
    CredibleInterval, FitReasons, FitVerdict, Format, Malformed, Message, UndecidedBecause,
    check_finite, check_label, check_range, check_text,
};
use crate::name::Name;

/// State of the alert of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlertState {
    /// The baseline is being learnt; no decision yet.
    Learning,
    /// No loss with the required credibility.
    Normal,
    /// Loss with the required credibility, but not yet for the sustain time.
    Pending,
    /// Loss with the required credibility for the sustain time.
    Raised,
    /// The alert was raised and a person has acknowledged it.
    Acknowledged,
    /// The alert was raised. The absence of the loss then reached the credibility required for
    /// clearing.
    Cleared,
    /// No decision is possible; `undecided_because` contains the reason.
    Undecided,
    /// The alert was raised and remains open, but the data do not currently support a decision.
    Unconfirmed,
    /// Loss with the required credibility in strong motion, or before the structure has settled. It
    /// informs, and is not damage.
    SofteningInMotion,
}

impl AlertState {
    /// All states.
    pub const ALL: [Self; 9] = [
        Self::Learning,
        Self::Normal,
        Self::Pending,
        Self::Raised,
        Self::Acknowledged,
        Self::Cleared,
        Self::Undecided,
        Self::Unconfirmed,
        Self::SofteningInMotion,
    ];

    /// Returns the name of the state, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Learning => "learning",
            Self::Normal => "normal",
            Self::Pending => "pending",
            Self::Raised => "raised",
            Self::Acknowledged => "acknowledged",
            Self::Cleared => "cleared",
            Self::Undecided => "undecided",
            Self::Unconfirmed => "unconfirmed",
            Self::SofteningInMotion => "softening-in-motion",
        }
    }
}

/// State of the alert of one parameter, with its reasons.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlertMessage {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the parameter.
    pub parameter: Name,
    /// Time of the frame on which the decision is based, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// State after the decision.
    pub state: AlertState,
    /// Time since which the loss has been credible, ns since the Unix epoch, UTC. `None` if it is
    /// not credible.
    pub since_ns: Option<i64>,
    /// Loss threshold of the rule, a share of the reference (0.1 = 10 %).
    pub rule_loss: f64,
    /// Credibility that the rule requires (0.95 = 95 %).
    pub rule_credibility: f64,
    /// Probability that the loss exceeds `rule_loss`; 0 while the reference is being learnt.
    pub credibility: f64,
    /// Estimated loss, a share of the reference. `None` while the reference is being learnt.
    pub loss: Option<f64>,
    /// Credible interval of the loss of this structure. It includes the uncertainty of the
    /// reference and, if the baseline states it, the variation between records.
    pub loss_interval: Option<CredibleInterval>,
    /// Credible interval of the loss within this record, if the reference were exact.
    #[serde(default)]
    pub loss_interval_within_record: Option<CredibleInterval>,
    /// Mean of the parameter, ratio to nominal.
    pub mean: f64,
    /// Standard deviation of the parameter, ratio to nominal.
    pub std: f64,
    /// Reference for the loss, ratio to nominal. `None` while it is being learnt.
    pub reference: Option<f64>,
    /// Standard deviation of the reference, ratio to nominal.
    pub reference_std: Option<f64>,
    /// Name of the person who acknowledged the alert, if any.
    pub acknowledged_by: Option<String>,
    /// The decision in words.
    pub why: String,
    /// Verdict on the fit at the deciding frame. `None` if the fit is not assessed, and in messages
    /// stored by early versions.
    #[serde(default)]
    pub fit: Option<FitVerdict>,
    /// Reasons why the verdict is not supported.
    #[serde(default)]
    pub fit_reasons: FitReasons,
    /// Whether the filter follows a sudden change. If so, the loss is still changing.
    #[serde(default)]
    pub follows_jump: bool,
    /// Reason why no decision is possible now. `None` if the service decides on alerts.
    #[serde(default)]
    pub undecided_because: Option<UndecidedBecause>,
    /// Number of revisions since the alert was raised. A revision changes neither the state nor
    /// `since_ns`.
    #[serde(default)]
    pub revision: u32,
}

impl AlertMessage {
    /// Returns `true` if the alert is open: raised, acknowledged or unconfirmed.
    #[must_use]
    pub fn stands(&self) -> bool {
        matches!(
            self.state,
            AlertState::Raised | AlertState::Acknowledged | AlertState::Unconfirmed
        )
    }

    /// Returns `true` if the alert is open and not acknowledged.
    #[must_use]
    pub fn is_unseen(&self) -> bool {
        self.stands() && self.state != AlertState::Acknowledged && self.acknowledged_by.is_none()
    }

    /// Returns `true` if this message revises `other`: same alert and state, newer loss.
    #[must_use]
    pub fn revises(&self, other: &Self) -> bool {
        let same = |alert: &Self| {
            (
                alert.state,
                alert.since_ns,
                alert.rule_loss.to_bits(),
                alert.undecided_because,
            )
        };
        self.revision > other.revision
            && other.time_ns <= self.time_ns
            && (&self.structure, &self.parameter) == (&other.structure, &other.parameter)
            && same(self) == same(other)
    }

    /// Makes a stored alert valid if it was stored under less strict limits.
    #[must_use]
    pub fn legible(mut self) -> Self {
        self.acknowledged_by.iter_mut().for_each(mend_label);
        mend_text(&mut self.why);
        self
    }
}

impl Message for AlertMessage {
    const TYPE: &'static str = "alert";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_finite("mean", self.mean)?;
        check_range("std", self.std, 0.0, f64::MAX)?;
        check_range("rule loss", self.rule_loss, 0.0, 1.0)?;
        check_range("rule credibility", self.rule_credibility, 0.0, 1.0)?;
        check_range("credibility", self.credibility, 0.0, 1.0)?;
        let optional = [
            ("loss", self.loss),
            (
                "loss interval low",
                self.loss_interval.map(|interval| interval.low),
            ),
            (
                "loss interval high",
                self.loss_interval.map(|interval| interval.high),
            ),
            (
                "loss interval within record low",
                self.loss_interval_within_record
                    .map(|interval| interval.low),
            ),
            (
                "loss interval within record high",
                self.loss_interval_within_record
                    .map(|interval| interval.high),
            ),
            ("reference", self.reference),
            ("reference std", self.reference_std),
        ];
        for (what, value) in optional {
            check_finite(what, value.unwrap_or(0.0))?;
        }
        if let Some(who) = &self.acknowledged_by {
            check_label("acknowledged by", who)?;
        }
        check_text("why", &self.why)
    }
}
