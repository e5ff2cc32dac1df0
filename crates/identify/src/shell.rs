//! Joins the identification of one structure to the bus.

use crate::error::IdentifyError;
use crate::identification::{Identification, Input, Output};
use crate::pool::FilterPool;
use spandrel_bus::{
    Bus, BusError, Delivery, Description, DisplayPublisher, EstimateBlock, Event, EventKind, FrameBlock, Keys,
    LatestPublisher, LiveToken, Message, ModelClassDisplay, Name, NoiseDisplay, NumberedPublisher, NumberedStream,
    OutlierDisplay, ParameterDisplay, ProgressPublisher, Service, Start, Status, Stream, StreamState,
};
use spandrel_structure::Structure;
use std::collections::BTreeMap;
use std::future::Future;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tracing::{debug, info, warn};

/// Estimates kept for readers that missed some; larger than the window that a replay keeps.
pub const ESTIMATES_KEPT: u64 = 32_768;

/// How often the status is put.
const STATUS_EVERY: Duration = Duration::from_secs(1);

/// After a stop, frames are waited for until none has come for this long.
const LAST_FRAMES: Duration = Duration::from_millis(100);

/// The identification service of one structure.
#[derive(Debug)]
pub struct IdentifyService {
    core: Option<Identification>,
    pool: FilterPool,
    frames: Stream<FrameBlock>,
    estimates: NumberedPublisher<EstimateBlock>,
    parameters: BTreeMap<Name, DisplayPublisher<ParameterDisplay>>,
    noise: BTreeMap<Name, DisplayPublisher<NoiseDisplay>>,
    outliers: BTreeMap<Name, DisplayPublisher<OutlierDisplay>>,
    classes: Option<DisplayPublisher<ModelClassDisplay>>,
    events: DisplayPublisher<Event>,
    _description: LatestPublisher<Description>,
    progress: ProgressPublisher,
    status: DisplayPublisher<Status>,
    keys: Keys,
    service: Name,
    id: Name,
    token: Option<LiveToken>,
    last_time_ns: Option<i64>,
    epoch: u64,
}

impl IdentifyService {
    /// Checks everything and joins the bus; `id` names this instance.
    ///
    /// # Errors
    /// When the filter cannot be made, or the bus refuses a declaration.
    pub async fn start(
        structure: &Structure,
        bus: &Bus,
        keys: Keys,
        id: Name,
        pool: FilterPool,
    ) -> Result<Self, IdentifyError> {
        let core = Identification::new(structure, id.as_str())?;
        let estimates = bus
            .publish_numbered(NumberedStream {
                key: keys.estimates(),
                buffer_key: keys.estimates_buffer(),
                source: id.to_string(),
                epoch: 0, // that of the frames, from the first block on
                capacity: ESTIMATES_KEPT,
            })
            .await?;
        let mut parameters = BTreeMap::new();
        for name in core.parameter_names() {
            parameters.insert(name.clone(), bus.publish_display(keys.parameter(name)).await?);
        }
        let mut noise = BTreeMap::new();
        for name in core.noise_names() {
            noise.insert(name.clone(), bus.publish_display(keys.noise(name)).await?);
        }
        let mut outliers = BTreeMap::new();
        for name in core.screened_channels() {
            outliers.insert(name.clone(), bus.publish_display(keys.outlier(name)).await?);
        }
        let classes = match core.compares_classes() {
            true => Some(bus.publish_display(keys.model_class()).await?),
            false => None,
        };
        let description = bus.publish_latest(keys.description()).await?;
        description
            .put(&Description { structure: keys.structure().clone(), text: structure.text().to_owned() })
            .await?;
        let (channels, rate_hz) = (structure.channel_count(), structure.sampling_rate_hz());
        let is_of_structure = move |block: &FrameBlock| match usize::from(block.channels) == channels
            && block.sampling_rate_hz == rate_hz
        {
            true => Ok(()),
            false => Err("frames-of-another-structure"),
        };
        let settings = bus.reading(Start::Beginning);
        let frames = bus.follow_fit(keys.frames(), keys.recording(), settings, is_of_structure).await?;
        let service = Self {
            pool,
            frames,
            estimates,
            parameters,
            noise,
            outliers,
            classes,
            events: bus.publish_display(keys.event()).await?,
            _description: description,
            progress: bus.publish_progress(keys.progress(Service::Identify), id.to_string()).await?,
            status: bus.publish_display(keys.status(Service::Identify, &id)).await?,
            token: Some(bus.announce(keys.live(Service::Identify, &id)).await?),
            core: Some(core),
            service: Name::new(Service::Identify.as_str())
                .map_err(|source| IdentifyError::Name { structure: structure.name().to_owned(), source })?,
            keys,
            id,
            last_time_ns: None,
            epoch: 0,
        };
        info!(
            structure = service.keys.structure().as_str(),
            parameters = service.parameters.len(),
            noise_levels = service.noise.len(),
            sampling_rate_hz = structure.sampling_rate_hz(),
            "identification ready"
        );
        Ok(service)
    }

