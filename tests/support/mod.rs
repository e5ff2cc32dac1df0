//! Shared parts of the end-to-end tests: processes that end with their test, a site with its own
//! root and folder, records, and bit-identical comparison of estimates.

mod archive;
mod building;
mod computers;
mod disk;
mod disk_log;
mod drops;
mod estimates;
mod lab;
pub mod mutation;
pub mod page;
mod preload;
mod process;
mod record;
mod secured;
mod sensors;
mod site;
mod skip;
mod stepped_clock;

pub use archive::write_stored_zip;
pub use building::{HOUSE, distributed_storeys, five_storeys, storeys, two_storeys};
pub use computers::{Computers, packaged_postgresql};
pub use disk::SmallDisk;
pub use disk_log::{Disk, DiskLog, Luck, differences};
pub use drops::Drops;
pub use estimates::{EstimateReader, Estimated, Identified, assert_same_bits, identified};
pub use lab::{Lab, Link};
pub use process::{Finished, Process, spandrel};
pub use record::Record;
pub use secured::Secured;
pub use sensors::{Node, Sensors, put_raw};
pub use site::{Site, free_endpoint};
pub use skip::{axe_or_skip, records_or_skip, skip, zenoh_pico_or_skip};
pub use stepped_clock::SteppedClock;

use std::future::Future;
use std::time::Duration;

/// Limit that only ends a hang. No test result depends on it.
pub const DEADLINE: Duration = Duration::from_secs(180);

/// Waits for an event that must occur. Panics after [`DEADLINE`].
pub async fn within<T>(what: &str, event: impl Future<Output = T>) -> T {
    match tokio::time::timeout(DEADLINE, event).await {
        Ok(value) => value,
        Err(_elapsed) => panic!("waited {} s in vain: {what}", DEADLINE.as_secs()),
    }
}
