//! Watches a condition: a thermometer that is frozen or missing gives no statement.

use serde::{Deserialize, Serialize};

/// A condition that keeps exactly the same value this long (s) is frozen,
const FROZEN_S: f64 = 86_400.0;
/// and over at least this many epochs. A series with one value a day may repeat one by chance.
const FROZEN_EPOCHS: u32 = 8;

/// The last value of a condition and since when it has not changed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ConditionWatch {
    last: Option<(f64, f64)>,
    epochs: u32,
}

impl ConditionWatch {
    /// Takes a value (scale of the model) and returns `true` if the condition is frozen.
    pub(crate) fn is_frozen(&mut self, time_s: f64, value: f64) -> bool {
        match self.last {
            Some((since_s, last)) if last.to_bits() == value.to_bits() => {
                self.epochs = self.epochs.saturating_add(1);
                time_s - since_s >= FROZEN_S && self.epochs >= FROZEN_EPOCHS
            }
            _ => {
                self.last = Some((time_s, value));
                self.epochs = 1;
                false
            }
        }
    }
}
