//! Parameters of a query for missing items: `?after=SEQUENCE;limit=ITEMS;epoch=EPOCH`.

use std::fmt;
use std::str::FromStr;

/// Number of items per reply if the query does not specify a limit.
const DEFAULT_LIMIT: u64 = 1000;

/// The items that a query requests.
///
/// `after` is a count: the client already has the first `after` items of the epoch. The reply
/// starts with item number `after`, or with the oldest stored item if that is later. If the source
/// is in another epoch, the reply starts with its oldest item.
///
/// ```
/// use spandrel_bus::QueryRange;
/// let range: QueryRange = "after=128;limit=10".parse()?;
/// assert_eq!((range.after, range.limit, range.epoch), (128, 10, None));
/// # Ok::<(), spandrel_bus::RangeError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueryRange {
    /// Number of items that the client has, which is the number of the first requested item.
    /// Default 0.
    pub after: u64,
    /// Maximum number of items in the reply; the source may return fewer. Default 1000.
    pub limit: u64,
    /// Epoch in which the client counts. `None` if it has not received any epoch yet.
    pub epoch: Option<u64>,
}

/// A query parameter that is not a whole number.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("query parameter {key} is {found:?}, must be a whole number")]
pub struct RangeError {
    /// Name of the parameter.
    pub key: &'static str,
    /// Rejected value, cut to 32 characters.
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
    fn written_query_is_parsed_back() {
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
    fn empty_query_requests_the_first_thousand_items() {
        let range: QueryRange = "".parse().unwrap();
        assert_eq!((range.after, range.limit, range.epoch), (0, 1000, None));
    }

    #[test]
    fn error_names_a_value_that_is_not_a_number() {
        let error = "after=-1".parse::<QueryRange>().unwrap_err();
        assert_eq!(error.key, "after");
        assert!(error.to_string().contains("\"-1\""));
    }
}
