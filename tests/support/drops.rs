//! Published counts of data that the services have dropped.

use super::{DEADLINE, within};
use spandrel_bus::{Bus, Keys, Service, Status, Subscription};
use std::collections::BTreeMap;

/// Status messages of a structure.
pub struct Drops {
    statuses: Subscription<Status>,
}

impl Drops {
    pub async fn watch(bus: &Bus, keys: &Keys) -> Self {
        Self {
            statuses: bus.subscribe(keys.all_statuses(), 256).await.unwrap(),
        }
    }

    /// Waits until a service has counted at least `least` under `reason`, and returns all its
    /// counts.
    pub async fn expect(
        &self,
        service: Service,
        reason: &str,
        least: u64,
    ) -> BTreeMap<String, u64> {
        let mut last = BTreeMap::new();
        let counted = async {
            loop {
                let (_, status) = self.statuses.messages().recv_async().await.unwrap();
                if status.service.as_str() == service.as_str() {
                    last = status.drops;
                    if last.get(reason).copied().unwrap_or(0) >= least {
                        break;
                    }
                }
            }
        };
        if tokio::time::timeout(DEADLINE, counted).await.is_err() {
            panic!(
                "status of {}\n  expected {reason} from {least} on\n  found    {last:?}",
                service.as_str()
            );
        }
        last
    }

    /// Waits for a status of a service that has processed `done` frames.
    pub async fn when_done(&self, service: Service, done: u64) -> Status {
        let what = format!("status of {} with {done} frames done", service.as_str());
        within(&what, async {
            loop {
                let (_, status) = self.statuses.messages().recv_async().await.unwrap();
                if status.service.as_str() == service.as_str() && status.done >= done {
                    return status;
                }
            }
        })
        .await
    }
}
