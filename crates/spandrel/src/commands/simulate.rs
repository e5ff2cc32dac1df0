//! `spandrel simulate`: simulates a structure, on the bus or to a file.

use super::{counted, in_place_of, print, progress, refuse_overwriting};
use crate::cli::SimulateArguments;
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

/// Default length of a record in a file (s).
const DEFAULT_RECORD_S: f64 = 120.0;

/// Simulates for the requested time, or until Ctrl-C.
///
/// # Errors
/// A file is not valid or cannot be written, or the bus cannot be joined.
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
        start_ns: arguments.start.map_or_else(
            || Clock::of_machine().now_ns(),
            |seconds| (seconds * 1e9) as i64,
        ),
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
/// The bus is closed.
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
    let rows = rows
        .skip_while(move |row| live && row.time_ns < epoch as i64)
        .map(move |mut row| {
            row.values = channels
                .iter()
                .map(|channel| row.values[*channel])
                .collect();
            Ok::<_, Infallible>(row)
        });
    Ok(service.run(rows, std::future::pending()).await?)
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
