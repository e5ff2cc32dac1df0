//! The three ways to move mean and covariance over a time step.

use crate::constant::ConstantPath;
use crate::dense::symmetrise_mut;
use crate::discretise::{self, Series};
use crate::error::FilterError;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::{ExcitationPath, NoiseModel};
use crate::proportional;
use nalgebra::DMatrix;

use super::state::StepExcitation;

/// The transition over a time step, with its scratch space. The model determines the form.
#[derive(Debug, Clone)]
pub(super) enum Propagator {
    /// The model is linear and time-invariant. Its transition was computed once.
    TimeInvariant(Box<ConstantPath>),
    /// The model is a linear structure with proportional damping. Its transition follows from
    /// polynomials of the stiffness at every step.
    ProportionalDamping(Box<proportional::Transition>),
    /// Any other model: Taylor series of the Jacobian as an operator, at every step.
    TaylorSeries(Box<TaylorSeries>),
}

/// The series of the last discretised step, with its scratch space.
#[derive(Debug, Clone)]
pub(super) struct TaylorSeries {
    series: Series,
    scratch: discretise::Workspace,
}

impl Propagator {
    /// Selects the cheapest form that the model allows and allocates its scratch space.
    ///
    /// # Errors
    /// Returns an error if the constant transition does not fit the model.
    pub(super) fn new(
        model: &(impl ProcessModel + ObservationModel),
        step_s: f64,
        noise: &NoiseModel,
    ) -> Result<Self, FilterError> {
        let (n, inputs) = (model.state_len(), model.excitation_len());
        if let Some(transition) = model.constant_transition(step_s) {
            transition.check(n, inputs)?;
            let path = ConstantPath::new(transition, model, noise);
            return Ok(Self::TimeInvariant(Box::new(path)));
        }
        Ok(match model.proportional_form() {
            Some(form) => Self::ProportionalDamping(Box::new(proportional::Transition::new(&form))),
            None => Self::TaylorSeries(Box::new(TaylorSeries {
                series: Series::choose(0.0, step_s),
                scratch: discretise::Workspace::new(n, inputs),
            })),
        })
    }

    /// Returns the parts of a time-invariant model that were computed once.
    pub(super) fn time_invariant(&self) -> Option<&ConstantPath> {
        match self {
            Self::TimeInvariant(constant) => Some(constant),
            Self::ProportionalDamping(_) | Self::TaylorSeries(_) => None,
        }
    }

    /// Discretises a step of `step_s` (s) at the linearisation point and integrates the inputs. The
    /// other methods then refer to this step.
    ///
    /// It replaces `[g, B_y]` in `inputs` (n × (1 + N_f)) by `[Γ g + Γ₂ ramp, Γ B_y]`, as
    /// [`discretise::integrate_inputs`] does. A time-invariant model needs no such step.
    pub(super) fn discretise(
        &mut self,
        model: &impl ProcessModel,
        step_s: f64,
        inputs: &mut DMatrix<f64>,
        ramp: Option<&[f64]>,
    ) {
        let rate_bound = model.rate_bound();
        match self {
            Self::TimeInvariant(_) => {}
            Self::ProportionalDamping(transition) => {
                let form = model.proportional_form();
                debug_assert!(form.is_some(), "a model has the form always or never");
                if let Some(form) = form {
                    transition.discretise(&form, step_s, rate_bound, inputs, ramp);
                }
            }
            Self::TaylorSeries(taylor) => {
                let TaylorSeries { series, scratch } = taylor.as_mut();
                *series = Series::choose(rate_bound, step_s);
                discretise::integrate_inputs(model, step_s, *series, inputs, ramp, scratch);
            }
        }
    }

    /// Writes `λ A_i Σ A_iᵀ` (n × n) into `out`, exactly symmetric, equation (2.61) without process
    /// noise.
    pub(super) fn propagate_covariance_to(
        &mut self,
        model: &impl ProcessModel,
        step_s: f64,
        fading: f64,
        covariance: &DMatrix<f64>,
        out: &mut DMatrix<f64>,
    ) {
        match self {
            Self::TimeInvariant(constant) => {
                constant.propagate_covariance_to(covariance, fading, out);
            }
            Self::ProportionalDamping(transition) => {
                transition.propagate_covariance_to(covariance, fading, out);
            }
            Self::TaylorSeries(taylor) => {
                let TaylorSeries { series, scratch } = taylor.as_mut();
                discretise::propagate_covariance(model, step_s, *series, covariance, out, scratch);
                *out *= fading;
                symmetrise_mut(out);
            }
        }
    }

    /// Replaces a narrow `X` (n × N_f) by `A_i X`.
    pub(super) fn mul_mut(&mut self, model: &impl ProcessModel, step_s: f64, x: &mut DMatrix<f64>) {
        match self {
            Self::TimeInvariant(constant) => {
                let ConstantPath {
                    transition, column, ..
                } = constant.as_mut();
                transition.mul_mut(x, column);
            }
            Self::ProportionalDamping(transition) => transition.mul_mut(x),
            Self::TaylorSeries(taylor) => {
                let TaylorSeries { series, scratch } = taylor.as_mut();
                discretise::transition_mul_narrow(model, step_s, *series, x, scratch);
            }
        }
    }

    /// Returns the path by which the noise of the excitation of the coming step reaches the datum.
    ///
    /// `h_b` is `H B` (N_0 × N_f) of a model that is not time-invariant. At the prior, its `B` is
    /// zero.
    pub(super) fn noise_path<'p>(
        &'p self,
        excitation: StepExcitation<'_>,
        h_b: &'p DMatrix<f64>,
    ) -> ExcitationPath<'p> {
        match (self, excitation) {
            (_, StepExcitation::Inferred(_))
            | (Self::TimeInvariant(_), StepExcitation::AtPrior) => ExcitationPath::Felt,
            (Self::TimeInvariant(constant), StepExcitation::WhiteNoise) => {
                ExcitationPath::Constant(constant)
            }
            (
                Self::ProportionalDamping(_) | Self::TaylorSeries(_),
                StepExcitation::AtPrior | StepExcitation::WhiteNoise,
            ) => ExcitationPath::Input(h_b),
        }
    }
}
