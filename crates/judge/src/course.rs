//! The history of one quantity: commissioning, then one decision per day.

use crate::cumulant::CLIP;
use crate::cusum;
use crate::day::{Day, DayEpochs};
use crate::detector::{Detector, Evidence, HELD_DAYS, SMALLEST_STEP, StepEstimate};
use crate::interval;
use crate::judgement::{Absence, Change, Expectation, Finding, Further, Judgement, Novelty, State};
use crate::model::{Explanation, Row};
use crate::present::{DayChange, LatestChanges};
use crate::reference::{Expected, Missing, Reference};
use crate::regression::{Posterior, weight};
use crate::settings::{Quantity, Settings};
use crate::thermometers::budget_share;
use serde::{Deserialize, Serialize};

/// Days between attempts to learn the reference after a commissioning that was not ready.
const RETRY_DAYS: i64 = 7;
/// The drift of the learnt reference is raised at a probability of 0.999: this quantile of the
/// normal distribution.
const LEARNED_AWAY_QUANTILE: f64 = 3.090;
/// Quantile of a 95 % interval.
const INTERVAL_QUANTILE: f64 = 1.960;
/// Days after a finding on which its first day is estimated again. Later days can contain further
/// changes, which would move it.
const DATING_DAYS: i64 = 30;

/// Course of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Course {
    pub(crate) epochs: DayEpochs,
    phase: Phase,
    found: Option<Found>,
}

/// A finding that holds, and what its next days need.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Found {
    finding: Finding,
    /// Day on which the change was first found.
    first_day: i64,
    /// Level just before the change, relative to the commissioning, in ln(value).
    before: f64,
    /// Interval of the loss that was last raised.
    raised: [f64; 2],
    /// Number of the latest judged days on which the loss had grown.
    grown_days: u32,
    /// Last further loss: its day, and the loss that was stated before it.
    further: Option<(i64, f64)>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Phase {
    Learning(Commissioning),
    Judging(Box<Judging>),
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Commissioning {
    days: Vec<Day>,
    /// What the last attempt missed, and its day.
    missing: Option<(Missing, i64)>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Judging {
    reference: Reference,
    adaptive: Posterior,
    detector: Detector,
    cusum: f64,
    cusum_threshold: f64,
    /// Number of the last day.
    last_day: i64,
    /// Changes on the latest days.
    latest: LatestChanges,
    /// q: half of the 95 % interval of a day, in units of its scatter.
    quantile: f64,
}

/// What the histories of all quantities of a structure share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame<'s> {
    pub(crate) settings: &'s Settings,
    pub(crate) quantity: &'s Quantity,
    /// Index of the quantity, from which the seed of its calibration follows.
    pub(crate) index: usize,
    /// Name of the quantity that serves as a thermometer in this course.
    pub(crate) thermometer: Option<&'s str>,
    /// Number of the day that is over.
    pub(crate) day: i64,
    /// Why the day has no statement, if it has none for a condition.
    pub(crate) absence: Option<&'s Absence>,
}

impl<'s> Frame<'s> {
    /// Returns what explains the quantity.
    pub(crate) fn explanation(self) -> Explanation<'s> {
        Explanation {
            conditions: &self.settings.conditions,
            thermometer: self.thermometer,
        }
    }

    /// Returns the number of false alarms that this course may raise in a year.
    pub(crate) fn per_year(self) -> f64 {
        let share = self.settings.false_alarms_per_year / self.settings.quantities.len() as f64;
        share * budget_share(self.quantity.thermometers.len())
    }
}

impl Course {
    pub(crate) fn new() -> Self {
        Self {
            epochs: DayEpochs::default(),
            phase: Phase::Learning(Commissioning::default()),
            found: None,
        }
    }

    /// Returns the reference, or the reason why there is none.
    pub(crate) fn reference(&self) -> Result<&Reference, Option<&Missing>> {
        match &self.phase {
            Phase::Judging(judging) => Ok(&judging.reference),
            Phase::Learning(learning) => Err(learning.missing.as_ref().map(|(what, _)| what)),
        }
    }

    pub(crate) fn finding(&self) -> Option<&Finding> {
        self.found.as_ref().map(|found| &found.finding)
    }

