//! One service fails alone, while all services run as separate processes and a simulation publishes
//! live samples.
//!
//! It is killed, finds damaged files at its start, or has a full disk. Meanwhile frames, estimates
//! and decisions must continue, and the status of no other service may report a new loss.

use crate::notify::{Request, alert, http};
use crate::support::{DEADLINE, Process, Site, SmallDisk, spandrel, two_storeys, within};
use spandrel_bus::{
    AlertMessage, AlertState, Bus, BusConfig, DisplayPublisher, HistorySpan, Mode, Name,
    ProgressWatch, Service, Status, Subscription,
};
use spandrel_service::Clock;
use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::time::Duration;

const SERVICES: [&str; 6] = [
    "ingest",
    "identify",
    "alert",
    "history",
    "notify",
    "dashboard",
];
/// Services whose progress shows that frames, estimates and decisions continue.
const MEASURING: [Service; 3] = [Service::Ingest, Service::Identify, Service::Alert];
/// Counts of a status that are no losses: a busy machine drops blocks, which the services fetch
/// again.
const FETCHED: [&str; 3] = ["duplicate-items", "fetched-items", "unkept-blocks"];
/// Time after which an unanswered change is published again.
const REPEAT_EVERY: Duration = Duration::from_secs(1);
/// Time between two looks at a condition that has no event.
const LOOK_EVERY: Duration = Duration::from_millis(100);

const RULE: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                    credibility = 0.99\nsustain-s = 3\n";

/// Losses by service and reason.
type Losses = BTreeMap<String, BTreeMap<String, u64>>;

/// All services as clients of a router. Each has a folder of its own.
struct Town {
    site: Site,
    configuration: PathBuf,
    /// The service that fails.
    victim: &'static str,
    running: BTreeMap<&'static str, Process>,
    token: String,
    notices: Receiver<Request>,
    /// Publishes alerts of a parameter that has no rule.
    alerts: DisplayPublisher<AlertMessage>,
    last_alert_s: i64,
    statuses: Subscription<Status>,
    progress: Vec<ProgressWatch>,
    /// Losses of the other services before the first failure.
    before: Losses,
    // In the order in which they must end.
    bus: Bus,
    _router: Bus,
    _disk: SmallDisk,
}

fn now_ns() -> i64 {
    Clock::of_machine().now_ns()
}

impl Town {
    /// Starts all services. The folder of `victim` is a disk of its own. Returns `None`, and prints
    /// a line, without permission to mount.
    async fn or_skip(victim: &'static str) -> Option<Self> {
        let site = Site::with(&two_storeys(RULE));
        for service in SERVICES {
            std::fs::create_dir(site.folder().join(service)).unwrap();
        }
        let disk = SmallDisk::or_skip(&site.folder().join(victim), "8m")?;
        let router = BusConfig {
            mode: Mode::Router,
            listen: vec![site.endpoint().to_owned()],
            ..BusConfig::default()
        };
        let router = Bus::open(&router).await.unwrap();
        let (receiver, notices) = http(0);
        let configuration = site.folder().join("spandrel.toml");
        let text = format!(
            "[bus]\nmode = \"client\"\n[state]\ncheckpoint-s = 0.5\n\
             [history]\ndatabase = \"history/history.sqlite\"\n\
             [dashboard]\nlisten = \"127.0.0.1:0\"\ntokens = \"dashboard/tokens.json\"\n\
             [[notify.webhook]]\nurl = \"http://{receiver}/\"\nstates = [\"raised\", \"cleared\"]\n\
             simulations = true\n"
        );
        std::fs::write(&configuration, text).unwrap();
        let mut issue = spandrel("token");
        issue.args(["ada", "--role", "viewer", "--file"]);
        issue.arg(site.folder().join("dashboard/tokens.json"));
        let token = Process::start(&mut issue).wait().expect_code(0).stdout;
        let (bus, keys) = (site.join().await, site.keys());
        let mut progress = Vec::new();
        for service in MEASURING {
            progress.push(bus.watch_progress(keys.progress(service)).await.unwrap());
        }
        let storey_2 = Name::new("storey-2").unwrap();
        let mut town = Self {
            configuration,
            victim,
            running: BTreeMap::new(),
            token: token.trim().to_owned(),
            notices,
            alerts: bus.publish_display(keys.alert(&storey_2)).await.unwrap(),
            last_alert_s: 0,
            statuses: bus.subscribe(keys.all_statuses(), 256).await.unwrap(),
            progress,
            before: Losses::new(),
            site,
            bus,
            _router: router,
            _disk: disk,
        };
        for service in SERVICES {
            town.start(service);
        }
        for service in SERVICES {
            town.wait_until_ready(service);
        }
        let mut simulate = town.site.connecting("simulate");
        simulate
            .arg("--live")
            .arg("--config")
            .arg(&town.configuration);
        town.running
            .insert("simulate", Process::start(&mut simulate));
        town.measures().await;
        town.victim_works().await;
        town.before = town.losses().await;
        Some(town)
    }

