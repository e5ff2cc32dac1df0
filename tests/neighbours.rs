//! Neighbours that are slow, wrong or hostile: others get in, the log names them, and the log stays
//! small.

use crate::support::{
    DEADLINE, Drops, Process, Sensors, Site, five_storeys, put_raw, spandrel, two_storeys, within,
};
use spandrel_bus::{
    AlertMessage, AlertState, Block as _, Bus, BusConfig, Delivery, EstimateBlock, EstimateFlags,
    Event, EventKind, Message as _, Mode, Name, Service, Start, Status, StreamSettings,
};
use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;
use std::time::Duration;
use tokio::io::AsyncReadExt as _;
use tokio::task::JoinSet;
use tokio::time::Instant;

/// Starts all services with a page, and returns the address of the page.
fn with_page(site: &Site, arguments: &[&str]) -> (Process, String) {
    let mut command = site.listening("run");
    command.args(["--http", "127.0.0.1:0"]).args(arguments);
    let services = Process::start(&mut command);
    services.wait_for_output("address of the page", |said| said.contains("page: http"));
    let said = services.output();
    let address = said.split("://").nth(1).unwrap();
    let address = address.split('/').next().unwrap().to_owned();
    services.wait_for_log("ready structures=1");
    (services, address)
}

/// Sends a request and returns the reply, as far as it comes without a pause of `patience`.
fn exchange(address: &str, request: &str, patience: Duration) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(patience)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut reply = String::new();
    // The server may close the connection before it has read all of a wrong request.
    let _ = stream.read_to_string(&mut reply);
    reply
}

fn get(address: &str, path: &str, headers: &str) -> String {
    get_within(DEADLINE, address, path, headers)
}

fn get_within(patience: Duration, address: &str, path: &str, headers: &str) -> String {
    let request =
        format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n{headers}Connection: close\r\n\r\n");
    exchange(address, &request, patience)
}

/// Returns the count of refusals for a reason, from the metrics of the page.
fn refused(metrics: &str, reason: &str) -> u64 {
    let start = format!("spandrel_refused_total{{reason=\"{reason}\"}} ");
    let line = metrics.lines().find_map(|line| line.strip_prefix(&start));
    line.and_then(|count| count.parse().ok())
        .unwrap_or_else(|| panic!("no count of {reason}\n{metrics}"))
}

/// Regression: 300 connections that sent half a head kept everybody out for 20 s, and 300 that sent
/// a head without its body for 8 s.
#[test]
fn slow_connections_keep_nobody_out() {
    const MANY: u64 = 300;
    const PATIENCE: Duration = Duration::from_secs(3);
    let site = Site::with(&two_storeys(""));
    let (services, address) = with_page(&site, &[]);
    let half_a_head = "GET / HTTP/1.1\r\nHost: ".to_owned();
    // The server asks for the body once it waits for it.
    let continued = "HTTP/1.1 100 Continue\r\n\r\n";
    let no_body = format!(
        "POST /api/structures/{}/alerts/storey-1/acknowledge HTTP/1.1\r\nHost: {address}\r\n\
         Content-Type: application/json\r\nContent-Length: 100\r\n\
         Expect: 100-continue\r\n\r\n",
        site.keys().structure()
    );
    let mut closed = 0;
    for (sent, awaited) in [(half_a_head, ""), (no_body, continued)] {
        let slow: Vec<TcpStream> = (0..MANY)
            .map(|_| {
                let mut stream = TcpStream::connect(&address).unwrap();
                stream.set_read_timeout(Some(PATIENCE)).unwrap();
                // The server may have closed it to make room for a later one.
                let _ = stream.write_all(sent.as_bytes());
                let _ = stream.read_exact(&mut vec![0; awaited.len()]);
                stream
            })
            .collect();
        for _ in 0..3 {
            let reply = get_within(PATIENCE, &address, "/api/structures", "");
            assert!(
                reply.starts_with("HTTP/1.1 200"),
                "{reply:?} after {sent:?}"
            );
        }
        let before = closed;
        closed = refused(&get(&address, "/metrics", ""), "connection");
        assert!(
            closed >= before + MANY - 256,
            "{closed} connections closed after {sent:?}, {before} before"
        );
        drop(slow);
    }
    services.wait_for_log("too many connections to the page");
    services.stop().expect_code(0);
}

