//! Live nodes in real time: one whose clock is far off, and one that a second program under its
//! name has locked out.

use crate::history::get;
use crate::notify::{Request, http};
use crate::support::{Node, Process, Record, Sensors, Site, put_raw, two_storeys, within};
use serde_json::Value;
use spandrel_bus::{
    Block, Bus, Delivery, Event, EventKind, FrameBlock, Message as _, MonitoringDisplay, Name,
    SampleBlock, Service, Start, Status, Stream, StreamSettings, Subscription,
};
use spandrel_service::Clock;
use std::sync::mpsc::Receiver;
use std::time::Duration;
use tokio::time::{Instant, Interval};

/// Rows of a block, and its length.
const ROWS: usize = 10;
const BLOCK: Duration = Duration::from_millis(100);
/// Time within which a wrong clock must be named everywhere.
const NAMED_WITHIN: Duration = Duration::from_secs(10);
/// Blocks of this time.
const BLOCKS_OF_NAMED_WITHIN: usize = 100;
const SECOND_NS: i64 = 1_000_000_000;
/// Epochs are times in ns. This one is 30 days after that of the nodes.
const THIRTY_DAYS: u64 = 30 * 86_400 * 1_000_000_000;

/// Nodes of [`two_storeys`], as a structure without a model.
const WITHOUT_MODEL: &str = r#"
[structure]
name = "house"
sampling-rate-hz = 100
[model]
kind = "modal"
nodes = { ground = [0, 0], floor-1 = [0, 3], floor-2 = [0, 6] }
[[node]]
name = "ground"
[[node.channel]]
name = "ground"
quantity = "absolute-acceleration"
unit = "m/s2"
at = "ground"
direction = "x"
[[node]]
name = "floor-1"
[[node.channel]]
name = "floor-1"
quantity = "absolute-acceleration"
unit = "m/s2"
at = "floor-1"
direction = "x"
[[node]]
name = "roof"
[[node.channel]]
name = "roof"
quantity = "absolute-acceleration"
unit = "m/s2"
at = "floor-2"
direction = "x"
[modal]
[[modal.mode]]
name = "sway"
frequency-hz = 1
[ingest]
lateness-s = 1
"#;

/// Services, and nodes that deliver a record in real time. Notices are sent to a webhook.
struct Running {
    site: Site,
    services: Process,
    notices: Receiver<Request>,
    bus: Bus,
    sensors: Sensors,
    record: Record,
    due: Interval,
    row: usize,
    events: Subscription<Event>,
    statuses: Subscription<Status>,
    reports: Subscription<MonitoringDisplay>,
    frames: Stream<FrameBlock>,
}

impl Running {
    async fn start() -> Self {
        let site = Site::with(&two_storeys("[ingest]\nlateness-s = 1\n"));
        let record = site.simulate(90.0);
        Self::serve(site, record, "").await
    }

    /// Starts the services of a structure with these keys of `[notify]`.
    async fn serve(site: Site, record: Record, keys_of_notify: &str) -> Self {
        let (hook, notices) = http(0);
        let configuration = site.folder().join("spandrel.toml");
        let text =
            format!("[notify]\n{keys_of_notify}[[notify.webhook]]\nurl = \"http://{hook}/\"\n");
        std::fs::write(&configuration, text).unwrap();
        let mut command = site.listening("run");
        command.args(["--http", "127.0.0.1:0"]).arg("--config");
        let services = Process::start(command.arg(&configuration));
        services.wait_for_log("ready structures=1");
        let (bus, keys) = (site.join().await, site.keys());
        let mut tokens = bus
            .watch_live(keys.all_live(Service::Ingest))
            .await
            .unwrap();
        within("token of ingest", tokens.some()).await;
        let from_now = StreamSettings::new(Start::Now);
        Self {
            sensors: Sensors::start(&bus, &keys, site.structure(), &record).await,
            events: bus.subscribe(keys.event(), 256).await.unwrap(),
            statuses: bus
                .subscribe(keys.statuses(Service::Ingest), 256)
                .await
                .unwrap(),
            reports: bus.subscribe(keys.monitoring(), 256).await.unwrap(),
            frames: bus
                .follow(keys.frames(), keys.recording(), from_now)
                .await
                .unwrap(),
            due: tokio::time::interval(BLOCK),
            row: 0,
            site,
            services,
            notices,
            bus,
            record,
        }
    }

