//! Removes the correlation between days.
//!
//! The deviation of a day from the model follows u(t) = φ^Δt u(t − Δt) + √(1 − φ^(2Δt)) e(t), with
//! u and e of the same variance. The differences y(t) − φ^Δt y(t − Δt), divided by that root, then
//! have independent errors. Regression on them is generalised least squares. It replaces the
//! correction n(1 − φ)/(1 + φ) of the sample size, which it contains for a constant regressor.

use nalgebra::DVector;

/// A row of the whitened regression.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Row {
    /// Regressors, with their own unit.
    pub(crate) x: DVector<f64>,
    /// ln(value).
    pub(crate) y: f64,
}

/// Correlation φ^Δt of two days, and the root that normalises their difference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Step {
    /// φ^Δt.
    pub(crate) factor: f64,
    /// √(1 − φ^(2Δt)).
    pub(crate) root: f64,
}

impl Step {
    /// The step to a day without a predecessor.
    pub(crate) const FIRST: Self = Self {
        factor: 0.0,
        root: 1.0,
    };

    /// Returns the step over a number of days, at least 1.
    pub(crate) fn over(phi: f64, days: i64) -> Self {
        let factor = phi.powf(days.max(1) as f64);
        Self {
            factor,
            root: (1.0 - factor * factor).sqrt(),
        }
    }

    /// Whitens a row with its predecessor.
    pub(crate) fn whiten(self, row: &Row, previous: &Row) -> Row {
        Row {
            x: (&row.x - &previous.x * self.factor) / self.root,
            y: (row.y - self.factor * previous.y) / self.root,
        }
    }

    /// Whitened value of a unit step on the first day of the step.
    pub(crate) fn onset(self) -> f64 {
        1.0 / self.root
    }

    /// Whitened value of a unit step on every later day.
    pub(crate) fn later(self) -> f64 {
        (1.0 - self.factor) / self.root
    }
}
