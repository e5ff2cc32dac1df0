//! Response of a damped oscillator to ground motion, and its spectral acceleration.
//!
//! Source: N. C. Nigam and P. C. Jennings, *Calculation of response spectra from strong-motion
//! earthquake records*, Bull. Seism. Soc. Am. 59 (1969), 909-922. Notation:
//!
//! - ω, ξ: undamped angular frequency (rad/s) and damping ratio
//! - ω_d = ω √(1 − ξ²)
//! - u, v: displacement (m) and velocity (m/s) relative to the ground
//! - a: acceleration of the ground (m/s²), linear between samples that are Δ apart (s)
//!
//! The motion obeys u″ + 2ξω u′ + ω² u = −a. For a ground acceleration that is linear between
//! samples, the recurrence of the paper is exact:
//!
//! x(i+1) = A x(i) + B [a(i), a(i+1)]ᵀ,  x = [u, v]ᵀ.

use crate::error::{EarthquakeError, require};
use std::f64::consts::TAU;

/// Number of steps per period of the oscillator. The largest value between two steps then exceeds
/// both by at most 1 − cos(π/20) = 1.2 %.
const STEPS_PER_PERIOD: f64 = 20.0;

/// The exact recurrence of one oscillator for one time step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Recurrence {
    a: [[f64; 2]; 2],
    b: [[f64; 2]; 2],
}

impl Recurrence {
    /// Returns A and B of the paper for ω (rad/s), ξ and Δ (s).
    pub(crate) fn new(omega: f64, xi: f64, delta: f64) -> Self {
        let root = (1.0 - xi * xi).sqrt();
        let omega_d = omega * root;
        let e = (-xi * omega * delta).exp();
        let (sin, cos) = (omega_d * delta).sin_cos();
        let k = (2.0 * xi * xi - 1.0) / (omega * omega * delta);
        let l = 2.0 * xi / (omega.powi(3) * delta);
        let square = 1.0 / (omega * omega);
        let slow = cos - xi / root * sin;
        let fast = omega_d * sin + xi * omega * cos;
        Self {
            a: [
                [e * (xi / root * sin + cos), e * sin / omega_d],
                [-omega / root * e * sin, e * slow],
            ],
            b: [
                [
                    e * ((k + xi / omega) * sin / omega_d + (l + square) * cos) - l,
                    -e * (k * sin / omega_d + l * cos) - square + l,
                ],
                [
                    e * ((k + xi / omega) * slow - (l + square) * fast) + square / delta,
                    -e * (k * slow - l * fast) - square / delta,
                ],
            ],
        }
    }

    /// Returns the state [u, v] one step later, for the ground acceleration at both ends.
    pub(crate) fn step(&self, [u, v]: [f64; 2], from: f64, to: f64) -> [f64; 2] {
        let row = |a: &[f64; 2], b: &[f64; 2]| a[0] * u + a[1] * v + b[0] * from + b[1] * to;
        [row(&self.a[0], &self.b[0]), row(&self.a[1], &self.b[1])]
    }
}

/// Returns the spectral acceleration ω²·max|u| (m/s²) of an oscillator that is at rest at the first
/// sample.
///
/// - `ground`: acceleration of the ground (m/s²), one value per step. A missing value (`NaN`) is
///   bridged linearly, and missing values at the ends count as 0
/// - `step_s`: time between two samples (s)
/// - `period_s`: natural period (s); `damping`: damping ratio, such as 0.05
///
/// This is the pseudo-acceleration of design codes.
///
/// # Errors
/// Returns an error if the step or the period is not positive, or if the damping ratio is not
/// between 0 and 1.
pub fn spectral_acceleration(
    ground: &[f64],
    step_s: f64,
    period_s: f64,
    damping: f64,
) -> Result<f64, EarthquakeError> {
    require(
        step_s > 0.0 && step_s.is_finite(),
        "time step",
        step_s,
        "above 0 s",
    )?;
    require(
        period_s > 0.0 && period_s.is_finite(),
        "period",
        period_s,
        "above 0 s",
    )?;
    require(
        (0.0..1.0).contains(&damping),
        "damping ratio",
        damping,
        "at least 0 and below 1",
    )?;
    let omega = TAU / period_s;
    // Finer steps do not change the motion, because the ground acceleration is linear between
    // samples. They only find the largest value more precisely.
    let parts = (STEPS_PER_PERIOD * step_s / period_s).ceil().max(1.0);
    let recurrence = Recurrence::new(omega, damping, step_s / parts);
    let ground = bridged(ground);
    let mut state = [0.0, 0.0];
    let mut largest = 0.0_f64;
    for pair in ground.windows(2) {
        let at = |part: f64| pair[0] + (pair[1] - pair[0]) * part / parts;
        let mut part = 0.0;
        while part < parts {
            state = recurrence.step(state, at(part), at(part + 1.0));
            largest = largest.max(state[0].abs());
            part += 1.0;
        }
    }
    Ok(omega * omega * largest)
}

