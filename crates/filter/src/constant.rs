//! Quantities that a linear time-invariant model computes only once: its transition and the effect
//! of its excitation noise.
//!
//! Notation: Yuen, Liang & Kuok (2013). `ẏ = A y + B f` becomes
//! `y_{k+1} = A_d y_k + B_d f_k + R (f_{k+1} − f_k)` with
//!
//! - `A_d = exp(A Δt)`
//! - `B_d = ∫₀^Δt exp(A s) ds B`
//! - `R = ∫₀^Δt exp(A (Δt − s)) s ds B/Δt`, for an excitation that varies linearly over the step
//!   instead of being held
//!
//! All three are blocks of one matrix exponential, which does not require an inverse of `A`.

use crate::dense::{add_scaled_mut, symmetrise_mut};
use crate::error::FilterError;
use crate::model::ObservationModel;
use crate::noise::{NoiseModel, NoiseTarget};
use crate::product::{Left, Multiplier, Right, Sum};
use crate::small::{Congruence, MOST_ROWS};
use nalgebra::{DMatrix, DVector};
use pulp::Arch;

/// The exact transition of a linear time-invariant model over one time step.
#[derive(Debug, Clone, PartialEq)]
pub struct ConstantTransition {
    transition: Transition,
    /// `B_d` (n × N_f)
    held: DMatrix<f64>,
    /// `R` (n × N_f)
    ramp: DMatrix<f64>,
}

#[derive(Debug, Clone, PartialEq)]
enum Transition {
    /// `A_d` (n × n)
    Dense(DMatrix<f64>),
    /// The four diagonals of `A_d` for a state `[q, q̇]` of uncoupled modes. Each mode has one 2 ×
    /// 2 block, stored row by row.
    Modal(Vec<[f64; 4]>),
}

