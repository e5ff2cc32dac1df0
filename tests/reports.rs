//! The service `reports`: a yielding building through the services. Its live reports have the
//! numbers of `spandrel earthquake`, also after crashes, and a folder that cannot be written is no
//! crash.

use crate::earthquake::{FLOORS, RATE_HZ, building, respond};
use crate::support::{DEADLINE, Process, Record, Site, spandrel, within};
use rand::{RngExt as _, SeedableRng};
use serde_json::Value;
use spandrel_bus::{AlertMessage, AlertState, Bus, Event, EventKind, Subscription};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};

/// Time of the first sample (s since 1970-01-01 UTC).
const START_S: i64 = 1_600_000_000;
/// Peak of the ground in a weak and in the strong earthquake, and of the ambient motion (m/s²).
const WEAK: f64 = 0.15;
const STRONG: f64 = 6.0;
const AMBIENT: f64 = 0.02;

/// The building with the limits of its reports.
fn watched_building(settings: &str) -> Site {
    Site::with(&format!(
        "{}\n[earthquakes]\ntrigger-m-per-s2 = 0.15\n{settings}",
        building()
    ))
}

/// A recording of ambient motion with earthquakes: their times (s) and peaks (m/s²).
struct Course {
    table: PathBuf,
    lines: Vec<String>,
}

impl Course {
    fn new(folder: &Path, seconds: usize, quakes: &[(f64, f64)]) -> Self {
        Self::of_first_storey(folder, seconds, quakes, 1.0)
    }

    /// As [`Course::new`], with this share of the stiffness of the first storey.
    fn of_first_storey(
        folder: &Path,
        seconds: usize,
        quakes: &[(f64, f64)],
        first_storey: f64,
    ) -> Self {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(11);
        let mut level = 0.0;
        let ground: Vec<f64> = (0..seconds * RATE_HZ as usize)
            .map(|frame| {
                let time_s = frame as f64 / RATE_HZ;
                // Its standard deviation is 0.87, and its peak in 20 s is about 3.
                level = 0.75 * level + random.random_range(-1.0..1.0);
                let envelope = |(at_s, peak): &(f64, f64)| match time_s - at_s {
                    t if t < 0.0 => 0.0,
                    t if t < 3.0 => peak * t / 3.0,
                    t if t < 9.0 => *peak,
                    t => peak * (-(t - 9.0) / 3.0).exp(),
                };
                let peak = quakes.iter().map(envelope).fold(AMBIENT, f64::max);
                peak * level / 3.0
            })
            .collect();
        let rows = respond(&ground, first_storey, &mut random);
        let line = |(frame, row): (usize, &[f64; FLOORS + 1])| {
            let values: Vec<String> = row.iter().map(|value| format!("{value:.6}")).collect();
            let (second, hundredth) = (START_S + (frame / 100) as i64, frame % 100);
            format!("{second}.{hundredth:02},{}\n", values.join(","))
        };
        let lines: Vec<String> = rows.iter().enumerate().map(line).collect();
        let table = folder.join("course.csv");
        std::fs::write(&table, header() + &lines.concat()).unwrap();
        Self { table, lines }
    }

    fn record(&self) -> Record {
        Record::read(&self.table)
    }

    /// Cuts this recording as a report states its span, and returns the numbers of the offline
    /// command for all parts.
    fn offline(&self, site: &Site, reports: &BTreeMap<String, Value>) -> BTreeMap<String, Value> {
        let folder = site.folder().join("offline");
        std::fs::create_dir_all(&folder).unwrap();
        let mut command = spandrel("earthquake");
        command.arg(site.structure_file());
        for report in reports.values() {
            let kept = events_folder(site).join(report["record"].as_str().unwrap());
            let kept = std::fs::read_to_string(kept).unwrap();
            let first = kept.lines().nth(1).unwrap().split(',').next().unwrap();
            let first: f64 = first.parse().unwrap();
            let from = ((first - START_S as f64) * RATE_HZ).round() as usize;
            let frames = (report["length_s"].as_f64().unwrap() * RATE_HZ).round() as usize;
            let part = folder.join(report["record"].as_str().unwrap());
            let lines = self.lines[from..from + frames].concat();
            std::fs::write(&part, header() + &lines).unwrap();
            command.arg(part);
        }
        let made = folder.join("reports");
        command.arg("--report").arg(&made);
        Process::start(&mut command).wait().expect_code(0);
        json_of(&made)
    }
}

