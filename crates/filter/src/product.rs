//! Products of dense matrices that do not allocate and skip known zeros.
//!
//! A strip of rows of the left factor, as many as registers hold, is multiplied by four columns of
//! the right factor at a time. Each loaded entry then serves several sums, which stay in registers
//! (Goto & van de Geijn 2008, *ACM Trans. Math. Softw.* 34, 12). Results that are needed transposed
//! or mirrored are transposed while they are in the nearest cache. The instruction set is selected
//! at run time. The order of every sum is fixed: a product is bit-identical on all machines with
//! one instruction set.

mod right;
mod transpose;

use nalgebra::DMatrix;
use pulp::bytemuck::Pod;
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;
use transpose::mirror_square;

pub(crate) use right::{COLUMNS, Right};

/// Maximum number of row registers in a strip.
///
/// With [`COLUMNS`] columns, it uses sixteen sums, which is half of the registers of wide
/// instruction sets.
const MOST_REGISTERS: usize = 4;

/// Number of rows that pass through all their columns before the next rows; a multiple of the
/// register size.
pub(crate) const STRIP: usize = 32;

/// Number of lanes of the widest register.
pub(crate) const MOST_LANES: usize = 8;

/// Returns the strips of `rows` rows.
///
/// The last strip starts early enough to fill registers. Entries that are computed twice have the
/// same bits.
pub(crate) fn strips(rows: usize) -> impl Iterator<Item = Range<usize>> {
    (0..rows).step_by(STRIP).map(move |first| {
        let end = (first + STRIP).min(rows);
        end - (end - first).next_multiple_of(MOST_LANES).min(end)..end
    })
}

/// Consecutive columns of a matrix, from some row on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Piece<'m> {
    /// The entries from the first row of the first column.
    pub(crate) entries: &'m [f64],
    /// Distance from one column to the next.
    pub(crate) stride: usize,
    /// Index of the first stored row.
    pub(crate) first_row: usize,
}

impl<'m> Piece<'m> {
    /// Returns all columns of a matrix.
    pub(crate) fn new(matrix: &'m DMatrix<f64>) -> Self {
        Self::after(matrix, 0)
    }

    /// Returns the columns of a matrix from `column` on.
    pub(crate) fn after(matrix: &'m DMatrix<f64>, column: usize) -> Self {
        let stride = matrix.nrows();
        Self {
            entries: &matrix.as_slice()[column * stride..],
            stride,
            first_row: 0,
        }
    }
}

/// The left factor (m × k), in one or two pieces.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Left<'m> {
    first: Piece<'m>,
    /// Column at which the second piece starts.
    second_from: usize,
    second: Piece<'m>,
}

impl<'m> Left<'m> {
    pub(crate) fn new(matrix: &'m DMatrix<f64>) -> Self {
        Self::whole(Piece::new(matrix))
    }

    pub(crate) fn whole(piece: Piece<'m>) -> Self {
        Self {
            first: piece,
            second_from: usize::MAX,
            second: piece,
        }
    }

    /// Joins the first `columns` columns of one piece and all columns of another piece.
    pub(crate) fn joined(first: Piece<'m>, columns: usize, second: Piece<'m>) -> Self {
        Self {
            first,
            second_from: columns,
            second,
        }
    }
}

/// The required entries of a product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Extent {
    /// All entries.
    Full,
    /// The groups of columns that start before this column of the target. The other entries stay
    /// unchanged.
    Before(usize),
    /// The entries up to this distance from the diagonal. The other entries are zero, because both
    /// factors are banded.
    Band(usize),
}

/// The form of the result: `factor · (Z + X Y)`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sum<'m> {
    pub(crate) factor: f64,
    /// `Z`, with the rows and columns of the product; `None` for zero.
    pub(crate) start: Option<Piece<'m>>,
}

impl Sum<'_> {
    /// The unscaled product.
    pub(crate) const PLAIN: Self = Self::scaled(1.0);

    /// Returns the product times a number.
    pub(crate) const fn scaled(factor: f64) -> Self {
        Self {
            factor,
            start: None,
        }
    }
}

/// The destination of a product, stored by columns.
#[derive(Debug)]
pub(crate) struct Target<'m> {
    pub(crate) entries: &'m mut [f64],
    pub(crate) stride: usize,
}

