//! Publication of numbered blocks, which can be queried again, and of display values.

use std::marker::PhantomData;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use tokio::task::JoinSet;
use tracing::{debug, warn};
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::key_expr::KeyExpr;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};

use crate::archive::{Archive, Lookup};
use crate::error::BusError;
use crate::message::{Block, CaughtUp, Message, StreamState};
use crate::range::QueryRange;
use crate::refusals::QueryRefusals;
use crate::ring::{Answer, Keep, Ring};
use crate::session::Bus;

/// Maximum number of waiting queries. A further query is dropped, and its client repeats it.
const QUERIES_WAITING: usize = 64;

/// Keys, position and buffer limits of a lossless stream.
#[derive(Clone, Debug)]
pub struct NumberedStream {
    /// Key of the blocks.
    pub key: String,
    /// Key of the queries for them.
    pub buffer_key: String,
    /// Source id, as in the headers.
    pub source: String,
    /// Epoch of the first block.
    pub epoch: u64,
    /// Number of the first item of this epoch. It is not 0 if the source resumes the stream of an
    /// earlier run.
    pub first: u64,
    /// Whether the earlier run ended the epoch.
    pub state: StreamState,
    /// Limits of the items in memory.
    pub keep: Keep,
}

/// Access to older items of a stream.
pub struct Older<B> {
    /// Storage of the older items.
    pub archive: Arc<dyn Archive<B>>,
    /// Number of latest items of the current epoch for a client that has none yet.
    pub recent: u64,
}

/// Publishes the blocks of a lossless stream, and stores the latest for readers that miss them.
///
/// Publishing never waits. Readers fetch the blocks that the network drops from the ring.
#[derive(Debug)]
pub struct NumberedPublisher<B> {
    publisher: Publisher<'static>,
    ring: Arc<Mutex<Ring<B>>>,
    answering: Answering,
}

/// Replies to queries until it is dropped.
#[derive(Debug)]
struct Answering {
    refusals: QueryRefusals,
    _queryable: Queryable<()>,
    _tasks: JoinSet<()>,
}

/// A standby for a lossless stream of another source. It stores the blocks until it becomes the
/// leader.
#[derive(Debug)]
pub struct NumberedStandby<B> {
    publisher: Publisher<'static>,
    buffer_key: String,
    ring: Ring<B>,
}

impl Bus {
    /// Declares a lossless stream.
    ///
    /// # Errors
    /// Fails if Zenoh rejects a key or the session is closed.
    pub async fn publish_numbered<B: Block>(
        &self,
        stream: NumberedStream,
    ) -> Result<NumberedPublisher<B>, BusError> {
        self.publish_archived(stream, None).await
    }

    /// Declares a lossless stream with older items from an archive.
    ///
    /// # Errors
    /// Fails if Zenoh rejects a key or the session is closed.
    pub async fn publish_archived<B: Block>(
        &self,
        stream: NumberedStream,
        older: Option<Older<B>>,
    ) -> Result<NumberedPublisher<B>, BusError> {
        let NumberedStream {
            key,
            buffer_key,
            source,
            epoch,
            first,
            state,
            keep,
        } = stream;
        let ring = Arc::new(Mutex::new(
            Ring::new(source, epoch, keep).going_on(first, state),
        ));
        let answering = self.answer(buffer_key, ring.clone(), older).await?;
        let publisher = declare_publisher::<B>(self.session(), key).await?;
        Ok(NumberedPublisher {
            publisher,
            ring,
            answering,
        })
    }

    /// Declares a standby for a lossless stream that another source publishes.
    ///
    /// The standby neither publishes nor replies until it becomes the leader.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub async fn stand_by_numbered<B: Block>(
        &self,
        stream: NumberedStream,
    ) -> Result<NumberedStandby<B>, BusError> {
        let NumberedStream {
            key,
            buffer_key,
            source,
            epoch,
            first,
            state,
            keep,
        } = stream;
        let ring = Ring::new(source, epoch, keep).going_on(first, state);
        let publisher = declare_publisher::<B>(self.session(), key).await?;
        Ok(NumberedStandby {
            publisher,
            buffer_key,
            ring,
        })
    }

    async fn answer<B: Block>(
        &self,
        buffer_key: String,
        ring: Arc<Mutex<Ring<B>>>,
        older: Option<Older<B>>,
    ) -> Result<Answering, BusError> {
        let (queries, waiting) = flume::bounded(QUERIES_WAITING);
        let queryable = declare_queryable(self.session(), buffer_key, queries).await?;
        let mut tasks = JoinSet::new();
        let refusals = QueryRefusals::default();
        tasks.spawn(answer_queries(ring, older, waiting, refusals.clone()));
        Ok(Answering {
            refusals,
            _queryable: queryable,
            _tasks: tasks,
        })
    }

    /// Declares a topic for display values. The network may drop values.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub async fn publish_display<M: Message>(
        &self,
        key: String,
    ) -> Result<DisplayPublisher<M>, BusError> {
        let publisher = declare_publisher::<M>(self.session(), key).await?;
        Ok(DisplayPublisher {
            publisher,
            message: PhantomData,
        })
    }

    /// Declares a topic whose latest value can also be queried.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub async fn publish_latest<M>(&self, key: String) -> Result<LatestPublisher<M>, BusError>
    where
        M: Message + 'static,
    {
        let latest = Arc::new(Mutex::new(None));
        let (queries, waiting) = flume::bounded(QUERIES_WAITING);
        let queryable = declare_queryable(self.session(), key.clone(), queries).await?;
        let mut answering = JoinSet::new();
        let answer_key = key.clone();
        answering.spawn(answer_latest::<M>(answer_key, latest.clone(), waiting));
        let publisher = self.publish_display(key).await?;
        Ok(LatestPublisher {
            publisher,
            latest,
            _queryable: queryable,
            _answering: answering,
        })
    }
}

