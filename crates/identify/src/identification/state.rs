//! The checkpoint state of an identification.

use super::hearing::Hearing;
use super::motion::{Motion, MotionState};
use super::recovery::Recovery;
use super::reliability::ReliabilityState;
use super::spikes::Spikes;
use super::sudden::SuddenFaultsState;
use super::{Identification, Stream};
use crate::estimator::EstimatorState;
use crate::screening::ScreeningView;
use serde::{Deserialize, Serialize};
use spandrel_bus::{ClassCalibration, TimeGrid};
use spandrel_checkpoint::Position;
use spandrel_faults::SensorCheckState;
use spandrel_filter::{BandLimit, FilterError};

/// The whole state of an identification between two inputs, as stored in a checkpoint.
///
/// After restoring it for the same structure file, results are bit-identical to an uninterrupted
/// run, unless a sensor that was not in doubt is excluded within the time of the recent frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IdentificationState {
    estimator: EstimatorState,
    band_limit: Option<BandLimit>,
    stream: Option<Stream>,
    screening: Vec<ScreeningView>,
    calibration: Option<ClassCalibration>,
    restarts: u64,
    unobserved: u64,
    hearing: Vec<Hearing>,
    last_values: Vec<f64>,
    since_clipped: Option<u64>,
    sensors: SensorCheckState,
    spikes: Spikes,
    settling: u64,
    reliability: ReliabilityState,
    motion: Option<MotionState>,
    recent: Vec<f32>,
    recovery: Recovery,
    sudden: SuddenFaultsState,
}

impl IdentificationState {
    /// Version of the layout. Every change of a field here or in the nested states must increase
    /// it.
    pub const VERSION: u16 = 14;
}

impl Identification {
    /// Returns the state for a checkpoint.
    #[must_use]
    pub fn state(&self) -> IdentificationState {
        IdentificationState {
            estimator: self.estimator.state(),
            band_limit: self.band_limit.clone(),
            stream: self.stream,
            screening: self.screening.clone(),
            calibration: self
                .classes
                .as_ref()
                .and_then(|classes| classes.calibration().cloned()),
            restarts: self.restarts,
            unobserved: self.unobserved,
            hearing: self.hearing.clone(),
            last_values: self.last_values.clone(),
            since_clipped: self.since_clipped,
            sensors: self.check.state().clone(),
            spikes: self.spikes.clone(),
            settling: self.settling,
            reliability: self.reliability.state().clone(),
            motion: self.motion.as_ref().map(Motion::state),
            // They are far larger than the rest, and are only used if a sensor becomes faulty.
            recent: match self.check.is_in_doubt(|_| true) {
                true => self.recent.state(),
                false => Vec::new(),
            },
            recovery: self.recovery,
            sudden: self.sudden.state(),
        }
    }

    /// Restores the state of a checkpoint.
    ///
    /// # Errors
    /// Returns an error if the state does not match the structure. The identification may then be
    /// partly restored and must not be used.
    pub fn restore(&mut self, state: IdentificationState) -> Result<(), FilterError> {
        let sizes = [
            (
                "band limit of a checkpoint",
                usize::from(state.band_limit.is_some()),
                usize::from(self.band_limit.is_some()),
            ),
            (
                "screened channels of a checkpoint",
                state.screening.len(),
                self.screening.len(),
            ),
            (
                "excitations of a checkpoint",
                state.hearing.len(),
                self.hearing.len(),
            ),
            (
                "channels of a checkpoint",
                state.last_values.len(),
                self.last_values.len(),
            ),
        ];
        FilterError::check_sizes(sizes)?;
        FilterError::check_sizes([(
            "sensor check of a checkpoint (0: of other channels, 1: of the structure file)",
            usize::from(self.check.restore(state.sensors)),
            1,
        )])?;
        FilterError::check_sizes([(
            "frames of a checkpoint without spikes (0: of other channels, 1: of the structure \
             file)",
            usize::from(state.spikes.fits(self.last_values.len())),
            1,
        )])?;
        FilterError::check_sizes([(
            "recent frames of a checkpoint (0: of other channels, 1: of the structure file)",
            usize::from(self.recent.restore(state.recent)),
            1,
        )])?;
        FilterError::check_sizes([(
            "sudden faults of a checkpoint (0: of other channels, 1: of the structure file)",
            usize::from(self.sudden.restore(state.sudden, &self.estimator)),
            1,
        )])?;
        self.reliability.restore(state.reliability)?;
        self.estimator.restore(state.estimator)?;
        self.band_limit = state.band_limit;
        self.stream = state.stream;
        if self.stream.is_some() {
            self.fit.resume(&self.estimator);
        }
        self.screening = state.screening;
        if let Some(classes) = &mut self.classes {
            classes.set_calibration(state.calibration);
        }
        self.restarts = state.restarts;
        self.unobserved = state.unobserved;
        self.hearing = state.hearing;
        self.last_values = state.last_values;
        self.since_clipped = state.since_clipped;
        self.spikes = state.spikes;
        self.settling = state.settling;
        self.recovery = state.recovery;
        if let Some((motion, state)) = self.motion.as_mut().zip(state.motion) {
            motion.restore(state);
        }
        Ok(())
    }

    /// Returns the time of the last processed frame, ns since the Unix epoch. `None` before the
    /// first.
    #[must_use]
    pub fn last_time_ns(&self) -> Option<i64> {
        let stream = self.stream?;
        let grid = TimeGrid::new(stream.t0_ns, stream.sampling_rate_hz)?;
        Some(grid.time_ns(stream.next.checked_sub(1)?))
    }

    /// Returns the position of the first frame that is not processed. `None` before the first.
    #[must_use]
    pub fn position(&self) -> Option<Position> {
        self.stream.map(|stream| Position {
            epoch: stream.epoch,
            sequence: stream.next,
        })
    }
}
