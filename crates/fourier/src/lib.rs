//! Fourier transforms of windows of samples, for spectra by Welch's method.
//!
//! The transform is generic, so each crate that plans one compiles all its algorithms. Only this
//! crate does.

use realfft::num_complex::Complex;
use realfft::{RealFftPlanner, RealToComplex};
use std::f64::consts::PI;
use std::fmt;
use std::sync::Arc;

/// The Fourier transform of windows of one length, weighted by a Hann window.
#[derive(Clone)]
pub struct HannTransform {
    plan: Arc<dyn RealToComplex<f64>>,
    /// Weight of each sample.
    weights: Vec<f64>,
}

impl HannTransform {
    /// Plans the transform of windows of `len` samples.
    #[must_use]
    pub fn new(len: usize) -> Self {
        let weight = |n: usize| 0.5 - 0.5 * (2.0 * PI * n as f64 / len as f64).cos();
        Self {
            plan: RealFftPlanner::new().plan_fft_forward(len),
            weights: (0..len).map(weight).collect(),
        }
    }

    /// Returns the number of samples of a window.
    #[must_use]
    pub fn window_len(&self) -> usize {
        self.weights.len()
    }

    /// Returns the sum of the squared weights, `L U` of Welch (1967), *IEEE Trans. Audio and
    /// Electroacoustics* 15, 70.
    #[must_use]
    pub fn power(&self) -> f64 {
        self.weights.iter().map(|weight| weight * weight).sum()
    }

    /// Returns the transform of the weighted deviations of `samples` from their mean, from
    /// frequency zero to half the sampling rate.
    ///
    /// # Panics
    /// Panics if there are more or fewer `samples` than a window has.
    pub fn transform(&self, samples: impl Iterator<Item = f64>) -> Vec<Complex<f64>> {
        let mut input: Vec<f64> = samples.collect();
        let mean = input.iter().sum::<f64>() / self.window_len() as f64;
        for (x, weight) in input.iter_mut().zip(&self.weights) {
            *x = weight * (*x - mean);
        }
        let mut output = self.plan.make_output_vec();
        let done = self.plan.process(&mut input, &mut output);
        assert!(done.is_ok(), "a window has {} samples", self.window_len());
        output
    }
}

impl fmt::Debug for HannTransform {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "HannTransform({})", self.window_len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sine_on_a_line_appears_there_and_on_its_neighbours() {
        let transform = HannTransform::new(64);
        let turn = |n: usize, line: f64| 2.0 * PI * line * n as f64 / 64.0;
        let samples = (0..64).map(|n| 5.0 + 3.0 * turn(n, 10.0).sin());
        let lines = transform.transform(samples);
        assert_eq!(lines.len(), 33);
        for (line, value) in lines.iter().enumerate() {
            // Half the amplitude times the sum of the weights, 32, and half of it beside
            let expected = match line {
                10 => 48.0,
                9 | 11 => 24.0,
                _ => 0.0,
            };
            assert!((value.norm() - expected).abs() < 1e-10, "{line}: {value}");
        }
        assert!(
            (transform.power() - 24.0).abs() < 1e-12,
            "3/8 of the length"
        );
    }

    #[test]
    #[should_panic(expected = "a window has 8 samples")]
    fn too_few_samples_panic() {
        HannTransform::new(8).transform([1.0; 7].into_iter());
    }

    #[test]
    #[should_panic(expected = "a window has 8 samples")]
    fn too_many_samples_panic() {
        HannTransform::new(8).transform([1.0; 9].into_iter());
    }
}
