//! The command line.

use crate::bus_audit::Scope;
use clap::{Args, Parser, Subcommand, ValueEnum};
use spandrel_access::Role;
use spandrel_bus::AnnotationKind;
use spandrel_filter::ImportanceDensity;
use spandrel_identify::ParticlePlan;
use spandrel_record::{ReadOptions, TimeUnit};
use spandrel_validate::Seeds;
use std::path::PathBuf;

/// Structural health monitoring of bridges and buildings in real time.
///
/// Sensors stream vibration. Spandrel identifies the stiffness of each part of the structure and
/// its uncertainty at the sampling rate. It raises an alert when a part has lost stiffness.
///
/// Start with `spandrel demo`.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true, max_term_width = 100)]
pub struct Arguments {
    #[command(subcommand)]
    pub command: Command,

    /// Format of the log on standard error.
    #[arg(long, global = true, value_enum, default_value_t = LogFormat::Text)]
    pub log: LogFormat,

    /// Log more on standard error; repeat for debugging.
    ///
    /// RUST_LOG overrides this option.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Lines for people.
    Text,
    /// One JSON object per line.
    Json,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run a demo: a simulated building is damaged, and Spandrel raises an alert.
    #[command(
        after_help = "Example: spandrel demo --speed max --duration 120 --seed 7 --headless --json"
    )]
    Demo(DemoArguments),
    /// Run all services of one machine in one process.
    #[command(after_help = "Example: spandrel run --config spandrel.toml")]
    Run(RunArguments),
    /// Connect instruments to the bus, and publish their samples as sensor nodes do.
    #[command(
        after_help = "Examples: spandrel feed --config spandrel.toml --check\n          \
                      spandrel feed --config spandrel.toml"
    )]
    Feed(FeedArguments),
    /// Align the samples of all nodes to frames, and store them for subscribers that miss some.
    #[command(after_help = "Example: spandrel ingest --config spandrel.toml")]
    Ingest(ServiceArguments),
    /// Identify parameters and noise levels from frames.
    #[command(
        after_help = "Examples: spandrel identify --config spandrel.toml\n          \
                            spandrel identify bridge.toml --node deck-3 --connect quic/10.0.0.5:7447 --certificate NAME.pem"
    )]
    Identify(IdentifyArguments),
    /// Fuse the local estimates of distributed sensor nodes.
    #[command(after_help = "Example: spandrel fuse bridge.toml --config spandrel.toml")]
    Fuse(ServiceArguments),
    /// Decide on alerts from estimates.
    #[command(after_help = "Example: spandrel alert --config spandrel.toml")]
    Alert(ServiceArguments),
    /// Find earthquakes in the frames, keep their recordings and report them.
    #[command(after_help = "Example: spandrel reports --config spandrel.toml")]
    Reports(ServiceArguments),
    /// Store estimates, alerts and events in a database, and answer queries for past data.
    #[command(
        after_help = "Example: spandrel history bridge.toml --connect quic/10.0.0.5:7447 --certificate NAME.pem"
    )]
    History(ServiceArguments),
    /// Notify people of alerts, and of structures whose damage would go unnoticed, by webhook,
    /// Alertmanager and e-mail.
    #[command(
        after_help = "Examples: spandrel notify --config spandrel.toml\n          \
                            spandrel notify --config spandrel.toml --test"
    )]
    Notify(NotifyArguments),
    /// Mute the notices of a structure during maintenance.
    ///
    /// Without --until and --end, list the present maintenance.
    #[command(
        after_help = "Examples: spandrel maintenance bridge --until 2026-12-01T18:00:00+01:00 --reason \"new bearings\"\n          \
                            spandrel maintenance bridge --parameter pier-2 --end\n          \
                            spandrel maintenance bridge"
    )]
    Maintenance(MaintenanceArguments),
    /// Note an inspection, a repair or another fact about a structure that is judged for lasting
    /// change.
    ///
    /// The service judge keeps the note. With --new-reference, it starts a new reference.
    #[command(
        after_help = "Examples: spandrel annotate bridge inspection \"crack in the bearing\" --quantity pier-2 --seen\n          \
                            spandrel annotate bridge repair \"new bearings\" --new-reference --from 2026-11-20\n          \
                            spandrel annotate bridge traffic \"closed to trucks\" --from 2026-03-01 --to 2026-04-01"
    )]
    Annotate(AnnotateArguments),
    /// Serve a web page with parameters and alerts, an HTTP interface and a WebSocket.
    #[command(
        after_help = "Examples: spandrel dashboard bridge.toml --connect quic/10.0.0.5:7447 --certificate NAME.pem\n          \
                            spandrel dashboard --config spandrel.toml --http 127.0.0.1:9000"
    )]
    Dashboard(RunArguments),
    /// Simulate a structure, and publish the samples or write them to a file.
    #[command(
        after_help = "Examples: spandrel simulate tower.toml --record tower.csv --duration 600\n          \
                            spandrel simulate tower.toml --speed 1 --connect quic/10.0.0.5:7447 --certificate NAME.pem\n          \
                            spandrel simulate tower.toml --live --node roof --start $(date +%s)"
    )]
    Simulate(SimulateArguments),
    /// Publish a recording on the bus as its sensor nodes would.
    #[command(
        after_help = "Example: spandrel replay week-12.csv --structure tower.toml --speed 10"
    )]
    Replay(ReplayArguments),
    /// Identify a recording without a bus, with results bit-identical to those of the services.
    #[command(
        after_help = "Examples: spandrel estimate tower.toml --record week-12.csv --output estimates.csv\n          \
                      spandrel estimate tower.toml --record week-12.csv --filter particle --particles 5000"
    )]
    Estimate(EstimateArguments),
    /// Learn the baseline values of the parameters from one or more recordings.
    #[command(
        after_help = "Example: spandrel baseline tower.toml --record monday.csv --record friday.csv --output tower.baseline.json"
    )]
    Baseline(BaselineArguments),
    /// Check a structure file: natural frequencies, damping, and what its sensors can identify.
    #[command(after_help = "Example: spandrel check tower.toml")]
    Check(CheckArguments),
    /// Judge stiffnesses or natural frequencies for lasting change: live, or a series offline.
    ///
    /// Without --series, run the service that judges the live estimates.
    #[command(
        after_help = "Examples: spandrel judge --config spandrel.toml\n          \
                      spandrel judge footbridge.toml --series footbridge.csv\n          \
                      spandrel judge footbridge.toml --series footbridge.csv --report\n          \
                      spandrel judge footbridge.toml --series footbridge.csv --json\n          \
                      spandrel judge footbridge.toml --series footbridge.csv --course days.csv"
    )]
    Judge(JudgeArguments),
    /// Report what earthquakes did to a structure: peaks, softening, recovery and lasting loss.
    ///
    /// The recordings are judged in the order of their time, each against the earlier ones.
    #[command(
        after_help = "Example: spandrel earthquake bridge.toml 2012.zip 2022-main.zip 2022-aftershock.zip --report events"
    )]
    Earthquake(EarthquakeArguments),
    /// Describe a recording: channels, rates, gaps, statistics and spectral peaks.
    #[command(after_help = "Examples: spandrel info bridge.mseed\n          \
                      spandrel info tower.dat --rate 100 --json")]
    Info(InfoArguments),
    /// Convert a recording to .csv, .mcap or .mseed, in SI units if its units are known.
    #[command(
        after_help = "Examples: spandrel convert event.zip event.mcap\n          \
                      spandrel convert modal-test.uff modal-test.csv --resample 200"
    )]
    Convert(ConvertArguments),
    /// Identify natural frequencies, damping ratios and mode shapes of a recording, or live.
    #[command(after_help = "Examples: spandrel modes bridge.mseed\n          \
                      spandrel modes tower.dat --rate 100 --epoch 164 --report modes\n          \
                      spandrel modes records-of-may --band 0.5..12\n          \
                      spandrel modes week-12.csv tower.toml --json\n          \
                      spandrel modes --live --config spandrel.toml")]
    Modes(ModesArguments),
    /// Run the published examples of the method and compare the results with the published figures.
    #[command(after_help = "Examples: spandrel validate --quick\n          \
                      spandrel validate outlier.oscillator --seed 17 --seed 5\n          \
                      spandrel validate ekf.bridge outlier --seeds 101..105 --report validation")]
    Validate(ValidateArguments),
    /// Measure how many structures this machine can monitor in real time, and with what latency.
    #[command(after_help = "Examples: spandrel bench --structures 100\n          \
                      spandrel bench --largest --apart --json")]
    Bench(BenchArguments),
    /// Show parameters and alerts of a running system in this terminal.
    #[command(after_help = "Example: spandrel watch tower --connect tcp/127.0.0.1:7447")]
    Watch(WatchArguments),
    /// Run a Zenoh router for a site, from its configuration file.
    #[command(after_help = "Example: spandrel router /etc/spandrel/router.json5")]
    Router(RouterArguments),
    /// Create the certificates of a site and the configuration of its router.
    #[command(
        subcommand,
        after_help = "Examples: spandrel site create bridge-site\n          \
                      spandrel site issue bridge-site router main --host 10.0.0.5\n          \
                      spandrel site issue bridge-site server main\n          \
                      spandrel site nodes bridge-site bridge.toml\n          \
                      spandrel site router bridge-site bridge.toml --listen quic/10.0.0.5:7447"
    )]
    Site(SiteCommand),
    /// Create a token for the web page, print it once and store its hash.
    #[command(
        after_help = "Example: spandrel token grace --role operator --file /etc/spandrel/tokens.json"
    )]
    Token(TokenArguments),
    /// Write shell completions to standard output.
    #[command(after_help = "Example: spandrel completions bash > /etc/bash_completion.d/spandrel")]
    Completions {
        /// Name of the shell.
        shell: clap_complete::Shell,
    },
}

