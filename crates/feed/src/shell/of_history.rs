//! Queries of the feed to the history: the newest value of each condition at the start.

use std::time::Duration;

use spandrel_bus::{HistorySpan, Keys, Name, Service, SpanQuery};
use tokio::time::timeout;
use tracing::{info, warn};

use super::Part;
use crate::core_input::FeedInput;

/// Timeout of a query to the history, and longest wait for the history to appear.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);
/// The history replies in seconds in double precision, which are accurate to 0.2 µs, ns.
const ROUNDING_NS: i64 = 1_000;

/// The newest value of a condition that the history has.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stored {
    pub(super) source: usize,
    pub(super) condition: usize,
    pub(super) newest_ns: i64,
}

impl Stored {
    /// Returns the input of the core.
    pub(super) fn input(&self) -> FeedInput {
        FeedInput::Stored {
            source: self.source,
            condition: self.condition,
            newest_ns: self.newest_ns,
        }
    }
}

impl Part {
    /// Queries the newest value of each condition whose source can repeat its values.
    pub(super) async fn stored(&self) -> Vec<Stored> {
        let mut stored = Vec::new();
        let repeating = self.core.config().sources.iter().enumerate();
        for (source, plan) in repeating.filter(|(_, plan)| plan.kind.can_repeat()) {
            for (condition, of) in plan.conditions.iter().enumerate() {
                let fed = self.structures.iter().find(|fed| fed.index == of.structure);
                let Some((fed, name)) = fed.zip(Name::new(&*of.name).ok()) else {
                    continue;
                };
                if let Some(newest_ns) = self.newest_ns(&fed.keys, &name).await {
                    info!(condition = %name, newest_ns, "feed resumes where the history ends");
                    stored.push(Stored {
                        source,
                        condition,
                        newest_ns,
                    });
                }
            }
        }
        stored
    }

    /// Returns the time of the newest stored value of a condition, ns.
    async fn newest_ns(&self, keys: &Keys, name: &Name) -> Option<i64> {
        let live = keys.all_live(Service::History);
        let mut watch = self.bus.watch_live(live).await.ok()?;
        if watch.present().is_empty() && timeout(ANSWER_TIMEOUT, watch.some()).await.is_err() {
            info!(condition = %name, "no history to resume from");
            return None;
        }
        let query = SpanQuery {
            points: 1,
            kind: "condition".to_owned(),
            ..SpanQuery::default()
        };
        let key = format!("{}?{query}", keys.history(name));
        match self
            .bus
            .ask_present::<HistorySpan>(&key, ANSWER_TIMEOUT)
            .await
        {
            Ok(spans) => spans
                .iter()
                .filter_map(|(_, span)| span.rows.time_s.last())
                .map(|time_s| ((time_s * 1e9) as i64).saturating_add(ROUNDING_NS))
                .max(),
            Err(error) => {
                warn!(condition = %name, %error, "cannot query the history");
                None
            }
        }
    }
}
