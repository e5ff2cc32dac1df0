//! Products of matrices with few rows, whose whole columns stay in registers.
//!
//! For such matrices, packing and transposing take longer than the sums.

use nalgebra::DMatrix;
use pulp::{Arch, Simd, WithSimd};

/// Maximum number of rows and columns of a small matrix.
pub(crate) const MOST_ROWS: usize = 16;

/// A column, padded with zeros.
type Column = [f64; MOST_ROWS];

/// Computes `A X Aᵀ` of symmetric matrices `X` (n × n), for one `A` of at most [`MOST_ROWS`] rows.
#[derive(Debug, Clone)]
pub(crate) struct Congruence {
    /// The columns of `A`, and in `rows` its rows.
    columns: Box<Columns>,
    rows: Box<Columns>,
    /// The columns of `A X`, and in `result` the columns of the result.
    half_way: Box<Columns>,
    result: Box<Columns>,
}

type Columns = [Column; MOST_ROWS];

impl Congruence {
    /// Stores `A` (n × n).
    pub(crate) fn new(a: &DMatrix<f64>) -> Self {
        let n = a.nrows();
        debug_assert!(n <= MOST_ROWS);
        let entry = |row: usize, column: usize| {
            if row < n && column < n {
                a[(row, column)]
            } else {
                0.0
            }
        };
        let columns = |entry: &dyn Fn(usize, usize) -> f64| -> Box<Columns> {
            Box::new(std::array::from_fn(|column| {
                std::array::from_fn(|row| entry(row, column))
            }))
        };
        Self {
            columns: columns(&entry),
            rows: columns(&|row, column| entry(column, row)),
            half_way: columns(&|_, _| 0.0),
            result: columns(&|_, _| 0.0),
        }
    }

    /// Writes `A y` (n) into `out`.
    pub(crate) fn mul_to(&self, arch: Arch, y: &[f64], out: &mut [f64]) {
        arch.dispatch(Multiply {
            columns: &self.columns[..],
            y,
            out,
        });
    }

    /// Computes `factor · A X Aᵀ` in `out` (n × n); both triangles are bit-identical.
    pub(crate) fn apply_to(
        &mut self,
        arch: Arch,
        factor: f64,
        x: &DMatrix<f64>,
        out: &mut DMatrix<f64>,
    ) {
        arch.dispatch(Apply {
            congruence: self,
            factor,
            x: x.as_slice(),
            out: out.as_mut_slice(),
            n: x.nrows(),
        });
    }
}

struct Multiply<'m> {
    columns: &'m [Column],
    y: &'m [f64],
    out: &'m mut [f64],
}

impl WithSimd for Multiply<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let mut sums = [0.0; MOST_ROWS];
        let (of_sums, _) = S::as_mut_simd_f64s(sums.as_mut_slice());
        for (column, weight) in self.columns.iter().zip(self.y) {
            let (column, weight) = (
                S::as_simd_f64s(column.as_slice()).0,
                simd.splat_f64s(*weight),
            );
            for (sum, entry) in of_sums.iter_mut().zip(column) {
                *sum = simd.mul_add_e_f64s(*entry, weight, *sum);
            }
        }
        let n = self.out.len();
        self.out.copy_from_slice(&sums[..n]);
    }
}

struct Apply<'m> {
    congruence: &'m mut Congruence,
    factor: f64,
    x: &'m [f64],
    out: &'m mut [f64],
    n: usize,
}

impl WithSimd for Apply<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // The number of simultaneous sums hides the latency of each sum and fits into the
        // registers.
        match (S::F64_LANES, self.n.div_ceil(S::F64_LANES)) {
            (8.., 1) => self.run::<S, 1, 4>(simd),
            (8.., _) => self.run::<S, 2, 4>(simd),
            (4.., 1) => self.run::<S, 1, 4>(simd),
            (4.., 2) => self.run::<S, 2, 4>(simd),
            (4.., 3) => self.run::<S, 3, 2>(simd),
            (4.., _) => self.run::<S, 4, 2>(simd),
            (2.., _) => self.run::<S, 8, 1>(simd),
            _ => self.run::<S, MOST_ROWS, 1>(simd),
        }
    }
}

