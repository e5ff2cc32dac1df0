//! Puts the blocks of simulated or replayed nodes on the bus.

use std::future::Future;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use spandrel_bus::{
    Block, BoxedFuture, Bus, CaughtUp, FrameBlock, Keep, Keys, LiveToken, NumberedPublisher,
    NumberedStream, Pace, Progress, ProgressWatch, SampleBlock, Service, StreamState, TimeGrid,
};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{info, warn};

use crate::cut::{Cutter, NodePlan};
use crate::error::SensorError;
use crate::pace::{RowsPut, Speed, Window};
use crate::rows::Row;

/// Frames on the way at most: a few seconds of work, and less than any queue or ring downstream holds.
pub const WINDOW_FRAMES: u64 = 4096;
/// Samples that a node keeps for readers that missed some: four windows.
pub const SAMPLES_KEPT: u64 = 4 * WINDOW_FRAMES;

/// Samples per block at full speed.
const LARGE_BLOCK: u64 = 128;
/// Duration of a block at a given speed, s of wall clock: what a dashboard sees as at once.
const BLOCK_S: f64 = 0.05;
/// Batches of blocks that are cut ahead; when they wait, cutting waits.
const BATCHES_WAITING: usize = 8;
/// Without any progress for this long, a source that is done leaves with a warning.
const PATIENCE: Duration = Duration::from_secs(30);
/// As [`PATIENCE`], after a stop: those waited for may have been stopped as well.
const PATIENCE_AFTER_STOP: Duration = Duration::from_secs(2);
/// Time for ingest to say where the frames stand.
const POSITION_TIMEOUT: Duration = Duration::from_secs(2);

/// What a simulation or replay is told.
#[derive(Clone, Debug)]
pub struct SensorSettings {
    /// How fast.
    pub speed: Speed,
    /// Epoch of the nodes: higher at each start, such as the wall clock in ns.
    pub epoch: u64,
    /// Services whose liveliness token is waited for, and whose progress is not run away from.
    pub wait_for: Vec<Service>,
    /// Whether to go on where the frames of ingest end, in place of a run of its own: after these nodes were killed.
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

/// Blocks cut together, with the time of the last row in them, and the rows since the batch before.
struct Batch {
    time_ns: i64,
    rows: u64,
    blocks: Vec<(usize, SampleBlock)>,
}

/// How far the nodes have come.
struct Put {
    first_ns: i64,
    rows: RowsPut,
    total: u64,
    last_sample_ns: i64,
    next: Vec<Option<SampleBlock>>,
}

/// Services that are not there for so long are asked for aloud.
const TOLD_AFTER: Duration = Duration::from_secs(1);

impl SensorService {
    /// Declares the nodes; `rate_hz` (Hz) is that of the rows.
    ///
    /// # Errors
    /// The bus refuses a declaration.
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
            let mut tokens = Vec::new();
            for node in &nodes {
                tokens.push(bus.announce(keys.live(Service::Sensor, &node.name)).await?);
            }
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

    /// Runs until the rows end or `stop`, and until the services waited for have done what was put; returns how many rows that was.
    ///
    /// # Errors
    /// The record cannot be read to its end, or the bus is closed underneath.
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
            // A thread of its own: a simulation computes, and a record waits for the disk.
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
            drop(batches); // ends the cutting, if it has not ended
            self.wait_until_done(&self.window(min_epoch, 0), put.last_sample_ns, patience)
                .await;
            let cut = cutting.join_next().await;
            self.withdraw().await?;
            match cut {
                Some(Ok(Err(error))) => Err(error),
                // Cutting does not panic; if it did, the panic has been reported where it happened.
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
                    "waiting for the {service} service on this bus before anything is sent"
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

    /// The last frame that ingest has made, and where its stream stands.
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
            "nodes go on where the frames end"
        );
        let nodes = self.cutter.nodes().to_vec();
        let cutter =
            std::mem::replace(&mut self.cutter, Cutter::new(nodes, self.settings.epoch, 1));
        self.cutter = cutter.resuming(grid, last.end());
    }

    /// The lowest epoch of frames of this run; what ingest has said of earlier ones must not count for it.
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

    /// The window so long after the first row (ns): clocks that drift move apart.
    fn window(&self, min_epoch: u64, elapsed_ns: i64) -> Window {
        let step_ns = TimeGrid::new(0, self.rate_hz).map_or(0, |grid| grid.step_ns());
        // A frame is done when the node whose clock is furthest behind has reached it.
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

    /// Ends the nodes where they are.
    async fn end_now(&self, put: &Put) -> Result<(), SensorError> {
        for (publisher, last) in self.publishers.iter().zip(&put.next) {
            if let Some(end) = last {
                publisher.put(end.clone()).await?;
            }
        }
        Ok(())
    }

    /// The samples must stay here to be fetched until nobody needs them.
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
                    Err(_elapsed) if last_sample_ns == i64::MIN => break, // nothing was put
                    Err(_elapsed) => {
                        warn!(
                            structure,
                            service = service.as_str(),
                            "service has not done all samples"
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
    /// Notes a block before it is put; once its put has begun, so has its number.
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

/// The instant at which the clock on the wall shows a time (ns since the Unix epoch).
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

/// Rows of a record, or why it cannot be read on.
type Rows = Box<dyn Iterator<Item = Result<Row, SensorError>> + Send>;

/// Cuts all rows, and sends a batch whenever blocks are complete; ends early when nobody receives.
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
            // rows are known ahead of their time: what ends with the row before this one is due when that one is
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
    // What came before an error is good, and has an end like any other.
    let mut blocks = Vec::new();
    cutter.end(&mut blocks);
    let _ = out.send(Batch {
        time_ns,
        rows: rows_cut,
        blocks,
    }); // nobody receives after a stop
    failure.map_or(Ok(()), Err)
}
