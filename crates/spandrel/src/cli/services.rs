//! The commands that run services, publish samples or show them.

use super::shared::{BusArguments, PageArguments, ServiceArguments};
use super::values::{Speed, check_seconds, seconds};
use clap::Args;
use std::path::PathBuf;

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
    ///
    /// Above 1 and with --duration, the samples have times in the past, and the last one has the
    /// present time. Without --duration, their times run ahead of the clock.
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

#[derive(Debug, Args)]
pub struct WatchArguments {
    /// Name of the structure [default: all].
    pub structure: Option<String>,
    #[command(flatten)]
    pub bus: BusArguments,
}
