//! Seeds of a validation.

use std::str::FromStr;

/// Maximum number of seeds of one validation.
const MOST: u64 = 1000;

/// An inclusive range of seeds, written `4..8`. A single number `N` means `1..N`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seeds {
    first: u64,
    last: u64,
}

impl Seeds {
    /// Returns the seeds in ascending order.
    pub fn iter(self) -> impl Iterator<Item = u64> {
        self.first..=self.last
    }
}

/// Error when a text is not a valid range of seeds.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SeedsError {
    /// The text is neither a number nor two numbers separated by two full stops.
    #[error(
        "invalid range of seeds `{found}`, must be a number such as 5 (seeds 1 to 5) or a range \
         such as 4..8"
    )]
    Form {
        /// Invalid text.
        found: String,
    },
    /// The range does not contain any seed.
    #[error("the range {first}..{last} is empty, its second number must be at least its first")]
    Empty {
        /// First seed.
        first: u64,
        /// Last seed.
        last: u64,
    },
    /// The range contains too many seeds.
    #[error("{count} seeds are too many, at most {MOST}")]
    TooMany {
        /// Number of seeds.
        count: u64,
    },
}

impl FromStr for Seeds {
    type Err = SeedsError;

    fn from_str(text: &str) -> Result<Self, SeedsError> {
        let form = || SeedsError::Form {
            found: text.to_owned(),
        };
        let number = |text: &str| text.parse::<u64>().map_err(|_| form());
        let (first, last) = match text.split_once("..") {
            Some((first, last)) => (number(first)?, number(last)?),
            None => (1, number(text)?),
        };
        match last.checked_sub(first) {
            None => Err(SeedsError::Empty { first, last }),
            Some(more) if more >= MOST => Err(SeedsError::TooMany {
                count: more.saturating_add(1),
            }),
            Some(_) => Ok(Self { first, last }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Vec<u64> {
        text.parse::<Seeds>().unwrap().iter().collect()
    }

    #[test]
    fn a_range_includes_both_ends() {
        assert_eq!(parsed("4..8"), [4, 5, 6, 7, 8]);
        assert_eq!(parsed("17..17"), [17]);
        assert_eq!(parsed("0..1"), [0, 1]);
    }

    #[test]
    fn number_means_the_seeds_from_one() {
        assert_eq!(parsed("3"), [1, 2, 3]);
    }

    #[test]
    fn error_names_the_allowed_forms_of_seeds() {
        for (text, part) in [
            ("8..4", "the range 8..4 is empty"),
            ("0", "the range 1..0 is empty"),
            ("4..=8", "must be a number such as 5"),
            ("..8", "must be a number such as 5"),
            ("five", "`five`"),
            ("-1", "`-1`"),
            ("1001", "1001 seeds are too many, at most 1000"),
            ("0..18446744073709551615", "too many"),
        ] {
            let message = text.parse::<Seeds>().unwrap_err().to_string();
            assert!(message.contains(part), "{text}: {message}");
        }
    }
}
