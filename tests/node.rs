//! Cost of the worker of one node: the building of forty storeys at its 250 Hz, in real time, as on
//! the computer of a sensor.
//!
//! `cargo test --workspace --test program node:: -- --nocapture` prints the figures of
//! docs/distributed.md. The kernel counts the processor time, which is divided by the seconds of
//! samples filtered in it. Other work on the machine therefore affects the figure only through
//! caches and clock rate.

#![cfg(target_os = "linux")]

use crate::support::{Process, free_endpoint, spandrel, within};
use spandrel_bus::{Bus, BusConfig, Mode, Status};
use std::path::Path;

const NODE: &str = "floor-1";
const RATE_HZ: f64 = 250.0;

/// Seconds of samples before the processor time is counted, and the minimum for which it is
/// counted.
const WARM_UP_S: f64 = 5.0;
const COUNTED_S: f64 = 30.0;

/// Maximum memory of its own (MB), and maximum processor time per second of samples. The resident
/// size also contains pages of the program file, and the kernel maps as many as its cache holds.
const MOST_MB: f64 = 10.0;
const MOST_SHARE: f64 = 0.25;

/// Returns the processor time of a process so far (s), user and system.
fn processor_s(process: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    // Fields after the name in parentheses: state is field 3, utime 14, stime 15, in hundredths of
    // a second.
    let fields: Vec<&str> = stat
        .rsplit_once(')')
        .unwrap()
        .1
        .split_whitespace()
        .collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

/// Returns a size in the status of a process (MB), such as that of `VmHWM:`.
fn size_mb(process: u32, name: &str) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with(name)).unwrap();
    let kilobytes = line.split_whitespace().nth(1).unwrap();
    kilobytes.parse::<f64>().unwrap() / 1024.0
}

#[tokio::test(flavor = "multi_thread")]
async fn the_worker_of_a_node_keeps_ten_megabytes_and_takes_a_quarter_of_a_core() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples/forty-storey-building.toml");
    let command = |subcommand: &str| {
        let mut command = spandrel(subcommand);
        command.arg(&file).arg("-v");
        command
    };
    let (at_station, at_node) = (free_endpoint(), free_endpoint());
    let station = Process::start(command("fuse").args(["--listen", &at_station]));
    station.wait_for_log("ready structures=1");
    let mut worker = command("identify");
    let worker = Process::start(worker.args([
        "--node",
        NODE,
        "--listen",
        &at_node,
        "--connect",
        &at_station,
    ]));
    worker.wait_for_log("ready structures=1");
    let mut sensor = command("simulate");
    sensor
        .args(["--live", "--node", NODE, "--connect", &at_node])
        .env("SPANDREL_BUS__MODE", "client");
    let _sensor = Process::start(&mut sensor);
    let config = BusConfig {
        mode: Mode::Client,
        connect: vec![at_node],
        ..BusConfig::default()
    };
    let bus = Bus::open(&config).await.unwrap();
    let keys = config.keys("forty-storey-building").unwrap();
    let statuses = bus
        .subscribe::<Status>(keys.all_statuses(), 256)
        .await
        .unwrap();

    // The kernel is queried for the cost whenever the worker reports its progress.
    let next = async || loop {
        let (_, status) = statuses.messages().recv_async().await.unwrap();
        if status.id.as_str() == NODE {
            return (status, processor_s(worker.id()));
        }
    };
    let (mut first, mut before_s) = within("status of the worker", next()).await;
    while (first.done as f64) < RATE_HZ * WARM_UP_S {
        (first, before_s) = within("status of the worker", next()).await;
    }
    let (mut last, mut after_s) = (first.clone(), before_s);
    while ((last.done - first.done) as f64) < RATE_HZ * COUNTED_S {
        (last, after_s) = within("status of the worker", next()).await;
    }
    let data_s = (last.done - first.done) as f64 / RATE_HZ;
    let share = (after_s - before_s) / data_s;
    let own = size_mb(worker.id(), "RssAnon:");
    let peak = size_mb(worker.id(), "VmHWM:");
    println!(
        "worker of {NODE}: {:.1} ms of processor time per second of samples ({:.1} % of a core), \
         {own:.1} MB of its own, largest resident size {peak:.1} MB",
        1e3 * share,
        1e2 * share
    );
    println!(
        "counted over {data_s:.0} s of samples; lag {:?} s, drops {:?}",
        last.lag_s, last.drops
    );
    assert!(own < MOST_MB, "{own} MB");
    assert!(
        share < MOST_SHARE,
        "{share} s of processor time per second of samples"
    );
    worker.stop().expect_code(0);
    station.stop().expect_code(0);
}
