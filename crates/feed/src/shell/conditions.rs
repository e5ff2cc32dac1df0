//! Publishes the values of conditions.

use std::collections::BTreeMap;
use std::time::Duration;

use spandrel_bus::{Bus, ConditionDisplay, LatestPublisher, Name};
use spandrel_service::Monitored;

use crate::error::FeedError;
use crate::settings::FeedConfig;

/// Number of values after which the feed pauses. They fill half a batch of Zenoh (64 KiB). The
/// network drops display values if its two batches are full, and a file can contain a year of
/// values.
const VALUES_AT_ONCE: u64 = 100;
/// Length of the pause, in which the network sends the values and the history takes them.
const PAUSE: Duration = Duration::from_millis(20);

/// The publishers of all conditions, by source and condition.
#[derive(Debug)]
pub(super) struct Conditions {
    publishers: BTreeMap<(usize, usize), Published>,
    published: u64,
}

/// One condition.
#[derive(Debug)]
struct Published {
    /// The last message. Only time and value change.
    message: ConditionDisplay,
    publisher: LatestPublisher<ConditionDisplay>,
}

impl Conditions {
    /// Declares a publisher for each condition.
    pub(super) async fn declare(
        bus: &Bus,
        structures: &[Monitored],
        config: &FeedConfig,
    ) -> Result<Self, FeedError> {
        let mut publishers = BTreeMap::new();
        for (source, plan) in config.sources.iter().enumerate() {
            for (condition, of) in plan.conditions.iter().enumerate() {
                let Some(monitored) = structures.get(of.structure) else {
                    continue;
                };
                let name = Name::new(&*of.name)?;
                let publisher = bus.publish_latest(monitored.keys.condition(&name)).await?;
                let message = ConditionDisplay {
                    structure: monitored.keys.structure().clone(),
                    name,
                    time_ns: 0,
                    value: 0.0,
                    unit: of.unit.to_owned(),
                    interval_s: of.interval_s,
                    instrument: Some(plan.name.clone()),
                };
                publishers.insert((source, condition), Published { message, publisher });
            }
        }
        Ok(Self {
            publishers,
            published: 0,
        })
    }

    /// Publishes a value of a condition, which is given by its source and its index there.
    pub(super) async fn put(
        &mut self,
        of: (usize, usize),
        time_ns: i64,
        value: f64,
    ) -> Result<(), FeedError> {
        let Some(Published { message, publisher }) = self.publishers.get_mut(&of) else {
            return Ok(());
        };
        (message.time_ns, message.value) = (time_ns, value);
        publisher.put(message).await?;
        self.published += 1;
        if self.published.is_multiple_of(VALUES_AT_ONCE) {
            tokio::time::sleep(PAUSE).await;
        }
        Ok(())
    }
}
