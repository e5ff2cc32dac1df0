//! Network traffic of a node that identifies its own parameters, compared with its raw samples.
//!
//! The results must agree with the table of docs/distributed.md. Each run of the tests counts the
//! payload without a network. The tests on the wire are ignored by default, because they need the
//! same as [`Lab`] and eight minutes.
//!
//! The node is on its own computer, a network namespace. All other nodes run next to the station,
//! so that the fusions are those of the whole structure. Nodes that identify their own parameters
//! run at a fraction of the rate there. Their messages have the same length, and two cores can run
//! all of them.

#![cfg(target_os = "linux")]

use crate::support::{Lab, Process, spandrel, within};
use spandrel_bus::{
    Bus, BusConfig, Header, Keys, LocalMessage, Message, Mode, Name, NodeDisplay, Pace,
    SampleBlock, StreamState, Subscription, ToldMotion, ToldSamples,
};
use spandrel_fuse::{Fusion, FusionInput, Output};
use spandrel_identify::{NodeIdentification, NodeInput, NodeOutput};
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// Seconds of samples during the start-up, which is not counted.
const WARM_UP_S: f64 = 10.0;
/// Duration of the count (s).
const COUNTED_S: f64 = 30.0;

/// Allowed relative difference of the payload from the table: sequence numbers with more digits and
/// times take a few bytes.
const PAYLOAD_WITHIN: f64 = 0.01;
/// Allowed relative difference of the bytes on the wire: the times of acknowledgements and
/// keep-alives depend on the load of the machine.
const WIRE_WITHIN: f64 = 0.05;

/// An example with a node, the published number of modes, and the published share of the raw
/// samples.
struct Example {
    name: &'static str,
    file: &'static str,
    node: &'static str,
    modes: usize,
    published: f64,
    /// Fraction of the rate of identifying nodes on the wire. The number of samples per second must
    /// be divisible by ten.
    part: f64,
    /// Samples of each channel that nodes exchange per second.
    told: &'static [usize],
}

const BUILDING: Example = Example {
    name: "building",
    file: "forty-storey-building.toml",
    node: "floor-1",
    modes: 5,
    published: 0.170,
    part: 5.0,
    told: &[10, 50],
};
const BRIDGE: Example = Example {
    name: "bridge",
    file: "two-pier-bridge.toml",
    node: "node-2",
    modes: 6,
    published: 0.068,
    part: 10.0,
    told: &[10],
};

impl Example {
    fn text(&self) -> String {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../docs/examples")
            .join(self.file);
        std::fs::read_to_string(path).unwrap()
    }

    /// Returns the variants of exchange: the row of the table, and the structure file that requests
    /// it.
    fn exchanges(&self) -> Vec<(String, String)> {
        let Self { name, modes, .. } = self;
        let of_modes = format!("motion = \"modes\"\nmodes = {modes}");
        let mut kinds = vec![
            (format!("{name}: modes ({modes})"), of_modes),
            (format!("{name}: densities"), "motion = \"none\"".to_owned()),
            (
                format!("{name}: densities and responses"),
                "motion = \"responses\"".to_owned(),
            ),
        ];
        for told in self.told {
            let fusion = format!("motion = \"samples\"\nsamples-per-period = {told}");
            kinds.push((format!("{name}: densities and {told} samples"), fusion));
        }
        let text = without_fusion(&self.text());
        let with = |fusion: &str| {
            text.replacen(
                "[simulation]",
                &format!("[fusion]\ndetector = \"none\"\n{fusion}\n\n[simulation]"),
                1,
            )
        };
        kinds
            .into_iter()
            .map(|(row, fusion)| (row, with(&fusion)))
            .collect()
    }

    fn raw_row(&self) -> String {
        format!("{}: raw samples", self.name)
    }
}

/// Traffic in bytes per second: payload and Ethernet frames, from the node and to it.
#[derive(Debug, Default, Clone, Copy)]
struct Traffic {
    payload_up: f64,
    payload_down: f64,
    wire_up: f64,
    wire_down: f64,
}

