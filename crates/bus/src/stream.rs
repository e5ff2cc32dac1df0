//! Readers of lossless streams, which connect [`Follower`] to Zenoh.

use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep};
use tracing::warn;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

use crate::BoxedFuture;
use crate::buffer::{Buffer, Fetched};
use crate::error::BusError;
use crate::follow::{Action, Delivery, FollowCounts, Follower, Gap, Patience, Silence, Start};
use crate::message::{Block, CaughtUp, DecodeError, SampleBlock};
use crate::range::QueryRange;
use crate::receive::{Intake, read};
use crate::ring::Answer;
use crate::session::Bus;

/// Maximum pause between failing fetches, and between polls of an idle stream.
const LONGEST_PAUSE: Duration = Duration::from_millis(2_400);
/// Pause before the second attempt of a fetch. It doubles up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(50);

/// Settings of a reader of a lossless stream.
#[derive(Clone, Debug)]
pub struct StreamSettings {
    /// Start position.
    pub start: Start,
    /// Duration of the attempts to fetch missing items.
    pub patience: Patience,
    /// Maximum number of messages between Zenoh and the reader. If the queue is full, the newest
    /// message is dropped and fetched later.
    pub queue: usize,
    /// Maximum number of blocks that wait for the consumer. If the queue is full, the reader waits.
    pub deliveries: usize,
    /// Maximum number of items per fetch.
    pub fetch_limit: u64,
    /// Time without a message after which the reader queries the source for lost messages.
    pub idle: Duration,
    /// Timeout of a fetch.
    pub fetch_timeout: Duration,
}

impl StreamSettings {
    /// Returns settings for a stream of a few hundred blocks per second.
    #[must_use]
    pub fn new(start: Start) -> Self {
        Self {
            start,
            patience: Patience::Limited,
            queue: 256,
            deliveries: 64,
            fetch_limit: 4096,
            idle: Duration::from_millis(300),
            fetch_timeout: Duration::from_secs(2),
        }
    }

    /// Returns these settings for a source that stores its items. Fetches of missing items are
    /// repeated until it replies.
    #[must_use]
    pub fn patient(self) -> Self {
        Self {
            patience: Patience::UntilAnswered,
            ..self
        }
    }
}

/// Time limit for a source to report its position.
pub const POSITION_TIMEOUT: Duration = Duration::from_secs(2);

/// Counts of a reader.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StreamCounts {
    /// Irregularities of the stream.
    pub follow: FollowCounts,
    /// Number of messages dropped because the queue was full.
    pub overflowed: u64,
    /// Number of messages dropped unread because of the rate limit. The reader fetches them at its
    /// own pace.
    pub flooded: u64,
    /// Number of rejected messages, by reason.
    pub refused: BTreeMap<&'static str, u64>,
    /// Number of blocks that the reader's own check rejected, by reason.
    pub unfit: BTreeMap<&'static str, u64>,
    /// Why the last message or block was rejected.
    pub last_rejection: Option<String>,
}

impl StreamCounts {
    /// Returns the number of rejected messages and blocks.
    #[must_use]
    pub fn rejected(&self) -> u64 {
        self.refused.values().chain(self.unfit.values()).sum()
    }

    /// Returns the number of dropped, lost or recovered items by reason, for a status message.
    #[must_use]
    pub fn drops(&self) -> BTreeMap<String, u64> {
        let follow = &self.follow;
        let counts = [
            ("duplicate-items", follow.duplicate_items),
            ("fetched-items", follow.fetched_items),
            ("lost-items", follow.gap_items),
            ("stale-blocks", follow.stale_blocks),
            ("foreign-blocks", follow.foreign_blocks),
            ("superseded-blocks", follow.superseded_blocks),
            ("unkept-blocks", follow.unkept_blocks),
            ("impossible-blocks", follow.impossible_blocks),
            ("locked-out-blocks", follow.locked_out_blocks),
            ("overflowed-messages", self.overflowed),
            ("flooded-messages", self.flooded),
        ];
        let counted = counts.into_iter().filter(|(_, count)| *count > 0);
        let mut drops: BTreeMap<String, u64> = counted
            .map(|(reason, count)| (reason.to_owned(), count))
            .collect();
        for (reason, count) in &self.unfit {
            *drops.entry((*reason).to_owned()).or_default() += count;
        }
        drops.extend(
            self.refused
                .iter()
                .map(|(reason, count)| (format!("refused-{reason}"), *count)),
        );
        drops
    }
}

