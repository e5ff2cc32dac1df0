//! The state in version 4 of the checkpoint of alert, which knew no strong motion.

use std::collections::VecDeque;

use serde::Deserialize;
use spandrel_checkpoint::Position;

use super::Basis;
use crate::Alert;
use crate::decision::version_4::Decision;

/// The version that these types read.
pub(super) const VERSION: u16 = 4;

/// [`super::AlertState`] of version 4.
#[derive(Debug, Deserialize)]
pub(super) struct AlertState {
    basis: Basis,
    watch: Watch,
    unsent: Vec<Alert>,
    log: VecDeque<Alert>,
    last_time_ns: Option<i64>,
}

impl From<AlertState> for super::AlertState {
    fn from(former: AlertState) -> Self {
        Self {
            basis: former.basis,
            watch: former.watch.into(),
            unsent: former.unsent,
            log: former.log,
            last_time_ns: former.last_time_ns,
        }
    }
}

/// [`crate::Watch`] of version 4.
#[derive(Debug, Deserialize)]
struct Watch {
    parameter_count: usize,
    decisions: Vec<Decision>,
    expected: Option<Position>,
}

impl From<Watch> for crate::Watch {
    fn from(former: Watch) -> Self {
        let decisions = former.decisions.into_iter().map(Into::into).collect();
        let mut watch = Self::from_decisions(former.parameter_count, decisions);
        watch.expected = former.expected;
        watch
    }
}
