//! Judges one stiffness parameter event by event.
//!
//! Notation: y and s as in [`course`](crate::course), τ and se as in [`between`](crate::between).
//!
//! Softening in motion compares the softest window of the shaking with the sound value, which the
//! earlier events predict with the variance τ² + se². It is reported, but it is not evidence of
//! damage.
//!
//! A lasting loss since event c compares weak motion only: the events before c with event c after
//! its shaking and all later ones. Their difference is
//!
//! δ = θ̄*(after) − θ̄*(before),  variance se²(after) + se²(before),
//!
//! where τ comes from the events before c. With equal deviations s, this variance is
//! τ²(1/m + 1/n) + s²/m + s²/n for m events before and n after. δ has a Student distribution with
//! the degrees of freedom of τ.

use crate::amplitude::{Expected, Softened, compare};
use crate::between::{
    Coverage, EventValue, Interval, Pooled, leave_one_out, student_cdf, student_quantile,
};
use crate::course::{EventCourse, WeakMotion};
use crate::error::{EarthquakeError, require};
use serde::Serialize;

/// Maximum time between recordings of one occasion (ns): half a day.
const OCCASION_NS: i64 = 12 * 3_600 * 1_000_000_000;
/// Scatter τ between events that is assumed while fewer than four events show their own (Δ ln k).
///
/// The weak motion of a highway bridge scatters by 10 % of stiffness between events.
const ASSUMED_SCATTER: f64 = 0.1;

/// Minimum number of earlier events from which their scatter is estimated. With one degree of
/// freedom, the tails of Student's t are so long that no interval is of use.
const FEWEST_EARLIER: usize = 4;

/// Degrees of freedom of a normal distribution.
const NORMAL: f64 = 1e6;

/// Minimum number of weak windows after shaking for a statement from one record.
const FEWEST_WINDOWS: usize = 3;

/// Settings of the judgement: the loss that matters, and the required probabilities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JudgeSettings {
    /// Loss of stiffness that matters, as a share of the undamaged stiffness (above 0 and below 1).
    pub loss: f64,
    /// Probability of the loss at and above which the loss is raised (above 0 and below 1).
    pub credibility: f64,
    /// Probability of the reported intervals, above 0 and below 1, such as 0.95.
    pub level: f64,
    /// log10 of the root mean square above which motion is strong.
    pub weak_amplitude: f64,
}

impl JudgeSettings {
    fn check(&self) -> Result<(), EarthquakeError> {
        let share = |setting, found| {
            let is_valid = found > 0.0 && found < 1.0;
            require(is_valid, setting, found, "above 0 and below 1")
        };
        share("loss", self.loss)?;
        share("credibility", self.credibility)?;
        share("level", self.level)?;
        let found = self.weak_amplitude;
        require(
            found.is_finite(),
            "amplitude of weak motion",
            found,
            "finite",
        )
    }
}

/// Origin of the reference value of the undamaged structure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReferenceKind {
    /// At least four earlier events, with their scatter.
    Events,
    /// One to three earlier events, with an assumed scatter.
    FewEvents,
    /// The weak motion of the same record, with an assumed scatter.
    OwnWeakMotion,
    /// The end of the same record, with an assumed scatter. The structure has perhaps not regained
    /// all of its stiffness, so that the softening is a lower bound.
    OwnRecovery,
}

/// Reference value of the undamaged structure with which an event is compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Reference {
    /// Origin of the reference value.
    pub kind: ReferenceKind,
    /// Number of events.
    pub events: usize,
    /// Mean of ln(stiffness) of the undamaged structure (y; stiffness as a ratio to nominal).
    pub y: f64,
    /// Standard deviation of y for a further event: √(τ² + se²).
    pub std: f64,
    /// Standard deviation of ln(stiffness) between events (τ).
    pub between_std: f64,
    /// Degrees of freedom. `None` for a normal distribution.
    pub degrees_of_freedom: Option<f64>,
}