impl Traffic {
    /// Returns the values of a row of the table in docs/distributed.md.
    fn documented(row: &str) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/distributed.md");
        let text = std::fs::read_to_string(path).unwrap();
        let line = text
            .lines()
            .find(|line| line.starts_with(&format!("| {row} |")));
        let line = line.unwrap_or_else(|| panic!("docs/distributed.md has no row {row:?}"));
        // A value that was not measured on the wire becomes NaN, which agrees with nothing.
        let number = |cell: &str| cell.trim().parse().unwrap_or(f64::NAN);
        let cells: Vec<f64> = line.split('|').skip(2).take(4).map(number).collect();
        Self {
            payload_up: cells[0],
            payload_down: cells[1],
            wire_up: cells[2],
            wire_down: cells[3],
        }
    }

    fn assert_payload(&self, row: &str) {
        let documented = Self::documented(row);
        assert_near(
            row,
            "payload up",
            self.payload_up,
            documented.payload_up,
            PAYLOAD_WITHIN,
        );
        assert_near(
            row,
            "payload down",
            self.payload_down,
            documented.payload_down,
            PAYLOAD_WITHIN,
        );
    }
}

/// Checks a value against the table. A difference of one byte per second may come from rounding.
fn assert_near(row: &str, what: &str, found: f64, documented: f64, within: f64) {
    let allowed = 1.0 + within * documented;
    assert!(
        (found - documented).abs() <= allowed,
        "{row}: {what} is {found:.1} bytes/s, docs/distributed.md says {documented} and allows \
         {:.0} %",
        100.0 * within
    );
}

/// Checks the published shares: the number of values in a message of (6.13) to (6.20) relative to
/// the raw samples of a fusion period.
#[test]
fn published_shares_equal_the_numbers_in_a_message() {
    for (example, channels, rate_hz) in [(BUILDING, 2.0, 250.0), (BRIDGE, 2.0, 500.0)] {
        let structure = Structure::parse(&example.text(), Path::new(example.file)).unwrap();
        let (modes, parameters) = (example.modes as f64, structure.parameters().len() as f64);
        let numbers = 4.0 * modes + parameters * (parameters + 3.0) / 2.0;
        assert!(
            (numbers / (channels * rate_hz) - example.published).abs() < 5e-4,
            "{}: {numbers}",
            example.name
        );
        // The same share of payload in bytes: messages and blocks of raw samples both have a
        // header.
        let row = format!("{}: modes ({})", example.name, example.modes);
        let (sent, raw) = (
            Traffic::documented(&row),
            Traffic::documented(&example.raw_row()),
        );
        let share = sent.payload_up / raw.payload_up;
        println!(
            "{row}: {share:.3} of the payload of raw samples, published {:.3} of the numbers",
            example.published
        );
        assert!(share < example.published, "{row}: {share}");
    }
}

#[test]
fn payload_of_the_building_matches_the_documentation() {
    payload_is_documented(&BUILDING);
}

#[test]
fn payload_of_the_bridge_matches_the_documentation() {
    payload_is_documented(&BRIDGE);
}

fn payload_is_documented(example: &Example) {
    let structure = Structure::parse(&example.text(), Path::new(example.file)).unwrap();
    raw_payload(&structure, example.node).assert_payload(&example.raw_row());
    for (row, text) in example.exchanges() {
        // Messages have the same length at a fraction of the rate.
        let text = slower(&text, example.part);
        let structure = Structure::parse(&text, Path::new(example.file))
            .unwrap_or_else(|error| panic!("{error}"));
        let traffic = exchanged_payload(&structure, example.node);
        println!(
            "{row}: payload {:.0} up, {:.0} down",
            traffic.payload_up, traffic.payload_down
        );
        traffic.assert_payload(&row);
    }
}

/// A time of the present, so that it takes as many bytes as real ones (ns).
const NOW_NS: i64 = 1_763_730_000_000_000_000;
const SECOND_NS: i64 = 1_000_000_000;