async fn declare_publisher<M: Message>(
    session: &Session,
    key: String,
) -> Result<Publisher<'static>, BusError> {
    let declared = session
        .declare_publisher(key.clone())
        .encoding(M::encoding())
        .congestion_control(CongestionControl::Drop)
        .express(false)
        .await;
    declared.map_err(|source| BusError::Declare { key, source })
}

/// Declares a queryable that forwards queries to a queue, because Zenoh's threads must not do our
/// work.
pub(crate) async fn declare_queryable(
    session: &Session,
    key: String,
    queries: flume::Sender<Query>,
) -> Result<Queryable<()>, BusError> {
    let declared = session
        .declare_queryable(key.clone())
        .callback(move |query| drop(queries.try_send(query)))
        .await;
    declared.map_err(|source| BusError::Declare { key, source })
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // No code under these locks panics, so that the data of a poisoned lock are valid.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

async fn put<M: Message>(publisher: &Publisher<'static>, message: &M) -> Result<(), BusError> {
    let payload = encode(publisher.key_expr(), message)?;
    put_payload(publisher, payload, message.attachment()).await
}

fn encode<M: Message>(key: &KeyExpr<'_>, message: &M) -> Result<Vec<u8>, BusError> {
    message.encode().map_err(|source| BusError::Encode {
        key: key.to_string(),
        source,
    })
}

async fn put_payload(
    publisher: &Publisher<'static>,
    payload: impl Into<ZBytes>,
    attachment: Option<String>,
) -> Result<(), BusError> {
    let put = publisher.put(payload).attachment(attachment).await;
    put.map_err(|source| BusError::Put {
        key: publisher.key_expr().to_string(),
        source,
    })
}

impl<B: Block> NumberedPublisher<B> {
    /// Releases the items before number `first` of an epoch, which no known reader needs any
    /// longer.
    pub fn release(&self, epoch: u64, first: u64) {
        lock(&self.ring).release(epoch, first);
    }

    /// Returns the number of rejected queries for stored items.
    #[must_use]
    pub fn refused_queries(&self) -> u64 {
        self.answering.refusals.total()
    }

    /// Removes the items from number `first` on. The source continues there and publishes them
    /// again.
    pub fn take_back(&self, first: u64) {
        lock(&self.ring).take_back(first);
    }

    /// Publishes the next block.
    ///
    /// # Errors
    /// Fails if the block is malformed or does not continue the stream, or if the session is
    /// closed.
    pub async fn put(&self, mut block: B) -> Result<(), BusError> {
        block.set_term(lock(&self.ring).term());
        let payload = encode(self.publisher.key_expr(), &block)?;
        // Store the block first, so that a reader that detects a gap finds it in the ring.
        push(
            &mut lock(&self.ring),
            self.publisher.key_expr(),
            &block,
            &payload,
        )?;
        put_payload(&self.publisher, payload, block.attachment()).await
    }

    /// Publishes the stored items again, from number `after` of an epoch on.
    ///
    /// The former leader may have failed before it published them.
    ///
    /// # Errors
    /// Fails if the session is closed.
    pub async fn put_again(&self, epoch: u64, after: u64) -> Result<(), BusError> {
        let mut range = QueryRange {
            after,
            limit: u64::MAX,
            epoch: Some(epoch),
        };
        loop {
            let answer = lock(&self.ring).answer(&range);
            let Answer::Block(block) = answer else {
                return Ok(());
            };
            put(&self.publisher, &block).await?;
            if block.count() == 0 || block.state() == StreamState::Ended {
                return Ok(());
            }
            range = QueryRange {
                after: block.end(),
                epoch: Some(block.header().epoch),
                ..range
            };
        }
    }
}

impl<B: Block> NumberedStandby<B> {
    /// Releases items as [`NumberedPublisher::release`] does.
    pub fn release(&mut self, epoch: u64, first: u64) {
        self.ring.release(epoch, first);
    }

    /// Stores the next block of the other source.
    ///
    /// # Errors
    /// Fails if the block is malformed or does not continue the stream.
    pub fn keep(&mut self, block: &B) -> Result<(), BusError> {
        let payload = encode(self.publisher.key_expr(), block)?;
        push(&mut self.ring, self.publisher.key_expr(), block, &payload)
    }

    /// Becomes the leader in a term: publishes the stream from now on and replies with the stored
    /// items.
    ///
    /// Readers prefer a term to all lower terms.
    ///
    /// # Errors
    /// Fails if Zenoh rejects the key or the session is closed.
    pub async fn lead(self, bus: &Bus, term: u64) -> Result<NumberedPublisher<B>, BusError> {
        let Self {
            publisher,
            buffer_key,
            mut ring,
        } = self;
        ring.lead(term);
        let ring = Arc::new(Mutex::new(ring));
        let answering = bus.answer(buffer_key, ring.clone(), None).await?;
        Ok(NumberedPublisher {
            publisher,
            ring,
            answering,
        })
    }
}

fn push<B: Block>(
    ring: &mut Ring<B>,
    key: &KeyExpr<'_>,
    block: &B,
    payload: &[u8],
) -> Result<(), BusError> {
    #[expect(
        clippy::disallowed_methods,
        reason = "the retention time of a block starts when it is published"
    )]
    let now = Instant::now();
    let pushed = ring.push(block, payload, now);
    pushed.map_err(|source| BusError::NotConsecutive {
        key: key.to_string(),
        source,
    })
}

