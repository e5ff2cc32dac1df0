//! Judges closed epochs, and states the result in messages.

use crate::course::{Course, Subject, change, expectation, start_ns, state, unit};
use crate::epochs::ClosedEpoch;
use crate::error::JudgingError;
use spandrel_bus::{
    Annotation, AnnotationEffect, BudgetSpent, ChangeSeen, EpochCondition, EpochDisplay, Event,
    EventKind, JudgementCourse, JudgementDisplay, JudgementState, LastingChange, Name, SpanQuery,
};
use spandrel_judge::{
    Budget, ConditionKind, Judge, JudgeError, Judgement, NewReference, Settings, Spent, State,
    date, season_warning,
};
use spandrel_structure::JudgePlan;

/// Age of the last epoch from which a quantity has no statement (ns).
const DAY_NS: i64 = 86_400_000_000_000;

/// The judge of one structure, and its judgements.
#[derive(Debug, Clone)]
pub(crate) struct Judging {
    structure: Name,
    judge: Judge,
    quantities: Vec<JudgedQuantity>,
    /// Names of the conditions, in the order of the settings.
    conditions: Vec<Name>,
    /// What people have noted.
    annotations: Vec<Annotation>,
    budget: Budget,
    /// Middle of the last epoch (ns since 1970-01-01 UTC).
    epoch_ns: Option<i64>,
    epochs: u64,
    /// Whether all samples were measured.
    is_measured: bool,
    /// Name of the configuration in force. `None` if it is not recorded.
    configuration: Option<String>,
}

#[derive(Debug, Clone)]
struct JudgedQuantity {
    name: Name,
    /// Number of epochs with a value.
    epochs: u64,
    course: Course,
    /// Whether a new reference has started after the last day of the course.
    is_new: bool,
}

impl Judging {
    /// Creates a judge without any reference. `names` and `conditions` are the names in `settings`.
    ///
    /// # Errors
    /// A setting is out of range.
    pub(crate) fn new(
        structure: Name,
        names: Vec<Name>,
        conditions: Vec<Name>,
        settings: Settings,
    ) -> Result<Self, JudgeError> {
        let quantities = names.into_iter().map(|name| JudgedQuantity {
            name,
            epochs: 0,
            course: Course::default(),
            is_new: false,
        });
        Ok(Self {
            structure,
            judge: Judge::new(settings)?,
            quantities: quantities.collect(),
            conditions,
            annotations: Vec::new(),
            budget: Budget::default(),
            epoch_ns: None,
            epochs: 0,
            is_measured: true,
            configuration: None,
        })
    }

    /// Creates a judge without any reference.
    ///
    /// # Errors
    /// A name cannot be a key, or a setting is out of range.
    pub(crate) fn of_plan(structure: Name, plan: &JudgePlan) -> Result<Self, JudgingError> {
        let conditions = plan.settings.conditions.iter();
        let conditions = conditions.map(|condition| name(&condition.name));
        Ok(Self::new(
            structure,
            quantity_names(plan)?,
            conditions.collect::<Result<_, _>>()?,
            plan.settings.clone(),
        )?)
    }

    /// States the name of the configuration in force.
    pub(crate) fn set_configuration(&mut self, name: String) {
        self.configuration = Some(name);
    }

    /// Returns the name of the structure.
    pub(crate) fn structure(&self) -> &Name {
        &self.structure
    }

    /// Returns the middle of the last epoch (ns since 1970-01-01 UTC).
    pub(crate) fn epoch_ns(&self) -> Option<i64> {
        self.epoch_ns
    }

    /// Returns the number of epochs.
    pub(crate) fn epochs(&self) -> u64 {
        self.epochs
    }

    /// Returns `true` if an annotation is about this structure, and about a judged quantity if it
    /// names one.
    pub(crate) fn knows(&self, annotation: &Annotation) -> bool {
        let mut quantities = self.quantities.iter();
        let is_known = |of: &Name| quantities.any(|known| known.name == *of);
        annotation.structure == self.structure && annotation.quantity.as_ref().is_none_or(is_known)
    }

