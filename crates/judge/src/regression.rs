//! Sequential Bayesian regression with priors in physical units: a dynamic linear model.
//!
//! Notation of a Kalman filter on coefficients: mean m, covariance σ² P relative to the variance of
//! a day. Source: Särkkä (2013), Bayesian Filtering and Smoothing, sections 3.2 and 4.3; West &
//! Harrison (1997), Bayesian Forecasting and Dynamic Models, chapter 4.
//!
//! - m ← F m, P ← F P Fᵀ + Q, where the level wanders, the offsets and the deviation forget (1)
//! - S = v + xᵀ P x, z = (y − xᵀ m)/(σ √S), v the variance of a day alone, relative to σ² (2)
//! - K = P x/(v/w + xᵀ P x), m ← m + K (y − xᵀ m), P ← P − K (P x)ᵀ (3)
//! - σ² = (b0 + ½ Σ w z² σ²)/(a0 + n/2) (4), the mode of an inverse gamma posterior
//!
//! w is the weight of errors with a Student t distribution (Lange, Little & Taylor 1989):
//! w = (ν + 1)/(ν + z²).

use crate::day::Day;
use crate::model::{Columns, Row, Structure};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use statrs::function::gamma::ln_gamma;

/// Shape a0 of the prior of σ²: as much as two days.
const SHAPE: f64 = 1.0;
/// Root of b0/a0: scatter of ln(frequency) between days.
const SCATTER: f64 = 0.005;
/// Number of iterations of σ².
const ITERATIONS: usize = 3;

/// Coefficients with their uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Posterior {
    /// m, one entry per regressor.
    pub(crate) mean: DVector<f64>,
    /// P: covariance of the coefficients relative to σ².
    pub(crate) covariance: DMatrix<f64>,
    /// σ: scale of the errors.
    pub(crate) sigma: f64,
}

impl Posterior {
    /// Creates the prior.
    fn new(columns: &Columns, structure: &Structure, sigma: f64) -> Self {
        let mut variance = columns.prior_variance() / (sigma * sigma);
        for forgetful in columns.forgetful(structure) {
            variance[forgetful.column] = forgetful.variance(sigma);
        }
        Self {
            mean: DVector::zeros(columns.count()),
            covariance: DMatrix::from_diagonal(&variance),
            sigma,
        }
    }

    /// Returns xᵀ m.
    pub(crate) fn expected(&self, x: &DVector<f64>) -> f64 {
        x.dot(&self.mean)
    }

    /// Returns xᵀ P x: the variance of the expected value relative to σ².
    pub(crate) fn leverage(&self, x: &DVector<f64>) -> f64 {
        x.dot(&(&self.covariance * x)).max(0.0)
    }

    /// Lets a number of days pass (1).
    pub(crate) fn evolve(&mut self, columns: &Columns, structure: &Structure, days: i64) {
        self.wander(columns, days);
        self.forget(columns, structure, days);
    }

    /// Lets the level wander for a number of days (1).
    pub(crate) fn wander(&mut self, columns: &Columns, days: i64) {
        self.covariance[(0, 0)] += columns.wander(days) / (self.sigma * self.sigma);
    }

    /// Lets the offsets and the deviation forget for a number of days (1).
    pub(crate) fn forget(&mut self, columns: &Columns, structure: &Structure, days: i64) {
        for forgetful in columns.forgetful(structure) {
            let (column, kept) = (forgetful.column, forgetful.kept(days));
            self.mean[column] *= kept;
            self.covariance.row_mut(column).scale_mut(kept);
            self.covariance.column_mut(column).scale_mut(kept);
            let fresh = (1.0 - kept * kept) * forgetful.variance(self.sigma);
            self.covariance[(column, column)] += fresh;
        }
    }

    /// Returns the gain K of a row (3), given v/w. A coefficient that does not learn has no gain.
    pub(crate) fn gain(
        &self,
        x: &DVector<f64>,
        variance: f64,
        learns: impl Fn(usize) -> bool,
    ) -> DVector<f64> {
        let c = &self.covariance * x;
        let mut gain = &c / (variance + x.dot(&c));
        for (column, gain) in gain.iter_mut().enumerate() {
            if !learns(column) {
                *gain = 0.0;
            }
        }
        gain
    }

