use spandrel_bus::{ChannelHealthDisplay, Estimate, EstimateFlags, Header};
use std::path::Path;

use super::*;

/// Two storeys. The stiffness of the lower one is watched.
const TOWER: &str = include_str!("../../tests/tower.toml");

const RATE_HZ: f64 = 100.0;

fn tower() -> Structure {
    Structure::parse(TOWER, Path::new("tower.toml")).unwrap()
}

/// The monitoring of the tower with its decisions, at 100 frames per second.
struct Bench {
    monitoring: Monitoring,
    watch: Watch,
    next: u64,
}

impl Bench {
    fn new() -> Self {
        Self {
            monitoring: Monitoring::new(&tower()).unwrap(),
            watch: Watch::new(&tower(), None).unwrap(),
            next: 0,
        }
    }

    /// Processes seconds of estimates of a sound tower. The filter uses the samples for which
    /// `is_used` returns `true`, and sustains this standard deviation.
    fn run(&mut self, seconds: u64, sustained_std: f32, is_used: impl Fn(u64) -> bool) {
        self.run_in(Phase::Working, seconds, sustained_std, is_used);
    }

    /// Does the same in a phase of the filter.
    fn run_in(
        &mut self,
        phase: Phase,
        seconds: u64,
        sustained_std: f32,
        is_used: impl Fn(u64) -> bool,
    ) {
        let parameters = self.watch.parameter_count();
        let channels = self.monitoring.channels.len();
        let estimates = (0..seconds * RATE_HZ as u64).map(|frame| {
            let innovation = if is_used(frame) { 0.1 } else { f64::NAN };
            let mut covariance = Vec::new();
            for column in 0..parameters {
                covariance.extend(vec![0.0; column]);
                covariance.push(1e-6);
            }
            Estimate {
                mean: vec![1.0; parameters],
                covariance,
                noise_mean: Vec::new(),
                noise_covariance: Vec::new(),
                innovations: vec![innovation; channels],
                normalised_innovation_squared: 1.0,
                log_evidence: 0.0,
                used_channels: 0,
                flags: EstimateFlags {
                    phase,
                    prediction_only: innovation.is_nan(),
                    ..EstimateFlags::working()
                },
                excluded: spandrel_bus::Excluded::None,
                sustained_information: vec![sustained_std.powi(-2); parameters],
            }
        });
        let block = EstimateBlock {
            header: Header {
                source: "identify".into(),
                epoch: 1,
                sequence: self.next,
                time_ns: 0,
            },
            term: 0,
            t0_ns: 0,
            sampling_rate_hz: RATE_HZ,
            parameters: parameters as u16,
            noise_parameters: 0,
            channels: channels as u16,
            estimates: estimates.collect(),
            state: StreamState::Running,
        };
        self.next = block.end();
        self.watch.handle_block(&block, &mut Vec::new()).unwrap();
        self.monitoring.take(&block);
    }

    /// Judges twice, a second apart. The first judgement only finds a candidate.
    fn judge(&mut self, silence: Duration) -> MonitoringDisplay {
        self.monitoring.judge(&self.watch, silence, 0);
        self.monitoring.judge(&self.watch, silence, 1_000_000_000).0
    }
}

#[test]
fn structure_with_samples_and_a_learning_filter_is_watched() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    let display = bench.judge(Duration::ZERO);
    assert_eq!(display.state, State::Watching, "{display:?}");
    assert_eq!(display.reasons, Vec::<String>::new());
    assert!(
        display
            .parameters
            .iter()
            .all(|one| one.state == State::Watching)
    );
}

#[test]
fn structure_without_estimates_is_blind() {
    let display = Bench::new().judge(Duration::ZERO);
    assert_eq!(display.words(), "blind: no estimates have arrived");
}

#[test]
fn structure_is_blind_when_estimates_cease() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    assert_eq!(bench.judge(Duration::from_secs(2)).state, State::Watching);
    let display = bench.judge(Duration::from_secs(4));
    assert_eq!(display.words(), "blind: no estimates have arrived for 4 s");
}

#[test]
fn a_third_of_used_samples_degrades_the_structure_and_is_reported() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |frame| frame % 3 == 0);
    let display = bench.judge(Duration::ZERO);
    assert_eq!(display.state, State::Degraded, "{display:?}");
    assert!(display.words().contains("33 %"), "{}", display.words());
}

#[test]
fn sensors_without_usable_samples_make_the_structure_blind() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    bench.run(10, 0.001, |_| false);
    let display = bench.judge(Duration::ZERO);
    assert_eq!(display.state, State::Blind, "{display:?}");
    assert_eq!(
        display.reasons,
        ["no sensor of the response delivers usable samples"]
    );
}

#[test]
fn narrow_estimate_is_blind_if_the_filter_learns_nothing() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    bench.run(10, 1e6, |_| true);
    let display = bench.judge(Duration::ZERO);
    assert_eq!(display.state, State::Blind, "{display:?}");
    let of_rule = display
        .parameters
        .iter()
        .find(|one| one.parameter.as_str() == "storey-1");
    let why = of_rule.unwrap().why.clone().unwrap();
    assert!(why.contains("depends on earlier data"), "{why}");
}

