//! The commands for the access to a site, and for its maintenance.

use super::shared::BusArguments;
use super::values::annotation_kind;
use clap::{Args, Subcommand, ValueEnum};
use spandrel_access::Role;
use spandrel_bus::AnnotationKind;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct RouterArguments {
    /// Configuration file of a Zenoh router, in the format of zenohd.
    ///
    /// `spandrel site router` writes such a file.
    #[arg(value_name = "ROUTER.json5")]
    pub file: PathBuf,
}

/// Rights of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum TokenRole {
    /// Read access.
    Viewer,
    /// Read access, and the right to acknowledge alerts and annotate structures.
    Operator,
}

#[derive(Debug, Args)]
pub struct TokenArguments {
    /// Name of the holder.
    pub name: String,
    /// Rights of the token.
    #[arg(long, value_enum)]
    pub role: TokenRole,
    /// Token file, as set in dashboard.tokens; created if missing.
    #[arg(long, value_name = "FILE")]
    pub file: PathBuf,
    /// Replace an existing token of that name.
    #[arg(long)]
    pub replace: bool,
}

/// Commands on the folder of a site.
#[derive(Debug, Subcommand)]
pub enum SiteCommand {
    /// Create an authority in a folder that only its owner can read.
    Create {
        /// Folder for the files of the authority.
        folder: PathBuf,
        /// Name of the site in the certificate of the authority.
        #[arg(long, default_value = "site")]
        name: String,
        /// Validity period in days.
        #[arg(long, default_value_t = 3650)]
        days: u32,
        /// Replace an existing authority.
        ///
        /// All certificates that it has issued become invalid.
        #[arg(long)]
        replace: bool,
    },
    /// Issue a certificate.
    Issue {
        /// Folder of the site.
        folder: PathBuf,
        /// Role of the party.
        ///
        /// One of router, database, server, worker, alert, history, notify, dashboard, operator,
        /// viewer, gateway, node-worker and sensor.
        role: Role,
        /// Name of the party.
        ///
        /// STRUCTURE.NODE for a sensor or node-worker, STRUCTURE for a gateway, and any name for
        /// other roles.
        name: String,
        /// Host name or address at which others connect to the party; may be repeated.
        ///
        /// A router or database requires at least one.
        #[arg(long)]
        host: Vec<String>,
        /// Validity period in days, at most until the authority expires.
        #[arg(long, default_value_t = 365)]
        days: u32,
        /// Replace an existing certificate.
        #[arg(long)]
        replace: bool,
    },
    /// Issue a certificate to each sensor node without one.
    Nodes {
        /// Folder of the site.
        folder: PathBuf,
        /// Structure files with the nodes.
        #[arg(value_name = "STRUCTURE.toml", required = true)]
        structures: Vec<PathBuf>,
        /// Validity period in days.
        #[arg(long, default_value_t = 365)]
        days: u32,
    },
    /// Write the configuration of the router.
    ///
    /// Each holder of a certificate in the folder receives the rights of its role.
    Router(SiteRouterArguments),
}

#[derive(Debug, Args)]
pub struct SiteRouterArguments {
    /// Folder of the site.
    pub folder: PathBuf,
    /// Structure files.
    ///
    /// Certificates of other structures or nodes are an error.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structures: Vec<PathBuf>,
    /// Endpoint to listen on, such as quic/10.0.0.5:7447; may be repeated.
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub listen: Vec<String>,
    /// Endpoint of another router of the site to connect to; may be repeated.
    ///
    /// Of two routers, only one needs to connect to the other.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Name of the router, required if several routers have a certificate.
    #[arg(long, value_name = "NAME")]
    pub router: Option<String>,
    /// First chunk of all key expressions [default: spandrel].
    #[arg(long)]
    pub root: Option<String>,
    /// Folder on the router's machine with its certificate, key and authority.pem [default: folder
    /// of the site].
    #[arg(long, value_name = "FOLDER")]
    pub installed_in: Option<PathBuf>,
    /// Output file [default: router.json5 in the folder of the site].
    #[arg(long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Overwrite an existing file.
    #[arg(long)]
    pub replace: bool,
}

#[derive(Debug, Args)]
pub struct MaintenanceArguments {
    /// Name of the structure.
    #[arg(value_name = "STRUCTURE")]
    pub structure: String,
    /// End of the maintenance, at most 30 days from now.
    ///
    /// Seconds since 1970, UTC, or ISO 8601 such as 2026-03-01T12:00:00Z. Requires --reason.
    #[arg(long, value_name = "TIME", requires = "reason", conflicts_with = "end")]
    pub until: Option<String>,
    /// End the maintenance now.
    #[arg(long)]
    pub end: bool,
    /// Reason of the maintenance, only with --until.
    #[arg(long, value_name = "TEXT", requires = "until")]
    pub reason: Option<String>,
    /// Mute only the alerts of this parameter [default: all notices of the structure].
    #[arg(long, value_name = "NAME")]
    pub parameter: Option<String>,
    /// Your name [default: USER].
    #[arg(long, value_name = "NAME")]
    pub who: Option<String>,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct AnnotateArguments {
    /// Name of the structure.
    #[arg(value_name = "STRUCTURE")]
    pub structure: String,
    /// Kind: inspection, repair, maintenance, weather, traffic or other.
    #[arg(value_name = "KIND", value_parser = annotation_kind)]
    pub kind: AnnotationKind,
    /// The note, or the reason of a new reference.
    #[arg(value_name = "TEXT")]
    pub text: String,
    /// Judged quantity [default: all of them].
    #[arg(long, value_name = "NAME")]
    pub quantity: Option<String>,
    /// Beginning [default: now].
    ///
    /// Seconds since 1970, UTC, or ISO 8601 such as 2026-03-01T12:00:00Z.
    #[arg(long, value_name = "TIME")]
    pub from: Option<String>,
    /// End, as for --from.
    #[arg(long, value_name = "TIME")]
    pub to: Option<String>,
    /// Mark the present lasting change as seen by you.
    #[arg(long, conflicts_with = "new_reference")]
    pub seen: bool,
    /// Start a new reference at the time --from, and discard the commissioning and the lasting
    /// change.
    ///
    /// Use it after the structure was changed on purpose. A new commissioning begins.
    #[arg(long)]
    pub new_reference: bool,
    /// Your name [default: USER].
    #[arg(long, value_name = "NAME")]
    pub who: Option<String>,
    #[command(flatten)]
    pub bus: BusArguments,
}
