//! Noise levels: variances of excitations and sensor groups, known or adapted.

/// Source of the noise with this level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NoiseSource {
    /// Unknown part of an excitation (index from 0); all components of a field together.
    Excitation(usize),
    /// Measurement noise of these observation rows (indices from 0).
    Sensors(Vec<usize>),
}

/// One variance of the excitation or of a group of sensors.
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseLevel {
    pub(crate) name: String,
    pub(crate) std: f64,
    pub(crate) adapted: bool,
    pub(crate) source: NoiseSource,
}

impl NoiseLevel {
    /// Returns the name, unique among the noise levels.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the standard deviation (unit of the source) stated in the file.
    ///
    /// It is the known value or the initial value of the adaptation.
    #[must_use]
    pub fn std(&self) -> f64 {
        self.std
    }

    /// Returns `true` if the filter adapts the level to the data.
    #[must_use]
    pub fn is_adapted(&self) -> bool {
        self.adapted
    }

    /// Returns the source of the noise.
    #[must_use]
    pub fn source(&self) -> &NoiseSource {
        &self.source
    }
}
