//! Queries for spans of time.
//!
//! [`read`] handles all spans that the page or a script requests. It returns the data that the
//! dashboard has collected since its start, and lists the missing parts. The history service
//! supplies these, and [`Span::put_before`] inserts its replies. Without a history service, the
//! reply states the time of the first stored value. Of waveforms, the recording of ingest supplies
//! the missing part.

use crate::series::{Series, Table};
use crate::store::Store;
use crate::topic::{Kind, SeriesName};
use serde::{Deserialize, Serialize};
use spandrel_bus::{HistorySpan, Name, Service, SpanQuery, TIMES, is_without_date, time_ns};
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Default number of points of each series, about the number of columns on a screen.
const POINTS: usize = 1_000;
/// Maximum number of points of each series.
const MOST_POINTS: usize = 20_000;
/// Maximum number of series in one request.
const MOST_SERIES: usize = 256;

/// A request before validation.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Asked {
    /// Names of series, separated by commas.
    series: Option<String>,
    /// Seconds since the Unix epoch (UTC), or ISO 8601.
    from: Option<String>,
    to: Option<String>,
    points: Option<usize>,
    /// Whether waveforms from before the stored ones are read from the recording of ingest. The
    /// default is `true`.
    recorded: Option<bool>,
    #[serde(default)]
    pub(crate) format: Format,
}

/// Format of the reply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Format {
    #[default]
    Json,
    Csv,
}

/// A validated request.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Request {
    series: Vec<SeriesName>,
    from_ns: i64,
    to_ns: i64,
    points: usize,
    reads_recording: bool,
}

/// Reason for rejecting a request, in the wording of the reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Refused {
    pub(crate) what: String,
    pub(crate) allowed: String,
}

/// Data of a time span.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Span {
    structure: String,
    /// Time of the first stored value of any requested series (s since the Unix epoch, UTC). `None`
    /// if there is no data. A series that begins later, such as a loss after the reference was
    /// learnt, does not hide what the others contain.
    kept_from_s: Option<f64>,
    /// Whether a history service has not replied in time, so that earlier data can be missing.
    pub(crate) incomplete: bool,
    /// Reason why waveforms from before the stored ones are missing.
    pub(crate) unread_waveforms: Option<String>,
    /// Ranges from before the stored waveforms.
    #[serde(skip)]
    pub(crate) unkept: Vec<Unkept>,
    series: Vec<SpanOfSeries>,
}

#[derive(Clone, Debug, Serialize)]
struct SpanOfSeries {
    name: String,
    /// Number of restarts of the measurement. Points of different generations do not belong
    /// together.
    generation: u64,
    columns: Vec<&'static str>,
    /// Data by column. The first column is the time (s since the Unix epoch, UTC).
    data: Vec<Vec<f64>>,
    #[serde(skip)]
    table: Table,
    #[serde(skip)]
    kind: Kind,
    #[serde(skip)]
    kept_from_ns: Option<i64>,
}

/// A query for data from before the dashboard's own data.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Earlier {
    /// Index of the series in the span.
    place: usize,
    pub(crate) name: Name,
    pub(crate) query: SpanQuery,
}

/// A range from before the stored points of a waveform. The recording of ingest may contain its
/// samples.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Unkept {
    /// Index of the series in the span.
    place: usize,
    /// Index of the channel in the structure file.
    pub(crate) sensor: usize,
    /// Ends of the range (ns since the Unix epoch, UTC), both inclusive.
    pub(crate) from_ns: i64,
    pub(crate) to_ns: i64,
    /// Maximum number of points, at least 1.
    pub(crate) points: usize,
}

