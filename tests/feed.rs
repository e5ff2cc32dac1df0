//! Instruments that the feed connects: the samples in the frames of ingest equal those that the
//! instrument sent, or the feed reports the difference to the sample.
//!
//! Each test contains a stand-in for an instrument, which speaks its real protocol.

use crate::support::{HOUSE, Process, Site, skip, spandrel, within};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use spandrel_bus::{
    Bus, Delivery, Event, EventKind, FrameBlock, InstrumentState, Service, Start, Status,
    Subscription, TimeGrid,
};
use spandrel_service::Clock;
use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io::Write;
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

const STEP_NS: i64 = 10_000_000;
const SECOND_NS: i64 = 1_000_000_000;
/// Samples of a packet.
const PACKET: i64 = 25;
/// Number of random moments at which a feed is killed.
const ROUNDS: usize = 10;

/// Returns a time `seconds` ago, in whole steps.
pub(crate) fn ago(seconds: i64) -> i64 {
    (Clock::of_machine().now_ns() - seconds * SECOND_NS) / STEP_NS * STEP_NS
}

/// Returns the counts of sample `number` of the two channels.
fn counts(number: i64) -> [i64; 2] {
    [3 * number + 1, -7 * number]
}

/// Returns the datacast packet that starts at sample `number`.
fn datacast(label: &str, channel: usize, t0_ns: i64, number: i64) -> String {
    let start_ns = t0_ns + number * STEP_NS;
    let (whole, milli) = (start_ns / SECOND_NS, start_ns % SECOND_NS / 1_000_000);
    let samples: Vec<String> = (number..number + PACKET)
        .map(|number| counts(number)[channel].to_string())
        .collect();
    format!("{{'{label}', {whole}.{milli:03}, {}}}", samples.join(", "))
}

/// A Raspberry Shake that sends its datacast to one address.
struct Shake {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicI64>,
    thread: Option<JoinHandle<()>>,
}

impl Shake {
    /// Sends a packet of each channel every `pause`.
    fn start(to: String, t0_ns: i64, pause: Duration) -> Self {
        let (stop, sent) = (
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicI64::new(0)),
        );
        let (stopping, sending) = (stop.clone(), sent.clone());
        let thread = std::thread::spawn(move || {
            let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
            let mut number = 0;
            while !stopping.load(Ordering::Relaxed) {
                for (channel, label) in ["ENZ", "ENE"].into_iter().enumerate() {
                    let packet = datacast(label, channel, t0_ns, number);
                    // Nobody may listen at the moment.
                    let _ = socket.send_to(packet.as_bytes(), &to);
                }
                number += PACKET;
                sending.store(number, Ordering::Relaxed);
                std::thread::sleep(pause);
            }
        });
        Self {
            stop,
            sent,
            thread: Some(thread),
        }
    }
}

impl Instrument for Shake {
    fn sent(&self) -> i64 {
        self.sent.load(Ordering::Relaxed)
    }

    fn stop(mut self) -> i64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        self.sent()
    }
}

/// The frames of ingest, in order.
pub(crate) struct Frames {
    stream: spandrel_bus::Stream<FrameBlock>,
    /// Values by the number of the sample since `t0_ns`.
    found: BTreeMap<i64, Vec<f64>>,
    t0_ns: i64,
}

impl Frames {
    pub(crate) async fn follow(bus: &Bus, site: &Site, t0_ns: i64) -> Self {
        let keys = site.keys();
        let settings = bus.reading(Start::Beginning).patient();
        Self {
            stream: bus
                .follow(keys.frames(), keys.recording(), settings)
                .await
                .unwrap(),
            found: BTreeMap::new(),
            t0_ns,
        }
    }

    /// Reads until sample `number` has arrived.
    pub(crate) async fn up_to(&mut self, number: i64) {
        let what = format!("frame with sample {number}");
        within(&what, async {
            while self
                .found
                .last_key_value()
                .is_none_or(|(last, _)| *last < number)
            {
                self.read().await;
            }
        })
        .await;
    }