impl Command {
    /// Returns the kinds of requests that Zenoh can refuse in this process. `None` if no other
    /// process connects to it.
    pub fn audited(&self) -> Option<Scope> {
        match self {
            Self::Router(_) | Self::Run(_) => Some(Scope::Router),
            Self::Demo(_)
            | Self::Feed(_)
            | Self::Ingest(_)
            | Self::Identify(_)
            | Self::Fuse(_)
            | Self::Alert(_)
            | Self::Judge(_)
            | Self::Reports(_)
            | Self::History(_)
            | Self::Notify(_)
            | Self::Dashboard(_) => Some(Scope::Peers),
            Self::Modes(modes) if modes.live => Some(Scope::Peers),
            _ => None,
        }
    }

    /// Returns `true` for a process that many others may connect to. The worker of a node serves
    /// its own sensor, and must stay small.
    pub fn serves_many(&self) -> bool {
        let is_worker = matches!(self, Self::Identify(identify) if !identify.node.is_empty());
        self.audited().is_some() && !is_worker
    }
}

/// Options for joining the bus.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Bus")]
pub struct BusArguments {
    /// Configuration file.
    ///
    /// Variables SPANDREL_… override the file, and flags override the variables.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// First chunk of all key expressions [default: spandrel].
    #[arg(long)]
    pub root: Option<String>,
    /// Endpoint to listen on, such as tcp/127.0.0.1:7447; may be repeated.
    #[arg(long, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// Endpoint to connect to; may be repeated.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Certificate (PEM) for QUIC endpoints.
    ///
    /// Its key and the authority.pem of the site must be in the same folder. Peers must present a
    /// certificate of that authority. Without --listen, the session is a client of a router.
    #[arg(long, value_name = "FILE.pem")]
    pub certificate: Option<PathBuf>,
    /// Zenoh configuration file (JSON5).
    #[arg(long, value_name = "FILE")]
    pub zenoh_config: Option<PathBuf>,
}

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
    /// Read access, and the right to acknowledge alerts.
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
pub struct ServiceArguments {
    /// Structure file; may be repeated [default: structures of the configuration].
    #[arg(value_name = "STRUCTURE.toml")]
    pub structures: Vec<PathBuf>,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct NotifyArguments {
    #[command(flatten)]
    pub service: ServiceArguments,
    /// Send a test notice with made-up values to each receiver, print the results, and exit.
    ///
    /// Exits with code 1 if a delivery fails. The services may run at the same time.
    #[arg(long)]
    pub test: bool,
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

/// Options of the web page.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Page")]
pub struct PageArguments {
    /// Address of the web page, such as 127.0.0.1:8080, or none [default: 127.0.0.1:8080, or a free
    /// port if that port is in use].
    ///
    /// Port 0 means any free port.
    #[arg(long, value_name = "ADDRESS")]
    pub http: Option<String>,
    /// Open the page in a browser.
    #[arg(long)]
    pub open: bool,
}

#[derive(Debug, Args)]
pub struct RunArguments {
    #[command(flatten)]
    pub service: ServiceArguments,
    #[command(flatten)]
    pub page: PageArguments,
}

#[derive(Debug, Args)]
pub struct FeedArguments {
    #[command(flatten)]
    pub service: ServiceArguments,
    /// Listen to all sources, print what arrives on each channel, and publish nothing.
    #[arg(long)]
    pub check: bool,
    /// Duration of the check in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = check_seconds, requires = "check")]
    pub duration: f64,
}

/// Parses a positive duration in seconds.
fn check_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds <= MAX_CHECK_S => Ok(seconds),
        Ok(_) | Err(_) => Err(format!(
            "must be a number above 0 and at most {MAX_CHECK_S}"
        )),
    }
}

