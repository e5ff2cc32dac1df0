//! Tests of the alert service with a real Zenoh session: estimates, alerts and acknowledgements.
#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "helper functions of tests may panic"
)]

use std::path::Path;
use std::time::Duration;

use spandrel_alert::{AlertPlan, AlertService};
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Bus, BusConfig, DisplayPublisher, Estimate,
    EstimateBlock, EstimateFlags, Event, EventKind, FitReason, FitVerdict, Header, HistoryLog,
    Keep, Keys, ModeDisplay, ModeEstimate, ModeState, Name, NumberedPublisher, NumberedStream,
    Service, ShapeValue, Status, StreamState, Subscription, UndecidedBecause,
};
use spandrel_checkpoint::Remembering;
use spandrel_service::{Monitored, Service as _, ServiceInstance};
use spandrel_structure::Structure;
use tokio::sync::oneshot;
use tokio::time::timeout;

/// Time limit for a hang. Nothing here takes a second.
const DEADLINE: Duration = Duration::from_secs(30);

const STRUCTURE: &str = include_str!("tower.toml");

fn estimate(mean: f64) -> Estimate {
    Estimate {
        mean: vec![mean],
        covariance: vec![1e-4],
        noise_mean: vec![],
        noise_covariance: vec![],
        innovations: vec![0.0],
        normalised_innovation_squared: 0.0,
        log_evidence: 0.0,
        used_channels: 1,
        flags: EstimateFlags::working(),
        excluded: spandrel_bus::Excluded::None,
        sustained_information: Vec::new(),
    }
}

fn block(sequence: u64, count: usize, mean: f64) -> EstimateBlock {
    EstimateBlock {
        header: Header {
            source: "identify-1".into(),
            epoch: 1,
            sequence,
            time_ns: sequence as i64 * 10_000_000,
        },
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 1,
        noise_parameters: 0,
        channels: 1,
        estimates: vec![estimate(mean); count],
        state: StreamState::Running,
    }
}

/// Opens a session and a publisher of estimates.
async fn open(root: &str) -> (Bus, Keys, NumberedPublisher<EstimateBlock>) {
    let config = BusConfig {
        root: root.into(),
        listen: vec!["tcp/127.0.0.1:0".into()],
        ..BusConfig::default()
    };
    let bus = Bus::open(&config).await.unwrap();
    let keys = config.keys("tower").unwrap();
    let stream = NumberedStream {
        key: keys.estimates(),
        buffer_key: keys.estimates_buffer(),
        source: "identify-1".into(),
        epoch: 1,
        first: 0,
        state: StreamState::Running,
        keep: Keep::last(10_000),
    };
    let estimates = bus.publish_numbered(stream).await.unwrap();
    (bus, keys, estimates)
}

/// The service under test while it runs.
struct Running {
    stop: oneshot::Sender<()>,
    service: tokio::task::JoinHandle<()>,
}

impl Running {
    async fn start(bus: &Bus, keys: &Keys) -> Self {
        Self::start_with(bus, keys, STRUCTURE, None).await
    }

    async fn start_with(
        bus: &Bus,
        keys: &Keys,
        text: &str,
        remembering: Option<&Remembering>,
    ) -> Self {
        let structure = Structure::parse(text, Path::new("tower.toml"))
            .unwrap_or_else(|error| panic!("{error}"));
        let id = Name::new("alert-1").unwrap();
        let plan = AlertPlan {
            instance: ServiceInstance::new(bus, id),
            monitored: Monitored {
                remembering: remembering.cloned(),
                ..Monitored::new(&structure, keys.clone())
            },
            baseline: None,
        };
        let running = AlertService::start(&plan).await.unwrap();
        let (stop, stopped) = oneshot::channel();
        let service = tokio::spawn(async move {
            let stopped = async move { drop(stopped.await) };
            running.run(Box::pin(stopped)).await.unwrap();
        });
        Self { stop, service }
    }

    async fn stop(self) {
        self.stop.send(()).unwrap();
        timeout(DEADLINE, self.service).await.unwrap().unwrap();
    }

    async fn end(self, bus: Bus) {
        self.stop().await;
        bus.close().await.unwrap();
    }
}

async fn next(alerts: &Subscription<AlertMessage>) -> AlertMessage {
    timeout(DEADLINE, alerts.messages().recv_async())
        .await
        .unwrap()
        .unwrap()
        .1
}

