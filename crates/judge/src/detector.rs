//! Shiryaev–Roberts e-detector of a lasting step.
//!
//! A candidate is a day on which a step may have begun. For each candidate and each size δ of the
//! step, the residual z of day t has the expected value g = h(t) δ/scale. The evidence of
//! the candidate is Π exp(g z − κ(g)). The detector is the sum over candidates and the mean over
//! sizes,
//!
//! R(t) = Σj mean_δ Πi exp(gi z(i) − κ(gi)).
//!
//! |g| is limited, because a clipped residual says nothing about larger shifts. While the structure
//! is sound, R(t) − t is a supermartingale. The average run length until R ≥ A is then at least A
//! days. Source: Shin, Ramdas & Rinaldo (2024), on e-detectors of Shiryaev–Roberts type.
//!
//! The regression keeps learning and absorbs part of a step. What remains of a unit step in the
//! residual is h(t) = 1 − x(t)ᵀ c(t). The response c of the coefficients follows c ← c + K h.
//! Source: Willsky & Jones (1976), IEEE Transactions on Automatic Control 21, 108–112.

use crate::cumulant::{CLIP, Cumulant, LARGEST_SHIFT};
use crate::model::{Columns, Deviation, Structure};
use nalgebra::DVector;
use serde::{Deserialize, Serialize};

/// Sizes of the step as multiples of the loss that matters.
pub(crate) const SIZES: [f64; 3] = [1.0, 2.0, 4.0];
/// Largest number of candidates. Dropping the weakest ones only lowers R.
const MOST_CANDIDATES: usize = 120;
/// Smallest number of judged days of a candidate that counts. A single wrong day must not decide.
pub(crate) const SHORTEST_STEP_DAYS: u32 = 3;

/// Number of judged days on which R must hold its threshold. Rain, snow or a holiday last for some
/// days, and the evidence recedes after them.
pub(crate) const HELD_DAYS: u32 = 3;

/// Number of judged days on which R must hold its threshold, so that a slow loss is raised. Most of
/// it is learnt, so that no step explains it.
const HELD_DAYS_SLOW: u32 = 30;

/// Smallest step that is raised, as a share of the loss that matters.
pub(crate) const SMALLEST_STEP: f64 = 0.7;
/// A step is raised if it differs from zero with a probability of 0.99: this quantile of the normal
/// distribution.
const CERTAIN: f64 = 2.326;

/// A day on which a step may have begun.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Candidate {
    day: i64,
    judged_days: u32,
    /// c: response of the coefficients to a unit step.
    response: DVector<f64>,
    /// ln of the evidence, for a loss of each size and a gain of each size.
    loss: [f64; SIZES.len()],
    gain: [f64; SIZES.len()],
    /// Σ h²/scale² and Σ h z/scale: information on the size of the step.
    information: f64,
    moment: f64,
}

/// What one judged day contributes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evidence<'d> {
    /// Residual in units of `scale`.
    pub(crate) z: f64,
    /// Standard deviation of the residual, parameter uncertainty included.
    pub(crate) scale: f64,
    /// Share of the evidence that counts: none in the frost zone.
    pub(crate) share: f64,
    /// ln of the threshold.
    pub(crate) ln_threshold: f64,
    /// κ of the quantity.
    pub(crate) cumulant: &'d Cumulant,
    /// Deviation that cannot be distinguished from a step.
    pub(crate) deviation: Deviation,
}

/// Size of the most credible step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct StepEstimate {
    pub(crate) day: i64,
    /// Change of ln(value), and its standard deviation.
    pub(crate) size: f64,
    pub(crate) std: f64,
}

impl StepEstimate {
    /// Returns the standard deviation of the size on a day. A deviation that began with the step
    /// cannot be distinguished from it.
    pub(crate) fn std_with(self, deviation: Deviation, day: i64) -> f64 {
        self.std.hypot(deviation.of_mean(day - self.day + 1))
    }

    /// Returns `true` if it is a loss with a probability of 0.99.
    pub(crate) fn is_certain_loss(self) -> bool {
        self.size <= -CERTAIN * self.std
    }

    /// Returns `true` if it is also large enough to be raised. `unit` is that of the detector.
    pub(crate) fn is_loss(self, unit: f64) -> bool {
        self.size <= -SMALLEST_STEP * unit && self.is_certain_loss()
    }

    /// Returns `true` if the step is large enough to be raised on a day. `unit` is that of the
    /// detector.
    ///
    /// A precise quantity must not raise a change that does not matter. A quantity that wanders
    /// must not raise a change like those of its commissioning.
    pub(crate) fn matters(self, day: i64, unit: f64, deviation: Deviation) -> bool {
        let size = self.size.abs();
        size >= SMALLEST_STEP * unit && size >= CERTAIN * self.std_with(deviation, day)
    }
}

