//! Other quantities as thermometers of a quantity, and what a change of one of them means.
//!
//! Each thermometer explains the quantity in a course of its own, with its own reference. If a
//! thermometer has changed, the quantity seems to have changed in its course only. A change of the
//! quantity shows in all courses. Therefore a change is raised if two courses agree on it. One
//! thermometer that changes then causes no finding. With three thermometers it hides none either.
//!
//! A thermometer stops serving once its own change is raised. If three courses may raise N alarms a
//! year each, two of them raise at most 3 N/2 together. The budget of each of three courses is
//! therefore 2/3 of that of the quantity.

use crate::course::{Course, Frame, has_grown};
use crate::day::DayEpochs;
use crate::judgement::{Absence, Change, Finding, Judgement, Novelty, State};
use crate::reference::{Missing, Reference};
use crate::settings::{Quantity, Settings};
use serde::{Deserialize, Serialize};

/// Number of courses that must agree on a change. A single course that is left decides alone.
const AGREEING: usize = 2;
/// A course without a judged day for this number of days with epochs is no longer awaited.
const SILENT_DAYS: u32 = 30;

/// Returns the share of the budget of a quantity that each of its courses has. It is 1 without
/// thermometers.
pub(crate) fn budget_share(courses: usize) -> f64 {
    AGREEING as f64 / courses.max(AGREEING) as f64
}

/// Course of a judged quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum QuantityCourse {
    /// Its conditions explain it.
    Alone(Course),
    /// Its conditions and one thermometer at a time explain it.
    Compared(Comparisons),
}

/// The courses of a quantity, one per thermometer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Comparisons {
    comparisons: Vec<Comparison>,
    held: Option<Held>,
}

/// A finding that holds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Held {
    finding: Finding,
    /// Interval of the loss that was last raised.
    raised: [f64; 2],
}

/// The course of a quantity with one thermometer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Comparison {
    /// Index of the thermometer among the quantities.
    thermometer: usize,
    course: Course,
    /// The thermometer has changed, or has a new reference.
    is_stopped: bool,
    /// An epoch of the day had the quantity, but not the thermometer.
    is_missing: bool,
    /// Number of days with epochs since the last judged one. Days of an outage do not count: on the
    /// first day after it, a single course would otherwise decide alone.
    silent_days: u32,
}

impl QuantityCourse {
    /// Creates the course of a quantity without a reference. The settings must be valid.
    pub(crate) fn new(quantity: &Quantity, settings: &Settings) -> Self {
        if quantity.thermometers.is_empty() {
            return Self::Alone(Course::new());
        }
        let quantities = settings.quantities.iter().enumerate();
        let thermometers = quantities.filter(|(_, one)| quantity.thermometers.contains(&one.name));
        let comparison = |(thermometer, _): (usize, &Quantity)| Comparison {
            thermometer,
            course: Course::new(),
            is_stopped: false,
            is_missing: false,
            silent_days: u32::MAX,
        };
        Self::Compared(Comparisons {
            comparisons: thermometers.map(comparison).collect(),
            held: None,
        })
    }

    /// Adds an epoch: ln(value), the conditions in the scale of the model, and ln(stiffness) of
    /// every quantity.
    pub(crate) fn add(&mut self, y: f64, conditions: &[f64], stiffnesses: &[Option<f64>]) {
        match self {
            Self::Alone(course) => course.epochs.add(y, conditions),
            Self::Compared(of) => {
                for comparison in of.serving_mut() {
                    match stiffnesses[comparison.thermometer] {
                        Some(stiffness) => {
                            let values = [conditions, &[stiffness][..]].concat();
                            comparison.course.epochs.add(y, &values);
                        }
                        None => comparison.is_missing = true,
                    }
                }
            }
        }
    }

    /// Discards the epochs of the open day in which a quantity was used: that of this course, or a
    /// thermometer of it.
    pub(crate) fn discard_day(&mut self, quantity: usize, is_own: bool) {
        match self {
            Self::Alone(course) if is_own => course.epochs = DayEpochs::default(),
            Self::Alone(_) => {}
            Self::Compared(of) => {
                let is_used = |one: &&mut Comparison| is_own || one.thermometer == quantity;
                let concerned = of.serving_mut().filter(is_used);
                concerned.for_each(|comparison| {
                    comparison.course.epochs = DayEpochs::default();
                    comparison.is_missing |= !is_own;
                });
            }
        }
    }

