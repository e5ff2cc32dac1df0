//! What a node that identifies for itself puts on the wire and takes off it, and what its raw samples would: the table of
//! docs/distributed.md.
//!
//! ```sh
//! cargo test -p spandrel --test traffic -- --ignored --nocapture
//! ```
//!
//! Takes seven minutes and what [`Lab`] needs. The node is a computer of its own, a network namespace; all others run beside the
//! station, so that the fusions are those of the whole structure, at a fifth or a tenth of the rate: their messages are as long, and two
//! cores can do all of them.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails panics")]
#![cfg(target_os = "linux")]

mod support;

use spandrel_bus::{Bus, BusConfig, Keys, Message, Mode, Name, NodeDisplay, SampleBlock};
use spandrel_structure::Structure;
use std::path::Path;
use std::process::Command;
use std::time::Duration;
use support::{Lab, Process};
use tokio::time::{Instant, sleep};

/// What comes before is start-up (s).
const WARM_UP_S: f64 = 10.0;
/// What is counted (s).
const COUNTED_S: f64 = 30.0;

/// An example with a node, the published number of modes, and the published share of the raw samples.
struct Example {
    file: &'static str,
    node: &'static str,
    modes: usize,
    published: f64,
    /// the other nodes have this part of the rate; ten instants have to divide their samples of a second
    part: f64,
}

const EXAMPLES: [Example; 2] = [
    Example { file: "forty-storey-building.toml", node: "floor-1", modes: 5, published: 0.170, part: 5.0 },
    Example { file: "two-pier-bridge.toml", node: "node-2", modes: 6, published: 0.068, part: 10.0 },
];

/// Bytes per second: payload and Ethernet frames, away from the node and to it.
#[derive(Default)]
struct Traffic {
    payload_up: f64,
    payload_down: f64,
    wire_up: f64,
    wire_down: f64,
}

/// A node and a station on computers of their own, and a session at the station.
struct Line {
    lab: Lab,
    folder: tempfile::TempDir,
    structure: Structure,
    keys: Keys,
    processes: Vec<Process>,
}

impl Line {
    /// Computers `node` and `station`; none where namespaces cannot be made.
    fn new(text: &str) -> Option<Self> {
        let lab = Lab::or_skip(&["node", "station"], 1)?;
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("structure.toml");
        std::fs::write(&file, text).unwrap();
        let structure = Structure::read(&file).unwrap_or_else(|error| panic!("{error}"));
        let keys = Keys::parse("spandrel", structure.name()).unwrap();
        Some(Self { lab, folder, structure, keys, processes: Vec::new() })
    }

    fn command(&self, computer: &str, subcommand: &str) -> Command {
        let mut command = self.lab.spandrel(computer, subcommand);
        command.arg(self.folder.path().join("structure.toml")).arg("-v");
        command
    }

    /// A service that is waited for.
    fn serve(&mut self, command: &mut Command) {
        let process = Process::start(command);
        process.wait_for_log("ready structures=1");
        self.processes.push(process);
    }

    fn socket(&self) -> String {
        format!("unixsock-stream/{}", self.folder.path().join("station.sock").display())
    }

    fn remote(&self) -> String {
        format!("tcp/{}:7447", self.lab.address("station"))
    }

    async fn join(&self) -> Bus {
        let config = BusConfig { mode: Mode::Client, connect: vec![self.socket()], ..BusConfig::default() };
        Bus::open(&config).await.unwrap()
    }

    /// Workers and live sensors of these nodes.
    fn start_nodes(&mut self, computer: &str, nodes: &[&str]) {
        const AT_NODE: &str = "tcp/127.0.0.1:7448";
        let nodes: Vec<&str> = nodes.iter().flat_map(|node| ["--node", node]).collect();
        let mut worker = self.command(computer, "identify");
        worker.args(&nodes).args(["--listen", AT_NODE, "--connect", &self.remote()]);
        self.serve(&mut worker);
        let mut sensors = self.command(computer, "simulate");
        sensors.args(&nodes).args(["--live", "--connect", AT_NODE]).env("SPANDREL_BUS__MODE", "client");
        self.processes.push(Process::start(&mut sensors));
    }

    /// Bytes per second from the node and to it, for the next [`COUNTED_S`].
    async fn watch_wire(&self) -> (f64, f64) {
        let (begun, before) = (Instant::now(), self.lab.bytes("node"));
        sleep(Duration::from_secs_f64(COUNTED_S)).await;
        let (after, seconds) = (self.lab.bytes("node"), begun.elapsed().as_secs_f64());
        ((after.1 - before.1) as f64 / seconds, (after.0 - before.0) as f64 / seconds)
    }
}

/// The raw samples of a node, streamed to an ingest.
async fn raw(text: &str, node: &str) -> Option<Traffic> {
    let text = without_fusion(text).replacen("identification = \"distributed\"\n", "", 1);
    let mut line = Line::new(&text)?;
    let mut ingest = line.command("station", "ingest");
    ingest.args(["--listen", &line.remote(), "--listen", &line.socket()]);
    line.serve(&mut ingest);
    let mut sensor = line.command("node", "simulate");
    sensor.args(["--live", "--node", node, "--connect", &line.remote()]).env("SPANDREL_BUS__MODE", "client");
    line.processes.push(Process::start(&mut sensor));
    let bus = line.join().await;
    let samples = bus.subscribe::<SampleBlock>(line.keys.samples(&Name::new(node).unwrap()), 1 << 14).await.unwrap();
    sleep(Duration::from_secs_f64(WARM_UP_S)).await;
    samples.messages().drain();
    let (wire_up, wire_down) = line.watch_wire().await;
    let payload: usize = samples.messages().drain().map(|(_, block)| block.encode().unwrap().len()).sum();
    Some(Traffic { payload_up: payload as f64 / COUNTED_S, payload_down: 0.0, wire_up, wire_down })
}

