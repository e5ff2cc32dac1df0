//! What turns frames into estimates: one filter, or one for each model class.

use spandrel_filter::{
    ClassBank, ExtendedKalmanFilter, FilterError, FilterSettings, Frame, NoiseState, OutlierState, Step,
};
use spandrel_structure::{Structure, StructureClasses, StructureModel};

/// The estimation of one structure, in terms of the parameters of its file.
#[derive(Debug)]
pub enum Estimator {
    /// One model, with all parameters of the file.
    Filter(Box<ExtendedKalmanFilter<StructureModel>>),
    /// Several models, weighted by their plausibilities.
    Classes(Box<ClassBank<StructureClasses>>),
}

impl Estimator {
    /// Makes what the structure file asks for, at its prior.
    ///
    /// # Errors
    /// When a filter refuses its settings.
    pub fn new(structure: &Structure) -> Result<Self, FilterError> {
        Ok(match structure.class_bank()? {
            Some(bank) => Self::Classes(Box::new(bank)),
            None => {
                let filter = ExtendedKalmanFilter::new(structure.model(), structure.filter_settings()?)?;
                Self::Filter(Box::new(filter))
            }
        })
    }

    /// Takes one frame.
    ///
    /// # Errors
    /// When the frame does not fit, or the estimation has diverged and must be restarted.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<Step, FilterError> {
        match self {
            Self::Filter(filter) => filter.step(frame),
            Self::Classes(bank) => bank.step(frame),
        }
    }

    /// Goes back to the prior.
    ///
    /// # Errors
    /// When a filter cannot be made, which has been possible before.
    pub fn restart(&mut self) -> Result<(), FilterError> {
        match self {
            Self::Filter(filter) => {
                filter.restart();
                Ok(())
            }
            Self::Classes(bank) => bank.restart(),
        }
    }

    /// Forgets the motion and keeps everything else.
    pub fn forget_motion(&mut self) {
        match self {
            Self::Filter(filter) => filter.forget_motion(),
            Self::Classes(bank) => bank.forget_motion(),
        }
    }

    /// Returns the settings of the model with all parameters.
    #[must_use]
    pub fn settings(&self) -> &FilterSettings {
        match self {
            Self::Filter(filter) => filter.settings(),
            Self::Classes(bank) => bank.template(),
        }
    }

    /// Returns the means of the parameters (ratios to nominal), in the order of the file.
    #[must_use]
    pub fn parameter_mean(&self) -> &[f64] {
        match self {
            Self::Filter(filter) => &filter.mean().as_slice()[self.first()..],
            Self::Classes(bank) => bank.parameter_mean().as_slice(),
        }
    }

    /// Returns the covariance of two parameters.
    #[must_use]
    pub fn parameter_covariance(&self, i: usize, j: usize) -> f64 {
        match self {
            Self::Filter(filter) => filter.covariance()[(self.first() + i, self.first() + j)],
            Self::Classes(bank) => bank.parameter_covariance()[(i, j)],
        }
    }

    /// Returns the bounds of a parameter (ratios to nominal).
    #[must_use]
    pub fn bounds(&self, parameter: usize) -> (f64, f64) {
        let (settings, entry) = (self.settings(), self.first() + parameter);
        (settings.lower[entry], settings.upper[entry])
    }

    /// Returns what is known of the noise parameters.
    #[must_use]
    pub fn noise(&self) -> &NoiseState {
        match self {
            Self::Filter(filter) => filter.noise(),
            Self::Classes(bank) => bank.noise(),
        }
    }

    /// Returns what is known of outliers in each channel; `None` where they are not screened.
    #[must_use]
    pub fn outliers(&self) -> Option<&OutlierState> {
        match self {
            Self::Filter(filter) => filter.outliers(),
            Self::Classes(bank) => bank.outliers(),
        }
    }

    /// Returns the innovation of the last step, NaN where a channel was missing or rejected.
    #[must_use]
    pub fn innovation(&self) -> &[f64] {
        match self {
            Self::Filter(filter) => filter.innovation().as_slice(),
            Self::Classes(bank) => bank.innovation().as_slice(),
        }
    }

    /// Returns the model classes, if there are several.
    #[must_use]
    pub fn classes(&self) -> Option<&ClassBank<StructureClasses>> {
        match self {
            Self::Filter(_) => None,
            Self::Classes(bank) => Some(bank),
        }
    }

    /// Returns the number of entries of the state before the parameters.
    fn first(&self) -> usize {
        match self {
            Self::Filter(filter) => filter.mean().len() - spandrel_filter::ProcessModel::parameter_len(filter.model()),
            Self::Classes(bank) => bank.motion().len(),
        }
    }
}
