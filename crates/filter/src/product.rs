//! Products of dense matrices that allocate nothing and leave out what is known to be zero.
//!
//! A strip of rows of the left factor, as many as registers hold, meets four columns of the right one at a time: every entry
//! that is loaded then serves several sums, which stay in registers (Goto & van de Geijn 2008, *ACM Trans. Math. Softw.* 34,
//! 12). The instructions are chosen when the program runs. The order of every sum is fixed: a product has the same bits on
//! every machine of one instruction set.

mod transpose;

use nalgebra::DMatrix;
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// Columns of the right factor that are multiplied together.
const COLUMNS: usize = 4;

/// Registers of rows in a strip: with [`COLUMNS`] of them sixteen sums, half of the registers of wide instruction sets.
const MOST_REGISTERS: usize = 4;

/// The right factor of a product (k × c), packed in the order in which it is read.
#[derive(Debug, Clone, Default)]
pub(crate) struct Right {
    columns: usize,
    /// Runs of rows of all groups of [`COLUMNS`] columns.
    runs: Vec<Range<usize>>,
    /// Where the runs of a group end.
    ends: Vec<usize>,
    /// [`COLUMNS`] values for each row of each run.
    values: Vec<f64>,
}

impl Right {
    /// Makes room for factors of at most `rows` × `columns`, with up to `runs` runs of rows in each group of columns.
    pub(crate) fn new(rows: usize, columns: usize, runs: usize) -> Self {
        let groups = columns.div_ceil(COLUMNS);
        Self {
            columns: 0,
            runs: Vec::with_capacity(groups * runs),
            ends: Vec::with_capacity(groups),
            values: Vec::with_capacity(groups * COLUMNS * rows),
        }
    }

    /// Packs a full matrix (k × c).
    pub(crate) fn pack(&mut self, matrix: &DMatrix<f64>) {
        let rows = matrix.nrows();
        self.pack_runs(matrix, |_, runs| runs.push(0..rows));
    }

    /// Packs a square matrix whose entries farther than `half_bandwidth` from the diagonal are zero, whatever they hold.
    pub(crate) fn pack_band(&mut self, matrix: &DMatrix<f64>, half_bandwidth: usize) {
        self.pack_bands([(matrix, 1.0)], half_bandwidth);
    }

    /// Does so for several of them, one below the other, each times a number.
    pub(crate) fn pack_bands<const N: usize>(&mut self, matrices: [(&DMatrix<f64>, f64); N], half_bandwidth: usize) {
        let n = matrices.first().map_or(0, |(matrix, _)| matrix.nrows());
        self.clear(n);
        for columns in groups(n) {
            let run = columns.start.saturating_sub(half_bandwidth)..(columns.end + half_bandwidth).min(n);
            for (place, (matrix, factor)) in matrices.iter().enumerate() {
                let first_value = self.values.len();
                self.values.resize(first_value + COLUMNS * run.len(), 0.0);
                for (lane, column) in columns.clone().enumerate() {
                    let start = column.saturating_sub(half_bandwidth);
                    let entries =
                        &matrix.as_slice()[column * n + start..column * n + (column + half_bandwidth + 1).min(n)];
                    let values = self.values[first_value + COLUMNS * (start - run.start) + lane..].iter_mut();
                    for (value, entry) in values.step_by(COLUMNS).zip(entries) {
                        *value = factor * entry;
                    }
                }
                self.runs.push(place * n + run.start..place * n + run.end);
            }
            self.ends.push(self.runs.len());
        }
    }

    /// Packs a matrix (k × c) without the rows that are zero throughout a group of columns.
    pub(crate) fn pack_sparse(&mut self, matrix: &DMatrix<f64>) {
        self.pack_runs(matrix, |columns, runs| {
            let first_run = runs.len();
            for row in 0..matrix.nrows() {
                if columns.clone().any(|column| matrix[(row, column)] != 0.0) {
                    match runs[first_run..].last_mut() {
                        Some(run) if run.end == row => run.end += 1,
                        _ => runs.push(row..row + 1),
                    }
                }
            }
        });
    }

    /// Packs a matrix (k × c) whose entries are zero outside the runs of rows, increasing, that `of_group` adds for some columns.
    pub(crate) fn pack_runs(&mut self, matrix: &DMatrix<f64>, of_group: impl Fn(Range<usize>, &mut Vec<Range<usize>>)) {
        self.clear(matrix.ncols());
        for columns in groups(matrix.ncols()) {
            of_group(columns, &mut self.runs);
            self.ends.push(self.runs.len());
        }
        self.repack(matrix);
    }

