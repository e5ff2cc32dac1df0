//! The true building of the robustness benchmark, independent of the models that identify it.
//!
//! A shear building with its own masses and damping and, optionally, one yielding storey
//! (Bouc-Wen). It is integrated by the fourth-order Runge-Kutta method at a tenth of the sampling
//! interval.

use super::file::STOREYS;
use super::ground::Ground;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Bernoulli, Distribution, StandardNormal};

/// Number of integration steps per sample.
pub(super) const SUBSTEPS: usize = 10;

/// A storey with a yielding Bouc-Wen spring: a tenth of its stiffness remains after yielding, and
/// the exponent is 2.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Yielding {
    /// Index of the storey, from 0.
    pub(super) storey: usize,
    /// Yield drift (m).
    pub(super) yield_drift_m: f64,
}

/// A sudden loss of stiffness.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Loss {
    /// Index of the storey, from 0.
    pub(super) storey: usize,
    pub(super) at_s: f64,
    /// Lost share of the stiffness.
    pub(super) share: f64,
}

/// Fault of the sensor of one floor, or of all.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SensorFault {
    /// Index of the floor, from 0; `None` for all floors.
    pub(super) floor: Option<usize>,
    pub(super) at_s: f64,
    pub(super) kind: FaultKind,
}

/// Kind of a fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum FaultKind {
    /// The sensor measures nothing, and only its noise remains.
    Dead,
    /// The motion is multiplied by this factor.
    Gain(f64),
    /// The noise is multiplied by this factor.
    Noise(f64),
    /// This share of the samples has an additional error of about [`SPIKE`].
    Spikes(f64),
}

/// Standard deviation of spikes (m/s²), several times that of the response.
const SPIKE: f64 = 1.0;

/// The true building with its motion and sensors.
#[derive(Debug, Clone)]
pub(super) struct Building {
    pub(super) masses_kg: Vec<f64>,
    pub(super) stiffnesses_n_per_m: Vec<f64>,
    /// Coefficients of the Rayleigh damping `α M + β K`.
    pub(super) alpha_per_s: f64,
    pub(super) beta_s: f64,
    /// Whether `K` in the damping remains that of the undamaged building after a loss.
    pub(super) damping_stays: bool,
    pub(super) yielding: Option<Yielding>,
    pub(super) loss: Option<Loss>,
    pub(super) fault: Option<SensorFault>,
    pub(super) ground: Ground,
    /// Standard deviation of the noise of the ground channel and of each floor channel (m/s²).
    pub(super) ground_noise: f64,
    pub(super) floor_noise: f64,
    pub(super) rate_hz: f64,
    /// Sampling instants of the ground channel and of each floor channel after the time of the
    /// frame, in tenths of the sampling interval, below 10.
    pub(super) instants: [usize; STOREYS + 1],
}

/// Share of the elastic stiffness that remains after yielding.
const HARDENING: f64 = 0.1;

/// One frame: the measured acceleration of the ground, then of each floor (m/s²).
pub(super) type Samples = Vec<f64>;

impl Building {
    /// Returns the samples of `duration_s`. The random stream of the noise does not depend on the
    /// motion.
    pub(super) fn measure(&self, duration_s: f64, seed: u64) -> Vec<Samples> {
        let samples = (duration_s * self.rate_hz).round() as usize;
        let random = |stream| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(stream);
            random
        };
        let (mut noise, mut motion, mut spikes) = (random(1), random(0), random(2));
        let ground = self
            .ground
            .draw(samples, SUBSTEPS, self.rate_hz, &mut motion);
        let storeys = self.masses_kg.len();
        let step_s = 1.0 / (self.rate_hz * SUBSTEPS as f64);
        let mut motion = Motion {
            building: self,
            state: vec![0.0; 3 * storeys],
            kept: vec![1.0; storeys],
        };
        let mut frames = Vec::with_capacity(samples);
        for sample in 0..samples {
            let time_s = sample as f64 / self.rate_hz;
            if let Some(loss) = self.loss.filter(|loss| time_s >= loss.at_s) {
                motion.kept[loss.storey] = 1.0 - loss.share;
            }
            let first = sample * SUBSTEPS;
            let fault = self.fault.filter(|fault| time_s >= fault.at_s);
            let mut values = vec![0.0; 1 + storeys];
            for substep in 0..SUBSTEPS {
                let accelerations = motion.absolute_accelerations();
                let ground_now = ground[first + substep];
                let moved = std::iter::once(ground_now).chain(accelerations);
                for ((value, moved), instant) in values.iter_mut().zip(moved).zip(self.instants) {
                    if instant == substep {
                        *value = moved;
                    }
                }
                motion.advance(step_s, ground_now, ground[first + substep + 1]);
            }
            values[0] += self.ground_noise * normal(&mut noise);
            for (floor, value) in values[1..].iter_mut().enumerate() {
                let noise = self.floor_noise * normal(&mut noise);
                *value = match fault.filter(|f| f.floor.is_none_or(|faulty| faulty == floor)) {
                    Some(fault) => fault.kind.measured(*value, noise, &mut spikes),
                    None => *value + noise,
                };
            }
            frames.push(values);
        }
        frames
    }
}

