//! Reduced forms of the state and covariance that a node sends.
//!
//! Notation: Huang & Yuen (2023), §6.3.1. `Φ` (N_d × N_m) contains the modes of the nominal model
//! with `Φᵀ M Φ = I`. The modal coordinates are `u = Φᵀ M x` and `v = Φᵀ M ẋ`, (6.11) to (6.15).
//! All nodes and the station know `Φ` and `Φᵀ M`, so they are never sent.

use super::samples::SampleExchange;
use crate::error::FilterError;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Share of missed effective mass above which the kept modes require a warning.
pub const MISSED_MASS: f64 = 0.05;

/// The kept modes of the nominal model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModalBasis {
    /// `Φ` (N_d × N_m).
    shapes: DMatrix<f64>,
    /// `Φᵀ M` (N_m × N_d).
    projection: DMatrix<f64>,
}

/// The reduction of a node's covariance, table of §6.3.1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weights {
    /// The whole covariance of the unprojected state.
    Whole,
    /// The blocks of `u`, `v` and `θ`, each as a matrix.
    Matrix,
    /// The variances of `u`, `v` and `θ`.
    Vector,
    /// One number for each block.
    Scalar,
    /// The variances of `u` and `v`, and the matrix of `θ`, as proposed in the source.
    #[default]
    Mixed,
}

impl Weights {
    /// Returns the count of numbers in the reduced covariance.
    ///
    /// `dofs` is the number of degrees of freedom, `modes` the number of kept modes.
    #[must_use]
    pub fn numbers(self, dofs: usize, modes: usize, parameters: usize) -> usize {
        let triangle = |n: usize| n * (n + 1) / 2;
        match self {
            Self::Whole => triangle(2 * dofs + parameters),
            Self::Matrix => 2 * triangle(modes) + triangle(parameters),
            Self::Vector => 2 * modes + parameters,
            Self::Scalar => 3,
            Self::Mixed => 2 * modes + triangle(parameters),
        }
    }

    /// Returns the count of numbers in a message: the reduced covariance and the estimate itself.
    #[must_use]
    pub fn message_numbers(self, dofs: usize, modes: usize, parameters: usize) -> usize {
        let estimate = match self {
            Self::Whole => 2 * dofs + parameters,
            Self::Matrix | Self::Vector | Self::Scalar | Self::Mixed => 2 * modes + parameters,
        };
        estimate + self.numbers(dofs, modes, parameters)
    }

    /// Returns the part of one covariance block (c × c) that a message keeps.
    ///
    /// A scalar weight is the mean variance, trace over dimension, so that the fused covariance has
    /// the right size.
    #[must_use]
    pub fn reduce(self, block: &DMatrix<f64>, is_parameters: bool) -> DMatrix<f64> {
        match self {
            Self::Whole | Self::Matrix => block.clone(),
            Self::Mixed if is_parameters => block.clone(),
            Self::Vector | Self::Mixed => DMatrix::from_diagonal(&block.diagonal()),
            Self::Scalar => {
                let n = block.nrows();
                DMatrix::identity(n, n) * (block.trace() / n.max(1) as f64)
            }
        }
    }
}

/// The motion of a structure in a few numbers, each with its variance.
///
/// - Modes: `u`, then `v` (2 N_m; kg^½ m, kg^½ m/s)
/// - Responses: one number for each row of [`Responses`], in its unit
/// - Samples: by instant and channel, in sensor units, NaN for a missing sample, without variances
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CompressedMotion {
    /// Means, in the order and units of [`CompressedMotion`].
    pub mean: DVector<f64>,
    /// Variances of the entries of `mean`, in their squared units, all positive. Empty for samples,
    /// because the noise of a sample is known.
    pub variance: DVector<f64>,
}

impl CompressedMotion {
    /// Returns `true` if it contains `len` finite means and `len` finite positive variances.
    pub(super) fn is_sound(&self, len: usize) -> bool {
        let finite = self
            .mean
            .iter()
            .chain(self.variance.iter())
            .all(|entry| entry.is_finite());
        let sized = self.mean.len() == len && self.variance.len() == len;
        finite && sized && self.variance.iter().all(|variance| *variance > 0.0)
    }
}

/// The responses that a node estimates best: its measured displacements, velocities or strains, and
/// their rates.
///
/// All other nodes can use them as measurements, because they are linear in the motion: `R [x, ẋ]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Responses {
    /// `R` (r × 2 N_d).
    rows: DMatrix<f64>,
}

impl Responses {
    /// Creates the responses `R [x, ẋ]` of a node from `R` (r × 2 N_d).
    #[must_use]
    pub fn new(rows: DMatrix<f64>) -> Self {
        Self { rows }
    }

