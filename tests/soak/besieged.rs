//! One process with all services, beside bad neighbours: wrong clocks, frozen readers, forged
//! results, slow connections and others, one after the other.
//!
//! After each of them, frames must contain the samples of all nodes again. Nothing may restart,
//! memory must not grow, and no sample of the steady node may be lost.

use super::houses::{Houses, OTHERS, STEADY, check_recording};
use super::measured::{Heard, Series, resident_mb};
use super::node::Manner;
use crate::neighbours::half;
use crate::support::{DEADLINE, Process, SmallDisk, put_raw, spandrel, storeys, within};
use rand::seq::SliceRandom as _;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use spandrel_bus::{
    Block as _, Bus, BusConfig, Delivery, EstimateBlock, Event, FrameBlock, Message as _, Mode,
    Name, SampleBlock, Service, Start, Stream, StreamSettings,
};
use std::collections::BTreeMap;
use std::io::{ErrorKind, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep};

/// Speed as a multiple of real time. The vote on the clocks compares them with a monotonic clock,
/// so that nodes at another speed are in a permanent state of catching up.
const SPEED: f64 = 1.0;
/// Structure whose ground is always measured by a correct node.
const STEADY_HOUSE: usize = 0;
/// Structure of which all nodes may be wrong at once.
const OTHER_HOUSE: usize = 1;
/// Maximum increase in memory from the first to the last fifth of the time after the warm-up, MB.
const GROWTH_MB: f64 = 10.0;

/// Size of the disk of the state.
const DISK: &str = "512m";
/// Maximum time until all is well again after a neighbour (s).
const MOST_RECOVERY_S: f64 = 30.0;

/// What one neighbour does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Trouble {
    /// The clock of one node is an hour ahead.
    NodeAhead,
    /// The clock of one node is some seconds ahead.
    NodeSecondsAhead,
    /// The clocks of all nodes are 400 days ahead.
    AllNodesAhead,
    /// A second program sends samples in the name of a node, in a higher epoch.
    SecondProgram,
    /// A node is killed.
    NodeGone,
    /// A simulation runs instead of the nodes.
    Simulation,
    /// Readers that are suspended while they receive.
    FrozenReaders,
    /// Connections to the page that send half a request.
    SlowConnections,
    /// Requests with a wrong token.
    WrongTokens,
    /// Frames, estimates and alerts in the name of the services: unreadable ones, estimates that
    /// continue the real ones with half the stiffness, and estimates of an impossible term.
    ForgedResults,
    /// Queries that nobody can answer.
    MalformedQueries,
    /// Bytes that are no samples.
    Garbage,
    /// The folder of the state is away.
    StateFolderAway,
    /// The disk of the state is full.
    FullDisk,
    /// The file of the history is overwritten.
    CorruptHistory,
    /// A command reads a file without end, a pipe that nobody writes, or one that unpacks to more
    /// than is allowed.
    BadFile,
    /// A check of 60 storeys, or one of 1,000, which is refused.
    LargeCheck,
}

const TROUBLES: [Trouble; 17] = [
    Trouble::NodeAhead,
    Trouble::NodeSecondsAhead,
    Trouble::AllNodesAhead,
    Trouble::SecondProgram,
    Trouble::NodeGone,
    Trouble::Simulation,
    Trouble::FrozenReaders,
    Trouble::SlowConnections,
    Trouble::WrongTokens,
    Trouble::ForgedResults,
    Trouble::MalformedQueries,
    Trouble::Garbage,
    Trouble::StateFolderAway,
    Trouble::FullDisk,
    Trouble::CorruptHistory,
    Trouble::BadFile,
    Trouble::LargeCheck,
];

