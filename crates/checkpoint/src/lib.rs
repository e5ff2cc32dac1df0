//! Checkpoints: the state of a service at one position of a numbered stream, saved in atomic files.
//!
//! A service that restarts loads its newest checkpoint and resumes from that position.
//!
//! ```
//! use spandrel_checkpoint::{Checkpoints, Identity, Position};
//! # let folder = tempfile::tempdir()?;
//! let identity = Identity { kind: "counter", version: 1, of: "bridge".into(), basis: "name = \"bridge\"".into() };
//! let checkpoints = Checkpoints::open(folder.path(), identity)?;
//! checkpoints.save(Position { epoch: 1, sequence: 500 }, &42_u64)?;
//! assert_eq!(checkpoints.load_latest::<u64>().found, Some((Position { epoch: 1, sequence: 500 }, 42)));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Checkpoints`]: the checkpoint files of one service and structure
//! - [`Identity`]: the service, version, structure and basis that a checkpoint must match
//! - [`fingerprint`]: a hash of the input that part of a state depends on, for services that
//!   validate parts separately
//! - [`Position`]: an item of a numbered stream, by epoch and sequence number
//! - [`Keeper`]: saves states in the background, at most once per interval
//! - [`Failures`]: counts failed saves and limits how often they are reported
//! - [`Remembering`]: the folder and interval of the checkpoints
//!
//! `save` writes a temporary file, syncs it to disk and renames it. A file with a checkpoint name
//! is therefore always complete. Every read verifies the SHA-256 of the whole file. A corrupt or
//! foreign file is renamed and reported, but never used.
//!
//! Checkpoints are not recordings and do not serve queries.

mod envelope;
mod error;
mod failures;
mod keeper;
mod series;

pub use envelope::{Identity, fingerprint};
pub use error::{CheckpointError, Refusal};
pub use failures::Failures;
pub use keeper::{Keeper, moment_within};
pub use series::{
    Checkpoints, Loaded, Position, Remembering, may_become_writable, replace_private_file,
    sync_name,
};