#[test]
fn state_keeps_its_reasons_until_the_next_state_is_confirmed() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |frame| frame % 3 == 0);
    bench.judge(Duration::ZERO);
    bench.run(10, 0.001, |_| true);
    let (display, change) = bench.monitoring.judge(&bench.watch, Duration::ZERO, 0);
    assert_eq!((display.state, change), (State::Degraded, None));
    assert!(display.words().contains("33 %"), "{}", display.words());
}

#[test]
fn slow_estimates_may_be_three_periods_apart() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    bench.monitoring.rate_hz = 0.5;
    assert_eq!(bench.judge(Duration::from_secs(5)).state, State::Watching);
    assert_eq!(bench.judge(Duration::from_secs(7)).state, State::Blind);
}

#[test]
fn state_changes_at_the_second_judgement_and_is_reported_once() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    bench.judge(Duration::ZERO);
    let late = Duration::from_secs(10);
    let changes: Vec<_> = (2..6)
        .map(|second| {
            bench
                .monitoring
                .judge(&bench.watch, late, second * 1_000_000_000)
                .1
        })
        .collect();
    let is_change: Vec<bool> = changes.iter().map(Option::is_some).collect();
    assert_eq!(is_change, [false, true, false, false]);
    let change = changes[1].as_ref().unwrap();
    assert_eq!(
        (change.before, change.display.state),
        (State::Watching, State::Blind)
    );
    assert_eq!(change.display.since_ns, 3_000_000_000);
}

/// Returns a status of ingest without any fault.
fn status_of_ingest() -> Status {
    Status {
        structure: Name::new("tower").unwrap(),
        service: Name::new("ingest").unwrap(),
        id: Name::new("ingest").unwrap(),
        time_ns: 0,
        lag_s: None,
        pace: None,
        state: None,
        done: 0,
        load: None,
        frames_behind: None,
        fit: None,
        undecided: BTreeMap::new(),
        instruments: BTreeMap::new(),
        clocks: BTreeMap::new(),
        missing: BTreeMap::new(),
        maintenance: Vec::new(),
        drops: BTreeMap::new(),
        restarts: 0,
        version: String::new(),
    }
}

#[test]
fn reason_of_the_structure_and_of_all_its_parameters_is_named_once() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    bench.run_in(Phase::SensorInDoubt, 10, 0.001, |_| true);
    let display = bench.judge(Duration::ZERO);
    assert_eq!(
        display.words(),
        "blind: the sensors measure different motions: their motion is too weak to compare, or a \
         sensor is faulty"
    );
}

// The state said that a sensor is faulty, and not which one.
#[test]
fn sensor_in_doubt_is_named_once_it_is_known() {
    let mut bench = Bench::new();
    bench.run_in(Phase::SensorInDoubt, 10, 0.001, |_| true);
    let health = |channel: &str, state: Soundness| SensorHealthDisplay {
        structure: Name::new("tower").unwrap(),
        node: Name::new(channel).unwrap(),
        time_ns: 0,
        channels: vec![ChannelHealthDisplay {
            channel: Name::new(channel).unwrap(),
            state,
            probability: 0.5,
            fault: None,
            gain: None,
            delay_s: None,
            coherence: None,
        }],
    };
    for (channel, state, expected) in [
        ("middle", Soundness::InDoubt, ": middle"),
        ("roof", Soundness::Faulty, ": middle, roof"),
        ("middle", Soundness::Sound, ": roof"),
    ] {
        bench.monitoring.take_health(&health(channel, state));
        let words = bench.judge(Duration::ZERO).words();
        assert_eq!(
            words,
            format!("blind: a sensor is probably faulty{expected}")
        );
    }
}

// A ground sensor that lost three of four samples changed nothing on the page.
#[test]
fn missing_samples_of_the_ground_degrade_the_structure_and_are_reported() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    let mut status = status_of_ingest();
    let ground = || Name::new("ground").unwrap();
    for (missing, state, reason) in [
        (
            0.75,
            State::Degraded,
            "only 25 % of the samples of ground are used",
        ),
        (1.0, State::Blind, "no samples of ground are used"),
    ] {
        status.missing.insert(ground(), missing);
        bench.monitoring.take_status(&status);
        let display = bench.judge(Duration::ZERO);
        assert_eq!(display.state, State::Degraded, "{display:?}");
        assert_eq!(display.reasons, [reason]);
        let channel = display.channels.last().unwrap();
        assert_eq!((&channel.channel, channel.state), (&ground(), state));
    }
    bench.monitoring.take_status(&status_of_ingest());
    let display = bench.judge(Duration::ZERO);
    assert_eq!(display.words(), "watching");
}

#[test]
fn wrong_clock_of_a_node_is_named() {
    let mut bench = Bench::new();
    bench.run(10, 0.001, |_| true);
    let mut status = status_of_ingest();
    let clock = spandrel_bus::NodeClock {
        difference_s: Some(-3600.0),
        ..spandrel_bus::NodeClock::default()
    };
    status.clocks.insert(Name::new("roof").unwrap(), clock);
    bench.monitoring.take_status(&status);
    let display = bench.judge(Duration::ZERO);
    assert_eq!(display.state, State::Degraded, "{display:?}");
    assert_eq!(
        display.reasons[0],
        "the clock of roof is 3600.0 s behind most nodes"
    );
}