    /// Returns `true` if an annotation starts a reference before an epoch that has been judged.
    pub(crate) fn is_past(&self, annotation: &Annotation) -> bool {
        let begins_s = ClosedEpoch::time_s(annotation.from_ns);
        annotation.effect == AnnotationEffect::NewReference
            && self
                .epoch_ns
                .is_some_and(|epoch_ns| begins_s <= ClosedEpoch::time_s(epoch_ns))
    }

    /// Takes an annotation. A new reference starts with the next epoch at or after its beginning.
    pub(crate) fn annotate(&mut self, annotation: Annotation) {
        if let Some(new) = new_reference(&annotation, self.judge.settings()) {
            self.judge.start_anew(new);
        }
        self.annotations.push(annotation);
    }

    /// Returns the person who was the last to see a change.
    fn seen(&self, quantity: &Name, change: &LastingChange) -> Option<ChangeSeen> {
        // A day is judged after its end.
        let known_ns = change.found_ns.saturating_add(DAY_NS);
        let sees = |annotation: &&Annotation| {
            annotation.effect == AnnotationEffect::Seen
                && annotation.covers(quantity)
                && annotation.time_ns >= known_ns
        };
        let annotation = self.annotations.iter().rfind(sees)?;
        Some(ChangeSeen {
            who: annotation.who.clone(),
            text: annotation.text.clone(),
            time_ns: annotation.time_ns,
        })
    }

    /// Judges an epoch, and appends the changes that it reveals to `events`. Returns `true` if a
    /// day has ended.
    ///
    /// # Errors
    /// The epoch is not later than the previous one. It is then ignored.
    pub(crate) fn handle(
        &mut self,
        closed: &ClosedEpoch,
        events: &mut Vec<Event>,
    ) -> Result<bool, JudgeError> {
        let mut judgements = Vec::new();
        let indices = 0..self.quantities.len();
        let before: Vec<bool> = indices
            .map(|index| self.judge.awaits_reference(index))
            .collect();
        self.judge.handle(&closed.epoch, &mut judgements)?;
        self.epoch_ns = Some(closed.middle_ns);
        self.epochs += 1;
        self.is_measured &= closed.is_measured;
        for (quantity, value) in self.quantities.iter_mut().zip(&closed.epoch.quantities) {
            quantity.epochs += u64::from(value.is_some());
        }
        let is_day_over = !judgements.is_empty();
        for judgement in judgements {
            self.budget.count(&judgement);
            let mut quantities = self.quantities.iter_mut();
            let is_it =
                |quantity: &&mut JudgedQuantity| quantity.name.as_str() == judgement.quantity;
            let Some(quantity) = quantities.find(is_it) else {
                continue; // the settings name all quantities
            };
            if judgement.raised {
                let configuration = self.configuration.as_deref();
                let time_ns = closed.middle_ns;
                let told = sentence(&self.judge, &judgement);
                let structure = &self.structure;
                events.extend(event(structure, configuration, &judgement, told, time_ns));
            }
            quantity.course.push(judgement);
        }
        // An epoch first ends the day before it, and then starts the reference.
        for (index, (quantity, awaited)) in self.quantities.iter_mut().zip(before).enumerate() {
            let has_started = awaited && !self.judge.awaits_reference(index);
            quantity.is_new = has_started || (quantity.is_new && !is_day_over);
        }
        Ok(is_day_over)
    }

    /// Returns an epoch of every quantity as it is judged. `epoch_s` is its length (s).
    pub(crate) fn epoch_displays(&self, closed: &ClosedEpoch, epoch_s: f64) -> Vec<EpochDisplay> {
        let declared = &self.judge.settings().conditions;
        let values = declared.iter().zip(&closed.epoch.conditions);
        let values: Vec<Option<f64>> = values
            .map(|(condition, value)| condition.kind.convert((*value)?).ok())
            .collect();
        let conditions = declared.iter().zip(&self.conditions).zip(&values);
        let conditions: Vec<EpochCondition> = conditions
            .map(|((condition, name), value)| EpochCondition {
                name: name.clone(),
                unit: unit(condition).to_owned(),
                value: *value,
            })
            .collect();
        let mut kinds = declared.iter().map(|condition| condition.kind);
        let amplitude = kinds.position(|kind| matches!(kind, ConditionKind::Amplitude));
        let amplitude = amplitude.and_then(|index| values.get(index).copied().flatten());
        let quantities = self.quantities.iter().zip(&closed.epoch.quantities);
        quantities
            .zip(&closed.deviations)
            .map(|((quantity, value), ln_std)| EpochDisplay {
                structure: self.structure.clone(),
                quantity: quantity.name.clone(),
                time_ns: closed.middle_ns,
                epoch_s,
                ln_mean: value.map(f64::ln),
                ln_std: *ln_std,
                amplitude,
                conditions: conditions.clone(),
                measured: closed.is_measured,
            })
            .collect()
    }