/// Longest check of sources, s: one day.
const MAX_CHECK_S: f64 = 86_400.0;

/// Speed at which data is sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Speed {
    /// Multiple of real time.
    Times(f64),
    /// As fast as the receivers process the data.
    Max,
}

impl std::str::FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let allowed = || format!("is `{text}`, must be a positive number or max");
        match text {
            "max" => Ok(Self::Max),
            _ => match text.parse::<f64>() {
                Ok(times) if times.is_finite() && times > 0.0 => Ok(Self::Times(times)),
                Ok(_) | Err(_) => Err(allowed()),
            },
        }
    }
}

#[derive(Debug, Args)]
pub struct IdentifyArguments {
    #[command(flatten)]
    pub service: ServiceArguments,
    /// Run only the worker of this sensor node; may be repeated [default: all distributed nodes].
    #[arg(long, value_name = "NAME")]
    pub node: Vec<String>,
    /// Stand by while another process identifies a structure, and take over if it fails.
    ///
    /// Others consider this process failed after 2 s without a message from it, unless bus.lease_s
    /// is set.
    #[arg(long, conflicts_with = "node")]
    pub standby: bool,
}

#[derive(Debug, Args)]
pub struct DemoArguments {
    /// Multiple of real time, or max.
    #[arg(long, default_value = "10")]
    pub speed: Speed,
    /// Length of the simulated record (s).
    #[arg(long, default_value_t = 120.0, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: f64,
    /// Seed of excitation and noise.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Print only alerts and the result, without terminal view and web page; for scripts.
    #[arg(long, conflicts_with_all = ["http", "open", "stay"])]
    pub headless: bool,
    /// Keep serving the page after the end, until Ctrl-C.
    ///
    /// In a terminal this is the default, except with --json.
    #[arg(long)]
    pub stay: bool,
    /// Print the result as one JSON object.
    #[arg(long)]
    pub json: bool,
    /// Demonstrate distributed identification, with a filter in each node and a station that fuses
    /// the estimates.
    ///
    /// The structure has forty storeys and sixteen nodes. One node has a constant offset, one is
    /// silent for a while, and all have spikes.
    #[arg(long, conflicts_with = "structure")]
    pub distributed: bool,
    /// Structure file with a simulation table, instead of the built-in structure.
    #[arg(long, value_name = "STRUCTURE.toml")]
    pub structure: Option<PathBuf>,
    #[command(flatten)]
    pub page: PageArguments,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct BenchArguments {
    /// Structure file with a simulation table, used for all copies [default: building of the demo].
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: Option<PathBuf>,
    /// Number of structures, or with --largest the first number to try.
    #[arg(long, default_value_t = 10, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=10_000))]
    pub structures: usize,
    /// Add structures until the machine is overloaded, and report the largest sustained number.
    #[arg(long)]
    pub largest: bool,
    /// Length of each measurement (s).
    ///
    /// The first 5 s are not counted.
    #[arg(long, default_value_t = 20.0, value_name = "SECONDS", value_parser = seconds)]
    pub duration: f64,
    /// Run the services in one process and the sensors in another.
    #[arg(long)]
    pub apart: bool,
    /// Print one JSON object per line and measurement.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct SimulateArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Write the record to this file instead of publishing it.
    ///
    /// Columns and units follow the record table of the structure file.
    #[arg(long, value_name = "OUT.csv|OUT.mcap")]
    pub record: Option<PathBuf>,
    /// Length (s) [default: unlimited on the bus, 120 s for a file].
    #[arg(long, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<f64>,
    /// Seed of excitation and noise [default: seed of the structure file].
    #[arg(long)]
    pub seed: Option<u64>,
    /// Multiple of real time, or max; on the bus only.
    #[arg(long, default_value = "1", conflicts_with = "record")]
    pub speed: Speed,
    /// Send samples as hardware does, at the time of their timestamp, without waiting for
    /// receivers.
    #[arg(long, conflicts_with_all = ["record", "speed"])]
    pub live: bool,
    /// Start of a live simulation (seconds since 1970, UTC) [default: now].
    ///
    /// At most one day before or after now. Nodes in several processes belong together if they have
    /// the same start. A process that starts later joins at the current time.
    #[arg(long, value_name = "SECONDS", requires = "live", value_parser = seconds, allow_negative_numbers = true)]
    pub start: Option<f64>,
    /// Simulate only this sensor node; may be repeated [default: all nodes].
    #[arg(long, value_name = "NAME", conflicts_with = "record")]
    pub node: Vec<String>,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// The recording.
    pub record: PathBuf,
    /// Structure file.
    ///
    /// Its record table maps columns to channels.
    #[arg(long, value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Multiple of real time, or max.
    #[arg(long, default_value = "1")]
    pub speed: Speed,
    /// Resume after the last frame of ingest, for example after a crash of this command, instead of
    /// starting a new run.
    #[arg(long)]
    pub resume: bool,
    #[command(flatten)]
    pub bus: BusArguments,
}

/// Options for information that a recording may lack.
#[derive(Debug, Args)]
pub struct ReadingArguments {
    /// Sampling rate of channels without a sampling rate in the recording (Hz).
    #[arg(long, value_name = "HZ", value_parser = positive, allow_negative_numbers = true)]
    pub rate: Option<f64>,
    /// Time column of a table [default: first column whose name begins with `time` or that contains
    /// dates].
    #[arg(long, value_name = "NAME")]
    pub time_column: Option<String>,
    /// Unit of a numeric time in a table: s, ms, us or ns [default: s].
    #[arg(long, value_name = "UNIT", value_parser = time_unit)]
    pub time_unit: Option<TimeUnit>,
}

impl ReadingArguments {
    /// Returns `true` if an option is given.
    pub fn is_some(&self) -> bool {
        self.rate.is_some() || self.time_column.is_some() || self.time_unit.is_some()
    }

