//! The command line.

use clap::{Args, Parser, Subcommand, ValueEnum};
use spandrel_access::Role;
use spandrel_filter::ImportanceDensity;
use spandrel_identify::ParticlePlan;
use spandrel_record::{ReadOptions, TimeUnit};
use spandrel_validate::Seeds;
use std::path::PathBuf;

/// Watches over bridges and buildings in real time.
///
/// Sensors stream vibration; Spandrel identifies, at the sampling rate, how stiff each part of the structure is and how
/// sure it is of that, and raises an alert when a part has become softer.
///
/// Start with `spandrel demo`.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true, max_term_width = 100)]
pub struct Arguments {
    #[command(subcommand)]
    pub command: Command,

    /// Form of the log on standard error.
    #[arg(long, global = true, value_enum, default_value_t = LogFormat::Text)]
    pub log: LogFormat,

    /// Say more on standard error; twice for debugging. RUST_LOG overrides it.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Lines for people.
    Text,
    /// One JSON object a line.
    Json,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Show the whole path: a simulated building is damaged on the way, and an alert says so.
    #[command(
        after_help = "Example: spandrel demo --speed max --duration 120 --seed 7 --headless --json"
    )]
    Demo(DemoArguments),
    /// Run all services of one machine in one process.
    #[command(after_help = "Example: spandrel run --config spandrel.toml")]
    Run(RunArguments),
    /// Align the samples of all nodes to frames, and keep them for those who missed some.
    #[command(after_help = "Example: spandrel ingest --config spandrel.toml")]
    Ingest(ServiceArguments),
    /// Identify parameters and noise levels from frames.
    #[command(
        after_help = "Examples: spandrel identify --config spandrel.toml\n          \
                            spandrel identify bridge.toml --node deck-3 --connect quic/10.0.0.5:7447 --certificate NAME.pem"
    )]
    Identify(IdentifyArguments),
    /// Fuse what sensor nodes have identified for themselves.
    #[command(after_help = "Example: spandrel fuse bridge.toml --config spandrel.toml")]
    Fuse(ServiceArguments),
    /// Decide on alerts from estimates.
    #[command(after_help = "Example: spandrel alert --config spandrel.toml")]
    Alert(ServiceArguments),
    /// Keep estimates, alerts and events in a database, and answer for the past.
    #[command(
        after_help = "Example: spandrel history bridge.toml --connect quic/10.0.0.5:7447 --certificate NAME.pem"
    )]
    History(ServiceArguments),
    /// Tell of alerts by webhook, Alertmanager and e-mail.
    #[command(after_help = "Example: spandrel notify --config spandrel.toml")]
    Notify(ServiceArguments),
    /// Serve a web page of parameters and alerts, with an HTTP interface and a WebSocket.
    #[command(
        after_help = "Examples: spandrel dashboard bridge.toml --connect quic/10.0.0.5:7447 --certificate NAME.pem\n          \
                            spandrel dashboard --config spandrel.toml --http 127.0.0.1:9000"
    )]
    Dashboard(RunArguments),
    /// Simulate a structure: to the bus, or to a file.
    #[command(
        after_help = "Examples: spandrel simulate tower.toml --record tower.csv --duration 600\n          \
                            spandrel simulate tower.toml --speed 1 --connect quic/10.0.0.5:7447 --certificate NAME.pem\n          \
                            spandrel simulate tower.toml --live --node roof --start 1763730000"
    )]
    Simulate(SimulateArguments),
    /// Send a recording to the bus as its sensor nodes would.
    #[command(
        after_help = "Example: spandrel replay week-12.csv --structure tower.toml --speed 10"
    )]
    Replay(ReplayArguments),
    /// Identify a recording without a bus, with the same cores and to the same bits.
    #[command(
        after_help = "Examples: spandrel estimate tower.toml --record week-12.csv --output estimates.csv\n          \
                      spandrel estimate tower.toml --record week-12.csv --filter particle --particles 5000"
    )]
    Estimate(EstimateArguments),
    /// Learn the sound values of the parameters from one or more recordings.
    #[command(
        after_help = "Example: spandrel baseline tower.toml --record monday.csv --record friday.csv --output tower.baseline.json"
    )]
    Baseline(BaselineArguments),
    /// Check a structure file: natural frequencies, damping, and what these sensors can tell.
    #[command(after_help = "Example: spandrel check tower.toml")]
    Check(CheckArguments),
    /// Tell what a recording holds: channels, rates, gaps, statistics, peaks of the spectra.
    #[command(after_help = "Examples: spandrel info bridge.mseed\n          \
                      spandrel info tower.dat --rate 100 --json")]
    Info(InfoArguments),
    /// Write a recording in another format: .csv or .mcap, in SI units where its own are known.
    #[command(
        after_help = "Examples: spandrel convert event.zip event.mcap\n          \
                      spandrel convert modal-test.uff modal-test.csv --resample 200"
    )]
    Convert(ConvertArguments),
    /// Rebuild the published examples of the method, and compare with the published figures.
    #[command(after_help = "Examples: spandrel validate --quick\n          \
                      spandrel validate outlier.oscillator --seed 17 --seed 5\n          \
                      spandrel validate ekf.bridge outlier --seeds 101..105 --report validation")]
    Validate(ValidateArguments),
    /// Measure how many structures this machine can watch in real time, and how late it is.
    #[command(after_help = "Examples: spandrel bench --structures 100\n          \
                      spandrel bench --largest --apart --json")]
    Bench(BenchArguments),
    /// Watch parameters and alerts of a running system in this terminal.
    #[command(after_help = "Example: spandrel watch tower --connect tcp/127.0.0.1:7447")]
    Watch(WatchArguments),
    /// Route between the parties of a site, by the configuration file of a Zenoh router.
    #[command(after_help = "Example: spandrel router /etc/spandrel/router.json5")]
    Router(RouterArguments),
    /// Make the certificates of a site, and the configuration of its router.
    #[command(
        subcommand,
        after_help = "Examples: spandrel site create bridge-site\n          \
                      spandrel site issue bridge-site router main --host 10.0.0.5\n          \
                      spandrel site issue bridge-site server main\n          \
                      spandrel site nodes bridge-site bridge.toml\n          \
                      spandrel site router bridge-site bridge.toml --listen quic/10.0.0.5:7447"
    )]
    Site(SiteCommand),
    /// Make a token for the web page: printed once, and kept as a hash.
    #[command(
        after_help = "Example: spandrel token grace --role operator --file /etc/spandrel/tokens.json"
    )]
    Token(TokenArguments),
    /// Write shell completions to standard output.
    #[command(after_help = "Example: spandrel completions bash > /etc/bash_completion.d/spandrel")]
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
}

