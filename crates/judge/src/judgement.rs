//! The result of one day of one quantity: a state, a sentence, and the numbers behind them.

use crate::reference::Missing;
use jiff::civil::Date;
use serde::{Deserialize, Serialize};

/// State of a judged quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum State {
    /// The commissioning is under way.
    Learning {
        /// Days until its end.
        days_left: u32,
    },
    /// The commissioning is over and gives no reference yet.
    NotReady {
        /// What is missing.
        missing: Missing,
    },
    /// The quantity was judged.
    Judged,
    /// The conditions did not occur in the commissioning, and are not known since then. The day is
    /// not judged, and the interval has no meaning.
    OutsideExperience {
        /// Reason why the conditions are outside experience.
        novelty: Novelty,
    },
    /// The day has no value of the quantity, or not all conditions.
    NoStatement {
        /// Reason why the day has no statement.
        why: Absence,
    },
}

impl State {
    /// Returns the name of the state, such as `outside-experience`.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Learning { .. } => "learning",
            Self::NotReady { .. } => "not-ready",
            Self::Judged => "judged",
            Self::OutsideExperience { .. } => "outside-experience",
            Self::NoStatement { .. } => "no-statement",
        }
    }
}

/// Reason why conditions are outside experience.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Novelty {
    /// Fewer than five days were as cold, in the commissioning and the later winters that are over.
    Frost,
    /// The uncertainty of the expected value exceeds the scatter of a day.
    Extrapolation,
}

/// Reason why a day has no statement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Absence {
    /// No epoch had a value of the quantity.
    Quantity,
    /// A condition was not measured.
    Condition(String),
    /// A condition has not changed for a day or longer.
    Frozen(String),
    /// The values of a thermometer have jumped and have not returned.
    Jumped(String),
    /// All quantities that serve as thermometers have changed, or have a new reference. Their
    /// names, with commas.
    Changed(String),
    /// The quantity has repeated its value, or the values of a whole day, for a day or longer.
    FrozenQuantity,
    /// The values of the quantity have jumped, as if their unit had changed.
    OtherUnit,
}

/// A lasting change that was found. It remains until a new reference starts.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Finding {
    /// The detector of a loss has crossed its threshold.
    LastingLoss(Change),
    /// The learnt reference has drifted from the frozen one by a credible loss.
    LearnedAway(Change),
    /// The detector of a gain has crossed its threshold. This is a notice.
    Stiffer(Change),
}

impl Finding {
    /// Returns `true` if the finding is an alarm that counts against the budget.
    #[must_use]
    pub fn is_alarm(&self) -> bool {
        matches!(self, Self::LastingLoss(_) | Self::LearnedAway(_))
    }

    /// Returns the name of the finding, such as `lasting-loss`.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::LastingLoss(_) => "lasting-loss",
            Self::LearnedAway(_) => "learned-away",
            Self::Stiffer(_) => "stiffer",
        }
    }

    /// Returns the size of the lasting change, and the days on which it began and was found.
    #[must_use]
    pub fn change(&self) -> &Change {
        match self {
            Self::LastingLoss(change) | Self::LearnedAway(change) | Self::Stiffer(change) => change,
        }
    }

    /// Returns the finding with another change.
    pub(crate) fn with(self, change: Change) -> Self {
        match self {
            Self::LastingLoss(_) => Self::LastingLoss(change),
            Self::LearnedAway(_) => Self::LearnedAway(change),
            Self::Stiffer(_) => Self::Stiffer(change),
        }
    }
}

/// Present size of a lasting change of the stiffness.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Change {
    /// Day on which the change was found (days since 1970-01-01 UTC). A loss that certainly exceeds
    /// the one that was found before is found again.
    pub found_day: i64,
    /// Most credible first day of the change (days since 1970-01-01 UTC).
    pub since_day: i64,
    /// Present loss of stiffness as a share of that of the commissioning; negative for a gain. It
    /// is the mean of at most the latest 30 judged days.
    pub loss: f64,
    /// 95 % interval of the loss, `[low, high]`, as shares of the stiffness. Negative values are a
    /// gain.
    pub interval: [f64; 2],
    /// Present loss relative to the level just before the change, as a share of that level. It is
    /// larger than `loss` if the stiffness had risen before.
    pub drop: f64,
    /// The last further loss that was found, if any.
    pub further: Option<Further>,
    /// Whether a certain loss was found, less than half of it remains, and the interval contains
    /// zero.
    pub may_have_recovered: bool,
}

