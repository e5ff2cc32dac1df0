//! The service `judge`, fed with the estimates and temperatures of years in seconds.

use crate::support::{DEADLINE, Finished, HOUSE, Process, Site, within};
use serde_json::Value;
use spandrel_bus::{
    AlertState, Bus, ConditionDisplay, DisplayPublisher, EpochDisplay, Event, EventKind,
    JudgementCourse, JudgementDisplay, JudgementLog, JudgementState, LiveToken, MonitoringDisplay,
    MonitoringState, Name, Pace, ParameterDisplay, Service, Status, Subscription,
};
use spandrel_validate::{SeasonRow, StiffnessLoss, seasons};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, channel};

const SECOND_NS: i64 = 1_000_000_000;
/// Length of an epoch: that of the rows of the simulated seasons (s).
const EPOCH_S: i64 = 21_600;
/// First day of the series: 1 July 2024 (days since 1970-01-01 UTC).
const FIRST_DAY: i64 = 19_905;
/// Frequency of the first mode of the simulated seasons at 0 °C (Hz).
const FREQUENCY: f64 = 2.31;
/// Number of days that are published before the service must have judged them.
const DAYS_AT_ONCE: u32 = 10;

/// Returns a house whose storey is judged. The quantity `girder` has no live values.
fn house(settings: &str) -> Site {
    Site::with(&format!(
        "{HOUSE}\n[judge]\nepoch-s = {EPOCH_S}\n{settings}\n\
         [[judge.quantity]]\nname = \"storey-1\"\nis = \"stiffness\"\n\
         [[judge.quantity]]\nname = \"girder\"\nis = \"frequency\"\ncolumn = \"girder_hz\"\n\
         [[judge.condition]]\nname = \"deck\"\nunit = \"degC\"\n"
    ))
}

/// The other services, whose messages the test publishes.
struct Others {
    site: Site,
    bus: Bus,
    estimates: DisplayPublisher<ParameterDisplay>,
    conditions: DisplayPublisher<ConditionDisplay>,
    monitoring: DisplayPublisher<MonitoringDisplay>,
    status: DisplayPublisher<Status>,
    judgements: Subscription<JudgementDisplay>,
    events: Subscription<Event>,
    of_judge: Subscription<Status>,
    tokens: Vec<LiveToken>,
    /// Last judgement of each quantity and day.
    judged: BTreeMap<(i64, String), JudgementDisplay>,
}

impl Others {
    async fn start(site: Site) -> Self {
        let (bus, keys) = (site.host().await, site.keys());
        let (storey, deck) = (name("storey-1"), name("deck"));
        let node = bus.announce(keys.live(Service::Sensor, &name("shake")));
        Self {
            estimates: bus.publish_display(keys.parameter(&storey)).await.unwrap(),
            conditions: bus.publish_display(keys.condition(&deck)).await.unwrap(),
            monitoring: bus.publish_display(keys.monitoring()).await.unwrap(),
            status: {
                let key = keys.status(Service::Ingest, &name("ingest"));
                bus.publish_display(key).await.unwrap()
            },
            judgements: bus.subscribe(keys.all_judgements(), 65_536).await.unwrap(),
            events: bus.subscribe(keys.event(), 1024).await.unwrap(),
            of_judge: bus
                .subscribe(keys.statuses(Service::Judge), 4)
                .await
                .unwrap(),
            tokens: vec![node.await.unwrap()],
            judged: BTreeMap::new(),
            site,
            bus,
        }
    }

    /// Marks the only node as simulated.
    async fn simulate(&mut self) {
        let key = self.site.keys().simulated(&name("shake"));
        self.tokens.push(self.bus.announce(key).await.unwrap());
    }

    fn state_folder(&self) -> PathBuf {
        self.site.folder().join("state")
    }

    /// Starts the service, and waits until it knows the monitoring and the pace of the samples.
    async fn judge(&self) -> Process {
        let mut command = self.site.connecting("judge");
        let judge = Process::start(command.env("XDG_STATE_HOME", self.state_folder()));
        judge.wait_for_log("ready structures=1");
        while self.of_judge.messages().try_recv().is_ok() {} // of an earlier run
        // A second status follows at least one look at what has arrived before the first.
        for _ in 0..3 {
            self.report().await;
            let status = self.of_judge.messages().recv_async();
            within("a status of judge", status).await.unwrap();
        }
        judge
    }