/// A reader of a lossless stream, created by [`Bus::follow`].
///
/// The reader delivers each item once and in order. It fetches missing items from the buffer of the
/// source, and reports a gap for items that are lost permanently. If the consumer is slow, the
/// reader waits. Excess messages are dropped and fetched later.
///
/// Reading ends when the stream is dropped.
#[derive(Debug)]
pub struct Stream<B> {
    deliveries: flume::Receiver<Delivery<B>>,
    source: Source,
    _reading: JoinSet<()>,
}

/// A reader of several lossless streams with one task and one queue. Reading ends when it is
/// dropped.
///
/// Blocks of sources that measure simultaneously arrive together. The group wakes its consumer once
/// for all of them.
#[derive(Debug)]
pub struct StreamGroup<B> {
    deliveries: mpsc::Receiver<(usize, Delivery<B>)>,
    sources: Vec<Source>,
    _reading: JoinSet<()>,
}

/// Settings of one stream of a group.
pub struct Reading<B> {
    /// Key of the blocks.
    pub key: String,
    /// Key of the queries for missing items.
    pub buffer_key: String,
    /// Settings of the reader.
    pub settings: StreamSettings,
    /// Check of each block. A rejected block is counted under its reason and changes nothing,
    /// regardless of its epoch and numbers.
    pub check: Check<B>,
}

/// Subscription of one stream, with its counts.
#[derive(Debug)]
struct Source {
    counts: Arc<Mutex<StreamCounts>>,
    overflowed: Arc<AtomicU64>,
    flooded: Arc<AtomicU64>,
    _subscriber: Subscriber<()>,
}

impl Source {
    fn counts(&self) -> StreamCounts {
        let counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        let load = |count: &AtomicU64| count.load(Ordering::Relaxed);
        StreamCounts {
            overflowed: load(&self.overflowed),
            flooded: load(&self.flooded),
            ..counts.clone()
        }
    }
}

impl<B: Block> Stream<B> {
    /// Returns the queue of items in order. It can be read from a thread without a runtime, and a
    /// wait is cancel-safe.
    ///
    /// The queue disconnects only when the session is closed.
    #[must_use]
    pub fn deliveries(&self) -> &flume::Receiver<Delivery<B>> {
        &self.deliveries
    }

    /// Returns the counts so far.
    #[must_use]
    pub fn counts(&self) -> StreamCounts {
        self.source.counts()
    }
}

impl<B: Block> StreamGroup<B> {
    /// Waits for the next delivery and returns it with the index of its stream. The wait is
    /// cancel-safe.
    ///
    /// Returns `None` if the session is closed or the group has no streams.
    pub async fn next(&mut self) -> Option<(usize, Delivery<B>)> {
        self.deliveries.recv().await
    }

    /// Returns the next delivery with the index of its stream, if one is available.
    pub fn next_now(&mut self) -> Option<(usize, Delivery<B>)> {
        self.deliveries.try_recv().ok()
    }

    /// Returns the counts so far, per stream.
    pub fn counts(&self) -> impl Iterator<Item = StreamCounts> + '_ {
        self.sources.iter().map(Source::counts)
    }
}

