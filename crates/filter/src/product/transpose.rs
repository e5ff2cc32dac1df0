//! Transposes, by tiles that are read whole before they are written.

use super::Multiplier;
use nalgebra::DMatrix;
use pulp::{Simd, WithSimd};

/// Rows and columns that are transposed together, so that both places stay in the nearest memory.
const TILE: usize = 4;

impl Multiplier {
    /// Writes the transpose of `matrix` (m × n) into `out` (n × m).
    pub(crate) fn transpose_to(self, matrix: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let (rows, columns) = matrix.shape();
        self.0.dispatch(Transpose { from: matrix.as_slice(), rows, columns, out: out.as_mut_slice() });
    }

    /// Copies what is below the diagonal of a square matrix to the place above it.
    pub(crate) fn mirror_lower_mut(self, matrix: &mut DMatrix<f64>) {
        let n = matrix.nrows();
        self.0.dispatch(Mirror { n, entries: matrix.as_mut_slice() });
    }
}

/// Copies the transpose of a tile: `from` begins at its first entry, columns `stride` apart; so does `to`.
#[inline(always)]
fn transpose_tile(from: &[f64], stride: usize, to: &mut [f64], to_stride: usize) {
    let column = |index: usize| from.get(index * stride..)?.first_chunk::<TILE>().copied();
    let (Some(a), Some(b), Some(c), Some(d)) = (column(0), column(1), column(2), column(3)) else {
        return;
    };
    for row in 0..TILE {
        if let Some(to) = to.get_mut(row * to_stride..).and_then(<[f64]>::first_chunk_mut::<TILE>) {
            *to = [a[row], b[row], c[row], d[row]];
        }
    }
}

struct Transpose<'m> {
    from: &'m [f64],
    rows: usize,
    columns: usize,
    out: &'m mut [f64],
}

impl WithSimd for Transpose<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { from, rows, columns, out } = self;
        let (whole_rows, whole_columns) = (rows / TILE * TILE, columns / TILE * TILE);
        for column in (0..whole_columns).step_by(TILE) {
            for row in (0..whole_rows).step_by(TILE) {
                transpose_tile(&from[column * rows + row..], rows, &mut out[row * columns + column..], columns);
            }
        }
        for column in 0..columns {
            let first = if column < whole_columns { whole_rows } else { 0 };
            for row in first..rows {
                out[row * columns + column] = from[column * rows + row];
            }
        }
    }
}

struct Mirror<'m> {
    n: usize,
    entries: &'m mut [f64],
}

impl WithSimd for Mirror<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { n, entries } = self;
        let whole = n / TILE * TILE;
        for row in (TILE..whole).step_by(TILE) {
            // the columns before `row` hold what is copied, the others receive it
            let (known, wanted) = entries.split_at_mut(row * n);
            for column in (0..row).step_by(TILE) {
                transpose_tile(&known[column * n + row..], n, &mut wanted[column..], n);
            }
        }
        // on the diagonal, and below the last whole tile
        for row in 0..n {
            let first = if row < whole { row / TILE * TILE } else { 0 };
            for column in first..row {
                entries[row * n + column] = entries[column * n + row];
            }
        }
    }
}