/// How to join the bus.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Bus")]
pub struct BusArguments {
    /// Configuration file; what it says is overridden by variables SPANDREL_…, and those by flags.
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
    /// Certificate (PEM) to show and to ask for at endpoints quic/…; its key and the authority.pem of the site lie beside it.
    /// Without --listen the session is then a client of a router.
    #[arg(long, value_name = "FILE.pem")]
    pub certificate: Option<PathBuf>,
    /// Zenoh configuration file (JSON5).
    #[arg(long, value_name = "FILE")]
    pub zenoh_config: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct RouterArguments {
    /// Configuration file of a Zenoh router, as zenohd takes it; spandrel site router writes one.
    #[arg(value_name = "ROUTER.json5")]
    pub file: PathBuf,
}

/// What a token allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum TokenRole {
    /// To read.
    Viewer,
    /// To read, and to acknowledge alerts.
    Operator,
}

#[derive(Debug, Args)]
pub struct TokenArguments {
    /// Whose token it is.
    pub name: String,
    /// What it allows.
    #[arg(long, value_enum)]
    pub role: TokenRole,
    /// File of the tokens, which dashboard.tokens names; it is made if it is not there.
    #[arg(long, value_name = "FILE")]
    pub file: PathBuf,
    /// Take the place of the token of that name.
    #[arg(long)]
    pub replace: bool,
}

/// What is done with the folder of a site.
#[derive(Debug, Subcommand)]
pub enum SiteCommand {
    /// Make an authority, in a folder that only its owner can read.
    Create {
        /// Where its files go.
        folder: PathBuf,
        /// Name of the site, as it stands in the certificate of the authority.
        #[arg(long, default_value = "site")]
        name: String,
        /// For how many days it is valid.
        #[arg(long, default_value_t = 3650)]
        days: u32,
        /// Take the place of an authority that is there; all that it has issued is worth nothing then.
        #[arg(long)]
        replace: bool,
    },
    /// Issue a certificate.
    Issue {
        /// Folder of the site.
        folder: PathBuf,
        /// What the party is for: router, database, server, worker, alert, history, notify, dashboard, operator, viewer,
        /// gateway, node-worker or sensor.
        role: Role,
        /// Its name: STRUCTURE.NODE of a sensor or node-worker, STRUCTURE of a gateway, any of the others.
        name: String,
        /// Name or address under which others connect to it; may be repeated. A router and a database need one.
        #[arg(long)]
        host: Vec<String>,
        /// For how many days it is valid, at most as long as the authority.
        #[arg(long, default_value_t = 365)]
        days: u32,
        /// Take the place of a certificate that is there.
        #[arg(long)]
        replace: bool,
    },
    /// Issue a certificate to each sensor node that has none.
    Nodes {
        /// Folder of the site.
        folder: PathBuf,
        /// Structure files that name the nodes.
        #[arg(value_name = "STRUCTURE.toml", required = true)]
        structures: Vec<PathBuf>,
        /// For how many days they are valid.
        #[arg(long, default_value_t = 365)]
        days: u32,
    },
    /// Write the configuration of the router: who has a certificate in the folder may do what its role needs.
    Router(SiteRouterArguments),
}