/// Local estimates and answers of a node; also in how many of the fusions it and the others took part on average.
async fn distributed(text: &str, node: &str) -> Option<(Traffic, f64)> {
    let mut line = Line::new(text)?;
    let mut station = line.command("station", "fuse");
    station.args(["--listen", &line.remote(), "--listen", &line.socket()]);
    line.serve(&mut station);
    let names: Vec<String> = line.structure.nodes().iter().map(|node| node.name().to_owned()).collect();
    let others: Vec<&str> = names.iter().map(String::as_str).filter(|name| *name != node).collect();
    line.start_nodes("station", &others);
    line.start_nodes("node", &[node]);
    let bus = line.join().await;
    let nodes = bus.subscribe::<NodeDisplay>(line.keys.all_nodes(), 1 << 14).await.unwrap();
    sleep(Duration::from_secs_f64(WARM_UP_S)).await;
    nodes.messages().drain();
    let (wire_up, wire_down) = line.watch_wire().await;
    let told: Vec<NodeDisplay> = nodes.messages().drain().map(|(_, display)| display).collect();
    let used = told.iter().filter(|display| display.state == spandrel_bus::NodeHealth::Used).count();
    let of_node: Vec<&NodeDisplay> = told.iter().filter(|display| display.node.as_str() == node).collect();
    let (first, last) = (of_node.first().expect("a fusion"), of_node.last().expect("a fusion"));
    let seconds = (last.time_ns - first.time_ns) as f64 * 1e-9;
    let traffic = Traffic {
        payload_up: (last.bytes_received - first.bytes_received) as f64 / seconds,
        payload_down: (last.bytes_sent - first.bytes_sent) as f64 / seconds,
        wire_up,
        wire_down,
    };
    Some((traffic, used as f64 / of_node.len() as f64))
}

/// The text with all nodes but one sampled at a part of the rate.
fn slower(text: &str, but: &str, part: f64) -> String {
    let rate = text.lines().find_map(|line| line.strip_prefix("sampling-rate-hz = ")).unwrap();
    let slow = format!("sampling-rate-hz = {}", rate.parse::<f64>().unwrap() / part);
    let mut nodes = text.split("[[node]]\n").map(str::to_owned);
    let before = nodes.next().unwrap();
    let is_one = |node: &String| node.starts_with(&format!("name = \"{but}\""));
    let nodes = nodes.map(|node| if is_one(&node) { node } else { format!("{slow}\n{node}") });
    nodes.fold(before, |text, node| text + "[[node]]\n" + &node)
}

/// The text of an example without its `[fusion]`.
fn without_fusion(text: &str) -> String {
    let (start, end) = (text.find("[fusion]").unwrap(), text.find("[simulation]").unwrap());
    format!("{}{}", &text[..start], &text[end..])
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "measures for seven minutes; prints the table of docs/distributed.md"]
async fn traffic_of_a_node_on_the_wire() {
    println!("| | payload up | down | wire up | down | payload / raw | both ways | wire / raw | nodes in a fusion |");
    println!("|---|---|---|---|---|---|---|---|---|");
    for Example { file, node, modes, published, part } in EXAMPLES {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples").join(file);
        let text = std::fs::read_to_string(path).unwrap();
        let Some(raw) = raw(&text, node).await else { return };
        let show = |name: &str, of: &Traffic, nodes: &str| {
            let Traffic { payload_up, payload_down, wire_up, wire_down } = of;
            let share = payload_up / raw.payload_up;
            let both = (payload_up + payload_down) / raw.payload_up;
            let wire = (wire_up + wire_down) / (raw.wire_up + raw.wire_down);
            println!(
                "| {file}, {name} | {payload_up:.0} | {payload_down:.0} | {wire_up:.0} | {wire_down:.0} | \
                 {share:.3} | {both:.3} | {wire:.3} | {nodes} |"
            );
        };
        show("raw samples", &raw, "");
        let of_modes = format!("motion = \"modes\"\nmodes = {modes}");
        let kinds = [
            (format!("modes, published {published:.3}"), of_modes.as_str()),
            ("densities".to_owned(), ""),
            ("densities and responses".to_owned(), "motion = \"responses\""),
            ("densities and samples".to_owned(), "motion = \"samples\""),
        ];
        for (name, fusion) in kinds {
            let text = without_fusion(&slower(&text, node, part)).replacen(
                "[simulation]",
                &format!("[fusion]\ndetector = \"none\"\n{fusion}\n[simulation]"),
                1,
            );
            let Some((traffic, nodes)) = distributed(&text, node).await else { return };
            show(&name, &traffic, &format!("{nodes:.1}"));
            assert!(traffic.payload_up > 0.0 && traffic.wire_up > traffic.payload_up, "nothing was counted");
        }
    }
}
