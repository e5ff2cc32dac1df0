//! Tests of the built binary with `spandrel watch` without a terminal, where it prints lines for
//! scripts.

use spandrel_bus::{
    AlertMessage, AlertState, Bus, BusConfig, CredibleInterval, Keys, LatestPublisher, Name,
    ParameterDisplay, Service,
};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// Only ends a hang; no result depends on it.
const DEADLINE: Duration = Duration::from_secs(180);

/// A system to watch, and its endpoint.
struct Site {
    bus: Bus,
    keys: Keys,
    endpoint: String,
}

impl Site {
    async fn open() -> Self {
        let free = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("tcp/{}", free.local_addr().unwrap());
        drop(free);
        let config = BusConfig {
            root: "site".into(),
            listen: vec![endpoint.clone()],
            ..BusConfig::default()
        };
        Self {
            bus: Bus::open(&config).await.unwrap(),
            keys: config.keys("tower").unwrap(),
            endpoint,
        }
    }

    fn watch(&self, more: &[&str]) -> Watch {
        let mut command = spandrel(&["watch", "--root", "site", "--connect", &self.endpoint]);
        let mut child = command.args(more).stdout(Stdio::piped()).spawn().unwrap();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        let (lines, said) = flume::unbounded();
        std::thread::spawn(move || {
            stdout
                .lines()
                .map_while(Result::ok)
                .try_for_each(|line| lines.send(line))
        });
        Watch { child, said }
    }

    async fn raise(&self) -> LatestPublisher<AlertMessage> {
        let alert = AlertMessage {
            structure: name("tower"),
            parameter: name("storey-2"),
            time_ns: 61_000_000_000,
            state: AlertState::Raised,
            since_ns: Some(60_000_000_000),
            rule_loss: 0.05,
            rule_credibility: 0.95,
            credibility: 0.999,
            loss: Some(0.14),
            loss_interval: Some(CredibleInterval {
                level: 0.95,
                low: 0.12,
                high: 0.16,
            }),
            loss_interval_within_record: None,
            mean: 0.86,
            std: 0.01,
            reference: Some(1.0),
            reference_std: Some(0.0),
            acknowledged_by: None,
            why: "storey-2 has lost 14 %".to_owned(),
            fit: None,
            fit_reasons: spandrel_bus::FitReasons::default(),
            follows_jump: false,
            undecided_because: None,
            revision: 0,
        };
        let alerts = self
            .bus
            .publish_latest(self.keys.alert(&alert.parameter))
            .await
            .unwrap();
        alerts.put(&alert).await.unwrap();
        alerts
    }
}

/// A running view. It is killed when dropped.
struct Watch {
    child: Child,
    said: flume::Receiver<String>,
}

impl Watch {
    /// Waits for a line that contains `part`. Calls `meanwhile` repeatedly, as a sensor would
    /// publish.
    async fn line(&self, part: &str, mut meanwhile: impl AsyncFnMut()) -> String {
        let mut before = Vec::new();
        let found = tokio::time::timeout(DEADLINE, async {
            loop {
                meanwhile().await;
                match tokio::time::timeout(Duration::from_millis(100), self.said.recv_async()).await
                {
                    Ok(Ok(line)) if line.contains(part) => return line,
                    Ok(Ok(line)) => before.push(line),
                    Ok(Err(flume::RecvError::Disconnected)) => {
                        panic!("ended without {part:?}: {before:#?}")
                    }
                    Err(_nothing_yet) => {}
                }
            }
        });
        found
            .await
            .unwrap_or_else(|_| panic!("no line with {part:?} within {} s", DEADLINE.as_secs()))
    }

    fn terminate(mut self) -> Option<i32> {
        let signalled = Command::new("kill")
            .args(["-TERM", &self.child.id().to_string()])
            .status();
        assert!(signalled.unwrap().success());
        self.child.wait().unwrap().code()
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        let _ = self.child.kill(); // it may have ended already
        let _ = self.child.wait();
    }
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn spandrel(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command.args(arguments).stdin(Stdio::null());
    command
}

#[tokio::test(flavor = "multi_thread")]
async fn watch_prints_an_earlier_alert_and_sigterm_ends_it_with_0() {
    let site = Site::open().await;
    let _alerts = site.raise().await;
    let watch = site.watch(&[]);
    let line = watch.line(" alert ", async || {}).await;
    assert_eq!(
        line,
        "61.00 s alert tower/storey-2 raised: storey-2 has lost 14 %"
    );
    assert_eq!(watch.terminate(), Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn watch_prints_a_structure_with_its_values_every_second() {
    let site = Site::open().await;
    let watch = site.watch(&["tower"]);
    let display = ParameterDisplay {
        structure: name("tower"),
        parameter: name("storey-2"),
        time_ns: 1_000_000_000,
        mean: 0.86,
        std: 0.01,
        interval: CredibleInterval {
            level: 0.95,
            low: 0.84,
            high: 0.88,
        },
    };
    let values = site
        .bus
        .publish_display(site.keys.parameter(&display.parameter))
        .await
        .unwrap();
    let line = watch
        .line("storey-2", async || values.put(&display).await.unwrap())
        .await;
    assert_eq!(
        line,
        "1.00 s of a record or simulation tower storey-2 0.860 ± 0.010"
    );
    let line = watch.line("stale", async || {}).await;
    assert!(
        line.starts_with("1.00 s of a record or simulation tower stale "),
        "{line}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn watch_reports_a_silent_bus_once() {
    let site = Site::open().await;
    let line = site.watch(&[]).line("no messages yet", async || {}).await;
    assert_eq!(
        line,
        "no messages yet below site: no service or sensor is running"
    );
}

/// Regression test: the line said that no service or sensor is running.
#[tokio::test(flavor = "multi_thread")]
async fn watch_of_an_unknown_structure_lists_the_known_ones() {
    let site = Site::open().await;
    let token = site.keys.live(Service::Ingest, &name("a"));
    let _token = site.bus.announce(token).await.unwrap();
    let line = site
        .watch(&["nosuch"])
        .line("structures with running services", async || {})
        .await;
    assert_eq!(
        line,
        "no messages yet of nosuch below site: no service or sensor of it is running; structures \
         with running services: tower"
    );
}

#[test]
fn watch_without_a_bus_ends_with_1_and_suggests_a_remedy() {
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", free.local_addr().unwrap());
    drop(free);
    let output = spandrel(&["watch", "--connect", &endpoint])
        .output()
        .unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(
        message.contains(&format!("no reply from {endpoint}")),
        "{message}"
    );
}

#[test]
fn a_structure_name_that_is_not_a_key_ends_with_2() {
    let output = spandrel(&["watch", "Tower/1", "--listen", "tcp/127.0.0.1:0"])
        .output()
        .unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("Tower/1"), "{message}");
}
