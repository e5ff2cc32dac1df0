//! A step through the accelerations that displacements and parameters cause, where `G` has a narrow band.
//!
//! With `ρ = (−G x + W θ) h²`, few terms each, `x ← x + h q̂ ẋ + ŝ ρ` and `ẋ ← (I − Gs − (α + βG) q) ẋ + q̂ ρ/h` are two bands a
//! row in place of those of `[Φ, ΨW]`.

use super::band::{Band, Evaluate};
use super::polynomials::{LARGEST_DEGREE, Polynomials};
use super::{ProportionalForm, extend_by_reached, near};
use crate::product::{COLUMNS, Extent, Left, Multiplier, Piece, Product, Right, STRIP, Store, Sum, Target, strips};
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// What a step through the accelerations needs.
#[derive(Debug, Clone)]
pub(super) struct Accelerations {
    /// `h` (s)
    step_s: f64,
    /// `Z`, and two of its powers
    z: Band,
    powers: [Band; 2],
    /// `q̂`, `ŝ` and `I − Gs − (α + βG) q`
    impulse: Band,
    step: Band,
    velocity: Band,
    /// `h² W` (N_d × N_θ) at the point, and where it is not zero
    by_theta: DMatrix<f64>,
    reach: Vec<Range<usize>>,
    /// `[Z, 0, h² W]ᵀ` (n × N_d)
    by_state: Right,
    /// `[h q̂, ŝ]ᵀ` and `[I − Gs − (α + βG) q, q̂/h]ᵀ` (2N_d × N_d)
    by_motion: [Right; 2],
    /// `[Φ, ΨW] Σ` (2N_d × 2N_d)
    half_way: DMatrix<f64>,
    /// `ρ` of a strip of rows
    caused: DMatrix<f64>,
    /// scratch (N_d)
    columns: [DVector<f64>; 4],
    multiplier: Multiplier,
}

impl Accelerations {
    /// Makes room for the steps of a model of that form.
    pub(super) fn new(form: &ProportionalForm<'_>, multiplier: Multiplier) -> Self {
        let (free, parameters) = form.acceleration_by_theta.shape();
        let (n, margin) = (2 * free + parameters, form.half_bandwidth);
        let band = |degree: usize| Band::new(free, degree * form.half_bandwidth, margin);
        let by_motion = || Right::new(2 * free, free, 2);
        Self {
            step_s: 0.0,
            z: band(1),
            powers: [band(LARGEST_DEGREE), band(LARGEST_DEGREE)],
            impulse: band(LARGEST_DEGREE),
            step: band(LARGEST_DEGREE),
            velocity: band(LARGEST_DEGREE),
            by_theta: DMatrix::zeros(free, parameters),
            reach: form.reach.to_vec(),
            by_state: Right::new(n, free, 1 + parameters.div_ceil(2)),
            by_motion: [by_motion(), by_motion()],
            half_way: DMatrix::zeros(2 * free, 2 * free),
            caused: DMatrix::zeros(STRIP, free),
            columns: std::array::from_fn(|_| DVector::zeros(free)),
            multiplier,
        }
    }

    /// Tells whether a step has fewer terms this way than by the blocks of `[Φ, ΨW]`.
    pub(super) fn are_shorter(form: &ProportionalForm<'_>, polynomials: &Polynomials) -> bool {
        let free = form.stiffness.nrows();
        let band = |degree: usize| (2 * degree * form.half_bandwidth + 1).min(free);
        let reached: usize = form.reach.iter().map(ExactSizeIterator::len).sum();
        let of_bands =
            2 * band(polynomials.impulse.degree) + band(polynomials.step.degree) + band(polynomials.velocity.degree);
        let of_block = band(polynomials.degree() + 1);
        let spread = |reach: &Range<usize>| if reach.is_empty() { 0 } else { (reach.len() + of_block - 1).min(free) };
        let by_theta: usize = form.reach.iter().map(spread).sum();
        (band(1) + of_bands) * free + reached < 2 * (2 * of_block * free + by_theta)
    }

    /// Returns the number of terms by which a row of the covariance moves.
    pub(super) fn term_count(&self) -> usize {
        let bands = 2 * self.impulse.entry_count() + self.step.entry_count() + self.velocity.entry_count();
        self.z.entry_count() + self.reach.iter().map(ExactSizeIterator::len).sum::<usize>() + bands
    }

