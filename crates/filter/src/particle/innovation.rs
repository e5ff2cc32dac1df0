//! The innovation of a particle filter: the difference between a frame and its prediction by the
//! particles.
//!
//! Each particle predicts `y^i = h(f(x^i, u, w), u)` with `w` from its prior. With the weights
//! before the frame, the predicted mean is `ȳ = Σ W^i y^i`. Its covariance is
//! `S = R + Σ W^i (y^i − ȳ)(y^i − ȳ)ᵀ`. The innovation is `ν = ŷ − ȳ`. While the particles follow
//! the data, `νᵀ S⁻¹ ν` varies around the number of channels. If the particles have diverged,
//! their predictions agree with each other but not with the frame. `νᵀ S⁻¹ ν` then grows without
//! limit.

use crate::dense::{cholesky_mut, solve_lower_mut};
use nalgebra::{DMatrix, DVector};

/// The predictions of all particles for one frame, and their statistics.
#[derive(Debug, Clone)]
pub(super) struct Innovation {
    /// y (q × N); one unused number per particle if there are no channels.
    pub(super) predicted: Vec<f64>,
    /// W before the frame (N).
    weights: Vec<f64>,
    /// ν, NaN for missing channels (q).
    values: DVector<f64>,
    /// S, then its factor (q × q).
    covariance: DMatrix<f64>,
    /// ν of the available channels, 0 for missing channels (q).
    whitened: DVector<f64>,
    /// νᵀ S⁻¹ ν.
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

    /// Returns `ν` (q, sensor units), NaN for missing channels.
    pub(super) fn values(&self) -> &[f64] {
        self.values.as_slice()
    }

    /// Returns `νᵀ S⁻¹ ν`; 0 without channels.
    pub(super) fn squared(&self) -> f64 {
        self.squared
    }

    /// Stores the weights before the frame, given as logarithms, and discards the previous
    /// predictions.
    pub(super) fn begin(&mut self, log_weights: &[f64]) {
        self.predicted.fill(f64::NAN);
        for (weight, value) in self.weights.iter_mut().zip(log_weights) {
            *weight = value.exp();
        }
    }

    /// Compares the frame `datum` (q, NaN where missing) with the predictions;
    /// `covariance_of_sensors` writes `R` (q × q).
    ///
    /// Particles with a non-finite prediction do not count.
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
            return; // no particle is left, as the weights also show
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
                    // S = R + Σ W (y − ȳ)(y − ȳ)ᵀ
                    covariance[(a, b)] += (row[a] - whitened[a]) * right;
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