    async fn read(&mut self) {
        let Delivery::Block(block) = self.stream.deliveries().recv_async().await.unwrap() else {
            panic!("ingest has lost frames");
        };
        let grid = TimeGrid::new(block.t0_ns, block.sampling_rate_hz).unwrap();
        for (frame, values) in (block.header.sequence..).zip(block.values.chunks(2)) {
            let number = (grid.time_ns(frame) - self.t0_ns).div_euclid(STEP_NS);
            self.found.insert(number, values.to_vec());
        }
    }

    /// Checks all values against what the instrument sent, and returns the number of missing
    /// samples per channel.
    pub(crate) fn missing(&self) -> [u64; 2] {
        let mut missing = [0; 2];
        for (number, values) in &self.found {
            for (channel, value) in values.iter().enumerate() {
                let sent = counts(*number)[channel] as f64 / 100.0;
                match value.is_nan() {
                    true => missing[channel] += 1,
                    false => assert_eq!(*value, sent, "sample {number} of channel {channel}"),
                }
            }
        }
        missing
    }
}

/// Returns the channels of a source, with 100 counts per m/s².
pub(crate) fn channels(labels: [&str; 2]) -> String {
    let channel = |label: &str, channel: &str| {
        format!(
            "[[feed.source.channel]]\nsource = \"{label}\"\nchannel = \"{channel}\"\n\
             sensitivity = 100\n"
        )
    };
    channel(labels[0], "ground") + &channel(labels[1], "roof")
}

/// Writes a configuration and returns its path.
pub(crate) fn configure(site: &Site, text: &str) -> PathBuf {
    let path = site.folder().join("feed.toml");
    std::fs::write(&path, text).unwrap();
    path
}

/// Starts the feed of a configuration, and waits until it is ready.
pub(crate) fn start_feed(site: &Site, configuration: &PathBuf) -> Process {
    let mut command = site.connecting("feed");
    let feed = Process::start(command.arg("--config").arg(configuration));
    feed.wait_for_log("feed ready");
    feed
}

pub(crate) fn start_ingest(site: &Site) -> Process {
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    ingest
}

/// Returns a UDP address that is free.
fn free_udp() -> String {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.local_addr().unwrap().to_string()
}

fn of_shake(address: &str) -> String {
    format!(
        "[[feed.source]]\nname = \"shake\"\nkind = \"udp\"\naddress = \"{address}\"\n\
         format = \"raspberry-shake\"\n"
    ) + &channels(["ENZ", "ENE"])
}

/// Adds up the reported gaps per channel, until they reach `expected`.
async fn reported(events: &Subscription<Event>, expected: [u64; 2]) -> [u64; 2] {
    let mut reported = [0; 2];
    let all = async {
        while reported != expected {
            let (_, event) = events.messages().recv_async().await.unwrap();
            if event.kind != EventKind::Gap {
                continue;
            }
            // `25 samples of channel ground lost up to …`
            let words: Vec<&str> = event.what.split(' ').collect();
            let channel = usize::from(words[4] == "roof");
            reported[channel] += words[0].parse::<u64>().unwrap();
        }
    };
    let _ = tokio::time::timeout(Duration::from_secs(15), all).await;
    reported
}

/// An instrument that sends samples until it is stopped.
pub(crate) trait Instrument {
    /// Returns the number of samples per channel so far.
    fn sent(&self) -> i64;
    /// Stops, and returns the number of samples per channel.
    fn stop(self) -> i64;
}

/// Kills the feed of an instrument at random moments, and checks that the reported gaps are the
/// missing samples. Returns the last feed.
pub(crate) async fn survive_kills(
    seed: u64,
    instrument: impl Instrument,
    start: impl Fn() -> Process,
    mut frames: Frames,
    events: &Subscription<Event>,
) -> Process {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..ROUNDS {
        let feed = start();
        let more = random.random_range(200..2500);
        frames.up_to(instrument.sent() + more).await;
        feed.kill();
    }
    let feed = start();
    frames.up_to(instrument.sent() + 500).await;
    let sent = instrument.stop();
    frames.up_to(sent - 1).await;
    let missing = frames.missing();
    assert!(
        missing[0] > 0,
        "no samples were sent while the feed was stopped"
    );
    assert_eq!(reported(events, missing).await, missing);
    feed
}

