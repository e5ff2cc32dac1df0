//! Judgement of the lasting change of one quantity.

use serde::{Deserialize, Serialize};

use super::{
    AlertState, CredibleInterval, Format, Malformed, Message, check_finite, check_label,
    check_range, check_text,
};
use crate::name::Name;

/// State of a judged quantity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum JudgementState {
    /// The commissioning is under way.
    Learning,
    /// The commissioning is over and gives no reference yet.
    NotReady,
    /// The quantity was judged.
    Judged,
    /// The conditions are new, so the day was not judged.
    OutsideExperience,
    /// The day has no value of the quantity, or not all conditions.
    NoStatement,
}

impl JudgementState {
    /// All states.
    pub const ALL: [Self; 5] = [
        Self::Learning,
        Self::NotReady,
        Self::Judged,
        Self::OutsideExperience,
        Self::NoStatement,
    ];

    /// Returns the name of the state, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Learning => "learning",
            Self::NotReady => "not-ready",
            Self::Judged => "judged",
            Self::OutsideExperience => "outside-experience",
            Self::NoStatement => "no-statement",
        }
    }
}

/// Kind of a lasting change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChangeKind {
    /// The detector of a loss has crossed its threshold.
    LastingLoss,
    /// The learnt reference has drifted by a credible loss.
    LearnedAway,
    /// The detector of a gain has crossed its threshold.
    Stiffer,
}

impl ChangeKind {
    /// All kinds.
    pub const ALL: [Self; 3] = [Self::LastingLoss, Self::LearnedAway, Self::Stiffer];

    /// Returns the name of the kind, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::LastingLoss => "lasting-loss",
            Self::LearnedAway => "learned-away",
            Self::Stiffer => "stiffer",
        }
    }

    /// Returns `true` if the change counts against the budget of false alarms.
    #[must_use]
    pub fn is_alarm(self) -> bool {
        match self {
            Self::LastingLoss | Self::LearnedAway => true,
            Self::Stiffer => false,
        }
    }
}

/// A lasting change that has been found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LastingChange {
    /// Kind of the change.
    pub kind: ChangeKind,
    /// Start of the day on which the change was found, ns since the Unix epoch, UTC.
    pub found_ns: i64,
    /// Start of the most credible first day of the change, ns since the Unix epoch, UTC.
    pub since_ns: i64,
    /// Loss of stiffness as a share of the reference; negative for a gain.
    pub loss: f64,
    /// Interval of the loss, as shares of the reference.
    pub interval: CredibleInterval,
}

/// The person who has seen a lasting change.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChangeSeen {
    /// Name of the person; at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without control
    /// characters.
    pub who: String,
    /// What the person noted.
    pub text: String,
    /// Time of the note, ns since the Unix epoch, UTC.
    pub time_ns: i64,
}

/// The alarms of a structure, and the false alarms that its budget promises for the same time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BudgetSpent {
    /// Number of days on which at least one quantity was judged.
    pub judged_days: u32,
    /// Number of false alarms that the budget promises for these days.
    pub promised: f64,
    /// Number of alarms of all quantities, true or false.
    pub alarms: u32,
    /// Number of alarms in the last 365 days.
    pub alarms_in_last_year: u32,
}

/// Expected value of a day, and how far the measured value is from it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DayExpectation {
    /// Mean value of the day, in the unit of the quantity.
    pub measured: f64,
    /// Expected value under the conditions, in the unit of the quantity.
    pub expected: f64,
    /// Interval of the expected value of a day, in the unit of the quantity.
    pub interval: CredibleInterval,
    /// Whitened residual, in standard deviations.
    pub residual: f64,
    /// Natural logarithm of the evidence of a loss.
    pub ln_evidence: f64,
    /// Natural logarithm of the threshold at which the evidence raises an alarm.
    pub ln_threshold: f64,
    /// CUSUM of the cross-check, divided by its threshold.
    pub cusum_share: f64,
}

