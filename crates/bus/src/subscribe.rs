//! Reads display topics: the newest values count.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tracing::warn;
use zenoh::pubsub::Subscriber;
use zenoh::query::ConsolidationMode;
use zenoh::sample::Sample;

use crate::error::BusError;
use crate::keys::{Topic, parse_key};
use crate::message::Message;
use crate::name::Name;
use crate::receive::{Intake, read};
use crate::session::Bus;

/// Answers to one query that are kept: more parameters than any structure has.
const MOST_ANSWERS: usize = 16_384;

/// Before a service that is there, and did not answer, is asked again; each pause is twice the one before.
const FIRST_PAUSE: Duration = Duration::from_millis(250);
/// After this pause it is asked once more and no more.
const LAST_PAUSE: Duration = Duration::from_secs(4);

/// Messages of one kind, with the keys they were put on; when the queue is full, the oldest is overwritten.
#[derive(Debug)]
pub struct Subscription<M> {
    messages: flume::Receiver<(String, M)>,
    refused: Arc<Mutex<BTreeMap<&'static str, u64>>>,
    _subscriber: Subscriber<()>,
}

impl<M: Message + Send + 'static> Subscription<M> {
    /// The messages; safe to drop while waiting.
    #[must_use]
    pub fn messages(&self) -> &flume::Receiver<(String, M)> {
        &self.messages
    }

    /// Takes all that waits and says the place of its key (structure and topic); what says another place is left out. A message
    /// that says none (`None`) is taken.
    pub fn gather(
        &self,
        root: &Name,
        place: impl Fn(&M) -> Option<(&Name, Topic)>,
    ) -> impl Iterator<Item = M> {
        // what comes meanwhile waits: a source at full speed must not keep us here
        self.messages
            .try_iter()
            .take(self.messages.len())
            .filter_map(move |(key, message)| {
                let is_in_place = place(&message).is_none_or(|(structure, topic)| {
                    parse_key(root, &key).is_some_and(|(of_key, topic_of_key)| {
                        (structure, topic) == (&of_key, topic_of_key)
                    })
                });
                is_in_place.then_some(message)
            })
    }

    /// Messages refused, by reason; `overwritten` counts those that a newer one pushed out.
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
    /// Subscribes to messages of one kind; at most `queue` wait.
    ///
    /// # Errors
    /// Zenoh refuses the key expression, or the session is closed.
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
                            warn!(key = %sample.key_expr(), %error, times, "message refused");
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

    /// Asks a service that is there by its liveliness token, and again while nobody answers: the way to those who answer may be known
    /// a moment later than the token, and whoever asks once would never learn what they know.
    ///
    /// # Errors
    /// As [`Bus::ask`].
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

    /// Asks for the last values of topics that answer queries; what is no such message is left out.
    ///
    /// # Errors
    /// Zenoh refuses the key expression, or the session is closed.
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
            let Ok(sample) = reply.result() else { continue }; // the one asked has nothing
            match read(sample) {
                Ok(message) if found.len() < MOST_ANSWERS => {
                    found.push((sample.key_expr().to_string(), message))
                }
                Ok(_) => warn!(
                    key_expression,
                    "more than {MOST_ANSWERS} answers, the others are left out"
                ),
                Err(error) => warn!(key_expression, %error, "answer refused"),
            }
        }
        Ok(found)
    }
}
