//! Errors of a case and of its report.

use std::path::PathBuf;

/// Reason why a case has no outcome or a report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ValidateError {
    /// A filter of a case stopped with an error.
    #[error("the filter stopped at {time_s:.3} s: {reason}")]
    Filter {
        /// Time in the record (s).
        time_s: f64,
        /// Error of the filter.
        reason: spandrel_filter::FilterError,
    },
    /// The structure file of a case is invalid.
    #[error("the structure of the case is wrong: {0}")]
    Structure(spandrel_structure::StructureError),
    /// An example contradicts itself.
    #[error("the {what} of the example is inconsistent")]
    Example {
        /// Inconsistent part of the example.
        what: &'static str,
    },
    /// A run of the robustness benchmark stopped.
    #[error("the robustness benchmark stopped: {0}")]
    Robustness(String),
    /// An example file could not be run through the cores of the services.
    #[error("the example could not be run: {0}")]
    Fit(String),
    /// A series could not be judged.
    #[error("the judgement stopped")]
    Judge(#[from] spandrel_judge::JudgeError),
    /// The recordings of earthquakes could not be judged.
    #[error("the earthquakes could not be judged: {0}")]
    Earthquakes(String),
    /// A simulated epoch could not be identified.
    #[error("the identification of modes stopped")]
    Modal(#[from] spandrel_modal::ModalError),
    /// A real record has no result.
    #[error(transparent)]
    Records(#[from] crate::robustness::records::RecordsError),
    /// The case reads records of real structures, and the plan has none.
    #[error("this case needs the records of real structures (--records DIR)")]
    NoRecords,
    /// The run was asked to stop.
    #[error("stopped")]
    Stopped,
    /// No case has this name.
    #[error("unknown case {found}, must be one of: {known}")]
    UnknownCase {
        /// Requested name.
        found: String,
        /// All known names.
        known: String,
    },
    /// A file of the report cannot be read or written.
    #[error("{}: {reason}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// I/O error.
        reason: std::io::Error,
    },
    /// A diagram cannot be drawn.
    #[error("diagram {title}: {reason}")]
    Drawing {
        /// Title of the diagram.
        title: String,
        /// Reason.
        reason: String,
    },
}

impl ValidateError {
    /// Returns `true` if a file, an argument or a setting of the user is the cause.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::UnknownCase { .. } | Self::File { .. })
    }
}

impl ValidateError {
    /// Returns a function that converts the error of a filter which stopped at a time (s).
    pub(crate) fn at(time_s: f64) -> impl FnOnce(spandrel_filter::FilterError) -> Self {
        move |reason| Self::Filter { time_s, reason }
    }

    /// Converts the error of an example file that could not be run.
    pub(crate) fn fit(source: impl std::fmt::Display) -> Self {
        Self::Fit(source.to_string())
    }

    /// Converts the error of a filter that could not be built.
    pub(crate) fn setting(reason: spandrel_filter::FilterError) -> Self {
        Self::Filter {
            time_s: 0.0,
            reason,
        }
    }
}

impl From<spandrel_structure::StructureError> for ValidateError {
    fn from(error: spandrel_structure::StructureError) -> Self {
        Self::Structure(error)
    }
}