impl Request {
    /// Checks a request. Without names, it covers all stored series except waveforms.
    pub(crate) fn new(asked: &Asked, store: &Store) -> Result<Self, Refused> {
        let refuse = |what: String, allowed: &str| {
            Err(Refused {
                what,
                allowed: allowed.to_owned(),
            })
        };
        let mut series = Vec::new();
        for name in asked
            .series
            .as_deref()
            .unwrap_or_default()
            .split(',')
            .filter(|name| !name.is_empty())
        {
            match SeriesName::parse(name).filter(|name| store.may_have(name)) {
                Some(name) => series.push(name),
                None => {
                    let known: Vec<String> =
                        store.series_names().map(ToString::to_string).collect();
                    let allowed = format!("must be one of: {}", known.join(", "));
                    let allowed = if known.is_empty() {
                        "no data received yet"
                    } else {
                        &allowed
                    };
                    return refuse(
                        format!("series `{}` is not known", shortened(name)),
                        allowed,
                    );
                }
            }
        }
        if series.is_empty() {
            // Waveforms are by far the largest part, and only their own names request them.
            let names = store.series_names();
            series = names
                .filter(|name| name.kind != Kind::Waveform)
                .cloned()
                .collect();
        }
        if series.len() > MOST_SERIES {
            return refuse(
                format!("{} series requested", series.len()),
                "must be at most 256",
            );
        }
        let points = asked.points.unwrap_or(POINTS);
        if !(1..=MOST_POINTS).contains(&points) {
            return refuse(format!("points is {points}"), "must be from 1 to 20000");
        }
        let (from_ns, to_ns) = (
            time("from", asked.from.as_ref(), i64::MIN)?,
            time("to", asked.to.as_ref(), i64::MAX)?,
        );
        if from_ns > to_ns {
            let seconds = |time_ns: i64| time_ns as f64 / 1e9;
            let what = format!(
                "the span is from {} to {} s",
                seconds(from_ns),
                seconds(to_ns)
            );
            return refuse(what, "from must come before to");
        }
        Ok(Self {
            series,
            from_ns,
            to_ns,
            points,
            reads_recording: asked.recorded.unwrap_or(true),
        })
    }

    /// Returns `true` if the samples of a series from before the stored points are read. Without a
    /// start, there would be no end of them.
    fn reads(&self, kind: Kind) -> bool {
        kind == Kind::Waveform && self.reads_recording && self.from_ns > i64::MIN
    }
}

/// Returns the time of a request (ns since the Unix epoch, UTC), or `missing` if there is none.
pub(crate) fn time(name: &str, text: Option<&String>, missing: i64) -> Result<i64, Refused> {
    match text {
        None => Ok(missing),
        Some(text) => time_ns(text).ok_or_else(|| Refused {
            what: format!("{name} is `{}`", shortened(text)),
            allowed: format!("must be {TIMES}"),
        }),
    }
}

/// Reads the stored data of a span, and returns the queries for earlier data that the history
/// service may have.
pub(crate) fn read(store: &Store, request: &Request) -> (Span, Vec<Earlier>) {
    let mut series = Vec::new();
    let mut earlier = Vec::new();
    let mut unkept = Vec::new();
    let has_history = store.state.has(Service::History);
    for (place, name) in request.series.iter().enumerate() {
        let found = store.series(name);
        let first_ns = found.and_then(Series::first_ns);
        let mut points = request.points;
        let is_earlier = request.from_ns < first_ns.unwrap_or(i64::MAX);
        if is_earlier && has_history && name.kind.is_in_history() {
            let query = before(request, name.kind, first_ns);
            // The remaining points are for the data stored here.
            points = (points - query.points).max(1);
            earlier.extend(Name::new(name.of.clone()).ok().map(|name| Earlier {
                place,
                name,
                query,
            }));
        } else if is_earlier && request.reads(name.kind) {
            let query = before(request, name.kind, first_ns);
            points = (points - query.points).max(1);
            let mut sensors = store.about.drawing.sensors.iter();
            let sensor = sensors.position(|sensor| sensor.channel == name.of);
            // Without stored points, the range would have no end.
            let newest_ns = store.state.time_ns.unwrap_or(i64::MAX);
            let to_ns = query.to_ns.min(newest_ns);
            let sensor = sensor.filter(|_| query.from_ns < to_ns);
            unkept.extend(sensor.map(|sensor| Unkept {
                place,
                sensor,
                from_ns: query.from_ns,
                to_ns,
                points: query.points,
            }));
        }
        // A possible series without data yet is empty.
        let span = |series: &Series| series.span(request.from_ns, request.to_ns, points);
        let width = name.kind.columns().len();
        let table = found.map_or_else(|| Table::of(width, std::iter::empty()), span);
        series.push(SpanOfSeries {
            name: name.to_string(),
            generation: found.map_or(0, Series::generation),
            columns: std::iter::once("time_s")
                .chain(name.kind.columns().iter().copied())
                .collect(),
            data: columns(&table, width),
            table,
            kind: name.kind,
            kept_from_ns: first_ns,
        });
    }
    let mut span = Span {
        structure: store.about.name.clone(),
        kept_from_s: None,
        incomplete: false,
        unread_waveforms: None,
        unkept,
        series,
    };
    span.tell_kept_from();
    (span, earlier)
}

