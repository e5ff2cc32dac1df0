//! The equivalent-linear stiffness of a whole structure, window by window, from the measured motion
//! of its ground and of its accelerometers.
//!
//! A filter follows slow changes, but cannot follow a stiffness that halves within two periods.
//! This fit has no memory and no local optimum: it searches all stiffnesses on a grid. One factor c
//! multiplies the stiffness of all members, so the mode shapes remain, and all frequencies change
//! by √c. The fit cannot determine which member has softened.
//!
//! Notation:
//!
//! - ω, ξ, φΓ: angular frequency (rad/s), damping ratio and participation of a mode at a sensor
//! - a: acceleration of the ground (m/s²), linear between samples
//! - z: acceleration of a sensor minus that of the rigidly moving structure
//! - S(c, d): sum of squared differences between z and the model with the stiffness c and d times
//!   the damping, over a window and all sensors
//! - n: independent samples of a window, two per fundamental period
//!
//! z = Σ φΓ q″ with q″ + 2ξω q′ + ω² q = −a. If the variance of the error is unknown and constant
//! over the window, with the prior 1/σ², the posterior is p(c, d) ∝ S(c, d)^(−n/2) (G. E. P. Box
//! and G. C. Tiao, *Bayesian Inference in Statistical Analysis*, 1973, section 8.2). The grid
//! contains a few values of the damping, over which the posterior is summed. Neighbouring sensors
//! share the error of the model, so that more sensors do not add independent samples.

use crate::course::CoursePoint;
use crate::oscillator::{Recurrence, bridged};
use crate::phase::Window;
use std::f64::consts::TAU;

/// Ends of the searched stiffness, as a ratio to nominal.
const RANGE: (f64, f64) = (0.06, 2.5);
/// Number of stiffnesses, 3.5 % apart.
const STIFFNESSES: usize = 108;
/// Factors of the damping. Strong motion dissipates more than the model assumes.
const DAMPINGS: [f64; 4] = [0.5, 1.0, 2.0, 3.0];
/// Largest damping ratio.
const LARGEST_DAMPING: f64 = 0.6;
/// Largest number of modes.
const MOST_MODES: usize = 12;
/// Independent samples per fundamental period.
const SAMPLES_PER_PERIOD: f64 = 2.0;
/// Share of the motion that the model must explain. A smaller share also widens the posterior.
const LEAST_EXPLAINED: f64 = 0.3;
/// Largest standard deviation of ln c at which a window counts.
const LARGEST_STD: f64 = 0.35;
/// Largest posterior probability of both ends of the grid together.
const LARGEST_AT_ENDS: f64 = 0.02;

/// A natural mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    /// Natural frequency as designed (Hz).
    pub frequency_hz: f64,
    /// Damping ratio as designed.
    pub damping: f64,
}

/// An accelerometer on the structure.
#[derive(Debug, Clone)]
pub struct Accelerometer {
    /// Measured acceleration (m/s², absolute), one value per frame, `NaN` where one is missing.
    pub samples: Vec<f64>,
    /// Acceleration for a slow ground acceleration of 1.
    pub rigid: f64,
    /// φΓ of each mode.
    pub participation: Vec<f64>,
}

/// The motion of a structure along one direction of the ground.
#[derive(Debug, Clone)]
pub struct MeasuredMotion {
    /// Sampling rate (Hz).
    pub rate_hz: f64,
    /// Acceleration of the ground (m/s²), one value per frame.
    pub ground: Vec<f64>,
    /// The modes, the lowest first.
    pub modes: Vec<Mode>,
    /// The accelerometers.
    pub sensors: Vec<Accelerometer>,
    /// Frequency of the first mode that moves a relevant share of the mass (Hz).
    pub fundamental_hz: f64,
}

