//! Scratch space of a filter, allocated once.

use super::Frame;
use super::propagator::Propagator;
use super::settings::FilterSettings;
use crate::dense::scale_symmetric_mut;
use crate::error::FilterError;
use crate::misfit;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::Objective;
use crate::product::{Multiplier, Right};
use crate::update;
use nalgebra::{DMatrix, DVector};

#[derive(Debug, Clone)]
pub(super) struct Workspace {
    pub(super) update: update::Workspace,
    pub(super) objective: Objective,
    pub(super) propagator: Propagator,
    /// `P` (n × n), without the contribution of the unknown excitation of the step; then
    /// `(I − GH) P`.
    pub(super) covariance: DMatrix<f64>,
    /// Predicted `y` (n).
    pub(super) mean: DVector<f64>,
    /// `[Γg, B]` (n × (1 + N_f))
    pub(super) inputs: DMatrix<f64>,
    /// `B` (n × N_f), constant for a constant model.
    pub(super) input_matrix: DMatrix<f64>,
    /// `H P` (N_0 × n), for models that do not provide `H`.
    pub(super) h_p: DMatrix<f64>,
    /// `P Hᵀ`, then `Vᵀ` (n × N_0)
    pub(super) p_ht: DMatrix<f64>,
    /// `Hᵀ` (n × N_0), for models that provide it.
    pub(super) h_t: DMatrix<f64>,
    pub(super) by_h_t: Right,
    /// `H B` (N_0 × N_f)
    pub(super) h_b: DMatrix<f64>,
    /// `λ B Σ_f` (n × N_f)
    pub(super) input_spread: DMatrix<f64>,
    /// `A C` (n × N_f)
    pub(super) cross: DMatrix<f64>,
    /// `[A C, B]` (n × 2N_f), followed by its halves, swapped and transposed (2N_f × n).
    pub(super) pair: DMatrix<f64>,
    pub(super) swapped_pair: DMatrix<f64>,
    pub(super) by_pair: Right,
    pub(super) multiplier: Multiplier,
    /// Part of the covariance of the predicted datum that does not depend on `ψ` (N_0 × N_0).
    pub(super) frame_known: DMatrix<f64>,
    /// `Σ_f` of the coming step and of the frame (N_f × N_f), then `Σ_n` (N_0 × N_0).
    pub(super) step_excitation: DMatrix<f64>,
    pub(super) frame_excitation: DMatrix<f64>,
    pub(super) sensors: DMatrix<f64>,
    /// Known excitation (N_f) at the older and the newer frame. `predict` adds the posterior mean
    /// to `older`.
    pub(super) older: DVector<f64>,
    pub(super) newer: DVector<f64>,
    /// `false` if this step must not change the parameters.
    pub(super) teaches: bool,
    /// Reliability `κ` of the known excitation at this step (N_f), 1 without noise.
    pub(super) reliability: DVector<f64>,
    /// Variance of a measured excitation whose sample at the older frame is missing, 0 for all
    /// others (N_f).
    pub(super) missing: DVector<f64>,
    /// Average over the step by which the known excitation exceeds its straight line (N_f).
    pub(super) above_the_line: DVector<f64>,
    /// Change of the known excitation over the step (N_f).
    pub(super) newer_less_older: DVector<f64>,
    /// `B_y ḟ` (n)
    pub(super) ramp: DVector<f64>,
    /// Predicted datum (N_0).
    pub(super) predicted: DVector<f64>,
    /// Diagonal of `S` with the noise levels from before this step (N_0).
    pub(super) variances: DVector<f64>,
    /// Diagonal of `S − R` (N_0).
    pub(super) predicted_variances: DVector<f64>,
    pub(super) misfit: misfit::Workspace,
    /// Scratch space for sorted residuals.
    pub(super) sorted: Vec<f64>,
}

impl Workspace {
    /// Allocates the workspace of a model and computes the quantities of a constant model.
    pub(super) fn new(
        model: &(impl ProcessModel + ObservationModel),
        settings: &FilterSettings,
    ) -> Result<Self, FilterError> {
        let (n, channels, inputs) = (
            model.state_len(),
            model.observation_len(),
            model.excitation_len(),
        );
        let propagator = Propagator::new(model, settings.step_s, &settings.noise)?;
        let (input_matrix, h_b) = match propagator.time_invariant() {
            Some(constant) => (
                constant.transition.held_input().clone(),
                constant.h_b.clone(),
            ),
            None => (DMatrix::zeros(n, inputs), DMatrix::zeros(channels, inputs)),
        };
        Ok(Self {
            propagator,
            update: update::Workspace::new(n, channels, inputs, settings.covariance_form),
            objective: Objective::new(channels, settings.noise.parameters.len())
                .with_inputs(inputs),
            covariance: DMatrix::zeros(n, n),
            mean: DVector::zeros(n),
            inputs: DMatrix::zeros(n, 1 + inputs),
            input_matrix,
            h_p: DMatrix::zeros(channels, n),
            p_ht: DMatrix::zeros(n, channels),
            h_t: DMatrix::zeros(n, channels),
            by_h_t: Right::new(n, channels, n.div_ceil(2)),
            h_b,
            input_spread: DMatrix::zeros(n, inputs),
            cross: DMatrix::zeros(n, inputs),
            pair: DMatrix::zeros(n, 2 * inputs),
            swapped_pair: DMatrix::zeros(2 * inputs, n),
            by_pair: Right::new(2 * inputs, n, 1),
            multiplier: Multiplier::new(),
            frame_known: DMatrix::zeros(channels, channels),
            step_excitation: DMatrix::zeros(inputs, inputs),
            frame_excitation: DMatrix::zeros(inputs, inputs),
            sensors: DMatrix::zeros(channels, channels),
            older: DVector::zeros(inputs),
            newer: DVector::zeros(inputs),
            teaches: true,
            reliability: DVector::repeat(inputs, 1.0),
            missing: DVector::zeros(inputs),
            above_the_line: DVector::zeros(inputs),
            newer_less_older: DVector::zeros(inputs),
            ramp: DVector::zeros(n),
            predicted: DVector::zeros(channels),
            variances: DVector::zeros(channels),
            predicted_variances: DVector::zeros(channels),
            misfit: misfit::Workspace::new(model.parameter_len()),
            sorted: Vec::with_capacity(
                settings
                    .outliers
                    .map_or(0, |outliers| outliers.recent_len()),
            ),
        })
    }

    /// Writes `K^½ Σ_f K^½` with `K = diag(κ)` to `Σ_f` of the coming step and of the frame.
    ///
    /// This is the variance that remains of an excitation after its sensor has measured it.
    pub(super) fn apply_reliability(&mut self) {
        let Self {
            reliability,
            step_excitation,
            frame_excitation,
            ..
        } = self;
        for covariance in [step_excitation, frame_excitation] {
            scale_symmetric_mut(covariance, reliability.as_slice());
        }
    }

    /// Adds the variance of missing samples to `Σ_f` of the coming step and of the frame.
    ///
    /// A missing sample of a measured excitation has the mean square of that excitation as its
    /// variance.
    pub(super) fn add_missing_excitation(&mut self, frame: Frame<'_>, mean_square: &DVector<f64>) {
        for j in 0..self.older.len() {
            self.step_excitation[(j, j)] += self.missing[j];
            if frame.excitation[j].is_nan() {
                self.frame_excitation[(j, j)] += mean_square[j];
            }
        }
    }
}
