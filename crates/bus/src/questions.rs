//! Queries to which a service replies itself.

use tracing::debug;
use zenoh::query::{Query, Queryable};

use crate::BoxedFuture;
use crate::error::BusError;
use crate::message::Message;
use crate::refusals::QueryRefusals;
use crate::session::Bus;

/// Queue of the queries on a key expression, in order of arrival. If it is full, a further query is
/// dropped without a reply.
#[derive(Debug)]
pub struct Questions {
    queries: flume::Receiver<Query>,
    refusals: QueryRefusals,
    _queryable: Queryable<()>,
}

/// One query.
#[derive(Debug)]
pub struct Question {
    query: Query,
    refusals: QueryRefusals,
}

impl Bus {
    /// Declares a queryable on a key expression. At most `waiting` queries wait.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key expression or the session is closed.
    pub fn questions<'a>(
        &'a self,
        key_expression: String,
        waiting: usize,
    ) -> BoxedFuture<'a, Result<Questions, BusError>> {
        Box::pin(async move {
            let (sender, queries) = flume::bounded(waiting.max(1));
            let queryable =
                crate::publish::declare_queryable(self.session(), key_expression, sender).await?;
            Ok(Questions {
                queries,
                refusals: QueryRefusals::default(),
                _queryable: queryable,
            })
        })
    }
}

impl Questions {
    /// Waits for the next query. The wait is cancel-safe. Returns `None` if the session is closed.
    pub async fn next(&self) -> Option<Question> {
        let query = self.queries.recv_async().await.ok()?;
        let refusals = self.refusals.clone();
        Some(Question { query, refusals })
    }
}

impl Question {
    /// Returns the queried key expression, which may be a pattern.
    #[must_use]
    pub fn key_expression(&self) -> &str {
        self.query.key_expr().as_str()
    }

    /// Returns the parameters, such as `from=0;points=10`.
    #[must_use]
    pub fn parameters(&self) -> &str {
        self.query.parameters().as_str()
    }

    /// Replies on a concrete key.
    ///
    /// # Errors
    /// Fails if the message is malformed. A disconnected client is not an error.
    pub async fn answer<M: Message>(&self, key: &str, message: &M) -> Result<(), BusError> {
        let payload = message.encode().map_err(|source| BusError::Encode {
            key: key.to_owned(),
            source,
        })?;
        if let Err(error) = self.query.reply(key, payload).encoding(M::encoding()).await {
            debug!(key, %error, "reply not sent");
        }
        Ok(())
    }

    /// Replies to an invalid query with an error, and counts the query. The rate of its log lines
    /// is limited.
    pub async fn reject(&self, why: &str) {
        self.refusals.add(self.key_expression(), why);
        self.refuse(why).await;
    }

    /// Replies with an error and its reason.
    pub async fn refuse(&self, why: &str) {
        if let Err(error) = self.query.reply_err(why).await {
            debug!(%error, "refusal not sent");
        }
    }
}
