//! Wrong clocks of one node, of all nodes, and of the machine that aligns their samples.
//!
//! The estimates are compared bit for bit with those of a record that contains the effect of the
//! clocks.

use crate::support::{
    Drops, EstimateReader, Process, Record, Sensors, Site, SteppedClock, assert_same_bits,
    two_storeys, within,
};
use spandrel_bus::{Bus, Keys, SampleBlock, Service, Status};
use spandrel_record::{FrameLog, LogLayout, LogSettings, LoggedFrames};
use spandrel_service::Clock;
use std::collections::BTreeMap;

const ROWS: usize = 800;
/// Row at which clocks are set.
const SET: usize = 400;
/// Number of rows per second.
const SECOND: usize = 100;
const SECOND_NS: i64 = 1_000_000_000;
/// 2100-01-01 in ns since 1970, far ahead of the clock of this machine.
const IN_2100_NS: i64 = 4_102_444_800 * SECOND_NS;
const NODES: [&str; 3] = ["ground", "floor-1", "roof"];

/// Running services and sensors with correct samples.
struct Running {
    site: Site,
    services: Process,
    bus: Bus,
    keys: Keys,
    drops: Drops,
    reader: EstimateReader,
    sensors: Sensors,
}

impl Running {
    async fn start(change: impl Fn(&mut Record)) -> Self {
        Self::start_at(Site::with(&two_storeys("")), change, Site::run).await
    }

    /// Starts the services of a site with `run`.
    async fn start_at(
        site: Site,
        change: impl Fn(&mut Record),
        run: impl Fn(&Site) -> Process,
    ) -> Self {
        let mut record = site.simulate(ROWS as f64 / SECOND as f64);
        change(&mut record);
        record.save_as("changed.csv");
        let services = run(&site);
        let (bus, keys) = (site.join().await, site.keys());
        site.wait_for_services(&bus).await;
        let drops = Drops::watch(&bus, &keys).await;
        let reader = EstimateReader::join(&bus, &keys).await;
        let sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
        Self {
            site,
            services,
            bus,
            keys,
            drops,
            reader,
            sensors,
        }
    }

    /// Publishes the record. From [`SET`] on, the clocks of some nodes are off by `seconds`.
    async fn put(&mut self, off: &[&str], seconds: i64) {
        self.sensors.put(0..SET).await;
        // A node whose clock goes back withdraws its samples that still wait for the other nodes.
        self.reader.read_frames(SET).await;
        for second in SET / SECOND..ROWS / SECOND {
            let rows = SECOND * second..SECOND * (second + 1);
            for node in off {
                let change = |block: &mut SampleBlock| block.header.time_ns += seconds * SECOND_NS;
                self.sensors.put_changed(node, rows.clone(), change).await;
            }
            self.sensors.put_all_but(off, rows).await;
        }
    }

    /// Compares the estimates with the first frames of those that `spandrel estimate` finds in a
    /// record.
    async fn assert_as_in(&mut self, what: &str, equivalent: &mut Record, frames: usize) {
        let expected = self.site.estimate(equivalent.save_as("equivalent.csv"));
        let found = self.reader.read_frames(frames).await;
        assert_same_bits(
            what,
            &expected.parameters,
            &expected.frames[..frames],
            &found[..frames],
        );
    }

    async fn counted(&self, reason: &str, least: u64) -> BTreeMap<String, u64> {
        self.drops.expect(Service::Ingest, reason, least).await
    }

