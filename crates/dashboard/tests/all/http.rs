//! Tests of the HTTP interface and the WebSocket, over a real Zenoh session and a real socket.

use futures_util::StreamExt;
use serde_json::{Value, json};
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, Annotation, AnnotationEffect, AnnotationKind, Bus,
    BusConfig, CredibleInterval, DisplayPublisher, Event, EventKind, FrameBlock, Header,
    HistoryRows, HistorySpan, JudgementDisplay, Keep, Keys, LatestPublisher, LossDisplay, Name,
    NumberedStream, ParameterDisplay, StreamState, time_ns,
};
use spandrel_dashboard::{DashboardError, DashboardPlan, DashboardService, Listen, PageSettings};
use spandrel_service::{EventPublisher, Monitored, Service as _, ServiceInstance};
use spandrel_structure::Structure;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

/// Only ends a hang.
const DEADLINE: Duration = Duration::from_secs(180);

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// A dashboard of the demo, and its bus.
struct Site {
    bus: Bus,
    keys: Keys,
    client: Client,
    parameter: DisplayPublisher<ParameterDisplay>,
    loss: DisplayPublisher<LossDisplay>,
    alert: LatestPublisher<AlertMessage>,
    stop: oneshot::Sender<()>,
    running: JoinHandle<Result<(), DashboardError>>,
}

/// An HTTP client of a dashboard.
struct Client {
    address: SocketAddr,
}

impl std::ops::Deref for Site {
    type Target = Client;

    fn deref(&self) -> &Client {
        &self.client
    }
}

struct Answer {
    status: u16,
    head: String,
    body: String,
}

impl Answer {
    fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.body))
    }

    #[track_caller]
    fn expect_refused(&self, status: u16, told: &str) {
        assert_eq!(self.status, status, "{}", self.body);
        let body = self.json();
        assert!(
            body["error"].as_str().unwrap().contains(told),
            "expected {told:?}, found {body}"
        );
        assert!(!body["allowed"].as_str().unwrap().is_empty());
    }
}

impl Site {
    async fn start() -> Self {
        Self::with(Listen::At("127.0.0.1:0".into()).into()).await
    }

    async fn with(page: PageSettings) -> Self {
        Self::of(page, "").await
    }

    /// Starts a page of the demo with more tables in its structure file.
    async fn of(page: PageSettings, more: &str) -> Self {
        let root = format!(
            "dashboard-{}",
            TcpListener::bind("127.0.0.1:0")
                .await
                .unwrap()
                .local_addr()
                .unwrap()
                .port()
        );
        let config = BusConfig {
            root,
            listen: vec!["tcp/127.0.0.1:0".into()],
            ..BusConfig::default()
        };
        let bus = Bus::open(&config).await.unwrap();
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
        let text = std::fs::read_to_string(&path).unwrap() + more;
        let structure = Structure::parse(&text, &path).unwrap();
        let keys = config.keys(structure.name()).unwrap();
        let parameter = bus
            .publish_display(keys.parameter(&name("storey-2")))
            .await
            .unwrap();
        let loss = bus
            .publish_display(keys.loss(&name("storey-2")))
            .await
            .unwrap();
        let alert = bus
            .publish_latest(keys.alert(&name("storey-2")))
            .await
            .unwrap();
        let plan = DashboardPlan {
            instance: ServiceInstance::new(&bus, name("dashboard")),
            structures: vec![Monitored::new(&structure, keys.clone())],
            page,
        };
        let service = DashboardService::start(&plan).await.unwrap();
        let address = service.address();
        let (stop, stopped) = oneshot::channel::<()>();
        let running = tokio::spawn(service.run(Box::pin(async {
            let _ = stopped.await;
        })));
        Self {
            bus,
            keys,
            client: Client { address },
            parameter,
            loss,
            alert,
            stop,
            running,
        }
    }

