//! This version takes over the files of earlier versions: checkpoints, a recording and a history.
//! The folder fixtures/kept contains one folder per version.
//!
//! Checkpoints of `identify` are an exception: one with another layout is set aside, and `identify`
//! reads the recording again.
//!
//! For a release, `cargo test --workspace --test program upgrade:: -- --ignored` adds the folder of
//! this version.

use crate::support::{
    DEADLINE, EstimateReader, Identified, Process, Record, Sensors, Site, put_raw, two_storeys,
    within,
};
use serde_json::Value;
use spandrel_bus::{
    AlertMessage, AlertState, Bus, HistoryLog, HistorySpan, Name, Service, Start, StreamSettings,
};
use spandrel_checkpoint::{Checkpoints, Identity, Position};
use std::path::{Path, PathBuf};

/// First chunk of all keys, which recording and history contain.
const ROOT: &str = "kept";
/// Number of rows that the earlier version has processed, and of the record.
const SEEN: usize = 800;
const ROWS: usize = 1200;
/// Rules, with a loss of 30 % in storey 2 from the start.
const RULES: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                     credibility = 0.95\nsustain-s = 0.5\n\
                     [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 0\nloss = 0.30\n";
/// Reference of version 0.1.0 for a rule that gives none: the design, taken as exact. Now such a
/// rule learns its reference.
const DESIGN_AS_EXACT: &str = "reference = { mean = 1.0, std = 0.0 }\n";
/// Allowed rounding difference of an estimate on other processors (ratio of a stiffness). The
/// deviation of the estimates is about 0.01.
const ROUNDED: f64 = 1e-6;

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/kept")
}

/// Returns the folders of all versions, including this one.
fn versions() -> Vec<PathBuf> {
    let entries = std::fs::read_dir(fixtures())
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut folders: Vec<PathBuf> = entries.filter(|path| path.is_dir()).collect();
    folders.sort();
    folders
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        match path.is_dir() {
            true => copy(&path, &target),
            false => drop(std::fs::copy(&path, &target).unwrap()),
        }
    }
}

/// A writable copy of the files of one version.
struct Kept {
    site: Site,
    state: PathBuf,
    record: Record,
    known: Value,
    /// Whether the state of its filter can be resumed. That of 0.1.0 cannot, because the filter now
    /// uses another method.
    is_filter_read: bool,
}

impl Kept {
    /// Opens the files of a version with its structure file.
    fn of(version: &Path) -> Self {
        Self::with(version, Site::of(&version.join("structure.toml")))
    }

    /// Opens the files of a version with its structure file, and gives rules without a reference
    /// the one that they had in 0.1.0.
    fn with_reference(version: &Path) -> Self {
        let text = std::fs::read_to_string(version.join("structure.toml")).unwrap();
        let given = text.replace("loss = 0.05\n", &format!("loss = 0.05\n{DESIGN_AS_EXACT}"));
        assert!(given != text, "{text}");
        Self::with(
            version,
            Site::with(if text.contains("reference") {
                &text
            } else {
                &given
            }),
        )
    }

    fn with(version: &Path, site: Site) -> Self {
        let site = site.rooted(ROOT);
        let state = site.folder().join("state");
        copy(&version.join("state"), &state);
        let record = Record::read(&version.join("record.csv"));
        let known =
            serde_json::from_str(&std::fs::read_to_string(version.join("known.json")).unwrap())
                .unwrap();
        let is_filter_read = !version.ends_with("0.1.0");
        Self {
            site,
            state,
            record,
            known,
            is_filter_read,
        }
    }

    fn checkpoints(&self) -> PathBuf {
        self.state
            .join("spandrel")
            .join(ROOT)
            .join("house/checkpoints")
    }

    /// Returns the epoch of its frames, from the name of a checkpoint.
    fn epoch(&self) -> u64 {
        let entries = std::fs::read_dir(self.checkpoints()).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let name = names
            .filter(|name| name.starts_with("identify-"))
            .last()
            .unwrap();
        name.split('-').nth(1).unwrap().parse().unwrap()
    }

    fn recording(&self) -> PathBuf {
        self.state
            .join("spandrel")
            .join(ROOT)
            .join("house/recording")
    }

    fn run(&self) -> Process {
        run(&self.site, &self.state)
    }
}

fn run(site: &Site, state: &Path) -> Process {
    let mut command = site.listening("run");
    let services = Process::start(
        command
            .args(["--http", "none"])
            .env("XDG_STATE_HOME", state),
    );
    services.wait_for_log("ready structures=1");
    services
}

