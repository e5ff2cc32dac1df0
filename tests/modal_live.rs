//! The service `modes`: the natural frequencies of live frames are those of the recording, bit for
//! bit, also after a crash.

use crate::support::{DEADLINE, Process, Record, Site, spandrel, within};
use serde_json::Value;
use spandrel_bus::{
    Bus, Event, EventKind, JudgementDisplay, ModeDisplay, ModeState, MonitoringDisplay, Name,
    ParameterDisplay, Service, Status, Subscription,
};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;

/// Length of the epochs (s).
const EPOCH_S: u32 = 100;
/// Number of epochs in the record.
const EPOCHS: u64 = 4;
/// Length of the record (s). The last epoch ends shortly before.
const RECORD_S: f64 = 410.0;

/// Returns the site of the example, with short epochs. The mode `far` does not exist.
fn ambient() -> Site {
    let text = include_str!("../docs/examples/modes/ambient.toml");
    let short = text.replace("epoch-s = 300", &format!("epoch-s = {EPOCH_S}"));
    assert_ne!(text, short);
    let mode = "\n[[modal.mode]]\nname = \"far\"\nfrequency-hz = 8.5\n";
    Site::with(&format!("{short}{mode}"))
}

/// Returns the messages that the offline command gives for a record, and its events.
fn offline(site: &Site, record: &Record) -> (Messages, Vec<Event>) {
    let mut command = spandrel("modes");
    command.arg(record.path()).arg(site.structure_file());
    let said = Process::start(command.arg("--json")).wait().expect_code(0);
    let json: Value = serde_json::from_str(&said.stdout).unwrap();
    let displays: Vec<ModeDisplay> =
        serde_json::from_value(json["declared_modes"].clone()).unwrap();
    let events = serde_json::from_value(json["events"].clone()).unwrap();
    (by_epoch(displays), events)
}

/// Messages by epoch and mode.
type Messages = BTreeMap<(u64, String), ModeDisplay>;

fn by_epoch(displays: Vec<ModeDisplay>) -> Messages {
    let keyed = displays
        .into_iter()
        .map(|display| ((display.epochs, display.mode.to_string()), display));
    keyed.collect()
}

/// Collects messages until those of the last epoch have arrived. A repetition must be equal.
async fn collect(modes: &Subscription<ModeDisplay>, found: &mut Messages, last: u64, count: usize) {
    let is_complete =
        |found: &Messages| found.keys().filter(|(epoch, _)| *epoch == last).count() == count;
    within(&format!("the modes of epoch {last}"), async {
        while !is_complete(found) {
            let (_, display) = modes.messages().recv_async().await.unwrap();
            let key = (display.epochs, display.mode.to_string());
            let earlier = found.insert(key, display.clone());
            assert!(earlier.is_none_or(|earlier| earlier == display));
        }
    })
    .await;
}

/// Compares messages with the time of the replay. The recording has other times, by a constant.
fn assert_equal(live: &Messages, recorded: &Messages) {
    assert_eq!(live.len(), recorded.len());
    let mut shifts_ns: Vec<i64> = Vec::new();
    for (key, display) in live {
        let expected = &recorded[key];
        shifts_ns.push(display.time_ns - expected.time_ns);
        let shifted = ModeDisplay {
            time_ns: display.time_ns,
            ..expected.clone()
        };
        assert_eq!(*display, shifted);
    }
    shifts_ns.dedup();
    assert_eq!(shifts_ns.len(), 1, "{shifts_ns:?}");
}

/// Waits until the service `modes` has processed this much of the record (s).
async fn wait_for_processed(site: &Site, bus: &Bus, seconds: u32) {
    let key = site.keys().progress(Service::Modes);
    let mut progress = bus.watch_progress(key).await.unwrap();
    let rate_hz = site.structure().modal().unwrap().settings.rate_hz;
    let frames = (f64::from(seconds) * rate_hz) as u64;
    let processed = progress.wait_for(|progress| progress.done >= frames);
    within(&format!("{seconds} s of modes"), processed).await;
}

fn with_state<'c>(command: &'c mut Command, site: &Site) -> &'c mut Command {
    command.env("XDG_STATE_HOME", site.folder().join("state"))
}

