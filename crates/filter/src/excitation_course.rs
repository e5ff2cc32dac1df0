//! How a measured excitation runs between two frames.
//!
//! A straight line between samples cuts the crests of a smooth motion: at the frequency `ω` it leaves `1 − (ωΔt)²/12` of the
//! amplitude, which is 13 % too little at 10 Hz and 50 samples a second. On average over a step, a smooth motion exceeds the line
//! by `−Δt² f̈/12`; the second difference of the last three samples stands for `Δt² f̈`. (K. E. Atkinson, *An Introduction to
//! Numerical Analysis*, 2nd ed. 1989, §5.2: the corrected trapezoidal rule.)
//!
//! An excitation that is independent from sample to sample, as simulations draw it, has no curvature that its samples could tell. The
//! two are told apart by the mean square of the second differences over that of the first: 3 for independent samples, and below 1
//! for a motion of up to a fifth of the sampling rate.

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

/// Ratio of the mean squares up to which an excitation is smooth, and from which on it is not.
const SMOOTH: f64 = 2.0;
const ROUGH: f64 = 2.4;

/// Time constant of the mean squares, in samples. The ratio of independent samples is then 3.00 ± 0.05.
const MEMORY: f64 = 1000.0;

/// Samples before which nothing is concluded: up to then independent samples may look smooth.
const LEAST_SAMPLES: f64 = 200.0;

/// What past samples tell of the course of the known excitation (N_f each).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ExcitationCourse {
    /// the sample before the last, NaN where it was missing
    before_last: DVector<f64>,
    first_squares: DVector<f64>,
    second_squares: DVector<f64>,
    samples: DVector<f64>,
}

impl ExcitationCourse {
    pub(crate) fn new(inputs: usize) -> Self {
        let zeros = || DVector::zeros(inputs);
        Self { before_last: zeros(), first_squares: zeros(), second_squares: zeros(), samples: zeros() }
    }

    /// Returns the number of components; `None` where the lengths disagree, as in a damaged checkpoint.
    pub(crate) fn len(&self) -> Option<usize> {
        let Self { before_last, first_squares, second_squares, samples } = self;
        let count = before_last.len();
        [first_squares, second_squares, samples].iter().all(|all| all.len() == count).then_some(count)
    }

    /// Returns what component `j` is larger, on average over the step, than on the straight line from `last` to `next`.
    pub(crate) fn above_the_line(&self, j: usize, last: f64, next: f64) -> f64 {
        if self.samples[j] < LEAST_SAMPLES {
            return 0.0;
        }
        let bend = next - 2.0 * last + self.before_last[j];
        if bend.is_nan() {
            return 0.0;
        }
        let ratio = self.second_squares[j] / self.first_squares[j];
        let share = ((ROUGH - ratio) / (ROUGH - SMOOTH)).clamp(0.0, 1.0); // of a silent excitation NaN, times 0
        if share > 0.0 { -share * bend / 12.0 } else { 0.0 }
    }

    /// Takes the next sample of each component, NaN where it is missing, after `last`.
    pub(crate) fn take(&mut self, last: &DVector<f64>, next: &[f64]) {
        let fade = 1.0 - 1.0 / MEMORY;
        for (j, (last, next)) in last.iter().zip(next).enumerate() {
            let (first, second) = (next - last, next - 2.0 * last + self.before_last[j]);
            if !second.is_nan() {
                self.first_squares[j] = fade * self.first_squares[j] + first * first;
                self.second_squares[j] = fade * self.second_squares[j] + second * second;
                self.samples[j] = fade * self.samples[j] + 1.0;
            }
            self.before_last[j] = *last;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// Runs over samples, and returns the mean square of the error of the step averages of `truth`: with the correction and without.
    fn errors(samples: &[f64], truth: impl Fn(usize) -> f64) -> (f64, f64) {
        let mut course = ExcitationCourse::new(1);
        let (mut with, mut without) = (0.0, 0.0);
        for (k, pair) in samples.windows(2).enumerate() {
            let line = 0.5 * (pair[0] + pair[1]);
            let above = course.above_the_line(0, pair[0], pair[1]);
            if k > 300 {
                without += (line - truth(k)).powi(2);
                with += (line + above - truth(k)).powi(2);
            }
            course.take(&DVector::from_element(1, pair[0]), &pair[1..]);
        }
        (with, without)
    }

    #[test]
    fn crests_of_a_smooth_motion_are_followed() {
        // 10 Hz at 50 and 100 samples a second, and a second sine so that phases do not repeat
        for rate in [50.0, 100.0] {
            let sine = |k: f64, hz: f64| (std::f64::consts::TAU * hz * k / rate).sin();
            let samples: Vec<f64> = (0..3000).map(|k| sine(k as f64, 10.0) + sine(k as f64, 3.7)).collect();
            let mean = |k: usize| {
                let points = (0..50).map(|i| k as f64 + (i as f64 + 0.5) / 50.0);
                points.map(|k| sine(k, 10.0) + sine(k, 3.7)).sum::<f64>() / 50.0
            };
            let (with, without) = errors(&samples, mean);
            println!("{rate}: {}", (with / without).sqrt());
            assert!(with < 0.25 * without, "{rate}: {with} against {without}");
        }
    }

    #[test]
    fn independent_samples_are_left_alone() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let samples: Vec<f64> = (0..20_000).map(|_| StandardNormal.sample(&mut random)).collect();
        let (with, without) = errors(&samples, |k| 0.5 * (samples[k] + samples[k + 1]));
        assert_eq!((with, without), (0.0, 0.0));
    }

    #[test]
    fn missing_samples_and_silence_correct_nothing() {
        let mut course = ExcitationCourse::new(1);
        let silent = DVector::zeros(1);
        (0..500).for_each(|_| course.take(&silent, &[0.0]));
        assert_eq!(course.above_the_line(0, 0.0, 1.0), 0.0);
        course.take(&silent, &[f64::NAN]);
        assert_eq!(course.above_the_line(0, f64::NAN, 1.0), 0.0);
        course.take(&DVector::from_element(1, f64::NAN), &[1.0]);
        assert_eq!(course.above_the_line(0, 1.0, 1.0), 0.0);
    }
}
