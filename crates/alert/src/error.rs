//! Errors of rules, baselines and the alert service.

use std::path::PathBuf;

/// An error of rules, baselines or the alert service.
#[derive(Debug, thiserror::Error)]
pub enum AlertError {
    /// A setting of a rule is out of range.
    #[error("{setting} is {found}, must lie between {low} and {high}")]
    Setting {
        /// The setting.
        setting: &'static str,
        /// The value found.
        found: f64,
        /// Smallest valid value.
        low: f64,
        /// Largest valid value.
        high: f64,
    },
    /// A reference is not positive, or too uncertain.
    #[error(
        "reference is {mean:.4} ± {std:.4}, must be positive and more than 3 standard deviations \
         from zero"
    )]
    Reference {
        /// Mean of the reference, as a ratio to nominal.
        mean: f64,
        /// Standard deviation of the reference, as a ratio to nominal.
        std: f64,
    },
    /// An error that concerns one parameter.
    #[error("parameter `{parameter}`")]
    Parameter {
        /// Name of the parameter.
        parameter: String,
        /// The error.
        source: Box<AlertError>,
    },
    /// A rule names a missing parameter, or one without a reference.
    #[error(
        "rule {rule} watches parameter {index}, must be one of the {count} identified ones with a \
         reference"
    )]
    NoSuchParameter {
        /// Number of the rule, from 1.
        rule: usize,
        /// Index of the parameter, from 0.
        index: usize,
        /// Number of identified parameters.
        count: usize,
    },
    /// Estimates or records have a different number of parameters than the structure.
    #[error("found {found} parameters, must be {expected}")]
    ParameterCount {
        /// Number of parameters found.
        found: usize,
        /// Number of parameters of the structure.
        expected: usize,
    },
    /// One record does not show the scatter between records.
    #[error(
        "one record does not show the scatter between records; use more records, or state it with \
         --between-std"
    )]
    OneRecord,
    /// The scatter between records is too large for an estimate from so few of them.
    #[error(
        "{} records with mean {mean:.4} and scatter {std:.4} do not exclude a baseline of zero; \
         use more records, or state the scatter with --between-std",
        degrees_of_freedom + 1.0
    )]
    FewRecords {
        /// Mean of the records, as a ratio to nominal.
        mean: f64,
        /// Scatter between the records, as a ratio to nominal.
        std: f64,
        /// Number of records minus one.
        degrees_of_freedom: f64,
    },
    /// The baseline contains an impossible reference of a sensor.
    #[error(
        "the reference of the sensor {channel} is impossible: its factor and its scatters must be \
         positive, and its delay finite"
    )]
    SensorReference {
        /// Name of the channel.
        channel: String,
    },
    /// The baseline contains an impossible effect of leaving out a sensor.
    #[error(
        "the changes without the sensor {channel} are impossible, must be {expected} numbers of \
         at least 0"
    )]
    WithoutSensor {
        /// Name of the channel.
        channel: String,
        /// Number of parameters.
        expected: usize,
    },
    /// The records differ by more than the stated scatter permits.
    #[error(
        "the scatter between records is {found:.4}, must be at most {allowed:.4} for a stated \
         scatter of {stated:.4} (probability 0.999)"
    )]
    StatedScatter {
        /// Scatter of the records, as a ratio to nominal.
        found: f64,
        /// Stated scatter, as a ratio to nominal.
        stated: f64,
        /// Largest scatter that the stated scatter and the uncertainty within records can explain.
        allowed: f64,
    },
    /// There are no records. A baseline needs at least one.
    #[error("no records to learn a baseline from, must be at least 1")]
    NoRecords,
    /// A file cannot be read or written.
    #[error("{}: cannot be read or written", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A file does not contain the JSON of a baseline.
    #[error("{}: is not a baseline file", path.display())]
    BaselineSyntax {
        /// Path of the file.
        path: PathBuf,
        /// Position and cause of the error.
        source: serde_json::Error,
    },
    /// A baseline file has an unsupported version.
    #[error("{}: format is `{found}`, must be `{expected}`", path.display())]
    BaselineFormat {
        /// Path of the file.
        path: PathBuf,
        /// The version in the file.
        found: String,
        /// The version that this program supports.
        expected: &'static str,
    },
    /// A baseline belongs to another structure.
    #[error("baseline is for structure `{found}`, must be for `{expected}`")]
    BaselineStructure {
        /// Name of the baseline's structure.
        found: String,
        /// Name of the watched structure.
        expected: String,
    },
    /// A name cannot be part of a key expression.
    #[error("`{found}` cannot be part of a key expression")]
    Name {
        /// The name.
        found: String,
        /// The cause.
        source: spandrel_bus::NameError,
    },
    /// A checkpoint cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] spandrel_checkpoint::CheckpointError),
    /// The matrices of the model do not fit each other.
    #[error(transparent)]
    Modal(#[from] spandrel_modal::ModalError),
    /// The bus rejected a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] spandrel_bus::BusError),
}

impl AlertError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(
            self,
            Self::File { .. }
                | Self::BaselineSyntax { .. }
                | Self::BaselineFormat { .. }
                | Self::BaselineStructure { .. }
        )
    }
}