impl MeasuredMotion {
    /// Returns one point for each window whose motion the model explains, as ln c.
    ///
    /// Means of the channels must have been removed.
    #[must_use]
    pub fn equivalent_stiffness(&self, windows: &[Window]) -> Vec<CoursePoint> {
        let ground = bridged(&self.ground);
        let own = self.relative(&ground);
        let motions = sums(windows, &own, |_, z| z * z);
        let step = (RANGE.1 / RANGE.0).ln() / (STIFFNESSES - 1) as f64;
        let stiffness = |index: usize| RANGE.0.ln() + step * index as f64;
        let errors: Vec<Vec<[f64; DAMPINGS.len()]>> = (0..STIFFNESSES)
            .map(|index| {
                let mut of_windows = vec![[0.0; DAMPINGS.len()]; windows.len()];
                for (position, damping) in DAMPINGS.into_iter().enumerate() {
                    let model = self.response(&ground, stiffness(index).exp(), damping);
                    let squares = sums(windows, &own, |at, z| (z - model[at]).powi(2));
                    for (of_window, square) in of_windows.iter_mut().zip(squares) {
                        of_window[position] = square;
                    }
                }
                of_windows
            })
            .collect();
        let points = windows.iter().enumerate().filter_map(|(number, window)| {
            let length_s = (window.end - window.first) as f64 / self.rate_hz;
            let samples = SAMPLES_PER_PERIOD * self.fundamental_hz * length_s;
            let least = errors
                .iter()
                .flat_map(|of_windows| of_windows[number])
                .fold(f64::INFINITY, f64::min);
            if !(least > 0.0 && least <= (1.0 - LEAST_EXPLAINED) * motions[number]) {
                return None;
            }
            let posterior: Vec<f64> = errors
                .iter()
                .map(|of_windows| {
                    let of_damping = of_windows[number].iter();
                    of_damping
                        .map(|square| (-0.5 * samples * (square / least).ln()).exp())
                        .sum()
                })
                .collect();
            let (y, s) = moments(&posterior, stiffness)?;
            Some(CoursePoint {
                start_s: window.start_s,
                end_s: window.end_s,
                phase: window.phase,
                amplitude: window.rms.log10(),
                y,
                s: s.hypot(0.5 * step), // a grid shows nothing below its step
                is_contradicted: false,
            })
        });
        points.collect()
    }

    /// Returns z of all sensors, sensor by sensor.
    fn relative(&self, ground: &[f64]) -> Vec<f64> {
        let of_sensor = |sensor: &Accelerometer| {
            let rigid = sensor.rigid;
            let samples = sensor.samples.iter().zip(ground);
            samples
                .map(|(value, ground)| value - rigid * ground)
                .collect::<Vec<f64>>()
        };
        self.sensors.iter().flat_map(of_sensor).collect()
    }

    /// Returns z of the model, sensor by sensor, for a stiffness and a factor of the damping.
    fn response(&self, ground: &[f64], stiffness: f64, damping: f64) -> Vec<f64> {
        let frames = ground.len();
        let mut response = vec![0.0; frames * self.sensors.len()];
        let resolved =
            |mode: &&Mode| mode.frequency_hz > 0.0 && mode.frequency_hz < 0.5 * self.rate_hz;
        let mut q = vec![0.0; frames];
        for (number, mode) in self.modes.iter().take(MOST_MODES).enumerate() {
            if !resolved(&mode) {
                continue;
            }
            let omega = TAU * mode.frequency_hz * stiffness.sqrt();
            let xi = (mode.damping * damping).min(LARGEST_DAMPING);
            let recurrence = Recurrence::new(omega, xi, 1.0 / self.rate_hz);
            let mut state = [0.0, 0.0];
            let acceleration =
                |[u, v]: [f64; 2], a: f64| -a - 2.0 * xi * omega * v - omega * omega * u;
            for at in 0..frames {
                if at > 0 {
                    state = recurrence.step(state, ground[at - 1], ground[at]);
                }
                q[at] = acceleration(state, ground[at]);
            }
            let of_sensors = response.chunks_exact_mut(frames.max(1));
            for (sensor, response) in self.sensors.iter().zip(of_sensors) {
                let participation = sensor.participation.get(number).copied().unwrap_or(0.0);
                for (response, q) in response.iter_mut().zip(&q) {
                    *response += participation * q;
                }
            }
        }
        response
    }
}

/// Returns the sum of a function of all samples in each window, without missing samples.
///
/// The function receives the position among all samples, and z.
fn sums(windows: &[Window], all: &[f64], of: impl Fn(usize, f64) -> f64) -> Vec<f64> {
    let frames = windows.last().map_or(0, |window| window.end);
    if frames == 0 {
        return Vec::new();
    }
    let sensors = all.len() / frames;
    windows
        .iter()
        .map(|window| {
            let mut sum = 0.0;
            for sensor in 0..sensors {
                for frame in window.first..window.end {
                    let at = sensor * frames + frame;
                    let value = of(at, all[at]);
                    if value.is_finite() {
                        sum += value;
                    }
                }
            }
            sum
        })
        .collect()
}

