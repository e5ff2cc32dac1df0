//! What ends the program, how it is told, and with which exit code.

use spandrel_access::AccessError;
use spandrel_alert::AlertError;
use spandrel_bus::{BusError, NameError, TlsError};
use spandrel_dashboard::DashboardError;
use spandrel_history::HistoryError;
use spandrel_identify::IdentifyError;
use spandrel_ingest::IngestError;
use spandrel_notify::NotifyError;
use spandrel_record::RecordError;
use spandrel_sensor::SensorError;
use spandrel_structure::StructureError;
use spandrel_validate::ValidateError;
use std::error::Error;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use thiserror::Error;

/// Exit code of bad usage and of bad input files.
const BAD_INPUT: u8 = 2;

/// Why the program ends.
#[derive(Debug, Error)]
pub enum AppError {
    /// A structure file is wrong.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// A recording is wrong.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The configuration file is not there.
    #[error("{}: no such configuration file", path.display())]
    NoConfiguration {
        /// The file.
        path: PathBuf,
    },
    /// The configuration is wrong.
    #[error(
        "configuration cannot be used (file {}, variables SPANDREL_…)",
        path.as_deref().map_or_else(|| "none".to_owned(), |path| path.display().to_string())
    )]
    Configuration {
        /// The file, if there is one.
        path: Option<PathBuf>,
        /// What is wrong.
        source: Box<config::ConfigError>,
    },
    /// No structure was named.
    #[error(
        "no structure: name a structure file, or list some under `structures` in the configuration"
    )]
    NoStructure,
    /// Two structure files have one name.
    #[error("{} and {} both name their structure `{name}`, names must differ", first.display(), second.display())]
    SameStructure {
        /// The name.
        name: String,
        /// One file.
        first: PathBuf,
        /// The other.
        second: PathBuf,
    },
    /// The configuration has sound values of a structure that it does not name.
    #[error("{} is the baseline of `{name}`, which is none of the structures: {known}", path.display())]
    BaselineOfNone {
        /// The name.
        name: String,
        /// The baseline file.
        path: PathBuf,
        /// The structures.
        known: String,
    },
    /// No node of this name identifies for itself.
    #[error(
        "no node `{name}` identifies for itself; those that do (identification = \"distributed\"): {known}"
    )]
    NoSuchNode {
        /// The name.
        name: String,
        /// The nodes that do.
        known: String,
    },
    /// Nodes that identify for themselves have no standby.
    #[error(
        "structure {structure} is identified by its nodes (identification = \"distributed\"), which have no standby; leave --standby out"
    )]
    NoStandbyOfNodes {
        /// The structure.
        structure: String,
    },
    /// The structure has no node of this name.
    #[error("structure {structure} has no node `{name}`; its nodes: {known}")]
    UnknownNode {
        /// The structure.
        structure: String,
        /// The name.
        name: String,
        /// The nodes that it has.
        known: String,
    },
    /// A certificate is for a structure that was not given.
    #[error("certificate {party} is for a structure that was not given; given: {}", if known.is_empty() { "none" } else { known })]
    CertificateOfNone {
        /// Whose certificate it is.
        party: String,
        /// The structures given.
        known: String,
    },
    /// The certificate does not allow what the subcommand has to do.
    #[error("certificate {} does not fit: {why}; the router would drop what it does not allow, and tell nobody", certificate.display())]
    WrongRole {
        /// The certificate.
        certificate: PathBuf,
        /// Whose it is, and who may.
        why: String,
    },
    /// Roles and certificates.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// A station was asked for, and no structure is identified by its nodes.
    #[error("nothing to fuse: no structure has identification = \"distributed\"")]
    NothingToFuse,
    /// The root or a name cannot be a key.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The bus cannot be joined, or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The ingest service failed.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The identification failed.
    #[error(transparent)]
    Identify(#[from] IdentifyError),
    /// The station failed.
    #[error(transparent)]
    Fuse(#[from] spandrel_fuse::FuseError),
    /// The alert service failed.
    #[error(transparent)]
    Alert(#[from] AlertError),
    /// The dashboard failed.
    #[error(transparent)]
    Dashboard(#[from] DashboardError),
    /// The history failed.
    #[error(transparent)]
    History(#[from] HistoryError),
    /// The history was asked for, and none is to be kept.
    #[error(
        "the history is switched off: history.database is none, must be a file, sqlite:FILE or postgres://…"
    )]
    NoHistory,
    /// Nothing says where this system keeps what programs have to remember.
    #[error(
        "no place for what is kept: none of STATE_DIRECTORY, XDG_STATE_HOME and HOME is set; set state.folder to a folder and history.database to a file or a postgres:// address, or both to none"
    )]
    NoStateFolder,
    /// The recording is to be forced to the disk at no time.
    #[error("state.recording.sync-s is {found}, must be a time in s, such as 1")]
    SyncTime {
        /// What was found.
        found: f64,
    },
    /// Notices failed.
    #[error(transparent)]
    Notify(#[from] NotifyError),
    /// Notices were asked for, and there is nobody to tell.
    #[error("nobody to tell: the configuration has no [[notify.webhook]] and no [[notify.email]]")]
    NobodyToTell,
    /// No estimate came in a measurement.
    #[error("nothing was measured: no estimate has come; is the measurement longer than 5 s?")]
    NothingMeasured,
    /// A page was asked for, and none is to be served.
    #[error(
        "the page is switched off: --http or dashboard.listen is none, must be an address such as 127.0.0.1:8080"
    )]
    NoPage,
    /// A simulated or replayed sensor failed.
    #[error(transparent)]
    Sensor(#[from] SensorError),
    /// A file, thread or terminal failed.
    #[error("{what}")]
    Io {
        /// What was tried.
        what: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// A service ended by a panic.
    #[error("{service} ended unexpectedly")]
    Panicked {
        /// The service.
        service: &'static str,
        /// What the runtime says.
        source: tokio::task::JoinError,
    },
    /// The validation could not be run, or its report not written.
    #[error(transparent)]
    Validate(#[from] ValidateError),
    /// The validation ran and not all is as required.
    #[error("{missed} figures are not as required, {failed} runs failed")]
    FiguresMissed {
        /// Figures outside.
        missed: usize,
        /// Runs without outcome.
        failed: usize,
    },
    /// The output is one of the inputs.
    #[error("{}: is read by this command and would be written over; name another file", path.display())]
    WouldOverwrite {
        /// The file.
        path: PathBuf,
    },
    /// An option of particles was given to another filter.
    #[error("{option} is of use only with --filter particle")]
    ParticlesOnly {
        /// The option.
        option: &'static str,
    },
    /// No particle was ever drawn.
    #[error(
        "--warm-up is {warm_up_s} s and the record has {record_s} s: no particle was drawn, it must be shorter than the record"
    )]
    WarmUpTooLong {
        /// Seconds for which a Kalman filter was to run.
        warm_up_s: f64,
        /// Length of the record (s).
        record_s: f64,
    },
    /// A recording has no frame from which a baseline could be learnt.
    #[error("{}: has no frame after the first {skip_s} s, nothing can be learnt from it", path.display())]
    NothingLearnt {
        /// The recording.
        path: PathBuf,
        /// Seconds left out at its start.
        skip_s: f64,
    },
    /// The data of a recording contradict the model for most of the time.
    #[error(
        "{}: the data contradict the model in {:.0} % of the frames, at most {:.0} % are allowed; \
         check sensors, units and model with spandrel estimate",
        path.display(), 100.0 * share, 100.0 * largest
    )]
    BaselineContradicted {
        /// The recording.
        path: PathBuf,
        /// Share of its frames.
        share: f64,
        /// Largest allowed share.
        largest: f64,
    },
    /// A structure without parameters has no sound values.
    #[error("{}: has no [[parameter]], must have one whose sound value can be learnt", path.display())]
    NoParameters {
        /// The structure file.
        path: PathBuf,
    },
}