#[tokio::test(flavor = "multi_thread")]
async fn loss_is_raised_acknowledged_and_answered_on_query() {
    let (bus, keys, estimates) = open("alert-test-a").await;
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let mut progress = bus
        .watch_progress(keys.progress(Service::Alert))
        .await
        .unwrap();
    let running = Running::start(&bus, &keys).await;

    estimates.put(block(0, 100, 0.86)).await.unwrap();
    assert_eq!(next(&alerts).await.state, AlertState::Pending);
    let raised = next(&alerts).await;
    assert_eq!(
        (raised.state, raised.time_ns, raised.since_ns),
        (AlertState::Raised, 500_000_000, Some(0))
    );
    assert!(
        raised
            .why
            .starts_with("storey-1 has lost 14.0 % of its stiffness"),
        "{}",
        raised.why
    );
    let done = timeout(DEADLINE, progress.wait_for(|progress| progress.done == 100))
        .await
        .unwrap();
    assert_eq!(done.header.epoch, 1);

    let parameter = Name::new("storey-1").unwrap();
    let person = bus
        .publish_display(keys.acknowledge(&parameter))
        .await
        .unwrap();
    let acknowledgement = Acknowledgement {
        structure: Name::new("tower").unwrap(),
        parameter,
        time_ns: 0,
        who: "Ada".into(),
        note: "crew is under way".into(),
    };
    person.put(&acknowledgement).await.unwrap();
    let acknowledged = next(&alerts).await;
    assert_eq!(acknowledged.state, AlertState::Acknowledged);
    assert_eq!(acknowledged.acknowledged_by.as_deref(), Some("Ada"));

    let last: Vec<(String, AlertMessage)> = bus.ask(&keys.all_alerts(), DEADLINE).await.unwrap();
    assert_eq!(
        last.into_iter().map(|(_, alert)| alert).collect::<Vec<_>>(),
        [acknowledged]
    );
    running.end(bus).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn estimates_published_before_the_start_of_the_service_are_decided() {
    let (bus, keys, estimates) = open("alert-test-b").await;
    estimates.put(block(0, 70, 0.86)).await.unwrap();
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let running = Running::start(&bus, &keys).await;
    assert_eq!(next(&alerts).await.state, AlertState::Pending);
    assert_eq!(next(&alerts).await.since_ns, Some(0));
    running.end(bus).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn changed_structure_file_keeps_acknowledgements_and_ends_alerts_it_does_not_raise() {
    let (bus, keys, estimates) = open("alert-test-d").await;
    let folder = tempfile::tempdir().unwrap();
    let remembering = Remembering {
        folder: folder.path().to_owned(),
        every: Duration::from_secs(5),
    };
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let running = Running::start_with(&bus, &keys, STRUCTURE, Some(&remembering)).await;
    estimates.put(block(0, 100, 0.86)).await.unwrap();
    assert_eq!(next(&alerts).await.state, AlertState::Pending);
    assert_eq!(next(&alerts).await.state, AlertState::Raised);
    let parameter = Name::new("storey-1").unwrap();
    let person = bus
        .publish_display(keys.acknowledge(&parameter))
        .await
        .unwrap();
    let acknowledgement = Acknowledgement {
        structure: Name::new("tower").unwrap(),
        parameter: parameter.clone(),
        time_ns: 0,
        who: "Ada".into(),
        note: String::new(),
    };
    person.put(&acknowledgement).await.unwrap();
    assert_eq!(next(&alerts).await.state, AlertState::Acknowledged);
    running.stop().await;

    let commented = format!("# the crew has been there\n{STRUCTURE}");
    let running = Running::start_with(&bus, &keys, &commented, Some(&remembering)).await;
    let again = next(&alerts).await;
    assert_eq!(
        (again.state, again.acknowledged_by.as_deref()),
        (AlertState::Acknowledged, Some("Ada"))
    );
    running.stop().await;

    let lenient = STRUCTURE.replace("loss = 0.05", "loss = 0.3");
    let running = Running::start_with(&bus, &keys, &lenient, Some(&remembering)).await;
    let ended = next(&alerts).await;
    assert_eq!(ended.state, AlertState::Cleared);
    assert!(
        ended
            .why
            .starts_with("alert of storey-1 has ended: its rule changed from more than 5 %"),
        "{}",
        ended.why
    );
    assert_eq!(next(&alerts).await.state, AlertState::Normal);
    // A late subscriber receives the changes from the log, also after a restart of the service.
    running.stop().await;
    let running = Running::start_with(&bus, &keys, &lenient, Some(&remembering)).await;
    let log: Vec<(String, HistoryLog)> = bus.ask(&keys.alert_log(), DEADLINE).await.unwrap();
    let states: Vec<AlertState> = log[0].1.alerts.iter().map(|alert| alert.state).collect();
    let told = ["pending", "raised", "acknowledged", "cleared", "normal"];
    assert_eq!(
        states
            .iter()
            .map(|state| state.as_str())
            .collect::<Vec<_>>(),
        told
    );
    running.end(bus).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn token_exists_while_the_service_runs() {
    let (bus, keys, _estimates) = open("alert-test-c").await;
    let mut live = bus.watch_live(keys.all_live(Service::Alert)).await.unwrap();
    let running = Running::start(&bus, &keys).await;
    timeout(DEADLINE, live.some()).await.unwrap();
    running.stop.send(()).unwrap();
    timeout(DEADLINE, running.service).await.unwrap().unwrap();
    timeout(DEADLINE, live.none()).await.unwrap();
    bus.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn alert_is_unconfirmed_and_counted_while_the_data_contradict_the_model() {
    let (bus, keys, estimates) = open("alert-test-undecided").await;
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let statuses = bus
        .subscribe::<Status>(keys.all_statuses(), 100)
        .await
        .unwrap();
    let running = Running::start(&bus, &keys).await;
    let contradicted = |sequence| {
        let mut block = block(sequence, 300, 0.5);
        for estimate in &mut block.estimates {
            estimate.flags.fit = Some(FitVerdict::Contradicted);
            estimate.flags.fit_reasons = [FitReason::ExcessNoise].into_iter().collect();
        }
        block
    };
    estimates.put(contradicted(0)).await.unwrap();
    let undecided = next(&alerts).await;
    let because = Some(UndecidedBecause::FitContradicted);
    assert_eq!(
        (undecided.state, undecided.time_ns),
        (AlertState::Undecided, 1_000_000_000)
    );
    assert_eq!(
        (undecided.undecided_because, undecided.fit),
        (because, Some(FitVerdict::Contradicted))
    );
    let counted = async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if !status.undecided.is_empty() {
                return status.undecided;
            }
        }
    };
    let counted = timeout(DEADLINE, counted).await.unwrap();
    assert_eq!(counted, [(UndecidedBecause::FitContradicted, 1)].into());

    estimates.put(block(300, 300, 0.86)).await.unwrap();
    let revised = next(&alerts).await;
    assert_eq!(
        (revised.state, revised.revision),
        (AlertState::Undecided, 1)
    );
    assert!((revised.mean - 0.86).abs() < 1e-12, "{revised:?}");
    assert_eq!(next(&alerts).await.state, AlertState::Pending);
    assert_eq!(next(&alerts).await.state, AlertState::Raised);
    estimates.put(contradicted(600)).await.unwrap();
    let unconfirmed = next(&alerts).await;
    assert_eq!(
        (unconfirmed.state, unconfirmed.undecided_because),
        (AlertState::Unconfirmed, because)
    );
    assert!(
        (unconfirmed.mean - 0.86).abs() < 1e-12,
        "the estimate of a contradicted model is not told"
    );
    running.end(bus).await;
}

/// Number of frames of an epoch of the modes, 100 s.
const EPOCH_FRAMES: u64 = 10_000;

/// Returns the tower with a second sensor, whose first mode is declared.
fn with_a_mode() -> String {
    let more = "
[[node.channel]]
name = \"top\"
quantity = \"absolute-acceleration\"
dof = \"floor-2\"
unit = \"m/s2\"
noise-std = 0.005

[modal]
epoch-s = 100
band-hz = [0.3, 10]

[[modal.mode]]
name = \"sway-1\"
frequency-hz = 1.0
";
    format!("{STRUCTURE}{more}")
}

/// Publishes the estimates of an epoch and the mode in it, and waits until the service has compared
/// them: it does so before each status.
async fn epoch(
    number: u64,
    frequency_hz: f64,
    estimates: &NumberedPublisher<EstimateBlock>,
    mode: &DisplayPublisher<ModeDisplay>,
    statuses: &Subscription<Status>,
) {
    for first in (0..EPOCH_FRAMES).step_by(1000) {
        let block = block((number - 1) * EPOCH_FRAMES + first, 1000, 1.0);
        estimates.put(block).await.unwrap();
    }
    let golden = (1.0 + 5_f64.sqrt()) / 2.0; // of two equal storeys, the upper one moves so much more
    let value = |channel: &str, value: f64| ShapeValue {
        channel: channel.to_owned(),
        value: [value, 0.0],
        std: 0.01,
    };
    let display = ModeDisplay {
        structure: Name::new("tower").unwrap(),
        mode: Name::new("sway-1").unwrap(),
        time_ns: (number * EPOCH_FRAMES * 10_000_000) as i64,
        epoch_s: 100.0,
        epochs: number,
        state: ModeState::Tracked,
        partner: None,
        estimate: Some(ModeEstimate {
            frequency_hz,
            frequency_std_hz: 0.004,
            damping: 0.02,
            damping_std: 0.004,
            shape: vec![value("roof", 1.0 / golden), value("top", 1.0)],
            amplitude: 0.1,
        }),
        presence: 1.0,
        machine: false,
        declared_hz: 1.0,
    };
    mode.put(&display).await.unwrap();
    let done = number * EPOCH_FRAMES;
    let mut compared = 0;
    while compared < 2 {
        let received = timeout(DEADLINE, statuses.messages().recv_async()).await;
        let (_, status) = received.unwrap().unwrap();
        compared += u32::from(status.done >= done);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn measured_modes_that_contradict_the_model_leave_alerts_undecided_until_they_agree() {
    let (bus, keys, estimates) = open("alert-test-modes").await;
    let folder = tempfile::tempdir().unwrap();
    let remembering = Remembering {
        folder: folder.path().to_owned(),
        every: Duration::from_secs(5),
    };
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let events: Subscription<Event> = bus.subscribe(keys.event(), 100).await.unwrap();
    let statuses = bus
        .subscribe(keys.statuses(Service::Alert), 100)
        .await
        .unwrap();
    let mode = keys.mode(&Name::new("sway-1").unwrap());
    let mode = bus.publish_display(mode).await.unwrap();
    let next_event = async |kind: EventKind| loop {
        let received = timeout(DEADLINE, events.messages().recv_async()).await;
        let (_, event) = received.unwrap().unwrap();
        if event.kind == kind {
            return event;
        }
    };
    let text = with_a_mode();
    let running = Running::start_with(&bus, &keys, &text, Some(&remembering)).await;
    for number in 1..=3 {
        epoch(number, 1.25, &estimates, &mode, &statuses).await;
    }
    let event = next_event(EventKind::ModelContradicted).await;
    assert_eq!(
        (event.subject.as_str(), event.time_ns),
        ("sway-1", 300_000_000_000)
    );
    let told = "mode sway-1 was measured at 1.2500 ± 0.0040 Hz, and the model has it at 1.0000 ± ";
    assert!(event.why.starts_with(told), "{}", event.why);
    assert_eq!(next(&alerts).await.state, AlertState::Normal);
    estimates.put(block(30_000, 1000, 1.0)).await.unwrap();
    let undecided = next(&alerts).await;
    assert_eq!(undecided.state, AlertState::Undecided);
    assert_eq!(
        undecided.undecided_because,
        Some(UndecidedBecause::FitContradicted)
    );
    assert!(undecided.why.contains(told), "{}", undecided.why);
    running.stop().await;

    let running = Running::start_with(&bus, &keys, &text, Some(&remembering)).await;
    assert_eq!(next(&alerts).await, undecided, "from the checkpoint");
    for first in (31_000..40_000).step_by(1000) {
        estimates.put(block(first, 1000, 1.0)).await.unwrap();
    }
    epoch(5, 1.0, &estimates, &mode, &statuses).await;
    let event = next_event(EventKind::ModelAgrees).await;
    assert_eq!(event.subject, "tower");
    estimates.put(block(50_000, 1000, 1.0)).await.unwrap();
    assert_eq!(next(&alerts).await.state, AlertState::Normal);
    running.end(bus).await;
}