    /// Runs until `stop`; blocks that have arrived are still done.
    ///
    /// # Errors
    /// When the bus is closed underneath, or the thread of a filter was lost.
    pub async fn run(mut self, stop: impl Future<Output = ()>) -> Result<(), IdentifyError> {
        tokio::pin!(stop);
        let mut status = tokio::time::interval(STATUS_EVERY);
        let deliveries = self.frames.deliveries().clone();
        loop {
            // Not biased: at full speed frames never stop, and status and stop must still get their turn.
            tokio::select! {
                delivery = deliveries.recv_async() => match delivery {
                    Ok(delivery) => self.take(delivery).await?,
                    Err(flume::RecvError::Disconnected) => break,
                },
                _ = status.tick() => self.put_status().await?,
                () = &mut stop => break,
            }
        }
        // Ingest has stopped before: what it put last may still be on its way through the reader.
        while let Ok(Ok(delivery)) = tokio::time::timeout(LAST_FRAMES, deliveries.recv_async()).await {
            self.take(delivery).await?;
        }
        if let Some(token) = self.token.take() {
            token.withdraw().await?;
        }
        Ok(())
    }

    async fn take(&mut self, delivery: Delivery<FrameBlock>) -> Result<(), IdentifyError> {
        let input = match delivery {
            Delivery::Block(block) => {
                self.epoch = block.header.epoch;
                if block.state == StreamState::Ended {
                    debug!(structure = self.keys.structure().as_str(), "last frames have come");
                }
                Input::Frames(block)
            }
            Delivery::Gap(gap) => Input::Gap { from: gap.from, to: gap.to },
        };
        let Some(mut core) = self.core.take() else {
            return Err(IdentifyError::ThreadLost { structure: self.keys.structure().to_string() });
        };
        let work = self.pool.run(move || {
            let mut outputs = Vec::new();
            core.handle(input, &mut outputs);
            (core, outputs)
        });
        let Some((core, outputs)) = work.await else {
            return Err(IdentifyError::ThreadLost { structure: self.keys.structure().to_string() });
        };
        let done = core.done();
        self.core = Some(core);
        for output in outputs {
            self.put(output).await?;
        }
        self.progress.set(self.epoch, done, self.last_time_ns.unwrap_or(i64::MIN));
        Ok(())
    }

    async fn put(&mut self, output: Output) -> Result<(), IdentifyError> {
        match output {
            Output::Estimates(block) => {
                if let (Some(grid), Some(last)) = (block.grid(), block.estimates.len().checked_sub(1)) {
                    self.last_time_ns = Some(grid.time_ns(block.header.sequence + last as u64));
                }
                self.estimates.put(block).await?;
            }
            Output::Parameter(display) => {
                if let Some(publisher) = self.parameters.get(&display.parameter) {
                    show(publisher, &display).await?;
                }
            }
            Output::Noise(display) => {
                if let Some(publisher) = self.noise.get(&display.name) {
                    show(publisher, &display).await?;
                }
            }
            Output::Outliers(display) => {
                if let Some(publisher) = self.outliers.get(&display.channel) {
                    show(publisher, &display).await?;
                }
            }
            Output::Classes(display) => {
                if let Some(publisher) = &self.classes {
                    show(publisher, &display).await?;
                }
            }
            Output::Responses(_) => {} // for files
            Output::Event(event) => {
                log_event(&event, None);
                self.events.put(&event).await?;
            }
        }
        Ok(())
    }

    async fn put_status(&self) -> Result<(), IdentifyError> {
        #[expect(clippy::disallowed_methods, reason = "the status tells the lag behind the wall clock")]
        let now = SystemTime::now();
        let now_ns = now.duration_since(UNIX_EPOCH).map_or(0, |elapsed| elapsed.as_nanos() as i64);
        let core = self.core.as_ref();
        let status = Status {
            structure: self.keys.structure().clone(),
            service: self.service.clone(),
            id: self.id.clone(),
            time_ns: now_ns,
            lag_s: self.last_time_ns.map(|time_ns| now_ns.saturating_sub(time_ns) as f64 / 1e9),
            done: core.map_or(0, Identification::done),
            drops: self.frames.counts().drops(),
            restarts: core.map_or(0, Identification::restarts),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        Ok(self.status.put(&status).await?)
    }
}

/// Puts a message for people; one that holds no numbers is told of and left out, the service goes on.
async fn show<M: Message>(publisher: &DisplayPublisher<M>, message: &M) -> Result<(), BusError> {
    match publisher.put(message).await {
        Err(error @ BusError::Encode { .. }) => {
            warn!(%error, "not shown");
            Ok(())
        }
        result => result,
    }
}

/// Logs an event: what was mended or lost as a warning, what belongs to normal work as information.
///
/// Its time of measurement is logged in ns since 1970 as on the bus, or in seconds since `start_ns` where a record has one.
pub fn log_event(event: &Event, start_ns: Option<i64>) {
    let (structure, subject) = (event.structure.as_str(), event.subject.as_str());
    let time_s = start_ns.map(|start_ns| event.time_ns.saturating_sub(start_ns) as f64 / 1e9);
    let time_ns = start_ns.is_none().then_some(event.time_ns);
    match event.kind {
        EventKind::Calibration | EventKind::LeadingClass | EventKind::NodeBack | EventKind::ChannelBack => {
            info!(structure, subject, time_s, time_ns, what = event.what, why = event.why, "event");
        }
        EventKind::Restart
        | EventKind::Unidentified
        | EventKind::NodeExcluded
        | EventKind::ChannelExcluded
        | EventKind::Gap => {
            warn!(structure, subject, time_s, time_ns, what = event.what, why = event.why, "event");
        }
    }
}
