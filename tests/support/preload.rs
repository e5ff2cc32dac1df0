//! Libraries that replace functions of the C library in a program.

use super::skip;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Compiles `tests/support/NAME.c` into a library for `LD_PRELOAD` in a folder. Skips the test
/// without a C compiler.
pub fn compile_or_skip(name: &str, folder: &Path) -> Option<PathBuf> {
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/support");
    let library = folder.join(name).with_extension("so");
    let compiled = Command::new("cc")
        .args(["-shared", "-fPIC", "-O1", "-o"])
        .arg(&library)
        .arg(sources.join(name).with_extension("c"))
        .arg("-ldl")
        .output();
    match compiled {
        Ok(output) if output.status.success() => Some(library),
        Ok(output) => panic!("{}", String::from_utf8_lossy(&output.stderr)),
        Err(_) => {
            skip(&format!(
                "cc, which compiles tests/support/{name}.c, is not installed"
            ));
            None
        }
    }
}