impl Bus {
    /// Reads the stream on `key`, and queries missing items on `buffer_key`.
    ///
    /// # Errors
    /// Fails if Zenoh rejects a key or the session is closed.
    pub async fn follow<B: Block>(
        &self,
        key: String,
        buffer_key: String,
        settings: StreamSettings,
    ) -> Result<Stream<B>, BusError> {
        self.follow_fit(key, buffer_key, settings, |_| Ok(())).await
    }

    /// Reads a stream as [`Bus::follow`] does, with a check of every block.
    ///
    /// A rejected block is counted under the reason that `check` returns. It changes nothing,
    /// regardless of its epoch and numbers.
    ///
    /// # Errors
    /// Fails if Zenoh rejects a key or the session is closed.
    pub async fn follow_fit<B: Block>(
        &self,
        key: String,
        buffer_key: String,
        settings: StreamSettings,
        check: impl Fn(&B) -> Result<(), &'static str> + Send + 'static,
    ) -> Result<Stream<B>, BusError> {
        let deliveries = settings.deliveries.max(1);
        let (reader, arrived, source) = self
            .reader(Reading {
                key,
                buffer_key,
                settings,
                check: Box::new(check),
            })
            .await?;
        let (out, deliveries) = flume::bounded(deliveries);
        let mut reading = JoinSet::new();
        reading.spawn(reader.run(arrived, Out::One(out)));
        Ok(Stream {
            deliveries,
            source,
            _reading: reading,
        })
    }

    /// Reads several streams into one queue with room for `deliveries` blocks.
    ///
    /// # Errors
    /// Fails if Zenoh rejects a key or the session is closed.
    pub fn follow_group<B: Block>(
        &self,
        streams: Vec<Reading<B>>,
        deliveries: usize,
    ) -> BoxedFuture<'_, Result<StreamGroup<B>, BusError>> {
        Box::pin(async move {
            let (out, queue) = mpsc::channel(deliveries.max(1));
            let (readers, mut sources) = (FuturesUnordered::new(), Vec::new());
            for (number, stream) in streams.into_iter().enumerate() {
                let (reader, arrived, source) = self.reader(stream).await?;
                readers.push(reader.run(arrived, Out::Group(number, out.clone())));
                sources.push(source);
            }
            let mut reading = JoinSet::new();
            reading.spawn(readers.collect::<()>());
            Ok(StreamGroup {
                deliveries: queue,
                sources,
                _reading: reading,
            })
        })
    }

    async fn reader<B: Block>(
        &self,
        stream: Reading<B>,
    ) -> Result<(Reader<B>, mpsc::Receiver<Box<Sample>>, Source), BusError> {
        let Reading {
            key,
            buffer_key,
            settings,
            check,
        } = stream;
        let overflowed = Arc::new(AtomicU64::new(0));
        // Samples are boxed, because each queue allocates room for 32 elements in advance, and
        // there is one queue per node.
        let (samples, arrived) = mpsc::channel(settings.queue.max(1));
        let counts = Arc::new(Mutex::new(StreamCounts::default()));
        let flooded = Arc::new(AtomicU64::new(0));
        let (full, too_often) = (overflowed.clone(), flooded.clone());
        let intake = Mutex::new(Intake::new());
        let declared = self.session().declare_subscriber(key.clone());
        let subscriber = declared
            .callback(move |sample: Sample| {
                if intake
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .take(&sample)
                    .is_err()
                {
                    too_often.fetch_add(1, Ordering::Relaxed);
                } else if samples.try_send(Box::new(sample)).is_err() {
                    full.fetch_add(1, Ordering::Relaxed);
                }
            })
            .await
            .map_err(|source| BusError::Declare {
                key: key.clone(),
                source,
            })?;
        let buffer = self.buffer(buffer_key, settings.fetch_timeout).await?;
        let reader = Reader {
            follower: Follower::new(settings.start, settings.fetch_limit, settings.patience),
            actions: VecDeque::new(),
            fetch: None,
            polls: 0,
            buffer: Arc::new(buffer),
            key,
            settings,
            check,
            counts: counts.clone(),
        };
        Ok((
            reader,
            arrived,
            Source {
                counts,
                overflowed,
                flooded,
                _subscriber: subscriber,
            },
        ))
    }
}

