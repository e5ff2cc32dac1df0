//! Parameters of a query for the history: `?from=TIME;to=TIME;points=COUNT;kind=KIND`.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;

/// Number of points per reply if the query does not specify it.
const DEFAULT_POINTS: usize = 1_000;
/// Maximum number of points per reply.
const MOST_POINTS: usize = 20_000;
const NS_PER_S: i64 = 1_000_000_000;

/// Time span and number of points that a query requests.
///
/// ```
/// use spandrel_bus::SpanQuery;
/// let query: SpanQuery = "from=1763730000;points=100".parse()?;
/// assert_eq!((query.from_ns, query.to_ns, query.points), (1_763_730_000_000_000_000, i64::MAX, 100));
/// assert_eq!(query.kind, "parameter");
/// let same: SpanQuery = "from=2025-11-21T13:00:00Z;points=100".parse()?;
/// assert_eq!(same, query);
/// # Ok::<(), spandrel_bus::SpanError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpanQuery {
    /// Start of the span, ns since the Unix epoch, UTC. By default, the earliest stored value.
    pub from_ns: i64,
    /// End of the span, ns since the Unix epoch, UTC. By default, the latest stored value.
    pub to_ns: i64,
    /// Maximum number of points, 1 to 20,000. Default 1,000.
    pub points: usize,
    /// Kind of the quantity. Default `parameter`.
    pub kind: String,
}

/// A query parameter with an invalid name or value.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("query parameter {key} is {found:?}, must be {allowed}")]
pub struct SpanError {
    /// Name of the parameter.
    pub key: String,
    /// Rejected value.
    pub found: String,
    /// Description of the valid values.
    pub allowed: &'static str,
}

/// Description of the valid times, for error messages.
pub const TIMES: &str =
    "seconds since 1970, UTC, or ISO 8601 such as 2026-03-01T12:00:00Z or 2026-03-01";

/// Parses a time, in seconds since 1970 or ISO 8601, and returns ns since the Unix epoch, UTC.
///
/// A time without an offset is UTC. A date without a time is its midnight. Returns `None` if the
/// text is not a time or is out of range.
///
/// ```
/// use spandrel_bus::time_ns;
/// assert_eq!(time_ns("1763730000.5"), Some(1_763_730_000_500_000_000));
/// assert_eq!(time_ns("2025-11-21T14:00:00+01:00"), Some(1_763_730_000_000_000_000));
/// assert_eq!(time_ns("2025-11-21"), time_ns("2025-11-21T00:00:00Z"));
/// assert_eq!(time_ns("yesterday"), None);
/// ```
#[must_use]
pub fn time_ns(text: &str) -> Option<i64> {
    if let Some(time_ns) = decimal_ns(text) {
        return Some(time_ns);
    }
    if let Ok(seconds) = text.parse::<f64>() {
        let ns = seconds * NS_PER_S as f64;
        return (ns.abs() < i64::MAX as f64).then_some(ns as i64);
    }
    let of_calendar = || {
        text.parse::<DateTime>()
            .ok()?
            .to_zoned(TimeZone::UTC)
            .ok()
            .map(|zoned| zoned.timestamp())
    };
    // In a URL, a plus sign that is not escaped is a space.
    let with_sign = || {
        text.rsplit_once(' ')
            .and_then(|(time, offset)| format!("{time}+{offset}").parse().ok())
    };
    let time: Timestamp = text.parse().ok().or_else(of_calendar).or_else(with_sign)?;
    i64::try_from(time.as_nanosecond()).ok()
}

/// Parses decimal seconds to the nanosecond. Floating-point seconds are accurate to 0.24 µs only.
fn decimal_ns(text: &str) -> Option<i64> {
    let (sign, digits) = text
        .strip_prefix('-')
        .map_or((1, text), |digits| (-1, digits));
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, "0"));
    let is_digits = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    if !is_digits(whole) || !is_digits(fraction) {
        return None;
    }
    let fraction: i64 = format!("{fraction:0<9}").get(..9)?.parse().ok()?;
    whole
        .parse::<i64>()
        .ok()?
        .checked_mul(NS_PER_S)?
        .checked_add(fraction)?
        .checked_mul(sign)
}

