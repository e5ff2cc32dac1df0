//! Temperatures and other conditions: from the instrument to the history, the page and the metrics.

use crate::support::{DEADLINE, HOUSE, Process, Site, within};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use spandrel_bus::{
    Bus, ConditionDisplay, HistorySpan, InstrumentState, InstrumentStatus, Name, Service, Status,
    Subscription,
};
use spandrel_service::Clock;
use std::fs::OpenOptions;
use std::io::{Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::Duration;

const SECOND_NS: i64 = 1_000_000_000;
/// A temperature that is expected every hour.
const AIR: &str =
    "[[condition]]\nname = \"air\"\nunit = \"degC\"\nrange = [-40, 60]\ninterval-s = 3600\n";

fn house() -> Site {
    Site::with(&format!("{HOUSE}\n{AIR}"))
}

/// Writes a configuration with a history, and with a source that measures `air` as `t`.
fn configure(site: &Site, source: &str) -> PathBuf {
    let path = site.folder().join("spandrel.toml");
    let text = format!(
        "[history]\ndatabase = \"house.sqlite\"\n[[feed.source]]\nname = \"mast\"\n{source}\n\
         [[feed.source.condition]]\nsource = \"t\"\ncondition = \"air\"\nsensitivity = 100\n"
    );
    std::fs::write(&path, text).unwrap();
    path
}

fn with_configuration(mut command: std::process::Command, path: &Path) -> Process {
    Process::start(command.arg("--config").arg(path))
}

/// Starts the history alone.
fn start_history(site: &Site, configuration: &Path) -> Process {
    let history = with_configuration(site.listening("history"), configuration);
    history.wait_for_log("ready structures=1");
    history
}

fn start_feed(site: &Site, configuration: &Path) -> Process {
    let feed = with_configuration(site.connecting("feed"), configuration);
    feed.wait_for_log("feed ready");
    feed
}

/// Returns a UDP address that is free.
fn free_udp() -> String {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.local_addr().unwrap().to_string()
}

/// Returns the stored values of `air` in their order once `is_complete` accepts them.
async fn stored(bus: &Bus, site: &Site, is_complete: impl Fn(&HistorySpan) -> bool) -> HistorySpan {
    let key = site.keys().history(&Name::new("air").unwrap());
    let key = format!("{key}?kind=condition;points=20000");
    let mut last = None;
    let found = tokio::time::timeout(DEADLINE, async {
        loop {
            let answers = bus.ask::<HistorySpan>(&key, DEADLINE).await.unwrap();
            last = answers.into_iter().next().map(|(_, span)| span);
            if let Some(span) = last.as_ref().filter(|span| is_complete(span)) {
                return span.clone();
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    });
    match found.await {
        Ok(found) => found,
        Err(_elapsed) => panic!("the history is not complete: {last:?}"),
    }
}

/// Queries the feed until it has published a condition.
async fn latest(bus: &Bus, site: &Site) -> ConditionDisplay {
    loop {
        let key = site.keys().all_conditions();
        let found = bus.ask_present::<ConditionDisplay>(&key, DEADLINE).await;
        if let Some((_, message)) = found.unwrap().into_iter().next() {
            return message;
        }
    }
}

/// Waits for a status of the feed whose source fulfils a condition.
async fn status_where(
    statuses: &Subscription<Status>,
    what: &str,
    is_met: impl Fn(&InstrumentStatus) -> bool,
) -> InstrumentStatus {
    within(what, async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if let Some(mast) = status.instruments.get("mast").filter(|mast| is_met(mast)) {
                return mast.clone();
            }
        }
    })
    .await
}

/// Sends one request to the page, and returns the body of the reply.
fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    let head = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200"), "{path}: {answer}");
    body.to_owned()
}

