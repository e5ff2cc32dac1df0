//! Instruments that publish to an MQTT broker. The broker is Mosquitto.

use crate::feed::{self, Frames, Logger, ago, channels, start_feed, start_ingest, survive_kills};
use crate::support::{DEADLINE, HOUSE, Process, Site, skip, within};
use spandrel_bus::{
    Bus, ConditionDisplay, Delivery, Event, FrameBlock, InstrumentState, Service, Start, Status,
    Stream, TimeGrid,
};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

const STEP_NS: i64 = 10_000_000;

/// Returns the counts of sample `number` of the two channels.
fn counts(number: i64) -> [i64; 2] {
    [2 * number, 9 - number]
}

/// A running broker, which is killed when it is dropped.
struct Broker {
    child: Child,
    address: String,
}

impl Broker {
    /// Starts a broker without a login, or with the login that only `file` knows. Returns `None` if
    /// Mosquitto is not installed.
    fn start(folder: &Path, access: &str) -> Option<Self> {
        let port = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap()
            .port();
        let path = folder.join("mosquitto.conf");
        std::fs::write(&path, format!("listener {port} 127.0.0.1\n{access}\n")).unwrap();
        let started = Command::new("mosquitto")
            .arg("-c")
            .arg(&path)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        let Ok(child) = started else {
            skip("mosquitto is not installed");
            return None;
        };
        let address = format!("127.0.0.1:{port}");
        let begun = tokio::time::Instant::now();
        while TcpStream::connect(&address).is_err() {
            assert!(begun.elapsed() < DEADLINE, "mosquitto does not listen");
            std::thread::yield_now();
        }
        Some(Self { child, address })
    }

