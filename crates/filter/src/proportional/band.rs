//! Square band matrices stored by diagonals, so that operations run along whole columns of numbers.

use super::polynomials::Polynomial;
use crate::product::{COLUMNS, MOST_LANES};
use nalgebra::DMatrix;
use pulp::bytemuck::cast_slice;
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// A band (N × N): entry `(i, i + d)` is entry `i` of diagonal `d`.
#[derive(Debug, Clone)]
pub(super) struct Band {
    n: usize,
    /// N, padded to whole registers.
    padded: usize,
    /// Distance from the diagonal beyond which entries are zero or stale.
    half_bandwidth: usize,
    /// All possible diagonals from the lowest one, each with zeros before and after it, and
    /// surrounded by diagonals of zeros.
    entries: Vec<f64>,
    /// Maximum half-bandwidth.
    most: usize,
    /// Number of zeros before and after each diagonal, and half the number of zero diagonals on
    /// each side.
    margin: usize,
}

impl Band {
    /// Allocates a band (N × N) of half-bandwidth up to `most`, for products with bands of
    /// half-bandwidth up to `margin`.
    pub(super) fn new(n: usize, most: usize, margin: usize) -> Self {
        let (most, padded) = (
            most.min(n.saturating_sub(1)),
            n.next_multiple_of(MOST_LANES),
        );
        let entries = vec![0.0; (2 * most + 4 * margin + 1) * (padded + 2 * margin)];
        Self {
            n,
            padded,
            half_bandwidth: 0,
            entries,
            most,
            margin,
        }
    }

    /// Returns N.
    pub(super) fn len(&self) -> usize {
        self.n
    }

    /// Returns the distance from the diagonal beyond which entries are zero.
    pub(super) fn half_bandwidth(&self) -> usize {
        self.half_bandwidth
    }

    /// Returns the number of entries in the band.
    pub(super) fn entry_count(&self) -> usize {
        (2 * self.half_bandwidth + 1) * self.n - self.half_bandwidth * (self.half_bandwidth + 1)
    }

    /// Sets the band to `factor` times the entries of a full matrix within `half_bandwidth` of the
    /// diagonal.
    pub(super) fn set(&mut self, matrix: &DMatrix<f64>, half_bandwidth: usize, factor: f64) {
        self.half_bandwidth = half_bandwidth.min(self.most);
        for (column, entries) in matrix.as_slice().chunks_exact(self.n).enumerate() {
            for row in around(column, self.half_bandwidth, self.n) {
                let place = self.place(column as isize - row as isize, row);
                self.entries[place] = factor * entries[row];
            }
        }
    }

    /// Returns the index of entry `(row, row + diagonal)`.
    #[inline(always)]
    fn place(&self, diagonal: isize, row: usize) -> usize {
        ((self.most + 2 * self.margin) as isize + diagonal) as usize
            * (self.padded + 2 * self.margin)
            + self.margin
            + row
    }

    /// Returns the entries of a diagonal, starting `shift` rows below its first row.
    #[inline(always)]
    fn diagonal(&self, diagonal: isize, shift: isize) -> &[f64] {
        let start = (self.place(diagonal, 0) as isize + shift) as usize;
        &self.entries[start..start + self.padded]
    }

    #[inline(always)]
    fn diagonal_mut(&mut self, diagonal: isize) -> &mut [f64] {
        let start = self.place(diagonal, 0);
        &mut self.entries[start..start + self.padded]
    }

    /// Returns the range of the diagonals within `half_bandwidth` of the main diagonal, including
    /// the zeros around each.
    #[inline(always)]
    fn all(&self, half_bandwidth: usize) -> Range<usize> {
        let (first, length) = (
            self.most + 2 * self.margin - half_bandwidth,
            self.padded + 2 * self.margin,
        );
        first * length..(first + 2 * half_bandwidth + 1) * length
    }

    /// Clears `2 width` diagonals on each side beyond `half_bandwidth`, which may be stale entries
    /// of a wider band.
    #[inline(always)]
    fn clear_around(&mut self, half_bandwidth: usize, width: usize) {
        let (inner, outer) = (
            self.all(half_bandwidth),
            self.all(half_bandwidth + 2 * width),
        );
        self.entries[outer.start..inner.start].fill(0.0);
        self.entries[inner.end..outer.end].fill(0.0);
    }

    /// Returns the distances of the diagonals from the main diagonal.
    fn diagonals(&self) -> std::ops::RangeInclusive<isize> {
        -(self.half_bandwidth as isize)..=self.half_bandwidth as isize
    }

