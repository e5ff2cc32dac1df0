//! The monitoring state of a structure whose samples are dropped, or whose sensors fall silent.

use crate::support::{DEADLINE, Drops, Process, Record, Site, storeys, within};
use spandrel_bus::{
    Delivery, Event, EventKind, FrameBlock, MonitoringDisplay, MonitoringState, Name, Pace,
    SampleBlock, Service, Start, Status, StreamSettings, Subscription,
};
use std::process::Command;
use std::time::Duration;
use tokio::time::Instant;

/// Rules and a half-life with which alerts are decided after some seconds.
const RULES: &str = r#"
[filter]
half-life-s = 4
[[alert]]
parameters = "all"
reference.design-std = 0.02
loss = 0.3
credibility = 0.9
[ingest]
lateness-s = 0.5
"#;

/// Waits for a report on the monitoring that satisfies a condition.
async fn report(
    reports: &Subscription<MonitoringDisplay>,
    what: &str,
    holds: impl Fn(&MonitoringDisplay) -> bool,
) -> MonitoringDisplay {
    within(what, async {
        loop {
            let (_, display) = reports.messages().recv_async().await.unwrap();
            if holds(&display) {
                return display;
            }
        }
    })
    .await
}

/// Returns the command of a live simulation.
fn live(site: &Site, arguments: &[&str]) -> Command {
    let mut command = site.connecting("simulate");
    command.arg("--live").args(arguments);
    command
}

/// Returns the present time, s since 1970.
fn now_s() -> f64 {
    std::time::UNIX_EPOCH.elapsed().unwrap().as_secs_f64()
}

/// Simulates a minute that begins now. A fast replay of it runs ahead of the clock.
fn ahead_of_the_clock(site: &Site) -> Record {
    let mut record = site.simulate(60.0);
    record.delay_from(0, now_s().floor()).save_as("ahead.csv");
    record
}

// The deadline of the simulation, in the future, closed the frames of the live samples: most of
// them were dropped, and the page showed a sound structure.
#[tokio::test(flavor = "multi_thread")]
async fn live_samples_after_a_simulation_are_used() {
    let site = Site::with(&storeys(2, RULES));
    let _services = site.run();
    let bus = site.join().await;
    let keys = site.keys();
    let reports = bus.subscribe(keys.monitoring(), 256).await.unwrap();
    let statuses = bus
        .subscribe::<Status>(keys.statuses(Service::Ingest), 256)
        .await
        .unwrap();
    site.replay(&ahead_of_the_clock(&site), "10")
        .wait()
        .expect_code(0);
    let ended = report(&reports, "the end of the simulation", |display| {
        display.words() == "blind: the samples have ended"
    })
    .await;
    let _live = Process::start(&mut live(&site, &[]));
    let watched = report(&reports, "live samples that are watched", |display| {
        display.state == MonitoringState::Watching && display.measured_ns < ended.measured_ns
    })
    .await;
    for channel in &watched.channels {
        assert!(channel.used_share > 0.99, "{channel:?}");
    }
    let drops = within("a status of ingest", async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.time_ns >= watched.time_ns {
                return status.drops;
            }
        }
    })
    .await;
    for reason in ["late-samples", "duplicate-samples"] {
        assert_eq!(drops.get(reason), None, "{drops:?}");
    }
}

