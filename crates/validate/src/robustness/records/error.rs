//! Errors of a real record.

/// Reason why a record has no result.
#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    /// A structure file of the benchmark is invalid.
    #[error("the structure file of the benchmark is wrong: {0}")]
    Structure(spandrel_structure::StructureError),
    /// A record cannot be read.
    #[error(transparent)]
    Record(#[from] spandrel_record::RecordError),
    /// The structure does not define any frames.
    #[error(transparent)]
    Layout(#[from] spandrel_ingest::LayoutError),
    /// A name is not a valid chunk of a key expression.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
    /// The structure cannot be identified.
    #[error(transparent)]
    Identify(#[from] spandrel_identify::IdentifyError),
    /// The modes cannot be identified, or do not update the stiffnesses.
    #[error(transparent)]
    Modes(#[from] spandrel_modes::ModesError),
    /// The alert rules cannot be applied.
    #[error(transparent)]
    Alert(#[from] spandrel_alert::AlertError),
    /// A record contains no estimate to learn from.
    #[error("{record}: no estimate to learn from")]
    NothingLearnt {
        /// Name of the record.
        record: String,
    },
    /// A structure file does not contain the text that should be replaced.
    #[error("the structure file has no `{expected}`")]
    NoSuchText {
        /// Missing text.
        expected: String,
    },
}

impl From<spandrel_structure::StructureError> for RecordsError {
    fn from(error: spandrel_structure::StructureError) -> Self {
        Self::Structure(error)
    }
}
