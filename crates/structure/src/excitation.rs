//! Excitation of the structure: ground motion or forces, measured or not.

use nalgebra::DMatrix;

/// Point of action of an excitation.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Action {
    /// Ground acceleration with `T = −M ι`.
    ///
    /// `ι` (N_d) contains the displacements for a ground displacement of 1.
    Ground { influence: Vec<f64> },
    /// A force on one degree of freedom (from 0).
    Force { degree_of_freedom: usize },
    /// Forces on several degrees of freedom that grow and fade together.
    ForceField(ForceField),
}

/// Forces with a known mean and the covariance `ψ C`, where `ψ` is the level.
///
/// This is `Σ_f = θ_f Σ_g⁰` of Yuen, Liang & Kuok (2013), case 3.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ForceField {
    /// Degrees of freedom (from 0), one per force.
    pub(crate) degrees_of_freedom: Vec<usize>,
    /// Known mean of each force (N).
    pub(crate) mean: Vec<f64>,
    /// `C` (N²), the covariance of the samples at level 1.
    pub(crate) covariance: DMatrix<f64>,
    /// `L` (N), with `L Lᵀ = C`.
    pub(crate) factor: DMatrix<f64>,
}

/// An excitation: one component, or one component per force of a field.
#[derive(Debug, Clone, PartialEq)]
pub struct Excitation {
    pub(crate) name: String,
    pub(crate) action: Action,
    /// Standard deviation of one sample (m/s² or N); for a field, the factor on the deviations of
    /// `C` (1).
    pub(crate) std: f64,
    /// Frame channel and noise standard deviation of the measuring channel.
    pub(crate) measured: Option<Measured>,
    pub(crate) adapts: bool,
    /// Factor by which the level of an unmeasured excitation may be off either way, if the file
    /// states it.
    ///
    /// The factor is one standard deviation. 1 means that the level is known and the excitation is
    /// white.
    pub(crate) level_factor: Option<f64>,
}

/// Channel that measures an excitation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Measured {
    /// Index in the frame.
    pub(crate) channel: usize,
    /// Noise standard deviation of the channel (m/s² or N).
    pub(crate) noise_std: f64,
}

/// Default factor by which an unmeasured level may be off.
///
/// Traffic, wind and small earthquakes vary by more from hour to hour. An estimate by eye from a
/// record varies by less.
const LEVEL_FACTOR: f64 = 3.0;

impl Excitation {
    /// Returns the name, unique among the excitations.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the expected standard deviation of one sample (m/s² or N), measured or not.
    ///
    /// For a force field it returns the factor on the standard deviations of its covariance (1).
    /// The filter uses this value for frames without a sample of the measuring channel.
    #[must_use]
    pub fn std(&self) -> f64 {
        self.std
    }

    /// Returns the frame channel that measures the excitation, if any.
    #[must_use]
    pub fn channel(&self) -> Option<usize> {
        self.measured.map(|measured| measured.channel)
    }

    /// Returns the standard deviation (m/s² or N) of the part that the filter does not know.
    ///
    /// This is the noise of the measuring channel, or the whole excitation if no channel measures
    /// it.
    #[must_use]
    pub fn unknown_std(&self) -> f64 {
        self.measured
            .map_or(self.std, |measured| measured.noise_std)
    }

    /// Returns `true` if the filter adapts the variance of the unknown part.
    #[must_use]
    pub fn adapts(&self) -> bool {
        self.adapts
    }

    /// Returns the factor by which the level of an unmeasured excitation may be off either way.
    ///
    /// The factor is one standard deviation. It is 1 if the file states that the level is known,
    /// and for a measured excitation.
    #[must_use]
    pub fn level_factor(&self) -> f64 {
        match self.measured {
            Some(_) => 1.0,
            None => self.level_factor.unwrap_or(LEVEL_FACTOR),
        }
    }

    /// Returns the SI unit in the notation of structure files.
    #[must_use]
    pub fn unit(&self) -> &'static str {
        match self.action {
            Action::Ground { .. } => "m/s2",
            Action::Force { .. } => "N",
            Action::ForceField(_) => "1",
        }
    }

    /// Returns the number of components: the number of forces of a field, otherwise 1.
    #[must_use]
    pub fn component_len(&self) -> usize {
        match &self.action {
            Action::Ground { .. } | Action::Force { .. } => 1,
            Action::ForceField(field) => field.degrees_of_freedom.len(),
        }
    }
}
