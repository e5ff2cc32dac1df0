//! Structures of the soak tests, and the processes of their sensor nodes.

use super::node::{Clock, Manner, ORDERS, Orders};
use crate::support::{Process, Site, two_storeys, within};
use spandrel_bus::{Bus, Keys, Service};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// Node that is always present and always correct. The others come and go.
pub const STEADY: &str = "ground";
pub const OTHERS: [&str; 2] = ["floor-1", "roof"];

/// Structures with the same root and endpoint, and the processes of their nodes.
pub struct Houses {
    pub sites: Vec<Site>,
    pub clock: Clock,
    /// Speed as a multiple of real time.
    speed: f64,
    /// Nodes by structure and name, each with its manner.
    pub nodes: BTreeMap<(usize, &'static str), (Manner, Process)>,
}

impl Houses {
    /// Creates the structures house-1, house-2, …, without nodes.
    pub fn new(count: usize, speed: f64) -> Self {
        let house = |number: usize| {
            let rules = "[ingest]\nlateness-s = 5\n[[alert]]\nparameters = \"all\"\n\
                         reference.design-std = 1e-9\nloss = 0.3\ncredibility = 0.99\n\
                         sustain-s = 10\n";
            let text = two_storeys(rules).replace("\"house\"", &format!("\"house-{number}\""));
            Site::with(&text.replace(
                "sampling-rate-hz = 100",
                "sampling-rate-hz = 100\ndisplay-rate-hz = 1",
            ))
        };
        let mut sites = vec![house(1)];
        for number in 2..=count {
            let site = house(number).at(&sites[0]);
            sites.push(site);
        }
        for site in &sites {
            assert_eq!(
                site.simulate(60.0).len() % 100,
                0,
                "the record is that of whole blocks"
            );
        }
        Self {
            sites,
            clock: Clock::starting(speed),
            speed,
            nodes: BTreeMap::new(),
        }
    }

    pub fn keys(&self) -> Vec<Keys> {
        self.sites.iter().map(Site::keys).collect()
    }

    /// Starts correct nodes of all structures, on a clock that begins now.
    pub fn start_nodes(&mut self) {
        self.clock = Clock::starting(self.speed);
        for structure in 0..self.sites.len() {
            for node in [STEADY].into_iter().chain(OTHERS) {
                self.send(structure, node, Manner::Honest);
            }
        }
    }

    /// Starts a node.
    pub fn send(&mut self, structure: usize, node: &'static str, manner: Manner) {
        let process = self.start(structure, node, manner);
        self.nodes.insert((structure, node), (manner, process));
    }

    /// Starts a process that sends samples in the name of a node.
    pub fn start(&self, structure: usize, node: &str, manner: Manner) -> Process {
        let site = &self.sites[structure];
        let orders = Orders {
            endpoint: site.endpoint().to_owned(),
            root: site.keys().root().to_string(),
            structure_file: site.structure_file().to_owned(),
            record: site.folder().join("record.csv"),
            node: node.to_owned(),
            manner,
            clock: self.clock,
        };
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["soak::sensor_node", "--exact", "--ignored", "--nocapture"]);
        Process::start_with_input(command.env(ORDERS, serde_json::to_string(&orders).unwrap()))
    }

    /// Stops the nodes, and waits until all frames are decided on. Returns the number of samples
    /// that each steady node has published, and the number of frames.
    pub async fn end(&mut self, bus: &Bus) -> Vec<(u64, u64)> {
        for (_, node) in self.nodes.values_mut() {
            node.write_line();
        }
        let mut counts = Vec::new();
        for structure in 0..self.sites.len() {
            let (_, steady) = &self.nodes[&(structure, STEADY)];
            steady.wait_for_output("put … samples", |said| said.contains(" samples\n"));
            let said = steady.output();
            let put = said
                .split("put ")
                .nth(1)
                .and_then(|rest| rest.split(' ').next())
                .unwrap()
                .parse()
                .unwrap();
            let keys = self.sites[structure].keys();
            let ended = async {
                loop {
                    let at = bus
                        .stream_position(&keys.recording(), crate::support::DEADLINE)
                        .await;
                    match at.filter(|at| at.state == spandrel_bus::StreamState::Ended) {
                        Some(at) => return at.header.sequence,
                        None => tokio::time::sleep(Duration::from_millis(100)).await,
                    }
                }
            };
            let frames = within("the end of the frames", ended).await;
            let mut decided = bus
                .watch_progress(keys.progress(Service::Alert))
                .await
                .unwrap();
            within(
                "decision on all frames",
                decided.wait_for(|progress| progress.done >= frames),
            )
            .await;
            counts.push((put, frames));
        }
        for (_, (_, mut node)) in std::mem::take(&mut self.nodes) {
            node.write_line();
            node.wait().expect_code(0);
        }
        counts
    }
}

/// Checks that the recording contains each sample that the steady node has published, and every
/// frame. All nodes are present at the end.
pub fn check_recording(state: &Path, site: &Site, put: u64, frames: u64) {
    let structure = site.structure();
    let channels: Vec<String> = structure
        .channels()
        .map(|channel| channel.name().to_owned())
        .collect();
    let log = site.recording_in(state);
    let reader = log.reader();
    let spans = reader.spans();
    assert_eq!(spans.len(), 1, "{}: {spans:?}", structure.name());
    assert_eq!(
        (spans[0].from, spans[0].to, spans[0].missing),
        (0, frames, 0),
        "{}: {spans:?}",
        structure.name()
    );
    let steady = channels
        .iter()
        .position(|channel| channel == STEADY)
        .unwrap();
    let (mut recorded, mut after, mut last_whole) = (0, 0, 0);
    while after < frames {
        let block = reader
            .read(spans[0].epoch, after, 4096, 1 << 20)
            .unwrap()
            .expect("the end is recorded");
        for (number, frame) in (after..).zip(block.values.chunks(channels.len())) {
            recorded += u64::from(!frame[steady].is_nan());
            if frame.iter().all(|value| value.is_finite()) {
                last_whole = number;
            }
        }
        after += block.count();
    }
    assert_eq!(
        recorded,
        put,
        "{}: samples of {STEADY} in the recording, of those put",
        structure.name()
    );
    let unheard = frames - last_whole;
    assert!(
        unheard < 2000,
        "{}: the last {unheard} frames lack a node that is online",
        structure.name()
    );
}
