//! Subscriptions to display topics, whose newest values matter.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tracing::warn;
use zenoh::pubsub::Subscriber;
use zenoh::query::ConsolidationMode;
use zenoh::sample::Sample;

use crate::error::BusError;
use crate::message::Message;
use crate::receive::{Intake, read};
use crate::session::Bus;

/// Maximum number of replies to one query, above the number of parameters of any structure.
const MOST_ANSWERS: usize = 16_384;

/// Pause before the first repetition of a query to a service that is online but did not reply. Each
/// pause is twice the previous one.
const FIRST_PAUSE: Duration = Duration::from_millis(250);
/// Last pause. After it, the query is repeated one last time.
const LAST_PAUSE: Duration = Duration::from_secs(4);

/// Messages of one kind, with their keys. A new message replaces the oldest if the queue is full.
#[derive(Debug)]
pub struct Subscription<M> {
    messages: flume::Receiver<(String, M)>,
    refused: Arc<Mutex<BTreeMap<&'static str, u64>>>,
    _subscriber: Subscriber<()>,
}

impl<M: Message + Send + 'static> Subscription<M> {
    /// Returns the queue of messages. A wait for the next message is cancel-safe.
    #[must_use]
    pub fn messages(&self) -> &flume::Receiver<(String, M)> {
        &self.messages
    }

    /// Returns the number of rejected messages, by reason. `overwritten` counts messages that a
    /// newer message replaced.
    #[must_use]
    pub fn refused(&self) -> BTreeMap<&'static str, u64> {
        let refused = self.refused.lock().unwrap_or_else(PoisonError::into_inner);
        refused.clone()
    }
}

fn count(refused: &Mutex<BTreeMap<&'static str, u64>>, reason: &'static str) -> u64 {
    let mut refused = refused.lock().unwrap_or_else(PoisonError::into_inner);
    let count = refused.entry(reason).or_default();
    *count += 1;
    *count
}

impl Bus {
    /// Subscribes to messages of one kind. At most `queue` messages wait.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub async fn subscribe<M: Message + Send + 'static>(
        &self,
        key_expression: String,
        queue: usize,
    ) -> Result<Subscription<M>, BusError> {
        let (sender, messages) = flume::bounded(queue.max(1));
        let refused = Arc::new(Mutex::new(BTreeMap::new()));
        let (oldest, refusals) = (messages.clone(), refused.clone());
        let intake = Mutex::new(Intake::new());
        let declared = self.session().declare_subscriber(key_expression.clone());
        let subscriber = declared
            .callback(move |sample: Sample| {
                if let Err(flooded) = intake
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .take(&sample)
                {
                    let times = count(&refusals, flooded.reason());
                    if times.is_power_of_two() {
                        warn!(reason = flooded.reason(), times, "message dropped unread");
                    }
                    return;
                }
                match read(&sample) {
                    Ok(message) => {
                        let mut unsent = Some((sample.key_expr().to_string(), message));
                        while let Some(message) = unsent.take() {
                            if let Err(flume::TrySendError::Full(message)) =
                                sender.try_send(message)
                            {
                                unsent = Some(message);
                                if oldest.try_recv().is_ok() {
                                    count(&refusals, "overwritten");
                                }
                            }
                        }
                    }
                    Err(error) => {
                        let times = count(&refusals, error.reason());
                        if times.is_power_of_two() {
                            let (key, error) = (sample.key_expr(), error.with_cause());
                            warn!(%key, error, times, "message rejected");
                        }
                    }
                }
            })
            .await
            .map_err(|source| BusError::Declare {
                key: key_expression,
                source,
            })?;
        Ok(Subscription {
            messages,
            refused,
            _subscriber: subscriber,
        })
    }

    /// Queries a service that is online according to its liveliness token, and retries while there
    /// is no reply.
    ///
    /// The route to the service may become known shortly after its token. A single query could
    /// therefore miss it.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub async fn ask_present<M: Message>(
        &self,
        key_expression: &str,
        timeout: Duration,
    ) -> Result<Vec<(String, M)>, BusError> {
        let mut pause = FIRST_PAUSE;
        loop {
            let found = self.ask(key_expression, timeout).await?;
            if !found.is_empty() || pause > LAST_PAUSE {
                return Ok(found);
            }
            tokio::time::sleep(pause).await;
            pause *= 2;
        }
    }

    /// Queries the latest values of topics. Invalid replies are dropped.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub async fn ask<M: Message>(
        &self,
        key_expression: &str,
        timeout: Duration,
    ) -> Result<Vec<(String, M)>, BusError> {
        let replies = self
            .session()
            .get(key_expression)
            .consolidation(ConsolidationMode::None)
            .timeout(timeout)
            .await
            .map_err(|source| BusError::Put {
                key: key_expression.to_owned(),
                source,
            })?;
        let mut found = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            let Ok(sample) = reply.result() else { continue }; // the service has no value
            match read(sample) {
                Ok(message) if found.len() < MOST_ANSWERS => {
                    found.push((sample.key_expr().to_string(), message))
                }
                Ok(_) => warn!(
                    key_expression,
                    "more than {MOST_ANSWERS} replies; the rest are ignored"
                ),
                Err(error) => {
                    warn!(key_expression, error = error.with_cause(), "reply rejected");
                }
            }
        }
        Ok(found)
    }
}