    /// Computes `factor` times the columns `columns` and rows `rows` of the transpose.
    pub(super) fn transpose_to(
        &self,
        factor: f64,
        columns: &Range<usize>,
        rows: &Range<usize>,
        values: &mut [[f64; COLUMNS]],
    ) {
        let half = self.half_bandwidth;
        if columns.len() == COLUMNS && rows.len() == COLUMNS + 2 * half {
            // All entries are inside the matrix, so the copy runs along each diagonal.
            for (first, d) in self.diagonals().enumerate() {
                let entries = &self.diagonal(d, 0)[columns.clone()];
                for (lane, (values, entry)) in values[first..first + COLUMNS]
                    .iter_mut()
                    .zip(entries)
                    .enumerate()
                {
                    values[lane] = factor * entry;
                }
            }
            return;
        }
        let length = self.padded + 2 * self.margin;
        for (lane, row) in columns.clone().enumerate() {
            let reached = around(row, self.half_bandwidth, self.n);
            let reached = reached.start.max(rows.start)..reached.end.min(rows.end);
            let mut place = self.place(reached.start as isize - row as isize, row);
            for values in &mut values[reached.start - rows.start..reached.end - rows.start] {
                values[lane] = factor * self.entries[place];
                place += length;
            }
        }
    }

    /// Computes the product with a vector (N).
    pub(super) fn mul_to(&self, arch: Arch, x: &Padded, out: &mut Padded) {
        arch.dispatch(MulTo { band: self, x, out });
    }
}

/// A vector (N) for products with bands, with zeros before and after it.
#[derive(Debug, Clone)]
pub(super) struct Padded {
    n: usize,
    /// Number of zeros on each side, at least the half-bandwidth of a band.
    margin: usize,
    entries: Vec<f64>,
}

impl Padded {
    /// Allocates N entries for products with bands of half-bandwidth up to `margin`.
    pub(super) fn new(n: usize, margin: usize) -> Self {
        let margin = margin.min(n.saturating_sub(1));
        Self {
            n,
            margin,
            entries: vec![0.0; n.next_multiple_of(ROWS) + 2 * margin],
        }
    }

    pub(super) fn copy_from(&mut self, x: &[f64]) {
        self.as_mut_slice().copy_from_slice(x);
    }

    pub(super) fn as_slice(&self) -> &[f64] {
        &self.entries[self.margin..self.margin + self.n]
    }

    pub(super) fn as_mut_slice(&mut self) -> &mut [f64] {
        &mut self.entries[self.margin..self.margin + self.n]
    }
}

/// Number of vector rows whose sums stay in registers.
const ROWS: usize = 4 * MOST_LANES;

struct MulTo<'m> {
    band: &'m Band,
    x: &'m Padded,
    out: &'m mut Padded,
}

impl WithSimd for MulTo<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        for first in (0..self.band.padded).step_by(ROWS) {
            match (self.band.padded - first) / S::F64_LANES {
                1 => self.rows::<S, 1>(simd, first),
                2 => self.rows::<S, 2>(simd, first),
                3 => self.rows::<S, 3>(simd, first),
                _ if S::F64_LANES == MOST_LANES => self.rows::<S, 4>(simd, first),
                _ => {
                    for first in (first..(first + ROWS).min(self.band.padded)).step_by(S::F64_LANES)
                    {
                        self.rows::<S, 1>(simd, first);
                    }
                }
            }
        }
    }
}

impl MulTo<'_> {
    /// Computes `R` registers of rows, starting at row `first`.
    #[inline(always)]
    fn rows<S: Simd, const R: usize>(&mut self, simd: S, first: usize) {
        let Self { band, x, out } = self;
        let length = R * S::F64_LANES;
        if first >= out.n {
            return; // padding of the last register, stays zero
        }
        let mut sums = [simd.splat_f64s(0.0); R];
        for d in band.diagonals() {
            let ahead = (x.margin as isize + d) as usize + first;
            let (entries, _) = S::as_simd_f64s(&band.diagonal(d, 0)[first..first + length]);
            let (x, _) = S::as_simd_f64s(&x.entries[ahead..ahead + length]);
            for (sum, (entry, x)) in sums.iter_mut().zip(entries.iter().zip(x)) {
                *sum = simd.mul_add_e_f64s(*entry, *x, *sum);
            }
        }
        let last = (first + length).min(out.n);
        out.as_mut_slice()[first..last].copy_from_slice(&cast_slice(&sums)[..last - first]);
    }
}

