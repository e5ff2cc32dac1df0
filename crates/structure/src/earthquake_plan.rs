//! What `[earthquakes]` states: what counts as an earthquake, and what is decided about it.

/// The `[earthquakes]` table.
#[derive(Debug, Clone, PartialEq)]
pub struct EarthquakePlan {
    /// Indices of the channels whose motion is watched, in frame order: the accelerations of the
    /// structure, or else those of its ground.
    pub channels: Vec<usize>,
    /// Acceleration above which motion is an earthquake (m/s²).
    pub trigger_m_per_s2: f64,
    /// Acceleration above which motion is strong (m/s²). Only weaker motion can show a lasting
    /// loss.
    pub strong_m_per_s2: f64,
    /// Loss of stiffness that matters, as a share.
    pub loss: f64,
    /// Probability of a loss at and above which the loss is raised, 0 to 1.
    pub credibility: f64,
    /// Times after an earthquake at which it is reported again (s), in increasing order.
    pub again_after_s: Vec<f64>,
    /// Number of recordings that are kept with their reports.
    pub keep: usize,
}

impl EarthquakePlan {
    /// Limit of weak motion of every structure (m/s²), unless its file states another one.
    pub const STRONG_M_PER_S2: f64 = 1.0;
    /// Loss of stiffness that matters, unless the file states another one.
    pub const LOSS: f64 = 0.05;
    /// Probability from which a loss is raised, unless the file states another one.
    pub const CREDIBILITY: f64 = 0.99;
    /// Five minutes, one hour, one day and one week (s).
    pub const AGAIN_AFTER_S: [f64; 4] = [300.0, 3_600.0, 86_400.0, 604_800.0];
    /// Number of recordings that are kept, unless the file states another one.
    pub const KEEP: usize = 100;
}
