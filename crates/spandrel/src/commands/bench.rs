//! `spandrel bench`: measures how many structures this machine can monitor, and with what latency.

use super::print;
use super::simulate::{Simulation, simulate};
use crate::cli::BenchArguments;
use crate::error::AppError;
use crate::services::{Running, Share, Watched, block_on};
use crate::settings::Settings;
use serde::Serialize;
use spandrel_bus::{Bus, BusConfig, EstimateBlock, Mode, Progress, Service, read_small_text};
use spandrel_service::Clock;
use spandrel_structure::Structure;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Read;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use tokio::task::JoinSet;

/// The default structure: five storeys, six channels, 100 Hz.
const BUILT_IN: &str = include_str!("../../../../docs/examples/demo.toml");
const BUILT_IN_NAME: &str = "docs/examples/demo.toml";

/// Queue length for blocks that await timing.
const BLOCKS_WAITING: usize = 1 << 17;
/// Time for all services to start before the first sample is measured.
const HEAD_START: Duration = Duration::from_secs(3);
/// Time at the start that is not counted, because the noise levels are being learnt and buffers
/// grow.
const WARM_UP: Duration = Duration::from_secs(5);
/// Time at the end that is not counted. After the last block, services publish their progress only
/// with its next repetition, and all sensors withdraw their declarations at once.
const RUN_OUT: Duration = Duration::from_secs(1);
/// Latency above which the machine counts as overloaded (s). It equals several blocks of 50 ms.
const SUSTAINED_P99_S: f64 = 0.5;

/// Result of one measurement.
#[derive(Clone, Debug, Serialize)]
struct Load {
    structures: usize,
    seconds: f64,
    /// Latency from the last frame of a block to its estimates (s): p50, p99, p99.9.
    estimate_latency_s: [f64; 3],
    /// Latency from the last frame of a block to the progress message of the alert service (s):
    /// p50, p99, p99.9.
    alert_latency_s: [f64; 3],
    /// Received estimates divided by expected estimates.
    complete: f64,
    /// Processor time of everything, including the sensors, as a multiple of one core.
    cores: f64,
    /// Processor time per structure and second (ms).
    cpu_ms_per_structure: f64,
    /// Share of the processor time by group of threads: filters, services with serialisation, and
    /// Zenoh.
    share: BTreeMap<&'static str, f64>,
    resident_mb: f64,
    resident_mb_per_structure: f64,
    sustained: bool,
}

/// Runs one measurement, or several up to the largest sustained number of structures.
///
/// # Errors
/// Returns an error if a structure is not valid, or if a service fails.
pub fn run(arguments: &BenchArguments) -> Result<(), AppError> {
    let text = match &arguments.structure {
        Some(path) => {
            let read = read_small_text(path);
            read.map_err(|source| AppError::Io {
                what: format!("{}: cannot be read", path.display()),
                source,
            })?
        }
        None => BUILT_IN.to_owned(),
    };
    let path = arguments
        .structure
        .clone()
        .unwrap_or_else(|| PathBuf::from(BUILT_IN_NAME));
    let mut loads = Vec::new();
    if !arguments.largest {
        loads.push(tell(
            measure(&text, &path, arguments, arguments.structures)?,
            arguments,
        )?);
    } else {
        let (mut good, mut bad) = (0, None);
        let mut next = arguments.structures;
        // Doubles the number until overload, then bisects to a tenth.
        while bad.is_none_or(|bad| bad > good + (good / 10).max(1)) {
            let load = tell(measure(&text, &path, arguments, next)?, arguments)?;
            if load.sustained {
                good = next
            } else {
                bad = Some(next)
            }
            next = bad.map_or(2 * next, |bad| usize::midpoint(good, bad));
            loads.push(load);
        }
        if !arguments.json {
            print(&format!("largest sustained: {good} structures\n"))?;
        }
    }
    Ok(())
}

