//! Records of Bouc–Wen chains: the true motion by Runge–Kutta steps with constant excitation within
//! a step.

use crate::error::ValidateError;
use crate::run::Run;
use crate::statistics::Normal;
use crate::systems::bouc_wen::{BoucWenChain, BoucWenModel, SHAPE_PARAMETERS};
use spandrel_filter::ProcessModel;

/// Simulation settings and changes of a chain over time.
pub(crate) struct Events<'e> {
    pub(crate) step_s: f64,
    pub(crate) seconds: f64,
    /// Number of Runge–Kutta steps in each time step.
    pub(crate) substeps: u32,
    /// Standard deviation of the ground acceleration at a time.
    pub(crate) ground_std: &'e dyn Fn(f64) -> f64,
    /// Stiffness factor of each group at a time.
    pub(crate) stiffness: &'e dyn Fn(f64) -> Vec<f64>,
}

/// True motion at the times of the data.
pub(crate) struct Motion {
    /// State `[ẋ, r]` at each step (2 N_d).
    pub(crate) states: Vec<Vec<f64>>,
    /// Time step (s). The first state is one step after rest.
    pub(crate) step_s: f64,
}

impl Motion {
    pub(crate) fn simulate(
        chain: &BoucWenChain,
        events: &Events<'_>,
        run: &Run<'_>,
    ) -> Result<Self, ValidateError> {
        let masses = chain.masses_kg.len();
        let mut model =
            BoucWenModel::new(chain.clone()).ok_or(ValidateError::Example { what: "chain" })?;
        let n = model.state_len();
        let mut y = vec![1.0; n];
        y[..2 * masses].fill(0.0);
        let mut ground = Normal::stream(run.seed, 0);
        let steps = (events.seconds / events.step_s).round() as usize;
        let mut states = Vec::with_capacity(steps);
        let mut slopes = vec![vec![0.0; n]; 4];
        let mut at = vec![0.0; n];
        let h = events.step_s / f64::from(events.substeps);
        for step in 0..steps {
            let time_s = step as f64 * events.step_s;
            y[2 * masses..n - SHAPE_PARAMETERS].copy_from_slice(&(events.stiffness)(time_s));
            let f = [(events.ground_std)(time_s) * ground.draw()];
            for _ in 0..events.substeps {
                for stage in 0..4_usize {
                    at.copy_from_slice(&y);
                    if let Some(before) = stage.checked_sub(1) {
                        let by = if stage == 3 { h } else { 0.5 * h };
                        at.iter_mut()
                            .zip(&slopes[before])
                            .for_each(|(at, slope)| *at += by * slope);
                    }
                    model.linearise_process(&at, &f);
                    model.derivative(&mut slopes[stage]);
                }
                for i in 0..n {
                    y[i] += h / 6.0
                        * (slopes[0][i] + 2.0 * slopes[1][i] + 2.0 * slopes[2][i] + slopes[3][i]);
                }
            }
            states.push(y[..2 * masses].to_vec());
            if step % 5000 == 0 && !run.advance(0.0) {
                return Err(ValidateError::Stopped);
            }
        }
        Ok(Self {
            states,
            step_s: events.step_s,
        })
    }

    /// Returns the time of a step (s).
    pub(crate) fn time_s(&self, step: usize) -> f64 {
        (step + 1) as f64 * self.step_s
    }
}

/// Returns the force of spring `j` over its nominal stiffness (m), from the chain's own matrix.
pub(crate) fn spring_force(theta: f64, r: &[f64], j: usize) -> f64 {
    theta * (r[j] - if j > 0 { r[j - 1] } else { 0.0 })
}