/// Returns samples of a node of the structure, all 0, from a sequence number on.
fn samples(structure: &Structure, node: &str, from: u64, count: u64) -> SampleBlock {
    let own = structure.of_node(node).unwrap();
    let (rate_hz, channels) = (own.sampling_rate_hz(), own.channel_count());
    SampleBlock {
        header: Header {
            source: node.to_owned(),
            epoch: NOW_NS as u64,
            sequence: from,
            time_ns: NOW_NS + (from as f64 * 1e9 / rate_hz).round() as i64,
        },
        sampling_rate_hz: rate_hz,
        pace: Pace::Replayed,
        channels: channels as u16,
        samples: vec![0.0; count as usize * channels],
        state: StreamState::Running,
        clock_quality: None,
    }
}

/// Returns the payload of a node's raw samples in blocks of 50 ms, once their sequence numbers have
/// three bytes.
fn raw_payload(structure: &Structure, node: &str) -> Traffic {
    const FROM: u64 = 20_000;
    let rate_hz = structure.of_node(node).unwrap().sampling_rate_hz();
    let count = (rate_hz * 0.05) as u64;
    let bytes = samples(structure, node, FROM, count)
        .encode()
        .unwrap()
        .len();
    Traffic {
        payload_up: bytes as f64 * rate_hz / count as f64,
        ..Traffic::default()
    }
}

/// Returns the exchanged motion as it is while the structure moves. Samples of twenty noise
/// deviations take two bytes, because their unit is at most an eighth of a deviation. Samples of a
/// structure at rest take one byte.
fn moving(told: &ToldMotion, units: &[i16]) -> ToldMotion {
    const DEVIATIONS: f64 = 20.0;
    match told {
        ToldMotion::Numbers(_) => told.clone(),
        ToldMotion::Samples(samples) => {
            let unit = units
                .iter()
                .map(|exponent| 2f64.powi(i32::from(*exponent)))
                .cycle();
            let samples: Vec<f64> = unit
                .map(|unit| 8.0 * DEVIATIONS * unit)
                .take(samples.samples().len())
                .collect();
            ToldMotion::Samples(ToldSamples::new(&samples, units))
        }
    }
}

/// Returns the sent and received payload of a node once the station has received messages of all
/// nodes in each of two periods of 1 s.
fn exchanged_payload(structure: &Structure, node: &str) -> Traffic {
    const PERIODS: u64 = 2;
    let epoch = NOW_NS as u64;
    let names: Vec<&str> = structure.nodes().iter().map(|node| node.name()).collect();
    let measured = names.iter().position(|name| *name == node).unwrap();
    let workers = (0..names.len())
        .map(|position| NodeIdentification::new(structure, position, epoch).unwrap());
    let mut workers: Vec<NodeIdentification> = workers.collect();
    let mut fusion = Fusion::new(structure, "fuse", epoch).unwrap();
    fusion.handle(
        FusionInput::Present(vec![true; names.len()]),
        &mut Vec::new(),
    );
    let mut traffic = Traffic::default();
    for period in 0..PERIODS {
        let mut fused = Vec::new();
        for (position, worker) in workers.iter_mut().enumerate() {
            let rate = structure
                .of_node(names[position])
                .unwrap()
                .sampling_rate_hz() as u64;
            let mut outputs = Vec::new();
            worker.handle(
                NodeInput::Samples(samples(structure, names[position], period * rate, rate)),
                &mut outputs,
            );
            let [NodeOutput::Local(message)] = &outputs[..] else {
                panic!("one message a period: {outputs:?}")
            };
            let mut sent = LocalMessage::clone(message);
            if let Some(told) = sent
                .density
                .as_mut()
                .and_then(|density| density.motion.as_mut())
            {
                *told = moving(told, &structure.told_units(position));
            }
            let bytes = sent.encode().unwrap().len();
            if position == measured {
                traffic.payload_up = bytes as f64;
            }
            let arrived_ns = NOW_NS + (period as i64 + 1) * SECOND_NS;
            let message = LocalMessage::clone(message);
            fusion.handle(
                FusionInput::Local {
                    node: position,
                    message: Box::new(message),
                    bytes: bytes as u64,
                    arrived_ns,
                },
                &mut fused,
            );
        }
        for output in fused {
            let Output::Feedback(position, feedback) = output else {
                continue;
            };
            assert_eq!(
                usize::from(feedback.nodes),
                names.len(),
                "the reply covers all nodes"
            );
            if position == measured {
                let mut sent = feedback.clone();
                for (node, told) in sent.responses.iter_mut().enumerate() {
                    *told = told
                        .as_ref()
                        .map(|told| moving(told, &structure.told_units(node)));
                }
                traffic.payload_down = sent.encode().unwrap().len() as f64;
            }
            workers[position].handle(NodeInput::Feedback(feedback), &mut Vec::new());
        }
    }
    traffic
}

