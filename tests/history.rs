//! The stored history behind the services, the queries and the page, after all processes that
//! observed it have ended.

use crate::support::{DEADLINE, Drops, Process, Site, SmallDisk, two_storeys, within};
use serde_json::{Value, json};
use spandrel_bus::{AlertState, Bus, HistoryLog, HistorySpan, Name, Service};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::Duration;

/// Damage of storey 2 at 40 s, and a rule relative to the design.
const DAMAGED: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                       credibility = 0.99\nsustain-s = 5\n\
                       [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 40\nloss = 0.15\n";
const LENGTH_S: f64 = 100.0;

/// Returns a configuration with its history in this file.
fn configuration(site: &Site, database: &Path) -> std::path::PathBuf {
    let path = site.folder().join("spandrel.toml");
    std::fs::write(
        &path,
        format!("[history]\ndatabase = \"{}\"\n", database.display()),
    )
    .unwrap();
    path
}

/// Repeats a query until its reply is accepted, because recent values reach the history only within
/// seconds.
async fn span(
    bus: &Bus,
    site: &Site,
    parameters: &str,
    accepted: impl Fn(&HistorySpan) -> bool,
) -> HistorySpan {
    let key = site.keys().history(&Name::new("storey-2").unwrap());
    within("an answer of the history", async {
        loop {
            let answers = bus
                .ask::<HistorySpan>(&format!("{key}?{parameters}"), DEADLINE)
                .await
                .unwrap();
            if let Some((_, span)) = answers.into_iter().find(|(_, span)| accepted(span)) {
                return span;
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    })
    .await
}

/// Starts a page in a separate process. Returns its address.
fn start_page(site: &Site) -> (Process, String) {
    let page = Process::start(site.connecting("dashboard").args(["--http", "127.0.0.1:0"]));
    page.wait_for_output("address of the page", |said| said.contains("page: http://"));
    let said = page.output();
    let address = said
        .split("page: http://")
        .nth(1)
        .unwrap()
        .split('/')
        .next()
        .unwrap()
        .to_owned();
    (page, address)
}

/// Sends one request to the interface of the page.
pub fn get(address: &str, path: &str) -> Value {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200"), "{path}: {answer}");
    serde_json::from_str(body).unwrap_or_else(|error| panic!("{error}: {body}"))
}

#[tokio::test(flavor = "multi_thread")]
async fn the_history_survives_a_restart_of_all_services() {
    let site = Site::with(&two_storeys(DAMAGED));
    let configuration = configuration(&site, Path::new("house.sqlite"));
    let services = Process::start(
        site.listening("run")
            .arg("--config")
            .arg(&configuration)
            .args(["--http", "none"]),
    );
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(LENGTH_S);
    site.replay(&record, "max").wait().expect_code(0);
    let is_whole = |span: &HistorySpan| {
        span.rows
            .time_s
            .last()
            .is_some_and(|last| *last > LENGTH_S - 1.0)
    };
    let before = span(&bus, &site, "points=20000", is_whole).await;
    assert!(
        before.rows.mean[..200]
            .iter()
            .all(|mean| (mean - 1.0).abs() < 0.2)
    );
    assert!(
        (before.rows.mean.last().unwrap() - 0.85).abs() < 0.05,
        "{:?}",
        before.rows.mean.last()
    );
    let losses = span(&bus, &site, "kind=loss;points=20000", is_whole).await;
    let (loss, probability) = (&losses.rows.mean, &losses.rows.probability_of_loss);
    assert!((loss.last().unwrap() - 0.15).abs() < 0.05, "{loss:?}");
    assert!(
        probability[0] < 0.5 && *probability.last().unwrap() > 0.99,
        "{probability:?}"
    );
    bus.close().await.unwrap();
    services.stop().expect_code(0);
    assert!(
        site.folder().join("house.sqlite").is_file(),
        "a relative file lies beside the configuration"
    );

    // Another run, in which nothing is measured.
    let history = Process::start(
        site.listening("history")
            .arg("--config")
            .arg(&configuration),
    );
    history.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let after = span(&bus, &site, "points=20000", is_whole).await;
    assert_eq!(after, before);
    let minutes = span(&bus, &site, "points=2", |_| true).await;
    assert_eq!(
        minutes.rows.count.iter().sum::<u64>(),
        before.rows.count.iter().sum::<u64>()
    );
    let logs = bus
        .ask::<HistoryLog>(&site.keys().history_log(), DEADLINE)
        .await
        .unwrap();
    let states: Vec<AlertState> = logs[0]
        .1
        .alerts
        .iter()
        .filter(|alert| alert.parameter.as_str() == "storey-2")
        .map(|alert| alert.state)
        .collect();
    assert!(
        states.contains(&AlertState::Pending) && states.contains(&AlertState::Raised),
        "{states:?}"
    );
    for refused in ["from=yesterday", "kind=weather", "from=2;to=1"] {
        let key = site.keys().history(&Name::new("storey-2").unwrap());
        let answers = bus
            .ask::<HistorySpan>(&format!("{key}?{refused}"), DEADLINE)
            .await
            .unwrap();
        assert!(answers.is_empty(), "{refused}: {answers:?}");
    }

    // A page that has not received any of it shows the history.
    let (_page, address) = start_page(&site);
    let shown = within("the page has found the history", async {
        loop {
            let path =
                "/api/structures/house/history?series=parameter/storey-2&from=0&to=1000&points=500";
            let answer = tokio::task::block_in_place(|| get(&address, path));
            if answer["series"][0]["data"][0]
                .as_array()
                .is_some_and(|times| times.len() > 100)
            {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    })
    .await;
    let mean = &shown["series"][0]["data"][1];
    let last = mean.as_array().unwrap().last().unwrap().as_f64().unwrap();
    assert!(
        (last - before.rows.mean.last().unwrap()).abs() < 0.02,
        "{last}"
    );
    assert!(shown["kept_from_s"].as_f64().unwrap() < 10.0);
    within("the page has learnt of the alerts", async {
        while tokio::task::block_in_place(|| get(&address, "/api/alerts?state=raised"))["changes"]
            == json!([])
        {
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    })
    .await;
}

/// Regression test: the series of a waveform from before the start of the page was empty, although
/// the page drew it.
#[tokio::test(flavor = "multi_thread")]
async fn waveforms_from_before_a_restart_of_the_page_are_those_of_the_recording() {
    const POINTS: usize = 10;
    const ROWS: usize = 100;
    let site = Site::with(&two_storeys(""));
    let services = Process::start(site.listening("run").args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(30.0);
    site.replay(&record, "max").wait().expect_code(0);
    let (_page, address) = start_page(&site);
    let first = (0..record.len()).find(|row| record.time_ns(*row) == 20_000_000_000);
    let first = first.expect("a row at 20 s");
    // Ten intervals of ten samples each. The range ends within the last step.
    let path = format!(
        "/api/structures/house/history?series=waveform/floor-1&from=20&to=20.9999&points={POINTS}"
    );
    let span = within("the waveform", async {
        loop {
            let span = tokio::task::block_in_place(|| get(&address, &path));
            if span["series"][0]["data"][0] != json!([]) {
                return span;
            }
            // The page may not have found ingest yet.
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    })
    .await;
    assert_eq!(span["unread_waveforms"], json!(null));
    let column = |column: usize| span["series"][0]["data"][column].as_array().unwrap();
    assert_eq!(column(0).len(), POINTS);
    for point in 0..POINTS {
        let from = first + point * ROWS / POINTS;
        let values = (from..from + ROWS / POINTS).map(|row| record.value(row, "floor-1"));
        let expected = [
            record.time_ns(from) as f64 / 1e9,
            values.clone().fold(f64::INFINITY, f64::min),
            values.fold(f64::NEG_INFINITY, f64::max),
        ];
        for (place, expected) in expected.into_iter().enumerate() {
            let found = column(place)[point].as_f64().unwrap();
            assert!(
                (found - expected).abs() < 1e-9,
                "point {point}, column {place}: {found}, expected {expected}"
            );
        }
    }
    services.stop().expect_code(0);
}

/// Writes until the file system is full.
fn fill(path: &Path) -> std::fs::File {
    let mut file = std::fs::File::create(path).unwrap();
    for bytes in [4096, 1] {
        while file.write_all(&[0; 4096][..bytes]).is_ok() {}
    }
    file
}

#[tokio::test(flavor = "multi_thread")]
async fn history_waits_for_a_disk_that_is_full_at_the_first_start() {
    let site = Site::with(&two_storeys(DAMAGED));
    let disk = site.folder().join("disk");
    std::fs::create_dir(&disk).unwrap();
    let Some(_mounted) = SmallDisk::or_skip(&disk, "2m") else {
        return;
    };
    let filling = disk.join("filling");
    let file = fill(&filling);
    // Recording and checkpoints are on this disk as well.
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(
        &configuration,
        "[state]\nfolder = \"disk/state\"\n[history]\ndatabase = \"disk/state/house.sqlite\"\n",
    )
    .unwrap();
    let services = Process::start(
        site.listening("run")
            .arg("--config")
            .arg(&configuration)
            .args(["--http", "none"]),
    );
    services.wait_for_log("history is waiting for its database");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    drops.expect(Service::History, "failed-writes", 1).await;
    let record = site.simulate(LENGTH_S);
    site.replay(&record, "max").wait().expect_code(0);
    drop(file);
    std::fs::remove_file(&filling).unwrap();
    let is_whole = |span: &HistorySpan| {
        span.rows
            .time_s
            .last()
            .is_some_and(|last| *last > LENGTH_S - 1.0)
    };
    let whole = span(&bus, &site, "points=20000", is_whole).await;
    assert!(whole.rows.time_s[0] < 1.0, "{:?}", &whole.rows.time_s[..3]);
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}

#[test]
fn the_error_names_a_place_where_no_history_can_be_written() {
    let site = Site::with(&two_storeys(""));
    std::fs::create_dir(site.folder().join("folder.sqlite")).unwrap();
    for (database, told) in [
        ("folder.sqlite", "Is a directory"),
        ("structure.toml/house.sqlite", "File exists"),
    ] {
        let configuration = configuration(&site, Path::new(database));
        let services = Process::start(
            site.listening("run")
                .arg("--config")
                .arg(&configuration)
                .args(["--http", "none"]),
        );
        let name = database.split('/').next().unwrap();
        services.wait().expect_code(1).expect_told(&[name, told]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_stops_nothing_and_waiting_values_are_written_later() {
    let site = Site::with(&two_storeys(DAMAGED));
    let disk = site.folder().join("disk");
    std::fs::create_dir(&disk).unwrap();
    let Some(_mounted) = SmallDisk::or_skip(&disk, "2m") else {
        return;
    };
    let configuration = configuration(&site, &disk.join("house.sqlite"));
    let services = Process::start(
        site.listening("run")
            .arg("--config")
            .arg(&configuration)
            .args(["--http", "none"]),
    );
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    let filling = disk.join("filling");
    let file = fill(&filling);
    let record = site.simulate(LENGTH_S);
    site.replay(&record, "max").wait().expect_code(0);
    drops.expect(Service::History, "failed-writes", 2).await;
    services.wait_for_log("history write failed; retrying");
    drop(file); // an open file keeps its space
    std::fs::remove_file(&filling).unwrap();
    let whole = span(&bus, &site, "points=20000", |span| {
        span.rows
            .time_s
            .last()
            .is_some_and(|last| *last > LENGTH_S - 1.0)
    })
    .await;
    // The history is complete from the beginning.
    assert!(whole.rows.time_s[0] < 1.0, "{:?}", &whole.rows.time_s[..3]);
    let longest = whole
        .rows
        .time_s
        .windows(2)
        .map(|pair| pair[1] - pair[0])
        .fold(0.0, f64::max);
    assert!(longest < 0.15, "{longest} s without a value");
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}

/// Idle connections must be limited in number and closed.
#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_are_limited_and_closed() {
    const MANY: usize = 400;
    const MOST: usize = 256;
    let site = Site::with(&two_storeys(""));
    let services = Process::start(site.listening("run").args(["--http", "127.0.0.1:0"]));
    services.wait_for_output("address of the page", |said| said.contains("page: http://"));
    let said = services.output();
    let address = said
        .split("page: http://")
        .nth(1)
        .unwrap()
        .split('/')
        .next()
        .unwrap()
        .to_owned();
    let silent: Vec<TcpStream> = (0..MANY)
        .map(|_| TcpStream::connect(&address).unwrap())
        .collect();
    services.wait_for_log("too many connections to the page");
    let open = std::fs::read_dir(format!("/proc/{}/fd", services.id())).unwrap();
    let sockets = open.flatten().filter(|file| {
        std::fs::read_link(file.path())
            .is_ok_and(|target| target.to_string_lossy().starts_with("socket:"))
    });
    let sockets = sockets.count();
    assert!(sockets < MOST + 100, "{sockets} sockets are open");
    // All idle connections end without a reply, and the page then answers others again.
    tokio::task::block_in_place(|| {
        for mut stream in silent {
            stream.set_read_timeout(Some(DEADLINE)).unwrap();
            let mut said = Vec::new();
            let ended = stream.read_to_end(&mut said);
            let is_reset = ended
                .as_ref()
                .is_err_and(|error| error.kind() == std::io::ErrorKind::ConnectionReset);
            assert!(ended.is_ok() || is_reset, "{ended:?}");
        }
        assert!(get(&address, "/api/structures")["structures"].is_array());
    });
    services.stop().expect_code(0);
}
