//! The objective `J(ψ)` of one frame (3.28), with its exact gradient and Hessian.

use super::{NoiseModel, NoiseTarget};
use crate::constant::ConstantPath;
use crate::dense::{
    add_quadratic_form_mut, add_scaled_mut, cholesky_mut, ln_determinant, scale_symmetric_mut,
    solve_lower_mut, solve_lower_of_rows_mut,
};
use nalgebra::{DMatrix, DVector};
use pulp::Arch;

/// The problem of one frame in the noise parameters. It is N_0 × N_0, for any number of states.
///
/// A missing channel becomes a row and a column of the identity with zero innovation, which adds
/// nothing.
#[derive(Debug, Clone)]
pub(crate) struct Objective {
    /// `S₀` with the contributions of the known noise covariances (N_0 × N_0).
    known: DMatrix<f64>,
    /// `U_l` (N_0 × N_0).
    patterns: Vec<DMatrix<f64>>,
    innovation: DVector<f64>,
    used: usize,
    /// Reliability `κ` of the excitation (N_f).
    reliability: Vec<f64>,
    /// Scratch space: `K^½ U_l K^½` (N_f × N_f).
    excitation: DMatrix<f64>,
    factor: DMatrix<f64>,
    whitened: DVector<f64>,
    /// `V_l` (N_0 × N_0)
    whitened_patterns: Vec<DMatrix<f64>>,
    /// `V_l ẽ` (N_0)
    pattern_innovations: Vec<DVector<f64>>,
    pub(super) gradient: DVector<f64>,
    pub(super) observed: DMatrix<f64>,
    pub(super) expected: DMatrix<f64>,
    pub(super) scratch: Scratch,
    arch: Arch,
}