    /// Returns the options for reading.
    pub fn options(&self) -> ReadOptions {
        ReadOptions {
            time_column: self.time_column.clone(),
            time_unit: self.time_unit,
            sampling_rate_hz: self.rate,
        }
    }
}

#[derive(Debug, Args)]
pub struct JudgeArguments {
    /// CSV file with a time, the quantities and the conditions; may be repeated in the order of
    /// time.
    ///
    /// The structure file then needs no model.
    #[arg(long, value_name = "FILE")]
    pub series: Vec<PathBuf>,
    /// Print what each reference promises, what it achieves, and what it misses.
    #[arg(long)]
    pub report: bool,
    /// Print one JSON object per line: every judgement of every day.
    #[arg(long)]
    pub json: bool,
    /// File judge-annotations.jsonl of the service judge. Its new references apply.
    #[arg(long, value_name = "FILE", requires = "series")]
    pub annotations: Option<PathBuf>,
    /// Write one row per quantity and day to this CSV file.
    #[arg(long, value_name = "FILE")]
    pub course: Option<PathBuf>,
    #[command(flatten)]
    pub service: ServiceArguments,
}

#[derive(Debug, Args)]
pub struct EarthquakeArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Recordings of the events, weak ones included: files of any known format.
    ///
    /// They are sorted by their dates. Without dates, the given order counts.
    #[arg(required = true, value_name = "RECORD")]
    pub records: Vec<PathBuf>,
    /// Folder for the reports: EVENT.html and EVENT.json of each event, and index.html.
    ///
    /// The index lists all reports in the folder, also those of other structures.
    #[arg(long, value_name = "DIR")]
    pub report: PathBuf,
    /// Peak acceleration of the structure above which motion is strong (m/s²) [default: that of
    /// the table earthquakes of the structure file, otherwise 1].
    ///
    /// Only weaker motion can show a lasting loss.
    #[arg(long, value_name = "M/S2", value_parser = positive, allow_negative_numbers = true)]
    pub strong: Option<f64>,
    /// Loss of stiffness that matters, as a share [default: that of the table
    /// earthquakes, otherwise 0.05].
    #[arg(long, value_name = "SHARE", value_parser = below_1, allow_negative_numbers = true)]
    pub loss: Option<f64>,
    /// Minimum probability at which a loss is reported [default: that of the table earthquakes,
    /// otherwise 0.99].
    #[arg(long, value_name = "PROBABILITY", value_parser = below_1, allow_negative_numbers = true)]
    pub credibility: Option<f64>,
}

