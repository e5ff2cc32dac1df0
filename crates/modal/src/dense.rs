//! Dense decompositions of `nalgebra`, with their order and failures settled.

use crate::ModalError;
use nalgebra::{Complex, ComplexField, DMatrix, SVD, Schur};

/// Largest number of iterations of a decomposition per row of its matrix. Convergence takes a few.
const ITERATIONS_PER_ROW: usize = 100;

/// A thin singular value decomposition, with singular values in descending order.
#[derive(Debug, Clone)]
pub(crate) struct Svd {
    /// Left singular vectors, *m* × min(*m*, *n*).
    pub(crate) u: DMatrix<f64>,
    /// Singular values.
    pub(crate) s: Vec<f64>,
    /// Right singular vectors, *n* × min(*m*, *n*).
    pub(crate) v: DMatrix<f64>,
}

/// Decomposes a matrix with at least as many rows as columns: `matrix` = U S Vᵀ.
///
/// A QR decomposition first reduces the matrix to a square one.
///
/// # Errors
/// Returns an error if the iteration did not converge, or if the matrix contains a value that is
/// not finite.
pub(crate) fn svd(matrix: DMatrix<f64>) -> Result<Svd, ModalError> {
    let failed = ModalError::NotConverged {
        what: "singular value decomposition",
    };
    if matrix.iter().any(|value| !value.is_finite()) {
        return Err(failed);
    }
    let most = ITERATIONS_PER_ROW * matrix.nrows();
    let (q, square) = if matrix.nrows() > matrix.ncols() {
        let (q, r) = matrix.qr().unpack();
        (Some(q), r)
    } else {
        (None, matrix)
    };
    // SVD::try_new returns the singular values in descending order.
    let svd = SVD::try_new(square, true, true, f64::EPSILON, most).ok_or(failed.clone())?;
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err(failed);
    };
    Ok(Svd {
        u: match q {
            Some(q) => q * u,
            None => u,
        },
        s: svd.singular_values.iter().copied().collect(),
        v: v_t.transpose(),
    })
}

/// Eigenvalues and right eigenvectors of a general square matrix.
#[derive(Debug, Clone)]
pub(crate) struct Eigen {
    /// Eigenvalues.
    pub(crate) values: Vec<Complex<f64>>,
    /// Eigenvectors of unit length, one per column.
    pub(crate) vectors: DMatrix<Complex<f64>>,
}

/// Decomposes a square matrix: `matrix` Ψ = Ψ diag(μ).
///
/// The complex Schur form is triangular. Its eigenvectors follow by back substitution (Golub & Van
/// Loan, *Matrix Computations*, section 7.6.4).
///
/// # Errors
/// Returns an error if the iteration did not converge, or if the matrix contains a value that is
/// not finite.
pub(crate) fn eigen(matrix: &DMatrix<f64>) -> Result<Eigen, ModalError> {
    let failed = ModalError::NotConverged {
        what: "eigenvalue decomposition",
    };
    if matrix.iter().any(|value| !value.is_finite()) {
        return Err(failed);
    }
    let n = matrix.nrows();
    let complex = matrix.map(|value| Complex::new(value, 0.0));
    let schur = Schur::try_new(complex, f64::EPSILON, ITERATIONS_PER_ROW * n).ok_or(failed)?;
    let (q, t) = schur.unpack();
    let smallest = f64::EPSILON * t.norm();
    let mut triangular = DMatrix::<Complex<f64>>::identity(n, n);
    for k in 0..n {
        for row in (0..k).rev() {
            let mut sum = t[(row, k)];
            for column in row + 1..k {
                sum += t[(row, column)] * triangular[(column, k)];
            }
            let gap = t[(k, k)] - t[(row, row)];
            // Equal eigenvalues are separated by a rounding error.
            let gap = if gap.norm() < smallest {
                Complex::new(smallest, 0.0)
            } else {
                gap
            };
            triangular[(row, k)] = sum / gap;
        }
    }
    let mut vectors = q * triangular;
    for mut vector in vectors.column_iter_mut() {
        let norm = vector.norm();
        vector.unscale_mut(norm);
    }
    Ok(Eigen {
        values: (0..n).map(|k| t[(k, k)]).collect(),
        vectors,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix(rows: usize, columns: usize) -> DMatrix<f64> {
        // A fixed matrix without structure: fractional parts of multiples of √2 and √3.
        DMatrix::from_fn(rows, columns, |i, j| {
            ((i + 1) as f64 * 2.0_f64.sqrt() + (j * j + 1) as f64 * 3.0_f64.sqrt()).fract() - 0.5
        })
    }

    #[test]
    fn factors_multiply_to_the_matrix() {
        for (rows, columns) in [(12, 5), (9, 9)] {
            let matrix = matrix(rows, columns);
            let Svd { u, s, v } = svd(matrix.clone()).unwrap();
            let s = DMatrix::from_diagonal(&nalgebra::DVector::from_vec(s));
            assert!((u * s * v.transpose() - matrix).norm() < 1e-12);
        }
    }

    #[test]
    fn eigenvectors_are_turned_into_their_multiples() {
        let matrix = matrix(14, 14);
        let Eigen { values, vectors } = eigen(&matrix).unwrap();
        let complex = matrix.map(|value| Complex::new(value, 0.0));
        for (k, value) in values.iter().enumerate() {
            let vector = vectors.column(k);
            let residual = &complex * vector - vector * *value;
            assert!(residual.norm() < 1e-11, "{k}: {}", residual.norm());
        }
    }

    #[test]
    fn values_that_are_not_finite_are_an_error() {
        let mut matrix = matrix(3, 3);
        matrix[(1, 1)] = f64::NAN;
        assert!(svd(matrix.clone()).is_err() && eigen(&matrix).is_err());
    }
}
