//! Products of dense matrices that allocate nothing and leave out what is known to be zero.
//!
//! The left factor is copied into strips of a few rows, so that the innermost loop runs over neighbours in memory and its sums
//! stay in registers (Goto & van de Geijn 2008, *ACM Trans. Math. Softw.* 34, 12). The order of every sum is fixed: a product
//! has the same bits on every machine of one instruction set.

use nalgebra::DMatrix;
use std::ops::Range;

/// Rows of a strip: eight registers of two doubles, which every 64-bit machine has to spare.
const ROWS: usize = 16;

/// The rows of a column of the right factor that meet entries of the left one which are not zero; the rest is left out.
pub(crate) type Spans = [Range<usize>; 3];

/// An entry of a product that is zero, or that nobody reads.
pub(crate) const NOTHING: Spans = [0..0, 0..0, 0..0];

/// The left factor of a product.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Left<'m> {
    /// The matrix itself.
    Plain(&'m DMatrix<f64>),
    /// Its transpose.
    Transposed(&'m DMatrix<f64>),
}

impl Left<'_> {
    fn nrows(self) -> usize {
        match self {
            Self::Plain(matrix) => matrix.nrows(),
            Self::Transposed(matrix) => matrix.ncols(),
        }
    }

    /// Copies the rows `rows` into `strip`, [`ROWS`] entries for each column; what a short strip lacks is left as it is.
    fn copy_rows_to(self, rows: Range<usize>, strip: &mut [f64]) {
        match self {
            Self::Plain(matrix) => {
                let columns = matrix.as_slice().chunks_exact(matrix.nrows());
                for (entries, column) in strip.chunks_exact_mut(ROWS).zip(columns) {
                    copy_rows(&column[rows.clone()], &mut entries[..rows.len()]);
                }
            }
            Self::Transposed(matrix) => {
                let rows_of_left = matrix.as_slice().chunks_exact(matrix.nrows()).skip(rows.start).take(rows.len());
                for (place, row) in rows_of_left.enumerate() {
                    for (entries, value) in strip.chunks_exact_mut(ROWS).zip(row) {
                        entries[place] = *value;
                    }
                }
            }
        }
    }
}

/// Scratch space of products, made once.
#[derive(Debug, Clone)]
pub(crate) struct Strip(Vec<f64>);

impl Strip {
    /// Makes room for left factors of at most `columns` columns.
    pub(crate) fn new(columns: usize) -> Self {
        Self(vec![0.0; ROWS * columns])
    }

    /// Writes `X Y` (m × c) into the first m rows of `out`, for `X` (m × k) and `Y` (k × c).
    ///
    /// `spans` says for some rows of `X` and a column of `Y` which of the k terms there are.
    pub(crate) fn multiply_to(
        &mut self,
        left: Left<'_>,
        right: &DMatrix<f64>,
        spans: impl Fn(Range<usize>, usize) -> Spans,
        out: &mut DMatrix<f64>,
    ) {
        let (rows, terms, stride) = (left.nrows(), right.nrows(), out.nrows());
        for first in (0..rows).step_by(ROWS) {
            let strip_rows = first..(first + ROWS).min(rows);
            left.copy_rows_to(strip_rows.clone(), &mut self.0);
            let columns = right.as_slice().chunks_exact(terms).zip(out.as_mut_slice().chunks_exact_mut(stride));
            for (index, (column, out)) in columns.enumerate() {
                let sums = sums_of_strip(&self.0, column, spans(strip_rows.clone(), index));
                copy_rows(&sums[..strip_rows.len()], &mut out[strip_rows.clone()]);
            }
        }
    }
}

/// Copies as many entries as there are, in registers where they fill a strip.
fn copy_rows(from: &[f64], to: &mut [f64]) {
    match (from.first_chunk::<ROWS>(), to.first_chunk_mut::<ROWS>()) {
        (Some(from), Some(to)) => *to = *from,
        _ => to.copy_from_slice(from),
    }
}

/// Returns a strip of rows times a column.
fn sums_of_strip(strip: &[f64], column: &[f64], spans: Spans) -> [f64; ROWS] {
    let mut sums = [0.0; ROWS];
    for span in spans {
        let entries = strip[span.start * ROWS..span.end * ROWS].chunks_exact(ROWS);
        for (entries, factor) in entries.zip(&column[span]) {
            for (sum, entry) in sums.iter_mut().zip(entries) {
                *sum += entry * factor;
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix(rows: usize, columns: usize) -> DMatrix<f64> {
        DMatrix::from_fn(rows, columns, |i, j| ((3 * i + 7 * j + 1) as f64).sin())
    }

    #[test]
    fn product_is_that_of_nalgebra() {
        // fewer rows than a strip, exactly one, and some more
        for rows in [3, ROWS, 2 * ROWS + 5] {
            let (left, right) = (matrix(rows, 21), matrix(21, 9));
            let expected = &left * &right;
            let (mut strip, mut out) = (Strip::new(21), DMatrix::repeat(rows + 2, 9, 7.0));
            strip.multiply_to(Left::Plain(&left), &right, |_, _| [0..4, 4..4, 4..21], &mut out);
            assert!((out.rows(0, rows) - &expected).amax() < 1e-14, "{rows} rows");
            assert!(out.rows(rows, 2).iter().all(|entry| *entry == 7.0), "{rows} rows");
            strip.multiply_to(Left::Transposed(&left.transpose()), &right, |_, _| [0..21, 0..0, 0..0], &mut out);
            assert!((out.rows(0, rows) - &expected).amax() < 1e-14, "{rows} rows, transposed");
        }
    }

    #[test]
    fn terms_outside_the_spans_are_left_out() {
        let (left, right) = (matrix(20, 20), matrix(20, 4));
        let (mut strip, mut out) = (Strip::new(20), DMatrix::repeat(20, 4, 7.0));
        let spans =
            |rows: Range<usize>, column| if rows.start == 0 { NOTHING } else { [column..column + 2, 9..9, 19..20] };
        strip.multiply_to(Left::Plain(&left), &right, spans, &mut out);
        for column in 0..4 {
            assert!(out.column(column).rows(0, ROWS).iter().all(|entry| *entry == 0.0));
            for row in ROWS..20 {
                let expected: f64 = [column, column + 1, 19].map(|k| left[(row, k)] * right[(k, column)]).iter().sum();
                assert!((out[(row, column)] - expected).abs() < 1e-15);
            }
        }
    }
}