fn tell(load: Load, arguments: &BenchArguments) -> Result<Load, AppError> {
    if arguments.json {
        print(&format!(
            "{}\n",
            serde_json::to_string(&load).unwrap_or_default()
        ))?;
        return Ok(load);
    }
    let ms = |seconds: [f64; 3]| {
        let [p50, p99, p999] = seconds.map(|seconds| 1e3 * seconds);
        format!("{p50:.1} ms (p50), {p99:.1} ms (p99), {p999:.1} ms (p99.9)")
    };
    let mut text = format!("{} structures, {:.0} s: ", load.structures, load.seconds);
    let verdict = if load.sustained {
        "sustained"
    } else {
        "overrun"
    };
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{verdict}");
    let _ = writeln!(
        text,
        "  block to estimates   {}",
        ms(load.estimate_latency_s)
    );
    let _ = writeln!(text, "  block to alert       {}", ms(load.alert_latency_s));
    let _ = writeln!(
        text,
        "  estimates received   {:.2} %",
        100.0 * load.complete
    );
    let per_structure = load.cpu_ms_per_structure;
    let _ = writeln!(
        text,
        "  processor            {:.2} cores, {per_structure:.2} ms per structure and second",
        load.cores
    );
    let share: Vec<String> = load
        .share
        .iter()
        .map(|(what, share)| format!("{what} {:.0} %", 100.0 * share))
        .collect();
    let _ = writeln!(text, "  of that              {}", share.join(", "));
    let (all, each) = (load.resident_mb, load.resident_mb_per_structure);
    let _ = writeln!(
        text,
        "  memory               {all:.0} MB, {each:.2} MB per structure"
    );
    print(&text)?;
    Ok(load)
}

/// Returns `count` copies of a structure, each with its own name.
fn named(text: &str, path: &Path, count: usize) -> Result<Vec<(Structure, String)>, AppError> {
    // Checks the original first, so that an error refers to the lines of the file.
    Structure::parse(text, path)?;
    let wrong = |error: &dyn std::fmt::Display| AppError::Io {
        what: format!("{}: cannot be copied", path.display()),
        source: std::io::Error::other(error.to_string()),
    };
    let file: toml::Table = text.parse().map_err(|error| wrong(&error))?;
    let one = |number: usize| {
        let mut file = file.clone();
        if let Some(toml::Value::Table(structure)) = file.get_mut("structure") {
            structure.insert(
                "name".to_owned(),
                toml::Value::String(format!("bench-{number}")),
            );
        }
        let text = toml::to_string(&file).map_err(|error| wrong(&error))?;
        Ok((Structure::parse(&text, path)?, text))
    };
    (1..=count).map(one).collect()
}

fn measure(
    text: &str,
    path: &Path,
    arguments: &BenchArguments,
    count: usize,
) -> Result<Load, AppError> {
    let structures = named(text, path, count)?;
    let settings = Settings::load(&arguments.bus)?;
    let duration = Duration::from_secs_f64(arguments.duration.max(1.0));
    if !arguments.apart {
        return block_on(async {
            // A port of its own, so that the measurement neither affects nor meets other systems.
            let bus = BusConfig {
                listen: vec!["tcp/127.0.0.1:0".to_owned()],
                ..BusConfig::default()
            };
            let bus = Bus::open(&BusConfig {
                root: settings.bus.root.clone(),
                ..bus
            })
            .await?;
            let watched = watched(&settings, structures)?;
            let before = Usage::now(std::process::id());
            let mut running = Running::new(&bus, &watched, None);
            running.start_alert().await?;
            running.start_identify(settings.threads, Share::ALL).await?;
            running.start_ingest(None).await?;
            let processes = [std::process::id()];
            let load = tokio::select! {
                load = time(&bus, &watched, duration, &processes, before.resident_mb) => load,
                failed = running.failed() => failed.and(Err(AppError::NothingMeasured)),
            };
            let stopped = running.stop().await;
            bus.close().await?;
            stopped.and(load)
        });
    }
    let folder = std::env::temp_dir().join(format!("spandrel-bench-{}", std::process::id()));
    let in_folder = |what: &str, source| AppError::Io {
        what: format!("{}: {what}", folder.display()),
        source,
    };
    std::fs::create_dir_all(&folder)
        .map_err(|source| in_folder("cannot create the folder", source))?;
    let result = measure_apart(&settings, structures, duration, &folder);
    // The temporary files may remain.
    let _ = std::fs::remove_dir_all(&folder);
    result
}

