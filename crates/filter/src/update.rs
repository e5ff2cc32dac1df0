//! The measurement update.
//!
//! Notation: Huang & Yuen (2023), (2.68) to (2.70). `P`: predicted covariance (n × n),
//! `S = H P Hᵀ + Σ_n` (N_0 × N_0), `L Lᵀ = S`, `V = L⁻¹ H P` (N_0 × n), `ν`: innovation,
//! `ν̃ = L⁻¹ ν`. Then `G ν = Vᵀ ν̃` and `(I − GH) P = P − Vᵀ V`. The gain itself is never computed,
//! and both triangles are bit-identical. The code stores `P Hᵀ` and `Vᵀ`, because their columns are
//! long.

use crate::dense::{
    cholesky_mut, diagonal_to, ln_determinant, solve_lower_mut, solve_lower_of_rows_mut,
    solve_lower_transposed_mut, subtract_gram_mut,
};
use crate::error::FilterError;
use crate::model::ObservationModel;
use crate::product::{Left, Multiplier, Piece, Right};
use crate::small;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// The form of the covariance correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CovarianceForm {
    /// `P − Vᵀ V`: the cheapest form, exactly symmetric. It is accurate in double precision with
    /// the exact gain.
    #[default]
    Symmetric,
    /// `(I − GH) P (I − GH)ᵀ + G Σ_n Gᵀ`: twice the work, for measurement noise many orders of
    /// magnitude below `H P Hᵀ`.
    Joseph,
}

/// The evidence of one update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Evidence {
    /// Normalised innovation squared: `νᵀ S⁻¹ ν`, with the innovation `ν` and its covariance `S`.
    pub normalised_innovation_squared: f64,
    /// `ln p(z | D)`.
    pub log_evidence: f64,
}

/// Scratch space of the update, allocated once.
#[derive(Debug, Clone)]
pub(crate) struct Workspace {
    /// `S` (N_0 × N_0).
    pub innovation_covariance: DMatrix<f64>,
    /// `ν`, NaN for missing channels (N_0).
    pub innovation: DVector<f64>,
    /// The corrected variances (n).
    pub variances: DVector<f64>,
    /// `L` (N_0 × N_0).
    factor: DMatrix<f64>,
    /// `ν̃` (N_0).
    whitened: DVector<f64>,
    /// `[−V; Bᵀ]` ((N_0 + N_f) × n).
    right: Right,
    multiplier: Multiplier,
    joseph: Option<JosephWorkspace>,
}

#[derive(Debug, Clone)]
struct JosephWorkspace {
    /// `Gᵀ` (N_0 × n).
    gain_transposed: DMatrix<f64>,
    /// `H (I − GH) P` (N_0 × n).
    h_x: DMatrix<f64>,
    /// `Σ_n Gᵀ` (N_0 × n).
    noise_gain: DMatrix<f64>,
}

impl Workspace {
    /// Returns `ν̃` of the last update (N_0).
    pub(crate) fn whitened(&self) -> &DVector<f64> {
        &self.whitened
    }

    pub(crate) fn new(n: usize, channels: usize, inputs: usize, form: CovarianceForm) -> Self {
        let wide = || DMatrix::zeros(channels, n);
        Self {
            innovation_covariance: DMatrix::zeros(channels, channels),
            innovation: DVector::zeros(channels),
            variances: DVector::zeros(n),
            factor: DMatrix::zeros(channels, channels),
            whitened: DVector::zeros(channels),
            right: Right::new(channels + inputs, n, 2),
            multiplier: Multiplier::new(),
            joseph: (form == CovarianceForm::Joseph).then(|| JosephWorkspace {
                gain_transposed: wide(),
                h_x: wide(),
                noise_gain: wide(),
            }),
        }
    }
}

/// Removes the missing channels (NaN in the innovation) from `S` and `P Hᵀ`; returns the number of
/// used channels.
///
/// A missing channel becomes a row of the identity with zero innovation and zero `P Hᵀ`. This is
/// equivalent to an infinite variance and keeps all sizes.
pub(crate) fn leave_out_missing(work: &mut Workspace, p_ht: &mut DMatrix<f64>) -> usize {
    let mut used = 0;
    for j in 0..work.innovation.len() {
        if work.innovation[j].is_nan() {
            work.innovation_covariance.row_mut(j).fill(0.0);
            work.innovation_covariance.column_mut(j).fill(0.0);
            work.innovation_covariance[(j, j)] = 1.0;
            p_ht.column_mut(j).fill(0.0);
        } else {
            used += 1;
        }
    }
    used
}

