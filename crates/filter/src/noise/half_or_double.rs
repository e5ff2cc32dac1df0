//! The two-stage rule of the linear filter: half-or-double training, then one Newton step a frame.
//!
//! Source: Yuen, Liang & Kuok (2013), *Online estimation of noise parameters for Kalman filter*. `ψ` is its `θ`. Three
//! printed details that matter: a Hessian that is not positive definite leaves `Σ_ψ` as it was, without the fading
//! factor; the Newton step is taken with that `Σ_ψ`, again without the factor, although the prior of the objective has it;
//! and the gradient is that of the objective with the new datum. Derivatives are exact where the source takes differences.

use super::objective::Objective;
use super::training::prior_distance;
use super::{NoiseSettings, NoiseState};

/// More noise parameters than this are refused: the candidates of a training step are three to their number.
pub(super) const MOST_PARAMETERS: usize = 5;

/// A candidate holds each noise parameter, halves it or doubles it; holding comes first and wins a tie.
const FACTORS: [f64; 3] = [1.0, 0.5, 2.0];

/// Unchanged training steps in a row before training may end.
pub(super) const UNCHANGED_STEPS: u32 = 10;

impl NoiseState {
    /// Replaces `ψ` by the best of all combinations of halves, doubles and what it was, and `Σ_ψ` by the inverse Hessian.
    pub(super) fn halve_or_double(&mut self, settings: &NoiseSettings, objective: &mut Objective) {
        self.prior_information_to(settings.fading, objective);
        let mut best = std::mem::take(&mut objective.scratch.best);
        let mut candidate = std::mem::take(&mut objective.scratch.candidate);
        best.copy_from(&self.mean);
        let mut best_value = objective.value(&best); // the prior term is zero at its own centre
        for index in 1..FACTORS.len().pow(self.mean.len() as u32) {
            let mut digits = index;
            for l in 0..candidate.len() {
                candidate[l] = FACTORS[digits % FACTORS.len()] * self.mean[l];
                digits /= FACTORS.len();
            }
            let value = objective.value(&candidate)
                + 0.5 * prior_distance(objective, &candidate, &self.mean);
            if value < best_value {
                best_value = value;
                best.copy_from(&candidate);
            }
        }
        // Exact: the values are those of the start times powers of two.
        self.unchanged = if best == self.mean {
            self.unchanged + 1
        } else {
            0
        };
        self.accumulate_observed(&best, objective);
        self.mean.copy_from(&best);
        objective.scratch.best = best;
        objective.scratch.candidate = candidate;
    }

    /// Moves `ψ` by `−Σ_ψ ∇J`, no component further than the guard allows, then `Σ_ψ` to the inverse of the Hessian there.
    pub(super) fn guarded_newton_step(
        &mut self,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) {
        if !objective.differentiate(&self.mean) {
            self.fall_back();
            return;
        }
        self.prior_information_to(settings.fading, objective);
        let mut moved = std::mem::take(&mut objective.scratch.best);
        let mut limited = false;
        for l in 0..self.mean.len() {
            let newton: f64 = (0..self.mean.len())
                .map(|m| self.covariance[(l, m)] * objective.gradient[m])
                .sum();
            let free = self.mean[l] - newton;
            moved[l] = if settings.positivity_guard.is_finite() {
                free.clamp(
                    self.mean[l] / settings.positivity_guard,
                    self.mean[l] * settings.positivity_guard,
                )
            } else {
                free
            };
            limited |= moved[l] != free;
        }
        self.limited += u64::from(limited);
        self.accumulate_observed(&moved, objective);
        self.mean.copy_from(&moved);
        objective.scratch.best = moved;
    }
}
