//! Course of a measured excitation between two frames.
//!
//! A straight line between samples cuts the crests of a smooth motion. At the frequency `ω`, it
//! preserves `1 − (ωΔt)²/12` of the amplitude. At 10 Hz and 50 samples per second, the line is 13 %
//! too low. On average over a step, a smooth motion exceeds the line by `−Δt² f̈/12`. The second
//! difference of the last three samples approximates `Δt² f̈`.
//!
//! Source: K. E. Atkinson, *An Introduction to Numerical Analysis*, 2nd ed. 1989, §5.2 (corrected
//! trapezoidal rule).
//!
//! If the samples of an excitation are independent, as in simulations, its curvature cannot be
//! derived from them. The mean square of the second differences, divided by the mean square of the
//! first differences, distinguishes the two cases. This ratio is 3 for independent samples. For a
//! sine, it is `4 sin²(ωΔt/2)`: 1 at a sixth of the sampling rate, and 2 at a quarter.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Ratio of the mean squares up to which an excitation is smooth, and the ratio from which it is
/// rough.
const SMOOTH: f64 = 2.0;
const ROUGH: f64 = 2.4;

/// Time constant of the mean squares, in samples. The ratio of independent samples is then 3.00 ±
/// 0.05.
const MEMORY: f64 = 1000.0;

/// Number of samples required for a decision. With fewer samples, independent samples may look
/// smooth.
const LEAST_SAMPLES: f64 = 200.0;

/// Number of consecutive samples before the last one that `make_up` requires.
const ENOUGH: u8 = 2;

/// Statistics of past samples that describe how the known excitation varies in time (N_f each).
///
/// A step needs the second difference at its middle, but only the one at its older frame is known.
/// The next sample yields the remainder, which is then added to the filtered state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ExcitationCourse {
    /// Number of samples without a gap before the last one, up to [`ENOUGH`].
    unbroken: Vec<u8>,
    /// The sample before the last one.
    before_last: DVector<f64>,
    /// Second difference of the last three samples.
    last_bend: DVector<f64>,
    first_squares: DVector<f64>,
    second_squares: DVector<f64>,
    samples: DVector<f64>,
    /// `B` of the last step (n × N_f). Only the columns of smooth components are kept up to date.
    input_matrix: DMatrix<f64>,
}

impl ExcitationCourse {
    /// Creates the statistics of `inputs` components that act on `n` states.
    pub(crate) fn new(n: usize, inputs: usize) -> Self {
        let zeros = || DVector::zeros(inputs);
        Self {
            unbroken: vec![0; inputs],
            before_last: zeros(),
            last_bend: zeros(),
            first_squares: zeros(),
            second_squares: zeros(),
            samples: zeros(),
            input_matrix: DMatrix::zeros(n, inputs),
        }
    }

    /// Returns the numbers of states and components, or `None` if the lengths disagree, as in a
    /// damaged checkpoint.
    pub(crate) fn shape(&self) -> Option<(usize, usize)> {
        let Self {
            unbroken,
            before_last,
            last_bend,
            first_squares,
            second_squares,
            samples,
            input_matrix,
        } = self;
        let (n, inputs) = input_matrix.shape();
        let lists = [
            before_last,
            last_bend,
            first_squares,
            second_squares,
            samples,
        ];
        (unbroken.len() == inputs && lists.iter().all(|list| list.len() == inputs))
            .then_some((n, inputs))
    }

    /// Returns the average over the step by which component `j` exceeds the straight line from
    /// `last` to `next`.
    pub(crate) fn above_the_line(&self, j: usize, last: f64, next: f64) -> f64 {
        let share = self.smooth_share(j);
        match self.bend(j, last, next) {
            Some(bend) if share > 0.0 => -share * bend / 12.0,
            Some(_) | None => 0.0,
        }
    }

    /// Adds the part of component `j` that the last step omitted to the filtered state `mean` (n).
    /// `next` now reveals it.
    pub(crate) fn make_up(&self, j: usize, last: f64, next: f64, mean: &mut DVector<f64>) {
        let share = self.smooth_share(j);
        if let Some(bend) = self.bend(j, last, next)
            && share > 0.0
            && self.unbroken[j] >= ENOUGH
        {
            let left_out = -share * (bend - self.last_bend[j]) / 24.0;
            mean.axpy(left_out, &self.input_matrix.column(j), 1.0);
        }
    }

    /// Returns the second difference of the last three samples, or `None` if one of them is
    /// missing.
    fn bend(&self, j: usize, last: f64, next: f64) -> Option<f64> {
        let bend = next - 2.0 * last + self.before_last[j];
        (self.unbroken[j] > 0 && !bend.is_nan()).then_some(bend)
    }

    /// Returns the mean square of the second differences divided by that of the first differences.
    ///
    /// The result is NaN while the excitation is zero.
    fn ratio(&self, j: usize) -> f64 {
        self.second_squares[j] / self.first_squares[j]
    }

    /// Returns the degree to which a component counts as smooth, from 0 (rough) to 1 (smooth).
    fn smooth_share(&self, j: usize) -> f64 {
        let share = (ROUGH - self.ratio(j)) / (ROUGH - SMOOTH);
        if self.samples[j] < LEAST_SAMPLES || share.is_nan() {
            0.0
        } else {
            share.clamp(0.0, 1.0)
        }
    }

    /// Marks a gap before the next frame, because earlier samples do not show how the excitation
    /// continues.
    pub(crate) fn interrupt(&mut self) {
        self.unbroken.fill(0);
    }

