//! A step through the accelerations caused by displacements and parameters, for a `G` with a narrow
//! band.
//!
//! `ρ = (−G x + W θ) h²` has few terms. The step is `x ← x + h q̂ ẋ + ŝ ρ` and
//! `ẋ ← (I − Gs − (α + βG) q) ẋ + q̂ ρ/h`. Each row then needs two bands instead of the blocks of
//! `[Φ, ΨW]`.

use super::band::{Band, Evaluate, Padded};
use super::polynomials::{LARGEST_DEGREE, Polynomials};
use super::{ProportionalForm, extend_by_reached, near};
use crate::dense::add_scaled_slice_mut;
use crate::product::{
    COLUMNS, Extent, Left, Multiplier, Piece, Product, Right, STRIP, Store, Sum, Target, strips,
};
use nalgebra::DMatrix;
use std::ops::Range;

/// Storage of a step through the accelerations.
#[derive(Debug, Clone)]
pub(super) struct Accelerations {
    /// `h` (s).
    step_s: f64,
    /// `Z`, and two of its powers.
    z: Band,
    powers: [Band; 2],
    /// `q̂`, `ŝ` and `I − Gs − (α + βG) q`.
    impulse: Band,
    step: Band,
    velocity: Band,
    /// `h² W` (N_d × N_θ) at the linearisation point, and its non-zero rows.
    by_theta: DMatrix<f64>,
    reach: Vec<Range<usize>>,
    /// `[Z, 0, h² W]ᵀ` (n × N_d).
    by_state: Right,
    /// `[h q̂, ŝ]ᵀ` and `[I − Gs − (α + βG) q, q̂/h]ᵀ` (2N_d × N_d).
    by_motion: [PairOfBands; 2],
    /// `[Φ, ΨW] Σ` (2N_d × 2N_d).
    half_way: DMatrix<f64>,
    /// `ρ` of a strip of rows.
    caused: DMatrix<f64>,
    /// Scratch (N_d).
    columns: [Padded; 5],
    multiplier: Multiplier,
}

