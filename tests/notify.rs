//! Notifications of alerts: a webhook, an Alertmanager and a mail server, all provided by the test.

use crate::support::{DEADLINE, Process, Site, spandrel, two_storeys, within};
use serde_json::Value;
use spandrel_bus::{
    AlertMessage, AlertState, Bus, Event, EventKind, Keys, MonitoringDisplay, MonitoringState,
    Name, REFERENCE_IS_LEARNT, Service, Status, Subscription,
};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

/// Damage of storey 2 at 20 s, and a rule relative to the design.
const DAMAGED: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                       credibility = 0.99\nsustain-s = 5\n\
                       [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 20\nloss = 0.15\n";
const TOKEN: &str = "t0ken-of-the-test";
const PATH: &str = "/hooks/s3cret-path";

/// A received request: head and body, and whether it was accepted.
#[derive(Debug)]
pub struct Request {
    pub head: String,
    pub body: Value,
    is_taken: bool,
}

/// Serves HTTP requests and rejects the first `failing` of them.
pub fn http(failing: usize) -> (SocketAddr, Receiver<Request>) {
    let asked = AtomicUsize::new(0);
    answering(move || asked.fetch_add(1, Ordering::Relaxed) < failing)
}

/// Serves HTTP requests and rejects them while `fails` returns `true`.
fn answering(fails: impl Fn() -> bool + Send + Sync + 'static) -> (SocketAddr, Receiver<Request>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, requests) = channel();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let (sender, fails) = (sender.clone(), fails());
            thread::spawn(move || answer(stream.unwrap(), fails, &sender));
        }
    });
    (address, requests)
}

fn answer(mut stream: TcpStream, fails: bool, requests: &Sender<Request>) {
    let mut reader = BufReader::new(stream.try_clone().unwrap());
    let (mut head, mut length) = (String::new(), 0);
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line).unwrap_or(0) == 0 || line == "\r\n" {
            break;
        }
        if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        head.push_str(&line);
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).unwrap();
    let status = if fails {
        "503 Service Unavailable"
    } else {
        "200 OK"
    };
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    // The test may have ended.
    let _ = requests.send(Request {
        head,
        body: serde_json::from_slice(&body).unwrap(),
        is_taken: !fails,
    });
}

