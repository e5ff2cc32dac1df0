//! The station of distributed identification and the workers of its nodes, killed while live
//! sensors measure.
//!
//! They must resume from their checkpoints, and the results must match those of an undisturbed run.

use crate::support::{Process, Site, distributed_storeys, within};
use spandrel_bus::{Bus, BusConfig, EstimateBlock, LocalMessage, Mode, Status, Subscription};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};

/// Node whose worker runs in its own process.
const NODE: &str = "floor-2";
/// Nodes whose workers share another process.
const OTHERS: [&str; 3] = ["floor-1", "floor-3", "floor-4"];
/// Time for sensors to start before the first sample is measured (s), and length of the record (s),
/// which exceeds the duration of the test.
const HEAD_START_S: f64 = 10.0;
const LENGTH_S: f64 = 600.0;
/// Number of fusions before the first kill, and from one kill to the next.
const LEARNT: usize = 20;
const RECOVERED: usize = 5;

/// A fused estimate: time (ns since 1970), epoch of the station, means and standard deviations of
/// the parameters.
#[derive(Debug, Clone)]
struct Fused {
    time_ns: i64,
    epoch: u64,
    mean: Vec<f64>,
    std: Vec<f64>,
}

/// A station, workers and sensors around a router, and their received messages.
struct Town {
    site: Site,
    configuration: PathBuf,
    running: BTreeMap<&'static str, Process>,
    bus: Bus,
    _router: Bus,
    estimates: Subscription<EstimateBlock>,
    local: Subscription<LocalMessage>,
    fused: Vec<Fused>,
}

impl Town {
    async fn start() -> Self {
        let site = Site::with(&distributed_storeys(1.0));
        let configuration = site.folder().join("spandrel.toml");
        let text = "[bus]\nmode = \"client\"\n[state]\nfolder = \"kept\"\ncheckpoint-s = 0.5\n";
        std::fs::write(&configuration, text).unwrap();
        let config = BusConfig {
            mode: Mode::Router,
            listen: vec![site.endpoint().to_owned()],
            ..BusConfig::default()
        };
        let router = Bus::open(&config).await.unwrap();
        let bus = site.join().await;
        let estimates = bus
            .subscribe(site.keys().estimates(), 1 << 12)
            .await
            .unwrap();
        let local = bus
            .subscribe(site.keys().all_local(), 1 << 12)
            .await
            .unwrap();
        let running = BTreeMap::new();
        let mut town = Self {
            site,
            configuration,
            running,
            bus,
            _router: router,
            estimates,
            local,
            fused: Vec::new(),
        };
        ["station", "worker", "others"]
            .into_iter()
            .for_each(|name| town.run(name));
        town
    }

    /// Starts a process, and waits until it is ready.
    fn run(&mut self, name: &'static str) {
        let mut command = match name {
            "station" => self.site.connecting("fuse"),
            "worker" => self.workers(&[NODE]),
            _ => self.workers(&OTHERS),
        };
        let process = Process::start(command.arg("--config").arg(&self.configuration));
        process.wait_for_log("ready structures=1");
        self.running.insert(name, process);
    }

    fn workers(&self, nodes: &[&str]) -> Command {
        let mut command = self.site.connecting("identify");
        for node in nodes {
            command.args(["--node", node]);
        }
        command
    }

    /// Starts the sensors, whose record begins at this time (s since 1970, UTC).
    fn measure(&mut self, start_s: f64) {
        let mut command = self.site.connecting("simulate");
        command.args([
            "--live",
            "--start",
            &start_s.to_string(),
            "--duration",
            &LENGTH_S.to_string(),
        ]);
        self.running.insert(
            "sensors",
            Process::start(command.env("SPANDREL_BUS__MODE", "client")),
        );
    }

