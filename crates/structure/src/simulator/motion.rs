//! Motion of a simulated structure from one frame to the next, and its observation by the sensors.

use crate::linear_form::{LinearForm, Recursion};
use crate::model::StructureModel;
use crate::ritz_basis::RitzBasis;
use crate::structure::Structure;
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{InputHold, ObservationModel, ProcessModel};

/// Maximum product of a substep and the fastest rate at rest, for hysteretic springs.
///
/// The error of a Runge-Kutta step is then below 10⁻⁷ of the state, far below any noise.
const RATE_TIMES_SUBSTEP: f64 = 0.1;

/// Amplitude of the motion, which determines the treatment of hysteretic springs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Amplitude {
    /// The springs follow their law.
    Any,
    /// The springs are linear, as for small motions. A large model moves in few shapes, as in the
    /// analysis of its sensors.
    Small,
}

/// A structure in motion.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    model: StructureModel,
    /// Shapes of the motion; `None` if every degree of freedom moves by itself.
    basis: Option<RitzBasis>,
    step_s: f64,
    /// Hold of each excitation component between frames.
    holds: Vec<InputHold>,
    rule: Rule,
    /// `u` (2 N_d).
    state: DVector<f64>,
    next_state: DVector<f64>,
}

#[derive(Debug, Clone)]
enum Rule {
    /// The exact recursion of a linear structure, `z = H u + D f`.
    Exact {
        recursion: Recursion,
        observation: DMatrix<f64>,
        direct: DMatrix<f64>,
    },
    /// The fourth-order Runge-Kutta method.
    RungeKutta(Stages),
}

/// Workspace of the Runge-Kutta method; `point` is a state with its parameters.
#[derive(Debug, Clone)]
struct Stages {
    theta: Vec<f64>,
    substeps: usize,
    point: Vec<f64>,
    slope: Vec<f64>,
    sum: DVector<f64>,
    excitation: Vec<f64>,
}

impl Motion {
    /// Starts with parameters `theta` (ratios to nominal), at rest, or in equilibrium with the mean
    /// forces.
    pub(super) fn new(structure: &Structure, theta: &[f64], amplitude: Amplitude) -> Self {
        let mut model = structure.model();
        let (step_s, holds) = (structure.step_s(), structure.input_holds());
        let basis = match amplitude {
            Amplitude::Any => None,
            Amplitude::Small => structure.analysis_basis().cloned(),
        };
        let rule = if model.is_hysteretic() && amplitude == Amplitude::Any {
            Rule::RungeKutta(Stages::new(&mut model, theta, step_s))
        } else {
            exact(&mut model, theta, step_s, &holds, basis.as_ref())
        };
        let state = match (amplitude, &basis) {
            (Amplitude::Any, _) => structure.static_state(theta),
            (Amplitude::Small, None) => DVector::zeros(2 * structure.system.len()),
            (Amplitude::Small, Some(basis)) => DVector::zeros(2 * basis.shapes.ncols()),
        };
        Self {
            model,
            basis,
            step_s,
            holds,
            rule,
            next_state: state.clone(),
            state,
        }
    }

    /// Returns `u` (2 N_d).
    pub(super) fn state(&self) -> &[f64] {
        self.state.as_slice()
    }

    /// Sets the parameters for the following steps.
    pub(super) fn set_parameters(&mut self, theta: &[f64]) {
        match &mut self.rule {
            Rule::Exact { .. } => {
                let basis = self.basis.as_ref();
                self.rule = exact(&mut self.model, theta, self.step_s, &self.holds, basis)
            }
            Rule::RungeKutta(stages) => stages.theta.copy_from_slice(theta),
        }
    }

    /// Writes `z` (N_0) at this frame under `excitation` (N_f).
    pub(super) fn respond(&mut self, excitation: &DVector<f64>, response: &mut DVector<f64>) {
        match &mut self.rule {
            Rule::Exact {
                observation,
                direct,
                ..
            } => {
                response.gemv(1.0, observation, &self.state, 0.0); // z = H u + D f
                response.gemv(1.0, direct, excitation, 1.0);
            }
            Rule::RungeKutta(stages) => {
                stages.set_point(&self.state, 0.0);
                self.model
                    .linearise_observation(&stages.point, excitation.as_slice());
                self.model.observe(response.as_mut_slice());
            }
        }
    }