/// Accepts mails, and sends their content to the returned channel.
fn smtp() -> (SocketAddr, Receiver<String>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, mails) = channel();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
            write!(stream, "220 test\r\n").unwrap();
            let mut mail = String::new();
            while let Some(Ok(line)) = lines.next() {
                match line.split(' ').next().unwrap().to_uppercase().as_str() {
                    "DATA" => {
                        write!(stream, "354 go on\r\n").unwrap();
                        let text = lines
                            .by_ref()
                            .map(Result::unwrap)
                            .take_while(|line| line != ".");
                        mail += &text.collect::<Vec<_>>().join("\n");
                        write!(stream, "250 taken\r\n").unwrap();
                    }
                    "QUIT" => break,
                    _ => {
                        mail += &format!("{line}\n");
                        write!(stream, "250 test\r\n").unwrap();
                    }
                }
            }
            let _ = sender.send(mail);
        }
    });
    (address, mails)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_alert_reaches_webhook_alertmanager_and_people_once() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (hook, hooks) = http(2);
    let (manager, managed) = http(0);
    let (pager, paged) = http(0);
    let (server, mails) = smtp();
    std::fs::write(site.folder().join("token"), format!("{TOKEN}\n")).unwrap();
    let configuration = site.folder().join("spandrel.toml");
    let text = format!(
        "[notify]\npublic-url = \"https://bridges.example\"\n\
         [[notify.webhook]]\nurl = \"http://{hook}{PATH}\"\ntoken-file = \"token\"\n\
         simulations = true\n\
         [[notify.webhook]]\nurl = \"http://{manager}/api/v2/alerts\"\nformat = \"alertmanager\"\n\
         simulations = true\n\
         [[notify.webhook]]\nurl = \"http://{pager}/\"\n\
         [[notify.email]]\nserver = \"127.0.0.1\"\nport = {}\nencryption = \"none\"\n\
         simulations = true\n\
         from = \"Bridges <bridges@site.example>\"\n\
         to = [\"ada@site.example\", \"bo@site.example\"]\n",
        server.port()
    );
    std::fs::write(&configuration, text).unwrap();
    let services = Process::start(
        site.listening("run")
            .arg("--config")
            .arg(&configuration)
            .args(["--http", "none"]),
    );
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(60.0);
    site.replay(&record, "max").wait().expect_code(0);

    // Two attempts fail and the third succeeds, with the same alert under the same key.
    let attempts: Vec<Request> = (0..3)
        .map(|_| hooks.recv_timeout(DEADLINE).unwrap())
        .collect();
    for attempt in &attempts {
        assert!(
            attempt.head.starts_with(&format!("POST {PATH} ")),
            "{}",
            attempt.head
        );
        assert!(
            attempt
                .head
                .to_lowercase()
                .contains(&format!("authorization: bearer {TOKEN}")),
            "{}",
            attempt.head
        );
        assert_eq!(
            (&attempt.body["parameter"], &attempt.body["state"]),
            (&"storey-2".into(), &"raised".into())
        );
        assert_eq!(attempt.body["key"], attempts[0].body["key"]);
        assert!(
            attempt.body["why"]
                .as_str()
                .unwrap()
                .contains("storey-2 has lost"),
            "{}",
            attempt.body
        );
        assert_eq!(attempt.body["origin"], "replayed");
        let link = attempt.body["link"].as_str().unwrap();
        let page = "https://bridges.example/#/structure/house?parameter=storey-2";
        assert!(link.starts_with(page), "{link}");
    }
    let alert = managed.recv_timeout(DEADLINE).unwrap();
    assert!(
        alert.head.starts_with("POST /api/v2/alerts "),
        "{}",
        alert.head
    );
    assert_eq!(alert.body[0]["labels"]["parameter"], "storey-2");
    assert!(alert.body[0].get("endsAt").is_none(), "{}", alert.body);
    let mail = mails.recv_timeout(DEADLINE).unwrap();
    for part in [
        "RCPT TO:<ada@site.example>",
        "RCPT TO:<bo@site.example>",
        "Subject: [REPLAYED] house: alert of storey-2 raised",
    ] {
        assert!(mail.contains(part), "{part}\n{mail}");
    }
    assert!(
        mail.contains("storey-2 has lost") && mail.contains("Rule:"),
        "{mail}"
    );

    // A further query to the alert service returns the same alert, which is not notified again.
    assert!(
        hooks.recv_timeout(Duration::from_secs(2)).is_err(),
        "told once"
    );
    assert!(mails.try_recv().is_err(), "told once");
    assert!(paged.try_recv().is_err(), "a replay pages nobody");
    bus.close().await.unwrap();
    let finished = services.stop().expect_code(0);
    for secret in [TOKEN, "s3cret-path"] {
        assert!(
            !finished.stderr.contains(secret),
            "{secret} in the log:\n{}",
            finished.stderr
        );
    }
    assert!(
        finished.stderr.contains("notice not sent; retrying"),
        "{}",
        finished.stderr
    );
}

/// Returns an alert of storey 2 as the alert service publishes it.
pub fn alert(site: &Site, seconds: i64, state: AlertState) -> AlertMessage {
    AlertMessage {
        structure: Name::new(site.structure().name()).unwrap(),
        parameter: Name::new("storey-2").unwrap(),
        time_ns: seconds * 1_000_000_000,
        state,
        since_ns: None,
        rule_loss: 0.05,
        rule_credibility: 0.99,
        credibility: 0.995,
        loss: Some(0.1),
        loss_interval: None,
        loss_interval_within_record: None,
        mean: 0.9,
        std: 0.01,
        reference: Some(1.0),
        reference_std: Some(0.0),
        acknowledged_by: None,
        why: "storey-2 has lost 10 %".to_owned(),
        fit: None,
        fit_reasons: spandrel_bus::FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
    }
}

/// Waits until `notify` has accepted `count` alerts. It publishes its status after they are on
/// disk.
async fn taken(bus: &Bus, keys: &Keys, count: u64) {
    let statuses = bus
        .subscribe::<Status>(keys.all_statuses(), 64)
        .await
        .unwrap();
    let taken = async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.service.as_str() == Service::Notify.as_str() && status.done >= count {
                return;
            }
        }
    };
    within(&format!("{count} alerts taken by notify"), taken).await;
}