impl Apply<'_> {
    /// Computes the product with `R` registers for a column, and `C` columns at a time.
    #[inline(always)]
    fn run<S: Simd, const R: usize, const C: usize>(self, simd: S) {
        let Self {
            congruence:
                Congruence {
                    columns,
                    rows,
                    half_way,
                    result,
                },
            factor,
            x,
            out,
            n,
        } = self;
        // No effect on the value. It lets the compiler omit bounds checks within a column.
        let n = n.min(MOST_ROWS);
        // Column j of A X is the sum of the columns of A, weighted by column j of X.
        for first in (0..n).step_by(C) {
            let mut of_x = [&x[..n]; C];
            for (lane, of_x) in of_x.iter_mut().enumerate() {
                let column = (first + lane).min(n - 1);
                *of_x = &x[column * n..(column + 1) * n];
            }
            let mut sums = [[simd.splat_f64s(0.0); R]; C];
            for (k, column) in columns[..n].iter().enumerate() {
                let (column, _) = S::as_simd_f64s(column.as_slice());
                for (of_x, sums) in of_x.iter().zip(&mut sums) {
                    let weight = simd.splat_f64s(of_x[k]);
                    for (sum, entry) in sums.iter_mut().zip(column) {
                        *sum = simd.mul_add_e_f64s(*entry, weight, *sum);
                    }
                }
            }
            keep::<S, R, C>(&sums, &mut half_way[first..first + C]);
        }
        // Column j of the result is the sum of the columns of A X, weighted by row j of A.
        let factor = simd.splat_f64s(factor);
        for first in (0..n).step_by(C) {
            let mut sums = [[simd.splat_f64s(0.0); R]; C];
            for (k, column) in half_way[..n].iter().enumerate() {
                let (column, _) = S::as_simd_f64s(column.as_slice());
                for (row, sums) in rows[first..first + C].iter().zip(&mut sums) {
                    let weight = simd.splat_f64s(row[k]);
                    for (sum, entry) in sums.iter_mut().zip(column) {
                        *sum = simd.mul_add_e_f64s(*entry, weight, *sum);
                    }
                }
            }
            for sums in &mut sums {
                for sum in sums {
                    *sum = simd.mul_f64s(factor, *sum);
                }
            }
            keep::<S, R, C>(&sums, &mut result[first..first + C]);
        }
        for column in 0..n {
            for row in column..n {
                let entry = result[column][row];
                (out[column * n + row], out[row * n + column]) = (entry, entry);
            }
        }
    }
}

#[inline(always)]
fn keep<S: Simd, const R: usize, const C: usize>(sums: &[[S::f64s; R]; C], columns: &mut [Column]) {
    for (sums, column) in sums.iter().zip(columns) {
        let (column, _) = S::as_mut_simd_f64s(column.as_mut_slice());
        for (entry, sum) in column.iter_mut().zip(sums) {
            *entry = *sum;
        }
    }
}

/// Replaces a symmetric `P` (n × n) by `P − V Vᵀ`, with `V` (n × c); both triangles are
/// bit-identical.
pub(crate) fn subtract_outer_mut(arch: Arch, p: &mut DMatrix<f64>, v: &DMatrix<f64>) {
    let n = p.nrows();
    // The weights give the same products in both triangles, because multiplication is commutative.
    let weight = |column: usize, k: usize| -v.as_slice()[k * n + column];
    arch.dispatch(Combine {
        adds: true,
        left: v.as_slice(),
        weight,
        out: p.as_mut_slice(),
        n,
    });
}

/// Computes `P X` with `P` (n × n) and `X` (n × c) in `out`.
pub(crate) fn multiply_to(arch: Arch, p: &DMatrix<f64>, x: &DMatrix<f64>, out: &mut DMatrix<f64>) {
    let n = p.nrows();
    let weight = |column: usize, k: usize| x.as_slice()[column * n + k];
    arch.dispatch(Combine {
        adds: false,
        left: p.as_slice(),
        weight,
        out: out.as_mut_slice(),
        n,
    });
}

/// Computes each column of `out` as a weighted sum of the columns of `left`.
struct Combine<'m, W> {
    /// `true` to add the sums to the existing values, `false` to replace them.
    adds: bool,
    left: &'m [f64],
    weight: W,
    out: &'m mut [f64],
    n: usize,
}