impl ConstantTransition {
    /// Creates the transition of `ẏ = A y + B f` over `step_s` (s) from `A` (n × n, 1/s) and `B` (n
    /// × N_f).
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] if `A` is not square or `B` does not have `n` rows.
    pub fn dense(
        system: &DMatrix<f64>,
        input: &DMatrix<f64>,
        step_s: f64,
    ) -> Result<Self, FilterError> {
        let n = system.nrows();
        for (what, found) in [
            ("columns of the system matrix", system.ncols()),
            ("rows of the input matrix", input.nrows()),
        ] {
            if found != n {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected: n,
                });
            }
        }
        let [transition, held, ramp] = exponential_blocks(system, input, step_s);
        Ok(Self {
            transition: Transition::Dense(transition),
            held,
            ramp,
        })
    }

    /// Creates the transition of uncoupled modes for the state `[q, q̇]`.
    ///
    /// Each mode follows `q̈_j + c_j q̇_j + ω_j² q_j = Σ_b p_jb f_b`.
    ///
    /// - `stiffness`: `ω²` (N_m, 1/s²)
    /// - `damping`: `c = 2ζω` (N_m, 1/s)
    /// - `participation`: `p` (N_m × N_f)
    ///
    /// # Errors
    /// Returns [`FilterError::Dimension`] if the lengths differ.
    pub fn modal(
        stiffness: &[f64],
        damping: &[f64],
        participation: &DMatrix<f64>,
        step_s: f64,
    ) -> Result<Self, FilterError> {
        let modes = stiffness.len();
        for (what, found) in [
            ("modal damping", damping.len()),
            ("modal participation", participation.nrows()),
        ] {
            if found != modes {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected: modes,
                });
            }
        }
        let inputs = participation.ncols();
        let (mut held, mut ramp) = (
            DMatrix::zeros(2 * modes, inputs),
            DMatrix::zeros(2 * modes, inputs),
        );
        let unit = DMatrix::from_column_slice(2, 1, &[0.0, 1.0]);
        let mut blocks = Vec::with_capacity(modes);
        for j in 0..modes {
            let system = DMatrix::from_row_slice(2, 2, &[0.0, 1.0, -stiffness[j], -damping[j]]);
            let [a, b, r] = exponential_blocks(&system, &unit, step_s);
            blocks.push([a[(0, 0)], a[(0, 1)], a[(1, 0)], a[(1, 1)]]);
            for k in 0..inputs {
                for (row, half) in [(j, 0), (modes + j, 1)] {
                    held[(row, k)] = b[half] * participation[(j, k)];
                    ramp[(row, k)] = r[half] * participation[(j, k)];
                }
            }
        }
        Ok(Self {
            transition: Transition::Modal(blocks),
            held,
            ramp,
        })
    }

    /// Returns `B_d` (n × N_f).
    #[must_use]
    pub fn held_input(&self) -> &DMatrix<f64> {
        &self.held
    }

    /// Replaces `X` (n × c) by `A_d X`. `column` (n) is scratch space.
    pub(crate) fn mul_mut(&self, x: &mut DMatrix<f64>, column: &mut DVector<f64>) {
        match &self.transition {
            Transition::Dense(a) => {
                for mut target in x.column_iter_mut() {
                    column.copy_from(&target);
                    target.gemv(1.0, a, column, 0.0);
                }
            }
            Transition::Modal(blocks) => {
                let modes = blocks.len();
                for mut target in x.column_iter_mut() {
                    for (j, [a, b, c, d]) in blocks.iter().enumerate() {
                        let (q, rate) = (target[j], target[modes + j]);
                        target[j] = a * q + b * rate;
                        target[modes + j] = c * q + d * rate;
                    }
                }
            }
        }
    }

    /// Replaces the mean (n) by `A_d y + B_d f + R Δf`.
    ///
    /// `held` is `f` and `ramp` is `Δf` (N_f each). `ramp` is `None` if the excitation is held over
    /// the step.
    fn predict_mean_mut(
        &self,
        mean: &mut DVector<f64>,
        held: &DVector<f64>,
        ramp: Option<&DVector<f64>>,
        column: &mut DVector<f64>,
        small: Option<(Arch, &Congruence)>,
    ) {
        column.copy_from(mean);
        if let Some((arch, congruence)) = small {
            congruence.mul_to(arch, column.as_slice(), mean.as_mut_slice());
        } else {
            self.move_to(column, mean);
        }
        mean.gemv(1.0, &self.held, held, 1.0);
        if let Some(ramp) = ramp {
            mean.gemv(1.0, &self.ramp, ramp, 1.0);
        }
    }

    /// Writes `A_d y` (n) into `mean`, where `column` is `y`.
    fn move_to(&self, column: &DVector<f64>, mean: &mut DVector<f64>) {
        match &self.transition {
            Transition::Dense(a) => mean.gemv(1.0, a, column, 0.0),
            Transition::Modal(blocks) => {
                let modes = blocks.len();
                for (j, [a, b, c, d]) in blocks.iter().enumerate() {
                    mean[j] = a * column[j] + b * column[modes + j];
                    mean[modes + j] = c * column[j] + d * column[modes + j];
                }
            }
        }
    }

    /// Writes `A_d Σ A_dᵀ` (n × n) into `out`. `column` (n) is scratch space.
    pub(crate) fn propagate_covariance_to(
        &self,
        covariance: &DMatrix<f64>,
        out: &mut DMatrix<f64>,
        column: &mut DVector<f64>,
    ) {
        match &self.transition {
            Transition::Dense(_) => {
                out.copy_from(covariance);
                self.mul_mut(out, column);
                out.transpose_mut(); // Σ A_dᵀ, because Σ is symmetric
                self.mul_mut(out, column);
            }
            Transition::Modal(blocks) => {
                propagate_modal_to(blocks, covariance.as_slice(), out.as_mut_slice())
            }
        }
    }

    pub(crate) fn check(&self, state_len: usize, excitation_len: usize) -> Result<(), FilterError> {
        FilterError::check_sizes([
            ("constant transition", self.held.nrows(), state_len),
            (
                "input of the constant transition",
                self.held.ncols(),
                excitation_len,
            ),
        ])
    }
}

/// Returns `A_d`, `B_d` and `R` from the exponential of `[[A, B, 0], [0, 0, I/Δt], [0, 0, 0]] Δt`.
fn exponential_blocks(
    system: &DMatrix<f64>,
    input: &DMatrix<f64>,
    step_s: f64,
) -> [DMatrix<f64>; 3] {
    let (n, inputs) = (system.nrows(), input.ncols());
    let mut augmented = DMatrix::zeros(n + 2 * inputs, n + 2 * inputs);
    augmented
        .view_mut((0, 0), (n, n))
        .copy_from(&(system * step_s));
    augmented
        .view_mut((0, n), (n, inputs))
        .copy_from(&(input * step_s));
    augmented
        .view_mut((n, n + inputs), (inputs, inputs))
        .fill_with_identity();
    let exponential = augmented.exp();
    [(0, n), (n, inputs), (n + inputs, inputs)]
        .map(|(start, columns)| exponential.view((0, start), (n, columns)).into_owned())
}

