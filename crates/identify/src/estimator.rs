//! The estimator of a structure: one filter, one filter per model class, or particles.

use crate::particles::{ParticleMemory, ParticlePlan, Particles};
use serde::{Deserialize, Serialize};
use spandrel_filter::{
    ChannelFit, ClassBank, ClassBankState, ExtendedKalmanFilter, FilterError, FilterSettings,
    FilterState, Fit, Frame, NoiseState, OutlierState, ProcessModel, Step,
};
use spandrel_structure::{Structure, StructureClasses, StructureModel};

/// The estimator of one structure: one filter, a bank of filters, or particles.
///
/// [`Estimator::new`] chooses the variant from the structure file, with all filters at their prior.
/// All variants have the same methods. With several model classes, most methods return the estimate
/// of the most plausible class or of all classes, as each method states.
#[derive(Debug)]
pub enum Estimator {
    /// One model with all parameters of the file.
    Filter(Box<ExtendedKalmanFilter<StructureModel>>),
    /// Several models, weighted by their plausibilities.
    Classes(Box<ClassBank<StructureClasses>>),
    /// One model without Gaussian assumptions: slow, but a reference for the other two.
    Particles(Box<Particles>),
}

/// The state of an estimator between two frames, as stored in a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(
    clippy::large_enum_variant,
    reason = "one of them exists per structure, and it lives in a checkpoint only"
)]
pub enum EstimatorState {
    /// State of one model.
    Filter(FilterState),
    /// State of several models.
    Classes(ClassBankState),
    /// State of particles.
    Particles(ParticleMemory),
}

impl Estimator {
    /// Creates the estimator that the structure file specifies, at its prior.
    ///
    /// # Errors
    /// Returns an error if a filter rejects its settings.
    pub fn new(structure: &Structure) -> Result<Self, FilterError> {
        if let Some(keys) = structure.particles() {
            return Self::with_particles(structure, &ParticlePlan::of(&keys));
        }
        Self::kalman(structure)
    }

    /// Creates the Kalman filter or the bank of model classes, even if the structure file specifies
    /// particles.
    ///
    /// # Errors
    /// Returns an error if a filter rejects its settings.
    pub fn kalman(structure: &Structure) -> Result<Self, FilterError> {
        Ok(match structure.class_bank()? {
            Some(bank) => Self::Classes(Box::new(bank)),
            None => {
                let filter =
                    ExtendedKalmanFilter::new(structure.model(), structure.filter_settings()?)?;
                Self::Filter(Box::new(filter))
            }
        })
    }

    /// Creates a particle filter for the model of the structure, at its prior.
    ///
    /// # Errors
    /// Returns an error if a setting is out of range.
    pub fn with_particles(structure: &Structure, plan: &ParticlePlan) -> Result<Self, FilterError> {
        let particles = Particles::new(structure, plan)?;
        Ok(Self::Particles(Box::new(particles)))
    }

