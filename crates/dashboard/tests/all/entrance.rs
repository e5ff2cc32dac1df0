//! Tests of admission with tokens and sessions, over real sockets with and without TLS.

use futures_util::StreamExt as _;
use rcgen::{CertificateParams, KeyPair};
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use serde_json::Value;
use spandrel_bus::{Acknowledgement, AlertMessage, AlertState, Bus, BusConfig, Keys, Name};
use spandrel_dashboard::{
    DashboardError, DashboardPlan, DashboardService, Listen, PageCertificate, PageRole,
    PageSettings, Tokens,
};
use spandrel_service::{Monitored, Service as _, ServiceInstance};
use spandrel_structure::Structure;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio_rustls::TlsConnector;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

/// Only ends a hang.
const DEADLINE: Duration = Duration::from_secs(180);

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// Whether a page has a certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scheme {
    Http,
    Https,
}

/// Files of a page: a certificate for 127.0.0.1, and tokens of a viewer and an operator.
struct Files {
    folder: tempfile::TempDir,
    certificate: CertificateDer<'static>,
    viewer: String,
    operator: String,
}

impl Files {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["127.0.0.1".to_owned()]).unwrap();
        let certificate = params.self_signed(&key).unwrap();
        std::fs::write(folder.path().join("page.pem"), certificate.pem()).unwrap();
        std::fs::write(folder.path().join("page.key"), key.serialize_pem()).unwrap();
        let tokens = folder.path().join("tokens.json");
        let viewer = Tokens::issue(&tokens, name("ada"), PageRole::Viewer, false).unwrap();
        let operator = Tokens::issue(&tokens, name("grace"), PageRole::Operator, false).unwrap();
        Self {
            folder,
            certificate: certificate.der().clone(),
            viewer,
            operator,
        }
    }

    fn certificate(&self) -> PageCertificate {
        let at = |file: &str| self.folder.path().join(file);
        PageCertificate {
            certificate: at("page.pem"),
            key: at("page.key"),
        }
    }

    fn tokens(&self) -> Tokens {
        Tokens::read(&self.folder.path().join("tokens.json")).unwrap()
    }
}

async fn start(
    bus: &Bus,
    structures: Vec<Monitored>,
    page: PageSettings,
) -> Result<DashboardService, DashboardError> {
    let plan = DashboardPlan {
        instance: ServiceInstance::new(bus, name("page")),
        structures,
        page,
    };
    DashboardService::start(&plan).await
}

/// A running page of the demo.
struct Site {
    files: Files,
    scheme: Scheme,
    bus: Bus,
    keys: Keys,
    address: SocketAddr,
    stop: oneshot::Sender<()>,
    running: JoinHandle<Result<(), DashboardError>>,
}

struct Answer {
    status: u16,
    head: String,
    body: String,
}

impl Answer {
    fn header(&self, name: &str) -> Option<&str> {
        self.head
            .lines()
            .find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
    }
}

async fn bus() -> (Bus, BusConfig) {
    let port = TcpListener::bind("127.0.0.1:0")
        .await
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let root = format!("entrance-{port}");
    let config = BusConfig {
        root,
        listen: vec!["tcp/127.0.0.1:0".into()],
        ..BusConfig::default()
    };
    (Bus::open(&config).await.unwrap(), config)
}

fn demo() -> Structure {
    Structure::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"))
        .unwrap()
}

impl Site {
    async fn start(scheme: Scheme) -> Self {
        let files = Files::new();
        let page = PageSettings {
            listen: Listen::At("127.0.0.1:0".into()),
            certificate: (scheme == Scheme::Https).then(|| files.certificate()),
            tokens: files.tokens(),
            cannot_acknowledge: None,
        };
        let (bus, config) = bus().await;
        let structure = demo();
        let keys = config.keys(structure.name()).unwrap();
        let service = start(&bus, vec![Monitored::new(&structure, keys.clone())], page)
            .await
            .unwrap();
        let address = service.address();
        let (stop, stopped) = oneshot::channel::<()>();
        let running = tokio::spawn(service.run(Box::pin(async {
            let _ = stopped.await;
        })));
        Self {
            files,
            scheme,
            bus,
            keys,
            address,
            stop,
            running,
        }
    }

