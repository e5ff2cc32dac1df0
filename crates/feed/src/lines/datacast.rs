//! The datacast of a Raspberry Shake: channel, time of the first sample, and counts.
//!
//! Source: Raspberry Shake manual, *UDP data cast*: `{'EHZ', 1507760140.530, 614, 916, 1095, …}`.
//! A packet contains 25 samples at 100 Hz.

use spandrel_record::TimeUnit;
use spandrel_record::record_time::parse_time_ns;

use super::LineFault;
use crate::packet::Packet;

pub(super) fn parse(line: &str) -> Result<Packet, LineFault> {
    let inner = line
        .strip_prefix('{')
        .and_then(|rest| rest.strip_suffix('}'))
        .ok_or_else(|| LineFault::new("packet", line, "must be {'CHANNEL', TIME, COUNTS…}"))?;
    let mut cells = inner.split(',').map(str::trim);
    let label = cells.next().unwrap_or_default();
    let label = label
        .strip_prefix(['\'', '"'])
        .and_then(|rest| rest.strip_suffix(['\'', '"']))
        .filter(|label| !label.is_empty())
        .ok_or_else(|| LineFault::new("channel", label, "must be a name in quotes"))?;
    let time = cells.next().unwrap_or_default();
    let start_ns = parse_time_ns(time, TimeUnit::Seconds)
        .ok_or_else(|| LineFault::new("time", time, "must be seconds since 1970"))?;
    let values: Result<Vec<f64>, LineFault> = cells.map(count).collect();
    let values = values?;
    if values.is_empty() {
        return Err(LineFault::new(
            "packet",
            line,
            "must have at least one sample",
        ));
    }
    Ok(Packet {
        label: label.to_owned(),
        start_ns: Some(start_ns),
        rate_hz: None,
        values,
        clock_quality: None,
    })
}

fn count(text: &str) -> Result<f64, LineFault> {
    text.parse()
        .map_err(|_| LineFault::new("sample", text, "must be a number"))
}