#[tokio::test(flavor = "multi_thread")]
async fn one_process_beside_each_bad_neighbour_once() {
    besiege(Duration::ZERO, 1.0..2.0).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes an hour: the long form of the test above"]
async fn one_process_beside_bad_neighbours_for_an_hour() {
    let length = std::env::var("SOAK_S").map_or(3600, |text| text.parse().unwrap());
    besiege(Duration::from_secs(length), 2.0..20.0).await;
}

struct Besieged {
    houses: Houses,
    run: Process,
    page: String,
    token: String,
    state: PathBuf,
    /// The disk of the state.
    disk: PathBuf,
    _mounted: SmallDisk,
    bus: Bus,
    random: ChaCha8Rng,
}

impl Besieged {
    /// Starts all services. `None` without permission to mount a disk.
    async fn start() -> Option<Self> {
        let mut houses = Houses::new(2, SPEED);
        let site = &houses.sites[STEADY_HOUSE];
        let disk = site.folder().join("disk");
        std::fs::create_dir(&disk).unwrap();
        let mounted = SmallDisk::or_skip(&disk, DISK)?;
        let tokens = site.folder().join("tokens.json");
        let mut issue = spandrel("token");
        issue.args(["ada", "--role", "viewer", "--file"]);
        let issued = Process::start(issue.arg(&tokens)).wait().expect_code(0);
        let configuration = site.folder().join("spandrel.toml");
        let text = "isolated = true\n\
                    [state]\nfolder = \"disk/kept\"\ncheckpoint-s = 1\nrecording.keep-s = 86400\n\
                    [history]\ndatabase = \"disk/kept/history.sqlite\"\n\
                    [dashboard]\nlisten = \"127.0.0.1:0\"\ntokens = \"tokens.json\"\n";
        std::fs::write(&configuration, text).unwrap();
        let mut command = site.listening("run");
        command.arg(houses.sites[OTHER_HOUSE].structure_file());
        let run = Process::start(command.arg("--config").arg(&configuration));
        run.wait_for_output("address of the page", |said| said.contains("page: http://"));
        let said = run.output();
        let page = said.split("://").nth(1).unwrap();
        let page = page.split('/').next().unwrap().to_owned();
        run.wait_for_log("ready structures=2");
        let config = BusConfig {
            root: site.keys().root().to_string(),
            mode: Mode::Client, // peers would connect to each other
            connect: vec![site.endpoint().to_owned()],
            connect_timeout_s: Some(DEADLINE.as_secs_f64()),
            ..BusConfig::default()
        };
        let bus = Bus::open(&config).await.unwrap();
        site.wait_for_services(&bus).await;
        houses.start_nodes();
        Some(Self {
            houses,
            run,
            page,
            token: issued.stdout.trim().to_owned(),
            state: disk.join("kept"),
            disk,
            _mounted: mounted,
            bus,
            random: ChaCha8Rng::seed_from_u64(1),
        })
    }

    /// Lets a neighbour do what it does for some time, and removes it.
    async fn suffer(&mut self, trouble: Trouble, hold: Duration) {
        let other = OTHERS[self.random.random_range(0..OTHERS.len())];
        match trouble {
            Trouble::NodeAhead => {
                self.replace(STEADY_HOUSE, &[other], Manner::ClockAhead);
                sleep(hold).await;
                self.replace(STEADY_HOUSE, &[other], Manner::Honest);
            }
            Trouble::NodeSecondsAhead => {
                self.replace(STEADY_HOUSE, &[other], Manner::SecondsAhead);
                sleep(hold).await;
                self.replace(STEADY_HOUSE, &[other], Manner::Honest);
            }
            Trouble::AllNodesAhead => {
                let all = [STEADY, OTHERS[0], OTHERS[1]];
                self.replace(OTHER_HOUSE, &all, Manner::YearAhead);
                sleep(hold).await;
                self.replace(OTHER_HOUSE, &all, Manner::Honest);
            }
            Trouble::SecondProgram => {
                let second = self.houses.start(STEADY_HOUSE, other, Manner::LaterEpoch);
                sleep(hold).await;
                second.kill();
            }
            Trouble::NodeGone => {
                self.houses.nodes.remove(&(STEADY_HOUSE, other));
                sleep(hold).await;
                self.houses.send(STEADY_HOUSE, other, Manner::Honest);
            }
            Trouble::Simulation => self.simulate(),
            Trouble::FrozenReaders => self.freeze_readers(hold).await,
            Trouble::SlowConnections => {
                let slow: Vec<TcpStream> = (0..300)
                    .map(|_| {
                        let mut stream = TcpStream::connect(&self.page).unwrap();
                        // The server may have closed it to make room for a later one.
                        let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: ");
                        stream
                    })
                    .collect();
                self.get_structures(&self.token, &["200"]);
                sleep(hold).await;
                drop(slow);
            }
            Trouble::WrongTokens => {
                for _ in 0..40 {
                    self.get_structures("spandrel-wrong", &["401", "429"]);
                }
                self.get_structures(&self.token, &["200"]);
            }
            Trouble::ForgedResults => {
                let keys = self.houses.sites[STEADY_HOUSE].keys();
                let alert = keys.alert(&Name::new("storey-1").unwrap());
                for _ in 0..100 {
                    for key in [&keys.frames(), &keys.estimates(), &alert] {
                        put_raw(&self.bus, key, "application/json", b"{}".to_vec()).await;
                    }
                }
                self.forge_estimates().await;
            }
            Trouble::MalformedQueries => {
                let keys = self.houses.sites[STEADY_HOUSE].keys();
                let query = format!("{}?after=yesterday", keys.recording());
                for _ in 0..500 {
                    let replies = self.bus.session().get(&query).timeout(DEADLINE).await;
                    let reply = replies.unwrap().recv_async().await.unwrap();
                    assert!(reply.result().is_err(), "a malformed query has a reply");
                }
            }
            Trouble::Garbage => {
                let keys = self.houses.sites[STEADY_HOUSE].keys();
                let key = keys.samples(&Name::new(STEADY).unwrap());
                for _ in 0..500 {
                    let bytes = (0..self.random.random_range(0..2000))
                        .map(|_| self.random.random())
                        .collect();
                    put_raw(&self.bus, &key, &SampleBlock::encoding(), bytes).await;
                }
            }
            Trouble::StateFolderAway => {
                let away = self.state.with_extension("away");
                std::fs::rename(&self.state, &away).unwrap();
                sleep(hold).await;
                std::fs::rename(&away, &self.state).unwrap();
            }
            Trouble::FullDisk => {
                let ballast = self.disk.join("ballast");
                let mut file = std::fs::File::create(&ballast).unwrap();
                let full = std::io::copy(&mut std::io::repeat(1), &mut file);
                assert_eq!(full.unwrap_err().kind(), ErrorKind::StorageFull);
                sleep(hold).await;
                std::fs::remove_file(&ballast).unwrap();
            }
            Trouble::CorruptHistory => {
                let file = self.state.join("history.sqlite");
                std::fs::write(file, vec![b'x'; 100_000]).unwrap();
                sleep(hold).await;
            }
            Trouble::BadFile => self.read_a_bad_file(),
            Trouble::LargeCheck => {
                let file = self.disk.join("tall.toml");
                let (count, code) = [(60, 0), (1000, 2)][self.random.random_range(0..2)];
                std::fs::write(&file, storeys(count, "")).unwrap();
                let mut check = spandrel("check");
                Process::start(check.arg(&file)).wait().expect_code(code);
            }
        }
    }

    /// Kills nodes, and starts them again in another manner.
    fn replace(&mut self, structure: usize, nodes: &[&'static str], manner: Manner) {
        for node in nodes {
            self.houses.nodes.remove(&(structure, *node));
        }
        for node in nodes {
            self.houses.send(structure, node, manner);
        }
    }

    /// Publishes estimates that a reader could use: those that follow the last block, and those of
    /// a term that no leader has.
    async fn forge_estimates(&self) {
        let keys = self.houses.sites[STEADY_HOUSE].keys();
        let settings = StreamSettings::new(Start::Now);
        let estimates = self
            .bus
            .follow(keys.estimates(), keys.estimates_buffer(), settings);
        let estimates: Stream<EstimateBlock> = estimates.await.unwrap();
        let last = within("estimates", async {
            loop {
                let delivery = estimates.deliveries().recv_async().await.unwrap();
                if let Delivery::Block(block) = delivery {
                    return block;
                }
            }
        })
        .await;
        let following = half(&last);
        let impossible = EstimateBlock {
            term: u64::MAX,
            ..following.clone()
        };
        for forged in [following, impossible] {
            let payload = forged.encode().unwrap();
            put_raw(
                &self.bus,
                &keys.estimates(),
                &EstimateBlock::encoding(),
                payload,
            )
            .await;
        }
    }

    /// Lets a command read a file that it must refuse.
    fn read_a_bad_file(&mut self) {
        let structure = self.houses.sites[STEADY_HOUSE].structure_file();
        let fifo = self.disk.join("fifo");
        let made = Command::new("mkfifo").arg(&fifo).status().unwrap();
        assert!(made.success());
        let wide = self.disk.join("wide.csv");
        let columns: Vec<String> = (0..100_000).map(|number| format!("c{number}")).collect();
        std::fs::write(&wide, columns.join(",") + "\n").unwrap();
        let endless = Path::new("/dev/zero");
        let (command, option, file) = [
            ("check", "--record", endless),
            ("check", "--record", fifo.as_path()),
            ("check", "--record", wide.as_path()),
            ("check", "--baseline", endless),
            ("check", "--baseline", fifo.as_path()),
            ("estimate", "--record", wide.as_path()),
        ][self.random.random_range(0..6)];
        let mut read = spandrel(command);
        read.arg(structure).arg(option).arg(file);
        Process::start(&mut read).wait().expect_code(2);
        std::fs::remove_file(&fifo).unwrap();
        std::fs::remove_file(&wide).unwrap();
    }

    fn simulate(&mut self) {
        for node in [STEADY].into_iter().chain(OTHERS) {
            self.houses.nodes.remove(&(OTHER_HOUSE, node));
        }
        let mut simulation = self.houses.sites[OTHER_HOUSE].connecting("simulate");
        simulation.env("SPANDREL_BUS__MODE", "client");
        simulation.args(["--speed", "20"]);
        match self.random.random() {
            // The simulated times end now, or run ahead of the clock until the simulation stops.
            true => {
                simulation.args(["--duration", "60"]);
                Process::start(&mut simulation).wait().expect_code(0);
            }
            false => {
                let simulation = Process::start(&mut simulation);
                std::thread::sleep(Duration::from_secs(3));
                simulation.stop().expect_code(0);
            }
        }
        for node in [STEADY].into_iter().chain(OTHERS) {
            self.houses.send(OTHER_HOUSE, node, Manner::Honest);
        }
    }

    async fn freeze_readers(&self, hold: Duration) {
        let site = &self.houses.sites[STEADY_HOUSE];
        let root = site.keys().root().to_string();
        let watch = |_| {
            let mut command = spandrel("watch");
            command.args(["--root", &root, "--connect", site.endpoint()]);
            Process::start(command.env("SPANDREL_BUS__MODE", "client"))
        };
        let readers: Vec<Process> = (0..20).map(watch).collect();
        for reader in &readers {
            reader.wait_for_output("values", |said| said.contains("house-1"));
        }
        readers.iter().for_each(Process::freeze);
        sleep(hold).await;
        readers.into_iter().for_each(Process::kill);
    }

    /// Requests the list of structures, and checks the status of the reply.
    fn get_structures(&self, token: &str, expected: &[&str]) {
        let page = &self.page;
        let request = format!(
            "GET /api/structures HTTP/1.1\r\nHost: {page}\r\nAuthorization: Bearer {token}\r\n\
             Connection: close\r\n\r\n"
        );
        let mut stream = TcpStream::connect(page).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut reply = String::new();
        stream.read_to_string(&mut reply).unwrap();
        let status = reply.split(' ').nth(1).unwrap_or("none");
        assert!(expected.contains(&status), "{reply}");
    }

    /// Waits until frames of both structures contain the samples of all nodes, and until alerts
    /// have been decided on them.
    async fn wait_until_whole(&self) {
        for keys in self.houses.keys() {
            let settings = StreamSettings::new(Start::Now);
            let frames = self.bus.follow(keys.frames(), keys.recording(), settings);
            let frames: Stream<FrameBlock> = frames.await.unwrap();
            let whole = async {
                loop {
                    let delivery = frames.deliveries().recv_async().await.unwrap();
                    let Delivery::Block(block) = delivery else {
                        continue;
                    };
                    let is_whole = |(_, frame): (u64, &[f64])| frame.iter().all(|v| v.is_finite());
                    if block.iter().any(is_whole) {
                        return block;
                    }
                }
            };
            let structure = keys.structure().as_str();
            let block = within(&format!("frames of {structure} with all nodes"), whole).await;
            let alert = self.bus.watch_progress(keys.progress(Service::Alert)).await;
            let mut alert = alert.unwrap();
            let decided = alert.wait_for(|progress| {
                (progress.header.epoch, progress.done) >= (block.header.epoch, block.end())
            });
            within(&format!("decisions on {structure}"), decided).await;
        }
    }
}

/// Runs the services for `length`, or until each trouble has happened once. A trouble that lasts
/// does so for a random time (s).
async fn besiege(length: Duration, hold_s: std::ops::Range<f64>) {
    let Some(mut besieged) = Besieged::start().await else {
        return;
    };
    let started = Instant::now();
    let clock = besieged.houses.clock;
    let (heard, listening) =
        Heard::listen(&besieged.bus, &besieged.houses.keys(), clock, started).await;
    let events = count_events(&besieged).await;
    let memory_mb = Arc::new(Mutex::new(Series::default()));
    let measuring = measure_memory(besieged.run.id(), memory_mb.clone(), started);
    besieged.wait_until_whole().await;
    let mut recovery_s: BTreeMap<Trouble, Vec<f64>> = BTreeMap::new();
    let mut order: Vec<Trouble> = Vec::new();
    while started.elapsed() < length || recovery_s.len() < TROUBLES.len() || !order.is_empty() {
        if order.is_empty() {
            order = TROUBLES.to_vec();
            order.shuffle(&mut besieged.random);
        }
        let Some(trouble) = order.pop() else {
            continue;
        };
        let hold = Duration::from_secs_f64(besieged.random.random_range(hold_s.clone()));
        besieged.suffer(trouble, hold).await;
        let removed = Instant::now();
        besieged.wait_until_whole().await;
        assert!(!besieged.run.has_ended(), "after {trouble:?}");
        recovery_s
            .entry(trouble)
            .or_default()
            .push(removed.elapsed().as_secs_f64());
    }
    let observed = started.elapsed();
    measuring.abort();
    let counts = besieged.houses.end(&besieged.bus).await;
    listening.iter().for_each(tokio::task::JoinHandle::abort);
    besieged.bus.close().await.unwrap();
    let log = besieged.run.stop().expect_code(0).stderr;

    println!("one process, two structures, {} s", observed.as_secs());
    println!("trouble             times   s until all is well again: median, most");
    for (trouble, times_s) in &mut recovery_s {
        times_s.sort_unstable_by(f64::total_cmp);
        let (median, most) = (times_s[times_s.len() / 2], times_s[times_s.len() - 1]);
        println!(
            "{:18} {:6} {median:8.1} {most:8.1}",
            format!("{trouble:?}"),
            times_s.len()
        );
    }
    println!("events: {:?}", events.lock().unwrap());
    // The tests of one process must not overwrite each other's log.
    let log_file = format!("besieged-{}-s.log", length.as_secs());
    let log_file = Path::new(env!("CARGO_TARGET_TMPDIR")).join(log_file);
    std::fs::write(&log_file, &log).unwrap();
    let (lines, log_path) = (log.lines().count(), log_file.display());
    println!("log: {lines} lines, {} bytes in {log_path}", log.len());
    let heard = heard.lock().unwrap();
    for service in ["ingest", "identify", "alert", "history"] {
        println!("{service} counts {:?}", heard.counted(service));
    }
    let memory_mb = memory_mb.lock().unwrap();
    let tenth = |number: u32| {
        let (from, to) = (observed / 10 * number, observed / 10 * (number + 1));
        memory_mb.median("run", from, to)
    };
    let tenths: Vec<f64> = (0..10).map(tenth).collect();
    println!("memory MB, medians of each tenth: {tenths:.1?}");

    assert!(!log.contains("panicked"), "{log}");
    let most_s = recovery_s.values().flatten().copied().fold(0.0, f64::max);
    assert!(most_s < MOST_RECOVERY_S, "{recovery_s:?}");
    for service in ["identify", "alert"] {
        let counts = heard.counted(service);
        assert_eq!(counts.get("lost-items"), None, "{service}: {counts:?}");
    }
    let (put, frames) = counts[STEADY_HOUSE];
    check_recording(
        &besieged.state,
        &besieged.houses.sites[STEADY_HOUSE],
        put,
        frames,
    );
    // Clocks that are 400 days ahead must not make the recording of a day forget the present.
    let kept = besieged.houses.sites[OTHER_HOUSE].recording_in(&besieged.state);
    let first = kept.reader().spans()[0];
    assert_eq!(first.from, 0, "{first:?}");
    if !length.is_zero() {
        let growth = tenths[8..].iter().sum::<f64>() / 2.0 - tenths[2..4].iter().sum::<f64>() / 2.0;
        assert!(growth <= GROWTH_MB, "memory grows by {growth:.1} MB");
    }
}

/// Counts the events of both structures from now on, by kind.
async fn count_events(besieged: &Besieged) -> Arc<Mutex<BTreeMap<String, u64>>> {
    let counts: Arc<Mutex<BTreeMap<String, u64>>> = Arc::default();
    for keys in besieged.houses.keys() {
        let events = besieged.bus.subscribe::<Event>(keys.event(), 1024).await;
        let (events, counts) = (events.unwrap(), counts.clone());
        tokio::spawn(async move {
            while let Ok((_, event)) = events.messages().recv_async().await {
                let kind = format!("{:?}", event.kind);
                *counts.lock().unwrap().entry(kind).or_default() += 1;
            }
        });
    }
    counts
}

/// Measures the memory of a process every second.
fn measure_memory(
    process: u32,
    into: Arc<Mutex<Series>>,
    started: Instant,
) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        let mut second = interval(Duration::from_secs(1));
        second.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            second.tick().await;
            let memory_mb = resident_mb(process);
            into.lock()
                .unwrap()
                .push("run", started.elapsed(), memory_mb);
        }
    })
}
