//! A stalled reader does not delay the other processes, and is informed of every loss.

use crate::support::{
    Drops, EstimateReader, Process, Site, assert_same_bits, five_storeys, free_endpoint, spandrel,
    storeys, within,
};
use spandrel_alert::{AlertPlan, AlertService};
use spandrel_bus::{
    Bus, BusConfig, Delivery, EstimateBlock, FrameBlock, Keys, Name, Service, Start, Stream,
    StreamSettings, StreamState,
};
use spandrel_identify::{FilterPool, IdentifyPlan, IdentifyService, Precedence};
use spandrel_ingest::{IngestPlan, IngestService};
use spandrel_sensor::{
    Clocks, NodePlan, Origin, SensorService, SensorSettings, Speed, simulated_rows,
};
use spandrel_service::{Monitored, Service as _, ServiceInstance};
use std::convert::Infallible;
use std::future::pending;
use std::io::BufRead;
use std::num::NonZeroUsize;
use std::process::Command;
use std::sync::Once;
use std::time::Duration;

/// Minimum duration of the stall. Zenoh closes a blocked link after 5 s, which is shorter.
const STALL: Duration = Duration::from_secs(8);
/// Environment variable of the stalled reader: the endpoint, the structure, and the number of
/// frames.
const STALLED_READER: &str = "STALLED_READER";

/// Reads all frames. Returns their number if none is missing.
async fn read_frames_to_end(stream: &Stream<FrameBlock>) -> u64 {
    let mut next = 0;
    loop {
        match within("frames", stream.deliveries().recv_async())
            .await
            .unwrap()
        {
            Delivery::Gap(gap) => panic!("frames lost: {gap:?}"),
            Delivery::Block(block) => {
                assert_eq!(block.header.sequence, next, "number of the next frame");
                next += block.iter().count() as u64;
                if block.state == StreamState::Ended {
                    return next;
                }
            }
        }
    }
}

async fn follow_frames(bus: &Bus, keys: &Keys, settings: StreamSettings) -> Stream<FrameBlock> {
    bus.follow(keys.frames(), keys.recording(), settings)
        .await
        .unwrap()
}