/// Returns the samples with missing values bridged linearly, and 0 at the ends.
pub(crate) fn bridged(samples: &[f64]) -> Vec<f64> {
    let mut bridged = samples.to_vec();
    let mut last: Option<usize> = None;
    for (index, value) in samples.iter().enumerate() {
        if !value.is_finite() {
            bridged[index] = 0.0;
            continue;
        }
        if let Some(before) = last {
            let length = (index - before) as f64;
            for between in before + 1..index {
                let share = (between - before) as f64 / length;
                bridged[between] = samples[before] + share * (value - samples[before]);
            }
        }
        last = Some(index);
    }
    bridged
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Integrates the oscillator by Runge-Kutta of fourth order in 200 steps per sample, and
    /// returns the states at the samples. This route shares no formula with the recurrence.
    fn by_runge_kutta(ground: &[f64], delta: f64, omega: f64, xi: f64) -> Vec<[f64; 2]> {
        const PARTS: u32 = 200;
        let step = delta / f64::from(PARTS);
        let mut state = [0.0, 0.0];
        let mut states = vec![state];
        for pair in ground.windows(2) {
            let slope = |time: f64, [u, v]: [f64; 2]| {
                let a = pair[0] + (pair[1] - pair[0]) * time / delta;
                [v, -a - 2.0 * xi * omega * v - omega * omega * u]
            };
            let plus = |x: [f64; 2], h: f64, k: [f64; 2]| [x[0] + h * k[0], x[1] + h * k[1]];
            for part in 0..PARTS {
                let time = step * f64::from(part);
                let k1 = slope(time, state);
                let k2 = slope(time + 0.5 * step, plus(state, 0.5 * step, k1));
                let k3 = slope(time + 0.5 * step, plus(state, 0.5 * step, k2));
                let k4 = slope(time + step, plus(state, step, k3));
                for row in 0..2 {
                    state[row] += step / 6.0 * (k1[row] + 2.0 * k2[row] + 2.0 * k3[row] + k4[row]);
                }
            }
            states.push(state);
        }
        states
    }

    #[test]
    fn recurrence_agrees_with_runge_kutta_on_an_irregular_motion() {
        let ground: Vec<f64> = (0..60)
            .map(|i| f64::from((i * 7919 + 13) % 101) / 50.0 - 1.0)
            .collect();
        for (period, xi, delta) in [(0.1, 0.05, 0.01), (0.5, 0.02, 0.02), (4.0, 0.2, 0.005)] {
            let omega = TAU / period;
            let recurrence = Recurrence::new(omega, xi, delta);
            let exact = by_runge_kutta(&ground, delta, omega, xi);
            let scale = exact.iter().map(|state| state[0].abs()).fold(0.0, f64::max);
            let mut state = [0.0, 0.0];
            for (pair, expected) in ground.windows(2).zip(&exact[1..]) {
                state = recurrence.step(state, pair[0], pair[1]);
                assert!(
                    (state[0] - expected[0]).abs() < 1e-7 * scale
                        && (state[1] - expected[1]).abs() < 1e-7 * scale * omega,
                    "period {period}: {state:?} {expected:?}"
                );
            }
        }
    }

    #[test]
    fn step_of_the_ground_acceleration_has_the_spectral_value_of_its_closed_form() {
        // u(t) = −a/ω² (1 − e^(−ξωt)(cos ω_d t + ξ/√(1−ξ²) sin ω_d t)) is largest after half a
        // period: ω² max|u| = a (1 + e^(−πξ/√(1−ξ²))).
        let ground = vec![2.0; 4000];
        for xi in [0.02, 0.05, 0.2] {
            let exact = 2.0 * (1.0 + (-std::f64::consts::PI * xi / f64::sqrt(1.0 - xi * xi)).exp());
            for period_s in [0.03, 0.2, 1.0, 3.0] {
                let found = spectral_acceleration(&ground, 0.005, period_s, xi).unwrap();
                assert!(
                    found <= exact * (1.0 + 1e-9) && found > exact * (1.0 - 0.013),
                    "T = {period_s}, damping {xi}: {found} {exact}"
                );
            }
        }
    }

    #[test]
    fn stiff_oscillator_follows_the_ground_and_soft_one_stays_in_place() {
        let ground: Vec<f64> = (0..2000)
            .map(|i| (0.01 * f64::from(i) * TAU).sin() * (-0.002 * f64::from(i)).exp())
            .collect();
        let peak = ground.iter().fold(0.0_f64, |peak, a| peak.max(a.abs()));
        let stiff = spectral_acceleration(&ground, 0.01, 0.02, 0.05).unwrap();
        assert!((stiff / peak - 1.0).abs() < 0.01, "{stiff} {peak}");
        let soft = spectral_acceleration(&ground, 0.01, 50.0, 0.05).unwrap();
        assert!(soft < 0.02 * peak, "{soft}");
    }

    #[test]
    fn missing_samples_are_bridged() {
        let whole: Vec<f64> = (0..400).map(|i| f64::from(i % 40) - 20.0).collect();
        let mut holed = whole.clone();
        holed[105] = f64::NAN; // on a straight part
        let value = |ground: &[f64]| spectral_acceleration(ground, 0.01, 0.5, 0.05).unwrap();
        assert!((value(&holed) - value(&whole)).abs() < 1e-9);
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let told = |step, period, damping| {
            spectral_acceleration(&[0.0; 3], step, period, damping)
                .unwrap_err()
                .to_string()
        };
        assert_eq!(told(0.01, 0.0, 0.05), "period is 0, must be above 0 s");
        assert_eq!(
            told(0.01, 1.0, 1.0),
            "damping ratio is 1, must be at least 0 and below 1"
        );
    }

    proptest! {
        #[test]
        fn spectral_value_is_proportional_to_the_motion(
            ground in prop::collection::vec(-5.0..5.0_f64, 2..200),
            period in 0.05..3.0_f64,
            factor in 0.01..100.0_f64,
        ) {
            let scaled: Vec<f64> = ground.iter().map(|a| -factor * a).collect();
            let one = spectral_acceleration(&ground, 0.01, period, 0.05).unwrap();
            let other = spectral_acceleration(&scaled, 0.01, period, 0.05).unwrap();
            prop_assert!((other - factor * one).abs() <= 1e-9 * other.max(1e-12));
        }
    }
}