    /// Packs a matrix (k × c) with zeros where the one before had them.
    pub(crate) fn repack(&mut self, matrix: &DMatrix<f64>) {
        let rows = matrix.nrows();
        self.values.clear();
        let mut start = 0;
        for (columns, end) in groups(self.columns).zip(&self.ends) {
            for run in &self.runs[start..*end] {
                let first_value = self.values.len();
                self.values.resize(first_value + COLUMNS * run.len(), 0.0);
                let values = self.values[first_value..].as_chunks_mut::<COLUMNS>().0;
                for (place, column) in columns.clone().enumerate() {
                    let entries = &matrix.as_slice()[column * rows + run.start..column * rows + run.end];
                    for (values, entry) in values.iter_mut().zip(entries) {
                        values[place] = *entry;
                    }
                }
            }
            start = *end;
        }
    }

    /// Tells whether a factor has been packed.
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
fn groups(columns: usize) -> impl Iterator<Item = Range<usize>> {
    (0..columns).step_by(COLUMNS).map(move |first| first..(first + COLUMNS).min(columns))
}

/// The left factor (m × k): columns one after the other, in one or two pieces.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Left<'m> {
    entries: &'m [f64],
    rows: usize,
    /// Where the second piece begins (column), and its entries.
    second: (usize, &'m [f64]),
}

impl<'m> Left<'m> {
    pub(crate) fn new(matrix: &'m DMatrix<f64>) -> Self {
        Self { entries: matrix.as_slice(), rows: matrix.nrows(), second: (usize::MAX, &[]) }
    }

    /// Joins the columns `columns` of one matrix and all of another, with as many rows.
    pub(crate) fn joined(first: &'m DMatrix<f64>, columns: Range<usize>, second: &'m DMatrix<f64>) -> Self {
        let rows = first.nrows();
        debug_assert_eq!(second.nrows(), rows);
        let entries = &first.as_slice()[columns.start * rows..columns.end * rows];
        Self { entries, rows, second: (columns.len(), second.as_slice()) }
    }
}

/// Which entries of a product are wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Extent {
    /// All of them.
    Full,
    /// Those on and below a line parallel to the diagonal, in row `column + from`; some above it are written too, the others stay
    /// as they are.
    Lower {
        /// 0 for the diagonal itself.
        from: isize,
    },
    /// Those not farther from the diagonal than this; the others are zero, because both factors have a band.
    Band(usize),
}

impl Extent {
    /// The diagonal and what is below it.
    pub(crate) const LOWER: Self = Self::Lower { from: 0 };

    /// Tells whether there is something to sum for a block.
    fn meets(self, rows: &Range<usize>, columns: &Range<usize>) -> bool {
        match self {
            Self::Full => true,
            Self::Lower { from } => rows.end as isize > columns.start as isize + from,
            Self::Band(half) => rows.end + half > columns.start && columns.end + half > rows.start,
        }
    }
}

/// What becomes of a product: `factor · (Z + X Y)`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sum<'m> {
    pub(crate) factor: f64,
    /// `Z`, of the rows and columns of the target; nothing for zero.
    pub(crate) start: Option<&'m DMatrix<f64>>,
}

impl Sum<'_> {
    /// The product as it is.
    pub(crate) const PLAIN: Self = Self::scaled(1.0);

    /// The product times a number.
    pub(crate) const fn scaled(factor: f64) -> Self {
        Self { factor, start: None }
    }
}

/// Multiplies with the best instructions that the processor has.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Multiplier(Arch);

impl Multiplier {
    pub(crate) fn new() -> Self {
        Self(Arch::new())
    }

    /// Writes the product of `left` (m × k) and `right` (k × c) into the first rows of the first columns of `out`.
    pub(crate) fn multiply_to(
        self,
        left: Left<'_>,
        right: &Right,
        extent: Extent,
        sum: Sum<'_>,
        out: &mut DMatrix<f64>,
    ) {
        self.multiply_to_columns(left, right, extent, sum, 0, out);
    }

    /// Does so from column `first` of `out` on; `extent` counts columns from there.
    pub(crate) fn multiply_to_columns(
        self,
        left: Left<'_>,
        right: &Right,
        extent: Extent,
        sum: Sum<'_>,
        first: usize,
        out: &mut DMatrix<f64>,
    ) {
        let out_stride = out.nrows();
        debug_assert!(out_stride >= left.rows && out.ncols() >= first + right.columns);
        let out = &mut out.as_mut_slice()[first * out_stride..];
        self.0.dispatch(Product { left, right, extent, sum, out, out_stride });
    }
}

