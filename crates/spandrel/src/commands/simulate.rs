//! `spandrel simulate`: simulates a structure, on the bus or to a file.

use super::{counted, in_place_of, print, progress, refuse_overwriting};
use crate::cli::{self, SimulateArguments};
use crate::error::AppError;
use crate::role_check::{Need, Work, check};
use crate::services::{block_on, interrupted};
use crate::settings::Settings;
use indicatif::ProgressBar;
use spandrel_bus::{Bus, Keys, Service};
use spandrel_record::RecordWriter;
use spandrel_sensor::{
    Clocks, NodePlan, Origin, SensorError, SensorService, SensorSettings, Speed, column_mapping,
    simulated_rows,
};
use spandrel_service::Clock;
use spandrel_structure::Structure;
use std::convert::Infallible;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tracing::warn;

/// Time before the start of a live simulation from which the program says that it waits (s).
const TOLD_AHEAD_S: f64 = 10.0;

/// Default length of a record in a file (s).
const DEFAULT_RECORD_S: f64 = 120.0;

/// Largest distance of the start of a live simulation from now (s).
///
/// A process that joins must compute all motion since the start. A process with a later start waits
/// silently.
const FARTHEST_START_S: f64 = 86_400.0;

/// Simulates for the requested time, or until Ctrl-C.
///
/// # Errors
/// Returns an error if a file is not valid or cannot be written, or if the bus cannot be joined.
pub fn run(arguments: SimulateArguments) -> Result<(), AppError> {
    let structure = Structure::read_with_model(&arguments.structure)?;
    let seed = arguments.seed.unwrap_or(structure.simulation().seed());
    let frames = |seconds: f64| (seconds * structure.sampling_rate_hz()).round() as u64;
    if let Some(path) = &arguments.record {
        refuse_overwriting(path, [arguments.structure.as_path()])?;
        return write_record(
            &structure,
            path,
            seed,
            frames(arguments.duration.unwrap_or(DEFAULT_RECORD_S)),
        );
    }
    let simulation = Simulation {
        speed: if arguments.live {
            Speed::Live
        } else {
            arguments.speed.into()
        },
        seed,
        frames: arguments.duration.map(frames),
        start_ns: start_ns(&arguments, Clock::of_machine().now_ns())?,
        nodes: (0..structure.nodes().len())
            .filter(wanted(&structure, &arguments.node)?)
            .collect(),
    };
    let settings = Settings::load(&arguments.bus)?;
    let keys = settings.bus.keys(structure.name())?;
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let nodes = simulation
            .nodes
            .iter()
            .map(|index| structure.nodes()[*index].name())
            .collect();
        let work = Work {
            subcommand: "simulate",
            needs: &[Need::PUT_SAMPLES],
            structures: vec![structure.name()],
            nodes,
        };
        check(&bus, &settings.bus, &work).await?;
        let bar = progress::bar("simulating", simulation.frames);
        let simulated = tokio::select! {
            simulated = simulate(&bus, &structure, &keys, &simulation, &bar) => simulated.map(Some),
            () = interrupted() => Ok(None),
        };
        bar.finish_and_clear();
        bus.close().await?;
        let Some(frames) = simulated? else {
            return Ok(());
        };
        let (name, seconds) = (
            structure.name(),
            frames as f64 / structure.sampling_rate_hz(),
        );
        print(&format!(
            "{} of {name} sent, {seconds} s, seed {seed}\n",
            counted(frames as usize, "frame", "frames")
        ))
    })
}

/// Returns the time of the first frame (ns since the Unix epoch, UTC).
fn start_ns(arguments: &SimulateArguments, now_ns: i64) -> Result<i64, AppError> {
    let Some(start_s) = arguments.start else {
        let head_start = |length_s| head_start_ns(length_s, arguments.speed);
        return Ok(now_ns.saturating_sub(arguments.duration.map_or(0, head_start)));
    };
    let refused = |why| Err(AppError::SimulationStart { start_s, why });
    let now_s = now_ns as f64 / 1e9;
    if (start_s - now_s).abs() > FARTHEST_START_S {
        let now_s = now_s.round();
        return refused(format!(
            "must be at most one day before or after now, {now_s}"
        ));
    }
    let ended_s = arguments
        .duration
        .map(|length_s| now_s - (start_s + length_s));
    if let Some(ended_s) = ended_s.filter(|ended_s| *ended_s >= 0.0) {
        return refused(format!(
            "with this --duration, the simulation ended {ended_s:.0} s ago and would send no \
             frame; choose a later start or a longer duration"
        ));
    }
    if start_s - now_s > TOLD_AHEAD_S {
        warn!(wait_s = (start_s - now_s).round(), "waiting for the start");
    }
    Ok((start_s * 1e9) as i64)
}

