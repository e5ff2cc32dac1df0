//! Publishes the blocks of simulated or replayed nodes on the bus.

use std::future::Future;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use spandrel_bus::{
    Block, BoxedFuture, Bus, CaughtUp, FrameBlock, Keep, Keys, LiveToken, NumberedPublisher,
    NumberedStream, POSITION_TIMEOUT, Pace, Progress, ProgressWatch, SampleBlock, Service,
    StreamState, TimeGrid,
};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{info, warn};

use crate::cut::{Cutter, NodePlan};
use crate::error::SensorError;
use crate::pace::{RowsPut, Speed, Window};
use crate::rows::Row;

/// Maximum number of frames in transit: a few seconds of work, and less than the capacity of any
/// queue or ring downstream.
pub const WINDOW_FRAMES: u64 = 4096;
/// Number of samples that a node keeps for readers that missed some: four windows.
pub const SAMPLES_KEPT: u64 = 4 * WINDOW_FRAMES;

/// Samples per block at full speed.
const LARGE_BLOCK: u64 = 128;
/// Duration of a block in wall-clock time, s. A dashboard shows this delay as instantaneous.
const BLOCK_S: f64 = 0.05;
/// Maximum number of batches that are cut ahead. If the queue is full, cutting pauses.
const BATCHES_WAITING: usize = 8;
/// Time without progress after which a source that has sent everything stops with a warning.
const PATIENCE: Duration = Duration::from_secs(30);
/// Like [`PATIENCE`], but after a stop request, because the services waited for may have stopped as
/// well.
const PATIENCE_AFTER_STOP: Duration = Duration::from_secs(2);

/// Origin of the samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A model computes the samples. A token marks each node, so that a live simulation does not
    /// pass for measurements.
    Simulated,
    /// The samples come from a recording.
    Recorded,
}

/// Settings of a simulation or replay.
#[derive(Clone, Debug)]
pub struct SensorSettings {
    /// Origin of the rows.
    pub origin: Origin,
    /// Speed of the rows.
    pub speed: Speed,
    /// Epoch of the nodes. It must increase at each start, like the wall clock in ns.
    pub epoch: u64,
    /// Services to wait for. The source starts when their liveliness tokens appear, and does not
    /// run ahead of their progress.
    pub wait_for: Vec<Service>,
    /// Whether to resume after the last frame of ingest instead of starting a new run. Used after
    /// the nodes were killed.
    pub resume: bool,
}

/// The nodes of one structure, simulated or replayed.
#[derive(Debug)]
pub struct SensorService {
    bus: Bus,
    keys: Keys,
    cutter: Cutter,
    rate_hz: f64,
    settings: SensorSettings,
    publishers: Vec<NumberedPublisher<SampleBlock>>,
    tokens: Vec<LiveToken>,
    progress: Vec<(Service, ProgressWatch)>,
}

/// Blocks cut together, with the time of the last row in them (ns) and the number of rows since the
/// previous batch.
struct Batch {
    time_ns: i64,
    rows: u64,
    blocks: Vec<(usize, SampleBlock)>,
}

/// The progress of the nodes.
struct Put {
    first_ns: i64,
    rows: RowsPut,
    total: u64,
    last_sample_ns: i64,
    next: Vec<Option<SampleBlock>>,
}

/// Time after which a warning names a service that has not appeared.
const TOLD_AFTER: Duration = Duration::from_secs(1);

