//! The history of a judged quantity: one row per day.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;

use super::{
    Annotation, DayExpectation, Format, JudgementState, LastingChange, Malformed, Message,
    check_count, check_finite, check_label, check_range, check_text,
};
use crate::name::Name;

/// Maximum number of conditions of a judgement.
pub(super) const MOST_CONDITIONS: usize = 16;
/// Maximum number of delays of a reference.
const MOST_DELAYS: usize = 64;

/// A condition in the history of a judged quantity.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CourseCondition {
    /// Name of the condition.
    pub name: Name,
    /// Unit of the values of the condition: `degC`, `log10` of an amplitude, or empty for any other
    /// condition; at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES).
    pub unit: String,
}

/// Time from a loss of stiffness to its detection, from simulated years.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CourseDelay {
    /// Size of the loss, as a share of the stiffness (0 to 1).
    pub loss: f64,
    /// Median time from the loss to its detection, days. `None` if most losses of this size are
    /// missed.
    pub median_days: Option<u32>,
    /// Share of the simulated losses of this size that are found within 30 days, 0 to 1.
    pub found_in_a_month: f64,
}

/// Summary of a learnt reference: its commissioning, false alarms and detection delays.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CourseReference {
    /// Start of the first day of the commissioning, ns since the Unix epoch, UTC.
    pub from_ns: i64,
    /// Start of the last day of the commissioning, ns since the Unix epoch, UTC.
    pub to_ns: i64,
    /// Share of the later days of the commissioning within their 95 % interval, 0 to 1.
    pub coverage: f64,
    /// Standard deviation of a day under known conditions, as a share of the value.
    pub scatter: f64,
    /// Whether the commissioning, with the later winters that are over, contained five days of
    /// frost. `None` without a temperature.
    pub knows_frost: Option<bool>,
    /// Budget of this quantity: false alarms per year.
    pub promised_per_year: f64,
    /// Rate of false alarms in simulated years, per year.
    pub achieved_per_year: f64,
    /// Delays by size of loss.
    pub delays: Vec<CourseDelay>,
}

/// One day of a judged quantity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CourseRow {
    /// Start of the day, ns since the Unix epoch, UTC.
    pub day_ns: i64,
    /// State on this day.
    pub state: JudgementState,
    /// The lasting change that was known at the end of the day. `None` without one.
    pub change: Option<LastingChange>,
    /// State and change in one sentence.
    pub sentence: String,
    /// Number of epochs of the day that count.
    pub epochs: u32,
    /// Mean value of the day, in the unit of the quantity. `None` if no epoch counts.
    pub measured: Option<f64>,
    /// Mean of each condition over the day, in the order of the conditions. Empty if no epoch
    /// counts.
    pub conditions: Vec<f32>,
    /// Expected value of the day. `None` without a reference, and for a day without data.
    pub expectation: Option<DayExpectation>,
}

/// Reply to a query for the history of a judged quantity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JudgementCourse {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the judged quantity.
    pub quantity: Name,
    /// What the quantity measures: `frequency` or `stiffness`; at most
    /// [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES).
    pub kind: String,
    /// The conditions, in the order of their values in the rows.
    pub conditions: Vec<CourseCondition>,
    /// Budget: false alarms per year, for all quantities of the structure.
    pub false_alarms_per_year: f64,
    /// Loss of stiffness that matters, as a share of the reference (0 to 1).
    pub loss: f64,
    /// Length of the commissioning, days.
    pub commissioning_days: u32,
    /// Reference with which the days are compared. `None` while the reference is learnt.
    pub reference: Option<CourseReference>,
    /// Start of the earliest day that is kept, ns since the Unix epoch, UTC. `None` without days.
    pub kept_from_ns: Option<i64>,
    /// Annotations of the quantity by people, in the order of their arrival. They are not limited
    /// to the requested span.
    pub annotations: Vec<Annotation>,
    /// The days of the span, in chronological order. If the reply cannot contain all, it contains
    /// the last ones.
    pub rows: Vec<CourseRow>,
}

impl JudgementCourse {
    /// Maximum number of annotations of a structure.
    pub const MOST_ANNOTATIONS: usize = 1000;
    /// Maximum number of rows of a reply: more than ten years, and less than 8 MiB.
    pub const MOST_ROWS: usize = 3700;

