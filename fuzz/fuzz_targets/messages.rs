//! Fuzzes the decoders of messages.

#![no_main]

#[path = "../decoders/messages.rs"]
mod messages;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    assert_ne!(messages::decode(bytes), Err(String::new()), "a reason");
});