    /// Returns the statistics for a model of `n` states with the same excitation.
    pub(crate) fn of_states(mut self, n: usize) -> Self {
        self.interrupt();
        self.input_matrix = DMatrix::zeros(n, self.input_matrix.ncols());
        self
    }

    /// Updates the statistics with the next sample of each component.
    ///
    /// `last` is the frame before (N_f), and `next` is NaN where a sample is missing.
    /// `input_matrix` is `B` (n × N_f) of the step between both frames.
    pub(crate) fn take(&mut self, last: &DVector<f64>, next: &[f64], input_matrix: &DMatrix<f64>) {
        let fade = 1.0 - 1.0 / MEMORY;
        for (j, (last, next)) in last.iter().zip(next).enumerate() {
            if let Some(bend) = self.bend(j, *last, *next) {
                self.first_squares[j] = fade * self.first_squares[j] + (next - last).powi(2);
                self.second_squares[j] = fade * self.second_squares[j] + bend * bend;
                self.samples[j] = fade * self.samples[j] + 1.0;
                self.last_bend[j] = bend;
            }
            let is_unbroken = !last.is_nan() && !next.is_nan();
            self.unbroken[j] = if is_unbroken {
                (self.unbroken[j] + 1).min(ENOUGH)
            } else {
                0
            };
            self.before_last[j] = if is_unbroken { *last } else { 0.0 };
            if self.smooth_share(j) > 0.0 {
                self.input_matrix.set_column(j, &input_matrix.column(j));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// Processes the samples and returns the mean square error of the step averages against
    /// `truth`, with the correction and without.
    fn errors(samples: &[f64], truth: impl Fn(usize) -> f64) -> (f64, f64) {
        let mut course = ExcitationCourse::new(1, 1);
        let unit = DMatrix::from_element(1, 1, 1.0);
        let (mut with, mut without) = (0.0, 0.0);
        for (k, pair) in samples.windows(2).enumerate().skip(1) {
            let line = |k: usize| 0.5 * (samples[k] + samples[k + 1]);
            let before = course.above_the_line(0, samples[k - 1], pair[0]);
            if k > 1 {
                course.take(&DVector::from_element(1, samples[k - 1]), &pair[..1], &unit);
            }
            let mut made_up = DVector::zeros(1);
            course.make_up(0, pair[0], pair[1], &mut made_up);
            if k > 300 {
                without += (line(k - 1) - truth(k - 1)).powi(2);
                with += (line(k - 1) + before + made_up[0] - truth(k - 1)).powi(2);
            }
        }
        (with, without)
    }

    #[test]
    fn crests_of_a_smooth_motion_are_reconstructed() {
        // 10 Hz at 50 and at 100 samples per second, with a second sine so that the phases do not
        // repeat.
        for (rate, most_left) in [(50.0, 0.3), (100.0, 0.1)] {
            let sine = |k: f64, hz: f64| (std::f64::consts::TAU * hz * k / rate).sin();
            let samples: Vec<f64> = (0..3000)
                .map(|k| sine(k as f64, 10.0) + sine(k as f64, 3.7))
                .collect();
            let mean = |k: usize| {
                let points = (0..50).map(|i| k as f64 + (i as f64 + 0.5) / 50.0);
                points.map(|k| sine(k, 10.0) + sine(k, 3.7)).sum::<f64>() / 50.0
            };
            let (with, without) = errors(&samples, mean);
            let left = (with / without).sqrt();
            println!("{rate} samples a second: {left:.3} of the error is left");
            assert!(
                left < most_left,
                "{rate} samples a second: {left} of the error is left"
            );
        }
    }

    #[test]
    fn independent_samples_are_not_corrected() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let samples: Vec<f64> = (0..20_000)
            .map(|_| StandardNormal.sample(&mut random))
            .collect();
        let (with, without) = errors(&samples, |k| 0.5 * (samples[k] + samples[k + 1]));
        assert_eq!((with, without), (0.0, 0.0));
    }

    #[test]
    fn missing_samples_and_silence_cause_no_correction() {
        let mut course = ExcitationCourse::new(1, 1);
        let (unit, silent) = (DMatrix::from_element(1, 1, 1.0), DVector::zeros(1));
        let corrects = |course: &ExcitationCourse, last: f64, next: f64| {
            let mut made_up = DVector::zeros(1);
            course.make_up(0, last, next, &mut made_up);
            course.above_the_line(0, last, next) != 0.0 || made_up[0] != 0.0
        };
        (0..500).for_each(|_| course.take(&silent, &[0.0], &unit));
        assert!(!corrects(&course, 0.0, 1.0));
        // A smooth motion, then gaps in it.
        let at = |k: usize| DVector::from_element(1, (0.1 * k as f64).sin());
        (0..500).for_each(|k| course.take(&at(k), at(k + 1).as_slice(), &unit));
        assert!(corrects(&course, at(500)[0], at(501)[0]));
        let mut after_a_gap = course.clone();
        after_a_gap.take(&at(500), &[f64::NAN], &unit);
        assert!(!corrects(&after_a_gap, f64::NAN, 1.0));
        after_a_gap.take(&DVector::from_element(1, f64::NAN), &[1.0], &unit);
        assert!(!corrects(&after_a_gap, 1.0, 2.0));
        course.interrupt();
        assert!(!corrects(&course, 1.0, 2.0));
    }
}
