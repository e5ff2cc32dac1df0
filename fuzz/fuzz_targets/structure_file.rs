//! Structure files: text to a structure, or all that is wrong with it.

#![no_main]

use libfuzzer_sys::fuzz_target;
use spandrel_structure::Structure;
use std::path::Path;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(text) = std::str::from_utf8(bytes) {
        // there is no such folder, and so no matrix beside the file
        match Structure::parse(text, Path::new("/nowhere/structure.toml")) {
            Ok(structure) => assert!(!structure.name().is_empty()),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
});
