//! The exact step of a linear structure with proportional damping, from a few products of half-size
//! matrices.
//!
//! Notation: Huang & Yuen (2023), §2.4, with `G = M⁻¹K` and `C = αM + βK`. With constant
//! parameters, the Jacobian (2.50) is `A_y = [[A_s, (0; W)], [0, 0]]`,
//! `A_s = [[0, I], [−G, −(αI + βG)]]`. All blocks of `A_s` are polynomials of `G` and therefore
//! commute. `A_s` solves its own characteristic equation as if the blocks were numbers:
//! `A_s² = −(α + βG) A_s − G`.
//!
//! Hence all blocks of `exp(A_s t)` and of its integrals follow from two functions of `G`. These
//! are the impulse response `q` (displacement after a unit velocity) and the step response
//! `s = ∫ q dt` (displacement under a unit acceleration):
//!
//! ```text
//! Φ = exp(A_s t) = [[I − Gs, q], [−Gq, I − Gs − (α + βG) q]]     (2.54)
//! Γ = ∫ Φ dt     = [[q + (α + βG) s, s], [−Gs, q]]               (2.55), (2.56)
//! A_i            = [[Φ, ΨW], [0, I]], where Ψ is the right half of Γ
//! ```
//!
//! `q` and `s` are the Taylor series that [`discretise`](crate::discretise) applies to columns.
//! Here they are polynomials of `Z = −G h²` with numbers as coefficients: `q = h q̂(Z)`,
//! `s = h² ŝ(Z)`. They are evaluated by the method of Paterson & Stockmeyer (1973, *SIAM J.
//! Comput.* 2, 60).
//!
//! A step that is too long for one series is halved repeatedly to `h`. It is then doubled again by
//! `Φ(2t) = Φ(t)²`, `Ψ(2t) = Ψ(t) + Φ(t) Ψ(t)`. If `G` has a narrow band, as in a shear building,
//! its powers have narrow bands too.
//!
//! Within one series and with a narrow band, the step uses the accelerations caused by
//! displacements and parameters (`accelerations`). All other steps use the blocks themselves
//! (`blocks`).

mod accelerations;
mod band;
mod blocks;
mod polynomials;

use crate::discretise::LARGEST_STEP;
use crate::product::Multiplier;
use accelerations::Accelerations;
use blocks::Blocks;
use nalgebra::DMatrix;
use polynomials::Polynomials;
use std::ops::Range;

/// The parts of the Jacobian of a linear structure with proportional damping, at the linearisation
/// point.
///
/// For a state of displacements, velocities and parameters `[x, ẋ, θ]`, equation (2.50) with
/// `C = αM + βK`: `A_y = [[0, I, 0], [−G, −(αI + βG), W], [0, 0, 0]]`.
#[derive(Debug, Clone, Copy)]
pub struct ProportionalForm<'m> {
    /// `G = M⁻¹K` (N_d × N_d, 1/s²), with `M` positive definite and `K` positive semidefinite.
    pub stiffness: &'m DMatrix<f64>,
    /// Upper bound of the eigenvalues of `G` (1/s²).
    pub stiffness_bound: f64,
    /// Distance from the diagonal beyond which the entries of `G` are zero.
    pub half_bandwidth: usize,
    /// `α` (1/s).
    pub alpha_per_s: f64,
    /// `β` (s).
    pub beta_s: f64,
    /// `W = ∂ẍ/∂θ` (N_d × N_θ, m/s²).
    pub acceleration_by_theta: &'m DMatrix<f64>,
    /// Row range of the non-zero entries in each column of `W` (N_θ).
    pub reach: &'m [Range<usize>],
}

/// The part of a time step that one series covers.
#[derive(Debug, Clone, Copy)]
struct Substep {
    /// Length (s).
    length_s: f64,
    /// Number of doublings that lead to the whole step.
    doublings: usize,
}

/// The transition over one time step, recomputed at every step in the same storage.
#[derive(Debug, Clone)]
pub(crate) struct Transition {
    blocks: Blocks,
    accelerations: Accelerations,
    /// `true` if the step uses the accelerations instead of the blocks.
    through_accelerations: bool,
}