// 9,520 samples were dropped in 24 s.
#[tokio::test(flavor = "multi_thread")]
async fn live_samples_after_a_simulation_ahead_of_the_clock_begin_a_new_run_within_a_second() {
    for is_killed in [false, true] {
        let site = Site::with(&storeys(2, RULES));
        let _services = site.run();
        let (bus, keys) = (site.join().await, site.keys());
        let drops = Drops::watch(&bus, &keys).await;
        let record = ahead_of_the_clock(&site);
        let started = Instant::now();
        let simulation = site.replay(&record, "10");
        drops.when_done(Service::Ingest, 5000).await;
        match is_killed {
            true => simulation.kill(),
            false => {
                simulation.wait().expect_code(0);
            }
        }
        let ground = Name::new("ground").unwrap();
        let samples = bus.subscribe::<SampleBlock>(keys.samples(&ground), 256);
        let samples = samples.await.unwrap();
        let from_now = StreamSettings::new(Start::Now);
        let frames = bus.follow::<FrameBlock>(keys.frames(), keys.recording(), from_now);
        let frames = frames.await.unwrap();
        let former = bus.stream_position(&keys.recording(), DEADLINE).await;
        let former = former.expect("frames of the simulation").header;
        let _live = Process::start(&mut live(&site, &[]));
        let first = within("a live sample", async {
            loop {
                let (_, block) = samples.messages().recv_async().await.unwrap();
                if block.pace == Pace::Live {
                    return block;
                }
            }
        })
        .await;
        // The simulation has measured 50 s.
        let elapsed = started.elapsed();
        assert!(elapsed < Duration::from_secs(45), "not ahead: {elapsed:?}");
        let run = within("a new run", async {
            loop {
                let delivery = frames.deliveries().recv_async().await.unwrap();
                if let Delivery::Block(block) = delivery
                    && block.header.epoch > former.epoch
                {
                    return block;
                }
            }
        })
        .await;
        let lost_s = (run.t0_ns - first.header.time_ns) as f64 * 1e-9;
        assert!(lost_s < 1.0, "{lost_s} s lost, killed: {is_killed}");
    }
}

// The times of the simulation were ahead of the clock.
#[tokio::test(flavor = "multi_thread")]
async fn a_fast_simulation_ends_now_and_a_second_one_loses_no_frame() {
    let site = Site::with(&storeys(2, RULES));
    let _services = site.run();
    let (bus, keys) = (site.join().await, site.keys());
    let reports = bus.subscribe(keys.monitoring(), 256).await.unwrap();
    let drops = Drops::watch(&bus, &keys).await;
    let mut last_ns = None;
    for _ in 0..2 {
        let mut simulation = site.connecting("simulate");
        simulation.args(["--duration", "60", "--speed", "20"]);
        let started_s = now_s();
        Process::start(&mut simulation).wait().expect_code(0);
        let ended = report(&reports, "the end of the simulation", |display| {
            display.words() == "blind: the samples have ended" && display.measured_ns > last_ns
        })
        .await;
        last_ns = ended.measured_ns;
        let ended_s = last_ns.unwrap() as f64 * 1e-9;
        assert!(
            (started_s..now_s()).contains(&ended_s),
            "ended at {ended_s}, started at {started_s}"
        );
        // A second simulation overlaps with the first, and therefore begins a new run.
        let frames = (60.0 * site.structure().sampling_rate_hz()) as u64;
        let status = loop {
            let status = drops.when_done(Service::Ingest, frames).await;
            if status.time_ns >= ended.time_ns {
                break status;
            }
        };
        assert_eq!(status.done, frames);
        for reason in ["late-samples", "duplicate-samples", "lost-items"] {
            assert_eq!(status.drops.get(reason), None, "{:?}", status.drops);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn structure_with_silent_response_sensors_is_blind_with_an_event() {
    let site = Site::with(&storeys(2, RULES));
    let _services = site.run();
    let bus = site.join().await;
    let keys = site.keys();
    let reports = bus.subscribe(keys.monitoring(), 256).await.unwrap();
    let events = bus.subscribe::<Event>(keys.event(), 256).await.unwrap();
    let start = std::time::UNIX_EPOCH
        .elapsed()
        .unwrap()
        .as_secs()
        .to_string();
    let _ground = Process::start(&mut live(&site, &["--node", "ground", "--start", &start]));
    let of_floors = ["--node", "floor-1", "--node", "floor-2", "--start", &start];
    let floors = Process::start(&mut live(&site, &of_floors));
    report(&reports, "a watched structure", |display| {
        display.state == MonitoringState::Watching
    })
    .await;
    floors.kill();
    let blind = report(&reports, "a blind structure", |display| {
        display.state == MonitoringState::Blind
    })
    .await;
    let reason = "no sensor of the response delivers usable samples";
    assert!(blind.words().contains(reason), "{}", blind.words());
    let event = within("an event about blindness", async {
        loop {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if event.kind == EventKind::Monitoring && event.subject == "blind" {
                return event;
            }
        }
    })
    .await;
    assert!(event.why.contains(reason), "{event:?}");
}