/// Opens a WebSocket, and reads nothing after the head of the reply. Returns `None` if all places
/// are taken.
fn open_socket(address: &str) -> Option<TcpStream> {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    let request = format!(
        "GET /api/live HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\n\
         Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).unwrap();
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        head.extend(byte);
    }
    let head = String::from_utf8(head).unwrap();
    let is_open = head.starts_with("HTTP/1.1 101");
    assert!(is_open || head.starts_with("HTTP/1.1 503"), "{head}");
    is_open.then_some(stream)
}

/// Regression: 64 WebSockets whose clients read nothing kept others out for 60 s.
#[test]
fn sockets_whose_clients_read_nothing_keep_nobody_out() {
    const PLACES: usize = 64;
    const WITHIN: Duration = Duration::from_secs(10);
    /// A frame without content, and with a mask of zeros, as a client must send one.
    const PONG: [u8; 6] = [0x8A, 0x80, 0, 0, 0, 0];
    let site = Site::with(&two_storeys(""));
    let (services, address) = with_page(&site, &[]);
    let mut answering = open_socket(&address).expect("a place");
    let answers = std::thread::spawn(move || {
        let mut received = [0; 4096];
        // The server sends something at least twice a second.
        while matches!(answering.read(&mut received), Ok(1..)) {
            if answering.write_all(&PONG).is_err() {
                return;
            }
        }
    });
    let silent: Vec<TcpStream> = (1..PLACES)
        .map(|_| open_socket(&address).expect("a place"))
        .collect();
    let taken = Instant::now();
    assert!(open_socket(&address).is_none(), "more than {PLACES} places");
    let newcomers: Vec<TcpStream> = (1..PLACES)
        .map(|number| {
            loop {
                if let Some(socket) = open_socket(&address) {
                    break socket;
                }
                let waited = taken.elapsed();
                assert!(waited < WITHIN, "no place for {number} in {waited:?}");
                std::thread::sleep(Duration::from_millis(100));
            }
        })
        .collect();
    assert!(
        open_socket(&address).is_none(),
        "a client that answers has lost its place"
    );
    assert!(!answers.is_finished(), "a client that answers is closed");
    services.wait_for_log("closed one whose client does not answer");
    drop((silent, newcomers));
    services.stop().expect_code(0);
}

#[test]
fn heads_that_two_programs_may_read_differently_are_rejected() {
    let site = Site::with(&two_storeys(""));
    let (services, address) = with_page(&site, &[]);
    for (request, status) in [
        (
            "GET /health/live HTTP/1.1\r\nHost: HERE\r\nConnection: close\r\n\r\n",
            200,
        ),
        (
            "GET /health/live HTTP/1.1\r\nHost: HERE\r\nHost: HERE\r\nConnection: close\r\n\r\n",
            400,
        ),
        (
            "GET /health/live HTTP/1.1\r\nConnection: close\r\n\r\n",
            400,
        ),
        (
            "GET /health/live HTTP/1.1\nHost: HERE\nConnection: close\n\n",
            400,
        ),
        (
            "GET /health/live HTTP/1.1\r\nHost: HERE\nConnection: close\r\n\r\n",
            400,
        ),
    ] {
        let reply = exchange(&address, &request.replace("HERE", &address), DEADLINE);
        let found = reply
            .split(' ')
            .nth(1)
            .and_then(|code| code.parse::<u16>().ok());
        assert_eq!(found, Some(status), "{request:?}: {reply:?}");
    }
    services.wait_for_log("malformed-request");
    services.stop().expect_code(0);
}

