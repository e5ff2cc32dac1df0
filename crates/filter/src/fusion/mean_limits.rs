//! Limits of the parameter means of a working filter.

use crate::error::FilterError;
use nalgebra::DVector;

/// Lower and upper limits of the parameter means (N_θ each).
///
/// A node or a station with a mean outside these limits restarts from its prior.
#[derive(Debug, Clone, PartialEq)]
pub struct MeanLimits {
    /// Lower limits.
    pub lower: DVector<f64>,
    /// Upper limits.
    pub upper: DVector<f64>,
}

impl MeanLimits {
    /// Returns `true` if all means (N_θ) lie between the limits.
    pub(super) fn contain(&self, means: &DVector<f64>) -> bool {
        means
            .iter()
            .zip(self.lower.iter().zip(&self.upper))
            .all(|(mean, (lower, upper))| (lower..=upper).contains(&mean))
    }

    /// Checks the lengths of the limits; `whats` names the lower and the upper ones in errors.
    pub(super) fn check(
        &self,
        expected: usize,
        whats: [&'static str; 2],
    ) -> Result<(), FilterError> {
        let [lower, upper] = whats;
        FilterError::check_sizes([
            (lower, self.lower.len(), expected),
            (upper, self.upper.len(), expected),
        ])
    }
}