/// Returns mean and standard deviation of a posterior on the grid. `None` if it reaches the ends,
/// or if it is too wide.
fn moments(posterior: &[f64], at: impl Fn(usize) -> f64) -> Option<(f64, f64)> {
    let whole: f64 = posterior.iter().sum();
    let ends = posterior.first()? + posterior.last()?;
    if !(whole.is_finite() && ends <= LARGEST_AT_ENDS * whole) {
        return None;
    }
    let mean = |of: &dyn Fn(usize) -> f64| {
        let weighted = posterior.iter().enumerate();
        weighted.map(|(index, p)| p * of(index)).sum::<f64>() / whole
    };
    let y = mean(&at);
    let s = mean(&|index| (at(index) - y).powi(2)).sqrt();
    (s <= LARGEST_STD).then_some((y, s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phase::{PhaseSettings, windows};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const RATE_HZ: f64 = 100.0;
    const FREQUENCY_HZ: f64 = 4.0;

    /// Integrates an oscillator whose stiffness depends on the time, with 20 steps of Runge-Kutta
    /// per sample, and returns the ground and the absolute acceleration with noise.
    fn simulated(seed: u64, stiffness: impl Fn(f64) -> f64) -> (Vec<f64>, Vec<f64>) {
        const PARTS: u32 = 20;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut level = 0.0;
        let ground: Vec<f64> = (0..4000)
            .map(|_| {
                level = 0.8 * level + random.random_range(-0.5..0.5);
                level
            })
            .collect();
        let (omega, xi) = (TAU * FREQUENCY_HZ, 0.06);
        let step = 1.0 / (RATE_HZ * f64::from(PARTS));
        let mut state = [0.0, 0.0];
        let mut measured = vec![0.0];
        for (index, pair) in ground.windows(2).enumerate() {
            let from_s = index as f64 / RATE_HZ;
            let slope = |part: f64, [u, v]: [f64; 2]| {
                let share = part / f64::from(PARTS);
                let a = pair[0] + (pair[1] - pair[0]) * share;
                let k = stiffness(from_s + share / RATE_HZ) * omega * omega;
                [v, -a - 2.0 * xi * omega * v - k * u]
            };
            let plus = |x: [f64; 2], h: f64, k: [f64; 2]| [x[0] + h * k[0], x[1] + h * k[1]];
            for part in 0..PARTS {
                let part = f64::from(part);
                let k1 = slope(part, state);
                let k2 = slope(part + 0.5, plus(state, 0.5 * step, k1));
                let k3 = slope(part + 0.5, plus(state, 0.5 * step, k2));
                let k4 = slope(part + 1.0, plus(state, step, k3));
                for row in 0..2 {
                    state[row] += step / 6.0 * (k1[row] + 2.0 * k2[row] + 2.0 * k3[row] + k4[row]);
                }
            }
            let a = slope(f64::from(PARTS), state)[1] + pair[1];
            measured.push(a + 0.2 * random.random_range(-1.0..1.0));
        }
        (ground, measured)
    }

    fn fitted(seed: u64, stiffness: impl Fn(f64) -> f64) -> Vec<CoursePoint> {
        let (ground, samples) = simulated(seed, stiffness);
        course(ground, samples)
    }

    fn course(ground: Vec<f64>, samples: Vec<f64>) -> Vec<CoursePoint> {
        let settings = PhaseSettings {
            rate_hz: RATE_HZ,
            fundamental_hz: FREQUENCY_HZ,
            weak_peak: 1.0,
            settling_s: 0.0,
            unsettled_s: 0.0,
        };
        let windows = windows(&[&samples], &settings).unwrap();
        let motion = MeasuredMotion {
            rate_hz: RATE_HZ,
            ground,
            modes: vec![Mode {
                frequency_hz: FREQUENCY_HZ,
                damping: 0.05,
            }],
            sensors: vec![Accelerometer {
                samples,
                rigid: 1.0,
                participation: vec![1.0],
            }],
            fundamental_hz: FREQUENCY_HZ,
        };
        motion.equivalent_stiffness(&windows)
    }

    #[test]
    fn stiffness_that_drops_to_a_quarter_is_found_in_the_next_window() {
        let points = fitted(1, |time_s| match time_s {
            t if t < 12.0 => 1.0,
            t if t < 21.0 => 0.25,
            _ => 0.8,
        });
        let at = |time_s: f64| {
            let inside = |point: &&CoursePoint| (point.start_s..point.end_s).contains(&time_s);
            points.iter().find(inside).unwrap().y.exp()
        };
        for (time_s, k) in [
            (7.0, 1.0),
            (16.0, 0.25),
            (19.0, 0.25),
            (26.0, 0.8),
            (32.0, 0.8),
        ] {
            assert!(
                (at(time_s) / k - 1.0).abs() < 0.08,
                "{time_s}: {} {k}",
                at(time_s)
            );
        }
    }

    #[test]
    fn stated_deviation_contains_the_truth() {
        let (mut inside, mut all) = (0_u32, 0_u32);
        for seed in 10..18 {
            for k in [0.4, 0.9, 1.3] {
                for point in fitted(seed, |_| k) {
                    all += 1;
                    inside += u32::from((point.y - f64::ln(k)).abs() < 2.0 * point.s);
                }
            }
        }
        let share = f64::from(inside) / f64::from(all);
        assert!(all > 200 && share > 0.9, "{inside} of {all}");
    }

    #[test]
    fn motion_that_is_not_that_of_the_structure_says_nothing() {
        let (ground, _) = simulated(2, |_| 1.0);
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let samples: Vec<f64> = ground
            .iter()
            .map(|_| random.random_range(-1.0..1.0))
            .collect();
        assert!(course(ground, samples).is_empty());
    }
}
