//! The present scatter of the residuals, relative to that of the commissioning.
//!
//! A sensor that ages, or a weaker excitation, can scatter a quantity more than its commissioning
//! did. The evidence and the guard would then read the scatter as a change. The scale σ is
//! therefore estimated again from the differences of successive residuals, Δz, which a lasting
//! change does not move:
//!
//! - s = median |Δz| over the latest days / median |Δz| in the commissioning
//! - r² = 1 + max(0, s² − 1.3²): the scatter beyond what chance gives

use serde::{Deserialize, Serialize};

/// Number of the latest judged days that give the present scatter.
const DAYS: usize = 40;
/// Smallest number of differences from which a scatter follows.
const FEWEST: usize = 10;
/// Ratio of scatters that chance gives. The standard error of a median of 40 is 0.2.
const CHANCE: f64 = 1.3;

/// Differences of the residuals of the latest judged days.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Spread {
    /// Median |Δz| in the commissioning.
    usual: f64,
    /// |Δz| of the latest judged days, the oldest first.
    latest: Vec<f64>,
    /// Whether the commissioning contains all seasons. Other seasons can have another scatter.
    has_seasons: bool,
    /// Residual of the last judged day, in standard deviations of the commissioning.
    last: Option<f64>,
}

impl Spread {
    /// Starts after a commissioning with these residuals z, in the order of the days.
    pub(crate) fn new(residuals: &[f64], has_seasons: bool) -> Self {
        let differences = residuals.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        Self {
            usual: median(differences.collect()).unwrap_or(1.0),
            latest: Vec::with_capacity(DAYS),
            has_seasons,
            last: None,
        }
    }

    /// Adds the residual of a judged day, in standard deviations of the commissioning.
    pub(crate) fn add(&mut self, z: f64) {
        if let Some(last) = self.last.replace(z) {
            if self.latest.len() == DAYS {
                self.latest.remove(0);
            }
            self.latest.push((z - last).abs());
        }
    }

    /// Returns r, at least 1: the factor by which the scatter has become larger. It is 1 after a
    /// commissioning without all seasons.
    pub(crate) fn ratio(&self) -> f64 {
        // Without a usual scatter, there is nothing to compare with.
        if !self.has_seasons || self.usual == 0.0 || self.latest.len() < FEWEST {
            return 1.0;
        }
        let s = median(self.latest.clone()).unwrap_or(0.0) / self.usual;
        (1.0 + (s * s - CHANCE * CHANCE).max(0.0)).sqrt()
    }
}

/// Returns the upper median, or `None` without values.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOUND: [f64; 8] = [0.5, -1.0, 0.2, 1.1, -0.4, 0.9, -1.3, 0.1];

    fn ratio(z: impl Fn(usize) -> f64) -> f64 {
        let mut spread = Spread::new(&SOUND, true);
        (0..60).for_each(|day| spread.add(z(day)));
        spread.ratio()
    }

    #[test]
    fn residuals_that_never_differed_give_no_ratio() {
        let mut spread = Spread::new(&[0.0; 400], true);
        (0..60).for_each(|day| spread.add(SOUND[day % SOUND.len()]));
        assert_eq!(spread.ratio(), 1.0);
    }

    #[test]
    fn scatter_counts_and_a_lasting_change_does_not() {
        let sound = |day: usize| SOUND[day % SOUND.len()];
        assert_eq!(ratio(sound), 1.0);
        assert_eq!(
            ratio(|day| sound(day) - if day < 55 { 0.0 } else { 8.0 }),
            1.0
        );
        assert_eq!(ratio(|day| sound(day) - 0.05 * day as f64), 1.0);
        let three = ratio(|day| 3.0 * sound(day));
        assert!((three * three - (1.0 + 9.0 - 1.69)).abs() < 1e-9, "{three}");
    }
}