async fn answer_queries<B: Block>(
    ring: Arc<Mutex<Ring<B>>>,
    older: Option<Older<B>>,
    queries: flume::Receiver<Query>,
    refusals: QueryRefusals,
) {
    while let Ok(query) = queries.recv_async().await {
        let range: QueryRange = match query.parameters().as_str().parse() {
            Ok(range) => range,
            Err(error) => {
                refusals.add(query.key_expr().as_str(), &error.to_string());
                let _ = query.reply_err(error.to_string()).await; // the client may be gone
                continue;
            }
        };
        let archived = match &older {
            Some(older) => read_archive(&ring, older, &range).await,
            None => None,
        };
        let answer = archived.map_or_else(|| lock(&ring).answer(&range), Answer::Block);
        let encoded = match &answer {
            Answer::Block(block) => block.encode().map(|payload| (payload, B::encoding())),
            Answer::CaughtUp(at) => at.encode().map(|payload| (payload, CaughtUp::encoding())),
        };
        match encoded {
            Ok((payload, encoding)) => reply(&query, query.key_expr(), payload, encoding).await,
            Err(error) => warn!(key = %query.key_expr(), %error, "reply cannot be encoded"),
        }
    }
}

/// Reads the requested items that only the archive contains, on a thread that may block.
async fn read_archive<B: Block>(
    ring: &Mutex<Ring<B>>,
    older: &Older<B>,
    range: &QueryRange,
) -> Option<B> {
    let lookup = Lookup::of(&*lock(ring), range, older.recent)?;
    let archive = older.archive.clone();
    let read = tokio::task::spawn_blocking(move || lookup.read(&*archive));
    // A read does not panic. If it did, the ring would reply with its own contents.
    read.await.ok().flatten()
}

/// Sends a reply. A failure is not an error, because a disconnected client repeats its query.
async fn reply(query: &Query, key: &KeyExpr<'static>, payload: Vec<u8>, encoding: String) {
    if let Err(error) = query.reply(key, payload).encoding(encoding).await {
        debug!(key = %key, %error, "reply not sent");
    }
}

/// Publishes display values.
#[derive(Debug)]
pub struct DisplayPublisher<M> {
    publisher: Publisher<'static>,
    message: PhantomData<fn(M)>,
}

impl<M: Message> DisplayPublisher<M> {
    /// Publishes a value.
    ///
    /// # Errors
    /// Fails if the value is malformed or the session is closed.
    pub async fn put(&self, message: &M) -> Result<(), BusError> {
        put(&self.publisher, message).await
    }
}

/// Publishes values and replies to queries with the latest value.
#[derive(Debug)]
pub struct LatestPublisher<M> {
    publisher: DisplayPublisher<M>,
    latest: Arc<Mutex<Option<Vec<u8>>>>,
    _queryable: Queryable<()>,
    _answering: JoinSet<()>,
}

impl<M: Message> LatestPublisher<M> {
    /// Publishes a value, which also becomes the reply to queries.
    ///
    /// # Errors
    /// Fails if the value is malformed or the session is closed.
    pub async fn put(&self, message: &M) -> Result<(), BusError> {
        let publisher = &self.publisher.publisher;
        let payload = encode(publisher.key_expr(), message)?;
        *lock(&self.latest) = Some(payload.clone());
        put_payload(publisher, payload, message.attachment()).await
    }
}

async fn answer_latest<M: Message>(
    key: String,
    latest: Arc<Mutex<Option<Vec<u8>>>>,
    queries: flume::Receiver<Query>,
) {
    let Ok(key) = KeyExpr::new(key) else {
        return; // the key is valid, because it has been declared
    };
    while let Ok(query) = queries.recv_async().await {
        // The query may request all parameters. The reply needs the concrete key of this parameter.
        let payload = lock(&latest).clone();
        if let Some(payload) = payload {
            reply(&query, &key, payload, M::encoding()).await;
        }
    }
}