    fn start(&mut self, service: &'static str) {
        let mut command = self.site.connecting(service);
        command.arg("--config").arg(&self.configuration);
        command.env("SPANDREL_STATE__FOLDER", self.folder(service));
        self.running.insert(service, Process::start(&mut command));
    }

    fn wait_until_ready(&self, service: &str) {
        let text = match service {
            "dashboard" => "dashboard ready",
            _ => "ready structures=1",
        };
        self.running[service].wait_for_log(text);
    }

    fn folder(&self, service: &str) -> PathBuf {
        self.site.folder().join(service)
    }

    fn kill(&mut self) {
        self.running.remove(self.victim).unwrap().kill();
    }

    /// Waits until frames, estimates and decisions of the present have been published.
    async fn measures(&mut self) {
        let now_ns = now_ns();
        for (service, progress) in MEASURING.iter().zip(&mut self.progress) {
            let reached = progress.wait_for(|progress| progress.header.time_ns >= now_ns);
            within(&format!("progress of {}", service.as_str()), reached).await;
        }
    }

    /// Waits for a present status of each service but the victim, and returns their losses.
    async fn losses(&self) -> Losses {
        let now_ns = now_ns();
        let mut losses = Losses::new();
        within("a status of each other service", async {
            while losses.len() < SERVICES.len() - 1 {
                let (_, mut status) = self.statuses.messages().recv_async().await.unwrap();
                let service = status.service.as_str().to_owned();
                if status.time_ns >= now_ns && service != self.victim {
                    status
                        .drops
                        .retain(|reason, _| !FETCHED.contains(&reason.as_str()));
                    losses.insert(service, status.drops);
                }
            }
        })
        .await;
        losses
    }

    /// Checks that nothing but the victim has failed so far.
    async fn others_continue(&mut self, failure: &str) {
        if self.running.contains_key("ingest") {
            self.measures().await;
        }
        let losses = self.losses().await;
        assert_eq!(losses, self.before, "{} {failure}", self.victim);
    }

    /// Waits until the victim has processed something that happens from now on.
    async fn victim_works(&mut self) {
        match self.victim {
            "history" => self.stores().await,
            "notify" => self.notifies().await,
            "dashboard" => self.shows(),
            "ingest" => self.measures().await,
            other => unreachable!("{other} never fails here"),
        }
    }

    /// Waits until the history has a present value.
    async fn stores(&self) {
        let now_s = now_ns() as f64 / 1e9;
        let key = self.site.keys().history(&Name::new("storey-1").unwrap());
        let query = format!("{key}?points=1000");
        let is_present = |span: &HistorySpan| span.rows.time_s.last().is_some_and(|t| *t > now_s);
        within("a present value in the history", async {
            loop {
                let answers = self.bus.ask::<HistorySpan>(&query, DEADLINE).await.unwrap();
                if answers.iter().any(|(_, span)| is_present(span)) {
                    return;
                }
                tokio::time::sleep(LOOK_EVERY).await;
            }
        })
        .await;
    }

    /// Publishes a change of an alert, and waits until the receiver gets its notice.
    async fn notifies(&mut self) {
        self.last_alert_s += 1;
        let state = match self.last_alert_s % 2 {
            0 => AlertState::Cleared,
            _ => AlertState::Raised,
        };
        let change = alert(&self.site, self.last_alert_s, state);
        let is_own = |notice: &Request| notice.body["time_ns"] == change.time_ns;
        let arrives = async {
            loop {
                // Nobody repeats this change for a `notify` that subscribes just now.
                self.alerts.put(&change).await.unwrap();
                // After a kill, an earlier notice may arrive again.
                let mut notices =
                    std::iter::from_fn(|| self.notices.recv_timeout(REPEAT_EVERY).ok());
                if notices.any(|notice| is_own(&notice)) {
                    return;
                }
            }
        };
        within("the notice of a change", arrives).await;
    }

    /// Requests the structures from the page.
    fn shows(&self) {
        let said = self.running["dashboard"].log();
        let (_, address) = said.rsplit_once("dashboard ready address=").unwrap();
        let address = address.split_whitespace().next().unwrap();
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        write!(
            stream,
            "GET /api/structures HTTP/1.1\r\nHost: {address}\r\n\
             Authorization: Bearer {}\r\nConnection: close\r\n\r\n",
            self.token
        )
        .unwrap();
        let mut reply = String::new();
        stream.read_to_string(&mut reply).unwrap();
        assert!(reply.starts_with("HTTP/1.1 200"), "{reply}");
    }

