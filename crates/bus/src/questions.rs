//! Queries that a service answers itself.

use tracing::debug;
use zenoh::key_expr::KeyExpr;
use zenoh::query::{Query, Queryable};

use crate::BoxedFuture;
use crate::error::BusError;
use crate::message::Message;
use crate::session::Bus;

/// Queries on a key expression, in the order in which they came; one more than wait is dropped, and its asker hears nothing.
#[derive(Debug)]
pub struct Questions {
    queries: flume::Receiver<Query>,
    _queryable: Queryable<()>,
}

/// One query.
#[derive(Debug)]
pub struct Question {
    query: Query,
}

impl Bus {
    /// Takes queries on a key expression; at most `waiting` wait.
    ///
    /// # Errors
    /// Zenoh refuses the key expression, or the session is closed.
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
                _queryable: queryable,
            })
        })
    }
}

impl Questions {
    /// Waits for the next query; safe to drop while waiting. None once the session is closed.
    pub async fn next(&self) -> Option<Question> {
        let query = self.queries.recv_async().await.ok()?;
        Some(Question { query })
    }
}

impl Question {
    /// The key expression asked for, which may be a pattern.
    #[must_use]
    pub fn key_expression(&self) -> &str {
        self.query.key_expr().as_str()
    }

    /// The parameters, such as `from=0;points=10`.
    #[must_use]
    pub fn parameters(&self) -> &str {
        self.query.parameters().as_str()
    }

    /// Whether a key is asked for.
    #[must_use]
    pub fn is_for(&self, key: &str) -> bool {
        KeyExpr::new(key).is_ok_and(|key| self.query.key_expr().intersects(&key))
    }

    /// Answers on a concrete key.
    ///
    /// # Errors
    /// The message is malformed. That the asker has gone is none.
    pub async fn answer<M: Message>(&self, key: &str, message: &M) -> Result<(), BusError> {
        let payload = message.encode().map_err(|source| BusError::Encode {
            key: key.to_owned(),
            source,
        })?;
        if let Err(error) = self.query.reply(key, payload).encoding(M::encoding()).await {
            debug!(key, %error, "answer not sent");
        }
        Ok(())
    }

    /// Answers that it cannot be answered, and why.
    pub async fn refuse(&self, why: &str) {
        if let Err(error) = self.query.reply_err(why).await {
            debug!(%error, "refusal not sent");
        }
    }
}