/// A loss that was found while an earlier one held.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Further {
    /// Most credible first day of the further loss (days since 1970-01-01 UTC).
    pub since_day: i64,
    /// Present loss beyond the one that was found before, as a share of the stiffness of the
    /// commissioning.
    pub loss: f64,
}

impl Change {
    /// Returns `true` if most of the change is the return from a level that had risen.
    fn is_from_above(&self) -> bool {
        self.interval[0] <= 0.0 && self.loss < 0.5 * self.drop
    }
}

/// Expected value of a day, and how far the measured value is from it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Expectation {
    /// Mean value of the day, in the unit of the quantity.
    pub measured: f64,
    /// Expected value under the conditions, in the unit of the quantity.
    pub expected: f64,
    /// 95 % interval of the expected value of the day, `[low, high]`, in the unit of the quantity.
    pub interval: [f64; 2],
    /// Whitened residual, in standard deviations.
    pub residual: f64,
    /// Natural logarithm of the evidence of a loss.
    pub ln_evidence: f64,
    /// Natural logarithm of the threshold of the evidence.
    pub ln_threshold: f64,
    /// CUSUM of the cross-check divided by its threshold.
    pub cusum_share: f64,
}

/// Means over the epochs of a day that count.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DayMeans {
    /// Geometric mean of the quantity, in its unit.
    pub value: f64,
    /// Mean of each condition, in the order of the settings: °C of a temperature, log10 of an
    /// amplitude, and the unit of any other.
    pub conditions: Vec<f32>,
    /// Number of epochs.
    pub epochs: u16,
}

/// Judgement of one day of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judgement {
    /// Days since 1970-01-01 UTC.
    pub day: i64,
    /// Name of the quantity.
    pub quantity: String,
    /// State on this day.
    pub state: State,
    /// Means of the day, if an epoch had the quantity and all conditions.
    pub means: Option<DayMeans>,
    /// Expected value, if a reference exists and the day has data.
    pub expectation: Option<Expectation>,
    /// Finding that holds on this day.
    pub finding: Option<Finding>,
    /// `true` on the day on which the finding was raised.
    pub raised: bool,
}