// Undelivered notices must survive a crash, and not only the last state of each alert.
#[tokio::test(flavor = "multi_thread")]
async fn notices_survive_kills_and_arrive_under_one_key_each() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (bus, keys) = (site.host().await, site.keys());
    let is_down = Arc::new(AtomicBool::new(true));
    let down = is_down.clone();
    let (hook, hooks) = answering(move || down.load(Ordering::SeqCst));
    let (manager, managed) = answering(|| false);
    let configuration = site.folder().join("spandrel.toml");
    let text = format!(
        "[[notify.webhook]]\nurl = \"http://{hook}{PATH}\"\nstates = [\"raised\", \"cleared\"]\n\
         [[notify.webhook]]\nurl = \"http://{manager}/\"\nstates = [\"raised\", \"cleared\"]\n\
         [state]\nfolder = \"state\"\n"
    );
    std::fs::write(&configuration, text).unwrap();
    let mut tokens = bus
        .watch_live(keys.all_live(Service::Notify))
        .await
        .unwrap();
    let mut notify = async || {
        // The token of an earlier run must be gone.
        within("no token of notify", async {
            while !tokens.present().is_empty() && !tokens.changed().await.is_empty() {}
        })
        .await;
        let process = Process::start(
            site.connecting("notify")
                .arg("--config")
                .arg(&configuration),
        );
        within("token of notify", tokens.some()).await;
        process
    };
    let publisher = bus
        .publish_display(keys.alert(&Name::new("storey-2").unwrap()))
        .await
        .unwrap();
    let put = async |seconds, state| publisher.put(&alert(&site, seconds, state)).await.unwrap();
    let states = [AlertState::Raised, AlertState::Cleared];

    // Three runs, each of which accepts two alerts, fails to deliver them, and is killed between
    // two attempts.
    let mut expected = Vec::new();
    for life in 0..3_u8 {
        let process = notify().await;
        for (number, state) in (1..).zip(states) {
            let seconds = 100 * i64::from(life) + number;
            expected.push(format!(
                "house/storey-2/{seconds}000000000/{}",
                state.as_str()
            ));
            put(seconds, state).await;
        }
        taken(&bus, &keys, 2).await;
        let attempts: Vec<Request> = (0..2)
            .map(|_| hooks.recv_timeout(DEADLINE).unwrap())
            .collect();
        for attempt in attempts {
            assert_eq!(attempt.body["key"], expected[0], "in order");
        }
        process.kill();
    }

    // The receiver works again and accepts each notice once, in order.
    is_down.store(false, Ordering::SeqCst);
    let process = notify().await;
    // Accepted notices up to a key.
    let taken_by = |requests: &Receiver<Request>, last: &str| {
        let mut keys: Vec<String> = Vec::new();
        while keys.last().is_none_or(|key| key != last) {
            let request = requests.recv_timeout(DEADLINE).unwrap();
            keys.extend(
                request
                    .is_taken
                    .then(|| request.body["key"].as_str().unwrap().to_owned()),
            );
        }
        keys
    };
    let last = expected.last().unwrap().clone();
    assert_eq!(taken_by(&hooks, &last), expected);
    // The receiver that always worked has each notice as well. A delivery that was not recorded
    // before the kill is repeated under its key.
    let mut of_other = taken_by(&managed, &last);
    of_other.dedup();
    assert_eq!(of_other, expected);
    // All deliveries are recorded: the next run sends only new notices.
    process.stop().expect_code(0);
    let process = notify().await;
    put(900, AlertState::Raised).await;
    let next = "house/storey-2/900000000000/raised";
    assert_eq!(taken_by(&hooks, next), [next]);
    process.stop().expect_code(0);

    // The disk contains only the part of the address that the log shows.
    let kept = site.folder().join("state");
    let mut files = Vec::new();
    let mut folders = vec![kept];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => files.push(path),
            }
        }
    }
    assert!(
        files
            .iter()
            .any(|file| file.to_string_lossy().contains("notify-")),
        "{files:?}"
    );
    for file in files {
        let bytes = std::fs::read(&file).unwrap();
        assert!(
            !bytes.windows(6).any(|part| part == b"s3cret"),
            "{}",
            file.display()
        );
    }
    bus.close().await.unwrap();
}

