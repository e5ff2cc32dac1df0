//! Rebuilds published examples from their description and compares the results with the published
//! figures.
//!
//! A [`Case`] is one example of a source. It simulates the described record from a seed and
//! identifies it with the filters of `spandrel-filter`. It then measures [`Figure`]s, each with its
//! published and required values. A [`Plan`] runs cases for several seeds on several threads,
//! stores finished runs so that a stopped run can resume, and returns a [`Report`].
//!
//! ```
//! use spandrel_validate::{Length, Plan, Quiet, cases};
//!
//! let case = cases().iter().find(|case| case.name == "kalman.vehicle").expect("a case of chapter 2");
//! let report = Plan::new(vec![case], vec![1], Length::Quick).run(&Quiet).expect("nothing is read or written");
//! assert!(report.passed());
//! ```
//!
//! [`seasons`] simulates natural frequencies of a footbridge over years, for documentation and
//! practice.

mod cases;
mod error;
mod figure;
mod fit;
mod judging;
mod kept;
mod modal;
mod network;
mod outcome;
mod plan;
mod report;
pub mod robustness;
mod run;
mod scene;
mod seeds;
mod statistics;
mod systems;
mod tracking;

pub use cases::{Case, cases, select};
pub use error::ValidateError;
pub use figure::{Figure, Judgement, Required};
pub use judging::{SeasonRow, StiffnessLoss, seasons, seasons_csv};
pub use outcome::{Outcome, Plot, Series, SeriesKind, Table};
pub use plan::{Plan, Quiet, Watch};
pub use report::{CaseReport, FigureReport, Program, Report};
pub use run::{JudgeEarthquakes, JudgedStiffness, Length, Records, Run};
pub use seeds::{Seeds, SeedsError};
