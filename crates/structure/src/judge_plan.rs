//! What `[judge]` states: quantities, conditions, budget, and the columns of their series.

use crate::error::StructureError;
use crate::file::StructureFile;
use crate::structure::read_text;
use serde::{Deserialize, Serialize};
use spandrel_judge::Settings;
use std::path::Path;

/// The `[judge]` table.
///
/// The service `judge` records it. A new field, also of [`Settings`], therefore needs a default for
/// the records of former versions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JudgePlan {
    /// What is judged, under which conditions and with which budget.
    pub settings: Settings,
    /// Length of the epochs that are formed of live values (s).
    pub epoch_s: u32,
    /// Column of the time in a series.
    pub time_column: String,
    /// Column of each quantity, in the order of the settings.
    pub quantity_columns: Vec<String>,
    /// Column of each condition, in the order of the settings.
    pub condition_columns: Vec<String>,
}

/// A structure that is judged: its name and its `[judge]` table.
///
/// The file needs no model, because natural frequencies may come from elsewhere.
#[derive(Debug, Clone, PartialEq)]
pub struct JudgedStructure {
    /// Name of the structure.
    pub name: String,
    /// The `[judge]` table of the structure file.
    pub plan: JudgePlan,
}

impl JudgedStructure {
    /// Reads a structure file with a `[judge]` table. The file may lack everything else but the
    /// name of the structure.
    ///
    /// # Errors
    /// Returns every mistake in the file, each with its line.
    pub fn read(path: &Path) -> Result<Self, StructureError> {
        Self::parse(&read_text(path)?, path)
    }

    /// Reads a structure file with a `[judge]` table and without a model. Returns `None` for a file
    /// that has a model, or no such table.
    ///
    /// # Errors
    /// Returns the same errors as [`JudgedStructure::read`].
    pub fn read_without_model(path: &Path) -> Result<Option<Self>, StructureError> {
        let text = read_text(path)?;
        let tables: Option<toml::Table> = toml::from_str(&text).ok();
        let is_alone =
            |tables: toml::Table| tables.contains_key("judge") && !tables.contains_key("model");
        match tables.is_some_and(is_alone) {
            true => Self::parse(&text, path).map(Some),
            false => Ok(None),
        }
    }

    /// Parses the text of a structure file. Messages contain `path`.
    ///
    /// # Errors
    /// Returns the same errors as [`JudgedStructure::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, StructureError> {
        StructureFile::parse(text, path)?.resolve_judged(path)
    }
}
