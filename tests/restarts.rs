//! Processes that are killed or stopped on the way, and started again.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails panics")]

mod support;

use spandrel_bus::Service;
use support::{EstimateReader, Identified, Process, Site, assert_same_bits, five_storeys, two_storeys, within};

/// Longer than what may be on the way, so that a replay cannot end before it has been read from.
const RECORD_S: f64 = 100.0;

#[tokio::test(flavor = "multi_thread")]
async fn an_identification_that_was_killed_in_a_replay_comes_to_the_same_numbers() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(RECORD_S);
    let expected = site.estimate(&record);
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let _alert = Process::start(&mut site.connecting("alert"));
    let identify = Process::start(&mut site.connecting("identify"));
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let replay = site.replay(&record, "max");
    reader.read_frames(1).await;
    identify.kill();
    let mut tokens = bus.watch_live(keys.all_live(Service::Identify)).await.unwrap();
    within("identify to be gone", tokens.none()).await;
    let _identify = Process::start(&mut site.connecting("identify"));
    replay.wait().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert_same_bits("first reader", &expected.parameters, &expected.frames, found);
    let mut late = EstimateReader::join(&bus, &keys).await;
    assert_same_bits("late reader", &expected.parameters, &expected.frames, late.read_to_end(1).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_ingest_that_was_killed_in_a_replay_gets_the_samples_from_its_nodes() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(RECORD_S);
    let alert = Process::start(&mut site.listening("alert"));
    alert.wait_for_log("ready structures=1");
    let _identify = Process::start(&mut site.connecting("identify"));
    let ingest = Process::start(&mut site.connecting("ingest"));
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let replay = site.replay(&record, "max");
    let before = reader.read_frames(1).await.len();
    ingest.kill();
    let mut tokens = bus.watch_live(keys.all_live(Service::Ingest)).await.unwrap();
    within("ingest to be gone", tokens.none()).await;
    let _ingest = Process::start(&mut site.connecting("ingest"));
    replay.wait().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert!(found.len() >= before + record.len(), "{} frames in all, {} of the record", found.len(), record.len());
    assert_is_the_whole_record(&found[found.len() - record.len()..]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replay_that_is_stopped_ends_its_nodes_where_they_are() {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(RECORD_S);
    let expected = site.estimate(&record);
    let services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let replay = site.replay(&record, "10");
    reader.read_frames(100).await;
    replay.stop().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert!(found.len() < record.len(), "stopped on the way");
    assert_same_bits("up to the stop", &expected.parameters, &expected.frames[..found.len()], found);
    services.stop().expect_code(0);
}

/// Checks that frames follow each other from time 0 on, at 100 Hz.
#[track_caller]
fn assert_is_the_whole_record(frames: &[Identified]) {
    let wrong = (0..).zip(frames).find(|(number, frame)| frame.time_ns != number * 10_000_000);
    assert!(wrong.is_none(), "frame {wrong:?} is not at its time");
}
