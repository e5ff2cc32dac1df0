//! Cholesky factor of a sparse symmetric matrix, applied in place.
//!
//! `P A Pᵀ = L D Lᵀ` with a unit lower triangular `L`. Rows are eliminated in the order of minimum
//! degree (Tinney & Walker 1967, *Proc. IEEE* 55, 1801). The factor of a structure is then about as
//! sparse as its matrix, because the mass of a frame joins only neighbours. The factor keeps the
//! row numbers of the matrix, so that it solves a right-hand side in place.

use nalgebra::DMatrix;
use std::collections::BTreeSet;

/// `L` and `D` of a symmetric positive definite matrix (n × n), with a column for each eliminated
/// row.
#[derive(Debug, Clone)]
pub(crate) struct SparseCholesky {
    /// Row that each step eliminates.
    order: Vec<usize>,
    /// `1/D` of each step.
    reciprocal_pivots: Vec<f64>,
    /// Start index of the entries of each step, and the end index of the last step.
    starts: Vec<usize>,
    /// Rows of the entries of `L` below the diagonal, in the numbering of the matrix.
    rows: Vec<usize>,
    values: Vec<f64>,
}

impl SparseCholesky {
    /// Factorises `matrix` (n × n, symmetric); `None` if it is not positive definite.
    pub(crate) fn new(matrix: &DMatrix<f64>) -> Option<Self> {
        let n = matrix.nrows();
        let mut rest = matrix.clone();
        let mut neighbours: Vec<BTreeSet<usize>> = (0..n)
            .map(|row| {
                (0..n)
                    .filter(|column| *column != row && matrix[(row, *column)] != 0.0)
                    .collect()
            })
            .collect();
        let mut left: BTreeSet<usize> = (0..n).collect();
        let mut factor = Self {
            order: Vec::new(),
            reciprocal_pivots: Vec::new(),
            starts: vec![0],
            rows: Vec::new(),
            values: Vec::new(),
        };
        while let Some(pivot_row) = left
            .iter()
            .copied()
            .min_by_key(|row| neighbours[*row].len())
        {
            left.remove(&pivot_row);
            let pivot = rest[(pivot_row, pivot_row)];
            // The negation also rejects NaN.
            if !(pivot > 0.0 && pivot.is_finite()) {
                return None;
            }
            let below = std::mem::take(&mut neighbours[pivot_row]);
            for row in &below {
                let entry = rest[(*row, pivot_row)] / pivot;
                for column in &below {
                    rest[(*row, *column)] -= entry * rest[(pivot_row, *column)];
                }
                factor.rows.push(*row);
                factor.values.push(entry);
            }
            for row in &below {
                neighbours[*row].extend(below.iter().filter(|column| *column != row));
                neighbours[*row].remove(&pivot_row);
            }
            factor.order.push(pivot_row);
            factor.reciprocal_pivots.push(1.0 / pivot);
            factor.starts.push(factor.rows.len());
        }
        Some(factor)
    }

    /// Replaces `b` (n) by `A⁻¹ b`.
    pub(crate) fn solve_mut(&self, b: &mut [f64]) {
        self.solve_columns_mut(&mut [b]);
    }

    /// Replaces each of several columns `b` (n) by `A⁻¹ b`, bit-identical to one column at a time.
    pub(crate) fn solve_columns_mut<const C: usize>(&self, columns: &mut [&mut [f64]; C]) {
        for (step, row) in self.order.iter().enumerate() {
            let solved: [f64; C] = std::array::from_fn(|c| columns[c][*row]);
            for (below, value) in self.column(step) {
                for (b, solved) in columns.iter_mut().zip(solved) {
                    b[*below] -= value * solved;
                }
            }
        }
        for (step, row) in self.order.iter().enumerate().rev() {
            let mut entries: [f64; C] =
                std::array::from_fn(|c| columns[c][*row] * self.reciprocal_pivots[step]);
            for (below, value) in self.column(step) {
                for (entry, b) in entries.iter_mut().zip(columns.iter()) {
                    *entry -= value * b[*below];
                }
            }
            for (b, entry) in columns.iter_mut().zip(entries) {
                b[*row] = entry;
            }
        }
    }

    #[inline] // a call per column takes longer than its few entries
    fn column(&self, step: usize) -> impl Iterator<Item = (&usize, &f64)> {
        let entries = self.starts[step]..self.starts[step + 1];
        self.rows[entries.clone()].iter().zip(&self.values[entries])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;

    /// Returns the matrix of a star of masses, in which row 0 joins all other rows.
    ///
    /// Elimination in row order would fill the whole factor.
    fn star() -> DMatrix<f64> {
        let mut matrix = DMatrix::from_diagonal_element(6, 6, 4.0);
        for leaf in 1..6 {
            matrix[(0, leaf)] = 0.5 + 0.1 * leaf as f64;
            matrix[(leaf, 0)] = matrix[(0, leaf)];
        }
        matrix
    }

    #[test]
    fn the_solution_solves_the_equations() {
        let matrix = star();
        let expected = DVector::from_fn(6, |row, _| (1.7 * row as f64).sin());
        let mut b = &matrix * &expected;
        SparseCholesky::new(&matrix)
            .unwrap()
            .solve_mut(b.as_mut_slice());
        assert!((b - expected).norm() < 1e-14);
    }

    #[test]
    fn a_tree_has_a_factor_without_fill() {
        assert_eq!(SparseCholesky::new(&star()).unwrap().values.len(), 5);
    }

    #[test]
    fn an_indefinite_matrix_has_no_factor() {
        let mut matrix = star();
        matrix[(3, 3)] = 0.01;
        assert!(SparseCholesky::new(&matrix).is_none());
        matrix[(3, 3)] = f64::NAN;
        assert!(SparseCholesky::new(&matrix).is_none());
    }
}
