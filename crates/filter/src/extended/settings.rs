//! All that a filter needs to know besides its model.

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

/// Start-up aid: the measurement noise is taken as `Σ_n (1 + a e^(−t/τ))`.
///
/// With accurate sensors and parameters that start far off, the first updates lie outside the linear range of the
/// filter and lock it at wrong values with small deviations; softened, they do not.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Annealing {
    /// `a`, 0 for none.
    pub amount: f64,
    /// `τ` (s).
    pub time_constant_s: f64,
}

/// All that a filter needs to know besides its model.
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
    /// No variance exceeds this (n, state unit²); infinite where there is no bound.
    pub variance_bound: DVector<f64>,
    /// The state is kept above this (n); minus infinity where there is no limit.
    pub lower: DVector<f64>,
    /// The state is kept below this (n).
    pub upper: DVector<f64>,
    /// Both noises.
    pub noise: NoiseModel,
    /// How the noise parameters are identified.
    pub noise_settings: NoiseSettings,
    /// How outliers are screened, if they are.
    pub outliers: Option<OutlierSettings>,
    /// Start-up aid, if any.
    pub annealing: Option<Annealing>,
    /// How misfit is measured and answered; `None` trusts the model.
    pub misfit: Option<MisfitSettings>,
    /// Standard deviation of each entry of the state that no datum can reduce (n): the published covariance includes it.
    ///
    /// A parameter that is identified by way of an assumption has the deviation here that follows from the assumption.
    pub considered_std: DVector<f64>,
    /// How a known excitation runs between frames.
    pub input_hold: InputHold,
    /// The form of the covariance update.
    pub covariance_form: CovarianceForm,
}

impl FilterSettings {
    /// Makes settings with no forgetting, no bounds, known noises and no start-up aid.
    #[must_use]
    pub fn new(
        step_s: f64,
        prior_mean: DVector<f64>,
        prior_std: DVector<f64>,
        noise: NoiseModel,
    ) -> Self {
        let n = prior_mean.len();
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
            annealing: None,
            misfit: None,
            considered_std: DVector::zeros(n),
            input_hold: InputHold::Zero,
            covariance_form: CovarianceForm::Symmetric,
        }
    }

    /// Returns the variance of the noise of each channel before anything is identified (N_0).
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
        if !(self.step_s > 0.0 && self.step_s.is_finite()) {
            return Err(FilterError::Setting {
                what: "time step",
                found: self.step_s,
                allowed: "positive",
            });
        }
        for (&low, &high) in self.lower.iter().zip(&self.upper) {
            // `clamp` panics on such limits
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