    /// Ends a day and returns its judgement.
    pub(crate) fn end_day(&mut self, frame: Frame<'_>) -> Judgement {
        let day = self.epochs.take(frame.day, frame.explanation());
        let mut judgement = Judgement {
            day: frame.day,
            quantity: frame.quantity.name.clone(),
            state: State::Judged,
            means: day.as_ref().map(Day::means),
            expectation: None,
            finding: None,
            raised: false,
        };
        match &mut self.phase {
            Phase::Learning(learning) => match learning.end_day(day, frame) {
                Ok(judging) => {
                    judgement.state = State::Learning { days_left: 0 };
                    self.phase = Phase::Judging(Box::new(judging));
                }
                Err(state) => judgement.state = state,
            },
            Phase::Judging(judging) => {
                let alarm = self.found.is_some_and(|found| found.finding.is_alarm());
                let (state, expectation) = match &day {
                    Some(day) => judging.end_day(day, alarm),
                    None => (absent(frame.absence), None),
                };
                judgement.state = state;
                judgement.expectation = expectation;
                let per_stiffness = frame.quantity.kind.per_stiffness();
                let found = judging.found(frame, per_stiffness, self.found);
                let found_day =
                    |found: Option<Found>| found.map(|found| found.finding.change().found_day);
                judgement.raised = found.is_some() && found_day(found) != found_day(self.found);
                judgement.finding = found.map(|found| found.finding);
                self.found = found;
            }
        }
        judgement
    }
}

fn absent(absence: Option<&Absence>) -> State {
    State::NoStatement {
        why: absence.cloned().unwrap_or(Absence::Quantity),
    }
}

impl Commissioning {
    /// Adds a day. Returns the judging phase once the commissioning is over and complete.
    fn end_day(&mut self, day: Option<Day>, frame: Frame<'_>) -> Result<Judging, State> {
        let absence = day.is_none().then(|| absent(frame.absence));
        self.days.extend(day);
        // The oldest days are dropped, so that the state is bounded and a commissioning can
        // recover. A first day with a wrong date does not shorten it.
        let oldest = frame.day - i64::from(Settings::COMMISSIONING_RANGE.1);
        self.days.retain(|day| day.number > oldest);
        let first = self.days.first().map_or(frame.day, |day| day.number);
        let length = i64::from(frame.settings.commissioning_days);
        let passed = frame.day - first + 1;
        if passed < length && self.missing.is_none() {
            let days_left = (length - passed) as u32;
            return Err(absence.unwrap_or(State::Learning { days_left }));
        }
        if let Some((missing, tried)) = &self.missing
            && frame.day - tried < RETRY_DAYS
        {
            let missing = missing.clone();
            return Err(absence.unwrap_or(State::NotReady { missing }));
        }
        match Reference::learn(&self.days, frame) {
            Ok(reference) => Ok(Judging::new(reference, frame)),
            Err(missing) => {
                self.missing = Some((missing.clone(), frame.day));
                Err(State::NotReady { missing })
            }
        }
    }
}

impl Judging {
    fn new(reference: Reference, frame: Frame<'_>) -> Self {
        let settings = frame.settings;
        let unit = -frame.quantity.kind.per_stiffness() * (1.0 - settings.loss).ln();
        Self {
            adaptive: reference.posterior.clone(),
            detector: Detector::new(unit),
            cusum: 0.0,
            cusum_threshold: cusum::threshold(365.25 / frame.per_year()),
            last_day: reference.to_day,
            latest: LatestChanges::default(),
            quantile: reference.quantile,
            reference,
        }
    }

