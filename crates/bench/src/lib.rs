//! Shared parts of the benchmarks: a building of any height, the filters for comparison, and the
//! lower bound of a step.
//!
//! - [`building`]: the building of the comparison
//! - [`structures`]: larger structures, whose filters must keep up with the sensors
//! - [`dense`]: a textbook filter with dense matrices
//! - [`floor`]: operations and bytes of a step, and the speed of this machine
//! - [`timing`]: times of single steps
//! - [`python`]: the filters in Python for comparison (the peers), from `python/peers.py`
//! - [`table`]: the table and the plot

pub mod building;
pub mod dense;
pub mod floor;
pub mod python;
pub mod structures;
pub mod table;
pub mod timing;
