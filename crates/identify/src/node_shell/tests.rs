use super::*;
use spandrel_bus::{
    BusConfig, Header, Keep, Keys, NumberedPublisher, NumberedStream, Status, StreamState,
};
use spandrel_service::Service as _;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

/// Unlike the numbers of a stream from its start.
const FIRST: u64 = 1_000_000;
const BLOCK: u64 = 50;
/// Value of a sample that makes the worker panic.
const POISON: f64 = 4096.0;
/// A sensor measures continuously, and a worker that starts meanwhile detects which samples belong
/// to its own run.
const BLOCK_EVERY: Duration = Duration::from_millis(20);

struct Lives {
    structure: Structure,
    bus: Bus,
    keys: Keys,
    remembering: Remembering,
    samples: NumberedPublisher<SampleBlock>,
    put: u64,
    pace: Pace,
    /// Number of the poisoned sample.
    poisoned: Option<u64>,
    _folder: tempfile::TempDir,
}

impl Lives {
    async fn new() -> Self {
        let file =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo-distributed.toml");
        let structure = Structure::read(&file).unwrap();
        let config = BusConfig {
            root: "lives".into(),
            listen: vec!["tcp/127.0.0.1:0".into()],
            ..BusConfig::default()
        };
        let bus = Bus::open(&config).await.unwrap();
        let keys = config.keys(structure.name()).unwrap();
        let node = Name::new(structure.nodes()[0].name()).unwrap();
        let stream = NumberedStream {
            key: keys.samples(&node),
            buffer_key: keys.buffer(&node),
            source: node.to_string(),
            epoch: 7,
            first: FIRST,
            state: StreamState::Running,
            keep: Keep::last(10_000),
        };
        let samples = bus.publish_numbered(stream).await.unwrap();
        let folder = tempfile::tempdir().unwrap();
        let remembering = Remembering {
            folder: folder.path().to_owned(),
            every: Duration::ZERO,
        };
        Self {
            structure,
            bus,
            keys,
            remembering,
            samples,
            put: FIRST,
            pace: Pace::Live,
            poisoned: None,
            _folder: folder,
        }
    }

    async fn begin(&self, epoch: i64, set_aside: &SetAside) -> NodeService {
        let pool = FilterPool::start(NonZeroUsize::MIN).unwrap();
        let plan = NodeServicePlan {
            bus: self.bus.clone(),
            clock: Clock::fixed(epoch),
            monitored: Monitored {
                remembering: Some(self.remembering.clone()),
                ..Monitored::new(&self.structure, self.keys.clone())
            },
            position: 0,
            pool,
            set_aside: set_aside.clone(),
        };
        let mut service = NodeService::start(&plan).await.unwrap();
        service.process = |core, input, outputs| {
            if let NodeInput::Samples(block) | NodeInput::Past(block) = &input {
                assert!(!block.samples.contains(&POISON), "a sample is poisoned");
            }
            core.handle(input, outputs);
        };
        service
    }

    /// Publishes blocks until an event has arrived.
    async fn measure_until<T>(&mut self, what: &str, event: impl Future<Output = T>) -> T {
        let mut clock = tokio::time::interval(BLOCK_EVERY);
        let measured = async {
            tokio::pin!(event);
            loop {
                tokio::select! {
                    found = &mut event => return found,
                    _ = clock.tick() => self.put().await,
                }
            }
        };
        within(what, measured).await
    }

    /// Publishes a block of a slow oscillation.
    async fn put(&mut self) {
        let node = &self.structure.nodes()[0];
        let rate_hz = self
            .structure
            .of_node(node.name())
            .unwrap()
            .sampling_rate_hz();
        let numbers = self.put..self.put + BLOCK;
        let value = |number: u64| match self.poisoned == Some(number) {
            true => POISON,
            false => 0.001 * (number as f64 * 0.06).sin(),
        };
        let block = SampleBlock {
            header: Header {
                source: node.name().to_owned(),
                epoch: 7,
                sequence: self.put,
                time_ns: (self.put as f64 * 1e9 / rate_hz) as i64,
            },
            sampling_rate_hz: rate_hz,
            pace: self.pace,
            channels: node.channels().len() as u16,
            samples: numbers
                .flat_map(|number| vec![value(number); node.channels().len()])
                .collect(),
            state: StreamState::Running,
            clock_quality: None,
        };
        self.put += BLOCK;
        self.samples.put(block).await.unwrap();
    }
}

async fn within<T>(what: &str, event: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(60), event)
        .await
        .unwrap_or_else(|_| panic!("waited in vain: {what}"))
}

