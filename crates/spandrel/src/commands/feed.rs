//! `spandrel feed`: connects instruments to the bus, or checks what they deliver.

use super::{print, run as services};
use crate::cli::FeedArguments;
use crate::error::AppError;
use crate::services::{Share, block_on, interrupted, read_structures};
use crate::settings::Settings;
use spandrel_feed::{CheckedChannel, CheckedCondition, CheckedSource, FeedError, listen};
use spandrel_service::Clock;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::Duration;

/// Runs the feed until it is stopped, or checks its sources.
///
/// # Errors
/// Returns an error if the configuration is not valid, the bus cannot be joined, or a channel
/// delivers nothing during a check.
pub fn run(arguments: &FeedArguments) -> Result<(), AppError> {
    match arguments.check {
        true => check(arguments),
        false => services::one(&arguments.service, services::Services::FEED, Share::ALL),
    }
}

fn check(arguments: &FeedArguments) -> Result<(), AppError> {
    let settings = Settings::load(&arguments.service.bus)?;
    let watched = read_structures(&settings, &arguments.service.structures)?;
    if settings.feed.is_empty() {
        return Err(FeedError::NoSource.into());
    }
    let config = services::checked_feed(&settings, &watched)?;
    let remarks = config.remarks.clone();
    let duration = Duration::from_secs_f64(arguments.duration);
    let (sources, drops) =
        block_on(async { Ok(listen(config, Clock::of_machine(), duration, interrupted()).await) })?;
    print(&text(&sources, &drops, &remarks))?;
    let channels = || sources.iter().flat_map(|source| &source.channels);
    let missing = channels().filter(|channel| channel.samples == 0).count();
    match missing {
        0 => Ok(()),
        missing => Err(AppError::ChannelsMissing {
            missing,
            all: channels().count(),
        }),
    }
}

/// Returns the report for people.
fn text(sources: &[CheckedSource], drops: &BTreeMap<String, u64>, remarks: &[String]) -> String {
    let mut text = String::new();
    for source in sources {
        let status = &source.status;
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "{} ({}): {}, {} samples, {} errors",
            source.name,
            source.description,
            status.state.as_str(),
            status.samples,
            status.errors
        );
        if let Some(error) = &status.last_error {
            let _ = write!(text, "; last error: {error}");
        }
        text.push('\n');
        for channel in &source.channels {
            text.push_str(&line(channel));
        }
        for condition in &source.conditions {
            text.push_str(&condition_line(condition));
        }
        for (label, samples) in &source.unmapped {
            let _ = writeln!(
                text,
                "  {label}: {samples} samples, not mapped to a channel"
            );
        }
    }
    for (reason, count) in drops {
        let _ = writeln!(text, "{reason}: {count}");
    }
    for remark in remarks {
        let _ = writeln!(text, "{remark}");
    }
    text
}

fn condition_line(condition: &CheckedCondition) -> String {
    let CheckedCondition {
        label,
        structure,
        name,
        unit,
        values,
        last,
    } = condition;
    let place = format!("  {label} -> {structure}/condition/{name}");
    match last {
        Some(last) => format!("{place}: {values} values, last {last} {unit}\n"),
        None => format!("{place}: no values\n"),
    }
}

fn line(channel: &CheckedChannel) -> String {
    let CheckedChannel {
        label,
        structure,
        node,
        channel: name,
        unit,
        samples,
        nominal_hz,
        ..
    } = channel;
    let place = format!("  {label} -> {structure}/{node}/{name}");
    if *samples == 0 {
        return format!("{place}: no samples\n");
    }
    let rate = match channel.measured_hz {
        Some(measured_hz) => format!("{measured_hz:.3} Hz (nominal {nominal_hz} Hz)"),
        None => format!("too few to measure the rate (nominal {nominal_hz} Hz)"),
    };
    let latency = channel.latency_s.map_or(String::new(), |(least, most)| {
        format!(", latency {least:.3} to {most:.3} s")
    });
    let range = channel.range.map_or(String::new(), |(least, most)| {
        format!(", {least:.4e} to {most:.4e} {unit}")
    });
    format!("{place}: {samples} samples, {rate}{latency}{range}\n")
}