fn header() -> String {
    "time,ground,floor-1,floor-2,floor-3\n".to_owned()
}

/// Returns the reports in a folder by their names.
fn json_of(folder: &Path) -> BTreeMap<String, Value> {
    let files = std::fs::read_dir(folder).unwrap();
    let paths = files.map(|file| file.unwrap().path());
    let reports = paths.filter(|path| path.extension().is_some_and(|found| found == "json"));
    reports
        .map(|path| {
            let name = path.file_stem().unwrap().to_string_lossy().into_owned();
            (
                name,
                serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap(),
            )
        })
        .collect()
}

fn state_folder(site: &Site) -> PathBuf {
    site.folder().join("state")
}

fn events_folder(site: &Site) -> PathBuf {
    let keys = site.keys();
    let (root, structure) = (keys.root().to_string(), keys.structure().to_string());
    state_folder(site)
        .join("spandrel")
        .join(root)
        .join(structure)
        .join("events")
}

/// Starts all services, and returns them with the address of the page.
fn run(site: &Site) -> (Process, String) {
    let mut command = site.listening("run");
    command.env("XDG_STATE_HOME", state_folder(site));
    let run = Process::start(command.args(["--http", "127.0.0.1:0"]));
    run.wait_for_log("reports of earthquakes ready");
    run.wait_for_output("address of the page", |said| said.contains("page: http"));
    let said = run.output();
    let address = said.split("http://").nth(1).unwrap();
    let address = address.split(['/', '\n']).next().unwrap().to_owned();
    run.wait_for_log("ready structures=1");
    (run, address)
}

/// Requests a path of the page, and returns the status, the head and the body.
fn get(address: &str, path: &str) -> (u16, String, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut reply = String::new();
    stream.read_to_string(&mut reply).unwrap();
    let (head, body) = reply.split_once("\r\n\r\n").unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    (status, head.to_lowercase(), body.to_owned())
}

/// Collects the events of one kind until there are this many.
async fn events_of(
    events: &Subscription<Event>,
    kind: EventKind,
    count: usize,
    all: &mut Vec<Event>,
) {
    within(&format!("{count} events {kind:?}"), async {
        while all.iter().filter(|event| event.kind == kind).count() < count {
            all.push(events.messages().recv_async().await.unwrap().1);
        }
    })
    .await;
}

async fn listen(site: &Site) -> (Bus, Subscription<Event>) {
    let bus = site.join().await;
    let events = bus.subscribe(site.keys().event(), 1024).await.unwrap();
    (bus, events)
}

/// The strong earthquake follows five weak ones. Weak motion is recorded five minutes and an hour
/// later.
const QUAKES: [(f64, f64); 6] = [
    (60.0, WEAK),
    (180.0, WEAK),
    (300.0, WEAK),
    (420.0, WEAK),
    (540.0, WEAK),
    (660.0, STRONG),
];