impl<'m> Target<'m> {
    pub(crate) fn new(matrix: &'m mut DMatrix<f64>) -> Self {
        let stride = matrix.nrows();
        Self {
            entries: matrix.as_mut_slice(),
            stride,
        }
    }
}

/// The storage of a product.
#[derive(Debug)]
pub(crate) enum Store<'m> {
    /// Unchanged. The target starts with row `first_row` of the left factor.
    Plain {
        target: Target<'m>,
        first_row: usize,
    },
    /// Both the product and its mirror across the diagonal, for the columns before the requested
    /// rows.
    Mirrored(Target<'m>),
    /// Rows before `split` transposed; the other rows unchanged and mirrored in another target.
    Split {
        transposed: Target<'m>,
        split: usize,
        mirrored: Target<'m>,
    },
}

/// A product of some rows of the left factor.
#[derive(Debug)]
pub(crate) struct Product<'m> {
    pub(crate) left: Left<'m>,
    pub(crate) rows: Range<usize>,
    pub(crate) right: &'m Right,
    /// Target column of the first product column; `extent` counts target columns.
    pub(crate) first_column: usize,
    pub(crate) extent: Extent,
    pub(crate) sum: Sum<'m>,
    pub(crate) store: Store<'m>,
}

/// Returns all instruction sets of this processor, because a correct result with one does not prove
/// another.
#[cfg(test)]
pub(crate) fn all_instructions() -> Vec<Arch> {
    let mut all = vec![Arch::Scalar, Arch::new()];
    #[cfg(target_arch = "x86_64")]
    all.extend(pulp::x86::V3::try_new().map(Arch::V3));
    all
}

/// Multiplies with the best instruction set of the processor.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Multiplier(Arch);

impl Multiplier {
    pub(crate) fn new() -> Self {
        Self::with(Arch::new())
    }

    /// Creates a multiplier with a certain instruction set.
    pub(crate) fn with(arch: Arch) -> Self {
        Self(arch)
    }

    /// Returns the instruction set.
    pub(crate) fn arch(self) -> Arch {
        self.0
    }

    /// Computes a product.
    pub(crate) fn run(self, product: Product<'_>) {
        let Product {
            left,
            rows,
            right,
            first_column,
            extent,
            sum: Sum { factor, start },
            store,
        } = product;
        let order = Order {
            left,
            rows,
            right,
            first_column,
            extent,
            factor,
        };
        // Each pair has its own compiled code, so that the inner blocks need no decision.
        match (store, start) {
            (Store::Plain { target, first_row }, None) => {
                self.sum(order, Nothing, Plain { target, first_row })
            }
            (Store::Plain { target, first_row }, Some(start)) => {
                self.sum(order, start, Plain { target, first_row })
            }
            (Store::Mirrored(target), None) => self.sum(order, Nothing, Mirrored(target)),
            (Store::Mirrored(target), Some(start)) => self.sum(order, start, Mirrored(target)),
            (
                Store::Split {
                    transposed,
                    split,
                    mirrored,
                },
                None,
            ) => {
                self.sum(
                    order,
                    Nothing,
                    Split {
                        transposed,
                        split,
                        mirrored,
                    },
                );
            }
            (
                Store::Split {
                    transposed,
                    split,
                    mirrored,
                },
                Some(start),
            ) => {
                self.sum(
                    order,
                    start,
                    Split {
                        transposed,
                        split,
                        mirrored,
                    },
                );
            }
        }
    }

    fn sum(self, order: Order<'_>, start: impl Start, keep: impl Destination) {
        self.0.dispatch(Strips {
            order,
            place: Between { start, keep },
        });
    }

    /// Computes the product of `left` (m × k) and `right` (k × c) in the first columns of `out`
    /// (m rows).
    pub(crate) fn multiply_to(
        self,
        left: Left<'_>,
        right: &Right,
        extent: Extent,
        sum: Sum<'_>,
        out: &mut DMatrix<f64>,
    ) {
        let rows = 0..out.nrows();
        debug_assert!(out.ncols() >= right.columns);
        let store = Store::Plain {
            target: Target::new(out),
            first_row: 0,
        };
        self.run(Product {
            left,
            rows,
            right,
            first_column: 0,
            extent,
            sum,
            store,
        });
    }

