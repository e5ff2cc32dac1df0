//! Determines the effect of an earthquake on a structure.
//!
//! The crate states how strong the motion was, how much the structure softened, whether it
//! recovered, and whether it has permanently lost stiffness.
//!
//! The inputs are the samples of the sensors and the stiffness estimates of each frame. The outputs
//! are figures of the motion, the history of each stiffness over the phases of the record, and one
//! judgement per event. The judgement compares an event with the earlier ones of the structure.
//!
//! ```
//! use spandrel_earthquake::{EventCourse, FrameEstimate, JudgeSettings, PhaseSettings, Sequence};
//! use spandrel_earthquake::{spectral_acceleration, windows};
//!
//! let ground: Vec<f64> = (0..4000).map(|i| (0.2 * f64::from(i)).sin()).collect();
//! let sa = spectral_acceleration(&ground, 0.01, 0.3, 0.05)?;
//! assert!(sa > 1.0);
//!
//! let phases = PhaseSettings {
//!     rate_hz: 100.0, fundamental_hz: 3.0, weak_peak: 2.0, settling_s: 300.0, unsettled_s: 0.0,
//! };
//! let windows = windows(&[&ground], &phases)?;
//! let estimate = FrameEstimate { mean: 0.98, std: 0.02, is_learning: true, is_contradicted: false };
//! let event = EventCourse::new(&windows, &vec![estimate; ground.len()]);
//! let settings = JudgeSettings { loss: 0.05, credibility: 0.99, level: 0.95, weak_amplitude: 0.3 };
//! let judgement = Sequence::new(settings)?.push(event, None);
//! assert!(judgement.softening.is_none() && judgement.lasting.is_empty());
//! # Ok::<(), spandrel_earthquake::EarthquakeError>(())
//! ```
//!
//! - [`mod@motion`]: peak, rms, Arias intensity and significant duration of a channel
//! - [`oscillator`]: spectral acceleration
//! - [`phase`]: windows of a record, and whether they are quiet, shaking, settling or weak motion
//! - [`detection`]: when an earthquake begins and ends in a stream of frames, and what is recorded
//! - [`course`]: the history of a stiffness over the windows
//! - [`equivalent`]: the equivalent-linear stiffness of the whole structure in each window
//! - [`between`]: the scatter between events
//! - [`amplitude`]: softening expected at an amplitude
//! - [`sequence`]: the judgement of one event after the other
//! - [`urgency`]: how soon an inspector is needed, and which report of a structure says so
//!
//! This crate has no clock, no bus, no log and no I/O. For slow changes under temperatures, without
//! earthquakes, use `spandrel-judge`.

mod error;

pub mod motion;
pub mod oscillator;

pub mod detection;

pub mod course;
pub mod equivalent;
pub mod phase;

pub mod amplitude;
pub mod between;
pub mod sequence;
pub mod urgency;

pub use amplitude::{Expected, Softened};
pub use between::{Coverage, EventValue, FEWEST_EVENTS, Interval, Pooled, leave_one_out};
pub use course::{CoursePoint, EventCourse, FrameEstimate, WeakMotion};
pub use detection::{
    Cut, CutKind, Detected, Detection, DetectionSettings, DetectionState, Due, Ending,
};
pub use equivalent::{Accelerometer, MeasuredMotion, Mode};
pub use error::EarthquakeError;
pub use motion::{IntensityFigures, MotionFigures, intensity_figures, motion_figures};
pub use oscillator::spectral_acceleration;
pub use phase::{Phase, PhaseSettings, Window, windows};
pub use sequence::{
    Candidate, EventJudgement, JudgeSettings, LastingLoss, Reference, ReferenceKind, Sequence,
    Softening, Waiting, WeakState,
};
pub use urgency::Urgency;
