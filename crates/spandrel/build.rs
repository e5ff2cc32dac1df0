//! Options of the linker for the program.

use std::env;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let is = |variable: &str, value: &str| env::var(variable).is_ok_and(|found| found == value);
    if is("CARGO_CFG_TARGET_OS", "linux") && is("CARGO_CFG_TARGET_ENV", "gnu") {
        // The table of relocations takes three megabytes, all of which the start reads into memory.
        // Packed, it takes some kilobytes. It then requires glibc 2.36. Older linkers ignore the
        // option.
        println!("cargo:rustc-link-arg-bins=-Wl,-z,pack-relative-relocs");
    }
}