#[tokio::test(flavor = "multi_thread")]
async fn live_modes_are_those_of_the_recording_and_survive_a_crash() {
    let site = ambient();
    let record = site.simulate(RECORD_S);
    let (recorded, told) = offline(&site, &record);
    let count = site.structure().modal().unwrap().modes.len();
    assert_eq!(recorded.len(), count * EPOCHS as usize);
    let sway: Vec<&ModeDisplay> = recorded
        .values()
        .filter(|display| display.mode.as_str() == "sway-2")
        .collect();
    for display in sway {
        let estimate = display.estimate.as_ref().unwrap();
        assert_eq!(display.state, ModeState::Tracked);
        assert!((estimate.frequency_hz - 2.92).abs() < 0.05, "{display:?}");
        assert_eq!(estimate.shape.len(), 5);
    }
    let far = &recorded[&(EPOCHS, "far".to_owned())];
    assert_eq!((far.state, far.presence), (ModeState::Missing, 0.0));

    let start = || {
        let process = Process::start(with_state(&mut site.listening("run"), &site));
        process.wait_for_log("ready structures=1");
        process
    };
    let run = start();
    let bus = site.join().await;
    let modes = bus.subscribe(site.keys().all_modes(), 4096).await.unwrap();
    let events: Subscription<Event> = bus.subscribe(site.keys().event(), 1024).await.unwrap();
    site.replay(&record, "max").wait().expect_code(0);
    let mut live = Messages::new();
    collect(&modes, &mut live, EPOCHS, count).await;
    assert_equal(&live, &recorded);
    let of_modes = |event: &Event| {
        let kinds = [
            EventKind::ModeProposed,
            EventKind::ModeFound,
            EventKind::ModeLost,
            EventKind::ModePaired,
            EventKind::ModeParted,
        ];
        kinds.contains(&event.kind)
    };
    let expected: Vec<(EventKind, String)> = told
        .iter()
        .map(|event| (event.kind, event.subject.clone()))
        .collect();
    assert!(!expected.is_empty());
    let mut heard = Vec::new();
    within("the events of the modes", async {
        while heard.len() < expected.len() {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if of_modes(&event) {
                heard.push((event.kind, event.subject));
            }
        }
    })
    .await;
    assert_eq!(heard, expected);

    run.kill();
    while modes.messages().try_recv().is_ok() {}
    let _run = start();
    let mut again = Messages::new();
    collect(&modes, &mut again, EPOCHS, count).await;
    let last = live.into_iter().filter(|((epoch, _), _)| *epoch == EPOCHS);
    assert_eq!(again, last.collect::<Messages>(), "from the checkpoint");
}

/// Kills only this service in the middle of an epoch, while frames arrive.
#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_is_killed_in_an_epoch_gives_the_same_modes() {
    let site = ambient();
    let record = site.simulate(RECORD_S);
    let (recorded, _) = offline(&site, &record);
    let count = site.structure().modal().unwrap().modes.len();
    let ingest = Process::start(with_state(&mut site.listening("ingest"), &site));
    ingest.wait_for_log("ready structures=1");
    let start = |subcommand: &str, more: &[&str]| {
        let mut command = site.connecting(subcommand);
        let process = Process::start(with_state(command.args(more), &site));
        process.wait_for_log("ready structures=1");
        process
    };
    let _others = [start("identify", &[]), start("alert", &[])];
    let modes = start("modes", &["--live"]);
    let bus = site.join().await;
    let heard = bus.subscribe(site.keys().all_modes(), 4096).await.unwrap();
    let replay = site.replay(&record, "40");
    let mut live = Messages::new();
    collect(&heard, &mut live, 1, count).await;
    let in_the_second_epoch_s = EPOCH_S + 40;
    wait_for_processed(&site, &bus, in_the_second_epoch_s).await;
    modes.kill();
    let _modes = start("modes", &["--live"]);
    collect(&heard, &mut live, EPOCHS, count).await;
    replay.wait().expect_code(0);
    assert_equal(&live, &recorded);
}

#[test]
fn the_declared_tables_follow_the_same_modes() {
    let site = ambient();
    let record = site.simulate(RECORD_S);
    let declare = |more: &[&str]| {
        let mut command = spandrel("modes");
        command.arg(record.path()).args(more).arg("--declare");
        Process::start(&mut command).wait().expect_code(0).stdout
    };
    let epoch = EPOCH_S.to_string();
    let tables = declare(&["--epoch", &epoch, "--band", "0.3..10"]);
    assert!(
        tables.starts_with("[modal]\nepoch-s = 100\nband-hz = [0.3, 10]\n"),
        "{tables}"
    );
    let text = include_str!("../docs/examples/modes/ambient.toml");
    let (before, rest) = text.split_once("[modal]").unwrap();
    let (_, after) = rest.split_once("[simulation]").unwrap();
    let declared = Site::with(&format!("{before}{tables}\n[simulation]{after}"));
    let plan = declared.structure().modal().unwrap();
    assert!(plan.modes.len() >= 4, "{tables}");
    let (recorded, _) = offline(&declared, &record);
    for mode in &plan.modes {
        let states = (1..=EPOCHS).map(|epoch| recorded[&(epoch, mode.name.clone())].state);
        let tracked = states.filter(|state| *state == ModeState::Tracked).count();
        assert!(tracked >= 2, "{}: {tracked} epochs", mode.name);
    }
    // With a table that declares a mode, only the others are printed.
    let more = declare(&[&site.structure_file().to_string_lossy()]);
    assert!(
        !more.contains("[modal]\n") && more.contains("name = \"mode-1\""),
        "{more}"
    );
    assert!(!more.contains("frequency-hz = 2.9"), "{more}");
}