    /// Judges a day and learns from it, unless an alarm holds.
    fn end_day(&mut self, day: &Day, alarm: bool) -> (State, Option<Expectation>) {
        let row = self.reference.next_row(day);
        let Reference {
            columns, structure, ..
        } = &self.reference;
        let passed = day.number - self.last_day;
        if !alarm {
            // Nothing is learnt while an alarm holds. With a level that wanders on, all days would
            // be outside experience after some months.
            self.adaptive.wander(columns, passed);
        }
        self.adaptive.forget(columns, structure, passed);
        self.detector.evolve(columns, structure, passed);
        let expected = Expected::new(columns, structure, &self.adaptive, &row);
        // How the day is learnt. After five days of frost, the guard returns, although the winter
        // is still outside experience.
        let learnt_as = match () {
            () if self.reference.is_new_frost(day) => Some(Novelty::Frost),
            () if expected.is_unknown || self.reference.is_beyond(day) => {
                Some(Novelty::Extrapolation)
            }
            () => None,
        };
        let novelty = match self.reference.lacks_frost(day) {
            true => Some(Novelty::Frost),
            false => learnt_as,
        };
        // σ is r times that of the commissioning.
        let ratio = self.reference.spread.ratio();
        let variance = ratio * ratio * columns.variance(&row, structure, self.adaptive.sigma);
        let scale = ratio * expected.std;
        let z = (row.y - expected.value) / scale;
        if novelty.is_none() {
            let cumulant = &self.reference.cumulant;
            let evidence = Evidence {
                z,
                scale,
                share: 1.0 - columns.zone(&row),
                ln_threshold: self.reference.ln_threshold,
                cumulant,
                deviation: self.reference.deviation(),
            };
            self.detector.judge(day.number, &row.x, evidence);
            self.cusum = cusum::next(self.cusum, z.clamp(-3.0, 3.0));
            self.latest.add(self.day_change(day.number, &row, variance));
            if columns.zone(&row) == 0.0 {
                self.reference.spread.add(z * ratio);
            }
        }
        let expectation = self.expectation(day, &expected, z, ratio);
        // A change must not widen the interval. The days before an alarm can belong to it.
        let shows_change = self.detector.exceeds(self.reference.ln_threshold);
        if alarm {
            self.quantile = self.reference.quantile;
        } else if novelty.is_none() && !shows_change {
            let error = (row.y - expected.value) / (ratio * expected.scatter_std);
            self.quantile = interval::next(self.quantile, self.reference.quantile, error);
        }
        if !alarm {
            // All variances grow by r², so that the gain does not depend on it.
            let learnt = Learnt {
                z,
                scale,
                variance: variance / (ratio * ratio),
                novelty: learnt_as,
            };
            self.learn(&row, learnt);
            self.reference.remember(day);
        }
        self.last_day = day.number;
        let state = match novelty {
            Some(novelty) => State::OutsideExperience { novelty },
            None => State::Judged,
        };
        (state, Some(expectation))
    }

    /// Guarded learning: a lasting loss is learnt slowly.
    ///
    /// Forgetting coefficients and frost are learnt without a guard, because the end of a frost
    /// must not look like a loss. Other new conditions have a wider guard. They explain a residual
    /// of some standard deviations, but not a loss that happens on such a day.
    fn learn(&mut self, row: &Row, learnt: Learnt) {
        let Reference {
            columns,
            structure,
            guard,
            ..
        } = &self.reference;
        let Learnt { z, scale, .. } = learnt;
        let (lasting, weight) = match learnt.novelty {
            Some(Novelty::Extrapolation) => (z.max(-CLIP), 1.0),
            Some(Novelty::Frost) => (z, 1.0),
            None => (guard.limit(z), weight(structure.freedom, z)),
        };
        let variance = learnt.variance / weight;
        let only_frost = columns.zone(row) > 0.0;
        let gain = self.adaptive.gain(&row.x, variance, |column| {
            !only_frost || columns.is_of_frost(column)
        });
        self.adaptive
            .learn_with(&gain, &row.x, lasting * scale, variance);
        // What the guard keeps from the lasting coefficients remains in the residuals of a step.
        let learnt_share = if z == 0.0 {
            1.0
        } else {
            (lasting / z).clamp(0.0, 1.0)
        };
        let mut response = &gain * learnt_share;
        for forgetful in columns.forgetful(structure) {
            let column = forgetful.column;
            self.adaptive.mean[column] += gain[column] * (z - lasting) * scale;
            response[column] = gain[column];
        }
        self.detector.learn(&row.x, &response);
    }

    fn expectation(&self, day: &Day, expected: &Expected, z: f64, ratio: f64) -> Expectation {
        let centre = self.reference.centre;
        let half = ratio * self.quantile * expected.scatter_std;
        Expectation {
            measured: day.value(),
            expected: (expected.value + centre).exp(),
            interval: [-half, half].map(|half| (expected.value + half + centre).exp()),
            residual: z,
            ln_evidence: self.detector.ln_loss(),
            ln_threshold: self.reference.ln_threshold,
            cusum_share: self.cusum / self.cusum_threshold,
        }
    }

