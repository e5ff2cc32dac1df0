//! A fault that lasts from one window to the next.

use crate::channel::Fault;
use serde::{Deserialize, Serialize};

/// What one window shows of one kind of fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Evidence {
    Fault(Fault),
    Sound,
    /// The window supports neither.
    Open,
}

/// The state of one kind of fault of one channel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Finding {
    fault: Option<Fault>,
    /// Successive windows that support a change.
    support: u32,
}

impl Finding {
    /// Takes the evidence of one window. The fault begins after `begins` windows in a row that
    /// show it, and ends after `ends` windows in a row that do not.
    pub(crate) fn take(&mut self, evidence: Evidence, begins: u32, ends: u32) {
        let (supports_change, needed) = match (self.fault, evidence) {
            (None, Evidence::Fault(_)) => (true, begins),
            (Some(_), Evidence::Sound) => (true, ends),
            (None | Some(_), _) => (false, 0),
        };
        self.support = if supports_change { self.support + 1 } else { 0 };
        let changes = supports_change && self.support >= needed;
        if changes {
            self.support = 0;
        }
        self.fault = match evidence {
            Evidence::Fault(fault) if changes || self.fault.is_some() => Some(fault),
            _ if changes => None,
            _ => self.fault,
        };
    }

    pub(crate) fn fault(&self) -> Option<Fault> {
        self.fault
    }
}