    /// Returns the rows as CSV, with a header.
    #[must_use]
    pub fn csv(&self) -> String {
        let names: Vec<&str> = self.conditions.iter().map(|of| of.name.as_str()).collect();
        let mut text = CourseRow::csv_header(&names);
        for row in &self.rows {
            text += &row.csv_line(self.quantity.as_str(), names.len());
        }
        text
    }
}

impl CourseRow {
    /// Returns the header of a CSV file of histories, with its line end.
    #[must_use]
    pub fn csv_header(conditions: &[&str]) -> String {
        let mut text = "date,quantity,state,change,loss,loss.low,loss.high,epochs,measured,\
                        expected,expected.low,expected.high,residual,ln-evidence,ln-threshold,\
                        cusum-share"
            .to_owned();
        for name in conditions {
            // Writing to a string cannot fail.
            let _ = write!(text, ",condition/{name}");
        }
        text + "\n"
    }

    /// Returns the day as a line of a CSV file, with its line end. A missing value is empty.
    ///
    /// Numbers have the fewest digits that read back as the same number.
    #[must_use]
    pub fn csv_line(&self, quantity: &str, conditions: usize) -> String {
        let change = self.change.as_ref();
        let expectation = self.expectation.as_ref();
        let mut text = format!("{},{quantity},{}", self.date(), self.state.as_str());
        text.push(',');
        text.push_str(change.map_or("", |change| change.kind.as_str()));
        let mut field = |value: Option<f64>| {
            text.push(',');
            if let Some(value) = value {
                // Writing to a string cannot fail.
                let _ = write!(text, "{value}");
            }
        };
        field(change.map(|change| change.loss));
        field(change.map(|change| change.interval.low));
        field(change.map(|change| change.interval.high));
        field(Some(f64::from(self.epochs)));
        field(self.measured);
        field(expectation.map(|of| of.expected));
        field(expectation.map(|of| of.interval.low));
        field(expectation.map(|of| of.interval.high));
        field(expectation.map(|of| of.residual));
        field(expectation.map(|of| of.ln_evidence));
        field(expectation.map(|of| of.ln_threshold));
        field(expectation.map(|of| of.cusum_share));
        for index in 0..conditions {
            text.push(',');
            if let Some(value) = self.conditions.get(index) {
                let _ = write!(text, "{value}");
            }
        }
        text + "\n"
    }

    fn date(&self) -> String {
        let time = Timestamp::from_nanosecond(i128::from(self.day_ns));
        time.map_or_else(
            |_| self.day_ns.to_string(),
            |time| time.strftime("%Y-%m-%d").to_string(),
        )
    }

    fn check(&self, conditions: usize) -> Result<(), Malformed> {
        check_text("sentence", &self.sentence)?;
        if let Some(change) = &self.change {
            change.check()?;
        }
        self.measured
            .map_or(Ok(()), |value| check_finite("measured", value))?;
        if !self.conditions.is_empty() && self.conditions.len() != conditions {
            return Err(Malformed::Length {
                what: "conditions of a day",
                found: self.conditions.len(),
                expected: conditions,
            });
        }
        self.conditions
            .iter()
            .try_for_each(|value| check_finite("condition", f64::from(*value)))?;
        match &self.expectation {
            Some(expectation) => expectation.check(),
            None => Ok(()),
        }
    }
}

impl CourseReference {
    fn check(&self) -> Result<(), Malformed> {
        let finite = [
            ("coverage", self.coverage),
            ("scatter", self.scatter),
            ("promised rate", self.promised_per_year),
            ("achieved rate", self.achieved_per_year),
        ];
        for (what, value) in finite {
            check_finite(what, value)?;
        }
        check_count("delays", self.delays.len(), 0, MOST_DELAYS)?;
        self.delays.iter().try_for_each(|delay| {
            check_finite("loss of a delay", delay.loss)?;
            check_range("found in a month", delay.found_in_a_month, 0.0, 1.0)
        })
    }
}

