//! The folder of the state: who may read it, and what happens when it disappears or cannot be used.

use crate::support::{
    DEADLINE, Drops, Node, Process, Sensors, Site, SmallDisk, put_raw, two_storeys, within,
};
use spandrel_bus::{
    Block as _, Bus, Delivery, Event, EventKind, FrameBlock, HistorySpan, Message as _, Name,
    SampleBlock, Service, Start, Status, StreamSettings, Subscription,
};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// Writes a configuration with state and history in `state`, and returns the command of `run`.
fn run_with_state(site: &Site, state: &Path) -> Command {
    let configuration = site.folder().join("spandrel.toml");
    let text = format!(
        "[state]\nfolder = \"{0}\"\ncheckpoint-s = 1\n[history]\n\
         database = \"{0}/history.sqlite\"\n",
        state.display()
    );
    std::fs::write(&configuration, text).unwrap();
    let mut command = site.listening("run");
    command.arg("--config").arg(configuration);
    command.args(["--http", "none"]);
    command
}

/// Waits for an event of a kind.
async fn event(events: &Subscription<Event>, kind: EventKind) -> Event {
    within(&format!("event {kind:?}"), async {
        loop {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if event.kind == kind {
                return event;
            }
        }
    })
    .await
}

/// Waits for events of all these kinds, in any order.
async fn all_events(events: &Subscription<Event>, kinds: &[EventKind]) {
    let mut missing = kinds.to_vec();
    within(&format!("events {kinds:?}"), async {
        while !missing.is_empty() {
            let (_, event) = events.messages().recv_async().await.unwrap();
            missing.retain(|kind| *kind != event.kind);
        }
    })
    .await;
}