/// Writes `A_d Σ A_dᵀ` for uncoupled modes: each pair of modes needs a 2 × 2 product from both
/// sides.
fn propagate_modal_to(blocks: &[[f64; 4]], covariance: &[f64], out: &mut [f64]) {
    let modes = blocks.len();
    let n = 2 * modes;
    let (left, right) = covariance.split_at(modes * n); // columns of q, columns of q̇
    let (out_left, out_right) = out.split_at_mut(modes * n);
    for (j, [a, b, c, d]) in blocks.iter().enumerate() {
        let column = j * n..(j + 1) * n;
        let (to_q, to_rate) = (&left[column.clone()], &right[column.clone()]);
        let (q_out, rate_out) = (&mut out_left[column.clone()], &mut out_right[column]);
        for (i, [e, f, g, h]) in blocks.iter().enumerate() {
            let upper = [
                e * to_q[i] + f * to_q[modes + i],
                e * to_rate[i] + f * to_rate[modes + i],
            ];
            let lower = [
                g * to_q[i] + h * to_q[modes + i],
                g * to_rate[i] + h * to_rate[modes + i],
            ];
            q_out[i] = upper[0] * a + upper[1] * b;
            rate_out[i] = upper[0] * c + upper[1] * d;
            q_out[modes + i] = lower[0] * a + lower[1] * b;
            rate_out[modes + i] = lower[0] * c + lower[1] * d;
        }
    }
}

/// Effect of an excitation covariance `C` (N_f × N_f) in one step, per unit of its level.
#[derive(Debug, Clone)]
pub(crate) struct NoiseSpread {
    /// `B_d C B_dᵀ` (n × n)
    state: DMatrix<f64>,
    /// `B_d C B_dᵀ Hᵀ` (n × N_0)
    cross: DMatrix<f64>,
    /// `H B_d C B_dᵀ Hᵀ` (N_0 × N_0)
    pub(crate) datum: DMatrix<f64>,
}

impl NoiseSpread {
    fn new(held: &DMatrix<f64>, h_b: &DMatrix<f64>, covariance: &DMatrix<f64>) -> Self {
        let b_c = held * covariance;
        let cross = &b_c * h_b.transpose();
        let mut datum = h_b * covariance * h_b.transpose();
        symmetrise_mut(&mut datum);
        let mut state = b_c * held.transpose();
        symmetrise_mut(&mut state);
        Self {
            state,
            cross,
            datum,
        }
    }
}

/// The precomputed parts of a filter whose model is linear and time-invariant.
#[derive(Debug, Clone)]
pub(crate) struct ConstantPath {
    pub(crate) transition: ConstantTransition,
    /// `H B_d` (N_0 × N_f)
    pub(crate) h_b: DMatrix<f64>,
    /// Effect of the known part of `Σ_f`; `None` if that part is zero.
    known: Option<NoiseSpread>,
    /// Effect of each noise parameter; `None` for a parameter that scales the sensor noise.
    pub(crate) levels: Vec<Option<NoiseSpread>>,
    /// Scratch space (n).
    pub(crate) column: DVector<f64>,
    dense: Option<DenseProducts>,
}

/// Operands for the products with a dense `A_d`.
#[derive(Debug, Clone)]
struct DenseProducts {
    factors: Factors,
    multiplier: Multiplier,
}

#[derive(Debug, Clone)]
enum Factors {
    Small(Congruence),
    Large {
        /// `A_dᵀ`
        by_transition: Right,
        /// `A_d Σ` (n × n)
        half_way: DMatrix<f64>,
    },
}

impl DenseProducts {
    fn new(transition: &DMatrix<f64>) -> Self {
        let n = transition.nrows();
        let factors = if n <= MOST_ROWS {
            Factors::Small(Congruence::new(transition))
        } else {
            let mut by_transition = Right::new(n, n, 1);
            by_transition.pack(&transition.transpose());
            Factors::Large {
                by_transition,
                half_way: DMatrix::zeros(n, n),
            }
        };
        Self {
            factors,
            multiplier: Multiplier::new(),
        }
    }

    /// Writes `λ A_d Σ A_dᵀ` (n × n) into `out`. Both triangles are bit-identical.
    fn propagate_covariance_to(
        &mut self,
        covariance: &DMatrix<f64>,
        fading: f64,
        out: &mut DMatrix<f64>,
    ) {
        let Self {
            factors,
            multiplier,
        } = self;
        match factors {
            Factors::Small(congruence) => {
                congruence.apply_to(multiplier.arch(), fading, covariance, out)
            }
            Factors::Large {
                by_transition,
                half_way,
            } => {
                multiplier.multiply_transposed_to(
                    Left::new(covariance),
                    by_transition,
                    Sum::PLAIN,
                    half_way,
                );
                multiplier.multiply_symmetric_to(
                    Left::new(half_way),
                    by_transition,
                    Sum::scaled(fading),
                    out,
                );
            }
        }
    }
}