    /// Waits until the victim counts something in its status.
    async fn victim_counts(&self, reason: &str) {
        within(&format!("{reason} of {}", self.victim), async {
            loop {
                let (_, status) = self.statuses.messages().recv_async().await.unwrap();
                if status.service.as_str() == self.victim && status.drops.contains_key(reason) {
                    return;
                }
            }
        })
        .await;
    }

    /// Lets the victim fail in each way, one after the other. `reason` is counted while the disk is
    /// full.
    async fn fail(&mut self, damage: impl Fn(&mut Self), reason: Option<&str>) {
        self.kill();
        self.others_continue("is killed").await;
        self.start(self.victim);
        self.wait_until_ready(self.victim);
        self.victim_works().await;
        self.others_continue("has been killed").await;

        self.kill();
        damage(self);
        self.others_continue("has had damaged files").await;
        self.victim_works().await;

        let full = fill(&self.folder(self.victim));
        if self.victim == "notify" {
            self.notifies().await; // it saves only changes
        }
        if let Some(reason) = reason {
            self.victim_counts(reason).await;
        }
        self.others_continue("has a full disk").await;
        std::fs::remove_file(full).unwrap();
        self.victim_works().await;
        self.others_continue("has had a full disk").await;
    }

    fn stop(&mut self) {
        for (_, process) in std::mem::take(&mut self.running) {
            process.stop().expect_code(0);
        }
    }
}

/// Fills a disk with a file, and returns its path.
fn fill(disk: &Path) -> PathBuf {
    let path = disk.join("filling");
    let mut file = std::fs::File::create(&path).unwrap();
    while file.write_all(&[0; 4096]).is_ok() {}
    while file.write_all(&[0; 1]).is_ok() {}
    path
}

/// Overwrites all files below a folder whose names contain `part`.
fn overwrite(folder: &Path, part: &str) {
    let mut folders = vec![folder.to_owned()];
    let mut count = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.file_name().unwrap().to_string_lossy().contains(part) {
                std::fs::write(path, "this is something else ".repeat(100)).unwrap();
                count += 1;
            }
        }
    }
    assert!(count > 0, "no file {part} in {}", folder.display());
}

/// Overwrites files of the victim, starts it, and waits until it has reported the damage.
fn start_with_damaged(part: &'static str, log: &'static str) -> impl Fn(&mut Town) {
    move |town| {
        overwrite(&town.folder(town.victim), part);
        town.start(town.victim);
        town.wait_until_ready(town.victim);
        town.running[town.victim].wait_for_log(log);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn history_fails_alone() {
    let Some(mut town) = Town::or_skip("history").await else {
        return;
    };
    let damage = start_with_damaged(".sqlite", "history.sqlite.corrupt-");
    town.fail(damage, Some("failed-writes")).await;
    town.stop();
}

#[tokio::test(flavor = "multi_thread")]
async fn notify_fails_alone() {
    let Some(mut town) = Town::or_skip("notify").await else {
        return;
    };
    let damage = start_with_damaged(".checkpoint", "checkpoint rejected");
    town.fail(damage, Some("checkpoints-not-kept")).await;
    town.stop();
}

/// The page writes no file. Its only file has the tokens.
#[tokio::test(flavor = "multi_thread")]
async fn dashboard_fails_alone() {
    let Some(mut town) = Town::or_skip("dashboard").await else {
        return;
    };
    let damage = |town: &mut Town| {
        let tokens = town.folder("dashboard").join("tokens.json");
        let kept = std::fs::read(&tokens).unwrap();
        overwrite(&town.folder("dashboard"), "tokens.json");
        town.start("dashboard");
        let ended = town.running.remove("dashboard").unwrap().wait();
        ended.expect_code(2).expect_told(&["tokens.json"]);
        std::fs::write(tokens, kept).unwrap();
        town.start("dashboard");
        town.wait_until_ready("dashboard");
    };
    town.fail(damage, None).await;
    town.stop();
}

/// Without `ingest` there are no frames. It continues with the samples that the nodes have kept.
#[tokio::test(flavor = "multi_thread")]
async fn recording_fails_alone() {
    let Some(mut town) = Town::or_skip("ingest").await else {
        return;
    };
    let damage = start_with_damaged(".mcap", "no part of this recording is readable");
    town.fail(damage, Some("frames-waiting-for-the-disk")).await;
    town.running["ingest"].wait_for_log("recording write succeeded again");
    town.stop();
    let recording = town.site.recording_in(&town.folder("ingest"));
    let spans = recording.reader().spans();
    assert!(
        !spans.is_empty() && spans.iter().all(|span| span.missing == 0),
        "{spans:?}"
    );
}
