//! The alert service on a real Zenoh session: estimates in, alerts out, acknowledgements back.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a helper of tests may fail them")]

use std::path::Path;
use std::time::Duration;

use spandrel_alert::AlertService;
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Bus, BusConfig, Estimate, EstimateBlock, EstimateFlags, Header, Keys,
    Name, NumberedPublisher, NumberedStream, Phase, Service, StreamState, Subscription,
};
use spandrel_structure::Structure;
use tokio::sync::oneshot;
use tokio::time::timeout;

/// Ends a hang; nothing here takes a second.
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
        flags: EstimateFlags { phase: Phase::Working, restarted: false, prediction_only: false },
    }
}

fn block(sequence: u64, count: usize, mean: f64) -> EstimateBlock {
    EstimateBlock {
        header: Header { source: "identify-1".into(), epoch: 1, sequence, time_ns: sequence as i64 * 10_000_000 },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 1,
        noise_parameters: 0,
        channels: 1,
        estimates: vec![estimate(mean); count],
        state: StreamState::Running,
    }
}

/// Both sides of the bus: a session, and the estimates put on it.
async fn open(root: &str) -> (Bus, Keys, NumberedPublisher<EstimateBlock>) {
    let config = BusConfig { root: root.into(), listen: vec!["tcp/127.0.0.1:0".into()], ..BusConfig::default() };
    let bus = Bus::open(&config).await.unwrap();
    let keys = config.keys("tower").unwrap();
    let stream = NumberedStream {
        key: keys.estimates(),
        buffer_key: keys.estimates_buffer(),
        source: "identify-1".into(),
        epoch: 1,
        capacity: 10_000,
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
        let structure = Structure::parse(STRUCTURE, Path::new("tower.toml")).unwrap_or_else(|error| panic!("{error}"));
        let id = Name::new("alert-1").unwrap();
        let running = AlertService::start(&structure, None, bus, keys.clone(), id).await.unwrap();
        let (stop, stopped) = oneshot::channel();
        let service = tokio::spawn(async move {
            let stopped = async move { drop(stopped.await) };
            running.run(stopped).await.unwrap();
        });
        Self { stop, service }
    }

    async fn end(self, bus: Bus) {
        self.stop.send(()).unwrap();
        timeout(DEADLINE, self.service).await.unwrap().unwrap();
        bus.close().await.unwrap();
    }
}

async fn next(alerts: &Subscription<AlertMessage>) -> AlertMessage {
    timeout(DEADLINE, alerts.messages().recv_async()).await.unwrap().unwrap().1
}

#[tokio::test(flavor = "multi_thread")]
async fn loss_is_raised_acknowledged_and_answered_on_query() {
    let (bus, keys, estimates) = open("alert-test-a").await;
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let mut progress = bus.watch_progress(keys.progress(Service::Alert)).await.unwrap();
    let running = Running::start(&bus, &keys).await;

    estimates.put(block(0, 100, 0.86)).await.unwrap();
    assert_eq!(next(&alerts).await.state, AlertState::Pending);
    let raised = next(&alerts).await;
    assert_eq!((raised.state, raised.time_ns, raised.since_ns), (AlertState::Raised, 500_000_000, Some(0)));
    assert!(raised.why.starts_with("storey-1 has lost 14 % of its stiffness"), "{}", raised.why);
    let done = timeout(DEADLINE, progress.wait_for(|progress| progress.done == 100)).await.unwrap();
    assert_eq!(done.header.epoch, 1);

    let parameter = Name::new("storey-1").unwrap();
    let person = bus.publish_display(keys.acknowledge(&parameter)).await.unwrap();
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
    assert_eq!(last.into_iter().map(|(_, alert)| alert).collect::<Vec<_>>(), [acknowledged]);
    running.end(bus).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn estimates_put_before_the_service_came_are_decided_too() {
    let (bus, keys, estimates) = open("alert-test-b").await;
    estimates.put(block(0, 70, 0.86)).await.unwrap();
    let alerts = bus.subscribe(keys.all_alerts(), 100).await.unwrap();
    let running = Running::start(&bus, &keys).await;
    assert_eq!(next(&alerts).await.state, AlertState::Pending);
    assert_eq!(next(&alerts).await.since_ns, Some(0));
    running.end(bus).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn token_is_there_while_the_service_runs() {
    let (bus, keys, _estimates) = open("alert-test-c").await;
    let mut live = bus.watch_live(keys.all_live(Service::Alert)).await.unwrap();
    let running = Running::start(&bus, &keys).await;
    timeout(DEADLINE, live.some()).await.unwrap();
    running.stop.send(()).unwrap();
    timeout(DEADLINE, running.service).await.unwrap().unwrap();
    timeout(DEADLINE, live.none()).await.unwrap();
    bus.close().await.unwrap();
}
