//! The change of a quantity on the latest days, against its commissioning.

use serde::{Deserialize, Serialize};

/// Number of the latest judged days whose mean is the present change. A change that grows slowly is
/// stated as it was half of this time ago.
const LATEST_DAYS: usize = 30;
/// Number of the latest judged days that replace them after a sudden further change.
const SUDDEN_DAYS: usize = 5;
/// Quantile of the normal distribution that the difference of both means must exceed for this.
const SUDDEN_QUANTILE: f64 = 3.0;

/// Smallest number of days on each side of a fall.
const SPLIT_DAYS: usize = 3;

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
    /// Variance of the size that the days have for themselves.
    alone: f64,
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

    /// Returns the last judged day.
    pub(crate) fn last_day(&self) -> Option<i64> {
        self.days.last().map(|change| change.day)
    }

    /// Returns `true` if a day was judged, and at least half of its evidence counts.
    pub(crate) fn has_evidence_on(&self, day: i64) -> bool {
        let last = self.days.last();
        last.is_some_and(|change| change.day == day && change.share >= 0.5)
    }

    /// Returns the mean change of the latest days before a day, or `None` if there are too few.
    pub(crate) fn before(&self, day: i64) -> Option<f64> {
        let first = self.days.partition_point(|change| change.day < day);
        let days = &self.days[..first];
        let shares: f64 = days.iter().map(|change| change.share).sum();
        let mean = mean(days).filter(|_| shares >= SPLIT_DAYS as f64)?;
        Some(mean.size)
    }

    /// Returns the most likely day of a fall since a day: the split with the largest likelihood
    /// ratio, with some days on both sides.
    pub(crate) fn fall_day(&self, since_day: i64) -> Option<i64> {
        let first = self.days.partition_point(|change| change.day < since_day);
        let days = &self.days[first..];
        let splits = SPLIT_DAYS..(days.len() + 1).saturating_sub(SPLIT_DAYS);
        let falls = splits.filter_map(|split| {
            let [before, after] = [mean(&days[..split])?, mean(&days[split..])?];
            let fall = before.size - after.size;
            let ratio = fall * fall / (before.alone + after.alone);
            (fall > 0.0).then_some((ratio, days[split].day))
        });
        let best = falls.max_by(|a, b| a.0.total_cmp(&b.0));
        best.map(|(_, day)| day)
    }

    /// Returns the weighted mean of the days since a day, or `None` if none of them counts.
    ///
    /// If the latest few days certainly differ from it, they alone are the present.
    pub(crate) fn since(&self, day: i64) -> Option<MeanChange> {
        let first = self.days.partition_point(|change| change.day < day);
        let days = &self.days[first..];
        let all = mean(days)?;
        let sudden = mean(&days[days.len().saturating_sub(SUDDEN_DAYS)..]);
        Some(match sudden {
            Some(sudden)
                if (sudden.size - all.size).abs() > SUDDEN_QUANTILE * sudden.alone.sqrt() =>
            {
                sudden
            }
            _ => all,
        })
    }
}

/// Returns the weighted mean of some days.
fn mean(days: &[DayChange]) -> Option<MeanChange> {
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
        alone,
        variance: alone + sum(|change| change.ignorance) / weights,
        days: days.last()?.day - days.first()?.day + 1,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Changes of this size on each day.
    fn changes(count: i64, size: impl Fn(i64) -> f64) -> LatestChanges {
        let mut changes = LatestChanges::default();
        for day in 0..count {
            changes.add(DayChange {
                day,
                size: size(day),
                variance: 4.0,
                ignorance: 0.5,
                share: 1.0,
            });
        }
        changes
    }

    #[test]
    fn only_the_latest_days_since_a_day_count() {
        let changes = changes(100, |day| 0.01 * day as f64);
        let mean = changes.since(0).unwrap();
        assert_eq!(mean.days, 30); // days 70 to 99
        assert!((mean.size - 0.845).abs() < 1e-12);
        let mean = changes.since(98).unwrap();
        assert!((mean.size - 0.985).abs() < 1e-12);
        assert_eq!((mean.variance, mean.days), (4.0 / 2.0 + 0.5, 2));
        assert_eq!(changes.since(100), None);
    }

    #[test]
    fn a_sudden_change_is_stated_after_five_days() {
        let changed = |days: i64| changes(60 + days, |day| if day < 60 { 0.0 } else { 10.0 });
        assert_eq!(changed(5).since(0).unwrap().size, 10.0);
        assert_eq!(changed(1).since(0).unwrap().days, 30);
    }

    #[test]
    fn days_in_the_frost_zone_do_not_count() {
        let mut changes = changes(2, |day| day as f64);
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