    /// Returns the next rows when they are due.
    async fn next_rows(&mut self) -> std::ops::Range<usize> {
        self.due.tick().await;
        self.row += ROWS;
        self.row - ROWS..self.row
    }

    /// Lets all nodes deliver a block. The clocks of some are off by seconds.
    async fn put(&mut self, nodes: &[(&str, i64)]) {
        let rows = self.next_rows().await;
        for (node, off_s) in nodes {
            self.sensors
                .put_changed(node, rows.clone(), |block| {
                    block.header.time_ns += off_s * SECOND_NS;
                })
                .await;
        }
    }

    /// Lets the nodes deliver until an event of this kind arrives, at most for some blocks.
    async fn until_event(
        &mut self,
        kind: EventKind,
        nodes: &[(&str, i64)],
        blocks: usize,
    ) -> Event {
        for _ in 0..blocks {
            self.put(nodes).await;
            let mut events = self.events.messages().try_iter();
            if let Some((_, event)) = events.find(|(_, event)| event.kind == kind) {
                return event;
            }
        }
        panic!(
            "no event {kind:?} within {blocks} blocks\n{}",
            self.services.log()
        );
    }

    /// Lets the nodes deliver until a frame satisfies a condition. Channels are those of ground,
    /// floor-1 and roof (2).
    async fn until_frame(
        &mut self,
        what: &str,
        nodes: &[(&str, i64)],
        is_it: impl Fn(&[f64]) -> bool,
    ) {
        for _ in 0..300 {
            self.put(nodes).await;
            for delivery in self.frames.deliveries().try_iter() {
                let Delivery::Block(block) = delivery else {
                    continue;
                };
                if block.iter().any(|(_, frame)| is_it(frame)) {
                    return;
                }
            }
        }
        panic!("no frame {what}\n{}", self.services.log());
    }

    async fn last_status(&self) -> Status {
        within("a status of ingest", async {
            while self.statuses.messages().try_iter().last().is_some() {}
            self.statuses.messages().recv_async().await.unwrap().1
        })
        .await
    }
}

impl Running {
    /// Returns the health that the page shows for a node.
    fn health_on_page(&self, node: &str) -> Option<String> {
        let said = self.services.output();
        let page = said.split("page: http://").nth(1)?.split('/').next()?;
        let shown = tokio::task::block_in_place(|| get(page, "/api/structures/house"));
        let sensors = shown["standing"]["sensors"].as_array()?;
        let sensor = sensors.iter().find(|sensor| sensor["node"] == node)?;
        sensor["health"].as_str().map(str::to_owned)
    }
}

/// Returns `true` if the text gives the difference of ten minutes after these words, to a second. A
/// busy machine shifts the figure.
fn says_ten_minutes(text: &str, before: &str) -> bool {
    let figure = text
        .split(before)
        .nth(1)
        .and_then(|rest| rest.split(' ').next());
    let difference_s = figure.and_then(|figure| figure.parse::<f64>().ok());
    difference_s.is_some_and(|difference_s| (difference_s - 600.0).abs() < 1.0)
}

