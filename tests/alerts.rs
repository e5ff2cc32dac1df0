//! The life of an alert through the services, from the damage to the acknowledgement.

use crate::support::{DEADLINE, Process, Record, Site, put_raw, spandrel, two_storeys, within};
use spandrel_bus::{
    AlertMessage, AlertState, Bus, HistoryLog, Name, Service, Subscription, UndecidedBecause,
};

/// Damage of storey 2 at 20 s, and a rule relative to the design.
const DAMAGED: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                       credibility = 0.99\nsustain-s = 5\n\
                       [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 20\nloss = 0.15\n";
/// Storey 2 with 90 % of its design stiffness from the start and damage at 40 s, and a rule
/// relative to the learnt reference.
const WEAK_FROM_THE_START: &str = "[[alert]]\nparameters = [\"storey-2\"]\nloss = 0.05\n\
                                   sustain-s = 5\n\
                                   reference = { learn-s = 25 }\n\
                                   [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 0\n\
                                   loss = 0.10\n\
                                   [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 40\n\
                                   loss = 0.18\n";

/// Running services and all their alert messages.
struct Watched {
    site: Site,
    _services: Process,
    bus: Bus,
    alerts: Subscription<AlertMessage>,
    heard: Vec<AlertMessage>,
}

impl Watched {
    async fn start(structure: &str) -> Self {
        let site = Site::with(&two_storeys(structure));
        let services = site.run();
        Self::join(site, services).await
    }

    async fn join(site: Site, services: Process) -> Self {
        let bus = site.join().await;
        site.wait_for_services(&bus).await;
        let alerts = bus.subscribe(site.keys().all_alerts(), 4096).await.unwrap();
        Self {
            site,
            _services: services,
            bus,
            alerts,
            heard: Vec::new(),
        }
    }

    /// Replays a record, and waits until storey 2 reaches a state.
    async fn replay_until(&mut self, record: &Record, state: AlertState) -> AlertMessage {
        let replay = self.site.replay(record, "max");
        let alert = self.heard_of_storey_2(state).await;
        replay.wait().expect_code(0);
        alert
    }

    async fn heard_of_storey_2(&mut self, state: AlertState) -> AlertMessage {
        loop {
            let (_, alert) = within(
                &format!("storey-2 {state:?}"),
                self.alerts.messages().recv_async(),
            )
            .await
            .unwrap();
            self.heard.push(alert.clone());
            if alert.parameter.as_str() == "storey-2" && alert.state == state {
                return alert;
            }
        }
    }

    fn states_of(&self, parameter: &str) -> Vec<AlertState> {
        self.heard
            .iter()
            .filter(|alert| alert.parameter.as_str() == parameter)
            .map(|alert| alert.state)
            .collect()
    }

    async fn acknowledge(&self, parameter: &str, json: &str) {
        let key = self.site.keys().acknowledge(&Name::new(parameter).unwrap());
        put_raw(&self.bus, &key, "application/json", json.into()).await;
    }
}

/// Converts nanoseconds to seconds of measurement time.
fn seconds(time_ns: i64) -> f64 {
    time_ns as f64 * 1e-9
}

#[track_caller]
fn assert_says(alert: &AlertMessage, parts: &[&str]) {
    for part in parts {
        assert!(
            alert.why.contains(part),
            "why of the alert\n  expected {part}\n  found    {}",
            alert.why
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn damage_is_pending_for_the_sustain_time_and_then_raised() {
    let mut watched = Watched::start(DAMAGED).await;
    let record = watched.site.simulate(60.0);
    let raised = watched.replay_until(&record, AlertState::Raised).await;
    let states = watched.states_of("storey-2");
    assert_eq!(
        states[states.len() - 2..],
        [AlertState::Pending, AlertState::Raised],
        "all states: {states:?}"
    );
    let since_s = seconds(raised.since_ns.unwrap());
    assert!(
        (20.0..40.0).contains(&since_s),
        "credible since {since_s} s, damaged at 20 s"
    );
    let sustained_s = seconds(raised.time_ns) - since_s;
    // The loss is sudden, and no new alert is raised in its first 8 s.
    assert!(
        (4.989..8.011).contains(&sustained_s),
        "raised {sustained_s} s after the loss was credible"
    );
    assert!(
        !watched.states_of("storey-1").contains(&AlertState::Raised),
        "storey 1 is sound: {:?}",
        watched.heard
    );
}

/// By this limit, all of the record is strong motion.
#[tokio::test(flavor = "multi_thread")]
async fn a_loss_in_strong_motion_is_softening_and_raises_nothing() {
    let limited = format!("{DAMAGED}[earthquakes]\nstrong-m-per-s2 = 0.2\n");
    let mut watched = Watched::start(&limited).await;
    let keys = watched.site.keys();
    let mut decided = watched
        .bus
        .watch_progress(keys.progress(Service::Alert))
        .await
        .unwrap();
    let record = watched.site.simulate(60.0);
    let state = AlertState::SofteningInMotion;
    let soft = watched.replay_until(&record, state).await;
    assert_says(
        &soft,
        &[
            "storey-2 is softer by",
            "in strong motion of up to",
            "whether this amplitude explains it is not known yet",
        ],
    );
    let all = decided.wait_for(|progress| progress.done >= 6000);
    within("decisions on the whole record", all).await;
    let logs = watched
        .bus
        .ask::<HistoryLog>(&keys.alert_log(), DEADLINE)
        .await
        .unwrap();
    let changes: Vec<&AlertMessage> = logs.iter().flat_map(|(_, log)| &log.alerts).collect();
    let is_one =
        |alert: &&&AlertMessage| matches!(alert.state, AlertState::Pending | AlertState::Raised);
    assert!(
        changes.iter().any(|alert| alert.state == state),
        "{changes:?}"
    );
    assert_eq!(changes.iter().find(is_one), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_raised_alert_states_part_loss_probability_and_start() {
    let mut watched = Watched::start(DAMAGED).await;
    let record = watched.site.simulate(60.0);
    let raised = watched.replay_until(&record, AlertState::Raised).await;
    let since = format!("since {:.2} s", seconds(raised.since_ns.unwrap()));
    let loss = raised.loss.unwrap();
    assert_says(
        &raised,
        &[
            "storey-2 has lost",
            "of its stiffness",
            "95 % interval",
            "more than 5 %",
            "probability",
            &since,
        ],
    );
    assert!(
        raised.credibility >= 0.99 && raised.rule_credibility == 0.99,
        "{raised:?}"
    );
    assert!(
        (0.05..0.20).contains(&loss),
        "loss {loss} on the way from 0 to 0.15"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn an_alert_is_acknowledged_by_json_with_name_and_note() {
    let mut watched = Watched::start(DAMAGED).await;
    let record = watched.site.simulate(60.0);
    watched.replay_until(&record, AlertState::Raised).await;
    let json = r#"{"structure": "house", "parameter": "storey-2", "time_ns": 0, "who": "anna", "note": "crew sent"}"#;
    watched.acknowledge("storey-2", json).await;
    let acknowledged = watched.heard_of_storey_2(AlertState::Acknowledged).await;
    assert_eq!(acknowledged.acknowledged_by.as_deref(), Some("anna"));
    assert_says(&acknowledged, &["acknowledged by anna: crew sent"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_later_query_returns_the_last_alert() {
    let mut watched = Watched::start(DAMAGED).await;
    let record = watched.site.simulate(60.0);
    let raised = watched.replay_until(&record, AlertState::Raised).await;
    let keys = watched.site.keys();
    let later = watched.site.join().await;
    let of_storey_2 = later
        .ask::<AlertMessage>(&keys.alert(&raised.parameter), DEADLINE)
        .await
        .unwrap();
    let [(key, last)] = &of_storey_2[..] else {
        panic!("answers: {of_storey_2:?}")
    };
    // The loss may have been revised since.
    assert_eq!(
        (key, last.state, last.since_ns),
        (
            &keys.alert(&raised.parameter),
            raised.state,
            raised.since_ns
        )
    );
    let of_all = later
        .ask::<AlertMessage>(&keys.all_alerts(), DEADLINE)
        .await
        .unwrap();
    assert!(
        of_all.contains(&of_storey_2[0]),
        "answers to alert/*: {of_all:?}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rule_with_a_learnt_reference_finds_damage_of_an_initially_weak_storey() {
    let mut watched = Watched::start(WEAK_FROM_THE_START).await;
    let record = watched.site.simulate(80.0);
    let raised = watched.replay_until(&record, AlertState::Raised).await;
    // No reference is learnt while the noise levels are in training.
    let mut states = watched.states_of("storey-2");
    states.retain(|state| *state != AlertState::Undecided);
    states.dedup();
    assert_eq!(
        states[..2],
        [AlertState::Learning, AlertState::Normal],
        "all states: {states:?}"
    );
    let (reference, since_s) = (raised.reference.unwrap(), seconds(raised.since_ns.unwrap()));
    assert!(
        (reference - 0.90).abs() < 0.02,
        "learnt {reference}, built with 0.90"
    );
    assert!(
        (40.0..60.0).contains(&since_s),
        "credible since {since_s} s, damaged at 40 s"
    );
    assert_says(&raised, &["storey-2 has lost"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_baseline_from_recordings_replaces_learning() {
    let site = Site::with(&two_storeys(WEAK_FROM_THE_START));
    let sound = site.simulate(38.0);
    let baseline = site.folder().join("house.baseline.json");
    let mut learn = spandrel("baseline");
    learn
        .arg(site.structure_file())
        .arg("--record")
        .arg(sound.path())
        .arg("--output")
        .arg(&baseline);
    // A simulated building does not differ between records.
    learn.args(["--between-std", "0"]);
    Process::start(&mut learn).wait().expect_code(0);
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(
        &configuration,
        "[baselines]\nhouse = \"house.baseline.json\"\n",
    )
    .unwrap();
    let services = Process::start(site.listening("run").arg("--config").arg(&configuration));
    services.wait_for_log("ready structures=1");
    let mut watched = Watched::join(site, services).await;
    let record = watched.site.simulate(80.0);
    let raised = watched.replay_until(&record, AlertState::Raised).await;
    let reference = raised.reference.unwrap();
    assert!(
        (reference - 0.90).abs() < 0.02,
        "learnt {reference}, built with 0.90"
    );
    assert!(
        !watched
            .states_of("storey-2")
            .contains(&AlertState::Learning),
        "{:?}",
        watched.states_of("storey-2")
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_alert_service_raises_the_same_alert_after_its_restart() {
    let site = Site::with(&two_storeys(DAMAGED));
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let _identify = Process::start(&mut site.connecting("identify"));
    let alert = Process::start(&mut site.connecting("alert"));
    let mut watched = Watched::join(site, ingest).await;
    let record = watched.site.simulate(60.0);
    let raised = watched.replay_until(&record, AlertState::Raised).await;
    alert.kill();
    let _alert = Process::start(&mut watched.site.connecting("alert"));
    let again = watched.heard_of_storey_2(AlertState::Raised).await;
    assert_eq!(
        (again.state, again.since_ns),
        (raised.state, raised.since_ns),
        "{again:?}"
    );
}

/// Undecided alerts must not appear as normal, and must be published.
#[tokio::test(flavor = "multi_thread")]
async fn alerts_without_a_measured_excitation_are_undecided_with_a_reason() {
    let mut watched = Watched::start(DAMAGED).await;
    let record = watched.site.simulate(20.0);
    let text = std::fs::read_to_string(record.path()).unwrap();
    let ground = text
        .lines()
        .next()
        .unwrap()
        .split(',')
        .position(|name| name.starts_with("ground"))
        .unwrap();
    let without = text.lines().enumerate().map(|(row, line)| {
        let mut cells: Vec<&str> = line.split(',').collect();
        if row > 0 {
            cells[ground] = "";
        }
        cells.join(",") + "\n"
    });
    std::fs::write(record.path(), without.collect::<String>()).unwrap();
    let undecided = watched.replay_until(&record, AlertState::Undecided).await;
    // The noise levels come first.
    assert_eq!(
        undecided.undecided_because,
        Some(UndecidedBecause::NoiseTraining)
    );
    assert_says(
        &undecided,
        &[
            "no decision on storey-2",
            "the filter is still learning its noise levels",
        ],
    );
    let mut estimate = spandrel("estimate");
    estimate
        .arg(watched.site.structure_file())
        .arg("--record")
        .arg(record.path())
        .arg("--json");
    let summary: serde_json::Value =
        serde_json::from_str(&Process::start(&mut estimate).wait().expect_code(0).stdout).unwrap();
    assert_eq!(
        summary["decided"]["storey-2"]["share"],
        serde_json::json!(0.0),
        "{summary}"
    );
    let warned = summary["warnings"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|warning| warning.as_str());
    assert_eq!(
        warned
            .filter(|warning| warning.starts_with("no decision on storey-2"))
            .count(),
        1,
        "{summary}"
    );
}

#[test]
fn log_in_json_is_one_object_per_line() {
    let site = Site::with(&two_storeys(DAMAGED));
    let record = site.simulate(30.0);
    let mut command = spandrel("estimate");
    command
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path())
        .args(["--log", "json", "-vv"]);
    let finished = Process::start(&mut command).wait().expect_code(0);
    let lines: Vec<serde_json::Value> = finished
        .stderr
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}")))
        .collect();
    assert!(!lines.is_empty(), "nothing was logged");
    for line in &lines {
        assert!(
            line["timestamp"].is_string()
                && line["level"].is_string()
                && line["fields"].is_object(),
            "{line}"
        );
    }
}

/// A sound parameter must be published even before its first change, so that new views and queries
/// receive its state.
#[tokio::test(flavor = "multi_thread")]
async fn query_returns_the_normal_state_of_a_sound_parameter() {
    let rule = "[[alert]]\nparameters = [\"storey-1\"]\nloss = 0.2\ncredibility = 0.99\n\
                reference.design-std = 1e-9\n";
    let watched = Watched::start(rule).await;
    let view = watched.site.watch();
    let record = watched.site.simulate(20.0);
    watched.site.replay(&record, "max").wait().expect_code(0);
    let is_normal = |said: &str| {
        said.lines()
            .any(|line| line.contains("storey-1 ") && line.contains(" normal, storey-2 "))
    };
    view.wait_for_output("storey-1 … normal, storey-2 …", is_normal);
    let keys = watched.site.keys();
    let later = watched.site.join().await;
    let answers = later
        .ask::<AlertMessage>(&keys.all_alerts(), DEADLINE)
        .await
        .unwrap();
    let told: Vec<(&str, AlertState, f64)> = answers
        .iter()
        .map(|(_, alert)| (alert.parameter.as_str(), alert.state, alert.rule_loss))
        .collect();
    assert_eq!(
        told,
        [("storey-1", AlertState::Normal, 0.2)],
        "no rule watches storey 2"
    );
    let afresh = watched.site.watch();
    let live = watched.site.replay(&record, "10");
    afresh.wait_for_output("storey-1 … normal, storey-2 …", is_normal);
    drop(live);
}

/// A view must mark the alerts of a terminated alert service as stale.
#[tokio::test(flavor = "multi_thread")]
async fn alerts_of_a_killed_alert_service_are_stale_until_its_restart() {
    let site = Site::with(&two_storeys(DAMAGED));
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let _identify = Process::start(&mut site.connecting("identify"));
    let alert = Process::start(&mut site.connecting("alert"));
    let mut watched = Watched::join(site, ingest).await;
    let view = watched.site.watch();
    let record = watched.site.simulate(60.0);
    watched.replay_until(&record, AlertState::Raised).await;
    view.wait_for_output("raised;", |said| said.contains(" raised;"));
    alert.kill();
    view.wait_for_output("raised (stale);", |said| said.contains(" raised (stale);"));
    let before = view.output().len();
    let _alert = Process::start(&mut watched.site.connecting("alert"));
    view.wait_for_output("raised; again", |said| said[before..].contains(" raised;"));
}
