//! Errors that end the program, their text, and their exit code.

use spandrel_access::AccessError;
use spandrel_alert::AlertError;
use spandrel_bus::{BusError, NameError};
use spandrel_dashboard::DashboardError;
use spandrel_earthquake::EarthquakeError;
use spandrel_feed::FeedError;
use spandrel_history::HistoryError;
use spandrel_identify::IdentifyError;
use spandrel_ingest::IngestError;
use spandrel_judge::JudgeError;
use spandrel_judging::JudgingError;
use spandrel_modal::ModalError;
use spandrel_modes::ModesError;
use spandrel_notify::NotifyError;
use spandrel_record::RecordError;
use spandrel_reports::ReportsError;
use spandrel_sensor::SensorError;
use spandrel_structure::StructureError;
use spandrel_structure::text_encoding::WrongEncoding;
use spandrel_validate::ValidateError;
use std::error::Error;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use thiserror::Error;

/// Exit code for bad usage and bad input files.
const BAD_INPUT: u8 = 2;

/// An error that ends the program.
#[derive(Debug, Error)]
pub enum AppError {
    /// A structure file is not valid.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// A recording is not valid.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The settings of a judgement are not valid.
    #[error(transparent)]
    Judge(#[from] JudgeError),
    /// A row of a series cannot be judged.
    #[error("{}:{line}: cannot be judged", path.display())]
    Epoch {
        /// Path of the series.
        path: PathBuf,
        /// Line of the row, from 1.
        line: u64,
        /// Cause of the error.
        source: JudgeError,
    },
    /// A value of a series is not possible.
    #[error("{}:{line}: column `{column}`: {what}", path.display())]
    SeriesValue {
        /// Path of the series.
        path: PathBuf,
        /// Line of the row, from 1.
        line: u64,
        /// The column.
        column: String,
        /// The value found and the allowed values.
        what: String,
    },
    /// The configuration file cannot be read.
    #[error("{}: the configuration file cannot be read", path.display())]
    UnreadableConfiguration {
        /// Path of the file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// The configuration file is not UTF-8.
    #[error("{}:{}: {wrong}", path.display(), wrong.line)]
    WrongEncoding {
        /// Path of the file.
        path: PathBuf,
        /// The encoding found and its position.
        wrong: WrongEncoding,
    },
    /// The configuration is not valid.
    #[error(
        "configuration cannot be used (file {}, variables SPANDREL_…)",
        path.as_deref().map_or_else(|| "none".to_owned(), |path| path.display().to_string())
    )]
    Configuration {
        /// Path of the configuration file, if there is one.
        path: Option<PathBuf>,
        /// Cause of the error.
        source: Box<config::ConfigError>,
    },
    /// No structure is specified.
    #[error(
        "no structure: name a structure file, or list some under `structures` in the configuration"
    )]
    NoStructure,
    /// Two structure files have the same structure name.
    #[error("{} and {} both name their structure `{name}`, names must \
             differ", first.display(), second.display())]
    SameStructure {
        /// The name.
        name: String,
        /// Path of the first file.
        first: PathBuf,
        /// Path of the second file.
        second: PathBuf,
    },
    /// The configuration has a baseline for an unknown structure.
    #[error("{} is the baseline of unknown structure `{name}`, must be one of: \
             {known}", path.display())]
    BaselineOfNone {
        /// Name of the unknown structure.
        name: String,
        /// Path of the baseline file.
        path: PathBuf,
        /// Names of the known structures.
        known: String,
    },
    /// A baseline file belongs to another structure.
    #[error("{}: baseline is for structure `{found}`, must be for `{expected}`", path.display())]
    OtherBaseline {
        /// Path of the baseline file.
        path: PathBuf,
        /// Structure of the baseline.
        found: String,
        /// Structure of the structure file.
        expected: String,
    },
    /// No distributed node has this name.
    #[error(
        "unknown distributed node `{name}`, must be a node with identification = \"distributed\": \
         {known}"
    )]
    NoSuchNode {
        /// The unknown name.
        name: String,
        /// Names of the distributed nodes.
        known: String,
    },
    /// A standby was requested for a distributed structure, whose nodes have no standby.
    #[error(
        "structure {structure} is identified by its nodes (identification = \"distributed\"), \
         which have no standby; omit --standby"
    )]
    NoStandbyOfNodes {
        /// Name of the structure.
        structure: String,
    },
    /// A live check of the sensors receives no frames.
    #[error(
        "no frames of {structure} for {within_s} s, after {taken_s:.0} s of data; see whether \
         spandrel run or spandrel ingest runs at the endpoint to connect to (--connect), and \
         whether the sensors deliver (spandrel watch)"
    )]
    NoFrames {
        /// Name of the structure.
        structure: String,
        /// Time without a frame (s).
        within_s: u64,
        /// Length of the data before (s).
        taken_s: f64,
    },
    /// The live frames are those of another structure file.
    #[error(
        "the frames of {structure} have {} channels at {} Hz, the structure file states {} at {} \
         Hz; use the file of the running services",
        found.0, found.1, expected.0, expected.1
    )]
    OtherFrames {
        /// Name of the structure.
        structure: String,
        /// Number of channels and sampling rate (Hz) of the frames.
        found: (usize, f64),
        /// Those of the structure file.
        expected: (usize, f64),
    },
    /// The process cannot be isolated.
    #[error("isolated = true: {why}")]
    Isolated {
        /// What prevents it.
        why: String,
    },
    /// The structure has no node with this name.
    #[error("structure {structure} has no node `{name}`; its nodes: {known}")]
    UnknownNode {
        /// Name of the structure.
        structure: String,
        /// The unknown name.
        name: String,
        /// Names of the structure's nodes.
        known: String,
    },
    /// A certificate is for a structure that was not given.
    #[error("certificate {party} is for a structure that was not given; given: \
             {}", if known.is_empty() { "none" } else { known })]
    CertificateOfNone {
        /// Common name in the certificate.
        party: String,
        /// Names of the given structures.
        known: String,
    },
    /// The certificate does not grant the rights that the subcommand needs.
    #[error("certificate {} does not permit this: {why}; the router would silently drop forbidden \
             messages", certificate.display())]
    WrongRole {
        /// Path of the certificate.
        certificate: PathBuf,
        /// Holder of the certificate, missing right, and roles with that right.
        why: String,
    },
    /// An error of roles and certificates.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// A station was requested, but no structure is distributed.
    #[error("nothing to fuse: no structure has identification = \"distributed\"")]
    NothingToFuse,
    /// The root or a name is not valid in a key.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The bus cannot be joined or is closed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The feed failed.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// Some channels of the sources delivered nothing during a check.
    #[error("no samples from {missing} of {all} channels")]
    ChannelsMissing {
        /// Number of channels without samples.
        missing: usize,
        /// Number of configured channels.
        all: usize,
    },
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
    /// The service that judges lasting changes failed.
    #[error(transparent)]
    Judging(#[from] JudgingError),
    /// The service that follows natural frequencies failed.
    #[error(transparent)]
    Modes(#[from] ModesError),
    /// The reports of earthquakes failed.
    #[error(transparent)]
    Reports(#[from] ReportsError),
    /// The dashboard failed.
    #[error(transparent)]
    Dashboard(#[from] DashboardError),
    /// The history failed.
    #[error(transparent)]
    History(#[from] HistoryError),
    /// The history was requested, but the configuration switches it off.
    #[error(
        "the history is switched off: history.database is none, must be a file, sqlite:FILE or \
         postgres://…"
    )]
    NoHistory,
    /// Identification or alerts were requested, but no structure has a model.
    #[error(
        "nothing for {service}: every structure has kind = \"modal\" and therefore no model; \
         spandrel modes --live follows its natural frequencies"
    )]
    NothingToIdentify {
        /// Name of the subcommand.
        service: &'static str,
    },
    /// No structure has a table `[judge]`.
    #[error("no structure has a table [judge]; --series judges a file instead")]
    NothingToJudge,
    /// No structure has a table `[modal]`.
    #[error(
        "no structure has a table [modal]; spandrel modes --declare prints one for a recording"
    )]
    NothingToFollow,
    /// No structure has a table `[earthquakes]`.
    #[error(
        "no structure has a table [earthquakes]; spandrel earthquake reports recordings instead"
    )]
    NothingToReport,
    /// The service has no place for its recordings and reports.
    #[error("reports of earthquakes need a state folder, but state.folder is \"none\"")]
    NoFolderOfReports,
    /// The files are not recordings and at most one structure file.
    #[error("{found}, must be one or more recordings and at most one structure file (.toml)")]
    FilesOfModes {
        /// What is wrong with them.
        found: &'static str,
    },
    /// Recordings that belong together differ.
    #[error(
        "{}: has {found}, must have {expected} like {}; leave other files out, or choose channels \
         with --channels", path.display(), first.display()
    )]
    UnlikeRecordings {
        /// Path of the recording.
        path: PathBuf,
        /// Its channels or sampling rate.
        found: String,
        /// Path of the first recording.
        first: PathBuf,
        /// Channels or sampling rate of the first recording.
        expected: String,
    },
    /// Options that describe a recording were given together with a structure file, which does so.
    #[error("--rate, --time-column and --time-unit are for a recording without a structure file")]
    ReadingOfStructure,
    /// Several structures were given for one series.
    #[error("{found} structure files are given with --series, must be 1")]
    SeriesOfStructures {
        /// Number of structure files.
        found: usize,
    },
    /// `--report`, `--json` or `--course` was given without a series.
    #[error("--report and --course need --series, and --json needs --series or --at")]
    NoSeries,
    /// None or several structures were given for one past judgement.
    #[error("{found} structure files are given with --at, must be 1")]
    PastOfStructures {
        /// Number of structure files.
        found: usize,
    },
    /// The state is switched off.
    #[error("past judgements need a state folder, but state.folder is \"none\"")]
    NoFolderOfPast,
    /// The system defines no folder for persistent state.
    #[error(
        "no folder for persistent state: none of STATE_DIRECTORY, XDG_STATE_HOME and HOME is set; \
         set state.folder to a folder and history.database to a file or a postgres:// address, or \
         both to none"
    )]
    NoStateFolder,
    /// `spandrel check` would take too much memory or time.
    #[error(
        "{}: a check of {unknowns} parameters and noise levels with {channels} channels takes \
         about {found_mb} MB of memory and {found_s:.0} s of processor time, must take at most \
         {most_mb} MB and {most_s:.0} s (20 s on two processors); leave out parameters or sensors \
         in a copy of the file",
        path.display()
    )]
    CheckTooLarge {
        /// Path of the structure file.
        path: PathBuf,
        /// Number of parameters and noise levels.
        unknowns: usize,
        /// Number of channels.
        channels: usize,
        /// Expected memory (MB).
        found_mb: usize,
        /// Maximum memory (MB).
        most_mb: usize,
        /// Expected processor time (s).
        found_s: f64,
        /// Maximum processor time (s).
        most_s: f64,
    },
    /// The interval for flushing the recording to disk is not a valid time.
    #[error("state.recording.sync-s is {found}, must be a time in s, such as 1")]
    SyncTime {
        /// The rejected value.
        found: f64,
    },
    /// Notifications failed.
    #[error(transparent)]
    Notify(#[from] NotifyError),
    /// Notifications were requested, but no recipient is configured.
    #[error(
        "no recipients of notices: the configuration must have at least one [[notify.webhook]] or \
         [[notify.email]]"
    )]
    NoRecipients,
    /// A test notice was not delivered.
    #[error("{failed} of {receivers} test notices were not delivered")]
    NotDelivered {
        /// Number of failed deliveries.
        failed: usize,
        /// Number of receivers.
        receivers: usize,
    },
    /// An option of `spandrel maintenance` is not valid.
    #[error("{option}: {found}, must be {allowed}")]
    Maintenance {
        /// The option.
        option: &'static str,
        /// The value found.
        found: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// Notify does not run, or has not confirmed a request.
    #[error(
        "no confirmation from notify within {within_s} s; check that it runs for this structure, \
         that the configuration names a receiver, and that the parameter exists"
    )]
    NoAnswerOfNotify {
        /// The time limit, s.
        within_s: u64,
    },
    /// An option of `spandrel annotate` or `spandrel judge` is not valid.
    #[error("{option}: {found}, must be {allowed}")]
    Annotation {
        /// The option.
        option: &'static str,
        /// The value found.
        found: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// Judge does not run, or has not kept an annotation.
    #[error(
        "no confirmation from judge within {within_s} s; check that it runs for this structure, \
         and that the quantity is judged"
    )]
    NoAnswerOfJudge {
        /// The time limit, s.
        within_s: u64,
    },
    /// No estimate arrived during a measurement.
    #[error("no estimate was received; check that the measurement is longer than 5 s")]
    NothingMeasured,
    /// A page was requested, but the configuration switches it off.
    #[error(
        "the page is switched off: --http or dashboard.listen is none, must be an address such as \
         127.0.0.1:8080"
    )]
    NoPage,
    /// A simulated or replayed sensor failed.
    #[error(transparent)]
    Sensor(#[from] SensorError),
    /// The start of a live simulation is too far from now, or the simulation has ended.
    #[error("--start is {start_s}: {why}")]
    SimulationStart {
        /// Start, seconds since 1970.
        start_s: f64,
        /// What is wrong with it, and what is allowed.
        why: String,
    },
    /// A file, thread or terminal failed.
    #[error("{what}")]
    Io {
        /// Message that describes the failure.
        what: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A service panicked.
    #[error("{service} ended unexpectedly")]
    Panicked {
        /// Name of the service.
        service: &'static str,
        /// Error of the runtime.
        source: tokio::task::JoinError,
    },
    /// Instances of a service did not stop, and were aborted.
    #[error("{service} of {of}: the service did not stop before its deadline of {deadline_s} s")]
    NotStopped {
        /// Name of the service.
        service: &'static str,
        /// Its structures and nodes.
        of: String,
        /// The deadline in s.
        deadline_s: u64,
    },
    /// The validation could not run, or its report could not be written.
    #[error(transparent)]
    Validate(#[from] ValidateError),
    /// The validation ran, but not all results meet the requirements.
    #[error("{missed} figures miss their requirements, {failed} runs failed")]
    FiguresMissed {
        /// Number of figures outside their limits.
        missed: usize,
        /// Number of failed runs.
        failed: usize,
    },
    /// The output file is also an input.
    #[error("{}: is an input of this command and would be overwritten; use another output \
             file", path.display())]
    WouldOverwrite {
        /// Path of the file.
        path: PathBuf,
    },
    /// An option of the particle filter was given for another filter.
    #[error("{option} requires --filter particle")]
    ParticlesOnly {
        /// Name of the option.
        option: &'static str,
    },
    /// The record ended before any particle was drawn.
    #[error(
        "--warm-up is {warm_up_s} s, must be shorter than the record of {record_s} s, as must the \
         training of the noise levels; no particle was drawn"
    )]
    WarmUpTooLong {
        /// Time for which a Kalman filter runs first (s).
        warm_up_s: f64,
        /// Length of the record (s).
        record_s: f64,
    },
    /// A recording has no frame to learn a baseline from.
    #[error("{}: contains no frame to learn from after the first {skip_s} s", path.display())]
    NothingLearnt {
        /// Path of the recording.
        path: PathBuf,
        /// Time that is left out at its start (s).
        skip_s: f64,
    },
    /// The data of a recording contradict the model for most of the time.
    #[error(
        "{}: the data contradict the model in {:.0} % of the frames, at most {:.0} % are allowed; \
         check sensors, units and model with spandrel estimate",
        path.display(), 100.0 * share, 100.0 * largest
    )]
    BaselineContradicted {
        /// Path of the recording.
        path: PathBuf,
        /// Share of its frames in which they do.
        share: f64,
        /// Largest allowed share.
        largest: f64,
    },
    /// The excitation or the response of a recording is unknown for most of the time.
    #[error(
        "{}: {what} missing, faulty or in doubt for {:.0} % of the time, at most {:.0} % are \
         allowed; check the sensors with spandrel check --record",
        path.display(), 100.0 * share, 100.0 * largest
    )]
    BaselineUnmeasured {
        /// Path of the recording.
        path: PathBuf,
        /// What is unknown, with its verb.
        what: &'static str,
        /// Share of the time.
        share: f64,
        /// Largest allowed share.
        largest: f64,
    },
    /// No recording is usable for a baseline.
    #[error("none of the {} recordings is usable for a baseline:\n  \
             {}", reasons.len(), reasons.join("\n  "))]
    NoUsableRecordings {
        /// Reason for each recording, with its path.
        reasons: Vec<String>,
    },
    /// The modes of a recording cannot be identified.
    #[error("{}: modes cannot be identified", path.display())]
    Modal {
        /// Path of the recording.
        path: PathBuf,
        /// Cause of the error.
        source: ModalError,
    },
    /// A recording does not have this channel, or the channel is of no use.
    #[error("{}: no channel `{name}`, must be one of: {known}", path.display())]
    UnknownChannel {
        /// Path of the recording.
        path: PathBuf,
        /// The unknown name.
        name: String,
        /// Names of the channels.
        known: String,
    },
    /// Too few channels of a recording are of use.
    #[error(
        "{}: {found} channels with samples that vary, must be at least 2{}", path.display(),
        if left_out.is_empty() { String::new() } else { format!("; left out: {left_out}") }
    )]
    TooFewChannels {
        /// Path of the recording.
        path: PathBuf,
        /// Number of channels that are of use.
        found: usize,
        /// Channels that are of no use, with the reasons.
        left_out: String,
    },
    /// A recording is too short for its modes.
    #[error(
        "{}: is {found_s:.2} s long, must be at least {at_least_s:.2} s with these channels and \
         this band", path.display()
    )]
    TooShort {
        /// Path of the recording.
        path: PathBuf,
        /// Length found (s).
        found_s: f64,
        /// Smallest length (s).
        at_least_s: f64,
    },
    /// A recording has no complete epoch without a gap.
    #[error(
        "{}: contains no epoch of {epoch_s:.1} s without a gap in {found_s:.1} s; choose a shorter \
         one with --epoch", path.display()
    )]
    NoEpoch {
        /// Path of the recording.
        path: PathBuf,
        /// Length of the recording (s).
        found_s: f64,
        /// Length of an epoch (s).
        epoch_s: f64,
    },
    /// The samples of a recording lie too far apart in time.
    #[error(
        "{}: {samples} samples of a channel over {steps} time steps, must cover at least 1 % of \
         them; check the times, or leave channels out with --without", path.display()
    )]
    TooSparse {
        /// Path of the recording.
        path: PathBuf,
        /// Largest number of samples of a channel.
        samples: usize,
        /// Number of time steps from the first to the last sample of any channel.
        steps: usize,
    },
    /// No mode of a recording was found.
    #[error(
        "{}: no mode found; choose a longer --epoch, another --band, or a recording with more \
         motion",
        path.display()
    )]
    NoMode {
        /// Path of the recording.
        path: PathBuf,
    },
    /// A diagram cannot be drawn.
    #[error("the diagram cannot be drawn: {reason}")]
    Diagram {
        /// Reason of the drawing library.
        reason: String,
    },
    /// A setting of the report of an earthquake is not valid.
    #[error(transparent)]
    Earthquake(#[from] EarthquakeError),
    /// The structure has no channel that shows how strongly it moves.
    #[error("structure {structure} has no channel of an acceleration, must have at least one")]
    NoAccelerations {
        /// Name of the structure.
        structure: String,
    },
    /// Two recordings would have the same report.
    #[error(
        "{} and {} both start at the same time, so that both reports would be {event}; give one \
         of them",
        first.display(), second.display()
    )]
    SameEvent {
        /// Path of the first recording.
        first: PathBuf,
        /// Path of the second recording.
        second: PathBuf,
        /// Name of the report.
        event: String,
    },
    /// Recordings with dates are not in the order of time, and cannot be sorted.
    #[error(
        "{} (starts at {later}) precedes {} (starts at {earlier}), and {} has no date; \
         give all recordings in the order of time",
        first.display(), second.display(), undated.display()
    )]
    NotInOrder {
        /// Path of the recording that precedes.
        first: PathBuf,
        /// Its start.
        later: String,
        /// Path of the recording that follows.
        second: PathBuf,
        /// Its start.
        earlier: String,
        /// Path of a recording without a date.
        undated: PathBuf,
    },
    /// Some recordings could not be read. The others are reported.
    #[error("{count} of {} recordings cannot be reported; the first:", count + reported)]
    NotReported {
        /// Number of recordings without a report.
        count: usize,
        /// Number of recordings with a report.
        reported: usize,
        /// Error of the first.
        source: Box<AppError>,
    },
    /// A structure without parameters cannot have a baseline.
    #[error("{}: has no [[parameter]], must have at least one", path.display())]
    NoParameters {
        /// Path of the structure file.
        path: PathBuf,
    },
}

