//! `spandrel simulate`: a simulated structure, to the bus or to a file.

use super::{counted, print, progress, refuse_overwriting};
use crate::cli::SimulateArguments;
use crate::error::AppError;
use crate::record_source;
use crate::services::{block_on, epoch_now, interrupted};
use crate::settings::Settings;
use indicatif::ProgressBar;
use spandrel_bus::{Bus, Keys, Service};
use spandrel_record::{CsvWriter, Recording};
use spandrel_sensor::{Clocks, NodePlan, SensorError, SensorService, SensorSettings, Speed, simulated_rows};
use spandrel_structure::Structure;
use std::convert::Infallible;
use std::path::Path;

/// Length of a record (s) when none is asked for.
const DEFAULT_RECORD_S: f64 = 120.0;

/// Simulates until the time asked for is over, or Ctrl-C.
///
/// # Errors
/// When a file is wrong or cannot be written, or the bus cannot be joined.
pub fn run(arguments: SimulateArguments) -> Result<(), AppError> {
    let structure = Structure::read(&arguments.structure)?;
    let seed = arguments.seed.unwrap_or(structure.simulation().seed());
    let frames = |seconds: f64| (seconds * structure.sampling_rate_hz()).round() as u64;
    if let Some(path) = &arguments.record {
        refuse_overwriting(path, [arguments.structure.as_path()])?;
        return write_record(&structure, path, seed, frames(arguments.duration.unwrap_or(DEFAULT_RECORD_S)));
    }
    let settings = Settings::load(&arguments.bus)?;
    let keys = settings.bus.keys(structure.name())?;
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let frames = arguments.duration.map(frames);
        let bar = progress::bar("simulating", frames);
        let simulated = tokio::select! {
            simulated = simulate(&bus, &structure, &keys, arguments.speed.into(), seed, frames, &bar) => simulated,
            () = interrupted() => Ok(()),
        };
        bar.finish_and_clear();
        bus.close().await?;
        simulated
    })
}

/// Sends a simulation to the bus as its sensor nodes would, and waits until alert has decided on all of it.
///
/// # Errors
/// When the bus is closed underneath.
pub async fn simulate(
    bus: &Bus,
    structure: &Structure,
    keys: &Keys,
    speed: Speed,
    seed: u64,
    frames: Option<u64>,
    bar: &ProgressBar,
) -> Result<(), AppError> {
    let epoch = epoch_now();
    let settings = SensorSettings { speed, epoch, wait_for: readers(structure) };
    let nodes = NodePlan::of(structure, Clocks::AsSimulated).map_err(SensorError::from)?;
    let service = SensorService::start(nodes, structure.sampling_rate_hz(), bus, keys.clone(), settings).await?;
    let counted = bar.clone();
    let rows = simulated_rows(structure, seed, epoch as i64, frames).inspect(move |_| counted.inc(1));
    Ok(service.run(rows.map(Ok::<_, Infallible>), std::future::pending()).await?)
}

/// Returns the services that the samples of a structure wait for.
pub fn readers(structure: &Structure) -> Vec<Service> {
    match structure.fusion() {
        Some(_) => vec![Service::Fuse],
        None => vec![Service::Ingest, Service::Identify, Service::Alert],
    }
}

fn write_record(structure: &Structure, path: &Path, seed: u64, frames: u64) -> Result<(), AppError> {
    Recording::check_format(path)?;
    let mut writer = CsvWriter::create_mapped(path, &record_source::mapping(structure)?)?;
    let bar = progress::bar("simulating", Some(frames));
    for row in simulated_rows(structure, seed, 0, Some(frames)) {
        writer.write_row(row.time_ns, &row.values)?;
        bar.inc(1);
    }
    writer.finish()?;
    bar.finish_and_clear();
    let (name, seconds) = (structure.name(), frames as f64 / structure.sampling_rate_hz());
    let frames = counted(frames as usize, "frame", "frames");
    print(&format!("{}: {frames} of {name}, {seconds} s, seed {seed}\n", path.display()))
}