#[derive(Debug, Args)]
pub struct InfoArguments {
    /// Recording: a file of any known format, or a zip archive or folder of such files.
    pub record: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub reading: ReadingArguments,
}

#[derive(Debug, Args)]
pub struct ConvertArguments {
    /// Recording: a file of any known format, or a zip archive or folder of such files.
    pub record: PathBuf,
    /// Output file.
    ///
    /// Its extension determines the format.
    #[arg(value_name = "OUT.csv|OUT.mcap|OUT.mseed")]
    pub output: PathBuf,
    /// Resample all channels to this rate (Hz), with an anti-aliasing filter.
    #[arg(long, value_name = "HZ", value_parser = positive, allow_negative_numbers = true)]
    pub resample: Option<f64>,
    #[command(flatten)]
    pub reading: ReadingArguments,
}

#[derive(Debug, Args)]
pub struct ModesArguments {
    /// Recordings of one structure, and optionally a structure file (.toml). With --live, structure
    /// files [default: structures of the configuration].
    ///
    /// A recording is a file of any known format, or a zip archive or folder of such files. The
    /// files of a folder are separate recordings if they have the same channels.
    #[arg(value_name = "FILE", required_unless_present = "live")]
    pub files: Vec<PathBuf>,
    /// Run the service that follows the natural frequencies of live samples.
    #[arg(long, conflicts_with_all = [
        "structure", "channels", "without", "references", "epoch", "band", "order", "report",
        "json", "csv", "uff", "declare", "rate", "time_column", "time_unit",
    ])]
    pub live: bool,
    /// Structure file, for the columns, units and sampling rate of its channels [default: all
    /// channels of the recording].
    ///
    /// Its modal table applies, unless an option chooses channels, references, epoch, band or
    /// order.
    #[arg(long, value_name = "STRUCTURE.toml", conflicts_with_all = ["rate", "time_column", "time_unit"])]
    pub structure: Option<PathBuf>,
    /// Channels to use, separated by commas [default: all].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub channels: Vec<String>,
    /// Channels to leave out, separated by commas.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub without: Vec<String>,
    /// Reference channels, separated by commas [default: all, or 6 of a larger number].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub references: Vec<String>,
    /// Length of an epoch (s) [default: the recording in equal parts of about 600 s].
    #[arg(long, value_name = "SECONDS", value_parser = positive, allow_negative_numbers = true)]
    pub epoch: Option<f64>,
    /// Frequency band (Hz), such as 0.5..12 [default: several bands, up to 0.4 of the sampling
    /// rate].
    #[arg(long, value_name = "LOW..HIGH")]
    pub band: Option<Band>,
    /// Highest order of the models [default: 40].
    #[arg(long, value_name = "ORDER")]
    pub order: Option<usize>,
    /// Folder for the stabilisation diagram and the singular-value spectrum (SVG), and for the
    /// modes with their shapes (JSON) and of each epoch (CSV).
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    /// Output file for the modes of each epoch, one row per epoch and mode.
    #[arg(long, value_name = "MODES.csv")]
    pub csv: Option<PathBuf>,
    /// Output file for the shapes and the spectral densities, as a universal file (datasets 55 and
    /// 58).
    #[arg(long, value_name = "MODES.uff")]
    pub uff: Option<PathBuf>,
    /// Print the modal tables for a structure file.
    #[arg(long, conflicts_with = "json")]
    pub declare: bool,
    #[command(flatten)]
    pub reading: ReadingArguments,
    #[command(flatten)]
    pub bus: BusArguments,
}