    /// Publishes what the services ingest and alert report each second.
    async fn report(&self) {
        self.monitoring.put(&watching()).await.unwrap();
        self.status.put(&live()).await.unwrap();
    }

    /// Publishes the rows of some days. Returns once they are judged, except for the last one.
    async fn publish(&mut self, rows: &[SeasonRow], days: Range<u32>, deck: impl Fn(f64) -> f64) {
        for from in days.clone().step_by(DAYS_AT_ONCE as usize) {
            let until = (from + DAYS_AT_ONCE).min(days.end);
            self.report().await;
            for row in rows {
                if (f64::from(from)..f64::from(until)).contains(&row.day) {
                    self.put(row, deck(row.deck)).await;
                }
            }
            // An epoch is closed in the second next one, and a day with the first epoch of the
            // next.
            self.wait_for(FIRST_DAY + i64::from(until) - 2).await;
        }
    }

    async fn put(&self, row: &SeasonRow, deck: f64) {
        let time_ns = row.time_s() as i64 * SECOND_NS;
        let condition = ConditionDisplay {
            structure: name("house"),
            name: name("deck"),
            time_ns,
            value: deck,
            unit: "degC".to_owned(),
            interval_s: Some(EPOCH_S as f64),
            instrument: None,
        };
        self.conditions.put(&condition).await.unwrap();
        if let Some(frequency) = row.frequencies[0] {
            let ratio = (frequency / FREQUENCY).powi(2);
            let (structure, storey) = (name("house"), name("storey-1"));
            let estimate = ParameterDisplay::of_normal(&structure, &storey, time_ns, ratio, 1e-6);
            self.estimates.put(&estimate).await.unwrap();
        }
    }

    /// Collects the judgements up to a day.
    async fn wait_for(&mut self, day: i64) {
        let what = format!("the judgement of day {day}");
        let (judgements, judged) = (self.judgements.messages().clone(), &mut self.judged);
        within(&what, async {
            loop {
                let (_, display) = judgements.recv_async().await.unwrap();
                let Some(day_ns) = display.day_ns else {
                    continue;
                };
                let found = day_ns / (86_400 * SECOND_NS);
                judged.insert((found, display.quantity.to_string()), display.clone());
                if found >= day && display.quantity.as_str() == "storey-1" {
                    return;
                }
            }
        })
        .await;
    }

