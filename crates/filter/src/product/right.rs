//! Packed right factors of products.

use nalgebra::DMatrix;
use std::ops::Range;

/// Number of right-factor columns that are multiplied together.
pub(crate) const COLUMNS: usize = 4;

/// The right factor of a product (k × c), packed in read order, without rows of zeros.
#[derive(Debug, Clone, Default)]
pub(crate) struct Right {
    pub(super) columns: usize,
    /// Runs of rows of all groups of [`COLUMNS`] columns.
    pub(super) runs: Vec<Range<usize>>,
    /// Ends of each group in `runs` and in `values`.
    pub(super) ends: Vec<(usize, usize)>,
    /// Rows of the groups, run by run.
    pub(super) values: Vec<[f64; COLUMNS]>,
}

impl Right {
    /// Reserves space for factors up to `rows` × `columns`, with up to `runs` runs of rows in each
    /// group of columns.
    pub(crate) fn new(rows: usize, columns: usize, runs: usize) -> Self {
        let groups = columns.div_ceil(COLUMNS);
        Self {
            columns: 0,
            runs: Vec::with_capacity(groups * runs),
            ends: Vec::with_capacity(groups),
            values: Vec::with_capacity(groups * rows),
        }
    }

    /// Packs a full matrix (k × c).
    pub(crate) fn pack(&mut self, matrix: &DMatrix<f64>) {
        let rows = matrix.nrows();
        self.pack_runs(matrix, |_, runs| runs.push(0..rows));
    }

    /// Packs a square matrix as a band; entries farther than `half_bandwidth` from the diagonal
    /// count as zero.
    pub(crate) fn pack_band(&mut self, matrix: &DMatrix<f64>, half_bandwidth: usize) {
        let n = matrix.nrows();
        let of_group = |columns: Range<usize>, runs: &mut Vec<Range<usize>>| {
            runs.push(
                columns.start.saturating_sub(half_bandwidth)..(columns.end + half_bandwidth).min(n),
            );
        };
        self.pack_with(n, of_group, |columns, run, values| {
            for (lane, column) in columns.clone().enumerate() {
                let start = column.saturating_sub(half_bandwidth);
                let entries = &matrix.as_slice()
                    [column * n + start..column * n + (column + half_bandwidth + 1).min(n)];
                for (values, entry) in values[start - run.start..].iter_mut().zip(entries) {
                    values[lane] = *entry;
                }
            }
        });
    }

    /// Packs a matrix (k × c) without the rows that are zero in a whole group of columns.
    pub(crate) fn pack_sparse(&mut self, matrix: &DMatrix<f64>) {
        self.pack_runs(matrix, |columns, runs| {
            let first_run = runs.len();
            let entries =
                &matrix.as_slice()[columns.start * matrix.nrows()..columns.end * matrix.nrows()];
            for row in 0..matrix.nrows() {
                if entries[row..]
                    .iter()
                    .step_by(matrix.nrows())
                    .any(|entry| *entry != 0.0)
                {
                    match runs[first_run..].last_mut() {
                        Some(run) if run.end == row => run.end += 1,
                        _ => runs.push(row..row + 1),
                    }
                }
            }
        });
    }

    /// Packs a matrix (k × c) that probably has the same zeros as the previous one.
    pub(crate) fn repack_sparse(&mut self, matrix: &DMatrix<f64>) {
        let entry_count = matrix
            .as_slice()
            .iter()
            .filter(|entry| **entry != 0.0)
            .count();
        let mut found = 0;
        if self.is_packed() {
            self.repack_with(|columns, run, values| {
                for (lane, column) in columns.clone().enumerate() {
                    let start = column * matrix.nrows();
                    let entries = &matrix.as_slice()[start + run.start..start + run.end];
                    for (values, entry) in values.iter_mut().zip(entries) {
                        values[lane] = *entry;
                        found += usize::from(*entry != 0.0);
                    }
                }
            });
        }
        if found < entry_count {
            self.pack_sparse(matrix); // one of the skipped entries is not zero
        }
    }

    /// Packs a matrix (k × c) whose entries outside certain runs of rows are zero.
    ///
    /// `of_group` appends the runs for a group of columns in increasing order.
    pub(crate) fn pack_runs(
        &mut self,
        matrix: &DMatrix<f64>,
        of_group: impl FnMut(Range<usize>, &mut Vec<Range<usize>>),
    ) {
        let rows = matrix.nrows();
        self.pack_with(matrix.ncols(), of_group, |columns, run, values| {
            for (lane, column) in columns.clone().enumerate() {
                let entries =
                    &matrix.as_slice()[column * rows + run.start..column * rows + run.end];
                for (values, entry) in values.iter_mut().zip(entries) {
                    values[lane] = *entry;
                }
            }
        });
    }

    /// Packs the values that `write` stores for each group of columns and each of its runs.
    ///
    /// `of_group` appends the runs of a group. All values are zero before `write`.
    pub(crate) fn pack_with(
        &mut self,
        columns: usize,
        mut of_group: impl FnMut(Range<usize>, &mut Vec<Range<usize>>),
        write: impl FnMut(&Range<usize>, &Range<usize>, &mut [[f64; COLUMNS]]),
    ) {
        self.clear(columns);
        let mut values = 0;
        for columns in column_groups(columns) {
            let first = self.runs.len();
            of_group(columns, &mut self.runs);
            values += self.runs[first..].iter().map(Range::len).sum::<usize>();
            self.ends.push((self.runs.len(), values));
        }
        self.values.resize(values, [0.0; COLUMNS]);
        self.repack_with(write);
    }

    /// Packs with the runs of rows and the values of the previous packing, which `write`
    /// overwrites.
    pub(crate) fn repack_with(
        &mut self,
        mut write: impl FnMut(&Range<usize>, &Range<usize>, &mut [[f64; COLUMNS]]),
    ) {
        let (mut start, mut values) = (0, self.values.as_mut_slice());
        for (columns, (end, _)) in column_groups(self.columns).zip(&self.ends) {
            for run in &self.runs[start..*end] {
                let (of_run, rest) = values.split_at_mut(run.len());
                write(&columns, run, of_run);
                values = rest;
            }
            start = *end;
        }
    }

    /// Returns the number of terms in one row of the product.
    pub(crate) fn term_count(&self) -> usize {
        COLUMNS * self.values.len()
    }

    /// Returns `true` if a factor has been packed.
    pub(crate) fn is_packed(&self) -> bool {
        !self.ends.is_empty()
    }

    fn clear(&mut self, columns: usize) {
        self.columns = columns;
        self.runs.clear();
        self.ends.clear();
        self.values.clear();
    }
}

/// Returns the columns of each group.
#[inline(always)]
fn column_groups(columns: usize) -> impl Iterator<Item = Range<usize>> {
    (0..columns)
        .step_by(COLUMNS)
        .map(move |first| first..(first + COLUMNS).min(columns))
}