#[test]
fn the_error_names_unusable_settings() {
    let site = Site::with(&two_storeys(DAMAGED));
    let configuration = site.folder().join("spandrel.toml");
    let template = "{\n  \"loss\": {{ losss }}\n}\n";
    std::fs::write(site.folder().join("body.json"), template).unwrap();
    for (text, parts) in [
        (
            "[[notify.webhook]]\nurl = \"gopher://x/s3cret\"\n",
            &["notify.webhook[0].url", "https://"][..],
        ),
        (
            "[[notify.webhook]]\nurl = \"http://x/\"\ntoken-file = \"nowhere\"\n",
            &["nowhere", "webhook[0].token-file"],
        ),
        (
            "[[notify.email]]\nserver = \"mail\"\nfrom = \"a@b.example\"\nto = [\"somebody\"]\n",
            &["notify.email[0].to", "\"somebody\""],
        ),
        ("[[notify.pager]]\nnumber = 1\n", &["pager", "webhook"]),
        (
            "[notify]\npublic-url = \"bridges.example\"\n",
            &["notify.public-url", "bridges.example", "https://"],
        ),
        (
            "[notify]\nblind-after-s = -1\n",
            &["notify.blind-after-s", "-1", "30 days"],
        ),
        (
            "[[notify.webhook]]\nurl = \"http://x/\"\ntemplate-file = \"body.json\"\n",
            &[
                "body.json:2",
                "webhook[0].template-file",
                "`losss`",
                "loss_low",
            ],
        ),
        (
            "[[notify.webhook]]\nurl = \"http://x/\"\nstates = [\"blinded\"]\n",
            &["blinded", "blind", "degraded", "watching"],
        ),
        (
            "[[notify.webhook]]\nurl = \"http://x/\"\n\
             quiet = [{ from = \"22:00\", to = \"06:00\", zone = \"Mars/Base\" }]\n",
            &[
                "notify.webhook[0].quiet[0].zone",
                "Mars/Base",
                "Europe/Zurich",
            ],
        ),
        (
            "[[notify.webhook]]\nurl = \"http://x/\"\n\
             quiet = [{ from = \"10 pm\", to = \"06:00\", zone = \"UTC\" }]\n",
            &["10 pm", "22:00"],
        ),
        (
            "[[notify.webhook]]\nurl = \"http://x/\"\nformat = \"alertmanager\"\nafter-s = 60\n",
            &["notify.webhook[0].format", "after-s"],
        ),
        ("", &["no recipients of notices"]),
    ] {
        std::fs::write(&configuration, text).unwrap();
        let mut command = spandrel("notify");
        command
            .arg(site.structure_file())
            .arg("--config")
            .arg(&configuration);
        let finished = Process::start(&mut command)
            .wait()
            .expect_code(2)
            .expect_told(parts);
        assert!(!finished.stderr.contains("s3cret"), "{}", finished.stderr);
    }
}

/// Publishes reports on the monitoring, as the alert service does each second, until it is dropped.
struct Reports(tokio::task::JoinHandle<()>);

impl Drop for Reports {
    fn drop(&mut self) {
        self.0.abort();
    }
}

async fn report(bus: &Bus, keys: &Keys, state: MonitoringState, reason: &str) -> Reports {
    let publisher = bus.publish_display(keys.monitoring()).await.unwrap();
    let since_ns = now_ns();
    let (structure, reason) = (keys.structure().clone(), reason.to_owned());
    let mut every = tokio::time::interval(Duration::from_millis(200));
    Reports(tokio::spawn(async move {
        loop {
            every.tick().await;
            let display = MonitoringDisplay {
                structure: structure.clone(),
                time_ns: now_ns(),
                measured_ns: Some(since_ns),
                state,
                since_ns,
                reasons: vec![reason.clone()],
                parameters: Vec::new(),
                channels: Vec::new(),
            };
            publisher.put(&display).await.unwrap();
        }
    }))
}