/// Returns the time by which a simulation of this length (s) starts in the past, so that its last
/// sample has the present time (ns).
///
/// A simulation at twice real time starts by half of its length in the past. One at real time or
/// slower starts now.
pub fn head_start_ns(length_s: f64, speed: cli::Speed) -> i64 {
    let real_share = match speed {
        cli::Speed::Max => 0.0,
        cli::Speed::Times(factor) => (1.0 / factor).min(1.0),
    };
    (length_s * (1.0 - real_share) * 1e9) as i64
}

/// Ends the computation of rows on its thread when the simulation is dropped. The runtime would
/// otherwise wait for it.
struct Computing(Arc<AtomicBool>);

impl Drop for Computing {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Relaxed);
    }
}

/// Settings of a simulation on the bus.
#[derive(Debug)]
pub struct Simulation {
    /// Speed of the simulation.
    pub speed: Speed,
    /// Seed of excitation and noise.
    pub seed: u64,
    /// Number of frames. `None` means unlimited.
    pub frames: Option<u64>,
    /// Time of the first frame (ns since the Unix epoch, UTC).
    pub start_ns: i64,
    /// Indices of the simulated nodes in the structure file, in that order.
    pub nodes: Vec<usize>,
}

/// Publishes a simulation on the bus as its sensor nodes would, and returns the number of frames
/// sent.
///
/// It waits until alert has decided on all frames. A live simulation waits for no service and skips
/// samples whose time has passed.
///
/// # Errors
/// Returns an error if the bus is closed.
pub async fn simulate(
    bus: &Bus,
    structure: &Structure,
    keys: &Keys,
    simulation: &Simulation,
    bar: &ProgressBar,
) -> Result<u64, AppError> {
    let &Simulation {
        speed,
        seed,
        frames,
        start_ns,
        ref nodes,
    } = simulation;
    let (epoch, live) = (Clock::of_machine().epoch(), speed == Speed::Live);
    let wait_for = if live { Vec::new() } else { readers(structure) };
    let settings = SensorSettings {
        origin: Origin::Simulated,
        speed,
        epoch,
        wait_for,
        resume: false,
    };
    let plans = NodePlan::of(structure, Clocks::AsSimulated).map_err(SensorError::from)?;
    let plans = plans
        .into_iter()
        .enumerate()
        .filter(|(index, _)| nodes.contains(index))
        .map(|(_, plan)| plan)
        .collect();
    let service = SensorService::start(
        plans,
        structure.sampling_rate_hz(),
        bus,
        keys.clone(),
        settings,
    )
    .await?;
    let (counted, channels) = (bar.clone(), channels_of(structure, nodes));
    let rows = simulated_rows(structure, seed, start_ns, frames).inspect(move |_| counted.inc(1));
    let computing = Computing(Arc::new(AtomicBool::new(true)));
    let is_wanted = Arc::clone(&computing.0);
    let rows = rows
        .take_while(move |_| is_wanted.load(Ordering::Relaxed))
        .skip_while(move |row| live && row.time_ns < epoch as i64)
        .map(move |mut row| {
            row.values = channels
                .iter()
                .map(|channel| row.values[*channel])
                .collect();
            Ok::<_, Infallible>(row)
        });
    let sent = service.run(rows, std::future::pending()).await?;
    drop(computing);
    Ok(sent)
}

/// Returns the channels of some nodes, as indices into a row of all nodes.
fn channels_of(structure: &Structure, nodes: &[usize]) -> Vec<usize> {
    let of_node = structure
        .nodes()
        .iter()
        .enumerate()
        .flat_map(|(index, node)| node.channels().iter().map(move |_| index));
    of_node
        .enumerate()
        .filter(|(_, node)| nodes.contains(node))
        .map(|(channel, _)| channel)
        .collect()
}