#[tokio::test(flavor = "multi_thread")]
async fn live_reports_have_the_numbers_of_the_offline_command_and_are_on_the_page() {
    let site = watched_building("loss = 0.08\n");
    let course = Course::new(site.folder(), 4480, &QUAKES);
    let (_run, address) = run(&site);
    let (_bus, events) = listen(&site).await;
    site.replay(&course.record(), "max").wait().expect_code(0);
    let mut all = Vec::new();
    let count = QUAKES.len() + 2;
    events_of(&events, EventKind::EarthquakeReport, count, &mut all).await;
    let of = |kind| all.iter().filter(move |event| event.kind == kind);
    let began: Vec<&Event> = of(EventKind::Earthquake).collect();
    assert_eq!(began.len(), QUAKES.len());
    for (event, (at_s, _)) in began.iter().zip(QUAKES) {
        let after_s = event.time_ns as f64 / 1e9 - START_S as f64 - at_s;
        assert!((0.0..6.0).contains(&after_s), "{event:?}");
    }
    let made: Vec<&Event> = of(EventKind::EarthquakeReport).collect();
    let subjects: Vec<&str> = made.iter().map(|event| event.subject.as_str()).collect();
    let announced: Vec<&str> = began.iter().map(|event| event.subject.as_str()).collect();
    assert_eq!(subjects[..QUAKES.len()], announced);
    for event in &made {
        let path = format!("/events/block-7/{}.html", event.subject);
        assert!(event.why.contains(&path), "{event:?}");
    }
    for (event, after) in made[QUAKES.len()..].iter().zip(["5 min", "1 h"]) {
        let start = format!("Weak motion {after} after");
        assert!(event.why.starts_with(&start), "{event:?}");
    }

    let live = json_of(&events_folder(&site));
    assert_eq!(live.len(), count);
    let offline = course.offline(&site, &live);
    assert_eq!(live, offline);
    let reports: Vec<&Value> = live.values().collect();
    println!("{}\n{}", reports[5]["headline"], reports[7]["headline"]);
    // The building yields, and has lost nothing five minutes and an hour later.
    let judgement = |report: &Value| report["parameters"][0]["judgement"].clone();
    assert_eq!(reports[5]["urgency"], "inspect");
    for later in &reports[6..] {
        let lasting = judgement(later)["lasting"].clone();
        let since = lasting.as_array().unwrap().iter();
        let mut since = since.filter(|candidate| candidate["since"] == 5);
        let loss = since.next().unwrap()["loss"].clone();
        assert_eq!(loss["is_raised"], false, "{loss}");
    }

    let path = format!("/events/block-7/{}", made[5].subject);
    let (status, head, html) = get(&address, &format!("{path}.html"));
    assert_eq!(status, 200);
    assert!(
        head.contains("content-security-policy: default-src 'none'"),
        "{head}"
    );
    assert!(
        html.contains("Earthquake report") && html.contains("<svg"),
        "{html}"
    );
    let (status, _, json) = get(&address, &format!("{path}.json"));
    let served: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((status, &served), (200, reports[5]));
    let (status, _, index) = get(&address, "/events/block-7/index.html");
    assert_eq!(status, 200);
    for name in live.keys() {
        let linked = format!("/events/block-7/{name}.html");
        assert!(index.contains(&format!("{name}.html")), "{name}: {index}");
        assert_eq!(get(&address, &linked).0, 200);
    }
    assert!(
        index.contains("is judged again 1 d after") && index.contains("is judged again 7 d after"),
        "the day and the week after are due: {index}"
    );
    for missing in ["2020-01-01t00-00-00z.html", "../../spandrel.toml", "x.csv"] {
        assert_eq!(get(&address, &format!("/events/block-7/{missing}")).0, 404);
    }
    assert_eq!(get(&address, "/events/nobody/index.html").0, 404);
}

