//! Maintenance of a structure, during which no notices are sent.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message, check_label, check_text};
use crate::name::Name;

/// A period of maintenance, or its early end. During the period, the notices of the structure, or
/// of one part, are muted.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Maintenance {
    /// Name of the structure.
    pub structure: Name,
    /// The part. `None` for the whole structure.
    #[serde(default)]
    pub parameter: Option<Name>,
    /// Time of this message, ns since the Unix epoch, UTC, by the clock of the sender.
    pub time_ns: i64,
    /// End of the period, ns since the Unix epoch, UTC. A time that is not after `time_ns` ends the
    /// maintenance of the same structure and part now.
    pub until_ns: i64,
    /// Name of the person; at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without control
    /// characters.
    pub who: String,
    /// The reason. It is not empty.
    pub reason: String,
}

impl Maintenance {
    /// Maximum length of a period, ns: 30 days. Muting must not last forever.
    pub const LONGEST_NS: i64 = 30 * 86_400 * 1_000_000_000;

    /// Returns `true` if this message ends maintenance.
    #[must_use]
    pub fn is_end(&self) -> bool {
        self.until_ns <= self.time_ns
    }

    /// Returns `true` if this period covers a part, or the structure itself for `None`.
    #[must_use]
    pub fn covers(&self, part: Option<&Name>) -> bool {
        self.parameter.is_none() || self.parameter.as_ref() == part
    }
}

impl Message for Maintenance {
    const TYPE: &'static str = "maintenance";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_label("who", &self.who)?;
        check_text("reason", &self.reason)?;
        if self.reason.trim().is_empty() {
            return Err(Malformed::Count {
                what: "length of the reason",
                found: 0,
                least: 1,
                most: 4096,
            });
        }
        match self.until_ns.checked_sub(self.time_ns) {
            Some(length_ns) if length_ns <= Self::LONGEST_NS => Ok(()),
            Some(_) | None => Err(Malformed::Range {
                what: "length of the maintenance in days",
                found: (self.until_ns as f64 - self.time_ns as f64) / 86.4e12,
                low: 0.0,
                high: 30.0,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY_NS: i64 = 86_400_000_000_000;

    fn maintenance(days: i64, reason: &str) -> Maintenance {
        Maintenance {
            structure: Name::new("tower").unwrap(),
            parameter: None,
            time_ns: DAY_NS,
            until_ns: DAY_NS * (1 + days),
            who: "ada".to_owned(),
            reason: reason.to_owned(),
        }
    }

    #[test]
    fn maintenance_has_a_reason_and_ends_within_thirty_days() {
        assert_eq!(maintenance(30, "new bearings").check(), Ok(()));
        let endless = maintenance(31, "new bearings").check().unwrap_err();
        assert_eq!(
            endless.to_string(),
            "length of the maintenance in days is 31, must lie between 0 and 30"
        );
        assert!(maintenance(1, " ").check().is_err());
        let overflow = Maintenance {
            time_ns: i64::MIN,
            until_ns: i64::MAX,
            ..maintenance(1, "x")
        };
        assert!(overflow.check().is_err());
    }

    #[test]
    fn maintenance_of_a_part_covers_only_this_part() {
        let name = |text: &str| Name::new(text).unwrap();
        let all = maintenance(1, "x");
        assert!(all.covers(None) && all.covers(Some(&name("deck"))) && !all.is_end());
        let deck = Maintenance {
            parameter: Some(name("deck")),
            ..maintenance(0, "done")
        };
        assert!(deck.covers(Some(&name("deck"))) && deck.is_end());
        assert!(!deck.covers(None) && !deck.covers(Some(&name("pier"))));
    }
}