impl SensorService {
    /// Declares the nodes on the bus.
    ///
    /// `rate_hz` is the sampling rate of the rows, Hz.
    ///
    /// # Errors
    /// Returns an error if the bus rejects a declaration.
    pub fn start<'a>(
        nodes: Vec<NodePlan>,
        rate_hz: f64,
        bus: &'a Bus,
        keys: Keys,
        settings: SensorSettings,
    ) -> BoxedFuture<'a, Result<Self, SensorError>> {
        Box::pin(async move {
            let mut publishers = Vec::new();
            for node in &nodes {
                let stream = NumberedStream {
                    key: keys.samples(&node.name),
                    buffer_key: keys.buffer(&node.name),
                    source: node.name.to_string(),
                    epoch: settings.epoch,
                    first: 0,
                    state: StreamState::Running,
                    keep: Keep::last(SAMPLES_KEPT),
                };
                publishers.push(bus.publish_numbered(stream).await?);
            }
            let mut progress = Vec::new();
            for service in &settings.wait_for {
                progress.push((*service, bus.watch_progress(keys.progress(*service)).await?));
            }
            // The nodes must not appear before their mark, nor outlive it.
            let mut tokens = Vec::new();
            let mut marks = Vec::new();
            for node in &nodes {
                if settings.origin == Origin::Simulated {
                    marks.push(bus.announce(keys.simulated(&node.name)).await?);
                }
                tokens.push(bus.announce(keys.live(Service::Sensor, &node.name)).await?);
            }
            tokens.extend(marks);
            let block_samples = match settings.speed {
                Speed::Factor(factor) => {
                    ((BLOCK_S * rate_hz * factor) as u64).clamp(1, LARGE_BLOCK)
                }
                Speed::Live => ((BLOCK_S * rate_hz) as u64).clamp(1, LARGE_BLOCK),
                Speed::Max => LARGE_BLOCK,
            };
            let pace = if settings.speed == Speed::Live {
                Pace::Live
            } else {
                Pace::Replayed
            };
            let cutter = Cutter::new(nodes, settings.epoch, block_samples).with_pace(pace);
            Ok(Self {
                bus: bus.clone(),
                keys,
                cutter,
                rate_hz,
                settings,
                publishers,
                tokens,
                progress,
            })
        })
    }

    /// Publishes rows until they end or `stop` completes, and then waits until the services have
    /// processed them.
    ///
    /// Returns the number of published rows.
    ///
    /// # Errors
    /// Returns an error if the record cannot be read to its end, or if the bus has been closed.
    pub fn run<'a, E>(
        self,
        rows: impl Iterator<Item = Result<Row, E>> + Send + 'static,
        stop: impl Future<Output = ()> + Send + 'a,
    ) -> BoxedFuture<'a, Result<u64, SensorError>>
    where
        SensorError: From<E>,
    {
        self.run_until(
            Box::new(rows.map(|row| row.map_err(SensorError::from))),
            Box::pin(stop),
        )
    }

    fn run_until(
        mut self,
        rows: Rows,
        mut stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<u64, SensorError>> {
        Box::pin(async move {
            tokio::select! {
                ready = self.wait_for_services() => ready?,
                () = &mut stop => return self.withdraw().await.map(|()| 0),
            }
            let min_epoch = match self.settings.resume {
                false => self.min_epoch().await,
                true => match self.last_frame().await {
                    Some((_, at)) if at.state == StreamState::Ended => {
                        info!(
                            structure = self.keys.structure().as_str(),
                            "nothing to resume: the frames have ended"
                        );
                        return self.withdraw().await.map(|()| 0);
                    }
                    Some((last, at)) => {
                        self.resume_after(&last);
                        at.header.epoch
                    }
                    None => self.min_epoch().await,
                },
            };
            let mut put = Put {
                first_ns: 0,
                rows: RowsPut::default(),
                total: 0,
                last_sample_ns: i64::MIN,
                next: Vec::new(),
            };
            put.next.resize_with(self.publishers.len(), || None);
            let nodes = self.cutter.nodes().to_vec();
            let cutter =
                std::mem::replace(&mut self.cutter, Cutter::new(nodes, self.settings.epoch, 1));
            let (out, batches) = flume::bounded(BATCHES_WAITING);
            let mut cutting = JoinSet::new();
            // Cutting needs its own thread, because a simulation computes and a record waits for
            // the disk.
            cutting.spawn_blocking(move || cut_all(cutter, rows, &out));
            let put_all = self.put_all(min_epoch, &batches, &mut put);
            let patience = tokio::select! {
                finished = put_all => {
                    finished?;
                    PATIENCE
                }
                () = &mut stop => {
                    self.end_now(&put).await?;
                    PATIENCE_AFTER_STOP
                }
            };
            // Ends the cutting if it is still running.
            drop(batches);
            self.wait_until_done(&self.window(min_epoch, 0), put.last_sample_ns, patience)
                .await;
            let cut = cutting.join_next().await;
            self.withdraw().await?;
            match cut {
                Some(Ok(Err(error))) => Err(error),
                // Cutting does not panic. If it did, the panic hook has already reported the panic.
                Some(Ok(Ok(())) | Err(_)) | None => Ok(put.total),
            }
        })
    }

    async fn wait_for_services(&self) -> Result<(), SensorError> {
        for service in &self.settings.wait_for {
            let mut watch = self.bus.watch_live(self.keys.all_live(*service)).await?;
            if watch.present().is_empty() && timeout(TOLD_AFTER, watch.some()).await.is_err() {
                let (structure, service) = (self.keys.structure().as_str(), service.as_str());
                warn!(
                    structure,
                    "waiting for the {service} service on this bus before sending samples"
                );
                watch.some().await;
            }
        }
        info!(
            structure = self.keys.structure().as_str(),
            nodes = self.publishers.len(),
            "sensor nodes start"
        );
        Ok(())
    }

    /// Returns the last frame that ingest has built, and the current position of its stream.
    async fn last_frame(&self) -> Option<(FrameBlock, CaughtUp)> {
        self.bus
            .last_item(&self.keys.recording(), POSITION_TIMEOUT)
            .await
    }

    fn resume_after(&mut self, last: &FrameBlock) {
        let Some(grid) = last.grid() else { return };
        info!(
            structure = self.keys.structure().as_str(),
            frame = last.end(),
            "nodes resume after the last frame"
        );
        let nodes = self.cutter.nodes().to_vec();
        let cutter =
            std::mem::replace(&mut self.cutter, Cutter::new(nodes, self.settings.epoch, 1));
        self.cutter = cutter.resuming(grid, last.end());
    }

    /// Returns the lowest epoch of frames of this run. Progress that ingest reported for earlier
    /// epochs must not count.
    async fn min_epoch(&self) -> u64 {
        let asks = self.settings.wait_for.contains(&Service::Ingest);
        let position = if asks {
            self.bus
                .stream_position(&self.keys.recording(), POSITION_TIMEOUT)
                .await
        } else {
            None
        };
        match position {
            Some(at) if at.state == StreamState::Ended => at.header.epoch + 1,
            Some(at) => at.header.epoch,
            None => 0,
        }
    }

    /// Returns the window `elapsed_ns` (ns) after the first row. It grows as drifting clocks
    /// diverge.
    fn window(&self, min_epoch: u64, elapsed_ns: i64) -> Window {
        let step_ns = TimeGrid::new(0, self.rate_hz).map_or(0, |grid| grid.step_ns());
        // A frame is complete when the node with the slowest clock has reached it.
        let clocks = || {
            self.cutter
                .nodes()
                .iter()
                .map(|node| node.clock_ahead_ns(elapsed_ns))
        };
        let (ahead, behind) = (clocks().max().unwrap_or(0), clocks().min().unwrap_or(0));
        Window {
            rows: WINDOW_FRAMES + (ahead.saturating_sub(behind) / step_ns.max(1)).unsigned_abs(),
            step_ns,
            clock_ahead_ns: ahead.max(0),
            min_epoch,
        }
    }

    async fn put_all(
        &self,
        min_epoch: u64,
        batches: &flume::Receiver<Batch>,
        put: &mut Put,
    ) -> Result<(), SensorError> {
        let mut started = None;
        while let Ok(Batch {
            time_ns,
            rows,
            blocks,
        }) = batches.recv_async().await
        {
            let started = *started.get_or_insert_with(|| {
                put.first_ns = time_ns;
                match self.settings.speed {
                    Speed::Live => instant_of(time_ns),
                    Speed::Factor(_) | Speed::Max => Instant::now(),
                }
            });
            let window = self.window(min_epoch, time_ns.saturating_sub(put.first_ns));
            if let Some(due) = self.settings.speed.due(put.first_ns, time_ns) {
                sleep_until(started + due).await;
            }
            for (_, watch) in &self.progress {
                let admits = |p: Option<&Progress>| window.admits(rows, &put.rows, p);
                let mut watch = watch.clone();
                if !admits(watch.latest().as_ref()) {
                    watch.wait_for(|progress| admits(Some(progress))).await;
                }
            }
            for (node, block) in blocks {
                put.note(node, &block);
                self.publishers[node].put(block).await?;
            }
            put.rows.push(&window, time_ns, rows);
            put.total += rows;
        }
        Ok(())
    }

    /// Ends the nodes at their current position.
    async fn end_now(&self, put: &Put) -> Result<(), SensorError> {
        for (publisher, last) in self.publishers.iter().zip(&put.next) {
            if let Some(end) = last {
                publisher.put(end.clone()).await?;
            }
        }
        Ok(())
    }

    /// Waits until all services have processed the samples, because subscribers can fetch samples
    /// only while this process runs.
    async fn wait_until_done(&mut self, window: &Window, last_sample_ns: i64, patience: Duration) {
        let structure = self.keys.structure().as_str();
        for (service, watch) in &mut self.progress {
            let mut seen = watch.latest();
            while !seen
                .as_ref()
                .is_some_and(|progress| window.all_done(last_sample_ns, progress))
            {
                let changed = watch.wait_for(|progress| Some(progress) != seen.as_ref());
                match timeout(patience, changed).await {
                    Ok(progress) => seen = Some(progress),
                    // Nothing was published.
                    Err(_elapsed) if last_sample_ns == i64::MIN => break,
                    Err(_elapsed) => {
                        warn!(
                            structure,
                            service = service.as_str(),
                            "service has not processed all samples"
                        );
                        break;
                    }
                }
            }
        }
    }

    async fn withdraw(self) -> Result<(), SensorError> {
        info!(
            structure = self.keys.structure().as_str(),
            "sensor nodes stop"
        );
        for token in self.tokens {
            token.withdraw().await?;
        }
        Ok(())
    }
}

