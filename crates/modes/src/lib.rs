//! The service `modes`: follows the natural frequencies of a structure through its frames.
//!
//! Takes the frames of ingest and the table `[modal]` of the structure file. Publishes frequency,
//! damping ratio and shape of each declared mode after each epoch, and proposes modes that are not
//! declared. No excitation is measured and no model is used.
//!
//! `spandrel modes` uses the same core for a recording, so both give the same modes, bit for bit.
//!
//! - [`DeclaredModes`]: the modes of an epoch in, messages and events out
//! - `following`: frames and gaps in, messages and events out, without clock or network
//! - [`ModesService`], [`ModesPlan`]: the service
//!
//! The identification of an epoch is in `spandrel-modal`. For the stiffness of parts of a structure
//! with a model, use `spandrel-identify`.

mod declared;
mod following;

mod error;
mod memory;
mod service;

#[cfg(test)]
mod testing;

pub use declared::{DeclaredModes, EpochOver, ModesOutput};
pub use error::ModesError;
pub use service::{ModesPlan, ModesService};