/// Detector of a lasting loss and of a lasting gain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Detector {
    /// Change of ln(value) of the loss that matters, positive.
    unit: f64,
    candidates: Vec<Candidate>,
    /// Number of the latest judged days on which a loss, and a gain, were above the threshold.
    held_loss: u32,
    held_gain: u32,
    /// Number of the latest judged days on which R of a loss was above the threshold.
    held_evidence: u32,
}

impl Detector {
    pub(crate) fn new(unit: f64) -> Self {
        Self {
            unit,
            candidates: Vec::new(),
            held_loss: 0,
            held_gain: 0,
            held_evidence: 0,
        }
    }

    /// Adds the day as a candidate, and the day's evidence to every candidate. `x` is its row.
    pub(crate) fn judge(&mut self, day: i64, x: &DVector<f64>, data: Evidence<'_>) {
        let (unit, z) = (self.unit, data.z.clamp(-CLIP, CLIP));
        let prior = -(SIZES.len() as f64).ln();
        self.candidates.push(Candidate {
            day,
            judged_days: 0,
            response: DVector::zeros(x.len()),
            loss: [prior; SIZES.len()],
            gain: [prior; SIZES.len()],
            information: 0.0,
            moment: 0.0,
        });
        for candidate in &mut self.candidates {
            let h = candidate.remainder(x);
            for (index, size) in SIZES.iter().enumerate() {
                let shift = data.share * h * size * unit / data.scale;
                let g = shift.clamp(-LARGEST_SHIFT, LARGEST_SHIFT);
                let kappa = data.cumulant.at(g);
                candidate.loss[index] += -g * z - kappa;
                candidate.gain[index] += g * z - kappa;
            }
            candidate.information += data.share * (h / data.scale).powi(2);
            candidate.moment += data.share * h * data.z / data.scale;
            candidate.judged_days += 1;
        }
        let counted = |holds: bool, held: u32| if holds { held.saturating_add(1) } else { 0 };
        let matters = |step: Option<StepEstimate>| {
            step.is_some_and(|step| step.matters(day, unit, data.deviation))
        };
        let evidence = self.ln_loss() >= data.ln_threshold;
        let loss = evidence && matters(self.loss(day));
        let gain = self.ln_gain() >= data.ln_threshold && matters(self.gain(day));
        self.held_evidence = counted(evidence, self.held_evidence);
        self.held_loss = counted(loss, self.held_loss);
        self.held_gain = counted(gain, self.held_gain);
        if self.candidates.len() > MOST_CANDIDATES {
            self.drop_weakest();
        }
    }

    /// Lets a number of days pass: some coefficients forget, and so do their responses to a step.
    pub(crate) fn evolve(&mut self, columns: &Columns, structure: &Structure, days: i64) {
        for forgetful in columns.forgetful(structure) {
            let kept = forgetful.kept(days);
            for candidate in &mut self.candidates {
                candidate.response[forgetful.column] *= kept;
            }
        }
    }

    /// Updates the response of every candidate after the regression has learnt a row with `gain`,
    /// as far as the guard let it learn.
    pub(crate) fn learn(&mut self, x: &DVector<f64>, gain: &DVector<f64>) {
        for candidate in &mut self.candidates {
            let h = candidate.remainder(x);
            candidate.response.axpy(h, gain, 1.0);
        }
    }

    /// Returns ln R of a loss.
    pub(crate) fn ln_loss(&self) -> f64 {
        self.total(|candidate| &candidate.loss)
    }

    /// Returns ln R of a gain.
    pub(crate) fn ln_gain(&self) -> f64 {
        self.total(|candidate| &candidate.gain)
    }

    /// Returns `true` if the evidence of a loss or of a gain exceeds a threshold.
    pub(crate) fn exceeds(&self, ln_threshold: f64) -> bool {
        self.ln_loss().max(self.ln_gain()) >= ln_threshold
    }

    /// Returns `true` if a loss that matters has begun, and has been seen for some days.
    pub(crate) fn finds_loss(&self) -> bool {
        self.held_loss >= HELD_DAYS
    }

    /// Returns `true` if the evidence of a loss has held for a month, regardless of its most likely step.
    pub(crate) fn shows_loss_for_long(&self) -> bool {
        self.held_evidence >= HELD_DAYS_SLOW
    }

    /// Returns the change of ln(value) of the loss that matters, positive.
    pub(crate) fn unit(&self) -> f64 {
        self.unit
    }

