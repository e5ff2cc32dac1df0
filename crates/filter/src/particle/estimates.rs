//! Estimates from the weighted particles: moments, quantiles and the effective sample size.

use super::moments;
use super::{ParticleFilter, ParticleModel};
use nalgebra::{DMatrix, DVector};

impl<M: ParticleModel> ParticleFilter<M> {
    /// Returns the weighted mean of the state (n).
    pub fn mean(&self) -> &DVector<f64> {
        &self.mean
    }

    /// Returns the weighted standard deviation of the state (n).
    pub fn std(&self) -> &DVector<f64> {
        &self.std
    }

    /// Writes the weighted covariance of the state (n × n).
    pub fn covariance_to(&self, out: &mut DMatrix<f64>) {
        moments::covariance_to(&self.state.states, &self.weights, &self.mean, out);
    }

    /// Returns `E[r(x)] = Σ W^i r(x^i)` of any quantity of interest, such as a drift or a cost.
    pub fn expectation(&self, mut quantity: impl FnMut(&[f64]) -> f64) -> f64 {
        let particles = self
            .state
            .states
            .chunks_exact(self.mean.len())
            .zip(&self.weights);
        particles
            .filter(|(_, weight)| **weight > 0.0)
            .map(|(particle, weight)| weight * quantity(particle))
            .sum()
    }

    /// Returns the limits of the central credible interval of one component.
    ///
    /// `probability` is the probability of the interval: 0.95 returns the weighted 2.5 % and 97.5 %
    /// quantiles. Returns `None` if the component does not exist.
    pub fn credible_interval(&mut self, component: usize, probability: f64) -> Option<(f64, f64)> {
        let n = self.mean.len();
        if component >= n {
            return None;
        }
        let (order, weights) = (&mut self.order, &self.weights);
        let value = |i: u32| self.state.states[i as usize * n + component];
        for (i, entry) in order.iter_mut().enumerate() {
            *entry = i as u32;
        }
        order.sort_unstable_by(|a, b| value(*a).total_cmp(&value(*b)).then(a.cmp(b)));
        let outside = 0.5 * (1.0 - probability);
        let mut sum = 0.0;
        let mut lower = None;
        let mut upper = f64::NAN;
        for i in order.iter().copied().filter(|i| weights[*i as usize] > 0.0) {
            sum += weights[i as usize];
            upper = value(i);
            if sum >= outside {
                lower.get_or_insert(upper);
            }
            if sum >= 1.0 - outside {
                break;
            }
        }
        lower.map(|lower| (lower, upper))
    }

    /// Returns the particles with their normalised weights.
    pub fn particles(&self) -> impl Iterator<Item = (&[f64], f64)> {
        self.state
            .states
            .chunks_exact(self.mean.len())
            .zip(self.weights.iter().copied())
    }

    /// Returns `N_eff = 1/Σ W²`.
    pub fn effective_size(&self) -> f64 {
        1.0 / self
            .weights
            .iter()
            .map(|weight| weight * weight)
            .sum::<f64>()
    }

    /// Returns the standard deviation of the weights (divisor `N`) over their mean.
    pub fn coefficient_of_variation(&self) -> f64 {
        let count = self.weights.len() as f64;
        let mean = self.weights.iter().sum::<f64>() / count;
        let variance = self
            .weights
            .iter()
            .map(|weight| (weight - mean) * (weight - mean))
            .sum::<f64>()
            / count;
        variance.sqrt() / mean
    }

    /// Returns the number of initial particles that have descendants; 1 if all particles descend
    /// from one initial draw.
    pub fn surviving_ancestors(&mut self) -> usize {
        self.order.copy_from_slice(&self.state.ancestors);
        self.order.sort_unstable();
        1 + self
            .order
            .windows(2)
            .filter(|pair| pair[0] != pair[1])
            .count()
    }
}
