//! A sensor node as a separate process on an accelerated clock, which the soak test starts, stops,
//! kills and lets send wrong data.

use crate::support::{Node, Record, put_raw};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use spandrel_bus::{Bus, BusConfig, Keys, Message, Mode, Name, SampleBlock, StreamState};
use spandrel_structure::Structure;
use std::io::BufRead;
use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Environment variable with the orders of the process.
pub const ORDERS: &str = "SOAK_NODE";
/// Number of samples in a block.
const BLOCK: u64 = 100;
/// Sampling interval (ns), which is 100 Hz.
const STEP_NS: i64 = 10_000_000;
/// Offset of a wrong clock (ns).
const OFF_NS: i64 = 3600 * 1_000_000_000;
const DAY_NS: i64 = 24 * OFF_NS;
/// Offset of a clock that is wrong by seconds (ns).
const SECONDS_NS: i64 = 7 * 1_000_000_000;

/// Manner in which a node changes its true samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Manner {
    Honest,
    /// Infinite values, and values outside the range of any sensor.
    Implausible,
    /// Clock one hour ahead.
    ClockAhead,
    /// Clock seven seconds ahead, within the limit of the vote.
    SecondsAhead,
    /// Clock one hour behind.
    ClockBehind,
    /// One channel too many.
    Channels,
    /// Each block twice, and once more as a block of an earlier run.
    OldMessages,
    /// Undecodable bytes between its blocks.
    Garbage,
    /// Clock 400 days ahead.
    YearAhead,
    /// A second program under the name of a node, with a clock 30 days ahead, so that its epoch is
    /// higher than that of the node.
    LaterEpoch,
}

impl Manner {
    /// What a node may do for as long as it likes.
    pub const LIES: [Self; 6] = [
        Self::Implausible,
        Self::ClockAhead,
        Self::ClockBehind,
        Self::Channels,
        Self::OldMessages,
        Self::Garbage,
    ];
}

/// Orders of a node.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Orders {
    pub endpoint: String,
    pub root: String,
    pub structure_file: PathBuf,
    /// Record that the node measures repeatedly.
    pub record: PathBuf,
    pub node: String,
    pub manner: Manner,
    pub clock: Clock,
}

/// An accelerated clock, the same in all processes.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Clock {
    /// Start of both clocks (ns since the Unix epoch).
    pub start_ns: i64,
    pub speed: f64,
}

impl Clock {
    /// Creates a clock that starts now.
    pub fn starting(speed: f64) -> Self {
        Self {
            start_ns: wall_ns(),
            speed,
        }
    }

    /// Returns the delay of a measurement at `time_ns` that is processed now, in seconds of
    /// wall-clock time.
    pub fn lag_s(&self, wall_ns: i64, time_ns: i64) -> f64 {
        let since = |ns: i64| (ns - self.start_ns) as f64 * 1e-9;
        since(wall_ns) - since(time_ns) / self.speed
    }

    /// Returns the next block whose first sample has not been measured yet.
    fn next_block(&self) -> u64 {
        let measured_ns = (wall_ns() - self.start_ns) as f64 * self.speed;
        (measured_ns / (BLOCK as i64 * STEP_NS) as f64).ceil() as u64
    }

    fn time_ns(&self, block: u64) -> i64 {
        self.start_ns + (block * BLOCK) as i64 * STEP_NS
    }

    /// Returns the time from now until a block has been measured.
    fn until_the_end_of(&self, block: u64) -> Duration {
        let due_ns = ((block + 1) * BLOCK) as f64 * STEP_NS as f64 / self.speed;
        let elapsed_ns = (wall_ns() - self.start_ns) as f64;
        Duration::from_secs_f64(((due_ns - elapsed_ns) * 1e-9).max(0.0))
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "sensors publish samples when they measure them"
)]
pub fn wall_ns() -> i64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap()
        .as_nanos() as i64
}