    /// Ends a day and returns its judgement.
    pub(crate) fn end_day(&mut self, frame: Frame<'_>) -> Judgement {
        match self {
            Self::Alone(course) => course.end_day(frame),
            Self::Compared(comparisons) => comparisons.end_day(frame),
        }
    }

    /// Takes note that a quantity has a new reference. It no longer serves as a thermometer.
    ///
    /// A course that is still in its commissioning begins again with the new values instead. The
    /// order in which several quantities get a new reference on one day therefore has no effect.
    pub(crate) fn begin_again(&mut self, quantity: usize) {
        if let Self::Compared(of) = self {
            for comparison in of.serving_mut().filter(|one| one.thermometer == quantity) {
                comparison.is_stopped = comparison.course.reference().is_ok();
                comparison.course = Course::new();
            }
        }
    }

    /// Takes note that a quantity has changed. It no longer serves as a thermometer.
    pub(crate) fn stop(&mut self, quantity: usize) {
        if let Self::Compared(of) = self {
            let concerned = of.serving_mut().filter(|one| one.thermometer == quantity);
            concerned.for_each(|comparison| {
                comparison.is_stopped = true;
                comparison.course = Course::new();
            });
        }
    }

    /// Returns the reference, or the reason why there is none. With thermometers, it is that of the
    /// course that decides most often: the second most precise one.
    pub(crate) fn reference(&self) -> Result<&Reference, Option<&Missing>> {
        let comparisons = match self {
            Self::Alone(course) => return course.reference(),
            Self::Compared(of) => of.comparisons.iter().filter(|one| !one.is_stopped),
        };
        let (mut references, mut missing) = (Vec::new(), Vec::new());
        for comparison in comparisons {
            match comparison.course.reference() {
                Ok(reference) => references.push(reference),
                Err(why) => missing.push(why),
            }
        }
        if let Some(why) = missing.first().filter(|_| references.len() < AGREEING) {
            return Err(*why);
        }
        references.sort_by(|a, b| a.scatter().total_cmp(&b.scatter()));
        let deciding = references.len().min(AGREEING).checked_sub(1);
        deciding.map(|place| references[place]).ok_or(None)
    }

    /// Returns the finding that holds.
    pub(crate) fn finding(&self) -> Option<&Finding> {
        match self {
            Self::Alone(course) => course.finding(),
            Self::Compared(comparisons) => comparisons.held.as_ref().map(|held| &held.finding),
        }
    }
}

impl Comparison {
    fn end_day(&mut self, frame: Frame<'_>) -> Judgement {
        let name = frame.settings.quantities[self.thermometer].name.as_str();
        let is_missing = std::mem::take(&mut self.is_missing);
        let missing = is_missing.then(|| Absence::Condition(name.to_owned()));
        let mut judgement = self.course.end_day(Frame {
            thermometer: Some(name),
            absence: frame.absence.or(missing.as_ref()),
            ..frame
        });
        self.silent_days = match judgement.state {
            // From the day on which its commissioning ends, the course has a say.
            State::Judged | State::Learning { days_left: 0 } => 0,
            // A first winter silences all courses. The first one after it would decide alone.
            State::OutsideExperience {
                novelty: Novelty::Frost,
            } => self.silent_days,
            _ => self.silent_days.saturating_add(1),
        };
        if let Some(means) = &mut judgement.means {
            means.conditions.truncate(frame.settings.conditions.len());
        }
        judgement
    }

    /// Returns `true` if the course was judged within the last days.
    fn is_awaited(&self) -> bool {
        self.silent_days < SILENT_DAYS
    }
}

impl Comparisons {
    fn serving_mut(&mut self) -> impl Iterator<Item = &mut Comparison> {
        self.comparisons.iter_mut().filter(|one| !one.is_stopped)
    }

    fn finding(&self) -> Option<Finding> {
        self.held.map(|held| held.finding)
    }