    async fn request(&self, method: &str, path: &str, headers: &str, body: &str) -> Answer {
        let (host, length) = (self.address, body.len());
        let text = format!(
            "{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\
             Content-Type: application/json\r\n\
             Content-Length: {length}\r\n{headers}\r\n{body}"
        );
        let socket = TcpStream::connect(self.address).await.unwrap();
        let exchanged = async {
            match self.scheme {
                Scheme::Http => exchange(socket, &text).await,
                Scheme::Https => {
                    let host = ServerName::try_from("127.0.0.1").unwrap();
                    exchange(self.connector().connect(host, socket).await.unwrap(), &text).await
                }
            }
        };
        let text = tokio::time::timeout(DEADLINE, exchanged)
            .await
            .expect("an answer in time");
        let (head, body) = text.split_once("\r\n\r\n").expect("a head and a body");
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Answer {
            status,
            head: head.to_owned(),
            body: body.to_owned(),
        }
    }

    fn connector(&self) -> TlsConnector {
        let mut roots = RootCertStore::empty();
        roots.add(self.files.certificate.clone()).unwrap();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap();
        TlsConnector::from(Arc::new(
            config.with_root_certificates(roots).with_no_client_auth(),
        ))
    }

    /// Returns the status of a request with this token.
    async fn status(&self, method: &str, path: &str, token: &str) -> u16 {
        let headers = format!("Authorization: Bearer {token}\r\n");
        self.request(method, path, &headers, "{\"who\":\"Grace\"}")
            .await
            .status
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

async fn exchange(mut socket: impl AsyncRead + AsyncWrite + Unpin, request: &str) -> String {
    socket.write_all(request.as_bytes()).await.unwrap();
    let mut text = Vec::new();
    // The server may close a connection without a TLS close message.
    let _ = socket.read_to_end(&mut text).await;
    String::from_utf8(text).unwrap()
}

const ACKNOWLEDGE: &str = "/api/structures/demo/alerts/storey-2/acknowledge";

#[tokio::test(flavor = "multi_thread")]
async fn only_the_files_of_the_page_are_served_without_a_token() {
    let site = Site::start(Scheme::Https).await;
    for path in ["/", "/app.js", "/style.css"] {
        let answer = site.request("GET", path, "", "").await;
        assert_eq!(answer.status, 200, "{path}");
        assert!(
            answer
                .header("content-security-policy")
                .unwrap()
                .contains("default-src 'none'")
        );
        assert_eq!(
            answer.header("strict-transport-security"),
            Some("max-age=31536000")
        );
        assert_eq!(answer.header("x-frame-options"), Some("DENY"));
        assert_eq!(answer.header("x-content-type-options"), Some("nosniff"));
    }
    for path in [
        "/api/structures",
        "/api/structures/demo",
        "/api/structures/demo/samples?from=0&to=1&format=csv",
        "/api/alerts",
        "/api/live",
        "/api/openapi.json",
        "/metrics",
    ] {
        let answer = site.request("GET", path, "", "").await;
        assert_eq!(answer.status, 401, "{path}");
        assert!(!answer.body.contains("storey"), "{}", answer.body);
    }
    assert_eq!(
        site.request("POST", ACKNOWLEDGE, "", "{\"who\":\"x\"}")
            .await
            .status,
        401
    );
    assert_eq!(
        site.request("GET", "/api/session", "", "").await.status,
        401
    );
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_reads_and_an_operator_acknowledges_too() {
    let site = Site::start(Scheme::Https).await;
    let (viewer, operator) = (site.files.viewer.clone(), site.files.operator.clone());
    for token in [&viewer, &operator] {
        assert_eq!(site.status("GET", "/api/structures", token).await, 200);
        assert_eq!(site.status("GET", "/metrics", token).await, 200);
        // Monitoring tools ask with HEAD whether a page answers.
        assert_eq!(site.status("HEAD", "/api/structures", token).await, 200);
    }
    assert_eq!(site.status("POST", ACKNOWLEDGE, &viewer).await, 403);
    let annotations = "/api/structures/demo/annotations";
    assert_eq!(site.status("POST", annotations, &viewer).await, 403);
    assert_eq!(
        site.status("POST", ACKNOWLEDGE, &operator).await,
        409,
        "there is no alert yet"
    );
    let alert = site
        .bus
        .publish_latest(site.keys.alert(&name("storey-2")))
        .await
        .unwrap();
    let seen = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    alert.put(&raised()).await.unwrap();
    let sent = async {
        while site.status("POST", ACKNOWLEDGE, &operator).await != 202 {
            tokio::task::yield_now().await;
        }
        seen.messages().recv_async().await.unwrap().1
    };
    let acknowledgement = tokio::time::timeout(DEADLINE, sent)
        .await
        .expect("an acknowledgement");
    assert_eq!(
        acknowledgement.who, "Grace (grace)",
        "what somebody calls themselves, and whose token it is"
    );
    site.end().await;
}

fn raised() -> AlertMessage {
    AlertMessage {
        structure: name("demo"),
        parameter: name("storey-2"),
        time_ns: 5_000_000_000,
        state: AlertState::Raised,
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
        acknowledged_by: None,
        why: "storey-2 has lost 15 %".into(),
        fit: None,
        fit_reasons: spandrel_bus::FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn browser_sends_its_token_once() {
    for scheme in [Scheme::Http, Scheme::Https] {
        let site = Site::start(scheme).await;
        let body = format!("{{\"token\":\"{}\"}}", site.files.viewer);
        let foreign = site
            .request(
                "POST",
                "/api/session",
                "Origin: https://elsewhere.example\r\n",
                &body,
            )
            .await;
        assert_eq!(foreign.status, 403);
        let entered = site.request("POST", "/api/session", "", &body).await;
        assert_eq!(entered.status, 200, "{}", entered.body);
        let who: Value = serde_json::from_str(&entered.body).unwrap();
        assert_eq!(
            (who["name"].as_str(), who["role"].as_str()),
            (Some("ada"), Some("viewer"))
        );
        let cookie = entered.header("set-cookie").unwrap();
        assert_eq!(
            cookie.contains("Secure"),
            scheme == Scheme::Https,
            "{cookie}"
        );
        assert!(
            cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"),
            "{cookie}"
        );
        assert!(!cookie.contains(&site.files.viewer) && !entered.body.contains(&site.files.viewer));
        let cookie = format!("Cookie: {}\r\n", cookie.split(';').next().unwrap());
        assert_eq!(
            site.request("GET", "/api/structures", &cookie, "")
                .await
                .status,
            200
        );
        assert_eq!(
            site.request("POST", ACKNOWLEDGE, &cookie, "{\"who\":\"x\"}")
                .await
                .status,
            403
        );
        assert_eq!(
            site.request("DELETE", "/api/session", &cookie, "")
                .await
                .status,
            200
        );
        assert_eq!(
            site.request("GET", "/api/structures", &cookie, "")
                .await
                .status,
            401
        );
        site.end().await;
    }
}

/// An attacker on the network can change a page without TLS, also one of the same host.
#[tokio::test(flavor = "multi_thread")]
async fn a_page_over_tls_rejects_its_own_origin_without_tls() {
    let site = Site::start(Scheme::Https).await;
    let body = format!("{{\"token\":\"{}\"}}", site.files.viewer);
    for (scheme, expected) in [("http", 403), ("https", 200)] {
        let origin = format!("Origin: {scheme}://{}\r\n", site.address);
        let entered = site.request("POST", "/api/session", &origin, &body).await;
        assert_eq!(entered.status, expected, "{origin}{}", entered.body);
    }
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn socket_closes_when_the_session_of_its_browser_ends() {
    let site = Site::start(Scheme::Http).await;
    let entered = site
        .request(
            "POST",
            "/api/session",
            "",
            &format!("{{\"token\":\"{}\"}}", site.files.viewer),
        )
        .await;
    let cookie = entered
        .header("set-cookie")
        .unwrap()
        .split(';')
        .next()
        .unwrap()
        .to_owned();
    let mut listening = Vec::new();
    for (name, value) in [
        ("cookie", cookie.clone()),
        ("authorization", format!("Bearer {}", site.files.viewer)),
    ] {
        let mut request = format!("ws://{}/api/live", site.address)
            .into_client_request()
            .unwrap();
        request.headers_mut().insert(name, value.parse().unwrap());
        let (mut socket, _) = tokio_tungstenite::connect_async(request).await.unwrap();
        assert!(matches!(next(&mut socket).await, Message::Text(_)));
        listening.push(socket);
    }
    assert_eq!(
        site.request(
            "DELETE",
            "/api/session",
            &format!("Cookie: {cookie}\r\n"),
            ""
        )
        .await
        .status,
        200
    );
    let why = loop {
        if let Message::Close(why) = next(&mut listening[0]).await {
            break why.unwrap();
        }
    };
    assert_eq!(
        (why.code, why.reason.as_str()),
        (CloseCode::Policy, "the session has ended")
    );
    // A connection with a token has no session that could end.
    for _ in 0..10 {
        assert!(matches!(next(&mut listening[1]).await, Message::Text(_)));
    }
    drop(listening);
    site.end().await;
}

/// Returns the next message that is not a ping.
async fn next(socket: &mut WebSocketStream<MaybeTlsStream<TcpStream>>) -> Message {
    loop {
        let message = tokio::time::timeout(DEADLINE, socket.next());
        let message = message.await.expect("a message in time").unwrap().unwrap();
        if !message.is_ping() {
            return message;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_tokens_are_rejected_and_then_limited() {
    let site = Site::start(Scheme::Http).await;
    let wrong = format!("{}0", site.files.operator);
    let mut statuses = Vec::new();
    for _ in 0..12 {
        statuses.push(site.status("GET", "/api/structures", &wrong).await);
    }
    assert_eq!(statuses[..10], [401; 10], "{statuses:?}");
    assert!(statuses[10..].contains(&429), "{statuses:?}");
    let answer = site
        .request("POST", "/api/session", "", "{\"token\":\"wrong\"}")
        .await;
    assert_eq!(answer.status, 429);
    assert!(
        answer
            .header("retry-after")
            .unwrap()
            .parse::<u64>()
            .unwrap()
            >= 1
    );
    let body = site
        .request(
            "POST",
            "/api/session",
            "",
            "{\"tokens\":\"secret-in-the-wrong-field\"}",
        )
        .await
        .body;
    assert!(!body.contains("secret-in-the-wrong-field"), "{body}");
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn plain_http_receives_no_reply_if_there_is_a_certificate() {
    let site = Site::start(Scheme::Https).await;
    let mut socket = TcpStream::connect(site.address).await.unwrap();
    socket
        .write_all(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        .await
        .unwrap();
    let mut answer = Vec::new();
    let _ = tokio::time::timeout(DEADLINE, socket.read_to_end(&mut answer))
        .await
        .expect("the connection ends");
    assert!(
        !answer.starts_with(b"HTTP"),
        "{}",
        String::from_utf8_lossy(&answer)
    );
    // Connections that never start a handshake block no other connection.
    let mut idle = Vec::new();
    for _ in 0..32 {
        idle.push(TcpStream::connect(site.address).await.unwrap());
    }
    assert_eq!(site.request("GET", "/", "", "").await.status, 200);
    drop(idle);
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn addresses_beyond_this_machine_require_certificate_and_tokens() {
    let files = Files::new();
    let (bus, _) = bus().await;
    for (certificate, tokens, missing) in [
        (None, Tokens::default(), "no certificate"),
        (None, files.tokens(), "no certificate"),
        (Some(files.certificate()), Tokens::default(), "no token"),
    ] {
        for address in ["0.0.0.0:0", "[::]:0"] {
            let page = PageSettings {
                listen: Listen::At(address.into()),
                certificate: certificate.clone(),
                tokens: tokens.clone(),
                cannot_acknowledge: None,
            };
            let error = start(&bus, Vec::new(), page).await.map(|_| ()).unwrap_err();
            let told = error.to_string();
            assert!(told.contains(address) && told.contains(missing), "{told}");
        }
    }
    let page = PageSettings {
        listen: Listen::At("0.0.0.0:0".into()),
        certificate: Some(files.certificate()),
        tokens: files.tokens(),
        cannot_acknowledge: None,
    };
    start(&bus, Vec::new(), page).await.unwrap();
    bus.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn foreign_host_names_are_rejected_without_tokens() {
    let (bus, config) = bus().await;
    let structure = demo();
    let keys = config.keys(structure.name()).unwrap();
    let page = Listen::At("127.0.0.1:0".into()).into();
    let service = start(&bus, vec![Monitored::new(&structure, keys)], page)
        .await
        .unwrap();
    let address = service.address();
    let (stop, stopped) = oneshot::channel::<()>();
    let running = tokio::spawn(service.run(Box::pin(async {
        let _ = stopped.await;
    })));
    let ask = async |host: &str| {
        let request =
            format!("GET /api/structures HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
        let text = exchange(TcpStream::connect(address).await.unwrap(), &request).await;
        text.split(' ').nth(1).unwrap().parse::<u16>().unwrap()
    };
    for host in ["127.0.0.1:8080", "localhost", "[::1]:80", "127.0.0.1"] {
        assert_eq!(ask(host).await, 200, "{host}");
    }
    for host in [
        "rebound.example",
        "rebound.example:8080",
        "127.0.0.1.example",
        "",
    ] {
        assert_eq!(ask(host).await, 403, "{host}");
    }
    stop.send(()).unwrap();
    running.await.unwrap().unwrap();
    bus.close().await.unwrap();
}