    /// Returns the words of a quantity in the order of their first appearance. If several days end
    /// at once, only the last one is published.
    fn words(&self, quantity: &str) -> Vec<&'static str> {
        let of_it = self.judged.iter().filter(|((_, name), _)| name == quantity);
        let mut words = Vec::new();
        for (_, display) in of_it {
            if !words.contains(&display.word()) {
                words.push(display.word());
            }
        }
        words
    }

    /// Returns the answer of the service to a query for the course of the storey.
    async fn course(&self, query: &str) -> JudgementCourse {
        let key = self.site.keys().judgement_course(&name("storey-1"));
        let answers = self.bus.ask(&format!("{key}{query}"), DEADLINE).await;
        let [(of, course)] = <[(String, JudgementCourse); 1]>::try_from(answers.unwrap()).unwrap();
        assert_eq!(of, key);
        course
    }

    /// Returns the past states of the lasting loss of the storey, as the service answers.
    async fn loss_states(&self) -> Vec<AlertState> {
        let key = self.site.keys().judgement_log();
        let answers = self.bus.ask(&key, DEADLINE).await;
        let [(_, log)] = <[(String, JudgementLog); 1]>::try_from(answers.unwrap()).unwrap();
        let of_it = log.changes.iter();
        let of_it = of_it.filter(|change| change.quantity.as_str() == "storey-1");
        of_it.map(|change| change.state).collect()
    }

    /// Runs `spandrel annotate`, and returns what it prints.
    fn annotate(&self, options: &[&str]) -> String {
        let mut command = crate::support::spandrel("annotate");
        command.arg("house").args(options).args(["--who", "ada"]);
        let root = self.site.keys().root().to_string();
        command.args(["--root", &root, "--connect", self.site.endpoint()]);
        Process::start(&mut command).wait().expect_code(0).stdout
    }

    /// Starts `spandrel watch`, which prints lines.
    fn watch(&self) -> Process {
        let mut command = crate::support::spandrel("watch");
        let root = self.site.keys().root().to_string();
        command.args(["house", "--root", &root, "--connect", self.site.endpoint()]);
        Process::start(&mut command)
    }

    /// Waits for a state of the storey.
    async fn state_where(&self, what: &str, is_it: impl Fn(&JudgementDisplay) -> bool) {
        within(what, async {
            loop {
                let (_, display) = self.judgements.messages().recv_async().await.unwrap();
                if display.quantity.as_str() == "storey-1" && is_it(&display) {
                    return;
                }
            }
        })
        .await;
    }

    /// Returns the course by `spandrel judge --series` of the storey, without the last day, which
    /// is not over.
    fn offline_course(&self) -> String {
        let series = find(&self.state_folder(), "judge-epochs.csv");
        let days = self.site.folder().join("days.csv");
        let mut command = crate::support::spandrel("judge");
        command.arg(self.site.structure_file()).arg("--series");
        command.arg(&series).arg("--course").arg(&days);
        let annotations = series.with_file_name("judge-annotations.jsonl");
        if annotations.exists() {
            command.arg("--annotations").arg(annotations);
        }
        Process::start(&mut command).wait().expect_code(0);
        let text = std::fs::read_to_string(days).unwrap();
        let mut lines: Vec<&str> = text
            .lines()
            .filter(|line| line.starts_with("date,") || line.contains(",storey-1,"))
            .collect();
        lines.pop();
        lines.join("\n") + "\n"
    }

    /// Runs `spandrel judge --at` for the time of an epoch.
    fn past(&self, epoch_ns: i64, options: &[&str]) -> Finished {
        let at = format!(
            "{}.{:09}",
            epoch_ns / SECOND_NS,
            epoch_ns.rem_euclid(SECOND_NS)
        );
        let root = self.site.keys().root().to_string();
        let mut command = crate::support::spandrel("judge");
        command.env("XDG_STATE_HOME", self.state_folder());
        command.arg(self.site.structure_file());
        command.args(["--root", &root, "--at", &at]).args(options);
        Process::start(&mut command).wait()
    }

    /// Checks that `spandrel judge --at` repeats what the service published.
    fn assert_is_repeated(&self, published: &JudgementDisplay) {
        let name = published.configuration.as_deref().unwrap();
        let options = ["--json", "--with-configuration", name];
        let said = self.past(published.epoch_ns.unwrap(), &options);
        let stdout = said.expect_code(0).stdout;
        let mut lines = stdout.lines();
        let configuration: Value = serde_json::from_str(lines.next().unwrap()).unwrap();
        assert_eq!(configuration["configuration"], name);
        let displays = lines.map(|line| serde_json::from_str::<JudgementDisplay>(line).unwrap());
        let mut displays = displays.filter(|display| display.quantity == published.quantity);
        let repeated = displays.next().unwrap();
        let expected = JudgementDisplay {
            time_ns: repeated.time_ns,
            ..published.clone()
        };
        assert_eq!(repeated, expected);
    }

    fn last(&self) -> &JudgementDisplay {
        let mut of_it = self.judged.iter().rev();
        of_it.find(|((_, name), _)| name == "storey-1").unwrap().1
    }

    /// Returns the judgements of the saved epochs by `spandrel judge --series`.
    fn offline(&self) -> BTreeMap<(i64, String), Value> {
        let root = self.site.keys().root().to_string();
        let series = find(&self.state_folder(), "judge-epochs.csv");
        assert!(series.to_string_lossy().contains(&root), "{series:?}");
        let mut command = crate::support::spandrel("judge");
        command.arg(self.site.structure_file()).arg("--series");
        let said = Process::start(command.arg(series).arg("--json")).wait();
        let said = said.expect_code(0);
        let lines = said.stdout.lines().map(|line| {
            let line: Value = serde_json::from_str(line).unwrap();
            let quantity = line["quantity"].as_str().unwrap().to_owned();
            let date: jiff::civil::Date = line["date"].as_str().unwrap().parse().unwrap();
            let since = date - jiff::civil::date(1970, 1, 1);
            ((i64::from(since.get_days()), quantity), line)
        });
        lines.collect()
    }
}

fn find(folder: &std::path::Path, file: &str) -> PathBuf {
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.file_name().is_some_and(|name| name == file) {
                return path;
            }
        }
    }
    panic!("no {file} below {}", folder.display());
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn watching() -> MonitoringDisplay {
    MonitoringDisplay {
        structure: name("house"),
        time_ns: 0,
        measured_ns: None,
        state: MonitoringState::Watching,
        since_ns: 0,
        reasons: Vec::new(),
        parameters: Vec::new(),
        channels: Vec::new(),
    }
}

