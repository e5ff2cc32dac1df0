//! `spandrel modes`: from a recording to its natural frequencies, damping ratios and shapes.
//!
//! - [`frames`]: the channels of a recording as frames of equal times
//! - [`analysis`]: chooses epochs and bands, and identifies the modes
//! - [`declaration`]: the tables of a structure file that declare the modes
//! - [`stiffness`]: the stiffnesses that the declared modes update
//! - [`table`]: the results as text, JSON and CSV
//! - [`diagrams`]: the stabilisation diagram and the singular-value spectrum as SVG
//! - [`uff`]: shapes and spectral densities as a universal file

pub mod analysis;
pub mod declaration;
pub mod diagrams;
pub mod frames;
pub mod stiffness;
pub mod table;
pub mod uff;
