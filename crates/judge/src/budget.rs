//! What a structure has spent of its budget of false alarms.

use crate::judgement::{Finding, Judgement, State};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// Mean length of a year (days).
const DAYS_PER_YEAR: f64 = 365.25;
/// The last year (days).
const LAST_YEAR_DAYS: i64 = 365;

/// Counts the judged days and the alarms of all quantities of a structure.
///
/// ```
/// use spandrel_judge::{Budget, Judgement, State};
///
/// let judged = Judgement {
///     day: 20_000,
///     quantity: "f1".to_owned(),
///     state: State::Judged,
///     means: None,
///     expectation: None,
///     finding: None,
///     raised: false,
/// };
/// let mut budget = Budget::default();
/// budget.count(&judged);
/// assert_eq!(budget.spent(0.1).judged_days, 1);
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Budget {
    last_day: Option<i64>,
    last_judged: Option<i64>,
    judged_days: u32,
    /// Days of the alarms. An alarm that is raised again, because the loss has grown, counts once.
    alarms: Vec<i64>,
    /// Quantities with an alarm.
    alarmed: BTreeSet<String>,
}

/// The alarms of a structure, and the false alarms that its budget promises for the same time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spent {
    /// Number of days on which at least one quantity was judged.
    pub judged_days: u32,
    /// Number of false alarms that the budget promises for these days.
    pub promised: f64,
    /// Number of alarms of all quantities, true or false.
    pub alarms: u32,
    /// Number of alarms in the last 365 days.
    pub alarms_in_last_year: u32,
}

impl Budget {
    /// Counts a judgement. Judgements come in the order of their days.
    pub fn count(&mut self, judgement: &Judgement) {
        let day = judgement.day;
        self.last_day = Some(day);
        if judgement.state == State::Judged && self.last_judged != Some(day) {
            self.last_judged = Some(day);
            self.judged_days += 1;
        }
        if !judgement.finding.as_ref().is_some_and(Finding::is_alarm) {
            self.alarmed.remove(&judgement.quantity);
        } else if self.alarmed.insert(judgement.quantity.clone()) {
            self.alarms.push(day);
        }
    }

    /// Returns what a budget of false alarms per year, for all quantities, has come to.
    #[must_use]
    pub fn spent(&self, false_alarms_per_year: f64) -> Spent {
        let since = self.last_day.unwrap_or_default() - LAST_YEAR_DAYS;
        let recent = self.alarms.iter().filter(|day| **day > since);
        let number = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        Spent {
            judged_days: self.judged_days,
            promised: false_alarms_per_year * f64::from(self.judged_days) / DAYS_PER_YEAR,
            alarms: number(self.alarms.len()),
            alarms_in_last_year: number(recent.count()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::judgement::{Absence, Change};

    fn judgement(day: i64, state: State, finding: Option<Finding>) -> Judgement {
        Judgement {
            day,
            quantity: "f1".to_owned(),
            state,
            means: None,
            expectation: None,
            finding,
            raised: finding.is_some_and(|finding| finding.change().found_day == day),
        }
    }

    fn change(found_day: i64) -> Change {
        Change {
            found_day,
            since_day: found_day,
            loss: 0.05,
            interval: [0.04, 0.06],
            ..Change::default()
        }
    }

    #[test]
    fn days_count_once_and_alarms_count_when_they_are_raised() {
        let mut budget = Budget::default();
        assert_eq!(budget.spent(0.1).judged_days, 0);
        let learning = State::Learning { days_left: 0 };
        budget.count(&judgement(0, learning, None));
        for day in 1..=1461 {
            let lost = (300..=400)
                .contains(&day)
                .then_some(Finding::LastingLoss(change(300)));
            budget.count(&judgement(day, State::Judged, lost));
            let stiffer = (day >= 1400).then_some(Finding::Stiffer(change(1400)));
            budget.count(&Judgement {
                quantity: "f2".to_owned(),
                ..judgement(day, State::Judged, stiffer)
            });
        }
        let spent = budget.spent(0.5);
        let (days, promised) = (spent.judged_days, spent.promised);
        assert_eq!((days, promised), (1461, 2.0));
        assert_eq!((spent.alarms, spent.alarms_in_last_year), (1, 0));
        let why = Absence::Quantity;
        let away = Finding::LearnedAway(change(1500));
        budget.count(&judgement(1500, State::NoStatement { why }, Some(away)));
        let grown = Finding::LearnedAway(change(1501));
        budget.count(&judgement(1501, State::Judged, Some(grown)));
        let spent = budget.spent(0.5);
        assert_eq!(spent.judged_days, 1462);
        assert_eq!((spent.alarms, spent.alarms_in_last_year), (2, 1));
    }
}