#[derive(Debug, Args)]
pub struct SiteRouterArguments {
    /// Folder of the site.
    pub folder: PathBuf,
    /// Structure files; certificates of other structures and nodes are refused.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structures: Vec<PathBuf>,
    /// Endpoint to listen on, such as quic/10.0.0.5:7447; may be repeated.
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub listen: Vec<String>,
    /// Endpoint of another router of the site to connect to; may be repeated. Of two routers, one connects to the other.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Name of the router, where several have a certificate.
    #[arg(long, value_name = "NAME")]
    pub router: Option<String>,
    /// First chunk of all key expressions [default: spandrel].
    #[arg(long)]
    pub root: Option<String>,
    /// Folder in which the router finds its certificate, its key and authority.pem [default: that of the site].
    #[arg(long, value_name = "FOLDER")]
    pub installed_in: Option<PathBuf>,
    /// Where to write it [default: router.json5 in the folder of the site].
    #[arg(long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Take the place of a file that is there.
    #[arg(long)]
    pub replace: bool,
}

#[derive(Debug, Args)]
pub struct ServiceArguments {
    /// Structure file; may be repeated [default: those of the configuration].
    #[arg(value_name = "STRUCTURE.toml")]
    pub structures: Vec<PathBuf>,
    #[command(flatten)]
    pub bus: BusArguments,
}

/// Where the web page is served.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Page")]
pub struct PageArguments {
    /// Address of the web page, such as 127.0.0.1:8080, or none; port 0 is any free one [default: 127.0.0.1:8080, a free
    /// port if that is taken].
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

/// How fast data are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Speed {
    /// So many times real time.
    Times(f64),
    /// As fast as they are worked off.
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
    /// Be the worker of this sensor node alone; may be repeated [default: all nodes that identify for themselves].
    #[arg(long, value_name = "NAME")]
    pub node: Vec<String>,
    /// Stand by as long as another process identifies a structure, and take over when it is gone. Others take this process for gone
    /// after 2 s without a sign of life then, unless bus.lease_s says otherwise.
    #[arg(long, conflicts_with = "node")]
    pub standby: bool,
}

