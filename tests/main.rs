//! Tests of the built program and of its services, in one test program.
//!
//! `cargo test --workspace --test program crash::` runs the tests of one file.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod support;

mod access;
mod alerts;
mod bad_input;
mod browser;
mod c_client;
mod check;
mod classes;
mod clocks;
mod conditions;
mod container;
mod corpus;
mod crash;
mod damage;
mod deploy;
mod distributed;
mod docs;
mod earthquake;
mod estimate;
mod faults;
mod feed;
mod history;
mod independent;
mod instruments;
mod judge;
mod judging;
mod memory;
mod modal_live;
mod modes;
mod monitoring;
mod mqtt;
mod mutated;
mod neighbours;
mod network;
mod node;
mod node_crash;
mod notify;
mod open;
mod outliers;
mod overload;
mod package;
mod pages;
mod power;
mod prometheus;
mod python;
mod recordings;
mod refused;
mod reports;
mod restarts;
mod seedlink;
mod shake_table;
mod soak;
mod stall;
mod standby;
mod state_folder;
mod streaming;
mod traffic;
mod upgrade;
mod validate;
mod watch;
mod wrong_clock;