    /// Computes the transposed product of `left` (m × k) and `right` (k × c) in the first rows of
    /// `out` (m columns).
    pub(crate) fn multiply_transposed_to(
        self,
        left: Left<'_>,
        right: &Right,
        sum: Sum<'_>,
        out: &mut DMatrix<f64>,
    ) {
        let split = out.ncols();
        let nothing = Target {
            entries: &mut [],
            stride: 0,
        };
        let store = Store::Split {
            transposed: Target::new(out),
            split,
            mirrored: nothing,
        };
        self.run(Product {
            left,
            rows: 0..split,
            right,
            first_column: 0,
            extent: Extent::Full,
            sum,
            store,
        });
    }

    /// Computes a symmetric product of `left` (m × k) and `right` (k × m) in the first rows and
    /// columns of `out`.
    ///
    /// Both triangles are bit-identical.
    pub(crate) fn multiply_symmetric_to(
        self,
        left: Left<'_>,
        right: &Right,
        sum: Sum<'_>,
        out: &mut DMatrix<f64>,
    ) {
        for rows in strips(right.columns) {
            let (extent, store) = (Extent::Before(rows.end), Store::Mirrored(Target::new(out)));
            self.run(Product {
                left,
                rows: rows.clone(),
                right,
                first_column: 0,
                extent,
                sum,
                store,
            });
            self.mirror_square_mut(rows, &mut Target::new(out));
        }
    }

    /// Adds a symmetric product of `left` (m × k) and `right` (k × m) to a symmetric matrix (m × m)
    /// in place.
    ///
    /// Both triangles are bit-identical. The function also writes the resulting diagonal (m) while
    /// it is in the nearest cache.
    pub(crate) fn add_symmetric_mut(
        self,
        left: Left<'_>,
        right: &Right,
        matrix: &mut DMatrix<f64>,
        diagonal: &mut [f64],
    ) {
        let n = matrix.nrows();
        let odd = n % MOST_LANES;
        // No row may be added twice. The rows that do not fill a register come first, one by one,
        // because the fewest columns precede them.
        let whole = (odd..n)
            .step_by(STRIP)
            .map(|first| first..(first + STRIP).min(n));
        for rows in (0..odd).map(|row| row..row + 1).chain(whole) {
            let extent = Extent::Before(rows.end);
            let order = Order {
                left,
                rows: rows.clone(),
                right,
                first_column: 0,
                extent,
                factor: 1.0,
            };
            self.0.dispatch(Strips {
                order,
                place: InPlace(Mirrored(Target::new(matrix))),
            });
            self.mirror_square_mut(rows.clone(), &mut Target::new(matrix));
            for row in rows {
                diagonal[row] = matrix[(row, row)];
            }
        }
    }

    /// Copies the entries below the diagonal to their mirror positions above it, for some rows and
    /// as many columns.
    pub(crate) fn mirror_square_mut(self, rows: Range<usize>, target: &mut Target<'_>) {
        mirror_square(self.0, rows, target.entries, target.stride);
    }
}

/// The terms of a product, without the start values and the destination of its sums.
#[derive(Debug)]
struct Order<'m> {
    left: Left<'m>,
    rows: Range<usize>,
    right: &'m Right,
    first_column: usize,
    extent: Extent,
    factor: f64,
}

/// The start values of the sums of a block.
trait Start: Copy {
    fn sums<S: Simd, const R: usize>(
        self,
        simd: S,
        first: usize,
        columns: &Range<usize>,
    ) -> [[S::f64s; R]; COLUMNS];
}

/// Zero as the start value.
#[derive(Debug, Clone, Copy)]
struct Nothing;

impl Start for Nothing {
    #[inline(always)]
    fn sums<S: Simd, const R: usize>(
        self,
        simd: S,
        _: usize,
        _: &Range<usize>,
    ) -> [[S::f64s; R]; COLUMNS] {
        [[simd.splat_f64s(0.0); R]; COLUMNS]
    }
}