    /// Returns the change of a day against the commissioning, under the mean conditions of the
    /// commissioning: what the model has learnt, and the residual that it has not learnt. What
    /// forgets is part of the residual.
    fn day_change(&self, day: i64, row: &Row, variance: f64) -> DayChange {
        let Reference {
            columns,
            conditions,
            posterior,
            ..
        } = &self.reference;
        let lasting = columns.lasting(&row.x);
        let learnt = self.adaptive.expected(conditions) - posterior.expected(conditions);
        let sigma_squared = self.adaptive.sigma.powi(2);
        DayChange {
            day,
            size: learnt + row.y - self.adaptive.expected(&lasting),
            variance: sigma_squared * variance,
            ignorance: sigma_squared * self.adaptive.leverage(&(lasting - conditions)),
            share: 1.0 - columns.zone(row),
        }
    }

    /// Returns the present change against the commissioning, from the latest days since a day.
    fn present(&self, since_day: i64, frame: Frame<'_>) -> Option<StepEstimate> {
        let latest = self.latest.since(since_day)?;
        let std = (latest.variance + self.reference_variance(frame.day)).sqrt();
        Some(StepEstimate {
            day: since_day,
            size: latest.size,
            std: std.hypot(self.reference.deviation().of_mean(latest.days)),
        })
    }

    /// Returns the variance of the reference until a day: of what the commissioning has learnt, and
    /// of the sound wandering since then.
    fn reference_variance(&self, day: i64) -> f64 {
        let Reference {
            columns,
            conditions,
            posterior,
            to_day,
            ..
        } = &self.reference;
        posterior.sigma.powi(2) * posterior.leverage(conditions) + columns.wander(day - to_day)
    }

    /// Returns the finding that holds after the day. An alarm stays, and replaces a notice.
    fn found(&self, frame: Frame<'_>, per_stiffness: f64, known: Option<Found>) -> Option<Found> {
        if let Some(known) = known
            && known.finding.is_alarm()
        {
            return Some(self.renewed(known, frame, per_stiffness));
        }
        if self.detector.finds_loss()
            && let Some(step) = self.detector.loss(frame.day)
        {
            return Some(self.raise(Finding::LastingLoss, step, frame, known));
        }
        if self.detector.shows_loss_for_long()
            && let Some(present) = self.present(self.reference.to_day, frame)
            && present.is_loss(self.detector.unit())
            && let Some(step) = self.detector.loss(frame.day)
        {
            return Some(self.raise(Finding::LastingLoss, step, frame, known));
        }
        if let Some(drift) = self.learned_away(frame, per_stiffness) {
            return Some(self.raise(Finding::LearnedAway, drift, frame, known));
        }
        if let Some(known) = known {
            return Some(self.renewed(known, frame, per_stiffness));
        }
        if self.detector.finds_gain() && self.exceeds_reference() {
            let step = self.detector.gain(frame.day)?;
            return Some(self.raise(Finding::Stiffer, step, frame, known));
        }
        None
    }

    /// Returns a new finding, which replaces a `known` notice.
    fn raise(
        &self,
        kind: fn(Change) -> Finding,
        step: StepEstimate,
        frame: Frame<'_>,
        known: Option<Found>,
    ) -> Found {
        let per_stiffness = frame.quantity.kind.per_stiffness();
        let present = self.present(step.day, frame).unwrap_or(step);
        // After a frost, only the notice of a gain knows the level before it.
        let risen = known.map(|known| per_stiffness * (1.0 - middle(known.raised)).ln());
        let before = self.latest.before(step.day).or(risen);
        let before = before.unwrap_or(present.size - step.size);
        let change = change(present, before, per_stiffness, frame.day);
        Found {
            finding: kind(change),
            first_day: frame.day,
            before,
            raised: change.interval,
            grown_days: 0,
            further: None,
        }
    }