    /// Returns `R` (r × 2 N_d).
    #[must_use]
    pub fn rows(&self) -> &DMatrix<f64> {
        &self.rows
    }

    /// Returns the responses with their variances, from mean (n) and covariance (n × n) of a state
    /// `[x, ẋ, …]`.
    #[must_use]
    pub fn compress(&self, mean: &DVector<f64>, covariance: &DMatrix<f64>) -> CompressedMotion {
        let moving = self.rows.ncols();
        let spread = &self.rows * covariance.view((0, 0), (moving, moving)) * self.rows.transpose();
        CompressedMotion {
            mean: &self.rows * mean.rows(0, moving),
            variance: spread
                .diagonal()
                .map(|variance| variance.max(f64::MIN_POSITIVE.sqrt())),
        }
    }
}

/// The motion data that nodes exchange through the station, which requires synchronised clocks.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum MotionExchange {
    /// No exchange.
    #[default]
    None,
    /// Motion of all nodes in the same modes, as published.
    Modes(ModalBasis),
    /// Responses of each node, in the order of the nodes.
    Responses(Vec<Responses>),
    /// A few samples of each node.
    Samples(SampleExchange),
}

impl ModalBasis {
    /// Creates a basis from mode shapes (N_d × N_m) and the mass matrix (N_d × N_d).
    ///
    /// # Errors
    /// Returns an error if the sizes do not fit, or if `Φᵀ M Φ` differs from the identity by more
    /// than 1e-8.
    pub fn new(shapes: DMatrix<f64>, mass: &DMatrix<f64>) -> Result<Self, FilterError> {
        let found = mass.nrows();
        if found != shapes.nrows() || mass.ncols() != found {
            return Err(FilterError::Dimension {
                what: "mass matrix",
                found,
                expected: shapes.nrows(),
            });
        }
        let projection = shapes.transpose() * mass;
        let modes = shapes.ncols();
        let off = (&projection * &shapes - DMatrix::identity(modes, modes)).amax();
        if off.is_nan() || off > 1e-8 {
            let what = "deviation of the modal masses from 1";
            return Err(FilterError::Setting {
                what,
                found: off,
                allowed: "at most 1e-8",
            });
        }
        Ok(Self { shapes, projection })
    }

    /// Returns the number of kept modes, `N_m`.
    #[must_use]
    pub fn modes(&self) -> usize {
        self.shapes.ncols()
    }

    /// Returns the number of degrees of freedom, `N_d`.
    #[must_use]
    pub fn dofs(&self) -> usize {
        self.shapes.nrows()
    }

    /// Returns the effective mass share of each kept mode, `(φᵀ M ι)² / ιᵀ M ι`.
    ///
    /// `influence` (N_d) is `ι`, the direction of a uniform ground motion.
    #[must_use]
    pub fn effective_mass_shares(&self, influence: &DVector<f64>, mass: &DMatrix<f64>) -> Vec<f64> {
        let total = influence.dot(&(mass * influence));
        let participation = &self.projection * influence;
        participation
            .iter()
            .map(|factor| factor * factor / total)
            .collect()
    }

    /// Compresses mean (n) and covariance (n × n) of a state `[x, ẋ, …]`, (6.11) to (6.15) and
    /// (6.18) to (6.20).
    ///
    /// All variances are at least the square root of the smallest normal number, so that they have
    /// a finite inverse.
    #[must_use]
    pub fn compress(&self, mean: &DVector<f64>, covariance: &DMatrix<f64>) -> CompressedMotion {
        let (dofs, modes) = (self.dofs(), self.modes());
        let mut motion = CompressedMotion {
            mean: DVector::zeros(2 * modes),
            variance: DVector::zeros(2 * modes),
        };
        for block in 0..2 {
            let of_block = &self.projection * mean.rows(block * dofs, dofs);
            motion
                .mean
                .rows_mut(block * modes, modes)
                .copy_from(&of_block);
            let spread = covariance.view((block * dofs, block * dofs), (dofs, dofs));
            for mode in 0..modes {
                let row = self.projection.row(mode);
                let variance = (row * spread * row.transpose())[(0, 0)];
                motion.variance[block * modes + mode] = variance.max(f64::MIN_POSITIVE.sqrt());
            }
        }
        motion
    }

    /// Returns displacements and velocities (2 N_d) of a compressed motion (2 N_m), (6.17).
    #[must_use]
    pub fn extract(&self, motion: &DVector<f64>) -> DVector<f64> {
        let (dofs, modes) = (self.dofs(), self.modes());
        let mut state = DVector::zeros(2 * dofs);
        for block in 0..2 {
            let of_block = &self.shapes * motion.rows(block * modes, modes);
            state.rows_mut(block * dofs, dofs).copy_from(&of_block);
        }
        state
    }

