//! Propagation of states and covariances over one time step, without inverting the Jacobian.
//!
//! The Jacobian is an operator. Notation: Huang & Yuen (2023), §2.4.
//!
//! - `A_i = exp(A_y Δt)` (2.54)
//! - `Γ = ∫₀^Δt exp(A_y s) ds`, which equals `A_y⁻¹(A_i − I)` of (2.55) and (2.56) if that inverse
//!   exists
//! - `Γ₂ = ∫₀^Δt exp(A_y(Δt − s)) s ds`, for an input that varies linearly over the step
//!
//! All three are Taylor series applied to given columns. A singular `A_y` is therefore not a
//! special case; constant parameters make it singular.

use crate::model::ProcessModel;
use nalgebra::DMatrix;

/// Size of the next term, relative to the sum, at which the series ends: the rounding error of a
/// double.
const SERIES_TOLERANCE: f64 = 1e-16;

/// Largest `ρ h` at which the series converges without cancellation of its terms. Longer steps are
/// divided into substeps.
pub(crate) const LARGEST_STEP: f64 = 1.5;

/// Course of a known excitation between two frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InputHold {
    /// The value of the older frame, held over the step. The examples of the source are simulated
    /// in this way.
    Zero,
    /// A straight line from the older frame to the newer frame, which follows a recorded motion
    /// without a delay of half a step.
    ///
    /// A smooth motion deviates from this line where it is curved. The filter adds the average
    /// deviation over the step.
    First,
}

/// Number of substeps of a time step, and number of series terms in each substep.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Series {
    /// Number of equal substeps.
    pub substeps: usize,
    /// Terms beyond the identity in each substep.
    pub order: usize,
}

impl Series {
    /// Selects the substeps and the order for a step of `step_s` (s) and a spectral radius of at
    /// most `rate_bound` (1/s).
    #[must_use]
    pub fn choose(rate_bound: f64, step_s: f64) -> Self {
        let reach = rate_bound * step_s;
        // If the bound is not finite, the check of the filtered state reports the error afterwards.
        let substeps = if reach.is_finite() {
            ((reach / LARGEST_STEP).ceil() as usize).clamp(1, 10_000)
        } else {
            1
        };
        let short = reach / substeps as f64;
        let mut order = 2;
        let mut term = short * short / 2.0;
        // One order more than the estimate requires, because Jacobians of structures are not
        // normal.
        while term > SERIES_TOLERANCE && order < 40 {
            order += 1;
            term *= short / order as f64;
        }
        Self {
            substeps,
            order: order + 1,
        }
    }
}

/// Scratch space of the series, allocated once.
#[derive(Debug, Clone)]
pub(crate) struct Workspace {
    /// n × n
    square: [DMatrix<f64>; 2],
    /// n × (1 + N_f)
    narrow: [DMatrix<f64>; 3],
    /// n × N_f
    inputs: [DMatrix<f64>; 2],
    /// n × 1
    ramp: [DMatrix<f64>; 2],
}

impl Workspace {
    pub(crate) fn new(n: usize, excitation_len: usize) -> Self {
        let narrow = || DMatrix::zeros(n, 1 + excitation_len);
        Self {
            square: [DMatrix::zeros(n, n), DMatrix::zeros(n, n)],
            narrow: [narrow(), narrow(), narrow()],
            inputs: [
                DMatrix::zeros(n, excitation_len),
                DMatrix::zeros(n, excitation_len),
            ],
            ramp: [DMatrix::zeros(n, 1), DMatrix::zeros(n, 1)],
        }
    }
}

/// Replaces `X` (n × c) by `exp(A_y h) X` for one substep `h`. `term` and `next` are scratch space
/// of the size of `X`.
fn exponential_mul(
    model: &impl ProcessModel,
    h: f64,
    order: usize,
    x: &mut DMatrix<f64>,
    term: &mut DMatrix<f64>,
    next: &mut DMatrix<f64>,
) {
    term.copy_from(x);
    for k in 1..=order {
        model.jacobian_mul(term, next);
        *next *= h / k as f64;
        *x += &*next;
        std::mem::swap(term, next);
    }
}

/// Writes `A_i Σ A_iᵀ` (n × n) into `out`: equation (2.61) without fading and process noise.
pub(crate) fn propagate_covariance(
    model: &impl ProcessModel,
    step_s: f64,
    series: Series,
    covariance: &DMatrix<f64>,
    out: &mut DMatrix<f64>,
    work: &mut Workspace,
) {
    out.copy_from(covariance);
    transition_mul(model, step_s, series, out, work); // A Σ
    out.transpose_mut(); // Σ Aᵀ, because Σ is symmetric
    transition_mul(model, step_s, series, out, work);
}

/// Replaces a square `X` (n × n) by `A_i X`.
pub(crate) fn transition_mul(
    model: &impl ProcessModel,
    step_s: f64,
    series: Series,
    x: &mut DMatrix<f64>,
    work: &mut Workspace,
) {
    let h = step_s / series.substeps as f64;
    let [term, next] = &mut work.square;
    for _ in 0..series.substeps {
        exponential_mul(model, h, series.order, x, term, next);
    }
}

/// Replaces a narrow `X` (n × N_f) by `A_i X`.
pub(crate) fn transition_mul_narrow(
    model: &impl ProcessModel,
    step_s: f64,
    series: Series,
    x: &mut DMatrix<f64>,
    work: &mut Workspace,
) {
    let h = step_s / series.substeps as f64;
    let [term, next] = &mut work.inputs;
    for _ in 0..series.substeps {
        exponential_mul(model, h, series.order, x, term, next);
    }
}

/// Replaces the columns of `inputs` (n × (1 + N_f)), which contain `[g, B_y]`, by
/// `[Γ g + Γ₂ ramp, Γ B_y]`.
///
/// The first column becomes the increment of the mean (2.67). The other columns become `B_i`
/// (2.55). `ramp` (n) is `B_y ḟ`, where `ḟ` is the slope of the known excitation over the step. It
/// is `None` under [`InputHold::Zero`].
pub(crate) fn integrate_inputs(
    model: &impl ProcessModel,
    step_s: f64,
    series: Series,
    inputs: &mut DMatrix<f64>,
    ramp: Option<&[f64]>,
    work: &mut Workspace,
) {
    let h = step_s / series.substeps as f64;
    let [sum, term, next] = &mut work.narrow;
    sum.fill(0.0);
    for substep in 0..series.substeps {
        if substep > 0 {
            exponential_mul(model, h, series.order, sum, term, next);
        }
        term.copy_from(inputs);
        if let Some(slope) = ramp {
            let start_s = substep as f64 * h;
            for (entry, slope) in term.column_mut(0).iter_mut().zip(slope) {
                *entry += start_s * slope;
            }
        }
        *term *= h; // h G, then h²/2 A G, ...
        *sum += &*term;
        for k in 1..=series.order {
            model.jacobian_mul(term, next);
            *next *= h / (k + 1) as f64;
            *sum += &*next;
            std::mem::swap(term, next);
        }
        if let Some(slope) = ramp {
            let [term, next] = &mut work.ramp;
            for (entry, slope) in term.iter_mut().zip(slope) {
                *entry = 0.5 * h * h * slope; // h²/2 b, then h³/6 A b, ...
            }
            for k in 1..=series.order {
                for (total, entry) in sum.column_mut(0).iter_mut().zip(term.iter()) {
                    *total += entry;
                }
                model.jacobian_mul(term, next);
                *next *= h / (k + 2) as f64;
                std::mem::swap(term, next);
            }
        }
    }
    std::mem::swap(inputs, sum);
}

#[cfg(test)]
mod tests;