/// Returns the query for data from before the first stored point. Its share of the points is its
/// share of the span.
fn before(request: &Request, kind: Kind, first_ns: Option<i64>) -> SpanQuery {
    let end_ns = first_ns.map_or(request.to_ns, |first_ns| {
        request.to_ns.min(first_ns.saturating_sub(1))
    });
    let length = |to_ns: i64| (to_ns as f64) - (request.from_ns as f64);
    let share = if first_ns.is_none() {
        1.0
    } else {
        length(end_ns) / length(request.to_ns).max(1.0)
    };
    // A span without a start or an end has no share.
    let is_bounded = request.from_ns > i64::MIN && request.to_ns < i64::MAX;
    let share = if is_bounded || first_ns.is_none() {
        share
    } else {
        0.5
    };
    let points = ((request.points as f64) * share).ceil() as usize;
    let query = SpanQuery {
        points: points.clamp(1, request.points),
        ..SpanQuery::default()
    };
    SpanQuery {
        from_ns: request.from_ns,
        to_ns: end_ns,
        kind: kind.as_str().to_owned(),
        ..query
    }
}

/// Returns the columns of a table, the time (s) first.
pub(crate) fn columns(table: &Table, width: usize) -> Vec<Vec<f64>> {
    let times = table
        .times_ns()
        .map(|time_ns| time_ns as f64 / 1e9)
        .collect();
    let values = (0..width).map(|column| table.column(column).collect());
    std::iter::once(times).chain(values).collect()
}

impl Span {
    /// Inserts a reply of the history service before the stored data.
    pub(crate) fn put_before(&mut self, earlier: &Earlier, answer: &HistorySpan) {
        let Some(series) = self.series.get_mut(earlier.place) else {
            return;
        };
        let width = series.kind.columns().len();
        let rows = &answer.rows;
        let row = |row: usize| {
            let values = match series.kind {
                Kind::Parameter | Kind::Noise | Kind::Mode => vec![rows.mean[row], rows.std[row]],
                Kind::Loss => vec![
                    rows.mean[row],
                    rows.low[row],
                    rows.high[row],
                    rows.probability_of_loss[row],
                ],
                // the history does not store the other columns
                Kind::Outlier | Kind::Node => vec![rows.largest[row]],
                Kind::Class | Kind::Condition => vec![rows.mean[row]],
                Kind::Innovation | Kind::Consistency | Kind::Waveform => Vec::new(),
            };
            (nearest_ns(rows.time_s[row]), values)
        };
        // A time in seconds is rounded. It must not exceed the times of the following rows.
        let end_ns = earlier.query.to_ns;
        let rows = (0..rows.time_s.len())
            .map(row)
            .map(|(time_ns, values)| (time_ns.min(end_ns), values));
        let table = Table::of(width, rows);
        let kept_from_ns = answer.kept_from_s.map(|seconds| (seconds * 1e9) as i64);
        series.put_before(table, kept_from_ns);
        self.tell_kept_from();
    }

    /// Inserts the waveform of a range before the stored one.
    pub(crate) fn put_recorded(&mut self, unkept: &Unkept, table: Table) {
        if let Some(series) = self.series.get_mut(unkept.place) {
            let first_ns = table.times_ns().next();
            series.put_before(table, first_ns);
            self.tell_kept_from();
        }
    }

    /// Returns `true` if no series has a point.
    pub(crate) fn is_empty(&self) -> bool {
        self.series.iter().all(|series| series.table.len() == 0)
    }