/// A node and a station on separate computers, and a session at the station.
struct Line {
    lab: Lab,
    folder: tempfile::TempDir,
    structure: Structure,
    keys: Keys,
    processes: Vec<Process>,
}

impl Line {
    /// Creates the computers `node` and `station`. Returns `None` if namespaces cannot be created.
    fn new(text: &str) -> Option<Self> {
        let lab = Lab::or_skip(&["node", "station"], 1)?;
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("structure.toml");
        std::fs::write(&file, text).unwrap();
        let structure = Structure::read(&file).unwrap_or_else(|error| panic!("{error}"));
        let keys = Keys::parse("spandrel", structure.name()).unwrap();
        let site = |arguments: &[&str]| {
            let mut command = spandrel("site");
            command
                .arg(arguments[0])
                .arg(folder.path().join("site"))
                .args(&arguments[1..]);
            Process::start(&mut command).wait().expect_code(0);
        };
        site(&["create"]);
        site(&[
            "issue",
            "server",
            "station",
            "--host",
            &lab.address("station"),
        ]);
        site(&["nodes", file.to_str().unwrap()]);
        Some(Self {
            lab,
            folder,
            structure,
            keys,
            processes: Vec::new(),
        })
    }

    fn command(&self, computer: &str, subcommand: &str) -> Command {
        let mut command = self.lab.spandrel(computer, subcommand);
        command
            .arg(self.folder.path().join("structure.toml"))
            .arg("-v");
        command
    }

    /// Starts a service and waits until it is ready.
    fn serve(&mut self, command: &mut Command) {
        let process = Process::start(command);
        process.wait_for_log("ready structures=1");
        self.processes.push(process);
    }

    fn socket(&self) -> String {
        format!(
            "unixsock-stream/{}",
            self.folder.path().join("station.sock").display()
        )
    }

    fn remote(&self) -> String {
        format!("quic/{}:7447", self.lab.address("station"))
    }

    /// Returns the path of a certificate: that of the station, or that of a node in a role.
    fn certificate(&self, role: &str, node: &str) -> PathBuf {
        let party = match role {
            "server" => "server.station".to_owned(),
            role => format!("{role}.{}.{node}", self.structure.name()),
        };
        self.folder.path().join("site").join(format!("{party}.pem"))
    }

    async fn join(&self) -> Bus {
        let config = BusConfig {
            mode: Mode::Client,
            connect: vec![self.socket()],
            ..BusConfig::default()
        };
        Bus::open(&config).await.unwrap()
    }

    /// Starts workers and live sensors of these nodes.
    fn start_nodes(&mut self, computer: &str, nodes: &[&str]) {
        const AT_NODE: &str = "tcp/127.0.0.1:7448";
        // A process with several nodes shows the certificate of the first, because roles do not
        // matter between peers.
        let certificate = self.certificate("node-worker", nodes[0]);
        let nodes: Vec<&str> = nodes.iter().flat_map(|node| ["--node", node]).collect();
        let mut worker = self.command(computer, "identify");
        worker
            .args(&nodes)
            .args([
                "--listen",
                AT_NODE,
                "--connect",
                &self.remote(),
                "--certificate",
            ])
            .arg(certificate);
        self.serve(&mut worker);
        let mut sensors = self.command(computer, "simulate");
        sensors
            .args(&nodes)
            .args(["--live", "--connect", AT_NODE])
            .env("SPANDREL_BUS__MODE", "client");
        self.processes.push(Process::start(&mut sensors));
    }