    /// Advances by one step, from `excitation` to `next` (N_f).
    pub(super) fn advance(&mut self, excitation: &DVector<f64>, next: &DVector<f64>) {
        match &mut self.rule {
            Rule::Exact {
                recursion:
                    Recursion {
                        transition,
                        input,
                        slope,
                    },
                ..
            } => {
                self.next_state.gemv(1.0, transition, &self.state, 0.0); // A u (2.7)
                self.next_state.gemv(1.0, input, excitation, 1.0); // + B f_i
                if self.holds.contains(&InputHold::First) {
                    self.next_state.gemv(1.0, slope, next, 1.0); // + B₁ (f_{i+1} − f_i)
                    self.next_state.gemv(-1.0, slope, excitation, 1.0);
                }
                std::mem::swap(&mut self.state, &mut self.next_state);
            }
            Rule::RungeKutta(stages) => {
                let mut to = excitation.clone();
                for (input, _) in self
                    .holds
                    .iter()
                    .enumerate()
                    .filter(|(_, hold)| **hold == InputHold::First)
                {
                    to[input] = next[input];
                }
                for substep in 0..stages.substeps {
                    stages.advance(
                        &mut self.model,
                        &mut self.state,
                        self.step_s,
                        substep,
                        [excitation, &to],
                    );
                }
            }
        }
    }
}

fn exact(
    model: &mut StructureModel,
    theta: &[f64],
    step_s: f64,
    holds: &[InputHold],
    basis: Option<&RitzBasis>,
) -> Rule {
    let form = LinearForm::moving_in(model, theta, basis);
    Rule::Exact {
        recursion: form.recursion(step_s, holds),
        observation: form.observation,
        direct: form.direct,
    }
}

impl Stages {
    fn new(model: &mut StructureModel, theta: &[f64], step_s: f64) -> Self {
        let (len, inputs) = (model.state_len(), model.excitation_len());
        let physical = len - model.parameter_len();
        let mut point = vec![0.0; len];
        point[physical..].copy_from_slice(theta);
        let excitation = vec![0.0; inputs];
        model.linearise_process(&point, &excitation);
        let substeps = (model.rate_bound() * step_s / RATE_TIMES_SUBSTEP)
            .ceil()
            .clamp(1.0, 1e4) as usize;
        let (slope, sum) = (vec![0.0; len], DVector::zeros(physical));
        Self {
            theta: theta.to_vec(),
            substeps,
            point,
            slope,
            sum,
            excitation,
        }
    }

    /// Sets the point to `state` plus `by` (s) times the last slope.
    fn set_point(&mut self, state: &DVector<f64>, by: f64) {
        let physical = state.len();
        for ((entry, u), slope) in self.point.iter_mut().zip(state).zip(&self.slope) {
            *entry = u + by * slope;
        }
        self.point[physical..].copy_from_slice(&self.theta);
    }

    /// Advances `state` by one substep of a step with linear excitation.
    fn advance(
        &mut self,
        model: &mut StructureModel,
        state: &mut DVector<f64>,
        step_s: f64,
        substep: usize,
        [from, to]: [&DVector<f64>; 2],
    ) {
        let h = step_s / self.substeps as f64;
        self.sum.fill(0.0);
        // Offset and weight of each stage.
        for (ahead, weight) in [(0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)] {
            self.set_point(state, ahead * h);
            let progress = (substep as f64 + ahead) / self.substeps as f64;
            for ((entry, from), to) in self.excitation.iter_mut().zip(from).zip(to) {
                *entry = from + progress * (to - from);
            }
            model.linearise_process(&self.point, &self.excitation);
            model.derivative(&mut self.slope);
            for (sum, slope) in self.sum.iter_mut().zip(&self.slope) {
                *sum += weight * slope;
            }
        }
        state.axpy(h / 6.0, &self.sum, 1.0);
    }
}