/// The softening in the softest window of the shaking.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Softening {
    /// Middle of the softest window since the first frame (s).
    pub at_s: f64,
    /// log10 of the root mean square of the response in the softest window (unit of the channels).
    pub amplitude: f64,
    /// Relative change of the stiffness in the softest window, such as −0.4 for a softening by 40
    /// %.
    pub change: f64,
    /// Interval of the relative change, including the scatter between events.
    pub interval: Interval,
    /// Probability that the stiffness was below (1 − loss) times the stiffness of the undamaged
    /// structure, 0 to 1.
    pub probability: f64,
    /// Whether the probability of the loss reaches the credibility of the settings.
    pub is_raised: bool,
    /// Whether the data contradict the model in the softest window, so that the figures are rough.
    pub is_contradicted: bool,
    /// Prediction of the softening from the earlier events. `None` if no earlier event had shaking.
    pub expected: Option<Expected>,
}

/// The weak motion of an event, compared with the earlier events.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WeakState {
    /// Weak motion of the record, after the shaking if there was any.
    pub motion: WeakMotion,
    /// Interval of the stiffness within the record, as a ratio to nominal.
    pub within: Interval,
    /// Interval of the stiffness that the earlier events predict, as a ratio to nominal. `None`
    /// with fewer than three earlier events.
    pub predicted: Option<Interval>,
    /// Relative change of the stiffness since the earlier events, negative for a loss. `None`
    /// without earlier events.
    pub change: Option<f64>,
}

/// Reason why a lasting loss cannot be judged yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "reason")]
pub enum Waiting {
    /// Too few events before show the scatter of sound values. Later events cannot replace them.
    EarlierEvents {
        /// Number of events with weak motion before.
        found: usize,
        /// Number required.
        required: usize,
    },
    /// Too little weak motion since: three windows of it, an aftershock or another weak record is
    /// missing.
    WeakMotion {
        /// Number of weak windows after the shaking.
        found: usize,
        /// Number required.
        required: usize,
    },
}

/// A lasting loss since an event, judged from weak motion.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LastingLoss {
    /// Number of events before the possible loss (m in the formulas).
    pub earlier: usize,
    /// Number of events since the possible loss (n in the formulas).
    pub later: usize,
    /// Most probable loss, as a share of the stiffness before. Negative if the structure became
    /// stiffer.
    pub loss: f64,
    /// Interval of the loss, as shares of the stiffness before.
    pub interval: Interval,
    /// Probability that the stiffness has decreased at all, 0 to 1.
    pub probability_of_any: f64,
    /// Probability that the loss exceeds the loss that matters, 0 to 1.
    pub probability: f64,
    /// Smallest loss that this number of events could raise, as a share of the stiffness before.
    pub smallest: f64,
    /// Whether the probability of the loss reaches the credibility of the settings.
    pub is_raised: bool,
}

/// What is known about a lasting loss since one event.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Candidate {
    /// Index of the event that shook.
    pub since: usize,
    /// The loss. `None` while it cannot be judged.
    pub loss: Option<LastingLoss>,
    /// Reason why the loss cannot be judged yet. `None` if there is a judgement.
    pub waiting: Option<Waiting>,
}

/// The judgement of one event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventJudgement {
    /// Index of the event.
    pub event: usize,
    /// Sound value. `None` without earlier events and without weak motion of its own.
    pub reference: Option<Reference>,
    /// Softest moment. `None` without shaking or without a reference.
    pub softening: Option<Softening>,
    /// Weak motion after the shaking. `None` if there was none.
    pub weak: Option<WeakState>,
    /// Lasting loss since each event that shook or whose weak motion was softer than predicted,
    /// this one included, in the order of time.
    pub lasting: Vec<Candidate>,
}

impl EventJudgement {
    /// Returns the number of earlier events with weak motion, from which the weak motion of this
    /// one is predicted.
    #[must_use]
    pub fn earlier(&self) -> usize {
        self.reference.map_or(0, |reference| match reference.kind {
            ReferenceKind::Events | ReferenceKind::FewEvents => reference.events,
            ReferenceKind::OwnWeakMotion | ReferenceKind::OwnRecovery => 0,
        })
    }

    /// Returns the raised lasting loss since the latest event, if any.
    #[must_use]
    pub fn raised(&self) -> Option<(usize, LastingLoss)> {
        let raised = |candidate: &Candidate| {
            let loss = candidate.loss.filter(|loss| loss.is_raised)?;
            Some((candidate.since, loss))
        };
        self.lasting.iter().rev().find_map(raised)
    }

