//! The loss of one parameter at display rate, as the alert service computes it.

use serde::{Deserialize, Serialize};

use super::{
    AlertMessage, AlertState, CredibleInterval, Format, Malformed, Message, RoundedProbability,
    check_finite, check_range,
};
use crate::name::Name;

/// Loss of one parameter under its rule, with the numbers on which alerts are decided.
///
/// There is a message for each displayed frame once the reference is known. A parameter without a
/// rule has none. If several rules watch a parameter, the message is that of the first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LossDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the parameter.
    pub parameter: Name,
    /// Time of the frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Estimated loss, a share of the reference (0.1 = 10 %).
    pub loss: f64,
    /// Credible interval of the loss of this structure, with the uncertainty of the reference.
    pub interval: CredibleInterval,
    /// Probability that the loss exceeds `rule_loss`, 0 to 1.
    pub probability_of_loss: f64,
    /// Loss threshold of the rule, a share of the reference.
    pub rule_loss: f64,
    /// Credibility that the rule requires (0.95 = 95 %).
    pub rule_credibility: f64,
    /// Reference for the loss, ratio to nominal.
    pub reference: f64,
    /// Standard deviation of the reference, ratio to nominal.
    pub reference_std: f64,
}

impl LossDisplay {
    /// Describes the loss if it is newer than an open alert of the same parameter and rule, and
    /// disagrees with the loss that the alert states.
    #[must_use]
    pub fn since(&self, alert: &AlertMessage) -> Option<String> {
        let is_open = match alert.state {
            AlertState::Pending
            | AlertState::Raised
            | AlertState::Unconfirmed
            | AlertState::Acknowledged
            | AlertState::Cleared
            | AlertState::SofteningInMotion => true,
            AlertState::Learning | AlertState::Normal | AlertState::Undecided => false,
        };
        let is_same = (&self.parameter, self.rule_loss) == (&alert.parameter, alert.rule_loss);
        let stated = alert.loss.zip(alert.loss_interval);
        let is_told = stated.is_some_and(|stated| losses_agree(stated, (self.loss, self.interval)));
        if !is_open || !is_same || self.time_ns <= alert.time_ns || is_told {
            return None;
        }
        Some(self.words())
    }

    /// Returns the loss in words: its value, interval and probability.
    #[must_use]
    pub fn words(&self) -> String {
        let [loss, low, high] = per_cents([self.loss, self.interval.low, self.interval.high]);
        format!(
            "loss {loss} % ({:.0} % interval {low} to {high} %), more than {} % with probability \
             {}",
            100.0 * self.interval.level,
            per_cent(self.rule_loss),
            self.shown_probability(),
        )
    }

    /// Returns the probability of the loss, rounded to the side of the credibility that the rule
    /// requires.
    #[must_use]
    pub fn shown_probability(&self) -> RoundedProbability {
        RoundedProbability::new(self.probability_of_loss, &[self.rule_credibility])
    }
}

/// Returns `true` if each of two losses lies within the interval of the other.
///
/// An alert is revised when its loss disagrees with the present one. Until then, it states both.
#[must_use]
pub fn losses_agree(a: (f64, CredibleInterval), b: (f64, CredibleInterval)) -> bool {
    a.1.contains(b.0) && b.1.contains(a.0)
}

/// Formats a share in per cent without the sign, with one decimal unless it is whole: `14.2`, `5`.
#[must_use]
pub fn per_cent(share: f64) -> String {
    let [text] = per_cents([share]);
    text
}

/// Formats the shares of one statement in per cent without the sign, with one decimal unless all
/// are whole: `15.0`, `14.1` and `16.0`, but `3`, `1` and `5`.
#[must_use]
pub fn per_cents<const N: usize>(shares: [f64; N]) -> [String; N] {
    let texts = shares.map(|share| match format!("{:.1}", share * 100.0) {
        zero if zero == "-0.0" => "0.0".to_owned(),
        text => text,
    });
    match texts.iter().all(|text| text.ends_with(".0")) {
        true => texts.map(|text| text.trim_end_matches(".0").to_owned()),
        false => texts,
    }
}