impl ConstantPath {
    /// Writes `λ A_d Σ A_dᵀ` (n × n) into `out`, exactly symmetric.
    pub(crate) fn propagate_covariance_to(
        &mut self,
        covariance: &DMatrix<f64>,
        fading: f64,
        out: &mut DMatrix<f64>,
    ) {
        if let Some(dense) = &mut self.dense {
            dense.propagate_covariance_to(covariance, fading, out);
        } else {
            self.transition
                .propagate_covariance_to(covariance, out, &mut self.column);
            *out *= fading;
            symmetrise_mut(out);
        }
    }

    /// Replaces the mean (n), like [`ConstantTransition::predict_mean_mut`].
    pub(crate) fn predict_mean_mut(
        &mut self,
        mean: &mut DVector<f64>,
        held: &DVector<f64>,
        ramp: Option<&DVector<f64>>,
    ) {
        let small = match &self.dense {
            Some(DenseProducts {
                factors: Factors::Small(congruence),
                multiplier,
            }) => Some((multiplier.arch(), congruence)),
            _ => None,
        };
        self.transition
            .predict_mean_mut(mean, held, ramp, &mut self.column, small);
    }

    pub(crate) fn new(
        transition: ConstantTransition,
        model: &impl ObservationModel,
        noise: &NoiseModel,
    ) -> Self {
        let held = &transition.held;
        let mut h_b = DMatrix::zeros(model.observation_len(), held.ncols());
        model.observation_jacobian_mul(held, &mut h_b);
        let spread = |covariance: &DMatrix<f64>| NoiseSpread::new(held, &h_b, covariance);
        let known = (noise.excitation.amax() > 0.0).then(|| spread(&noise.excitation));
        let levels = noise
            .parameters
            .iter()
            .map(|parameter| {
                (parameter.target == NoiseTarget::Excitation).then(|| spread(&parameter.pattern))
            })
            .collect();
        let column = DVector::zeros(held.nrows());
        let dense = match &transition.transition {
            Transition::Dense(a) => Some(DenseProducts::new(a)),
            Transition::Modal(_) => None,
        };
        Self {
            known,
            levels,
            h_b,
            column,
            dense,
            transition,
        }
    }

    /// Adds the effect of the known part of `Σ_f` to the covariance of the datum (N_0 × N_0).
    ///
    /// `missing` is as in [`Self::add_noise_mut`].
    pub(crate) fn add_known_datum_mut(
        &self,
        fading: f64,
        missing: &DVector<f64>,
        datum: &mut DMatrix<f64>,
    ) {
        if let Some(known) = &self.known {
            add_scaled_mut(datum, fading, &known.datum);
        }
        for (j, &variance) in missing.iter().enumerate() {
            add_outer_mut(
                datum,
                fading * variance,
                self.h_b.column(j).as_slice(),
                self.h_b.column(j).as_slice(),
            );
        }
    }

    /// Adds the excitation noise of the step to `P` (n × n), `P Hᵀ` (n × N_0) and `H P Hᵀ` (N_0 ×
    /// N_0).
    ///
    /// `missing` (N_f) is the variance of each measured excitation whose sample is missing, and 0
    /// for all others.
    pub(crate) fn add_noise_mut(
        &self,
        psi: &DVector<f64>,
        fading: f64,
        missing: &DVector<f64>,
        covariance: &mut DMatrix<f64>,
        p_ht: &mut DMatrix<f64>,
        datum: &mut DMatrix<f64>,
    ) {
        let known = self.known.iter().map(|spread| (1.0, spread));
        let levels = psi
            .iter()
            .zip(&self.levels)
            .filter_map(|(level, spread)| Some((*level, spread.as_ref()?)));
        for (level, spread) in known.chain(levels) {
            add_scaled_mut(covariance, fading * level, &spread.state);
            add_scaled_mut(p_ht, fading * level, &spread.cross);
            add_scaled_mut(datum, fading * level, &spread.datum);
        }
        for (j, &variance) in missing.iter().enumerate() {
            let (b, h_b) = (self.transition.held.column(j), self.h_b.column(j));
            add_outer_mut(covariance, fading * variance, b.as_slice(), b.as_slice());
            add_outer_mut(p_ht, fading * variance, b.as_slice(), h_b.as_slice());
            add_outer_mut(datum, fading * variance, h_b.as_slice(), h_b.as_slice());
        }
    }
}

/// Adds `weight · u vᵀ`. The result is exactly symmetric if `u` equals `v`.
fn add_outer_mut(target: &mut DMatrix<f64>, weight: f64, u: &[f64], v: &[f64]) {
    if weight == 0.0 {
        return;
    }
    for (mut column, right) in target.column_iter_mut().zip(v) {
        for (entry, left) in column.iter_mut().zip(u) {
            *entry += weight * (left * right);
        }
    }
}
