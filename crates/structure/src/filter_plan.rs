//! Filter settings of the structure file, in seconds and ratios.
//!
//! [`Structure::filter_settings`](crate::Structure::filter_settings) converts them to steps and
//! covariances.

use crate::settings::ParticleKeys;
use spandrel_filter::{InputHold, NoiseRule};
use std::ops::RangeInclusive;

/// The `[filter]` table of a structure file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FilterPlan {
    /// Half-life of a sample's weight (s), Huang & Yuen (2023), (2.71).
    pub(crate) half_life_s: f64,
    pub(crate) noise_rule: NoiseRule,
    /// Half-life of the noise levels (s).
    pub(crate) noise_half_life_s: f64,
    /// Initial standard deviation of a noise level, relative to the level.
    pub(crate) noise_prior_std: f64,
    /// Lower limit of a noise level as a share of its initial value (standard deviations).
    pub(crate) noise_floor: f64,
    pub(crate) annealing: Annealing,
    /// Keys of the particle filter; `None` for the Kalman filter.
    pub(crate) particles: Option<ParticleKeys>,
    /// Keys of outlier screening; `None` without screening.
    pub(crate) outliers: Option<OutlierPlan>,
    /// Upper limit of a parameter's variance as a multiple of its prior variance.
    pub(crate) variance_bound: f64,
    /// Hold of measured excitations between samples.
    pub(crate) input_hold: InputHold,
    /// Initial standard deviation of each displacement (m).
    pub(crate) displacement_std_m: f64,
    /// Initial standard deviation of each velocity (m/s).
    pub(crate) velocity_std_m_per_s: f64,
}

/// The `[outliers]` table; `None` stands for a number of fundamental periods.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct OutlierPlan {
    /// `true` if the training ignores large residuals when it determines the first scale.
    pub(crate) gated: bool,
    pub(crate) training_s: Option<f64>,
    pub(crate) window_s: Option<f64>,
    pub(crate) fault_window_s: Option<f64>,
    /// Share of rejected samples above which a channel is investigated.
    pub(crate) fault_share: f64,
}

impl OutlierPlan {
    /// Allowed number of samples of the training and of the fault window.
    ///
    /// Fewer samples have no scale, and more take megabytes for each channel.
    pub(crate) const RESIDUALS: RangeInclusive<usize> = 3..=1_000_000;
    /// Allowed number of samples of the window.
    ///
    /// With fewer samples, the upper bound (4.27) falls below the lower bound of two standard
    /// deviations. With more, not even the tail fits into memory.
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

/// Initially increased sensor noise: `Σ_n (1 + a e^{−t/τ})`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Annealing {
    /// `a`, 0 for no annealing.
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
            // Three standard deviations reach zero: Huang & Yuen (2023), §3.2.
            noise_prior_std: 1.0 / 3.0,
            // A quiet hour must not make the filter trust the first seconds of shaking a
            // hundredfold.
            noise_floor: 0.1,
            // Start-up: spec of chapter 2, §3.6; tolerates parameters that are 30 % off.
            annealing: Annealing {
                amount: 100.0,
                time_s: 2.0,
            },
            particles: None,
            outliers: None,
            variance_bound: 1.0,
            // A held record is late by half a step, which looks like a change of stiffness and
            // damping.
            input_hold: InputHold::First,
            // At rest: wide priors make the first updates leave the linear range of the filter.
            displacement_std_m: 1e-5,
            velocity_std_m_per_s: 1e-4,
        }
    }
}