/// Returns a predicate for node indices in the structure file. It is true for nodes with these
/// names, or for all nodes if there are no names.
fn wanted<'a>(
    structure: &'a Structure,
    names: &'a [String],
) -> Result<impl Fn(&usize) -> bool + 'a, AppError> {
    let known = || structure.nodes().iter().map(|node| node.name());
    if let Some(name) = names
        .iter()
        .find(|name| !known().any(|known| known == **name))
    {
        let (name, known) = (name.clone(), known().collect::<Vec<_>>().join(", "));
        return Err(AppError::UnknownNode {
            structure: structure.name().to_owned(),
            name,
            known,
        });
    }
    let is_wanted = |index: &usize| {
        names.is_empty()
            || names
                .iter()
                .any(|name| name == structure.nodes()[*index].name())
    };
    Ok(is_wanted)
}

/// Returns the services whose progress the samples of a structure wait for.
pub fn readers(structure: &Structure) -> Vec<Service> {
    match structure.fusion() {
        Some(_) => vec![Service::Fuse],
        None if !structure.is_filtered() => vec![Service::Ingest, Service::Modes],
        None => vec![Service::Ingest, Service::Identify, Service::Alert],
    }
}

fn write_record(
    structure: &Structure,
    path: &Path,
    seed: u64,
    frames: u64,
) -> Result<(), AppError> {
    let replacing = in_place_of(path);
    let mut writer = RecordWriter::create(
        path,
        &column_mapping(structure)?,
        structure.sampling_rate_hz(),
    )?;
    let bar = progress::bar("simulating", Some(frames));
    for row in simulated_rows(structure, seed, 0, Some(frames)) {
        writer.write_row(row.time_ns, &row.values)?;
        bar.inc(1);
    }
    writer.finish()?;
    bar.finish_and_clear();
    let (name, seconds) = (
        structure.name(),
        frames as f64 / structure.sampling_rate_hz(),
    );
    let frames = counted(frames as usize, "frame", "frames");
    print(&format!(
        "{}: {frames} of {name}, {seconds} s, seed {seed}{replacing}\n",
        path.display()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Arguments, Command};
    use clap::Parser as _;

    const NOW_NS: i64 = 1_795_220_273_000_000_000;

    fn start(options: &[&str]) -> Result<i64, String> {
        let words = ["spandrel", "simulate", "tower.toml"];
        let arguments = Arguments::try_parse_from(words.iter().chain(options)).unwrap();
        let Command::Simulate(arguments) = arguments.command else {
            panic!("another command")
        };
        start_ns(&arguments, NOW_NS).map_err(|error| error.to_string())
    }

    #[test]
    fn a_fast_simulation_of_known_length_starts_in_the_past_and_ends_now() {
        let s = |seconds: i64| NOW_NS + seconds * 1_000_000_000;
        for (options, expected) in [
            ("--duration 120 --speed 10", s(-108)),
            ("--duration 120 --speed max", s(-120)),
            ("--duration 120", s(0)),
            ("--duration 120 --speed 0.5", s(0)),
            ("--duration 120 --live", s(0)),
            ("--speed 10", s(0)),
        ] {
            let words: Vec<&str> = options.split(' ').collect();
            assert_eq!(start(&words), Ok(expected), "{options}");
        }
    }

    #[test]
    fn live_simulation_starts_within_a_day_and_sends_something() {
        assert_eq!(start(&["--live"]), Ok(NOW_NS));
        let hour_ago = ["--live", "--start", "1795216673"];
        assert_eq!(start(&hour_ago), Ok(1_795_216_673_000_000_000));
        for far in ["100", "2000000000", "1e300"] {
            let error = start(&["--live", "--start", far]).unwrap_err();
            assert!(
                error.contains("at most one day before or after now"),
                "{error}"
            );
        }
        let ended = [&hour_ago[..], &["--duration", "60"]].concat();
        let error = start(&ended).unwrap_err();
        assert!(error.contains("ended 3540 s ago"), "{error}");
        let running = [&hour_ago[..], &["--duration", "3700"]].concat();
        assert!(start(&running).is_ok());
    }
}
