use super::*;
use crate::memory::identity;
use spandrel_bus::{Block, BusConfig, EstimateBlock, Header, Keep, NumberedStream};
use spandrel_checkpoint::{Checkpoints, Remembering};
use spandrel_service::Service as _;
use std::num::NonZeroUsize;
use std::path::Path;
use std::time::Duration;

/// Unlike the numbers of a stream from its start.
const FIRST: u64 = 1_000_000;
const POISON: u64 = FIRST + 333;
const FRAMES: u64 = 600;
const BLOCK: u64 = 40;

fn structure() -> Structure {
    Structure::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"))
        .unwrap()
}

fn blocks() -> Vec<FrameBlock> {
    let structure = structure();
    let rows: Vec<Vec<f64>> = structure
        .simulator(5)
        .take(FRAMES as usize)
        .map(|frame| frame.values)
        .collect();
    let block = |(number, rows): (u64, &[Vec<f64>])| {
        let sequence = FIRST + number * BLOCK;
        FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch: 7,
                sequence,
                time_ns: sequence as i64 * 10_000_000,
            },
            t0_ns: 0,
            sampling_rate_hz: 100.0,
            channels: structure.channel_count() as u16,
            values: rows.concat(),
            state: if (number + 1) * BLOCK >= FRAMES {
                StreamState::Ended
            } else {
                StreamState::Running
            },
        }
    };
    (0..).zip(rows.chunks(BLOCK as usize)).map(block).collect()
}

/// Returns the estimates of a run that never receives the poisoned frame.
fn without_the_frame() -> Vec<String> {
    let mut core = Identification::new(&structure(), "identify").unwrap();
    let mut outputs = Vec::new();
    for block in blocks() {
        let (mut before, mut after) = (block.clone(), block.clone());
        before.truncate(
            POISON
                .saturating_sub(block.header.sequence)
                .min(block.count()),
        );
        after.skip(
            (POISON + 1)
                .saturating_sub(block.header.sequence)
                .min(block.count()),
        );
        let holds_it = (block.header.sequence..block.end()).contains(&POISON);
        match holds_it {
            false => core.handle(IdentificationInput::Frames(block), &mut outputs),
            true => {
                core.handle(IdentificationInput::Frames(before), &mut outputs);
                core.handle(IdentificationInput::gap(POISON, POISON + 1), &mut outputs);
                core.handle(IdentificationInput::Frames(after), &mut outputs);
            }
        }
    }
    let estimates = outputs.into_iter().filter_map(|output| match output {
        Output::Estimates(block) => Some(block.estimates),
        _ => None,
    });
    estimates
        .flatten()
        .map(|estimate| format!("{estimate:?}"))
        .collect()
}

/// Waits for a checkpoint behind the first frame.
async fn wait_for_a_checkpoint(remembering: &Remembering) {
    let checkpoints = Checkpoints::open(&remembering.folder, identity(&structure())).unwrap();
    let saved = async {
        while checkpoints
            .positions()
            .unwrap()
            .last()
            .is_none_or(|position| position.sequence <= FIRST)
        {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), saved)
        .await
        .expect("a checkpoint");
}

/// What a subscriber receives from a service that panics on one of its frames.
struct Received {
    estimates: Vec<(u64, String)>,
    restarts: u64,
    /// The frame from which the identification resumed after its first panic.
    resumed_from: u64,
}

