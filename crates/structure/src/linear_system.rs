//! A structure: mass, damping and the stiffness matrices of its substructures, with or without
//! hysteresis.
//!
//! Notation: Huang & Yuen (2023), §2.2 and §2.4. `M ẍ + C ẋ + K x = T f` (2.1) with
//! `K = Σ θ⁽ⁿ⁾ K⁽ⁿ⁾` over the substructures. `C` is `α M + β K`, a sum of dashpots, or a given
//! matrix. Every model kind of the structure file is converted to this form. With hysteresis, the
//! spring forces are `k r` instead of `k x`, and the matrices are those of the springs.

use crate::hysteresis::{Drive, Hysteresis};
use crate::skeleton::Skeleton;
use crate::sparse_cholesky::SparseCholesky;
use nalgebra::{DMatrix, DVector};
use nalgebra_sparse::{CooMatrix, CsrMatrix};
use std::ops::{AddAssign, Range};

/// Maximum number of degrees of freedom.
///
/// Eigenvalues and covariances are dense, and a filter of this size is already far from real time.
pub(crate) const LARGEST_MODEL: usize = 1000;

/// The mass matrix `M` (kg), positive definite.
#[derive(Debug, Clone)]
pub(crate) enum Mass {
    /// A diagonal matrix, stored as its diagonal.
    Lumped(DVector<f64>),
    /// Any symmetric matrix, with its factor.
    Consistent {
        matrix: DMatrix<f64>,
        factor: SparseCholesky,
    },
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

/// A part of the structure whose stiffness or, for dashpots, damping a parameter can scale.
#[derive(Debug, Clone)]
pub(crate) struct Substructure {
    pub(crate) name: String,
    /// `K⁽ⁿ⁾` (N/m), symmetric and positive semidefinite, over all degrees of freedom.
    pub(crate) stiffness: CsrMatrix<f64>,
}

/// Damping of the structure.
#[derive(Debug, Clone)]
pub(crate) enum Damping {
    /// `C = α M + β K`.
    Rayleigh { alpha_per_s: f64, beta_s: f64 },
    /// `C = Σ C⁽ⁿ⁾` of dashpots that a parameter can scale, each like a substructure (N s/m).
    Dashpots(Vec<Substructure>),
    /// A given `C` (N s/m), symmetric and positive semidefinite.
    Matrix(CsrMatrix<f64>),
}

impl Damping {
    /// No damping, the value before the `[damping]` table is read.
    pub(crate) const NONE: Self = Self::Rayleigh {
        alpha_per_s: 0.0,
        beta_s: 0.0,
    };

    /// Returns the damping, multiplied by `factor`.
    pub(crate) fn times(&self, factor: f64) -> Self {
        match self {
            Self::Rayleigh {
                alpha_per_s,
                beta_s,
            } => Self::Rayleigh {
                alpha_per_s: factor * alpha_per_s,
                beta_s: factor * beta_s,
            },
            Self::Dashpots(parts) => {
                let scale = |part: &Substructure| Substructure {
                    stiffness: &part.stiffness * factor,
                    ..part.clone()
                };
                Self::Dashpots(parts.iter().map(scale).collect())
            }
            Self::Matrix(matrix) => Self::Matrix(matrix * factor),
        }
    }

    /// Returns `C` (N s/m) as designed, for dashpots or a given matrix; `None` for Rayleigh
    /// damping.
    pub(crate) fn matrix(&self, len: usize) -> Option<DMatrix<f64>> {
        match self {
            Self::Rayleigh { .. } => None,
            Self::Dashpots(dashpots) => {
                Some(sum(len, dashpots.iter().map(|part| (&part.stiffness, 1.0))))
            }
            Self::Matrix(matrix) => Some(dense(matrix)),
        }
    }
}

/// Storeys that are scaled together, as one substructure of a chain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct StoreyGroup {
    pub(crate) name: String,
    /// Range of storeys (from 0, the lowest).
    pub(crate) storeys: Range<usize>,
}

/// A direction in which the ground can move, in a model with geometry.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GroundDirection {
    pub(crate) name: &'static str,
    /// `ι` (N_d), the displacement of each degree of freedom for a ground displacement of 1 in this
    /// direction.
    pub(crate) influence: Vec<f64>,
}