impl Transition {
    /// Allocates storage for the transitions of a model of this form.
    pub(crate) fn new(form: &ProportionalForm<'_>) -> Self {
        Self::with(form, Multiplier::new())
    }

    /// Allocates storage, with a certain instruction set.
    fn with(form: &ProportionalForm<'_>, multiplier: Multiplier) -> Self {
        Self {
            blocks: Blocks::new(form, multiplier),
            accelerations: Accelerations::new(form, multiplier),
            through_accelerations: false,
        }
    }

    /// Returns the number of terms in the transition of one covariance row.
    pub(crate) fn term_count(&self) -> usize {
        if self.through_accelerations {
            self.accelerations.term_count()
        } else {
            self.blocks.term_count()
        }
    }

    /// Discretises a step of `step_s` (s) and integrates the inputs.
    ///
    /// It replaces `[g, B_y]` in `inputs` (n × (1 + N_f)) by `[Γ g + Γ₂ ramp, Γ B_y]`. `rate_bound`
    /// (1/s) and `ramp` (n) are as for [`integrate_inputs`](crate::discretise::integrate_inputs).
    pub(crate) fn discretise(
        &mut self,
        form: &ProportionalForm<'_>,
        step_s: f64,
        rate_bound: f64,
        inputs: &mut DMatrix<f64>,
        ramp: Option<&[f64]>,
    ) {
        let free = form.stiffness.nrows();
        let mut substep = Substep {
            length_s: step_s,
            doublings: 0,
        };
        // The subsequent check of the filtered state detects a bound that is not finite.
        while rate_bound.is_finite() && rate_bound * substep.length_s > LARGEST_STEP {
            substep.length_s *= 0.5;
            substep.doublings += 1;
        }
        let h = substep.length_s;
        let damping = [-form.alpha_per_s * h, form.beta_s / h];
        let polynomials = Polynomials::new(damping, rate_bound * h, form.stiffness_bound * h * h);
        let slope = ramp.map(|ramp| &ramp[free..2 * free]);
        self.through_accelerations =
            substep.doublings == 0 && Accelerations::are_shorter(form, &polynomials);
        if self.through_accelerations {
            self.accelerations.set(form, h, &polynomials);
            self.accelerations
                .integrate_inputs(damping, &polynomials, inputs, slope);
        } else {
            self.blocks
                .discretise(form, substep, damping, &polynomials, inputs, slope);
        }
    }

    /// Computes `λ A_i Σ A_iᵀ` (n × n) in `out`, without process noise, equation (2.61).
    ///
    /// Both triangles are bit-identical.
    pub(crate) fn propagate_covariance_to(
        &mut self,
        covariance: &DMatrix<f64>,
        fading: f64,
        out: &mut DMatrix<f64>,
    ) {
        if self.through_accelerations {
            self.accelerations
                .propagate_covariance_to(covariance, fading, out);
        } else {
            self.blocks.propagate_covariance_to(covariance, fading, out);
        }
    }

    /// Replaces `X` (n × c) by `A_i X`.
    pub(crate) fn mul_mut(&mut self, x: &mut DMatrix<f64>) {
        if self.through_accelerations {
            self.accelerations.mul_mut(x);
        } else {
            self.blocks.mul_mut(x);
        }
    }
}

/// Returns the rows of a square matrix (n × n) within `half_bandwidth` of the diagonal in any of
/// `columns`.
fn near(columns: &Range<usize>, half_bandwidth: usize, n: usize) -> Range<usize> {
    columns.start.saturating_sub(half_bandwidth)..(columns.end + half_bandwidth).min(n)
}

/// Adds runs of the parameters that affect one of `rows`; parameter 0 has row `first`.
fn extend_by_reached(
    runs: &mut Vec<Range<usize>>,
    first: usize,
    reach: &[Range<usize>],
    rows: &Range<usize>,
) {
    let mut last = 0..0;
    for (parameter, reach) in reach.iter().enumerate() {
        if reach.start < rows.end && reach.end > rows.start && !reach.is_empty() {
            let row = first + parameter;
            if last.end != row {
                runs.extend((!last.is_empty()).then_some(last));
                last = row..row;
            }
            last.end = row + 1;
        }
    }
    runs.extend((!last.is_empty()).then_some(last));
}

#[cfg(test)]
mod tests;
