//! The service `modes`: follows the natural frequencies of a structure through its frames.
//!
//! Takes the frames of ingest and the table `[modal]` of the structure file. Publishes frequency,
//! damping ratio and shape of each declared mode after each epoch, and proposes modes that are not
//! declared. It needs no measured excitation. If the file requests it, the modes update the
//! stiffnesses of the model, which are published as parameters.
//!
//! `spandrel modes` uses the same core for a recording, so both give the same modes, bit for bit.
//!
//! - [`DeclaredModes`]: the modes of an epoch in, messages and events out
//! - [`Stiffnesses`]: with a model, the stiffness of its parts from the declared modes
//! - `following`: frames and gaps in, messages and events out, without clock or network
//! - [`ModesService`], [`ModesPlan`]: the service
//!
//! The identification of an epoch is in `spandrel-modal`. If the excitation is
//! measured, `spandrel-identify` estimates the parameters from every frame.

mod declared;
mod following;
mod stiffness;

mod error;
mod memory;
mod service;

#[cfg(test)]
mod testing;

pub use declared::{DeclaredModes, EpochOver, ModesOutput};
pub use error::ModesError;
pub use service::{ModesPlan, ModesService};
pub use stiffness::Stiffnesses;
