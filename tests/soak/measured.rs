//! Measurements of running services: their memory, their delay and their counts.

use super::node::Clock;
use crate::support::Process;
use spandrel_bus::{Bus, Keys, Load, Status};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio::time::Instant;

/// Values over time, by name.
#[derive(Debug, Default)]
pub struct Series(BTreeMap<String, Vec<(Duration, f64)>>);

impl Series {
    pub fn push(&mut self, of: &str, at: Duration, value: f64) {
        self.0.entry(of.to_owned()).or_default().push((at, value));
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// Returns the median between two times.
    pub fn median(&self, of: &str, from: Duration, to: Duration) -> f64 {
        let mut values = self.within(of, from, to);
        assert!(
            !values.is_empty(),
            "no status of {of} from {from:?} to {to:?}"
        );
        values.sort_unstable_by(f64::total_cmp);
        values[values.len() / 2]
    }

    pub fn most(&self, of: &str, from: Duration, to: Duration) -> f64 {
        self.within(of, from, to)
            .into_iter()
            .fold(f64::MIN, f64::max)
    }

    fn within(&self, of: &str, from: Duration, to: Duration) -> Vec<f64> {
        let all = self.0.get(of).into_iter().flatten();
        all.filter(|(at, _)| (from..=to).contains(at))
            .map(|(_, value)| *value)
            .collect()
    }
}

/// Collected contents of the status messages.
#[derive(Debug, Default)]
pub struct Heard {
    /// Delay of each service (s of wall-clock time).
    pub lag_s: Series,
    /// Last counts of each service of each structure.
    pub drops: BTreeMap<(String, String), BTreeMap<String, u64>>,
    /// Number of processed frames.
    pub done: BTreeMap<(String, String), u64>,
    /// States of `identify`.
    pub loads: BTreeSet<&'static str>,
    pub restarts: u64,
}

impl Heard {
    /// Receives the statuses of structures from now on.
    pub async fn listen(
        bus: &Bus,
        keys: &[Keys],
        clock: Clock,
        started: Instant,
    ) -> (Arc<Mutex<Self>>, Vec<JoinHandle<()>>) {
        let heard = Arc::new(Mutex::new(Self::default()));
        let mut listening = Vec::new();
        for keys in keys {
            let statuses = bus
                .subscribe::<Status>(keys.all_statuses(), 1024)
                .await
                .unwrap();
            let heard = heard.clone();
            listening.push(tokio::spawn(async move {
                while let Ok((_, status)) = statuses.messages().recv_async().await {
                    heard.lock().unwrap().take(status, clock, started.elapsed());
                }
            }));
        }
        (heard, listening)
    }

    fn take(&mut self, status: Status, clock: Clock, at: Duration) {
        let service = status.service.to_string();
        if let Some(lag_s) = status
            .lag_s
            .filter(|_| ["ingest", "identify", "alert"].contains(&service.as_str()))
        {
            let time_ns = status.time_ns - (lag_s * 1e9) as i64;
            self.lag_s
                .push(&service, at, clock.lag_s(status.time_ns, time_ns));
        }
        self.loads.extend(status.load.map(Load::as_str));
        let key = (status.structure.to_string(), service);
        self.drops.insert(key.clone(), status.drops);
        self.done.insert(key, status.done);
        self.restarts = self.restarts.max(status.restarts);
    }

    /// Returns the counts of a service, summed over its instances.
    pub fn counted(&self, service: &str) -> BTreeMap<&str, u64> {
        let mut all = BTreeMap::new();
        for (_, drops) in self.drops.iter().filter(|((_, name), _)| name == service) {
            for (reason, count) in drops {
                *all.entry(reason.as_str()).or_default() += count;
            }
        }
        all
    }
}

/// Returns the memory of a process, by its ID, in MB (10⁶ bytes).
pub fn resident_mb(process: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .unwrap();
    line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() * 1024e-6
}

/// Returns the processor time of a process so far (s).
pub fn processor_s(process: &Process) -> f64 {
    const TICKS_PER_SECOND: f64 = 100.0; // of /proc, on all Linux systems
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", process.id())).unwrap();
    let fields: Vec<&str> = stat
        .rsplit_once(')')
        .unwrap()
        .1
        .split_whitespace()
        .collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / TICKS_PER_SECOND
}
