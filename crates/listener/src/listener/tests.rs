//! Tests with real sessions: messages are collected, and earlier alerts are queried.

use super::*;
use crate::structures::Structures;
use crate::testing::{alert, name, parameter};
use spandrel_bus::{AlertState, BusConfig, Keys};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

const NEEDS: Needs = Needs {
    topics: &[DisplayTopic::Parameters, DisplayTopic::Alerts],
    services: &Service::ALL,
    logs: &[],
};

/// Only ends a hang; no test takes a second.
const DEADLINE: Duration = Duration::from_secs(30);

async fn open() -> (Bus, Keys) {
    let config = BusConfig {
        root: "watched".into(),
        listen: vec!["tcp/127.0.0.1:0".into()],
        ..BusConfig::default()
    };
    (
        Bus::open(&config).await.unwrap(),
        config.keys("tower").unwrap(),
    )
}

/// Returns the parameters of `tower` with an alert.
fn alerts(structures: &Structures) -> Vec<&str> {
    let tower = structures.structure(&Name::new("tower").unwrap());
    let alerts = tower.iter().flat_map(|tower| tower.alerts.keys());
    alerts.map(Name::as_str).collect()
}

/// Collects messages until `done`. The deadline only ends a hang.
async fn gather_until(listener: &mut Listener, done: impl Fn(&Structures) -> bool) -> Structures {
    let mut structures = Structures::default();
    let gathered = tokio::time::timeout(DEADLINE, async {
        while !done(&structures) {
            for input in listener.gather() {
                structures.handle(input, &mut Vec::new());
            }
            tokio::task::yield_now().await;
        }
    });
    gathered.await.unwrap();
    structures
}

#[tokio::test(flavor = "multi_thread")]
async fn earlier_alerts_are_queried_and_later_alerts_received() {
    let (bus, keys) = open().await;
    let before = bus
        .publish_latest(keys.alert(&name("storey-1")))
        .await
        .unwrap();
    before
        .put(&alert("storey-1", 1, AlertState::Raised))
        .await
        .unwrap();
    let mut listener = Listener::start(&bus, keys.root(), None, NEEDS)
        .await
        .unwrap();
    gather_until(&mut listener, |structures| {
        alerts(structures) == ["storey-1"]
    })
    .await;
    let later = bus
        .publish_latest(keys.alert(&name("storey-2")))
        .await
        .unwrap();
    later
        .put(&alert("storey-2", 2, AlertState::Pending))
        .await
        .unwrap();
    let structures = gather_until(&mut listener, |structures| !alerts(structures).is_empty()).await;
    assert_eq!(alerts(&structures), ["storey-2"]);
}

/// Announces an alert service that replies to queries and publishes nothing. `current` returns the
/// alert of storey-1 at a query, by its number. The service ends with the session.
async fn announce_alerts(
    bus: &Bus,
    keys: &Keys,
    current: impl Fn(u32) -> Option<AlertMessage> + Send + 'static,
) -> spandrel_bus::LiveToken {
    let key = keys.alert(&name("storey-1"));
    let queries = bus.session().declare_queryable(&key).await.unwrap();
    tokio::spawn(async move {
        for number in 0.. {
            let Ok(query) = queries.recv_async().await else {
                return;
            };
            if let Some(alert) = current(number) {
                let reply = query.reply(&key, alert.encode().unwrap());
                reply.encoding(AlertMessage::encoding()).await.unwrap();
            }
        }
    });
    let token = keys.live(Service::Alert, &name("alert"));
    bus.announce(token).await.unwrap()
}

/// Returns `true` if storey-1 has an alert in this state.
fn has_alert(structures: &Structures, state: AlertState) -> bool {
    let tower = structures.structure(&name("tower"));
    tower.is_some_and(|tower| {
        let alert = tower.alerts.get(&name("storey-1"));
        alert.is_some_and(|alert| alert.state == state)
    })
}

