//! Distinguishes faulty sensors from damage.
//!
//! Far below the first natural frequency, a structure follows the ground almost rigidly. All
//! accelerometers along one direction then measure the same motion, regardless of the stiffness of
//! the structure. A channel that differs from the others in this band has a fault, because damage
//! cannot explain the difference. Drifting offsets, clipped peaks and exchanged channels have their
//! own tests.
//!
//! - [`SensorCheck`]: one frame after the other, for all channels of a structure
//! - [`ChannelHealth`]: the health of one channel
//! - [`Fault`]: the kinds of faults
//!
//! This crate has no clock, no network and no log.

mod channel;
mod clipping;
mod finding;
mod hypothesis;
mod memory;
mod offset;
mod profile;
mod reference;
mod resonance;
mod sensor_check;
mod spectrum;

pub use channel::{ChannelHealth, Fault, Soundness};
pub use profile::ProfileReference;
pub use reference::{ObservedRelation, SensorReference};
pub use sensor_check::{Change, SensorCheck, SensorCheckState};
