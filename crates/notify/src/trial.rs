//! Test notices with made-up values, for `spandrel notify --test`.

use crate::content::Content;
use crate::error::NotifyError;
use crate::samples::samples;
use crate::send::{Receiver, receivers};
use crate::settings::NotifySettings;
use spandrel_service::Clock;
use std::time::Duration;

/// The result of the test notice to one receiver.
#[derive(Debug)]
pub struct Trial {
    /// Address of the receiver, without secrets.
    pub receiver: String,
    /// Time that the delivery took, or the reason for the failure, without secrets.
    pub result: Result<Duration, String>,
}

/// Sends one notice with made-up values to each receiver, regardless of its states, quiet hours and
/// delay. The settings must have been checked. The call blocks for up to 15 s per receiver.
///
/// # Errors
/// Returns an error if a setting is invalid. A failed delivery is part of the result.
pub fn try_receivers(
    settings: &NotifySettings,
    structure: &str,
) -> Result<Vec<Trial>, NotifyError> {
    let clock = Clock::of_machine();
    let mut notices = samples(structure).into_iter();
    let Some(notice) = notices.next() else {
        return Ok(Vec::new()); // the structure file has checked the name
    };
    let link = settings.base_url();
    let mut content = Content {
        // Each test has its own key, so that receivers do not drop it as a duplicate.
        key: format!("{}/{}", notice.key, clock.epoch()),
        ..notice
    };
    content.circumstances.link = link
        .map(|base| format!("{base}/#/structure/{structure}"))
        .unwrap_or_default();
    let attempt = |receiver: Receiver| {
        let start_ns = clock.now_ns();
        let result = receiver.send(&content).map(|()| {
            let taken_ns = clock.now_ns().saturating_sub(start_ns).max(0);
            Duration::from_nanos(taken_ns.unsigned_abs())
        });
        Trial {
            receiver: receiver.shown(),
            result,
        }
    };
    Ok(receivers(settings)?.into_iter().map(attempt).collect())
}