    /// Makes the step anew, of `step_s` (s).
    pub(super) fn set(&mut self, form: &ProportionalForm<'_>, step_s: f64, polynomials: &Polynomials) {
        let Self { z, powers, impulse, step, velocity, by_theta, by_state, .. } = self;
        let h = step_s;
        self.step_s = h;
        z.set(form.stiffness, form.half_bandwidth, -h * h);
        self.multiplier.arch().dispatch(Evaluate {
            z,
            powers,
            polynomials: [&polynomials.impulse, &polynomials.step, &polynomials.velocity],
            sums: [impulse, step, velocity],
        });
        let free = form.stiffness.nrows();
        let pairs = by_theta.as_mut_slice().chunks_exact_mut(free);
        let pairs = pairs.zip(form.acceleration_by_theta.as_slice().chunks_exact(free)).zip(form.reach);
        for ((column, by_theta), reach) in pairs {
            for (entry, by_theta) in column[reach.clone()].iter_mut().zip(&by_theta[reach.clone()]) {
                *entry = h * h * by_theta;
            }
        }
        if !by_state.is_packed() {
            // which entries are zero is the same at every point
            by_state.pack_with(
                free,
                |columns, runs| {
                    runs.push(near(&columns, form.half_bandwidth, free));
                    extend_by_reached(runs, 2 * free, form.reach, &columns);
                },
                |_, _, _| (),
            );
        }
        by_state.repack_with(|columns, run, values| {
            if run.start < free {
                z.transpose_to(1.0, columns, run, values);
            } else {
                for (parameter, values) in (run.start - 2 * free..).zip(values) {
                    let entries =
                        &by_theta.as_slice()[parameter * free + columns.start..parameter * free + columns.end];
                    for (value, entry) in values.iter_mut().zip(entries) {
                        *value = *entry;
                    }
                }
            }
        });
        let [of_x, of_v] = &mut self.by_motion;
        pack_pair(of_x, [(impulse, h), (step, 1.0)]);
        pack_pair(of_v, [(velocity, 1.0), (impulse, 1.0 / h)]);
    }

    /// Replaces `[g, B_y]` (n × (1 + N_f)) by `[Γ g + Γ₂ ramp, Γ B_y]`; the parameters at their ends stay zero.
    ///
    /// `rest`, `slope_of_z`: `−(α + βG) h = rest + slope_of_z Z`; `slope`: of the known accelerations (N_d).
    pub(super) fn integrate_inputs(
        &mut self,
        [rest, slope_of_z]: [f64; 2],
        polynomials: &Polynomials,
        inputs: &mut DMatrix<f64>,
        slope: Option<&[f64]>,
    ) {
        let Self { step_s: h, z, impulse, step, columns: [pushed, turned, moved, by_step], .. } = self;
        let arch = self.multiplier.arch();
        let free = pushed.len();
        for mut column in inputs.column_iter_mut() {
            let (velocity, rest_of_column) = column.as_mut_slice().split_at_mut(free);
            let acceleration = &mut rest_of_column[..free];
            let is_at_rest = velocity.iter().all(|entry| *entry == 0.0); // excitations move accelerations alone
            if is_at_rest {
                turned.fill(0.0);
            } else {
                step.mul_to(arch, velocity, pushed.as_mut_slice());
                z.mul_to(arch, pushed.as_slice(), turned.as_mut_slice()); // −G s ẋ
                impulse.mul_to(arch, velocity, moved.as_mut_slice());
                for (row, entry) in velocity.iter_mut().enumerate() {
                    *entry = *h * (moved[row] - rest * pushed[row] - slope_of_z * turned[row]); // (q + (α + βG) s) ẋ
                }
            }
            step.mul_to(arch, acceleration, by_step.as_mut_slice());
            impulse.mul_to(arch, acceleration, moved.as_mut_slice());
            for row in 0..free {
                velocity[row] += *h * *h * by_step[row]; // + s ẍ
                acceleration[row] = turned[row] + *h * moved[row]; // −G s ẋ + q ẍ
            }
        }
        if let Some(slope) = slope {
            // the integral of s, by Horner's rule
            moved.fill(0.0);
            for coefficient in polynomials.ramp.coefficients[..=polynomials.ramp.degree].iter().rev() {
                z.mul_to(arch, moved.as_slice(), turned.as_mut_slice());
                std::mem::swap(moved, turned);
                for (entry, slope) in moved.iter_mut().zip(slope) {
                    *entry += coefficient * slope;
                }
            }
            step.mul_to(arch, slope, by_step.as_mut_slice());
            let mut increment = inputs.column_mut(0);
            for row in 0..free {
                increment[row] += h.powi(3) * moved[row];
                increment[free + row] += *h * *h * by_step[row];
            }
        }
    }