// The samples of all other nodes were dropped for as long as the clock was wrong, and nothing
// reported it.
#[tokio::test(flavor = "multi_thread")]
async fn node_that_is_ten_minutes_ahead_and_comes_first_is_named_and_the_others_are_watched() {
    let mut running = Running::start().await;
    let all = |off_s: i64| [("roof", off_s), ("ground", 0), ("floor-1", 0)];
    for _ in 0..30 {
        running.put(&[("roof", 600)]).await;
    }
    // The first block of the wrong clock beside sound ones.
    let beside = Instant::now();
    let (mut event, mut on_topic, mut on_page, mut notice) = (None, None, None, None);
    while event.is_none() || on_topic.is_none() || on_page.is_none() || notice.is_none() {
        assert!(
            beside.elapsed() < NAMED_WITHIN,
            "after {NAMED_WITHIN:?}: event {event:?}, monitoring {on_topic:?}, page {on_page:?}, \
             notice {notice:?}\n{}",
            running.services.log()
        );
        running.put(&all(600)).await;
        let mut events = running.events.messages().try_iter().map(|(_, event)| event);
        event = event.or_else(|| events.find(|event| event.kind == EventKind::ClockWrong));
        let reports = running.reports.messages().try_iter();
        let mut words = reports.map(|(_, report)| report.words());
        let is_named = |words: &String| says_ten_minutes(words, "the clock of roof is ");
        on_topic = on_topic.or_else(|| words.find(is_named));
        on_page = on_page.or_else(|| {
            let health = running.health_on_page("roof");
            health.filter(|health| health == "wrong-clock")
        });
        notice = notice.or_else(|| running.notices.try_recv().ok());
    }
    let (event, notice) = (event.unwrap(), notice.unwrap().body);
    println!("named everywhere after {:?}", beside.elapsed());
    assert_eq!(event.subject, "roof", "{event:?}");
    let before = "the clock of the node is ";
    assert!(says_ten_minutes(&event.what, before), "{event:?}");
    assert!(running.services.log().contains("s ahead of most nodes"));
    assert_eq!(
        (&notice["state"], &notice["node"], &notice["structure"]),
        (&"clock-wrong".into(), &"roof".into(), &"house".into())
    );
    let sentence = notice["sentence"].as_str().unwrap();
    assert!(says_ten_minutes(sentence, before), "{notice}");
    let advice = notice["advice"].as_str().unwrap();
    assert!(advice.contains("time synchronisation of roof"), "{notice}");
    // The samples of the former run, on the time of the wrong clock, are still newer.
    let is_alive =
        |running: &Running, node| running.health_on_page(node).as_deref() == Some("alive");
    while !["ground", "floor-1"]
        .iter()
        .all(|node| is_alive(&running, node))
    {
        assert!(
            beside.elapsed() < NAMED_WITHIN,
            "{}",
            running.services.log()
        );
        running.put(&all(600)).await;
    }
    println!("all others shown as alive after {:?}", beside.elapsed());
    running
        .until_frame("of the others alone", &all(600), |frame| {
            frame[..2].iter().all(|value| value.is_finite())
                && frame[2..].iter().all(|value| value.is_nan())
        })
        .await;
    let status = running.last_status().await;
    let clock = status.clocks[&Name::new("roof").unwrap()];
    assert!(
        (clock.difference_s.unwrap() - 600.0).abs() < 1.0,
        "{clock:?}"
    );
    assert!(
        status.drops["wrong-clock-samples"] > 0,
        "{:?}",
        status.drops
    );
    let event = running
        .until_event(EventKind::ClockRight, &all(0), BLOCKS_OF_NAMED_WITHIN)
        .await;
    assert_eq!(event.subject, "roof", "{event:?}");
    running
        .until_frame("of all nodes", &all(0), |frame| {
            frame.iter().all(|value| value.is_finite())
        })
        .await;
    running
        .services
        .stop()
        .expect_code(0)
        .expect_told(&["s ahead of most nodes"]);
}

// Its time began the frames. The samples of the others were late, so the events blamed the others.
#[tokio::test(flavor = "multi_thread")]
async fn node_that_is_seconds_ahead_and_comes_first_is_named_and_no_other_node_is() {
    for off_s in [3, 30] {
        let mut running = Running::start().await;
        // The clock of the machine confirms the majority.
        let now_s = (Clock::of_machine().now_ns() + SECOND_NS / 2) / SECOND_NS;
        let all = [
            ("roof", now_s + off_s),
            ("ground", now_s),
            ("floor-1", now_s),
        ];
        for _ in 0..10 {
            running.put(&all[..1]).await;
        }
        let (mut named, mut others) = (None, Vec::new());
        for block in 0..BLOCKS_OF_NAMED_WITHIN + 50 {
            running.put(&all).await;
            for (_, event) in running.events.messages().try_iter() {
                match (event.kind, event.subject.as_str()) {
                    (EventKind::ClockWrong, "roof") => named = named.or(Some((block, event))),
                    (_, "ground" | "floor-1") => others.push(event),
                    _ => {}
                }
            }
        }
        let (block, event) = named.unwrap_or_else(|| panic!("{}", running.services.log()));
        println!("{off_s} s ahead: named after {block} blocks: {event:?}");
        assert!(block < BLOCKS_OF_NAMED_WITHIN, "{block}: {event:?}");
        assert!(event.why.starts_with("2 of 3 nodes"), "{event:?}");
        assert!(others.is_empty(), "{others:?}");
        running
            .until_frame("of the others alone", &all, |frame| {
                frame[..2].iter().all(|value| value.is_finite())
                    && frame[2..].iter().all(|value| value.is_nan())
            })
            .await;
        running.services.stop().expect_code(0);
    }
}

