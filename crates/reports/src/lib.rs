//! Finds earthquakes in the frames of a structure, and keeps their recordings and reports.
//!
//! Takes frames and alerts from the bus. Cuts the recording of each earthquake from them, and
//! recordings of weak motion at set times afterwards. Keeps them as CSV files, has each of them
//! reported, and replies to queries for the reports. The plan contains what makes a report, so this
//! crate contains no page and no filter.
//!
//! - [`ReportMaker`], [`ReportCourse`], [`MadeReport`]: what makes a report from a recording
//! - `cutting`: from frames to recordings, without clock, network or files
//! - `records`: the folder of the recordings and reports
//! - `desk`: reports the recordings in the order of time
//! - [`ReportsService`], [`ReportsPlan`]: connects them to the bus
//!
//! To report recordings that exist as files, use the program instead.

mod error;
mod maker;
mod name;

mod cutting;
mod records;

mod desk;
mod memory;
mod service;

pub use error::ReportsError;
pub use maker::{MadeReport, ReportCourse, ReportIndex, ReportMaker};
pub use service::{ReportsPlan, ReportsService};