impl Message for LossDisplay {
    const TYPE: &'static str = "loss";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        let finite = [
            ("loss", self.loss),
            ("interval low", self.interval.low),
            ("interval high", self.interval.high),
            ("reference", self.reference),
        ];
        for (what, value) in finite {
            check_finite(what, value)?;
        }
        check_range("interval level", self.interval.level, 0.0, 1.0)?;
        check_range("probability of loss", self.probability_of_loss, 0.0, 1.0)?;
        check_range("rule loss", self.rule_loss, 0.0, 1.0)?;
        check_range("rule credibility", self.rule_credibility, 0.0, 1.0)?;
        check_range("reference std", self.reference_std, 0.0, f64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::super::FitReasons;
    use super::*;

    /// Regression test: a loss of "-1 %" was beside an interval "-2.7 to 0.7 %".
    #[test]
    fn a_loss_and_its_interval_have_the_same_number_of_decimals() {
        let statements = [
            [-0.01, -0.027, 0.007],
            [0.15, 0.141, 0.16],
            [0.03, 0.01, 0.05],
            [0.06, -0.0001, 0.123],
            [0.1, 0.0, 0.2],
        ];
        let found = statements.map(|statement| per_cents(statement).join(" "));
        let expected = [
            "-1.0 -2.7 0.7",
            "15.0 14.1 16.0",
            "3 1 5",
            "6.0 0.0 12.3",
            "10 0 20",
        ];
        assert_eq!(found, expected);
    }

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

    fn loss(time_ns: i64) -> LossDisplay {
        LossDisplay {
            structure: Name::new("tower").unwrap(),
            parameter: Name::new("storey-2").unwrap(),
            time_ns,
            loss: 0.061,
            interval: CredibleInterval {
                level: 0.95,
                low: 0.014,
                high: 0.108,
            },
            probability_of_loss: 0.679,
            rule_loss: 0.05,
            rule_credibility: 0.99,
            reference: 0.9,
            reference_std: 0.02,
        }
    }

    #[test]
    fn a_later_loss_updates_an_open_alert() {
        let text = "loss 6.1 % (95 % interval 1.4 to 10.8 %), more than 5 % with probability 0.679";
        let raised = alert(AlertState::Raised);
        assert_eq!(loss(101).since(&raised).as_deref(), Some(text));
        assert_eq!(loss(100).since(&raised), None, "it decided the alert");
        let normal = alert(AlertState::Normal);
        assert_eq!(loss(101).since(&normal), None, "there is no alert");
        let of_another_rule = AlertMessage {
            rule_loss: 0.1,
            ..raised
        };
        assert_eq!(loss(101).since(&of_another_rule), None);
    }

    /// Regression test: the alert stated 15 % (14.1 to 16 %), and the line below it 14.8 % (14.3 to
    /// 15.4 %).
    #[test]
    fn a_later_loss_that_agrees_with_the_alert_is_not_told_again() {
        let told = |loss: f64, low: f64, high: f64| AlertMessage {
            loss: Some(loss),
            loss_interval: Some(CredibleInterval {
                level: 0.95,
                low,
                high,
            }),
            ..alert(AlertState::Raised)
        };
        assert_eq!(loss(101).since(&told(0.07, 0.05, 0.09)), None);
        let outside = [(0.12, 0.05, 0.19), (0.1, 0.08, 0.12)];
        for (share, low, high) in outside {
            assert!(loss(101).since(&told(share, low, high)).is_some());
        }
    }

    #[test]
    fn whole_percentages_have_no_decimals() {
        let shares = [0.05, 0.142, -0.000_1, -0.021].map(per_cent);
        assert_eq!(shares, ["5", "14.2", "0", "-2.1"]);
    }

    #[test]
    fn an_impossible_probability_is_rejected() {
        let valid = loss(1);
        assert!(valid.encode().is_ok());
        let wrong = LossDisplay {
            probability_of_loss: 1.5,
            ..valid
        };
        assert!(wrong.encode().is_err());
    }
}
