//! The bounded queues between the connections and the core.

use std::task::Poll;

use spandrel_service::Clock;
use tokio::sync::mpsc;
use tokio::time::Instant;

use crate::core_input::{FeedInput, Link, Moment};
use crate::packet::Packet;
use crate::source_plan::SourceKind;

/// Maximum number of datagrams that wait for the core. If the queue is full, the newest datagram is
/// dropped and counted.
pub(crate) const DATAGRAMS: usize = 1024;
/// Maximum number of messages of another source that wait for the core. If the queue is full, the
/// source waits. A message has up to 64 KiB of text.
pub(crate) const MESSAGES: usize = 16;

/// The clocks of the feed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clocks {
    clock: Clock,
    started: Instant,
}

impl Clocks {
    /// Starts the monotonic clock.
    pub(crate) fn start(clock: Clock) -> Self {
        Self {
            clock,
            started: Instant::now(),
        }
    }

    /// Returns the present moment.
    pub(crate) fn now(self) -> Moment {
        Moment {
            wall_ns: self.clock.now_ns(),
            elapsed_ns: i64::try_from(self.started.elapsed().as_nanos()).unwrap_or(i64::MAX),
        }
    }
}

/// An input with the moment of its arrival.
#[derive(Debug)]
pub(crate) struct Arrived {
    pub(crate) input: FeedInput,
    pub(crate) at: Moment,
}

/// The queue of one source, from the side of its connection.
#[derive(Clone, Debug)]
pub(crate) struct Outlet {
    source: usize,
    clocks: Clocks,
    queue: mpsc::Sender<Arrived>,
}

/// The queues of all sources, from the side of the core.
#[derive(Debug, Default)]
pub(crate) struct Arrivals {
    queues: Vec<mpsc::Receiver<Arrived>>,
    next: usize,
}

impl Arrivals {
    /// Adds the queue of a source.
    pub(crate) fn add(&mut self, source: usize, kind: &SourceKind, clocks: Clocks) -> Outlet {
        let capacity = match kind {
            SourceKind::Udp { .. } => DATAGRAMS,
            _ => MESSAGES,
        };
        let (queue, arrived) = mpsc::channel(capacity);
        self.queues.push(arrived);
        Outlet {
            source,
            clocks,
            queue,
        }
    }

    /// Returns the next input, from one source after the other. Returns `None` if all sources have
    /// ended. The wait is cancel-safe.
    ///
    /// A source that is `held` keeps its inputs until a later call.
    pub(crate) async fn next(&mut self, held: &[bool]) -> Option<Arrived> {
        std::future::poll_fn(|context| {
            let count = self.queues.len();
            let mut is_open = false;
            for step in 0..count {
                let index = (self.next + step) % count;
                let Some(queue) = self.queues.get_mut(index) else {
                    continue;
                };
                if held.get(index).is_some_and(|is_held| *is_held) {
                    is_open = true;
                    continue;
                }
                match queue.poll_recv(context) {
                    Poll::Ready(Some(arrived)) => {
                        self.next = index + 1;
                        return Poll::Ready(Some(arrived));
                    }
                    Poll::Ready(None) => {}
                    Poll::Pending => is_open = true,
                }
            }
            match is_open {
                true => Poll::Pending,
                false => Poll::Ready(None),
            }
        })
        .await
    }

    /// Returns the next input if one is available.
    pub(crate) fn next_now(&mut self) -> Option<Arrived> {
        self.queues
            .iter_mut()
            .find_map(|queue| queue.try_recv().ok())
    }
}

impl Outlet {
    /// Passes an input on, and waits while the queue is full. Returns `false` if the feed stops.
    async fn put(&self, input: FeedInput) -> bool {
        let at = self.clocks.now();
        self.queue.send(Arrived { input, at }).await.is_ok()
    }

    /// Passes packets on.
    pub(crate) async fn packets(&self, packets: Vec<Packet>) -> bool {
        packets.is_empty()
            || self
                .put(FeedInput::Packets {
                    source: self.source,
                    packets,
                })
                .await
    }

    /// Passes packets on, or drops them if the queue is full. Returns `false` if it is full.
    pub(crate) fn packets_or_drop(&self, packets: Vec<Packet>) -> bool {
        let input = FeedInput::Packets {
            source: self.source,
            packets,
        };
        let at = self.clocks.now();
        self.queue.try_send(Arrived { input, at }).is_ok()
    }

    /// Reports messages that were dropped. Returns `false` if the queue is full.
    pub(crate) fn dropped(&self, messages: u64) -> bool {
        let input = FeedInput::Dropped {
            source: self.source,
            messages,
        };
        let at = self.clocks.now();
        self.queue.try_send(Arrived { input, at }).is_ok()
    }

    /// Reports data that cannot be read.
    pub(crate) async fn malformed(&self, fault: String) -> bool {
        self.put(FeedInput::Malformed {
            source: self.source,
            fault,
        })
        .await
    }

    /// Reports a change of the connection.
    pub(crate) async fn link(&self, link: Link) -> bool {
        self.put(FeedInput::Link {
            source: self.source,
            link,
        })
        .await
    }

    /// Reports a failure of the connection.
    pub(crate) async fn failed(&self, why: String) -> bool {
        self.link(Link::Failed { why }).await
    }

    /// Returns `true` if the feed has stopped.
    pub(crate) fn is_closed(&self) -> bool {
        self.queue.is_closed()
    }

    /// Passes an input on from a thread without a runtime.
    pub(crate) fn put_blocking(&self, input: FeedInput) -> bool {
        let at = self.clocks.now();
        self.queue.blocking_send(Arrived { input, at }).is_ok()
    }

    /// Returns the index of the source.
    pub(crate) fn source(&self) -> usize {
        self.source
    }
}