    /// Connects an instrument. Source: MQTT 3.1.1, sections 3.1 to 3.3.
    fn instrument(&self) -> Instrument {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        let id = b"logger";
        let mut body = b"\x00\x04MQTT\x04\x02\x00\x3c".to_vec(); // clean session, 60 s
        body.extend([0, id.len() as u8]);
        body.extend(id);
        send(&mut stream, 0x10, &body);
        let mut answer = [0; 4];
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(answer, [0x20, 2, 0, 0], "the broker accepts the instrument");
        Instrument(stream)
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

struct Instrument(TcpStream);

impl Instrument {
    /// Publishes a message with quality of service 0.
    fn publish(&mut self, topic: &str, payload: &[u8]) {
        let mut body = vec![0, topic.len() as u8];
        body.extend(topic.as_bytes());
        body.extend(payload);
        send(&mut self.0, 0x30, &body);
    }
}

/// Sends a packet: its type, the length in groups of seven bits, and the body.
fn send(stream: &mut TcpStream, kind: u8, body: &[u8]) {
    let mut packet = vec![kind];
    let mut length = body.len();
    loop {
        let group = (length % 128) as u8;
        length /= 128;
        packet.push(if length > 0 { group | 128 } else { group });
        if length == 0 {
            break;
        }
    }
    packet.extend(body);
    stream.write_all(&packet).unwrap();
}

fn configure(site: &Site, address: &str, more: &str) -> PathBuf {
    let text = format!(
        "[[feed.source]]\nname = \"broker\"\nkind = \"mqtt\"\naddress = \"{address}\"\n\
         topic = \"house/+/acc\"\n{more}\n"
    ) + &channels(["x", "y"]);
    feed::configure(site, &text)
}

async fn start(more: &str, address: &str) -> (Site, Process, Process, Bus) {
    let site = Site::with(HOUSE);
    let ingest = start_ingest(&site);
    let bus = site.join().await;
    let path = configure(&site, address, more);
    let feed = Process::start(site.connecting("feed").arg("--config").arg(path));
    (site, ingest, feed, bus)
}

/// Reads frames until there are `count`.
async fn frames(bus: &Bus, site: &Site, count: usize) -> BTreeMap<i64, Vec<f64>> {
    let (keys, settings) = (site.keys(), bus.reading(Start::Beginning).patient());
    let stream = bus
        .follow::<FrameBlock>(keys.frames(), keys.recording(), settings)
        .await;
    let (stream, mut found) = (stream.unwrap(), BTreeMap::new());
    let mut frames = 0;
    read_frames(&stream, &mut found, |_| {
        frames += 1;
        frames >= count
    })
    .await;
    found
}

/// Reads frames until one of them satisfies `is_last`, which receives its time (ns). The rest of
/// its block is read, too.
async fn read_frames(
    stream: &Stream<FrameBlock>,
    found: &mut BTreeMap<i64, Vec<f64>>,
    mut is_last: impl FnMut(i64) -> bool,
) {
    within("frames", async {
        let mut has_all = false;
        while !has_all {
            let Delivery::Block(block) = stream.deliveries().recv_async().await.unwrap() else {
                panic!("ingest has lost frames");
            };
            let grid = TimeGrid::new(block.t0_ns, block.sampling_rate_hz).unwrap();
            for (frame, values) in (block.header.sequence..).zip(block.values.chunks(2)) {
                let time_ns = grid.time_ns(frame);
                has_all |= is_last(time_ns);
                found.insert(time_ns, values.to_vec());
            }
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn json_messages_arrive_in_the_frames_as_they_were_published() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Broker::start(folder.path(), "allow_anonymous true") else {
        return;
    };
    let more = "format = \"json\"\ntime-field = \"t\"\ntime-unit = \"ns\"";
    let (site, _ingest, feed, bus) = start(more, &broker.address).await;
    feed.wait_for_log("state=\"connected\"");
    let (t0_ns, mut instrument) = (ago(60), broker.instrument());
    for first in (0..500).step_by(10) {
        let list = |channel: usize| -> Vec<i64> {
            (first..first + 10)
                .map(|number| counts(number)[channel])
                .collect()
        };
        let t_ns = t0_ns + first * STEP_NS;
        let message = format!(
            "{{\"t\": {t_ns}, \"x\": {:?}, \"y\": {:?}}}",
            list(0),
            list(1)
        );
        instrument.publish("house/a/acc", message.as_bytes());
        instrument.publish("house/a/temperature", b"20.5"); // another topic
    }
    let found = frames(&bus, &site, 500).await;
    for (time_ns, values) in found {
        let sent = counts((time_ns - t0_ns) / STEP_NS).map(|count| count as f64 / 100.0);
        assert_eq!(values, sent);
    }
    feed.stop().expect_code(0);
}

/// A message contains the lines of one write.
impl Write for Instrument {
    fn write(&mut self, lines: &[u8]) -> std::io::Result<usize> {
        self.publish("house/a/acc", lines);
        Ok(lines.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn gaps_of_messages_are_reported_to_the_sample_when_the_feed_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Broker::start(folder.path(), "allow_anonymous true") else {
        return;
    };
    let site = Site::with(HOUSE);
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let events = bus.subscribe::<Event>(site.keys().event(), 256);
    let events = events.await.unwrap();
    let t0_ns = ago(3600);
    let frames = Frames::follow(&bus, &site, t0_ns).await;
    let kind = format!(
        "kind = \"mqtt\"\naddress = \"{}\"\ntopic = \"house/+/acc\"",
        broker.address
    );
    let configuration = feed::configure(&site, &feed::of_lines(&kind));
    let mut instrument = Some(broker.instrument());
    let logger = Logger::start(t0_ns, move |_| instrument.take());
    let feed = survive_kills(
        20_068,
        logger,
        || start_feed(&site, &configuration),
        frames,
        &events,
    )
    .await;
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_temperature_beside_the_samples_is_a_condition() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Broker::start(folder.path(), "allow_anonymous true") else {
        return;
    };
    let air = "[[condition]]\nname = \"air\"\nunit = \"degC\"\n";
    let site = Site::with(&format!("{HOUSE}\n{air}"));
    let _ingest = start_ingest(&site);
    let bus = site.join().await;
    let values = bus.subscribe::<ConditionDisplay>(site.keys().all_conditions(), 64);
    let values = values.await.unwrap();
    let more = "format = \"json\"\ntime-field = \"t\"\ntime-unit = \"ns\"\n\
                [[feed.source.condition]]\nsource = \"air.celsius\"\ncondition = \"air\"";
    let path = configure(&site, &broker.address, more);
    let feed = Process::start(site.connecting("feed").arg("--config").arg(path));
    feed.wait_for_log("state=\"connected\"");
    let (t0_ns, mut instrument) = (ago(60), broker.instrument());
    for number in 0..100 {
        let [x, y] = counts(number);
        let air = match number % 50 {
            0 => format!(", \"air\": {{\"celsius\": {number}.5}}"),
            _ => String::new(),
        };
        let t_ns = t0_ns + number * STEP_NS;
        let message = format!("{{\"t\": {t_ns}, \"x\": {x}, \"y\": {y}{air}}}");
        instrument.publish("house/a/acc", message.as_bytes());
    }
    assert_eq!(frames(&bus, &site, 100).await.len(), 100);
    for number in [0, 50] {
        let received = within("a value", values.messages().recv_async()).await;
        let (_, value) = received.unwrap();
        assert_eq!(value.time_ns, t0_ns + number * STEP_NS);
        assert_eq!(value.value, number as f64 + 0.5);
    }
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn raw_arrays_arrive_in_their_order() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Broker::start(folder.path(), "allow_anonymous true") else {
        return;
    };
    let more = "format = \"raw\"\nnumber = \"i32\"\ncolumns = [\"x\", \"y\"]\njitter-s = 100";
    let (site, _ingest, feed, bus) = start(more, &broker.address).await;
    feed.wait_for_log("state=\"connected\"");
    let mut instrument = broker.instrument();
    for first in (0..500).step_by(50) {
        let payload: Vec<u8> = (first..first + 50)
            .flat_map(counts)
            .flat_map(|count| (count as i32).to_le_bytes())
            .collect();
        instrument.publish("house/a/acc", &payload);
    }
    let found = frames(&bus, &site, 500).await;
    for (number, values) in (0..).zip(found.values()) {
        assert_eq!(values[..], counts(number).map(|count| count as f64 / 100.0));
    }
    feed.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_login_is_a_failed_source_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Broker::start(folder.path(), "allow_anonymous false") else {
        return;
    };
    let more = "format = \"json\"\ntime-field = \"t\"";
    let (site, _ingest, feed, bus) = start(more, &broker.address).await;
    let statuses = bus
        .subscribe::<Status>(site.keys().statuses(Service::Feed), 256)
        .await
        .unwrap();
    let error = within("a failed source", async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            let broker = &status.instruments["broker"];
            if broker.state == InstrumentState::Failed {
                return broker.last_error.clone().unwrap();
            }
        }
    })
    .await;
    assert!(error.contains("NotAuthorized"), "{error}");
    feed.stop().expect_code(0);
}