/// Publishes samples until the first line on standard input, and stays connected until the second.
pub async fn be(orders: Orders) {
    let Orders {
        endpoint,
        root,
        structure_file,
        record,
        node,
        manner,
        clock,
    } = orders;
    let config = BusConfig {
        root: root.clone(),
        mode: Mode::Client,
        connect: vec![endpoint],
        connect_timeout_s: Some(crate::support::DEADLINE.as_secs_f64()),
        ..BusConfig::default()
    };
    let bus = Bus::open(&config).await.unwrap();
    let structure = Structure::read(&structure_file).unwrap();
    let keys = Keys::parse(&root, structure.name()).unwrap();
    let layout = structure
        .nodes()
        .iter()
        .find(|layout| layout.name() == node)
        .unwrap();
    let channels = layout
        .channels()
        .iter()
        .map(|channel| channel.name().to_owned())
        .collect();
    let record = Record::read(&record);
    let mut node = Node::start(
        &bus,
        &keys,
        Name::new(&node).unwrap(),
        channels,
        match manner {
            Manner::LaterEpoch => wall_ns() + 30 * DAY_NS,
            _ => wall_ns(),
        } as u64,
    )
    .await;
    let lines = lines();
    let mut random = ChaCha8Rng::seed_from_u64(clock.next_block());
    let first = clock.next_block();
    let mut number = first;
    loop {
        tokio::select! {
            () = tokio::time::sleep(clock.until_the_end_of(number)) => {}
            line = lines.recv_async() => {
                line.unwrap();
                break;
            }
        }
        let row = (number * BLOCK) as usize % record.len();
        let mut block = node.block(&record, row..row + BLOCK as usize);
        block.header.time_ns = clock.time_ns(number);
        lie(manner, &mut block, &bus, &node.key, &mut random).await;
        node.put(block).await;
        number += 1;
    }
    let mut end = node.block(&record, 0..0);
    end.header.time_ns = clock.time_ns(number);
    end.state = StreamState::Ended;
    node.put(end).await;
    println!("put {} samples", (number - first) * BLOCK);
    lines.recv_async().await.unwrap();
    drop(node);
    bus.close().await.unwrap();
}

/// Returns the lines on standard input. They end when the parent process ends.
fn lines() -> flume::Receiver<()> {
    let (sender, lines) = flume::unbounded();
    std::thread::spawn(move || {
        for _ in std::io::stdin().lock().lines() {
            sender.send(()).unwrap();
        }
        std::process::exit(1);
    });
    lines
}

async fn lie(
    manner: Manner,
    block: &mut SampleBlock,
    bus: &Bus,
    key: &str,
    random: &mut ChaCha8Rng,
) {
    match manner {
        Manner::Honest => {}
        Manner::Implausible => {
            let absurd = [1e12, -1e300, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
            block
                .samples
                .iter_mut()
                .for_each(|value| *value = absurd[random.random_range(0..absurd.len())]);
        }
        Manner::ClockAhead => block.header.time_ns += OFF_NS,
        Manner::SecondsAhead => block.header.time_ns += SECONDS_NS,
        Manner::ClockBehind => block.header.time_ns -= OFF_NS,
        Manner::YearAhead => block.header.time_ns += 400 * DAY_NS,
        Manner::LaterEpoch => block.header.time_ns += 30 * DAY_NS,
        Manner::Channels => {
            block.channels += 1;
            block.samples = vec![0.0; usize::from(block.channels) * BLOCK as usize];
        }
        Manner::OldMessages => {
            let mut earlier = block.clone();
            earlier.header.epoch -= 1;
            for old in [&*block, &earlier] {
                put_raw(bus, key, &SampleBlock::encoding(), old.encode().unwrap()).await;
            }
        }
        Manner::Garbage => {
            let garbage: Vec<u8> = (0..random.random_range(0..2000))
                .map(|_| random.random())
                .collect();
            for encoding in [
                SampleBlock::encoding().as_str(),
                "application/postcard;spandrel.samples.v9",
                "text/plain",
            ] {
                put_raw(bus, key, encoding, garbage.clone()).await;
            }
        }
    }
}