/// Waits for a status of the feed in which a source fulfils a condition.
async fn status_where(
    statuses: &Subscription<Status>,
    what: &str,
    is_met: impl Fn(&spandrel_bus::InstrumentStatus) -> bool,
) -> Status {
    within(what, async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.instruments.values().any(&is_met) {
                return status;
            }
        }
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn datacast_arrives_in_the_frames_as_it_was_sent() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let (address, t0_ns) = (free_udp(), ago(600));
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let feed = start_feed(&site, &configure(&site, &of_shake(&address)));
    feed.wait_for_log("state=\"connected\"");
    let shake = Shake::start(address, t0_ns, Duration::from_millis(10));
    frames.up_to(2000).await;
    let sent = shake.stop();
    frames.up_to(sent - 1).await;
    assert_eq!(frames.missing(), [0, 0]);
    assert_eq!(frames.found.len() as i64, sent);
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn gaps_of_a_feed_that_is_killed_at_random_moments_are_reported_to_the_sample() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let events = bus
        .subscribe::<Event>(site.keys().event(), 256)
        .await
        .unwrap();
    let (address, t0_ns) = (free_udp(), ago(3600));
    let frames = Frames::follow(&bus, &site, t0_ns).await;
    let configuration = configure(&site, &of_shake(&address));
    let shake = Shake::start(address, t0_ns, Duration::from_millis(10));
    let feed = survive_kills(
        20_061,
        shake,
        || start_feed(&site, &configuration),
        frames,
        &events,
    )
    .await;
    feed.stop().expect_code(0);
}

/// A logger that sends lines `t;a;b` to whoever reads, and goes on without a reader.
pub(crate) struct Logger<W> {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicI64>,
    /// The reader. A write error removes it.
    reader: Arc<Mutex<Option<W>>>,
    thread: Option<JoinHandle<()>>,
}

impl<W: Write + Send + 'static> Logger<W> {
    /// Sends 25 lines every 10 ms. `accept` returns the next reader if there is one, and receives
    /// whether there is a reader already.
    pub(crate) fn start(
        t0_ns: i64,
        mut accept: impl FnMut(bool) -> Option<W> + Send + 'static,
    ) -> Self {
        let (stop, sent, reader) = (
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicI64::new(0)),
            Arc::new(Mutex::new(None)),
        );
        let (stopping, sending, to) = (stop.clone(), sent.clone(), reader.clone());
        let thread = std::thread::spawn(move || {
            let mut number = 0;
            while !stopping.load(Ordering::Relaxed) {
                let lines: String = (number..number + PACKET)
                    .map(|number| line(t0_ns, number))
                    .collect();
                let mut to: std::sync::MutexGuard<'_, Option<W>> = to.lock().unwrap();
                if let Some(next) = accept(to.is_some()) {
                    *to = Some(next);
                }
                if let Some(reader) = &mut *to
                    && reader.write_all(lines.as_bytes()).is_err()
                {
                    *to = None;
                }
                drop(to);
                number += PACKET;
                sending.store(number, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(10));
            }
        });
        Self {
            stop,
            sent,
            reader,
            thread: Some(thread),
        }
    }
}

impl<W> Instrument for Logger<W> {
    fn sent(&self) -> i64 {
        self.sent.load(Ordering::Relaxed)
    }

    /// Stops, closes the connection, and returns the number of samples.
    fn stop(mut self) -> i64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        *self.reader.lock().unwrap() = None;
        self.sent()
    }
}

/// Returns the line with sample `number` of both channels.
fn line(t0_ns: i64, number: i64) -> String {
    let [a, b] = counts(number);
    format!("{};{a};{b}\n", t0_ns + number * STEP_NS)
}