/// A frequency band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band {
    /// Lower end (Hz).
    pub lowest_hz: f64,
    /// Upper end (Hz).
    pub highest_hz: f64,
}

impl std::str::FromStr for Band {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = || "must be two increasing frequencies in Hz, such as 0.5..12".to_owned();
        let (low, high) = text.split_once("..").ok_or_else(wrong)?;
        let number = |text: &str| text.parse::<f64>().map_err(|_| wrong());
        let (lowest_hz, highest_hz) = (number(low)?, number(high)?);
        if lowest_hz >= 0.0 && lowest_hz < highest_hz && highest_hz.is_finite() {
            Ok(Self {
                lowest_hz,
                highest_hz,
            })
        } else {
            Err(wrong())
        }
    }
}

#[derive(Debug, Args)]
pub struct EstimateArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// The recording.
    #[arg(long)]
    pub record: PathBuf,
    /// Output file for the mean and standard deviation of each parameter, response and adapted
    /// noise level, one row per frame.
    #[arg(long, value_name = "ESTIMATES.csv")]
    pub output: Option<PathBuf>,
    /// Baseline file, for alert rules with a learnt reference.
    #[arg(long, value_name = "BASELINE.json")]
    pub baseline: Option<PathBuf>,
    /// Filter for the identification.
    #[arg(long, value_enum, default_value_t = FilterChoice::File)]
    pub filter: FilterChoice,
    /// Print the summary as one JSON object.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub particle: ParticleArguments,
}

/// Filters of `spandrel estimate`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FilterChoice {
    /// The filter that the structure file specifies, as the services run it.
    File,
    /// The adaptive extended Kalman filter or the bank of model classes, even if the file specifies
    /// particles.
    Kalman,
    /// A particle filter for the model with all parameters, slow but without the assumption of
    /// Gaussian distributions.
    Particle,
}

/// Distribution from which particles are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DensityChoice {
    /// Close to the next observation, by a Kalman filter for each particle.
    Optimal,
    /// From the model alone.
    Prior,
}

/// Options of the particle filter. [`ParticleArguments::plan`] supplies the defaults.
#[derive(Debug, Clone, Copy, Args)]
#[command(next_help_heading = "With --filter particle")]
pub struct ParticleArguments {
    /// Number of particles [default: 2000].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=10_000_000), allow_negative_numbers = true)]
    pub particles: Option<u32>,
    /// Distribution from which particles are drawn [default: optimal].
    #[arg(long, value_enum)]
    pub density: Option<DensityChoice>,
    /// Standard deviation of the drift of each parameter within a second, as a ratio to nominal per
    /// square root of a second [default: 0.005].
    #[arg(long, value_name = "RATIO", value_parser = not_negative, allow_negative_numbers = true)]
    pub drift: Option<f64>,
    /// Share of a particle's own state in resampling [default: 1].
    ///
    /// The rest is drawn from all particles. With 1, nothing is drawn from other particles.
    #[arg(long, value_name = "SHARE", value_parser = share, allow_negative_numbers = true)]
    pub kernel: Option<f64>,
    /// Time for which a Kalman filter runs before particles are drawn (s) [default: 2].
    #[arg(long, value_name = "SECONDS", value_parser = not_negative, allow_negative_numbers = true)]
    pub warm_up: Option<f64>,
    /// Seed of the random numbers [default: 0].
    #[arg(long)]
    pub seed: Option<u64>,
}

