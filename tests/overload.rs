//! An identification that is slower than its input: it first reduces its display output, then falls
//! behind while all frames are recorded, then catches up.
//!
//! Each state must be reported. In the end, the estimates must be bit-identical to those of a run
//! without overload.

use crate::support::{EstimateReader, Process, Sensors, Site, assert_same_bits, within};
use spandrel_bus::{
    Bus, BusConfig, Event, EventKind, Load, Mode, ParameterDisplay, ProgressWatch, Service, Status,
    StreamState, Subscription,
};
use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::Duration;
use tokio::sync::mpsc;

/// Number of rows in a block.
const BLOCK: usize = 20;
/// Maximum number of frames in transit to ingest, so that ingest is not overloaded.
const WINDOW: u64 = 2_000;

/// Returns a tower of sixty storeys. One core identifies in the order of a thousand frames a
/// second, and ingest is many times faster.
fn tower() -> String {
    let storeys = |range: std::ops::RangeInclusive<u32>| -> String {
        range
            .map(|storey| format!("\"storey-{storey}\""))
            .collect::<Vec<_>>()
            .join(", ")
    };
    tower_with(
        60,
        &(parameter("lower", storeys(1..=30)) + &parameter("upper", storeys(31..=60))),
    )
}

/// Returns a tower of 160 storeys, all of whose stiffnesses are identified: a few hundred frames a
/// second.
fn heavy_tower() -> String {
    let of_storey = |storey| {
        parameter(
            &format!("stiffness-{storey}"),
            format!("\"storey-{storey}\""),
        )
    };
    tower_with(160, &(1..=160).map(of_storey).collect::<String>())
}

fn parameter(name: &str, of: String) -> String {
    format!("[[parameter]]\nname = \"{name}\"\nscales = \"stiffness\"\nof = [{of}]\n")
}

fn tower_with(storeys: u32, parameters: &str) -> String {
    let node = |floor: u32| {
        format!(
            "[[node]]\nname = \"floor-{floor}\"\n[[node.channel]]\nname = \"floor-{floor}\"\n\
             quantity = \"absolute-acceleration\"\ndof = \"floor-{floor}\"\nunit = \"m/s2\"\n\
             noise-std = 0.005\n"
        )
    };
    let model = format!("[model]\nkind = \"shear-building\"\nstoreys = {storeys}\n");
    "[structure]\nname = \"tower\"\nsampling-rate-hz = 100\n".to_owned()
        + &model
        + "mass-kg = 20_000\nfirst-frequency-hz = 0.5\n\
     [damping]\nkind = \"rayleigh\"\nratio = 0.02\n"
        + parameters
        + "[[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = 0.1\n\
           measured-on = \"ground\"\n\
           [[node]]\nname = \"ground\"\n[[node.channel]]\nname = \"ground\"\n\
           quantity = \"ground-acceleration\"\nunit = \"m/s2\"\nnoise-std = 0.005\n"
        + &node(30)
        + &node(60)
        + "[ingest]\nlateness-s = 3600\n\
           [[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
           credibility = 0.99\nsustain-s = 3\n"
}

/// Live sensors that publish as fast as ingest accepts samples, and the reported states of
/// `identify`.
struct Rush {
    sensors: Sensors,
    /// Number of published rows.
    put: usize,
    ingest: ProgressWatch,
    identify: ProgressWatch,
    statuses: Subscription<Status>,
    /// States of `identify`, without repetitions.
    states: Vec<Load>,
    last: Option<Status>,
}

impl Rush {
    /// Keeps the identification about `behind` frames behind until it reports a state.
    async fn until(&mut self, state: Load, behind: u64) {
        let done = |watch: &ProgressWatch| watch.latest().map_or(0, |progress| progress.done);
        while self.states.last() != Some(&state) {
            let (put, identified) = (self.put as u64, done(&self.identify));
            assert!(
                self.put + BLOCK < self.sensors.record().len(),
                "the record is over before it is {state:?}"
            );
            if put - identified < behind {
                within(
                    "ingest",
                    self.ingest
                        .wait_for(|progress| progress.done + WINDOW > put),
                )
                .await;
                self.put_block().await;
                while let Ok((_, status)) = self.statuses.messages().try_recv() {
                    self.note(status);
                }
            } else {
                tokio::select! {
                    _ = within("identify", self.identify.wait_for(|progress| progress.done > identified)) => {}
                    status = self.statuses.messages().recv_async() => self.note(status.unwrap().1),
                }
            }
        }
    }

