//! Requests to the page, and messages on its WebSocket.

use super::table::{Table, code};
use crate::support::{DEADLINE, Process, Site, spandrel, two_storeys, within};
use futures_util::{SinkExt, StreamExt};
use std::io::{Read, Write};
use std::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;

/// A served page with its process.
struct Page {
    _process: Process,
    address: String,
}

impl Page {
    fn start(process: Process) -> Self {
        process.wait_for_output("the address of the page", |said| {
            said.contains("page: http")
        });
        let output = process.output();
        let address = output
            .split_once("http://")
            .unwrap()
            .1
            .split('/')
            .next()
            .unwrap()
            .to_owned();
        Self {
            _process: process,
            address,
        }
    }

    /// Sends bytes, and returns the status and text of the reply, or `closed` if the connection
    /// closes without a reply.
    fn send(&self, request: &[u8]) -> String {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        let _ = stream.write_all(request); // a reply may precede the last byte
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer); // data before a reset counts
        let answer = String::from_utf8_lossy(&answer).into_owned();
        let Some(status) = answer
            .strip_prefix("HTTP/1.1 ")
            .and_then(|rest| rest.get(..3))
        else {
            return "closed".to_owned();
        };
        let body = answer.split_once("\r\n\r\n").map_or("", |(_, body)| body);
        match serde_json::from_str::<serde_json::Value>(body) {
            Ok(body) if body["error"].is_string() => {
                let (error, allowed) = (
                    body["error"].as_str().unwrap(),
                    body["allowed"].as_str().unwrap(),
                );
                format!("{status}: {error}, {allowed}")
            }
            Ok(_) | Err(_) => status.to_owned(),
        }
    }

    fn request(&self, method: &str, path: &str, headers: &str, body: &str) -> String {
        let host = if headers.contains("Host:") {
            String::new()
        } else {
            format!("Host: {}\r\n", self.address)
        };
        let length = body.len();
        let head = format!(
            "{method} {path} HTTP/1.1\r\n{host}Connection: close\r\nContent-Length: {length}\r\n"
        );
        self.send(format!("{head}{headers}\r\n{body}").as_bytes())
    }

    /// Returns `true` if the page still answers.
    fn is_alive(&self) -> bool {
        self.request("GET", "/health/live", "", "")
            .starts_with("200")
    }

    /// Adds a request whose reply must begin with a status and contain `told`. The page must answer
    /// the next request.
    fn add(&self, table: &mut Table, given: &str, (status, told): (&str, &[&str]), observed: &str) {
        let is_told = told.iter().all(|part| observed.contains(part));
        let named: Vec<String> = told.iter().map(|part| code(part)).collect();
        let naming = if named.is_empty() {
            String::new()
        } else {
            format!(", naming {}", named.join(", "))
        };
        let is_right = observed.starts_with(status) && is_told && self.is_alive();
        table.add(given, &format!("{status}{naming}"), observed, is_right);
    }
}

/// A request: description; method, path, headers and body; status of the reply and what it names.
type Asked<'a> = (&'a str, [&'a str; 4], (&'a str, &'a [&'a str]));

pub async fn all(table: &mut Table) {
    let site = Site::with(&two_storeys(""));
    let page = Page::start(Process::start(
        site.listening("run").args(["--http", "127.0.0.1:0"]),
    ));
    requests(table, &page);
    sockets(table, &page).await;
    with_tokens(table, &site);
}

