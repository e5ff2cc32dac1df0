//! SeedLink servers that the feed reads. The server is `seedlink-rs-server`, not our own code.

use crate::support::{HOUSE, Process, Site, within};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seedlink_rs_server::{DataStore, SeedLinkServer, ServerConfig, ShutdownHandle};
use spandrel_bus::{
    Bus, ConditionDisplay, Delivery, Event, EventKind, FrameBlock, Name, Service, Start, Status,
    TimeGrid,
};
use spandrel_service::Clock;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

const STEP_NS: i64 = 10_000_000;
const SECOND_NS: i64 = 1_000_000_000;
/// Samples of a record of 512 bytes with integers of 32 bits: (512 − 64) / 4.
const RECORD: i64 = 112;

/// Returns the counts of sample `number` of a station.
fn counts(station: usize, number: i64) -> i32 {
    let number = number as i32;
    [5 * number, 1 - number][station]
}

/// Returns the record of station `R1` or `R2` that starts at sample `number`.
fn record(station: usize, t0_ns: i64, number: i64) -> Vec<u8> {
    let id = (&*format!("R{}", station + 1), "ENZ");
    record_of(id, 100, t0_ns + number * STEP_NS, |sample| {
        counts(station, number + sample)
    })
}

/// Returns a miniSEED 2 record of a channel of a station, big endian, without compression.
///
/// Source: SEED reference manual v2.4, chapter 8.
fn record_of(
    (station, channel): (&str, &str),
    rate_hz: i16,
    start_ns: i64,
    counts: impl Fn(i64) -> i32,
) -> Vec<u8> {
    let (day, of_day_ns) = (
        start_ns.div_euclid(86_400 * SECOND_NS),
        start_ns.rem_euclid(86_400 * SECOND_NS),
    );
    let (year, day_of_year) = year_and_day(day);
    let seconds = of_day_ns / SECOND_NS;
    let mut bytes = format!(
        "{:06}D {:<5}{:<2}{:<3}{:<2}",
        1, station, "00", channel, "AM"
    )
    .into_bytes();
    bytes.extend((year as u16).to_be_bytes());
    bytes.extend((day_of_year as u16).to_be_bytes());
    bytes.extend([
        (seconds / 3600) as u8,
        (seconds / 60 % 60) as u8,
        (seconds % 60) as u8,
        0,
    ]);
    bytes.extend(((of_day_ns % SECOND_NS / 100_000) as u16).to_be_bytes());
    bytes.extend((RECORD as u16).to_be_bytes());
    bytes.extend(rate_hz.to_be_bytes()); // rate factor
    bytes.extend(1_i16.to_be_bytes()); // rate multiplier
    bytes.extend([0, 0, 0, 1]); // flags, number of blockettes
    bytes.extend(0_i32.to_be_bytes()); // time correction
    bytes.extend(64_u16.to_be_bytes()); // start of the samples
    bytes.extend(48_u16.to_be_bytes()); // first blockette
    bytes.extend(1000_u16.to_be_bytes());
    bytes.extend(0_u16.to_be_bytes()); // no further blockette
    bytes.extend([3, 1, 9, 0]); // 32-bit integers, big endian, 2⁹ bytes
    bytes.resize(64, 0);
    for sample in 0..RECORD {
        bytes.extend(counts(sample).to_be_bytes());
    }
    assert_eq!(bytes.len(), 512);
    bytes
}

/// Returns the year and the day of the year (from 1) of a day since 1970.
fn year_and_day(mut day: i64) -> (i64, i64) {
    let mut year = 1970;
    loop {
        let is_leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
        let days = if is_leap { 366 } else { 365 };
        if day < days {
            return (year, day + 1);
        }
        day -= days;
        year += 1;
    }
}

/// A running server.
struct Server {
    store: DataStore,
    address: String,
    shutdown: ShutdownHandle,
    running: tokio::task::JoinHandle<()>,
}

impl Server {
    /// Starts a server that keeps its packets in a folder.
    async fn start(address: &str, journal: &Path) -> Self {
        let config = ServerConfig {
            persist_dir: Some(journal.to_owned()),
            ..ServerConfig::default()
        };
        let server = SeedLinkServer::bind_with_config(address, config)
            .await
            .unwrap();
        Self {
            store: server.store().clone(),
            address: server.local_addr().unwrap().to_string(),
            shutdown: server.shutdown_handle(),
            running: tokio::spawn(server.run()),
        }
    }

