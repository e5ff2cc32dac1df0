//! Settings of a filter, except for its model.

use crate::discretise::InputHold;
use crate::error::FilterError;
use crate::fading::FadingFactor;
use crate::misfit::MisfitSettings;
use crate::model::{ObservationModel, ProcessModel};
use crate::noise::{NoiseModel, NoiseSettings, NoiseTarget};
use crate::outlier::OutlierSettings;
use crate::update::CovarianceForm;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};

/// Start-up aid that increases the measurement noise to `Σ_n (1 + a e^(−t/τ))`.
///
/// If the sensors are accurate and the initial parameters are far from the truth, the first updates
/// leave the linear range of the filter. It then locks at wrong values with small standard
/// deviations. The increased noise prevents this.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Annealing {
    /// `a`, 0 for no effect.
    pub amount: f64,
    /// `τ` (s).
    pub time_constant_s: f64,
}

/// Settings of a filter, except for its model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FilterSettings {
    /// Time between two frames (s).
    pub step_s: f64,
    /// Mean of the state before the first frame (n).
    pub prior_mean: DVector<f64>,
    /// Standard deviation of the state before the first frame (n).
    pub prior_std: DVector<f64>,
    /// `λ` of the state.
    pub fading: FadingFactor,
    /// Largest variance of each state entry (n, state unit²); infinite for no bound.
    pub variance_bound: DVector<f64>,
    /// Lower limit of the state (n); minus infinity for no limit.
    pub lower: DVector<f64>,
    /// Upper limit of the state (n); infinite for no limit.
    pub upper: DVector<f64>,
    /// Covariances of the excitation noise and the measurement noise.
    pub noise: NoiseModel,
    /// Settings for the identification of the noise parameters.
    pub noise_settings: NoiseSettings,
    /// Settings for the screening of outliers; `None` disables it.
    pub outliers: Option<OutlierSettings>,
    /// Number of the sensor of each observation (N_0), from 0. A fault can affect all observations
    /// of one sensor.
    pub sensors: Vec<usize>,
    /// Start-up aid; `None` disables it.
    pub annealing: Option<Annealing>,
    /// Settings for the measurement of misfit and the reaction to it; `None` trusts the model.
    pub misfit: Option<MisfitSettings>,
    /// Standard deviation of each state entry that no datum can reduce (n). The published
    /// covariance includes it.
    ///
    /// For a parameter whose identification relies on an assumption, it is the standard deviation
    /// that follows from this assumption.
    pub considered_std: DVector<f64>,
    /// Course of a known excitation between frames.
    pub input_hold: InputHold,
    /// Form of the covariance update.
    pub covariance_form: CovarianceForm,
}

impl FilterSettings {
    /// Creates settings with no forgetting, no bounds, known noise covariances, no start-up aid,
    /// and one sensor per observation.
    #[must_use]
    pub fn new(
        step_s: f64,
        prior_mean: DVector<f64>,
        prior_std: DVector<f64>,
        noise: NoiseModel,
    ) -> Self {
        let (n, observations) = (prior_mean.len(), noise.sensors.nrows());
        Self {
            step_s,
            prior_mean,
            prior_std,
            fading: FadingFactor::NONE,
            variance_bound: DVector::repeat(n, f64::INFINITY),
            lower: DVector::repeat(n, f64::NEG_INFINITY),
            upper: DVector::repeat(n, f64::INFINITY),
            noise,
            noise_settings: NoiseSettings::default(),
            outliers: None,
            sensors: (0..observations).collect(),
            annealing: None,
            misfit: None,
            considered_std: DVector::zeros(n),
            input_hold: InputHold::Zero,
            covariance_form: CovarianceForm::Symmetric,
        }
    }

    /// Returns the noise variance of each channel before identification (N_0).
    pub(crate) fn stated_noise(&self) -> impl Iterator<Item = f64> {
        let identified = |channel: usize| -> f64 {
            let of_sensors = self
                .noise
                .parameters
                .iter()
                .filter(|parameter| parameter.target == NoiseTarget::Sensors);
            of_sensors
                .map(|parameter| parameter.start * parameter.pattern[(channel, channel)])
                .sum()
        };
        (0..self.noise.sensors.nrows())
            .map(move |channel| self.noise.sensors[(channel, channel)] + identified(channel))
    }

    pub(crate) fn check(
        &self,
        model: &(impl ProcessModel + ObservationModel),
    ) -> Result<(), FilterError> {
        let n = model.state_len();
        let vectors = [
            ("prior mean", self.prior_mean.len()),
            ("prior standard deviation", self.prior_std.len()),
            ("variance bound", self.variance_bound.len()),
            ("lower limit", self.lower.len()),
            ("upper limit", self.upper.len()),
            ("considered standard deviation", self.considered_std.len()),
        ];
        for (what, found) in vectors {
            if found != n {
                return Err(FilterError::Dimension {
                    what,
                    found,
                    expected: n,
                });
            }
        }
        if self.sensors.len() != model.observation_len() {
            return Err(FilterError::Dimension {
                what: "sensors of the observations",
                found: self.sensors.len(),
                expected: model.observation_len(),
            });
        }
        if let Some(sensor) = self
            .sensors
            .iter()
            .find(|sensor| **sensor >= self.sensors.len())
        {
            return Err(FilterError::Setting {
                what: "number of a sensor",
                found: *sensor as f64,
                allowed: "below the number of observations",
            });
        }
        if !(self.step_s > 0.0 && self.step_s.is_finite()) {
            return Err(FilterError::Setting {
                what: "time step",
                found: self.step_s,
                allowed: "positive",
            });
        }
        for (&low, &high) in self.lower.iter().zip(&self.upper) {
            // `clamp` panics if its limits are NaN or in the wrong order.
            if low.is_nan() || high.is_nan() || low > high {
                let allowed = "not above its upper limit, and a number";
                return Err(FilterError::Setting {
                    what: "lower limit of the state",
                    found: low,
                    allowed,
                });
            }
        }
        for &std in &self.prior_std {
            if !(std >= 0.0 && std.is_finite()) {
                let what = "prior standard deviation";
                return Err(FilterError::Setting {
                    what,
                    found: std,
                    allowed: "finite and not negative",
                });
            }
        }
        self.noise_settings.check(self.noise.parameters.len())?;
        if let Some(outliers) = &self.outliers {
            outliers.check()?;
        }
        self.noise
            .check(model.excitation_len(), model.observation_len())
    }
}