impl Bus {
    /// Queries the position of a stream. Returns `None` if there is no reply in time.
    pub fn stream_position<'a>(
        &'a self,
        buffer_key: &'a str,
        timeout: Duration,
    ) -> BoxedFuture<'a, Option<CaughtUp>> {
        Box::pin(async move {
            // No source has so many items, so that the reply only contains the end of the stream.
            let range = QueryRange {
                after: u64::MAX,
                limit: 1,
                epoch: None,
            };
            let buffer = self.buffer(buffer_key.to_owned(), timeout).await.ok()?;
            match buffer.ask::<SampleBlock>(range).await {
                Fetched::Answer(Answer::CaughtUp(at)) => Some(at),
                Fetched::Answer(Answer::Block(_))
                | Fetched::Unreadable(_)
                | Fetched::Nothing(_) => None,
            }
        })
    }
}

impl Bus {
    /// Queries the last item and the position of a stream.
    ///
    /// Returns `None` if there is no reply in time or no item yet.
    pub async fn last_item<B: Block>(
        &self,
        buffer_key: &str,
        timeout: Duration,
    ) -> Option<(B, CaughtUp)> {
        let at = self.stream_position(buffer_key, timeout).await?;
        let after = at.header.sequence.checked_sub(1)?;
        let buffer = self.buffer(buffer_key.to_owned(), timeout).await.ok()?;
        match buffer
            .ask::<B>(QueryRange {
                after,
                limit: 1,
                epoch: Some(at.header.epoch),
            })
            .await
        {
            Fetched::Answer(Answer::Block(block)) if block.count() > 0 => Some((block, at)),
            Fetched::Answer(_) | Fetched::Unreadable(_) | Fetched::Nothing(_) => None,
        }
    }
}

/// Destination of the deliveries of a reader.
enum Out<B> {
    One(flume::Sender<Delivery<B>>),
    Group(usize, mpsc::Sender<(usize, Delivery<B>)>),
}

impl<B> Out<B> {
    /// Waits while the queue is full. Returns `false` if the queue no longer has a consumer.
    async fn put(&self, delivery: Delivery<B>) -> bool {
        match self {
            Self::One(queue) => queue.send_async(delivery).await.is_ok(),
            Self::Group(number, queue) => queue.send((*number, delivery)).await.is_ok(),
        }
    }
}

/// A check that returns the reason why a block does not suit its reader.
pub type Check<B> = Box<dyn Fn(&B) -> Result<(), &'static str> + Send>;

struct Reader<B> {
    follower: Follower<B>,
    actions: VecDeque<Action<B>>,
    fetch: Option<Pin<Box<dyn Future<Output = Fetched<B>> + Send>>>,
    polls: u32,
    buffer: Arc<Buffer>,
    key: String,
    settings: StreamSettings,
    check: Check<B>,
    counts: Arc<Mutex<StreamCounts>>,
}

impl<B: Block> Reader<B> {
    async fn run(mut self, mut arrived: mpsc::Receiver<Box<Sample>>, out: Out<B>) {
        self.follower.idle(&mut self.actions); // fetch earlier items
        // The timer is only reset after it has elapsed or if it is too late. A reset per block
        // would cost more than reading the block.
        let mut idle = std::pin::pin!(sleep(self.idle_pause()));
        loop {
            while let Some(action) = self.actions.pop_front() {
                match action {
                    Action::Deliver(delivery) => {
                        self.log_gap(&delivery);
                        if !out.put(delivery).await {
                            return; // no consumer
                        }
                    }
                    Action::Fetch { range, failures } => self.start_fetch(range, failures),
                }
            }
            self.publish_counts();
            let due = Instant::now() + self.idle_pause();
            if idle.deadline() > due {
                idle.as_mut().reset(due);
            }
            loop {
                tokio::select! {
                    biased; // replies first, because the messages after them wait for them
                    fetched = answer_of(&mut self.fetch) => self.fetched(fetched),
                    sample = arrived.recv() => match sample {
                        Some(sample) => self.arrived(&sample),
                        None => return,
                    },
                    () = idle.as_mut() => match Instant::now() < due {
                        true => {
                            idle.as_mut().reset(due);
                            continue;
                        }
                        false => {
                            self.polls += 1;
                            self.follower.idle(&mut self.actions);
                            idle.as_mut().reset(Instant::now() + self.idle_pause());
                        }
                    }
                }
                break;
            }
        }
    }