// A page that could not reach the alert service at first never showed its standing alerts.
#[tokio::test(flavor = "multi_thread")]
async fn standing_alerts_are_queried_until_the_alert_service_replies() {
    let (bus, keys) = open().await;
    let mut listener = Listener::start(&bus, keys.root(), None, NEEDS)
        .await
        .unwrap();
    // The listener asks once at its start, and once when the service appears.
    let raised = |number| (number > 1).then(|| alert("storey-1", 1, AlertState::Raised));
    let _token = announce_alerts(&bus, &keys, raised).await;
    gather_until(&mut listener, |structures| {
        has_alert(structures, AlertState::Raised)
    })
    .await;
}

// A page that missed the change showed the former state of the alert for as long as it stood.
#[tokio::test(flavor = "multi_thread")]
async fn change_of_an_alert_that_the_network_drops_is_received_by_a_later_query() {
    let (bus, keys) = open().await;
    let mut listener = Listener::start(&bus, keys.root(), None, NEEDS)
        .await
        .unwrap();
    let is_raised = Arc::new(AtomicBool::new(false));
    let is_raised_now = is_raised.clone();
    let current = move |_| match is_raised_now.load(Ordering::Relaxed) {
        true => Some(alert("storey-1", 2, AlertState::Raised)),
        false => Some(alert("storey-1", 1, AlertState::Pending)),
    };
    let _token = announce_alerts(&bus, &keys, current).await;
    gather_until(&mut listener, |structures| {
        has_alert(structures, AlertState::Pending)
    })
    .await;
    while listener.asked.join_next().await.is_some() {}
    is_raised.store(true, Ordering::Relaxed);
    listener.ask_again_at = Instant::now();
    gather_until(&mut listener, |structures| {
        has_alert(structures, AlertState::Raised)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn values_and_tokens_of_all_structures_are_received() {
    let (bus, keys) = open().await;
    let mut listener = Listener::start(&bus, keys.root(), None, NEEDS)
        .await
        .unwrap();
    for structure in ["tower", "bridge"] {
        let keys = Keys::new(keys.root().clone(), name(structure));
        let mut value = parameter("storey-1", 0);
        value.structure = name(structure);
        let values = bus
            .publish_display(keys.parameter(&value.parameter))
            .await
            .unwrap();
        values.put(&value).await.unwrap();
    }
    let _token = bus
        .announce(keys.live(Service::Ingest, &name("a")))
        .await
        .unwrap();
    let is_complete = |structures: &Structures| {
        let is_there = |(service, _): &(Service, Name)| *service == Service::Ingest;
        let has_token = structures
            .structure(&name("tower"))
            .is_some_and(|tower| tower.instances.keys().any(is_there));
        has_token
            && structures
                .structures()
                .filter(|(_, structure)| !structure.parameters.is_empty())
                .count()
                == 2
    };
    let structures = gather_until(&mut listener, is_complete).await;
    assert_eq!(structures.left_out(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn listener_can_be_limited_to_one_structure() {
    let (bus, keys) = open().await;
    let mut listener = Listener::start(&bus, keys.root(), Some(&name("tower")), NEEDS)
        .await
        .unwrap();
    for structure in ["bridge", "tower"] {
        let mut value = parameter("storey-1", 0);
        value.structure = name(structure);
        let keys = Keys::new(keys.root().clone(), name(structure));
        bus.publish_display(keys.parameter(&value.parameter))
            .await
            .unwrap()
            .put(&value)
            .await
            .unwrap();
    }
    let structures = gather_until(&mut listener, |structures| {
        structures.structures().len() > 0
    })
    .await;
    assert_eq!(
        structures
            .structures()
            .map(|(name, _)| name.as_str())
            .collect::<Vec<_>>(),
        ["tower"]
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn new_alert_service_is_queried_for_its_alerts() {
    let (bus, keys) = open().await;
    // Before the subscription, so that only a query can return it.
    let latest = bus
        .publish_latest(keys.alert(&name("storey-1")))
        .await
        .unwrap();
    latest
        .put(&alert("storey-1", 1, AlertState::Raised))
        .await
        .unwrap();
    let mut listener = Listener::start(&bus, keys.root(), None, NEEDS)
        .await
        .unwrap();
    while listener.asked.join_next().await.is_some() {} // discards the reply to the first query
    let _token = bus
        .announce(keys.live(Service::Alert, &name("a")))
        .await
        .unwrap();
    let is_answered = |structures: &Structures| alerts(structures) == ["storey-1"];
    gather_until(&mut listener, is_answered).await;
}
