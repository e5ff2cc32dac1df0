//! How soon a structure needs an inspector, and which of its reports says so.

use serde::Serialize;

/// How soon an inspector is needed, the most urgent first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Urgency {
    /// A lasting loss is raised, or the structure softened more than predicted from its earlier
    /// events.
    InspectFirst,
    /// The structure softened, and whether it recovered is not judged. Or a lasting loss is
    /// probable, the stiffness in weak motion is not as predicted, or an alert is raised.
    Inspect,
    /// Strong shaking without a sign of lasting loss, or a sensor in doubt.
    Watch,
    /// Weak motion without a sign of change, or weak motion from which nothing can be judged.
    NoAction,
}

impl Urgency {
    const ALL: [Self; 4] = [
        Self::InspectFirst,
        Self::Inspect,
        Self::Watch,
        Self::NoAction,
    ];

    /// Returns the urgency with these words. `None` if there is none.
    #[must_use]
    pub fn of_words(words: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|one| one.words() == words)
    }

    /// Returns the words for people.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::InspectFirst => "inspect first",
            Self::Inspect => "inspect",
            Self::Watch => "watch",
            Self::NoAction => "no action",
        }
    }

    /// Returns the rank, from 1 for the most urgent.
    #[must_use]
    pub fn rank(self) -> u8 {
        match self {
            Self::InspectFirst => 1,
            Self::Inspect => 2,
            Self::Watch => 3,
            Self::NoAction => 4,
        }
    }
}

/// Time for which a report ranks its structure, s. The last usual report of an earthquake follows
/// after a day.
const RANKS_FOR_S: f64 = 2.0 * 86_400.0;

/// Time and urgency of a report, from which [`ranking`] selects the report that ranks a structure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dated {
    /// Time of the report (s). All reports must use the same origin.
    pub time_s: f64,
    /// Rank of the urgency of the report, from 1 for the most urgent.
    pub rank: u8,
}

/// Returns the position of the report that ranks a structure, in `newest_first`. `None` if no report
/// is of the two days before `until_s`.
///
/// It is the most urgent report of these two days, and the newest of equal ones. A weak aftershock
/// needs no action by itself, which must not hide that an inspector is needed.
#[must_use]
pub fn ranking(newest_first: &[Dated], until_s: f64) -> Option<usize> {
    let all = newest_first.iter().enumerate();
    let recent = all.filter(|(_, report)| until_s - report.time_s <= RANKS_FOR_S);
    // The first of equal reports is the minimum.
    let most_urgent = recent.min_by_key(|(_, report)| report.rank);
    most_urgent.map(|(position, _)| position)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY_S: f64 = 86_400.0;

    fn at(day: f64, urgency: Urgency) -> Dated {
        Dated {
            time_s: day * DAY_S,
            rank: urgency.rank(),
        }
    }

    #[test]
    fn the_most_urgent_report_of_two_days_ranks_a_structure_and_then_the_newest() {
        let reports = [
            at(3.5, Urgency::NoAction),
            at(3.0, Urgency::Inspect),
            at(2.0, Urgency::Inspect),
            at(1.0, Urgency::InspectFirst),
        ];
        assert_eq!(ranking(&reports, 3.5 * DAY_S), Some(1));
        assert_eq!(ranking(&reports, 3.0 * DAY_S), Some(3), "two days exactly");
        assert_eq!(ranking(&reports, 5.25 * DAY_S), Some(0));
        assert_eq!(ranking(&reports, 6.0 * DAY_S), None);
    }

    #[test]
    fn words_name_their_urgency() {
        for urgency in Urgency::ALL {
            assert_eq!(Urgency::of_words(urgency.words()), Some(urgency));
        }
        assert_eq!(Urgency::of_words("soon"), None);
    }
}