    fn idle_pause(&self) -> Duration {
        let doubled = self.settings.idle * 2_u32.pow(self.polls.min(8));
        doubled.min(LONGEST_PAUSE.max(self.settings.idle))
    }

    fn arrived(&mut self, sample: &Sample) {
        self.polls = 0;
        match read::<B>(sample) {
            Ok(block) if self.fits(&block) => self.follower.live(block, &mut self.actions),
            Ok(_unfit) => {}
            Err(error) => self.refuse(&error),
        }
    }

    fn fetched(&mut self, fetched: Fetched<B>) {
        self.fetch = None;
        match fetched {
            Fetched::Answer(Answer::Block(block)) if !self.fits(&block) => {
                self.unanswered(Silence::Denied)
            }
            Fetched::Answer(answer) => self.follower.answered(answer, &mut self.actions),
            Fetched::Unreadable(error) => {
                self.refuse(&error);
                self.unanswered(Silence::Denied);
            }
            Fetched::Nothing(silence) => self.unanswered(silence),
        }
    }

    fn unanswered(&mut self, silence: Silence) {
        self.follower.unanswered(silence, &mut self.actions);
    }

    /// Returns `true` if the reader's check accepts a block. Otherwise counts it, and logs it each
    /// time the count has doubled.
    fn fits(&self, block: &B) -> bool {
        let Err(reason) = (self.check)(block) else {
            return true;
        };
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        counts.last_rejection = Some(reason.to_owned());
        let count = counts.unfit.entry(reason).or_default();
        *count += 1;
        if count.is_power_of_two() {
            let source = block.header().source.as_str();
            warn!(
                key = self.key,
                source,
                reason,
                count = *count,
                "block rejected"
            );
        }
        false
    }

    /// Counts a rejected message, and logs it each time the count has doubled.
    fn refuse(&mut self, error: &DecodeError) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        let (why, reason) = (error.with_cause(), error.reason());
        counts.last_rejection = Some(why.to_string());
        let count = counts.refused.entry(reason).or_default();
        *count += 1;
        if count.is_power_of_two() {
            warn!(key = self.key, error = %why, reason, count = *count, "message rejected");
        }
    }

    fn log_gap(&self, delivery: &Delivery<B>) {
        if let Delivery::Gap(Gap { epoch, from, to }) = delivery {
            warn!(
                key = self.key,
                epoch, from, to, "items lost: their source no longer has them"
            );
        }
    }

    fn publish_counts(&self) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        counts.follow = self.follower.counts().clone();
    }

    fn start_fetch(&mut self, range: QueryRange, failures: u32) {
        let pause = match failures {
            0 => Duration::ZERO,
            n => (FIRST_PAUSE * 2_u32.pow((n - 1).min(8))).min(LONGEST_PAUSE),
        };
        let buffer = self.buffer.clone();
        self.fetch = Some(Box::pin(async move {
            sleep(pause).await;
            buffer.ask(range).await
        }));
    }
}

/// Waits for the pending fetch, or forever if there is none.
async fn answer_of<B>(
    fetch: &mut Option<Pin<Box<dyn Future<Output = Fetched<B>> + Send>>>,
) -> Fetched<B> {
    match fetch {
        Some(fetch) => fetch.await,
        None => std::future::pending().await,
    }
}
