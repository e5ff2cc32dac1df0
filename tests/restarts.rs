//! Processes that are killed or stopped during operation, and restarted.

use crate::support::{
    DEADLINE, Drops, EstimateReader, Identified, Process, Sensors, Site, assert_same_bits,
    distributed_storeys, five_storeys, spandrel, two_storeys, within,
};
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Block, Bus, BusConfig, Description, EstimateBlock,
    Event, EventKind, Mode, Name, Service, Subscription,
};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Length of the record (s), longer than the data that can be in transit. A replay therefore cannot
/// end before it is read.
const RECORD_S: f64 = 100.0;

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_identification_gives_the_same_numbers_after_its_restart() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(RECORD_S);
    let expected = site.estimate(&record);
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let _alert = Process::start(&mut site.connecting("alert"));
    let identify = Process::start(&mut site.connecting("identify"));
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let replay = site.replay(&record, "max");
    reader.read_frames(1).await;
    identify.kill();
    let mut tokens = bus
        .watch_live(keys.all_live(Service::Identify))
        .await
        .unwrap();
    within("identify to be gone", tokens.none()).await;
    let _identify = Process::start(&mut site.connecting("identify"));
    replay.wait().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert_same_bits(
        "first reader",
        &expected.parameters,
        &expected.frames,
        found,
    );
    let mut late = EstimateReader::join(&bus, &keys).await;
    assert_same_bits(
        "late reader",
        &expected.parameters,
        &expected.frames,
        late.read_to_end(1).await,
    );
}

/// Returns the checkpoints of a service in a folder.
fn checkpoints(folder: &Path, service: &str) -> usize {
    let Ok(files) = std::fs::read_dir(folder) else {
        return 0; // not yet created
    };
    let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
    let is_one = |name: &String| name.starts_with(service) && name.ends_with(".checkpoint");
    names.filter(is_one).count()
}