/// Measures with the services in a separate process.
fn measure_apart(
    settings: &Settings,
    structures: Vec<(Structure, String)>,
    duration: Duration,
    folder: &Path,
) -> Result<Load, AppError> {
    let io = |what: &str, source| AppError::Io {
        what: what.to_owned(),
        source,
    };
    let endpoint = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    let endpoint = format!(
        "tcp/{}",
        endpoint.map_err(|source| io("no free port", source))?
    );
    let program =
        std::env::current_exe().map_err(|source| io("cannot find the program", source))?;
    let mut command = Command::new(program);
    command.args([
        "run",
        "--http",
        "none",
        "--listen",
        &endpoint,
        "-v",
        "--root",
        &settings.bus.root,
    ]);
    command
        .env("SPANDREL_HISTORY__DATABASE", "none")
        .env("SPANDREL_STATE__FOLDER", folder.join("state"));
    for (structure, text) in &structures {
        let path = folder.join(format!("{}.toml", structure.name()));
        std::fs::write(&path, text)
            .map_err(|source| io("cannot write a structure file", source))?;
        command.arg(path);
    }
    let started = command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn();
    let mut services = Started(started.map_err(|source| io("cannot start the services", source))?);
    let id = services.0.id();
    services.wait_until_ready()?;
    let before = Usage::now(id);
    block_on(async {
        let bus = BusConfig {
            connect: vec![endpoint],
            mode: Mode::Client,
            ..BusConfig::default()
        };
        let bus = Bus::open(&BusConfig {
            root: settings.bus.root.clone(),
            ..bus
        })
        .await?;
        let watched = watched(settings, structures)?;
        let load = time(
            &bus,
            &watched,
            duration,
            &[id, std::process::id()],
            before.resident_mb,
        )
        .await;
        bus.close().await?;
        load
    })
}

/// A child process that is killed when this value is dropped.
struct Started(Child);