impl<W: Fn(usize, usize) -> f64> WithSimd for Combine<'_, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match self.n.div_ceil(S::F64_LANES) {
            _ if self.n < S::F64_LANES => self.run::<pulp::Scalar, MOST_ROWS>(pulp::Scalar),
            1 => self.run::<S, 1>(simd),
            2 => self.run::<S, 2>(simd),
            3 => self.run::<S, 3>(simd),
            4 => self.run::<S, 4>(simd),
            _ => self.run::<S, MOST_ROWS>(simd),
        }
    }
}

impl<W: Fn(usize, usize) -> f64> Combine<'_, W> {
    /// Computes the sums with up to `R` registers per column.
    ///
    /// The last register starts early enough to be full. Entries that are computed twice have the
    /// same bits.
    #[inline(always)]
    fn run<S: Simd, const R: usize>(self, simd: S) {
        let Self {
            adds,
            left,
            weight,
            out,
            n,
        } = self;
        let lanes = S::F64_LANES;
        let registers = n.div_ceil(lanes);
        for (column, out) in out.chunks_exact_mut(n).enumerate() {
            let mut sums = [simd.splat_f64s(0.0); R];
            if adds {
                for (register, sum) in sums.iter_mut().enumerate().take(registers) {
                    let first = (register * lanes).min(n - lanes);
                    *sum = S::as_simd_f64s(&out[first..first + lanes]).0[0];
                }
            }
            for (k, left) in left.chunks_exact(n).enumerate() {
                let weight = simd.splat_f64s(weight(column, k));
                for (register, sum) in sums.iter_mut().enumerate().take(registers) {
                    let first = (register * lanes).min(n - lanes);
                    *sum = simd.mul_add_e_f64s(
                        S::as_simd_f64s(&left[first..first + lanes]).0[0],
                        weight,
                        *sum,
                    );
                }
            }
            for (register, sum) in sums.iter().enumerate().take(registers) {
                let first = (register * lanes).min(n - lanes);
                S::as_mut_simd_f64s(&mut out[first..first + lanes]).0[0] = *sum;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::product::all_instructions;

    fn matrix(rows: usize, columns: usize) -> DMatrix<f64> {
        DMatrix::from_fn(rows, columns, |i, j| ((3 * i + 7 * j + 1) as f64).sin())
    }

    #[test]
    fn congruence_agrees_with_nalgebra_and_is_exactly_symmetric() {
        for (n, arch) in
            (1..=MOST_ROWS).flat_map(|n| all_instructions().into_iter().map(move |arch| (n, arch)))
        {
            let (a, root) = (matrix(n, n), matrix(n, n));
            let mut x = &root * root.transpose();
            x.fill_upper_triangle_with_lower_triangle();
            let mut out = DMatrix::repeat(n, n, f64::NAN);
            Congruence::new(&a).apply_to(arch, 0.5, &x, &mut out);
            assert!((&out - 0.5 * &a * &x * a.transpose()).amax() < 1e-12, "{n}");
            assert_eq!(out, out.transpose(), "{n}");
            let y = root.column(0).into_owned();
            let mut product = y.clone();
            Congruence::new(&a).mul_to(arch, y.as_slice(), product.as_mut_slice());
            assert!((product - a * y).amax() < 1e-13, "{n}");
        }
    }

    #[test]
    fn outer_products_are_subtracted_identically_from_both_triangles() {
        for (n, arch) in
            (1..=MOST_ROWS).flat_map(|n| all_instructions().into_iter().map(move |arch| (n, arch)))
        {
            let columns = 1 + n % 3;
            let (v, root) = (matrix(n, columns), matrix(n, n));
            let mut p = &root * root.transpose();
            p.fill_upper_triangle_with_lower_triangle();
            let mut out = p.clone();
            subtract_outer_mut(arch, &mut out, &v);
            assert!((&out - (&p - &v * v.transpose())).amax() < 1e-13, "{n}");
            assert_eq!(out, out.transpose(), "{n}");
            let mut product = v.clone();
            multiply_to(arch, &p, &v, &mut product);
            assert!((product - &p * v).amax() < 1e-12, "{n}");
        }
    }
}
