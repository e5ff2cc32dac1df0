//! Transposes, by tiles that are read whole before they are written.

use super::{COLUMNS, Target};
use pulp::bytemuck::{Pod, cast_slice};
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// Rows and columns that are transposed together: as many as there are columns in a block of a product.
const TILE: usize = COLUMNS;

/// Most rows of a block: registers times the lanes of the widest.
const LONGEST: usize = 32;

impl Target<'_> {
    /// Writes a block to columns `columns`, from row `first` on.
    #[inline(always)]
    pub(super) fn store<F: Pod, const R: usize>(
        &mut self,
        first: usize,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        for (column, entries) in columns.zip(block) {
            let (place, entries) = (column * self.stride + first, cast_slice::<F, f64>(entries));
            self.entries[place..place + entries.len()].copy_from_slice(entries);
        }
    }

    /// Writes the transpose of a block, or of its first rows and columns: to columns `rows` of rows `columns`.
    #[inline(always)]
    pub(super) fn scatter<F: Pod, const R: usize>(
        &mut self,
        rows: Range<usize>,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        let [a, b, c, d] = block;
        let (a, b, c, d) = (cast_slice(a), cast_slice(b), cast_slice(c), cast_slice::<F, f64>(d));
        let mut turned = [[0.0; COLUMNS]; LONGEST];
        for (to, (((a, b), c), d)) in turned.iter_mut().zip(a.iter().zip(b).zip(c).zip(d)) {
            *to = [*a, *b, *c, *d];
        }
        let first = rows.start * self.stride + columns.start;
        let last = first + (rows.len() - 1) * self.stride;
        let (before, last_row) = self.entries.split_at_mut(last);
        let (turned, of_last) = turned[..rows.len()].split_at(rows.len() - 1);
        let rows = before[first..].chunks_exact_mut(self.stride).zip(turned);
        if columns.len() == COLUMNS {
            for (to, turned) in rows {
                to[..COLUMNS].copy_from_slice(turned);
            }
        } else {
            for (to, turned) in rows {
                for (entry, value) in to[..columns.len()].iter_mut().zip(turned) {
                    *entry = *value;
                }
            }
        }
        for (entry, value) in last_row[..columns.len()].iter_mut().zip(of_last.iter().flatten()) {
            *entry = *value;
        }
    }
}

/// Copies what is below the diagonal of a square matrix to the place above it, for some rows and as many columns.
pub(super) fn mirror_square(arch: Arch, rows: Range<usize>, entries: &mut [f64], stride: usize) {
    arch.dispatch(Mirror { rows, entries, stride });
}

struct Mirror<'m> {
    rows: Range<usize>,
    entries: &'m mut [f64],
    stride: usize,
}

impl WithSimd for Mirror<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { rows: Range { start, end }, entries, stride } = self;
        let whole = start + (end - start) / TILE * TILE;
        for row in (start + TILE..whole).step_by(TILE) {
            // the columns before `row` hold what is copied, the others receive it
            let (known, wanted) = entries.split_at_mut(row * stride);
            for column in (start..row).step_by(TILE) {
                transpose_tile(&known[column * stride + row..], &mut wanted[column..], stride);
            }
        }
        // on the diagonal, and below the last whole tile
        for row in start..end {
            let first = if row < whole { start + (row - start) / TILE * TILE } else { start };
            for column in first..row {
                entries[row * stride + column] = entries[column * stride + row];
            }
        }
    }
}

/// Copies the transpose of a tile: `from` and `to` begin at its first entry, columns `stride` apart.
#[inline(always)]
fn transpose_tile(from: &[f64], to: &mut [f64], stride: usize) {
    let column = |index: usize| from.get(index * stride..)?.first_chunk::<TILE>().copied();
    let (Some(a), Some(b), Some(c), Some(d)) = (column(0), column(1), column(2), column(3)) else {
        return;
    };
    for row in 0..TILE {
        if let Some(to) = to.get_mut(row * stride..).and_then(<[f64]>::first_chunk_mut::<TILE>) {
            *to = [a[row], b[row], c[row], d[row]];
        }
    }
}