/// Evaluates polynomials of one band `Z` into `sums`, with `powers` as scratch.
pub(super) struct Evaluate<'b, const N: usize> {
    pub(super) z: &'b Band,
    pub(super) powers: &'b mut [Band; 2],
    pub(super) polynomials: [&'b Polynomial; N],
    pub(super) sums: [&'b mut Band; N],
}

impl<const N: usize> WithSimd for Evaluate<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            z,
            powers: [power, next],
            polynomials,
            mut sums,
        } = self;
        for (polynomial, sum) in polynomials.iter().zip(&mut sums) {
            sum.half_bandwidth = (polynomial.degree * z.half_bandwidth).min(sum.most);
            let all = sum.all(sum.half_bandwidth);
            sum.entries[all].fill(0.0);
            sum.diagonal_mut(0)[..z.n].fill(polynomial.coefficients[0]);
        }
        power.half_bandwidth = 0;
        power.clear_around(0, z.half_bandwidth);
        power.diagonal_mut(0)[..z.n].fill(1.0);
        let degree = polynomials
            .iter()
            .map(|polynomial| polynomial.degree)
            .max()
            .unwrap_or(0);
        for k in 1..=degree {
            next.half_bandwidth = (z.half_bandwidth + power.half_bandwidth).min(next.most);
            next.clear_around(next.half_bandwidth, z.half_bandwidth);
            let mut first = 0;
            while first < z.padded {
                let registers = ((z.padded - first) / S::F64_LANES).min(5);
                let mut terms = Terms {
                    z,
                    power,
                    next,
                    polynomials,
                    sums: &mut sums,
                    k,
                    first,
                };
                match registers {
                    1 => terms.add::<S, 1>(simd),
                    2 => terms.add::<S, 2>(simd),
                    3 => terms.add::<S, 3>(simd),
                    4 => terms.add::<S, 4>(simd),
                    _ => terms.add::<S, 5>(simd),
                }
                first += registers * S::F64_LANES;
            }
            std::mem::swap(power, next);
        }
    }
}

/// Some rows of a power, and their contribution to the polynomials.
struct Terms<'e, 'b, const N: usize> {
    z: &'e Band,
    power: &'e Band,
    next: &'e mut Band,
    polynomials: [&'b Polynomial; N],
    sums: &'e mut [&'b mut Band; N],
    /// Exponent of the next power.
    k: usize,
    /// The first row.
    first: usize,
}

impl<const N: usize> Terms<'_, '_, N> {
    /// Computes `R` registers of rows of the next power and adds them to the sums.
    ///
    /// `(Z P)_{i, i+d} = Σ_e Z_{i, i+e} P_{i+e, i+d}`. The zero diagonals around all bands make
    /// special cases at the edges unnecessary.
    #[inline(always)]
    fn add<S: Simd, const R: usize>(&mut self, simd: S) {
        let Self {
            z,
            power,
            next,
            polynomials,
            sums,
            k,
            first,
        } = self;
        let rows = *first..*first + R * S::F64_LANES;
        let half = z.half_bandwidth as isize;
        for d in next.diagonals() {
            let mut product = [simd.splat_f64s(0.0); R];
            for e in -half..=half {
                let (z, _) = S::as_simd_f64s(&z.diagonal(e, 0)[rows.clone()]);
                let (p, _) = S::as_simd_f64s(&power.diagonal(d - e, e)[rows.clone()]);
                for (sum, (z, p)) in product.iter_mut().zip(z.iter().zip(p)) {
                    *sum = simd.mul_add_e_f64s(*z, *p, *sum);
                }
            }
            let (next, _) = S::as_mut_simd_f64s(&mut next.diagonal_mut(d)[rows.clone()]);
            for (entry, product) in next.iter_mut().zip(product) {
                *entry = product;
            }
            for (polynomial, sum) in polynomials.iter().zip(sums.iter_mut()) {
                if *k <= polynomial.degree {
                    let coefficient = simd.splat_f64s(polynomial.coefficients[*k]);
                    let (sum, _) = S::as_mut_simd_f64s(&mut sum.diagonal_mut(d)[rows.clone()]);
                    for (entry, product) in sum.iter_mut().zip(product) {
                        *entry = simd.mul_add_e_f64s(coefficient, product, *entry);
                    }
                }
            }
        }
    }
}

/// Returns the rows of a square matrix (n × n) within `half_bandwidth` of the diagonal in a column.
pub(super) fn around(column: usize, half_bandwidth: usize, n: usize) -> Range<usize> {
    column.saturating_sub(half_bandwidth)..(column + half_bandwidth + 1).min(n)
}
