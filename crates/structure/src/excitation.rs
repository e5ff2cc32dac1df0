//! What shakes the structure: ground motion or forces, measured or not.

use nalgebra::DMatrix;

/// Where an excitation acts.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Action {
    /// Acceleration of the ground; `T = −M ι`, `ι` (N_d) the displacements when the ground moves by 1.
    Ground { influence: Vec<f64> },
    /// A force on one degree of freedom (from 0).
    Force { degree_of_freedom: usize },
    /// Forces on several degrees of freedom that grow and fade together.
    ForceField(ForceField),
}

/// Forces with a known mean and the covariance `ψ C`, of which `ψ` is the level: `Σ_f = θ_f Σ_g⁰` of Yuen, Liang & Kuok
/// (2013), case 3.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ForceField {
    /// From 0, one for each force.
    pub(crate) degrees_of_freedom: Vec<usize>,
    /// Known mean of each force (N).
    pub(crate) mean: Vec<f64>,
    /// `C` (N²), of the samples at level 1.
    pub(crate) covariance: DMatrix<f64>,
    /// `L` (N), with `L Lᵀ = C`.
    pub(crate) factor: DMatrix<f64>,
}

/// An excitation, held over a time step: one component, or one for each force of a field.
#[derive(Debug, Clone, PartialEq)]
pub struct Excitation {
    pub(crate) name: String,
    pub(crate) action: Action,
    /// Standard deviation of one sample (m/s² or N); of a field, the factor on the deviations of its `C` (1).
    pub(crate) std: f64,
    /// Frame channel and noise standard deviation of the channel that measures it.
    pub(crate) measured: Option<Measured>,
    pub(crate) adapts: bool,
    /// Factor by which the level of an unmeasured excitation may be off either way, one standard deviation, where the file
    /// states it; 1: it is known, and white.
    pub(crate) level_factor: Option<f64>,
}

/// The channel that measures an excitation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Measured {
    /// Index in the frame.
    pub(crate) channel: usize,
    /// Noise of that channel (m/s² or N).
    pub(crate) noise_std: f64,
}

/// What an unmeasured level may be off by where the file states nothing: traffic, wind and small earthquakes differ by more
/// from hour to hour, what a person estimates from a look at a record by less.
const LEVEL_FACTOR: f64 = 3.0;

impl Excitation {
    /// Returns the name, unique among the excitations.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the expected standard deviation of one sample (m/s² or N), measured or not; of a field of forces, the
    /// factor on the deviations that its covariance states (1).
    ///
    /// The filter falls back on it for frames in which the measuring channel is missing.
    #[must_use]
    pub fn std(&self) -> f64 {
        self.std
    }

    /// Returns the frame channel that measures the excitation, if one does.
    #[must_use]
    pub fn channel(&self) -> Option<usize> {
        self.measured.map(|measured| measured.channel)
    }

    /// Returns the standard deviation (m/s² or N) of the part the filter does not know: the noise of the measuring
    /// channel, or the whole excitation.
    #[must_use]
    pub fn unknown_std(&self) -> f64 {
        self.measured
            .map_or(self.std, |measured| measured.noise_std)
    }

    /// Tells whether the variance of the unknown part is adapted.
    #[must_use]
    pub fn adapts(&self) -> bool {
        self.adapts
    }

    /// Returns the factor by which the level of an unmeasured excitation may be off either way, one standard deviation.
    ///
    /// 1 where the file states that the level is known, and for a measured excitation.
    #[must_use]
    pub fn level_factor(&self) -> f64 {
        match self.measured {
            Some(_) => 1.0,
            None => self.level_factor.unwrap_or(LEVEL_FACTOR),
        }
    }

    /// Returns the SI unit, as structure files write it.
    #[must_use]
    pub fn unit(&self) -> &'static str {
        match self.action {
            Action::Ground { .. } => "m/s2",
            Action::Force { .. } => "N",
            Action::ForceField(_) => "1",
        }
    }

    /// Returns the number of components: that of the forces of a field, otherwise 1.
    #[must_use]
    pub fn component_len(&self) -> usize {
        match &self.action {
            Action::Ground { .. } | Action::Force { .. } => 1,
            Action::ForceField(field) => field.degrees_of_freedom.len(),
        }
    }
}