/// Formats a time in seconds, so that it is parsed as the same nanosecond.
fn seconds(time_ns: i64) -> String {
    let (sign, size) = (if time_ns < 0 { "-" } else { "" }, time_ns.unsigned_abs());
    let (whole, fraction) = (
        size / NS_PER_S.unsigned_abs(),
        size % NS_PER_S.unsigned_abs(),
    );
    let text = format!("{sign}{whole}.{fraction:09}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

impl Default for SpanQuery {
    fn default() -> Self {
        Self {
            from_ns: i64::MIN,
            to_ns: i64::MAX,
            points: DEFAULT_POINTS,
            kind: "parameter".to_owned(),
        }
    }
}

impl FromStr for SpanQuery {
    type Err = SpanError;

    fn from_str(parameters: &str) -> Result<Self, SpanError> {
        let mut query = Self::default();
        for (key, value) in parameters
            .split(';')
            .filter_map(|pair| pair.split_once('='))
        {
            let refused = |key: &str, allowed| {
                let (key, found) = (
                    key.chars().take(32).collect(),
                    value.chars().take(32).collect(),
                );
                SpanError {
                    key,
                    found,
                    allowed,
                }
            };
            let seconds = |key| time_ns(value).ok_or_else(|| refused(key, TIMES));
            match key {
                "from" => query.from_ns = seconds("from")?,
                "to" => query.to_ns = seconds("to")?,
                "points" => match value.parse() {
                    Ok(points) if (1..=MOST_POINTS).contains(&points) => query.points = points,
                    Ok(_) | Err(_) => {
                        return Err(refused("points", "a whole number from 1 to 20000"));
                    }
                },
                "kind" if value.len() <= 64 => value.clone_into(&mut query.kind),
                "kind" => return Err(refused("kind", "a word")),
                _ if key.starts_with('_') => {} // parameters of Zenoh itself
                _ => {
                    return Err(refused(
                        key,
                        "omitted: a query supports only from, to, points and kind",
                    ));
                }
            }
        }
        if query.from_ns > query.to_ns {
            return Err(SpanError {
                key: "from".to_owned(),
                found: parameters.chars().take(64).collect(),
                allowed: "before to",
            });
        }
        Ok(query)
    }
}

impl fmt::Display for SpanQuery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.from_ns > i64::MIN {
            write!(f, "from={};", seconds(self.from_ns))?;
        }
        if self.to_ns < i64::MAX {
            write!(f, "to={};", seconds(self.to_ns))?;
        }
        write!(f, "points={};kind={}", self.points, self.kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: the end of a span was rounded up to the start of the next span. Both
    /// replies then contained the first point of the next span.
    #[test]
    fn a_query_is_read_back_to_the_nanosecond() {
        let at_ns = 1_671_532_441_000_000_000;
        for (from_ns, to_ns) in [
            (-1, at_ns - 1),
            (-1_500_000_000, 0),
            (at_ns, at_ns + 7),
            (i64::MIN + 1, i64::MAX - 1),
        ] {
            let query = SpanQuery {
                from_ns,
                to_ns,
                ..SpanQuery::default()
            };
            assert_eq!(
                query.to_string().parse::<SpanQuery>(),
                Ok(query.clone()),
                "{query}"
            );
        }
        assert_eq!(time_ns("1e9"), Some(1_000_000_000_000_000_000));
        for out_of_range in ["1e10", "-1e300", "inf", "99999999999999"] {
            assert_eq!(time_ns(out_of_range), None, "{out_of_range}");
        }
        assert_eq!(
            (time_ns("-0.25"), time_ns("0.0000000019")),
            (Some(-250_000_000), Some(1))
        );
    }

    #[test]
    fn written_query_is_parsed_back() {
        let query = SpanQuery {
            from_ns: 1_500_000_000,
            to_ns: 86_400_000_000_000,
            points: 7,
            kind: "noise".to_owned(),
        };
        assert_eq!(query.to_string().parse(), Ok(query));
        assert_eq!(
            SpanQuery::default().to_string().parse(),
            Ok(SpanQuery::default())
        );
        assert_eq!("".parse(), Ok(SpanQuery::default()));
    }

    #[test]
    fn times_are_seconds_or_dates() {
        let noon = Some(1_709_208_000_000_000_000);
        for text in [
            "1709208000",
            "2024-02-29T12:00:00Z",
            "2024-02-29 12:00:00",
            "2024-02-29T13:00+01",
            "2024-02-29T13:00:00 01:00",
        ] {
            assert_eq!(time_ns(text), noon, "{text}");
        }
        let query: SpanQuery = "from=2024-02-29T12:00:00Z;to=2024-03-01".parse().unwrap();
        assert_eq!(
            (Some(query.from_ns), query.to_ns),
            (noon, 1_709_251_200_000_000_000)
        );
        assert_eq!(time_ns("9999-12-30"), None, "beyond what ns can count");
    }

    #[test]
    fn invalid_span_is_rejected_with_the_allowed_form() {
        for (text, key) in [
            ("from=yesterday", "from"),
            ("to=NaN", "to"),
            ("points=0", "points"),
            ("points=20001", "points"),
            ("from=2;to=1", "from"),
            ("from=2026-13-01", "from"),
            ("form=2", "form"),
        ] {
            assert_eq!(text.parse::<SpanQuery>().unwrap_err().key, key, "{text}");
        }
        assert!(
            "_time=[now(-1h)..]".parse::<SpanQuery>().is_ok(),
            "a parameter of Zenoh itself"
        );
        let error = "since=2".parse::<SpanQuery>().unwrap_err();
        let told = "query parameter since is \"2\", must be omitted: a query supports only from, \
            to, points and kind";
        assert_eq!(error.to_string(), told);
        let error = "points=many".parse::<SpanQuery>().unwrap_err();
        assert_eq!(
            error.to_string(),
            "query parameter points is \"many\", must be a whole number from 1 to 20000"
        );
    }
}