fn requests(table: &mut Table, page: &Page) {
    table.section("Requests (HTTP)");
    let json = "Content-Type: application/json\r\n";
    let history = "/api/structures/house/history";
    let acknowledge = "/api/structures/house/alerts/storey-1/acknowledge";
    let large = format!("{{\"who\":\"Ada\",\"note\":\"{}\"}}", "a".repeat(20_000));
    let long = format!("{{\"who\":\"{}\"}}", "a".repeat(101));
    let wide = format!("X-Wide: {}\r\n", "a".repeat(600_000));
    let from_elsewhere = format!("{json}Origin: https://example.org\r\n");
    let cases: [Asked<'_>; 23] = [
        (
            "an unknown path",
            ["GET", "/api/nothing", "", ""],
            ("404", &["/api/nothing", "openapi.json"]),
        ),
        (
            "a path outside the page",
            ["GET", "/../../etc/passwd", "", ""],
            ("404", &["etc/passwd"]),
        ),
        (
            "an unknown structure",
            ["GET", "/api/structures/tower", "", ""],
            ("404", &["`tower`", "house"]),
        ),
        (
            "a path that is not UTF-8",
            ["GET", "/api/structures/%ff", "", ""],
            ("400", &[]),
        ),
        (
            "a method that the path does not support",
            ["POST", "/api/structures", "", ""],
            ("405", &["POST"]),
        ),
        (
            "an unknown method",
            ["FLY", "/api/structures", "", ""],
            ("405", &["FLY"]),
        ),
        (
            "an invalid number of points",
            ["GET", &format!("{history}?points=none"), "", ""],
            ("400", &["points"]),
        ),
        (
            "an unknown query parameter",
            ["GET", &format!("{history}?until=5"), "", ""],
            ("400", &["until"]),
        ),
        (
            "an unknown series",
            ["GET", &format!("{history}?series=parameter/roof"), "", ""],
            ("400", &["parameter/roof"]),
        ),
        (
            "a time that is not finite",
            ["GET", &format!("{history}?from=nan"), "", ""],
            ("400", &["from"]),
        ),
        (
            "an unknown state",
            ["GET", "/api/alerts?state=angry", "", ""],
            ("400", &["angry"]),
        ),
        (
            "a body that is not JSON",
            ["POST", acknowledge, json, "{"],
            ("400", &["JSON"]),
        ),
        (
            "a body without a required field",
            ["POST", acknowledge, json, "{\"note\":\"x\"}"],
            ("422", &["who"]),
        ),
        (
            "a body of 20 kB",
            ["POST", acknowledge, json, &large],
            ("413", &[]),
        ),
        (
            "a name of 101 characters",
            ["POST", acknowledge, json, &long],
            ("400", &["who is too long", "100"]),
        ),
        (
            "a name with a zero byte",
            ["POST", acknowledge, json, "{\"who\":\"Ada\\u0000\"}"],
            ("400", &["who has control characters", "a line of text"]),
        ),
        (
            "a note with an escape character",
            [
                "POST",
                acknowledge,
                json,
                "{\"who\":\"Ada\",\"note\":\"\\u001b[2J\"}",
            ],
            ("400", &["note has control characters"]),
        ),
        (
            "a body of another type",
            ["POST", acknowledge, "", "{\"who\":\"Ada\"}"],
            ("415", &["application/json"]),
        ),
        (
            "an acknowledgement without alert",
            ["POST", acknowledge, json, "{\"who\":\"Ada\"}"],
            ("409", &["storey-1"]),
        ),
        (
            "a change from the page of another site",
            ["POST", acknowledge, &from_elsewhere, "{\"who\":\"Ada\"}"],
            ("403", &["another site"]),
        ),
        (
            "the page under a foreign host name",
            ["GET", "/api/structures", "Host: example.org\r\n", ""],
            ("403", &["foreign host name", "127.0.0.1"]),
        ),
        (
            "two host names",
            [
                "GET",
                "/api/structures",
                "Host: 127.0.0.1\r\nHost: 127.0.0.1\r\n",
                "",
            ],
            ("400", &["2 Host headers", "must have one"]),
        ),
        (
            "a header of 600 kB",
            ["GET", "/api/structures", &wide, ""],
            ("431", &[]),
        ),
    ];
    for (given, [method, path, headers, body], expected) in cases {
        page.add(
            table,
            given,
            expected,
            &page.request(method, path, headers, body),
        );
    }
    page.add(
        table,
        "a line of the head that ends without CR",
        ("400", &[]),
        &page.send(b"GET /health/live HTTP/1.1\nHost: 127.0.0.1\n\n"),
    );
    page.add(
        table,
        "bytes that are not HTTP",
        ("400", &[]),
        &page.send(b"\x00\x01\x02 spandrel\r\n\r\n"),
    );
    page.add(
        table,
        "TLS to a page without TLS",
        ("400", &[]),
        &page.send(b"\x16\x03\x01\x00\x05hello\r\n\r\n"),
    );
}

