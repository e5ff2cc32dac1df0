//! The streaming path gives bit-identical results to `spandrel estimate`, with real processes and
//! real Zenoh over TCP.

use crate::support::{
    Drops, EstimateReader, Identified, Process, Record, Site, assert_same_bits, five_storeys,
    spandrel, two_storeys,
};
use serde_json::Value;
use spandrel_bus::{NoiseDisplay, Service};
use std::collections::BTreeSet;

/// Replays a record to running services, and compares the estimates on the bus with those of the
/// file.
async fn assert_replay_gives_the_numbers_of_estimate(
    route: &str,
    site: &Site,
    record: &Record,
    speed: &str,
) {
    assert_runs_give_the_numbers_of_estimate(route, site, record, speed, 1).await;
}

/// Compares as above, for a record with gaps that start new runs of frames.
async fn assert_runs_give_the_numbers_of_estimate(
    route: &str,
    site: &Site,
    record: &Record,
    speed: &str,
    runs: usize,
) {
    let expected = site.estimate(record);
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let replay = site.replay(record, speed);
    let found = reader.read_to_end(runs).await;
    assert_same_bits(route, &expected.parameters, &expected.frames, found);
    replay.wait().expect_code(0);
    for service in [Service::Ingest, Service::Identify, Service::Alert] {
        let lost = drops
            .when_done(service, 1)
            .await
            .drops
            .get("lost-items")
            .copied();
        assert_eq!(
            lost,
            None,
            "{route}: frames lost on the way to {}",
            service.as_str()
        );
    }
    // If dropped, a session would block this thread while it closes, and with it all other work of
    // this task.
    bus.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replay_at_full_speed_gives_the_numbers_of_estimate() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(30.0);
    let _services = site.run();
    assert_replay_gives_the_numbers_of_estimate("run, replay --speed max", &site, &record, "max")
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replay_at_ten_times_real_time_gives_the_numbers_of_estimate() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(20.0);
    let _services = site.run();
    assert_replay_gives_the_numbers_of_estimate("run, replay --speed 10", &site, &record, "10")
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn services_in_three_processes_give_the_numbers_of_estimate() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(30.0);
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let _identify = Process::start(&mut site.connecting("identify"));
    let _alert = Process::start(&mut site.connecting("alert"));
    assert_replay_gives_the_numbers_of_estimate(
        "ingest, identify, alert apart",
        &site,
        &record,
        "max",
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_number_of_threads_changes_no_bit() {
    for threads in ["1", "2"] {
        let site = Site::of(&five_storeys());
        let record = site.simulate(30.0);
        let services = Process::start(site.listening("run").env("SPANDREL_THREADS", threads));
        services.wait_for_log("ready structures=1");
        let route = format!("run with SPANDREL_THREADS={threads}");
        assert_replay_gives_the_numbers_of_estimate(&route, &site, &record, "max").await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_record_with_gaps_and_missing_fields_gives_the_numbers_of_estimate() {
    let site = Site::of(&five_storeys());
    let mut record = site.simulate(30.0);
    record
        .remove("floor-2", 0..3)
        .remove("floor-3", 700..900)
        .remove("ground", 1000..1001)
        .remove("floor-5", 2999..3000);
    for channel in [
        "ground", "floor-1", "floor-2", "floor-3", "floor-4", "floor-5",
    ] {
        record.remove(channel, 1200..1250);
    }
    record.cut(2000..2300).cut(500..501).save_as("gaps.csv");
    let _services = site.run();
    assert_replay_gives_the_numbers_of_estimate("record with gaps", &site, &record, "max").await;
}

// A source must publish the frame before a gap without waiting for the frame after it, even if the
// gap is longer than its window.
#[tokio::test(flavor = "multi_thread")]
async fn a_gap_longer_than_the_window_gives_the_numbers_of_estimate() {
    let site = Site::of(&five_storeys());
    let mut record = site.simulate(20.0);
    record.delay_from(1000, 100.0).save_as("hole.csv");
    let _services = site.run();
    assert_replay_gives_the_numbers_of_estimate(
        "record with a hole of 100 s",
        &site,
        &record,
        "max",
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_gap_of_half_an_hour_starts_a_new_run_on_both_routes() {
    let site = Site::of(&five_storeys());
    let mut record = site.simulate(20.0);
    record.delay_from(1000, 1800.0).save_as("hole.csv");
    let _services = site.run();
    assert_runs_give_the_numbers_of_estimate(
        "record with a hole of 1800 s",
        &site,
        &record,
        "max",
        2,
    )
    .await;
}

// Blocks of a slow node must not span more than the window, so they have fewer samples than those
// of other nodes.
#[tokio::test(flavor = "multi_thread")]
async fn a_node_far_slower_than_the_frames_gives_the_numbers_of_estimate() {
    let slow = "[[node]]\nname = \"tilt\"\nsampling-rate-hz = 1\n[[node.channel]]\n\
                name = \"tilt\"\n\
                quantity = \"displacement\"\ndof = \"floor-2\"\nunit = \"m\"\nnoise-std = 1e-4\n";
    let site = Site::with(&two_storeys(slow));
    let record = site.simulate(120.0);
    let _services = site.run();
    assert_replay_gives_the_numbers_of_estimate(
        "node of 1 Hz among nodes of 100 Hz",
        &site,
        &record,
        "max",
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn nodes_of_several_channels_at_200_hz_give_the_numbers_of_estimate() {
    let site = Site::of(&five_storeys().with_file_name("matrices.toml"));
    let record = site.simulate(15.0);
    let _services = site.run();
    assert_replay_gives_the_numbers_of_estimate("matrices.toml", &site, &record, "max").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_building_without_parameters_gives_the_numbers_of_estimate() {
    for name in ["fifty-storeys.toml", "fifty-storeys-wind.toml"] {
        let site = Site::of(&five_storeys().with_file_name(name));
        let record = site.simulate(8.0);
        let _services = site.run();
        let bus = site.join().await;
        let noise = bus
            .subscribe::<NoiseDisplay>(site.keys().all_noise(), 1024)
            .await
            .unwrap();
        assert_replay_gives_the_numbers_of_estimate(name, &site, &record, "max").await;
        let shown: BTreeSet<String> = noise
            .messages()
            .drain()
            .map(|(_, level)| level.name.to_string())
            .collect();
        let levels: BTreeSet<String> = site
            .structure()
            .noise_levels()
            .iter()
            .map(|l| l.name().to_owned())
            .collect();
        assert_eq!(shown, levels, "{name}: topics noise/*");
        bus.close().await.unwrap();
    }
}

/// Returns the tower of the documentation with 12 beams and lumped masses, which is fast enough for
/// a test.
fn coarse_tower() -> String {
    let mut text = std::fs::read_to_string(five_storeys().with_file_name("tower.toml")).unwrap();
    for (from, to) in [
        ("kind = \"tower\"", "kind = \"tower\"\nmass = \"lumped\""),
        ("elements = 27", "elements = 8"),
        ("elements = 10", "elements = 4"),
        ("modes = [1, 11]", "modes = [1, 9]"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    for (from, to) in [
        (4, 1),
        (8, 3),
        (13, 4),
        (18, 5),
        (23, 7),
        (27, 8),
        (32, 10),
        (37, 12),
    ] {
        text = text.replace(&format!("\"node-{from}-"), &format!("\"node-{to}-"));
    }
    text
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_a_truss_a_dome_and_a_tower_give_the_numbers_of_estimate() {
    let example = |name: &str| Site::of(&five_storeys().with_file_name(name));
    for (kind, site) in [
        ("frame", example("three-pier-bridge.toml")),
        ("truss", example("fourteen-bay-truss.toml")),
        ("dome", example("dome.toml")),
        ("tower", Site::with(&coarse_tower())),
    ] {
        let record = site.simulate(2.0);
        let _services = site.run();
        assert_replay_gives_the_numbers_of_estimate(kind, &site, &record, "max").await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_record_replayed_twice_gives_as_many_frames_twice() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(20.0);
    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    for runs in 1..=2 {
        let replay = site.replay(&record, "max");
        let found = reader.read_to_end(runs).await.len();
        assert_eq!(found, runs * record.len(), "frames after replay {runs}");
        replay.wait().expect_code(0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn two_structures_in_one_process_do_not_mix() {
    let (five, two) = (Site::of(&five_storeys()), Site::with(&two_storeys("")));
    let two = two.at(&five);
    let records = [five.simulate(30.0), two.simulate(40.0)];
    let services = Process::start(five.listening("run").arg(two.structure_file()));
    services.wait_for_log("ready structures=2");
    tokio::join!(
        assert_replay_gives_the_numbers_of_estimate(
            "one of two structures",
            &five,
            &records[0],
            "max"
        ),
        assert_replay_gives_the_numbers_of_estimate(
            "the other of two structures",
            &two,
            &records[1],
            "max"
        ),
    );
}

/// Returns means and standard deviations without their times.
fn without_times(mut frames: Vec<Identified>) -> Vec<Identified> {
    frames.iter_mut().for_each(|frame| frame.time_ns = 0);
    frames
}

/// Runs separate services, simulates to the bus for some seconds at full speed, and returns the
/// estimates.
async fn estimates_of_a_simulation(site: &Site, seconds: &str) -> Vec<Identified> {
    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let simulation =
        Process::start(
            site.connecting("simulate")
                .args(["--speed", "max", "--duration", seconds]),
        );
    let found = without_times(reader.read_to_end(1).await.to_vec());
    simulation.wait().expect_code(0);
    found
}

#[tokio::test(flavor = "multi_thread")]
async fn a_simulation_on_the_bus_gives_the_numbers_of_its_record() {
    let site = Site::of(&five_storeys());
    let expected = site.estimate(&site.simulate(30.0));
    let found = estimates_of_a_simulation(&site, "30").await;
    assert_same_bits(
        "simulate --speed max",
        &expected.parameters,
        &without_times(expected.frames),
        &found,
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_simulation_with_faulty_sensors_gives_the_same_bits_each_time() {
    let noisy = five_storeys().with_file_name("noisy.toml");
    let (first, second) = (Site::of(&noisy), Site::of(&noisy));
    let names: Vec<String> = first
        .structure()
        .parameters()
        .iter()
        .map(|parameter| parameter.name().to_owned())
        .collect();
    let expected = estimates_of_a_simulation(&first, "40").await;
    let found = estimates_of_a_simulation(&second, "40").await;
    assert_same_bits("noisy.toml, second time", &names, &expected, &found);
}

#[test]
fn demo_and_estimate_agree_on_the_same_simulation() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(120.0);
    let mut expected = site.estimate(&record).summary;
    let mut demo = spandrel("demo");
    demo.args([
        "--speed",
        "max",
        "--duration",
        "120",
        "--seed",
        "1",
        "--headless",
        "--json",
    ]);
    let finished = Process::start(demo.args(["--listen", "tcp/127.0.0.1:0"]))
        .wait()
        .expect_code(0);
    let mut found: Value = serde_json::from_str(finished.stdout.lines().last().unwrap()).unwrap();
    assert!(
        found["alerts"]
            .as_array()
            .is_some_and(|alerts| !alerts.is_empty()),
        "the demo raises an alert: {found}"
    );
    for summary in [&mut expected, &mut found] {
        forget_when(summary);
    }
    assert_eq!(
        found, expected,
        "demo --json\n  expected {expected}\n  found    {found}"
    );
}

/// Removes the times from the sentences: the demo starts today, the record at 0.
fn forget_when(summary: &mut Value) {
    for alert in summary["alerts"].as_array_mut().unwrap() {
        let why = alert["why"].as_str().unwrap();
        let sentence = why.split_once(", since ").unwrap_or((why, "")).0.to_owned();
        alert["why"] = sentence.into();
    }
}