/// Factorises `S` and whitens the innovation.
///
/// If the first attempt fails, it adds 1e-12 of the mean variance to the diagonal and tries again.
/// A second failure is an error.
pub(crate) fn factorise(work: &mut Workspace, used: usize) -> Result<Evidence, FilterError> {
    let channels = work.innovation.len();
    work.factor.copy_from(&work.innovation_covariance);
    if cholesky_mut(&mut work.factor).is_err() {
        let jitter = 1e-12 * work.innovation_covariance.trace() / channels as f64;
        for j in 0..channels {
            work.innovation_covariance[(j, j)] += jitter;
        }
        work.factor.copy_from(&work.innovation_covariance);
        cholesky_mut(&mut work.factor)
            .map_err(|pivot| FilterError::InnovationCovariance { pivot })?;
    }
    for j in 0..channels {
        let innovation = work.innovation[j];
        work.whitened[j] = if innovation.is_nan() { 0.0 } else { innovation };
    }
    solve_lower_mut(&work.factor, work.whitened.as_mut_slice());
    let normalised_innovation_squared = work.whitened.norm_squared();
    let log_evidence = -0.5
        * (used as f64 * std::f64::consts::TAU.ln()
            + ln_determinant(&work.factor)
            + normalised_innovation_squared);
    Ok(Evidence {
        normalised_innovation_squared,
        log_evidence,
    })
}

/// The contribution of the unknown excitation to the predicted covariance, `λ B Σ_f Bᵀ`, as
/// factors.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ExcitationSpread<'a> {
    /// `B` (n × N_f).
    pub input: &'a DMatrix<f64>,
    /// `λ B Σ_f` (n × N_f).
    pub scaled: &'a DMatrix<f64>,
}

/// Corrects the mean (n) and the covariance (n × n), and stores the variances in the scratch space.
///
/// - `covariance`: `P` without the `spread` of the excitation
/// - `p_ht`: `P Hᵀ` (n × N_0) with the `spread`; becomes `Vᵀ`
/// - `sensors`: `Σ_n`, used only by the Joseph form
///
/// [`factorise`] must run first.
pub(crate) fn correct(
    model: &impl ObservationModel,
    mean: &mut DVector<f64>,
    covariance: &mut DMatrix<f64>,
    spread: Option<ExcitationSpread<'_>>,
    p_ht: &mut DMatrix<f64>,
    sensors: &DMatrix<f64>,
    work: &mut Workspace,
) {
    let Workspace {
        factor,
        whitened,
        right,
        multiplier,
        variances,
        ..
    } = work;
    solve_lower_of_rows_mut(multiplier.arch(), factor, p_ht.as_mut_slice()); // Vᵀ = P Hᵀ L⁻ᵀ
    mean.gemv(1.0, p_ht, whitened, 1.0); // y ← y + Vᵀ ν̃                            (2.68)
    if covariance.nrows() <= small::MOST_ROWS && spread.is_none() {
        small::subtract_outer_mut(multiplier.arch(), covariance, p_ht); // Σ = P − Vᵀ V      (2.70)
        diagonal_to(covariance, variances);
    } else {
        subtract_by_strips(covariance, spread, p_ht, right, *multiplier, variances);
    }
    let Some(JosephWorkspace {
        gain_transposed,
        h_x,
        noise_gain,
    }) = &mut work.joseph
    else {
        return;
    };
    gain_transposed.tr_copy_from(p_ht);
    solve_lower_transposed_mut(&work.factor, gain_transposed.as_mut_slice()); // Gᵀ = L⁻ᵀ V
    model.observation_jacobian_mul(covariance, h_x); // H X with X = (I − GH) P
    noise_gain.gemm_tr(1.0, sensors, gain_transposed, 0.0); // Σ_n Gᵀ, because Σ_n is symmetric
    let n = covariance.nrows();
    for j in 0..n {
        let noise = noise_gain.column(j);
        let right = gain_transposed.column(j);
        for i in 0..n {
            // X − X Hᵀ Gᵀ + G Σ_n Gᵀ
            let product = h_x.column(i).dot(&right);
            covariance[(i, j)] += gain_transposed.column(i).dot(&noise) - product;
        }
    }
    crate::dense::symmetrise_mut(covariance);
    diagonal_to(covariance, variances);
}

