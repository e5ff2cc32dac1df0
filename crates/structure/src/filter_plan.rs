//! The filter that the owner asks for, in seconds and ratios; [`Structure::filter_settings`](crate::Structure::filter_settings)
//! turns it into steps and covariances.

use crate::settings::ParticleKeys;
use spandrel_filter::{InputHold, NoiseRule};
use std::ops::RangeInclusive;

/// The `[filter]` table of a structure file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FilterPlan {
    /// Half-life of a sample's weight (s), Huang & Yuen (2023), (2.71).
    pub(crate) half_life_s: f64,
    pub(crate) noise_rule: NoiseRule,
    /// Half-life for the noise levels (s).
    pub(crate) noise_half_life_s: f64,
    /// Standard deviation of a noise level at the start, relative to it.
    pub(crate) noise_prior_std: f64,
    /// No noise level falls below this share of its start (standard deviations).
    pub(crate) noise_floor: f64,
    pub(crate) annealing: Annealing,
    /// Particles in place of the Kalman filter, if the file asks for them.
    pub(crate) particles: Option<ParticleKeys>,
    /// How outliers are screened, if they are.
    pub(crate) outliers: Option<OutlierPlan>,
    /// A parameter's variance is kept below this times its prior variance.
    pub(crate) variance_bound: f64,
    /// Of measured excitations.
    pub(crate) input_hold: InputHold,
    /// Standard deviation of each displacement at the start (m).
    pub(crate) displacement_std_m: f64,
    /// Standard deviation of each velocity at the start (m/s).
    pub(crate) velocity_std_m_per_s: f64,
}

/// The `[outliers]` table; times are counted in fundamental periods where the file says nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct OutlierPlan {
    /// Large residuals stay out while the first scale is found.
    pub(crate) gated: bool,
    pub(crate) training_s: Option<f64>,
    pub(crate) window_s: Option<f64>,
    pub(crate) fault_window_s: Option<f64>,
    /// Share of rejected samples from which on a channel is looked into.
    pub(crate) fault_share: f64,
}

impl OutlierPlan {
    /// Samples of the training and of the fault window: fewer have no scale, and more take megabytes for each channel.
    pub(crate) const RESIDUALS: RangeInclusive<usize> = 3..=1_000_000;
    /// Samples of the window: with fewer the upper bound (4.27) falls below the lower one, two deviations; of more not even
    /// the tail fits into memory.
    pub(crate) const WINDOW: RangeInclusive<usize> = 14..=10_000_000;
}

impl Default for OutlierPlan {
    fn default() -> Self {
        Self {
            gated: true,
            training_s: None,
            window_s: None,
            fault_window_s: None,
            fault_share: 0.2,
        }
    }
}

/// Distrust of the sensors at the start: `Σ_n (1 + a e^{−t/τ})`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Annealing {
    /// `a`, 0 for none.
    pub(crate) amount: f64,
    /// `τ` (s).
    pub(crate) time_s: f64,
}

impl Default for FilterPlan {
    fn default() -> Self {
        Self {
            half_life_s: 10.0,
            noise_rule: NoiseRule::Fisher,
            noise_half_life_s: 10.0,
            // three standard deviations reach zero: Huang & Yuen (2023), §3.2
            noise_prior_std: 1.0 / 3.0,
            // a quiet hour must not make the filter believe the first seconds of shaking a hundredfold
            noise_floor: 0.1,
            // start-up: spec of chapter 2, §3.6; tolerates parameters that are 30 % off
            annealing: Annealing {
                amount: 100.0,
                time_s: 2.0,
            },
            particles: None,
            outliers: None,
            variance_bound: 1.0,
            // held, a record is late by half a step, which reads as a change of stiffness and damping
            input_hold: InputHold::First,
            // at rest: wide priors make the first updates leave the linear range of the filter
            displacement_std_m: 1e-5,
            velocity_std_m_per_s: 1e-4,
        }
    }
}