/// Waits for an estimate from this run of the worker.
async fn estimate_of(local: &Subscription<LocalMessage>, epoch: u64) {
    loop {
        let (_, message) = local.messages().recv_async().await.unwrap();
        if message.header.epoch == epoch && message.density.is_some() {
            return;
        }
    }
}

/// Waits for a checkpoint in this folder.
async fn kept_in(folder: PathBuf) {
    let is_kept = || {
        std::fs::read_dir(&folder).is_ok_and(|mut entries| {
            entries.any(|entry| {
                entry
                    .unwrap()
                    .path()
                    .extension()
                    .is_some_and(|extension| extension == "checkpoint")
            })
        })
    };
    while !is_kept() {
        tokio::time::sleep(BLOCK_EVERY).await;
    }
}

fn is_lost(ended: &Result<(), IdentifyError>) -> bool {
    matches!(ended, Err(IdentifyError::ThreadLost { .. }))
}

/// Regression: the panic terminated the process, and each restart received the same samples again.
#[tokio::test(flavor = "multi_thread")]
async fn samples_that_cause_a_panic_are_set_aside_after_restarts() {
    let mut lives = Lives::new().await;
    let node = Name::new(lives.structure.nodes()[0].name()).unwrap();
    let local = lives
        .bus
        .subscribe::<LocalMessage>(lives.keys.local(&node), 1024)
        .await
        .unwrap();
    let statuses = lives
        .bus
        .subscribe::<Status>(lives.keys.status(Service::Identify, &node), 1024)
        .await
        .unwrap();
    let events = lives
        .bus
        .subscribe::<Event>(lives.keys.event(), 1024)
        .await
        .unwrap();
    let set_aside = SetAside::default();

    let first = tokio::spawn(
        lives
            .begin(1, &set_aside)
            .await
            .run(Box::pin(std::future::pending())),
    );
    lives
        .measure_until("an estimate of the first life", estimate_of(&local, 1))
        .await;
    lives
        .measure_until(
            "a checkpoint",
            kept_in(lives.remembering.folder.join("nodes").join(node.as_str())),
        )
        .await;
    let poisoned = lives.put;
    lives.poisoned = Some(poisoned + 20);
    let ended = lives
        .measure_until("the end of the first life", first)
        .await
        .unwrap();
    assert!(is_lost(&ended), "{ended:?}");
    let expected = format!(
        "samples {poisoned} to {} are skipped and count as missing",
        poisoned + BLOCK - 1
    );
    let told = async { while events.messages().recv_async().await.unwrap().1.what != expected {} };
    within(&expected, told).await;

    // The same samples arrive again and cause a panic in a worker that does not exclude them.
    let ignorant = tokio::spawn(
        lives
            .begin(2, &SetAside::default())
            .await
            .run(Box::pin(std::future::pending())),
    );
    let ended = lives
        .measure_until("the end of the second life", ignorant)
        .await
        .unwrap();
    assert!(is_lost(&ended), "{ended:?}");

    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let third = tokio::spawn(
        lives
            .begin(3, &set_aside)
            .await
            .run(Box::pin(async move { drop(stopped.await) })),
    );
    lives
        .measure_until("an estimate of the third life", estimate_of(&local, 3))
        .await;
    let status = async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.drops.contains_key("samples-set-aside") {
                return status;
            }
        }
    };
    let status = within("a status of the third life", status).await;
    assert_eq!(status.drops["samples-set-aside"], BLOCK, "{status:?}");
    drop(stop);
    within("the end of the third life", third)
        .await
        .unwrap()
        .unwrap();
}

/// Regression: each status began the wait anew, so that replayed samples waited forever for a
/// station that has crashed.
#[tokio::test(flavor = "multi_thread")]
async fn replayed_samples_continue_without_the_reply_of_a_station() {
    let mut lives = Lives::new().await;
    lives.pace = Pace::Replayed;
    let node = Name::new(lives.structure.nodes()[0].name()).unwrap();
    let local = lives
        .bus
        .subscribe::<LocalMessage>(lives.keys.local(&node), 1024)
        .await
        .unwrap();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let run = tokio::spawn(
        lives
            .begin(1, &SetAside::default())
            .await
            .run(Box::pin(async move { drop(stopped.await) })),
    );
    lives
        .measure_until("an estimate", estimate_of(&local, 1))
        .await;
    lives
        .measure_until(
            "an estimate after the one without a reply",
            estimate_of(&local, 1),
        )
        .await;
    drop(stop);
    within("the end of the worker", run).await.unwrap().unwrap();
}
