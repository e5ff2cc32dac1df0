//! Who somebody is: a role and a name, as they stand in the common name of a certificate.

use std::fmt;
use std::str::FromStr;

use spandrel_bus::Name;

/// What somebody is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// A router that others connect to; passes on what is said at other routers of the site.
    Router,
    /// The PostgreSQL server of the history: nothing on the bus.
    Database,
    /// All services of one machine in one process.
    Server,
    /// Ingest, identify and fuse.
    Worker,
    /// The alert service.
    Alert,
    /// The history service.
    History,
    /// Who tells people of alerts.
    Notify,
    /// The page, without acknowledging.
    Dashboard,
    /// People who may acknowledge, and a page on which they can.
    Operator,
    /// People and programs that look.
    Viewer,
    /// All sensor nodes of one structure: a logger, a simulation, a replay.
    Gateway,
    /// A node that identifies for itself.
    NodeWorker,
    /// One sensor node.
    Sensor,
}

/// What a name under a role says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Any name; the role holds for all structures of the site.
    Site,
    /// The name of a structure.
    Structure,
    /// `STRUCTURE.NODE`.
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

    /// The role as it is written.
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

    /// What a name under this role says.
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

/// Somebody with a certificate.
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

/// A role and a name that do not make a party.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PartyError {
    /// No such role.
    #[error("`{found}` is no role; roles are {}", Role::ALL.map(Role::as_str).join(", "))]
    Role {
        /// The text found.
        found: String,
    },
    /// A part of the name is none.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
    /// The name has not the parts that its role needs.
    #[error("`{found}` is no name of a {role}, must be {}", match role.scope() {
        Scope::Site => "one word of a-z, 0-9 and -",
        Scope::Structure => "the name of a structure",
        Scope::Node => "STRUCTURE.NODE, such as tower.roof",
    })]
    Parts {
        /// The role.
        role: Role,
        /// The text found.
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
    /// Checks a name against its role.
    ///
    /// # Errors
    /// [`PartyError`] says what the name must be.
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

    /// The role.
    #[must_use]
    pub fn role(&self) -> Role {
        self.role
    }

    /// The structure that the role is limited to.
    #[must_use]
    pub fn structure(&self) -> Option<&Name> {
        self.name
            .first()
            .filter(|_| self.role.scope() != Scope::Site)
    }

    /// The node that the role is limited to.
    #[must_use]
    pub fn node(&self) -> Option<&Name> {
        self.name.get(1)
    }

    /// As it stands in the certificate: `ROLE.NAME`.
    #[must_use]
    pub fn common_name(&self) -> String {
        let name: Vec<&str> = self.name.iter().map(Name::as_str).collect();
        format!("{}.{}", self.role, name.join("."))
    }
}

impl FromStr for Party {
    type Err = PartyError;

    /// Reads a common name.
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
