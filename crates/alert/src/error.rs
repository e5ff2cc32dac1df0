//! What can be wrong with alerts.

use std::path::PathBuf;

/// Why alerts cannot be decided or published.
#[derive(Debug, thiserror::Error)]
pub enum AlertError {
    /// A setting of a rule is out of range.
    #[error("{setting} is {found}, must lie between {low} and {high}")]
    Setting {
        /// Which one.
        setting: &'static str,
        /// What was found.
        found: f64,
        /// Least value allowed.
        low: f64,
        /// Largest value allowed.
        high: f64,
    },
    /// A reference is not positive, or too uncertain.
    #[error(
        "reference is {mean} ± {std}, must be positive and more than 3 standard deviations from zero"
    )]
    Reference {
        /// Its mean, ratio to nominal.
        mean: f64,
        /// Its standard deviation, ratio to nominal.
        std: f64,
    },
    /// What is wrong concerns one parameter.
    #[error("parameter `{parameter}`")]
    Parameter {
        /// Its name.
        parameter: String,
        /// What is wrong.
        source: Box<AlertError>,
    },
    /// A rule names a parameter, or its reference, that is not there.
    #[error(
        "rule {rule} watches parameter {index}, must be one of the {count} identified ones with a reference"
    )]
    NoSuchParameter {
        /// Number of the rule, from 1.
        rule: usize,
        /// Number of the parameter, from 0.
        index: usize,
        /// Identified parameters.
        count: usize,
    },
    /// Estimates or records have another number of parameters than the structure.
    #[error("found {found} parameters, must be {expected}")]
    ParameterCount {
        /// Parameters found.
        found: usize,
        /// Parameters of the structure.
        expected: usize,
    },
    /// One record does not show how records differ.
    #[error(
        "one record does not show the scatter between records; use more records, or state it with --between-std"
    )]
    OneRecord,
    /// The scatter between records is too large to be known from so few of them.
    #[error(
        "{} records of mean {mean:.4} that scatter by {std:.4} do not exclude a sound value of zero; use more records, or \
         state the scatter with --between-std",
        degrees_of_freedom + 1.0
    )]
    FewRecords {
        /// Mean of the records, ratio to nominal.
        mean: f64,
        /// Scatter between them, ratio to nominal.
        std: f64,
        /// Records less one.
        degrees_of_freedom: f64,
    },
    /// The records differ by more than the stated scatter between them allows.
    #[error(
        "records scatter by {found:.4}, a stated scatter of {stated:.4} between records allows {allowed:.4} at most \
         (probability 0.999)"
    )]
    StatedScatter {
        /// Scatter of the records, ratio to nominal.
        found: f64,
        /// Scatter stated.
        stated: f64,
        /// Largest scatter that the stated one and the uncertainty within records explain.
        allowed: f64,
    },
    /// A baseline needs at least one record.
    #[error("no records to learn a baseline from, must be at least 1")]
    NoRecords,
    /// A file could not be read or written.
    #[error("{}: cannot be read or written", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A file is no JSON of a baseline.
    #[error("{}: is no baseline file", path.display())]
    BaselineSyntax {
        /// The file.
        path: PathBuf,
        /// Where and why.
        source: serde_json::Error,
    },
    /// A baseline file has another version.
    #[error("{}: format is `{found}`, must be `{expected}`", path.display())]
    BaselineFormat {
        /// The file.
        path: PathBuf,
        /// What it says.
        found: String,
        /// What this program reads.
        expected: &'static str,
    },
    /// A baseline is that of another structure.
    #[error("baseline is that of structure `{found}`, must be that of `{expected}`")]
    BaselineStructure {
        /// The structure of the baseline.
        found: String,
        /// The structure watched.
        expected: String,
    },
    /// A name cannot be part of a key expression.
    #[error("`{found}` cannot be part of a key expression")]
    Name {
        /// The name.
        found: String,
        /// Why.
        source: spandrel_bus::NameError,
    },
    /// What the service remembers cannot be kept.
    #[error(transparent)]
    Checkpoint(#[from] spandrel_checkpoint::CheckpointError),
    /// The bus refused a declaration or is closed.
    #[error(transparent)]
    Bus(#[from] spandrel_bus::BusError),
}
