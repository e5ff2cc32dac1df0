//! Ingest over real Zenoh sessions on the loopback interface, without multicast.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

use std::future::pending;
use std::net::TcpListener;
use std::time::Duration;

use spandrel_bus::{
    Block, Bus, BusConfig, Delivery, Event, EventKind, FrameBlock, Header, Keep, Keys, Message,
    Name, NumberedPublisher, NumberedStream, Pace, SampleBlock, Service, Start, Status, Stream,
    StreamSettings, StreamState,
};
use spandrel_ingest::{FrameWait, IngestService, IngestSettings, Layout, NodeLayout};
use spandrel_service::{Clock, Service as _, ServiceInstance};
use tokio::time::timeout;
use zenoh::qos::CongestionControl;

/// Limits the duration of a test that hangs.
const DEADLINE: Duration = Duration::from_secs(180);
const STEP: i64 = 5_000_000;

async fn pair() -> (Bus, Bus) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", listener.local_addr().unwrap());
    drop(listener);
    let listen = BusConfig {
        listen: vec![endpoint.clone()],
        ..BusConfig::default()
    };
    let connect = BusConfig {
        connect: vec![endpoint],
        ..BusConfig::default()
    };
    (
        Bus::open(&listen).await.unwrap(),
        Bus::open(&connect).await.unwrap(),
    )
}