fn now_ns() -> i64 {
    i64::try_from(std::time::UNIX_EPOCH.elapsed().unwrap().as_nanos()).unwrap()
}

/// Starts notify with a configuration, and waits until it is ready.
async fn start_notify(site: &Site, bus: &Bus, text: &str) -> Process {
    let configuration = site.folder().join("spandrel.toml");
    std::fs::write(&configuration, text).unwrap();
    let process = Process::start(
        site.connecting("notify")
            .arg("--config")
            .arg(&configuration),
    );
    let tokens = site.keys().all_live(Service::Notify);
    let mut tokens = bus.watch_live(tokens).await.unwrap();
    within("token of notify", tokens.some()).await;
    process
}

fn states(requests: &Receiver<Request>, count: usize) -> Vec<(String, String)> {
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let next = |_| {
        let body = requests.recv_timeout(DEADLINE).unwrap().body;
        (text(&body["kind"]), text(&body["state"]))
    };
    (0..count).map(next).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn blind_structure_and_silent_alert_service_are_notified_and_their_end_is() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (bus, keys) = (site.host().await, site.keys());
    let (hook, hooks) = http(0);
    let text = format!(
        "[notify]\nblind-after-s = 1\nwatching-after-s = 1\n\
         [[notify.webhook]]\nurl = \"http://{hook}/\"\n[state]\nfolder = \"state\"\n"
    );
    let learning = report(&bus, &keys, MonitoringState::Blind, REFERENCE_IS_LEARNT).await;
    let notify = start_notify(&site, &bus, &text).await;
    // Learning for longer than the delay of blindness is no loss of sight.
    let next = hooks.recv_timeout(Duration::from_secs(8));
    assert!(next.is_err(), "learning pages nobody");
    drop(learning);
    let blind = report(&bus, &keys, MonitoringState::Blind, "no samples arrive").await;
    let first = hooks.recv_timeout(DEADLINE).unwrap().body;
    assert_eq!(first["state"], "blind");
    assert_eq!(first["reasons"][0], "no samples arrive");
    assert_eq!(first["title"], site.structure().description());
    drop(blind);
    let watching = report(&bus, &keys, MonitoringState::Watching, "").await;
    let of = |state: &str| ("monitoring".to_owned(), state.to_owned());
    assert_eq!(states(&hooks, 1), [of("watching")]);
    // Nothing is heard of the structure any longer.
    drop(watching);
    let silent = hooks.recv_timeout(DEADLINE).unwrap().body;
    assert_eq!(silent["state"], "blind");
    let reason = silent["reasons"][0].as_str().unwrap();
    assert!(
        reason.contains("alert service has sent no report"),
        "{reason}"
    );
    let advice = silent["advice"].as_str().unwrap();
    assert!(advice.contains("Check the server"), "{advice}");
    // The next run knows that the blindness was notified.
    notify.stop().expect_code(0);
    let notify = start_notify(&site, &bus, &text).await;
    let _watching = report(&bus, &keys, MonitoringState::Watching, "").await;
    assert_eq!(states(&hooks, 1), [of("watching")]);
    notify.stop().expect_code(0);
    bus.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn maintenance_mutes_across_a_restart_and_ends_with_a_summary() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (bus, keys) = (site.host().await, site.keys());
    let (hook, hooks) = http(0);
    let text =
        format!("[[notify.webhook]]\nurl = \"http://{hook}/\"\n[state]\nfolder = \"state\"\n");
    let events = bus.subscribe::<Event>(keys.event(), 64).await.unwrap();
    let _watching = report(&bus, &keys, MonitoringState::Watching, "").await;
    let notify = start_notify(&site, &bus, &text).await;
    let maintenance = |options: &[&str]| {
        let mut command = spandrel("maintenance");
        command.arg(site.structure().name()).args(options).args([
            "--who",
            "grace",
            "--root",
            keys.root().as_str(),
            "--connect",
            site.endpoint(),
        ]);
        Process::start(&mut command).wait().expect_code(0).stdout
    };
    assert_eq!(maintenance(&[]), "house: no maintenance\n");
    let until = (now_ns() / 1_000_000_000 + 3600).to_string();
    let told = maintenance(&["--until", &until, "--reason", "new bearings"]);
    assert!(told.contains("by grace: new bearings"), "{told}");
    let event = within("an event", events.messages().recv_async())
        .await
        .unwrap()
        .1;
    assert_eq!(
        (event.kind, &*event.why),
        (EventKind::Maintenance, "grace: new bearings")
    );

    let publisher = bus
        .publish_display(keys.alert(&Name::new("storey-2").unwrap()))
        .await
        .unwrap();
    publisher
        .put(&alert(&site, 100, AlertState::Raised))
        .await
        .unwrap();
    muted(&bus, &keys).await;
    notify.stop().expect_code(0);
    let notify = start_notify(&site, &bus, &text).await;
    assert_eq!(maintenance(&[]), told, "after a restart");
    assert!(hooks.try_recv().is_err(), "muted");
    // A misspelt part mutes nothing, and the command says so.
    let mut misspelt = spandrel("maintenance");
    misspelt
        .args(["house", "--until", &until, "--reason", "paint"])
        .args(["--parameter", "story-2", "--who", "grace"])
        .args(["--root", keys.root().as_str(), "--connect", site.endpoint()]);
    Process::start(&mut misspelt)
        .wait()
        .expect_code(1)
        .expect_told(&["no confirmation", "that the parameter exists"]);
    assert_eq!(maintenance(&["--end"]), "house: no maintenance\n");
    let summary = hooks.recv_timeout(DEADLINE).unwrap().body;
    assert_eq!(summary["kind"], "summary");
    assert_eq!(summary["cause"], "maintenance by grace (new bearings)");
    let line = summary["lines"][0].as_str().unwrap();
    assert!(line.contains("storey-2 raised"), "{line}");
    // The alert lasts.
    assert_eq!(
        states(&hooks, 1),
        [("alert".to_owned(), "raised".to_owned())]
    );
    notify.stop().expect_code(0);
    bus.close().await.unwrap();
}

