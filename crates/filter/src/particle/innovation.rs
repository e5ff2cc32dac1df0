//! The innovation of a particle filter: how far a frame lies from what the particles predict of it.
//!
//! Each particle predicts `y^i = h(f(x^i, u, w), u)` with `w` from its prior. With the weights before the frame the mean of
//! the frame is `ȳ = Σ W^i y^i`, and its covariance `S = R + Σ W^i (y^i − ȳ)(y^i − ȳ)ᵀ`. The innovation is `ν = ŷ − ȳ`, and
//! `νᵀ S⁻¹ ν` scatters around the number of channels while the particles follow the data. When they have lost the state,
//! their predictions agree with one another and not with the frame, and it grows without limit.

use crate::dense::{cholesky_mut, solve_lower_mut};
use nalgebra::{DMatrix, DVector};

/// Predictions of all particles for one frame, and what follows from them.
#[derive(Debug, Clone)]
pub(super) struct Innovation {
    /// y (q × N), and a number for each particle where there is no channel
    pub(super) predicted: Vec<f64>,
    /// W before the frame (N)
    weights: Vec<f64>,
    /// ν, NaN where a channel is missing (q)
    values: DVector<f64>,
    /// S, then its factor (q × q)
    covariance: DMatrix<f64>,
    /// ν of the channels that are there, 0 for the others (q)
    whitened: DVector<f64>,
    /// νᵀ S⁻¹ ν
    squared: f64,
}

impl Innovation {
    pub(super) fn new(channels: usize, particles: usize) -> Self {
        Self {
            predicted: vec![f64::NAN; channels.max(1) * particles],
            weights: vec![0.0; particles],
            values: DVector::repeat(channels, f64::NAN),
            covariance: DMatrix::zeros(channels, channels),
            whitened: DVector::zeros(channels),
            squared: 0.0,
        }
    }

    /// Returns `ν` (q, sensor units), NaN where a channel was missing.
    pub(super) fn values(&self) -> &[f64] {
        self.values.as_slice()
    }

    /// Returns `νᵀ S⁻¹ ν`; 0 without a channel.
    pub(super) fn squared(&self) -> f64 {
        self.squared
    }

    /// Takes the logarithms of the weights before the frame, and forgets the predictions of the frame before.
    pub(super) fn begin(&mut self, log_weights: &[f64]) {
        self.predicted.fill(f64::NAN);
        for (weight, value) in self.weights.iter_mut().zip(log_weights) {
            *weight = value.exp();
        }
    }

    /// Compares the frame `datum` (q, NaN where missing) with the predictions; `covariance_of_sensors` writes `R` (q × q).
    ///
    /// A particle whose prediction is not finite does not count.
    pub(super) fn compare(
        &mut self,
        datum: &[f64],
        covariance_of_sensors: impl FnOnce(&mut DMatrix<f64>),
    ) {
        let Self {
            predicted,
            weights,
            values,
            covariance,
            whitened,
            squared,
        } = self;
        let q = datum.len();
        *squared = 0.0;
        values.fill(f64::NAN);
        if q == 0 {
            return;
        }
        let finite = |row: &[f64]| row.iter().all(|value| value.is_finite());
        whitened.fill(0.0);
        let mut total = 0.0;
        for (row, weight) in predicted
            .chunks_exact(q)
            .zip(weights.iter())
            .filter(|(row, _)| finite(row))
        {
            total += weight;
            whitened
                .iter_mut()
                .zip(row)
                .for_each(|(sum, value)| *sum += weight * value);
        }
        if total.is_nan() || total <= 0.0 {
            return; // no particle is left, which the weights say too
        }
        *whitened /= total; // ȳ
        covariance_of_sensors(covariance);
        for (row, weight) in predicted
            .chunks_exact(q)
            .zip(weights.iter())
            .filter(|(row, _)| finite(row))
        {
            for b in 0..q {
                let right = weight / total * (row[b] - whitened[b]);
                for a in 0..q {
                    covariance[(a, b)] += (row[a] - whitened[a]) * right; // S = R + Σ W (y − ȳ)(y − ȳ)ᵀ
                }
            }
        }
        for (j, value) in datum.iter().enumerate() {
            if value.is_nan() {
                covariance.row_mut(j).fill(0.0);
                covariance.column_mut(j).fill(0.0);
                covariance[(j, j)] = 1.0;
                whitened[j] = 0.0;
            } else {
                values[j] = value - whitened[j]; // ν
                whitened[j] = values[j];
            }
        }
        if cholesky_mut(covariance).is_ok() {
            solve_lower_mut(covariance, whitened.as_mut_slice());
            *squared = whitened.norm_squared();
        }
    }
}