/// Regression: 40 wrong tokens left no trace, and kept out the holder of a right one at the same
/// address.
#[test]
fn wrong_tokens_are_logged_and_counted_and_right_ones_still_work() {
    let site = Site::with(&two_storeys(""));
    let tokens = site.folder().join("tokens.json");
    let mut issue = spandrel("token");
    issue
        .args(["ada", "--role", "viewer", "--file"])
        .arg(&tokens);
    let token = Process::start(&mut issue).wait().expect_code(0).stdout;
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(&configuration, "[dashboard]\ntokens = \"tokens.json\"\n").unwrap();
    let (services, address) = with_page(&site, &["--config", configuration.to_str().unwrap()]);
    let bearer = |token: &str| format!("Authorization: Bearer {token}\r\n");
    for _ in 0..40 {
        let reply = get(&address, "/api/structures", &bearer("spandrel-wrong"));
        let refused = ["HTTP/1.1 401", "HTTP/1.1 429"];
        assert!(
            refused.iter().any(|status| reply.starts_with(status)),
            "{reply}"
        );
    }
    let reply = get(&address, "/api/structures", &bearer(token.trim()));
    assert!(reply.starts_with("HTTP/1.1 200"), "{reply}");
    services.wait_for_log("what=\"wrong-token\" who=\"127.0.0.1\"");
    let lines = services.log().matches("refused what=").count();
    assert!(lines <= 20, "{lines} lines about 40 wrong tokens");
    let metrics = get(&address, "/metrics", &bearer(token.trim()));
    let count = |reason: &str| refused(&metrics, reason);
    assert_eq!(count("wrong-token") + count("repeated-wrong-token"), 40);
    assert!(
        !services.log().contains("spandrel-wrong"),
        "the log has a token"
    );
    services.stop().expect_code(0);
}