    /// Processes one frame. Returns the result of the step, such as the number of used channels.
    /// The estimates are available from the other methods.
    ///
    /// # Errors
    /// Returns an error if the frame has the wrong size, or if the estimation has diverged and must
    /// be restarted.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<Step, FilterError> {
        match self {
            Self::Filter(filter) => filter.step(frame),
            Self::Classes(bank) => bank.step(frame),
            Self::Particles(particles) => particles.step(frame),
        }
    }

    /// Sets whether the next frame contains information about the parameters. Particles ignore it.
    pub fn set_teaching(&mut self, teaches: bool) {
        match self {
            Self::Filter(filter) => filter.set_teaching(teaches),
            Self::Classes(bank) => bank.set_teaching(teaches),
            Self::Particles(_) => {}
        }
    }

    /// Sets the reliability of each component of the measured excitation (N_f, 0 to 1) in the next
    /// frame. Particles ignore it.
    ///
    /// # Errors
    /// Returns an error if the length does not match the model, or a value is outside 0 to 1.
    pub fn set_reliability(&mut self, reliability: &[f64]) -> Result<(), FilterError> {
        match self {
            Self::Filter(filter) => filter.set_reliability(reliability),
            Self::Classes(bank) => bank.set_reliability(reliability),
            Self::Particles(_) => Ok(()),
        }
    }

    /// Restarts from the prior.
    ///
    /// # Errors
    /// Returns an error if a filter rejects its settings, which cannot happen with settings
    /// accepted before.
    pub fn restart(&mut self) -> Result<(), FilterError> {
        match self {
            Self::Filter(filter) => {
                filter.restart();
                Ok(())
            }
            Self::Classes(bank) => bank.restart(),
            Self::Particles(particles) => particles.restart(),
        }
    }

    /// Sets the standard deviations of the parameters of a single filter to a multiple of those of
    /// the prior. The means remain.
    ///
    /// # Errors
    /// Returns an error if the covariance is singular.
    pub fn set_parameter_std(&mut self, of_prior: f64) -> Result<(), FilterError> {
        let first = self.first();
        match self {
            Self::Filter(filter) if filter.model().parameter_len() > 0 => {
                let mut parameters = filter.parameters();
                let prior_std = &filter.settings().prior_std;
                parameters.covariance.fill(0.0);
                for (j, std) in prior_std.iter().skip(first).enumerate() {
                    parameters.covariance[(j, j)] = (of_prior * std).powi(2);
                }
                filter.replace_parameters(&parameters)
            }
            Self::Filter(_) | Self::Classes(_) | Self::Particles(_) => Ok(()),
        }
    }

    /// Discards the motion after a gap that is too long to bridge: the physical state returns to
    /// its prior. Parameters, noise levels and plausibilities remain.
    pub fn forget_motion(&mut self) {
        match self {
            Self::Filter(filter) => filter.forget_motion(),
            Self::Classes(bank) => bank.forget_motion(),
            Self::Particles(particles) => particles.forget_motion(),
        }
    }

    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> EstimatorState {
        match self {
            Self::Filter(filter) => EstimatorState::Filter(filter.state().clone()),
            Self::Classes(bank) => EstimatorState::Classes(bank.state()),
            Self::Particles(particles) => EstimatorState::Particles(particles.state()),
        }
    }

    /// Restores the state of a checkpoint. The next results are bit-identical to an uninterrupted
    /// run.
    ///
    /// # Errors
    /// Returns an error if the state belongs to another kind of estimator, or does not match the
    /// models.
    pub fn restore(&mut self, state: EstimatorState) -> Result<(), FilterError> {
        match (self, state) {
            (Self::Filter(filter), EstimatorState::Filter(state)) => filter.restore(state),
            (Self::Classes(bank), EstimatorState::Classes(state)) => bank.restore(state),
            (Self::Particles(particles), EstimatorState::Particles(state)) => {
                particles.restore(state)
            }
            (Self::Filter(_) | Self::Classes(_) | Self::Particles(_), _) => {
                let what =
                    "kind of estimator of a checkpoint (0: another, 1: that of the structure file)";
                Err(FilterError::Dimension {
                    what,
                    found: 0,
                    expected: 1,
                })
            }
        }
    }

    /// Returns the settings of the model with all parameters.
    #[must_use]
    pub fn settings(&self) -> &FilterSettings {
        match self {
            Self::Filter(filter) => filter.settings(),
            Self::Classes(bank) => bank.template(),
            Self::Particles(particles) => particles.kalman().settings(),
        }
    }

    /// Returns the means of the parameters (ratios to nominal), in the order of the file.
    #[must_use]
    pub fn parameter_mean(&self) -> &[f64] {
        match self {
            Self::Filter(filter) => &filter.mean().as_slice()[self.first()..],
            Self::Classes(bank) => bank.parameter_mean().as_slice(),
            Self::Particles(particles) => particles.parameter_mean(),
        }
    }

    /// Returns the covariance of the parameters with the indices `i` and `j` in file order (ratios
    /// to nominal). For one model, it includes the contribution of the misfit.
    #[must_use]
    pub fn parameter_covariance(&self, i: usize, j: usize) -> f64 {
        match self {
            Self::Filter(filter) => filter.parameter_covariance(i, j),
            Self::Classes(bank) => bank.parameter_covariance()[(i, j)],
            Self::Particles(particles) => particles.parameter_covariance(i, j),
        }
    }

    /// Returns the variance of parameter `j` (ratio to nominal) that the present learning rate
    /// sustains. `None` if it is not measured: at the start, with several model classes, and with
    /// particles.
    #[must_use]
    pub fn sustained_variance(&self, j: usize) -> Option<f64> {
        match self {
            Self::Filter(filter) => filter.sustained_variance(j),
            Self::Classes(_) | Self::Particles(_) => None,
        }
    }

    /// Returns mean and standard deviation of a linear combination of the physical state.
    ///
    /// Each of the `terms` is the index of a state entry, from 0, and its factor. The results have
    /// the unit of the sum, for example m for displacements.
    ///
    /// With several model classes, it uses the most plausible class.
    #[must_use]
    pub fn response(&self, terms: &[(usize, f64)]) -> (f64, f64) {
        let (mean, covariance) = match self {
            Self::Filter(filter) => (filter.mean().as_slice(), filter.covariance()),
            Self::Classes(bank) => {
                let filter = bank.filter(bank.leader());
                (filter.mean().as_slice(), filter.covariance())
            }
            Self::Particles(particles) => (particles.state_mean(), particles.state_covariance()),
        };
        let value = terms
            .iter()
            .map(|(entry, factor)| factor * mean[*entry])
            .sum();
        let pairs = terms
            .iter()
            .flat_map(|one| terms.iter().map(move |other| (one, other)));
        let variance: f64 = pairs
            .map(|((i, a), (j, b))| a * b * covariance[(*i, *j)])
            .sum();
        (value, variance.max(0.0).sqrt())
    }

    /// Returns `true` if the last step kept a parameter, given by its index in file order, at one
    /// of its bounds.
    #[must_use]
    pub fn is_at_bound(&self, parameter: usize) -> bool {
        match self {
            Self::Filter(_) | Self::Particles(_) => {
                let (settings, entry) = (self.settings(), self.first() + parameter);
                let mean = self.parameter_mean()[parameter];
                mean <= settings.lower[entry] || mean >= settings.upper[entry]
            }
            Self::Classes(bank) => bank.limited_parameters().contains(&parameter),
        }
    }

    /// Returns the state of the noise parameters.
    #[must_use]
    pub fn noise(&self) -> &NoiseState {
        match self {
            Self::Filter(filter) => filter.noise(),
            Self::Classes(bank) => bank.noise(),
            Self::Particles(particles) => particles.kalman().noise(),
        }
    }

    /// Returns the verdict on the fit after the last step.
    ///
    /// With several model classes, it is the verdict of the most plausible class. There is no
    /// verdict if the fit is not measured.
    #[must_use]
    pub fn fit(&self) -> Fit {
        match self {
            Self::Filter(filter) => filter.fit(),
            Self::Classes(bank) => bank.filter(bank.leader()).fit(),
            Self::Particles(_) => Fit::default(),
        }
    }

    /// Returns the measures of fit of each channel. Empty if the estimator has none.
    #[must_use]
    pub fn channel_fits(&self) -> &[ChannelFit] {
        match self {
            Self::Filter(filter) => filter.channel_fits(),
            Self::Classes(bank) => bank.filter(bank.leader()).channel_fits(),
            Self::Particles(_) => &[],
        }
    }

    /// Returns the outlier state of all channels. `None` if they are not screened.
    #[must_use]
    pub fn outliers(&self) -> Option<&OutlierState> {
        match self {
            Self::Filter(filter) => filter.outliers(),
            Self::Classes(bank) => bank.outliers(),
            Self::Particles(_) => None,
        }
    }

    /// Returns the innovation of the last step, NaN for missing or rejected channels.
    #[must_use]
    pub fn innovation(&self) -> &[f64] {
        match self {
            Self::Filter(filter) => filter.innovation().as_slice(),
            Self::Classes(bank) => bank.innovation().as_slice(),
            Self::Particles(particles) => particles.innovation(),
        }
    }

    /// Returns the prediction of each channel by the last step (SI units), including missing
    /// channels. Empty if the estimator is not a single filter.
    #[must_use]
    pub fn predicted(&self) -> &[f64] {
        match self {
            Self::Filter(filter) => filter.predicted().as_slice(),
            Self::Classes(_) | Self::Particles(_) => &[],
        }
    }

    /// Returns a copy of a single filter that continues from `state`. `None` for other estimators,
    /// and for a state that does not belong to the filter.
    pub(crate) fn resumed(&self, state: &EstimatorState) -> Option<Self> {
        let (Self::Filter(filter), EstimatorState::Filter(state)) = (self, state) else {
            return None;
        };
        let mut filter = filter.clone();
        filter.restore(state.clone()).ok()?;
        Some(Self::Filter(filter))
    }

    /// Returns the model classes, if there are several.
    #[must_use]
    pub fn classes(&self) -> Option<&ClassBank<StructureClasses>> {
        match self {
            Self::Filter(_) | Self::Particles(_) => None,
            Self::Classes(bank) => Some(bank),
        }
    }

    /// Returns the number of state entries before the parameters.
    fn first(&self) -> usize {
        match self {
            Self::Filter(filter) => filter.mean().len() - filter.model().parameter_len(),
            Self::Classes(bank) => bank.motion().len(),
            Self::Particles(particles) => particles.first(),
        }
    }
}
