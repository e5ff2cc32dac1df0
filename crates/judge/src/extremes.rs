//! The range of a condition that has been learnt.

use serde::{Deserialize, Serialize};

/// Number of learnt days that make a value known.
const LEARNT_DAYS: usize = 5;
/// A condition may exceed the range of the learnt days by this share of it.
const MARGIN: f32 = 0.05;

/// The lowest and highest learnt values of a condition, each in ascending order.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Extremes {
    lowest: Vec<f32>,
    highest: Vec<f32>,
}

impl Extremes {
    /// Returns `true` if fewer than five learnt days were as low, or as high.
    pub(crate) fn is_beyond(&self, value: f32) -> bool {
        let (Some(low), Some(high)) = (self.lowest.last(), self.highest.first()) else {
            return true;
        };
        let margin = MARGIN * (high - low).max(0.0);
        value < low - margin || value > high + margin
    }

    pub(crate) fn remember(&mut self, value: f32) {
        let place = self.lowest.partition_point(|known| *known <= value);
        self.lowest.insert(place, value);
        self.lowest.truncate(LEARNT_DAYS);
        let place = self.highest.partition_point(|known| *known <= value);
        self.highest.insert(place, value);
        let surplus = self.highest.len().saturating_sub(LEARNT_DAYS);
        self.highest.drain(..surplus);
    }
}