// Such a structure has no alert service. Notify called it blind after `blind-after-s`.
#[tokio::test(flavor = "multi_thread")]
async fn wrong_clock_of_a_structure_without_a_model_is_the_only_notice() {
    let with_model = Site::with(&two_storeys(""));
    let record = with_model.simulate(90.0);
    let keys_of_notify = "blind-after-s = 1\ndegraded-after-s = 1\n";
    let site = Site::with(WITHOUT_MODEL);
    let mut running = Running::serve(site, record, keys_of_notify).await;
    let all = |off_s: i64| [("roof", off_s), ("ground", 0), ("floor-1", 0)];
    // Notify calls a structure blind if its alert service has sent nothing for 5 s.
    for _ in 0..80 {
        running.put(&all(0)).await;
    }
    let mut notice = None;
    for _ in 0..BLOCKS_OF_NAMED_WITHIN {
        running.put(&all(3600)).await;
        notice = running.notices.try_recv().ok();
        if notice.is_some() {
            break;
        }
    }
    let notice: Value = notice.expect("a notice").body;
    assert_eq!(
        (&notice["state"], &notice["node"]),
        (&"clock-wrong".into(), &"roof".into()),
        "{notice}"
    );
    assert_eq!(notice["quality"], "", "{notice}");
    running.services.stop().expect_code(0);
}

// A clock that moves by less than the limit of the vote went unnoticed.
#[tokio::test(flavor = "multi_thread")]
async fn node_whose_clock_moves_by_a_second_is_named_and_used() {
    let mut running = Running::start().await;
    let all = |off_s: i64| [("roof", off_s), ("ground", 0), ("floor-1", 0)];
    for _ in 0..150 {
        running.put(&all(0)).await;
    }
    let event = running
        .until_event(EventKind::ClockMoved, &all(1), 2 * BLOCKS_OF_NAMED_WITHIN)
        .await;
    assert_eq!(event.subject, "roof", "{event:?}");
    assert!(event.what.contains("moved forward by "), "{event:?}");
    let complete = |frame: &[f64]| frame.iter().all(|value| value.is_finite());
    running.until_frame("of all nodes", &all(1), complete).await;
    running.services.stop().expect_code(0);
}

// The node was refused after every restart, until its clock passed the epoch of the other program.
#[tokio::test(flavor = "multi_thread")]
async fn node_that_a_second_program_has_locked_out_is_used_again() {
    let mut running = Running::start().await;
    let all = [("roof", 0), ("ground", 0), ("floor-1", 0)];
    let others = [("ground", 0), ("floor-1", 0)];
    let complete = |frame: &[f64]| frame.iter().all(|value| value.is_finite());
    running.until_frame("of all nodes", &all, complete).await;
    let elsewhere = running.site.join().await;
    let keys = running.site.keys();
    // The node itself stores nothing, so that nobody contradicts the second program.
    let node = running.sensors.remove("roof");
    let (mut block, key) = (node.block(&running.record, 0..ROWS), node.key.clone());
    let (channels, name) = (node.channels().to_vec(), node.name.clone());
    drop(node);
    let mut second = Node::start(&elsewhere, &keys, name, channels, THIRTY_DAYS).await;
    let mut lockout = None;
    let mut again = false;
    for number in 0..400 {
        running.put(&others).await;
        block.header.time_ns = running.record.time_ns(running.row - ROWS);
        let payload = block.encode().unwrap();
        put_raw(&running.bus, &key, &SampleBlock::encoding(), payload).await;
        block.header.sequence = block.end();
        if number < 50 {
            let mut ahead = second.block(&running.record, 0..ROWS);
            ahead.header.time_ns = block.header.time_ns + THIRTY_DAYS as i64;
            second.put(ahead).await;
        }
        let events = running.events.messages().try_iter().map(|(_, event)| event);
        let mut lockouts = events.filter(|event| event.kind == EventKind::SamplesDropped);
        lockout = lockout.or_else(|| lockouts.find(|event| event.what.contains("higher epoch")));
        for delivery in running.frames.deliveries().try_iter() {
            let Delivery::Block(frames) = delivery else {
                continue;
            };
            let mut rows = frames.iter().map(|(_, frame)| frame.to_vec());
            again |= lockout.is_some() && number > 60 && rows.any(|frame| complete(&frame));
        }
        if again {
            break;
        }
    }
    let lockout = lockout.unwrap_or_else(|| panic!("not named\n{}", running.services.log()));
    assert_eq!(lockout.subject, "roof", "{lockout:?}");
    assert!(again, "not used again\n{}", running.services.log());
    let status = running.last_status().await;
    assert!(status.drops["locked-out-blocks"] > 0, "{:?}", status.drops);
    running.services.stop().expect_code(0);
}
