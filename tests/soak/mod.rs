//! Services of several structures at twenty times real time, while sensor nodes leave, return and
//! send wrong data.
//!
//! Memory must not grow, no service may fall behind, and no sample of a sound node may be lost. A
//! short form runs with the other tests. To run the long form, use `cargo test --workspace --test
//! program soak:: -- --ignored --nocapture`, with `SOAK_S` for another length (s).

mod besieged;
mod houses;
mod measured;
mod node;

use crate::support::{Process, Site, spandrel};
use houses::{Houses, OTHERS, check_recording};
use measured::{Heard, Series, processor_s, resident_mb};
use node::{Manner, ORDERS};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use spandrel_bus::{Bus, BusConfig, Mode};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

/// Speed as a multiple of real time.
const SPEED: f64 = 20.0;
const STRUCTURES: usize = 3;
const SERVICES: [&str; 5] = ["ingest", "identify", "alert", "history", "dashboard"];

/// Durations of the observation, and limits that must hold.
struct Plan {
    length: Duration,
    /// Time in which memory may still grow: rings, series of the page, caches of the allocator.
    warm_up: Duration,
    /// Time between two disturbances of nodes (s).
    pause_s: std::ops::Range<f64>,
    /// Time at the end in which all nodes are present and correct.
    calm: Duration,
    /// Maximum increase in memory of a service from the first to the last fifth of the time after
    /// the warm-up (MB).
    growth_mb: f64,
    /// Maximum increase in delay between the same periods (s of wall-clock time).
    lag_growth_s: f64,
}