fn live() -> Status {
    let text = "{\"structure\":\"house\",\"service\":\"ingest\",\"id\":\"ingest\",\"time_ns\":1,\
                \"lag_s\":0.0,\"done\":0,\"drops\":{},\"restarts\":0,\"version\":\"0\"}";
    Status {
        pace: Some(Pace::Live),
        ..serde_json::from_str(text).unwrap()
    }
}

/// Serves a webhook, and returns the bodies of the requests.
fn webhook() -> (SocketAddr, Receiver<Value>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, bodies) = channel();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut reader = BufReader::new(stream.try_clone().unwrap());
            let (mut line, mut length) = (String::new(), 0);
            while reader.read_line(&mut line).unwrap_or(0) > 2 {
                if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                line.clear();
            }
            let mut body = vec![0; length];
            reader.read_exact(&mut body).unwrap();
            let answer = "HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
            stream.write_all(answer.as_bytes()).unwrap();
            // The test may have ended.
            let _ = sender.send(serde_json::from_slice(&body).unwrap());
        }
    });
    (address, bodies)
}

/// Starts notices to a webhook.
async fn notify(others: &Others, address: SocketAddr) -> Process {
    let configuration = others.site.folder().join("spandrel.toml");
    let text = format!(
        "[notify]\n[[notify.webhook]]\nurl = \"http://{address}/\"\nstates = [\"lasting-loss\"]\n"
    );
    std::fs::write(&configuration, text).unwrap();
    let mut command = others.site.connecting("notify");
    let notify = Process::start(command.arg("--config").arg(&configuration));
    notify.wait_for_log("ready structures=1");
    notify
}

