//! Puts messages: numbered blocks that can be asked for again, and values for people.

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
use crate::ring::{Answer, Keep, Ring};
use crate::session::Bus;

/// Queries waiting for an answer; one more is dropped, and its asker asks again.
const QUERIES_WAITING: usize = 64;

/// Where a lossless stream is put, and what its ring keeps.
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
    /// Number of its first item: not 0 for a source that goes on where an earlier life of it was.
    pub first: u64,
    /// Whether that earlier life had ended the epoch.
    pub state: StreamState,
    /// What is kept in memory.
    pub keep: Keep,
}

/// Where older items of a stream are kept, and how many of them an asker gets that has none yet.
pub struct Older<B> {
    /// Where they are kept.
    pub archive: Arc<dyn Archive<B>>,
    /// Items of the running epoch, counted back from its end.
    pub recent: u64,
}

/// Puts the blocks of a lossless stream, and keeps the latest for those who missed them.
///
/// A put never waits: what the network cannot take is dropped, and fetched by its readers from the ring.
#[derive(Debug)]
pub struct NumberedPublisher<B> {
    publisher: Publisher<'static>,
    ring: Arc<Mutex<Ring<B>>>,
    _answering: Answering,
}

/// Answers queries for as long as it lives.
#[derive(Debug)]
struct Answering {
    _queryable: Queryable<()>,
    _tasks: JoinSet<()>,
}

/// The blocks of a lossless stream that somebody else puts: kept in the same way, for the time when this source leads.
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
    /// Zenoh refuses a key, or the session is closed.
    pub async fn publish_numbered<B: Block>(
        &self,
        stream: NumberedStream,
    ) -> Result<NumberedPublisher<B>, BusError> {
        self.publish_archived(stream, None).await
    }

    /// As [`Bus::publish_numbered`], with older items from an archive.
    ///
    /// # Errors
    /// As [`Bus::publish_numbered`].
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
            _answering: answering,
        })
    }

    /// Declares a lossless stream that another source puts, and that this one may come to lead: nothing is put nor answered till then.
    ///
    /// # Errors
    /// As [`Bus::publish_numbered`].
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
        tasks.spawn(answer_queries(ring, older, waiting));
        Ok(Answering {
            _queryable: queryable,
            _tasks: tasks,
        })
    }

    /// Declares a topic for people and dashboards: a value that the network cannot take is dropped.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
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

    /// Declares a topic whose last value is also given on query.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
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

/// The callback only hands over: Zenoh's threads do no work of ours.
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
    // Nothing that panics runs under these locks; a poisoned one is as good as any.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

async fn put<M: Message>(publisher: &Publisher<'static>, message: &M) -> Result<(), BusError> {
    let payload = encode(publisher.key_expr(), message)?;
    put_payload(publisher, payload).await
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
) -> Result<(), BusError> {
    let put = publisher.put(payload).await;
    put.map_err(|source| BusError::Put {
        key: publisher.key_expr().to_string(),
        source,
    })
}

impl<B: Block> NumberedPublisher<B> {
    /// Whoever is known to need the items of an epoch needs those before number `first` no more.
    pub fn release(&self, epoch: u64, first: u64) {
        lock(&self.ring).release(epoch, first);
    }

    /// Takes back the items from number `first` on: this source goes on from there, and puts them again.
    pub fn take_back(&self, first: u64) {
        lock(&self.ring).take_back(first);
    }

    /// Puts the next block.
    ///
    /// # Errors
    /// The block does not continue the stream or is malformed, or the session is closed.
    pub async fn put(&self, mut block: B) -> Result<(), BusError> {
        block.set_term(lock(&self.ring).term());
        let payload = encode(self.publisher.key_expr(), &block)?;
        // Into the ring first: whoever sees a gap after this put finds the block there.
        push(
            &mut lock(&self.ring),
            self.publisher.key_expr(),
            &block,
            &payload,
        )?;
        put_payload(&self.publisher, payload).await
    }