impl Message for JudgementCourse {
    const TYPE: &'static str = "judgement-course";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_label("kind", &self.kind)?;
        check_count("conditions", self.conditions.len(), 0, MOST_CONDITIONS)?;
        for condition in &self.conditions {
            check_label("unit", &condition.unit)?;
        }
        check_range(
            "false alarms per year",
            self.false_alarms_per_year,
            0.0,
            f64::MAX,
        )?;
        check_range("loss", self.loss, 0.0, 1.0)?;
        if let Some(reference) = &self.reference {
            reference.check()?;
        }
        let most = Self::MOST_ANNOTATIONS;
        check_count("annotations", self.annotations.len(), 0, most)?;
        self.annotations.iter().try_for_each(Message::check)?;
        check_count("rows", self.rows.len(), 0, Self::MOST_ROWS)?;
        let conditions = self.conditions.len();
        self.rows.iter().try_for_each(|row| row.check(conditions))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ChangeKind, CredibleInterval};

    fn course() -> JudgementCourse {
        let interval = |low, high| CredibleInterval {
            level: 0.95,
            low,
            high,
        };
        let name = |text: &str| Name::new(text).unwrap();
        let learning = CourseRow {
            day_ns: 20_000 * 86_400_000_000_000,
            state: JudgementState::Learning,
            change: None,
            sentence: "deck is being learnt; 1 days of commissioning remain.".to_owned(),
            epochs: 96,
            measured: Some(2.5),
            conditions: vec![14.74],
            expectation: None,
        };
        let judged = CourseRow {
            day_ns: 20_001 * 86_400_000_000_000,
            state: JudgementState::Judged,
            change: Some(LastingChange {
                kind: ChangeKind::LastingLoss,
                found_ns: 0,
                since_ns: 0,
                loss: 0.1 + 0.2,
                interval: interval(0.25, 0.375),
            }),
            sentence: "deck has lost 30 % of stiffness.".to_owned(),
            expectation: Some(DayExpectation {
                measured: 2.0,
                expected: 2.5,
                interval: interval(2.25, 2.75),
                residual: -4.0,
                ln_evidence: 9.5,
                ln_threshold: 8.25,
                cusum_share: 1.5,
            }),
            measured: Some(2.0),
            ..learning.clone()
        };
        let absent = CourseRow {
            day_ns: 20_002 * 86_400_000_000_000,
            state: JudgementState::NoStatement,
            epochs: 0,
            measured: None,
            conditions: Vec::new(),
            ..learning.clone()
        };
        JudgementCourse {
            structure: name("bridge"),
            quantity: name("deck"),
            kind: "frequency".to_owned(),
            conditions: vec![CourseCondition {
                name: name("air"),
                unit: "degC".to_owned(),
            }],
            false_alarms_per_year: 0.1,
            loss: 0.02,
            commissioning_days: 365,
            reference: None,
            kept_from_ns: Some(0),
            annotations: Vec::new(),
            rows: vec![learning, judged, absent],
        }
    }

    #[test]
    fn a_course_is_read_back_with_the_same_bits() {
        let bytes = course().encode().unwrap();
        let read = JudgementCourse::decode("application/json", &bytes).unwrap();
        assert_eq!(read, course());
    }

    #[test]
    fn csv_has_a_line_per_day_and_empty_fields_for_what_is_missing() {
        let text = course().csv();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[0].ends_with(",cusum-share,condition/air"));
        assert_eq!(
            &lines[1..],
            [
                "2024-10-04,deck,learning,,,,,96,2.5,,,,,,,,14.74",
                "2024-10-05,deck,judged,lasting-loss,0.30000000000000004,0.25,0.375,96,2,2.5,2.25,\
                 2.75,-4,9.5,8.25,1.5,14.74",
                "2024-10-06,deck,no-statement,,,,,0,,,,,,,,,",
            ]
        );
    }

    #[test]
    fn rows_that_contradict_the_conditions_are_refused() {
        let mut wrong = course();
        wrong.rows[0].conditions = vec![1.0, 2.0];
        assert!(matches!(wrong.check(), Err(Malformed::Length { .. })));
        let mut wrong = course();
        wrong.rows[1].measured = Some(f64::NAN);
        assert!(matches!(wrong.check(), Err(Malformed::NotFinite { .. })));
        let mut many = course();
        many.rows = vec![many.rows[0].clone(); JudgementCourse::MOST_ROWS + 1];
        assert!(matches!(many.check(), Err(Malformed::Count { .. })));
    }
}
