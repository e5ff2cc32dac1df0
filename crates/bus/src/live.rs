//! Liveliness: who is there.

use std::collections::BTreeSet;
use std::time::Duration;

use tokio::sync::watch;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use crate::BoxedFuture;
use crate::error::BusError;
use crate::session::Bus;

/// Says that a service or node is there, until this is dropped, its process ends or its link is lost.
#[derive(Debug)]
pub struct LiveToken {
    token: LivelinessToken,
}

impl LiveToken {
    /// Takes the token back, and returns once that is on its way.
    ///
    /// # Errors
    /// The session is closed already.
    pub fn withdraw(self) -> BoxedFuture<'static, Result<(), BusError>> {
        Box::pin(async move {
            let undeclared = self.token.undeclare().await;
            undeclared.map_err(|source| BusError::Close { source })
        })
    }
}

/// The tokens that match a key expression, as they come and go.
#[derive(Debug)]
pub struct LiveWatch {
    present: watch::Receiver<BTreeSet<String>>,
    _subscriber: Subscriber<()>,
}

impl Bus {
    /// Announces a service or node under its `live` key; to be done when it is ready, and not before.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
    pub fn announce<'a>(&'a self, key: String) -> BoxedFuture<'a, Result<LiveToken, BusError>> {
        Box::pin(async move {
            let declared = self.session().liveliness().declare_token(key.clone()).await;
            match declared {
                Ok(token) => Ok(LiveToken { token }),
                Err(source) => Err(BusError::Declare { key, source }),
            }
        })
    }

    /// Asks the network which tokens match a `live` key expression now; what does not answer in time is left out.
    ///
    /// # Errors
    /// Zenoh refuses the key expression, or the session is closed.
    pub fn ask_who_is_there<'a>(
        &'a self,
        key_expression: &'a str,
        timeout: Duration,
    ) -> BoxedFuture<'a, Result<BTreeSet<String>, BusError>> {
        Box::pin(async move {
            let asked = self.session().liveliness().get(key_expression).timeout(timeout).await;
            let refused = |source| BusError::Declare { key: key_expression.to_owned(), source };
            let replies = match asked {
                Ok(replies) => replies,
                Err(source) => return Err(refused(source)),
            };
            let mut present = BTreeSet::new();
            while let Ok(reply) = replies.recv_async().await {
                present.extend(reply.result().ok().map(|token| token.key_expr().to_string()));
            }
            Ok(present)
        })
    }

    /// Watches the tokens that match a `live` key expression, those already there included.
    ///
    /// # Errors
    /// Zenoh refuses the key expression, or the session is closed.
    pub fn watch_live<'a>(&'a self, key_expression: String) -> BoxedFuture<'a, Result<LiveWatch, BusError>> {
        Box::pin(async move {
            let (changes, present) = watch::channel(BTreeSet::new());
            let declared = self
                .session()
                .liveliness()
                .declare_subscriber(key_expression.clone())
                .history(true)
                .callback(move |sample: Sample| {
                    let key = sample.key_expr().to_string();
                    changes.send_modify(|present| {
                        match sample.kind() {
                            SampleKind::Put => present.insert(key),
                            SampleKind::Delete => present.remove(&key),
                        };
                    });
                })
                .await;
            match declared {
                Ok(subscriber) => Ok(LiveWatch { present, _subscriber: subscriber }),
                Err(source) => Err(BusError::Declare { key: key_expression, source }),
            }
        })
    }
}

impl LiveWatch {
    /// The keys of the tokens that are there now.
    #[must_use]
    pub fn present(&self) -> BTreeSet<String> {
        self.present.borrow().clone()
    }

    /// Waits until a token comes or goes, then returns those that are there.
    ///
    /// A token that comes and goes between two calls may not be seen.
    pub async fn changed(&mut self) -> BTreeSet<String> {
        let closed = self.present.changed().await.is_err();
        if closed {
            std::future::pending().await // nothing changes any more
        }
        self.present.borrow_and_update().clone()
    }

    /// Waits until at least one token is there.
    pub async fn some(&mut self) {
        let closed = self.present.wait_for(|present| !present.is_empty()).await.is_err();
        if closed {
            std::future::pending().await
        }
    }

    /// Waits until no token is there.
    pub async fn none(&mut self) {
        // A closed session has no tokens either.
        let _ = self.present.wait_for(BTreeSet::is_empty).await;
    }
}
