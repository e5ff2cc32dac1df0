//! Small dense kernels that do not allocate.
//!
//! Where nalgebra does not allocate and is as fast, its functions are used.

use nalgebra::{DMatrix, DMatrixViewMut, DVector};
use pulp::{Arch, Simd, WithSimd};

/// Replaces the lower triangle of a symmetric positive definite matrix by its Cholesky factor `L`
/// and sets the rest to zero.
///
/// # Errors
/// Returns the first row whose pivot is not positive and finite.
pub(crate) fn cholesky_mut(matrix: &mut DMatrix<f64>) -> Result<(), usize> {
    let n = matrix.nrows();
    for j in 0..n {
        let (known, rest) = matrix.as_mut_slice().split_at_mut(j * n);
        let (above, column) = rest[..n].split_at_mut(j);
        for known in known.chunks_exact(n) {
            add_scaled(column, -known[j], &known[j..]);
        }
        let pivot = column[0];
        // This form of the condition also rejects NaN.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return Err(j);
        }
        above.fill(0.0);
        let diagonal = pivot.sqrt();
        column[0] = diagonal;
        for entry in &mut column[1..] {
            *entry /= diagonal;
        }
    }
    Ok(())
}

/// Returns `ln|L Lᵀ|` of a Cholesky factor.
pub(crate) fn ln_determinant(factor: &DMatrix<f64>) -> f64 {
    2.0 * (0..factor.nrows())
        .map(|i| factor[(i, i)].ln())
        .sum::<f64>()
}

/// Replaces every column `b` (in a column-major slice) by `L⁻¹ b`.
pub(crate) fn solve_lower_mut(factor: &DMatrix<f64>, columns: &mut [f64]) {
    factor.solve_lower_triangular_unchecked_mut(&mut of_columns(factor, columns));
}

/// Replaces every column `b` (in a column-major slice) by `L⁻ᵀ b`.
pub(crate) fn solve_lower_transposed_mut(factor: &DMatrix<f64>, columns: &mut [f64]) {
    factor.tr_solve_lower_triangular_unchecked_mut(&mut of_columns(factor, columns));
}

/// Returns a slice as a matrix with as many rows as a factor.
fn of_columns<'m>(factor: &DMatrix<f64>, columns: &'m mut [f64]) -> DMatrixViewMut<'m, f64> {
    let rows = factor.nrows();
    let count = columns.len().checked_div(rows).unwrap_or(0);
    DMatrixViewMut::from_slice(columns, rows, count)
}

/// Replaces every row `b` (in a column-major slice) by `L⁻¹ b`.
pub(crate) fn solve_lower_of_rows_mut(arch: Arch, factor: &DMatrix<f64>, columns: &mut [f64]) {
    arch.dispatch(SolveLowerOfRows { factor, columns });
}

struct SolveLowerOfRows<'m> {
    factor: &'m DMatrix<f64>,
    columns: &'m mut [f64],
}

impl WithSimd for SolveLowerOfRows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let m = self.factor.nrows();
        if m == 0 {
            return;
        }
        let (rows, lanes) = (self.columns.len() / m, S::F64_LANES);
        let mut first = 0;
        while first < rows {
            match (rows - first) / lanes {
                0 => {
                    self.rows::<pulp::Scalar, 1>(pulp::Scalar, first);
                    first += 1;
                }
                1 => {
                    self.rows::<S, 1>(simd, first);
                    first += lanes;
                }
                2 | 3 => {
                    self.rows::<S, 2>(simd, first);
                    first += 2 * lanes;
                }
                _ => {
                    self.rows::<S, 4>(simd, first);
                    first += 4 * lanes;
                }
            }
        }
    }
}

impl SolveLowerOfRows<'_> {
    /// Solves for `R` registers of rows, starting with row `first`. The solved entries of these
    /// rows remain in the fastest cache.
    #[inline(always)]
    fn rows<S: Simd, const R: usize>(&mut self, simd: S, first: usize) {
        let Self { factor, columns } = self;
        let (m, length) = (factor.nrows(), R * S::F64_LANES);
        let stride = columns.len() / m;
        for i in 0..m {
            let (solved, rest) = columns.split_at_mut(i * stride);
            let (entries, _) = S::as_mut_simd_f64s(&mut rest[first..first + length]);
            let mut sums = [simd.splat_f64s(0.0); R];
            for (sum, entry) in sums.iter_mut().zip(&*entries) {
                *sum = *entry;
            }
            for k in 0..i {
                let weight = simd.splat_f64s(-factor[(i, k)]);
                let (known, _) =
                    S::as_simd_f64s(&solved[k * stride + first..k * stride + first + length]);
                for (sum, known) in sums.iter_mut().zip(known) {
                    *sum = simd.mul_add_e_f64s(weight, *known, *sum);
                }
            }
            let reciprocal = simd.splat_f64s(1.0 / factor[(i, i)]);
            for (entry, sum) in entries.iter_mut().zip(sums) {
                *entry = simd.mul_f64s(reciprocal, sum);
            }
        }
    }
}

/// Replaces a square matrix by `(X + Xᵀ)/2`.
pub(crate) fn symmetrise_mut(matrix: &mut DMatrix<f64>) {
    let n = matrix.nrows();
    for j in 0..n {
        for i in 0..j {
            let mean = 0.5 * (matrix[(i, j)] + matrix[(j, i)]);
            matrix[(i, j)] = mean;
            matrix[(j, i)] = mean;
        }
    }
}

/// Writes the diagonal of a square matrix (n × n).
pub(crate) fn diagonal_to(matrix: &DMatrix<f64>, out: &mut DVector<f64>) {
    for (entry, value) in out
        .iter_mut()
        .zip(matrix.as_slice().iter().step_by(matrix.nrows() + 1))
    {
        *entry = *value;
    }
}