/// Regression: malformed queries wrote 33.8 MB of log in 5 s.
#[tokio::test(flavor = "multi_thread")]
async fn malformed_queries_are_counted_and_hardly_logged() {
    const MANY: u64 = 2_000;
    let site = Site::with(&two_storeys(""));
    let services = Process::start(site.listening("run").args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    let query = format!("{}?after=yesterday", site.keys().recording());
    for _ in 0..MANY {
        let replies = bus.session().get(&query).timeout(DEADLINE).await.unwrap();
        let reply = replies.recv_async().await.unwrap();
        assert!(reply.result().is_err(), "a malformed query has a reply");
    }
    drops.expect(Service::Ingest, "refused-queries", MANY).await;
    let lines = services.log().matches("query rejected").count();
    assert!(
        (1..=12).contains(&lines),
        "{lines} lines about {MANY} queries"
    );
    bus.close().await.unwrap();
    services.stop().expect_code(0);
}

/// Regression: 100 connections that sent nothing took all places for opening a session, so that most
/// programs could not connect to the bus.
#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_to_the_bus_keep_no_client_out() {
    const MANY: usize = 300;
    const CLIENTS: usize = 5;
    let site = Site::with(&two_storeys(""));
    let services = Process::start(site.listening("run").args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let address = site.endpoint().trim_start_matches("tcp/").to_owned();
    let (closed, mut all_closed) = tokio::sync::mpsc::unbounded_channel();
    let mut silent = JoinSet::new();
    for number in 0..MANY {
        let mut stream = tokio::net::TcpStream::connect(&address).await.unwrap();
        let (address, closed) = (address.clone(), closed.clone());
        silent.spawn(async move {
            loop {
                // Zenoh sends nothing first, so this ends with the connection.
                while stream.read(&mut [0]).await.is_ok_and(|read| read > 0) {}
                let _ = closed.send(number); // the test may have ended
                match tokio::net::TcpStream::connect(&address).await {
                    Ok(next) => stream = next,
                    Err(_) => return,
                }
            }
        });
    }
    // While the first connections are open, and again after each has been reopened.
    let mut reopened = BTreeSet::new();
    for round in ["first", "reopened"] {
        for _ in 0..CLIENTS {
            let bus = neighbour(&site).await;
            bus.close().await.unwrap();
        }
        within(&format!("the end of all {round} connections"), async {
            while reopened.len() < MANY {
                reopened.insert(all_closed.recv().await.unwrap());
            }
        })
        .await;
    }
    silent.shutdown().await;
    services.stop().expect_code(0);
}

/// Regression: to close the connection of a suspended subscriber blocked a thread of Zenoh for 10
/// s. Two of them stopped all reception, nodes disappeared, and samples were lost.
#[tokio::test(flavor = "multi_thread")]
async fn suspended_subscribers_delay_nobody_and_are_disconnected() {
    const READERS: usize = 20;
    // More than the threads on which Zenoh receives.
    const CROWD: usize = 150;
    const DURATION_S: usize = 75;
    // Two frozen subscribers delayed alerts by 10 s.
    const MOST_LAG_S: f64 = 2.0;
    // The connections of the crowd above the number of threads are closed a second later. Frames may
    // then wait 2 s for late samples.
    const MOST_LAG_OF_CROWD_S: f64 = 5.0;
    // Zenoh gives up a subscriber 10 s after its last message.
    const GONE_WITHIN: Duration = Duration::from_secs(20);
    let site = Site::of(&five_storeys());
    let (services, page) = with_page(&site, &[]);
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let drops = Drops::watch(&bus, &site.keys()).await;
    let of_alert = site.keys().statuses(Service::Alert);
    let of_alert = bus.subscribe::<Status>(of_alert, 256).await.unwrap();
    let mut simulation = site.connecting("simulate");
    simulation.args(["--live", "--duration", &DURATION_S.to_string()]);
    let simulation = Process::start(&mut simulation);
    let root = site.keys().root().to_string();
    let watch = |_| {
        let mut command = spandrel("watch");
        command.args(["--root", &root, "--connect", site.endpoint()]);
        Process::start(command.env("SPANDREL_BUS__MODE", "client"))
    };
    let readers: Vec<Process> = (0..READERS).map(watch).collect();
    for reader in &readers {
        reader.wait_for_output("values", |said| said.contains("storey-1"));
    }
    let lags = |most_s: f64| {
        let statuses = of_alert.messages().try_iter();
        let lags_s: Vec<f64> = statuses.filter_map(|(_, status)| status.lag_s).collect();
        let is_met = lags_s.len() >= 3 && lags_s.iter().all(|lag_s| *lag_s < most_s);
        assert!(is_met, "alert lags {most_s} s or more: {lags_s:?}");
    };
    let events = bus.subscribe::<Event>(site.keys().event(), 1024).await;
    let events = events.unwrap();
    while of_alert.messages().try_iter().next().is_some() {}
    readers.iter().for_each(Process::freeze);
    let frozen = Instant::now();
    loop {
        let gone = lost_readers(&services.log());
        if gone.len() >= READERS {
            break;
        }
        let waited = frozen.elapsed();
        assert!(waited < GONE_WITHIN, "only {gone:?} gone after {waited:?}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    lags(MOST_LAG_S);
    let crowd = std::env::current_exe().unwrap();
    let mut crowd = Command::new(crowd);
    crowd.args([
        "neighbours::crowd_of_readers",
        "--exact",
        "--ignored",
        "--nocapture",
    ]);
    let orders = format!("{CROWD} {root} {}", site.endpoint());
    let crowd = Process::start(crowd.env(CROWD_ORDERS, orders));
    crowd.wait_for_output("all readers have received", |said| {
        said.contains("all have received")
    });
    while of_alert.messages().try_iter().next().is_some() {}
    crowd.freeze();
    simulation.wait().expect_code(0);
    // The first frame is the first instant of all six nodes.
    let frames = 100 * DURATION_S as u64 - 50;
    let identify = drops.when_done(Service::Identify, frames).await;
    let ingest = drops.expect(Service::Ingest, "late-samples", 0).await;
    for reason in ["late-samples", "lost-items", "gap-samples"] {
        assert_eq!(ingest.get(reason), None, "{ingest:?}");
        assert_eq!(identify.drops.get(reason), None, "{:?}", identify.drops);
    }
    lags(MOST_LAG_OF_CROWD_S);
    let metrics = get(&page, "/metrics", "");
    assert!(
        refused(&metrics, "bus-reader") >= (READERS + CROWD) as u64,
        "{metrics}"
    );
    let of_readers = |event: &Event| event.kind == EventKind::ReaderDisconnected;
    let events: Vec<Event> = events
        .messages()
        .try_iter()
        .map(|(_, event)| event)
        .collect();
    let named = |event: &Event| event.subject.starts_with("tcp/127.0.0.1:");
    assert!(
        events.iter().any(|event| of_readers(event) && named(event)),
        "{events:?}"
    );
    readers.into_iter().for_each(Process::kill);
    crowd.kill();
    services.stop().expect_code(0);
}

/// Returns the addresses of the disconnected subscribers that the log names.
fn lost_readers(log: &str) -> BTreeSet<String> {
    let start = "refused what=\"bus-reader\" who=\"";
    let addresses = log.lines().filter_map(|line| {
        let (_, rest) = line.split_once(start)?;
        let (who, _) = rest.split_once('"')?;
        who.starts_with("tcp/127.0.0.1:").then(|| who.to_owned())
    });
    addresses.collect()
}

const CROWD_ORDERS: &str = "CROWD_OF_READERS";

/// Runs as a separate process of the test above: many connections that read everything.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "is started by the test above"]
async fn crowd_of_readers() {
    let Ok(orders) = std::env::var(CROWD_ORDERS) else {
        return; // a run of all ignored tests
    };
    let [count, root, endpoint] = orders.split(' ').collect::<Vec<_>>()[..] else {
        panic!("{orders}");
    };
    let mut readers = Vec::new();
    for _ in 0..count.parse().unwrap() {
        let config = BusConfig {
            root: root.to_owned(),
            mode: Mode::Client,
            connect: vec![endpoint.to_owned()],
            ..BusConfig::default()
        };
        let bus = Bus::open(&config).await.unwrap();
        let (first, received) = std::sync::mpsc::sync_channel(1);
        let all = bus.session().declare_subscriber(format!("{root}/**"));
        let all = all.callback(move |_| {
            let _ = first.try_send(());
        });
        let all = all.await;
        readers.push((bus, all.unwrap(), received));
    }
    for (_, _, received) in &readers {
        received.recv_timeout(DEADLINE).unwrap();
    }
    println!("all have received");
    std::future::pending::<()>().await;
}

/// Starts an isolated process with all services, and returns the address of its page.
fn isolated(site: &Site) -> (Process, String) {
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(&configuration, "isolated = true\n").unwrap();
    with_page(site, &["--config", configuration.to_str().unwrap()])
}

/// Opens the session of another program of the machine.
async fn neighbour(site: &Site) -> Bus {
    let config = BusConfig {
        root: site.keys().root().to_string(),
        mode: Mode::Client, // peers would connect to each other
        connect: vec![site.endpoint().to_owned()],
        ..BusConfig::default()
    };
    Bus::open(&config).await.unwrap()
}

/// Regression: any program of the machine could publish estimates and alerts in the name of the
/// services.
#[tokio::test(flavor = "multi_thread")]
async fn an_isolated_run_accepts_samples_but_no_forged_results() {
    const ROWS: usize = 400;
    const MANY: usize = 100;
    let site = Site::with(&two_storeys(""));
    let keys = site.keys();
    let (services, page) = isolated(&site);
    let forger = neighbour(&site).await;
    let viewer = neighbour(&site).await;
    site.wait_for_services(&viewer).await;
    let drops = Drops::watch(&viewer, &keys).await;
    let alert = keys.alert(&Name::new("storey-1").unwrap());
    let alerts = viewer.session().declare_subscriber(&alert).await.unwrap();
    let forged = [keys.frames(), keys.estimates(), alert.clone()];
    for key in &forged {
        put_raw(&forger, key, "application/json", b"{}".to_vec()).await;
        services.wait_for_log(&format!("why=\"Put on {key}\""));
    }
    for number in 3..MANY {
        let key = &forged[number % forged.len()];
        put_raw(&forger, key, "application/json", b"{}".to_vec()).await;
    }
    let all_counted = || refused(&get(&page, "/metrics", ""), "bus-right") >= MANY as u64;
    within(&format!("{MANY} refused messages in the metrics"), async {
        while !all_counted() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    })
    .await;
    let lines = services.log().matches("refused what=").count();
    assert!(lines <= 20, "{lines} lines about {MANY} messages");
    let record = site.simulate(ROWS as f64 / 100.0);
    let mut sensors = Sensors::start(&forger, &keys, site.structure(), &record).await;
    sensors.put(0..ROWS).await;
    for service in [Service::Identify, Service::Alert] {
        let status = drops.when_done(service, ROWS as u64).await;
        // A busy machine drops blocks, which the services fetch again.
        let fetched = ["duplicate-items", "fetched-items", "unkept-blocks"];
        let reasons: Vec<_> = status.drops.keys().collect();
        assert!(
            reasons
                .iter()
                .all(|reason| fetched.contains(&reason.as_str())),
            "{service:?}: {:?}",
            status.drops
        );
    }
    assert!(
        alerts.try_recv().unwrap().is_none(),
        "a forged alert was heard"
    );
    services.stop().expect_code(0);
}

/// Regression: valid estimates at the next number raised false alerts.
#[tokio::test(flavor = "multi_thread")]
async fn forged_estimates_of_half_the_stiffness_raise_no_alert_in_an_isolated_run() {
    const ROWS: usize = 400;
    const RULE: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                        credibility = 0.99\nsustain-s = 1\n";
    let site = Site::with(&two_storeys(RULE));
    let keys = site.keys();
    let (services, page) = isolated(&site);
    let forger = neighbour(&site).await;
    let viewer = neighbour(&site).await;
    site.wait_for_services(&viewer).await;
    let drops = Drops::watch(&viewer, &keys).await;
    let alerts = viewer.subscribe::<AlertMessage>(keys.all_alerts(), 256);
    let alerts = alerts.await.unwrap();
    let settings = StreamSettings::new(Start::Beginning);
    let estimates =
        viewer.follow::<EstimateBlock>(keys.estimates(), keys.estimates_buffer(), settings);
    let estimates = estimates.await.unwrap();
    let record = site.simulate(2.0 * ROWS as f64 / 100.0);
    let mut sensors = Sensors::start(&forger, &keys, site.structure(), &record).await;
    sensors.put(0..ROWS).await;
    drops.when_done(Service::Alert, ROWS as u64).await;
    let forged = within("the last estimate", async {
        loop {
            match estimates.deliveries().recv_async().await.unwrap() {
                Delivery::Block(block) if block.end() == ROWS as u64 => return half(&block),
                Delivery::Block(_) => {}
                Delivery::Gap(gap) => panic!("estimates are lost: {gap:?}"),
            }
        }
    })
    .await;
    let payload = forged.encode().unwrap();
    let encoding = EstimateBlock::encoding();
    put_raw(&forger, &keys.estimates(), &encoding, payload).await;
    // These samples arrive later on the same connection.
    sensors.put(ROWS..2 * ROWS).await;
    drops.when_done(Service::Alert, 2 * ROWS as u64).await;
    for (_, alert) in alerts.messages().try_iter() {
        let is_of_loss = matches!(alert.state, AlertState::Pending | AlertState::Raised);
        assert!(!is_of_loss, "{alert:?}");
    }
    services.wait_for_log(&format!("why=\"Put on {}\"", keys.estimates()));
    assert_eq!(refused(&get(&page, "/metrics", ""), "bus-right"), 1);
    services.stop().expect_code(0);
}

/// Returns 5 s of estimates that follow a block, with half the stiffness and high precision.
pub fn half(last: &EstimateBlock) -> EstimateBlock {
    let mut forged = last.clone();
    forged.header.sequence = last.end();
    let mut estimate = last.estimates.last().unwrap().clone();
    for mean in &mut estimate.mean {
        *mean *= 0.5;
    }
    for covariance in &mut estimate.covariance {
        *covariance *= 1e-4;
    }
    estimate.flags = EstimateFlags::working(); // otherwise an alert stays undecided
    forged.estimates = vec![estimate; 500];
    forged
}

/// An isolated process would silently keep out the other services that it needs.
#[test]
fn only_a_process_with_all_services_can_be_isolated() {
    let site = Site::with(&two_storeys(""));
    let with = |subcommand: &str, variables: &[(&str, &str)]| {
        let mut command = site.listening(subcommand);
        command.env("SPANDREL_ISOLATED", "true");
        command.envs(variables.iter().copied());
        Process::start(&mut command).wait().expect_code(2).stderr
    };
    let ingest = with("ingest", &[]);
    assert!(
        ingest.contains("isolated = true: `spandrel ingest`"),
        "{ingest}"
    );
    let client = with("run", &[("SPANDREL_BUS__MODE", "client")]);
    assert!(client.contains("isolated = true: a client"), "{client}");
    let file = with("run", &[("SPANDREL_BUS__CONFIG_FILE", "zenoh.json5")]);
    assert!(file.contains("zenoh.json5 states the rights"), "{file}");
}