    /// Returns `true` if one of the waveforms has no point.
    pub(crate) fn lacks(&self, unkept: &[Unkept]) -> bool {
        let mut series = unkept.iter().filter_map(|one| self.series.get(one.place));
        series.any(|series| series.table.len() == 0)
    }

    fn tell_kept_from(&mut self) {
        let first = self
            .series
            .iter()
            .filter_map(|series| series.kept_from_ns)
            .min();
        self.kept_from_s = first.map(|time_ns| time_ns as f64 / 1e9);
    }

    /// Returns the span as CSV, with one row per time and one column per series and value.
    ///
    /// Times are ISO 8601 in UTC, or seconds for a record without dates. A cell is empty if its
    /// series has no point at that time.
    pub(crate) fn csv(&self) -> String {
        let mut rows: BTreeMap<i64, Vec<(usize, f64)>> = BTreeMap::new();
        let mut header = "time".to_owned();
        let mut width = 0;
        for series in &self.series {
            for column in series.columns.iter().skip(1) {
                // Writing to a string cannot fail.
                let _ = write!(header, ",{}", quoted(&format!("{}.{column}", series.name)));
            }
            for (row, time_ns) in series.table.times_ns().enumerate() {
                let values = series
                    .table
                    .row(row)
                    .enumerate()
                    .map(|(column, value)| (width + column, value));
                rows.entry(time_ns).or_default().extend(values);
            }
            width += series.columns.len() - 1;
        }
        let mut text = header + "\n";
        for (time_ns, values) in rows {
            let mut cells = vec![String::new(); width];
            for (column, value) in values.into_iter().filter(|(_, value)| value.is_finite()) {
                cells[column] = shortest(value);
            }
            let _ = writeln!(text, "{},{}", written(time_ns), cells.join(","));
        }
        text
    }
}

impl SpanOfSeries {
    /// Inserts earlier rows. `kept_from_ns` is the time of the first one that is kept, in or before
    /// the span.
    fn put_before(&mut self, mut table: Table, kept_from_ns: Option<i64>) {
        table.append(std::mem::take(&mut self.table));
        self.data = columns(&table, self.kind.columns().len());
        self.table = table;
        self.kept_from_ns = self.kept_from_ns.into_iter().chain(kept_from_ns).min();
    }
}

#[cfg(test)]
impl Unkept {
    /// Creates a range of the first series of a span.
    pub(crate) fn new(sensor: usize, from_ns: i64, to_ns: i64, points: usize) -> Self {
        Self {
            place: 0,
            sensor,
            from_ns,
            to_ns,
            points,
        }
    }
}

/// Converts a time in seconds to nanoseconds.
///
/// A date is rounded to microseconds, because seconds since 1970 in double precision are no more
/// precise.
fn nearest_ns(time_s: f64) -> i64 {
    let time_ns = (time_s * 1e9).round() as i64;
    if is_without_date(time_ns) {
        time_ns
    } else {
        (time_s * 1e6).round() as i64 * 1_000
    }
}

/// Formats a number with the fewest digits that read back as the same number. It uses an exponent
/// instead of many zeros.
fn shortest(value: f64) -> String {
    /// Range of magnitudes that are more legible without an exponent.
    const PLAIN: std::ops::Range<f64> = 1e-5..1e16;
    if value == 0.0 || PLAIN.contains(&value.abs()) {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

/// Formats a time as a date, or in seconds if the record has no dates.
fn written(time_ns: i64) -> String {
    let dated = (!is_without_date(time_ns))
        .then(|| jiff::Timestamp::from_nanosecond(i128::from(time_ns)).ok())
        .flatten();
    dated.map_or_else(|| shortest(time_ns as f64 / 1e9), |time| time.to_string())
}

/// Quotes a name as a CSV field.
///
/// A spreadsheet would take a leading sign for a formula, but no name starts with a sign, because
/// it starts with its kind.
fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", name.replace('"', "\"\""))
    } else {
        name.to_owned()
    }
}

/// Returns the first 64 characters of external text.
fn shortened(text: &str) -> String {
    text.chars().take(64).collect()
}

#[cfg(test)]
mod tests;
