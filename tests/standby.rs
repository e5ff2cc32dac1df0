//! Two identifications of the same structures: one leads, and the other is a standby that takes
//! over.
//!
//! Readers receive each estimate once, in strictly increasing terms. The estimates are
//! bit-identical to those of `spandrel estimate`.

use crate::support::{
    Drops, Estimated, Identified, Process, Record, Site, assert_same_bits, identified, put_raw,
    spandrel, two_storeys, within,
};
use spandrel_bus::{
    Block, Bus, BusConfig, Delivery, EstimateBlock, Message, Mode, Service, Standing, Start,
    Status, Stream, StreamSettings, StreamState, Subscription,
};
use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio::time::Instant;

/// Maximum time between two estimates at a takeover, according to the requirement.
const GAP: Duration = Duration::from_secs(3);
/// Replay speed as a multiple of real time.
const SPEED: &str = "10";

/// Time without a status after which an instance counts as gone.
const SILENT: Duration = Duration::from_secs(5);

/// Structures around a router, with ingest and alert in separate processes.
struct Town {
    sites: Vec<Site>,
    records: Vec<Record>,
    expected: Vec<Estimated>,
    bus: Bus,
    statuses: Vec<Subscription<Status>>,
    _others: [Process; 2],
    router: Bus,
}

impl Town {
    async fn start(structures: usize, length_s: f64) -> Self {
        let named = |number: usize| {
            let rule = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\n\
                        loss = 0.05\ncredibility = 0.99\nsustain-s = 3\n";
            two_storeys(rule).replace("name = \"house\"", &format!("name = \"house-{number}\""))
        };
        let first = Site::with(&named(0));
        let mut sites: Vec<Site> = (1..structures)
            .map(|number| Site::with(&named(number)).at(&first))
            .collect();
        sites.insert(0, first);
        let records: Vec<Record> = sites.iter().map(|site| site.simulate(length_s)).collect();
        let expected = sites
            .iter()
            .zip(&records)
            .map(|(site, record)| site.estimate(record))
            .collect();
        let config = BusConfig {
            mode: Mode::Router,
            listen: vec![sites[0].endpoint().to_owned()],
            ..BusConfig::default()
        };
        let router = Bus::open(&config).await.unwrap();
        let bus = sites[0].join().await;
        let mut statuses = Vec::new();
        for site in &sites {
            statuses.push(
                bus.subscribe(site.keys().all_statuses(), 1024)
                    .await
                    .unwrap(),
            );
        }
        let ready = format!("ready structures={structures}");
        let others = ["alert", "ingest"].map(|service| {
            let process = Process::start(&mut client(service, &sites));
            process.wait_for_log(&ready);
            process
        });
        Self {
            sites,
            records,
            expected,
            bus,
            statuses,
            _others: others,
            router,
        }
    }

    fn identify(&self, arguments: &[&str]) -> Process {
        Process::start(client("identify", &self.sites).args(arguments))
    }

    fn replay(&self) -> Vec<Process> {
        self.sites
            .iter()
            .zip(&self.records)
            .map(|(site, record)| site.replay(record, SPEED))
            .collect()
    }

    async fn read(&self) -> Vec<Reader> {
        let mut readers = Vec::new();
        for site in &self.sites {
            readers.push(Reader::join(&self.bus, site).await);
        }
        readers
    }