    /// Adds records of both stations.
    fn push(&self, t0_ns: i64, records: std::ops::Range<i64>) {
        for number in records {
            for station in 0..2 {
                let name = format!("R{}", station + 1);
                let record = record(station, t0_ns, number * RECORD);
                self.store.push("AM", &name, &record).unwrap();
            }
        }
    }

    async fn stop(self) {
        self.shutdown.shutdown();
        self.running.await.unwrap();
    }
}

/// Returns the time one hour ago, in whole steps.
fn an_hour_ago() -> i64 {
    (Clock::of_machine().now_ns() - 3600 * SECOND_NS) / STEP_NS * STEP_NS
}

fn configure(site: &Site, address: &str, more: &str) -> PathBuf {
    let channel = |label: &str, channel: &str| {
        format!(
            "[[feed.source.channel]]\nsource = \"{label}\"\nchannel = \"{channel}\"\n\
             sensitivity = 100\n"
        )
    };
    let text = format!(
        "[[feed.source]]\nname = \"hub\"\nkind = \"seedlink\"\naddress = \"{address}\"\n{more}\n"
    ) + &channel("AM.R1.00.ENZ", "ground")
        + &channel("AM.R2.00.ENZ", "roof");
    let path = site.folder().join("feed.toml");
    std::fs::write(&path, text).unwrap();
    path
}

fn start_feed(site: &Site, configuration: &Path) -> Process {
    let mut command = site.connecting("feed");
    let feed = Process::start(command.arg("--config").arg(configuration));
    feed.wait_for_log("feed ready");
    feed
}

/// The frames of ingest by the number of the sample.
struct Frames {
    stream: spandrel_bus::Stream<FrameBlock>,
    found: BTreeMap<i64, Vec<f64>>,
    t0_ns: i64,
}

impl Frames {
    async fn follow(bus: &Bus, site: &Site, t0_ns: i64) -> Self {
        let (keys, settings) = (site.keys(), bus.reading(Start::Beginning).patient());
        let stream = bus.follow(keys.frames(), keys.recording(), settings).await;
        Self {
            stream: stream.unwrap(),
            found: BTreeMap::new(),
            t0_ns,
        }
    }

    async fn up_to(&mut self, number: i64) {
        within(&format!("frame with sample {number}"), async {
            while self
                .found
                .last_key_value()
                .is_none_or(|(last, _)| *last < number)
            {
                let Delivery::Block(block) = self.stream.deliveries().recv_async().await.unwrap()
                else {
                    panic!("ingest has lost frames");
                };
                let grid = TimeGrid::new(block.t0_ns, block.sampling_rate_hz).unwrap();
                for (frame, values) in (block.header.sequence..).zip(block.values.chunks(2)) {
                    let number = (grid.time_ns(frame) - self.t0_ns).div_euclid(STEP_NS);
                    self.found.insert(number, values.to_vec());
                }
            }
        })
        .await;
    }

    /// Checks that samples 0 to `count` are complete and equal those of the server.
    fn expect_all(&self, count: i64) {
        assert_eq!(self.found.len() as i64, count);
        for (number, values) in &self.found {
            let sent = [0, 1].map(|station| f64::from(counts(station, *number)) / 100.0);
            assert_eq!(values[..], sent, "sample {number}");
        }
    }
}

async fn start_site(configuration: &str, address: &str) -> (Site, Process, Bus, PathBuf) {
    let site = Site::with(HOUSE);
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let path = configure(&site, address, configuration);
    (site, ingest, bus, path)
}