    /// Returns the bytes per second from the node and to it, for the next [`COUNTED_S`].
    async fn watch_wire(&self) -> (f64, f64) {
        let (begun, before) = (Instant::now(), self.lab.bytes("node"));
        sleep(Duration::from_secs_f64(COUNTED_S)).await; // the span of the measurement
        let (after, seconds) = (self.lab.bytes("node"), begun.elapsed().as_secs_f64());
        (
            (after.1 - before.1) as f64 / seconds,
            (after.0 - before.0) as f64 / seconds,
        )
    }
}

/// Receives messages until one fulfils a condition.
async fn next<M: Message + Send + 'static>(
    messages: &Subscription<M>,
    is_wanted: impl Fn(&M) -> bool,
) {
    while !is_wanted(&messages.messages().recv_async().await.unwrap().1) {}
}

/// Measures the raw samples of a node, streamed to an ingest.
async fn raw(text: &str, node: &str) -> Option<Traffic> {
    let text = without_fusion(text).replacen("identification = \"distributed\"\n", "", 1);
    let mut line = Line::new(&text)?;
    let mut ingest = line.command("station", "ingest");
    ingest.args([
        "--listen",
        &line.remote(),
        "--listen",
        &line.socket(),
        "--certificate",
    ]);
    ingest.arg(line.certificate("server", ""));
    line.serve(&mut ingest);
    let mut sensor = line.command("node", "simulate");
    sensor.args([
        "--live",
        "--node",
        node,
        "--connect",
        &line.remote(),
        "--certificate",
    ]);
    sensor
        .arg(line.certificate("sensor", node))
        .env("SPANDREL_BUS__MODE", "client");
    line.processes.push(Process::start(&mut sensor));
    let bus = line.join().await;
    let samples = bus
        .subscribe::<SampleBlock>(line.keys.samples(&Name::new(node).unwrap()), 1 << 14)
        .await
        .unwrap();
    let is_warm =
        |block: &SampleBlock| block.header.sequence as f64 >= WARM_UP_S * block.sampling_rate_hz;
    within("samples of the start-up", next(&samples, is_warm)).await;
    samples.messages().drain();
    let (wire_up, wire_down) = line.watch_wire().await;
    let blocks: Vec<SampleBlock> = samples.messages().drain().map(|(_, block)| block).collect();
    let payload: usize = blocks
        .iter()
        .map(|block| block.encode().unwrap().len())
        .sum();
    let seconds: f64 = blocks
        .iter()
        .map(|block| {
            block.samples.len() as f64 / f64::from(block.channels) / block.sampling_rate_hz
        })
        .sum();
    Some(Traffic {
        payload_up: payload as f64 / seconds,
        payload_down: 0.0,
        wire_up,
        wire_down,
    })
}

/// Measures local estimates and replies of a node. Also returns the mean share of the fusions in
/// which it and the others took part.
async fn distributed(text: &str, node: &str) -> Option<(Traffic, f64)> {
    let mut line = Line::new(text)?;
    let mut station = line.command("station", "fuse");
    station.args([
        "--listen",
        &line.remote(),
        "--listen",
        &line.socket(),
        "--certificate",
    ]);
    station.arg(line.certificate("server", ""));
    line.serve(&mut station);
    let names: Vec<String> = line
        .structure
        .nodes()
        .iter()
        .map(|node| node.name().to_owned())
        .collect();
    let others: Vec<&str> = names
        .iter()
        .map(String::as_str)
        .filter(|name| *name != node)
        .collect();
    line.start_nodes("station", &others);
    line.start_nodes("node", &[node]);
    let bus = line.join().await;
    let nodes = bus
        .subscribe::<NodeDisplay>(line.keys.all_nodes(), 1 << 14)
        .await
        .unwrap();
    // One message per second.
    let is_warm = |display: &NodeDisplay| {
        display.node.as_str() == node && display.messages as f64 >= WARM_UP_S
    };
    within("messages of the start-up", next(&nodes, is_warm)).await;
    nodes.messages().drain();
    let (wire_up, wire_down) = line.watch_wire().await;
    let told: Vec<NodeDisplay> = nodes
        .messages()
        .drain()
        .map(|(_, display)| display)
        .collect();
    let used = told
        .iter()
        .filter(|display| display.state == spandrel_bus::NodeHealth::Used)
        .count();
    let of_node: Vec<&NodeDisplay> = told
        .iter()
        .filter(|display| display.node.as_str() == node)
        .collect();
    let (first, last) = (
        of_node.first().expect("a fusion"),
        of_node.last().expect("a fusion"),
    );
    // One message per second.
    let messages = (last.messages - first.messages) as f64;
    let traffic = Traffic {
        payload_up: (last.bytes_received - first.bytes_received) as f64 / messages,
        payload_down: (last.bytes_sent - first.bytes_sent) as f64 / messages,
        wire_up,
        wire_down,
    };
    Some((traffic, used as f64 / of_node.len() as f64))
}