impl Accelerations {
    /// Allocates storage for the steps of a model of this form.
    pub(super) fn new(form: &ProportionalForm<'_>, multiplier: Multiplier) -> Self {
        let (free, parameters) = form.acceleration_by_theta.shape();
        let (n, margin) = (2 * free + parameters, form.half_bandwidth);
        let band = |degree: usize| Band::new(free, degree * form.half_bandwidth, margin);
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
            by_motion: [PairOfBands::new(free), PairOfBands::new(free)],
            half_way: DMatrix::zeros(2 * free, 2 * free),
            caused: DMatrix::zeros(STRIP, free),
            columns: std::array::from_fn(|_| {
                Padded::new(free, LARGEST_DEGREE * form.half_bandwidth)
            }),
            multiplier,
        }
    }

    /// Returns `true` if a step has fewer terms through the accelerations than by the blocks of
    /// `[Φ, ΨW]`.
    pub(super) fn are_shorter(form: &ProportionalForm<'_>, polynomials: &Polynomials) -> bool {
        let free = form.stiffness.nrows();
        let band = |degree: usize| (2 * degree * form.half_bandwidth + 1).min(free);
        let reached: usize = form.reach.iter().map(ExactSizeIterator::len).sum();
        let of_bands = 2 * band(polynomials.impulse.degree)
            + band(polynomials.step.degree)
            + band(polynomials.velocity.degree);
        let of_block = band(polynomials.degree() + 1);
        let spread = |reach: &Range<usize>| {
            if reach.is_empty() {
                0
            } else {
                (reach.len() + of_block - 1).min(free)
            }
        };
        let by_theta: usize = form.reach.iter().map(spread).sum();
        (band(1) + of_bands) * free + reached < 2 * (2 * of_block * free + by_theta)
    }

    /// Returns the number of terms in the transition of one covariance row.
    pub(super) fn term_count(&self) -> usize {
        let bands =
            2 * self.impulse.entry_count() + self.step.entry_count() + self.velocity.entry_count();
        self.z.entry_count() + self.reach.iter().map(ExactSizeIterator::len).sum::<usize>() + bands
    }

    /// Computes the matrices of a step of `step_s` (s).
    pub(super) fn set(
        &mut self,
        form: &ProportionalForm<'_>,
        step_s: f64,
        polynomials: &Polynomials,
    ) {
        let Self {
            z,
            powers,
            impulse,
            step,
            velocity,
            by_theta,
            by_state,
            ..
        } = self;
        let h = step_s;
        self.step_s = h;
        z.set(form.stiffness, form.half_bandwidth, -h * h);
        self.multiplier.arch().dispatch(Evaluate {
            z,
            powers,
            polynomials: [
                &polynomials.impulse,
                &polynomials.step,
                &polynomials.velocity,
            ],
            sums: [impulse, step, velocity],
        });
        let free = form.stiffness.nrows();
        let pairs = by_theta.as_mut_slice().chunks_exact_mut(free);
        let pairs = pairs
            .zip(form.acceleration_by_theta.as_slice().chunks_exact(free))
            .zip(form.reach);
        for ((column, by_theta), reach) in pairs {
            for (entry, by_theta) in column[reach.clone()]
                .iter_mut()
                .zip(&by_theta[reach.clone()])
            {
                *entry = h * h * by_theta;
            }
        }
        if !by_state.is_packed() {
            // The zero entries are the same at every point.
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
                    let entries = &by_theta.as_slice()
                        [parameter * free + columns.start..parameter * free + columns.end];
                    for (value, entry) in values.iter_mut().zip(entries) {
                        *value = *entry;
                    }
                }
            }
        });
        let [of_x, of_v] = &mut self.by_motion;
        of_x.pack([(impulse, h), (step, 1.0)]);
        of_v.pack([(velocity, 1.0), (impulse, 1.0 / h)]);
    }

    /// Replaces `[g, B_y]` (n × (1 + N_f)) by `[Γ g + Γ₂ ramp, Γ B_y]`; the parameter rows at the
    /// end stay zero.
    ///
    /// - `rest`, `slope_of_z`: `−(α + βG) h = rest + slope_of_z Z`
    /// - `slope`: slope of the known accelerations (N_d)
    pub(super) fn integrate_inputs(
        &mut self,
        [rest, slope_of_z]: [f64; 2],
        polynomials: &Polynomials,
        inputs: &mut DMatrix<f64>,
        slope: Option<&[f64]>,
    ) {
        let Self {
            step_s: h,
            z,
            impulse,
            step,
            columns: [x, pushed, turned, moved, by_step],
            ..
        } = self;
        let arch = self.multiplier.arch();
        let free = step.len();
        for mut column in inputs.column_iter_mut() {
            let (velocity, rest_of_column) = column.as_mut_slice().split_at_mut(free);
            let acceleration = &mut rest_of_column[..free];
            // Excitations change only accelerations.
            let is_at_rest = velocity.iter().all(|entry| *entry == 0.0);
            if is_at_rest {
                turned.as_mut_slice().fill(0.0);
            } else {
                x.copy_from(velocity);
                step.mul_to(arch, x, pushed);
                z.mul_to(arch, pushed, turned); // −G s ẋ
                impulse.mul_to(arch, x, moved);
                let terms = moved
                    .as_slice()
                    .iter()
                    .zip(pushed.as_slice())
                    .zip(turned.as_slice());
                for (entry, ((moved, pushed), turned)) in velocity.iter_mut().zip(terms) {
                    // (q + (α + βG) s) ẋ
                    *entry = *h * (moved - rest * pushed - slope_of_z * turned);
                }
            }
            x.copy_from(acceleration);
            step.mul_to(arch, x, by_step);
            impulse.mul_to(arch, x, moved);
            add_scaled_slice_mut(velocity, *h * *h, by_step.as_slice()); // + s ẍ
            for (entry, (turned, moved)) in acceleration
                .iter_mut()
                .zip(turned.as_slice().iter().zip(moved.as_slice()))
            {
                *entry = turned + *h * moved; // −G s ẋ + q ẍ
            }
        }
        if let Some(slope) = slope {
            // The integral of s, by Horner's rule.
            moved.as_mut_slice().fill(0.0);
            for coefficient in polynomials.ramp.coefficients[..=polynomials.ramp.degree]
                .iter()
                .rev()
            {
                z.mul_to(arch, moved, turned);
                std::mem::swap(moved, turned);
                add_scaled_slice_mut(moved.as_mut_slice(), *coefficient, slope);
            }
            x.copy_from(slope);
            step.mul_to(arch, x, by_step);
            let mut increment = inputs.column_mut(0);
            let (velocity, acceleration) = increment.as_mut_slice().split_at_mut(free);
            add_scaled_slice_mut(velocity, h.powi(3), moved.as_slice());
            add_scaled_slice_mut(acceleration, *h * *h, by_step.as_slice());
        }
    }

    /// Computes `λ A_i Σ A_iᵀ` (n × n) in `out`; both triangles are bit-identical.
    ///
    /// The first pass multiplies all rows from the right and transposes the result at once. The
    /// second pass can then multiply from the right too.
    pub(super) fn propagate_covariance_to(
        &mut self,
        covariance: &DMatrix<f64>,
        fading: f64,
        out: &mut DMatrix<f64>,
    ) {
        let Self {
            by_state,
            by_motion,
            half_way,
            caused,
            multiplier,
            ..
        } = self;
        let (n, free) = (covariance.nrows(), caused.ncols());
        let moving = 2 * free;
        let mut strip = Strip {
            by_state,
            by_motion,
            caused,
            multiplier: *multiplier,
        };
        let start = Piece::new(covariance);
        for rows in strips(n) {
            strip.accelerate(Left::whole(start), rows.clone(), Extent::Full);
            for half in [Half::Displacements(start), Half::Velocities] {
                let (transposed, mirrored) = (Target::new(half_way), Target::new(out));
                let store = Store::Split {
                    transposed,
                    split: moving,
                    mirrored,
                };
                strip.step(
                    half,
                    Piece::after(covariance, free),
                    rows.clone(),
                    Extent::Full,
                    fading,
                    store,
                );
            }
        }
        let start = Piece::new(half_way);
        let reach = self
            .impulse
            .half_bandwidth()
            .max(self.step.half_bandwidth());
        let (of_motion, of_parameters) = out.as_mut_slice().split_at_mut(moving * n);
        let of_parameters = Piece {
            entries: of_parameters,
            stride: n,
            first_row: 0,
        };
        for rows in strips(moving) {
            let wanted = if rows.end <= free {
                rows.end + COLUMNS + reach
            } else {
                free
            };
            strip.accelerate(
                Left::joined(start, moving, of_parameters),
                rows.clone(),
                Extent::Before(wanted),
            );
            for half in [Half::Displacements(start), Half::Velocities] {
                let store = Store::Mirrored(Target {
                    entries: of_motion,
                    stride: n,
                });
                let lower = Extent::Before(rows.end);
                strip.step(
                    half,
                    Piece::after(half_way, free),
                    rows.clone(),
                    lower,
                    1.0,
                    store,
                );
            }
            multiplier.mirror_square_mut(
                rows,
                &mut Target {
                    entries: of_motion,
                    stride: n,
                },
            );
        }
        for column in moving..n {
            let entries = column * n + moving..(column + 1) * n;
            let at_rest = &covariance.as_slice()[entries.clone()];
            for (entry, at_rest) in out.as_mut_slice()[entries].iter_mut().zip(at_rest) {
                *entry = fading * at_rest; // the parameter block
            }
        }
    }

    /// Replaces `X` (n × c) by `A_i X`.
    pub(super) fn mul_mut(&mut self, columns: &mut DMatrix<f64>) {
        let Self {
            step_s: h,
            z,
            impulse,
            step,
            velocity,
            by_theta,
            columns: [x, caused, term, other, _],
            ..
        } = self;
        let arch = self.multiplier.arch();
        let free = step.len();
        for mut column in columns.column_iter_mut() {
            let (displacements, rest) = column.as_mut_slice().split_at_mut(free);
            let (velocities, parameters) = rest.split_at_mut(free);
            x.copy_from(displacements);
            z.mul_to(arch, x, caused);
            for (by_theta, theta) in by_theta.as_slice().chunks_exact(free).zip(parameters) {
                add_scaled_slice_mut(caused.as_mut_slice(), *theta, by_theta);
            }
            x.copy_from(velocities);
            impulse.mul_to(arch, x, term);
            step.mul_to(arch, caused, other);
            for (entry, (term, other)) in displacements
                .iter_mut()
                .zip(term.as_slice().iter().zip(other.as_slice()))
            {
                *entry += *h * term + other; // x + h q̂ ẋ + ŝ ρ
            }
            velocity.mul_to(arch, x, term);
            impulse.mul_to(arch, caused, other);
            for (entry, (term, other)) in velocities
                .iter_mut()
                .zip(term.as_slice().iter().zip(other.as_slice()))
            {
                *entry = term + other / *h;
            }
        }
    }
}

