//! The working phase under the rules `published` and `fisher`, and the covariance of the noise
//! parameters (3.36) to (3.38).

use super::objective::Objective;
use super::{NoiseModel, NoiseSettings, NoiseState};
use crate::dense::{cholesky_mut, solve_lower_mut, solve_lower_transposed_mut};
use nalgebra::{DMatrix, DVector};

/// Largest change of a noise parameter in one published step, relative to its value.
const LARGEST_RELATIVE_STEP: f64 = 0.5;

/// Largest change of the logarithm of a noise parameter in one scoring step, unless the frame is a
/// burst.
const LARGEST_LOGARITHMIC_STEP: f64 = 0.5;

impl NoiseState {
    /// Moves `ψ` by `−Σ_ψ ∇J` (3.33), then sets `Σ_ψ` to the inverse of the observed Hessian
    /// (3.36).
    pub(super) fn newton_step(
        &mut self,
        model: &NoiseModel,
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
            let newton = self.newton_step_of(l, objective);
            let largest = LARGEST_RELATIVE_STEP * self.mean[l];
            limited |= newton.abs() > largest;
            moved[l] = self.mean[l] - newton.clamp(-largest, largest);
        }
        self.apply_floor(&mut moved, model, settings);
        self.limited += u64::from(limited);
        self.accumulate_observed(&moved, objective);
        self.mean.copy_from(&moved);
        objective.scratch.best = moved;
    }

    /// Returns the component `l` of `Σ_ψ ∇J`.
    pub(super) fn newton_step_of(&self, l: usize, objective: &Objective) -> f64 {
        (0..self.mean.len())
            .map(|m| self.covariance[(l, m)] * objective.gradient[m])
            .sum()
    }

    /// Moves `ln ψ` by the score divided by the accumulated expected information, which fades by
    /// `λ`.
    ///
    /// With `φ = ln ψ`:
    ///
    /// - `s_l = −ψ_l ∂J/∂ψ_l`
    /// - `F_lm = ½ ψ_l ψ_m tr(WU_lWU_m)`
    /// - `Λ ← Λ/λ + F`
    /// - `φ ← φ + Λ⁻¹ s`
    pub(super) fn scoring_step(
        &mut self,
        model: &NoiseModel,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) {
        let mut moved = std::mem::take(&mut objective.scratch.best);
        if self.scoring_candidate_to(&mut moved, settings, objective) {
            invert_factor_to(&objective.scratch.information, &mut self.covariance);
            let count = moved.len();
            self.apply_floor(&mut moved, model, settings);
            for l in 0..count {
                for m in 0..count {
                    self.covariance[(l, m)] *= moved[l] * moved[m];
                }
            }
            self.mean.copy_from(&moved);
            self.bound_relative_std(model);
        } else {
            self.fall_back();
        }
        objective.scratch.best = moved;
    }

    /// Writes the result of one scoring step to `candidate` and the Cholesky factor of `Λ` to the
    /// scratch space.
    ///
    /// Returns `false` if no step is possible.
    pub(super) fn scoring_candidate_to(
        &mut self,
        candidate: &mut DVector<f64>,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) -> bool {
        if !objective.differentiate(&self.mean)
            || !self.logarithmic_information_to(&self.mean, settings.fading, objective)
        {
            return false;
        }
        let count = self.mean.len();
        // A structure that starts to shake far exceeds what the model explained while it was quiet.
        // Without a fast increase of the level, the excess would change the parameters. The level
        // may therefore increase at once, but not beyond the excess of this frame.
        let excess = objective.whitened_norm_squared() / objective.used_channels() as f64;
        if !excess.is_finite() {
            // No level explains such a frame. The filter will detect that it has diverged.
            return false;
        }
        let upward = LARGEST_LOGARITHMIC_STEP.max(excess.ln());
        let mut step = std::mem::take(&mut objective.scratch.step);
        for l in 0..count {
            step[l] = -self.mean[l] * objective.gradient[l];
        }
        let factor = &objective.scratch.information; // Cholesky factor of Λ
        solve_lower_mut(factor, step.as_mut_slice());
        solve_lower_transposed_mut(factor, step.as_mut_slice());
        let mut limited = false;
        for l in 0..count {
            limited |= step[l] > upward || step[l] < -LARGEST_LOGARITHMIC_STEP;
            candidate[l] = self.mean[l] * step[l].clamp(-LARGEST_LOGARITHMIC_STEP, upward).exp();
        }
        if self.phase == super::NoisePhase::Working {
            self.limited += u64::from(limited);
        }
        objective.scratch.step = step;
        true
    }

    /// Replaces `Σ_ψ` by the inverse of `∇²J + Σ_ψ⁻¹/λ` at `psi`, if that matrix is positive
    /// definite.
    ///
    /// Otherwise, `Σ_ψ` remains unchanged. The scratch space must contain the prior information.
    pub(super) fn accumulate_observed(&mut self, psi: &DVector<f64>, objective: &mut Objective) {
        if !objective.differentiate(psi) {
            self.fall_back();
            return;
        }
        let count = psi.len();
        // Scaled by ψ_l ψ_m, because the raw entries can differ by ten orders of magnitude.
        let scratch = &mut objective.scratch;
        for l in 0..count {
            for m in 0..count {
                scratch.information[(l, m)] =
                    psi[l] * psi[m] * (objective.observed[(l, m)] + scratch.prior[(l, m)]);
            }
        }
        if cholesky_mut(&mut scratch.information).is_err() {
            self.fall_back();
            return;
        }
        invert_factor_to(&scratch.information, &mut self.covariance);
        for l in 0..count {
            for m in 0..count {
                self.covariance[(l, m)] *= psi[l] * psi[m];
            }
        }
    }

    /// Replaces `Σ_ψ` by the inverse of the accumulated expected information at `psi`.
    pub(super) fn accumulate_expected(
        &mut self,
        psi: &DVector<f64>,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) {
        if !objective.differentiate(psi)
            || !self.logarithmic_information_to(psi, settings.fading, objective)
        {
            self.fall_back();
            return;
        }
        invert_factor_to(&objective.scratch.information, &mut self.covariance);
        for l in 0..psi.len() {
            for m in 0..psi.len() {
                self.covariance[(l, m)] *= psi[l] * psi[m];
            }
        }
    }

    /// Writes the Cholesky factor of `Λ/λ + F` for `ln ψ` to the scratch space, with `F` at `psi`.
    ///
    /// Returns `false` if a matrix is not positive definite.
    fn logarithmic_information_to(
        &self,
        psi: &DVector<f64>,
        fading: f64,
        objective: &mut Objective,
    ) -> bool {
        if !self.prior_information_to(fading, objective) {
            return false;
        }
        let scratch = &mut objective.scratch;
        for l in 0..psi.len() {
            for m in 0..psi.len() {
                scratch.information[(l, m)] = scratch.prior[(l, m)] * self.mean[l] * self.mean[m]
                    + objective.expected[(l, m)] * psi[l] * psi[m];
            }
        }
        cholesky_mut(&mut scratch.information).is_ok()
    }

    /// Writes `Σ_ψ⁻¹/λ` to the scratch space and returns `false` if `Σ_ψ` is not positive definite.
    pub(super) fn prior_information_to(&self, fading: f64, objective: &mut Objective) -> bool {
        let scratch = &mut objective.scratch;
        let count = self.mean.len();
        for l in 0..count {
            scratch.scale[l] = self.mean[l];
        }
        for l in 0..count {
            for m in 0..count {
                scratch.information[(l, m)] =
                    self.covariance[(l, m)] / (scratch.scale[l] * scratch.scale[m]);
            }
        }
        if cholesky_mut(&mut scratch.information).is_err() {
            scratch.prior.fill(0.0);
            return false;
        }
        invert_factor_to(&scratch.information, &mut scratch.prior);
        for l in 0..count {
            for m in 0..count {
                scratch.prior[(l, m)] /= fading * scratch.scale[l] * scratch.scale[m];
            }
        }
        true
    }

    /// Limits the relative variance of each level to that of its start, because the variance of
    /// uninformed levels would grow.
    fn bound_relative_std(&mut self, model: &NoiseModel) {
        let count = self.mean.len();
        for l in 0..count {
            let parameter = &model.parameters[l];
            let bound = parameter.start_std / parameter.start * self.mean[l];
            let std = self.covariance[(l, l)].sqrt();
            if std > bound {
                let shrink = bound / std;
                for m in 0..count {
                    self.covariance[(l, m)] *= shrink;
                    self.covariance[(m, l)] *= shrink;
                }
            }
        }
    }
}

/// Writes `(L Lᵀ)⁻¹` for the Cholesky factor of a small matrix (N_ψ × N_ψ). Here, the inverse
/// itself is the result.
fn invert_factor_to(factor: &DMatrix<f64>, out: &mut DMatrix<f64>) {
    out.fill_with_identity();
    solve_lower_mut(factor, out.as_mut_slice());
    solve_lower_transposed_mut(factor, out.as_mut_slice());
}
