//! The command line.

mod operation;
mod recordings;
mod services;
mod shared;
mod values;

pub use operation::{
    AnnotateArguments, MaintenanceArguments, RouterArguments, SiteCommand, SiteRouterArguments,
    TokenArguments, TokenRole,
};
pub use recordings::{
    BaselineArguments, CheckArguments, ConvertArguments, EarthquakeArguments, EstimateArguments,
    ExampleArguments, FilterChoice, InfoArguments, JudgeArguments, ModesArguments,
    ValidateArguments,
};
pub use services::{
    BenchArguments, DemoArguments, FeedArguments, IdentifyArguments, NotifyArguments,
    ReplayArguments, RunArguments, SimulateArguments, WatchArguments,
};
pub use shared::{BusArguments, PageArguments, ServiceArguments};
pub use values::Speed;

use crate::bus_audit::Scope;
use clap::{Parser, Subcommand, ValueEnum};

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
    /// Without --series, --at and --example, run the service that judges the live estimates.
    #[command(
        after_help = "Examples: spandrel judge --config spandrel.toml\n          \
                      spandrel judge --example footbridge.csv --loss 0.05 --loss-day 480\n          \
                      spandrel judge footbridge.toml --series footbridge.csv\n          \
                      spandrel judge footbridge.toml --series footbridge.csv --report\n          \
                      spandrel judge footbridge.toml --series footbridge.csv --json\n          \
                      spandrel judge footbridge.toml --series footbridge.csv --course days.csv\n          \
                      spandrel judge bridge.toml --at 2026-03-01T12:00:00Z"
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
                      spandrel validate ekf.bridge outlier --seeds 101..105 --report validation\n\
                      \x20         spandrel validate judge --records ../shared/data")]
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

#[cfg(test)]
mod tests;
