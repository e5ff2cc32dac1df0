//! The identity of a party: a role and a name, as in the common name of its certificate.

use std::fmt;
use std::str::FromStr;

use spandrel_bus::Name;

/// The role of a party.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// A router that other parties connect to. It forwards messages to and from the other routers
    /// of the site.
    Router,
    /// The PostgreSQL server of the history, which has no rights on the bus.
    Database,
    /// All services of one machine in one process.
    Server,
    /// The services ingest, identify, fuse and modes.
    Worker,
    /// The alert service, and the service that judges lasting changes.
    Alert,
    /// The history service.
    History,
    /// A program that notifies people of alerts.
    Notify,
    /// The dashboard, without the right to acknowledge alerts.
    Dashboard,
    /// People who may acknowledge alerts, and a dashboard on which they can.
    Operator,
    /// People and programs with read access.
    Viewer,
    /// All sensor nodes of one structure, for example a logger, a simulation or a replay.
    Gateway,
    /// A node that identifies the structure from its own samples.
    NodeWorker,
    /// One sensor node.
    Sensor,
}

/// What the NAME part of a common name `ROLE.NAME` refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Any name. The role applies to all structures of the site.
    Site,
    /// The name of a structure.
    Structure,
    /// The name of a structure and of a node, `STRUCTURE.NODE`.
    Node,
}

impl Role {
    /// All roles.
    pub const ALL: [Self; 13] = [
        Self::Router,
        Self::Database,
        Self::Server,
        Self::Worker,
        Self::Alert,
        Self::History,
        Self::Notify,
        Self::Dashboard,
        Self::Operator,
        Self::Viewer,
        Self::Gateway,
        Self::NodeWorker,
        Self::Sensor,
    ];

    /// Returns the role as written in common names.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Router => "router",
            Self::Database => "database",
            Self::Server => "server",
            Self::Worker => "worker",
            Self::Alert => "alert",
            Self::History => "history",
            Self::Notify => "notify",
            Self::Dashboard => "dashboard",
            Self::Operator => "operator",
            Self::Viewer => "viewer",
            Self::Gateway => "gateway",
            Self::NodeWorker => "node-worker",
            Self::Sensor => "sensor",
        }
    }

    /// Returns the meaning of the name that follows this role.
    #[must_use]
    pub fn scope(self) -> Scope {
        match self {
            Self::Gateway => Scope::Structure,
            Self::NodeWorker | Self::Sensor => Scope::Node,
            Self::Router
            | Self::Database
            | Self::Server
            | Self::Worker
            | Self::Alert
            | Self::History
            | Self::Notify
            | Self::Dashboard
            | Self::Operator
            | Self::Viewer => Scope::Site,
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A holder of a certificate.
///
/// ```
/// use spandrel_access::{Party, Role};
/// let roof = Party::new(Role::Sensor, "tower.roof")?;
/// assert_eq!(roof.common_name(), "sensor.tower.roof");
/// # Ok::<(), spandrel_access::PartyError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Party {
    role: Role,
    name: Vec<Name>,
}

/// An error in the role or the name of a party.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PartyError {
    /// The role is unknown.
    #[error("unknown role `{found}`, must be one of {}", Role::ALL.map(Role::as_str).join(", "))]
    Role {
        /// The rejected text.
        found: String,
    },
    /// A part of the name is not a valid [`Name`].
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
    /// The number of parts in the name does not match the role.
    #[error("`{found}` is not a valid name of a {role}, must be {}", match role.scope() {
        Scope::Site => "one word of a-z, 0-9 and -",
        Scope::Structure => "the name of a structure",
        Scope::Node => "STRUCTURE.NODE, such as tower.roof",
    })]
    Parts {
        /// The role.
        role: Role,
        /// The rejected name.
        found: String,
    },
}

impl FromStr for Role {
    type Err = PartyError;

    fn from_str(text: &str) -> Result<Self, PartyError> {
        let role = Self::ALL.into_iter().find(|role| role.as_str() == text);
        role.ok_or_else(|| PartyError::Role {
            found: text.to_owned(),
        })
    }
}

impl Party {
    /// Creates a party from a role and the name that follows it in `ROLE.NAME`.
    ///
    /// # Errors
    /// Returns [`PartyError`] with the required form if `name` does not have the form that `role`
    /// requires.
    pub fn new(role: Role, name: &str) -> Result<Self, PartyError> {
        let parts = name
            .split('.')
            .map(Name::new)
            .collect::<Result<Vec<_>, _>>()?;
        let wanted = if role.scope() == Scope::Node { 2 } else { 1 };
        match parts.len() == wanted {
            true => Ok(Self { role, name: parts }),
            false => Err(PartyError::Parts {
                role,
                found: name.to_owned(),
            }),
        }
    }

    /// Returns the role.
    #[must_use]
    pub fn role(&self) -> Role {
        self.role
    }

    /// Returns the structure that limits the role, or `None` if the role applies to the whole site.
    #[must_use]
    pub fn structure(&self) -> Option<&Name> {
        self.name
            .first()
            .filter(|_| self.role.scope() != Scope::Site)
    }

    /// Returns the node that limits the role, or `None` if the role is not limited to a node.
    #[must_use]
    pub fn node(&self) -> Option<&Name> {
        self.name.get(1)
    }

    /// Returns the common name of the certificate, `ROLE.NAME`.
    #[must_use]
    pub fn common_name(&self) -> String {
        let name: Vec<&str> = self.name.iter().map(Name::as_str).collect();
        format!("{}.{}", self.role, name.join("."))
    }
}

impl FromStr for Party {
    type Err = PartyError;

    /// Parses a common name.
    fn from_str(text: &str) -> Result<Self, PartyError> {
        let (role, name) = text.split_once('.').unwrap_or((text, ""));
        Self::new(role.parse()?, name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_common_name_is_read_back() {
        for text in [
            "sensor.tower.roof",
            "gateway.tower",
            "worker.main",
            "node-worker.bridge.deck-3",
        ] {
            assert_eq!(text.parse::<Party>().unwrap().common_name(), text);
        }
    }

    #[test]
    fn a_name_must_fit_its_role() {
        for text in [
            "sensor.tower",
            "gateway.tower.roof",
            "worker.a.b",
            "worker.",
            "worker",
            "nobody.x",
            "viewer.A",
        ] {
            assert!(text.parse::<Party>().is_err(), "{text}");
        }
        let error = Party::new(Role::Sensor, "roof").unwrap_err().to_string();
        assert!(error.contains("STRUCTURE.NODE"), "{error}");
        let error = "boss.x".parse::<Party>().unwrap_err().to_string();
        assert!(
            error.contains("boss") && error.contains("operator"),
            "{error}"
        );
    }

    #[test]
    fn the_scope_of_a_role_is_in_the_name() {
        let roof = Party::new(Role::Sensor, "tower.roof").unwrap();
        assert_eq!(
            (
                roof.structure().unwrap().as_str(),
                roof.node().unwrap().as_str()
            ),
            ("tower", "roof")
        );
        let worker = Party::new(Role::Worker, "tower").unwrap();
        assert_eq!((worker.structure(), worker.node()), (None, None));
    }
}
