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

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Ratio of the mean squares up to which an excitation is smooth, and from which on it is not.
const SMOOTH: f64 = 2.0;
const ROUGH: f64 = 2.4;

/// Time constant of the mean squares, in samples. The ratio of independent samples is then 3.00 ± 0.05.
const MEMORY: f64 = 1000.0;

/// Samples before which nothing is concluded: up to then independent samples may look smooth.
const LEAST_SAMPLES: f64 = 200.0;

/// Samples before the last one that a step asks for.
const ENOUGH: u8 = 2;

/// What past samples tell of the course of the known excitation (N_f each).
///
/// The second difference that a step needs is that of its middle; known is that of its older frame. What is missing shows with the
/// next sample, and is then added to the filtered state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ExcitationCourse {
    /// samples without a gap before the last one, up to [`ENOUGH`]
    unbroken: Vec<u8>,
    /// the sample before the last
    before_last: DVector<f64>,
    /// second difference of the last three samples
    last_bend: DVector<f64>,
    first_squares: DVector<f64>,
    second_squares: DVector<f64>,
    samples: DVector<f64>,
    /// `B` of the last step (n × N_f); only the columns of smooth components are kept up to date
    input_matrix: DMatrix<f64>,
}

impl ExcitationCourse {
    /// Makes the course of `inputs` components that drive `n` states.
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

    /// Returns the numbers of states and components; `None` where the lengths disagree, as in a damaged checkpoint.
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

    /// Returns what component `j` is larger, on average over the step, than on the straight line from `last` to `next`.
    pub(crate) fn above_the_line(&self, j: usize, last: f64, next: f64) -> f64 {
        let share = self.smooth_share(j);
        match self.bend(j, last, next) {
            Some(bend) if share > 0.0 => -share * bend / 12.0,
            Some(_) | None => 0.0,
        }
    }

    /// Adds to the filtered state `mean` (n) what the last step left out of component `j`, as `next` shows now.
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

    /// Returns the second difference of the last three samples; `None` where one is missing.
    fn bend(&self, j: usize, last: f64, next: f64) -> Option<f64> {
        let bend = next - 2.0 * last + self.before_last[j];
        (self.unbroken[j] > 0 && !bend.is_nan()).then_some(bend)
    }

    /// Returns the mean square of the second differences over that of the first; NaN while the excitation is silent.
    fn ratio(&self, j: usize) -> f64 {
        self.second_squares[j] / self.first_squares[j]
    }

    /// Returns how far a component counts as smooth, 0 to 1.
    fn smooth_share(&self, j: usize) -> f64 {
        let share = (ROUGH - self.ratio(j)) / (ROUGH - SMOOTH);
        if self.samples[j] < LEAST_SAMPLES || share.is_nan() {
            0.0
        } else {
            share.clamp(0.0, 1.0)
        }
    }

    /// Starts anew with the frame to come: what was before it tells nothing of what follows.
    pub(crate) fn interrupt(&mut self) {
        self.unbroken.fill(0);
    }

    /// Returns the course for a model of `n` states with the same excitation.
    pub(crate) fn of_states(mut self, n: usize) -> Self {
        self.interrupt();
        self.input_matrix = DMatrix::zeros(n, self.input_matrix.ncols());
        self
    }

    /// Takes the next sample of each component, NaN where it is missing, after `last`, and `B` (n × N_f) of the step between.
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

    /// Runs over samples, and returns the mean square of the error of the step averages of `truth`: with the correction and without.
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
    fn crests_of_a_smooth_motion_are_followed() {
        // 10 Hz at 50 and 100 samples a second, and a second sine so that phases do not repeat
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
    fn independent_samples_are_left_alone() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let samples: Vec<f64> = (0..20_000)
            .map(|_| StandardNormal.sample(&mut random))
            .collect();
        let (with, without) = errors(&samples, |k| 0.5 * (samples[k] + samples[k + 1]));
        assert_eq!((with, without), (0.0, 0.0));
    }

    #[test]
    fn missing_samples_and_silence_correct_nothing() {
        let mut course = ExcitationCourse::new(1, 1);
        let (unit, silent) = (DMatrix::from_element(1, 1, 1.0), DVector::zeros(1));
        let corrects = |course: &ExcitationCourse, last: f64, next: f64| {
            let mut made_up = DVector::zeros(1);
            course.make_up(0, last, next, &mut made_up);
            course.above_the_line(0, last, next) != 0.0 || made_up[0] != 0.0
        };
        (0..500).for_each(|_| course.take(&silent, &[0.0], &unit));
        assert!(!corrects(&course, 0.0, 1.0));
        // a smooth motion, and gaps in it
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