/// Runs as a separate process of the tests below.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "is started by the tests below"]
async fn sensor_node() {
    let Ok(orders) = std::env::var(ORDERS) else {
        return; // a run of all ignored tests
    };
    node::be(serde_json::from_str(&orders).unwrap()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn faulty_nodes_for_a_short_time() {
    let plan = Plan {
        length: Duration::from_secs(25),
        warm_up: Duration::from_secs(15),
        pause_s: 0.1..0.7,
        calm: Duration::from_secs(5),
        growth_mb: 24.0,
        lag_growth_s: 2.0,
    };
    soak(plan).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes twenty minutes: the long form of the test above"]
async fn faulty_nodes_for_twenty_minutes() {
    let length = std::env::var("SOAK_S").map_or(1200, |text| text.parse().unwrap());
    let plan = Plan {
        length: Duration::from_secs(length),
        warm_up: Duration::from_secs(length / 4),
        pause_s: 0.5..3.0,
        calm: Duration::from_secs(10),
        growth_mb: 4.0,
        lag_growth_s: 0.5,
    };
    soak(plan).await;
}

/// All running processes.
struct Town {
    houses: Houses,
    services: BTreeMap<&'static str, Process>,
    _router: Bus,
}

impl Town {
    async fn start() -> Self {
        let mut houses = Houses::new(STRUCTURES, SPEED);
        let site = &houses.sites[0];
        let router = Bus::open(&BusConfig {
            mode: Mode::Router,
            listen: vec![site.endpoint().to_owned()],
            ..BusConfig::default()
        })
        .await
        .unwrap();
        let configuration = site.folder().join("spandrel.toml");
        let text = "[bus]\nmode = \"client\"\n[state]\nfolder = \"kept\"\n[history]\n\
                    database = \"history.sqlite\"\n\
                    [dashboard]\nlisten = \"127.0.0.1:0\"\n";
        std::fs::write(&configuration, text).unwrap();
        let start = |service: &'static str| {
            let mut command = spandrel(service);
            command
                .args(houses.sites.iter().map(Site::structure_file))
                .args(["-v", "--root", site.keys().root().as_str()]);
            command
                .args(["--connect", site.endpoint()])
                .arg("--config")
                .arg(&configuration);
            (service, Process::start(&mut command))
        };
        let services: BTreeMap<_, _> = SERVICES.into_iter().map(start).collect();
        let all = format!("ready structures={STRUCTURES}");
        for (name, service) in &services {
            service.wait_for_log(if *name == "dashboard" {
                "dashboard ready"
            } else {
                &all
            });
        }
        houses.start_nodes();
        Self {
            houses,
            services,
            _router: router,
        }
    }

    /// Returns the manner of a returning node. Only one of three clocks may be an hour ahead,
    /// because a majority is accepted as correct.
    fn next_manner(&self, structure: usize, random: &mut ChaCha8Rng) -> Manner {
        if random.random() {
            return Manner::Honest;
        }
        let is_ahead = self
            .houses
            .nodes
            .iter()
            .any(|((of, _), (manner, _))| *of == structure && *manner == Manner::ClockAhead);
        match Manner::LIES[random.random_range(0..Manner::LIES.len())] {
            Manner::ClockAhead if is_ahead => Manner::Honest,
            lie => lie,
        }
    }

    /// Disturbs a node other than the steady one, and returns a description.
    fn disturb(&mut self, random: &mut ChaCha8Rng) -> &'static str {
        let place = (
            random.random_range(0..STRUCTURES),
            OTHERS[random.random_range(0..OTHERS.len())],
        );
        match self.houses.nodes.remove(&place) {
            Some((_, process)) if random.random() => {
                process.kill();
                "killed"
            }
            Some((_, mut process)) => {
                process.write_line();
                process.write_line();
                process.wait().expect_code(0);
                "stopped"
            }
            None => {
                let manner = self.next_manner(place.0, random);
                self.houses.send(place.0, place.1, manner);
                match manner {
                    Manner::Honest => "came back honest",
                    Manner::Implausible => "came back with absurd values",
                    Manner::ClockAhead => "came back an hour ahead",
                    Manner::ClockBehind => "came back an hour behind",
                    Manner::Channels => "came back with a channel too many",
                    Manner::OldMessages => "came back with old messages",
                    Manner::Garbage => "came back with garbage",
                    Manner::SecondsAhead | Manner::YearAhead | Manner::LaterEpoch => {
                        unreachable!("not among the lies")
                    }
                }
            }
        }
    }

    /// Restarts absent nodes and replaces incorrect ones.
    fn calm_down(&mut self) {
        for structure in 0..STRUCTURES {
            for node in OTHERS {
                match self.houses.nodes.remove(&(structure, node)) {
                    Some((Manner::Honest, process)) => drop(
                        self.houses
                            .nodes
                            .insert((structure, node), (Manner::Honest, process)),
                    ),
                    Some((_, liar)) => {
                        liar.kill();
                        self.houses.send(structure, node, Manner::Honest);
                    }
                    None => self.houses.send(structure, node, Manner::Honest),
                }
            }
        }
    }
}

async fn soak(plan: Plan) {
    let mut town = Town::start().await;
    let bus = town.houses.sites[0].join().await;
    let started = Instant::now();
    let (heard, listening) =
        Heard::listen(&bus, &town.houses.keys(), town.houses.clock, started).await;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut memory_mb = Series::default();
    let mut happened: BTreeMap<&str, u32> = BTreeMap::new();
    let mut second = interval(Duration::from_secs(1));
    second.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut next = started + Duration::from_secs(3);
    let turmoil = plan.length - plan.calm;
    let mut is_calm = false;
    while started.elapsed() < plan.length {
        tokio::select! {
            _ = second.tick() => {
                for (name, service) in &town.services {
                    memory_mb.push(name, started.elapsed(), resident_mb(service.id()));
                }
                if started.elapsed() >= turmoil && !is_calm {
                    is_calm = true;
                    town.calm_down();
                }
            }
            () = sleep_until(next), if !is_calm => {
                let what = tokio::task::block_in_place(|| town.disturb(&mut random));
                *happened.entry(what).or_default() += 1;
                next = Instant::now() + Duration::from_secs_f64(random.random_range(plan.pause_s.clone()));
            }
        }
    }
    let counts = town.houses.end(&bus).await;
    let processor_s = town
        .services
        .iter()
        .map(|(name, service)| (*name, processor_s(service)))
        .collect();
    listening.iter().for_each(tokio::task::JoinHandle::abort);
    bus.close().await.unwrap();
    for (_, service) in std::mem::take(&mut town.services) {
        let log = service.stop().expect_code(0).stderr;
        assert!(!log.contains("panicked"), "{log}");
    }
    let report = Report {
        plan,
        memory_mb,
        heard,
        processor_s,
        happened,
    };
    report.tell(&counts);
    for (site, (put, frames)) in town.houses.sites.iter().zip(counts) {
        check_recording(
            &town.houses.sites[0].folder().join("kept"),
            site,
            put,
            frames,
        );
    }
    report.check();
}

/// Results.
struct Report {
    plan: Plan,
    memory_mb: Series,
    heard: Arc<Mutex<Heard>>,
    processor_s: BTreeMap<&'static str, f64>,
    happened: BTreeMap<&'static str, u32>,
}

impl Report {
    /// Returns the first and the last fifth of the time after the warm-up.
    fn early_and_late(&self) -> [(Duration, Duration); 2] {
        let Plan {
            length, warm_up, ..
        } = self.plan;
        let fifth = (length - warm_up) / 5;
        [(warm_up, warm_up + fifth), (length - fifth, length)]
    }

    fn tell(&self, counts: &[(u64, u64)]) {
        let Plan {
            length, warm_up, ..
        } = self.plan;
        let [early, late] = self.early_and_late();
        let heard = self.heard.lock().unwrap();
        let (put, frames) = counts
            .iter()
            .fold((0, 0), |(a, b), (put, frames)| (a + put, b + frames));
        println!(
            "{STRUCTURES} structures at {SPEED} times real time for {} s; frames {frames}, \
             samples put by the steady nodes {put}",
            length.as_secs()
        );
        println!("nodes: {:?}", self.happened);
        println!("service    memory MB early   late   most   processor s");
        for name in self.memory_mb.names() {
            let median = |(from, to)| self.memory_mb.median(name, from, to);
            let most = self.memory_mb.most(name, Duration::ZERO, length);
            println!(
                "{name:10} {:15.1} {:6.1} {most:6.1} {:13.1}",
                median(early),
                median(late),
                self.processor_s[name]
            );
        }
        println!("memory MB, medians of each tenth of the time");
        for name in self.memory_mb.names() {
            let tenth = |number: u32| {
                self.memory_mb
                    .median(name, length / 10 * number, length / 10 * (number + 1))
            };
            println!(
                "{name:10} {}",
                (0..10)
                    .map(|number| format!("{:6.1}", tenth(number)))
                    .collect::<String>()
            );
        }
        println!("service    lag s early   late   most (medians of what the statuses say)");
        for name in heard.lag_s.names() {
            let median = |(from, to)| heard.lag_s.median(name, from, to);
            let most = heard.lag_s.most(name, warm_up, length);
            println!(
                "{name:10} {:11.2} {:6.2} {most:6.2}",
                median(early),
                median(late)
            );
        }
        for service in SERVICES {
            println!("{service} counts {:?}", heard.counted(service));
        }
        println!(
            "states of identify: {:?}; restarts of a filter, most: {}",
            heard.loads, heard.restarts
        );
    }

    fn check(&self) {
        let [early, late] = self.early_and_late();
        let heard = self.heard.lock().unwrap();
        for name in self.memory_mb.names() {
            let median = |(from, to)| self.memory_mb.median(name, from, to);
            let growth = median(late) - median(early);
            assert!(
                growth <= self.plan.growth_mb,
                "{name} grows by {growth:.1} MB, more than {}",
                self.plan.growth_mb
            );
        }
        for name in heard.lag_s.names() {
            let median = |(from, to)| heard.lag_s.median(name, from, to);
            let growth = median(late) - median(early);
            assert!(
                growth <= self.plan.lag_growth_s,
                "the lag of {name} grows by {growth:.2} s"
            );
        }
        for service in ["identify", "alert"] {
            assert_eq!(
                heard.counted(service).get("lost-items"),
                None,
                "frames or estimates lost on the way to {service}"
            );
        }
    }
}
