//! Fuzzes the reader of checkpoints.

#![no_main]

#[path = "../decoders/checkpoint.rs"]
mod checkpoint;
#[path = "../decoders/folder.rs"]
mod folder;

use std::sync::LazyLock;

static DECODER: LazyLock<checkpoint::Decoder> = LazyLock::new(|| {
    // The hook of the fuzzer would end it at a panic that is caught. A panic that nobody catches
    // still ends the fuzzer.
    std::panic::set_hook(Box::new(|_| {}));
    checkpoint::Decoder::new(&folder::folder())
});

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    assert_ne!(DECODER.decode(bytes), Err(String::new()), "a reason");
});