    /// Kills processes, runs `meanwhile` on their remaining state, and restarts them.
    fn kill(&mut self, names: &[&'static str], meanwhile: impl FnOnce(&Self)) {
        names
            .iter()
            .for_each(|name| self.running.remove(name).unwrap().kill());
        meanwhile(self);
        names.iter().for_each(|name| self.run(name));
    }

    /// Reads until there are `count` more fusions.
    async fn more(&mut self, count: usize) {
        let wanted = self.fused.len() + count;
        while self.fused.len() < wanted {
            let what = format!("fusion {} of {wanted}", self.fused.len() + 1);
            let (_, block) = within(&what, self.estimates.messages().recv_async())
                .await
                .unwrap();
            for estimate in &block.estimates {
                let std = |index| estimate.variance(index).unwrap().sqrt();
                self.fused.push(Fused {
                    time_ns: block.header.time_ns,
                    epoch: block.header.epoch,
                    mean: estimate.mean.clone(),
                    std: (0..estimate.mean.len()).map(std).collect(),
                });
            }
        }
    }

    /// Returns the first local estimate of the node from a later run of its worker.
    async fn first_after(&self, epoch: u64) -> LocalMessage {
        loop {
            let what = "a message of the worker in its new life";
            let (key, message) = within(what, self.local.messages().recv_async())
                .await
                .unwrap();
            if key.ends_with(NODE) && message.header.epoch > epoch && message.density.is_some() {
                return message;
            }
        }
    }

    /// Returns the last received local estimate of the node.
    fn last_local(&self) -> LocalMessage {
        let of_node = self
            .local
            .messages()
            .drain()
            .filter(|(key, _)| key.ends_with(NODE));
        of_node
            .map(|(_, message)| message)
            .last()
            .expect("the worker has sent something")
    }

    fn checkpoints(&self) -> PathBuf {
        let keys = self.site.keys();
        self.site
            .folder()
            .join("kept")
            .join(keys.root().as_str())
            .join("house/checkpoints")
    }

    fn log(&self, name: &str) -> String {
        self.running[name].log()
    }
}

/// Returns the newest checkpoint in a folder.
fn newest(folder: &Path, kind: &str) -> PathBuf {
    let entries = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let is_one = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_str().unwrap();
        name.starts_with(kind) && name.ends_with(".checkpoint")
    };
    entries
        .filter(is_one)
        .max()
        .unwrap_or_else(|| panic!("no checkpoint of {kind} in {}", folder.display()))
}

/// Changes a bit in the middle of a file, and returns the name of the file.
fn damage(path: &Path) -> String {
    let mut bytes = std::fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(path, bytes).unwrap();
    path.file_name().unwrap().to_str().unwrap().to_owned()
}

fn now_ns() -> i64 {
    #[expect(
        clippy::disallowed_methods,
        reason = "live sensors and the station use the wall clock"
    )]
    let now = SystemTime::now();
    now.duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64
}

/// Checks that the first result after a restart continues the last one. It must be close to it, and
/// must not be as uncertain as the prior. The deviation of the prior (0.1) is several times that of
/// the last result.
#[track_caller]
fn assert_goes_on(what: &str, last: (&[f64], &[f64]), next: (&[f64], &[f64])) {
    for parameter in 0..last.0.len() {
        let (std, next_std) = (last.1[parameter], next.1[parameter]);
        let moved = (next.0[parameter] - last.0[parameter]).abs() / std;
        println!(
            "{what}: parameter {parameter} moved by {moved:.2} deviations, {std:.4} became \
             {next_std:.4}"
        );
        assert!(
            moved < 1.0,
            "{what}: parameter {parameter} moved by {moved:.2} deviations"
        );
        assert!(
            next_std < 1.5 * std,
            "{what}: deviation {std:.4} of parameter {parameter} became {next_std:.4}"
        );
    }
}

/// Checks that the first result of the restarted station continues the last one.
async fn station_goes_on(town: &mut Town, what: &str) {
    let last = town.fused.last().unwrap().clone();
    while town.fused.last().unwrap().epoch == last.epoch {
        town.more(1).await;
    }
    // Messages sent before the kill may arrive after it.
    let before = town
        .fused
        .iter()
        .rfind(|fused| fused.epoch == last.epoch)
        .unwrap();
    let next = town.fused.last().unwrap();
    assert!(next.epoch > last.epoch);
    assert_goes_on(what, (&before.mean, &before.std), (&next.mean, &next.std));
    assert!(
        town.log("station").contains("resumed from its checkpoint"),
        "{}",
        town.log("station")
    );
}