    /// Returns the judged loss that most probably exceeds the loss that matters.
    #[must_use]
    pub fn most_probable(&self) -> Option<(usize, LastingLoss)> {
        let judged = self.lasting.iter();
        judged
            .filter_map(|candidate| Some((candidate.since, candidate.loss?)))
            .rev() // the earliest of equal ones
            .max_by(|a, b| a.1.probability.total_cmp(&b.1.probability))
    }

    /// Returns the judgement of a lasting loss since this event. `None` if the event had no
    /// shaking.
    #[must_use]
    pub fn own(&self) -> Option<&Candidate> {
        self.lasting
            .iter()
            .find(|candidate| candidate.since == self.event)
    }
}

/// The first event of an occasion, and its time (ns since 1970-01-01 UTC).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Occasion(usize, Option<i64>);

/// The events of one parameter in the order of time.
#[derive(Debug, Clone)]
pub struct Sequence {
    settings: JudgeSettings,
    events: Vec<EventCourse>,
    /// Occasion of each event. The recordings of one occasion count as one event.
    occasions: Vec<Occasion>,
    softened: Vec<Option<Softened>>,
    /// Whether the weak motion of each event was softer than the earlier events predicted.
    is_softer: Vec<bool>,
    /// First event of the present reference: the latest with a raised lasting loss.
    reference_from: usize,
}

impl Sequence {
    /// Creates an empty sequence.
    ///
    /// # Errors
    /// Returns an error if a setting is out of range.
    pub fn new(settings: JudgeSettings) -> Result<Self, EarthquakeError> {
        settings.check()?;
        Ok(Self {
            settings,
            events: Vec::new(),
            occasions: Vec::new(),
            softened: Vec::new(),
            is_softer: Vec::new(),
            reference_from: 0,
        })
    }

    /// Adds an event that is later than all others, and judges it. `time_ns` is the time of its
    /// recording, ns since 1970-01-01 UTC, if it is known.
    ///
    /// A recording without shaking that begins within twelve hours of one with shaking belongs to
    /// the same occasion. Temperature and moisture, which make events scatter, are then the same,
    /// so that both together count as one event.
    pub fn push(&mut self, event: EventCourse, time_ns: Option<i64>) -> EventJudgement {
        let index = self.events.len();
        let occasion = match (self.occasions.last(), time_ns) {
            (Some(&Occasion(first, Some(begun_ns))), Some(time_ns))
                if self.events[first].has_shaking
                    && !event.has_shaking
                    && time_ns.saturating_sub(begun_ns) <= OCCASION_NS =>
            {
                Occasion(first, Some(begun_ns))
            }
            _ => Occasion(index, time_ns),
        };
        self.occasions.push(occasion);
        let reference = self.reference(&event);
        let softened = reference.and_then(|reference| self.softened(&event, &reference));
        let softening = reference
            .zip(softened)
            .and_then(|(reference, softened)| self.softening(&event, &reference, &softened));
        let weak = event.after.map(|motion| self.weak_state(motion));
        let predicted = weak.and_then(|weak| Some((weak.motion.y.exp(), weak.predicted?)));
        self.is_softer
            .push(predicted.is_some_and(|(k, interval)| k < interval.low));
        self.events.push(event);
        self.softened.push(softened);
        let lasting = self.lasting();
        EventJudgement {
            event: index,
            reference,
            softening,
            weak,
            lasting,
        }
    }

    /// Returns the interval of y in which the events of the present reference expect the weak
    /// motion of a further event that is known exactly. `None` with fewer than three events.
    #[must_use]
    pub fn expected(&self) -> Option<Interval> {
        let earlier = self.values(self.reference_from, self.events.len());
        Pooled::new(&earlier)?.prediction(0.0, self.settings.level)
    }

    /// Returns how often the weak motion of an event lies in the interval that all other events
    /// predict, among the events of this range.
    #[must_use]
    pub fn coverage(&self, events: std::ops::Range<usize>) -> Coverage {
        let values: Vec<EventValue> = self.values(events.start, events.end);
        leave_one_out(&values, self.settings.level)
    }

