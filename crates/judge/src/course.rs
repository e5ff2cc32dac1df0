//! The history of one quantity: commissioning, then one decision per day.

use crate::cumulant::CLIP;
use crate::cusum;
use crate::day::{Day, DayEpochs};
use crate::detector::{Detector, Evidence, StepEstimate};
use crate::judgement::{Absence, Change, Expectation, Finding, Judgement, Novelty, State};
use crate::model::Row;
use crate::reference::{Expected, Missing, Reference};
use crate::regression::{Posterior, weight};
use crate::settings::{Quantity, Settings};
use serde::{Deserialize, Serialize};

/// Days between attempts to learn the reference after a commissioning that was not ready.
const RETRY_DAYS: i64 = 7;
/// The drift of the learnt reference is raised at a probability of 0.999: this quantile of the
/// normal distribution.
const LEARNED_AWAY_QUANTILE: f64 = 3.090;
/// Quantile of a 95 % interval.
const INTERVAL_QUANTILE: f64 = 1.960;

/// Course of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Course {
    pub(crate) epochs: DayEpochs,
    phase: Phase,
    finding: Option<Finding>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Phase {
    Learning(Commissioning),
    Judging(Box<Judging>),
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Commissioning {
    first_day: Option<i64>,
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
}

/// What the histories of all quantities of a structure share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame<'s> {
    pub(crate) settings: &'s Settings,
    pub(crate) quantity: &'s Quantity,
    /// Index of the quantity, from which the seed of its calibration follows.
    pub(crate) index: usize,
    /// Number of the day that is over.
    pub(crate) day: i64,
    /// Why the day has no statement, if it has none for a condition.
    pub(crate) absence: Option<&'s Absence>,
}

impl Course {
    pub(crate) fn new() -> Self {
        Self {
            epochs: DayEpochs::default(),
            phase: Phase::Learning(Commissioning::default()),
            finding: None,
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
        self.finding.as_ref()
    }

    /// Ends a day and returns its judgement.
    pub(crate) fn end_day(&mut self, frame: Frame<'_>) -> Judgement {
        let day = self.epochs.take(frame.day);
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
                let alarm = self.finding.is_some_and(|finding| finding.is_alarm());
                let (state, expectation) = match &day {
                    Some(day) => judging.end_day(day, alarm),
                    None => (absent(frame.absence), None),
                };
                judgement.state = state;
                judgement.expectation = expectation;
                let per_stiffness = frame.quantity.kind.per_stiffness();
                let found = judging.finding(frame, per_stiffness, self.finding);
                judgement.raised = match (found, self.finding) {
                    (Some(found), Some(known)) => {
                        found.change().found_day != known.change().found_day
                    }
                    (Some(_), None) => true,
                    (None, _) => false,
                };
                self.finding = found;
                judgement.finding = found;
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
        let first = *self.first_day.get_or_insert(frame.day);
        self.days.extend(day);
        let length = i64::from(frame.settings.commissioning_days);
        let passed = frame.day - first + 1;
        if passed < length {
            let days_left = (length - passed) as u32;
            return Err(absence.unwrap_or(State::Learning { days_left }));
        }
        if let Some((missing, tried)) = &self.missing
            && frame.day - tried < RETRY_DAYS
        {
            let missing = missing.clone();
            return Err(absence.unwrap_or(State::NotReady { missing }));
        }
        // The oldest days are dropped, so that the state is bounded and a commissioning can
        // recover.
        let oldest = frame.day - i64::from(Settings::COMMISSIONING_RANGE.1);
        self.days.retain(|day| day.number > oldest);
        let seed = frame.index as u64;
        match Reference::learn(&self.days, frame.quantity, frame.settings, seed) {
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
        let share = settings.false_alarms_per_year / settings.quantities.len() as f64;
        let unit = -frame.quantity.kind.per_stiffness() * (1.0 - settings.loss).ln();
        Self {
            adaptive: reference.posterior.clone(),
            detector: Detector::new(unit),
            cusum: 0.0,
            cusum_threshold: cusum::threshold(365.25 / share),
            last_day: reference.to_day,
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
        self.adaptive.evolve(columns, structure, passed);
        self.detector.evolve(columns, structure, passed);
        let expected = Expected::new(columns, structure, &self.adaptive, &row);
        let novelty = match () {
            () if self.reference.is_new_frost(day) => Some(Novelty::Frost),
            () if expected.is_unknown || self.reference.is_beyond(day) => {
                Some(Novelty::Extrapolation)
            }
            () => None,
        };
        let variance = columns.variance(&row, structure, self.adaptive.sigma);
        let (scale, z) = (expected.std, (row.y - expected.value) / expected.std);
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
        }
        let expectation = self.expectation(day, &expected, z);
        if !alarm {
            let learnt = Learnt {
                z,
                scale,
                variance,
                novelty,
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

    fn expectation(&self, day: &Day, expected: &Expected, z: f64) -> Expectation {
        let centre = self.reference.centre;
        let half = self.reference.quantile * expected.scatter_std;
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

    /// Returns the finding that holds after the day. An alarm stays, and replaces a notice.
    fn finding(
        &self,
        frame: Frame<'_>,
        per_stiffness: f64,
        known: Option<Finding>,
    ) -> Option<Finding> {
        let deviation = self.reference.deviation();
        let change = |step: StepEstimate, found_day| {
            let std = step.std_with(deviation, frame.day);
            Change {
                found_day,
                since_day: step.day,
                loss: loss(step.size, per_stiffness),
                interval: [INTERVAL_QUANTILE, -INTERVAL_QUANTILE]
                    .map(|q| loss(step.size + q * std, per_stiffness)),
            }
        };
        // A change does not begin after the day on which it was found.
        let found_day = |known: Option<Finding>| known.map_or(frame.day, |f| f.change().found_day);
        if let Some(known @ Finding::LearnedAway(_)) = known {
            return Some(known);
        }
        let lost = known.filter(|known| matches!(known, Finding::LastingLoss(_)));
        if (lost.is_some() || self.detector.finds_loss())
            && let Some(step) = self.detector.loss(found_day(lost))
        {
            return Some(Finding::LastingLoss(change(step, found_day(lost))));
        }
        if lost.is_some() {
            return lost; // an alarm stays, even if no candidate speaks for a loss any longer
        }
        if let Some(step) = self.learned_away(frame, per_stiffness) {
            return Some(Finding::LearnedAway(change(step, frame.day)));
        }
        if (known.is_some() || (self.detector.finds_gain() && self.exceeds_reference()))
            && let Some(step) = self.detector.gain(found_day(known))
        {
            return Some(Finding::Stiffer(change(step, found_day(known))));
        }
        known
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
    fn learned_away(&self, frame: Frame<'_>, per_stiffness: f64) -> Option<StepEstimate> {
        let Reference {
            conditions,
            posterior,
            to_day,
            ..
        } = &self.reference;
        let size = self.adaptive.expected(conditions) - posterior.expected(conditions);
        let known = posterior.sigma.powi(2) * posterior.leverage(conditions);
        let wander = self.reference.columns.wander(frame.day - to_day);
        let std = (known + wander).sqrt();
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

/// Returns the loss of stiffness (share) of a change of ln(value).
fn loss(change: f64, per_stiffness: f64) -> f64 {
    1.0 - (change / per_stiffness).exp()
}
