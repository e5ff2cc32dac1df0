//! The two-stage rule of the linear filter: half-or-double training, then one Newton step per
//! frame.
//!
//! Source: Yuen, Liang & Kuok (2013), *Online estimation of noise parameters for Kalman filter*.
//! Its `θ` is `ψ` here. Three printed details matter:
//!
//! - If the Hessian is not positive definite, `Σ_ψ` remains unchanged, without the fading factor.
//! - The Newton step uses that `Σ_ψ`, again without the factor, although the prior of the objective
//!   includes it.
//! - The gradient is that of the objective with the new datum.
//!
//! The derivatives are exact, whereas the source uses differences.

use super::objective::Objective;
use super::training::prior_distance;
use super::{NoiseSettings, NoiseState};

/// Maximum number of noise parameters `N_ψ`, because a training step evaluates `3^N_ψ` candidates.
pub(super) const MOST_PARAMETERS: usize = 5;

/// Factors by which a candidate keeps, halves or doubles a noise parameter. The first factor wins a
/// tie.
const FACTORS: [f64; 3] = [1.0, 0.5, 2.0];

/// Number of consecutive unchanged training steps before training can end.
pub(super) const UNCHANGED_STEPS: u32 = 10;

impl NoiseState {
    /// Replaces `ψ` by the best combination of kept, halved and doubled levels, and `Σ_ψ` by the
    /// inverse Hessian.
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
        // The comparison is exact, because the values are the start values times powers of two.
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

    /// Moves `ψ` by `−Σ_ψ ∇J`, each component by at most the guard factor, then sets `Σ_ψ` to the
    /// inverse Hessian there.
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
            let free = self.mean[l] - self.newton_step_of(l, objective);
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