    /// Writes `λ A_i Σ A_iᵀ` (n × n) into `out`, both triangles with the same bits.
    ///
    /// First all rows from the right; what has moved is turned at once, so that its rows can move from the right too.
    pub(super) fn propagate_covariance_to(&mut self, covariance: &DMatrix<f64>, fading: f64, out: &mut DMatrix<f64>) {
        let Self { by_state, by_motion, half_way, caused, multiplier, .. } = self;
        let (n, free) = (covariance.nrows(), caused.ncols());
        let moving = 2 * free;
        let mut strip = Strip { by_state, by_motion, caused, multiplier: *multiplier };
        let start = Piece::new(covariance);
        for rows in strips(n) {
            strip.accelerate(Left::whole(start), rows.clone(), Extent::Full);
            for half in [Half::Displacements(start), Half::Velocities] {
                let (transposed, mirrored) = (Target::new(half_way), Target::new(out));
                let store = Store::Split { transposed, split: moving, mirrored };
                strip.step(half, Piece::after(covariance, free), rows.clone(), Extent::Full, fading, store);
            }
        }
        let start = Piece::new(half_way);
        let reach = self.impulse.half_bandwidth().max(self.step.half_bandwidth());
        let (of_motion, of_parameters) = out.as_mut_slice().split_at_mut(moving * n);
        let of_parameters = Piece { entries: of_parameters, stride: n, first_row: 0 };
        for rows in strips(moving) {
            let wanted = if rows.end <= free { rows.end + COLUMNS + reach } else { free };
            strip.accelerate(Left::joined(start, moving, of_parameters), rows.clone(), Extent::Before(wanted));
            for half in [Half::Displacements(start), Half::Velocities] {
                let store = Store::Mirrored(Target { entries: of_motion, stride: n });
                let lower = Extent::Before(rows.end);
                strip.step(half, Piece::after(half_way, free), rows.clone(), lower, 1.0, store);
            }
            multiplier.mirror_square_mut(rows, &mut Target { entries: of_motion, stride: n });
        }
        for column in moving..n {
            let entries = column * n + moving..(column + 1) * n;
            let at_rest = &covariance.as_slice()[entries.clone()];
            for (entry, at_rest) in out.as_mut_slice()[entries].iter_mut().zip(at_rest) {
                *entry = fading * at_rest; // the parameters among themselves
            }
        }
    }

    /// Replaces `X` (n × c) by `A_i X`.
    pub(super) fn mul_mut(&mut self, x: &mut DMatrix<f64>) {
        let Self { step_s: h, z, impulse, step, velocity, by_theta, columns: [caused, term, other, _], .. } = self;
        let arch = self.multiplier.arch();
        let free = caused.len();
        for mut column in x.column_iter_mut() {
            let (displacements, rest) = column.as_mut_slice().split_at_mut(free);
            let (velocities, parameters) = rest.split_at_mut(free);
            z.mul_to(arch, displacements, caused.as_mut_slice());
            for (by_theta, theta) in by_theta.as_slice().chunks_exact(free).zip(parameters) {
                for (entry, by_theta) in caused.iter_mut().zip(by_theta) {
                    *entry += by_theta * *theta;
                }
            }
            impulse.mul_to(arch, velocities, term.as_mut_slice());
            step.mul_to(arch, caused.as_slice(), other.as_mut_slice());
            for (entry, (term, other)) in displacements.iter_mut().zip(term.iter().zip(other.iter())) {
                *entry += *h * term + other; // x + h q̂ ẋ + ŝ ρ
            }
            velocity.mul_to(arch, velocities, term.as_mut_slice());
            impulse.mul_to(arch, caused.as_slice(), other.as_mut_slice());
            for (entry, (term, other)) in velocities.iter_mut().zip(term.iter().zip(other.iter())) {
                *entry = term + other / *h;
            }
        }
    }
}

/// What moves some rows of a matrix `X` (m × n) to those of `X [Φ, ΨW]ᵀ`.
struct Strip<'m> {
    by_state: &'m Right,
    by_motion: &'m [Right; 2],
    caused: &'m mut DMatrix<f64>,
    multiplier: Multiplier,
}

/// Which columns of the motion.
enum Half<'m> {
    /// Those of displacements, which start from where they are.
    Displacements(Piece<'m>),
    Velocities,
}

impl Strip<'_> {
    /// Writes `ρ` for the rows of `x` (m × n).
    fn accelerate(&mut self, x: Left<'_>, rows: Range<usize>, extent: Extent) {
        let store = Store::Plain { target: Target::new(self.caused), first_row: rows.start };
        let (right, sum) = (self.by_state, Sum::PLAIN);
        self.multiplier.run(Product { left: x, rows, right, first_column: 0, extent, sum, store });
    }

    /// Writes half of the motion of the rows, given `ρ` and their columns of velocities.
    fn step(
        &self,
        half: Half<'_>,
        velocities: Piece<'_>,
        rows: Range<usize>,
        extent: Extent,
        factor: f64,
        store: Store<'_>,
    ) {
        let (free, first_row) = (self.caused.ncols(), rows.start);
        let left = Left::joined(velocities, free, Piece { first_row, ..Piece::new(self.caused) });
        let [of_x, of_v] = self.by_motion;
        let (right, first_column, start) = match half {
            Half::Displacements(start) => (of_x, 0, Some(start)),
            Half::Velocities => (of_v, free, None),
        };
        self.multiplier.run(Product { left, rows, right, first_column, extent, sum: Sum { factor, start }, store });
    }
}

/// Packs the transposes of two bands, each times a number, one below the other.
fn pack_pair(right: &mut Right, bands: [(&Band, f64); 2]) {
    let [(first, _), (second, _)] = bands;
    let n = first.len();
    right.pack_with(
        n,
        |columns, runs| {
            runs.push(near(&columns, first.half_bandwidth(), n));
            let of_second = near(&columns, second.half_bandwidth(), n);
            runs.push(n + of_second.start..n + of_second.end);
        },
        |columns, run, values| {
            let [first, second] = bands;
            let ((band, factor), skipped) = if run.start < n { (first, 0) } else { (second, n) };
            band.transpose_to(factor, columns, &(run.start - skipped..run.end - skipped), values);
        },
    );
}
