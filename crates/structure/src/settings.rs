//! Settings that other rooms carry out: the band limit and the alignment of samples.

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

/// How samples become frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IngestSettings {
    /// How long a frame waits for late samples (s) when the data are live.
    pub lateness_s: f64,
    /// How far the time of a sample may be from its frame (s), at most half a step.
    pub tolerance_s: f64,
}

impl IngestSettings {
    /// Default lateness: several blocks over a slow link.
    pub(crate) const LATENESS_S: f64 = 2.0;
}