impl Judgement {
    /// Returns one sentence for a person who has never seen the state.
    #[must_use]
    pub fn sentence(&self) -> String {
        let name = &self.quantity;
        if let Some(finding) = &self.finding {
            let change = finding.change();
            let [low, high] = change.interval.map(|share| 100.0 * share);
            let interval = format!("(95 % interval {low:.1} to {high:.1} %)");
            let of_gain = format!("(95 % interval {:.1} to {:.1} %)", -high, -low);
            let since = date(change.since_day);
            let loss = 100.0 * change.loss;
            let mut sentence = match finding {
                Finding::LastingLoss(_) if change.may_have_recovered => format!(
                    "{name} lost stiffness, most probably since {since}, and may have recovered: \
                     its present loss is {loss:.1} % {interval}."
                ),
                Finding::LastingLoss(_) if change.is_from_above() => format!(
                    "{name} has dropped by {:.1} % of stiffness, most probably since {since}, from \
                     a level that had risen. Its change since the commissioning is {:+.1} % \
                     [{:+.1}, {:+.1}].",
                    100.0 * change.drop,
                    -loss,
                    -high,
                    -low
                ),
                // Uncertain against the commissioning.
                Finding::LastingLoss(_) if low <= 0.0 => format!(
                    "{name} has lost stiffness, most probably since {since}. Its loss since the \
                     commissioning is {loss:.1} % {interval}."
                ),
                Finding::LastingLoss(_) => format!(
                    "{name} has lost {loss:.1} % of stiffness {interval}, most probably since \
                     {since}."
                ),
                Finding::LearnedAway(_) => format!(
                    "The learnt reference of {name} has drifted away: the present loss of \
                     stiffness since the commissioning is {loss:.1} % {interval}."
                ),
                Finding::Stiffer(_) if high >= 0.0 => format!(
                    "{name} gained stiffness, most probably since {since}. Its present gain is \
                     {:.1} % {of_gain}.",
                    -loss
                ),
                Finding::Stiffer(_) => format!(
                    "{name} has gained {:.1} % of stiffness {of_gain}, most probably since \
                     {since}.",
                    -loss
                ),
            };
            if let Some(further) = change.further.filter(|further| further.loss > 0.0) {
                sentence.push_str(&format!(
                    " A further loss of {:.1} % of stiffness was found, most probably since {}.",
                    100.0 * further.loss,
                    date(further.since_day)
                ));
            }
            return sentence;
        }
        match &self.state {
            State::Learning { days_left } => {
                format!("{name} is being learnt; {days_left} days of commissioning remain.")
            }
            State::NotReady { missing } => format!("{name} has no reference: {missing}."),
            State::Judged => format!("{name} shows no lasting change."),
            State::OutsideExperience { novelty } => match novelty {
                Novelty::Frost => format!(
                    "{name} is not judged, because fewer than five days of its commissioning \
                     or of earlier winters were as cold."
                ),
                Novelty::Extrapolation => format!(
                    "{name} is not judged, because its value under these conditions is unknown."
                ),
            },
            State::NoStatement { why } => match why {
                Absence::Quantity => format!("{name} has no value on this day."),
                Absence::FrozenQuantity => format!(
                    "{name} is not judged, because it has repeated its values for a day or longer. \
                     Check the program that determines them."
                ),
                Absence::OtherUnit => format!(
                    "{name} is not judged, because its values have jumped by a factor of 10 or \
                     more. Check their unit."
                ),
                Absence::Condition(condition) => {
                    format!("{name} is not judged, because {condition} was not measured.")
                }
                Absence::Frozen(condition) => format!(
                    "{name} is not judged, because {condition} has not changed for a day or longer."
                ),
                Absence::Jumped(condition) => format!(
                    "{name} is not judged, because {condition} has jumped from one epoch to the \
                     next and has not gone back. Check the thermometer."
                ),
                Absence::Changed(quantities) => format!(
                    "{name} is not judged, because its thermometers {quantities} have changed or \
                     have a new reference. It needs a new reference."
                ),
            },
        }
    }
}

/// Returns the date of a number of days since 1970-01-01.
#[must_use]
pub fn date(day: i64) -> Date {
    let days = jiff::Span::new().try_days(day).unwrap_or_default();
    Date::constant(1970, 1, 1).saturating_add(days)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The day of the judgement does not matter: the sentence of an old finding stands beside a
    /// later date.
    #[test]
    fn sentence_states_the_date_on_which_a_change_probably_began() {
        let change = |loss| Change {
            loss,
            interval: [loss - 0.01, loss + 0.01],
            since_day: 20_385, // 2025-10-24: date -u -d @$((86400 * 20385))
            found_day: 20_389,
            drop: loss,
            ..Change::default()
        };
        let sentence = |finding, day| {
            let (quantity, state) = ("bending".to_owned(), State::Judged);
            let judgement = Judgement {
                day,
                quantity,
                state,
                means: None,
                expectation: None,
                finding: Some(finding),
                raised: false,
            };
            judgement.sentence()
        };
        let recovered = Change {
            interval: [-0.01, 0.02],
            may_have_recovered: true,
            ..change(0.005)
        };
        assert_eq!(
            sentence(Finding::LastingLoss(recovered), 20_700),
            "bending lost stiffness, most probably since 2025-10-24, and may have recovered: its \
             present loss is 0.5 % (95 % interval -1.0 to 2.0 %)."
        );
        let uncertain = Change {
            interval: [-0.002, 0.05],
            ..change(0.024)
        };
        assert_eq!(
            sentence(Finding::LastingLoss(uncertain), 20_390),
            "bending has lost stiffness, most probably since 2025-10-24. Its loss since the \
             commissioning is 2.4 % (95 % interval -0.2 to 5.0 %)."
        );
        for day in [20_385, 20_386, 20_414] {
            assert_eq!(
                sentence(Finding::LastingLoss(change(0.052)), day),
                "bending has lost 5.2 % of stiffness (95 % interval 4.2 to 6.2 %), most probably \
                 since 2025-10-24."
            );
            assert_eq!(
                sentence(Finding::Stiffer(change(-0.052)), day),
                "bending has gained 5.2 % of stiffness (95 % interval 4.2 to 6.2 %), most probably \
                 since 2025-10-24."
            );
        }
    }
}