// Identify resumed from its oldest checkpoint, and the first 50 to 850 estimates never reached
// alert.
#[tokio::test(flavor = "multi_thread")]
async fn estimates_before_the_first_checkpoint_of_alert_survive_that_both_are_killed() {
    let rule = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                credibility = 0.99\n";
    let site = Site::with(&two_storeys(rule));
    let record = site.simulate(10.0);
    let expected = site.estimate(&record);
    let state = site.folder().join("state");
    let command = |service: &str, checkpoint_s: f64| {
        let file = site.folder().join(format!("{service}.toml"));
        let text = format!(
            "[bus]\nmode = \"client\"\n[state]\nfolder = \"{}\"\ncheckpoint-s = {checkpoint_s}\n",
            state.display()
        );
        std::fs::write(&file, text).unwrap();
        let mut command = site.connecting(service);
        command.arg("--config").arg(file);
        command
    };
    // Whether alert saves anything within seconds is chance. Here it does not, because no alert
    // changes in the first second.
    let mut alert = command("alert", 3600.0);
    let mut identify = command("identify", 0.05);
    let config = BusConfig {
        mode: Mode::Router,
        listen: vec![site.endpoint().to_owned()],
        ..BusConfig::default()
    };
    let _router = Bus::open(&config).await.unwrap();
    let (bus, keys) = (site.join().await, site.keys());
    let _ingest = Process::start(&mut command("ingest", 5.0));
    let first = [Process::start(&mut identify), Process::start(&mut alert)];
    site.wait_for_services(&bus).await;
    let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
    let folder = state
        .join(keys.root().as_str())
        .join(site.structure().name())
        .join("checkpoints");
    const BEFORE: usize = 90;
    for row in (0..BEFORE).step_by(10) {
        sensors.put(row..row + 10).await;
        let mut decided = bus
            .watch_progress(keys.progress(Service::Alert))
            .await
            .unwrap();
        let done = row as u64;
        within(
            "decisions",
            decided.wait_for(|progress| progress.done >= done),
        )
        .await;
    }
    assert!(
        checkpoints(&folder, "identify-") > 2,
        "{}",
        folder.display()
    );
    assert_eq!(checkpoints(&folder, "alert-"), 0, "alert has saved nothing");
    first.into_iter().for_each(Process::kill);
    let _second = [Process::start(&mut identify), Process::start(&mut alert)];
    let mut reader = EstimateReader::join(&bus, &keys).await;
    sensors.put(BEFORE..record.len()).await;
    let found = reader.read_frames(record.len()).await;
    assert_same_bits("second run", &expected.parameters, &expected.frames, found);
    let status = Drops::watch(&bus, &keys)
        .await
        .when_done(Service::Alert, record.len() as u64)
        .await;
    assert_eq!(status.drops.get("lost-items"), None, "{:?}", status.drops);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_ingest_fetches_the_samples_from_its_nodes() {
    let site = Site::of(&five_storeys());
    let record = site.simulate(RECORD_S);
    let alert = Process::start(&mut site.listening("alert"));
    alert.wait_for_log("ready structures=1");
    let _identify = Process::start(&mut site.connecting("identify"));
    let ingest = Process::start(&mut site.connecting("ingest"));
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let replay = site.replay(&record, "max");
    let before = reader.read_frames(1).await.len();
    ingest.kill();
    let mut tokens = bus
        .watch_live(keys.all_live(Service::Ingest))
        .await
        .unwrap();
    within("ingest to be gone", tokens.none()).await;
    let _ingest = Process::start(&mut site.connecting("ingest"));
    replay.wait().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert!(
        found.len() >= before + record.len(),
        "{} frames in all, {} of the record",
        found.len(),
        record.len()
    );
    assert_is_the_whole_record(&found[found.len() - record.len()..]);
}

/// The list of events showed only that the monitoring had been blind.
#[tokio::test(flavor = "multi_thread")]
async fn a_restart_of_ingest_is_an_event_with_the_age_of_its_last_frame() {
    const GAP: Duration = Duration::from_secs(2);
    let site = Site::with(&two_storeys(""));
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(&configuration, "[state]\nfolder = \"kept\"\n").unwrap();
    // The event is published at the start, so the test must be there before.
    let (bus, keys) = (site.host().await, site.keys());
    let events = bus.subscribe::<Event>(keys.event(), 256).await.unwrap();
    let mut done = bus
        .watch_progress(keys.progress(Service::Ingest))
        .await
        .unwrap();
    let ingest = || {
        Process::start(
            site.connecting("ingest")
                .arg("--config")
                .arg(&configuration),
        )
    };
    let first = ingest();
    let sensors = Process::start(site.connecting("simulate").arg("--live"));
    within("frames", done.wait_for(|progress| progress.done >= 200)).await;
    sensors.stop().expect_code(0);
    first.kill();
    let is_restart = |event: &Event| event.kind == EventKind::Restart;
    let earlier: Vec<Event> = events.messages().drain().map(|(_, event)| event).collect();
    assert!(
        !earlier.iter().any(is_restart),
        "without a state: {earlier:?}"
    );
    tokio::time::sleep(GAP).await; // the gap that the event states
    let _second = ingest();
    let event = within("the event", async {
        loop {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if is_restart(&event) {
                return event;
            }
        }
    })
    .await;
    assert_eq!(event.subject, "ingest");
    let what = "ingest has restarted and resumes from frame ";
    assert!(event.what.starts_with(what), "{event:?}");
    let age_s = event.why.strip_prefix("its last frame was ");
    let age_s = age_s.and_then(|age| age.strip_suffix(" s old"));
    let age_s: f64 = age_s.and_then(|age| age.parse().ok()).expect(&event.why);
    assert!(age_s >= GAP.as_secs_f64(), "{event:?}");
    bus.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replay_that_is_stopped_ends_its_nodes_where_they_are() {
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(RECORD_S);
    let expected = site.estimate(&record);
    let services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let replay = site.replay(&record, "10");
    reader.read_frames(100).await;
    replay.stop().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert!(found.len() < record.len(), "stopped on the way");
    assert_same_bits(
        "up to the stop",
        &expected.parameters,
        &expected.frames[..found.len()],
        found,
    );
    services.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hangup_reloads_the_rules_and_changes_no_bit_of_the_estimates() {
    let rule = |loss: f64| {
        format!(
            "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = {loss}\n\
             credibility = 0.99\nsustain-s = 3\n"
        )
    };
    let site = Site::with(&two_storeys(&rule(0.05)));
    let record = site.simulate(RECORD_S);
    let expected = site.estimate(&record);
    let services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let replay = site.replay(&record, "20");
    reader.read_frames(500).await;
    // An invalid file is reported and changes nothing.
    std::fs::write(
        site.structure_file(),
        two_storeys("[[alert]]\nparameters = \"none of them\"\n"),
    )
    .unwrap();
    services.hang_up();
    services.wait_for_log("nothing changed");
    reader.read_frames(1000).await;
    std::fs::write(site.structure_file(), two_storeys(&rule(0.2))).unwrap();
    services.hang_up();
    services.wait_for_log("restarting the services");
    replay.wait().expect_code(0);
    let found = reader.read_to_end(1).await;
    assert_same_bits(
        "with another rule",
        &expected.parameters,
        &expected.frames,
        found,
    );
    let answers = bus
        .ask::<Description>(&site.keys().description(), DEADLINE)
        .await
        .unwrap();
    assert!(
        answers
            .iter()
            .any(|(_, description)| description.text.contains("loss = 0.2")),
        "{answers:?}"
    );
    services.stop().expect_code(0);
}

/// An alert that the new rule no longer raises must end with a message, so that its recipients
/// learn of the end. A change of the rule must keep the acknowledgement.
#[tokio::test(flavor = "multi_thread")]
async fn a_hangup_keeps_an_acknowledgement_and_ends_alerts_that_the_new_rule_does_not_raise() {
    let with = |loss: f64| {
        let rule = format!(
            "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = {loss}\n\
             credibility = 0.99\nsustain-s = 3\n"
        );
        let damage = "[[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 20\nloss = 0.15\n";
        two_storeys(&format!("{rule}{damage}"))
    };
    let site = Site::with(&with(0.05));
    let record = site.simulate(60.0);
    let services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let parameter = Name::new("storey-2").unwrap();
    let alerts = bus
        .subscribe::<AlertMessage>(site.keys().alert(&parameter), 256)
        .await
        .unwrap();
    let until = async |state: AlertState| loop {
        let (_, alert) = alerts.messages().recv_async().await.unwrap();
        if alert.state == state {
            return alert;
        }
    };
    site.replay(&record, "max").wait().expect_code(0);
    within("a raised alert", until(AlertState::Raised)).await;
    let person = bus
        .publish_display(site.keys().acknowledge(&parameter))
        .await
        .unwrap();
    let seen = Acknowledgement {
        structure: Name::new("house").unwrap(),
        parameter: parameter.clone(),
        time_ns: 0,
        who: "anna".to_owned(),
        note: String::new(),
    };
    person.put(&seen).await.unwrap();
    within("an acknowledged alert", until(AlertState::Acknowledged)).await;

    std::fs::write(
        site.structure_file(),
        format!("# anna has been there\n{}", with(0.05)),
    )
    .unwrap();
    services.hang_up();
    let again = within("what stands", until(AlertState::Acknowledged)).await;
    assert_eq!(again.acknowledged_by.as_deref(), Some("anna"));

    std::fs::write(site.structure_file(), with(0.3)).unwrap();
    services.hang_up();
    let ended = within("its end", until(AlertState::Cleared)).await;
    let why = "alert of storey-2 has ended: its rule changed from more than 5 % with probability \
               0.990 for 3 s to more than 30 %";
    assert!(ended.why.starts_with(why), "{}", ended.why);
    services.wait_for_log("alert of storey-2 has ended");
    services.stop().expect_code(0);
}

/// Services of one configuration whose only checkpoints are the final ones, stopped while sensors
/// continue.
struct Beside {
    site: Site,
    configuration: PathBuf,
    bus: Bus,
    estimates: Subscription<EstimateBlock>,
    _host: Process,
}

impl Beside {
    /// Starts the service that the others connect to.
    async fn start(site: Site, host: &str) -> Self {
        let configuration = site.folder().join("spandrel.toml");
        std::fs::write(
            &configuration,
            "[state]\nfolder = \"kept\"\ncheckpoint-s = 3600\n",
        )
        .unwrap();
        let host = Process::start(site.listening(host).arg("--config").arg(&configuration));
        host.wait_for_log("ready structures=1");
        let bus = site.join().await;
        let estimates = bus
            .subscribe(site.keys().estimates(), 1 << 12)
            .await
            .unwrap();
        Self {
            site,
            configuration,
            bus,
            estimates,
            _host: host,
        }
    }

    fn service(&self, subcommand: &str, arguments: &[&str]) -> Process {
        Process::start(
            self.site
                .connecting(subcommand)
                .args(arguments)
                .arg("--config")
                .arg(&self.configuration),
        )
    }

    /// Starts sensors that measure for longer than the test takes.
    fn measure(&self) -> Process {
        Process::start(
            self.site
                .connecting("simulate")
                .args(["--live", "--duration", "600"]),
        )
    }

    /// Waits for estimates in a higher term or epoch than this one, and returns theirs.
    async fn after(&self, last: (u64, u64)) -> (u64, u64) {
        let what = format!("estimates after term and epoch {last:?}");
        within(&what, async {
            loop {
                let (_, block) = self.estimates.messages().recv_async().await.unwrap();
                let found = (block.term(), block.header.epoch);
                if found > last {
                    return found;
                }
            }
        })
        .await
    }

    /// Returns the number of processes that claim to lead the identification.
    async fn leaders(&self) -> usize {
        self.bus
            .query_tokens(&self.site.keys().all_leaders(), DEADLINE)
            .await
            .unwrap()
            .len()
    }

    /// Returns the names of the checkpoints of this kind, including those of nodes.
    fn checkpoints(&self, kind: &str) -> Vec<String> {
        fn below(folder: &Path, found: &mut Vec<String>) {
            for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
                match entry.file_type().unwrap().is_dir() {
                    true => below(&entry.path(), found),
                    false => found.push(entry.file_name().into_string().unwrap()),
                }
            }
        }
        let mut found = Vec::new();
        below(&self.site.folder().join("kept"), &mut found);
        found.retain(|name| name.starts_with(kind) && name.ends_with(".checkpoint"));
        found.sort();
        found
    }
}

/// The stream of live sensors has no end. A hangup must nevertheless stop the former leader and
/// write its final checkpoint.
#[tokio::test(flavor = "multi_thread")]
async fn an_identification_beside_live_sensors_starts_again_and_ends_in_order() {
    for arguments in [&[][..], &["--standby"]] {
        let beside = Beside::start(Site::with(&two_storeys("")), "ingest").await;
        let identify = beside.service("identify", arguments);
        let sensors = beside.measure();
        let mut life = beside.after((0, 0)).await;
        for _ in 0..2 {
            identify.hang_up();
            life = beside.after(life).await;
            assert_eq!(
                beside.leaders().await,
                1,
                "{arguments:?}: leaders after a hangup"
            );
        }
        let before = beside.checkpoints("identify");
        identify
            .stop()
            .expect_code(0)
            .expect_untold(&["did not finish in time"]);
        assert_eq!(
            beside.leaders().await,
            0,
            "{arguments:?}: leaders after the end"
        );
        assert_ne!(
            beside.checkpoints("identify"),
            before,
            "{arguments:?}: no checkpoint of the end"
        );
        sensors.stop().expect_code(0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn station_and_nodes_beside_live_sensors_end_in_order() {
    // Messages of the nodes arrive faster than the station's wait for the last one.
    let beside = Beside::start(Site::with(&distributed_storeys(12.5)), "alert").await;
    let (station, workers) = (beside.service("fuse", &[]), beside.service("identify", &[]));
    let sensors = beside.measure();
    beside.after((0, 0)).await;
    station
        .stop()
        .expect_code(0)
        .expect_untold(&["did not finish in time"]);
    assert_eq!(beside.checkpoints("fuse").len(), 1, "the one of the end");
    workers
        .stop()
        .expect_code(0)
        .expect_untold(&["did not finish in time"]);
    assert_eq!(
        beside.checkpoints("node").len(),
        4,
        "the one of the end of each"
    );
    sensors.stop().expect_code(0);
}

/// Checks that frames follow each other from time 0 on, at 100 Hz.
#[track_caller]
fn assert_is_the_whole_record(frames: &[Identified]) {
    let wrong = (0..)
        .zip(frames)
        .find(|(number, frame)| frame.time_ns != number * 10_000_000);
    assert!(wrong.is_none(), "frame {wrong:?} is not at its time");
}

#[test]
fn a_stop_while_structures_start_ends_the_process() {
    let folder = tempfile::tempdir().unwrap();
    let files: Vec<PathBuf> = (0..40)
        .map(|number| {
            let text =
                two_storeys("").replace("name = \"house\"", &format!("name = \"h{number}\""));
            let path = folder.path().join(format!("{number}.toml"));
            std::fs::write(&path, text).unwrap();
            path
        })
        .collect();
    let address = folder.path().join("notify");
    let systemd = UnixDatagram::bind(&address).unwrap();
    let mut command = spandrel("run");
    command
        .args(&files)
        .args(["--listen", "tcp/127.0.0.1:0", "-v"])
        .args(["--http", "none"])
        .env("NOTIFY_SOCKET", &address)
        .env("SPANDREL_STATE__FOLDER", folder.path().join("state"));
    let process = Process::start(&mut command);
    process.wait_for_log("alerts ready structure=\"h0\"");
    process
        .stop()
        .expect_code(0)
        .expect_untold(&["ready structures=40"]);
    let mut told = [0; 64];
    systemd.set_nonblocking(true).unwrap();
    let length = systemd.recv(&mut told).unwrap();
    assert_eq!(told[..length].trim_ascii(), b"STOPPING=1");
}

/// As the first process of a container, a program without a handler would not receive SIGTERM.
#[test]
fn a_stop_while_the_router_does_not_answer_ends_the_process() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("house.toml");
    std::fs::write(&file, two_storeys("")).unwrap();
    for subcommand in ["run", "dashboard"] {
        let router = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("tcp/{}", router.local_addr().unwrap());
        let mut command = spandrel(subcommand);
        command
            .arg(&file)
            .args(["--http", "127.0.0.1:0", "--connect", &address])
            .env("SPANDREL_STATE__FOLDER", folder.path().join("state"));
        let process = Process::start(&mut command);
        let _silent = router.accept().unwrap();
        process.stop().expect_code(0);
    }
}

/// Regression: the second process put the checkpoints of the first aside before it failed.
#[tokio::test(flavor = "multi_thread")]
async fn a_second_process_in_the_same_state_folder_ends_and_refuses_no_checkpoint() {
    let site = Site::with(&two_storeys(""));
    let state = site.folder().join("state");
    let file = site.folder().join("config.toml");
    let text = format!(
        "[state]\nfolder = \"{}\"\ncheckpoint-s = 0.05\n",
        state.display()
    );
    std::fs::write(&file, text).unwrap();
    let run = |site: &Site| {
        let mut command = site.listening("run");
        Process::start(command.arg("--config").arg(&file))
    };
    let first = run(&site);
    first.wait_for_log("ready structures=1");
    let record = site.simulate(60.0);
    site.replay(&record, "max").wait().expect_code(0);
    let keys = site.keys();
    let folder = state
        .join(keys.root().as_str())
        .join(site.structure().name())
        .join("checkpoints");
    let bus = site.join().await;
    let mut done = bus
        .watch_progress(keys.progress(Service::Identify))
        .await
        .unwrap();
    within("estimates", done.wait_for(|progress| progress.done >= 5900)).await;
    let is_kept = async {
        while checkpoints(&folder, "identify-") == 0 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    within("a checkpoint", is_kept).await;
    let other = two_storeys("").replace("ratio = 0.02", "ratio = 0.03");
    assert_ne!(other, two_storeys(""));
    let other = Site::with(&other).rooted(keys.root().as_str());
    run(&other)
        .wait()
        .expect_code(2)
        .expect_told(&["another process is using the frame log"]);
    let files = std::fs::read_dir(&folder).unwrap();
    let names: Vec<String> = files
        .map(|file| file.unwrap().file_name().into_string().unwrap())
        .collect();
    assert!(
        !names.iter().any(|name| name.ends_with(".refused")),
        "{names:?}"
    );
    first.stop().expect_code(0);
}