/// Returns the site of the example without a model, with short epochs.
fn sensors_only() -> Site {
    let text = include_str!("../docs/examples/modes/sensors-only.toml");
    let short = text.replace("epoch-s = 300", &format!("epoch-s = {EPOCH_S}"));
    assert_ne!(text, short);
    Site::with(&short)
}

/// Requests a path of the page, and returns the status and the JSON or text.
fn get(address: &str, path: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut reply = String::new();
    stream.read_to_string(&mut reply).unwrap();
    let (head, body) = reply.split_once("\r\n\r\n").unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    (status, body.to_owned())
}

/// Without a model, the same samples give the same modes. Nothing waits for a filter or calls the
/// structure blind.
#[tokio::test(flavor = "multi_thread")]
async fn a_structure_without_a_model_has_its_modes_judgements_and_page() {
    let site = sensors_only();
    let with_model = ambient();
    let record = with_model.simulate(RECORD_S);
    let (recorded, _) = offline(&site, &record);
    let (of_model, _) = offline(&with_model, &record);
    for (key, display) in &recorded {
        let expected = ModeDisplay {
            structure: display.structure.clone(),
            ..of_model[key].clone()
        };
        assert_eq!(*display, expected);
    }
    let count = site.structure().modal().unwrap().modes.len();
    assert_eq!(recorded.len(), count * EPOCHS as usize);

    let mut command = site.listening("run");
    command.args(["--http", "127.0.0.1:0"]);
    let run = Process::start(with_state(&mut command, &site));
    run.wait_for_output("address of the page", |said| said.contains("page: http"));
    let said = run.output();
    let address = said.split("://").nth(1).unwrap().split('/').next().unwrap();
    run.wait_for_log("ready structures=1");
    run.wait_for_log("no model to identify, only natural frequencies");
    let bus = site.join().await;
    let keys = site.keys();
    let modes = bus.subscribe(keys.all_modes(), 4096).await.unwrap();
    let monitoring: Subscription<MonitoringDisplay> =
        bus.subscribe(keys.monitoring(), 64).await.unwrap();
    let identify: Subscription<Status> = bus
        .subscribe(keys.statuses(Service::Identify), 64)
        .await
        .unwrap();
    let sway = Name::new("sway-1").unwrap();
    let judgements: Subscription<JudgementDisplay> =
        bus.subscribe(keys.judgement(&sway), 64).await.unwrap();
    let watch = site.watch();
    let replay = site.replay(&record, "40");
    let mut live = Messages::new();
    collect(&modes, &mut live, EPOCHS, count).await;
    assert_equal(&live, &recorded);

    let (status, text) = get(address, "/api/structures/sensors-only");
    assert_eq!(status, 200, "{text}");
    let answer: Value = serde_json::from_str(&text).unwrap();
    let overview = &answer["overview"];
    assert_eq!(overview["has_model"], false, "{overview}");
    assert!(overview["age_s"].as_f64().is_some(), "{overview}");
    assert_eq!(
        (&overview["sensors"]["alive"], &overview["sensors"]["total"]),
        (&5.into(), &5.into())
    );
    assert_eq!(get(address, "/health/ready").0, 200);
    let metrics = get(address, "/metrics").1;
    assert!(metrics.contains("mode=\"sway-1\""), "{metrics}");
    assert!(!metrics.contains("monitoring_state{"), "{metrics}");
    within(
        "the judgement of a frequency",
        judgements.messages().recv_async(),
    )
    .await
    .unwrap();
    watch.wait_for_output("the frequency", |said| {
        said.contains("no model: natural frequencies only; sway-1")
    });
    replay.wait().expect_code(0);
    assert!(monitoring.messages().try_recv().is_err(), "no monitoring");
    assert!(identify.messages().try_recv().is_err(), "no identification");
    run.stop().expect_code(0);
}

