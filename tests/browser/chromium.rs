//! Controls a headless Chromium with its DevTools protocol.

use base64::Engine;
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

/// Only ends a hang.
const DEADLINE: Duration = Duration::from_secs(90);
/// Interval at which a condition in the page is checked.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Names of the program, those of distributions first.
const NAMES: [&str; 4] = [
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
];

/// One page of a browser. Dropping it ends the browser.
pub struct Browser {
    process: Child,
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    calls: u64,
    /// Errors and warnings of the page.
    complaints: Vec<String>,
    /// Number of pages that have been loaded.
    loads: u32,
    _profile: tempfile::TempDir,
    screenshots: PathBuf,
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Returns the path of Chromium, if it is installed.
pub fn installed() -> Option<PathBuf> {
    let folders: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    NAMES
        .iter()
        .flat_map(|name| folders.iter().map(move |folder| folder.join(name)))
        .find(|path| path.is_file())
}

impl Browser {
    /// Starts a browser with an empty profile.
    pub async fn start(program: &Path, screenshots: PathBuf) -> Self {
        let profile = tempfile::tempdir().unwrap();
        let mut command = Command::new(program);
        // Chromium cannot use its sandbox as root, as in a container.
        command.args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--remote-debugging-port=0",
            // The language of the page is that of the browser.
            "--lang=en-US",
            "--accept-lang=en-US",
        ]);
        command
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank");
        let mut process = command
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (told, address) = std::sync::mpsc::channel();
        let lines = BufReader::new(process.stderr.take().unwrap()).lines();
        // Reads the log to its end, so that the browser never blocks on it.
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                if let Some((_, rest)) = line.split_once("DevTools listening on ws://") {
                    let _ = told.send(rest.split('/').next().unwrap_or_default().to_owned());
                }
            }
        });
        let address = address
            .recv_timeout(DEADLINE)
            .expect("the address of the DevTools");
        let targets: Value = serde_json::from_str(&get(&address, "/json").await).unwrap();
        let page = targets
            .as_array()
            .unwrap()
            .iter()
            .find(|target| target["type"] == "page")
            .unwrap();
        let page = page["webSocketDebuggerUrl"].as_str().unwrap();
        let (socket, _) = tokio_tungstenite::connect_async(page).await.unwrap();
        std::fs::create_dir_all(&screenshots).unwrap();
        let mut browser = Self {
            process,
            socket,
            calls: 0,
            complaints: Vec::new(),
            loads: 0,
            _profile: profile,
            screenshots,
        };
        for domain in ["Page.enable", "Runtime.enable", "Log.enable"] {
            browser.call(domain, json!({})).await;
        }
        browser
    }

    /// Calls a method of the protocol and returns its result.
    pub async fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.calls += 1;
        let id = self.calls;
        let text = json!({"id": id, "method": method, "params": parameters}).to_string();
        self.socket.send(text.into()).await.unwrap();
        loop {
            let mut message = self.next(method).await;
            if message["id"] == id {
                assert!(message["error"].is_null(), "{method}: {}", message["error"]);
                return message["result"].take();
            }
            self.listen(&message);
        }
    }

    /// Returns the next message of the protocol.
    async fn next(&mut self, what: &str) -> Value {
        loop {
            let message = tokio::time::timeout(DEADLINE, self.socket.next()).await;
            let message = message
                .unwrap_or_else(|_| panic!("{what}: no answer"))
                .expect("a running browser")
                .unwrap();
            if let Ok(text) = message.to_text() {
                return serde_json::from_str(text).unwrap();
            }
        }
    }

    fn listen(&mut self, message: &Value) {
        let parameters = &message["params"];
        let complaint = match message["method"].as_str() {
            Some("Runtime.exceptionThrown") => parameters["exceptionDetails"].to_string(),
            Some("Log.entryAdded") if parameters["entry"]["level"] == "error" => {
                let entry = &parameters["entry"];
                format!("{} {}", entry["text"], entry["url"])
            }
            Some("Page.loadEventFired") => {
                self.loads += 1;
                return;
            }
            _ => return,
        };
        self.complaints.push(complaint);
    }

    /// Returns and clears the errors and warnings of the page.
    pub fn complaints(&mut self) -> Vec<String> {
        std::mem::take(&mut self.complaints)
    }

    /// Opens an address.
    pub async fn open(&mut self, address: &str) {
        self.call("Page.navigate", json!({"url": address})).await;
    }

    /// Loads the page again, and waits until it is loaded.
    pub async fn reload(&mut self) {
        let loads = self.loads;
        self.call("Page.reload", json!({})).await;
        while self.loads == loads {
            let message = self.next("reload").await;
            self.listen(&message);
        }
    }

    /// Evaluates an expression in the page.
    pub async fn evaluate(&mut self, expression: &str) -> Value {
        let parameters =
            json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let mut answer = self.call("Runtime.evaluate", parameters).await;
        assert!(
            answer["exceptionDetails"].is_null(),
            "{expression}: {}",
            answer["exceptionDetails"]
        );
        answer["result"]["value"].take()
    }

    /// Waits until an expression is true in the page.
    pub async fn wait(&mut self, what: &str, expression: &str) {
        let end = tokio::time::Instant::now() + DEADLINE;
        // During navigation, the page cannot evaluate the expression.
        let guarded = format!(
            "(() => {{ try {{ return Boolean({expression}) }} catch {{ return false }} }})()"
        );
        while self.evaluate(&guarded).await != true {
            if tokio::time::Instant::now() >= end {
                self.screenshot("failed").await;
                let text = self.evaluate("document.body.innerText").await;
                let focus = self
                    .evaluate(
                        "`${document.hasFocus()}, \
                               ${document.activeElement?.outerHTML.slice(0, 200)}`",
                    )
                    .await;
                panic!(
                    "waited in vain: {what}\n  {expression}\n  the page says: {text}\n  the \
                     focus: {focus}\n  {:?}",
                    self.complaints
                );
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    /// Sets the size of the window (CSS pixels).
    pub async fn resize(&mut self, width: u32, height: u32) {
        let is_phone = width < 600;
        let size = json!({"width": width, "height": height, "deviceScaleFactor": if is_phone { 2 } else { 1 }, "mobile": is_phone});
        self.call("Emulation.setDeviceMetricsOverride", size).await;
    }

    /// Sets the preferred colour scheme, `light` or `dark`.
    pub async fn prefer(&mut self, scheme: &str) {
        let features = json!({"features": [{"name": "prefers-color-scheme", "value": scheme}]});
        self.call("Emulation.setEmulatedMedia", features).await;
    }

    /// Sets the time zone, such as `Asia/Kathmandu`.
    pub async fn move_to(&mut self, zone: &str) {
        let zone = json!({"timezoneId": zone});
        self.call("Emulation.setTimezoneOverride", zone).await;
    }

    /// Types a text into the focused element.
    pub async fn write(&mut self, text: &str) {
        self.call("Input.insertText", json!({"text": text})).await;
    }

    /// Presses a key.
    pub async fn press(&mut self, key: &str) {
        let (code, text) = match key {
            "Tab" => (9, ""),
            "Enter" => (13, "\r"),
            "Home" => (36, ""),
            "End" => (35, ""),
            "ArrowLeft" => (37, ""),
            "ArrowRight" => (39, ""),
            "+" => (187, "+"),
            "-" => (189, "-"),
            other => panic!("no such key: {other}"),
        };
        for kind in ["keyDown", "keyUp"] {
            let mut event =
                json!({"type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code});
            if kind == "keyDown" && !text.is_empty() {
                event["text"] = json!(text);
            }
            self.call("Input.dispatchKeyEvent", event).await;
        }
    }

    /// Saves a screenshot.
    pub async fn screenshot(&mut self, name: &str) {
        let shot = self
            .call("Page.captureScreenshot", json!({"format": "png"}))
            .await;
        let bytes = base64::prelude::BASE64_STANDARD
            .decode(shot["data"].as_str().unwrap())
            .unwrap();
        std::fs::write(self.screenshots.join(format!("{name}.png")), bytes).unwrap();
    }
}

/// Returns the body of the response to a GET request.
async fn get(address: &str, path: &str) -> String {
    let mut socket = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    socket.write_all(request.as_bytes()).await.unwrap();
    let mut bytes = Vec::new();
    // The DevTools keep the connection open, so the length determines the end.
    loop {
        let text = String::from_utf8_lossy(&bytes).into_owned();
        if let Some((head, body)) = text.split_once("\r\n\r\n") {
            let length = head.lines().find_map(|line| {
                let (name, value) = line.split_once(':')?;
                name.eq_ignore_ascii_case("content-length")
                    .then(|| value.trim().parse::<usize>().unwrap())
            });
            if body.len() >= length.expect("a length") {
                return body.to_owned();
            }
        }
        let read = socket.read_buf(&mut bytes).await.unwrap();
        assert!(read > 0, "the DevTools have closed: {text}");
    }
}