    async fn end(self) {
        let mut decided = self
            .bus
            .watch_progress(self.keys.progress(Service::Alert))
            .await
            .unwrap();
        within("decisions", decided.wait_for(|progress| progress.done > 0)).await;
        self.services.stop().expect_code(0).expect_told(&[]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_whose_clock_steps_forward_is_missing_for_the_length_of_the_step() {
    let mut running = Running::start(|_| {}).await;
    running.put(&["floor-1"], 1).await;
    let mut equivalent = running.sensors.record().clone();
    equivalent.shift("floor-1", SET, SECOND as isize);
    running
        .assert_as_in("a second forth", &mut equivalent, ROWS)
        .await;
    let drops = running.counted("missing-samples", SECOND as u64).await;
    assert_eq!(drops["missing-samples"], SECOND as u64, "{drops:?}");
    running.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_whose_clock_steps_back_is_late_for_the_length_of_the_step() {
    let mut running = Running::start(|_| {}).await;
    running.put(&["floor-1"], -1).await;
    let mut equivalent = running.sensors.record().clone();
    // The last second waits for a node that is a second behind.
    let whole = ROWS - SECOND;
    for row in SET..whole {
        let later = running.sensors.record().value(row + SECOND, "floor-1");
        equivalent.change("floor-1", row..row + 1, |_, _| later);
    }
    running
        .assert_as_in("a second back", &mut equivalent, whole)
        .await;
    let drops = running.counted("late-samples", SECOND as u64 - 1).await;
    // The last sample of the second duplicates one of the frame that was closed last.
    assert_eq!(
        (drops["late-samples"], drops["duplicate-samples"]),
        (SECOND as u64 - 1, 1),
        "{drops:?}"
    );
    running.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_repeated_leap_second_is_late_and_duplicates_nothing() {
    let mut running = Running::start(|_| {}).await;
    running.put(&NODES, -1).await;
    let mut equivalent = running.sensors.record().clone();
    equivalent.cut(SET..SET + SECOND).delay_from(SET, -1.0);
    running
        .assert_as_in("a repeated second", &mut equivalent, ROWS - SECOND)
        .await;
    let lost = NODES.len() as u64;
    let drops = running
        .counted("late-samples", lost * (SECOND as u64 - 1))
        .await;
    assert_eq!(
        drops["late-samples"] + drops["duplicate-samples"],
        lost * SECOND as u64,
        "{drops:?}"
    );
    running.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_skipped_second_is_a_gap_of_a_second() {
    let mut running = Running::start(|_| {}).await;
    running.put(&NODES, 1).await;
    let mut equivalent = running.sensors.record().clone();
    equivalent.delay_from(SET, 1.0);
    running
        .assert_as_in("a second left out", &mut equivalent, ROWS + SECOND)
        .await;
    let drops = running.counted("missing-samples", 3 * SECOND as u64).await;
    assert_eq!(drops["missing-samples"], 3 * SECOND as u64, "{drops:?}");
    running.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn times_before_1970_and_across_it_are_valid() {
    let mut running = Running::start(|record| {
        record.delay_from(0, -4.0);
    })
    .await;
    assert!(running.sensors.record().time_ns(0) < 0);
    running.put(&[], 0).await;
    let mut equivalent = running.sensors.record().clone();
    running
        .assert_as_in("across 1970", &mut equivalent, ROWS)
        .await;
    let (first, last) = (
        running.reader.read_frames(ROWS).await[0].time_ns,
        3_990_000_000,
    );
    assert_eq!(
        (
            first,
            running.reader.read_frames(ROWS).await[ROWS - 1].time_ns
        ),
        (-4 * SECOND_NS, last)
    );
    running.end().await;
}

// Nothing distinguishes a sensor clock that is ahead from a machine clock that is behind.
#[tokio::test(flavor = "multi_thread")]
async fn a_machine_whose_clock_is_decades_behind_its_sensors_identifies_the_same() {
    let mut running = Running::start(|_| {}).await;
    for node in NODES {
        running
            .sensors
            .put_changed(node, 0..ROWS, |block| block.header.time_ns += IN_2100_NS)
            .await;
    }
    let mut equivalent = running.sensors.record().clone();
    let mut expected = running.site.estimate(equivalent.save_as("equivalent.csv"));
    expected
        .frames
        .iter_mut()
        .for_each(|frame| frame.time_ns += IN_2100_NS);
    let found = running.reader.read_frames(ROWS).await;
    assert_same_bits(
        "sensors of 2100",
        &expected.parameters,
        &expected.frames,
        found,
    );
    let status = running.drops.when_done(Service::Ingest, ROWS as u64).await;
    // On a busy machine, ingest may also request what is on its way. It discards the repeats.
    let is_loss =
        |reason: &&String| !["fetched-items", "duplicate-items"].contains(&reason.as_str());
    let lost: Vec<_> = status.drops.keys().filter(is_loss).collect();
    assert!(lost.is_empty(), "{:?}", status.drops);
    assert!(status.lag_s.unwrap() < -1e9, "lag {:?} s", status.lag_s);
    running.end().await;
}

/// As NTP does it: by hours and by seconds, forward and back.
#[tokio::test(flavor = "multi_thread")]
async fn a_machine_whose_clock_is_set_while_services_run_identifies_the_same() {
    const STEPS_S: [i64; 4] = [3600, -3605, 5, 0];
    let site = Site::with(&two_storeys(""));
    let Some(clock) = SteppedClock::or_skip(site.folder()) else {
        return;
    };
    let start = |site: &Site| {
        let mut command = site.listening("run");
        clock.of(&mut command);
        let services = Process::start(command.args(["--http", "none"]));
        services.wait_for_log("ready structures=1");
        services
    };
    let mut running = Running::start_at(site, |_| {}, start).await;
    let statuses = running.keys.statuses(Service::Ingest);
    let statuses = running
        .bus
        .subscribe::<Status>(statuses, 256)
        .await
        .unwrap();
    let rows = ROWS / STEPS_S.len();
    for (step, ahead_s) in STEPS_S.into_iter().enumerate() {
        clock.set(ahead_s);
        let (from, to) = (step * rows, (step + 1) * rows);
        running.sensors.put(from..to).await;
        running.reader.read_frames(to).await;
        // The services read the clock that was set.
        let shown = async {
            loop {
                let (_, status) = statuses.messages().recv_async().await.unwrap();
                let off_s = (status.time_ns - Clock::of_machine().now_ns()) / SECOND_NS - ahead_s;
                if off_s.abs() <= 3 {
                    break;
                }
            }
        };
        within("a status with the time that was set", shown).await;
    }
    let mut record = running.sensors.record().clone();
    running
        .assert_as_in("a clock that was set", &mut record, ROWS)
        .await;
    let status = running.drops.when_done(Service::Ingest, ROWS as u64).await;
    let is_loss =
        |reason: &&String| !["fetched-items", "duplicate-items"].contains(&reason.as_str());
    let lost: Vec<_> = status.drops.keys().filter(is_loss).collect();
    assert!(lost.is_empty(), "{:?}", status.drops);
    running.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn setting_all_clocks_back_by_a_day_starts_a_new_run_of_frames() {
    let mut running = Running::start(|_| {}).await;
    running.put(&NODES, -86_400).await;
    let found = running.reader.read_frames(ROWS).await;
    let times = (found[SET - 1].time_ns, found[SET].time_ns);
    assert_eq!(
        times,
        (3_990_000_000, 4 * SECOND_NS - 86_400 * SECOND_NS),
        "the last frame before, the first one after"
    );
    let status = running
        .drops
        .when_done(Service::Ingest, ROWS as u64 / 2)
        .await;
    assert!(
        !status.drops.contains_key("late-samples"),
        "{:?}",
        status.drops
    );
    running.end().await;
}

// The recording of the true time was deleted at once.
#[tokio::test(flavor = "multi_thread")]
async fn clocks_that_are_400_days_ahead_delete_no_recording_of_a_day() {
    const AHEAD_NS: i64 = 400 * 86_400 * SECOND_NS;
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(ROWS as f64 / SECOND as f64);
    let configuration = site.folder().join("spandrel.toml");
    let text = "[state]\nfolder = \"kept\"\nrecording.keep-s = 86400\nrecording.segment-s = 1\n";
    std::fs::write(&configuration, text).unwrap();
    let services = Process::start(site.listening("run").arg("--config").arg(&configuration));
    services.wait_for_log("ready structures=1");
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
    sensors.put(0..SET).await;
    reader.read_frames(SET).await;
    for from in (SET..ROWS).step_by(SECOND) {
        for node in NODES {
            let change = |block: &mut SampleBlock| block.header.time_ns += AHEAD_NS;
            sensors.put_changed(node, from..from + SECOND, change).await;
        }
    }
    let found = reader.read_frames(ROWS).await;
    let apart_ns = found[SET].time_ns - found[SET - 1].time_ns;
    assert!(apart_ns >= AHEAD_NS, "the clocks moved by {apart_ns} ns");
    services.stop().expect_code(0);
    let recording = site.recording_in(&site.folder().join("kept"));
    let spans = recording.reader().spans();
    let (first, last) = (&spans[0], &spans[spans.len() - 1]);
    assert_eq!((first.from, first.to), (0, SET as u64), "{spans:?}");
    assert_eq!(last.to - last.from, (ROWS - SET) as u64, "{spans:?}");
}

// An epoch is the wall clock at a start, but must increase with each start.
#[tokio::test(flavor = "multi_thread")]
async fn an_ingest_whose_clock_was_set_back_since_its_last_run_is_accepted() {
    const LATER: u64 = 1 << 62; // 2116
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(4.0);
    let state = site.folder().join("state");
    let folder = state
        .join("spandrel")
        .join(site.keys().root().as_str())
        .join("house/recording");
    let names = |names: &[&str]| {
        names
            .iter()
            .map(|name| (*name).to_owned())
            .collect::<Vec<_>>()
    };
    let layout = LogLayout {
        structure: "house".to_owned(),
        channels: names(&["ground", "floor-1", "roof", "roof-velocity"]),
        nodes: names(&NODES),
        sampling_rate_hz: 100.0,
    };
    let last = LoggedFrames {
        source: "ingest".to_owned(),
        epoch: LATER,
        sequence: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: 4,
        values: vec![0.0; 40],
        ended: true,
        nodes: Vec::new(),
    };
    let (mut log, _) = FrameLog::open(&folder, layout, LogSettings::default()).unwrap();
    log.append(&[last]).unwrap();
    log.close().unwrap();
    let services = Process::start(
        site.listening("run")
            .args(["--http", "none"])
            .env("XDG_STATE_HOME", &state),
    );
    services.wait_for_log("ready structures=1");
    site.replay(&record, "max").wait().expect_code(0);
    services.stop().expect_code(0);
    let newest = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let newest = newest
        .filter(|name| name.starts_with("frames-"))
        .max()
        .unwrap();
    assert!(
        newest > format!("frames-{LATER:020}-{:020}.mcap", 0),
        "{newest}"
    );
}