    /// Returns the state of every quantity. `time_ns` is the wall-clock time (ns since 1970-01-01
    /// UTC).
    pub(crate) fn displays(&self, time_ns: i64) -> Vec<JudgementDisplay> {
        let false_alarms_per_year = self.judge.settings().false_alarms_per_year;
        let spent = self.budget.spent(false_alarms_per_year);
        let display = |(index, quantity): (usize, &JudgedQuantity)| {
            // What was judged before a new reference no longer holds.
            let last = quantity.course.last();
            let is_new = quantity.is_new || self.judge.awaits_reference(index);
            let last = last.filter(|_| !is_new);
            let judgement = match last {
                Some(last) => last.clone(),
                None => self.first(quantity),
            };
            let change = judgement.finding.as_ref().map(change);
            JudgementDisplay {
                structure: self.structure.clone(),
                quantity: quantity.name.clone(),
                time_ns,
                day_ns: last.map(|last| start_ns(last.day)),
                epoch_ns: self.epoch_ns,
                epochs: quantity.epochs,
                measured: self.is_measured,
                state: state(&judgement.state),
                seen: change.and_then(|change| self.seen(&quantity.name, &change)),
                change,
                sentence: sentence(&self.judge, &judgement),
                expectation: judgement.expectation.as_ref().map(expectation),
                false_alarms_per_year,
                spent: Some(budget_spent(spent)),
                configuration: self.configuration.clone(),
            }
        };
        self.quantities.iter().enumerate().map(display).collect()
    }

    /// Returns what is known before the end of the first day.
    fn first(&self, quantity: &JudgedQuantity) -> Judgement {
        Judgement {
            day: 0,
            quantity: quantity.name.to_string(),
            state: State::Learning {
                days_left: self.judge.settings().commissioning_days,
            },
            means: None,
            expectation: None,
            finding: None,
            raised: false,
        }
    }

    /// Returns the days of a quantity in the span of a query, or `None` if it is not judged.
    pub(crate) fn course(&self, quantity: &Name, query: &SpanQuery) -> Option<JudgementCourse> {
        let mut quantities = self.quantities.iter();
        let index = quantities.position(|known| known.name == *quantity)?;
        let settings = self.judge.settings();
        let subject = Subject {
            structure: &self.structure,
            quantity,
            kind: settings.quantities.get(index)?.kind,
            conditions: &self.conditions,
            annotations: &self.annotations,
            settings,
            reference: self.judge.report().into_iter().nth(index)?.reference,
        };
        let course = &self.quantities.get(index)?.course;
        Some(course.answer(subject, query))
    }
}

/// Returns the new reference that `annotation` starts.
///
/// Returns `None` if the annotation has another effect, or if it names a quantity that is not
/// judged.
#[must_use]
pub fn new_reference(annotation: &Annotation, settings: &Settings) -> Option<NewReference> {
    if annotation.effect != AnnotationEffect::NewReference {
        return None;
    }
    let index = |of: &Name| {
        let mut quantities = settings.quantities.iter();
        quantities.position(|quantity| quantity.name == of.as_str())
    };
    let quantity = match &annotation.quantity {
        Some(of) => Some(index(of)?),
        None => None,
    };
    Some(NewReference {
        time_s: ClosedEpoch::time_s(annotation.from_ns),
        quantity,
    })
}