impl Started {
    fn wait_until_ready(&mut self) -> Result<(), AppError> {
        let mut said = String::new();
        let Some(mut errors) = self.0.stderr.take() else {
            return Err(AppError::NothingMeasured);
        };
        let mut buffer = [0; 4096];
        while !said.contains("ready structures=") {
            match errors.read(&mut buffer) {
                Ok(0) | Err(_) => return Err(AppError::NothingMeasured),
                Ok(count) => said.push_str(&String::from_utf8_lossy(&buffer[..count])),
            }
        }
        // Drains the pipe, so that the child never blocks on its log.
        std::thread::spawn(move || std::io::copy(&mut errors, &mut std::io::sink()));
        Ok(())
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn watched(
    settings: &Settings,
    structures: Vec<(Structure, String)>,
) -> Result<Vec<Watched>, AppError> {
    let one = |(structure, _): (Structure, String)| {
        let keys = settings.bus.keys(structure.name())?;
        Ok(Watched {
            structure,
            keys,
            baseline: None,
            file: PathBuf::new(),
        })
    };
    structures.into_iter().map(one).collect()
}

/// Runs the sensors and measures the resulting latencies.
async fn time(
    bus: &Bus,
    watched: &[Watched],
    duration: Duration,
    processes: &[u32],
    resident_before_mb: f64,
) -> Result<Load, AppError> {
    let Some(first) = watched.first() else {
        return Err(AppError::NothingMeasured);
    };
    let root = first.keys.root();
    let estimates = bus
        .subscribe::<EstimateBlock>(format!("{root}/*/estimates"), BLOCKS_WAITING)
        .await?;
    let decided = bus
        .subscribe::<Progress>(
            format!("{root}/*/progress/{}", Service::Alert.as_str()),
            BLOCKS_WAITING,
        )
        .await?;
    let start_ns = Clock::of_machine().now_ns() + HEAD_START.as_nanos() as i64;
    let mut sensors = start_sensors(bus, watched, duration, start_ns);
    let (from_ns, to_ns) = (
        start_ns + WARM_UP.as_nanos() as i64,
        start_ns + duration.saturating_sub(RUN_OUT).as_nanos() as i64,
    );
    let late = |time_ns: i64| Clock::of_machine().now_ns().saturating_sub(time_ns) as f64 / 1e9;
    let is_counted = |time_ns: i64| (from_ns..to_ns).contains(&time_ns);
    let (mut estimated, mut alerted, mut frames) = (Vec::new(), Vec::new(), 0);
    let mut done: BTreeMap<String, u64> = BTreeMap::new();
    let mut first_usage = None;
    let end = tokio::time::sleep(
        Duration::from_nanos((to_ns - Clock::of_machine().now_ns()).max(0).unsigned_abs())
            + RUN_OUT,
    );
    tokio::pin!(end);
    loop {
        tokio::select! {
            biased;
            () = &mut end => break,
            Ok((_, block)) = estimates.messages().recv_async() => {
                let time_ns = last_ns(&block);
                if is_counted(time_ns) {
                    first_usage.get_or_insert_with(|| processes.iter().map(|id| Usage::now(*id)).collect::<Vec<_>>());
                    estimated.push(late(time_ns));
                    frames += block.estimates.len();
                }
            }
            Ok((key, progress)) = decided.messages().recv_async() => {
                // Ignores repetitions, which the service publishes while nothing changes.
                let is_new = done.insert(key, progress.done) != Some(progress.done);
                if is_new && is_counted(progress.header.time_ns) {
                    alerted.push(late(progress.header.time_ns));
                }
            }
        }
    }
    let last_usage: Vec<Usage> = processes.iter().map(|id| Usage::now(*id)).collect();
    sensors.shutdown().await;
    let Some(first_usage) = first_usage else {
        return Err(AppError::NothingMeasured);
    };
    let measured = Measured {
        seconds: (to_ns - from_ns) as f64 / 1e9,
        frames,
        estimated,
        alerted,
        first_usage,
        last_usage,
    };
    let rate_hz = first.structure.sampling_rate_hz();
    Ok(measured.load(watched.len(), rate_hz, resident_before_mb))
}

/// What one measurement has received, and what the processes have used.
struct Measured {
    /// Length of the counted time (s).
    seconds: f64,
    /// Number of frames whose estimates were received.
    frames: usize,
    /// Latencies of the estimates (s).
    estimated: Vec<f64>,
    /// Latencies of the progress messages of the alert service (s).
    alerted: Vec<f64>,
    /// Resources that each process has used before the counted time, and up to its end.
    first_usage: Vec<Usage>,
    last_usage: Vec<Usage>,
}

impl Measured {
    fn load(mut self, structures: usize, rate_hz: f64, resident_before_mb: f64) -> Load {
        let seconds = self.seconds;
        let expected = structures as f64 * seconds * rate_hz;
        let groups = used_between(&self.first_usage, &self.last_usage);
        let cpu_s: f64 = groups.values().sum();
        let last_usage = self.last_usage.first();
        let resident_mb = last_usage.map_or(0.0, |usage| usage.resident_mb);
        let complete = self.frames as f64 / expected;
        let estimate_latency_s = quantiles(&mut self.estimated);
        Load {
            structures,
            seconds,
            sustained: estimate_latency_s[1] < SUSTAINED_P99_S && complete > 0.99,
            estimate_latency_s,
            alert_latency_s: quantiles(&mut self.alerted),
            complete,
            cores: cpu_s / seconds,
            cpu_ms_per_structure: 1e3 * cpu_s / seconds / structures as f64,
            share: groups
                .into_iter()
                .map(|(group, group_s)| (group, group_s / cpu_s.max(1e-9)))
                .collect(),
            resident_mb,
            resident_mb_per_structure: (resident_mb - resident_before_mb).max(0.0)
                / structures as f64,
        }
    }
}

/// Starts the sensors of all structures, which measure from `start_ns` on (ns since the Unix epoch,
/// UTC).
fn start_sensors(
    bus: &Bus,
    watched: &[Watched],
    duration: Duration,
    start_ns: i64,
) -> JoinSet<Result<u64, AppError>> {
    let mut sensors = JoinSet::new();
    for (
        number,
        Watched {
            structure, keys, ..
        },
    ) in watched.iter().enumerate()
    {
        let frames = (duration.as_secs_f64() * structure.sampling_rate_hz()).round() as u64;
        let simulation = Simulation {
            speed: spandrel_sensor::Speed::Live,
            seed: number as u64 + 1,
            frames: Some(frames),
            start_ns,
            nodes: (0..structure.nodes().len()).collect(),
        };
        let (bus, structure, keys) = (bus.clone(), structure.clone(), keys.clone());
        sensors.spawn(async move {
            simulate(
                &bus,
                &structure,
                &keys,
                &simulation,
                &indicatif::ProgressBar::hidden(),
            )
            .await
        });
    }
    sensors
}

/// Returns the processor time that the processes have used between two moments, by group of threads
/// (s).
fn used_between(before: &[Usage], after: &[Usage]) -> BTreeMap<&'static str, f64> {
    let mut groups: BTreeMap<&'static str, f64> = BTreeMap::new();
    for (before, after) in before.iter().zip(after) {
        for (group, cpu_s) in &after.cpu_s {
            *groups.entry(group).or_default() +=
                cpu_s - before.cpu_s.get(group).copied().unwrap_or(0.0);
        }
    }
    groups
}

/// Returns the time of the last frame of a block (ns since the Unix epoch, UTC).
fn last_ns(block: &EstimateBlock) -> i64 {
    let steps = block.estimates.len().saturating_sub(1) as f64 / block.sampling_rate_hz;
    block.header.time_ns.saturating_add((steps * 1e9) as i64)
}

/// Returns p50, p99 and p99.9, or the maximum if there are too few values.
fn quantiles(values: &mut [f64]) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [0.5, 0.99, 0.999].map(|level| {
        let place = ((values.len() as f64 * level) as usize).min(values.len().saturating_sub(1));
        values.get(place).copied().unwrap_or(f64::NAN)
    })
}

