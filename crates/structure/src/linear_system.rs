//! A linear structure: mass, damping and the stiffness matrices of its substructures.
//!
//! Notation: Huang & Yuen (2023), §2.2 and §2.4. `M ẍ + C ẋ + K x = T f` (2.1) with `K = Σ θ⁽ⁿ⁾ K⁽ⁿ⁾` over the
//! substructures and `C = α M + β K` or a given matrix. Every kind of model of the structure file that is linear
//! becomes one of these.

use crate::sparse_cholesky::SparseCholesky;
use nalgebra::{DMatrix, DVector};
use nalgebra_sparse::CsrMatrix;

/// More degrees of freedom than this are refused: eigenvalues and covariances are dense, and a filter of this size is far
/// from real time already.
pub(crate) const LARGEST_MODEL: usize = 1000;

/// The mass matrix `M` (kg), positive definite.
#[derive(Debug, Clone)]
pub(crate) enum Mass {
    /// A diagonal matrix, by its diagonal.
    Lumped(DVector<f64>),
    /// Any symmetric matrix, with its factor.
    Consistent { matrix: DMatrix<f64>, factor: SparseCholesky },
}

impl Mass {
    pub(crate) fn to_dense(&self) -> DMatrix<f64> {
        match self {
            Self::Lumped(diagonal) => DMatrix::from_diagonal(diagonal),
            Self::Consistent { matrix, .. } => matrix.clone(),
        }
    }

    /// Returns `M⁻¹ X` for given columns `X`.
    pub(crate) fn solve(&self, mut columns: DMatrix<f64>) -> DMatrix<f64> {
        for mut column in columns.column_iter_mut() {
            match self {
                Self::Lumped(diagonal) => column.component_div_assign(diagonal),
                Self::Consistent { factor, .. } => factor.solve_mut(column.as_mut_slice()),
            }
        }
        columns
    }
}

/// A part of the structure whose stiffness a parameter can scale.
#[derive(Debug, Clone)]
pub(crate) struct Substructure {
    pub(crate) name: String,
    /// `K⁽ⁿ⁾` (N/m), symmetric and positive semidefinite, over all degrees of freedom.
    pub(crate) stiffness: CsrMatrix<f64>,
}

/// How the structure loses energy.
#[derive(Debug, Clone)]
pub(crate) enum Damping {
    /// `C = α M + β K`.
    Rayleigh { alpha_per_s: f64, beta_s: f64 },
    /// A given `C` (N s/m), symmetric and positive semidefinite.
    Matrix(CsrMatrix<f64>),
}

impl Damping {
    /// None yet: the file says it in a table of its own.
    pub(crate) const NONE: Self = Self::Rayleigh { alpha_per_s: 0.0, beta_s: 0.0 };
}

/// A direction in which the ground can move, in a model with geometry.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GroundDirection {
    pub(crate) name: &'static str,
    /// `ι` (N_d): displacement of each degree of freedom when the ground moves by 1 in this direction.
    pub(crate) influence: Vec<f64>,
}

/// A linear structure without its excitation and sensors; dimensions agree, checked where it is built.
#[derive(Debug, Clone)]
pub(crate) struct LinearSystem {
    pub(crate) mass: Mass,
    pub(crate) substructures: Vec<Substructure>,
    pub(crate) damping: Damping,
    pub(crate) degrees_of_freedom: Vec<String>,
    /// Directions of ground motion; empty where the model has no geometry.
    pub(crate) ground_directions: Vec<GroundDirection>,
}

impl LinearSystem {
    /// Returns `N_d`, the number of degrees of freedom.
    pub(crate) fn len(&self) -> usize {
        self.degrees_of_freedom.len()
    }

    /// Returns `K` (N/m) with each substructure scaled by its entry of `factors`.
    pub(crate) fn stiffness(&self, factors: &[f64]) -> DMatrix<f64> {
        let mut stiffness = DMatrix::zeros(self.len(), self.len());
        for (part, factor) in self.substructures.iter().zip(factors) {
            for (row, column, value) in part.stiffness.triplet_iter() {
                stiffness[(row, column)] += factor * value;
            }
        }
        stiffness
    }

    /// Returns `K` (N/m) as designed.
    pub(crate) fn nominal_stiffness(&self) -> DMatrix<f64> {
        self.stiffness(&vec![1.0; self.substructures.len()])
    }
}

/// Returns the dense form of a sparse matrix.
pub(crate) fn dense(matrix: &CsrMatrix<f64>) -> DMatrix<f64> {
    let mut out = DMatrix::zeros(matrix.nrows(), matrix.ncols());
    for (row, column, value) in matrix.triplet_iter() {
        out[(row, column)] += *value;
    }
    out
}