    fn end_day(&mut self, frame: Frame<'_>) -> Judgement {
        let (mut awaited, mut others, mut learning) = (Vec::new(), Vec::new(), None);
        let mut ready = 0;
        for comparison in self.serving_mut() {
            let judgement = comparison.end_day(frame);
            if comparison.course.reference().is_err() {
                learning.get_or_insert(judgement);
                continue;
            }
            ready += 1;
            if comparison.is_awaited() {
                awaited.push(judgement);
            } else {
                others.push(judgement);
            }
        }
        // A third thermometer can follow later, or never.
        if let Some(judgement) = learning.filter(|_| ready < AGREEING) {
            return Judgement {
                finding: self.finding(),
                raised: false,
                ..judgement
            };
        }
        let raised = agreed(&awaited).is_some_and(|change| self.hold(change, frame));
        let courses = if awaited.is_empty() { others } else { awaited };
        let judgement = deciding(courses).unwrap_or_else(|| self.without_thermometer(frame));
        Judgement {
            finding: self.finding(),
            raised,
            ..judgement
        }
    }

    /// Takes a change on which courses agree. Returns `true` if it is raised: it is new, or a loss
    /// that has grown.
    ///
    /// A notice does not replace an alarm.
    fn hold(&mut self, finding: Finding, frame: Frame<'_>) -> bool {
        let is_alarm = finding.is_alarm();
        if !is_alarm && self.finding().is_some_and(|held| held.is_alarm()) {
            return false;
        }
        let change = finding.change();
        // An alarm replaces a notice.
        let known = self.held.filter(|held| held.finding.is_alarm() == is_alarm);
        let is_raised = known
            .is_none_or(|held| is_alarm && has_grown(change, held.raised, frame.settings.loss));
        let (found_day, raised) = match known {
            Some(held) if !is_raised => (held.finding.change().found_day, held.raised),
            _ => (frame.day, change.interval),
        };
        self.held = Some(Held {
            finding: finding.with(Change {
                found_day,
                ..*change
            }),
            raised,
        });
        is_raised
    }

    fn without_thermometer(&self, frame: Frame<'_>) -> Judgement {
        let name = |one: &Comparison| frame.settings.quantities[one.thermometer].name.as_str();
        let names: Vec<&str> = self.comparisons.iter().map(name).collect();
        Judgement {
            day: frame.day,
            quantity: frame.quantity.name.clone(),
            state: State::NoStatement {
                why: Absence::Changed(names.join(", ")),
            },
            means: None,
            expectation: None,
            finding: None,
            raised: false,
        }
    }
}

/// Returns the change on which enough courses agree: the smallest one of theirs. An alarm comes
/// before a notice.
fn agreed(courses: &[Judgement]) -> Option<Finding> {
    let needed = courses.len().min(AGREEING);
    let of_kind = |is_alarm: bool| {
        let findings = courses.iter().filter_map(|course| course.finding);
        let findings = findings.filter(move |finding| finding.is_alarm() == is_alarm);
        let size = |finding: &Finding| finding.change().loss.abs();
        let smallest = findings.clone().min_by(|a, b| size(a).total_cmp(&size(b)));
        smallest.filter(|_| findings.count() >= needed)
    };
    of_kind(true).or_else(|| of_kind(false))
}

/// Returns the judgement of the course that decides: of those with the best state of the day, the
/// one with the second-largest evidence.
fn deciding(mut courses: Vec<Judgement>) -> Option<Judgement> {
    let rank = |course: &Judgement| match course.state {
        State::Judged => 0,
        State::OutsideExperience { .. } => 1,
        State::Learning { .. } | State::NotReady { .. } | State::NoStatement { .. } => 2,
    };
    let evidence = |course: &Judgement| {
        let expectation = course.expectation.as_ref();
        expectation.map_or(f64::NEG_INFINITY, |expectation| expectation.ln_evidence)
    };
    let best = courses.iter().map(rank).min()?;
    courses.retain(|course| rank(course) == best);
    courses.sort_by(|a, b| evidence(b).total_cmp(&evidence(a)));
    let place = courses.len().min(AGREEING) - 1;
    courses.into_iter().nth(place)
}