#[test]
fn commands_that_need_a_model_name_the_kind_and_its_line() {
    let site = sensors_only();
    let file = site.structure_file().to_str().unwrap().to_owned();
    for (subcommand, more) in [
        ("simulate", &[][..]),
        ("estimate", &["--record", "none.csv"]),
        (
            "baseline",
            &["--record", "none.csv", "--output", "none.json"],
        ),
        ("check", &["--record", "none.csv"]),
    ] {
        let mut command = spandrel(subcommand);
        let finished = Process::start(command.arg(&file).args(more)).wait();
        let told = [
            &format!("{file}:13: model.kind: is \"modal\"")[..],
            "needs a model",
        ];
        finished.expect_code(2).expect_told(&told);
    }
    for subcommand in ["identify", "alert"] {
        let finished = Process::start(&mut site.listening(subcommand)).wait();
        finished
            .expect_code(2)
            .expect_told(&[&format!("nothing for {subcommand}")]);
    }
}

/// Length of the epochs (s) and of the record (s), and number of epochs, of which two are the
/// commissioning.
const UPDATE_EPOCH_S: u32 = 100;
const UPDATE_RECORD_S: f64 = 510.0;
const UPDATE_EPOCHS: usize = 5;

/// Returns the site of the example whose modes update the stiffnesses, with short epochs.
fn stiffness() -> Site {
    let text = include_str!("../docs/examples/modes/stiffness.toml");
    let epoch = format!("epoch-s = {UPDATE_EPOCH_S}");
    let short = text
        .replace("epoch-s = 300", &epoch)
        .replace("commissioning-epochs = 6", "commissioning-epochs = 2")
        .replace("at-s = 1850", "at-s = 350");
    assert_eq!(short.matches(&epoch).count(), 1);
    assert!(short.contains("commissioning-epochs = 2") && short.contains("at-s = 350"));
    Site::with(&short)
}

/// Replays a record and returns the messages of each parameter, in order of time since the first
/// epoch. Kills the service `modes` in the middle of the epochs after those of `kill_after`.
async fn parameters(
    site: &Site,
    record: &Record,
    kill_after: &[u64],
) -> BTreeMap<(String, i64), ParameterDisplay> {
    let ingest = Process::start(with_state(&mut site.listening("ingest"), site));
    ingest.wait_for_log("ready structures=1");
    let start = || {
        let mut command = site.connecting("modes");
        let process = Process::start(with_state(command.arg("--live"), site));
        process.wait_for_log("ready structures=1");
        process
    };
    let mut modes = start();
    let bus = site.join().await;
    let keys = site.keys();
    let frequencies: Subscription<ModeDisplay> =
        bus.subscribe(keys.all_modes(), 4096).await.unwrap();
    let heard: Subscription<ParameterDisplay> =
        bus.subscribe(keys.all_parameters(), 4096).await.unwrap();
    let replay = site.replay(record, "40");
    let first_ns = within("the first epoch", async {
        let (_, display) = frequencies.messages().recv_async().await.unwrap();
        display.time_ns
    })
    .await;
    for epoch in kill_after {
        within("the epoch before the kill", async {
            while frequencies.messages().recv_async().await.unwrap().1.epochs < *epoch {}
        })
        .await;
        let in_the_next_epoch_s = *epoch as u32 * UPDATE_EPOCH_S + 40;
        wait_for_processed(site, &bus, in_the_next_epoch_s).await;
        modes.kill();
        modes = start();
    }
    let names = site.structure().modal().unwrap().update.as_ref().unwrap();
    let count = names.parts.len() * (UPDATE_EPOCHS - 2);
    let mut found = BTreeMap::new();
    within("the parameters of all epochs", async {
        while found.len() < count {
            let (_, display) = heard.messages().recv_async().await.unwrap();
            let time_ns = display.time_ns - first_ns;
            let key = (display.parameter.to_string(), time_ns);
            let shifted = ParameterDisplay { time_ns, ..display };
            let earlier = found.insert(key, shifted.clone());
            assert!(earlier.is_none_or(|earlier| earlier == shifted));
        }
    })
    .await;
    replay.wait().expect_code(0);
    modes.stop().expect_code(0);
    ingest.stop().expect_code(0);
    found
}

/// One kill is in the commissioning, and one after it.
#[tokio::test(flavor = "multi_thread")]
async fn stiffnesses_from_modes_are_the_same_after_two_kills() {
    let site = stiffness();
    let record = site.simulate(UPDATE_RECORD_S);
    let uninterrupted = parameters(&site, &record, &[]).await;
    let other = stiffness();
    let interrupted = parameters(&other, &record, &[1, 3]).await;
    assert_eq!(interrupted, uninterrupted);
    assert!(uninterrupted.values().any(|display| display.std > 0.0));
}
