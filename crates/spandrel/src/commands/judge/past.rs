//! `spandrel judge --at`: repeats a past judgement of the service.

use crate::cli::JudgeArguments;
use crate::commands::print;
use crate::error::AppError;
use crate::settings::Settings;
use jiff::Timestamp;
use spandrel_bus::{TIMES, time_ns};
use spandrel_judging::{Configuration, PastJudgement, judge_past};
use spandrel_structure::JudgedStructure;
use std::fmt::Write as _;

/// Judges the saved epochs up to `at`, and prints the state of each quantity.
///
/// # Errors
/// Returns an error if the time is not valid, or if the epochs or the configuration of that time
/// are not known.
pub fn run(arguments: &JudgeArguments, at: &str) -> Result<(), AppError> {
    let [structure] = arguments.service.structures.as_slice() else {
        let found = arguments.service.structures.len();
        return Err(AppError::PastOfStructures { found });
    };
    let at_ns = time_ns(at).ok_or_else(|| AppError::Annotation {
        option: "--at",
        found: format!("{at:?}"),
        allowed: TIMES,
    })?;
    let settings = Settings::load(&arguments.service.bus)?;
    let keys = settings.bus.keys(&JudgedStructure::read(structure)?.name)?;
    let state = settings.state.state()?.ok_or(AppError::NoFolderOfPast)?;
    let folder = state.remembering(&keys).folder;
    let wanted = arguments.with_configuration.as_deref();
    let past = judge_past(&folder, keys.structure(), at_ns, wanted)?;
    print(&match arguments.json {
        true => json(&past),
        false => text(keys.structure().as_str(), &past),
    })
}

fn text(structure: &str, past: &PastJudgement) -> String {
    let Configuration {
        version,
        judge,
        references,
    } = &past.configuration;
    let settings = &judge.settings;
    let mut text = format!(
        "{structure}: {} epochs, the last one of {}\nconfiguration {} since {}: {} false alarms \
         per year, loss {:.1} %, commissioning {} days, version {version}\n",
        past.epochs,
        utc(past.epoch_ns),
        past.name,
        utc(past.since_ns),
        settings.false_alarms_per_year,
        100.0 * settings.loss,
        settings.commissioning_days,
    );
    for annotation in references {
        let of = annotation.quantity.as_ref();
        let of = of.map_or("all quantities", |quantity| quantity.as_str());
        let (from, why) = (utc(annotation.from_ns), annotation.why());
        // Writing to a string cannot fail.
        let _ = writeln!(text, "new reference of {of} since {from}, {why}");
    }
    let own = env!("CARGO_PKG_VERSION");
    if version != own {
        let _ = writeln!(
            text,
            "this is version {own}, whose numbers may differ from those of version {version}"
        );
    }
    for display in &past.displays {
        let (quantity, word) = (&display.quantity, display.word());
        let _ = writeln!(text, "{quantity}: {word}: {}", display.sentence);
    }
    text
}

/// Returns the configuration in one line, and each state in a line as on the bus.
fn json(past: &PastJudgement) -> String {
    let Configuration {
        version,
        judge,
        references,
    } = &past.configuration;
    let configuration = serde_json::json!({
        "configuration": past.name,
        "since_ns": past.since_ns,
        "version": version,
        "judge": judge,
        "references": references,
        "epochs": past.epochs,
        "epoch_ns": past.epoch_ns,
    });
    let mut text = format!("{configuration}\n");
    for display in &past.displays {
        let _ = writeln!(text, "{}", serde_json::json!(display));
    }
    text
}

/// Returns a time (ns since 1970-01-01 UTC) in ISO 8601.
fn utc(time_ns: i64) -> Timestamp {
    Timestamp::from_nanosecond(time_ns.into()).unwrap_or_default()
}