impl Put {
    /// Records a block before it is published. Once publishing has started, its sequence numbers
    /// are in use.
    fn note(&mut self, node: usize, block: &SampleBlock) {
        let mut end = block.clone();
        if let (Some(grid), Some(last)) = (block.grid(), block.count().checked_sub(1)) {
            self.last_sample_ns = self.last_sample_ns.max(grid.time_ns(last));
        }
        end.skip(block.count());
        let ended = block.state == StreamState::Ended;
        end.state = StreamState::Ended;
        if let Some(place) = self.next.get_mut(node) {
            *place = (!ended).then_some(end);
        }
    }
}

/// Returns the instant at which the wall clock shows `time_ns` (ns since the Unix epoch).
fn instant_of(time_ns: i64) -> Instant {
    #[expect(
        clippy::disallowed_methods,
        reason = "live samples are put when they are measured"
    )]
    let wall = SystemTime::now();
    let now = Instant::now();
    let wall_ns = wall
        .duration_since(UNIX_EPOCH)
        .map_or(0, |elapsed| elapsed.as_nanos() as i64);
    let away = Duration::from_nanos(time_ns.abs_diff(wall_ns));
    let instant = if time_ns > wall_ns {
        now.checked_add(away)
    } else {
        now.checked_sub(away)
    };
    instant.unwrap_or(now)
}