/// Kills the feed at random moments, and then restarts the server. No sample is lost.
async fn nothing_is_lost(protocol: &str) {
    let journal = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", journal.path()).await;
    let address = server.address.clone();
    let (site, _ingest, bus, path) = start_site(protocol, &address).await;
    let t0_ns = an_hour_ago();
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let mut random = ChaCha8Rng::seed_from_u64(20_062);
    let mut next = 0;
    for _ in 0..10 {
        let feed = start_feed(&site, &path);
        let records = random.random_range(10..60);
        server.push(t0_ns, next..next + records);
        let samples = random.random_range(1..records * RECORD);
        frames.up_to(next * RECORD + samples).await;
        next += records;
        feed.kill();
        server.push(t0_ns, next..next + 5);
        next += 5;
    }
    let feed = start_feed(&site, &path);
    frames.up_to(next * RECORD - 1).await;
    server.stop().await;
    feed.wait_for_log("state=\"failed\"");
    let server = Server::start(&address, journal.path()).await;
    server.push(t0_ns, next..next + 20);
    next += 20;
    frames.up_to(next * RECORD - 1).await;
    frames.expect_all(next * RECORD);
    feed.stop().expect_code(0);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn version_4_loses_nothing_when_feed_or_server_restart() {
    nothing_is_lost("").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn version_3_loses_nothing_when_feed_or_server_restart() {
    nothing_is_lost("protocol = \"3\"").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_channel_is_a_condition_with_one_value_per_sample() {
    let journal = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", journal.path()).await;
    let air = "[[condition]]\nname = \"air\"\nunit = \"degC\"\n";
    let site = Site::with(&format!("{HOUSE}\n{air}"));
    let bus = site.host().await;
    let values = bus
        .subscribe::<ConditionDisplay>(site.keys().all_conditions(), 1024)
        .await
        .unwrap();
    let path = site.folder().join("feed.toml");
    let text = format!(
        "[[feed.source]]\nname = \"hub\"\nkind = \"seedlink\"\naddress = \"{}\"\n\
         [[feed.source.condition]]\nsource = \"AM.R1.00.ENZ\"\ncondition = \"air\"\n\
         sensitivity = 100\n",
        server.address
    );
    std::fs::write(&path, text).unwrap();
    let feed = start_feed(&site, &path);
    feed.wait_for_log("state=\"connected\"");
    let t0_ns = an_hour_ago();
    let mut slow = record(0, t0_ns, 0);
    slow[32..34].copy_from_slice(&1_i16.to_be_bytes()); // 1 Hz
    server.store.push("AM", "R1", &slow).unwrap();
    for sample in 0..RECORD {
        let received = within("a value", values.messages().recv_async()).await;
        let (_, value) = received.unwrap();
        assert_eq!(value.time_ns, t0_ns + sample * SECOND_NS);
        assert_eq!(value.value, f64::from(counts(0, sample)) / 100.0);
    }
    feed.stop().expect_code(0);
    tokio::time::timeout(Duration::from_secs(30), server.stop())
        .await
        .unwrap();
}

/// Adds a blockette 1001 with this quality of the time (per cent) to a record.
fn with_quality(mut record: Vec<u8>, quality: u8) -> Vec<u8> {
    record[39] = 2; // number of blockettes
    record[50..52].copy_from_slice(&56_u16.to_be_bytes());
    record[56..58].copy_from_slice(&1001_u16.to_be_bytes());
    record[60] = quality;
    record
}

// The quality was read and dropped.
#[tokio::test(flavor = "multi_thread")]
async fn quality_of_the_clock_reaches_the_status_of_ingest_and_a_low_one_is_named() {
    let journal = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", journal.path()).await;
    let (site, _ingest, bus, path) = start_site("", &server.address).await;
    let keys = site.keys();
    let events = bus.subscribe::<Event>(keys.event(), 64).await.unwrap();
    let statuses = bus
        .subscribe::<Status>(keys.statuses(Service::Ingest), 256)
        .await
        .unwrap();
    let feed = start_feed(&site, &path);
    let t0_ns = an_hour_ago();
    for (station, quality) in [90, 35].into_iter().enumerate() {
        let record = with_quality(record(station, t0_ns, 0), quality);
        let id = format!("R{}", station + 1);
        server.store.push("AM", &id, &record).unwrap();
    }
    let named = within("an event", async {
        loop {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if event.kind == EventKind::ClockDoubtful {
                return event;
            }
        }
    });
    let named = named.await;
    // Both stations are channels of one node.
    assert_eq!(named.subject, "shake", "{named:?}");
    assert!(named.what.contains("35 %"), "{named:?}");
    let shake = Name::new("shake").unwrap();
    within("the quality in a status", async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            let clock = status.clocks.get(&shake);
            if clock.is_some_and(|clock| clock.quality_percent == Some(35)) {
                return;
            }
        }
    })
    .await;
    feed.stop().expect_code(0);
    tokio::time::timeout(Duration::from_secs(30), server.stop())
        .await
        .unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_rate_of_a_record_is_an_error_with_both_rates() {
    let journal = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", journal.path()).await;
    let (site, _ingest, bus, path) = start_site("", &server.address).await;
    let statuses = bus
        .subscribe::<Status>(site.keys().statuses(Service::Feed), 256)
        .await
        .unwrap();
    let feed = start_feed(&site, &path);
    let mut slow = record(0, an_hour_ago(), 0);
    slow[32..34].copy_from_slice(&50_i16.to_be_bytes());
    server.store.push("AM", "R1", &slow).unwrap();
    let error = within("an error", async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if let Some(error) = status.instruments["hub"].last_error.clone() {
                return error;
            }
        }
    })
    .await;
    assert!(
        error.starts_with("AM.R1.00.ENZ: sampling rate is 50.0000 Hz, must be 100 Hz"),
        "{error}"
    );
    feed.stop().expect_code(0);
    tokio::time::timeout(Duration::from_secs(30), server.stop())
        .await
        .unwrap();
}