/// Returns the state of the alert of storey 2.
async fn alert_of_storey_2(bus: &Bus, site: &Site) -> AlertMessage {
    let key = site.keys().alert(&Name::new("storey-2").unwrap());
    within("the alert of storey 2", async {
        loop {
            if let Some((_, alert)) = bus.ask::<AlertMessage>(&key, DEADLINE).await.unwrap().pop() {
                return alert;
            }
        }
    })
    .await
}

/// Returns all displayed values of storey 2 once the last of them is at `until_s`.
async fn history_of_storey_2(bus: &Bus, site: &Site, until_s: f64) -> HistorySpan {
    let key = format!(
        "{}?points=20000",
        site.keys().history(&Name::new("storey-2").unwrap())
    );
    within("the history of storey 2", async {
        loop {
            let answers = bus.ask::<HistorySpan>(&key, DEADLINE).await.unwrap();
            let is_there =
                |span: &HistorySpan| span.rows.time_s.last().is_some_and(|last| *last >= until_s);
            if let Some((_, span)) = answers.into_iter().find(|(_, span)| is_there(span)) {
                return span;
            }
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
    })
    .await
}

/// Returns the largest difference of means and standard deviations.
fn difference(expected: &[Identified], found: &[Identified]) -> f64 {
    assert_eq!(expected.len(), found.len(), "frames");
    let of = |(a, b): (&Identified, &Identified)| {
        assert_eq!(a.time_ns, b.time_ns);
        let pairs = a
            .mean_and_std
            .iter()
            .zip(&b.mean_and_std)
            .map(|(a, b)| (a.0 - b.0).abs().max((a.1 - b.1).abs()));
        pairs.fold(0.0, f64::max)
    };
    expected.iter().zip(found).map(of).fold(0.0, f64::max)
}

/// Checks every field of a message that an earlier version has published. Fields that it did not
/// have are ignored.
fn assert_as_known(found: &AlertMessage, known: &Value) {
    let found = serde_json::to_value(found).unwrap();
    for (field, expected) in known.as_object().unwrap() {
        assert_eq!(&found[field], expected, "{field} of {found}");
    }
}

/// Returns the changes of storey 2 that the alert service stores, oldest first.
async fn log_of_storey_2(bus: &Bus, site: &Site) -> Vec<AlertMessage> {
    let logs = bus
        .ask::<HistoryLog>(&site.keys().alert_log(), DEADLINE)
        .await
        .unwrap();
    logs.into_iter()
        .flat_map(|(_, log)| log.alerts)
        .filter(|alert| alert.parameter.as_str() == "storey-2")
        .collect()
}

fn states(alerts: &[AlertMessage]) -> Vec<AlertState> {
    alerts.iter().map(|alert| alert.state).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn services_resume_from_the_files_of_each_version() {
    for version in versions() {
        println!("{}", version.display());
        let kept = Kept::with_reference(&version);
        let expected = kept
            .site
            .estimate(kept.record.clone().save_as_copy(kept.site.folder()));
        let epoch = kept.epoch();
        let services = kept.run();
        let log = services.log();
        let of_identify: &[&str] = match kept.is_filter_read {
            true => &["spandrel_identify::memory: resumed"],
            false => &[
                "it has layout version 1,",
                "identifying the recorded frames again refused=1",
            ],
        };
        for told in of_identify.iter().chain(&[
            "spandrel_alert::memory: resumed",
            "resuming where the recording",
        ]) {
            assert!(log.contains(told), "expected {told}, found:\n{log}");
        }
        assert!(log.contains(&format!("frame={SEEN}")), "{log}");
        let (bus, keys) = (kept.site.join().await, kept.site.keys());

        // The alert: its acknowledgement and its start time.
        let alert = alert_of_storey_2(&bus, &kept.site).await;
        assert_as_known(&alert, &kept.known["alert"]);
        let changes = log_of_storey_2(&bus, &kept.site).await;
        assert_eq!(
            states(&changes),
            [
                AlertState::Pending,
                AlertState::Raised,
                AlertState::Acknowledged
            ],
            "{changes:?}"
        );
        // The history: displayed values and events.
        let span = history_of_storey_2(&bus, &kept.site, 7.0).await;
        assert_eq!(
            serde_json::to_value(&span).unwrap(),
            kept.known["history"],
            "history"
        );
        let log = bus
            .ask::<HistoryLog>(&keys.history_log(), DEADLINE)
            .await
            .unwrap();
        assert!(
            log[0]
                .1
                .acknowledgements
                .iter()
                .any(|seen| seen.who == "Ada"),
            "{log:?}"
        );

        // The identification continues from the stored state, or from the result of reading the
        // recording again.
        let first = if kept.is_filter_read { SEEN } else { 0 };
        let start = Start::At {
            epoch,
            sequence: first as u64,
        };
        let mut reader =
            EstimateReader::with_settings(&bus, &keys, StreamSettings::new(start)).await;
        let mut decided = bus
            .watch_progress(keys.progress(Service::Alert))
            .await
            .unwrap();
        let mut sensors = Sensors::start(&bus, &keys, kept.site.structure(), &kept.record).await;
        sensors.put(0..SEEN).await;
        sensors.put(SEEN..ROWS).await;
        let found = reader.read_frames(ROWS - first).await;
        let off = difference(&expected.frames[first..], found);
        println!("frames {first} to {ROWS}: difference of {off}");
        assert!(
            off < ROUNDED,
            "frames {first} to {ROWS} are identified with a difference of {off}"
        );

        // The alert continues as well.
        within(
            "decision on all frames",
            decided.wait_for(|progress| progress.done >= ROWS as u64),
        )
        .await;
        let alert = alert_of_storey_2(&bus, &kept.site).await;
        assert_eq!(
            (alert.state, alert.acknowledged_by.as_deref()),
            (AlertState::Acknowledged, Some("Ada")),
            "{alert:?}"
        );
        assert_eq!(
            serde_json::to_value(alert.since_ns).unwrap(),
            kept.known["alert"]["since_ns"]
        );
        // Frames that are identified again do not change their entries in the history.
        let span = serde_json::to_value(history_of_storey_2(&bus, &kept.site, 11.0).await).unwrap();
        for (column, before) in kept.known["history"]["rows"].as_object().unwrap() {
            let before = before.as_array().unwrap();
            assert_eq!(
                &span["rows"][column].as_array().unwrap()[..before.len()],
                before,
                "{column}"
            );
        }
        services.stop().expect_code(0);
    }
}

// A rule without a reference was relative to the design in 0.1.0. It now learns its reference.
#[tokio::test(flavor = "multi_thread")]
async fn an_alert_of_0_1_0_whose_rule_now_learns_its_reference_ends_with_a_reason() {
    let kept = Kept::of(&fixtures().join("0.1.0"));
    let services = kept.run();
    let bus = kept.site.join().await;
    assert_eq!(alert_of_storey_2(&bus, &kept.site).await.state, Learning);
    let changes = log_of_storey_2(&bus, &kept.site).await;
    use AlertState::{Acknowledged, Cleared, Learning, Pending, Raised};
    assert_eq!(
        states(&changes),
        [Pending, Raised, Acknowledged, Cleared, Learning],
        "{changes:?}"
    );
    assert_as_known(&changes[2], &kept.known["alert"]);
    assert_eq!(
        changes[3].why,
        "alert of storey-2 has ended: its reference is being learnt again because the rule or the \
         model changed"
    );
    // A client that was absent finds the end of the alert in the history.
    let keys = kept.site.keys();
    within("the end in the history", async {
        loop {
            let logs = bus
                .ask::<HistoryLog>(&keys.history_log(), DEADLINE)
                .await
                .unwrap();
            let log = &logs[0].1;
            assert!(
                log.acknowledgements.iter().any(|seen| seen.who == "Ada"),
                "{log:?}"
            );
            if log
                .alerts
                .iter()
                .any(|alert| alert.state == Cleared && alert.parameter.as_str() == "storey-2")
            {
                return;
            }
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
    })
    .await;
    services.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_recording_of_each_version_contains_all_samples() {
    for version in versions() {
        let kept = Kept::of(&version);
        let copied = kept.site.folder().join("frames.csv");
        let mut convert = crate::support::spandrel("convert");
        Process::start(convert.arg(kept.recording()).arg(&copied))
            .wait()
            .expect_code(0);
        let found = Record::read(&copied);
        assert_eq!(found.len(), SEEN, "frames");
        for channel in kept.record.channels() {
            let name = found
                .channels()
                .iter()
                .find(|name| name.starts_with(channel.as_str()))
                .unwrap();
            for row in 0..SEEN {
                let (expected, found) = (kept.record.value(row, channel), found.value(row, name));
                assert_eq!(
                    expected.to_bits(),
                    found.to_bits(),
                    "{channel}, frame {row}"
                );
            }
        }
    }
}

// After a rollback, the files of a later version must be neither misread nor lost.
#[tokio::test(flavor = "multi_thread")]
async fn a_checkpoint_of_a_later_version_is_set_aside_and_the_recording_reread() {
    let kept = Kept::of(versions().last().unwrap());
    let expected = kept
        .site
        .estimate(kept.record.clone().save_as_copy(kept.site.folder()));
    for entry in std::fs::read_dir(kept.checkpoints()).unwrap() {
        std::fs::remove_file(entry.unwrap().path()).unwrap();
    }
    for kind in ["identify", "alert"] {
        let identity = Identity {
            kind,
            version: 1_000,
            of: "house".to_owned(),
            basis: String::new(),
        };
        let position = Position {
            epoch: 1,
            sequence: 1,
        };
        Checkpoints::open(&kept.checkpoints(), identity)
            .unwrap()
            .save(position, &"later".to_owned())
            .unwrap();
    }
    let services = kept.run();
    let log = services.log();
    for kind in ["identify", "alert"] {
        let name = format!("{kind}-{:020}-{:020}.checkpoint.refused", 1, 1);
        let line = log
            .lines()
            .find(|line| line.contains(&name))
            .unwrap_or_else(|| panic!("{name} in\n{log}"));
        assert!(
            line.contains("it has layout version 1000, this program reads version "),
            "{line}"
        );
        assert!(kept.checkpoints().join(name).is_file());
    }
    let (bus, keys) = (kept.site.join().await, kept.site.keys());
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let found = reader.read_frames(SEEN).await;
    let off = difference(&expected.frames[..SEEN], found);
    assert!(
        off < ROUNDED,
        "the recording is identified with a difference of {off}"
    );
    let mut decided = bus
        .watch_progress(keys.progress(Service::Alert))
        .await
        .unwrap();
    within(
        "decision on all frames",
        decided.wait_for(|progress| progress.done >= SEEN as u64),
    )
    .await;
    assert_ne!(
        alert_of_storey_2(&bus, &kept.site).await.state,
        AlertState::Normal
    );
    services.stop().expect_code(0);
}

/// Writes the state of this version for later versions.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "adds a folder to tests/fixtures/kept, once for each release"]
async fn write_the_files_of_this_version() {
    let folder = fixtures().join(env!("CARGO_PKG_VERSION"));
    assert!(
        !folder.exists(),
        "{} already exists and must not change",
        folder.display()
    );
    let site = Site::with(&two_storeys(RULES)).rooted(ROOT);
    let record = site.simulate(ROWS as f64 / 100.0).rounded(5);
    let state = site.folder().join("state");
    let services = run(&site, &state);
    let (bus, keys) = (site.join().await, site.keys());
    site.wait_for_services(&bus).await;
    let mut decided = bus
        .watch_progress(keys.progress(Service::Alert))
        .await
        .unwrap();
    let alerts = bus
        .subscribe::<AlertMessage>(keys.all_alerts(), 256)
        .await
        .unwrap();
    let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
    for block in 0..SEEN / 100 {
        sensors.put(100 * block..100 * (block + 1)).await;
    }
    within(
        "decision on all frames",
        decided.wait_for(|progress| progress.done >= SEEN as u64),
    )
    .await;
    let json =
        br#"{"structure": "house", "parameter": "storey-2", "time_ns": 8000000000, "who": "Ada", "note": "seen"}"#;
    put_raw(
        &bus,
        &keys.acknowledge(&Name::new("storey-2").unwrap()),
        "application/json",
        json.to_vec(),
    )
    .await;
    within("an acknowledged alert", async {
        while alerts.messages().recv_async().await.unwrap().1.state != AlertState::Acknowledged {}
    })
    .await;
    let span = history_of_storey_2(&bus, &site, 7.0).await;
    let known = serde_json::json!({"alert": alert_of_storey_2(&bus, &site).await, "history": span});
    services.stop().expect_code(0);
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::copy(site.structure_file(), folder.join("structure.toml")).unwrap();
    std::fs::write(
        folder.join("known.json"),
        serde_json::to_string(&known).unwrap(),
    )
    .unwrap();
    copy(&state, &folder.join("state"));
    record.clone().save_as_copy(&folder);
}