    /// Waits without publishing samples until `identify` reports a state.
    async fn wait_for(&mut self, state: Load) {
        while self.states.last() != Some(&state) {
            let status = within(
                &format!("state {state:?}"),
                self.statuses.messages().recv_async(),
            )
            .await;
            self.note(status.unwrap().1);
        }
    }

    async fn put_block(&mut self) {
        self.sensors.put(self.put..self.put + BLOCK).await;
        self.put += BLOCK;
    }

    fn note(&mut self, status: Status) {
        let load = status.load.expect("identify tells its load");
        if self.states.last() != Some(&load) {
            self.states.push(load);
        }
        self.last = Some(status);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_overloaded_identification_sheds_display_falls_behind_and_catches_up_with_the_same_bits()
{
    let site = Site::with(&tower());
    let mut record = site.simulate(900.0);
    let config = BusConfig {
        mode: Mode::Router,
        listen: vec![site.endpoint().to_owned()],
        ..BusConfig::default()
    };
    let _router = Bus::open(&config).await.unwrap();
    let start = |service: &str, queue: &str| {
        let mut command = site.connecting(service);
        command
            .env("SPANDREL_BUS__MODE", "client")
            .env("SPANDREL_BUS__QUEUE", queue);
        let process = Process::start(&mut command);
        process.wait_for_log("ready structures=1");
        process
    };
    // A short queue: `identify` must fetch its excess frames from ingest, and soon from the disk of
    // ingest, instead of queueing them.
    let services = [
        start("alert", "256"),
        start("identify", "8"),
        start("ingest", "256"),
    ];
    let (bus, keys) = (site.join().await, site.keys());
    let mut reader = EstimateReader::join(&bus, &keys).await;
    let events = bus.subscribe::<Event>(keys.event(), 256).await.unwrap();
    let alert_statuses = bus
        .subscribe::<Status>(keys.statuses(Service::Alert), 4)
        .await
        .unwrap();
    let mut rush = Rush {
        sensors: Sensors::start(&bus, &keys, site.structure(), &record).await,
        put: 0,
        ingest: bus
            .watch_progress(keys.progress(Service::Ingest))
            .await
            .unwrap(),
        identify: bus
            .watch_progress(keys.progress(Service::Identify))
            .await
            .unwrap(),
        statuses: bus
            .subscribe(keys.statuses(Service::Identify), 256)
            .await
            .unwrap(),
        states: Vec::new(),
        last: None,
    };
    rush.wait_for(Load::Normal).await;
    rush.put_block().await;
    let read = tokio::spawn(async move { reader.read_to_end(1).await.to_vec() });

    rush.until(Load::DisplayShed, 3_000).await;
    rush.until(Load::Behind, 12_000).await;
    // Ingest does not wait for identification: all frames are recorded long before they are
    // identified.
    let put = rush.put as u64;
    within(
        "ingest",
        rush.ingest.wait_for(|progress| progress.done == put),
    )
    .await;
    rush.wait_for(Load::CatchingUp).await;
    rush.wait_for(Load::Normal).await;
    assert_eq!(
        rush.states,
        [
            Load::Normal,
            Load::DisplayShed,
            Load::Behind,
            Load::CatchingUp,
            Load::Normal
        ],
        "states told in the status"
    );

    // Display values have returned, ten per second of measurement.
    let displayed = bus
        .subscribe::<ParameterDisplay>(keys.all_parameters(), 4096)
        .await
        .unwrap();
    let mut times_ns = Vec::new();
    while !times_ns
        .windows(2)
        .any(|pair: &[i64]| pair[1] - pair[0] == 100_000_000)
    {
        rush.put_block().await;
        let (_, shown) = within("a displayed value", displayed.messages().recv_async())
            .await
            .unwrap();
        times_ns.extend((shown.parameter.as_str() == "lower").then_some(shown.time_ns));
    }
    let rows = rush.put;
    for node in ["ground", "floor-30", "floor-60"] {
        rush.sensors
            .put_changed(node, rows..rows, |block| block.state = StreamState::Ended)
            .await;
    }

    let found = within("the last estimate", read).await.unwrap();
    record.cut(rows..record.len()).save_as("rushed.csv");
    let unhurried = site.estimate(&record);
    assert_same_bits(
        "overloaded",
        &unhurried.parameters,
        &unhurried.frames,
        &found,
    );

    let decided = async {
        loop {
            let (_, status) = alert_statuses.messages().recv_async().await.unwrap();
            if status.done == rows as u64 {
                return status.drops;
            }
        }
    };
    let decided = within("decision on each estimate", decided).await;
    let counted = rush.last.unwrap().drops;
    for (service, drops) in [("alert", &decided), ("identify", &counted)] {
        assert_eq!(drops.get("lost-items"), None, "{service}: {drops:?}");
    }
    assert!(
        counted["fetched-items"] > 1_024,
        "no more came from the recording than ingest has in memory: {counted:?}"
    );
    assert!(counted["shed-values"] > 0, "nothing was shed: {counted:?}");
    let told: Vec<EventKind> = events
        .messages()
        .try_iter()
        .map(|(_, event)| event.kind)
        .collect();
    let of_load: Vec<&EventKind> = told
        .iter()
        .filter(|kind| matches!(kind, EventKind::Overloaded | EventKind::CaughtUp))
        .collect();
    assert_eq!(of_load, [&EventKind::Overloaded, &EventKind::CaughtUp]);
    println!("{rows} rows; identify counted {counted:?}");
    for service in services.into_iter().rev() {
        service.stop().expect_code(0);
    }
}

/// Messages to systemd from a service whose unit has a watchdog.
struct Systemd {
    words: mpsc::UnboundedReceiver<String>,
}

impl Systemd {
    /// Watchdog time, after which systemd would kill the process.
    const WATCHDOG: Duration = Duration::from_secs(4);

    fn of(command: &mut Command, site: &Site) -> Self {
        let path = site.folder().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        command
            .env("NOTIFY_SOCKET", path)
            .env("WATCHDOG_USEC", Self::WATCHDOG.as_micros().to_string());
        command.env_remove("WATCHDOG_PID");
        let (heard, words) = mpsc::unbounded_channel();
        std::thread::spawn(move || {
            let mut buffer = [0; 512];
            while let Ok(count) = socket.recv(&mut buffer) {
                let word = String::from_utf8_lossy(&buffer[..count]).trim().to_owned();
                if heard.send(word).is_err() {
                    return;
                }
            }
        });
        Self { words }
    }

    async fn next(&mut self) -> String {
        within("a word to systemd", self.words.recv())
            .await
            .unwrap()
    }

    /// Waits for the next watchdog message as systemd does.
    async fn is_fed(&mut self, what: impl Fn() -> String) {
        match tokio::time::timeout(Self::WATCHDOG, self.words.recv()).await {
            Ok(word) => assert_eq!(word.unwrap(), "WATCHDOG=1"),
            Err(_elapsed) => panic!("systemd would have killed it: {}", what()),
        }
    }
}

/// A fetched block must be processed in parts, because a whole block can take longer than the
/// watchdog time.
#[tokio::test(flavor = "multi_thread")]
async fn a_heavy_model_that_catches_up_feeds_the_watchdog_and_obeys_a_stop() {
    const FRAMES: usize = 4_000;
    let site = Site::with(&heavy_tower());
    let record = site.simulate(FRAMES as f64 / 100.0);
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let (bus, keys) = (site.join().await, site.keys());
    let mut made = bus
        .watch_progress(keys.progress(Service::Ingest))
        .await
        .unwrap();
    let identified = bus
        .watch_progress(keys.progress(Service::Identify))
        .await
        .unwrap();
    let mut sensors = Sensors::start(&bus, &keys, site.structure(), &record).await;
    for first in (0..FRAMES).step_by(500) {
        sensors.put(first..first + 500).await;
        within(
            "frames",
            made.wait_for(|progress| progress.done >= first as u64 + 500),
        )
        .await;
    }

    let mut command = site.connecting("identify");
    command.env("SPANDREL_THREADS", "1"); // a second thread would hide the busy one
    let mut systemd = Systemd::of(&mut command, &site);
    let identify = Process::start(&mut command);
    assert_eq!(systemd.next().await, "READY=1");
    let done = || identified.latest().map_or(0, |progress| progress.done);
    let told = || format!("{} of {FRAMES} frames are identified", done());
    let mut times = 0;
    while times < 2 || done() == 0 {
        systemd.is_fed(told).await;
        times += 1;
    }
    assert!(
        done() < FRAMES as u64,
        "it has caught up already: this tests nothing"
    );
    identify.terminate();
    while systemd.next().await != "STOPPING=1" {}
    identify
        .wait()
        .expect_code(0)
        .expect_untold(&["did not finish in time", "do not respond"]);
    assert!(
        done() < FRAMES as u64,
        "it has worked off all before it stopped"
    );
}
