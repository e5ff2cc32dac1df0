//! Settings for other crates: the particles, the band limit and the alignment of samples.

use spandrel_filter::ImportanceDensity;

/// Settings of the particle filter, `[filter] kind = "particle"`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParticleKeys {
    /// Number of particles, at least 2.
    pub particles: usize,
    /// Density from which the particles are drawn.
    pub density: ImportanceDensity,
    /// Standard deviation of the drift of each parameter (ratio to nominal per √s).
    pub drift_per_root_s: f64,
    /// Duration for which a Kalman filter runs before the particles are drawn (s).
    pub warm_up_s: f64,
}

impl Default for ParticleKeys {
    /// Returns 2000 particles from the optimal density after two seconds, and a drift of 1 % in
    /// four seconds.
    fn default() -> Self {
        Self {
            particles: 2000,
            density: ImportanceDensity::Optimal,
            drift_per_root_s: 0.005,
            warm_up_s: 2.0,
        }
    }
}

/// A causal low-pass filter, the same on every channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandLimit {
    /// Corner frequency (Hz), below half the sampling rate.
    pub frequency_hz: f64,
    /// Number of poles, even.
    pub order: usize,
}

impl BandLimit {
    /// Default order.
    pub(crate) const ORDER: usize = 4;
}

/// Alignment of samples to frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IngestSettings {
    /// Time for which a live frame waits for late samples (s).
    pub lateness_s: f64,
    /// Maximum difference between the timestamps of a sample and its frame (s), at most half a
    /// step.
    pub tolerance_s: f64,
}

impl IngestSettings {
    /// Default lateness (s): several blocks over a slow link.
    pub(crate) const LATENESS_S: f64 = 2.0;
}