impl FaultKind {
    /// Returns the sample of a faulty sensor (m/s²).
    fn measured(self, acceleration: f64, noise: f64, random: &mut ChaCha8Rng) -> f64 {
        match self {
            Self::Dead => noise,
            Self::Gain(gain) => gain * acceleration + noise,
            Self::Noise(factor) => acceleration + factor * noise,
            Self::Spikes(share) => {
                let is_spike = Bernoulli::new(share).is_ok_and(|spike| spike.sample(random));
                let spike = if is_spike {
                    SPIKE * normal(random)
                } else {
                    0.0
                };
                acceleration + noise + spike
            }
        }
    }
}

fn normal(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}

/// Displacements and velocities relative to the ground, then the hysteretic drifts of the storeys.
struct Motion<'b> {
    building: &'b Building,
    state: Vec<f64>,
    /// Remaining share of the stiffness of each storey.
    kept: Vec<f64>,
}

impl Motion<'_> {
    fn absolute_accelerations(&self) -> Vec<f64> {
        let storeys = self.kept.len();
        let mut rates = vec![0.0; 3 * storeys];
        self.rates_to(&self.state, 0.0, &mut rates);
        rates[storeys..2 * storeys].to_vec()
    }

    /// Writes the time derivative of `state` under the ground acceleration `ground` (m/s²).
    fn rates_to(&self, state: &[f64], ground: f64, rates: &mut [f64]) {
        let building = self.building;
        let storeys = self.kept.len();
        let drift =
            |of: &[f64], storey: usize| of[storey] - if storey == 0 { 0.0 } else { of[storey - 1] };
        let (x, rest) = state.split_at(storeys);
        let (v, z) = rest.split_at(storeys);
        for storey in 0..storeys {
            let elastic = drift(x, storey);
            let rate = drift(v, storey);
            let stiffness = self.kept[storey] * building.stiffnesses_n_per_m[storey];
            let yields = building
                .yielding
                .filter(|yielding| yielding.storey == storey);
            let spring = match yields {
                Some(_) => HARDENING * elastic + (1.0 - HARDENING) * z[storey],
                None => elastic,
            };
            rates[2 * storeys + storey] = yields.map_or(0.0, |yielding| {
                let ratio = z[storey] / yielding.yield_drift_m;
                rate * (1.0 - ratio * ratio * 0.5 * (1.0 + (rate * z[storey]).signum()))
            });
            let damped = if building.damping_stays {
                building.stiffnesses_n_per_m[storey]
            } else {
                stiffness
            };
            let force = stiffness * spring + building.beta_s * damped * rate;
            rates[storeys + storey] = -force;
            if storey > 0 {
                rates[storeys + storey - 1] += force;
            }
        }
        for storey in 0..storeys {
            let damping = building.alpha_per_s * v[storey];
            let absolute = rates[storeys + storey] / building.masses_kg[storey] - damping;
            rates[storeys + storey] = absolute - ground;
            rates[storey] = v[storey];
        }
    }

    fn advance(&mut self, step_s: f64, from: f64, to: f64) {
        let len = self.state.len();
        let (mut sum, mut slope, mut point) = (vec![0.0; len], vec![0.0; len], self.state.clone());
        for (stage, weight) in [(0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)] {
            if stage > 0.0 {
                for ((point, state), slope) in point.iter_mut().zip(&self.state).zip(&slope) {
                    *point = state + stage * step_s * slope;
                }
            }
            self.rates_to(&point, from + stage * (to - from), &mut slope);
            for (sum, slope) in sum.iter_mut().zip(&slope) {
                *sum += weight * slope;
            }
        }
        for (state, sum) in self.state.iter_mut().zip(&sum) {
            *state += step_s / 6.0 * sum;
        }
    }
}
