//! What can go wrong on the bus.

use std::path::PathBuf;

use crate::message::EncodeError;
use crate::ring::NotConsecutive;

/// An error of Zenoh; its types are private, so its text is all it gives.
pub type ZenohError = Box<dyn std::error::Error + Send + Sync>;

/// Errors of the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// The Zenoh configuration file cannot be used.
    #[error("zenoh configuration file {} cannot be read", path.display())]
    ConfigFile {
        /// The file.
        path: PathBuf,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A setting is none that Zenoh knows.
    #[error("bus setting {key} has the value {value}, which zenoh refuses")]
    Setting {
        /// The key in the Zenoh configuration.
        key: &'static str,
        /// The value.
        value: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// Another program listens there already.
    #[error(
        "cannot listen on {endpoint}: {source}; if another spandrel runs there, \
         connect to it (bus.connect = [\"{endpoint}\"]), otherwise choose another bus.listen"
    )]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// Nobody answers there.
    #[error(
        "nobody answers at {endpoint}: {source}; start a router or another spandrel there, \
         or correct bus.connect"
    )]
    Unreachable {
        /// The endpoint.
        endpoint: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// The session cannot be opened for another reason.
    #[error("cannot open the zenoh session")]
    Open {
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A publisher, subscriber, queryable or token cannot be declared.
    #[error("cannot declare {key}")]
    Declare {
        /// The key expression.
        key: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A message cannot be put: the session is closed.
    #[error("cannot put on {key}")]
    Put {
        /// The key.
        key: String,
        /// What Zenoh says.
        source: ZenohError,
    },
    /// A message cannot be written.
    #[error("cannot encode a message for {key}")]
    Encode {
        /// The key.
        key: String,
        /// What is wrong with it.
        source: EncodeError,
    },
    /// A block does not continue its stream.
    #[error("cannot put on {key}")]
    NotConsecutive {
        /// The key.
        key: String,
        /// What was expected and found.
        source: NotConsecutive,
    },
    /// The session cannot be closed in order.
    #[error("cannot close the zenoh session")]
    Close {
        /// What Zenoh says.
        source: ZenohError,
    },
}