    /// Returns `true` if a gain of the same size has begun.
    pub(crate) fn finds_gain(&self) -> bool {
        self.held_gain >= HELD_DAYS
    }

    /// Returns the most likely step downwards until a day.
    pub(crate) fn loss(&self, until: i64) -> Option<StepEstimate> {
        self.most_likely(-1.0, until)
    }

    /// Returns the most likely step upwards until a day.
    pub(crate) fn gain(&self, until: i64) -> Option<StepEstimate> {
        self.most_likely(1.0, until)
    }

    /// Returns `true` if the most likely gain matters beside what the model has `learnt` before: a
    /// change of ln(value) since the commissioning, under its conditions `x`.
    ///
    /// The model has learnt part of the gain itself. Only the rest is added.
    pub(crate) fn gains_beyond(&self, learnt: f64, x: &DVector<f64>) -> bool {
        self.best(1.0, i64::MAX).is_some_and(|best| {
            let rest = best.moment / best.information * best.remainder(x);
            learnt + rest >= SMALLEST_STEP * self.unit
        })
    }

    fn counting(&self) -> impl Iterator<Item = &Candidate> {
        let counts = |candidate: &&Candidate| candidate.judged_days >= SHORTEST_STEP_DAYS;
        self.candidates.iter().filter(counts)
    }

    fn total(&self, of: impl Fn(&Candidate) -> &[f64; SIZES.len()]) -> f64 {
        let terms = || {
            self.counting()
                .flat_map(|candidate| of(candidate).iter().copied())
        };
        let largest = terms().fold(f64::NEG_INFINITY, f64::max);
        match largest.is_finite() {
            true => largest + terms().map(|term| (term - largest).exp()).sum::<f64>().ln(),
            false => f64::NEG_INFINITY,
        }
    }

    /// Returns the candidate with the largest likelihood ratio, moment²/information,
    /// among the steps of one sign until a day.
    ///
    /// The evidence would not do: its clipped residuals hardly distinguish neighbouring candidates.
    fn best(&self, sign: f64, until: i64) -> Option<&Candidate> {
        let has_sign =
            |candidate: &&Candidate| candidate.information > 0.0 && sign * candidate.moment > 0.0;
        let ratio = |candidate: &Candidate| candidate.moment.powi(2) / candidate.information;
        let candidates = self.counting().filter(has_sign);
        let candidates = candidates.filter(|candidate| candidate.day <= until);
        candidates.max_by(|a, b| ratio(a).total_cmp(&ratio(b)))
    }

    fn most_likely(&self, sign: f64, until: i64) -> Option<StepEstimate> {
        let best = self.best(sign, until)?;
        Some(StepEstimate {
            day: best.day,
            size: best.moment / best.information,
            std: best.information.sqrt().recip(),
        })
    }

    fn drop_weakest(&mut self) {
        let old = self.candidates.len() - SHORTEST_STEP_DAYS as usize;
        let strength = |c: &Candidate| largest(&c.loss).max(largest(&c.gain));
        let candidates = self.candidates[..old].iter().enumerate();
        let weakest = candidates.min_by(|(_, a), (_, b)| strength(a).total_cmp(&strength(b)));
        if let Some((index, _)) = weakest {
            self.candidates.remove(index);
        }
    }
}

impl Candidate {
    /// Returns h, the part of a unit step that is still in the residual.
    fn remainder(&self, x: &DVector<f64>) -> f64 {
        1.0 - x.dot(&self.response)
    }
}

fn largest(values: &[f64; SIZES.len()]) -> f64 {
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNIT: f64 = 0.01;

    /// Judges 20 days with a loss of three units, under a deviation of `std`.
    fn finds(std: f64) -> bool {
        const SCALE: f64 = 0.005;
        let cumulant = Cumulant::new(&[-1.0, 0.5, 1.0]);
        let mut detector = Detector::new(UNIT);
        for day in 0..20 {
            let evidence = Evidence {
                z: -3.0 * UNIT / SCALE,
                scale: SCALE,
                share: 1.0,
                ln_threshold: 9.0,
                cumulant: &cumulant,
                deviation: Deviation {
                    std,
                    memory_days: 40.0,
                },
            };
            detector.judge(day, &DVector::zeros(1), evidence);
        }
        detector.finds_loss()
    }

    #[test]
    fn a_step_is_raised_only_if_it_exceeds_the_deviation() {
        assert!(finds(0.0));
        assert!(finds(UNIT)); // three standard deviations
        assert!(!finds(2.0 * UNIT));
    }
}