/// Number of stations, and of channels of each station, of [`load_of_many_stations`].
const STATIONS: usize = 24;
const CHANNELS: [&str; 3] = ["ENZ", "ENN", "ENE"];
/// Sampling rate of these stations, Hz.
const FAST_HZ: i64 = 200;
/// Length of the measurement, s.
const MEASURED_S: i64 = 60;

/// Returns a building with a station on each floor.
fn tall_house() -> String {
    let mut text = format!(
        "[structure]\nname = \"tower\"\nsampling-rate-hz = {FAST_HZ}\n[model]\n\
         kind = \"shear-building\"\nstoreys = {STATIONS}\nmass-kg = 20_000\n\
         first-frequency-hz = 0.5\n\
         [damping]\nkind = \"rayleigh\"\nratio = 0.02\n[[parameter]]\nname = \"all\"\n\
         scales = \"stiffness\"\nof = [\"storey-1\"]\n[[excitation]]\nname = \"ground\"\n\
         kind = \"ground\"\nstd = 0.1\n"
    );
    for floor in 1..=STATIONS {
        text += &format!("[[node]]\nname = \"floor-{floor}\"\n");
        for channel in CHANNELS.map(str::to_lowercase) {
            text += &format!(
                "[[node.channel]]\nname = \"floor-{floor}-{channel}\"\n\
                 quantity = \"absolute-acceleration\"\ndof = \"floor-{floor}\"\nunit = \"m/s2\"\n\
                 noise-std = 0.005\nrange = 1e9\n"
            );
        }
    }
    text
}

/// Prints the processor time of a feed that receives 24 stations of 3 channels at 200 Hz in real
/// time.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "a measurement of a minute, for docs/performance.md"]
async fn load_of_many_stations() {
    let journal = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", journal.path()).await;
    let site = Site::with(&tall_house());
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let mut text = format!(
        "[[feed.source]]\nname = \"hub\"\nkind = \"seedlink\"\naddress = \"{}\"\n",
        server.address
    );
    for floor in 1..=STATIONS {
        for channel in CHANNELS {
            text += &format!(
                "[[feed.source.channel]]\nsource = \"AM.R{floor}.00.{channel}\"\n\
                 channel = \"floor-{floor}-{}\"\nsensitivity = 100\n",
                channel.to_lowercase()
            );
        }
    }
    let path = site.folder().join("feed.toml");
    std::fs::write(&path, text).unwrap();
    let feed = start_feed(&site, &path);
    feed.wait_for_log("state=\"connected\"");
    let statuses = bus.subscribe::<Status>(site.keys().statuses(Service::Feed), 256);
    let statuses = statuses.await.unwrap();
    let step_ns = SECOND_NS / FAST_HZ;
    let t0_ns = Clock::of_machine().now_ns() / step_ns * step_ns;
    let mut due = tokio::time::interval(Duration::from_nanos((RECORD * step_ns) as u64));
    let records = MEASURED_S * FAST_HZ / RECORD;
    let before_s = feed.processor_s();
    let begun = tokio::time::Instant::now();
    for number in 0..records {
        due.tick().await; // a record is complete
        for floor in 1..=STATIONS {
            let station = format!("R{floor}");
            for channel in CHANNELS {
                let start_ns = t0_ns + (number - 1) * RECORD * step_ns;
                let record = record_of((&station, channel), FAST_HZ as i16, start_ns, |sample| {
                    ((number * RECORD + sample) as f64)
                        .sin()
                        .mul_add(1e5, floor as f64) as i32
                });
                server.store.push("AM", &station, &record).unwrap();
            }
        }
    }
    let samples = records * RECORD * (STATIONS * CHANNELS.len()) as i64;
    within("all samples", async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.instruments["hub"].samples >= samples.unsigned_abs() {
                assert_eq!(status.instruments["hub"].errors, 0);
                return;
            }
        }
    })
    .await;
    let (used_s, wall_s) = (feed.processor_s() - before_s, begun.elapsed().as_secs_f64());
    println!(
        "{STATIONS} stations of {} channels at {FAST_HZ} Hz: {samples} samples in {wall_s:.1} s, \
         {used_s:.2} s of processor time, {:.1} % of a core",
        CHANNELS.len(),
        100.0 * used_s / wall_s
    );
    feed.stop().expect_code(0);
    server.stop().await;
}
