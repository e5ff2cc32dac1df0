//! Fuzzes the parser of structure files.

#![no_main]

#[path = "../decoders/structure_file.rs"]
mod structure_file;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    assert_ne!(structure_file::decode(bytes), Err(String::new()), "a reason");
});
