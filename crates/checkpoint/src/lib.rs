//! What a service remembers over its own death: its state at a place of a numbered stream, in files that are whole or refused.
//!
//! ```
//! use spandrel_checkpoint::{Checkpoints, Identity, Place};
//! # let folder = tempfile::tempdir()?;
//! let identity = Identity { kind: "counter", version: 1, of: "bridge".into(), basis: "name = \"bridge\"".into() };
//! let checkpoints = Checkpoints::open(folder.path(), identity)?;
//! checkpoints.save(Place { epoch: 1, sequence: 500 }, &42_u64)?;
//! assert_eq!(checkpoints.load_latest::<u64>().found, Some((Place { epoch: 1, sequence: 500 }, 42)));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Checkpoints`]: the checkpoints of one service and structure, the newest and those before it
//! - [`Identity`]: what a checkpoint must be of to be read
//! - [`fingerprint`]: what a part of a state rests on, for services that judge its parts one by one
//! - [`Place`]: an item of a numbered stream
//! - [`Keeper`]: keeps states in the background, no more often than is asked for
//! - [`Failures`]: those to keep a state, counted, and told without a flood
//! - [`Remembering`]: where a service keeps them, and how often
//!
//! A file is written beside its place, forced to the disk and renamed, so that there is never half of one under a name that
//! counts. What is read is checked by a SHA-256 of all of it; a corrupt or foreign file is renamed and told of, never read.
//!
//! The wrong room for recordings and for what people ask for later.

mod envelope;
mod error;
mod failures;
mod keeper;
mod series;

pub use envelope::{Identity, fingerprint};
pub use error::{CheckpointError, Refusal};
pub use failures::Failures;
pub use keeper::{Keeper, moment_within};
pub use series::{Checkpoints, Loaded, Place, Remembering};
