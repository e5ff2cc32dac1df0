//! Cumulant generating function of the residuals.
//!
//! An e-detector needs increments L with E[L | past] ≤ 1 while the structure is sound. The
//! increment exp(g z − κ(g)) meets this if κ(g) ≥ ln E[exp(g z)]. κ(g) is the larger of two values:
//! g²/2, which is that of a normal residual, and that of the clipped residuals of the
//! commissioning. The latter are mirrored, because their sign carries no information.
//!
//! Source: Shin, Ramdas & Rinaldo (2024), New England Journal of Statistics in Data Science,
//! on e-detectors; κ takes the place of their ψ.

use serde::{Deserialize, Serialize};

/// Residuals are clipped at ± this, so that one day cannot decide.
pub(crate) const CLIP: f64 = 2.5;
/// Largest |g|. The increment of one day is then at most e^2.6.
pub(crate) const LARGEST_SHIFT: f64 = 1.5;
/// Distance between the entries of the table.
const SPACING: f64 = 0.1;
/// Largest g of the table.
const LARGEST: f64 = LARGEST_SHIFT + 0.1;

/// The function κ(g), tabulated for |g| up to the largest shift.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Cumulant {
    table: Vec<f64>,
}

impl Cumulant {
    /// Tabulates κ for residuals in units of σ.
    pub(crate) fn new(residuals: &[f64]) -> Self {
        let entries = (LARGEST / SPACING).round() as usize;
        let n = residuals.len().max(1) as f64;
        let of = |g: f64| {
            let terms = residuals.iter().map(|z| (g * z.clamp(-CLIP, CLIP)).cosh());
            (terms.sum::<f64>() / n).ln().max(0.5 * g * g)
        };
        Self {
            table: (0..=entries)
                .map(|entry| of(entry as f64 * SPACING))
                .collect(),
        }
    }

    /// Returns κ(g). The function is even.
    pub(crate) fn at(&self, g: f64) -> f64 {
        let g = g.abs();
        let place = g / SPACING;
        let entry = place.floor() as usize;
        match (self.table.get(entry), self.table.get(entry + 1)) {
            // A chord of a convex function lies above it.
            (Some(low), Some(high)) => low + (place - entry as f64) * (high - low),
            _ => 0.5 * g * g,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_increments_have_a_mean_of_at_most_one() {
        let residuals = [-1.4, -0.6, -0.1, 0.2, 0.5, 1.3];
        let cumulant = Cumulant::new(&residuals);
        for g in [0.05, 0.5, 1.0, 1.33, 1.97, 2.0] {
            let mean = residuals
                .iter()
                .map(|z| (0.5 * ((g * z).exp() + (-g * z).exp())) / 6.0)
                .sum::<f64>();
            assert!(mean * (-cumulant.at(g)).exp() <= 1.0 + 1e-12, "g = {g}");
            assert!(cumulant.at(g) >= 0.5 * g * g - 1e-12, "g = {g}");
        }
    }
}