    /// Waits until exactly these standings have been reported for each structure since this call,
    /// each by a different instance. Returns the id of the leader of the first structure.
    async fn until_standing(&self, wanted: &[Standing]) -> String {
        let mut leader = String::new();
        for (site, statuses) in self.sites.iter().zip(&self.statuses).rev() {
            let what = format!("{wanted:?} of {}", site.structure().name());
            let all = async {
                drop(statuses.messages().drain());
                let mut told: BTreeMap<String, (Standing, u32, Instant)> = BTreeMap::new();
                loop {
                    let (_, status) = statuses.messages().recv_async().await.unwrap();
                    let Some(state) = status.state else { continue };
                    // Each instance publishes its status once a second. Drop those that have
                    // stopped.
                    told.retain(|_, (_, _, heard)| heard.elapsed() < SILENT);
                    let times = told
                        .get(status.id.as_str())
                        .map_or(0, |(_, times, _)| *times);
                    told.insert(status.id.to_string(), (state, times + 1, Instant::now()));
                    let now: Vec<Standing> = told.values().map(|(state, ..)| *state).collect();
                    let count = |of: &[Standing], standing| {
                        of.iter().filter(|state| **state == standing).count()
                    };
                    let is_wanted = [Standing::Leading, Standing::StandingBy, Standing::Joining]
                        .into_iter()
                        .all(|standing| count(&now, standing) == count(wanted, standing));
                    if is_wanted && told.values().all(|(_, times, _)| *times >= 2) {
                        return told
                            .into_iter()
                            .find(|(_, (state, ..))| *state == Standing::Leading)
                            .unwrap()
                            .0;
                    }
                }
            };
            leader = within(&what, all).await;
        }
        leader
    }

    /// Waits for the end of all records, compares every estimate, and returns the readers.
    async fn finish(&self, replays: Vec<Process>, readers: Vec<JoinHandle<Reader>>) -> Vec<Reader> {
        for replay in replays {
            replay.wait().expect_code(0);
        }
        let mut all = Vec::new();
        for (reader, expected) in readers.into_iter().zip(&self.expected) {
            let reader = within("the last estimate", reader).await.unwrap();
            assert_same_bits(
                "stream",
                &expected.parameters,
                &expected.frames,
                &reader.frames,
            );
            all.push(reader);
        }
        all
    }

    async fn close(self) {
        self.bus.close().await.unwrap();
        self.router.close().await.unwrap();
    }
}

/// Checks that the records have not ended, so that the test affects processes in operation.
fn assert_still_running(replays: &mut [Process]) {
    assert!(
        replays.iter_mut().all(|replay| !replay.has_ended()),
        "the records ended too early"
    );
}

/// Returns a service of all structures as a client of the router.
fn client(service: &str, sites: &[Site]) -> Command {
    let mut command = spandrel(service);
    command
        .env("SPANDREL_BUS__MODE", "client")
        .args(sites.iter().map(Site::structure_file));
    command.args([
        "-v",
        "--root",
        sites[0].keys().root().as_str(),
        "--connect",
        sites[0].endpoint(),
    ]);
    command
}

/// Reads the estimates of one structure, and notes their terms and times.
struct Reader {
    stream: Stream<EstimateBlock>,
    of: String,
    frames: Vec<Identified>,
    /// Term, number of its first estimate here, and time since the preceding estimate.
    terms: Vec<(u64, u64, Duration)>,
    last: Instant,
}

impl Reader {
    async fn join(bus: &Bus, site: &Site) -> Self {
        let keys = site.keys();
        let settings = StreamSettings::new(Start::Beginning);
        let stream = bus
            .follow(keys.estimates(), keys.estimates_buffer(), settings)
            .await
            .unwrap();
        let of = site.structure().name().to_owned();
        Self {
            stream,
            of,
            frames: Vec::new(),
            terms: Vec::new(),
            last: Instant::now(),
        }
    }

    /// Reads a block. Returns `false` at the end of the stream.
    async fn read_block(&mut self) -> bool {
        let what = format!("estimates of {}, {} so far", self.of, self.frames.len());
        let delivery = within(&what, self.stream.deliveries().recv_async())
            .await
            .unwrap();
        let Delivery::Block(block) = delivery else {
            panic!("{}: lost: {delivery:?}", self.of)
        };
        assert_eq!(
            block.header.sequence,
            self.frames.len() as u64,
            "{}: each estimate comes once",
            self.of
        );
        let last = self.terms.last().map_or(0, |(term, ..)| *term);
        assert!(
            block.term >= last,
            "{}: term {} after {last}",
            self.of,
            block.term
        );
        if block.term > last {
            self.terms
                .push((block.term, block.header.sequence, self.last.elapsed()));
        }
        self.last = Instant::now();
        self.frames.extend(identified(&block));
        block.state() == StreamState::Running
    }