/// State of one judged quantity, with one sentence and the numbers behind it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JudgementDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// The quantity.
    pub quantity: Name,
    /// Wall-clock time, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Start of the last judged day, ns since the Unix epoch, UTC. `None` before the first day.
    pub day_ns: Option<i64>,
    /// Middle of the last epoch, ns since the Unix epoch, UTC. `None` before the first epoch.
    pub epoch_ns: Option<i64>,
    /// Number of epochs with a value of the quantity.
    pub epochs: u64,
    /// Whether all epochs contain measured samples. Replayed and simulated samples cause no notice.
    pub measured: bool,
    /// State of the last day.
    pub state: JudgementState,
    /// The lasting change that was found. It remains until a new reference starts.
    pub change: Option<LastingChange>,
    /// The person who has seen the change. `None` if there is no change or nobody has seen it.
    #[serde(default)]
    pub seen: Option<ChangeSeen>,
    /// State and change in one sentence.
    pub sentence: String,
    /// Expected value of the last day. `None` without a reference, and for a day without data.
    pub expectation: Option<DayExpectation>,
    /// Budget: promised number of false alarms per year, for all quantities of the structure.
    pub false_alarms_per_year: f64,
    /// What all quantities of the structure have spent of the budget. `None` from a service that
    /// does not count it.
    #[serde(default)]
    pub spent: Option<BudgetSpent>,
    /// Name of the configuration in force, from which `spandrel judge --at` repeats the judgement;
    /// at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without control characters. `None`
    /// without a state folder.
    #[serde(default)]
    pub configuration: Option<String>,
}

impl JudgementDisplay {
    /// Returns the name of the change if there is one, and otherwise that of the state.
    #[must_use]
    pub fn word(&self) -> &'static str {
        match &self.change {
            Some(change) => change.kind.as_str(),
            None => self.state.as_str(),
        }
    }

    /// Returns the state of the lasting loss as an alert: raised, or acknowledged once a person has
    /// seen it. `None` if no loss was found.
    ///
    /// A lasting loss has no other states: it is over when a new reference starts.
    #[must_use]
    pub fn alert_state(&self) -> Option<AlertState> {
        self.change.filter(|change| change.kind.is_alarm())?;
        Some(match self.seen {
            Some(_) => AlertState::Acknowledged,
            None => AlertState::Raised,
        })
    }
}

impl Message for JudgementDisplay {
    const TYPE: &'static str = "judgement";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_text("sentence", &self.sentence)?;
        check_range(
            "false alarms per year",
            self.false_alarms_per_year,
            0.0,
            f64::MAX,
        )?;
        if let Some(spent) = &self.spent {
            check_range("promised false alarms", spent.promised, 0.0, f64::MAX)?;
        }
        if let Some(change) = &self.change {
            change.check()?;
        }
        if let Some(configuration) = &self.configuration {
            check_label("configuration", configuration)?;
        }
        if let Some(seen) = &self.seen {
            check_label("who", &seen.who)?;
            check_text("text", &seen.text)?;
        }
        match &self.expectation {
            Some(expectation) => expectation.check(),
            None => Ok(()),
        }
    }
}

impl LastingChange {
    pub(super) fn check(&self) -> Result<(), Malformed> {
        check_finite("loss", self.loss)?;
        check_interval(&self.interval)
    }
}

impl DayExpectation {
    pub(super) fn check(&self) -> Result<(), Malformed> {
        let finite = [
            ("measured", self.measured),
            ("expected", self.expected),
            ("residual", self.residual),
            ("ln evidence", self.ln_evidence),
            ("ln threshold", self.ln_threshold),
            ("cusum share", self.cusum_share),
        ];
        for (what, value) in finite {
            check_finite(what, value)?;
        }
        check_interval(&self.interval)
    }
}

