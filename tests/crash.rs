//! Services and sensors that are killed at random moments.
//!
//! Every frame must be recorded, every estimate must be bit-identical to that of an uninterrupted
//! run, and every alert must appear exactly once. A short form runs with the other tests. To run
//! the long form with 200 kills, use
//! `cargo test --workspace --test program crash:: -- --ignored --nocapture`.

use crate::support::{
    DEADLINE, Drops, EstimateReader, Identified, Node, Process, Record, Sensors, Site, SmallDisk,
    assert_same_bits, spandrel, two_storeys, within,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use spandrel_alert::Watch;
use spandrel_bus::{
    AlertMessage, AlertState, Bus, BusConfig, FrameBlock, Header, HistoryLog, Mode, Name, Service,
    StreamState, Subscription,
};
use spandrel_identify::{Identification, IdentificationInput, Output};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use tokio::time::Instant;

/// Time between two looks at a condition that has no event.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Returns damage of storey 2 after a third of the record, and a rule whose alert passes through
/// all its states.
fn damaged(at_s: f64) -> String {
    format!(
        "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
         credibility = 0.99\nsustain-s = 3\n\
         [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = {at_s}\nloss = 0.15\n"
    )
}

/// The processes of a site around a router, each of which can be killed. One folder holds their
/// state.
struct Town {
    site: Site,
    record: Record,
    speed: &'static str,
    configuration: PathBuf,
    router: Option<Bus>,
    running: BTreeMap<&'static str, Process>,
}

const SERVICES: [&str; 4] = ["ingest", "identify", "alert", "history"];

impl Town {
    /// Creates a site with its state in `state` and starts all services.
    async fn start(length_s: f64, speed: &'static str, state: &str) -> Self {
        let site = Site::with(&two_storeys(&damaged(length_s / 3.0)));
        let record = site.simulate(length_s);
        let configuration = site.folder().join("spandrel.toml");
        let text = format!(
            "[bus]\nmode = \"client\"\n[state]\nfolder = \"{state}\"\ncheckpoint-s = 0.2\n\
             [history]\ndatabase = \"history.sqlite\"\n"
        );
        std::fs::write(&configuration, text).unwrap();
        let mut town = Self {
            site,
            record,
            speed,
            configuration,
            router: None,
            running: BTreeMap::new(),
        };
        town.start_router().await;
        for name in SERVICES {
            town.run(name);
        }
        for name in SERVICES {
            town.running[name].wait_for_log("ready structures=1");
        }
        town
    }

    async fn start_router(&mut self) {
        let config = BusConfig {
            mode: Mode::Router,
            listen: vec![self.site.endpoint().to_owned()],
            ..BusConfig::default()
        };
        self.router = Some(Bus::open(&config).await.unwrap());
    }

    fn run(&mut self, name: &'static str) {
        let mut command = match name {
            "replay" => {
                let mut command = spandrel("replay");
                command
                    .arg(self.record.path())
                    .arg("--structure")
                    .arg(self.site.structure_file());
                command.args([
                    "-v",
                    "--resume",
                    "--speed",
                    self.speed,
                    "--root",
                    self.site.keys().root().as_str(),
                ]);
                command.args(["--connect", self.site.endpoint()]);
                command
            }
            service => self.site.connecting(service),
        };
        command.arg("--config").arg(&self.configuration);
        self.running.insert(name, Process::start(&mut command));
    }

    /// Kills a process and restarts it.
    fn kill(&mut self, name: &'static str) {
        self.running.remove(name).unwrap().kill();
        self.run(name);
    }

    /// Waits until this number of frames has been identified. Returns the number at that time.
    async fn wait_for_frames(&self, bus: &Bus, count: u64) -> u64 {
        let key = self.site.keys().progress(Service::Identify);
        let mut progress = bus.watch_progress(key).await.unwrap();
        let reached = progress.wait_for(|progress| progress.done >= count);
        within(&format!("{count} identified frames"), reached)
            .await
            .done
    }

    fn has_ended(&mut self, name: &str) -> bool {
        self.running.get_mut(name).is_some_and(Process::has_ended)
    }

    /// Waits until all frames are replayed and decided on, stops everything, and compares with an
    /// uninterrupted run.
    async fn finish(mut self, bus: Bus, found: tokio::task::JoinHandle<Vec<Identified>>) {
        let expected = Expected::of(&self.site, &self.record);
        let (started, rate_hz) = (Instant::now(), self.site.structure().sampling_rate_hz());
        let length_s = self.record.len() as f64 / rate_hz / self.speed.parse::<f64>().unwrap();
        while !self.has_ended("replay") {
            assert!(
                started.elapsed() < DEADLINE + Duration::from_secs_f64(length_s),
                "the replay does not end"
            );
            tokio::time::sleep(LOOK_EVERY).await;
        }
        self.running.remove("replay").unwrap().wait().expect_code(0);
        let estimated = self.site.estimate(&self.record);
        let found = within("the last estimate", found).await.unwrap();
        assert_same_bits("stream", &estimated.parameters, &estimated.frames, &found);

        let is_last = |alert: &&AlertMessage| {
            let is_later = |other: &AlertMessage| {
                (&other.parameter, other.state, other.since_ns)
                    == (&alert.parameter, alert.state, alert.since_ns)
                    && other.revision > alert.revision
            };
            alert.revision == 0 || !expected.alerts.iter().any(is_later)
        };
        // The history contains the first announcement and the last revision.
        let wanted: Vec<&AlertMessage> = expected.alerts.iter().filter(is_last).collect();
        assert!(
            wanted.iter().any(|alert| alert.state == AlertState::Raised),
            "the record has no alert to lose"
        );
        let key = format!("{}?points=1000", self.site.keys().history_log());
        let started = Instant::now();
        let known = loop {
            let logs = bus.ask::<HistoryLog>(&key, DEADLINE).await.unwrap();
            let known: Vec<AlertMessage> =
                logs.into_iter().flat_map(|(_, log)| log.alerts).collect();
            if wanted.iter().all(|alert| known.contains(alert)) || started.elapsed() > DEADLINE {
                break known;
            }
            tokio::time::sleep(LOOK_EVERY).await;
        };
        // Each run of the service publishes again that a parameter is normal. All other decisions
        // are published once.
        let decided: Vec<&AlertMessage> = known
            .iter()
            .filter(|alert| alert.state != AlertState::Normal)
            .collect();
        let wanted: Vec<&AlertMessage> = wanted
            .into_iter()
            .filter(|alert| alert.state != AlertState::Normal)
            .collect();
        assert_eq!(decided, wanted, "alerts in the history");

        bus.close().await.unwrap();
        for (_, process) in std::mem::take(&mut self.running) {
            process.stop().expect_code(0);
        }
        self.compare_recording(&expected);
    }

    fn compare_recording(&self, expected: &Expected) {
        let (root, structure) = (
            self.site.keys().root().to_string(),
            self.site.structure().name().to_owned(),
        );
        let folder = self
            .state_folder()
            .join(root)
            .join(&structure)
            .join("recording");
        let log = self.site.frame_log(&folder);
        let reader = log.reader();
        let spans = reader.spans();
        assert_eq!(spans.len(), 1, "{spans:?}");
        assert_eq!(
            (spans[0].from, spans[0].to, spans[0].missing),
            (0, self.record.len() as u64, 0),
            "{spans:?}"
        );
        let mut values = Vec::new();
        let mut after = 0;
        loop {
            let frames = reader
                .read(spans[0].epoch, after, 1000, 1 << 20)
                .unwrap()
                .expect("the end is recorded");
            assert_eq!(frames.sequence, after);
            after += frames.count();
            values.extend(frames.values);
            if frames.ended {
                break;
            }
        }
        let bits = |values: &[f64]| {
            values
                .iter()
                .map(|value| value.to_bits())
                .collect::<Vec<_>>()
        };
        assert!(
            bits(&values) == bits(&expected.values),
            "the recording differs from the record"
        );
    }

    fn state_folder(&self) -> PathBuf {
        let text = std::fs::read_to_string(&self.configuration).unwrap();
        let folder = text
            .split("folder = \"")
            .nth(1)
            .unwrap()
            .split('"')
            .next()
            .unwrap();
        self.site.folder().join(folder)
    }
}

/// Results of an uninterrupted run, from the cores alone.
struct Expected {
    values: Vec<f64>,
    alerts: Vec<AlertMessage>,
}

impl Expected {
    fn of(site: &Site, record: &Record) -> Self {
        let structure = site.structure();
        let channels: Vec<String> = structure
            .channels()
            .map(|channel| channel.name().to_owned())
            .collect();
        let value = |row: usize, channel: &String| record.value(row, channel);
        let values: Vec<f64> = (0..record.len())
            .flat_map(|row| channels.iter().map(move |channel| value(row, channel)))
            .collect();
        let block = FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch: 1,
                sequence: 0,
                time_ns: 0,
            },
            t0_ns: 0,
            sampling_rate_hz: structure.sampling_rate_hz(),
            channels: channels.len() as u16,
            values: values.clone(),
            state: StreamState::Ended,
        };
        let mut watch = Watch::new(structure, None).unwrap();
        let (mut outputs, mut alerts) = (Vec::new(), Vec::new());
        Identification::new(structure, "identify")
            .unwrap()
            .handle(IdentificationInput::Frames(block), &mut outputs);
        for output in outputs {
            if let Output::Estimates(block) = output {
                watch.handle_block(&block, &mut alerts).unwrap();
            }
        }
        let name = |name: &str| Name::new(name).unwrap();
        let message = |alert: &spandrel_alert::Alert| {
            alert.to_message(
                &name(structure.name()),
                &name(structure.parameters()[alert.parameter].name()),
            )
        };
        Self {
            values,
            alerts: alerts.iter().map(message).collect(),
        }
    }
}