/// Runs as a separate process of the test below. Its link stalls from the first estimates on.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "is started by the test below"]
async fn stalled_reader() {
    static FIRST: Once = Once::new();
    let Ok(told) = std::env::var(STALLED_READER) else {
        return; // a run of all ignored tests
    };
    let [endpoint, root, structure, output] = told.split(' ').collect::<Vec<_>>()[..] else {
        panic!("{STALLED_READER} is {told}");
    };
    let config = BusConfig {
        root: root.to_owned(),
        connect: vec![endpoint.to_owned()],
        ..BusConfig::default()
    };
    let (bus, keys) = (
        Bus::open(&config).await.unwrap(),
        Keys::parse(root, structure).unwrap(),
    );
    let stall = |_| {
        FIRST.call_once(|| {
            eprintln!("stalled");
            std::thread::sleep(STALL); // the fault under test
            std::io::stdin()
                .lock()
                .read_line(&mut String::new())
                .unwrap();
            eprintln!("awake");
        });
    };
    let _frames = bus
        .session()
        .declare_subscriber(keys.frames())
        .callback(|_| {})
        .await
        .unwrap();
    let _estimates = bus
        .session()
        .declare_subscriber(keys.estimates())
        .callback(stall)
        .await
        .unwrap();
    let frames = follow_frames(&bus, &keys, StreamSettings::new(Start::Beginning)).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    eprintln!("joined");
    let estimates = reader.read_to_end(1).await;
    let lines = estimates.iter().map(crate::support::Identified::to_line);
    std::fs::write(output, lines.collect::<String>()).unwrap();
    let counts = (read_frames_to_end(&frames).await, estimates.len());
    eprintln!("read {} frames and {} estimates", counts.0, counts.1);
    assert!(
        reader.fetched() > 0,
        "nothing was dropped on the way: this was no stall"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stalled_reader_delays_no_other_reader_and_recovers_everything() {
    // Less than the services store, and far more than the buffers of a link hold.
    let site = Site::with(&storeys(10, ""));
    let record = site.simulate(240.0);
    let expected = site.estimate(&record);
    let _services = site.run();
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &keys).await;

    let output = site.folder().join("stalled.txt");
    let told = [
        site.endpoint(),
        keys.root().as_str(),
        keys.structure().as_str(),
        output.to_str().unwrap(),
    ]
    .join(" ");
    let mut command = Command::new(std::env::current_exe().unwrap());
    command
        .args([
            "stall::stalled_reader",
            "--exact",
            "--ignored",
            "--nocapture",
        ])
        .env(STALLED_READER, told);
    let mut stalled = Process::start_with_input(&mut command);
    stalled.wait_for_log("joined");

    let frames = follow_frames(&bus, &keys, StreamSettings::new(Start::Beginning)).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let replay = site.replay(&record, "max");
    stalled.wait_for_log("stalled");
    assert_same_bits(
        "reader beside a stalled one",
        &expected.parameters,
        &expected.frames,
        reader.read_to_end(1).await,
    );
    assert_eq!(
        read_frames_to_end(&frames).await,
        record.len() as u64,
        "frames of the reader beside a stalled one"
    );
    replay.wait().expect_code(0);
    assert!(
        !stalled.log().contains("awake"),
        "all of this has happened while the reader was stalled"
    );

    stalled.write_line();
    let finished = stalled.wait().expect_code(0);
    let count = record.len();
    finished.expect_told(&[&format!("read {count} frames and {count} estimates")]);
    let recovered: Vec<_> = std::fs::read_to_string(output)
        .unwrap()
        .lines()
        .map(crate::support::Identified::from_line)
        .collect();
    assert_same_bits(
        "stalled reader",
        &expected.parameters,
        &expected.frames,
        &recovered,
    );
    for service in [Service::Ingest, Service::Identify, Service::Alert] {
        let lost = drops
            .when_done(service, 1)
            .await
            .drops
            .get("lost-items")
            .copied();
        assert_eq!(lost, None, "frames lost on the way to {}", service.as_str());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_is_too_late_for_the_ring_receives_a_gap() {
    let site = Site::with(&crate::support::two_storeys(""));
    let record = site.simulate(400.0);
    let expected = site.estimate(&record);
    let _services = site.run();
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    site.replay(&record, "max").wait().expect_code(0);
    let stream: Stream<EstimateBlock> = bus
        .follow(
            keys.estimates(),
            keys.estimates_buffer(),
            StreamSettings::new(Start::Beginning),
        )
        .await
        .unwrap();
    let Delivery::Gap(gap) = within("gap", stream.deliveries().recv_async())
        .await
        .unwrap()
    else {
        panic!(
            "expected a gap first: {} estimates are more than is kept",
            record.len()
        );
    };
    let kept = record.len() - gap.to as usize;
    // `alert` has decided on all frames and stored the decisions. It keeps at least the last 1,024,
    // and up to 32,768 of the last 15 s.
    let is_kept = (1_024..32_768 + 4_096).contains(&kept);
    assert!(
        gap.from == 0 && is_kept,
        "expected a gap from 0 that leaves what is kept, found {gap:?}"
    );
    let mut found = Vec::new();
    while found.len() < kept {
        match within("kept estimates", stream.deliveries().recv_async())
            .await
            .unwrap()
        {
            Delivery::Block(block) => found.extend(crate::support::identified(&block)),
            Delivery::Gap(gap) => panic!("expected one gap, found another: {gap:?}"),
        }
    }
    assert_same_bits(
        "late reader",
        &expected.parameters,
        &expected.frames[gap.to as usize..],
        &found,
    );
}

#[test]
fn the_demo_loses_no_frame_of_ten_minutes_at_full_speed() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(600.0);
    let expected = site.estimate(&record).summary;
    let mut demo = spandrel("demo");
    demo.args([
        "--speed",
        "max",
        "--duration",
        "600",
        "--headless",
        "--json",
        "--listen",
        "tcp/127.0.0.1:0",
    ]);
    let finished = Process::start(&mut demo).wait().expect_code(0);
    let found: serde_json::Value =
        serde_json::from_str(finished.stdout.lines().last().unwrap()).unwrap();
    assert_eq!(found["frames"], 60_000);
    for part in ["frames", "parameters", "noise"] {
        assert_eq!(
            found[part], expected[part],
            "{part} of demo --json against estimate --json"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn services_and_readers_with_tiny_queues_in_one_session_lose_nothing() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(120.0);
    let expected = site.estimate(&record);
    let config = BusConfig {
        listen: vec![free_endpoint()],
        queue: NonZeroUsize::MIN,
        ..BusConfig::default()
    };
    let (bus, keys, structure) = (
        Bus::open(&config).await.unwrap(),
        site.keys(),
        site.structure(),
    );
    let tiny = bus.reading(Start::Beginning);
    assert_eq!((tiny.queue, tiny.deliveries), (1, 1));
    let frames = follow_frames(&bus, &keys, tiny.clone()).await;
    let mut reader = EstimateReader::with_settings(&bus, &keys, tiny).await;
    let drops = Drops::watch(&bus, &keys).await;

    let id = |text: &str| Name::new(text).unwrap();
    let monitored = Monitored::new(structure, keys.clone());
    let pool = FilterPool::start(NonZeroUsize::MIN).unwrap();
    let plan = AlertPlan {
        instance: ServiceInstance::new(&bus, id("alert")),
        monitored: monitored.clone(),
        baseline: None,
    };
    let alert = AlertService::start(&plan).await.unwrap();
    let plan = IdentifyPlan {
        instance: ServiceInstance::new(&bus, id("identify")),
        monitored: monitored.clone(),
        pool,
        precedence: Precedence::Leads,
        sensors: Vec::new(),
    };
    let identify = IdentifyService::start(&plan).await.unwrap();
    let plan = IngestPlan {
        instance: ServiceInstance::new(&bus, id("ingest")),
        monitored,
        recording: None,
    };
    let ingest = IngestService::start(&plan).await.unwrap();
    let services = [
        tokio::spawn(async { alert.run(Box::pin(pending())).await.unwrap() }),
        tokio::spawn(async { identify.run(Box::pin(pending())).await.unwrap() }),
        tokio::spawn(async { ingest.run(Box::pin(pending())).await.unwrap() }),
    ];
    let wait_for = vec![Service::Ingest, Service::Identify, Service::Alert];
    let settings = SensorSettings {
        origin: Origin::Simulated,
        speed: Speed::Max,
        epoch: 1,
        wait_for,
        resume: false,
    };
    let plans = NodePlan::of(structure, Clocks::Right).unwrap();
    let sensors = SensorService::start(plans, structure.sampling_rate_hz(), &bus, keys, settings)
        .await
        .unwrap();
    let rows = simulated_rows(
        structure,
        structure.simulation().seed(),
        0,
        Some(record.len() as u64),
    );
    let sent = tokio::spawn(sensors.run(rows.map(Ok::<_, Infallible>), pending()));

    // One after the other: the second waits while the first is read.
    assert_same_bits(
        "tiny queues",
        &expected.parameters,
        &expected.frames,
        reader.read_to_end(1).await,
    );
    assert_eq!(
        read_frames_to_end(&frames).await,
        record.len() as u64,
        "frames with tiny queues"
    );
    within("sensors that stop", sent).await.unwrap().unwrap();
    // The queues were too small, but nothing was lost.
    for service in [Service::Ingest, Service::Identify, Service::Alert] {
        let drops = drops.when_done(service, record.len() as u64).await.drops;
        println!("{}: {drops:?}", service.as_str());
        assert!(
            !drops.contains_key("lost-items"),
            "{}: {drops:?}",
            service.as_str()
        );
        if service == Service::Ingest {
            assert!(
                drops.contains_key("overflowed-messages"),
                "the queues were large enough: this tests nothing"
            );
        }
    }
    services.iter().for_each(|service| service.abort());
}
