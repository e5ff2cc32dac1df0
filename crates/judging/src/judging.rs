//! Judges closed epochs, and states the result in messages.

use crate::epochs::ClosedEpoch;
use spandrel_bus::{
    ChangeKind, CredibleInterval, DayExpectation, Event, EventKind, JudgementDisplay,
    JudgementState, LastingChange, Name,
};
use spandrel_judge::{Change, Expectation, Finding, Judge, JudgeError, Judgement, Settings, State};

/// Nanoseconds of a day.
const DAY_NS: i64 = 86_400_000_000_000;
/// Level of the intervals of the judgement.
const LEVEL: f64 = 0.95;

/// The judge of one structure, and its last judgements.
#[derive(Debug, Clone)]
pub(crate) struct Judging {
    structure: Name,
    judge: Judge,
    quantities: Vec<JudgedQuantity>,
    /// Middle of the last epoch (ns since 1970-01-01 UTC).
    epoch_ns: Option<i64>,
    epochs: u64,
    /// Whether all samples were measured.
    is_measured: bool,
}

#[derive(Debug, Clone)]
struct JudgedQuantity {
    name: Name,
    /// Number of epochs with a value.
    epochs: u64,
    last: Option<Judgement>,
}

impl Judging {
    /// Creates a judge without any reference. `names` are those of the quantities in `settings`.
    ///
    /// # Errors
    /// A setting is out of range.
    pub(crate) fn new(
        structure: Name,
        names: Vec<Name>,
        settings: Settings,
    ) -> Result<Self, JudgeError> {
        let quantities = names.into_iter().map(|name| JudgedQuantity {
            name,
            epochs: 0,
            last: None,
        });
        Ok(Self {
            structure,
            judge: Judge::new(settings)?,
            quantities: quantities.collect(),
            epoch_ns: None,
            epochs: 0,
            is_measured: true,
        })
    }

    /// Returns the middle of the last epoch (ns since 1970-01-01 UTC).
    pub(crate) fn epoch_ns(&self) -> Option<i64> {
        self.epoch_ns
    }

    /// Returns the number of epochs.
    pub(crate) fn epochs(&self) -> u64 {
        self.epochs
    }

    /// Judges an epoch, and appends the changes that it reveals to `events`. Returns `true` if a day
    /// has ended.
    ///
    /// # Errors
    /// The epoch is not later than the previous one. It is then ignored.
    pub(crate) fn handle(
        &mut self,
        closed: &ClosedEpoch,
        events: &mut Vec<Event>,
    ) -> Result<bool, JudgeError> {
        let mut judgements = Vec::new();
        self.judge.handle(&closed.epoch, &mut judgements)?;
        self.epoch_ns = Some(closed.middle_ns);
        self.epochs += 1;
        self.is_measured &= closed.is_measured;
        for (quantity, value) in self.quantities.iter_mut().zip(&closed.epoch.quantities) {
            quantity.epochs += u64::from(value.is_some());
        }
        let is_day_over = !judgements.is_empty();
        for judgement in judgements {
            let mut quantities = self.quantities.iter_mut();
            let is_it =
                |quantity: &&mut JudgedQuantity| quantity.name.as_str() == judgement.quantity;
            let Some(quantity) = quantities.find(is_it) else {
                continue; // the settings name all quantities
            };
            if judgement.raised {
                events.extend(event(&self.structure, &judgement, closed.middle_ns));
            }
            quantity.last = Some(judgement);
        }
        Ok(is_day_over)
    }

    /// Returns the state of every quantity. `time_ns` is the wall-clock time (ns since 1970-01-01
    /// UTC).
    pub(crate) fn displays(&self, time_ns: i64) -> Vec<JudgementDisplay> {
        let display = |quantity: &JudgedQuantity| {
            let judgement = match &quantity.last {
                Some(last) => last.clone(),
                None => self.first(quantity),
            };
            JudgementDisplay {
                structure: self.structure.clone(),
                quantity: quantity.name.clone(),
                time_ns,
                day_ns: quantity.last.as_ref().map(|last| start_ns(last.day)),
                epoch_ns: self.epoch_ns,
                epochs: quantity.epochs,
                measured: self.is_measured,
                state: state(&judgement.state),
                change: judgement.finding.as_ref().map(change),
                sentence: judgement.sentence(),
                expectation: judgement.expectation.as_ref().map(expectation),
                false_alarms_per_year: self.judge.settings().false_alarms_per_year,
            }
        };
        self.quantities.iter().map(display).collect()
    }

    /// Returns what is known before the end of the first day.
    fn first(&self, quantity: &JudgedQuantity) -> Judgement {
        Judgement {
            day: 0,
            quantity: quantity.name.to_string(),
            state: State::Learning {
                days_left: self.judge.settings().commissioning_days,
            },
            expectation: None,
            finding: None,
            raised: false,
        }
    }
}

fn event(structure: &Name, judgement: &Judgement, time_ns: i64) -> Option<Event> {
    let finding = judgement.finding.as_ref()?;
    Some(Event {
        structure: structure.clone(),
        time_ns,
        kind: EventKind::LastingChange,
        subject: judgement.quantity.clone(),
        what: finding.name().to_owned(),
        why: judgement.sentence(),
    })
}

fn state(state: &State) -> JudgementState {
    match state {
        State::Learning { .. } => JudgementState::Learning,
        State::NotReady { .. } => JudgementState::NotReady,
        State::Judged => JudgementState::Judged,
        State::OutsideExperience { .. } => JudgementState::OutsideExperience,
        State::NoStatement { .. } => JudgementState::NoStatement,
    }
}

fn change(finding: &Finding) -> LastingChange {
    let Change {
        found_day,
        since_day,
        loss,
        interval,
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

fn expectation(of_day: &Expectation) -> DayExpectation {
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
        ln_evidence,
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
fn start_ns(day: i64) -> i64 {
    day.saturating_mul(DAY_NS)
}

#[cfg(test)]
mod tests;