/// Replaces `P` by `Σ = P + λ B Σ_f Bᵀ − Vᵀ V`, equation (2.70); `p_ht` already contains `Vᵀ`
/// (n × N_0).
fn subtract_by_strips(
    covariance: &mut DMatrix<f64>,
    spread: Option<ExcitationSpread<'_>>,
    p_ht: &DMatrix<f64>,
    right: &mut Right,
    multiplier: Multiplier,
    variances: &mut DVector<f64>,
) {
    let (n, channels) = p_ht.shape();
    let inputs = spread.map_or(0, |spread| spread.input.ncols());
    let of_group = |_: Range<usize>, runs: &mut Vec<Range<usize>>| {
        runs.extend(
            [0..channels, channels..channels + inputs]
                .into_iter()
                .filter(|run| !run.is_empty()),
        );
    };
    right.pack_with(n, of_group, |columns, run, values| {
        let (sign, entries) = match spread {
            Some(spread) if run.start == channels => (1.0, spread.input.as_slice()),
            _ => (-1.0, p_ht.as_slice()),
        };
        for (values, entries) in values.iter_mut().zip(entries.chunks_exact(n)) {
            for (value, entry) in values.iter_mut().zip(&entries[columns.clone()]) {
                *value = sign * entry;
            }
        }
    });
    let v_transposed = Piece::new(p_ht);
    let left = Left::joined(
        v_transposed,
        channels,
        spread.map_or(v_transposed, |spread| Piece::new(spread.scaled)),
    );
    multiplier.add_symmetric_mut(left, right, covariance, variances.as_mut_slice());
}

/// Computes the posterior of the unknown excitation at the frame itself, for models with a direct
/// term.
///
/// - mean `w̄ = Σ_f Dᵀ S⁻¹ ν` (N_f)
/// - covariance `W = Σ_f − Σ_f Dᵀ S⁻¹ D Σ_f` (N_f × N_f)
/// - covariance with the state `C = −P Hᵀ S⁻¹ D Σ_f` (n × N_f), from `Vᵀ` (n × N_0)
///
/// The next prediction starts from this posterior, because the excitation already measured by the
/// sensors acts on the state over the next step.
pub(crate) fn infer_excitation(
    feedthrough: &DMatrix<f64>,
    excitation: &DMatrix<f64>,
    v_transposed: &DMatrix<f64>,
    work: &Workspace,
    posterior: &mut ExcitationPosterior,
) {
    let ExcitationPosterior {
        mean,
        covariance,
        cross,
        whitened_gain,
    } = posterior;
    // R = L⁻¹ D Σ_f, with zero rows for missing channels.
    whitened_gain.fill(0.0);
    for b in 0..excitation.ncols() {
        for a in 0..excitation.nrows() {
            for j in 0..feedthrough.nrows() {
                if !work.innovation[j].is_nan() {
                    whitened_gain[(j, b)] += feedthrough[(j, a)] * excitation[(a, b)];
                }
            }
        }
    }
    solve_lower_mut(&work.factor, whitened_gain.as_mut_slice());
    mean.gemv_tr(1.0, whitened_gain, &work.whitened, 0.0);
    covariance.copy_from(excitation);
    subtract_gram_mut(covariance, whitened_gain);
    for (mut cross, gain) in cross.column_iter_mut().zip(whitened_gain.column_iter()) {
        cross.gemv(-1.0, v_transposed, &gain, 0.0);
    }
}

/// The posterior of the unknown excitation at the last frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExcitationPosterior {
    /// `w̄` (N_f).
    pub(crate) mean: DVector<f64>,
    /// `W` (N_f × N_f).
    pub(crate) covariance: DMatrix<f64>,
    /// `C` (n × N_f).
    pub(crate) cross: DMatrix<f64>,
    /// `L⁻¹ D Σ_f` (N_0 × N_f).
    whitened_gain: DMatrix<f64>,
}

impl ExcitationPosterior {
    pub(crate) fn new(n: usize, channels: usize, excitation_len: usize) -> Self {
        Self {
            mean: DVector::zeros(excitation_len),
            covariance: DMatrix::zeros(excitation_len, excitation_len),
            cross: DMatrix::zeros(n, excitation_len),
            whitened_gain: DMatrix::zeros(channels, excitation_len),
        }
    }

    /// Resets the posterior to zero.
    pub(crate) fn clear(&mut self) {
        self.mean.fill(0.0);
        self.covariance.fill(0.0);
        self.cross.fill(0.0);
    }
}