fn local_numbers(message: &LocalMessage) -> (Vec<f64>, Vec<f64>) {
    let density = message.density.as_ref().unwrap();
    let std = |index: usize| density.covariance[index * (index + 3) / 2].sqrt();
    (
        density.mean.clone(),
        (0..density.mean.len()).map(std).collect(),
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_station_and_worker_resume_from_their_checkpoints() {
    let (mut undisturbed, mut town) = (Town::start().await, Town::start().await);
    let start_s = (now_ns() as f64 * 1e-9).ceil() + HEAD_START_S;
    undisturbed.measure(start_s);
    town.measure(start_s);
    town.more(LEARNT).await;

    // A worker.
    let last = town.last_local();
    let statuses = town
        .bus
        .subscribe::<Status>(town.site.keys().all_statuses(), 1 << 10)
        .await
        .unwrap();
    let killed_ns = now_ns();
    town.kill(&["worker"], |_| ());
    let first = town.first_after(last.header.epoch).await;
    let ((mean, std), (next_mean, next_std)) = (local_numbers(&last), local_numbers(&first));
    assert_goes_on("a worker", (&mean, &std), (&next_mean, &next_std));
    assert!(
        first.header.time_ns > killed_ns,
        "the first message is older than the restart"
    );
    assert!(
        town.log("worker").contains("resumed from its checkpoint"),
        "{}",
        town.log("worker")
    );
    // The sensor has supplied the samples missed by the worker.
    let status = async {
        loop {
            let (_, status) = statuses.messages().recv_async().await.unwrap();
            if status.id.as_str() == NODE
                && status.done > 0
                && status.time_ns > first.header.time_ns
            {
                return status;
            }
        }
    };
    let status = within("a status of the worker", status).await;
    assert!(
        !status.drops.contains_key("missing-samples"),
        "{:?}",
        status.drops
    );
    assert!(
        status.drops.contains_key("fetched-items"),
        "{:?}",
        status.drops
    );
    town.more(RECOVERED).await;

    // The station.
    town.kill(&["station"], |_| ());
    station_goes_on(&mut town, "the station").await;
    town.more(RECOVERED).await;

    // All of them at once, as in a power failure.
    town.kill(&["station", "worker", "others"], |_| ());
    station_goes_on(&mut town, "station and workers").await;
    town.more(RECOVERED).await;

    // Again, with damaged newest checkpoints: the preceding ones are used.
    let mut damaged = Vec::new();
    town.kill(&["station", "worker", "others"], |town| {
        let folder = town.checkpoints();
        damaged.push(damage(&newest(&folder, "fuse")));
        damaged.push(damage(&newest(&folder.join("nodes").join(NODE), "node")));
    });
    for (name, file) in ["station", "worker"].into_iter().zip(&damaged) {
        let log = town.log(name);
        let refused = log
            .lines()
            .find(|line| line.contains("checkpoint rejected"));
        let refused =
            refused.unwrap_or_else(|| panic!("{name} has not said that it refuses {file}:\n{log}"));
        assert!(
            refused.contains(file.as_str()) && refused.contains("damaged"),
            "{refused}"
        );
        assert!(log.contains("resumed from its checkpoint"), "{log}");
    }
    let aside = town.checkpoints().join(format!("{}.refused", damaged[0]));
    assert!(aside.is_file(), "{}", aside.display());
    station_goes_on(&mut town, "station and workers with damaged checkpoints").await;
    town.more(RECOVERED).await;

    // No earlier result has been lost.
    let end_ns = town.fused.last().unwrap().time_ns;
    while undisturbed
        .fused
        .last()
        .is_none_or(|fused| fused.time_ns < end_ns)
    {
        undisturbed.more(1).await;
    }
    let (mut furthest, mut widest) = (0.0_f64, 0.0_f64);
    for fused in &town.fused[LEARNT / 2..] {
        let other = undisturbed
            .fused
            .iter()
            .min_by_key(|other| (other.time_ns - fused.time_ns).abs())
            .unwrap();
        for parameter in 0..4 {
            let off = (fused.mean[parameter] - other.mean[parameter]).abs() / fused.std[parameter];
            let wider = fused.std[parameter] / other.std[parameter];
            (furthest, widest) = (furthest.max(off), widest.max(wider));
            assert!(
                off < 2.0,
                "parameter {parameter}: {fused:?} in place of {other:?}"
            );
            assert!(
                wider < 2.0,
                "parameter {parameter}: {fused:?} in place of {other:?}"
            );
        }
    }
    println!(
        "off the undisturbed run by at most {furthest:.2} deviations, and at most {widest:.2} \
         times as wide"
    );
    for name in ["worker", "others", "station"] {
        town.running.remove(name).unwrap().stop().expect_code(0);
    }
}
