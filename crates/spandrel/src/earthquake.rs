//! `spandrel earthquake` and the service `reports`: from recordings of earthquakes to a report of
//! each event.
//!
//! - [`event_record`]: a recording with the figures of its channels
//! - [`identified`]: its stiffnesses, frame by frame, and the displacements of the model
//! - [`whole`]: the motion from which the stiffness of the whole structure follows
//! - [`storeys`]: displacements and drifts that the model can state
//! - [`course`]: the events of a structure in the order of time
//! - [`live`]: the same reports for the service `reports`
//! - [`report`]: the judgement of an event in numbers (JSON)
//! - [`wording`]: the same in sentences
//! - [`charts`]: the diagrams of a report as SVG
//! - [`judgement_table`]: what is judged, as a table
//! - [`page`]: the report of an event as HTML
//! - [`index`]: the ranked list of all reports in a folder

pub mod charts;
pub mod course;
pub mod event_record;
pub mod identified;
pub mod index;
pub mod judgement_table;
pub mod live;
pub mod page;
pub mod report;
pub mod storeys;
pub mod whole;
pub mod wording;
