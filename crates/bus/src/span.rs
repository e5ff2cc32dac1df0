//! The parameters of a query for what was: `?from=SECONDS;to=SECONDS;points=COUNT;kind=KIND`.

use std::fmt;
use std::str::FromStr;

/// Points of an answer when the query names none.
const DEFAULT_POINTS: usize = 1_000;
/// Most points of an answer.
const MOST_POINTS: usize = 20_000;

/// Which span of time is asked for, in how many points.
///
/// ```
/// use spandrel_bus::SpanQuery;
/// let query: SpanQuery = "from=1763730000;points=100".parse()?;
/// assert_eq!((query.from_ns, query.to_ns, query.points), (1_763_730_000_000_000_000, i64::MAX, 100));
/// assert_eq!(query.kind, "parameter");
/// # Ok::<(), spandrel_bus::SpanError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpanQuery {
    /// First time, ns since the Unix epoch, UTC. Missing means from the first one kept.
    pub from_ns: i64,
    /// Last time. Missing means up to now.
    pub to_ns: i64,
    /// Most points wanted, 1 to 20,000. Missing means 1,000.
    pub points: usize,
    /// What kind of quantity is asked for. Missing means `parameter`.
    pub kind: String,
}

/// A query parameter that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("query parameter {key} is {found:?}, must be {allowed}")]
pub struct SpanError {
    /// The parameter.
    pub key: &'static str,
    /// Its value.
    pub found: String,
    /// What it may be.
    pub allowed: &'static str,
}

impl Default for SpanQuery {
    fn default() -> Self {
        Self { from_ns: i64::MIN, to_ns: i64::MAX, points: DEFAULT_POINTS, kind: "parameter".to_owned() }
    }
}

impl FromStr for SpanQuery {
    type Err = SpanError;

    fn from_str(parameters: &str) -> Result<Self, SpanError> {
        let mut query = Self::default();
        for (key, value) in parameters.split(';').filter_map(|pair| pair.split_once('=')) {
            let refused = |key, allowed| SpanError { key, found: value.chars().take(32).collect(), allowed };
            let seconds = |key| match value.parse::<f64>() {
                // a cast of what no i64 holds stops at its ends
                Ok(seconds) if !seconds.is_nan() => Ok((seconds * 1e9) as i64),
                Ok(_) | Err(_) => Err(refused(key, "seconds since 1970, UTC")),
            };
            match key {
                "from" => query.from_ns = seconds("from")?,
                "to" => query.to_ns = seconds("to")?,
                "points" => match value.parse() {
                    Ok(points) if (1..=MOST_POINTS).contains(&points) => query.points = points,
                    Ok(_) | Err(_) => return Err(refused("points", "a whole number from 1 to 20000")),
                },
                "kind" if value.len() <= 64 => value.clone_into(&mut query.kind),
                "kind" => return Err(refused("kind", "a word")),
                _ => {} // of a later version, or of Zenoh itself
            }
        }
        if query.from_ns > query.to_ns {
            return Err(SpanError { key: "from", found: parameters.chars().take(64).collect(), allowed: "before to" });
        }
        Ok(query)
    }
}

impl fmt::Display for SpanQuery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.from_ns > i64::MIN {
            write!(f, "from={};", self.from_ns as f64 / 1e9)?;
        }
        if self.to_ns < i64::MAX {
            write!(f, "to={};", self.to_ns as f64 / 1e9)?;
        }
        write!(f, "points={};kind={}", self.points, self.kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        let query =
            SpanQuery { from_ns: 1_500_000_000, to_ns: 86_400_000_000_000, points: 7, kind: "noise".to_owned() };
        assert_eq!(query.to_string().parse(), Ok(query));
        assert_eq!(SpanQuery::default().to_string().parse(), Ok(SpanQuery::default()));
        assert_eq!("".parse(), Ok(SpanQuery::default()));
    }

    #[test]
    fn what_is_no_span_is_refused_with_what_is_one() {
        for (text, key) in [
            ("from=yesterday", "from"),
            ("to=NaN", "to"),
            ("points=0", "points"),
            ("points=20001", "points"),
            ("from=2;to=1", "from"),
        ] {
            assert_eq!(text.parse::<SpanQuery>().unwrap_err().key, key, "{text}");
        }
        let error = "points=many".parse::<SpanQuery>().unwrap_err();
        assert_eq!(error.to_string(), "query parameter points is \"many\", must be a whole number from 1 to 20000");
    }
}