/// Returns an event for each change that only one of two configurations finds in the same epochs.
pub(crate) fn differences(
    former: &[JudgementDisplay],
    present: &[JudgementDisplay],
    time_ns: i64,
) -> Vec<Event> {
    let kind_in = |displays: &[JudgementDisplay], quantity: &Name| {
        let mut displays = displays.iter();
        let display = displays.find(|display| display.quantity == *quantity)?;
        display.change.map(|change| change.kind)
    };
    let configuration = present.first().and_then(|of| of.configuration.as_deref());
    let configuration = configuration.unwrap_or("now in force");
    let event = |display: &JudgementDisplay, what: String, why: String| Event {
        structure: display.structure.clone(),
        time_ns,
        kind: EventKind::LastingChange,
        subject: display.quantity.to_string(),
        what,
        why,
    };
    let mut events = Vec::new();
    for display in former {
        let lost = display.change.map(|change| change.kind);
        if let Some(lost) = lost.filter(|lost| kind_in(present, &display.quantity) != Some(*lost)) {
            let what = format!("{} no longer found", lost.as_str());
            let before = display.configuration.as_deref().unwrap_or_default();
            let why = format!(
                "Configuration {configuration} does not find it. Configuration {before} stated: {}",
                display.sentence
            );
            events.push(event(display, what, why));
        }
    }
    for display in present {
        let new = display.change.map(|change| change.kind);
        if let Some(new) = new.filter(|new| kind_in(former, &display.quantity) != Some(*new)) {
            let why = format!("{} Configuration {configuration}.", display.sentence);
            events.push(event(display, new.as_str().to_owned(), why));
        }
    }
    events
}

/// Withdraws a judgement at a time (ns since 1970-01-01 UTC) if its last epoch is older than a day:
/// without epochs, no day ends, so that the last judgement would remain.
///
/// A replay or simulation may have any time.
pub(crate) fn withdraw_old(display: &mut JudgementDisplay, time_ns: i64) {
    let Some(epoch_ns) = display.epoch_ns.filter(|_| display.measured) else {
        return;
    };
    if time_ns.saturating_sub(epoch_ns) <= DAY_NS {
        return;
    }
    let since = date(epoch_ns.div_euclid(DAY_NS));
    display.state = JudgementState::NoStatement;
    display.sentence = match display.change {
        Some(_) => format!("{} It has no value since {since}.", display.sentence),
        None => format!("{} has no value since {since}.", display.quantity),
    };
}

fn budget_spent(spent: Spent) -> BudgetSpent {
    let Spent {
        judged_days,
        promised,
        alarms,
        alarms_in_last_year,
    } = spent;
    BudgetSpent {
        judged_days,
        promised,
        alarms,
        alarms_in_last_year,
    }
}

/// Returns the names of the judged quantities.
pub(crate) fn quantity_names(plan: &JudgePlan) -> Result<Vec<Name>, JudgingError> {
    let quantities = plan.settings.quantities.iter();
    quantities.map(|quantity| name(&quantity.name)).collect()
}

pub(crate) fn name(text: &str) -> Result<Name, JudgingError> {
    Name::new(text).map_err(|source| JudgingError::Name {
        found: text.to_owned(),
        source,
    })
}

/// Returns the sentence of a judgement. If it has a finding, this contains the warning about a
/// commissioning that lacks a season.
fn sentence(judge: &Judge, judgement: &Judgement) -> String {
    let told = judgement.sentence();
    if judgement.finding.is_none() {
        return told;
    }
    let mut reports = judge.report().into_iter();
    let report = reports.find(|report| report.quantity == judgement.quantity);
    let reference = report.and_then(|report| report.reference);
    match reference.and_then(|reference| season_warning(reference.commissioning_days())) {
        Some(warning) => format!("{told} But {warning}."),
        None => told,
    }
}

/// Returns the event of a change that was found in the epoch with this middle (ns).
fn event(
    structure: &Name,
    configuration: Option<&str>,
    judgement: &Judgement,
    sentence: String,
    time_ns: i64,
) -> Option<Event> {
    let finding = judgement.finding.as_ref()?;
    let judged = configuration.map(|name| format!(" Configuration {name}."));
    Some(Event {
        structure: structure.clone(),
        time_ns,
        kind: EventKind::LastingChange,
        subject: judgement.quantity.clone(),
        what: finding.name().to_owned(),
        why: sentence + &judged.unwrap_or_default(),
    })
}

#[cfg(test)]
mod tests;
