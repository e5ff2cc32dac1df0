//! A hysteretic oscillator with drifting parameters (Ching et al. 2006, example 2), and its data.

use super::{Normal, rms};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{ContinuousSystem, Drifting, FilterError, IncrementTime};

/// Length of the state: x (m), ẋ (m/s), r (N), θ₁ to θ₄, h (m/s²). The mass is 1 kg.
pub(crate) const STATE: usize = 8;
pub(crate) const STEP_S: f64 = 0.5;
const INITIAL: [f64; 4] = [6.0, 0.9, -0.08, 1.0];
/// Ranges of the actual parameters, from the figure of the source.
const RANGES: [(f64, f64); 4] = [(4.0, 7.5), (0.5, 1.3), (-0.14, -0.02), (0.6, 1.4)];
/// Drift per step as a share of the initial value.
const DRIFT: f64 = 0.02;

#[derive(Debug, Clone, Default)]
pub(crate) struct Oscillator;

impl ContinuousSystem for Oscillator {
    fn mechanical_len(&self) -> usize {
        3
    }
    fn drifting_len(&self) -> usize {
        5
    }
    fn input_len(&self) -> usize {
        1
    }
    fn observation_len(&self) -> usize {
        1
    }
    fn derivative(&self, state: &[f64], input: &[f64], out: &mut [f64]) {
        let (velocity, force) = (state[1], state[2]);
        let strength = force.abs().powf(state[6]);
        out[0] = velocity;
        out[1] = input[0] - force;
        // |r|^(θ₄−1) r written as sign(r) |r|^θ₄ avoids a negative power of zero.
        out[2] = state[3] * velocity
            - state[4] * velocity.abs() * force.signum() * strength
            - state[5] * velocity * strength;
    }
    fn output(&self, state: &[f64], input: &[f64], out: &mut [f64]) {
        out[0] = input[0] - state[2];
    }
    fn noise_std(&self, state: &[f64], out: &mut [f64]) {
        out[0] = state[7];
    }
}

/// A simulated record. The k-th input acts from the k-th time to the next one.
pub(crate) struct Record {
    pub(crate) input: Vec<f64>,
    pub(crate) truth: Vec<[f64; STATE]>,
    pub(crate) data: Vec<f64>,
    pub(crate) noise_std: f64,
}

impl Record {
    pub(crate) fn simulate(seed: u64, steps: usize) -> Self {
        let mut normal = Normal::seeded(seed);
        let parameters: Vec<[f64; 4]> = loop {
            let mut value = INITIAL;
            let path: Vec<[f64; 4]> = (0..=steps)
                .map(|k| {
                    if k > 0 {
                        value = std::array::from_fn(|j| {
                            value[j] + DRIFT * INITIAL[j].abs() * normal.draw()
                        });
                    }
                    value
                })
                .collect();
            let inside =
                |value: &[f64; 4]| (0..4).all(|j| value[j] > RANGES[j].0 && value[j] < RANGES[j].1);
            if path.iter().all(inside) {
                break path;
            }
        };
        let input: Vec<f64> = (0..=steps).map(|_| 2.0 * normal.draw()).collect();
        let mut state = [0.0; STATE];
        let mut truth = Vec::with_capacity(steps + 1);
        for k in 0..=steps {
            state[3..7].copy_from_slice(&parameters[k]);
            if k > 0 {
                super::integrate(&Oscillator, &mut state, &[input[k - 1]], STEP_S, 50);
            }
            truth.push(state);
        }
        let clean = |k: usize, state: &[f64; STATE]| input[k] - state[2];
        let noise_std = 0.1 * rms(truth.iter().enumerate().map(|(k, state)| clean(k, state)));
        for state in &mut truth {
            state[7] = noise_std;
        }
        let data = truth
            .iter()
            .enumerate()
            .map(|(k, state)| clean(k, state) + noise_std * normal.draw())
            .collect();
        Self {
            input,
            truth,
            data,
            noise_std,
        }
    }

    fn initial(&self) -> [f64; 5] {
        std::array::from_fn(|j| if j < 4 { INITIAL[j] } else { self.noise_std })
    }

    /// Returns the model of the filter. Its noise level drifts too, although the true one is
    /// constant.
    pub(crate) fn model(&self) -> Result<Drifting<Oscillator>, FilterError> {
        let initial = self.initial();
        let drift = initial.iter().map(|value| DRIFT * value.abs()).collect();
        // The restoring force is meaningless with an exponent below 0.05. θ₃ may have either sign.
        let lower = vec![
            0.02 * initial[0],
            0.02 * initial[1],
            f64::NEG_INFINITY,
            0.05,
            0.02 * initial[4],
        ];
        Drifting::new(Oscillator, STEP_S, 10, IncrementTime::Start, drift, lower)
    }

    /// Returns the mean and covariance of the prior, with deviations of 1 for the motion, 20 % for
    /// the parameters and 50 % for the noise level.
    pub(crate) fn prior(&self) -> (DVector<f64>, DMatrix<f64>) {
        let initial = self.initial();
        let mean = DVector::from_fn(STATE, |j, _| if j < 3 { 0.0 } else { initial[j - 3] });
        let std = DVector::from_fn(STATE, |j, _| match j {
            0..3 => 1.0,
            3..7 => 0.2 * mean[j].abs(),
            _ => 0.5 * mean[j],
        });
        (mean, DMatrix::from_diagonal(&std.map(|std| std * std)))
    }
}
