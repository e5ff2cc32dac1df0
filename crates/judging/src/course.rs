//! The history of a quantity: its judgements day by day, as messages of the bus.

use spandrel_bus::{
    Annotation, ChangeKind, CourseCondition, CourseDelay, CourseReference, CourseRow,
    CredibleInterval, DayExpectation, JudgementCourse, JudgementState, LastingChange, Name,
    SpanQuery,
};
use spandrel_judge::{
    Change, Condition, ConditionKind, Delay, Expectation, Finding, Judgement, QuantityKind,
    ReferenceReport, Settings, State,
};
use std::collections::VecDeque;

/// Nanoseconds of a day.
const DAY_NS: i64 = 86_400_000_000_000;
/// Level of the intervals of the judgement.
const LEVEL: f64 = 0.95;
/// Lower limit of the reported natural logarithm of the evidence. Before the first possible step
/// the evidence is 0, and a message cannot contain its logarithm, −∞.
pub const LEAST_LN_EVIDENCE: f64 = -10.0;
/// Maximum number of days of a quantity, about 27 years. Beyond it, the oldest day is dropped.
const MOST_DAYS: usize = 10_000;

/// The judgements of one quantity, the last day last.
#[derive(Debug, Clone, Default)]
pub(crate) struct Course {
    days: VecDeque<Judgement>,
}

/// What the answer to a query states besides the days.
#[derive(Debug, Clone)]
pub(crate) struct Subject<'s> {
    pub(crate) structure: &'s Name,
    pub(crate) quantity: &'s Name,
    pub(crate) kind: QuantityKind,
    pub(crate) conditions: &'s [Name],
    pub(crate) annotations: &'s [Annotation],
    pub(crate) settings: &'s Settings,
    pub(crate) reference: Option<ReferenceReport>,
}

impl Course {
    pub(crate) fn push(&mut self, judgement: Judgement) {
        if self.days.len() == MOST_DAYS {
            self.days.pop_front();
        }
        self.days.push_back(judgement);
    }

    pub(crate) fn last(&self) -> Option<&Judgement> {
        self.days.back()
    }

    /// Returns the last days that begin in the span of a query.
    pub(crate) fn answer(&self, subject: Subject<'_>, query: &SpanQuery) -> JudgementCourse {
        let Subject {
            structure,
            quantity,
            kind,
            conditions,
            annotations,
            settings,
            reference,
        } = subject;
        let annotations = annotations.iter().filter(|of| of.covers(quantity));
        let most = query.points.min(JudgementCourse::MOST_ROWS);
        let first = |limit_ns: i64| self.days.partition_point(|of| start_ns(of.day) < limit_ns);
        let end = first(query.to_ns.saturating_add(1));
        let begin = first(query.from_ns).max(end.saturating_sub(most)).min(end);
        let rows = self.days.range(begin..end).map(course_row);
        let units = settings.conditions.iter().map(unit);
        let conditions = conditions.iter().zip(units);
        JudgementCourse {
            structure: structure.clone(),
            quantity: quantity.clone(),
            kind: match kind {
                QuantityKind::Frequency => "frequency",
                QuantityKind::Stiffness => "stiffness",
            }
            .to_owned(),
            conditions: conditions
                .map(|(name, unit)| CourseCondition {
                    name: name.clone(),
                    unit: unit.to_owned(),
                })
                .collect(),
            false_alarms_per_year: settings.false_alarms_per_year,
            loss: settings.loss,
            commissioning_days: settings.commissioning_days,
            reference: reference.map(course_reference),
            kept_from_ns: self.days.front().map(|of| start_ns(of.day)),
            annotations: annotations.cloned().collect(),
            rows: rows.collect(),
        }
    }
}

/// Returns the unit of a condition in the scale of the judgement.
pub(crate) fn unit(condition: &Condition) -> &'static str {
    match condition.kind {
        ConditionKind::Celsius | ConditionKind::Kelvin | ConditionKind::Fahrenheit => "degC",
        ConditionKind::Amplitude => "log10",
        ConditionKind::Other { .. } => "",
    }
}

/// Converts the judgement of one day to a row of the history of the quantity.
#[must_use]
pub fn course_row(judgement: &Judgement) -> CourseRow {
    let means = judgement.means.as_ref();
    CourseRow {
        day_ns: start_ns(judgement.day),
        state: state(&judgement.state),
        change: judgement.finding.as_ref().map(change),
        sentence: judgement.sentence(),
        epochs: means.map_or(0, |means| u32::from(means.epochs)),
        measured: means.map(|means| means.value),
        conditions: means.map_or_else(Vec::new, |means| means.conditions.clone()),
        expectation: judgement.expectation.as_ref().map(expectation),
    }
}