impl ParticleArguments {
    /// Returns the name of the first given option, or `None`. These options are valid only for the
    /// particle filter.
    pub fn given(&self) -> Option<&'static str> {
        let Self {
            particles,
            density,
            drift,
            kernel,
            warm_up,
            seed,
        } = self;
        let given = [
            (particles.is_some(), "--particles"),
            (density.is_some(), "--density"),
            (drift.is_some(), "--drift"),
            (kernel.is_some(), "--kernel"),
            (warm_up.is_some(), "--warm-up"),
            (seed.is_some(), "--seed"),
        ];
        given
            .into_iter()
            .find_map(|(is_given, option)| is_given.then_some(option))
    }

    /// Returns the plan of the particle filter.
    pub fn plan(&self) -> ParticlePlan {
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get);
        let mut plan = ParticlePlan::default();
        plan.settings.threads = threads;
        plan.settings.seed = self.seed.unwrap_or(0);
        plan.settings.particles = self
            .particles
            .map_or(plan.settings.particles, |particles| particles as usize);
        plan.settings.density = match self.density {
            Some(DensityChoice::Optimal) | None => ImportanceDensity::Optimal,
            Some(DensityChoice::Prior) => ImportanceDensity::Prior,
        };
        plan.settings.kernel = self.kernel.unwrap_or(1.0);
        plan.drift_per_root_s = self.drift.unwrap_or(plan.drift_per_root_s);
        plan.warm_up_s = self.warm_up.unwrap_or(plan.warm_up_s);
        plan
    }
}

#[derive(Debug, Args)]
pub struct BaselineArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Recording of the undamaged structure; may be repeated.
    ///
    /// Several recordings show the scatter from record to record.
    #[arg(long, required = true)]
    pub record: Vec<PathBuf>,
    /// Time at the start of each recording to leave out while the filter converges (s).
    #[arg(long, default_value_t = 10.0, value_name = "SECONDS", value_parser = not_negative, allow_negative_numbers = true)]
    pub skip: f64,
    /// Standard deviation of each parameter between records, as a ratio to nominal [default:
    /// estimated from the recordings].
    ///
    /// A single recording contains no information about this scatter.
    #[arg(long, value_name = "RATIO", value_parser = not_negative, allow_negative_numbers = true)]
    pub between_std: Option<f64>,
    /// Output file for the baseline values.
    #[arg(long, value_name = "BASELINE.json")]
    pub output: PathBuf,
}

#[derive(Debug, Args)]
pub struct CheckArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Length of data for which to report standard deviations (s).
    #[arg(long, default_value_t = 60.0, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub after: f64,
    /// Compare the sensors with each other in this recording instead of checking the design; may be
    /// repeated.
    #[arg(long, value_name = "RECORD", group = "data", conflicts_with = "after")]
    pub record: Vec<PathBuf>,
    /// Compare the sensors with each other in SECONDS of live data instead.
    ///
    /// `spandrel run` or `spandrel ingest` must run, and the sensors must deliver.
    #[arg(long, value_name = "SECONDS", value_parser = seconds, group = "data", conflicts_with_all = ["after", "record"])]
    pub live: Option<f64>,
    /// Baseline file with the behaviour of the sound sensors.
    ///
    /// With it, the comparison finds smaller faults, and exchanged channels.
    #[arg(long, value_name = "BASELINE.json", requires = "data")]
    pub baseline: Option<PathBuf>,
    /// Print one JSON object instead of text.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct ValidateArguments {
    /// Cases, or the first part of their names such as `ekf` [default: all].
    #[arg(value_name = "CASE")]
    pub cases: Vec<String>,
    /// List the cases and exit.
    #[arg(long)]
    pub list: bool,
    /// Use shortened records and the corresponding limits.
    #[arg(long)]
    pub quick: bool,
    /// Run each case with this seed; may be repeated [default: 1].
    #[arg(long, value_name = "N", conflicts_with = "seeds")]
    pub seed: Vec<u64>,
    /// Run each case with a range of seeds, including both ends.
    ///
    /// 4..8 means 4, 5, 6, 7, 8. A single number N means 1..N.
    #[arg(long, value_name = "FIRST..LAST")]
    pub seeds: Option<Seeds>,
    /// Identify the records of real structures below DIR instead of running cases, and print the
    /// results.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["cases", "quick", "seed", "seeds", "report", "list"])]
    pub records: Option<PathBuf>,

    /// Identify the records again with one faulty sensor each, which takes some minutes.
    #[arg(long, requires = "records")]
    pub faulty_sensors: bool,
    /// Number of concurrent cases [default: number of cores].
    #[arg(long, value_name = "N")]
    pub jobs: Option<usize>,
    /// Print one JSON object per line and figure.
    #[arg(long)]
    pub json: bool,
    /// Write figures.md and index.html with diagrams to DIR.
    ///
    /// DIR/outcomes stores the outcomes. A stopped run resumes from them, and a run of some cases
    /// keeps the others on the page.
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct WatchArguments {
    /// Name of the structure [default: all].
    pub structure: Option<String>,
    #[command(flatten)]
    pub bus: BusArguments,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be a positive number of seconds".to_owned()),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be a positive number".to_owned()),
    }
}

