//! Spans of time: which are asked for, and what is known of them.
//!
//! Every span that the page or a script asks for goes through [`read`]. It answers from what the dashboard has kept since
//! its start. What lies before that is for the history service, under the keys of `Keys::history`; there is none yet, so
//! that the answer says from when on it has everything.

use crate::series::{Series, Table};
use crate::store::Store;
use crate::topic::SeriesName;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Points of each series unless asked otherwise: about as many as a screen has columns.
const POINTS: usize = 1_000;
/// Most points of each series.
const MOST_POINTS: usize = 20_000;
/// Most series in one request.
const MOST_SERIES: usize = 256;

/// A request as it comes.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Asked {
    /// Names, separated by commas.
    series: Option<String>,
    /// Seconds since the Unix epoch, UTC.
    from: Option<f64>,
    to: Option<f64>,
    points: Option<usize>,
    #[serde(default)]
    pub(crate) format: Format,
}

/// How the answer is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Format {
    #[default]
    Json,
    Csv,
}

/// A request that has been checked.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Request {
    series: Vec<SeriesName>,
    from_ns: i64,
    to_ns: i64,
    points: usize,
}

/// Why a request is refused, in the words of the answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Refused {
    pub(crate) what: String,
    pub(crate) allowed: String,
}

/// What is known of a span.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Span {
    structure: String,
    /// From when on everything asked for is kept (s since the Unix epoch, UTC); none where nothing is.
    kept_from_s: Option<f64>,
    series: Vec<SpanOfSeries>,
}

#[derive(Clone, Debug, Serialize)]
struct SpanOfSeries {
    name: String,
    /// How often measurement has begun anew: points of another number do not belong together.
    generation: u64,
    columns: Vec<&'static str>,
    /// Column by column, the first one the time (s since the Unix epoch, UTC).
    data: Vec<Vec<f64>>,
    #[serde(skip)]
    table: Table,
}

impl Request {
    /// Checks a request; without names it is for all that is kept.
    pub(crate) fn new(asked: &Asked, store: &Store) -> Result<Self, Refused> {
        let refuse = |what: String, allowed: &str| Err(Refused { what, allowed: allowed.to_owned() });
        let mut series = Vec::new();
        for name in asked.series.as_deref().unwrap_or_default().split(',').filter(|name| !name.is_empty()) {
            match SeriesName::parse(name).filter(|name| store.may_have(name)) {
                Some(name) => series.push(name),
                None => {
                    let known: Vec<String> = store.series_names().map(ToString::to_string).collect();
                    let allowed = format!("must be one of: {}", known.join(", "));
                    let allowed = if known.is_empty() { "nothing has been heard yet" } else { &allowed };
                    return refuse(format!("series `{}` is not known", shortened(name)), allowed);
                }
            }
        }
        if series.is_empty() {
            series = store.series_names().cloned().collect();
        }
        if series.len() > MOST_SERIES {
            return refuse(format!("{} series are asked for", series.len()), "must be 256 or fewer");
        }
        let points = asked.points.unwrap_or(POINTS);
        if !(1..=MOST_POINTS).contains(&points) {
            return refuse(format!("points is {points}"), "must be from 1 to 20000");
        }
        let (from, to) = (asked.from.unwrap_or(f64::MIN), asked.to.unwrap_or(f64::MAX));
        if from.is_nan() || to.is_nan() || from > to {
            return refuse(format!("the span is from {from} to {to}"), "must be seconds since 1970, from before to");
        }
        // a cast of what no i64 holds stops at its ends
        Ok(Self { series, from_ns: (from * 1e9) as i64, to_ns: (to * 1e9) as i64, points })
    }
}

/// Reads what is known of a span.
pub(crate) fn read(store: &Store, request: &Request) -> Span {
    let mut kept_from_ns = None;
    let mut series = Vec::new();
    for name in &request.series {
        let found = store.series(name);
        kept_from_ns = kept_from_ns.max(found.and_then(Series::first_ns));
        // what may come and has not yet is empty
        let span = |series: &Series| series.span(request.from_ns, request.to_ns, request.points);
        let table = found.map(span).unwrap_or_default();
        series.push(SpanOfSeries {
            name: name.to_string(),
            generation: found.map_or(0, Series::generation),
            columns: std::iter::once("time_s").chain(name.kind.columns().iter().copied()).collect(),
            data: columns(&table, name.kind.columns().len()),
            table,
        });
    }
    let kept_from_s = kept_from_ns.map(|time_ns| time_ns as f64 / 1e9);
    Span { structure: store.about.name.clone(), kept_from_s, series }
}

/// The columns of a table, the time (s) first.
pub(crate) fn columns(table: &Table, width: usize) -> Vec<Vec<f64>> {
    let times = table.times_ns().map(|time_ns| time_ns as f64 / 1e9).collect();
    let values = (0..width).map(|column| table.column(column).collect());
    std::iter::once(times).chain(values).collect()
}

impl Span {
    /// One row per time (ISO 8601, UTC), one column per series and value; empty where a series has no point.
    pub(crate) fn csv(&self) -> String {
        let mut rows: BTreeMap<i64, Vec<(usize, f64)>> = BTreeMap::new();
        let mut header = "time".to_owned();
        let mut width = 0;
        for series in &self.series {
            for column in series.columns.iter().skip(1) {
                // writing to a String does not fail
                let _ = write!(header, ",{}", quoted(&format!("{}.{column}", series.name)));
            }
            for (row, time_ns) in series.table.times_ns().enumerate() {
                let values = series.table.row(row).enumerate().map(|(column, value)| (width + column, value));
                rows.entry(time_ns).or_default().extend(values);
            }
            width += series.columns.len() - 1;
        }
        let mut text = header + "\n";
        for (time_ns, values) in rows {
            let mut cells = vec![String::new(); width];
            for (column, value) in values.into_iter().filter(|(_, value)| value.is_finite()) {
                cells[column] = value.to_string();
            }
            let _ = writeln!(text, "{},{}", iso_8601(time_ns), cells.join(","));
        }
        text
    }
}

fn iso_8601(time_ns: i64) -> String {
    match jiff::Timestamp::from_nanosecond(i128::from(time_ns)) {
        Ok(time) => time.to_string(),
        Err(_) => format!("{}", time_ns as f64 / 1e9), // beyond the calendar, and so of no record
    }
}

/// A name as a field of CSV; a leading sign that a spreadsheet would take for a formula cannot come from a kind.
fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) { format!("\"{}\"", name.replace('"', "\"\"")) } else { name.to_owned() }
}

/// The beginning of what somebody else wrote.
fn shortened(text: &str) -> String {
    text.chars().take(64).collect()
}

#[cfg(test)]
mod tests;