/// A structure without its excitation and sensors.
///
/// Its constructors check that the dimensions agree.
#[derive(Debug, Clone)]
pub(crate) struct LinearSystem {
    pub(crate) mass: Mass,
    pub(crate) substructures: Vec<Substructure>,
    pub(crate) damping: Damping,
    pub(crate) degrees_of_freedom: Vec<String>,
    /// Directions of ground motion; empty if the model has no geometry.
    pub(crate) ground_directions: Vec<GroundDirection>,
    /// Groups of storeys of a chain, from the bottom up; empty for other models.
    pub(crate) storeys: Vec<StoreyGroup>,
    /// Law of hysteretic springs; `None` for linear springs.
    pub(crate) hysteresis: Option<Hysteresis>,
    /// Geometry of the parts; `None` for chains and matrices.
    pub(crate) skeleton: Option<Skeleton>,
}

impl LinearSystem {
    /// Returns a system without degrees of freedom, for a structure without a model.
    pub(crate) fn empty(skeleton: Option<Skeleton>) -> Self {
        Self {
            mass: Mass::Lumped(DVector::zeros(0)),
            substructures: Vec::new(),
            damping: Damping::NONE,
            degrees_of_freedom: Vec::new(),
            ground_directions: Vec::new(),
            storeys: Vec::new(),
            hysteresis: None,
            skeleton,
        }
    }

    /// Returns `N_d`, the number of degrees of freedom.
    pub(crate) fn len(&self) -> usize {
        self.degrees_of_freedom.len()
    }

    /// Returns `true` if there is no model.
    pub(crate) fn is_empty(&self) -> bool {
        self.degrees_of_freedom.is_empty()
    }

    /// Returns the matrix (N/m) from spring displacements (columns) to the forces of one
    /// substructure.
    ///
    /// The forces act on the degrees of freedom (rows). The matrix is `K⁽ⁿ⁾` unless the drift
    /// drives hysteretic springs. In that case it is `K⁽ⁿ⁾ D⁻¹`. `D` takes the differences of
    /// neighbours, so each column becomes the sum of the columns from that column on.
    pub(crate) fn forces(&self, part: usize) -> CsrMatrix<f64> {
        let stiffness = &self.substructures[part].stiffness;
        if self.hysteresis.is_none_or(|law| law.drive == Drive::Floor) {
            return stiffness.clone();
        }
        let mut summed = dense(stiffness);
        for column in (1..summed.ncols()).rev() {
            let from_here_on = summed.column(column).into_owned();
            summed.column_mut(column - 1).add_assign(&from_here_on);
        }
        CsrMatrix::from(&CooMatrix::from(&summed))
    }

    /// Returns `a`, the stiffness factor of hysteretic springs for small motions; 1 for linear
    /// springs.
    pub(crate) fn initial_slope(&self) -> f64 {
        self.hysteresis.map_or(1.0, |law| law.a)
    }

    /// Returns `K` (N/m) for small motions, with each substructure scaled by its entry of
    /// `factors`.
    pub(crate) fn stiffness(&self, factors: &[f64]) -> DMatrix<f64> {
        let parts = self.substructures.iter().map(|part| &part.stiffness);
        sum(self.len(), parts.zip(factors.iter().copied())) * self.initial_slope()
    }

    /// Returns `K` (N/m) as designed.
    pub(crate) fn nominal_stiffness(&self) -> DMatrix<f64> {
        self.stiffness(&vec![1.0; self.substructures.len()])
    }
}

/// Returns the sum of scaled matrices over `len` degrees of freedom.
fn sum<'m>(len: usize, parts: impl Iterator<Item = (&'m CsrMatrix<f64>, f64)>) -> DMatrix<f64> {
    let mut total = DMatrix::zeros(len, len);
    for (matrix, factor) in parts {
        for (row, column, value) in matrix.triplet_iter() {
            total[(row, column)] += factor * value;
        }
    }
    total
}

/// Returns the dense form of a sparse matrix.
pub(crate) fn dense(matrix: &CsrMatrix<f64>) -> DMatrix<f64> {
    let mut out = DMatrix::zeros(matrix.nrows(), matrix.ncols());
    for (row, column, value) in matrix.triplet_iter() {
        out[(row, column)] += *value;
    }
    out
}
