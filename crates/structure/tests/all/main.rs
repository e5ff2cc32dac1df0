//! Tests of the public interface of this crate, in one test program.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod allocation;
mod by_operator;
mod exact_reference;
mod examples;
mod identification;
mod published_nodes;
mod step_routes;
mod structures;