/// Waits until notify has muted a notice. It publishes its status after the notice is on disk.
async fn muted(bus: &Bus, keys: &Keys) {
    let statuses = bus
        .subscribe(keys.statuses(Service::Notify), 64)
        .await
        .unwrap();
    within("a muted notice", async {
        loop {
            let (_, status): (_, Status) = statuses.messages().recv_async().await.unwrap();
            if status.drops.contains_key("muted-notices") {
                return;
            }
        }
    })
    .await;
}

#[test]
fn maintenance_without_notify_is_an_error() {
    let site = Site::with(&two_storeys(DAMAGED));
    let mut command = spandrel("maintenance");
    command.args(["house", "--listen", site.endpoint()]);
    Process::start(&mut command)
        .wait()
        .expect_code(1)
        .expect_told(&["no confirmation from notify", "check that it runs"]);
}

#[test]
fn test_notice_reports_the_result_of_each_receiver() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (hook, hooks) = http(0);
    let (broken, _refused) = answering(|| true);
    let (server, mails) = smtp();
    let template = "{\"text\": {{ sentence }}, \"key\": {{ key }}}";
    std::fs::write(site.folder().join("body.json"), template).unwrap();
    let configuration = site.folder().join("spandrel.toml");
    let good = format!(
        "[[notify.webhook]]\nurl = \"http://{hook}{PATH}\"\ntemplate-file = \"body.json\"\n\
         [[notify.email]]\nserver = \"127.0.0.1\"\nport = {}\nencryption = \"none\"\n\
         from = \"Bridges <bridges@site.example>\"\nto = [\"ada@site.example\"]\n\
         states = [\"blind\"]\n",
        server.port()
    );
    let test = |text: &str, code: i32| {
        std::fs::write(&configuration, text).unwrap();
        let mut command = spandrel("notify");
        command.arg(site.structure_file()).arg("--config");
        command.arg(&configuration).arg("--test");
        Process::start(&mut command).wait().expect_code(code)
    };
    let told = test(&good, 0).stdout;
    let lines: Vec<&str> = told.lines().collect();
    assert_eq!(lines.len(), 2, "{told}");
    assert!(
        lines[0].starts_with(&format!("http://{hook}/…: delivered in ")),
        "{told}"
    );
    assert!(
        lines[1].starts_with("ada@site.example: delivered in "),
        "{told}"
    );
    let body = hooks.recv_timeout(DEADLINE).unwrap().body;
    assert!(
        body["text"].as_str().unwrap().starts_with("TEST: "),
        "{body}"
    );
    let mail = mails.recv_timeout(DEADLINE).unwrap();
    assert!(
        mail.contains("Subject: [TEST] house: alert of test-part raised"),
        "{mail}"
    );
    assert!(mail.contains("All values are made up"), "{mail}");
    let finished = test(
        &format!("{good}[[notify.webhook]]\nurl = \"http://{broken}/\"\n"),
        1,
    );
    assert!(
        finished.stdout.contains("failed: replied with 503"),
        "{}",
        finished.stdout
    );
    finished.expect_told(&["1 of 3 test notices"]);
}

