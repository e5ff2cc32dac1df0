//! Liveliness of services and nodes.

use std::collections::BTreeSet;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use crate::BoxedFuture;
use crate::error::BusError;
use crate::session::Bus;

/// Signals that a service or node is online. The signal ends when this is dropped, its process ends
/// or its link is lost.
#[derive(Debug)]
pub struct LiveToken {
    token: LivelinessToken,
}

impl LiveToken {
    /// Withdraws the token, and returns after the withdrawal was sent.
    ///
    /// # Errors
    /// Fails if the session is already closed.
    pub fn withdraw(self) -> BoxedFuture<'static, Result<(), BusError>> {
        Box::pin(async move {
            let undeclared = self.token.undeclare().await;
            undeclared.map_err(|source| BusError::Close { source })
        })
    }
}

/// The tokens that match a key expression, with their changes.
#[derive(Debug)]
pub struct LiveWatch {
    present: watch::Receiver<Presence>,
    _subscriber: Subscriber<()>,
    doubts: JoinHandle<()>,
}

impl Drop for LiveWatch {
    fn drop(&mut self) {
        self.doubts.abort();
    }
}

/// Timeout of a query for an uncertain token, and pause before its repetition.
const DOUBT: Duration = Duration::from_secs(2);

/// The tokens that are online.
///
/// A new subscription receives the tokens that its session already knows from a separate Zenoh
/// task. Another task reports tokens that disappear meanwhile. Zenoh can therefore report the
/// appearance of a token after its disappearance, and the token would remain online forever.
#[derive(Clone, Debug, Default)]
struct Presence {
    tokens: BTreeSet<String>,
    /// Tokens that disappeared before they were reported to appear.
    gone_before: BTreeSet<String>,
}

impl Presence {
    /// Records that a token has appeared. Returns `true` if this is uncertain.
    fn comes(&mut self, key: &str) -> bool {
        self.tokens.insert(key.to_owned());
        self.gone_before.remove(key)
    }

    fn goes(&mut self, key: &str) {
        if !self.tokens.remove(key) {
            self.gone_before.insert(key.to_owned());
        }
    }

    /// Removes an uncertain token that is offline.
    fn was_gone(&mut self, key: &str) {
        self.tokens.remove(key);
    }
}

/// Queries the uncertain tokens, one at a time, until the network replies whether they are online.
async fn settle_doubts(
    session: Session,
    presence: watch::Sender<Presence>,
    mut doubtful: mpsc::UnboundedReceiver<String>,
) {
    while let Some(key) = doubtful.recv().await {
        loop {
            match is_there(&session, &key).await {
                Some(true) => break,
                Some(false) => {
                    presence.send_modify(|presence| presence.was_gone(&key));
                    break;
                }
                None => tokio::time::sleep(DOUBT).await,
            }
        }
    }
}

/// Returns whether the network knows a token, or `None` if a host did not reply in time.
async fn is_there(session: &Session, key: &str) -> Option<bool> {
    let replies = session.liveliness().get(key).timeout(DOUBT).await.ok()?;
    let mut all_answered = true;
    while let Ok(reply) = replies.recv_async().await {
        match reply.result() {
            Ok(_) => return Some(true),
            Err(_timeout) => all_answered = false,
        }
    }
    all_answered.then_some(false)
}

impl Bus {
    /// Announces a service or node under its `live` key. Call it only when the service is ready.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub fn announce<'a>(&'a self, key: String) -> BoxedFuture<'a, Result<LiveToken, BusError>> {
        Box::pin(async move {
            let declared = self.session().liveliness().declare_token(key.clone()).await;
            match declared {
                Ok(token) => Ok(LiveToken { token }),
                Err(source) => Err(BusError::Declare { key, source }),
            }
        })
    }

    /// Queries the network for the current tokens that match a `live` key expression. Late replies
    /// are ignored.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub fn query_tokens<'a>(
        &'a self,
        key_expression: &'a str,
        timeout: Duration,
    ) -> BoxedFuture<'a, Result<BTreeSet<String>, BusError>> {
        Box::pin(async move {
            let asked = self
                .session()
                .liveliness()
                .get(key_expression)
                .timeout(timeout)
                .await;
            let refused = |source| BusError::Declare {
                key: key_expression.to_owned(),
                source,
            };
            let replies = match asked {
                Ok(replies) => replies,
                Err(source) => return Err(refused(source)),
            };
            let mut present = BTreeSet::new();
            while let Ok(reply) = replies.recv_async().await {
                present.extend(
                    reply
                        .result()
                        .ok()
                        .map(|token| token.key_expr().to_string()),
                );
            }
            Ok(present)
        })
    }

    /// Watches the tokens that match a `live` key expression, including existing tokens.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub fn watch_live<'a>(
        &'a self,
        key_expression: String,
    ) -> BoxedFuture<'a, Result<LiveWatch, BusError>> {
        Box::pin(async move {
            let (changes, present) = watch::channel(Presence::default());
            let (doubt, doubtful) = mpsc::unbounded_channel();
            let told = changes.clone();
            let declared = self
                .session()
                .liveliness()
                .declare_subscriber(key_expression.clone())
                .history(true)
                .callback(move |sample: Sample| {
                    let key = sample.key_expr().as_str();
                    told.send_modify(|presence| match sample.kind() {
                        SampleKind::Put => {
                            if presence.comes(key) {
                                let _ = doubt.send(key.to_owned()); // the watch may have ended
                            }
                        }
                        SampleKind::Delete => presence.goes(key),
                    });
                })
                .await;
            match declared {
                Ok(subscriber) => {
                    let doubts =
                        tokio::spawn(settle_doubts(self.session().clone(), changes, doubtful));
                    Ok(LiveWatch {
                        present,
                        _subscriber: subscriber,
                        doubts,
                    })
                }
                Err(source) => Err(BusError::Declare {
                    key: key_expression,
                    source,
                }),
            }
        })
    }
}

impl LiveWatch {
    /// Returns the keys of the current tokens.
    #[must_use]
    pub fn present(&self) -> BTreeSet<String> {
        self.present.borrow().tokens.clone()
    }

    /// Waits until a token appears or disappears, and returns the current tokens.
    ///
    /// A token that appears and disappears between two calls may be missed.
    pub async fn changed(&mut self) -> BTreeSet<String> {
        let closed = self.present.changed().await.is_err();
        if closed {
            std::future::pending().await // the session is closed, so that nothing changes
        }
        self.present.borrow_and_update().tokens.clone()
    }

    /// Waits until at least one token is online.
    pub async fn some(&mut self) {
        let closed = self
            .present
            .wait_for(|present| !present.tokens.is_empty())
            .await
            .is_err();
        if closed {
            std::future::pending().await
        }
    }

    /// Waits until no token is online.
    pub async fn none(&mut self) {
        // A closed session has no tokens either.
        let _ = self
            .present
            .wait_for(|present| present.tokens.is_empty())
            .await;
    }
}

#[cfg(test)]
mod tests {
    use super::Presence;

    #[test]
    fn token_that_appears_after_its_removal_is_verified_once() {
        let mut presence = Presence::default();
        assert!(!presence.comes("one"));
        presence.goes("one");
        assert!(!presence.comes("one"), "it is back");
        presence.goes("two");
        assert!(presence.comes("two"));
        assert!(
            presence.tokens.contains("two"),
            "until it is known to be gone"
        );
        presence.was_gone("two");
        assert!(presence.tokens.iter().eq(["one"]));
        assert!(!presence.comes("two"), "it is there after all");
    }
}