/// Path from the excitation of the coming step to the datum.
#[derive(Debug, Clone, Copy)]
pub(crate) enum ExcitationPath<'a> {
    /// The excitation has no effect, or `S₀` contains it because the previous frame has already
    /// measured it.
    Felt,
    /// Through `H B` (N_0 × N_f).
    Input(&'a DMatrix<f64>),
    /// Through the constant `H B C Bᵀ Hᵀ` of each noise parameter.
    Constant(&'a ConstantPath),
}

/// Scratch space of the rules (N_ψ).
#[derive(Debug, Clone)]
pub(super) struct Scratch {
    pub(super) information: DMatrix<f64>,
    pub(super) prior: DMatrix<f64>,
    pub(super) scale: DVector<f64>,
    pub(super) step: DVector<f64>,
    pub(super) candidate: DVector<f64>,
    pub(super) best: DVector<f64>,
}

impl Objective {
    pub(crate) fn new(channels: usize, parameters: usize) -> Self {
        let square = || DMatrix::zeros(channels, channels);
        let small = || DMatrix::zeros(parameters, parameters);
        let vector = || DVector::zeros(parameters);
        Self {
            known: square(),
            patterns: vec![square(); parameters],
            innovation: DVector::zeros(channels),
            used: 0,
            reliability: Vec::new(),
            excitation: DMatrix::zeros(0, 0),
            factor: square(),
            whitened: DVector::zeros(channels),
            whitened_patterns: vec![square(); parameters],
            pattern_innovations: vec![DVector::zeros(channels); parameters],
            gradient: vector(),
            observed: small(),
            expected: small(),
            scratch: Scratch {
                information: small(),
                prior: small(),
                scale: vector(),
                step: vector(),
                candidate: vector(),
                best: vector(),
            },
            arch: Arch::new(),
        }
    }

    /// Allocates the scratch space for an excitation with `inputs` components.
    pub(crate) fn with_inputs(mut self, inputs: usize) -> Self {
        self.reliability = vec![1.0; inputs];
        self.excitation = DMatrix::zeros(inputs, inputs);
        self
    }

    /// Sets the reliability `κ` (N_f) of the excitation at the coming frames. Without it, `κ` is 1.
    pub(crate) fn set_reliability(&mut self, reliability: &[f64]) {
        self.reliability.clear();
        self.reliability.extend_from_slice(reliability);
    }

    pub(crate) fn used_channels(&self) -> usize {
        self.used
    }

    /// Sets the frame.
    ///
    /// - `known`: `S₀ = λ H A Σ Aᵀ Hᵀ` (N_0 × N_0), with all parts that do not depend on `ψ`
    /// - `feedthrough`: `D` (N_0 × N_f)
    /// - `fading`: `λ` of the state
    /// - `innovation`: innovation (N_0), NaN for a missing channel
    pub(crate) fn set_frame(
        &mut self,
        model: &NoiseModel,
        known: &DMatrix<f64>,
        path: ExcitationPath<'_>,
        feedthrough: Option<&DMatrix<f64>>,
        fading: f64,
        innovation: &DVector<f64>,
    ) {
        self.known.copy_from(known);
        let excitation = &mut self.excitation;
        for (l, (parameter, pattern)) in model.parameters.iter().zip(&mut self.patterns).enumerate()
        {
            match parameter.target {
                NoiseTarget::Sensors => pattern.copy_from(&parameter.pattern),
                NoiseTarget::Excitation => {
                    pattern.fill(0.0);
                    if excitation.shape() != parameter.pattern.shape() {
                        *excitation = parameter.pattern.clone();
                    }
                    excitation.copy_from(&parameter.pattern);
                    scale_symmetric_mut(excitation, &self.reliability);
                    match path {
                        ExcitationPath::Felt => {}
                        ExcitationPath::Input(h_b) => {
                            add_quadratic_form_mut(pattern, h_b, excitation, fading);
                        }
                        ExcitationPath::Constant(constant) => {
                            if let Some(spread) = &constant.levels[l] {
                                add_scaled_mut(pattern, fading, &spread.datum);
                            }
                        }
                    }
                    if let Some(direct) = feedthrough {
                        add_quadratic_form_mut(pattern, direct, excitation, 1.0);
                    }
                }
            }
        }
        self.used = 0;
        for j in 0..innovation.len() {
            if innovation[j].is_nan() {
                self.innovation[j] = 0.0;
                clear_channel_mut(&mut self.known, j, 1.0);
                for pattern in &mut self.patterns {
                    clear_channel_mut(pattern, j, 0.0);
                }
            } else {
                self.innovation[j] = innovation[j];
                self.used += 1;
            }
        }
    }

    /// Returns the likelihood part of `J(ψ)`, `½[ln|Σ_z| + eᵀ Σ_z⁻¹ e]`.
    ///
    /// It is infinite if `Σ_z` is not positive definite.
    pub(crate) fn value(&mut self, psi: &DVector<f64>) -> f64 {
        if !self.factorise(psi) {
            return f64::INFINITY;
        }
        0.5 * (ln_determinant(&self.factor) + self.whitened.norm_squared())
    }

    /// Returns `eᵀ Σ_z⁻¹ e`, or NaN if `Σ_z` is not positive definite.
    pub(crate) fn normalised_innovation_squared(&mut self, psi: &DVector<f64>) -> f64 {
        if self.factorise(psi) {
            self.whitened.norm_squared()
        } else {
            f64::NAN
        }
    }

    /// Returns `eᵀ Σ_z⁻¹ e` at the `ψ` of the last factorisation.
    pub(super) fn whitened_norm_squared(&self) -> f64 {
        self.whitened.norm_squared()
    }

    fn factorise(&mut self, psi: &DVector<f64>) -> bool {
        self.factor.copy_from(&self.known);
        for (pattern, level) in self.patterns.iter().zip(psi.iter()) {
            if *level <= 0.0 || level.is_nan() {
                return false;
            }
            for (entry, weight) in self.factor.iter_mut().zip(pattern.iter()) {
                *entry += level * weight;
            }
        }
        if cholesky_mut(&mut self.factor).is_err() {
            return false;
        }
        self.whitened.copy_from(&self.innovation);
        solve_lower_mut(&self.factor, self.whitened.as_mut_slice());
        true
    }

    /// Computes gradient, observed Hessian and expected information of the likelihood part at
    /// `psi`.
    ///
    /// With `W = Σ_z⁻¹`:
    ///
    /// - gradient: `∂J/∂ψ_l = ½ tr(WU_l) − ½ eᵀWU_lWe`
    /// - observed Hessian: `∂²J/∂ψ_l∂ψ_m = −½ tr(WU_lWU_m) + eᵀWU_lWU_mWe`
    /// - expected information: `½ tr(WU_lWU_m)`
    ///
    /// These are the exact forms of the differences (3.34) to (3.38). Returns `false` if `Σ_z` is
    /// not positive definite.
    pub(crate) fn differentiate(&mut self, psi: &DVector<f64>) -> bool {
        if !self.factorise(psi) {
            return false;
        }
        let count = self.patterns.len();
        for l in 0..count {
            let whitened = &mut self.whitened_patterns[l];
            whitened.copy_from(&self.patterns[l]);
            // U L⁻ᵀ, because U is symmetric.
            solve_lower_of_rows_mut(self.arch, &self.factor, whitened.as_mut_slice());
            whitened.transpose_mut();
            // L⁻¹ U L⁻ᵀ = V
            solve_lower_of_rows_mut(self.arch, &self.factor, whitened.as_mut_slice());
            self.pattern_innovations[l].gemv(1.0, whitened, &self.whitened, 0.0);
            let trace = whitened.trace();
            let quadratic = self.whitened.dot(&self.pattern_innovations[l]);
            self.gradient[l] = 0.5 * (trace - quadratic);
        }
        for l in 0..count {
            for m in 0..=l {
                let trace = self.whitened_patterns[l].dot(&self.whitened_patterns[m]);
                let quadratic = self.pattern_innovations[l].dot(&self.pattern_innovations[m]);
                for (row, column) in [(l, m), (m, l)] {
                    self.expected[(row, column)] = 0.5 * trace;
                    self.observed[(row, column)] = quadratic - 0.5 * trace;
                }
            }
        }
        true
    }
}

fn clear_channel_mut(matrix: &mut DMatrix<f64>, channel: usize, diagonal: f64) {
    matrix.row_mut(channel).fill(0.0);
    matrix.column_mut(channel).fill(0.0);
    matrix[(channel, channel)] = diagonal;
}