fn course_reference(reference: ReferenceReport) -> CourseReference {
    let delay = |delay: &Delay| CourseDelay {
        loss: delay.loss,
        median_days: delay.median_days,
        found_in_a_month: delay.found_in_a_month,
    };
    CourseReference {
        from_ns: start_ns(reference.from_day),
        to_ns: start_ns(reference.to_day),
        coverage: reference.coverage,
        scatter: reference.scatter,
        knows_frost: reference.knows_frost,
        promised_per_year: reference.performance.promised_per_year,
        achieved_per_year: reference.performance.achieved_per_year,
        delays: reference.performance.delays.iter().map(delay).collect(),
    }
}

pub(crate) fn state(state: &State) -> JudgementState {
    match state {
        State::Learning { .. } => JudgementState::Learning,
        State::NotReady { .. } => JudgementState::NotReady,
        State::Judged => JudgementState::Judged,
        State::OutsideExperience { .. } => JudgementState::OutsideExperience,
        State::NoStatement { .. } => JudgementState::NoStatement,
    }
}

pub(crate) fn change(finding: &Finding) -> LastingChange {
    let Change {
        found_day,
        since_day,
        loss,
        interval,
        ..
    } = *finding.change();
    LastingChange {
        kind: match finding {
            Finding::LastingLoss(_) => ChangeKind::LastingLoss,
            Finding::LearnedAway(_) => ChangeKind::LearnedAway,
            Finding::Stiffer(_) => ChangeKind::Stiffer,
        },
        found_ns: start_ns(found_day),
        since_ns: start_ns(since_day),
        loss,
        interval: credible(interval),
    }
}

pub(crate) fn expectation(of_day: &Expectation) -> DayExpectation {
    let Expectation {
        measured,
        expected,
        interval,
        residual,
        ln_evidence,
        ln_threshold,
        cusum_share,
    } = *of_day;
    DayExpectation {
        measured,
        expected,
        interval: credible(interval),
        residual,
        ln_evidence: ln_evidence.max(LEAST_LN_EVIDENCE),
        ln_threshold,
        cusum_share,
    }
}

fn credible([low, high]: [f64; 2]) -> CredibleInterval {
    CredibleInterval {
        level: LEVEL,
        low,
        high,
    }
}

/// Returns the start of a day (ns since 1970-01-01 UTC).
pub(crate) fn start_ns(day: i64) -> i64 {
    day.saturating_mul(DAY_NS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{name, plan};
    use spandrel_judge::DayMeans;

    fn day(number: i64) -> Judgement {
        Judgement {
            day: number,
            quantity: "pier".to_owned(),
            state: State::Learning { days_left: 1 },
            means: Some(DayMeans {
                value: number as f64,
                conditions: vec![0.5],
                epochs: 4,
            }),
            expectation: None,
            finding: None,
            raised: false,
        }
    }

    fn answer(course: &Course, query: &SpanQuery) -> (Vec<i64>, Option<i64>) {
        let settings = plan().settings;
        let (bridge, pier, conditions) = (name("bridge"), name("pier"), [name("deck")]);
        let subject = Subject {
            structure: &bridge,
            quantity: &pier,
            kind: QuantityKind::Stiffness,
            conditions: &conditions,
            annotations: &[],
            settings: &settings,
            reference: None,
        };
        let answer = course.answer(subject, query);
        let days = answer.rows.iter().map(|row| row.day_ns / DAY_NS);
        (days.collect(), answer.kept_from_ns.map(|ns| ns / DAY_NS))
    }

    #[test]
    fn a_query_returns_the_last_days_of_its_span() {
        let mut course = Course::default();
        assert_eq!(answer(&course, &SpanQuery::default()), (Vec::new(), None));
        (10..20).for_each(|number| course.push(day(number)));
        let all = SpanQuery::default();
        assert_eq!(answer(&course, &all), ((10..20).collect(), Some(10)));
        let span = SpanQuery {
            from_ns: 12 * DAY_NS,
            to_ns: 15 * DAY_NS,
            ..SpanQuery::default()
        };
        assert_eq!(answer(&course, &span).0, [12, 13, 14, 15]);
        let few = SpanQuery { points: 2, ..span };
        assert_eq!(answer(&course, &few).0, [14, 15]);
        let before = SpanQuery {
            to_ns: 3 * DAY_NS,
            ..SpanQuery::default()
        };
        assert_eq!(answer(&course, &before).0, Vec::<i64>::new());
    }

    #[test]
    fn a_course_and_its_answer_are_bounded() {
        let mut course = Course::default();
        let most = MOST_DAYS as i64;
        (0..most + 3).for_each(|number| course.push(day(number)));
        let query = SpanQuery {
            points: 20_000,
            ..SpanQuery::default()
        };
        let (days, kept_from) = answer(&course, &query);
        assert_eq!(kept_from, Some(3));
        assert_eq!(days.len(), JudgementCourse::MOST_ROWS);
        assert_eq!(days.last(), Some(&(most + 2)));
    }
}
