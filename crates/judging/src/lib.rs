//! The service `judge`: judges lasting changes of a structure from its live estimates.
//!
//! Takes the estimates of the parameters and the values of the conditions. Forms epochs of them,
//! saves each epoch in a CSV file, and publishes it. Publishes the state of each quantity with one
//! sentence. Answers queries for the history of a quantity: one row per day.
//!
//! The file is a series that `spandrel judge --series` reads. After a restart, the service reads it
//! with the same reader, so both give the same judgements, bit for bit.
//!
//! Users can send annotations. An annotation with a new reference discards the former reference.
//! Annotations are stored in the same folder as the epochs, and so is each configuration with which
//! the structure was judged. From these files, [`judge_past`] repeats a past judgement. A further
//! file contains the changes of lasting losses as they were stated.
//!
//! - `epochs`: estimates and conditions in, closed epochs out, without clock or network
//! - `ahead`: limits the reports about values ahead of the clock
//! - [`course_row`]: a judgement as a row of the history of the quantity
//! - `judging`: closed epochs in, judgements and events out
//! - `epoch_log`, `annotations`, `configurations`, `loss_log`: the files
//! - `bench`: keeps what arrives, then judges it
//! - [`new_reference`], [`read_annotations`], [`NotedLine`]: the same for a series offline
//! - [`JudgeService`], [`JudgePlanned`]: the service
//!
//! The maths is in `spandrel-judge`. For rules on single estimates, use `spandrel-alert`.

mod ahead;
mod course;
mod epochs;
mod judging;

mod annotations;
mod configurations;
mod epoch_log;
mod loss_log;

mod error;

mod bench;
mod past;
mod service;

#[cfg(test)]
mod testing;

pub use annotations::{NotedLine, read as read_annotations};
pub use configurations::Configuration;
pub use course::{LEAST_LN_EVIDENCE, course_row};
pub use error::{JudgingError, NoPast};
pub use judging::new_reference;
pub use past::{PastJudgement, judge_past};
pub use service::{JudgePlanned, JudgeService};