/// Returns a source of these lines.
pub(crate) fn of_lines(kind: &str) -> String {
    format!(
        "[[feed.source]]\nname = \"logger\"\n{kind}\nformat = \"csv\"\nseparator = \";\"\n\
         columns = [\"t\", \"a\", \"b\"]\ntime-field = \"t\"\ntime-unit = \"ns\"\n"
    ) + &channels(["a", "b"])
}

#[tokio::test(flavor = "multi_thread")]
async fn gaps_of_lines_over_tcp_are_reported_to_the_sample_when_the_feed_is_killed() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let events = bus
        .subscribe::<Event>(site.keys().event(), 256)
        .await
        .unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    listener.set_nonblocking(true).unwrap();
    let t0_ns = ago(3600);
    let frames = Frames::follow(&bus, &site, t0_ns).await;
    let source = of_lines(&format!("kind = \"tcp\"\naddress = \"{address}\""));
    let configuration = configure(&site, &source);
    let logger = Logger::start(t0_ns, move |_| {
        let (stream, _) = listener.accept().ok()?;
        stream.set_nonblocking(false).unwrap();
        Some(stream)
    });
    let feed = survive_kills(
        20_064,
        logger,
        || start_feed(&site, &configuration),
        frames,
        &events,
    )
    .await;
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn gaps_of_lines_from_a_tcp_client_are_reported_to_the_sample_when_the_feed_is_killed() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let events = bus
        .subscribe::<Event>(site.keys().event(), 256)
        .await
        .unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener); // the feed listens there
    let t0_ns = ago(3600);
    let frames = Frames::follow(&bus, &site, t0_ns).await;
    let source = of_lines(&format!("kind = \"tcp-server\"\naddress = \"{address}\""));
    let configuration = configure(&site, &source);
    let logger = Logger::start(t0_ns, move |is_connected| match is_connected {
        true => None,
        false => TcpStream::connect(address).ok(),
    });
    let feed = survive_kills(
        20_067,
        logger,
        || start_feed(&site, &configuration),
        frames,
        &events,
    )
    .await;
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn gaps_of_standard_input_are_reported_to_the_sample_when_the_feed_is_killed() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let events = bus
        .subscribe::<Event>(site.keys().event(), 256)
        .await
        .unwrap();
    let t0_ns = ago(3600);
    let frames = Frames::follow(&bus, &site, t0_ns).await;
    let configuration = configure(&site, &of_lines("kind = \"stdin\""));
    let (pipes, next) = std::sync::mpsc::channel();
    let logger = Logger::start(t0_ns, move |_| next.try_recv().ok());
    let start = || {
        let mut command = site.connecting("feed");
        let (feed, pipe) = Process::start_with_pipe(command.arg("--config").arg(&configuration));
        feed.wait_for_log("feed ready");
        pipes.send(pipe).unwrap();
        feed
    };
    let feed = survive_kills(20_065, logger, start, frames, &events).await;
    feed.wait().expect_code(0); // its input has ended
}

/// Stands in for a board at a serial port: prints the name of a pseudo-terminal, and writes its own
/// input to that terminal.
const BOARD: &str = "import os, pty\n\
    port, terminal = pty.openpty()\n\
    print(os.ttyname(terminal), flush=True)\n\
    while text := os.read(0, 4096): os.write(port, text)\n";

