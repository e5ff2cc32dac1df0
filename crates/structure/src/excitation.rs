//! What shakes the structure: ground motion or forces, measured or not.

/// Where an excitation acts.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Action {
    /// Acceleration of the ground; `T = −M ι`, `ι` (N_d) the displacements when the ground moves by 1.
    Ground { influence: Vec<f64> },
    /// A force on one degree of freedom (from 0).
    Force { degree_of_freedom: usize },
}

/// One component of the excitation, held over a time step.
#[derive(Debug, Clone, PartialEq)]
pub struct Excitation {
    pub(crate) name: String,
    pub(crate) action: Action,
    /// Standard deviation of one sample (m/s² or N).
    pub(crate) std: f64,
    /// Frame channel and noise standard deviation of the channel that measures it.
    pub(crate) measured: Option<Measured>,
    pub(crate) adapts: bool,
}

/// The channel that measures an excitation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Measured {
    /// Index in the frame.
    pub(crate) channel: usize,
    /// Noise of that channel (m/s² or N).
    pub(crate) noise_std: f64,
}

impl Excitation {
    /// Returns the name, unique among the excitations.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the expected standard deviation of one sample (m/s² or N), measured or not.
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
        self.measured.map_or(self.std, |measured| measured.noise_std)
    }

    /// Tells whether the variance of the unknown part is adapted.
    #[must_use]
    pub fn adapts(&self) -> bool {
        self.adapts
    }

    /// Returns the SI unit, as structure files write it.
    #[must_use]
    pub fn unit(&self) -> &'static str {
        match self.action {
            Action::Ground { .. } => "m/s2",
            Action::Force { .. } => "N",
        }
    }
}