/// The operands for rows of `X [Φ, ΨW]ᵀ` from rows of `X` (m × n).
struct Strip<'m> {
    by_state: &'m Right,
    by_motion: &'m [PairOfBands; 2],
    caused: &'m mut DMatrix<f64>,
    multiplier: Multiplier,
}

/// The half of the motion columns.
enum Half<'m> {
    /// Displacements, which start from their current values.
    Displacements(Piece<'m>),
    Velocities,
}

impl Strip<'_> {
    /// Computes `ρ` for the rows of `x` (m × n).
    fn accelerate(&mut self, x: Left<'_>, rows: Range<usize>, extent: Extent) {
        let store = Store::Plain {
            target: Target::new(self.caused),
            first_row: rows.start,
        };
        let (right, sum) = (self.by_state, Sum::PLAIN);
        self.multiplier.run(Product {
            left: x,
            rows,
            right,
            first_column: 0,
            extent,
            sum,
            store,
        });
    }

    /// Computes one half of the motion of the rows from `ρ` and their velocity columns.
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
        let left = Left::joined(
            velocities,
            free,
            Piece {
                first_row,
                ..Piece::new(self.caused)
            },
        );
        let [of_x, of_v] = self.by_motion;
        let (right, first_column, start) = match half {
            Half::Displacements(start) => (of_x, 0, Some(start)),
            Half::Velocities => (of_v, free, None),
        };
        let right = &right.right;
        self.multiplier.run(Product {
            left,
            rows,
            right,
            first_column,
            extent,
            sum: Sum { factor, start },
            store,
        });
    }
}

