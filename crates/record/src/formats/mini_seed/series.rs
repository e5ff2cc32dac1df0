//! Joins records to channels in time order, with gaps where samples are missing.

use super::record::Record;
use crate::fault::Fault;
use crate::rate::SAME_RATE;
use crate::recorded::{RecordedChannel, Segment, TimeOrigin};

/// Joins records, each with its byte position. The order of channels is that of their first
/// records.
///
/// If a record repeats existing samples, the repeated part is dropped.
pub(super) fn join(records: Vec<(usize, Record)>) -> Result<Vec<RecordedChannel>, Fault> {
    let mut groups: Vec<Vec<(usize, Record)>> = Vec::new();
    for (place, record) in records {
        match groups.iter_mut().find(|group| {
            group
                .first()
                .is_some_and(|(_, first)| first.name == record.name)
        }) {
            Some(group) => group.push((place, record)),
            None => groups.push(vec![(place, record)]),
        }
    }
    groups.into_iter().map(join_channel).collect()
}

fn join_channel(mut records: Vec<(usize, Record)>) -> Result<RecordedChannel, Fault> {
    // The stable sort keeps the file order of records with the same start.
    records.sort_by_key(|(_, record)| record.start_ns);
    let (name, rate_hz) = records.first().map_or((String::new(), 1.0), |(_, first)| {
        (first.name.clone(), first.rate_hz)
    });
    let qualities = records
        .iter()
        .filter_map(|(_, record)| record.clock_quality);
    let clock_quality = qualities.min();
    let mut segments: Vec<(i64, Vec<f64>)> = Vec::new();
    for (place, record) in records {
        if (record.rate_hz - rate_hz).abs() > SAME_RATE * rate_hz {
            let found = format!("{} Hz", record.rate_hz);
            return Err(Fault::at_byte(
                place,
                format!("sampling rate of {name}"),
                found,
                format!("{rate_hz} Hz as before"),
            ));
        }
        let Some((start_ns, samples)) = segments.last_mut() else {
            segments.push((record.start_ns, record.samples));
            continue;
        };
        let since_start = (record.start_ns.saturating_sub(*start_ns)) as f64 * rate_hz / 1e9;
        let steps_ahead = since_start - samples.len() as f64;
        if steps_ahead > 0.5 {
            segments.push((record.start_ns, record.samples));
            continue;
        }
        let overlap = ((-steps_ahead).round() as usize).min(record.samples.len());
        let there =
            &samples[samples.len() - ((-steps_ahead).round() as usize).min(samples.len())..];
        if there
            .iter()
            .zip(&record.samples)
            .any(|(there, again)| there.to_bits() != again.to_bits())
        {
            let (found, allowed) = (
                "different samples for times that already have samples",
                "the same samples, or later ones",
            );
            return Err(Fault::at_byte(
                place,
                format!("record of {name}"),
                found,
                allowed,
            ));
        }
        samples.extend_from_slice(&record.samples[overlap..]);
    }
    let segments = segments
        .into_iter()
        .map(|(start_ns, samples)| Segment::new(start_ns, samples))
        .collect();
    Ok(RecordedChannel::new(name, Some(rate_hz), segments)
        .with_unit("counts")
        .with_origin(TimeOrigin::Epoch)
        .with_clock_quality(clock_quality))
}
