//! Reports in status and events whether the service keeps up with ingest.

use super::IdentifyService;
use crate::error::IdentifyError;
use crate::seat::Seat;
use spandrel_bus::{EventKind, Load};
use std::cmp::Ordering;

impl IdentifyService {
    /// Compares the progress with that of ingest. If the load has changed, publishes it and returns
    /// `true`.
    pub(super) async fn update_load(&mut self) -> Result<bool, IdentifyError> {
        if let Some((_, status)) = self.ingest_statuses.messages().try_iter().last() {
            self.pace = status.pace;
        }
        let (Some(core), Some(made)) = (&self.core, self.made.latest()) else {
            return Ok(false); // this process is paused, or the progress of ingest is unknown
        };
        let behind = match made.header.epoch.cmp(&self.epoch) {
            Ordering::Less => 0, // progress of an earlier epoch
            Ordering::Equal => made.done.saturating_sub(core.done()),
            Ordering::Greater => made.done, // plus the rest of the earlier epoch
        };
        if !self.load.observe(behind, self.pace) {
            return Ok(false);
        }
        self.put_status().await?;
        let (kind, what) = match self.load.load() {
            Load::DisplayShed => (
                EventKind::Overloaded,
                "display values are published at a tenth of their rate",
            ),
            Load::Normal => (
                EventKind::CaughtUp,
                "display values are published at their normal rate",
            ),
            Load::Behind | Load::CatchingUp => return Ok(true),
        };
        if matches!(self.seat, Seat::Leading(_)) {
            self.tell(
                kind,
                what.to_owned(),
                format!("identification is {behind} frames behind ingest"),
            )
            .await?;
        }
        Ok(true)
    }
}
