//! Tests of the HTTP interface and the WebSocket, over a real Zenoh session and a real socket.
//!
//! Each module tests one subject. The page, its client and its bus are here, for all of them.

mod acknowledgements;
mod annotations;
mod history;
mod overview;
mod requests;
mod socket;

use serde_json::Value;
use spandrel_bus::{
    AlertMessage, AlertState, Bus, BusConfig, CredibleInterval, DisplayPublisher, Keys,
    LatestPublisher, LossDisplay, Name, ParameterDisplay,
};
use spandrel_dashboard::{DashboardError, DashboardPlan, DashboardService, Listen, PageSettings};
use spandrel_service::{Monitored, Service as _, ServiceInstance};
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

/// Makes storey 2 of the demo a judged quantity.
const JUDGE: &str = "\n[judge]\n[[judge.quantity]]\nname = \"storey-2\"\nis = \"stiffness\"\n";

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
