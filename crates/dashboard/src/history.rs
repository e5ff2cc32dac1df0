//! Spans of time: which are asked for, and what is known of them.
//!
//! Every span that the page or a script asks for goes through [`read`]. It answers from what the dashboard has kept since
//! its start, and says what it lacks: that is for the history service, whose answers [`Span::put_before`] takes. Without one the
//! answer says from when on it has everything.

use crate::series::{Series, Table};
use crate::store::Store;
use crate::topic::{Kind, SeriesName};
use serde::{Deserialize, Serialize};
use spandrel_bus::{HistorySpan, Name, Service, SpanQuery, TIMES, is_without_date, time_ns};
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
    /// Seconds since the Unix epoch, UTC, or ISO 8601.
    from: Option<String>,
    to: Option<String>,
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
    #[serde(skip)]
    kind: Kind,
    #[serde(skip)]
    kept_from_ns: Option<i64>,
}

/// What lies before that which a dashboard has kept itself.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Earlier {
    /// Which series of the span.
    place: usize,
    pub(crate) name: Name,
    pub(crate) query: SpanQuery,
}

impl Request {
    /// Checks a request; without names it is for all that is kept.
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
                        "nothing has been heard yet"
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
            series = store.series_names().cloned().collect();
        }
        if series.len() > MOST_SERIES {
            return refuse(
                format!("{} series are asked for", series.len()),
                "must be 256 or fewer",
            );
        }
        let points = asked.points.unwrap_or(POINTS);
        if !(1..=MOST_POINTS).contains(&points) {
            return refuse(format!("points is {points}"), "must be from 1 to 20000");
        }
        let time = |name: &str, text: &Option<String>, missing: i64| match text {
            None => Ok(missing),
            Some(text) => time_ns(text).ok_or_else(|| Refused {
                what: format!("{name} is `{}`", shortened(text)),
                allowed: format!("must be {TIMES}"),
            }),
        };
        let (from_ns, to_ns) = (
            time("from", &asked.from, i64::MIN)?,
            time("to", &asked.to, i64::MAX)?,
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
        })
    }
}

/// Reads what is known of a span here, and tells what the history service may know of it.
pub(crate) fn read(store: &Store, request: &Request) -> (Span, Vec<Earlier>) {
    let mut series = Vec::new();
    let mut earlier = Vec::new();
    let has_history = store
        .present
        .iter()
        .any(|(service, _)| *service == Service::History);
    for (place, name) in request.series.iter().enumerate() {
        let found = store.series(name);
        let first_ns = found.and_then(Series::first_ns);
        let mut points = request.points;
        if has_history && request.from_ns < first_ns.unwrap_or(i64::MAX) {
            let query = before(request, name.kind, first_ns);
            // the rest of the points is for what is here
            points = (points - query.points).max(1);
            earlier.extend(Name::new(name.of.clone()).ok().map(|name| Earlier {
                place,
                name,
                query,
            }));
        }
        // what may come and has not yet is empty
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
        series,
    };
    span.tell_kept_from();
    (span, earlier)
}

/// What to ask for before the first point that is here: a share of the points that is that of its time.
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
    // a span without a beginning or an end says nothing of shares
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

/// The columns of a table, the time (s) first.
pub(crate) fn columns(table: &Table, width: usize) -> Vec<Vec<f64>> {
    let times = table
        .times_ns()
        .map(|time_ns| time_ns as f64 / 1e9)
        .collect();
    let values = (0..width).map(|column| table.column(column).collect());
    std::iter::once(times).chain(values).collect()
}

impl Span {
    /// Puts what the history service knows before what is known here.
    pub(crate) fn put_before(&mut self, earlier: &Earlier, answer: &HistorySpan) {
        let Some(series) = self.series.get_mut(earlier.place) else {
            return;
        };
        let width = series.kind.columns().len();
        let rows = &answer.rows;
        let row = |row: usize| {
            let values = match series.kind {
                Kind::Parameter => {
                    vec![rows.mean[row], rows.std[row], rows.probability_of_loss[row]]
                }
                Kind::Noise => vec![rows.mean[row], rows.std[row]],
                Kind::Outlier | Kind::Node => vec![rows.largest[row]], // the rest is not kept
                Kind::Class => vec![rows.mean[row]],
                Kind::Innovation | Kind::Consistency => Vec::new(),
            };
            (nearest_ns(rows.time_s[row]), values)
        };
        // a time in seconds is rounded, and must not come after what follows
        let end_ns = earlier.query.to_ns;
        let rows = (0..rows.time_s.len())
            .map(row)
            .map(|(time_ns, values)| (time_ns.min(end_ns), values));
        let mut table = Table::of(width, rows);
        table.append(std::mem::take(&mut series.table));
        series.data = columns(&table, width);
        series.table = table;
        let kept_from_ns = answer.kept_from_s.map(|seconds| (seconds * 1e9) as i64);
        series.kept_from_ns = series.kept_from_ns.into_iter().chain(kept_from_ns).min();
        self.tell_kept_from();
    }

    fn tell_kept_from(&mut self) {
        let last = self
            .series
            .iter()
            .filter_map(|series| series.kept_from_ns)
            .max();
        self.kept_from_s = last.map(|time_ns| time_ns as f64 / 1e9);
    }

    /// One row per time (ISO 8601, UTC; seconds of a record without dates), one column per series and value; empty where a series has no point.
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

/// A time in seconds as nanoseconds: of a date to the microsecond, because a number of seconds since 1970 tells no more.
fn nearest_ns(time_s: f64) -> i64 {
    let time_ns = (time_s * 1e9).round() as i64;
    if is_without_date(time_ns) {
        time_ns
    } else {
        (time_s * 1e6).round() as i64 * 1_000
    }
}

/// A number in the fewest digits that are read back as the same, with an exponent where zeros would be written instead.
fn shortest(value: f64) -> String {
    /// Sizes that are read more easily without an exponent.
    const PLAIN: std::ops::Range<f64> = 1e-5..1e16;
    if value == 0.0 || PLAIN.contains(&value.abs()) {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

/// A time: by the calendar, or in seconds where there is no date.
fn written(time_ns: i64) -> String {
    let dated = (!is_without_date(time_ns))
        .then(|| jiff::Timestamp::from_nanosecond(i128::from(time_ns)).ok())
        .flatten();
    dated.map_or_else(|| shortest(time_ns as f64 / 1e9), |time| time.to_string())
}

/// A name as a field of CSV; a leading sign that a spreadsheet would take for a formula cannot come from a kind.
fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", name.replace('"', "\"\""))
    } else {
        name.to_owned()
    }
}

/// The beginning of what somebody else wrote.
fn shortened(text: &str) -> String {
    text.chars().take(64).collect()
}

#[cfg(test)]
mod tests;