    async fn put(&self, time_s: i64, mean: f64) {
        let time_ns = time_s * 1_000_000_000;
        let display =
            ParameterDisplay::of_normal(&name("demo"), &name("storey-2"), time_ns, mean, 1e-4);
        self.parameter.put(&display).await.unwrap();
        let loss = LossDisplay {
            structure: name("demo"),
            parameter: name("storey-2"),
            time_ns,
            loss: 1.0 - mean,
            interval: CredibleInterval::of_normal(1.0 - mean, 1e-4),
            probability_of_loss: if mean < 0.95 { 1.0 } else { 0.0 },
            rule_loss: 0.05,
            rule_credibility: 0.99,
            reference: 1.0,
            reference_std: 0.0,
        };
        self.loss.put(&loss).await.unwrap();
    }

    async fn raise(&self, state: AlertState) {
        let alert = AlertMessage {
            structure: name("demo"),
            parameter: name("storey-2"),
            time_ns: 5_000_000_000,
            state,
            since_ns: None,
            rule_loss: 0.05,
            rule_credibility: 0.99,
            credibility: 1.0,
            loss: Some(0.15),
            loss_interval: None,
            loss_interval_within_record: None,
            mean: 0.85,
            std: 0.01,
            reference: Some(1.0),
            reference_std: Some(0.0),
            acknowledged_by: (state == AlertState::Acknowledged).then(|| "Ada".to_owned()),
            why: "storey-2 <b>has lost</b> 15 %".into(),
            fit: None,
            fit_reasons: spandrel_bus::FitReasons::default(),
            follows_jump: false,
            undecided_because: None,
            revision: 0,
        };
        self.alert.put(&alert).await.unwrap();
    }

    async fn end(self) {
        self.stop.send(()).unwrap();
        tokio::time::timeout(DEADLINE, self.running)
            .await
            .expect("ends in time")
            .unwrap()
            .unwrap();
        self.bus.close().await.unwrap();
    }
}

impl Client {
    async fn request(&self, method: &str, path: &str, headers: &str, body: &str) -> Answer {
        let exchange = async {
            let mut socket = TcpStream::connect(self.address).await.unwrap();
            let host = self.address;
            let length = body.len();
            let request = format!(
                "{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\
                 Content-Length: {length}\r\n{headers}\r\n{body}"
            );
            socket.write_all(request.as_bytes()).await.unwrap();
            let mut text = String::new();
            socket.read_to_string(&mut text).await.unwrap();
            text
        };
        let text = tokio::time::timeout(DEADLINE, exchange)
            .await
            .expect("an answer in time");
        let (head, body) = text.split_once("\r\n\r\n").expect("a head and a body");
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Answer {
            status,
            head: head.to_lowercase(),
            body: body.to_owned(),
        }
    }

    async fn get(&self, path: &str) -> Answer {
        self.request("GET", path, "", "").await
    }

    async fn acknowledge(&self, parameter: &str, headers: &str, body: &str) -> Answer {
        let path = format!("/api/structures/demo/alerts/{parameter}/acknowledge");
        self.request(
            "POST",
            &path,
            &format!("Content-Type: application/json\r\n{headers}"),
            body,
        )
        .await
    }

    async fn annotate(&self, headers: &str, body: &str) -> Answer {
        let headers = format!("Content-Type: application/json\r\n{headers}");
        let path = "/api/structures/demo/annotations";
        self.request("POST", path, &headers, body).await
    }