/// Resources that a process has used.
struct Usage {
    /// Processor time by group of threads (s).
    cpu_s: BTreeMap<&'static str, f64>,
    resident_mb: f64,
}

impl Usage {
    /// Reads the usage from `/proc`. It is zero on systems other than Linux.
    fn now(process: u32) -> Self {
        let mut cpu_s: BTreeMap<&'static str, f64> = BTreeMap::new();
        for task in std::fs::read_dir(format!("/proc/{process}/task"))
            .into_iter()
            .flatten()
            .flatten()
        {
            let read =
                |file: &str| std::fs::read_to_string(task.path().join(file)).unwrap_or_default();
            *cpu_s.entry(group(read("comm").trim())).or_default() +=
                cpu_seconds(&read("schedstat"));
        }
        let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
        let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kilobytes =
            resident.and_then(|text| text.trim().trim_end_matches(" kB").parse::<f64>().ok());
        Self {
            cpu_s,
            resident_mb: kilobytes.unwrap_or(0.0) / 1024.0,
        }
    }
}

/// Returns the processor time from `schedstat` (s), which is its first number (ns).
fn cpu_seconds(schedstat: &str) -> f64 {
    let first = schedstat
        .split_whitespace()
        .next()
        .and_then(|text| text.parse::<f64>().ok());
    first.unwrap_or(0.0) / 1e9
}

/// Returns the group of a thread from its name.
fn group(name: &str) -> &'static str {
    match name.split('-').next() {
        Some("filter") => "filters",
        Some("tokio" | "recording") => "services",
        _ if ["rx-", "tx-", "net-", "acc-", "app-"]
            .iter()
            .any(|zenoh| name.starts_with(zenoh)) =>
        {
            "zenoh"
        }
        _ => "other",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_values() {
        let mut values: Vec<f64> = (0..1000).rev().map(f64::from).collect();
        assert_eq!(quantiles(&mut values), [500.0, 990.0, 999.0]);
        assert!(quantiles(&mut []).iter().all(|value| value.is_nan()));
    }

    #[test]
    fn copies_differ_only_in_their_names() {
        let copies = named(BUILT_IN, Path::new(BUILT_IN_NAME), 3).unwrap();
        let names: Vec<&str> = copies
            .iter()
            .map(|(structure, _)| structure.name())
            .collect();
        assert_eq!(names, ["bench-1", "bench-2", "bench-3"]);
        assert_eq!(copies[0].0.channel_count(), 6);
    }

    #[test]
    fn threads_are_grouped_by_name() {
        assert_eq!(group("filter-1"), "filters");
        assert_eq!(
            (group("tokio-runtime-w"), group("recording")),
            ("services", "services")
        );
        assert_eq!(group("rx-0"), "zenoh");
        assert_eq!(cpu_seconds("1500000000 200 3"), 1.5);
    }
}