fn check_interval(interval: &CredibleInterval) -> Result<(), Malformed> {
    check_finite("interval low", interval.low)?;
    check_finite("interval high", interval.high)?;
    check_range("interval level", interval.level, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display() -> JudgementDisplay {
        let interval = |low, high| CredibleInterval {
            level: 0.95,
            low,
            high,
        };
        JudgementDisplay {
            structure: Name::new("bridge").unwrap(),
            quantity: Name::new("deck").unwrap(),
            time_ns: 9,
            day_ns: Some(0),
            epoch_ns: Some(8),
            epochs: 96,
            measured: true,
            state: JudgementState::Judged,
            change: Some(LastingChange {
                kind: ChangeKind::LastingLoss,
                found_ns: 0,
                since_ns: 0,
                loss: 0.05,
                interval: interval(0.04, 0.06),
            }),
            seen: Some(ChangeSeen {
                who: "ada".to_owned(),
                text: "crack in the bearing".to_owned(),
                time_ns: 9,
            }),
            sentence: "deck has lost 5 % of stiffness.".to_owned(),
            expectation: Some(DayExpectation {
                measured: 0.95,
                expected: 1.0,
                interval: interval(0.98, 1.02),
                residual: -5.0,
                ln_evidence: 9.0,
                ln_threshold: 8.2,
                cusum_share: 1.1,
            }),
            false_alarms_per_year: 0.1,
            spent: Some(BudgetSpent {
                judged_days: 200,
                promised: 0.055,
                alarms: 1,
                alarms_in_last_year: 1,
            }),
            configuration: Some("0123456789abcdef".to_owned()),
        }
    }

    #[test]
    fn words_are_those_of_the_json() {
        let text = String::from_utf8(display().encode().unwrap()).unwrap();
        assert!(text.contains(r#""state":"judged""#), "{text}");
        assert!(text.contains(r#""kind":"lasting-loss""#), "{text}");
        let decoded = JudgementDisplay::decode("application/json", text.as_bytes()).unwrap();
        assert_eq!(decoded, display());
        for state in JudgementState::ALL {
            let json = serde_json::to_string(&state).unwrap();
            assert_eq!(json, format!("\"{}\"", state.as_str()));
        }
        for kind in ChangeKind::ALL {
            let json = serde_json::to_string(&kind).unwrap();
            assert_eq!(json, format!("\"{}\"", kind.as_str()));
        }
    }

    #[test]
    fn a_message_of_a_former_version_is_read() {
        let text = String::from_utf8(display().encode().unwrap()).unwrap();
        let (before, _) = text.split_once(",\"spent\":").unwrap();
        let old = format!("{before}}}");
        let decoded = JudgementDisplay::decode("application/json", old.as_bytes()).unwrap();
        let expected = JudgementDisplay {
            spent: None,
            configuration: None,
            ..display()
        };
        assert_eq!(decoded, expected);
    }

    #[test]
    fn a_change_that_was_found_replaces_the_state_as_the_word() {
        assert_eq!(display().word(), "lasting-loss");
        let sound = JudgementDisplay {
            change: None,
            ..display()
        };
        assert_eq!(sound.word(), "judged");
    }

    #[test]
    fn a_loss_is_raised_until_it_is_seen_and_a_gain_is_no_alert() {
        assert_eq!(display().alert_state(), Some(AlertState::Acknowledged));
        let unseen = JudgementDisplay {
            seen: None,
            ..display()
        };
        assert_eq!(unseen.alert_state(), Some(AlertState::Raised));
        let mut other = unseen.clone();
        other.change.as_mut().unwrap().kind = ChangeKind::Stiffer;
        assert_eq!(other.alert_state(), None);
        other.change = None;
        assert_eq!(other.alert_state(), None);
    }

    #[test]
    fn numbers_out_of_range_are_refused() {
        let mut wrong = display();
        wrong.expectation.as_mut().unwrap().ln_evidence = f64::NEG_INFINITY;
        assert!(matches!(wrong.check(), Err(Malformed::NotFinite { .. })));
        let mut wrong = display();
        wrong.change.as_mut().unwrap().interval.level = 95.0;
        assert!(matches!(wrong.check(), Err(Malformed::Range { .. })));
        let mut wrong = display();
        "a\nb".clone_into(&mut wrong.seen.as_mut().unwrap().who);
        assert!(matches!(wrong.check(), Err(Malformed::Control { .. })));
        let mut wrong = display();
        wrong.spent.as_mut().unwrap().promised = f64::INFINITY;
        assert!(wrong.check().is_err());
        let wrong = JudgementDisplay {
            configuration: Some("a\nb".to_owned()),
            ..display()
        };
        assert!(matches!(wrong.check(), Err(Malformed::Control { .. })));
        let wrong = JudgementDisplay {
            false_alarms_per_year: -1.0,
            ..display()
        };
        assert!(matches!(wrong.check(), Err(Malformed::Range { .. })));
    }
}