// A live simulation has the pace of measured samples.
#[tokio::test(flavor = "multi_thread")]
async fn live_simulation_sends_no_notice_without_a_request() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (pager, paged) = http(0);
    let (hook, hooks) = http(0);
    let configuration = site.folder().join("spandrel.toml");
    let text = format!(
        "[notify]\nblind-after-s = 1\nwatching-after-s = 0\n\
         [[notify.webhook]]\nurl = \"http://{pager}/\"\n\
         [[notify.webhook]]\nurl = \"http://{hook}/\"\nsimulations = true\n\
         [state]\nfolder = \"none\"\n[history]\ndatabase = \"none\"\n"
    );
    std::fs::write(&configuration, text).unwrap();
    let mut simulation = Process::start(site.listening("simulate").args(["--live"]));
    let services = Process::start(
        site.connecting("run")
            .arg("--config")
            .arg(&configuration)
            .args(["--http", "none"]),
    );
    services.wait_for_log("ready structures=1");
    assert!(!simulation.has_ended());
    simulation.kill();
    // The blindness after the simulation is still that of a simulation.
    let body = loop {
        let body = hooks.recv_timeout(DEADLINE).unwrap().body;
        if body["state"] == "blind" {
            break body;
        }
    };
    assert_eq!(
        (&body["origin"], &body["kind"]),
        (&"simulated".into(), &"monitoring".into())
    );
    assert!(paged.try_recv().is_err(), "a simulation pages nobody");
    services.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn only_unacknowledged_alerts_are_escalated() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (bus, keys) = (site.host().await, site.keys());
    let (first, told) = http(0);
    let (second, escalated) = http(0);
    let states = "states = [\"raised\", \"acknowledged\", \"cleared\"]";
    let text = format!(
        "[[notify.webhook]]\nurl = \"http://{first}/\"\n{states}\n\
         [[notify.webhook]]\nurl = \"http://{second}/\"\n{states}\nafter-s = 6\n\
         [state]\nfolder = \"none\"\n"
    );
    let notify = start_notify(&site, &bus, &text).await;
    let put = async |parameter: &str, seconds, state| {
        let parameter = Name::new(parameter).unwrap();
        let publisher = bus.publish_display(keys.alert(&parameter)).await.unwrap();
        let alert = AlertMessage {
            parameter,
            ..alert(&site, seconds, state)
        };
        publisher.put(&alert).await.unwrap();
    };
    put("storey-1", 10, AlertState::Raised).await;
    put("storey-2", 10, AlertState::Raised).await;
    put("storey-1", 11, AlertState::Acknowledged).await;
    let mut at_once: Vec<String> = (0..3)
        .map(|_| told.recv_timeout(DEADLINE).unwrap().body["state"].to_string())
        .collect();
    at_once.sort();
    assert_eq!(at_once, ["\"acknowledged\"", "\"raised\"", "\"raised\""]);
    let body = escalated.recv_timeout(DEADLINE).unwrap().body;
    assert_eq!(
        (&body["parameter"], &body["state"]),
        (&"storey-2".into(), &"raised".into())
    );
    let unanswered = body["unanswered"].as_str().unwrap();
    assert!(unanswered.ends_with(" s"), "{unanswered}");
    // Its end is sent, and nothing of the other one.
    put("storey-1", 20, AlertState::Cleared).await;
    put("storey-2", 20, AlertState::Cleared).await;
    let end = escalated.recv_timeout(DEADLINE).unwrap().body;
    assert_eq!(
        (&end["parameter"], &end["state"]),
        (&"storey-2".into(), &"cleared".into())
    );
    notify.stop().expect_code(0);
    bus.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn notice_of_an_alert_in_an_earthquake_links_to_the_report() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (bus, keys) = (site.host().await, site.keys());
    let (hook, hooks) = http(0);
    let text = format!(
        "[notify]\npublic-url = \"https://bridges.example\"\n\
         [[notify.webhook]]\nurl = \"http://{hook}/\"\n[state]\nfolder = \"state\"\n"
    );
    let notify = start_notify(&site, &bus, &text).await;
    let events = bus.publish_display(keys.event()).await.unwrap();
    let quake = Event {
        structure: keys.structure().clone(),
        time_ns: 100_000_000_000,
        kind: EventKind::Earthquake,
        subject: "1970-01-01t00-01-10z".to_owned(),
        what: "earthquake begins".to_owned(),
        why: "a report follows".to_owned(),
    };
    events.put(&quake).await.unwrap();
    let alerts = keys.alert(&Name::new("storey-2").unwrap());
    let alerts = bus.publish_display(alerts).await.unwrap();
    let raised = alert(&site, 104, AlertState::Raised);
    alerts.put(&raised).await.unwrap();
    let notice = hooks.recv_timeout(DEADLINE).unwrap().body;
    let advice = notice["advice"].as_str().unwrap();
    let link = "https://bridges.example/events/house/1970-01-01t00-01-10z.html";
    assert!(advice.contains(link), "{notice}");
    notify.stop().expect_code(0);
    bus.close().await.unwrap();
}

