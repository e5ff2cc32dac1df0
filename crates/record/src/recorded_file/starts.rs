//! The starts of channels whose file does not date them reliably.

use crate::recorded::StartTime;
use crate::{Format, RecordedChannel, TimeOrigin};

/// Largest difference between the stated starts of the channels of an archive (ns). The recorders
/// of one structure are triggered together.
const APART_NS: i64 = 1_000_000_000;

/// Moves channels without a reliable start to the first sample of the others, and returns a remark
/// for each assumption and each contradiction.
///
/// The recorders of one structure are triggered together. Without any reliable start, the channels
/// start with the earliest of them.
pub(super) fn align(
    format: Format,
    channels: Vec<RecordedChannel>,
) -> (Vec<RecordedChannel>, Vec<String>) {
    let is_archive = matches!(format, Format::Zip | Format::Folder);
    let mut remarks: Vec<String> = is_archive
        .then(|| apart(&channels))
        .flatten()
        .into_iter()
        .collect();
    let is_doubtful = |channel: &&RecordedChannel| channel.start_time() != StartTime::Stated;
    let doubtful = || channels.iter().filter(is_doubtful);
    // A channel that occurs twice has the name of its file before its own. Such files can be
    // records of several events.
    if channels.len() < 2 || doubtful().any(|channel| channel.name().contains('/')) {
        return (channels, remarks);
    }
    let is_alone = doubtful().count() == channels.len();
    let others = channels
        .iter()
        .filter(|channel| is_alone || channel.start_time() == StartTime::Stated);
    let dated = others.filter(|channel| channel.origin() == TimeOrigin::Epoch);
    let Some(start_ns) = dated.filter_map(RecordedChannel::start_ns).min() else {
        // No channel has a date. Times from the start align all of them.
        if is_alone && doubtful().any(|channel| channel.start_time() == StartTime::LowQuality) {
            remarks.push(assumed(doubtful(), is_alone));
        }
        return (channels, remarks);
    };
    let is_there = |channel: &RecordedChannel| {
        channel.origin() == TimeOrigin::Epoch && channel.start_ns() == Some(start_ns)
    };
    if !doubtful().all(is_there) {
        remarks.push(assumed(doubtful(), is_alone));
    }
    let aligned = |channel: RecordedChannel| match channel.start_time() {
        StartTime::Stated => channel,
        StartTime::LowQuality | StartTime::Missing => {
            channel.starting_at(start_ns, TimeOrigin::Epoch)
        }
    };
    (channels.into_iter().map(aligned).collect(), remarks)
}

/// Returns the remark on channels whose start is assumed.
fn assumed<'c>(channels: impl Iterator<Item = &'c RecordedChannel>, is_alone: bool) -> String {
    // The blocks of a channel have its name and their quantity.
    let names = channels.map(|channel| channel.name().split('.').next().unwrap_or_default());
    let mut names: Vec<&str> = names.collect();
    names.dedup();
    let start = match is_alone {
        true => "to start together",
        false => "to start with the first sample of the others",
    };
    format!(
        "time of a low-quality clock, or no time; assumed {start}: {}",
        names.join(", ")
    )
}

/// Returns the remark on channels whose own times are far apart.
fn apart(channels: &[RecordedChannel]) -> Option<String> {
    let stated = channels.iter().filter(|channel| {
        channel.origin() == TimeOrigin::Epoch && channel.start_time() == StartTime::Stated
    });
    let starts = stated.filter_map(|channel| Some((channel.start_ns()?, channel.name())));
    let (first_ns, first) = starts.clone().min()?;
    let (last_ns, last) = starts.max()?;
    let apart_ns = last_ns.saturating_sub(first_ns);
    (apart_ns > APART_NS).then(|| {
        let apart_s = apart_ns as f64 / 1e9;
        format!("channels start at different times: {last} {apart_s:.1} s after {first}")
    })
}
