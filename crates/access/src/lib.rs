//! Who may do what on the bus: roles, certificates, and the rules of the router.
//!
//! A folder with an authority and the certificates that it has issued goes in, the configuration of a Zenoh router comes out,
//! in which every party is allowed what its role needs and nothing else.
//!
//! ```
//! use spandrel_access::{Party, Right, keys_of};
//! use spandrel_bus::Name;
//! let roof: Party = "sensor.tower.roof".parse()?;
//! assert_eq!(keys_of(&Name::new("spandrel")?, &roof, Right::Put), ["spandrel/tower/sensor/roof/samples"]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! - [`Role`], [`Party`]: who somebody is
//! - [`rights()`]: what each role may do, on which keys
//! - [`SiteFolder`]: the authority of a site and what it has issued, as files
//! - [`router_file()`]: the configuration of the router
//!
//! The wrong room for checking a certificate when a session is opened: that is done in `spandrel-bus`.

mod certificate;
mod error;
mod rights;
mod role;
mod router_file;
mod site_folder;

pub use error::AccessError;
pub use rights::{Right, is_of_node, rights};
pub use role::{Party, PartyError, Role, Scope};
pub use router_file::{RouterPlan, keys_of, router_file};
pub use site_folder::{Existing, Issued, SiteFolder};
