//! Tells strong from weak motion, for the flags of the estimates.
//!
//! Motion is strong by the rule that finds earthquakes in the frames, with the limit
//! `strong-m-per-s2` as its trigger. It therefore ends when no window has been strong for 20 to 40
//! s.

use serde::{Deserialize, Serialize};
use spandrel_earthquake::{
    Detected, Detection, DetectionSettings, DetectionState, EarthquakeError,
};
use spandrel_structure::Structure;

/// The motion of one structure.
#[derive(Debug)]
pub(super) struct Motion {
    detection: Detection,
    /// Indices of the channels that are watched.
    channels: Vec<usize>,
    /// Largest acceleration of the present strong motion (m/s²).
    peak: f64,
    /// Scratch space: the values of the watched channels, and what they have shown.
    watched: Vec<f64>,
    found: Vec<Detected>,
}

/// What a checkpoint contains of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct MotionState {
    detection: DetectionState,
    peak: f64,
}

impl Motion {
    /// Returns `None` if the structure file does not state what strong motion is.
    ///
    /// # Errors
    /// Returns an error if a setting is out of range.
    pub(super) fn new(structure: &Structure) -> Result<Option<Self>, EarthquakeError> {
        let Some(plan) = structure.earthquakes() else {
            return Ok(None);
        };
        let detection = Detection::new(DetectionSettings {
            rate_hz: structure.sampling_rate_hz(),
            fundamental_hz: structure.fundamental_hz().unwrap_or(1.0),
            channels: plan.channels.len(),
            trigger: plan.strong_m_per_s2,
            strong: plan.strong_m_per_s2,
            again_after_s: Vec::new(),
            most_frames: u64::MAX, // nothing is recorded
        })?;
        Ok(Some(Self {
            detection,
            watched: vec![f64::NAN; plan.channels.len()],
            channels: plan.channels.clone(),
            peak: 0.0,
            found: Vec::new(),
        }))
    }

    /// Takes the values of a frame as measured.
    pub(super) fn take(&mut self, frame: u64, time_ns: i64, values: &[f64]) {
        for (value, channel) in self.watched.iter_mut().zip(&self.channels) {
            *value = values.get(*channel).copied().unwrap_or(f64::NAN);
        }
        self.found.clear();
        let found = &mut self.found;
        let deviation = self.detection.push(frame, time_ns, &self.watched, found);
        self.peak = match self.detection.is_shaking() {
            true => self.peak.max(deviation),
            false => 0.0,
        };
    }

    /// Restarts with the frames of another epoch.
    pub(super) fn restart(&mut self) {
        self.found.clear();
        self.detection.restart(&mut self.found);
        self.peak = 0.0;
    }

    /// Returns the largest acceleration of the present strong motion (m/s²). `None` in weak motion.
    pub(super) fn strong(&self) -> Option<f32> {
        self.detection.is_shaking().then_some(self.peak as f32)
    }

    pub(super) fn state(&self) -> MotionState {
        MotionState {
            detection: self.detection.state().clone(),
            peak: self.peak,
        }
    }

    /// Restores a state. One of other channels is ignored, because `[earthquakes]` may have
    /// changed.
    pub(super) fn restore(&mut self, state: MotionState) {
        if self.detection.restore(state.detection) {
            self.peak = state.peak;
        }
    }
}
