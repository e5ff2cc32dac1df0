//! Counts the queries that a service rejects, and limits how often they are logged.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing::warn;

/// Maximum number of bytes of a key in the log. Others choose the key.
const KEY_IN_LOG: usize = 200;

/// A shared count of rejected queries. A rejection is logged each time the count has doubled.
#[derive(Clone, Debug, Default)]
pub(crate) struct QueryRefusals(Arc<AtomicU64>);

impl QueryRefusals {
    /// Counts a rejected query.
    pub(crate) fn add(&self, key: &str, why: &str) {
        let times = self.0.fetch_add(1, Ordering::Relaxed) + 1;
        if times.is_power_of_two() {
            let key = &key[..key.floor_char_boundary(KEY_IN_LOG)];
            warn!(key, error = why, times, "query rejected");
        }
    }

    /// Returns the number of rejected queries.
    pub(crate) fn total(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
