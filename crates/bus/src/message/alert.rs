//! The alert of one parameter.

use serde::{Deserialize, Serialize};

use super::parameter::{ParameterDisplay, probability_below};
use super::text::{mend_label, mend_text};
use super::{
    CredibleInterval, FitReasons, FitVerdict, Format, Malformed, Message, RoundedProbability,
    UndecidedBecause, check_finite, check_label, check_range, check_text,
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
}

impl AlertState {
    /// All states.
    pub const ALL: [Self; 8] = [
        Self::Learning,
        Self::Normal,
        Self::Pending,
        Self::Raised,
        Self::Acknowledged,
        Self::Cleared,
        Self::Undecided,
        Self::Unconfirmed,
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
        }
    }
}

/// State of the alert of one parameter, with its reasons.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlertMessage {
    /// The structure.
    pub structure: Name,
    /// The parameter.
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

    /// Describes the loss of this alert according to a later value.
    ///
    /// The text states the loss, the estimate with its interval, and the probability that the loss
    /// exceeds the threshold of the rule. Estimate and reference are independent normal variables,
    /// as in the decision itself.
    ///
    /// Returns `None` if there is no alert, or if the reference is not positive or is being learnt.
    /// Also returns `None` if the value belongs to another parameter or is not newer than the
    /// decision.
    #[must_use]
    pub fn loss_by(&self, display: &ParameterDisplay) -> Option<String> {
        let is_open = match self.state {
            AlertState::Pending
            | AlertState::Raised
            | AlertState::Unconfirmed
            | AlertState::Acknowledged
            | AlertState::Cleared => true,
            AlertState::Learning | AlertState::Normal | AlertState::Undecided => false,
        };
        let reference = self
            .reference
            .filter(|reference| is_open && *reference > 0.0)?;
        if display.parameter != self.parameter || display.time_ns <= self.time_ns {
            return None;
        }
        let kept = 1.0 - self.rule_loss;
        let spread = display.std.hypot(kept * self.reference_std.unwrap_or(0.0));
        let probability = probability_below(kept * reference, display.mean, spread);
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        Some(format!(
            "loss {} (estimate {:.3}, {:.0} % interval {:.3} to {:.3}), more than {} with probability {}",
            percent(1.0 - display.mean / reference),
            display.mean,
            100.0 * display.interval.level,
            display.interval.low,
            display.interval.high,
            percent(self.rule_loss),
            RoundedProbability::new(probability, &[self.rule_credibility]),
        ))
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

#[cfg(test)]
mod tests {
    use super::*;

    fn alert(state: AlertState) -> AlertMessage {
        AlertMessage {
            structure: Name::new("tower").unwrap(),
            parameter: Name::new("storey-2").unwrap(),
            time_ns: 100,
            state,
            since_ns: Some(50),
            rule_loss: 0.05,
            rule_credibility: 0.99,
            credibility: 0.997,
            loss: Some(0.14),
            loss_interval: None,
            loss_interval_within_record: None,
            mean: 0.86,
            std: 0.01,
            reference: Some(1.0),
            reference_std: Some(0.0),
            acknowledged_by: None,
            why: "storey-2 has lost 14 % of its stiffness".to_owned(),
            fit: None,
            fit_reasons: FitReasons::default(),
            follows_jump: false,
            undecided_because: None,
            revision: 0,
        }
    }

    fn display(time_ns: i64, mean: f64) -> ParameterDisplay {
        let names = (
            &Name::new("tower").unwrap(),
            &Name::new("storey-2").unwrap(),
        );
        ParameterDisplay::of_gaussian(names, time_ns, (mean, 1e-4), (0.05, 1.0))
    }

    #[test]
    fn a_later_value_says_how_the_loss_stands_now() {
        let raised = alert(AlertState::Raised);
        // If the mean equals the threshold 0.95, the probability is 0.5 for every standard
        // deviation.
        let told = "loss 5.0 % (estimate 0.950, 95 % interval 0.930 to 0.970), more than 5.0 % with probability 0.500";
        assert_eq!(raised.loss_by(&display(101, 0.95)).as_deref(), Some(told));
        assert!(
            raised
                .loss_by(&display(101, 0.86))
                .unwrap()
                .ends_with("with probability above 0.999")
        );
        assert_eq!(
            raised.loss_by(&display(100, 0.95)),
            None,
            "it is the value that decided"
        );
    }

    #[test]
    fn the_loss_counts_from_the_reference_of_the_alert() {
        // (0.95·0.9 − 0.845)/√(0.01² + (0.95·0.02)²) = 0.4657; Φ(0.4657) = 0.679 (Abramowitz &
        // Stegun, table 26.1)
        let learnt = AlertMessage {
            reference: Some(0.9),
            reference_std: Some(0.02),
            ..alert(AlertState::Acknowledged)
        };
        let told = learnt.loss_by(&display(101, 0.845)).unwrap();
        assert!(
            told.starts_with("loss 6.1 %") && told.ends_with("probability 0.679"),
            "{told}"
        );
        let learning = AlertMessage {
            reference: None,
            ..alert(AlertState::Raised)
        };
        assert_eq!(learning.loss_by(&display(101, 0.845)), None);
        assert_eq!(
            alert(AlertState::Normal).loss_by(&display(101, 0.845)),
            None,
            "there is no alert"
        );
    }
}
