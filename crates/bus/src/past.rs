//! Single queries for past items of a lossless stream, for readers that do not follow it.

use std::time::Duration;

use tracing::warn;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::ConsolidationMode;

use crate::BoxedFuture;
use crate::buffer::read_answer;
use crate::error::BusError;
use crate::message::Block;
use crate::range::QueryRange;
use crate::ring::Answer;
use crate::session::Bus;

impl Bus {
    /// Queries past items of a lossless stream on `key`, which is the key of its buffer or
    /// recording.
    ///
    /// Live blocks overtake the reply, and a busy link may drop it. Returns `None` without a valid
    /// reply within `timeout`.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub fn ask_past<'a, B: Block>(
        &'a self,
        key: &'a str,
        range: QueryRange,
        timeout: Duration,
    ) -> BoxedFuture<'a, Result<Option<Answer<B>>, BusError>> {
        Box::pin(async move {
            let replies = self
                .session()
                .get(format!("{key}?{range}"))
                .consolidation(ConsolidationMode::None)
                .priority(Priority::DataLow)
                .congestion_control(CongestionControl::Drop)
                .timeout(timeout)
                .await
                .map_err(|source| BusError::Put {
                    key: key.to_owned(),
                    source,
                })?;
            while let Ok(reply) = replies.recv_async().await {
                let Ok(sample) = reply.result() else { continue }; // the query was rejected
                match read_answer(sample) {
                    Ok(answer) => return Ok(Some(answer)),
                    Err(error) => warn!(key, error = error.with_cause(), "reply rejected"),
                }
            }
            Ok(None)
        })
    }
}