impl AppError {
    /// Bad input files and bad usage are 2, everything else is 1.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            // a clock that is set later, or a new certificate, mends it: whoever starts this program is to try again
            Self::Bus(BusError::Tls(TlsError::NotInTime { .. })) => ExitCode::FAILURE,
            Self::Structure(_)
            | Self::Record(_)
            | Self::NoConfiguration { .. }
            | Self::Configuration { .. }
            | Self::NoStructure
            | Self::SameStructure { .. }
            | Self::BaselineOfNone { .. }
            | Self::NothingLearnt { .. }
            | Self::BaselineContradicted { .. }
            | Self::NoParameters { .. }
            | Self::NoSuchNode { .. }
            | Self::NoStandbyOfNodes { .. }
            | Self::UnknownNode { .. }
            | Self::NothingToFuse
            | Self::NoPage
            | Self::Dashboard(
                DashboardError::Unprotected { .. }
                | DashboardError::Tls(_)
                | DashboardError::Certificate { .. }
                | DashboardError::TokenFile { .. }
                | DashboardError::NotTokens { .. }
                | DashboardError::NoTokens { .. }
                | DashboardError::TokenExists { .. },
            )
            | Self::NoHistory
            | Self::NobodyToTell
            | Self::Notify(NotifyError::Setting { .. } | NotifyError::Secret { .. })
            | Self::NoStateFolder
            | Self::SyncTime { .. }
            | Self::History(HistoryError::Address { .. })
            | Self::WouldOverwrite { .. }
            | Self::ParticlesOnly { .. }
            | Self::WarmUpTooLong { .. }
            | Self::Name(_)
            | Self::Validate(ValidateError::UnknownCase { .. } | ValidateError::File { .. })
            | Self::Sensor(SensorError::Record(_))
            | Self::Ingest(IngestError::Record(RecordError::OtherLog { .. }))
            | Self::Identify(IdentifyError::StateTooLarge { .. })
            | Self::CertificateOfNone { .. }
            | Self::WrongRole { .. }
            | Self::Access(
                AccessError::Party(_)
                | AccessError::Exists { .. }
                | AccessError::NoSite { .. }
                | AccessError::NoHost { .. }
                | AccessError::Host { .. }
                | AccessError::Days { .. }
                | AccessError::NoRouter { .. }
                | AccessError::SeveralRouters { .. }
                | AccessError::PlainEndpoint { .. }
                | AccessError::PathNotText { .. },
            )
            | Self::Bus(
                BusError::ConfigFile { .. }
                | BusError::Setting { .. }
                | BusError::Root { .. }
                | BusError::Structure { .. }
                | BusError::ConnectTimeout { .. }
                | BusError::Lease { .. }
                | BusError::TlsOverTcp { .. }
                | BusError::NotARouter { .. }
                | BusError::PathNotText { .. }
                | BusError::Unprotected { .. }
                | BusError::NoCertificateAsked { .. }
                | BusError::Multicast
                | BusError::NoCertificates { .. }
                | BusError::Tls(_),
            )
            | Self::Alert(
                AlertError::File { .. }
                | AlertError::BaselineSyntax { .. }
                | AlertError::BaselineFormat { .. }
                | AlertError::BaselineStructure { .. },
            ) => ExitCode::from(BAD_INPUT),
            Self::Access(_)
            | Self::Bus(_)
            | Self::Ingest(_)
            | Self::Identify(_)
            | Self::Fuse(_)
            | Self::Alert(_)
            | Self::Dashboard(_)
            | Self::History(_)
            | Self::Notify(_)
            | Self::Sensor(_)
            | Self::Validate(_)
            | Self::FiguresMissed { .. }
            | Self::NothingMeasured
            | Self::Io { .. }
            | Self::Panicked { .. } => ExitCode::FAILURE,
        }
    }

    /// Whether a service has ended by a panic, after which another life of it may go better.
    pub fn is_of_a_panic(&self) -> bool {
        matches!(
            self,
            Self::Panicked { .. } | Self::Identify(IdentifyError::ThreadLost { .. })
        )
    }

    /// The error and its causes, for a person.
    pub fn report(&self) -> String {
        let mut text = format!("error: {self}\n");
        let mut cause = self.source();
        while let Some(error) = cause {
            let line = without_source_places(&error.to_string());
            if !text.contains(&line) {
                // writing to a String does not fail
                let _ = writeln!(text, "  because: {line}");
            }
            cause = error.source();
        }
        text
    }
}

/// Takes out where in its own source Zenoh noticed an error: ` at …/lib.rs:1507.`
fn without_source_places(text: &str) -> String {
    let mut text = text.to_owned();
    while let Some(end) = text.find(".rs:") {
        let Some(begin) = text[..end].rfind(" at ") else {
            break;
        };
        let number = end + ".rs:".len();
        let digits = text[number..]
            .bytes()
            .take_while(u8::is_ascii_digit)
            .count();
        let dot = usize::from(text[number + digits..].starts_with('.'));
        text.replace_range(begin..number + digits + dot, "");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_the_source_of_zenoh_are_left_out() {
        let told = "No such file (os error 2) at /root/.cargo/zenoh-config-1.10.2/src/lib.rs:1507. - Caused by x at a.rs:3.";
        assert_eq!(
            without_source_places(told),
            "No such file (os error 2) - Caused by x"
        );
        for plain in ["found at line 7", "main.rs: is no configuration", ""] {
            assert_eq!(without_source_places(plain), plain);
        }
    }
}
