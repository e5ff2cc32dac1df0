//! Structure files: from the text to a structure, or to all mistakes in it.

use spandrel_structure::Structure;
use std::path::Path;

/// Parses one input. Returns the mistakes if the file is rejected.
pub fn decode(bytes: &[u8]) -> Result<(), String> {
    let text = std::str::from_utf8(bytes).map_err(|error| error.to_string())?;
    // This folder does not exist, so that no matrix lies beside the file.
    let structure = Structure::parse(text, Path::new("/nowhere/structure.toml"));
    let structure = structure.map_err(|error| error.to_string())?;
    assert!(!structure.name().is_empty());
    Ok(())
}
