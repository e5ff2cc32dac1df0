//! What can go wrong with a real record.

/// Why a record has no result.
#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    /// A structure file of the benchmark is wrong.
    #[error("the structure file of the benchmark is wrong: {0}")]
    Structure(#[from] spandrel_structure::StructureError),
    /// A record cannot be read.
    #[error(transparent)]
    Record(#[from] spandrel_record::RecordError),
    /// The structure makes no frames.
    #[error(transparent)]
    Layout(#[from] spandrel_ingest::LayoutError),
    /// A name is no chunk of a key expression.
    #[error(transparent)]
    Name(#[from] spandrel_bus::NameError),
    /// The structure cannot be identified.
    #[error(transparent)]
    Identify(#[from] spandrel_identify::IdentifyError),
    /// The alert rules cannot be followed.
    #[error(transparent)]
    Alert(#[from] spandrel_alert::AlertError),
    /// A record has nothing to learn from.
    #[error("{record}: no estimate to learn from")]
    NothingLearnt {
        /// Name of the record.
        record: String,
    },
    /// A text of a structure file that should be replaced is not in it.
    #[error("the structure file has no `{expected}`")]
    NoSuchText {
        /// The text.
        expected: String,
    },
}