/// Returns the text with a fraction of the sampling rate.
fn slower(text: &str, part: f64) -> String {
    let line = text
        .lines()
        .find(|line| line.starts_with("sampling-rate-hz = "))
        .unwrap();
    let rate_hz: f64 = line
        .trim_start_matches("sampling-rate-hz = ")
        .trim()
        .parse()
        .unwrap();
    text.replacen(line, &format!("sampling-rate-hz = {}", rate_hz / part), 1)
}

/// Returns the text of an example without its `[fusion]`.
fn without_fusion(text: &str) -> String {
    let (start, end) = (
        text.find("[fusion]").unwrap(),
        text.find("[simulation]").unwrap(),
    );
    format!("{}{}", &text[..start], &text[end..])
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes eight minutes; prints the table of docs/distributed.md and compares"]
async fn traffic_of_a_node_on_the_wire_matches_the_documentation() {
    println!(
        "| | payload up | down | wire up | down | payload / raw | both ways | wire / raw | nodes \
         in a fusion |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    let mut measured = Vec::new();
    for example in [BUILDING, BRIDGE] {
        let Some(raw) = raw(&example.text(), example.node).await else {
            return;
        };
        let mut show = |row: String, of: Traffic, nodes: Option<(f64, usize)>| {
            let Traffic {
                payload_up,
                payload_down,
                wire_up,
                wire_down,
            } = of;
            let share = payload_up / raw.payload_up;
            let both = (payload_up + payload_down) / raw.payload_up;
            let wire = (wire_up + wire_down) / (raw.wire_up + raw.wire_down);
            let heard =
                nodes.map_or_else(String::new, |(heard, all)| format!("{heard:.1} of {all}"));
            println!(
                "| {row} | {payload_up:.0} | {payload_down:.0} | {wire_up:.0} | {wire_down:.0} | \
                 {share:.3} | {both:.3} | {wire:.3} | {heard} |"
            );
            measured.push((row, of, nodes));
        };
        show(example.raw_row(), raw, None);
        for (row, text) in example.exchanges() {
            let Some((traffic, nodes)) =
                distributed(&slower(&text, example.part), example.node).await
            else {
                return;
            };
            let all = Structure::parse(&text, Path::new(example.file))
                .unwrap()
                .nodes()
                .len();
            show(row, traffic, Some((nodes, all)));
        }
    }
    for (row, of, nodes) in &measured {
        let documented = Traffic::documented(row);
        // Small samples take fewer bytes. A reply is shorter without the data of a node whose
        // message was missing or from another time. The documented bytes on the wire are therefore
        // adjusted to the actual payload.
        let expected_up = documented.wire_up - documented.payload_up + of.payload_up;
        let expected_down = documented.wire_down - documented.payload_down + of.payload_down;
        assert_near(row, "wire up", of.wire_up, expected_up, WIRE_WITHIN);
        assert_near(row, "wire down", of.wire_down, expected_down, WIRE_WITHIN);
        if !row.contains("samples") || row.contains("raw") {
            assert_near(
                row,
                "payload up",
                of.payload_up,
                documented.payload_up,
                PAYLOAD_WITHIN,
            );
        }
        if (of.payload_down - documented.payload_down).abs()
            > 1.0 + PAYLOAD_WITHIN * documented.payload_down
        {
            println!(
                "{row}: {:.0} bytes/s in answers for {}, {nodes:?} heard",
                of.payload_down, documented.payload_down
            );
        }
    }
}