async fn sockets(table: &mut Table, page: &Page) {
    table.section("WebSocket (`/api/live`)");
    let socket = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
                  Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n";
    let foreign = format!("{socket}Origin: https://example.org\r\n");
    let cases: [Asked<'_>; 4] = [
        (
            "a request that does not open a WebSocket",
            ["GET", "/api/live", "", ""],
            ("400", &["WebSocket"]),
        ),
        (
            "an unknown structure",
            ["GET", "/api/live?structure=tower", socket, ""],
            ("404", &["`tower`", "house"]),
        ),
        (
            "an unknown query parameter",
            ["GET", "/api/live?struct=house", socket, ""],
            ("400", &["struct"]),
        ),
        (
            "from the page of another site",
            ["GET", "/api/live", &foreign, ""],
            ("403", &["another site"]),
        ),
    ];
    for (given, [method, path, headers, body], expected) in cases {
        page.add(
            table,
            given,
            expected,
            &page.request(method, path, headers, body),
        );
    }
    for (given, message, expected) in [
        (
            "a text with a request",
            Message::text("{\"subscribe\":\"all\"}"),
            "continues",
        ),
        ("bytes", Message::binary(vec![0xff; 100]), "continues"),
        (
            "a message of 5 kB",
            Message::text("a".repeat(5_000)),
            "closed",
        ),
    ] {
        let observed = answer_to(page, message).await;
        page.add(table, given, (expected, &[]), &observed);
    }
}

/// Sends a message on a separate socket. Returns whether further messages follow, or whether the
/// socket is closed.
async fn answer_to(page: &Page, message: Message) -> String {
    let address = format!("ws://{}/api/live?structure=house", page.address);
    let (mut socket, _) = tokio_tungstenite::connect_async(address).await.unwrap();
    within("the first message", socket.next())
        .await
        .unwrap()
        .unwrap();
    socket.send(message).await.unwrap();
    // The server reads in order: a reply to a ping shows that it has read the preceding messages.
    let pinged = socket.send(Message::Ping("behind it".into())).await;
    let goes_on = within("a pong or the end", async {
        loop {
            match socket.next().await {
                Some(Ok(Message::Pong(_))) => return true,
                Some(Ok(Message::Close(_)) | Err(_)) | None => return false,
                Some(Ok(_)) => {}
            }
        }
    })
    .await;
    (if pinged.is_ok() && goes_on {
        "continues"
    } else {
        "closed"
    })
    .to_owned()
}

fn with_tokens(table: &mut Table, site: &Site) {
    table.section("Tokens of the page");
    let token = |name: &str, role: &str| {
        let mut command = spandrel("token");
        command
            .current_dir(site.folder())
            .args([name, "--role", role, "--file", "tokens.json"]);
        Process::start(&mut command)
            .wait()
            .expect_code(0)
            .stdout
            .trim()
            .to_owned()
    };
    let viewer = token("ada", "viewer");
    let tokens = site.folder().join("tokens.json");
    let mut command = site.connecting("dashboard");
    command
        .args(["--http", "127.0.0.1:0"])
        .env("SPANDREL_DASHBOARD__TOKENS", tokens);
    let page = Page::start(Process::start(&mut command));
    let acknowledge = "/api/structures/house/alerts/storey-1/acknowledge";
    let json = "Content-Type: application/json\r\n";
    let bearer = |token: &str| format!("{json}Authorization: Bearer {token}\r\n");
    let of_viewer = bearer(&viewer);
    let wrong = bearer("spandrel-0000");
    let cases: [Asked<'_>; 5] = [
        (
            "none",
            ["GET", "/api/structures", "", ""],
            ("401", &["Bearer TOKEN"]),
        ),
        (
            "a wrong one",
            ["GET", "/api/structures", &wrong, ""],
            ("401", &["no valid token"]),
        ),
        (
            "an invented cookie",
            [
                "GET",
                "/api/structures",
                "Cookie: spandrel-session=0\r\n",
                "",
            ],
            ("401", &["no valid token"]),
        ),
        (
            "a viewer token for an acknowledgement",
            ["POST", acknowledge, &of_viewer, "{\"who\":\"Ada\"}"],
            ("403", &["viewer", "operator"]),
        ),
        (
            "a session request with another body",
            ["POST", "/api/session", json, "[]"],
            ("400", &["the body is not a token"]),
        ),
    ];
    for (given, [method, path, headers, body], expected) in cases {
        page.add(
            table,
            given,
            expected,
            &page.request(method, path, headers, body),
        );
    }
    let answers: Vec<String> = (0..10)
        .map(|_| page.request("GET", "/api/structures", &wrong, ""))
        .collect();
    // The waiting time depends on the speed of the other requests.
    let last = answers[9].split(", must wait").next().unwrap();
    page.add(
        table,
        "eleven wrong tokens from one address",
        ("429", &["too many wrong tokens"]),
        last,
    );
}