impl Start for Piece<'_> {
    #[inline(always)]
    fn sums<S: Simd, const R: usize>(
        self,
        simd: S,
        first: usize,
        columns: &Range<usize>,
    ) -> [[S::f64s; R]; COLUMNS] {
        let mut sums = [[simd.splat_f64s(0.0); R]; COLUMNS];
        let mut rest = &self.entries[columns.start * self.stride + first - self.first_row..];
        for (lane, sums) in sums.iter_mut().enumerate() {
            let (entries, _) = S::as_simd_f64s(&rest[..R * S::F64_LANES]);
            for (sum, entry) in sums.iter_mut().zip(entries) {
                *sum = *entry;
            }
            if lane + 1 >= columns.len() {
                break;
            }
            rest = &rest[self.stride..];
        }
        sums
    }
}

/// The destination of a block.
trait Destination {
    /// Stores a block. `before` is the first of all requested rows.
    fn keep<F: Pod, const R: usize>(
        &mut self,
        before: usize,
        rows: Range<usize>,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    );

    /// Stores zeros.
    fn clear(&mut self, rows: &Range<usize>, columns: Range<usize>);
}

struct Plain<'m> {
    target: Target<'m>,
    first_row: usize,
}

impl Destination for Plain<'_> {
    #[inline(always)]
    fn keep<F: Pod, const R: usize>(
        &mut self,
        _: usize,
        rows: Range<usize>,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        self.target
            .store(rows.start - self.first_row, columns, block);
    }

    fn clear(&mut self, rows: &Range<usize>, columns: Range<usize>) {
        for column in columns {
            let start = column * self.target.stride + rows.start - self.first_row;
            self.target.entries[start..start + rows.len()].fill(0.0);
        }
    }
}

struct Mirrored<'m>(Target<'m>);

impl Destination for Mirrored<'_> {
    #[inline(always)]
    fn keep<F: Pod, const R: usize>(
        &mut self,
        before: usize,
        rows: Range<usize>,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        self.0.store(rows.start, columns.clone(), block);
        if columns.start < before {
            // Entries beside the diagonal are mirrored later, together with the complete square.
            self.0
                .scatter(rows, columns.start..columns.end.min(before), block);
        }
    }

    fn clear(&mut self, _: &Range<usize>, _: Range<usize>) {} // no caller combines it with a band
}

struct Split<'m> {
    transposed: Target<'m>,
    split: usize,
    mirrored: Target<'m>,
}

impl Destination for Split<'_> {
    #[inline(always)]
    fn keep<F: Pod, const R: usize>(
        &mut self,
        _: usize,
        rows: Range<usize>,
        columns: Range<usize>,
        block: &[[F; R]; COLUMNS],
    ) {
        if rows.start < self.split {
            self.transposed
                .scatter(rows.start..rows.end.min(self.split), columns.clone(), block);
        }
        if rows.end > self.split {
            self.mirrored.store(rows.start, columns.clone(), block);
            self.mirrored.scatter(rows, columns, block);
        }
    }

    fn clear(&mut self, _: &Range<usize>, _: Range<usize>) {}
}

/// The start values and the destination of sums.
trait Accumulator {
    type Destination: Destination;

    fn sums<S: Simd, const R: usize>(
        &self,
        simd: S,
        first: usize,
        columns: &Range<usize>,
    ) -> [[S::f64s; R]; COLUMNS];

    fn keep_mut(&mut self) -> &mut Self::Destination;
}

/// Separate start values and destination.
struct Between<B, K> {
    start: B,
    keep: K,
}

impl<B: Start, K: Destination> Accumulator for Between<B, K> {
    type Destination = K;

    #[inline(always)]
    fn sums<S: Simd, const R: usize>(
        &self,
        simd: S,
        first: usize,
        columns: &Range<usize>,
    ) -> [[S::f64s; R]; COLUMNS] {
        self.start.sums::<S, R>(simd, first, columns)
    }

    #[inline(always)]
    fn keep_mut(&mut self) -> &mut K {
        &mut self.keep
    }
}

/// A matrix that is both start value and destination.
struct InPlace<'m>(Mirrored<'m>);

impl<'m> Accumulator for InPlace<'m> {
    type Destination = Mirrored<'m>;

