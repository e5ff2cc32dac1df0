//! Tests of the public interface of this crate, in one test program.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod amplitude;
mod frost;
mod inertia;
mod lasting;
mod state;
mod support;
mod thermometers;
