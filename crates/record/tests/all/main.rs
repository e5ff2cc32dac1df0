//! Tests of the public interface of this crate, in one test program.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod bounds;
mod frame_log;
mod mutated;
#[path = "../../../../tests/support/mutation.rs"]
mod mutation;
mod shake_table;
mod shared_records;
#[path = "../../../../tests/support/skip.rs"]
#[expect(dead_code, reason = "other programs use the rest of it")]
mod skip;