/// Waits until the history has values of a parameter after this time (s).
async fn stored_until(bus: &Bus, site: &Site, time_s: f64) -> HistorySpan {
    let key = site.keys().history(&Name::new("storey-2").unwrap());
    within("an answer of the history", async {
        loop {
            let query = format!("{key}?points=20000");
            let answers = bus.ask::<HistorySpan>(&query, DEADLINE).await.unwrap();
            let is_whole =
                |span: &HistorySpan| span.rows.time_s.last().is_some_and(|t| *t > time_s);
            if let Some((_, span)) = answers.into_iter().find(|(_, span)| is_whole(span)) {
                return span;
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    })
    .await
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = vec![folder.to_owned()];
    let mut next = 0;
    while let Some(path) = found.get(next).cloned() {
        next += 1;
        if path.is_dir() {
            found.extend(
                std::fs::read_dir(path)
                    .unwrap()
                    .map(|entry| entry.unwrap().path()),
            );
        }
    }
    found
}

#[tokio::test(flavor = "multi_thread")]
async fn recordings_checkpoints_and_history_are_for_their_owner_alone() {
    let site = Site::with(&two_storeys(""));
    let state = site.folder().join("state");
    let services = Process::start(&mut run_with_state(&site, &state));
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(20.0);
    site.replay(&record, "max").wait().expect_code(0);
    stored_until(&bus, &site, 19.0).await;
    bus.close().await.unwrap();
    services.stop().expect_code(0);
    let found = files(&state);
    // Regression: the page said that `run` writes no file.
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/operations.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, told) = page.split_once("\n`run` writes ").unwrap();
    let (told, _) = told.split_once('.').unwrap();
    for (kind, word) in [
        ("mcap", "recording"),
        ("checkpoint", "checkpoints"),
        ("sqlite", "database"),
    ] {
        let has = |path: &PathBuf| path.extension().is_some_and(|extension| extension == kind);
        assert!(found.iter().any(has), "no {kind} among {found:?}");
        assert!(
            told.contains(word),
            "docs/operations.md: `run` writes {told}"
        );
    }
    for path in found {
        let mode = path.metadata().unwrap().mode() & 0o777;
        let expected = if path.is_dir() { 0o700 } else { 0o600 };
        assert_eq!(mode, expected, "{}: {mode:o}", path.display());
    }
}

/// Regression: services wrote to files without a name until they restarted, and said nothing.
#[tokio::test(flavor = "multi_thread")]
async fn a_state_folder_that_disappears_is_noticed_and_used_again_when_it_is_back() {
    for returns in [Returns::AsItWas, Returns::Empty] {
        let site = Site::with(&two_storeys(""));
        let state = site.folder().join("state");
        let services = Process::start(&mut run_with_state(&site, &state));
        services.wait_for_log("ready structures=1");
        let bus = site.join().await;
        site.wait_for_services(&bus).await;
        let drops = Drops::watch(&bus, &site.keys()).await;
        let events = bus.subscribe(site.keys().event(), 256).await.unwrap();
        let record = site.simulate(60.0);
        let mut sensors = Sensors::start(&bus, &site.keys(), site.structure(), &record).await;
        put_slowly(&mut sensors, 0..2000).await;
        drops.when_done(Service::Identify, 1800).await;

        let away = site.folder().join("away");
        std::fs::rename(&state, &away).unwrap();
        // No service has anything to do meanwhile.
        all_events(
            &events,
            &[EventKind::StateLost, EventKind::HistoryUnavailable],
        )
        .await;
        for service in [Service::Identify, Service::Alert] {
            drops.expect(service, "checkpoints-not-kept", 1).await;
        }
        put_slowly(&mut sensors, 2000..4000).await;
        drops
            .expect(Service::Ingest, "frames-waiting-for-the-disk", 1800)
            .await;
        drops.when_done(Service::Alert, 3800).await;
        assert!(!state.exists(), "a new folder would hide the former one");

        match returns {
            Returns::AsItWas => std::fs::rename(&away, &state).unwrap(),
            Returns::Empty => std::fs::create_dir(&state).unwrap(),
        }
        all_events(&events, &[EventKind::StateBack, EventKind::HistoryBack]).await;
        put_slowly(&mut sensors, 4000..6000).await;
        drops.when_done(Service::Alert, 5800).await;
        let stored = stored_until(&bus, &site, 55.0).await;
        bus.close().await.unwrap();
        services.stop().expect_code(0);
        let recorded = recorded(&site, &state);
        let first = match returns {
            Returns::AsItWas => 0,
            Returns::Empty => 2000,
        };
        assert!(
            recorded.len() >= 5800 - first,
            "{} frames recorded from {first} on",
            recorded.len()
        );
        if returns == Returns::AsItWas {
            // An overloaded identification publishes one value per second. The rows that came while
            // the folder was away span 20 s.
            let longest = stored.rows.time_s.windows(2).map(|pair| pair[1] - pair[0]);
            let longest = longest.fold(0.0, f64::max);
            assert!(longest < 5.0, "{longest} s without a value in the history");
        }
    }
}

/// The services have nothing to save when the folder disappears.
#[tokio::test(flavor = "multi_thread")]
async fn each_service_reports_within_ten_seconds_that_its_state_is_gone() {
    const SAVING: [Service; 6] = [
        Service::Identify,
        Service::Alert,
        Service::Modes,
        Service::Reports,
        Service::Judge,
        Service::Notify,
    ];
    let site = Site::with(&two_storeys(
        "[modal]\nepoch-s = 60\nband-hz = [0.5, 20]\n[earthquakes]\n[judge]\n\
         [[judge.quantity]]\nname = \"storey-1\"\nis = \"stiffness\"\n",
    ));
    let state = site.folder().join("state");
    let mut command = run_with_state(&site, &state);
    let configuration = site.folder().join("spandrel.toml");
    let mut text = std::fs::read_to_string(&configuration).unwrap();
    text += "[[notify.webhook]]\nurl = \"http://127.0.0.1:9/\"\n"; // nobody listens there
    std::fs::write(&configuration, text).unwrap();
    let services = Process::start(&mut command);
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    let record = site.simulate(20.0);
    let mut sensors = Sensors::start(&bus, &site.keys(), site.structure(), &record).await;
    put_slowly(&mut sensors, 0..2000).await;
    for service in [Service::Alert, Service::Modes, Service::Reports] {
        drops.when_done(service, 1800).await;
    }
    let events = bus.subscribe(site.keys().event(), 256).await.unwrap();
    let statuses = bus.subscribe::<Status>(site.keys().all_statuses(), 256);
    let statuses = statuses.await.unwrap();

    std::fs::rename(&state, site.folder().join("away")).unwrap();
    let mut silent: Vec<&str> = SAVING.iter().map(|service| service.as_str()).collect();
    let noticed = async {
        let lost = [EventKind::StateLost, EventKind::HistoryUnavailable];
        all_events(&events, &lost).await;
        while !silent.is_empty() {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.drops.contains_key("checkpoints-not-kept") {
                silent.retain(|service| *service != status.service.as_str());
            }
        }
    };
    let noticed = tokio::time::timeout(Duration::from_secs(10), noticed).await;
    assert!(noticed.is_ok(), "without a report: {silent:?}");
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Returns {
    AsItWas,
    Empty,
}

/// Publishes rows in blocks of 0.5 s.
async fn put_slowly(sensors: &mut Sensors, rows: std::ops::Range<usize>) {
    for start in rows.clone().step_by(50) {
        sensors.put(start..(start + 50).min(rows.end)).await;
        tokio::task::yield_now().await;
    }
}

/// Returns the times of all recorded frames, as `convert` writes them.
fn recorded(site: &Site, state: &Path) -> Vec<String> {
    let folder = files(state)
        .into_iter()
        .find(|path| path.ends_with("recording"))
        .unwrap();
    let output = site.folder().join("recorded.csv");
    let mut convert = crate::support::spandrel("convert");
    convert.arg(folder).arg(&output);
    Process::start(&mut convert).wait().expect_code(0);
    let text = std::fs::read_to_string(output).unwrap();
    let times = text
        .lines()
        .skip(1)
        .filter_map(|line| line.split(',').next());
    times.map(str::to_owned).collect()
}

/// Regression: `run` ended with code 1, so that nothing was monitored.
#[tokio::test(flavor = "multi_thread")]
async fn a_corrupt_history_is_set_aside_and_monitoring_starts() {
    let site = Site::with(&two_storeys(""));
    let state = site.folder().join("state");
    std::fs::create_dir(&state).unwrap();
    let path = state.join("history.sqlite");
    let garbage = "this is no database ".repeat(1000);
    std::fs::write(&path, &garbage).unwrap();
    // The events are published at the start, so the test must be there before.
    let bus = site.host().await;
    let events = bus.subscribe(site.keys().event(), 256).await.unwrap();
    let configuration = site.folder().join("spandrel.toml");
    let text = "[state]\nfolder = \"state\"\n[history]\ndatabase = \"state/history.sqlite\"\n";
    std::fs::write(&configuration, text).unwrap();
    let mut command = site.connecting("run");
    command.arg("--config").arg(&configuration);
    let services = Process::start(command.args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let event = event(&events, EventKind::HistoryUnavailable).await;
    let aside = files(&state)
        .into_iter()
        .find(|path| path.to_string_lossy().contains("history.sqlite.corrupt-"))
        .expect("the corrupt file under another name");
    assert_eq!(std::fs::read_to_string(&aside).unwrap(), garbage);
    for name in [&path, &aside] {
        let name = name.file_name().unwrap().to_str().unwrap();
        assert!(event.what.contains(name), "{event:?}");
        services.wait_for_log(name);
    }
    site.wait_for_services(&bus).await;
    let record = site.simulate(20.0);
    site.replay(&record, "max").wait().expect_code(0);
    stored_until(&bus, &site, 19.0).await;
    services.stop().expect_code(0);
    bus.close().await.unwrap();
}

/// Regression: opening the pipe waited for its writer, and `run` did not end at a signal.
#[tokio::test(flavor = "multi_thread")]
async fn a_history_that_is_a_pipe_waits_and_monitoring_starts() {
    let site = Site::with(&two_storeys(""));
    let database = site.folder().join("house.sqlite");
    let made = Command::new("mkfifo").arg(&database).status();
    assert!(made.unwrap().success());
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(&configuration, "[history]\ndatabase = \"house.sqlite\"\n").unwrap();
    let mut command = site.listening("run");
    command.arg("--config").arg(&configuration);
    let services = Process::start(command.args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    services.wait_for_log("must be a regular file");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(20.0);
    site.replay(&record, "max").wait().expect_code(0);
    std::fs::remove_file(&database).unwrap();
    let stored = stored_until(&bus, &site, 19.0).await;
    assert!(stored.rows.time_s[0] < 1.0, "{:?}", stored.rows.time_s);
    services.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_history_on_a_read_only_disk_waits_and_monitoring_starts() {
    let site = Site::with(&two_storeys(""));
    let disk = site.folder().join("disk");
    std::fs::create_dir(&disk).unwrap();
    let Some(_mounted) = SmallDisk::or_skip(&disk, "20m") else {
        return;
    };
    remount(&disk, "ro");
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(
        &configuration,
        "[history]\ndatabase = \"disk/house.sqlite\"\n",
    )
    .unwrap();
    let mut command = site.listening("run");
    command.arg("--config").arg(&configuration);
    let services = Process::start(command.args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    drops.expect(Service::History, "failed-writes", 2).await;
    let record = site.simulate(20.0);
    site.replay(&record, "max").wait().expect_code(0);
    remount(&disk, "rw");
    let stored = stored_until(&bus, &site, 19.0).await;
    assert!(
        stored.rows.time_s[0] < 1.0,
        "{:?}",
        &stored.rows.time_s[..3]
    );
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}

/// How a state folder cannot be written at the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Unwritable {
    ReadOnlyDisk,
    NoPermission,
}

/// Regression: `run` ended with code 1, so that nothing was monitored.
#[tokio::test(flavor = "multi_thread")]
async fn a_state_folder_that_cannot_be_written_at_the_start_only_delays_what_is_stored() {
    for how in [Unwritable::ReadOnlyDisk, Unwritable::NoPermission] {
        let site = Site::with(&two_storeys(""));
        let disk = site.folder().join("disk");
        let state = disk.join("state");
        std::fs::create_dir(&disk).unwrap();
        let Some(_mounted) = SmallDisk::or_skip(&disk, "20m") else {
            return;
        };
        std::fs::create_dir(&state).unwrap();
        let mut command = run_with_state(&site, &state);
        match how {
            Unwritable::ReadOnlyDisk => remount(&disk, "ro"),
            Unwritable::NoPermission => {
                // Who may mount may also write anywhere.
                for folder in [site.folder(), &disk, &state] {
                    set_mode(folder, 0o555);
                }
                command.uid(NOBODY).gid(NOBODY);
            }
        }
        let services = Process::start(&mut command);
        services.wait_for_log("ready structures=1");
        let bus = site.join().await;
        site.wait_for_services(&bus).await;
        let drops = Drops::watch(&bus, &site.keys()).await;
        let events = bus.subscribe(site.keys().event(), 256).await.unwrap();
        let record = site.simulate(20.0);
        site.replay(&record, "max").wait().expect_code(0);
        drops.when_done(Service::Alert, 2000).await;
        let waiting = "frames-waiting-for-the-disk";
        drops.expect(Service::Ingest, waiting, 2000).await;
        drops.expect(Service::History, "failed-writes", 2).await;
        match how {
            Unwritable::ReadOnlyDisk => remount(&disk, "rw"),
            Unwritable::NoPermission => set_mode(&state, 0o777),
        }
        all_events(&events, &[EventKind::StateBack, EventKind::HistoryBack]).await;
        stored_until(&bus, &site, 19.0).await;
        bus.close().await.unwrap();
        services.stop().expect_code(0);
        let recorded = recorded(&site, &state);
        assert_eq!(recorded.len(), 2000, "{how:?}");
        let has_checkpoint = |path: &PathBuf| path.extension().is_some_and(|e| e == "checkpoint");
        assert!(files(&state).iter().any(has_checkpoint), "{how:?}");
    }
}

/// User and group without rights.
const NOBODY: u32 = 65_534;

fn set_mode(path: &Path, mode: u32) {
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
}

/// Epoch of a second program under the name of a node.
const LATER_EPOCH: u64 = 30 * 86_400 * 1_000_000_000;

// The documentation describes this procedure (Epochs of the future).
#[tokio::test(flavor = "multi_thread")]
async fn an_operator_ends_a_lockout_by_renaming_the_recording() {
    for is_renamed in [false, true] {
        let site = Site::with(&two_storeys(""));
        let state = site.folder().join("state");
        let (bus, keys) = (site.host().await, site.keys());
        run_with_state(&site, &state); // for its configuration
        let start = || {
            let mut command = site.connecting("run");
            command
                .arg("--config")
                .arg(site.folder().join("spandrel.toml"));
            let services = Process::start(command.args(["--http", "none"]));
            services.wait_for_log("ready structures=1");
            services
        };
        let services = start();
        site.wait_for_services(&bus).await;
        let drops = Drops::watch(&bus, &keys).await;
        let record = site.simulate(30.0);
        let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
        put_slowly(&mut sensors, 0..1000).await;
        // The node itself stores nothing, so that nobody contradicts the second program.
        let node = sensors.remove("roof");
        let (channels, name, key) = (
            node.channels().to_vec(),
            node.name.clone(),
            node.key.clone(),
        );
        let mut block = node.block(&record, 2000..2050);
        drop(node);
        let elsewhere = site.join().await;
        let second = Node::start(&elsewhere, &keys, name, channels, LATER_EPOCH).await;
        sensors.add(second);
        put_slowly(&mut sensors, 1000..2000).await;
        drops.when_done(Service::Identify, 1900).await;
        drop(sensors.remove("roof"));
        elsewhere.close().await.unwrap();
        services.stop().expect_code(0);

        let recording = files(&state)
            .into_iter()
            .find(|path| path.ends_with("recording"));
        let recording = recording.unwrap();
        if is_renamed {
            std::fs::rename(&recording, recording.with_extension("before")).unwrap();
        }
        let services = start();
        site.wait_for_services(&bus).await;
        let drops = Drops::watch(&bus, &keys).await;
        let from_now = StreamSettings::new(Start::Now);
        let frames = bus.follow::<FrameBlock>(keys.frames(), keys.recording(), from_now);
        let frames = frames.await.unwrap();
        // Fewer blocks than those after which the node is read again by itself.
        for row in (2000..2250).step_by(50) {
            sensors.put(row..row + 50).await;
            block.header.time_ns = record.time_ns(row);
            let payload = block.encode().unwrap();
            put_raw(&bus, &key, &SampleBlock::encoding(), payload).await;
            block.header.sequence = block.end();
        }
        match is_renamed {
            true => {
                within("frames of all nodes", async {
                    loop {
                        let delivery = frames.deliveries().recv_async().await.unwrap();
                        let Delivery::Block(block) = delivery else {
                            continue;
                        };
                        if block
                            .iter()
                            .any(|(_, frame)| frame.iter().all(|v| v.is_finite()))
                        {
                            return;
                        }
                    }
                })
                .await;
            }
            false => {
                drops.expect(Service::Ingest, "locked-out-blocks", 3).await;
            }
        }
        services.stop().expect_code(0);
        bus.close().await.unwrap();
    }
}

fn remount(disk: &Path, how: &str) {
    let options = format!("remount,{how}");
    let done = Command::new("mount")
        .args(["-o", &options])
        .arg(disk)
        .status();
    assert!(done.unwrap().success(), "cannot remount {}", disk.display());
}