fn json(address: &str, path: &str) -> Value {
    tokio::task::block_in_place(|| serde_json::from_str(&get(address, path)).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_temperature_in_a_datagram_reaches_history_page_metrics_and_view() {
    let site = house();
    let address = free_udp();
    let source = format!(
        "kind = \"udp\"\naddress = \"{address}\"\nformat = \"json\"\ntime-field = \"at\"\n\
         time-unit = \"ns\""
    );
    let configuration = configure(&site, &source);
    let mut command = site.listening("run");
    command.args(["--http", "127.0.0.1:0"]);
    let services = with_configuration(command, &configuration);
    services.wait_for_output("address of the page", |said| said.contains("page: http://"));
    services.wait_for_log("state=\"connected\"");
    let bus = site.join().await;
    let measured_ns = Clock::of_machine().now_ns() - 2 * SECOND_NS;
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let send = |later_ns: i64, hundredths: i64| {
        let line = format!(
            "{{\"at\": {}, \"t\": {hundredths}}}",
            measured_ns + later_ns
        );
        socket.send_to(line.as_bytes(), &address).unwrap();
    };
    send(0, 2150);
    let first = within("a condition", latest(&bus, &site)).await;
    let expected = ConditionDisplay {
        structure: site.keys().structure().clone(),
        name: Name::new("air").unwrap(),
        time_ns: measured_ns,
        value: 21.5,
        unit: "degC".to_owned(),
        interval_s: Some(3600.0),
        instrument: Some("mast".to_owned()),
    };
    assert_eq!(first, expected);
    send(SECOND_NS, -325);

    let both = stored(&bus, &site, |span| span.rows.mean.len() == 2).await;
    assert_eq!(both.rows.mean, [21.5, -3.25]);
    let said = services.output();
    let page = said.split("page: http://").nth(1).unwrap();
    let page = page.split('/').next().unwrap().to_owned();
    let shown = json(&page, "/api/structures/house");
    let air = &shown["standing"]["conditions"][0];
    assert_eq!(air["value"], -3.25, "{shown}");
    assert_eq!(air["unit"], "degC");
    assert_eq!(
        (&air["stale"], &air["implausible"]),
        (&false.into(), &false.into())
    );
    assert!(air["age_s"].as_f64().unwrap() < DEADLINE.as_secs_f64());
    let plot = json(&page, "/api/structures/house/history?series=condition/air");
    assert_eq!(
        plot["series"][0]["data"][1],
        serde_json::json!([21.5, -3.25])
    );
    let metrics = tokio::task::block_in_place(|| get(&page, "/metrics"));
    let gauge =
        "spandrel_condition_value{structure=\"house\",condition=\"air\",unit=\"degC\"} -3.25";
    assert!(metrics.lines().any(|line| line == gauge), "{metrics}");

    // A view that starts later asks the feed for the latest value.
    let watch = site.watch();
    watch.wait_for_output("the condition", |said| said.contains("air -3.25 degC"));
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}

/// Regression: the history waited for the next value, an hour later.
#[tokio::test(flavor = "multi_thread")]
async fn a_history_that_starts_after_the_feed_stores_the_standing_temperature() {
    let site = house();
    let address = free_udp();
    let source = format!(
        "kind = \"udp\"\naddress = \"{address}\"\nformat = \"json\"\ntime-field = \"at\"\n\
         time-unit = \"ns\""
    );
    let configuration = configure(&site, &source);
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let feed = start_feed(&site, &configuration);
    feed.wait_for_log("state=\"connected\"");
    let measured_ns = Clock::of_machine().now_ns() - 2 * SECOND_NS;
    let line = format!("{{\"at\": {measured_ns}, \"t\": 2150}}");
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.send_to(line.as_bytes(), &address).unwrap();
    let standing = within("a condition", latest(&bus, &site)).await;
    assert_eq!(standing.time_ns, measured_ns);

    let history = with_configuration(site.connecting("history"), &configuration);
    let one = stored(&bus, &site, |span| !span.rows.mean.is_empty()).await;
    assert_eq!(one.rows.mean, [21.5]);
    history.stop().expect_code(0);
    feed.stop().expect_code(0);
    bus.close().await.unwrap();
}

/// Appends values of the temperature to a table `at,note,t`.
fn append(path: &Path, t0_ns: i64, numbers: std::ops::Range<i64>) {
    let mut file = OpenOptions::new()
        .create(true)
        .append(true)
        .open(path)
        .unwrap();
    let mut text = String::new();
    if file.metadata().unwrap().len() == 0 {
        text += "at,note,t\n";
    }
    for number in numbers {
        text += &format!(
            "{},calm,{}\n",
            t0_ns + number * SECOND_NS,
            hundredths(number)
        );
    }
    file.write_all(text.as_bytes()).unwrap();
}

/// Returns the temperature number `number`, in hundredths of a degree.
fn hundredths(number: i64) -> i64 {
    number % 4000 - 1000
}

#[tokio::test(flavor = "multi_thread")]
async fn each_temperature_of_a_growing_file_is_kept_once_when_feed_and_history_are_killed() {
    let site = house();
    let source = "kind = \"file\"\npath = \"log.csv\"\nfrom = \"start\"\nformat = \"csv\"\n\
                  time-field = \"at\"\ntime-unit = \"ns\"";
    let configuration = configure(&site, source);
    let log = site.folder().join("log.csv");
    let t0_ns = Clock::of_machine().now_ns() - 100_000 * SECOND_NS;
    let mut history = start_history(&site, &configuration);
    let mut random = ChaCha8Rng::seed_from_u64(20_063);
    let mut next = 0;
    for round in 0..10 {
        let feed = start_feed(&site, &configuration);
        let rows = random.random_range(100..3000);
        append(&log, t0_ns, next..next + rows);
        let seen = next + random.random_range(0..rows);
        let bus = site.join().await;
        let reached = |span: &HistorySpan| {
            let last_s = span.rows.time_s.last().copied().unwrap_or_default();
            last_s * 1e9 >= (t0_ns + seen * SECOND_NS) as f64 - 1e6
        };
        stored(&bus, &site, reached).await;
        next += rows;
        feed.kill();
        if round % 3 == 2 {
            bus.close().await.unwrap();
            history.kill();
            history = start_history(&site, &configuration);
        }
        append(&log, t0_ns, next..next + 20);
        next += 20;
    }
    let feed = start_feed(&site, &configuration);
    let bus = site.join().await;
    let last_s = (t0_ns + (next - 1) * SECOND_NS) as f64 / 1e9;
    let whole = stored(&bus, &site, |span| {
        span.rows
            .time_s
            .last()
            .is_some_and(|found_s| (found_s - last_s).abs() < 1e-3)
    })
    .await;
    let count: u64 = whole.rows.count.iter().sum();
    assert_eq!(count, next.unsigned_abs());
    let found: f64 = whole
        .rows
        .mean
        .iter()
        .zip(&whole.rows.count)
        .map(|(mean, count)| mean * *count as f64)
        .sum();
    let sent: f64 = (0..next)
        .map(|number| hundredths(number) as f64 / 100.0)
        .sum();
    assert!(
        (found - sent).abs() < 1e-3,
        "the sum is {found}, must be {sent}"
    );
    feed.stop().expect_code(0);
    bus.close().await.unwrap();
    history.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_temperature_that_cannot_be_is_an_error_of_its_source_and_named() {
    let site = house();
    let address = free_udp();
    let source = format!(
        "kind = \"udp\"\naddress = \"{address}\"\nformat = \"csv\"\ncolumns = [\"t\", \"battery\"]"
    );
    let configuration = configure(&site, &source);
    let _history = start_history(&site, &configuration);
    let bus = site.join().await;
    let statuses = bus
        .subscribe::<Status>(site.keys().statuses(Service::Feed), 256)
        .await
        .unwrap();
    let feed = start_feed(&site, &configuration);
    feed.wait_for_log("state=\"connected\"");
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    for line in [
        "99900,3.1",
        "warm,3.1",
        "2150",
        "nan,3.1",
        ",3.1",
        "2150,3.1",
    ] {
        socket.send_to(line.as_bytes(), &address).unwrap();
    }
    let mast = status_where(&statuses, "all errors and a value", |mast| {
        mast.errors == 3 && mast.state == InstrumentState::Receiving
    })
    .await;
    assert_eq!(mast.samples, 1);
    feed.wait_for_log("t: air is 999 degC, must lie between -40 and 60 degC");
    let one = stored(&bus, &site, |span| !span.rows.mean.is_empty()).await;
    assert_eq!(one.rows.mean, [21.5]);
    feed.stop().expect_code(0);
    bus.close().await.unwrap();
}

#[test]
fn a_check_shows_the_last_temperature_of_a_source() {
    let site = house();
    let log = site.folder().join("log.csv");
    append(&log, Clock::of_machine().now_ns() - 10 * SECOND_NS, 0..5);
    let source = "kind = \"file\"\npath = \"log.csv\"\nfrom = \"start\"\nformat = \"csv\"\n\
                  time-field = \"at\"\ntime-unit = \"ns\"";
    let configuration = configure(&site, source);
    let mut command = crate::support::spandrel("feed");
    command
        .arg(site.structure_file())
        .arg("--config")
        .arg(&configuration);
    let finished = Process::start(command.args(["--check", "--duration", "2"])).wait();
    let said = finished.expect_code(0).stdout;
    assert!(
        said.contains("  t -> house/condition/air: 5 values, last -9.96 degC\n"),
        "{said}"
    );
}

#[test]
fn mistakes_of_a_condition_end_the_program_before_it_starts() {
    let site = house();
    let source = "kind = \"stdin\"\nformat = \"json\"";
    let configuration = configure(&site, source);
    let text = std::fs::read_to_string(&configuration).unwrap();
    let text = text.replace("condition = \"air\"", "condition = \"water\"\nsign = -1");
    std::fs::write(&configuration, text).unwrap();
    let mut command = crate::support::spandrel("feed");
    command
        .arg(site.structure_file())
        .arg("--config")
        .arg(&configuration);
    let finished = Process::start(&mut command).wait().expect_code(2);
    for expected in [
        "feed.source[0].condition[0].condition: is \"water\", must be one of air (house)",
        "feed.source[0].condition[0].sign: is an unknown key here, must be one of condition, \
         offset, sensitivity, source, structure",
    ] {
        assert!(finished.stderr.contains(expected), "{}", finished.stderr);
    }
}
