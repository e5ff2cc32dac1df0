//! The training phase: stochastic local search, (3.30) to (3.32).

use super::objective::Objective;
use super::{NoiseModel, NoiseRule, NoiseSettings, NoiseState};
use nalgebra::DVector;
use rand_distr::{Distribution, StandardNormal};

impl NoiseState {
    /// Replaces `ψ` by the best of the incumbent and `N_τ − 1` candidates around it, and updates
    /// `Σ_ψ` accordingly.
    ///
    /// Under [`NoiseRule::Fisher`], the scoring step is an additional candidate. Random draws move
    /// a level by less than 1 % per step, which is too slow for a structure that starts to shake.
    pub(super) fn search(
        &mut self,
        model: &NoiseModel,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) {
        let prior_is_known = self.prior_information_to(settings.fading, objective);
        // The prior term is zero at its own centre.
        let mut best_value = objective.value(&self.mean);
        let mut best = std::mem::take(&mut objective.scratch.best);
        let mut candidate = std::mem::take(&mut objective.scratch.candidate);
        best.copy_from(&self.mean);
        for _ in 1..settings.candidates {
            for l in 0..candidate.len() {
                let draw = truncated_normal(&mut self.rng, -1.0 / settings.relative_step);
                candidate[l] = (1.0 + settings.relative_step * draw) * self.mean[l];
            }
            let mut value = objective.value(&candidate);
            if prior_is_known {
                value += 0.5 * prior_distance(objective, &candidate, &self.mean);
            }
            if value < best_value {
                best_value = value;
                best.copy_from(&candidate);
            }
        }
        if settings.rule == NoiseRule::Fisher
            && self.scoring_candidate_to(&mut candidate, settings, objective)
        {
            let value = objective.value(&candidate)
                + 0.5 * logarithmic_distance(objective, &candidate, &self.mean);
            if value < best_value {
                best.copy_from(&candidate);
            }
        }
        self.apply_floor(&mut best, model, settings);
        self.unchanged = if best == self.mean {
            self.unchanged + 1
        } else {
            0
        };
        match settings.rule {
            // Far from the level, each frame would add the same information, whether true or not.
            // The search would then slow down.
            NoiseRule::Fisher if !self.innovations_agree() => self.rescale_covariance(&best),
            NoiseRule::Fisher => self.accumulate_expected(&best, settings, objective),
            NoiseRule::Published | NoiseRule::HalfOrDouble | NoiseRule::Fixed => {
                self.accumulate_observed(&best, objective)
            }
        }
        self.mean.copy_from(&best);
        objective.scratch.best = best;
        objective.scratch.candidate = candidate;
    }
}

impl NoiseState {
    /// Rescales `Σ_ψ` with `ψ`, so that the relative covariance remains unchanged.
    fn rescale_covariance(&mut self, psi: &DVector<f64>) {
        for l in 0..psi.len() {
            for m in 0..psi.len() {
                self.covariance[(l, m)] *= psi[l] / self.mean[l] * psi[m] / self.mean[m];
            }
        }
    }
}

/// Returns `(ψ − ψ̂)ᵀ Σ_ψ⁻¹ (ψ − ψ̂)/λ`.
pub(super) fn prior_distance(
    objective: &mut Objective,
    candidate: &DVector<f64>,
    centre: &DVector<f64>,
) -> f64 {
    let prior = &objective.scratch.prior;
    let mut distance = 0.0;
    for l in 0..candidate.len() {
        for m in 0..candidate.len() {
            distance += prior[(l, m)] * (candidate[l] - centre[l]) * (candidate[m] - centre[m]);
        }
    }
    distance
}

/// Returns `(φ − φ̂)ᵀ Λ (φ − φ̂)/λ` for `φ = ln ψ`.
fn logarithmic_distance(
    objective: &mut Objective,
    candidate: &DVector<f64>,
    centre: &DVector<f64>,
) -> f64 {
    let prior = &objective.scratch.prior;
    let mut distance = 0.0;
    for l in 0..candidate.len() {
        for m in 0..candidate.len() {
            let steps = (candidate[l] / centre[l]).ln() * (candidate[m] / centre[m]).ln();
            distance += prior[(l, m)] * centre[l] * centre[m] * steps;
        }
    }
    distance
}

/// Draws a standard normal number above `lowest` by rejection. With the default step, rejections
/// practically never occur.
fn truncated_normal(rng: &mut rand_chacha::ChaCha8Rng, lowest: f64) -> f64 {
    loop {
        let draw: f64 = StandardNormal.sample(rng);
        if draw > lowest {
            return draw;
        }
    }
}
