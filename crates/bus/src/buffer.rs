//! Queries to the source of a lossless stream for missing items.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tracing::debug;
use zenoh::matching::MatchingStatus;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Querier};
use zenoh::sample::Sample;

use crate::error::BusError;
use crate::follow::Silence;
use crate::message::{Block, CaughtUp, DecodeError, Message};
use crate::range::QueryRange;
use crate::receive::read;
use crate::ring::Answer;
use crate::session::Bus;

/// Number of replies to one query that are read; there should be one.
const REPLIES: usize = 4;

/// Result of a query.
#[derive(Debug)]
pub(crate) enum Fetched<B> {
    /// A valid reply.
    Answer(Answer<B>),
    /// An invalid reply.
    Unreadable(DecodeError),
    /// No reply.
    Nothing(Silence),
}

/// The buffer of one stream, from the perspective of its reader.
#[derive(Debug)]
pub(crate) struct Buffer {
    querier: Querier<'static>,
    /// Whether a source for this key has ever been available. A source that has disappeared may
    /// only have lost its link.
    seen: Arc<AtomicBool>,
}

impl Bus {
    /// Declares a querier for missing items on `key`, with a reply timeout.
    pub(crate) async fn buffer(&self, key: String, timeout: Duration) -> Result<Buffer, BusError> {
        let declared = self
            .session()
            .declare_querier(key.clone())
            .consolidation(ConsolidationMode::None)
            .timeout(timeout)
            // The reply inherits both: it overtakes the live blocks, and never delays the source.
            .priority(Priority::DataHigh)
            .congestion_control(CongestionControl::Drop)
            .await;
        let refused = |source| BusError::Declare { key, source };
        let querier = match declared {
            Ok(querier) => querier,
            Err(source) => return Err(refused(source)),
        };
        let seen = Arc::new(AtomicBool::new(false));
        let sees = seen.clone();
        let note = move |status: MatchingStatus| {
            sees.fetch_or(status.matching(), Ordering::Relaxed);
        };
        match querier
            .matching_listener()
            .callback(note)
            .background()
            .await
        {
            Ok(()) => Ok(Buffer { querier, seen }),
            Err(source) => Err(refused(source)),
        }
    }
}

impl Buffer {
    /// Queries a range of items and waits for the reply.
    ///
    /// A query that ends without a reply does not prove that there is no source. A source with too
    /// many waiting queries drops them, and the network drops replies.
    pub(crate) async fn ask<B: Block>(&self, range: QueryRange) -> Fetched<B> {
        let (replies, received) = flume::bounded(REPLIES);
        let range = range.to_string();
        let asked = self
            .querier
            .get()
            .parameters(range.as_str())
            .callback(move |reply| drop(replies.try_send(reply)))
            .await;
        let key = self.querier.key_expr().as_str();
        if let Err(error) = asked {
            debug!(key, range, %error, "query not sent");
            return Fetched::Nothing(self.silence());
        }
        while let Ok(reply) = received.recv_async().await {
            match reply.result() {
                Ok(sample) => {
                    return match read_answer(sample) {
                        Ok(answer) => Fetched::Answer(answer),
                        Err(error) => Fetched::Unreadable(error),
                    };
                }
                Err(error) => {
                    let text = error.payload().try_to_string();
                    debug!(key, range, error = ?text, "query rejected");
                }
            }
        }
        Fetched::Nothing(self.silence())
    }

    fn silence(&self) -> Silence {
        match self.seen.load(Ordering::Relaxed) {
            true => Silence::NoAnswer,
            false => Silence::NoBuffer,
        }
    }
}

/// Reads a reply to a query for items.
pub(crate) fn read_answer<B: Block>(sample: &Sample) -> Result<Answer<B>, DecodeError> {
    // A reply without a type is a block.
    let encoding = sample.encoding().to_string();
    let encodings = CaughtUp::ACCEPTED.iter().copied();
    match encodings
        .map(CaughtUp::encoding_as)
        .any(|of| of == encoding)
    {
        true => read(sample).map(Answer::CaughtUp),
        false => read(sample).map(Answer::Block),
    }
}
