//! The noise levels: variances of the excitation and of the sensors, shared within a group, known or adapted.

/// What a noise level is the variance of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NoiseSource {
    /// The unknown part of an excitation (index from 0), all components of a field together.
    Excitation(usize),
    /// The measurement noise of these observation rows (indices from 0).
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

    /// Returns the standard deviation (unit of the source) that the file states: known, or where adaptation starts.
    #[must_use]
    pub fn std(&self) -> f64 {
        self.std
    }

    /// Tells whether the filter adapts it to the data.
    #[must_use]
    pub fn is_adapted(&self) -> bool {
        self.adapted
    }

    /// Returns what it is the variance of.
    #[must_use]
    pub fn source(&self) -> &NoiseSource {
        &self.source
    }
}