    async fn read_frames(&mut self, count: usize) {
        while self.frames.len() < count {
            self.read_block().await;
        }
    }

    /// Reads until the `count`th term.
    async fn read_terms(&mut self, count: usize) {
        while self.terms.len() < count {
            self.read_block().await;
        }
    }

    fn read_to_end(mut self) -> JoinHandle<Self> {
        tokio::spawn(async move {
            while self.read_block().await {}
            self
        })
    }
}

/// Prints the time between the last estimate of a leader and the first one of the next, and checks
/// it against the requirement.
fn check_gaps(what: &str, readers: &[Reader], takeovers: usize) {
    for reader in readers {
        let gaps: Vec<Duration> = reader
            .terms
            .iter()
            .skip(1)
            .map(|(_, _, gap)| *gap)
            .collect();
        let told: Vec<String> = gaps
            .iter()
            .map(|gap| format!("{:.3} s", gap.as_secs_f64()))
            .collect();
        println!(
            "{what}: {}: {} of {} terms, gaps {}",
            reader.of,
            takeovers,
            reader.terms.len(),
            told.join(", ")
        );
        assert_eq!(
            gaps.len(),
            takeovers,
            "{}: terms {:?}",
            reader.of,
            reader.terms
        );
        let terms: BTreeSet<u64> = reader.terms.iter().map(|(term, ..)| *term).collect();
        assert_eq!(
            terms.len(),
            reader.terms.len(),
            "{}: a term comes twice",
            reader.of
        );
        assert!(
            gaps.iter().all(|gap| *gap < GAP),
            "{}: a gap of 3 s or more",
            reader.of
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_leader_under_load_is_replaced_within_three_seconds_with_the_same_bits() {
    let town = Town::start(4, 100.0).await;
    let first = town.identify(&["--standby"]);
    town.until_standing(&[Standing::Leading]).await;
    let second = town.identify(&["--standby"]);
    town.until_standing(&[Standing::Leading, Standing::StandingBy])
        .await;
    let mut readers = town.read().await;
    let drops = Drops::watch(&town.bus, &town.sites[0].keys()).await;
    let replays = town.replay();
    for reader in &mut readers {
        reader.read_frames(1500).await;
    }
    let term = readers[0].terms[0].0;
    first.kill();
    let readers = readers.into_iter().map(Reader::read_to_end).collect();
    let readers = town.finish(replays, readers).await;
    check_gaps("killed", &readers, 1);

    // Late messages of the terminated leader have a lower term and are rejected.
    let alert = drops.when_done(Service::Alert, 10_000).await;
    assert!(!alert.drops.contains_key("lost-items"), "{:?}", alert.drops);
    let mut late = EstimateBlock {
        header: spandrel_bus::Header {
            source: "identify".into(),
            epoch: u64::MAX,
            sequence: 0,
            time_ns: 0,
        },
        term,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 2,
        noise_parameters: 0,
        channels: 0,
        estimates: Vec::new(),
        state: StreamState::Running,
    };
    for _ in 0..3 {
        late.header.sequence += 1;
        let key = town.sites[0].keys().estimates();
        put_raw(
            &town.bus,
            &key,
            &EstimateBlock::encoding(),
            late.encode().unwrap(),
        )
        .await;
    }
    let counted = drops.expect(Service::Alert, "superseded-blocks", 3).await;
    assert!(!counted.contains_key("lost-items"), "{counted:?}");
    second.stop().expect_code(0);
    town.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_leader_becomes_a_standby_when_it_resumes() {
    let town = Town::start(2, 300.0).await;
    let first = town.identify(&["--standby"]);
    town.until_standing(&[Standing::Leading]).await;
    let second = town.identify(&["--standby"]);
    town.until_standing(&[Standing::Leading, Standing::StandingBy])
        .await;
    let mut readers = town.read().await;
    let mut replays = town.replay();
    for reader in &mut readers {
        reader.read_frames(1000).await;
    }
    first.freeze();
    for reader in &mut readers {
        reader.read_terms(2).await;
    }
    let frozen = readers
        .iter()
        .map(|reader| reader.terms[1].2)
        .max()
        .unwrap();
    println!(
        "frozen: {:.3} s until the next estimate",
        frozen.as_secs_f64()
    );
    first.thaw();
    first.wait_for_log("superseded: another process leads");
    let readers: Vec<_> = readers.into_iter().map(Reader::read_to_end).collect();
    town.until_standing(&[Standing::Leading, Standing::StandingBy])
        .await;
    assert_still_running(&mut replays);
    second.kill();
    let readers = town.finish(replays, readers).await;
    for reader in &readers {
        assert_eq!(
            reader.terms.len(),
            3,
            "{}: the first, the second and the first again: {:?}",
            reader.of,
            reader.terms
        );
    }
    first.stop().expect_code(0);
    town.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn one_of_two_simultaneous_starts_leads_and_a_standby_can_restart() {
    let town = Town::start(2, 300.0).await;
    let mut both = [town.identify(&["--standby"]), town.identify(&["--standby"])].map(Some);
    town.until_standing(&[Standing::Leading, Standing::StandingBy])
        .await;
    let mut readers = town.read().await;
    let mut replays = town.replay();
    for reader in &mut readers {
        reader.read_frames(500).await;
    }
    // Whichever instance leads a structure: one is killed and restarted, then the other is killed.
    both[0].take().unwrap().kill();
    let again = town.identify(&["--standby"]);
    let readers: Vec<_> = readers.into_iter().map(Reader::read_to_end).collect();
    town.until_standing(&[Standing::Leading, Standing::StandingBy])
        .await;
    assert_still_running(&mut replays);
    both[1].take().unwrap().kill();
    let readers = town.finish(replays, readers).await;
    for reader in &readers {
        assert!(
            reader.terms.len() > 1,
            "{}: one of the two that were killed led: {:?}",
            reader.of,
            reader.terms
        );
        let gaps: Vec<f64> = reader
            .terms
            .iter()
            .skip(1)
            .map(|(_, _, gap)| gap.as_secs_f64())
            .collect();
        println!("started again: {}: gaps {gaps:.3?} s", reader.of);
    }
    again.stop().expect_code(0);
    town.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_that_is_not_a_standby_takes_the_lead() {
    let town = Town::start(1, 200.0).await;
    let standby = town.identify(&["--standby"]);
    let before = town.until_standing(&[Standing::Leading]).await;
    assert!(before.starts_with("identify-"), "{before}");
    let mut readers = town.read().await;
    let mut replays = town.replay();
    readers[0].read_frames(500).await;
    let first = town.identify(&[]);
    standby.wait_for_log("superseded: another process leads");
    let readers: Vec<_> = readers.into_iter().map(Reader::read_to_end).collect();
    assert_eq!(
        town.until_standing(&[Standing::Leading, Standing::StandingBy])
            .await,
        "identify"
    );
    assert_still_running(&mut replays);
    first.stop().expect_code(0);
    let readers = town.finish(replays, readers).await;
    check_gaps("stopped in order", &readers, 2);
    standby.stop().expect_code(0);
    town.close().await;
}

#[test]
fn nodes_with_their_own_filters_have_no_standby() {
    let example = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples/demo-distributed.toml");
    let told = Process::start(spandrel("identify").arg(example).arg("--standby"))
        .wait()
        .expect_code(2);
    assert!(told.stderr.contains("have no standby"), "{}", told.stderr);
}