    #[inline(always)]
    fn sums<S: Simd, const R: usize>(
        &self,
        simd: S,
        first: usize,
        columns: &Range<usize>,
    ) -> [[S::f64s; R]; COLUMNS] {
        let Target { entries, stride } = &self.0.0;
        Piece {
            entries,
            stride: *stride,
            first_row: 0,
        }
        .sums::<S, R>(simd, first, columns)
    }

    #[inline(always)]
    fn keep_mut(&mut self) -> &mut Mirrored<'m> {
        &mut self.0
    }
}

struct Strips<'m, P> {
    order: Order<'m>,
    place: P,
}

impl<P: Accumulator> WithSimd for Strips<'_, P> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, lanes) = (self.order.rows.clone(), S::F64_LANES);
        if rows.len() < lanes {
            for row in rows {
                self.strip::<pulp::Scalar, 1>(pulp::Scalar, row);
            }
            return;
        }
        // Sixteen registers hold three times four sums and their operands.
        let most = if lanes > 4 {
            MOST_REGISTERS
        } else {
            MOST_REGISTERS - 1
        };
        let mut done = rows.start;
        while done < rows.end {
            // The last strip starts early enough to fill its registers. Entries that are computed
            // twice have the same bits.
            let wanted = (rows.end - done).div_ceil(lanes).min(most);
            let registers = wanted.min(rows.len() / lanes);
            let first = done.min(rows.end - registers * lanes);
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

impl<P: Accumulator> Strips<'_, P> {
    /// Computes `R` registers of rows, starting at row `first`.
    #[inline(always)]
    fn strip<S: Simd, const R: usize>(&mut self, simd: S, first: usize) {
        let Order {
            left,
            rows: Range { start: before, .. },
            right,
            first_column,
            extent,
            factor,
        } = self.order;
        let rows = first..first + R * S::F64_LANES;
        let (mut first_run, mut first_value, mut first_of_group) = (0, 0, 0);
        for &(run_end, value_end) in &right.ends {
            let (runs, values) = (
                &right.runs[first_run..run_end],
                &right.values[first_value..value_end],
            );
            let columns = first_of_group..(first_of_group + COLUMNS).min(right.columns);
            (first_run, first_value, first_of_group) = (run_end, value_end, columns.end);
            let target = columns.start + first_column..columns.end + first_column;
            match extent {
                Extent::Before(end) if target.start >= end => return,
                Extent::Band(half)
                    if rows.end + half <= target.start || target.end + half <= rows.start =>
                {
                    self.place.keep_mut().clear(&rows, target);
                    continue;
                }
                _ => {}
            }
            let mut sums = left.add_to::<S, R>(
                simd,
                first,
                runs,
                values,
                self.place.sums::<S, R>(simd, first, &columns),
            );
            if factor != 1.0 {
                let factor = simd.splat_f64s(factor);
                for sums in &mut sums {
                    for sum in sums {
                        // A closure would not be compiled with the selected instruction set.
                        *sum = simd.mul_f64s(factor, *sum);
                    }
                }
            }
            self.place
                .keep_mut()
                .keep(before, rows.clone(), target, &sums);
        }
    }
}

impl Left<'_> {
    /// Adds the product of `R` registers of rows from row `first` and some columns of the right
    /// factor.
    #[inline(always)]
    fn add_to<S: Simd, const R: usize>(
        self,
        simd: S,
        first: usize,
        runs: &[Range<usize>],
        mut values: &[[f64; COLUMNS]],
        mut sums: [[S::f64s; R]; COLUMNS],
    ) -> [[S::f64s; R]; COLUMNS] {
        for run in runs {
            let (of_run, rest) = values.split_at(run.len());
            values = rest;
            let (
                Piece {
                    entries,
                    stride,
                    first_row,
                },
                start,
            ) = match run.start.checked_sub(self.second_from) {
                Some(start) => (self.second, start),
                None => (self.first, run.start),
            };
            let mut place = start * stride + first - first_row;
            for factors in of_run {
                let (entries, _) = S::as_simd_f64s(&entries[place..place + R * S::F64_LANES]);
                for (sums, factor) in sums.iter_mut().zip(factors) {
                    let factor = simd.splat_f64s(*factor);
                    for (sum, entry) in sums.iter_mut().zip(entries) {
                        *sum = simd.mul_add_e_f64s(*entry, factor, *sum);
                    }
                }
                place += stride;
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests;
