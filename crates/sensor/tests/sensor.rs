//! Sensor nodes over real Zenoh sessions on the loopback interface, without multicast.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

use std::convert::Infallible;
use std::future::{pending, ready};
use std::net::TcpListener;
use std::time::Duration;

use spandrel_bus::{
    Block, Bus, BusConfig, Delivery, Keys, Name, SampleBlock, Service, Start, Stream,
    StreamSettings, StreamState,
};
use spandrel_sensor::{
    NodePace, NodePlan, Origin, Row, SensorService, SensorSettings, Speed, WINDOW_FRAMES,
};
use tokio::time::timeout;

/// Limits the duration of a test that hangs.
const DEADLINE: Duration = Duration::from_secs(180);
const STEP: i64 = 5_000_000;
/// Number of rows of one block. An admitted block may extend beyond the end of the window.
const BLOCK: u64 = 256;

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

fn rows(count: u64) -> impl Iterator<Item = Result<Row, Infallible>> {
    (0..count).map(|number| {
        Ok(Row {
            time_ns: number as i64 * STEP,
            values: vec![number as f64],
        })
    })
}

async fn sensor(bus: &Bus, wait_for: Vec<Service>) -> SensorService {
    let node = NodePlan {
        name: name("roof"),
        channels: 1,
        sampling_rate_hz: 200.0,
        pace: NodePace::EveryRow,
        clock_offset_ns: 0,
        clock_drift_ppm: 0.0,
    };
    let settings = SensorSettings {
        origin: Origin::Simulated,
        speed: Speed::Max,
        epoch: 1,
        wait_for,
        resume: false,
    };
    SensorService::start(vec![node], 200.0, bus, keys(), settings)
        .await
        .unwrap()
}

async fn samples(bus: &Bus) -> Stream<SampleBlock> {
    let node = name("roof");
    bus.follow(
        keys().samples(&node),
        keys().buffer(&node),
        StreamSettings::new(Start::Beginning),
    )
    .await
    .unwrap()
}

async fn next(stream: &Stream<SampleBlock>) -> SampleBlock {
    match timeout(DEADLINE, stream.deliveries().recv_async())
        .await
        .expect("no samples")
        .unwrap()
    {
        Delivery::Block(block) => block,
        Delivery::Gap(gap) => panic!("{gap:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_source_stays_within_the_window_ahead_of_identify_and_ends() {
    let (first, second) = pair().await;
    let total = 5 * WINDOW_FRAMES;
    let service = sensor(&first, vec![Service::Identify]).await;
    let running = tokio::spawn(async move { service.run(rows(total), pending()).await });
    let stream = samples(&second).await;
    let progress = second
        .publish_progress(keys().progress(Service::Identify), "identify-1".into())
        .await
        .unwrap();
    let _token = second
        .announce(keys().live(Service::Identify, &name("identify-1")))
        .await
        .unwrap();
    let (mut read, mut done) = (0, 0);
    let mut state = StreamState::Running;
    while state == StreamState::Running {
        let block = next(&stream).await;
        assert_eq!(block.header.sequence, read);
        read = block.end();
        state = block.state;
        assert!(
            read <= done + WINDOW_FRAMES + BLOCK,
            "{read} put, {done} done"
        );
        if read >= done + WINDOW_FRAMES - BLOCK || state == StreamState::Ended {
            done = read;
            progress.set(1, done, (done as i64 - 1) * STEP);
        }
    }
    assert_eq!(read, total);
    timeout(DEADLINE, running)
        .await
        .expect("the source does not end")
        .unwrap()
        .unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_source_that_is_stopped_ends_its_nodes() {
    let (first, second) = pair().await;
    let service = sensor(&first, vec![Service::Identify]).await;
    let stream = samples(&second).await;
    let _token = second
        .announce(keys().live(Service::Identify, &name("identify-1")))
        .await
        .unwrap();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let running = tokio::spawn(async move {
        let stop = async { drop(stopped.await) };
        service.run(rows(u64::MAX), stop).await
    });
    assert_eq!(next(&stream).await.header.sequence, 0);
    stop.send(()).unwrap();
    while next(&stream).await.state == StreamState::Running {}
    timeout(DEADLINE, running)
        .await
        .expect("the source does not end")
        .unwrap()
        .unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_waiting_source_stops_at_once() {
    let (first, _second) = pair().await;
    let service = sensor(&first, vec![Service::Identify]).await;
    let running = service.run(rows(10), ready(()));
    timeout(DEADLINE, running)
        .await
        .expect("the source does not end")
        .unwrap();
}