    /// Returns a finding with the present size of its change.
    ///
    /// A loss that certainly exceeds the one that was raised, by a loss that matters, is raised again
    /// once this has held for some days.
    fn renewed(&self, known: Found, frame: Frame<'_>, per_stiffness: f64) -> Found {
        let Change {
            found_day,
            since_day,
            ..
        } = *known.finding.change();
        let step = match known.finding {
            Finding::LastingLoss(_) => self.detector.loss(known.first_day),
            Finding::Stiffer(_) => self.detector.gain(known.first_day),
            Finding::LearnedAway(_) => None,
        };
        // A change does not begin after the day on which it was found.
        let since_day = match step {
            Some(step) if frame.day - known.first_day <= DATING_DAYS => step.day,
            _ => since_day,
        };
        let Some(present) = self.present(since_day, frame) else {
            return known;
        };
        let mut change = change(present, known.before, per_stiffness, found_day);
        let mut found = known;
        let was_raised = middle(known.raised);
        change.may_have_recovered =
            known.raised[0] > 0.0 && change.interval[0] <= 0.0 && change.loss < 0.5 * was_raised;
        if self.latest.last_day() == Some(frame.day) {
            let grows =
                known.finding.is_alarm() && has_grown(&change, known.raised, frame.settings.loss);
            found.grown_days = if grows { known.grown_days + 1 } else { 0 };
        }
        if found.grown_days >= HELD_DAYS {
            let day = self.latest.fall_day(since_day).unwrap_or(frame.day);
            change.found_day = frame.day;
            found.grown_days = 0;
            found.raised = change.interval;
            found.further = Some((day, was_raised));
        }
        change.further = found.further.map(|(since_day, before)| Further {
            since_day,
            loss: change.loss - before,
        });
        found.finding = known.finding.with(change);
        found
    }

    /// Returns `true` if a gain leads beyond the commissioning. Otherwise a loss that was learnt
    /// has come back, at most.
    fn exceeds_reference(&self) -> bool {
        let Reference {
            conditions,
            posterior,
            ..
        } = &self.reference;
        let learnt = self.adaptive.expected(conditions) - posterior.expected(conditions);
        self.detector.gains_beyond(learnt, conditions)
    }

    /// Returns the drift of the adaptive model from the frozen one at the reference conditions, if
    /// a loss that matters is credible.
    ///
    /// What was learnt in the frost zone or under new conditions may be wrong. Therefore the day must
    /// have evidence, and the latest days must show a loss as well.
    fn learned_away(&self, frame: Frame<'_>, per_stiffness: f64) -> Option<StepEstimate> {
        let Reference {
            conditions,
            posterior,
            to_day,
            ..
        } = &self.reference;
        let present = self.present(*to_day, frame)?;
        if !self.latest.has_evidence_on(frame.day) || !present.is_certain_loss() {
            return None;
        }
        let size = self.adaptive.expected(conditions) - posterior.expected(conditions);
        let std = self.reference_variance(frame.day).sqrt();
        let matters = per_stiffness * (1.0 - frame.settings.loss).ln();
        // P(size + std · normal < matters) ≥ 0.999
        (size + LEARNED_AWAY_QUANTILE * std < matters).then_some(StepEstimate {
            day: *to_day,
            size,
            std,
        })
    }
}

/// The update of the model by one day.
#[derive(Debug, Clone, Copy)]
struct Learnt {
    z: f64,
    scale: f64,
    variance: f64,
    novelty: Option<Novelty>,
}

/// Returns the change of stiffness against the commissioning.
///
/// `before` is the level just before it, relative to the commissioning, in ln(value).
fn change(present: StepEstimate, before: f64, per_stiffness: f64, found_day: i64) -> Change {
    let StepEstimate { size, std, .. } = present;
    Change {
        found_day,
        since_day: present.day,
        loss: loss(size, per_stiffness),
        interval: [INTERVAL_QUANTILE, -INTERVAL_QUANTILE]
            .map(|quantile| loss(size + quantile * std, per_stiffness)),
        drop: loss(size - before, per_stiffness),
        further: None,
        may_have_recovered: false,
    }
}

/// Returns `true` if a loss certainly exceeds the one that was `raised` with this interval, by a
/// further loss that is large enough to be raised. `matters` is the loss that matters.
pub(crate) fn has_grown(change: &Change, raised: [f64; 2], matters: f64) -> bool {
    let further = change.loss - middle(raised);
    change.interval[0] > raised[1] && further >= SMALLEST_STEP * matters
}

fn middle([low, high]: [f64; 2]) -> f64 {
    0.5 * (low + high)
}

/// Returns the loss of stiffness (share) of a change of ln(value).
fn loss(change: f64, per_stiffness: f64) -> f64 {
    1.0 - (change / per_stiffness).exp()
}
