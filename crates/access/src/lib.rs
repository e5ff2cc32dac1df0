//! Access control on the bus: roles, certificates and the rules of the router.
//!
//! The input is a folder with an authority and the certificates that it has issued. The output is
//! the configuration of a Zenoh router. It grants each party the rights of its role and denies
//! everything else.
//!
//! ```
//! use spandrel_access::{Party, Right, keys_of};
//! use spandrel_bus::Name;
//! let roof: Party = "sensor.tower.roof".parse()?;
//! assert_eq!(
//!     keys_of(&Name::new("spandrel")?, &roof, Right::Put),
//!     ["spandrel/tower/sensor/roof/samples"]
//! );
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Role`], [`Party`]: the identity of a party
//! - [`rights()`]: what each role may do, and on which keys
//! - [`SiteFolder`]: the authority of a site and the certificates it has issued, as files
//! - [`router_file()`]: the configuration of the router
//! - [`isolation`]: the access control of a process that runs all services of a machine
//!
//! `spandrel-bus` checks certificates when it opens a session; this crate does not.

mod certificate;
mod error;
mod rights;
mod role;
mod router_file;
mod site_folder;

pub use error::AccessError;
pub use rights::{Right, is_of_node, rights};
pub use role::{Party, PartyError, Role, Scope};
pub use router_file::{RouterPlan, isolation, keys_of, router_file};
pub use site_folder::{Existing, Issued, SiteFolder};
