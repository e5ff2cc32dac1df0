//! A linear shear building of four storeys with drifting properties (Ching et al. 2006, example 1),
//! and its data.

use super::{Normal, rms};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{ContinuousSystem, Drifting, FilterError, IncrementTime};

pub(crate) const STOREYS: usize = 4;
/// Length of the state: displacements (m), velocities (m/s), stiffness (MN/m), damping (kN·s/m),
/// noise levels (m/s²).
pub(crate) const STATE: usize = 5 * STOREYS;
pub(crate) const STIFFNESS: usize = 2 * STOREYS;
pub(crate) const DAMPING: usize = 3 * STOREYS;
pub(crate) const NOISE: usize = 4 * STOREYS;
pub(crate) const STEP_S: f64 = 0.02;
/// Mass of each storey (t).
const MASS: f64 = 250.0;
const INITIAL_STIFFNESS: f64 = 300.0;
const INITIAL_DAMPING: f64 = 600.0;
/// Drift per step as a share of the initial value.
const DRIFT: f64 = 0.02;

#[derive(Debug, Clone, Default)]
pub(crate) struct Building;

/// Writes the absolute accelerations (m/s²) that follow from the storey forces, from the base
/// upwards.
fn absolute_acceleration(state: &[f64], out: &mut [f64]) {
    let (x, rest) = state.split_at(STOREYS);
    let (v, rest) = rest.split_at(STOREYS);
    let mut above = 0.0;
    for i in (0..STOREYS).rev() {
        let (below_x, below_v) = if i > 0 {
            (x[i - 1], v[i - 1])
        } else {
            (0.0, 0.0)
        };
        // In kN: MN/m · m · 1000, kN·s/m · m/s.
        let force = 1000.0 * rest[i] * (x[i] - below_x) + rest[STOREYS + i] * (v[i] - below_v);
        out[i] = (above - force) / MASS;
        above = force;
    }
}

impl ContinuousSystem for Building {
    fn mechanical_len(&self) -> usize {
        2 * STOREYS
    }
    fn drifting_len(&self) -> usize {
        3 * STOREYS
    }
    fn input_len(&self) -> usize {
        1
    }
    fn observation_len(&self) -> usize {
        STOREYS
    }
    fn derivative(&self, state: &[f64], input: &[f64], out: &mut [f64]) {
        let (velocity, acceleration) = out.split_at_mut(STOREYS);
        velocity.copy_from_slice(&state[STOREYS..2 * STOREYS]);
        absolute_acceleration(state, acceleration);
        acceleration.iter_mut().for_each(|value| *value -= input[0]);
    }
    fn output(&self, state: &[f64], _: &[f64], out: &mut [f64]) {
        absolute_acceleration(state, out);
    }
    fn noise_std(&self, state: &[f64], out: &mut [f64]) {
        out.copy_from_slice(&state[NOISE..]);
    }
}

/// A simulated record. The k-th input acts from the k-th time to the next one.
pub(crate) struct Record {
    pub(crate) input: Vec<f64>,
    pub(crate) truth: Vec<[f64; STATE]>,
    pub(crate) data: Vec<[f64; STOREYS]>,
    pub(crate) noise_std: [f64; STOREYS],
}

impl Record {
    /// Simulates `steps` steps. The second storey loses half its stiffness between 8 and 10 s, and
    /// the other properties drift.
    pub(crate) fn simulate(seed: u64, steps: usize) -> Self {
        let mut normal = Normal::seeded(seed);
        let mut path = |initial: f64, low: f64, high: f64| loop {
            let mut value = initial;
            let path: Vec<f64> = (0..=steps)
                .map(|k| {
                    if k > 0 {
                        value += DRIFT * initial * normal.draw();
                    }
                    value
                })
                .collect();
            if path.iter().all(|value| (low..high).contains(value)) {
                return path;
            }
        };
        let mut parameters: Vec<Vec<f64>> = (0..STOREYS)
            .map(|_| path(INITIAL_STIFFNESS, 100.0, 600.0))
            .collect();
        parameters[1] = (0..=steps)
            .map(|k| {
                INITIAL_STIFFNESS * (1.0 - 0.5 * ((k as f64 * STEP_S - 8.0) / 2.0).clamp(0.0, 1.0))
            })
            .collect();
        parameters.extend((0..STOREYS).map(|_| path(INITIAL_DAMPING, 100.0, 1500.0)));
        let mut input: Vec<f64> = (0..=steps).map(|_| 2.0 * normal.draw()).collect();
        input[0] = 0.0;

        let mut state = [0.0; STATE];
        let mut truth = Vec::with_capacity(steps + 1);
        for k in 0..=steps {
            if k > 0 {
                super::integrate(&Building, &mut state, &[input[k - 1]], STEP_S, 8);
            }
            for (parameter, path) in state[STIFFNESS..].iter_mut().zip(&parameters) {
                *parameter = path[k];
            }
            truth.push(state);
        }
        let clean: Vec<[f64; STOREYS]> = truth
            .iter()
            .map(|state| {
                let mut out = [0.0; STOREYS];
                absolute_acceleration(state, &mut out);
                out
            })
            .collect();
        let noise_std: [f64; STOREYS] =
            std::array::from_fn(|j| 0.1 * rms(clean.iter().map(|y| y[j])));
        for state in &mut truth {
            state[NOISE..].copy_from_slice(&noise_std);
        }
        let data = clean
            .iter()
            .map(|y| std::array::from_fn(|j| y[j] + noise_std[j] * normal.draw()))
            .collect();
        Self {
            input,
            truth,
            data,
            noise_std,
        }
    }

    fn initial(&self) -> [f64; 3 * STOREYS] {
        std::array::from_fn(|j| match j / STOREYS {
            0 => INITIAL_STIFFNESS,
            1 => INITIAL_DAMPING,
            _ => self.noise_std[j - 2 * STOREYS],
        })
    }

    /// Returns the model of the filter: all properties drift by 2 % of their initial value per
    /// step, including those that are constant in truth.
    pub(crate) fn model(&self) -> Result<Drifting<Building>, FilterError> {
        let initial = self.initial();
        let drift = initial.iter().map(|value| DRIFT * value).collect();
        let lower = initial.iter().map(|value| 0.02 * value).collect();
        Drifting::new(Building, STEP_S, 4, IncrementTime::End, drift, lower)
    }

    /// Returns the mean and covariance of the prior, with deviations of 30 % (stiffness), 50 %
    /// (damping, noise) and the rms response.
    pub(crate) fn prior(&self) -> (DVector<f64>, DMatrix<f64>) {
        let initial = self.initial();
        let mean = DVector::from_fn(STATE, |j, _| {
            if j < STIFFNESS {
                0.0
            } else {
                initial[j - STIFFNESS]
            }
        });
        let std = DVector::from_fn(STATE, |j, _| match j / STOREYS {
            0 | 1 => rms(self.truth.iter().map(|state| state[j])),
            2 => 0.3 * mean[j],
            _ => 0.5 * mean[j],
        });
        (mean, DMatrix::from_diagonal(&std.map(|std| std * std)))
    }
}