/// Replaces `X` by `D^½ X D^½` with the diagonal `factors`, or by itself if there are none.
pub(crate) fn scale_symmetric_mut(matrix: &mut DMatrix<f64>, factors: &[f64]) {
    if factors.iter().all(|factor| *factor == 1.0) {
        return;
    }
    for (b, column) in factors.iter().enumerate() {
        for (a, row) in factors.iter().enumerate() {
            matrix[(a, b)] *= (row * column).sqrt();
        }
    }
}

/// Adds `scale · X` to a matrix of the same size.
pub(crate) fn add_scaled_mut(target: &mut DMatrix<f64>, scale: f64, x: &DMatrix<f64>) {
    add_scaled_slice_mut(target.as_mut_slice(), scale, x.as_slice());
}

/// Adds `scale · x` to a vector of the same length.
pub(crate) fn add_scaled_slice_mut(target: &mut [f64], scale: f64, x: &[f64]) {
    if target.len() < SHORT {
        add_scaled(target, scale, x);
    } else {
        Arch::new().dispatch(AddScaled { target, scale, x });
    }
}

/// Length below which a plain loop finishes before a faster instruction set could be selected.
const SHORT: usize = 24;

struct AddScaled<'m> {
    target: &'m mut [f64],
    scale: f64,
    x: &'m [f64],
}

impl WithSimd for AddScaled<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        add_scaled(self.target, self.scale, self.x);
    }
}

#[inline(always)]
fn add_scaled(target: &mut [f64], scale: f64, x: &[f64]) {
    // Slices are several times faster here than the iterators of nalgebra.
    for (entry, addend) in target.iter_mut().zip(x) {
        *entry += scale * addend;
    }
}

/// Adds `scale · X C Xᵀ` to a symmetric matrix.
///
/// `X` is n × c and the symmetric `C` is c × c. The method suits a small `c`.
pub(crate) fn add_quadratic_form_mut(
    target: &mut DMatrix<f64>,
    x: &DMatrix<f64>,
    c: &DMatrix<f64>,
    scale: f64,
) {
    let n = x.nrows();
    for j in 0..n {
        let column = &mut target.as_mut_slice()[j * n..(j + 1) * n];
        for a in 0..c.nrows() {
            let weight: f64 = (0..c.ncols()).map(|b| scale * c[(a, b)] * x[(j, b)]).sum();
            if weight != 0.0 {
                add_scaled_slice_mut(column, weight, &x.as_slice()[a * n..(a + 1) * n]);
            }
        }
    }
}

/// Subtracts `Vᵀ V` from a symmetric matrix (n × n), with `V` (m × n). Both triangles are
/// bit-identical.
pub(crate) fn subtract_gram_mut(target: &mut DMatrix<f64>, v: &DMatrix<f64>) {
    let n = target.nrows();
    for j in 0..n {
        for i in 0..=j {
            let product = v.column(i).dot(&v.column(j));
            let entry = target[(i, j)] - product;
            target[(i, j)] = entry;
            target[(j, i)] = entry;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::product::all_instructions;
    use nalgebra::{Cholesky, DVector};

    fn spd(n: usize) -> DMatrix<f64> {
        let a = DMatrix::from_fn(n, n, |i, j| ((3 * i + 7 * j + 1) as f64).sin());
        &a * a.transpose() + DMatrix::identity(n, n)
    }

    #[test]
    fn factor_and_solves_agree_with_nalgebra() {
        let s = spd(7);
        let reference = Cholesky::new(s.clone()).unwrap();
        let mut factor = s.clone();
        cholesky_mut(&mut factor).unwrap();
        assert!((&factor - reference.l()).amax() < 1e-13);
        assert!((ln_determinant(&factor) - reference.ln_determinant()).abs() < 1e-12);
        let mut b = DVector::from_fn(7, |i, _| (i as f64).cos());
        let expected = reference.solve(&b);
        solve_lower_mut(&factor, b.as_mut_slice());
        solve_lower_transposed_mut(&factor, b.as_mut_slice());
        assert!((b - expected).amax() < 1e-12);
        let rows = DMatrix::from_fn(150, 7, |i, j| (i as f64 + 0.3 * j as f64).cos());
        let expected = reference
            .l()
            .solve_lower_triangular(&rows.transpose())
            .unwrap()
            .transpose();
        for (arch, count) in all_instructions()
            .into_iter()
            .flat_map(|arch| (1..=150).map(move |count| (arch, count)))
        {
            let mut solved = rows.rows(0, count).into_owned();
            solve_lower_of_rows_mut(arch, &factor, solved.as_mut_slice());
            assert!(
                (solved - expected.rows(0, count)).amax() < 1e-12,
                "{count} rows"
            );
        }
    }

    #[test]
    fn indefinite_matrix_names_its_pivot() {
        let mut s = spd(4);
        s[(2, 2)] = -1.0;
        assert_eq!(cholesky_mut(&mut s), Err(2));
    }

    #[test]
    fn rank_updates_agree_with_dense_products() {
        let v = DMatrix::from_fn(3, 6, |i, j| (i as f64 - 0.3 * j as f64).sin());
        let mut target = spd(6);
        let expected = &target - v.transpose() * &v;
        subtract_gram_mut(&mut target, &v);
        assert!((&target - expected).amax() < 1e-13);
        let x = DMatrix::from_fn(6, 2, |i, j| (1.0 + i as f64 * j as f64).cos());
        let c = spd(2);
        let expected = &target + 0.5 * &x * &c * x.transpose();
        add_quadratic_form_mut(&mut target, &x, &c, 0.5);
        assert!((&target - expected).amax() < 1e-12);
    }
}
