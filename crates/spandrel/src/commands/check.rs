//! `spandrel check`: reports what a structure and its sensors can identify, before any sensor is
//! bought, and whether the sensors of a recording or of live data agree with each other.

use super::watch::joining_by_default;
use super::{print, progress};
use crate::check_report::CheckPage;
use crate::cli::CheckArguments;
use crate::error::AppError;
use crate::judge_report::JudgedPage;
use crate::modal_check::ModalCheckPage;
use crate::role_check::{self, Need, Work};
use crate::sensor_report::SensorPage;
use crate::services::{block_on, check_baseline_structure};
use crate::settings::Settings;
use spandrel_alert::Baseline;
use spandrel_bus::{Block as _, Bus, Delivery, FrameBlock, Start, StreamSettings};
use spandrel_faults::SensorCheck;
use spandrel_structure::{JudgedStructure, Structure};
use std::path::Path;
use std::time::Duration;
use tracing::{info, warn};

/// Seed of the simulated data. It is fixed, so that the same file yields the same report.
const SEED: u64 = 1;

/// Maximum memory of the matrices of a check (MB).
const MOST_MB: usize = 240;

/// Maximum processor time of a check (s). A check of 32 s took 20 s on two processors, because a
/// part of its work runs on one. The estimate can be a seventh too small.
const MOST_PROCESSOR_S: f64 = 28.0;

/// Longest data whose time counts (s). Only `--after` requests longer data.
const COUNTED_S: f64 = 60.0;

/// Number of steps of the progress bar.
const SHARES: u64 = 1000;

/// Maximum time between two frames of a live check. The first one waits for the slowest sensor.
const LONGEST_SILENCE: Duration = Duration::from_secs(10);

/// Checks a structure file and prints the report. Warnings do not change the exit code.
///
/// # Errors
/// Returns an error if the file is not valid, a recording cannot be read, or no live data of this
/// file arrive.
pub fn run(arguments: CheckArguments) -> Result<(), AppError> {
    if arguments.live.is_some() || !arguments.record.is_empty() {
        let structure = Structure::read_with_model(&arguments.structure)?;
        let sensors = sensor_check(&structure, arguments.baseline.as_deref())?;
        let page = match arguments.live {
            Some(seconds) => live(&structure, sensors, seconds, &arguments)?,
            None => SensorPage::of_records(&structure, sensors, &arguments.record)?,
        };
        return print(&match arguments.json {
            true => page.json(),
            false => page.to_string(),
        });
    }
    if let Some(judged) = JudgedStructure::read_without_model(&arguments.structure)? {
        let page = JudgedPage(&judged);
        return print(&match arguments.json {
            true => page.json(),
            false => page.to_string(),
        });
    }
    let structure = Structure::read(&arguments.structure)?;
    if let (false, Some(plan)) = (structure.is_filtered(), structure.modal()) {
        let page = ModalCheckPage::new(&structure, plan)?;
        return print(&match arguments.json {
            true => page.json(),
            false => page.to_string(),
        });
    }
    limit_cost(&structure, &arguments)?;
    let bar = progress::share_bar(SHARES).with_message("checking");
    let report = structure.check_with_progress(arguments.after, SEED, &|share| {
        bar.set_position((share * SHARES as f64) as u64);
    });
    bar.finish_and_clear();
    let page = CheckPage::new(&structure, report);
    print(&match arguments.json {
        true => page.json(),
        false => page.to_string(),
    })
}

/// Rejects a structure whose check would take too much memory or time. It could stop the services
/// of the machine.
fn limit_cost(structure: &Structure, arguments: &CheckArguments) -> Result<(), AppError> {
    let found_mb = structure.check_bytes() / 1_000_000;
    let found_s = structure.check_processor_s(arguments.after.min(COUNTED_S));
    match found_mb <= MOST_MB && found_s <= MOST_PROCESSOR_S {
        true => Ok(()),
        false => Err(AppError::CheckTooLarge {
            path: arguments.structure.clone(),
            unknowns: structure.parameters().len() + structure.noise_levels().len(),
            channels: structure.channel_count(),
            found_mb,
            most_mb: MOST_MB,
            found_s,
            most_s: MOST_PROCESSOR_S,
        }),
    }
}

/// Returns the check of the sensors, which expects what the baseline file has learnt if there is
/// one.
fn sensor_check(structure: &Structure, baseline: Option<&Path>) -> Result<SensorCheck, AppError> {
    let mut check = SensorCheck::new(structure);
    let Some(path) = baseline else {
        return Ok(check);
    };
    let baseline = Baseline::read(path)?;
    check_baseline_structure(structure, &baseline, path)?;
    let names: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
    check.expect(&names, baseline.sensors());
    let is_known = |name: &str| { baseline.sensors().iter() }.any(|known| known.channel == name);
    let checked = names.iter().zip(check.health());
    let unknown: Vec<&str> = checked
        .filter(|(name, health)| health.is_some() && !is_known(name))
        .map(|(name, _)| *name)
        .collect();
    if !unknown.is_empty() {
        let (path, unknown) = (path.display(), unknown.join(", "));
        warn!("{path}: contains no reference for the sensors {unknown}; default scatter applies");
    }
    Ok(check)
}

/// Compares the sensors in `seconds` of the frames that ingest publishes from now on.
fn live(
    structure: &Structure,
    mut check: SensorCheck,
    seconds: f64,
    arguments: &CheckArguments,
) -> Result<SensorPage, AppError> {
    let config = joining_by_default(Settings::load(&arguments.bus)?.bus);
    let keys = config.keys(structure.name())?;
    let rate_hz = structure.sampling_rate_hz();
    let wanted = (seconds * rate_hz).ceil() as u64;
    block_on(async {
        let bus = Bus::open(&config).await?;
        let work = Work {
            subcommand: "check",
            needs: &[Need::READ_FRAMES],
            structures: vec![structure.name()],
            nodes: Vec::new(),
        };
        role_check::check(&bus, &config, &work).await?;
        let settings = StreamSettings::new(Start::Now);
        let frames = bus
            .follow::<FrameBlock>(keys.frames(), keys.recording(), settings)
            .await?;
        info!(structure = structure.name(), "waiting for frames");
        let bar = progress::bar("checking", Some(wanted));
        let mut taken = 0;
        while taken < wanted {
            let delivery = frames.deliveries().recv_async();
            match tokio::time::timeout(LONGEST_SILENCE, delivery).await {
                Ok(Ok(Delivery::Block(block))) => {
                    let found = (usize::from(block.channels), block.sampling_rate_hz);
                    let expected = (structure.channel_count(), rate_hz);
                    if found != expected {
                        return Err(AppError::OtherFrames {
                            structure: structure.name().to_owned(),
                            found,
                            expected,
                        });
                    }
                    for (_, values) in block.iter() {
                        check.take(values);
                    }
                    taken += block.count();
                    bar.set_position(taken.min(wanted));
                }
                Ok(Ok(Delivery::Gap(_))) => check.forget_motion(),
                Ok(Err(_)) | Err(_) => {
                    return Err(AppError::NoFrames {
                        structure: structure.name().to_owned(),
                        within_s: LONGEST_SILENCE.as_secs(),
                        taken_s: taken as f64 / rate_hz,
                    });
                }
            }
        }
        bar.finish_and_clear();
        bus.close().await?;
        Ok(SensorPage::of_check(structure, &check))
    })
}