#[derive(Debug, Args)]
pub struct DemoArguments {
    /// Times real time, or max.
    #[arg(long, default_value = "10")]
    pub speed: Speed,
    /// Length of the simulated record (s).
    #[arg(long, default_value_t = 120.0, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: f64,
    /// Seed of excitation and noise.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// No view and no page, only alerts and the result: for scripts.
    #[arg(long, conflicts_with_all = ["http", "open", "stay"])]
    pub headless: bool,
    /// Keep the page after the end, until Ctrl-C; on a terminal that is so anyway.
    #[arg(long)]
    pub stay: bool,
    /// End with one JSON object.
    #[arg(long)]
    pub json: bool,
    /// Nodes that identify for themselves and a station that fuses them: forty storeys, sixteen nodes, one of them off all the time,
    /// one silent for a while, and spikes in all.
    #[arg(long, conflicts_with = "structure")]
    pub distributed: bool,
    /// Another structure file, with a simulation table, than the built-in one.
    #[arg(long, value_name = "STRUCTURE.toml")]
    pub structure: Option<PathBuf>,
    #[command(flatten)]
    pub page: PageArguments,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct BenchArguments {
    /// Structure file with a simulation table, of which there are copies [default: the building of the demo].
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: Option<PathBuf>,
    /// Number of structures, or the first one that is tried.
    #[arg(long, default_value_t = 10, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=10_000))]
    pub structures: usize,
    /// Go on with more structures until the machine is overrun, and tell the largest number that is sustained.
    #[arg(long)]
    pub largest: bool,
    /// Length of each measurement (s); the first 5 s are not counted.
    #[arg(long, default_value_t = 20.0, value_name = "SECONDS", value_parser = seconds)]
    pub duration: f64,
    /// Services in a process of their own, and sensors in another.
    #[arg(long)]
    pub apart: bool,
    /// One JSON object a line, each a measurement.
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
    /// Write the record to this file instead of sending it to the bus: columns and units as its record table has them.
    #[arg(long, value_name = "OUT.csv|OUT.mcap")]
    pub record: Option<PathBuf>,
    /// Length (s); without it a simulation on the bus goes on until it is stopped, and one to a file takes 120 s.
    #[arg(long, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<f64>,
    /// Seed of excitation and noise [default: that of the structure file].
    #[arg(long)]
    pub seed: Option<u64>,
    /// Times real time, or max; on the bus only.
    #[arg(long, default_value = "1", conflicts_with = "record")]
    pub speed: Speed,
    /// Send samples as hardware does: at the times that they bear, whoever is there, and not to be waited for.
    #[arg(long, conflicts_with_all = ["record", "speed"])]
    pub live: bool,
    /// When a live simulation has begun (seconds since 1970, UTC), so that nodes in several processes belong together; a
    /// process that comes later joins where the others are [default: now].
    #[arg(long, value_name = "SECONDS", requires = "live", value_parser = seconds, allow_negative_numbers = true)]
    pub start: Option<f64>,
    /// Be this sensor node alone; may be repeated [default: all nodes].
    #[arg(long, value_name = "NAME", conflicts_with = "record")]
    pub node: Vec<String>,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// The recording.
    pub record: PathBuf,
    /// Structure file; its record table says which column is which channel.
    #[arg(long, value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Times real time, or max.
    #[arg(long, default_value = "1")]
    pub speed: Speed,
    /// Go on where the frames of ingest end, as after a crash of this command, in place of a run of its own.
    #[arg(long)]
    pub resume: bool,
    #[command(flatten)]
    pub bus: BusArguments,
}

/// What a recording may not say of itself.
#[derive(Debug, Args)]
pub struct ReadingArguments {
    /// Sampling rate of channels for which the recording states none (Hz).
    #[arg(long, value_name = "HZ", value_parser = positive, allow_negative_numbers = true)]
    pub rate: Option<f64>,
    /// Column of a table with the time [default: the first one whose name begins with `time`, or that has dates].
    #[arg(long, value_name = "NAME")]
    pub time_column: Option<String>,
    /// Unit of the time in a table, if it is a number: s, ms, us or ns [default: s].
    #[arg(long, value_name = "UNIT", value_parser = time_unit)]
    pub time_unit: Option<TimeUnit>,
}

impl ReadingArguments {
    /// Returns the options of reading.
    pub fn options(&self) -> ReadOptions {
        ReadOptions {
            time_column: self.time_column.clone(),
            time_unit: self.time_unit,
            sampling_rate_hz: self.rate,
        }
    }
}

#[derive(Debug, Args)]
pub struct InfoArguments {
    /// The recording: a file of any known format, a zip archive or a folder of such files.
    pub record: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub reading: ReadingArguments,
}

#[derive(Debug, Args)]
pub struct ConvertArguments {
    /// The recording: a file of any known format, a zip archive or a folder of such files.
    pub record: PathBuf,
    /// Where to write it; the end of its name tells the format.
    #[arg(value_name = "OUT.csv|OUT.mcap")]
    pub output: PathBuf,
    /// Bring all channels to this rate (Hz), through a filter against aliasing.
    #[arg(long, value_name = "HZ", value_parser = positive, allow_negative_numbers = true)]
    pub resample: Option<f64>,
    #[command(flatten)]
    pub reading: ReadingArguments,
}

#[derive(Debug, Args)]
pub struct EstimateArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// The recording.
    #[arg(long)]
    pub record: PathBuf,
    /// Where to write mean and standard deviation of each parameter, response and adapted noise level, one row per frame.
    #[arg(long, value_name = "ESTIMATES.csv")]
    pub output: Option<PathBuf>,
    /// Sound values for alert rules that would learn them.
    #[arg(long, value_name = "BASELINE.json")]
    pub baseline: Option<PathBuf>,
    /// What identifies.
    #[arg(long, value_enum, default_value_t = FilterChoice::File)]
    pub filter: FilterChoice,
    /// End with one JSON object.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub particle: ParticleArguments,
}

/// The filters of `spandrel estimate`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FilterChoice {
    /// What the structure file asks for, as the services run it.
    File,
    /// The adaptive extended Kalman filter, or the bank of model classes, also where the file asks for particles.
    Kalman,
    /// A particle filter of the model with all parameters: slow, and takes nothing for Gaussian.
    Particle,
}

