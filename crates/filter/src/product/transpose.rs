//! Transposition by tiles, which are read completely before they are written.

use super::{COLUMNS, Target};
use pulp::bytemuck::{Pod, cast_slice};
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// Number of rows and columns that are transposed together, equal to the columns of a product
/// block.
const TILE: usize = COLUMNS;

/// Maximum number of rows of a block: registers times lanes of the widest register.
const LONGEST: usize = 32;

impl Target<'_> {
    /// Writes a block to columns `columns`, starting at row `first`.
    #[inline(always)]
    pub(super) fn store<F: Pod, const R: usize>(
        &mut self,
        first: usize,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        let mut rest = &mut self.entries[columns.start * self.stride + first..];
        for (lane, entries) in block.iter().enumerate() {
            let entries = cast_slice::<F, f64>(entries);
            rest[..entries.len()].copy_from_slice(entries);
            if lane + 1 >= columns.len() {
                break;
            }
            rest = &mut rest[self.stride..];
        }
    }

    /// Writes the transpose of a block, or of its first rows and columns, to columns `rows` and
    /// rows `columns`.
    #[inline(always)]
    pub(super) fn scatter<F: Pod, const R: usize>(
        &mut self,
        rows: Range<usize>,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        let [a, b, c, d] = block;
        let (a, b, c, d) = (
            cast_slice(a),
            cast_slice(b),
            cast_slice(c),
            cast_slice::<F, f64>(d),
        );
        let mut turned = [[0.0; COLUMNS]; LONGEST];
        for (to, (((a, b), c), d)) in turned.iter_mut().zip(a.iter().zip(b).zip(c).zip(d)) {
            *to = [*a, *b, *c, *d];
        }
        let mut rest = &mut self.entries[rows.start * self.stride + columns.start..];
        let (turned, of_last) = turned[..rows.len()].split_at(rows.len() - 1);
        if columns.len() == COLUMNS {
            for turned in turned {
                rest[..COLUMNS].copy_from_slice(turned);
                rest = &mut rest[self.stride..];
            }
        } else {
            for turned in turned {
                for (entry, value) in rest[..columns.len()].iter_mut().zip(turned) {
                    *entry = *value;
                }
                rest = &mut rest[self.stride..];
            }
        }
        for (entry, value) in rest[..columns.len()]
            .iter_mut()
            .zip(of_last.iter().flatten())
        {
            *entry = *value;
        }
    }
}

/// Copies the entries of a square matrix below the diagonal to their mirror positions, for some
/// rows and as many columns.
pub(super) fn mirror_square(arch: Arch, rows: Range<usize>, entries: &mut [f64], stride: usize) {
    arch.dispatch(Mirror {
        rows,
        entries,
        stride,
    });
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
        let Self {
            rows: Range { start, end },
            entries,
            stride,
        } = self;
        let mut column = start;
        while column + TILE < end {
            // The columns before `below` contain the entries to copy. The later columns receive
            // them.
            let below = column + TILE;
            let (known, mut wanted) = entries.split_at_mut(below * stride);
            let known = &known[column * stride..];
            let rows = |index: usize| &known[index * stride + below..index * stride + end];
            let (a, b, c, d) = (rows(0), rows(1), rows(2), rows(3));
            let last = end - below - 1;
            for (row, (((a, b), c), d)) in a.iter().zip(b).zip(c).zip(d).enumerate() {
                wanted[column..below].copy_from_slice(&[*a, *b, *c, *d]);
                if row < last {
                    wanted = &mut wanted[stride..];
                }
            }
            column = below;
        }
        // The tiles on the diagonal.
        for row in start..end {
            for column in start + (row - start) / TILE * TILE..row {
                entries[row * stride + column] = entries[column * stride + row];
            }
        }
    }
}