struct Product<'m> {
    left: Left<'m>,
    right: &'m Right,
    extent: Extent,
    sum: Sum<'m>,
    out: &'m mut [f64],
    out_stride: usize,
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, lanes) = (self.left.rows, S::F64_LANES);
        if rows < lanes {
            for row in 0..rows {
                self.strip::<pulp::Scalar, 1>(pulp::Scalar, row);
            }
            return;
        }
        // sixteen registers hold three times four sums beside what they are made of
        let most = if lanes > 4 { MOST_REGISTERS } else { MOST_REGISTERS - 1 };
        let mut done = 0;
        while done < rows {
            // the last strip is moved up until it is full: what is summed twice has the same bits
            let wanted = (rows - done).div_ceil(lanes).min(most);
            let registers = wanted.min(rows / lanes);
            let first = done.min(rows - registers * lanes);
            match registers {
                1 => self.strip::<S, 1>(simd, first),
                2 => self.strip::<S, 2>(simd, first),
                3 => self.strip::<S, 3>(simd, first),
                _ => self.strip::<S, MOST_REGISTERS>(simd, first),
            }
            done = first + registers * lanes;
        }
    }
}

impl Product<'_> {
    /// Writes `R` registers of rows from row `first` on.
    #[inline(always)]
    fn strip<S: Simd, const R: usize>(&mut self, simd: S, first: usize) {
        let Right { columns, runs, ends, values } = self.right;
        let rows = first..first + R * S::F64_LANES;
        let (mut start, mut values) = (0, values.as_slice());
        for (columns, end) in groups(*columns).zip(ends) {
            let len: usize = runs[start..*end].iter().map(|run| COLUMNS * run.len()).sum();
            let (of_group, rest) = values.split_at(len);
            values = rest;
            if self.extent.meets(&rows, &columns) {
                let sums = self.left.sums::<S, R>(simd, first, &runs[start..*end], of_group);
                self.store(simd, rows.clone(), columns, sums);
            } else if matches!(self.extent, Extent::Band(_)) {
                for column in columns {
                    let entries = column * self.out_stride + rows.start..column * self.out_stride + rows.end;
                    self.out[entries].fill(0.0);
                }
            }
            start = *end;
        }
    }

    /// Writes a block of the product.
    #[inline(always)]
    fn store<S: Simd, const R: usize>(
        &mut self,
        simd: S,
        rows: Range<usize>,
        columns: Range<usize>,
        sums: [[S::f64s; R]; COLUMNS],
    ) {
        for (column, sums) in columns.zip(sums) {
            let entries = column * self.out_stride + rows.start..column * self.out_stride + rows.end;
            let (out, _) = S::as_mut_simd_f64s(&mut self.out[entries]);
            let factor = simd.splat_f64s(self.sum.factor);
            match self.sum.start {
                None => {
                    for (out, sum) in out.iter_mut().zip(sums) {
                        *out = simd.mul_f64s(factor, sum);
                    }
                }
                Some(matrix) => {
                    let stride = matrix.nrows();
                    let entries = column * stride + rows.start..column * stride + rows.end;
                    let (start, _) = S::as_simd_f64s(&matrix.as_slice()[entries]);
                    for ((out, sum), start) in out.iter_mut().zip(sums).zip(start) {
                        *out = simd.mul_f64s(factor, simd.add_f64s(*start, sum));
                    }
                }
            }
        }
    }
}

impl Left<'_> {
    /// Returns `R` registers of rows from row `first` on, times some columns of the right factor.
    #[inline(always)]
    fn sums<S: Simd, const R: usize>(
        self,
        simd: S,
        first: usize,
        runs: &[Range<usize>],
        mut values: &[f64],
    ) -> [[S::f64s; R]; COLUMNS] {
        let mut sums = [[simd.splat_f64s(0.0); R]; COLUMNS];
        for run in runs {
            let (of_run, rest) = values.split_at(COLUMNS * run.len());
            values = rest;
            if run.is_empty() {
                continue;
            }
            let (entries, start) = match run.start.checked_sub(self.second.0) {
                Some(start) => (self.second.1, start),
                None => (self.entries, run.start),
            };
            let columns = entries[start * self.rows + first..].chunks(self.rows);
            for (column, factors) in columns.zip(of_run.as_chunks::<COLUMNS>().0) {
                let (entries, _) = S::as_simd_f64s(&column[..R * S::F64_LANES]);
                for (sums, factor) in sums.iter_mut().zip(factors) {
                    let factor = simd.splat_f64s(*factor);
                    for (sum, entry) in sums.iter_mut().zip(entries) {
                        *sum = simd.mul_add_e_f64s(*entry, factor, *sum);
                    }
                }
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests;
