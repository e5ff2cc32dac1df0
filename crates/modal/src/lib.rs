//! Natural frequencies, damping ratios and mode shapes from ambient vibration.
//!
//! Takes frames: one value per channel and time step. Returns the modes of each epoch with their
//! standard deviations, and tracks them from epoch to epoch. No excitation is measured and no model
//! is needed. The theory is in `docs/theory/modal.md`.
//!
//! ```
//! use spandrel_modal::{ModalSettings, ModalStream, identify};
//!
//! let settings = ModalSettings { epoch_s: 200.0, ..ModalSettings::new(2, 20.0) };
//! let mut stream = ModalStream::new(&settings)?;
//! let mut noise = 1_u32; // a linear congruential generator
//! let mut motion = [[0.0; 2]; 2];
//! let epoch = loop {
//!     noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
//!     let force = f64::from(noise) / f64::from(u32::MAX) - 0.5;
//!     // Two resonances, at 1.0 and 2.5 Hz, seen by two channels.
//!     for (state, frequency_hz) in motion.iter_mut().zip([1.0, 2.5]) {
//!         let rotation = std::f64::consts::TAU * frequency_hz / 20.0;
//!         let next = 2.0 * 0.99 * rotation.cos() * state[0] - 0.99 * 0.99 * state[1] + force;
//!         *state = [next, state[0]];
//!     }
//!     let [[first, _], [second, _]] = motion;
//!     if let Some(epoch) = stream.push(&[first + second, first - second])? {
//!         break epoch;
//!     }
//! };
//! let modes = identify(&epoch)?.modes;
//! let frequencies: Vec<f64> = modes.iter().map(|mode| mode.frequency_hz).collect();
//! assert!((frequencies[0] - 1.0).abs() < 0.05 && (frequencies[1] - 2.5).abs() < 0.05);
//! # Ok::<(), spandrel_modal::ModalError>(())
//! ```
//!
//! - [`ModalSettings`]: channels, band, epochs and orders
//! - [`ModalStream`]: filters, decimates and accumulates frames into an [`Epoch`];
//!   [`BandLadder`] does so in several bands
//! - [`EpochStream`]: cuts frames with gaps into epochs, live and from a recording alike
//! - [`identify()`]: from an epoch to [`Mode`]s, with uncertainty
//! - [`Tracker`]: assigns the modes of each epoch to known ones, and proposes new ones
//! - [`RecordModes`]: all of this for a recording
//! - [`StiffnessUpdate`]: with a model, the change of the stiffness of each part from these modes
//! - [`normal_cdf()`]: the normal distribution function, which the credibility of alerts also uses
//!
//! The crate contains only maths: no files, no clock, no log. If the excitation is measured,
//! `spandrel-filter` determines the stiffness of the parts at the sampling rate.

mod cluster;
mod covariance;
mod dense;
mod epoch_stream;
mod error;
mod identify;
mod ladder;
mod law;
mod normal;
mod perturbation;
mod prefilter;
mod realisation;
mod record_modes;
mod settings;
mod shape;
mod spectrum;
mod stream;
mod tracking;
mod updating;

pub use covariance::EpochCovariances;
pub use epoch_stream::{EpochStream, LONGEST_GAP_S};
pub use error::ModalError;
pub use identify::{
    CERTAIN_DAMPING, HIGHEST_DAMPING, Identified, MACHINE_DAMPING, MACHINE_KURTOSIS, Mode, Source,
    identify,
};
pub use ladder::{BandLadder, LadderEpoch, LadderModes, highest_band_end_hz};
pub use law::{Uncertainty, smallest_uncertainty};
pub use normal::normal_cdf;
pub use realisation::Pole;
pub use record_modes::{EpochModes, ModeSummary, RecordModes, SAME_MACHINE};
pub use settings::ModalSettings;
pub use shape::{mac, phase_collinearity};
pub use spectrum::EpochSpectrum;
pub use stream::{ChannelUse, Epoch, MOST_MISSING, ModalStream};
pub use tracking::{
    Assignment, LEAST_PRESENCE, LOST_AFTER, ModeId, PRESENCE_WINDOW, TrackEvent, TrackedMode,
    Tracker,
};
pub use updating::{
    Comparison, Entry, PartModel, SeenMode, StiffnessChange, StiffnessUpdate, UpdatePrecision,
    UpdateReference, UpdateSettings, UpdateState,
};
