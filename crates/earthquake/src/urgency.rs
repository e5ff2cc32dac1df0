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
    /// Largest acceleration of the structure (m/s²), or 0 if it is unknown.
    pub peak_m_per_s2: f64,
}

/// Unit of the peak behind a result.
const UNIT: &str = " m/s².";
/// Words before the peak behind a result.
const PEAK: &str = " Peak ";

/// Returns the result of a report with its peak (m/s²) as the last sentence. [`peak_in`] reads it.
///
/// ```
/// use spandrel_earthquake::urgency::{peak_in, with_peak};
///
/// let result = with_peak("Strong shaking.", 5.561);
/// assert_eq!(result, "Strong shaking. Peak 5.56 m/s².");
/// assert_eq!(peak_in(&result), Some(5.56));
/// ```
#[must_use]
pub fn with_peak(headline: &str, peak_m_per_s2: f64) -> String {
    format!("{headline}{PEAK}{peak_m_per_s2:.2}{UNIT}")
}

/// Returns the peak (m/s²) behind the result of a report. `None` if it has none.
#[must_use]
pub fn peak_in(result: &str) -> Option<f64> {
    let (_, peak) = result.strip_suffix(UNIT)?.rsplit_once(PEAK)?;
    peak.parse().ok()
}

/// Returns the position of the report that ranks a structure, in `newest_first`. `None` if no
/// report is of the two days before `until_s`.
///
/// It is the most urgent report of these two days. Of equally urgent ones, it is the one with the
/// largest acceleration, and then the newest. A weak aftershock must not hide the main shock.
#[must_use]
pub fn ranking(newest_first: &[Dated], until_s: f64) -> Option<usize> {
    let all = newest_first.iter().enumerate();
    let recent = all.filter(|(_, report)| until_s - report.time_s <= RANKS_FOR_S);
    // The first of equal reports is the minimum.
    let most_urgent = recent.min_by(|(_, a), (_, b)| {
        let by_rank = a.rank.cmp(&b.rank);
        by_rank.then(b.peak_m_per_s2.total_cmp(&a.peak_m_per_s2))
    });
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
            peak_m_per_s2: 1.0,
        }
    }

    #[test]
    fn a_weak_aftershock_does_not_hide_an_equally_urgent_main_shock() {
        let aftershock = Dated {
            peak_m_per_s2: 0.46,
            ..at(1.1, Urgency::Inspect)
        };
        let main_shock = Dated {
            peak_m_per_s2: 5.56,
            ..at(1.0, Urgency::Inspect)
        };
        assert_eq!(ranking(&[aftershock, main_shock], DAY_S * 1.2), Some(1));
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
