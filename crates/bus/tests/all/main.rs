//! Tests of the public interface of this crate, in one test program.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod bus;
#[path = "../../../../fuzz/decoders/messages.rs"]
#[expect(
    dead_code,
    reason = "only the fuzzer selects the type by the first byte"
)]
mod decoders;
mod mutated;
mod samples_json;