/// Where particles are drawn from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DensityChoice {
    /// Near the coming datum, by a Kalman filter of each particle.
    Optimal,
    /// From the model alone.
    Prior,
}

/// How particles are used; what is not given has the default of [`ParticleArguments::plan`].
#[derive(Debug, Clone, Copy, Args)]
#[command(next_help_heading = "With --filter particle")]
pub struct ParticleArguments {
    /// Number of particles [default: 2000].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=10_000_000), allow_negative_numbers = true)]
    pub particles: Option<u32>,
    /// Where particles are drawn from [default: optimal].
    #[arg(long, value_enum)]
    pub density: Option<DensityChoice>,
    /// Standard deviation by which each parameter may drift within a second, ratio to nominal per root of a second
    /// [default: 0.005].
    #[arg(long, value_name = "RATIO", value_parser = not_negative, allow_negative_numbers = true)]
    pub drift: Option<f64>,
    /// Share of a particle's own state at a resampling, the rest being drawn from all of them; 1 for none [default: 1].
    #[arg(long, value_name = "SHARE", value_parser = share, allow_negative_numbers = true)]
    pub kernel: Option<f64>,
    /// Seconds for which a Kalman filter runs before the particles are drawn [default: 2].
    #[arg(long, value_name = "SECONDS", value_parser = not_negative, allow_negative_numbers = true)]
    pub warm_up: Option<f64>,
    /// Seed of all draws [default: 0].
    #[arg(long)]
    pub seed: Option<u64>,
}

impl ParticleArguments {
    /// Returns the first option that was given, which is of no use without particles.
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

    /// Returns how the particles are used.
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
    /// A recording of the sound structure; several show how it differs from day to day.
    #[arg(long, required = true)]
    pub record: Vec<PathBuf>,
    /// Seconds at the start of each recording that are left out while the filter finds its way.
    #[arg(long, default_value_t = 10.0, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub skip: f64,
    /// Standard deviation of each parameter between records, ratio to nominal, where it is known: a single recording shows none
    /// [default: estimated from the recordings].
    #[arg(long, value_name = "RATIO", value_parser = not_negative, allow_negative_numbers = true)]
    pub between_std: Option<f64>,
    /// Where to write the sound values.
    #[arg(long, value_name = "BASELINE.json")]
    pub output: PathBuf,
}

#[derive(Debug, Args)]
pub struct CheckArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Length of data (s) for which the standard deviations are given.
    #[arg(long, default_value_t = 60.0, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub after: f64,
    /// One JSON object instead of text.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub struct ValidateArguments {
    /// Cases, or the first part of their names such as `ekf` [default: all].
    #[arg(value_name = "CASE")]
    pub cases: Vec<String>,
    /// List the cases and end.
    #[arg(long)]
    pub list: bool,
    /// Shortened records, with the figures that hold for them.
    #[arg(long)]
    pub quick: bool,
    /// Run each case for this seed; may be repeated [default: 1].
    #[arg(long, value_name = "N", conflicts_with = "seeds")]
    pub seed: Vec<u64>,
    /// Run each case for the seeds of a range that includes both ends: 4..8 stands for 4, 5, 6, 7, 8. A number N stands for
    /// 1..N.
    #[arg(long, value_name = "FIRST..LAST")]
    pub seeds: Option<Seeds>,
    /// Identify the records of real structures below DIR instead of running cases, and print what Spandrel says of them.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["cases", "quick", "seed", "seeds", "report", "list"])]
    pub records: Option<PathBuf>,
    /// Cases at the same time [default: one for each core].
    #[arg(long, value_name = "N")]
    pub jobs: Option<usize>,
    /// One JSON object a line, each a figure.
    #[arg(long)]
    pub json: bool,
    /// Write figures.md and index.html with diagrams there. Outcomes are kept in DIR/outcomes: a stopped run goes on, and a run
    /// of some cases leaves the others on the page.
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct WatchArguments {
    /// The structure [default: all].
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

fn time_unit(text: &str) -> Result<TimeUnit, String> {
    TimeUnit::of_symbol(text).ok_or_else(|| "must be s, ms, us or ns".to_owned())
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be above 0, up to 1".to_owned()),
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
    fn numbers_below_their_range_are_refused_with_it() {
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
    fn defaults_of_particles_are_those_that_help_tells() {
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
    fn speed_is_a_number_or_max() {
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("10".parse(), Ok(Speed::Times(10.0)));
        for wrong in ["0", "-1", "fast", "inf", ""] {
            assert!(wrong.parse::<Speed>().is_err(), "{wrong}");
        }
    }
}