/// Kills all services in the strong motion, and removes a report that then was due while they were
/// down.
#[tokio::test(flavor = "multi_thread")]
async fn crash_in_the_strong_motion_changes_no_report_and_a_due_report_is_made_at_the_start() {
    let site = watched_building("again-after-s = [300.0]\n");
    let course = Course::new(site.folder(), 1160, &QUAKES);
    let (first, _) = run(&site);
    let (bus, events) = listen(&site).await;
    let replay = site.replay(&course.record(), "60");
    let mut all = Vec::new();
    events_of(&events, EventKind::Earthquake, QUAKES.len(), &mut all).await;
    first.kill();
    drop(bus);
    let (second, _) = run(&site);
    let (bus, events) = listen(&site).await;
    replay.wait().expect_code(0);
    let later = |event: &&Event| event.why.starts_with("Weak motion 5 min after");
    let mut all = Vec::new();
    while all.iter().find(later).is_none() {
        let known = all
            .iter()
            .filter(|event: &&Event| event.kind == EventKind::EarthquakeReport);
        let count = known.count() + 1;
        events_of(&events, EventKind::EarthquakeReport, count, &mut all).await;
    }
    let live = json_of(&events_folder(&site));
    assert_eq!(live.len(), QUAKES.len() + 1);
    assert_eq!(live, course.offline(&site, &live));

    second.kill();
    drop(bus);
    let last = live.keys().next_back().unwrap();
    for extension in ["html", "json"] {
        let file = events_folder(&site).join(format!("{last}.{extension}"));
        std::fs::remove_file(file).unwrap();
    }
    let (_third, _) = run(&site);
    let file = events_folder(&site).join(format!("{last}.json"));
    within("the report that is due", async {
        while !file.exists() {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    })
    .await;
    assert_eq!(json_of(&events_folder(&site)), live);
}

/// An alert is raised before the second earthquake. The report of this earthquake alone shows weak
/// motion without a change.
#[tokio::test(flavor = "multi_thread")]
async fn report_states_an_open_alert_and_asks_for_an_inspection() {
    let site = watched_building(
        "\n[[alert]]\nparameters = [\"storey-1\"]\nloss = 0.1\ncredibility = 0.99\nsustain-s = 5\n\
         reference = { design-std = 0.05 }\n",
    );
    let quakes = [(60.0, WEAK), (240.0, WEAK)];
    let course = Course::of_first_storey(site.folder(), 300, &quakes, 0.6);
    let (_run, address) = run(&site);
    let (bus, events) = listen(&site).await;
    let alerts = bus
        .subscribe::<AlertMessage>(site.keys().all_alerts(), 1024)
        .await
        .unwrap();
    let replay = site.replay(&course.record(), "60");
    let raised = within("the alert", async {
        loop {
            let (_, alert) = alerts.messages().recv_async().await.unwrap();
            if alert.state == AlertState::Raised {
                return alert;
            }
        }
    })
    .await;
    let after_s = raised.time_ns as f64 / 1e9 - START_S as f64;
    assert!(after_s < 200.0, "raised after {after_s} s");
    replay.wait().expect_code(0);
    let mut all = Vec::new();
    events_of(&events, EventKind::EarthquakeReport, 2, &mut all).await;
    let made = json_of(&events_folder(&site));
    let last = made.values().last().unwrap();
    println!("{}", last["headline"]);
    let open = last["open_alerts"].as_array().unwrap();
    assert_eq!(open.len(), 1, "{last}");
    let why = open[0].as_str().unwrap();
    assert!(why.starts_with("storey-1 has lost"), "{why}");
    let headline = last["headline"].as_str().unwrap();
    let sentence = format!("An alert of the running services is open: {why}.");
    assert!(headline.contains(&sentence), "{headline}");
    assert_eq!(last["urgency"], "inspect");
    let name = made.keys().next_back().unwrap();
    let (_, _, html) = get(&address, &format!("/events/block-7/{name}.html"));
    assert!(html.contains("An alert of the running services is open: storey-1"));
}

#[tokio::test(flavor = "multi_thread")]
async fn recording_that_cannot_be_kept_is_announced_and_kept_once_it_can() {
    let site = watched_building("");
    let course = Course::new(site.folder(), 130, &QUAKES[..1]);
    let (run, address) = run(&site);
    let (_bus, events) = listen(&site).await;
    let folder = events_folder(&site);
    std::fs::remove_dir(&folder).unwrap();
    site.replay(&course.record(), "max").wait().expect_code(0);
    let mut all = Vec::new();
    events_of(&events, EventKind::EarthquakeUnreported, 1, &mut all).await;
    let last = all.last().unwrap();
    assert_eq!(last.what, "the recording of an earthquake is not kept");
    assert!(last.why.contains("No such file"), "{last:?}");
    std::fs::create_dir(&folder).unwrap();
    events_of(&events, EventKind::EarthquakeReport, 1, &mut all).await;
    assert_eq!(json_of(&folder).len(), 1);
    assert_eq!(get(&address, "/events/block-7/index.html").0, 200);
    run.stop().expect_code(0);
}
