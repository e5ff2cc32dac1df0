//! Detects lasting changes of a structure with a stated rate of false alarms.
//!
//! The inputs are epochs: values of natural frequencies or stiffnesses, with temperatures and other
//! conditions. The outputs are one judgement per quantity and day. During the commissioning, the
//! crate learns how each quantity depends on the conditions. Afterwards it decides once a day
//! whether a lasting change explains the values better than the conditions do.
//!
//! ```
//! use spandrel_judge::{Condition, ConditionKind, Epoch, Judge, Quantity, QuantityKind, Season, Settings, State};
//!
//! let settings = Settings {
//!     false_alarms_per_year: 0.1,
//!     loss: 0.02,
//!     commissioning_days: 100,
//!     season: Season::Required,
//!     quantities: vec![Quantity {
//!         name: "f1".to_owned(),
//!         kind: QuantityKind::Frequency,
//!         thermometers: Vec::new(),
//!     }],
//!     conditions: vec![Condition { name: "deck".to_owned(), kind: ConditionKind::Celsius }],
//! };
//! let mut judge = Judge::new(settings)?;
//! let mut judgements = Vec::new();
//! for hour in 0..24 {
//!     let deck = 10.0 + f64::from(hour) / 10.0;
//!     let epoch = Epoch {
//!         time_s: 3600.0 * f64::from(hour),
//!         quantities: vec![Some(4.0 - 0.005 * deck)],
//!         conditions: vec![Some(deck)],
//!     };
//!     judge.handle(&epoch, &mut judgements)?;
//! }
//! judge.finish(&mut judgements);
//! assert_eq!(judgements[0].state, State::Learning { days_left: 99 });
//! # Ok::<(), spandrel_judge::JudgeError>(())
//! ```
//!
//! Types:
//!
//! - [`Settings`], [`Quantity`], [`Condition`]: what is judged, under which conditions
//! - [`Epoch`], [`Judgement`], [`State`], [`Finding`]: what goes in and comes out
//! - [`QuantityReport`]: what a reference promises and can find
//! - [`Budget`], [`Spent`]: judged days and alarms against the promised false alarms
//!
//! Maths:
//!
//! - `day`, `frost`, `amplitude`, `extremes`, `model`: the mean of a day and its regressors
//! - `regression`, `choice`: a dynamic linear model with priors in physical units
//! - `spread`: the present scatter
//! - `cumulant`, `detector`, `cusum`: the evidence of a lasting step
//! - `calibration`: the threshold that holds the budget
//! - `interval`: the width of the 95 % interval, which follows the judged days
//!
//! Logic:
//!
//! - `reference`: what the commissioning has taught, or what is missing
//! - `course`: the history of one quantity, day by day
//! - `thermometers`: the histories of a quantity that other quantities explain
//! - [`Judge`]: the state machine of a structure, without clock, log or I/O
//!
//! # Notation
//!
//! - y: mean of ln(value) over a day, with the regressors x
//! - σ: scale of the error of a day
//! - u: deviation with a memory
//! - z: residual in units of its standard deviation, predicted from the days before it
//! - R: evidence of a lasting step
//!
//! For rules on single estimates, within seconds, use `spandrel-alert`.

mod epoch;
mod error;
mod judgement;
mod settings;

mod amplitude;
mod climate;
mod day;
mod extremes;
mod frost;
mod inertia;
mod model;
mod present;

mod choice;
mod regression;
mod spread;

mod calibration;
mod cumulant;
mod cusum;
mod detector;
mod interval;

mod budget;
mod condition_watch;
mod course;
mod judge;
mod quantity_watch;
mod reference;
mod report;
mod thermometers;

pub use budget::{Budget, Spent};
pub use calibration::{Delay, Performance};
pub use epoch::Epoch;
pub use error::JudgeError;
pub use judge::{Judge, NewReference};
pub use judgement::{
    Absence, Change, DayMeans, Expectation, Finding, Further, Judgement, Novelty, State, date,
};
pub use reference::Missing;
pub use report::{QuantityReport, ReferenceReport, season_warning};
pub use settings::{
    Condition, ConditionKind, Implausible, PLAUSIBLE_CELSIUS, Quantity, QuantityKind, Season,
    Settings, ThermometerMistake,
};