    /// Returns the pooled weak motion of the events of this range. `None` if there is none.
    #[must_use]
    pub fn pooled(&self, events: std::ops::Range<usize>) -> Option<Pooled> {
        Pooled::new(&self.values(events.start, events.end))
    }

    /// Returns the weak motion of all records from `from` to before `end`.
    fn values(&self, from: usize, end: usize) -> Vec<EventValue> {
        let events = self.events.get(from..end).unwrap_or(&[]).iter();
        let weak = (from..)
            .zip(events)
            .map(|(index, event)| (index, event.weak()));
        self.by_occasion(weak)
    }

    /// Returns one value per occasion of these weak motions, in order of time.
    fn by_occasion(
        &self,
        motions: impl IntoIterator<Item = (usize, Option<WeakMotion>)>,
    ) -> Vec<EventValue> {
        let mut groups: Vec<(usize, Vec<EventValue>)> = Vec::new();
        for (index, motion) in motions {
            let Some(motion) = motion else { continue };
            let Occasion(first, _) = self.occasions[index];
            match groups.last_mut() {
                Some((of, group)) if *of == first => group.push(value(motion)),
                _ => groups.push((first, vec![value(motion)])),
            }
        }
        let pooled = groups
            .iter()
            .filter_map(|(_, group)| Pooled::with_scatter(group, 0.0));
        pooled
            .map(|pooled| EventValue {
                value: pooled.mean,
                std: pooled.mean_std,
            })
            .collect()
    }

    fn reference(&self, event: &EventCourse) -> Option<Reference> {
        let earlier = self.values(self.reference_from, self.events.len());
        let (kind, pooled) = if earlier.len() >= FEWEST_EARLIER {
            (ReferenceKind::Events, Pooled::new(&earlier)?)
        } else if earlier.is_empty() {
            let weak = event.before.or(event.after);
            let kind = match weak {
                Some(_) => ReferenceKind::OwnWeakMotion,
                None => ReferenceKind::OwnRecovery,
            };
            let own = value(weak.or_else(|| event.regained())?);
            (kind, Pooled::with_scatter(&[own], ASSUMED_SCATTER)?)
        } else {
            let few = Pooled::with_scatter(&earlier, ASSUMED_SCATTER)?;
            (ReferenceKind::FewEvents, few)
        };
        Some(Reference {
            kind,
            events: pooled.events,
            y: pooled.mean,
            std: pooled.further_std(0.0),
            between_std: pooled.between_std,
            degrees_of_freedom: match kind {
                ReferenceKind::Events => pooled.degrees_of_freedom(),
                ReferenceKind::FewEvents
                | ReferenceKind::OwnWeakMotion
                | ReferenceKind::OwnRecovery => None,
            },
        })
    }

    /// Returns how much the event softened, against its own weak motion if there is any.
    fn softened(&self, event: &EventCourse, reference: &Reference) -> Option<Softened> {
        let softest = event.softest()?;
        Some(Softened {
            decades: (softest.amplitude - self.settings.weak_amplitude).max(0.0),
            change: softest.y - reference.y,
            variance: softest.s.powi(2) + reference.std.max(ASSUMED_SCATTER).powi(2),
        })
    }

    fn softening(
        &self,
        event: &EventCourse,
        reference: &Reference,
        softened: &Softened,
    ) -> Option<Softening> {
        let softest = event.softest()?;
        let degrees = reference.degrees_of_freedom.unwrap_or(NORMAL);
        let std = softest.s.hypot(reference.std);
        let change = softened.change;
        let half = student_quantile(degrees, 0.5 + 0.5 * self.settings.level) * std;
        let limit = (1.0 - self.settings.loss).ln();
        let probability = student_cdf(degrees, (limit - change) / std);
        let earlier: Vec<Softened> = self.softened.iter().flatten().copied().collect();
        Some(Softening {
            at_s: 0.5 * (softest.start_s + softest.end_s),
            amplitude: softest.amplitude,
            change: change.exp_m1(),
            interval: Interval {
                low: change - half,
                high: change + half,
            }
            .map(f64::exp_m1),
            probability,
            is_raised: probability >= self.settings.credibility,
            is_contradicted: softest.is_contradicted,
            expected: compare(&earlier, softened),
        })
    }