/// The rows of a record, or the error that ended reading.
type Rows = Box<dyn Iterator<Item = Result<Row, SensorError>> + Send>;

/// Cuts all rows, and sends a batch whenever blocks are complete. Returns early if the receiver is
/// gone.
fn cut_all(mut cutter: Cutter, rows: Rows, out: &flume::Sender<Batch>) -> Result<(), SensorError> {
    let (mut time_ns, mut rows_cut) = (0, 0);
    let mut failure = None;
    for row in rows {
        let row = match row {
            Ok(row) => row,
            Err(error) => {
                failure = Some(error);
                break;
            }
        };
        let mut blocks = Vec::new();
        cutter.push(row.time_ns, &row.values, &mut blocks);
        if !blocks.is_empty() {
            // Rows are available before they are due. A block that ends with the previous row is
            // due at the time of that row.
            let rows = std::mem::take(&mut rows_cut);
            if out
                .send(Batch {
                    time_ns,
                    rows,
                    blocks,
                })
                .is_err()
            {
                return Ok(());
            }
        }
        time_ns = row.time_ns;
        rows_cut += 1;
    }
    // Rows before an error are valid, and their stream ends normally.
    let mut blocks = Vec::new();
    cutter.end(&mut blocks);
    // Ignore the error: no receiver is left after a stop.
    let _ = out.send(Batch {
        time_ns,
        rows: rows_cut,
        blocks,
    });
    failure.map_or(Ok(()), Err)
}
