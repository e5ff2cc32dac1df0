//! Tests of the public interface of this crate, in one test program.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod inertia;
mod injected;
mod lasting;
#[path = "../../../../tests/support/skip.rs"]
#[expect(dead_code, reason = "other programs use the rest of it")]
mod skip;
mod state;
mod support;
