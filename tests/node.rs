//! What the worker of one node costs: the building of forty storeys at its 250 Hz, in real time, as it would run on the computer of
//! a sensor. `cargo test -p spandrel --test node -- --nocapture` shows the figures of docs/distributed.md.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails panics")]
#![cfg(target_os = "linux")]

mod support;

use spandrel_bus::{Bus, BusConfig, Mode, Status};
use std::path::Path;
use std::time::Duration;
use support::{Process, free_endpoint, spandrel};

const NODE: &str = "floor-1";
const RATE_HZ: f64 = 250.0;

/// Time before the processor time is counted, and how long it is counted (s).
const WARM_UP_S: f64 = 5.0;
const COUNTED_S: f64 = 30.0;

/// Largest resident size (MB).
const MOST_MB: f64 = 30.0;

/// Processor time of a process so far (s), user and system.
fn processor_s(process: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    // what follows the name in parentheses: state is field 3, utime 14, stime 15, in hundredths of a second
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

/// Largest resident size of a process so far (MB).
fn peak_mb(process: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

#[tokio::test(flavor = "multi_thread")]
async fn the_worker_of_a_node_stays_below_thirty_megabytes() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/forty-storey-building.toml");
    let command = |subcommand: &str| {
        let mut command = spandrel(subcommand);
        command.arg(&file).arg("-v");
        command
    };
    let (at_station, at_node) = (free_endpoint(), free_endpoint());
    let station = Process::start(command("fuse").args(["--listen", &at_station]));
    station.wait_for_log("ready structures=1");
    let mut worker = command("identify");
    let worker = Process::start(worker.args(["--node", NODE, "--listen", &at_node, "--connect", &at_station]));
    worker.wait_for_log("ready structures=1");
    let mut sensor = command("simulate");
    sensor.args(["--live", "--node", NODE, "--connect", &at_node]).env("SPANDREL_BUS__MODE", "client");
    let _sensor = Process::start(&mut sensor);
    let config = BusConfig { mode: Mode::Client, connect: vec![at_node], ..BusConfig::default() };
    let bus = Bus::open(&config).await.unwrap();
    let keys = config.keys("forty-storey-building").unwrap();
    let statuses = bus.subscribe::<Status>(keys.all_statuses(), 256).await.unwrap();

    tokio::time::sleep(Duration::from_secs_f64(WARM_UP_S)).await;
    let before = processor_s(worker.id());
    tokio::time::sleep(Duration::from_secs_f64(COUNTED_S)).await;
    let share = (processor_s(worker.id()) - before) / COUNTED_S;
    let peak = peak_mb(worker.id());
    println!("worker of {NODE}: {:.1} % of a core, largest resident size {peak:.1} MB", 100.0 * share);
    let status = statuses.messages().drain().filter(|(_, status)| status.id.as_str() == NODE).last();
    let (_, status) = status.expect("a status of the worker");
    println!("samples filtered {}, lag {:?} s, drops {:?}", status.done, status.lag_s, status.drops);
    assert!(status.done as f64 > RATE_HZ * COUNTED_S * 0.8, "the worker was not seen at work: {} samples", status.done);
    assert!(peak < MOST_MB, "{peak} MB");
    worker.stop().expect_code(0);
    station.stop().expect_code(0);
}