    /// Queries the structures until the first one satisfies `is_there`.
    async fn wait(&self, what: &str, is_there: impl Fn(&Value) -> bool) -> Value {
        let waited = async {
            loop {
                let found = self.get("/api/structures").await.json()["structures"][0].take();
                if is_there(&found) {
                    return found;
                }
                tokio::task::yield_now().await;
            }
        };
        tokio::time::timeout(DEADLINE, waited)
            .await
            .unwrap_or_else(|_| panic!("waited in vain: {what}"))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn values_on_the_bus_appear_in_the_overview_and_in_the_structure() {
    let site = Site::start().await;
    assert_eq!(
        site.get("/api/structures").await.json()["structures"][0]["level"],
        "learning"
    );
    site.put(5, 0.85).await;
    site.raise(AlertState::Raised).await;
    let seen = site
        .wait("an alarm", |found| {
            found["level"] == "alarm" && !found["worst"].is_null()
        })
        .await;
    assert_eq!(seen["worst"]["parameter"], "storey-2");
    assert_eq!(seen["sentence"], "storey-2 <b>has lost</b> 15 %");
    let whole = site.get("/api/structures/demo").await.json();
    assert_eq!(
        whole["about"]["drawing"]["members"]
            .as_array()
            .unwrap()
            .len(),
        5
    );
    assert_eq!(whole["standing"]["parameters"]["storey-2"]["mean"], 0.85);
    assert_eq!(
        whole["standing"]["series"],
        json!(["parameter/storey-2", "loss/storey-2"])
    );
    let alerts = site.get("/api/alerts?state=raised").await.json();
    assert_eq!(alerts["standing"][0]["parameter"], "storey-2");
    assert!(
        site.get("/api/alerts?state=cleared").await.json()["standing"]
            .as_array()
            .unwrap()
            .is_empty()
    );
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn late_dashboard_queries_the_state_of_the_alerts() {
    let site = Site::start().await;
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = Structure::read(&path).unwrap();
    let plan = DashboardPlan {
        instance: ServiceInstance::new(&site.bus, name("late")),
        structures: vec![Monitored::new(&structure, site.keys.clone())],
        page: Listen::At("127.0.0.1:0".into()).into(),
    };
    let late = DashboardService::start(&plan).await.unwrap();
    let client = Client {
        address: late.address(),
    };
    let (stop, stopped) = oneshot::channel::<()>();
    let running = tokio::spawn(late.run(Box::pin(async {
        let _ = stopped.await;
    })));
    client
        .wait("the alarm that was there before", |found| {
            found["raised"] == 1
        })
        .await;
    stop.send(()).unwrap();
    running.await.unwrap().unwrap();
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn history_is_served_as_json_and_csv() {
    let site = Site::start().await;
    for second in 1..=10 {
        site.put(second, 1.0 - 0.01 * second as f64).await;
    }
    site.wait("all points", |found| found["time_s"] == 10.0)
        .await;
    let path = "/api/structures/demo/history?series=parameter/storey-2&from=3&to=5";
    let span = site.get(path).await.json();
    assert_eq!(span["series"][0]["data"][0], json!([3.0, 4.0, 5.0]));
    assert_eq!(span["kept_from_s"], 1.0);
    let csv = site.get(&format!("{path}&format=csv")).await;
    assert!(
        csv.head.contains("content-type: text/csv") && csv.head.contains("filename=\"demo.csv\""),
        "{}",
        csv.head
    );
    let lines: Vec<&str> = csv.body.lines().collect();
    assert_eq!((lines.len(), &lines[1][..7]), (4, "3,0.97,"));
    site.end().await;
}

/// Regression test: waveforms from before the start of the page were empty, without a reason.
#[tokio::test(flavor = "multi_thread")]
async fn waveforms_from_before_the_start_are_those_of_the_recording() {
    const CHANNELS: u16 = 6;
    let site = Site::start().await;
    let path = "/api/structures/demo/history?series=waveform/floor-1&from=0.5&to=1.5&points=10";
    let span = site.get(path).await.json();
    assert_eq!(span["series"][0]["data"], json!([[], [], []]));
    assert_eq!(
        span["unread_waveforms"],
        "the service ingest does not answer"
    );
    site.get(&format!("{path}&format=csv"))
        .await
        .expect_refused(503, "the service ingest does not answer");

    let stream = NumberedStream {
        key: site.keys.frames(),
        buffer_key: site.keys.recording(),
        source: "ingest".to_owned(),
        epoch: 1,
        first: 0,
        state: StreamState::Running,
        keep: Keep::last(1_000),
    };
    let frames = site.bus.publish_numbered(stream).await.unwrap();
    let value = |frame: u32, channel: u16| f64::from(frame) + 1e3 * f64::from(channel);
    let of_frame = |frame| (0..CHANNELS).map(move |channel| value(frame, channel));
    let block = FrameBlock {
        header: Header {
            source: "ingest".to_owned(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        channels: CHANNELS,
        values: (0..200).flat_map(of_frame).collect(),
        state: StreamState::Running,
    };
    frames.put(block).await.unwrap();
    let span = site.get(path).await.json();
    assert_eq!(span["unread_waveforms"], json!(null));
    let data = &span["series"][0]["data"];
    // Ten samples in each interval. Those of floor-1 are the second channel.
    assert_eq!(data[0].as_array().unwrap().len(), 10);
    assert_eq!(
        (&data[0][1], &data[1][1], &data[2][1]),
        (&json!(0.6), &json!(1060.0), &json!(1069.0))
    );
    assert_eq!(span["kept_from_s"], 0.5);
    let csv = site.get(&format!("{path}&format=csv")).await;
    let lines: Vec<&str> = csv.body.lines().collect();
    assert_eq!((lines.len(), lines[2]), (11, "0.6,1060,1069"));
    // The page reads the samples itself.
    let span = site.get(&format!("{path}&recorded=false")).await.json();
    assert_eq!(span["series"][0]["data"], json!([[], [], []]));

    let at = |from: u32, to: u32| {
        format!(
            "/api/structures/demo/history?series=waveform/floor-1&from={from}&to={to}&format=csv"
        )
    };
    site.get(&at(100, 200))
        .await
        .expect_refused(404, "no samples in this range");
    site.get(&at(0, 10_000))
        .await
        .expect_refused(400, "the range is 10000 s long");
    site.end().await;
}

/// Regression test: replies that came too late were left out, so that a comparison of two ranges
/// without data was a comparison without a difference.
#[tokio::test(flavor = "multi_thread")]
async fn history_states_that_a_service_has_not_replied() {
    let site = Site::start().await;
    let both = "/api/structures/demo/history?series=parameter/storey-2,loss/storey-2&from=0&to=5";
    assert_eq!(site.get(both).await.json()["incomplete"], false);
    let questions = site.bus.questions(site.keys.all_history(), 64).await;
    let questions = questions.unwrap();
    let key = site.keys.history(&name("storey-2"));
    // This service replies to queries for the parameter only.
    let answering = tokio::spawn(async move {
        while let Some(question) = questions.next().await {
            if question.parameters().contains("kind=parameter") {
                question.answer(&key, &past()).await.unwrap();
            }
        }
    });
    let instance = ServiceInstance::new(&site.bus, name("history"));
    let history = spandrel_bus::Service::History;
    let token = instance.announce(history, &site.keys).await.unwrap();
    let replied = async {
        loop {
            let span = site.get(both).await.json();
            if span["incomplete"] == true && span["series"][0]["data"][0] == json!([1.0]) {
                return;
            }
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(DEADLINE, replied)
        .await
        .expect("the reply for the parameter, and none for its loss");
    let one = "/api/structures/demo/history?series=parameter/storey-2&from=0&to=5";
    let span = site.get(one).await.json();
    assert_eq!(span["incomplete"], false, "{span}");
    site.get(&format!("{both}&format=csv"))
        .await
        .expect_refused(503, "the history did not answer in time");
    assert_eq!(site.get(&format!("{one}&format=csv")).await.status, 200);
    drop(token);
    answering.abort();
    site.end().await;
}

/// One value of storey 2, as the history replies.
fn past() -> HistorySpan {
    HistorySpan {
        structure: name("demo"),
        kind: "parameter".to_owned(),
        name: "storey-2".to_owned(),
        resolution_s: None,
        kept_from_s: Some(1.0),
        rows: HistoryRows {
            time_s: vec![1.0],
            count: vec![1],
            mean: vec![0.9],
            std: vec![0.02],
            spread: vec![0.0],
            least: vec![0.9],
            largest: vec![0.9],
            low: vec![0.86],
            high: vec![0.94],
            probability_of_loss: vec![0.0],
        },
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn log_of_a_period_states_that_no_history_was_read() {
    let site = Site::start().await;
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    let log = site.get("/api/structures/demo/log").await.json();
    assert_eq!(log["history"], "absent");
    assert_eq!(log["cut_at_s"], Value::Null);
    assert_eq!(log["changes"][0]["parameter"], "storey-2");
    let before = site.get("/api/structures/demo/log?to=-1").await.json();
    assert_eq!(before["changes"], json!([]));
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn acknowledgement_is_published_with_name_and_note() {
    let site = Site::start().await;
    let heard = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(409, "the alert of storey-2 is not known");
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    let sent = site
        .acknowledge("storey-2", "", r#"{"who":" Ada ","note":"on my way"}"#)
        .await;
    assert_eq!(
        (sent.status, sent.json()),
        (202, json!({"sent": true, "state": null})),
        "nobody has answered"
    );
    let (key, found) = tokio::time::timeout(DEADLINE, heard.messages().recv_async())
        .await
        .unwrap()
        .unwrap();
    assert_eq!(key, site.keys.acknowledge(&name("storey-2")));
    assert_eq!(
        (found.who.as_str(), found.note.as_str()),
        ("Ada", "on my way")
    );
    let taking = async {
        heard.messages().recv_async().await.unwrap();
        site.raise(AlertState::Acknowledged).await;
    };
    let (sent, ()) = tokio::join!(site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#), taking);
    assert_eq!(
        (sent.status, sent.json()),
        (200, json!({"sent": true, "state": "acknowledged"}))
    );
    site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(409, "is acknowledged");
    assert!(heard.messages().is_empty(), "what is refused is not sent");
    site.end().await;
}

/// Regression test: a request for the alerts just after the confirmation still returned the raised
/// state.
#[tokio::test(flavor = "multi_thread")]
async fn confirmed_acknowledgement_is_in_the_alerts_at_once() {
    let site = Site::start().await;
    let heard = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    for _ in 0..5 {
        site.raise(AlertState::Raised).await;
        site.wait("an alarm", |found| found["raised"] == 1).await;
        let taking = async {
            heard.messages().recv_async().await.unwrap();
            site.raise(AlertState::Acknowledged).await;
        };
        let (sent, ()) = tokio::join!(
            site.acknowledge("storey-2", "", r#"{"who":"Ada","note":"seen"}"#),
            taking
        );
        assert_eq!(sent.status, 200);
        let alerts = site.get("/api/alerts").await.json();
        let standing = &alerts["standing"][0];
        assert_eq!(
            (&standing["state"], &standing["note"]),
            (&json!("acknowledged"), &json!("seen")),
            "{alerts}"
        );
        assert_eq!(
            site.get("/api/alerts?state=raised").await.json()["standing"],
            json!([])
        );
    }
    site.end().await;
}

/// Regression test: the interface reported the acknowledgement as sent although the router dropped
/// it.
#[tokio::test(flavor = "multi_thread")]
async fn error_names_the_roles_if_the_router_would_drop_an_acknowledgement() {
    let why = "role dashboard may not acknowledge; roles that may: server, operator";
    let listen = Listen::At("127.0.0.1:0".into()).into();
    let page = PageSettings {
        cannot_acknowledge: Some(why.to_owned()),
        ..listen
    };
    let site = Site::of(page, JUDGE).await;
    let heard = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(403, why);
    assert!(heard.messages().is_empty());
    site.annotate("", r#"{"kind":"other","text":"x","who":"Ada"}"#)
        .await
        .expect_refused(403, why);
    site.end().await;
}

/// Makes storey 2 of the demo a judged quantity.
const JUDGE: &str = "\n[judge]\n[[judge.quantity]]\nname = \"storey-2\"\nis = \"stiffness\"\n";

#[tokio::test(flavor = "multi_thread")]
async fn annotation_is_published_and_confirmed_by_the_service_judge() {
    let site = Site::of(Listen::At("127.0.0.1:0".into()).into(), JUDGE).await;
    let key = site.keys.annotation();
    let heard = site.bus.subscribe::<Annotation>(key, 8).await.unwrap();
    let events = EventPublisher::declare(&site.bus, &site.keys)
        .await
        .unwrap();
    let keeping = async {
        let (_, annotation) = heard.messages().recv_async().await.unwrap();
        let event = Event {
            structure: name("demo"),
            time_ns: annotation.from_ns,
            kind: EventKind::Annotation,
            subject: "storey-2".to_owned(),
            what: annotation.what(),
            why: annotation.why(),
        };
        events.put(&event).await.unwrap();
        annotation
    };
    let body = r#"{"kind":"repair","text":"new bearings","who":" Ada ","quantity":"storey-2",
        "effect":"new-reference","from":"2025-01-01"}"#;
    site.annotate("", body)
        .await
        .expect_refused(503, "the service judge does not run");
    let instance = ServiceInstance::new(&site.bus, name("judge"));
    let judge = spandrel_bus::Service::Judge;
    let token = instance.announce(judge, &site.keys).await.unwrap();
    let sending = async {
        loop {
            let sent = site.annotate("", body).await;
            if sent.status != 503 {
                return sent;
            }
        }
    };
    let (sent, annotation) = tokio::join!(sending, keeping);
    assert_eq!(
        (sent.status, sent.json()),
        (200, json!({"sent": true, "kept": true}))
    );
    let expected = Annotation {
        structure: name("demo"),
        quantity: Some(name("storey-2")),
        time_ns: annotation.time_ns,
        from_ns: time_ns("2025-01-01").unwrap(),
        to_ns: None,
        kind: AnnotationKind::Repair,
        effect: AnnotationEffect::NewReference,
        who: "Ada".to_owned(),
        text: "new bearings".to_owned(),
    };
    assert_eq!(annotation, expected);

    let refused = async |body: &str, status: u16, told: &str| {
        let answer = site.annotate("", body).await;
        answer.expect_refused(status, told);
    };
    refused(
        r#"{"kind":"other","text":" ","who":"Ada"}"#,
        400,
        "text is empty",
    )
    .await;
    refused(
        r#"{"kind":"other","text":"x","who":"Ada","from":"2200-01-01"}"#,
        400,
        "from is in the future",
    )
    .await;
    refused(
        r#"{"kind":"party","text":"x","who":"Ada"}"#,
        422,
        "unknown variant `party`",
    )
    .await;
    let huge = format!(
        r#"{{"kind":"other","text":"{}","who":"Ada"}}"#,
        "a".repeat(20_000)
    );
    refused(&huge, 413, "").await;
    let other = "Origin: https://example.org\r\n";
    site.annotate(other, body)
        .await
        .expect_refused(403, "another site");
    assert!(heard.messages().is_empty(), "what is refused is not sent");
    drop(token);
    site.end().await;
}

/// Returns the judgement of storey 2, which has lost 5 % of its stiffness.
fn lasting_loss() -> JudgementDisplay {
    let text = r#"{"structure":"demo","quantity":"storey-2","time_ns":9,"day_ns":0,"epoch_ns":8,
        "epochs":96,"measured":true,"state":"judged","change":{"kind":"lasting-loss","found_ns":0,
        "since_ns":0,"loss":0.05,"interval":{"level":0.95,"low":0.04,"high":0.06}},
        "sentence":"storey-2 has lost 5.0 % of stiffness [4.0, 6.0].","expectation":null,
        "false_alarms_per_year":0.1}"#;
    serde_json::from_str(text).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn lasting_loss_is_an_alert_that_is_acknowledged_as_an_annotation() {
    let site = Site::of(Listen::At("127.0.0.1:0".into()).into(), JUDGE).await;
    let key = site.keys.judgement(&name("storey-2"));
    let judgements = site.bus.publish_display(key).await.unwrap();
    let key = site.keys.annotation();
    let heard = site.bus.subscribe::<Annotation>(key, 8).await.unwrap();
    let events = EventPublisher::declare(&site.bus, &site.keys)
        .await
        .unwrap();
    let path = "/api/structures/demo/judgements/storey-2/acknowledge";
    let json_body = "Content-Type: application/json\r\n";
    let body = r#"{"who":"Ada","note":"on my way"}"#;
    site.request("POST", path, json_body, body)
        .await
        .expect_refused(409, "no lasting loss of storey-2 is known");
    judgements.put(&lasting_loss()).await.unwrap();
    let found = site.wait("an alarm", |found| found["raised"] == 1).await;
    assert_eq!(found["level"], "alarm");
    let alerts = site.get("/api/alerts?state=raised").await.json();
    let alert = &alerts["standing"][0];
    assert_eq!(
        (&alert["kind"], &alert["parameter"]),
        (&json!("lasting-loss"), &json!("storey-2"))
    );
    let none = site.get("/api/alerts?state=acknowledged").await.json();
    assert_eq!(none["standing"], json!([]));

    let instance = ServiceInstance::new(&site.bus, name("judge"));
    let judge = spandrel_bus::Service::Judge;
    let token = instance.announce(judge, &site.keys).await.unwrap();
    let keeping = async {
        let (_, annotation) = heard.messages().recv_async().await.unwrap();
        let event = Event {
            structure: name("demo"),
            time_ns: annotation.from_ns,
            kind: EventKind::Annotation,
            subject: "storey-2".to_owned(),
            what: annotation.what(),
            why: annotation.why(),
        };
        events.put(&event).await.unwrap();
        annotation
    };
    let sending = async {
        loop {
            let sent = site.request("POST", path, json_body, body).await;
            if sent.status != 503 {
                return sent;
            }
        }
    };
    let (sent, annotation) = tokio::join!(sending, keeping);
    assert_eq!(
        (sent.status, sent.json()),
        (200, json!({"sent": true, "state": "acknowledged"}))
    );
    assert_eq!(
        (
            annotation.effect,
            annotation.quantity.clone(),
            annotation.why()
        ),
        (
            AnnotationEffect::Seen,
            Some(name("storey-2")),
            "Ada: on my way".to_owned()
        )
    );
    drop(token);
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_name_the_mistake_and_the_allowed_values() {
    let site = Site::start().await;
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    site.get("/api/structures/tower")
        .await
        .expect_refused(404, "structure `tower` is not known");
    site.get("/api/nothing")
        .await
        .expect_refused(404, "unknown path /api/nothing");
    site.request("POST", "/api/structures", "", "")
        .await
        .expect_refused(405, "does not support POST");
    let history = "/api/structures/demo/history";
    site.get(&format!("{history}?points=none"))
        .await
        .expect_refused(400, "points");
    site.get(&format!("{history}?until=5"))
        .await
        .expect_refused(400, "until");
    site.get(&format!("{history}?series=parameter/roof"))
        .await
        .expect_refused(400, "parameter/roof");
    site.get("/api/structures/demo/log?most=0")
        .await
        .expect_refused(400, "most is 0");
    site.get("/api/alerts?state=angry")
        .await
        .expect_refused(400, "angry");
    site.get("/api/live?structure=tower")
        .await
        .expect_refused(404, "tower");
    site.get("/api/live").await.expect_refused(400, "");
    site.acknowledge("roof", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(404, "parameter `roof`");
    site.acknowledge("storey-2", "", r#"{"who":"  "}"#)
        .await
        .expect_refused(400, "who is empty");
    site.acknowledge("storey-2", "", r#"{"note":"x"}"#)
        .await
        .expect_refused(422, "who");
    site.acknowledge("storey-2", "", "{")
        .await
        .expect_refused(400, "");
    let long = format!(r#"{{"who":"{}"}}"#, "a".repeat(101));
    site.acknowledge("storey-2", "", &long)
        .await
        .expect_refused(400, "who is too long");
    let huge = format!(r#"{{"who":"Ada","note":"{}"}}"#, "a".repeat(20_000));
    site.acknowledge("storey-2", "", &huge)
        .await
        .expect_refused(413, "");
    let other = "Origin: https://example.org\r\n";
    site.acknowledge("storey-2", other, r#"{"who":"Ada"}"#)
        .await
        .expect_refused(403, "another site");
    let plain = "/api/structures/demo/alerts/storey-2/acknowledge";
    site.request("POST", plain, "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(415, "");
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn content_security_policy_allows_only_own_files() {
    let site = Site::start().await;
    let page = site.get("/").await;
    assert_eq!(page.status, 200);
    assert!(page.body.contains("<title>Spandrel</title>"));
    assert!(
        page.head
            .contains("content-security-policy: default-src 'none'; script-src 'self';"),
        "{}",
        page.head
    );
    assert!(page.head.contains("x-content-type-options: nosniff"));
    for (path, content) in [
        ("/app.js", "text/javascript"),
        ("/uplot.js", "text/javascript"),
        ("/style.css", "text/css"),
    ] {
        let file = site.get(path).await;
        assert!(
            file.status == 200 && file.head.contains(content),
            "{path}: {}",
            file.head
        );
    }
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn socket_sends_the_present_state_and_then_each_new_point() {
    let site = Site::start().await;
    site.put(1, 1.0).await;
    site.wait("the first point", |found| found["time_s"] == 1.0)
        .await;
    let address = format!("ws://{}/api/live?structure=demo", site.address);
    let (mut socket, _) = tokio_tungstenite::connect_async(address).await.unwrap();
    let mut next = async || -> Value {
        loop {
            let message = tokio::time::timeout(DEADLINE, socket.next());
            let message = message.await.unwrap().unwrap().unwrap();
            if !message.is_ping() {
                return serde_json::from_str(message.to_text().unwrap()).unwrap();
            }
        }
    };
    let overview = next().await;
    assert_eq!(
        (&overview["type"], &overview["structures"][0]["name"]),
        (&json!("overview"), &json!("demo"))
    );
    let standing = next().await;
    assert_eq!(
        (
            &standing["type"],
            &standing["standing"]["parameters"]["storey-2"]["mean"]
        ),
        (&json!("structure"), &json!(1.0))
    );
    site.put(2, 0.9).await;
    let points = loop {
        let message = next().await;
        if message["type"] == "points" {
            break message;
        }
    };
    // The client fetches the earlier point from the history interface.
    assert_eq!(
        points["series"]["parameter/storey-2"]["data"][0],
        json!([2.0])
    );
    assert_eq!(
        points["series"]["parameter/storey-2"]["data"][1],
        json!([0.9])
    );
    site.end().await;
    // A stop of the dashboard closes the socket.
    let ended = async { while let Some(Ok(_)) = socket.next().await {} };
    tokio::time::timeout(DEADLINE, ended)
        .await
        .expect("the socket ends");
}

#[tokio::test(flavor = "multi_thread")]
async fn requested_address_in_use_is_an_error() {
    let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let site = Site::start().await;
    let plan = DashboardPlan {
        instance: ServiceInstance::new(&site.bus, name("other")),
        structures: Vec::new(),
        page: Listen::At(address.clone()).into(),
    };
    let failed = DashboardService::start(&plan).await;
    let told = failed.unwrap_err().to_string();
    assert!(told.contains(&address), "{told}");
    site.end().await;
}