/// Reads all estimates of a site on a separate session, whatever happens to their publishers.
async fn read_all(site: &Site) -> (Bus, tokio::task::JoinHandle<Vec<Identified>>) {
    let bus = site.join().await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    (
        bus,
        tokio::spawn(async move { reader.read_to_end(1).await.to_vec() }),
    )
}

/// Kills `kills` processes at random moments while a record is replayed.
async fn killed_at_random_moments(kills: u32, length_s: f64, speed: &'static str, seed: u64) {
    let mut town = Town::start(length_s, speed, "kept").await;
    let (bus, found) = read_all(&town.site).await;
    town.run("replay");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut killed: BTreeMap<&str, u32> = BTreeMap::new();
    let victims = ["ingest", "identify", "alert", "history", "replay"];
    for _ in 0..kills {
        // The time between two kills is random. It stands for no event.
        tokio::time::sleep(Duration::from_millis(random.random_range(50..700))).await;
        assert!(
            !town.has_ended("replay"),
            "the record ended before {kills} kills: {killed:?}"
        );
        let victim = victims[random.random_range(0..victims.len())];
        *killed.entry(victim).or_default() += 1;
        town.kill(victim);
    }
    println!(
        "seed {seed}: killed {killed:?} in a record of {length_s} s at {speed} times real time"
    );
    town.finish(bus, found).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn kills_at_random_moments_lose_nothing_and_change_no_bit() {
    killed_at_random_moments(15, 150.0, "10", 1).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes minutes: the long form of the test above"]
async fn two_hundred_kills_lose_nothing_and_change_no_bit() {
    for seed in [1, 2] {
        killed_at_random_moments(200, 1500.0, "10", seed).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restarted_router_and_a_truncated_recording_lose_nothing() {
    let mut town = Town::start(150.0, "10", "kept").await;
    let (bus, found) = read_all(&town.site).await;
    town.run("replay");
    let before = town.wait_for_frames(&bus, 2_000).await;
    town.router.take().unwrap().close().await.unwrap();
    tokio::time::sleep(Duration::from_secs(1)).await; // the fault under test
    town.start_router().await;
    town.wait_for_frames(&bus, before + 2_000).await;
    town.running.remove("ingest").unwrap().kill();
    let segment = newest(&town.state_folder());
    let length = std::fs::metadata(&segment).unwrap().len();
    std::fs::OpenOptions::new()
        .write(true)
        .open(&segment)
        .unwrap()
        .set_len(length - 100)
        .unwrap();
    town.run("ingest");
    town.running["ingest"].wait_for_log("the recording ended in an incomplete record");
    town.finish(bus, found).await;
}

/// Returns the most recently written file of a recording.
fn newest(folder: &Path) -> PathBuf {
    let found = Command::new("find")
        .arg(folder)
        .args(["-name", "*.mcap", "-printf", "%T@ %p\n"])
        .output()
        .unwrap();
    let text = String::from_utf8(found.stdout).unwrap();
    let newest = text
        .lines()
        .max_by(|a, b| a.partial_cmp(b).unwrap())
        .unwrap();
    PathBuf::from(newest.split_once(' ').unwrap().1)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_stops_no_service_and_waiting_frames_are_recorded() {
    let disk = tempfile::tempdir().unwrap();
    let Some(_mounted) = SmallDisk::or_skip(disk.path(), "8m") else {
        return;
    };
    let mut town = Town::start(150.0, "10", disk.path().to_str().unwrap()).await;
    let (bus, found) = read_all(&town.site).await;
    let drops = Drops::watch(&bus, &town.site.keys()).await;
    town.run("replay");
    town.wait_for_frames(&bus, 2_000).await;
    let filling = disk.path().join("filling");
    let mut file = std::fs::File::create(&filling).unwrap();
    while file.write_all(&[0; 4096]).is_ok() {}
    drops
        .expect(Service::Ingest, "frames-waiting-for-the-disk", 1)
        .await;
    // The identification continues while the disk is full.
    let before = town.wait_for_frames(&bus, 0).await;
    town.wait_for_frames(&bus, before + 3_000).await;
    drop(file);
    std::fs::remove_file(&filling).unwrap();
    town.running["ingest"].wait_for_log("recording write succeeded again");
    town.finish(bus, found).await;
}

/// Receives frames until `count` are known, by epoch and sequence number. A repeated frame must be
/// bit-identical.
async fn hear(
    frames: &Subscription<FrameBlock>,
    heard: &mut BTreeMap<(u64, u64), Vec<u64>>,
    count: usize,
) {
    let listening = async {
        while heard.len() < count {
            let (_, block) = frames.messages().recv_async().await.unwrap();
            for (number, values) in block.iter() {
                let bits: Vec<u64> = values.iter().map(|value| value.to_bits()).collect();
                let known = heard
                    .entry((block.header.epoch, number))
                    .or_insert_with(|| bits.clone());
                assert!(
                    *known == bits,
                    "frame {number} of epoch {} came with other samples",
                    block.header.epoch
                );
            }
        }
    };
    within(&format!("{count} frames"), listening).await;
}

/// Subscribers may have received frames that a killed process never wrote to disk. The sequence
/// numbers of these frames must not be reused.
#[tokio::test(flavor = "multi_thread")]
async fn published_frames_that_were_never_recorded_do_not_reappear_with_other_samples() {
    let disk = tempfile::tempdir().unwrap();
    let Some(_mounted) = SmallDisk::or_skip(disk.path(), "2m") else {
        return;
    };
    let site = Site::with(&two_storeys(""));
    let record = site.simulate(6.0);
    let (bus, keys) = (site.host().await, site.keys());
    let run = || {
        let ingest = Process::start(
            site.connecting("ingest")
                .env("SPANDREL_STATE__FOLDER", disk.path()),
        );
        ingest.wait_for_log("ready structures=1");
        ingest
    };
    let frames = bus
        .subscribe::<FrameBlock>(keys.frames(), 4096)
        .await
        .unwrap();
    let mut heard: BTreeMap<(u64, u64), Vec<u64>> = BTreeMap::new();
    let mut ingest = run();
    let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
    sensors.put(0..200).await;
    hear(&frames, &mut heard, 200).await;
    let filling = disk.path().join("filling");
    let mut file = std::fs::File::create(&filling).unwrap();
    while file.write_all(&[0; 4096]).is_ok() {}
    while file.write_all(&[0; 1]).is_ok() {}
    sensors.put(200..300).await;
    hear(&frames, &mut heard, 300).await;
    ingest.wait_for_log("recording write failed");
    ingest.kill();
    drop((sensors, file));
    std::fs::remove_file(&filling).unwrap();

    // The nodes have restarted as well and no longer have their earlier samples.
    ingest = run();
    let mut nodes = Vec::new();
    for node in site.structure().nodes() {
        let channels = node
            .channels()
            .iter()
            .map(|channel| channel.name().to_owned())
            .collect();
        let mut node = Node::start(&bus, &keys, Name::new(node.name()).unwrap(), channels, 2).await;
        let block = node.block(&record, 400..600);
        node.put(block).await;
        nodes.push(node);
    }
    hear(&frames, &mut heard, 500).await;
    let epochs: Vec<u64> = heard.keys().map(|(epoch, _)| *epoch).collect();
    assert!(epochs.first() < epochs.last(), "a new epoch has begun");
    ingest.stop().expect_code(0);
}