/// A receiver learns whom to call. The bus learns who was notified, so that the page shows it.
#[tokio::test(flavor = "multi_thread")]
async fn notices_name_a_contact_and_the_bus_learns_who_was_notified() {
    let (contact, runbook) = ("Ada, +41 44 123 45 67", "https://site.example/alarm");
    let head = format!("[structure]\ncontact = \"{contact}\"\nrunbook = \"{runbook}\"\n");
    let site = Site::with(&two_storeys(DAMAGED).replacen("[structure]\n", &head, 1));
    let (bus, keys) = (site.host().await, site.keys());
    let events: Subscription<Event> = bus.subscribe(keys.event(), 64).await.unwrap();
    let (hook, hooks) = http(1);
    let text =
        format!("[[notify.webhook]]\nurl = \"http://{hook}{PATH}\"\n[state]\nfolder = \"state\"\n");
    let notify = start_notify(&site, &bus, &text).await;
    let alerts = keys.alert(&Name::new("storey-2").unwrap());
    let alerts = bus.publish_display(alerts).await.unwrap();
    let raised = alert(&site, 104, AlertState::Raised);
    alerts.put(&raised).await.unwrap();
    for _ in 0..2 {
        let notice = hooks.recv_timeout(DEADLINE).unwrap().body;
        assert_eq!(
            (&notice["contact"], &notice["runbook"]),
            (&contact.into(), &runbook.into())
        );
    }
    let host = format!("http://{hook}/");
    let expected = [
        (
            EventKind::NoticeFailed,
            format!("notice not sent to {host}"),
            "replied with 503",
        ),
        (
            EventKind::NoticeSent,
            format!("notice sent to {host}"),
            "raised at 1970-01-01T00:01:44Z",
        ),
    ];
    for (kind, what, why) in expected {
        let event: Event = loop {
            let (_, event) = within("an event", events.messages().recv_async())
                .await
                .unwrap();
            if matches!(event.kind, EventKind::NoticeFailed | EventKind::NoticeSent) {
                break event;
            }
        };
        assert_eq!((event.kind, &*event.subject), (kind, "storey-2"));
        assert!(event.what.starts_with(&what), "{event:?}");
        assert!(event.why.starts_with(why), "{event:?}");
        assert!(!event.what.contains("s3cret"), "{event:?}");
    }
    notify.stop().expect_code(0);
    bus.close().await.unwrap();
}