fn keys() -> Keys {
    Keys::parse("test", "tower").unwrap()
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

async fn start_ingest(bus: &Bus, waiting: FrameWait) -> tokio::task::JoinHandle<()> {
    start_ingest_of(bus, &["base", "roof"], waiting).await
}

async fn start_ingest_of(
    bus: &Bus,
    nodes: &[&str],
    waiting: FrameWait,
) -> tokio::task::JoinHandle<()> {
    let channels = nodes.iter().map(|node| format!("{node}-x")).collect();
    let nodes = nodes.iter().map(|node| NodeLayout {
        name: name(node),
        ranges: vec![1e9],
    });
    let layout = Layout::new(nodes.collect(), 200.0, 0.0025).unwrap();
    let instance = ServiceInstance {
        clock: Clock::fixed(1),
        ..ServiceInstance::new(bus, name("ingest-1"))
    };
    let settings = IngestSettings {
        waiting,
        nodes_publish_waveforms: false,
        recording: None,
    };
    let service = IngestService::start_with(layout, channels, &instance, keys(), settings)
        .await
        .unwrap();
    tokio::spawn(async move { service.run(Box::pin(pending())).await.unwrap() })
}

async fn node(bus: &Bus, text: &str) -> NumberedPublisher<SampleBlock> {
    let stream = NumberedStream {
        key: keys().samples(&name(text)),
        buffer_key: keys().buffer(&name(text)),
        source: text.into(),
        epoch: 1,
        first: 0,
        state: StreamState::Running,
        keep: Keep::last(100_000),
    };
    bus.publish_numbered(stream).await.unwrap()
}

/// Returns samples `from..to`. The value of a sample is its number.
fn samples(node: &str, epoch: u64, from: u64, to: u64) -> SampleBlock {
    SampleBlock {
        header: Header {
            source: node.into(),
            epoch,
            sequence: from,
            time_ns: from as i64 * STEP,
        },
        sampling_rate_hz: 200.0,
        pace: Pace::Live,
        channels: 1,
        samples: (from..to).map(|v| v as f64).collect(),
        state: StreamState::Running,
        clock_quality: None,
    }
}

async fn frames(bus: &Bus) -> Stream<FrameBlock> {
    bus.follow(
        keys().frames(),
        keys().recording(),
        StreamSettings::new(Start::Beginning),
    )
    .await
    .unwrap()
}

async fn next(stream: &Stream<FrameBlock>) -> FrameBlock {
    match timeout(DEADLINE, stream.deliveries().recv_async())
        .await
        .expect("no frames")
        .unwrap()
    {
        Delivery::Block(block) => block,
        Delivery::Gap(gap) => panic!("{gap:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn all_samples_become_frames_if_one_node_is_far_ahead() {
    let (first, second) = pair().await;
    let ingest = start_ingest(&second, FrameWait::Unlimited).await;
    let (base, roof) = (node(&first, "base").await, node(&first, "roof").await);
    let stream = frames(&first).await;
    for (publisher, node, size) in [(base, "base", 10), (roof, "roof", 16)] {
        for block in 0..20_000 / size {
            publisher
                .put(samples(node, 1, block * size, (block + 1) * size))
                .await
                .unwrap();
        }
        if node == "base" {
            // The publisher must stay alive, because samples can be fetched only from a running
            // node.
            std::mem::forget(publisher);
            continue;
        }
        let mut done = 0;
        while done < 20_000 {
            let block = next(&stream).await;
            assert_eq!(block.header.sequence, done);
            for (number, frame) in block.iter() {
                assert_eq!(frame, [number as f64, number as f64]);
            }
            done = block.end();
        }
    }
    ingest.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn ingest_does_not_wait_for_a_node_without_token() {
    let (first, second) = pair().await;
    let ingest = start_ingest(&second, FrameWait::Unlimited).await;
    let (base, roof) = (node(&first, "base").await, node(&first, "roof").await);
    let token = first
        .announce(keys().live(Service::Sensor, &name("roof")))
        .await
        .unwrap();
    let stream = frames(&first).await;
    roof.put(samples("roof", 1, 0, 1)).await.unwrap();
    base.put(samples("base", 1, 0, 3)).await.unwrap();
    assert_eq!(next(&stream).await.values, [0.0, 0.0]);
    token.withdraw().await.unwrap();
    let alone = next(&stream).await;
    assert_eq!(alone.header.sequence, 1);
    assert!(alone.values[0] == 1.0 && alone.values[1].is_nan());
    ingest.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn ingest_waits_for_a_silent_node_only_for_the_lateness() {
    let (first, second) = pair().await;
    let ingest = start_ingest(&second, FrameWait::Limited(Duration::from_millis(200))).await;
    let base = node(&first, "base").await;
    let stream = frames(&first).await;
    base.put(samples("base", 1, 0, 3)).await.unwrap();
    let block = next(&stream).await;
    assert!(block.values[0] == 0.0 && block.values[1].is_nan());
    ingest.abort();
}

// A query to a source without a buffer must not hold back the blocks behind the gap for longer than
// frames wait.
#[tokio::test(flavor = "multi_thread")]
async fn a_lost_block_of_a_node_without_buffer_affects_only_its_own_frames() {
    const BLOCKS: u64 = 100;
    const LOST: u64 = 40;
    let (first, second) = pair().await;
    // Two nodes determine the lateness. The third one is late.
    let nodes = ["base", "middle", "roof"];
    let ingest = start_ingest_of(&second, &nodes, FrameWait::Limited(Duration::from_secs(4))).await;
    let (base, middle) = (node(&first, "base").await, node(&first, "middle").await);
    let stream = frames(&first).await;
    let mut ready = first
        .watch_live(keys().all_live(Service::Ingest))
        .await
        .unwrap();
    timeout(DEADLINE, ready.some()).await.expect("no ingest");
    for block in 0..BLOCKS {
        let (from, to) = (block * 10, (block + 1) * 10);
        base.put(samples("base", 1, from, to)).await.unwrap();
        middle.put(samples("middle", 1, from, to)).await.unwrap();
        if block != LOST {
            let by_hand = samples("roof", 1, from, to).encode().unwrap();
            let put = first.session().put(keys().samples(&name("roof")), by_hand);
            put.encoding(SampleBlock::encoding())
                .congestion_control(CongestionControl::Block)
                .await
                .unwrap();
        }
    }
    let (mut done, mut without) = (0, Vec::new());
    while done < 10 * BLOCKS {
        let block = next(&stream).await;
        without.extend(
            block
                .iter()
                .filter(|(_, frame)| frame[2].is_nan())
                .map(|(number, _)| number),
        );
        done = block.end();
    }
    assert_eq!(without.len(), 10, "frames without a sample of the node");
    assert_eq!(
        (without[0], without[9]),
        (10 * LOST, 10 * LOST + 9),
        "first and last of them"
    );
    ingest.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_status_counts_rejected_messages() {
    let (first, second) = pair().await;
    let ingest = start_ingest(&second, FrameWait::Unlimited).await;
    let statuses = first
        .subscribe::<Status>(keys().all_statuses(), 16)
        .await
        .unwrap();
    let base = node(&first, "base").await;
    let mut wrong = samples("base", 1, 0, 4);
    wrong.channels = 2;
    base.put(wrong).await.unwrap();
    let counted = async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.drops.get("wrong-channels") == Some(&1) {
                return;
            }
        }
    };
    timeout(DEADLINE, counted).await.unwrap();
    ingest.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn stated_quality_of_a_clock_is_in_the_status_and_a_low_one_is_an_event() {
    let (first, second) = pair().await;
    let ingest = start_ingest(&second, FrameWait::Unlimited).await;
    let statuses = first
        .subscribe::<Status>(keys().all_statuses(), 16)
        .await
        .unwrap();
    let events = first.subscribe::<Event>(keys().event(), 16).await.unwrap();
    let base = node(&first, "base").await;
    // The first blocks may be queried, and then state no quality.
    let stated = async {
        for number in 0.. {
            let block = SampleBlock {
                clock_quality: Some(35),
                ..samples("base", 1, 4 * number, 4 * number + 4)
            };
            base.put(block).await.unwrap();
            let next = events.messages().recv_async();
            if let Ok(event) = timeout(Duration::from_millis(100), next).await {
                return event.unwrap().1;
            }
        }
        unreachable!("the numbers do not end");
    };
    let event = timeout(DEADLINE, stated).await.unwrap();
    assert_eq!(
        (event.kind, event.subject.as_str()),
        (EventKind::ClockDoubtful, "base")
    );
    assert!(event.what.contains("35 %"), "{event:?}");
    let shown = async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if let Some(clock) = status.clocks.get(&name("base")) {
                return clock.quality_percent;
            }
        }
    };
    assert_eq!(timeout(DEADLINE, shown).await.unwrap(), Some(35));
    ingest.abort();
}
