//! What the benchmarks share: a building of any height, the filters it is compared with, and what a step costs at least.
//!
//! - [`building`]: the building that all filters follow
//! - [`structures`]: larger ones, which have to keep up with their sensors
//! - [`dense`]: the textbook route in dense matrices
//! - [`floor`]: operations and bytes of a step, and how fast this machine does them
//! - [`timing`]: times of single steps
//! - [`python`]: the peers in Python, of `python/peers.py`
//! - [`table`]: the table and the plot

pub mod building;
pub mod dense;
pub mod floor;
pub mod python;
pub mod structures;
pub mod table;
pub mod timing;