#[tokio::test(flavor = "multi_thread")]
async fn a_loss_after_a_year_is_found_across_a_kill_and_as_offline_bit_for_bit() {
    let loss = StiffnessLoss {
        share: 0.05,
        day: 480,
        repair_day: None,
    };
    let rows = seasons(1, 510, Some(loss));
    let mut others = Others::start(house("commissioning-days = 365")).await;
    let (address, bodies) = webhook();
    let notify = notify(&others, address).await;
    let judge = others.judge().await;
    others.publish(&rows, 0..430, |deck| deck).await;
    let found = ["lasting-loss", "learned-away", "stiffer"];
    let before = others.words("storey-1");
    assert_eq!(
        (before.first(), before.last()),
        (Some(&"learning"), Some(&"judged"))
    );
    assert!(
        !before.iter().any(|word| found.contains(word)),
        "{before:?}"
    );
    judge.kill();
    // The epochs that were open are lost.
    let judge = others.judge().await;
    others.publish(&rows, 430..510, |deck| deck).await;

    let words = others.words("storey-1");
    let first = words.iter().find(|word| found.contains(word));
    assert_eq!(
        (first, words.last()),
        (Some(&"lasting-loss"), Some(&"lasting-loss"))
    );
    assert!(others.words("girder").contains(&"no-statement"));
    let last = others.last().clone();
    let change = last.change.unwrap();
    assert!(last.measured);
    assert!(
        last.sentence.starts_with("storey-1 has lost ")
            && last.sentence.contains(" % of stiffness (95 % interval "),
        "{}",
        last.sentence
    );
    assert!(
        change.interval.low < 0.05 && 0.05 < change.interval.high,
        "{change:?}"
    );
    let found_day = change.found_ns / (86_400 * SECOND_NS) - FIRST_DAY;
    assert!((480..510).contains(&found_day), "found on day {found_day}");

    let offline = others.offline();
    assert!(others.judged.len() > 100, "{}", others.judged.len());
    for (key, display) in &others.judged {
        let line = &offline[key];
        assert_eq!(line["state"], display.state.as_str(), "{key:?}");
        assert_eq!(line["sentence"], display.sentence.as_str(), "{key:?}");
        let found = display.change.map(|change| {
            let ends = [change.interval.low, change.interval.high].map(f64::to_bits);
            (
                change.kind.as_str(),
                change.loss.to_bits(),
                ends[0],
                ends[1],
            )
        });
        let expected = line["finding"].as_object().map(|finding| {
            let ends = finding["interval"].as_array().unwrap();
            (
                finding["kind"].as_str().unwrap(),
                bits(&finding["loss"]),
                bits(&ends[0]),
                bits(&ends[1]),
            )
        });
        assert_eq!(found, expected, "{key:?}");
        let found = display.expectation.map(|expectation| {
            [
                expectation.measured,
                expectation.expected,
                expectation.interval.low,
                expectation.interval.high,
                expectation.residual,
                expectation.ln_evidence,
                expectation.ln_threshold,
                expectation.cusum_share,
            ]
            .map(f64::to_bits)
        });
        let expected = line["expectation"].as_object().map(|expectation| {
            [
                &expectation["measured"],
                &expectation["expected"],
                &expectation["interval"][0],
                &expectation["interval"][1],
                &expectation["residual"],
                &expectation["ln_evidence"],
                &expectation["ln_threshold"],
                &expectation["cusum_share"],
            ]
            .map(bits)
        });
        assert_eq!(found, expected, "{key:?}");
    }

    // The course has every day, also the days that were over at once and were not published.
    let course = others.course("").await;
    assert_eq!(course.csv(), others.offline_course());
    let days: Vec<i64> = course
        .rows
        .iter()
        .map(|row| row.day_ns / (86_400 * SECOND_NS) - FIRST_DAY)
        .collect();
    assert_eq!(days, (0..509).collect::<Vec<_>>());
    let published = others.judged.keys().filter(|(_, of)| of == "storey-1");
    assert!(published.count() < days.len());
    let reference = course.reference.as_ref().unwrap();
    assert_eq!(reference.promised_per_year, 0.05);
    let span = others
        .course("?from=2025-10-01;to=2025-10-31;points=10")
        .await;
    assert_eq!(span.rows, course.rows[478..488]);
    assert_eq!(span.kept_from_ns, course.kept_from_ns);
    judge.kill();
    let judge = others.judge().await;
    assert_eq!(others.course("").await.rows, course.rows);

    // One event, and one notice although the state is published again and again.
    let events: Vec<Event> = others
        .events
        .messages()
        .drain()
        .map(|(_, event)| event)
        .collect();
    let changes: Vec<&Event> = events
        .iter()
        .filter(|event| event.kind == EventKind::LastingChange)
        .collect();
    let told: Vec<&str> = changes.iter().map(|event| event.what.as_str()).collect();
    assert_eq!(told, ["lasting-loss"], "{events:?}");
    let body = tokio::task::block_in_place(|| bodies.recv_timeout(DEADLINE).unwrap());
    assert_eq!(
        (&body["kind"], &body["quantity"], &body["origin"]),
        (&"judgement".into(), &"storey-1".into(), &"measured".into())
    );
    others.wait_for(FIRST_DAY + 508).await; // at least one repetition
    notify.stop().expect_code(0);
    assert!(bodies.try_recv().is_err());
    judge.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_change_is_seen_and_a_new_reference_begins_as_offline_and_after_a_kill() {
    let loss = StiffnessLoss {
        share: 0.15,
        day: 45,
        repair_day: None,
    };
    let rows = seasons(1, 100, Some(loss));
    let mut others = Others::start(house(SHORT)).await;
    let judge = others.judge().await;
    others.publish(&rows, 0..70, |deck| deck).await;
    assert_eq!(others.last().word(), "lasting-loss");
    let watch = others.watch();
    let shows = |state: &str| {
        let line = format!("alert house/storey-1 (lasting loss) {state}: storey-1 ");
        watch.wait_for_output(&line, |text| text.contains(&line));
    };
    shows("raised");
    let told = others.annotate(&["inspection", "crack", "--seen", "--quantity", "storey-1"]);
    assert_eq!(told, "storey-1: inspection: acknowledged, ada: crack\n");
    let is_seen = |display: &JudgementDisplay| {
        let seen = display.seen.as_ref();
        seen.is_some_and(|seen| seen.who == "ada" && seen.text == "crack")
    };
    others.state_where("a change that was seen", is_seen).await;
    shows("acknowledged");

    // The bearings were replaced on day 60, which is past.
    let from = ((FIRST_DAY + 60) * 86_400 + 43_200).to_string();
    let new = ["repair", "new bearings", "--new-reference", "--from", &from];
    others.annotate(&new);
    let is_new = |display: &JudgementDisplay| {
        display.change.is_none() && display.state == JudgementState::Learning
    };
    others.state_where("a new reference", is_new).await;
    shows("cleared");
    watch.stop();
    let course = others.course("").await;
    assert_eq!(course.annotations.len(), 2);
    assert!(course.rows[59].change.is_some());
    assert_eq!((course.rows[60].change, course.rows[60].epochs), (None, 2));
    assert_eq!(course.csv(), others.offline_course());

    judge.kill();
    let judge = others.judge().await;
    assert_eq!(others.course("").await, course);
    let states = [
        AlertState::Raised,
        AlertState::Acknowledged,
        AlertState::Cleared,
    ];
    assert_eq!(others.loss_states().await, states);
    others.publish(&rows, 70..100, |deck| deck).await;
    let course = others.course("").await;
    assert_eq!(course.csv(), others.offline_course());
    assert_eq!(course.rows.last().unwrap().state, JudgementState::Judged);
    assert_eq!(course.rows.last().unwrap().change, None);
    let events = others.events.messages().drain();
    let noted: Vec<(String, String)> = events
        .filter(|(_, event)| event.kind == EventKind::Annotation)
        .map(|(_, event)| (event.what, event.why))
        .collect();
    let text = |text: &str| text.to_owned();
    assert_eq!(
        noted,
        [
            (text("inspection: acknowledged"), text("ada: crack")),
            (text("repair: new reference"), text("ada: new bearings")),
        ]
    );
    judge.stop().expect_code(0);
}

fn bits(value: &Value) -> u64 {
    value.as_f64().unwrap().to_bits()
}

/// Settings of a short commissioning.
const SHORT: &str = "commissioning-days = 30\naccept-short-commissioning = true";

#[tokio::test(flavor = "multi_thread")]
async fn a_loss_of_simulated_samples_is_judged_and_pages_nobody() {
    let loss = StiffnessLoss {
        share: 0.15,
        day: 45,
        repair_day: None,
    };
    let rows = seasons(1, 70, Some(loss));
    let mut others = Others::start(house(SHORT)).await;
    others.simulate().await;
    let (address, bodies) = webhook();
    let notify = notify(&others, address).await;
    let judge = others.judge().await;
    let of_notify: Subscription<Status> = {
        let key = others.site.keys().statuses(Service::Notify);
        others.bus.subscribe(key, 64).await.unwrap()
    };
    others.publish(&rows, 0..70, |deck| deck).await;
    let last = others.last();
    assert_eq!(last.word(), "lasting-loss", "{last:?}");
    assert!(!last.measured);
    within("a notice that is not sent", async {
        loop {
            let (_, status) = of_notify.messages().recv_async().await.unwrap();
            if status.drops.get("simulated-notices") == Some(&1) {
                return;
            }
        }
    })
    .await;
    notify.stop().expect_code(0);
    assert!(bodies.try_recv().is_err());
    judge.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_past_judgement_is_repeated_with_the_configuration_of_then() {
    let loss = StiffnessLoss {
        share: 0.15,
        day: 45,
        repair_day: None,
    };
    let rows = seasons(1, 80, Some(loss));
    let mut others = Others::start(house(SHORT)).await;
    let judge = others.judge().await;
    others.publish(&rows, 0..70, |deck| deck).await;
    let before: Vec<JudgementDisplay> = others.judged.values().cloned().collect();
    judge.kill();
    let file = others.site.structure_file().to_owned();
    let text = std::fs::read_to_string(&file).unwrap();
    let other = format!("false-alarms-per-year = 0.05\n{SHORT}");
    std::fs::write(&file, text.replace(SHORT, &other)).unwrap();
    let judge = others.judge().await;
    others.publish(&rows, 70..80, |deck| deck).await;
    let last = others.last().clone();
    assert_eq!(last.false_alarms_per_year, 0.05);
    others.assert_is_repeated(&last);
    let found = before.iter().find(|display| display.change.is_some());
    let found = found.unwrap();
    let (first, second) = (&found.configuration, &last.configuration);
    assert_ne!(first, second);
    for published in [found, &before[0], before.last().unwrap()] {
        assert_eq!(&published.configuration, first);
        others.assert_is_repeated(published);
    }

    // Also while the service runs, and for people.
    let (epoch_ns, first) = (found.epoch_ns.unwrap(), first.as_deref().unwrap());
    let said = others.past(epoch_ns, &[]).expect_code(0).stdout;
    for part in [
        format!("configuration {first} since "),
        "0.1 false alarms per year, loss 2.0 %".to_owned(),
        format!("storey-1: {}: {}", found.word(), found.sentence),
    ] {
        assert!(said.contains(&part), "{part}\n{said}");
    }
    let second = second.as_deref().unwrap();
    others
        .past(epoch_ns, &["--with-configuration", second])
        .expect_code(2)
        .expect_told(&[&format!(
            "configuration {second} was not in force; {first} was"
        )]);
    let too_early = (FIRST_DAY - 1) * 86_400 * SECOND_NS;
    others
        .past(too_early, &[])
        .expect_code(2)
        .expect_told(&["the first saved epoch is that of 2024-07-01T"]);
    let file = find(&others.state_folder(), "judge-configurations.jsonl");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replacen("0.02", "0.03", 1)).unwrap();
    others
        .past(epoch_ns, &[])
        .expect_code(1)
        .expect_told(&["judge-configurations.jsonl:1: is damaged"]);
    std::fs::remove_file(&file).unwrap();
    others
        .past(epoch_ns, &[])
        .expect_code(2)
        .expect_told(&["judge-configurations.jsonl: contains no configuration"]);
    judge.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_thermometer_gives_no_statement() {
    let rows = seasons(1, 45, None);
    let mut others = Others::start(house(SHORT)).await;
    let judge = others.judge().await;
    others.publish(&rows, 0..40, |deck| deck).await;
    assert_ne!(others.last().state, JudgementState::NoStatement);
    others.publish(&rows, 40..45, |_| 15.0).await;
    let last = others.last();
    assert_eq!(last.state, JudgementState::NoStatement, "{last:?}");
    assert_eq!(
        last.sentence,
        "storey-1 is not judged, because deck has not changed for a day or longer."
    );
    judge.stop().expect_code(0);
}

#[tokio::test(flavor = "multi_thread")]
async fn each_epoch_is_published_once_as_it_is_saved() {
    let rows = seasons(1, 6, None);
    let mut others = Others::start(house(SHORT)).await;
    let epochs: Subscription<EpochDisplay> = {
        let key = others.site.keys().epoch(&name("storey-1"));
        others.bus.subscribe(key, 1024).await.unwrap()
    };
    let judge = others.judge().await;
    others.publish(&rows, 0..6, |deck| deck).await;
    judge.stop().expect_code(0);
    let file = std::fs::read_to_string(find(&others.state_folder(), "judge-epochs.csv")).unwrap();
    let number = |field: &str| field.parse::<f64>().ok();
    let saved = file.lines().skip(1).map(|line| {
        let fields: Vec<&str> = line.split(',').collect(); // time, storey-1, girder, deck, …
        let ln_mean = number(fields[1]).map(f64::ln);
        (
            number(fields[0]).unwrap() as i64,
            ln_mean,
            number(fields[3]),
        )
    });
    let saved: Vec<_> = saved.collect();
    assert!(saved.len() > 4 * 3, "{saved:?}");
    for expected in saved {
        let next = within("an epoch", epochs.messages().recv_async()).await;
        let (_, display) = next.unwrap();
        let deck = &display.conditions[0];
        let found = (display.time_ns / SECOND_NS, display.ln_mean, deck.value);
        assert_eq!(found, expected);
        assert_eq!(display.epoch_s, EPOCH_S as f64);
        assert_eq!(display.ln_std.is_some(), display.ln_mean.is_some());
        assert_eq!(deck.name, name("deck"));
    }
    assert!(epochs.messages().try_recv().is_err());
}

#[test]
fn a_past_judgement_needs_one_structure_and_a_time() {
    let site = house(SHORT);
    let mut command = crate::support::spandrel("judge");
    Process::start(command.args(["--at", "2026-03-01"]))
        .wait()
        .expect_code(2)
        .expect_told(&["0 structure files are given with --at, must be 1"]);
    let mut command = crate::support::spandrel("judge");
    command.arg(site.structure_file());
    Process::start(command.args(["--at", "yesterday"]))
        .wait()
        .expect_code(2)
        .expect_told(&["--at: \"yesterday\", must be seconds since 1970"]);
}

#[test]
fn judge_without_series_needs_a_judged_structure() {
    let site = Site::with(HOUSE);
    Process::start(&mut site.listening("judge"))
        .wait()
        .expect_code(2)
        .expect_told(&["no structure has a table [judge]"]);
    let mut command = site.listening("judge");
    Process::start(command.arg("--report"))
        .wait()
        .expect_code(2)
        .expect_told(&["--report and --course need --series"]);
}
