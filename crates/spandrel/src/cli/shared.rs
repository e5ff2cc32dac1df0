//! Options that several commands have.

use super::values::{positive, time_unit};
use clap::Args;
use spandrel_record::{ReadOptions, TimeUnit};
use std::path::PathBuf;

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
pub struct ServiceArguments {
    /// Structure file; may be repeated [default: structures of the configuration].
    #[arg(value_name = "STRUCTURE.toml")]
    pub structures: Vec<PathBuf>,
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