/// Reads a kind of annotation.
fn annotation_kind(text: &str) -> Result<AnnotationKind, String> {
    AnnotationKind::from_name(text).ok_or_else(|| {
        let names: Vec<&str> = AnnotationKind::ALL
            .iter()
            .map(|kind| kind.as_str())
            .collect();
        format!("must be one of: {}", names.join(", "))
    })
}

fn time_unit(text: &str) -> Result<TimeUnit, String> {
    TimeUnit::of_symbol(text).ok_or_else(|| "must be s, ms, us or ns".to_owned())
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be above 0 and at most 1".to_owned()),
    }
}

fn below_1(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value < 1.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be above 0 and below 1".to_owned()),
    }
}

fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be a number, 0 or more".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn command_line_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_subcommand_shows_an_example() {
        for command in Arguments::command().get_subcommands() {
            let help = command
                .get_after_help()
                .map(ToString::to_string)
                .unwrap_or_default();
            assert!(
                help.contains("Example"),
                "{} has no example",
                command.get_name()
            );
        }
    }

    #[test]
    fn error_names_the_range_of_a_number() {
        for (option, told) in [
            ("--drift=-1", "must be a number, 0 or more"),
            ("--warm-up", "0 or more"),
        ] {
            let mut words = vec![
                "spandrel", "estimate", "a.toml", "--record", "a.csv", option,
            ];
            if !option.contains('=') {
                words.push("-3");
            }
            let error = Arguments::try_parse_from(words).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
        let words = [
            "spandrel", "simulate", "a.toml", "--record", "a.csv", "--speed", "2",
        ];
        let error = Arguments::try_parse_from(words).unwrap_err().to_string();
        assert!(error.contains("cannot be used with"), "{error}");
    }

    #[test]
    fn defaults_of_particles_equal_those_in_the_help() {
        let Command::Estimate(arguments) =
            Arguments::try_parse_from(["spandrel", "estimate", "a.toml", "--record", "a.csv"])
                .unwrap()
                .command
        else {
            panic!("another command")
        };
        let plan = arguments.particle.plan();
        assert_eq!(
            (
                plan.settings.particles,
                plan.settings.seed,
                plan.settings.kernel
            ),
            (2000, 0, 1.0)
        );
        assert_eq!((plan.drift_per_root_s, plan.warm_up_s), (0.005, 2.0));
        assert_eq!(arguments.particle.given(), None);
    }

    #[test]
    fn seeds_are_single_ones_or_a_range_but_not_both() {
        let parse = |options: &[&str]| {
            let words = ["spandrel", "validate"].iter().chain(options);
            Arguments::try_parse_from(words).map(|arguments| match arguments.command {
                Command::Validate(arguments) => (arguments.seed, arguments.seeds),
                _ => panic!("another command"),
            })
        };
        assert_eq!(
            parse(&["--seed", "17", "--seed", "5"]).unwrap(),
            (vec![17, 5], None)
        );
        let (single, range) = parse(&["--seeds", "4..8"]).unwrap();
        assert_eq!(
            (single, range.unwrap().iter().collect::<Vec<_>>()),
            (Vec::new(), vec![4, 5, 6, 7, 8])
        );
        for (options, told) in [
            (&["--seeds", "8..4"][..], "the range 8..4 is empty"),
            (&["--seed", "17", "--seeds", "4..8"], "cannot be used with"),
            (&["--seed", "many"], "invalid digit"),
        ] {
            let error = parse(options).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
    }

    #[test]
    fn band_is_two_increasing_frequencies() {
        let band = Band {
            lowest_hz: 0.5,
            highest_hz: 12.0,
        };
        assert_eq!("0.5..12".parse(), Ok(band));
        for wrong in ["5", "5..", "12..0.5", "-1..3", "0..inf", "a..b"] {
            assert!(wrong.parse::<Band>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn speed_is_a_number_or_max() {
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("10".parse(), Ok(Speed::Times(10.0)));
        for wrong in ["0", "-1", "fast", "inf", ""] {
            assert!(wrong.parse::<Speed>().is_err(), "{wrong}");
        }
    }
}
