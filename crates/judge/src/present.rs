//! The change of a quantity on the latest days, against its commissioning.

use serde::{Deserialize, Serialize};

/// Number of the latest judged days whose mean is the present change. A change that grows is stated
/// as it was half of this time ago.
const LATEST_DAYS: usize = 30;

/// Change of one judged day.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct DayChange {
    pub(crate) day: i64,
    /// Change of ln(value) under the mean conditions of the commissioning.
    pub(crate) size: f64,
    /// Variance that the day has for itself.
    pub(crate) variance: f64,
    /// Variance of the effect of the conditions of the day, which successive days share.
    pub(crate) ignorance: f64,
    /// Share with which the day counts: none in the frost zone.
    pub(crate) share: f64,
}

/// Changes of the latest judged days, the oldest first.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct LatestChanges {
    days: Vec<DayChange>,
}

/// Mean of the changes of some days.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MeanChange {
    /// Change of ln(value).
    pub(crate) size: f64,
    /// Variance of the size, without that of the reference and of the deviation u.
    pub(crate) variance: f64,
    /// Number of days from the first to the last one.
    pub(crate) days: i64,
}

impl LatestChanges {
    pub(crate) fn add(&mut self, change: DayChange) {
        if self.days.len() == LATEST_DAYS {
            self.days.remove(0);
        }
        self.days.push(change);
    }

    /// Returns the weighted mean of the days since a day, or `None` if none of them counts.
    pub(crate) fn since(&self, day: i64) -> Option<MeanChange> {
        let first = self.days.partition_point(|change| change.day < day);
        let days = &self.days[first..];
        let weight = |change: &DayChange| change.share / change.variance;
        let sum = |of: fn(&DayChange) -> f64| -> f64 {
            days.iter().map(|change| weight(change) * of(change)).sum()
        };
        let weights = sum(|_| 1.0);
        if weights <= 0.0 {
            return None;
        }
        // Σ w² v = Σ w share
        let alone = sum(|change| change.share) / (weights * weights);
        Some(MeanChange {
            size: sum(|change| change.size) / weights,
            variance: alone + sum(|change| change.ignorance) / weights,
            days: days.last()?.day - days.first()?.day + 1,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn changes(count: i64) -> LatestChanges {
        let mut changes = LatestChanges::default();
        for day in 0..count {
            changes.add(DayChange {
                day,
                size: day as f64,
                variance: 4.0,
                ignorance: 0.5,
                share: 1.0,
            });
        }
        changes
    }

    #[test]
    fn only_the_latest_days_since_a_day_count() {
        let mean = changes(100).since(0).unwrap();
        assert_eq!((mean.size, mean.days), (84.5, 30)); // days 70 to 99
        let mean = changes(100).since(98).unwrap();
        assert_eq!((mean.size, mean.days), (98.5, 2));
        assert_eq!(mean.variance, 4.0 / 2.0 + 0.5);
        assert_eq!(changes(100).since(100), None);
    }

    #[test]
    fn days_in_the_frost_zone_do_not_count() {
        let mut changes = changes(2);
        changes.add(DayChange {
            day: 2,
            size: 1000.0,
            variance: 4.0,
            ignorance: 0.5,
            share: 0.0,
        });
        assert_eq!(changes.since(0).unwrap().size, 0.5);
        assert_eq!(changes.since(2), None);
    }
}