impl AppError {
    /// Returns the exit code: 2 for bad input files and bad usage, 1 for everything else.
    pub fn exit_code(&self) -> ExitCode {
        if self.is_bad_input() {
            ExitCode::from(BAD_INPUT)
        } else {
            ExitCode::FAILURE
        }
    }

    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    fn is_bad_input(&self) -> bool {
        match self {
            Self::Access(error) => error.is_bad_input(),
            Self::Alert(error) => error.is_bad_input(),
            Self::Bus(error) => error.is_bad_input(),
            Self::Dashboard(error) => error.is_bad_input(),
            Self::Feed(error) => error.is_bad_input(),
            Self::Fuse(error) => error.is_bad_input(),
            Self::History(error) => error.is_bad_input(),
            Self::Identify(error) => error.is_bad_input(),
            Self::Ingest(error) => error.is_bad_input(),
            Self::Judging(error) => error.is_bad_input(),
            Self::Modes(error) => error.is_bad_input(),
            Self::Notify(error) => error.is_bad_input(),
            Self::Reports(error) => error.is_bad_input(),
            Self::Sensor(error) => error.is_bad_input(),
            Self::Validate(error) => error.is_bad_input(),
            Self::Structure(_)
            | Self::Record(_)
            | Self::Judge(_)
            | Self::Epoch { .. }
            | Self::SeriesValue { .. }
            | Self::UnreadableConfiguration { .. }
            | Self::WrongEncoding { .. }
            | Self::Configuration { .. }
            | Self::NoStructure
            | Self::SameStructure { .. }
            | Self::BaselineOfNone { .. }
            | Self::OtherBaseline { .. }
            | Self::NothingLearnt { .. }
            | Self::BaselineContradicted { .. }
            | Self::BaselineUnmeasured { .. }
            | Self::NoUsableRecordings { .. }
            | Self::NoParameters { .. }
            | Self::Earthquake(_)
            | Self::NoAccelerations { .. }
            | Self::SameEvent { .. }
            | Self::NotInOrder { .. }
            | Self::NotReported { .. }
            | Self::Modal { .. }
            | Self::UnknownChannel { .. }
            | Self::TooFewChannels { .. }
            | Self::TooShort { .. }
            | Self::NoEpoch { .. }
            | Self::TooSparse { .. }
            | Self::NoSuchNode { .. }
            | Self::NoStandbyOfNodes { .. }
            | Self::Isolated { .. }
            | Self::OtherFrames { .. }
            | Self::UnknownNode { .. }
            | Self::NothingToFuse
            | Self::NothingToIdentify { .. }
            | Self::NothingToJudge
            | Self::NothingToFollow
            | Self::NothingToReport
            | Self::NoFolderOfReports
            | Self::FilesOfModes { .. }
            | Self::UnlikeRecordings { .. }
            | Self::ReadingOfStructure
            | Self::SeriesOfStructures { .. }
            | Self::NoSeries
            | Self::PastOfStructures { .. }
            | Self::NoFolderOfPast
            | Self::NoPage
            | Self::NoHistory
            | Self::NoRecipients
            | Self::Maintenance { .. }
            | Self::Annotation { .. }
            | Self::NoStateFolder
            | Self::CheckTooLarge { .. }
            | Self::SyncTime { .. }
            | Self::SimulationStart { .. }
            | Self::WouldOverwrite { .. }
            | Self::ParticlesOnly { .. }
            | Self::WarmUpTooLong { .. }
            | Self::Name(_)
            | Self::CertificateOfNone { .. }
            | Self::WrongRole { .. } => true,
            Self::FiguresMissed { .. }
            | Self::ChannelsMissing { .. }
            | Self::NothingMeasured
            | Self::NoMode { .. }
            | Self::Diagram { .. }
            | Self::NotDelivered { .. }
            | Self::NoAnswerOfNotify { .. }
            | Self::NoAnswerOfJudge { .. }
            | Self::NoFrames { .. }
            | Self::Io { .. }
            | Self::NotStopped { .. }
            | Self::Panicked { .. } => false,
        }
    }

    /// Returns `true` if a service panicked, in which case a restart may succeed.
    pub fn is_of_a_panic(&self) -> bool {
        matches!(
            self,
            Self::Panicked { .. } | Self::Identify(IdentifyError::ThreadLost { .. })
        )
    }

    /// Returns the error and its causes as text for people.
    pub fn report(&self) -> String {
        let mut text = format!("error: {self}\n");
        let mut cause = self.source();
        while let Some(error) = cause {
            let line = without_source_places(&error.to_string());
            // Writing to a string cannot fail.
            let _ = writeln!(text, "  because: {line}");
            cause = error.source();
        }
        text
    }
}

/// Removes source locations that Zenoh adds to its errors, such as ` at …/lib.rs:1507.`
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
    fn source_locations_of_zenoh_are_removed() {
        let told = "No such file (os error 2) at \
                    /root/.cargo/zenoh-config-1.10.2/src/lib.rs:1507. - Caused by x at a.rs:3.";
        assert_eq!(
            without_source_places(told),
            "No such file (os error 2) - Caused by x"
        );
        for plain in ["found at line 7", "main.rs: is no configuration", ""] {
            assert_eq!(without_source_places(plain), plain);
        }
    }
}