/// The transposes of two bands, each times a number, one below the other.
#[derive(Debug, Clone)]
struct PairOfBands {
    right: Right,
    half_bandwidths: [usize; 2],
}

impl PairOfBands {
    fn new(free: usize) -> Self {
        Self {
            right: Right::new(2 * free, free, 2),
            half_bandwidths: [0; 2],
        }
    }

    fn pack(&mut self, bands: [(&Band, f64); 2]) {
        let [(first, _), (second, _)] = bands;
        let n = first.len();
        let write = |columns: &Range<usize>, run: &Range<usize>, values: &mut [[f64; COLUMNS]]| {
            let [first, second] = bands;
            let ((band, factor), skipped) = if run.start < n {
                (first, 0)
            } else {
                (second, n)
            };
            band.transpose_to(
                factor,
                columns,
                &(run.start - skipped..run.end - skipped),
                values,
            );
        };
        let half_bandwidths = [first, second].map(Band::half_bandwidth);
        if self.right.is_packed() && self.half_bandwidths == half_bandwidths {
            // Entries outside the bands are still zero from the previous packing.
            self.right.repack_with(write);
            return;
        }
        self.half_bandwidths = half_bandwidths;
        let of_group = |columns: Range<usize>, runs: &mut Vec<Range<usize>>| {
            runs.push(near(&columns, first.half_bandwidth(), n));
            let of_second = near(&columns, second.half_bandwidth(), n);
            runs.push(n + of_second.start..n + of_second.end);
        };
        self.right.pack_with(n, of_group, write);
    }
}
