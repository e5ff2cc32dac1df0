//! What can go wrong while a case runs.

use std::path::PathBuf;

/// Why a case has no outcome, or a report could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ValidateError {
    /// A filter of a case stopped.
    #[error("the filter stopped at {time_s:.3} s: {source}")]
    Filter {
        /// When (s of the record).
        time_s: f64,
        /// Why.
        source: spandrel_filter::FilterError,
    },
    /// A structure file of a case is wrong.
    #[error("the structure of the case is wrong: {0}")]
    Structure(#[from] spandrel_structure::StructureError),
    /// An example contradicts itself.
    #[error("the {what} of the example does not hold together")]
    Example {
        /// What of it.
        what: &'static str,
    },
    /// A run of the robustness benchmark stopped.
    #[error("the robustness benchmark stopped: {0}")]
    Robustness(String),
    /// An example file could not be run through the cores of the services.
    #[error("the example could not be run: {0}")]
    Fit(String),
    /// A real record has no result.
    #[error(transparent)]
    Records(#[from] crate::robustness::records::RecordsError),
    /// The case was told to stop.
    #[error("stopped")]
    Stopped,
    /// A case has no such name.
    #[error("there is no case {found}; cases are {known}")]
    UnknownCase {
        /// What was asked for.
        found: String,
        /// All names.
        known: String,
    },
    /// A file of the report cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A diagram cannot be drawn.
    #[error("diagram {title}: {reason}")]
    Drawing {
        /// Which.
        title: String,
        /// Why.
        reason: String,
    },
}

impl ValidateError {
    /// Makes the error of a filter that stopped at a time (s).
    pub(crate) fn at(time_s: f64) -> impl FnOnce(spandrel_filter::FilterError) -> Self {
        move |source| Self::Filter { time_s, source }
    }

    /// Makes the error of an example file that could not be run.
    pub(crate) fn fit(source: impl std::fmt::Display) -> Self {
        Self::Fit(source.to_string())
    }

    /// Makes the error of a filter that could not be built.
    pub(crate) fn setting(source: spandrel_filter::FilterError) -> Self {
        Self::Filter {
            time_s: 0.0,
            source,
        }
    }
}