/// Runs the service on frames, one of which causes a panic.
async fn run_with_a_frame_that_panics(remembering: Option<Remembering>) -> Received {
    let config = BusConfig {
        root: "poison".into(),
        listen: vec!["tcp/127.0.0.1:0".into()],
        ..BusConfig::default()
    };
    let bus = Bus::open(&config).await.unwrap();
    let keys = config.keys("demo").unwrap();
    let stream = NumberedStream {
        key: keys.frames(),
        buffer_key: keys.recording(),
        source: "ingest".into(),
        epoch: 7,
        first: FIRST,
        state: StreamState::Running,
        keep: Keep::last(10_000),
    };
    let frames = bus.publish_numbered::<FrameBlock>(stream).await.unwrap();
    let pool = FilterPool::start(NonZeroUsize::MIN).unwrap();
    let id = Name::new("identify").unwrap();
    let plan = IdentifyPlan {
        instance: ServiceInstance::new(&bus, id),
        monitored: Monitored {
            remembering: remembering.clone(),
            ..Monitored::new(&structure(), keys.clone())
        },
        pool,
        precedence: Precedence::Leads,
        sensors: Vec::new(),
    };
    let mut service = IdentifyService::start(&plan).await.unwrap();
    service.process = |core, input, outputs| {
        if let IdentificationInput::Frames(block) = &input {
            let numbers = block.header.sequence..block.end();
            assert!(!numbers.contains(&POISON), "frame {POISON} is poisoned");
        }
        core.handle_part(input, outputs)
    };
    let estimates = bus
        .follow::<EstimateBlock>(
            keys.estimates(),
            keys.estimates_buffer(),
            bus.reading(Start::Beginning),
        )
        .await
        .unwrap();
    let events = bus.subscribe::<Event>(keys.event(), 64).await.unwrap();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let running = tokio::spawn(service.run(Box::pin(async move { drop(stopped.await) })));
    for block in blocks() {
        if let Some(remembering) = &remembering
            && (block.header.sequence..block.end()).contains(&POISON)
        {
            wait_for_a_checkpoint(remembering).await;
        }
        frames.put(block).await.unwrap();
    }
    let mut found = Vec::new();
    loop {
        let delivery =
            tokio::time::timeout(Duration::from_secs(30), estimates.deliveries().recv_async())
                .await;
        let Delivery::Block(block) = delivery.unwrap().unwrap() else {
            continue;
        };
        found.extend(
            block
                .iter()
                .map(|(number, estimate)| (number, format!("{estimate:?}"))),
        );
        if block.state == StreamState::Ended {
            break;
        }
    }
    let status = bus
        .subscribe::<Status>(
            keys.status(Service::Identify, &Name::new("identify").unwrap()),
            8,
        )
        .await
        .unwrap();
    let (_, status) = tokio::time::timeout(Duration::from_secs(10), status.messages().recv_async())
        .await
        .unwrap()
        .unwrap();
    drop(stop);
    running.await.unwrap().unwrap();
    assert_eq!(
        status.drops.get("frames-set-aside"),
        Some(&1),
        "{:?}",
        status.drops
    );
    let resumed_from = |(_, event): (_, Event)| {
        let frame = event
            .what
            .strip_prefix("identification resumes from frame ")?;
        Some(frame.parse().unwrap())
    };
    let resumed: Vec<u64> = events.messages().drain().filter_map(resumed_from).collect();
    let [resumed_from] = resumed[..] else {
        panic!("one event for the first panic, found {resumed:?}");
    };
    Received {
        estimates: found,
        restarts: status.restarts,
        resumed_from,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frame_that_causes_two_panics_is_set_aside_and_nothing_else_changes() {
    let folder = tempfile::tempdir().unwrap();
    let remembering = Remembering {
        folder: folder.path().to_owned(),
        every: Duration::ZERO,
    };
    for remembering in [Some(remembering), None] {
        let has_checkpoints = remembering.is_some();
        let received = run_with_a_frame_that_panics(remembering).await;
        assert_eq!(received.restarts, 2);
        assert_eq!(
            (FIRST + 1..=POISON).contains(&received.resumed_from),
            has_checkpoints,
            "resumed from frame {}, checkpoints: {has_checkpoints}",
            received.resumed_from
        );
        let numbers: Vec<u64> = received
            .estimates
            .iter()
            .map(|(number, _)| *number)
            .collect();
        assert_eq!(numbers, (FIRST..FIRST + FRAMES).collect::<Vec<_>>());
        let expected = without_the_frame();
        let differs = received
            .estimates
            .iter()
            .zip(&expected)
            .position(|((_, found), expected)| found != expected);
        assert_eq!(differs, None, "first estimate that differs");
    }
}
