//! Options of the linker for the program.

use std::env;
use std::process::Command;

/// First version of glibc that can load packed relocations.
const PACKED_SINCE: (u32, u32) = (2, 36);

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    // The table of relocations takes three megabytes, all of which the start reads into memory.
    // Packed, it takes some kilobytes. An older glibc refuses to start such a program. A static
    // program contains the musl of the toolchain, which can load packed relocations.
    let is_musl = env::var("CARGO_CFG_TARGET_ENV").is_ok_and(|found| found == "musl");
    if is_musl || glibc().is_some_and(|found| found >= PACKED_SINCE) {
        println!("cargo:rustc-link-arg-bins=-Wl,-z,pack-relative-relocs");
    }
}

/// Returns the version of the glibc of this machine, if the program is built for this machine.
fn glibc() -> Option<(u32, u32)> {
    if env::var_os("TARGET") != env::var_os("HOST") {
        return None;
    }
    let output = Command::new("getconf").arg("GNU_LIBC_VERSION").output();
    let text = String::from_utf8(output.ok()?.stdout).ok()?;
    let (major, minor) = text.trim().strip_prefix("glibc ")?.split_once('.')?;
    Some((major.parse().ok()?, minor.parse().ok()?))
}
