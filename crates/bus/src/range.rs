//! The parameters of a query for missing items: `?after=SEQUENCE;limit=ITEMS;epoch=EPOCH`.

use std::fmt;
use std::str::FromStr;

/// Items per answer when the query names none.
const DEFAULT_LIMIT: u64 = 1000;

/// Which items are asked for.
///
/// `after` counts: the asker has the first `after` items of the epoch, so the answer starts with item number `after`,
/// or with the oldest one still held if that is later. If the answerer is in another epoch, it answers with its oldest.
///
/// ```
/// use spandrel_bus::QueryRange;
/// let range: QueryRange = "after=128;limit=10".parse()?;
/// assert_eq!((range.after, range.limit, range.epoch), (128, 10, None));
/// # Ok::<(), spandrel_bus::RangeError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueryRange {
    /// Number of items the asker has: number of the first one wanted. Missing means 0.
    pub after: u64,
    /// Most items wanted in the answer; the answerer may give fewer. Missing means 1000.
    pub limit: u64,
    /// The epoch in which the asker counts; none if it has seen none yet.
    pub epoch: Option<u64>,
}

/// A query parameter that is no number.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("query parameter {key} is {found:?}, must be a whole number")]
pub struct RangeError {
    /// The parameter.
    pub key: &'static str,
    /// Its value.
    pub found: String,
}

impl FromStr for QueryRange {
    type Err = RangeError;

    fn from_str(parameters: &str) -> Result<Self, RangeError> {
        let number = |key: &'static str| {
            let value = parameters
                .split(';')
                .filter_map(|pair| pair.split_once('='))
                .find_map(|(k, value)| (k == key).then_some(value));
            let parse = |text: &str| {
                text.parse().map_err(|_| RangeError {
                    key,
                    found: text.chars().take(32).collect(),
                })
            };
            value.map(parse).transpose()
        };
        Ok(Self {
            after: number("after")?.unwrap_or(0),
            limit: number("limit")?.unwrap_or(DEFAULT_LIMIT),
            epoch: number("epoch")?,
        })
    }
}

impl fmt::Display for QueryRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "after={};limit={}", self.after, self.limit)?;
        match self.epoch {
            Some(epoch) => write!(f, ";epoch={epoch}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        for epoch in [None, Some(u64::MAX)] {
            let range = QueryRange {
                after: 7,
                limit: 9,
                epoch,
            };
            assert_eq!(range.to_string().parse(), Ok(range));
        }
    }

    #[test]
    fn nothing_asked_is_the_first_thousand() {
        let range: QueryRange = "".parse().unwrap();
        assert_eq!((range.after, range.limit, range.epoch), (0, 1000, None));
    }

    #[test]
    fn what_is_no_number_is_named() {
        let error = "after=-1".parse::<QueryRange>().unwrap_err();
        assert_eq!(error.key, "after");
        assert!(error.to_string().contains("\"-1\""));
    }
}