    /// Puts what is kept from number `after` of an epoch on once more, as far as it is kept: the source before may have died before
    /// it had put it.
    ///
    /// # Errors
    /// The session is closed.
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
    /// As [`NumberedPublisher::release`].
    pub fn release(&mut self, epoch: u64, first: u64) {
        self.ring.release(epoch, first);
    }

    /// Keeps the next block, which somebody else puts.
    ///
    /// # Errors
    /// The block does not continue the stream or is malformed.
    pub fn keep(&mut self, block: &B) -> Result<(), BusError> {
        let payload = encode(self.publisher.key_expr(), block)?;
        push(&mut self.ring, self.publisher.key_expr(), block, &payload)
    }

    /// Puts the stream from now on in a term of leadership, which its readers prefer to all lower ones, and answers for what it has kept.
    ///
    /// # Errors
    /// Zenoh refuses the key, or the session is closed.
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
            _answering: answering,
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
        reason = "how long blocks are kept goes by the time at which they were put"
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
) {
    while let Ok(query) = queries.recv_async().await {
        let range: QueryRange = match query.parameters().as_str().parse() {
            Ok(range) => range,
            Err(error) => {
                warn!(key = %query.key_expr(), %error, "query refused");
                let _ = query.reply_err(error.to_string()).await; // the asker may be gone
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
            Err(error) => warn!(key = %query.key_expr(), %error, "answer cannot be encoded"),
        }
    }
}

/// What an asker wants that is only in the archive; read on a thread that may wait for the disk.
async fn read_archive<B: Block>(
    ring: &Mutex<Ring<B>>,
    older: &Older<B>,
    range: &QueryRange,
) -> Option<B> {
    let lookup = Lookup::of(&*lock(ring), range, older.recent)?;
    let archive = older.archive.clone();
    let read = tokio::task::spawn_blocking(move || lookup.read(&*archive));
    read.await.ok().flatten() // a read does not panic; if it did, the ring answers with what it has
}

/// An asker that is gone asks again when it is back: a failed reply is no error of ours.
async fn reply(query: &Query, key: &KeyExpr<'static>, payload: Vec<u8>, encoding: String) {
    if let Err(error) = query.reply(key, payload).encoding(encoding).await {
        debug!(key = %key, %error, "answer not sent");
    }
}

/// Puts values for people and dashboards.
#[derive(Debug)]
pub struct DisplayPublisher<M> {
    publisher: Publisher<'static>,
    message: PhantomData<fn(M)>,
}

impl<M: Message> DisplayPublisher<M> {
    /// Puts a value.
    ///
    /// # Errors
    /// The value is malformed, or the session is closed.
    pub async fn put(&self, message: &M) -> Result<(), BusError> {
        put(&self.publisher, message).await
    }
}

/// Puts values, and gives the last one to whoever asks.
#[derive(Debug)]
pub struct LatestPublisher<M> {
    publisher: DisplayPublisher<M>,
    latest: Arc<Mutex<Option<Vec<u8>>>>,
    _queryable: Queryable<()>,
    _answering: JoinSet<()>,
}

impl<M: Message> LatestPublisher<M> {
    /// Puts a value; it is the answer to queries from now on.
    ///
    /// # Errors
    /// The value is malformed, or the session is closed.
    pub async fn put(&self, message: &M) -> Result<(), BusError> {
        let publisher = &self.publisher.publisher;
        let payload = encode(publisher.key_expr(), message)?;
        *lock(&self.latest) = Some(payload.clone());
        put_payload(publisher, payload).await
    }
}

async fn answer_latest<M: Message>(
    key: String,
    latest: Arc<Mutex<Option<Vec<u8>>>>,
    queries: flume::Receiver<Query>,
) {
    let Ok(key) = KeyExpr::new(key) else {
        return; // it has been declared, so it is one
    };
    while let Ok(query) = queries.recv_async().await {
        // The query may be for all parameters: the reply goes to the key of this one.
        let payload = lock(&latest).clone();
        if let Some(payload) = payload {
            reply(&query, &key, payload, M::encoding()).await;
        }
    }
}