    fn weak_state(&self, motion: WeakMotion) -> WeakState {
        let earlier = self.values(self.reference_from, self.events.len());
        let pooled = Pooled::new(&earlier);
        let half = student_quantile(NORMAL, 0.5 + 0.5 * self.settings.level) * motion.s;
        let within = Interval {
            low: motion.y - half,
            high: motion.y + half,
        };
        let predicted = pooled.and_then(|all| all.prediction(motion.s, self.settings.level));
        WeakState {
            motion,
            within: within.map(f64::exp),
            predicted: predicted.map(|interval| interval.map(f64::exp)),
            change: pooled.map(|pooled| (motion.y - pooled.mean).exp_m1()),
        }
    }

    /// Judges a lasting loss since each event with shaking. An event whose weak motion was softer
    /// than predicted counts as well, because an unrecorded earthquake may have preceded it. A
    /// raised loss starts a new reference.
    fn lasting(&mut self) -> Vec<Candidate> {
        let mut from = 0;
        let mut candidates = Vec::new();
        for since in 0..self.events.len() {
            // One weak event alone may be an outlier.
            let is_confirmed = || {
                let later = self.events.iter().zip(&self.occasions).skip(since + 1);
                later
                    .filter(|(_, occasion)| **occasion != self.occasions[since])
                    .any(|(event, _)| event.weak().is_some())
            };
            let is_softer = self.is_softer[since] && is_confirmed();
            if !self.events[since].has_shaking && !is_softer {
                continue;
            }
            let candidate = self.candidate(from, since);
            if candidate.loss.is_some_and(|loss| loss.is_raised) {
                from = since;
            }
            candidates.push(candidate);
        }
        self.reference_from = from;
        candidates
    }

    fn candidate(&self, from: usize, since: usize) -> Candidate {
        let waits = |waiting| Candidate {
            since,
            loss: None,
            waiting: Some(waiting),
        };
        let before = self.values(from, since);
        if before.len() < FEWEST_EARLIER {
            return waits(Waiting::EarlierEvents {
                found: before.len(),
                required: FEWEST_EARLIER,
            });
        }
        let own = self.events[since].after;
        let later: Vec<(usize, Option<WeakMotion>)> = (since + 1..self.events.len())
            .map(|index| (index, self.events[index].weak()))
            .filter(|(_, weak)| weak.is_some())
            .collect();
        let windows = own.map_or(0, |own| own.windows);
        if later.is_empty() && windows < FEWEST_WINDOWS {
            return waits(Waiting::WeakMotion {
                found: windows,
                required: FEWEST_WINDOWS,
            });
        }
        // Too few windows of its own say nothing, also with later events.
        let own = own.filter(|own| own.windows >= FEWEST_WINDOWS);
        let after = self.by_occasion([(since, own)].into_iter().chain(later));
        let loss = self.loss(&before, &after);
        Candidate {
            since,
            loss,
            waiting: None,
        }
    }

    fn loss(&self, before: &[EventValue], after: &[EventValue]) -> Option<LastingLoss> {
        let sound = Pooled::new(before)?;
        let degrees = sound.degrees_of_freedom()?;
        let now = Pooled::with_scatter(after, sound.between_std)?;
        let delta = now.mean - sound.mean;
        let std = now.mean_std.hypot(sound.mean_std);
        let half = student_quantile(degrees, 0.5 + 0.5 * self.settings.level) * std;
        let limit = (1.0 - self.settings.loss).ln();
        let probability = student_cdf(degrees, (limit - delta) / std);
        let margin = student_quantile(degrees, self.settings.credibility) * std;
        Some(LastingLoss {
            earlier: before.len(),
            later: after.len(),
            loss: -delta.exp_m1(),
            interval: Interval {
                low: -(delta + half).exp_m1(),
                high: -(delta - half).exp_m1(),
            },
            probability_of_any: student_cdf(degrees, -delta / std),
            probability,
            smallest: -(limit - margin).exp_m1(),
            is_raised: probability >= self.settings.credibility,
        })
    }
}

fn value(motion: WeakMotion) -> EventValue {
    EventValue {
        value: motion.y,
        std: motion.s,
    }
}

#[cfg(test)]
mod tests;