    /// Learns one row with any gain: P ← P − K cᵀ − c Kᵀ + K S Kᵀ, c = P x, which is (3) for the
    /// best gain.
    pub(crate) fn learn_with(
        &mut self,
        gain: &DVector<f64>,
        x: &DVector<f64>,
        residual: f64,
        variance: f64,
    ) {
        let c = &self.covariance * x;
        let s = variance + x.dot(&c);
        self.mean.axpy(residual, gain, 1.0);
        self.covariance.ger(-1.0, gain, &c, 1.0);
        self.covariance.ger(-1.0, &c, gain, 1.0);
        self.covariance.ger(s, gain, gain, 1.0);
    }

    /// Learns one row, given the residual to learn and v/w. Returns the gain.
    pub(crate) fn learn(&mut self, x: &DVector<f64>, residual: f64, variance: f64) -> DVector<f64> {
        let gain = self.gain(x, variance, |_| true);
        self.learn_with(&gain, x, residual, variance);
        gain
    }
}

/// Returns the weight of an error z (in units of its standard deviation).
pub(crate) fn weight(freedom: f64, z: f64) -> f64 {
    (freedom + 1.0) / (freedom + z * z)
}

/// A series of days that is learnt in order.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Series<'d> {
    pub(crate) columns: &'d Columns,
    pub(crate) structure: &'d Structure,
    pub(crate) days: &'d [Day],
    /// Row of each day.
    pub(crate) rows: &'d [Row],
}

/// What a series has taught.
pub(crate) struct Taught {
    pub(crate) posterior: Posterior,
    /// Residuals z of the days, each predicted from the days before it.
    pub(crate) residuals: Vec<f64>,
    /// Logarithm of the evidence of the days.
    pub(crate) ln_evidence: f64,
}

impl Series<'_> {
    /// Learns the days with a given σ. `watch` sees the posterior before each day.
    pub(crate) fn learn(self, sigma: f64, mut watch: impl FnMut(usize, &Posterior)) -> Taught {
        let (columns, structure) = (self.columns, self.structure);
        let freedom = structure.freedom;
        let mut posterior = Posterior::new(columns, structure, sigma);
        let mut residuals = Vec::with_capacity(self.days.len());
        let mut ln_evidence = 0.0;
        let mut previous = None;
        for (index, (day, row)) in self.days.iter().zip(self.rows).enumerate() {
            let passed = previous.map_or(1, |previous| day.number - previous);
            posterior.evolve(columns, structure, passed);
            watch(index, &posterior);
            let variance = columns.variance(row, structure, sigma);
            let scale = sigma * (variance + posterior.leverage(&row.x)).sqrt(); // (2)
            let residual = row.y - posterior.expected(&row.x);
            let z = residual / scale;
            ln_evidence += ln_student(z, freedom) - scale.ln();
            posterior.learn(&row.x, residual, variance / weight(freedom, z));
            residuals.push(z);
            previous = Some(day.number);
        }
        Taught {
            posterior,
            residuals,
            ln_evidence,
        }
    }

    /// Learns the days, and σ from them (4). `sigma` is where the iteration begins.
    pub(crate) fn fit(self, sigma: f64) -> Taught {
        let (mut sigma, n) = (sigma, self.days.len() as f64);
        for _ in 1..ITERATIONS {
            let taught = self.learn(sigma, |_, _| ());
            let weighted = |z: &f64| weight(self.structure.freedom, *z) * z * z;
            let square: f64 = taught.residuals.iter().map(weighted).sum();
            let b = SHAPE * SCATTER * SCATTER + 0.5 * square * sigma * sigma;
            sigma = (b / (SHAPE + 0.5 * n)).sqrt(); // (4)
        }
        self.learn(sigma, |_, _| ())
    }

    /// Returns a first σ: the scatter of successive days.
    pub(crate) fn scatter(self) -> f64 {
        let squares = self
            .days
            .windows(2)
            .map(|pair| (pair[1].y - pair[0].y).powi(2));
        let mean = squares.sum::<f64>() / (2 * self.days.len().max(1)) as f64;
        mean.sqrt().max(0.01 * SCATTER)
    }
}

/// Returns the logarithm of the density of Student's t distribution.
fn ln_student(z: f64, freedom: f64) -> f64 {
    let half = 0.5 * freedom;
    ln_gamma(half + 0.5)
        - ln_gamma(half)
        - 0.5 * freedom.ln()
        - (half + 0.5) * (z * z / freedom).ln_1p()
}
