//! Receives the display topics, and keeps the present state of each structure.
//!
//! Takes the messages of one structure, or of all below a root. Returns each message as an
//! [`Input`], and the state that results from all of them. The page, the terminal view, the history
//! and the notices use it.
//!
//! ```
//! use spandrel_bus::{Name, NoiseDisplay};
//! use spandrel_listener::{Input, Structures};
//!
//! let tower: Name = "tower".parse()?;
//! let noise = NoiseDisplay {
//!     structure: tower.clone(),
//!     name: "floors".parse()?,
//!     time_ns: 1_709_208_000_000_000_000,
//!     mean: 2.5e-5,
//!     std: 1e-6,
//! };
//! let mut structures = Structures::default();
//! structures.handle(Input::Noise(noise), &mut Vec::new());
//! assert_eq!(structures.structure(&tower).unwrap().noise["floors"].mean, 2.5e-5);
//! # Ok::<(), spandrel_bus::NameError>(())
//! ```
//!
//! - [`Input`], [`Instance`]: messages, tokens, replies to queries, and the passage of time
//! - [`StructureState`], [`Structures`]: the present state of one or of several structures, without
//!   clock, network or log
//! - [`Listener`], [`Needs`]: subscribes to the bus, and queries what was published before
//!
//! To read a stream without gaps, follow it with `spandrel_bus::Stream` instead.

mod input;
mod structure;
mod structures;

mod listener;

#[cfg(test)]
mod testing;

pub use input::{Input, Instance};
pub use listener::{DisplayTopic, Listener, Needs};
pub use structure::{AlertChange, ConditionState, InstanceState, STALE_AFTER, StructureState};
pub use structures::Structures;