    /// Returns the covariance of an extracted motion (2 N_d × 2 N_d, rank 2 N_m) according to
    /// (6.21).
    #[must_use]
    pub fn extract_covariance(&self, variance: &DVector<f64>) -> DMatrix<f64> {
        let (dofs, modes) = (self.dofs(), self.modes());
        let mut covariance = DMatrix::zeros(2 * dofs, 2 * dofs);
        for block in 0..2 {
            let weights = DMatrix::from_diagonal(&variance.rows(block * modes, modes).into_owned());
            let of_block = &self.shapes * weights * self.shapes.transpose();
            covariance
                .view_mut((block * dofs, block * dofs), (dofs, dofs))
                .copy_from(&of_block);
        }
        covariance
    }
}

/// The reduction of the parameter covariance for nodes that send only parameters, §7.3.1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CovarianceScheme {
    /// The whole covariance.
    #[default]
    Full,
    /// The variances: (7.21) to (7.27), with the parameters as the basis.
    Identity,
}

impl CovarianceScheme {
    /// Returns the reduced covariance (N_θ × N_θ).
    #[must_use]
    pub fn reduce(self, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        match self {
            Self::Full => covariance.clone(),
            Self::Identity => DMatrix::from_diagonal(&covariance.diagonal()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::{Gaussian, product};

    #[test]
    fn messages_have_the_published_lengths() {
        // ch6 §4.1 to §4.3
        assert_eq!(Weights::Mixed.message_numbers(40, 5, 10), 85);
        assert_eq!(Weights::Mixed.message_numbers(49, 6, 8), 68);
        assert_eq!(Weights::Whole.message_numbers(100, 0, 10), 22_365);
        assert_eq!(Weights::Whole.numbers(100, 5, 5), 21_115);
        assert_eq!(Weights::Matrix.numbers(100, 5, 5), 45);
        assert_eq!(Weights::Mixed.numbers(100, 5, 5), 25);
        // The other schemes for the structures of §4.1 and §4.2.
        for (weights, building, bridge) in [
            (Weights::Whole, 4185, 5777),
            (Weights::Matrix, 105, 98),
            (Weights::Mixed, 85, 68),
            (Weights::Vector, 40, 40),
            (Weights::Scalar, 23, 23),
        ] {
            assert_eq!(weights.message_numbers(40, 5, 10), building, "{weights:?}");
            assert_eq!(weights.message_numbers(49, 6, 8), bridge, "{weights:?}");
        }
        // Numbers in the whole record, distributed and raw.
        assert_eq!(85 * 16 * 300, 408_000);
        assert_eq!(68 * 15 * 300, 306_000);
        assert!((408_000.0_f64 / (2.0 * 16.0 * 250.0 * 300.0) - 0.170).abs() < 1e-12);
        assert!((306_000.0_f64 / (2.0 * 15.0 * 500.0 * 300.0) - 0.068).abs() < 1e-12);
    }

    #[test]
    fn motion_in_the_span_survives_compression() {
        // Two modes of a chain of three unit masses.
        let stiffness = DMatrix::<f64>::from_row_slice(
            3,
            3,
            &[2.0, -1.0, 0.0, -1.0, 2.0, -1.0, 0.0, -1.0, 1.0],
        );
        let eigen = stiffness.symmetric_eigen();
        let frequency = |mode: usize| -> f64 { eigen.eigenvalues[mode] };
        let mut order: [usize; 3] = [0, 1, 2];
        order.sort_by(|a, b| frequency(*a).total_cmp(&frequency(*b)));
        let mass = DMatrix::identity(3, 3);
        let basis = ModalBasis::new(eigen.eigenvectors.select_columns(&order[..2]), &mass).unwrap();
        let state = basis.extract(&DVector::from_row_slice(&[0.3, -0.1, 2.0, 0.7]));
        let compressed = basis.compress(&state, &DMatrix::identity(6, 6));
        for (found, expected) in compressed.mean.iter().zip([0.3, -0.1, 2.0, 0.7]) {
            assert!((found - expected).abs() < 1e-12);
        }
        assert!(
            compressed
                .variance
                .iter()
                .all(|variance| (variance - 1.0).abs() < 1e-12)
        );
        let shares = basis.effective_mass_shares(&DVector::repeat(3, 1.0), &mass);
        assert!(shares[0] > 0.9 && shares.iter().sum::<f64>() < 1.0);
        assert!(ModalBasis::new(DMatrix::identity(3, 2) * 2.0, &mass).is_err());
    }

    #[test]
    fn closed_form_fusion_agrees_with_the_matrix_form() {
        // ch7 §5.2: four nodes, six parameters, a random orthogonal basis
        let random =
            |k: usize| DMatrix::from_fn(6, 6, |i, j| ((7 * i + 3 * j + 11 * k + 1) as f64).sin());
        let basis = random(9).qr().q();
        let reduce = |covariance: DMatrix<f64>| {
            let along = (basis.transpose() * covariance * &basis).diagonal();
            &basis * DMatrix::from_diagonal(&along) * basis.transpose()
        };
        let nodes: Vec<Gaussian> = (0..4)
            .map(|k| {
                let a = random(k);
                let covariance = reduce(&a * a.transpose() + DMatrix::identity(6, 6) * 0.1);
                Gaussian {
                    mean: DVector::from_fn(6, |i, _| ((i + 5 * k) as f64).cos()),
                    covariance,
                }
            })
            .collect();
        let (matrix_form, _) = product(&nodes).unwrap();
        let along = |g: &Gaussian, m: usize| {
            (basis.column(m).transpose() * &g.covariance * basis.column(m))[(0, 0)]
        };
        let mut mean = DVector::zeros(6);
        let mut covariance = DMatrix::zeros(6, 6);
        for m in 0..6 {
            let w = basis.column(m);
            let fused = 1.0 / nodes.iter().map(|g| 1.0 / along(g, m)).sum::<f64>();
            let weighted: f64 = nodes.iter().map(|g| w.dot(&g.mean) / along(g, m)).sum();
            mean += w * (fused * weighted);
            covariance += w * w.transpose() * fused;
        }
        assert!((mean - matrix_form.mean).amax() < 1e-12);
        assert!((covariance - matrix_form.covariance).amax() < 1e-12);
    }

    /// Shows why files cannot select scalar weights.
    ///
    /// A node that has learnt one parameter would claim information about all parameters.
    #[test]
    fn scalar_weight_claims_information_that_was_not_learnt() {
        let before = DMatrix::from_diagonal_element(3, 3, 0.04);
        let after = DMatrix::from_diagonal(&DVector::from_row_slice(&[0.0004, 0.04, 0.04]));
        let learnt = |weights: Weights| {
            let of =
                |covariance: &DMatrix<f64>| weights.reduce(covariance, true).try_inverse().unwrap();
            (of(&after) - of(&before)).diagonal()
        };
        for weights in [Weights::Mixed, Weights::Vector, Weights::Matrix] {
            let learnt = learnt(weights);
            assert!(
                (learnt[0] - 2475.0).abs() < 1e-9 && learnt[1].abs() < 1e-9,
                "{weights:?}: {learnt}"
            );
        }
        // The claim for the unseen parameters is half of their prior information. The claim for the
        // learnt parameter is half a per cent of its true gain.
        let learnt = learnt(Weights::Scalar);
        assert!(
            (learnt[1] * 0.04 - 0.4925).abs() < 1e-4 && learnt[0] < 0.01 * 2475.0,
            "{learnt}"
        );
    }

    #[test]
    fn finer_weights_fuse_better_on_average() {
        // ch6 §3.3: 200 random triples of independent four-variate estimates, error variance
        // relative to matrix weights
        let mut seed = 1_u64;
        let mut uniform = || {
            seed = seed
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (seed >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let mut totals = [0.0; 4];
        for _ in 0..200 {
            let truths: Vec<DMatrix<f64>> = (0..3)
                .map(|_| {
                    let a = DMatrix::from_fn(4, 4, |_, _| uniform());
                    &a * a.transpose() + DMatrix::identity(4, 4) * 0.01
                })
                .collect();
            // Variance of the fused mean if the weights of the estimates follow the scheme.
            let error = |weights: Option<Weights>| {
                let informations: Vec<DMatrix<f64>> = truths
                    .iter()
                    .map(|truth| match weights {
                        Some(weights) => weights.reduce(truth, false).try_inverse().unwrap(),
                        None => DMatrix::identity(4, 4),
                    })
                    .collect();
                let sum = informations
                    .iter()
                    .fold(DMatrix::zeros(4, 4), |sum: DMatrix<f64>, i| sum + i);
                let gain = sum.try_inverse().unwrap();
                informations
                    .iter()
                    .zip(&truths)
                    .map(|(i, t)| (&gain * i * t * i * &gain).trace())
                    .sum::<f64>()
            };
            let reference = error(Some(Weights::Matrix));
            for (total, weights) in totals.iter_mut().zip([
                Some(Weights::Matrix),
                Some(Weights::Vector),
                Some(Weights::Scalar),
                None,
            ]) {
                *total += error(weights) / reference / 200.0;
            }
        }
        assert!(
            totals.windows(2).all(|pair| pair[0] < pair[1]),
            "{totals:?}"
        );
        assert!((totals[0] - 1.0).abs() < 1e-9);
    }
}