#[tokio::test(flavor = "multi_thread")]
async fn lines_of_a_serial_port_arrive_with_the_commands_of_the_page() {
    let has_python = std::process::Command::new("python3").arg("-V").output();
    if !has_python.is_ok_and(|output| output.status.success()) {
        return skip("python3 is not installed");
    }
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let t0_ns = ago(600);
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let configuration = configure(&site, &of_lines("kind = \"stdin\""));
    let mut board = std::process::Command::new("python3");
    let (board, mut lines) = Process::start_with_pipe(board.args(["-c", BOARD]));
    board.wait_for_output("the name of the port", |said| said.ends_with('\n'));

    let page = include_str!("../docs/instruments.md");
    let (_, section) = page.split_once("## A serial port").unwrap();
    let (_, script) = section.split_once("```sh\n").unwrap();
    let (script, _) = script.split_once("```").unwrap();
    let script = script
        .replace("/dev/ttyUSB0", board.output().trim())
        .replace("spandrel feed --config serial.toml", "exec \"$0\" \"$@\"");
    assert!(
        script.contains("stty") && script.contains("exec"),
        "{script}"
    );
    let feed = site.connecting("feed");
    let mut shell = std::process::Command::new("sh");
    shell.args(["-ec", &script]).arg(feed.get_program());
    shell
        .args(feed.get_args())
        .arg("--config")
        .arg(configuration);
    let feed = Process::start(&mut shell);
    feed.wait_for_log("feed ready");

    let text: String = (0..1000).map(|number| line(t0_ns, number)).collect();
    lines.write_all(text.as_bytes()).unwrap();
    frames.up_to(999).await;
    assert_eq!(frames.missing(), [0, 0]);
    // The board is unplugged.
    drop(lines);
    feed.wait().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn lines_over_tcp_go_on_after_a_broken_connection() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let statuses = bus
        .subscribe::<Status>(site.keys().statuses(Service::Feed), 256)
        .await
        .unwrap();
    let t0_ns = ago(600);
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let logger = TcpListener::bind("127.0.0.1:0").unwrap();
    let text = format!(
        "[[feed.source]]\nname = \"logger\"\nkind = \"tcp\"\naddress = \"{}\"\nformat = \"csv\"\n\
         separator = \";\"\ncolumns = [\"t\", \"a\", \"b\"]\ntime-field = \"t\"\n\
         time-unit = \"ns\"\n",
        logger.local_addr().unwrap()
    ) + &channels(["a", "b"]);
    let feed = start_feed(&site, &configure(&site, &text));
    let line = |number: i64| {
        let [a, b] = counts(number);
        format!("{};{a};{b}\n", t0_ns + number * STEP_NS)
    };
    let (mut stream, _) = logger.accept().unwrap();
    let first: String = (0..500).map(line).collect();
    stream.write_all(first.as_bytes()).unwrap();
    frames.up_to(499).await;
    stream.write_all(b"500;7\nnoise\n").unwrap();
    drop(stream);
    let (mut stream, _) = logger.accept().unwrap();
    let rest: String = (500..1000).map(line).collect();
    stream.write_all(rest.as_bytes()).unwrap();
    frames.up_to(999).await;
    assert_eq!(frames.missing(), [0, 0]);
    let status = status_where(&statuses, "a status with all errors", |logger| {
        logger.state == InstrumentState::Receiving && logger.errors == 3
    })
    .await;
    assert_eq!(status.instruments["logger"].samples, 2000);
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn end_of_standard_input_ends_the_feed_after_its_last_sample() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let t0_ns = ago(600);
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let text = "[[feed.source]]\nname = \"pipe\"\nkind = \"stdin\"\nformat = \"json\"\n\
                time-field = \"t\"\ntime-unit = \"ms\"\n"
        .to_owned()
        + &channels(["x", "y"]);
    let lines: String = (0..400)
        .step_by(10)
        .map(|first| {
            let list = |channel: usize| -> Vec<i64> {
                (first..first + 10)
                    .map(|number| counts(number)[channel])
                    .collect()
            };
            let t_ms = (t0_ns + first * STEP_NS) / 1_000_000;
            format!(
                "{{\"t\": {t_ms}, \"x\": {:?}, \"y\": {:?}}}\n",
                list(0),
                list(1)
            )
        })
        .collect();
    let input = site.folder().join("lines.json");
    std::fs::write(&input, lines).unwrap();
    let mut command = site.connecting("feed");
    command.arg("--config").arg(configure(&site, &text));
    command.stdin(std::fs::File::open(input).unwrap());
    let ended = command.output().unwrap();
    assert!(
        ended.status.success(),
        "{}",
        String::from_utf8_lossy(&ended.stderr)
    );
    frames.up_to(399).await;
    assert_eq!(frames.missing(), [0, 0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn source_that_cannot_be_reached_is_failed_and_others_are_not_disturbed() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let statuses = bus
        .subscribe::<Status>(site.keys().statuses(Service::Feed), 256)
        .await
        .unwrap();
    let nobody = free_udp(); // a TCP port on which nobody listens
    let address = free_udp();
    let one = |name: &str, kind: &str, address: &str, label: &str, channel: &str| {
        format!(
            "[[feed.source]]\nname = \"{name}\"\nkind = \"{kind}\"\naddress = \"{address}\"\n\
             format = \"raspberry-shake\"\nwait-s = 0\n[[feed.source.channel]]\n\
             source = \"{label}\"\nchannel = \"{channel}\"\nsensitivity = 100\n"
        )
    };
    let text = one("dead", "tcp", &nobody, "ENE", "roof")
        + &one("alive", "udp", &address, "ENZ", "ground");
    let feed = start_feed(&site, &configure(&site, &text));
    let shake = Shake::start(address, ago(600), Duration::from_millis(10));
    let status = status_where(&statuses, "both states", |source| {
        source.state == InstrumentState::Receiving
    })
    .await;
    let (dead, alive) = (&status.instruments["dead"], &status.instruments["alive"]);
    assert_eq!(dead.state, InstrumentState::Failed);
    let error = dead.last_error.as_deref().unwrap();
    assert!(
        error.starts_with(&format!("cannot connect to {nobody}")),
        "{error}"
    );
    assert_eq!((alive.errors, dead.samples), (0, 0));
    shake.stop();
    feed.stop().expect_code(0);
}

/// Appends rows of a table `t,note,a,b` to a file.
fn append(path: &Path, t0_ns: i64, rows: std::ops::Range<i64>) {
    let mut file = OpenOptions::new()
        .create(true)
        .append(true)
        .open(path)
        .unwrap();
    let mut text = String::new();
    if file.metadata().unwrap().len() == 0 {
        text += "t,note,a,b\n";
    }
    for number in rows {
        let [a, b] = counts(number);
        text += &format!("{},calm,{a},{b}\n", t0_ns + number * STEP_NS);
    }
    file.write_all(text.as_bytes()).unwrap();
}

/// Returns the source of a table, with the time in nanoseconds.
fn of_file(name: &str, from: &str) -> String {
    format!(
        "[[feed.source]]\nname = \"log\"\nkind = \"file\"\npath = \"{name}\"\nfrom = \"{from}\"\n\
         format = \"csv\"\ntime-field = \"t\"\ntime-unit = \"ns\"\n"
    ) + &channels(["a", "b"])
}

#[tokio::test(flavor = "multi_thread")]
async fn growing_file_loses_nothing_when_it_is_renamed_and_the_feed_is_killed() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let t0_ns = ago(3600);
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let (log, old) = (
        site.folder().join("log.csv"),
        site.folder().join("log.csv.1"),
    );
    append(&log, t0_ns, 0..300);
    let configuration = configure(&site, &of_file("log.csv", "start"));
    let feed = start_feed(&site, &configuration);
    frames.up_to(299).await;
    append(&log, t0_ns, 300..400);
    std::fs::rename(&log, &old).unwrap();
    append(&old, t0_ns, 400..500); // the writer still has its handle
    append(&log, t0_ns, 500..600);
    frames.up_to(599).await;
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let mut next = 600;
    let mut feed = Some(feed);
    for round in 0..ROUNDS {
        let rows = random.random_range(1000..5000);
        append(&log, t0_ns, next..next + rows);
        frames.up_to(next + random.random_range(0..rows)).await;
        feed.take().unwrap().kill();
        next += rows;
        if round % 3 == 2 {
            // Rotated while the feed does not run.
            append(&log, t0_ns, next..next + 50);
            std::fs::rename(&log, &old).unwrap();
            next += 50;
        }
        append(&log, t0_ns, next..next + 50);
        next += 50;
        feed = Some(start_feed(&site, &configuration));
    }
    frames.up_to(next - 1).await;
    assert_eq!(frames.missing(), [0, 0]);
    assert_eq!(frames.found.len() as i64, next);
    feed.take().unwrap().stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn dated_files_are_read_one_after_the_other() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let t0_ns = ago(3600);
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let day = |day: &str| site.folder().join(format!("log-2026-11-{day}.csv"));
    append(&day("08"), t0_ns, 0..100);
    append(&day("09"), t0_ns, 100..200);
    let feed = start_feed(&site, &configure(&site, &of_file("log-*.csv", "start")));
    frames.up_to(199).await;
    append(&day("09"), t0_ns, 200..300);
    append(&day("10"), t0_ns, 300..400);
    frames.up_to(399).await;
    assert_eq!(frames.missing(), [0, 0]);
    assert_eq!(frames.found.len(), 400);
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn file_without_a_mapped_column_is_failed_and_named() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let statuses = bus
        .subscribe::<Status>(site.keys().statuses(Service::Feed), 256)
        .await
        .unwrap();
    std::fs::write(site.folder().join("log.csv"), "t,a,c\n1,2,3\n").unwrap();
    let feed = start_feed(&site, &configure(&site, &of_file("log.csv", "start")));
    let status = status_where(&statuses, "a failed file", |log| {
        log.state == InstrumentState::Failed
    })
    .await;
    let error = status.instruments["log"].last_error.clone().unwrap();
    assert!(
        error.ends_with("has no column b, its columns are t, a, c"),
        "{error}"
    );
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn files_dropped_into_a_folder_are_read_once_in_the_order_of_their_times() {
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let t0_ns = ago(3600);
    let mut frames = Frames::follow(&bus, &site, t0_ns).await;
    let inbox = site.folder().join("inbox");
    std::fs::create_dir(&inbox).unwrap();
    let drop_file = |name: &str, rows: std::ops::Range<i64>| {
        let mut text = "time,a,b\n".to_owned();
        for number in rows {
            let ([a, b], t_ns) = (counts(number), t0_ns + number * STEP_NS);
            let (whole, hundredth) = (t_ns / SECOND_NS, t_ns % SECOND_NS / 10_000_000);
            text += &format!("{whole}.{hundredth:02},{a},{b}\n");
        }
        std::fs::write(inbox.join(name), text).unwrap();
    };
    // The names are not in the order of the times.
    drop_file("b.csv", 0..6000);
    drop_file("a.csv", 6000..12_000);
    std::fs::write(inbox.join("notes.bin"), [0, 1, 2]).unwrap();
    let text = format!(
        "[[feed.source]]\nname = \"inbox\"\nkind = \"folder\"\npath = \"{}\"\n",
        inbox.display()
    ) + &channels(["a", "b"]);
    let configuration = configure(&site, &text);
    let feed = start_feed(&site, &configuration);
    feed.wait_for_log("notes.bin");
    feed.kill();
    let mut random = ChaCha8Rng::seed_from_u64(20_066);
    let mut reached = 0;
    for _ in 0..ROUNDS {
        let feed = start_feed(&site, &configuration);
        reached += random.random_range(100..1200);
        frames.up_to(reached).await;
        feed.kill();
    }
    let feed = start_feed(&site, &configuration);
    frames.up_to(11_999).await;
    feed.stop().expect_code(0);
    drop_file("c.csv", 12_000..12_500);
    let feed = start_feed(&site, &configuration);
    frames.up_to(12_499).await;
    assert_eq!(frames.missing(), [0, 0]);
    assert_eq!(frames.found.len(), 12_500);
    feed.stop().expect_code(0);
}

/// Regression: one task served all structures, and waited for the ingest of each.
#[tokio::test(flavor = "multi_thread")]
async fn a_structure_without_ingest_does_not_delay_another_of_the_same_feed() {
    let house = Site::with(HOUSE);
    let shed = HOUSE.replace("name = \"house\"", "name = \"shed\"");
    let shed = Site::with(&shed).at(&house);
    let _ingest = start_ingest(&house);
    let bus = house.join().await;
    let t0_ns = ago(3600);
    let of = |site: &Site, number: usize| {
        append(&site.folder().join("log.csv"), t0_ns, 0..2000);
        let structure = site.keys().structure().to_string();
        let path = site.folder().join("log.csv");
        of_file(path.to_str().unwrap(), "start")
            .replace("\"log\"", &format!("\"log-{number}\""))
            .replace(
                "channel = ",
                &format!("structure = \"{structure}\"\nchannel = "),
            )
    };
    let configuration = configure(&house, &(of(&shed, 1) + &of(&house, 2)));
    let mut command = house.connecting("feed");
    command.arg(shed.structure_file());
    let feed = Process::start(command.arg("--config").arg(configuration));
    let mut frames = Frames::follow(&bus, &house, t0_ns).await;
    frames.up_to(1999).await;
    assert_eq!((frames.missing(), frames.found.len()), ([0, 0], 2000));

    // The samples of the other structure have waited in their file.
    let late = Process::start(&mut shed.connecting("ingest"));
    late.wait_for_log("ready structures=1");
    let mut frames = Frames::follow(&bus, &shed, t0_ns).await;
    frames.up_to(1999).await;
    assert_eq!((frames.missing(), frames.found.len()), ([0, 0], 2000));
    feed.stop().expect_code(0);
}

#[test]
fn check_names_what_arrives_and_what_is_missing() {
    let site = Site::with(HOUSE);
    let address = free_udp();
    let text = of_shake(&address).replace("\"ENE\"", "\"ENN\"");
    let shake = Shake::start(address, ago(600), Duration::from_millis(20));
    let mut command = spandrel("feed");
    command.arg(site.structure_file()).arg("--config");
    command.arg(configure(&site, &text));
    let finished = Process::start(command.args(["--check", "--duration", "3"])).wait();
    shake.stop();
    let finished = finished.expect_code(1);
    let lines: Vec<&str> = finished.stdout.lines().collect();
    let found = finished.stdout.as_str();
    assert!(lines[0].starts_with("shake (udp 127.0.0.1:"), "{found}");
    assert!(lines[0].contains("): receiving, "), "{found}");
    assert!(
        lines[1].starts_with("  ENZ -> house/shake/ground: "),
        "{found}"
    );
    assert!(
        lines[1].contains(" samples, 100.000 Hz (nominal 100 Hz), latency "),
        "{found}"
    );
    assert!(lines[1].ends_with(" m/s2"), "{found}");
    assert_eq!(lines[2], "  ENN -> house/shake/roof: no samples");
    assert!(lines[3].starts_with("  ENE: "), "{found}");
    assert!(
        lines[3].ends_with(" samples, not mapped to a channel"),
        "{found}"
    );
    assert!(finished.stderr.contains("no samples from 1 of 2 channels"));
}

#[test]
fn mistakes_of_the_configuration_end_the_program_before_it_starts() {
    let site = Site::with(HOUSE);
    let text = of_shake("8888").replace("\"roof\"", "\"attic\"");
    let path = configure(&site, &text);
    let mut command = spandrel("feed");
    command
        .arg(site.structure_file())
        .arg("--config")
        .arg(&path);
    let finished = Process::start(&mut command).wait().expect_code(2);
    let file = path.display();
    for expected in [
        format!("{file}: feed.source[0].address: is \"8888\", must be HOST:PORT"),
        format!(
            "{file}: feed.source[0].channel[1].channel: is \"attic\", must be one of ground, roof"
        ),
    ] {
        assert!(finished.stderr.contains(&expected), "{}", finished.stderr);
    }
}
