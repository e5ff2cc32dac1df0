//! A step by the blocks of `[Φ, ΨW]`, for fully coupled structures and for steps that require
//! doubling.

use super::band::around;
use super::polynomials::Polynomials;
use super::{ProportionalForm, Substep, extend_by_reached, near};
use crate::dense::add_scaled_mut;
use crate::product::{Extent, Left, Multiplier, Right, Sum};
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// Number of precomputed powers of `Z`.
///
/// About the square root of the usual degree, which minimises the number of products.
const POWERS: usize = 4;

/// Storage of a step by blocks.
///
/// All polynomials are stored transposed, because they are right factors of products with the
/// covariance.
#[derive(Debug, Clone)]
pub(super) struct Blocks {
    /// `h` (s): the time step, halved until one series covers it.
    substep_s: f64,
    /// Distance from the diagonal beyond which the polynomials of `G` are zero.
    half_bandwidth: usize,
    /// `Z` to `Z⁴`.
    powers: [DMatrix<f64>; POWERS],
    /// `q̂` and `Z q̂`.
    impulse: DMatrix<f64>,
    z_impulse: DMatrix<f64>,
    /// `ŝ` and `Z ŝ`.
    step: DMatrix<f64>,
    z_step: DMatrix<f64>,
    /// `∫ s dt b / h³` for the slope `b` of the known accelerations (N_d).
    ramp: DVector<f64>,
    /// Scratch (N_d × N_d).
    square: [DMatrix<f64>; 2],
    /// Scratch (N_d).
    column: [DVector<f64>; 2],
    /// `[Φ, ΨW]ᵀ` (n × 2N_d).
    transposed: DMatrix<f64>,
    /// Distance from the diagonal beyond which its motion blocks are zero.
    transposed_half_bandwidth: usize,
    /// `[Φ, ΨW] Σ` (2N_d × n).
    half_way: DMatrix<f64>,
    /// `Wᵀ` (N_θ × N_d).
    theta_by_acceleration: DMatrix<f64>,
    /// `Wᵀ sᵀ` or `Wᵀ qᵀ` (N_θ × N_d).
    by_theta: DMatrix<f64>,
    /// Scratch (2N_d).
    motion: DVector<f64>,
    /// Right factors: `Z`, another polynomial of `Z`, and `[Φ, ΨW]ᵀ`.
    by_z: Right,
    by_square: Right,
    by_transition: Right,
    multiplier: Multiplier,
}

impl Blocks {
    /// Allocates storage for the steps of a model of this form.
    pub(super) fn new(form: &ProportionalForm<'_>, multiplier: Multiplier) -> Self {
        let (free, parameters) = form.acceleration_by_theta.shape();
        let n = 2 * free + parameters;
        let square = || DMatrix::zeros(free, free);
        let column = || DVector::zeros(free);
        Self {
            substep_s: 0.0,
            half_bandwidth: 0,
            powers: std::array::from_fn(|_| square()),
            impulse: square(),
            z_impulse: square(),
            step: square(),
            z_step: square(),
            ramp: column(),
            square: [square(), square()],
            column: [column(), column()],
            transposed: DMatrix::zeros(n, 2 * free),
            transposed_half_bandwidth: 0,
            half_way: DMatrix::zeros(2 * free, n),
            theta_by_acceleration: DMatrix::zeros(parameters, free),
            by_theta: DMatrix::zeros(parameters, free),
            motion: DVector::zeros(2 * free),
            by_z: Right::new(free, free, 1),
            by_square: Right::new(free, free, 1),
            by_transition: Right::new(n, 2 * free, 2 + parameters.div_ceil(2)),
            multiplier,
        }
    }

    /// Computes a step, and integrates the inputs.
    ///
    /// It replaces `[g, B_y]` as [`Transition::discretise`](super::Transition::discretise) does.
    ///
    /// - `damping`: `rest` and `slope` in `−(α + βG) h = rest + slope Z`
    /// - `slope`: slope of the known accelerations (N_d)
    pub(super) fn discretise(
        &mut self,
        form: &ProportionalForm<'_>,
        substep: Substep,
        damping: [f64; 2],
        polynomials: &Polynomials,
        inputs: &mut DMatrix<f64>,
        slope: Option<&[f64]>,
    ) {
        self.substep_s = substep.length_s;
        self.raise_to_powers(form);
        self.evaluate(form, polynomials, slope);
        for _ in 0..substep.doublings {
            self.double(damping, slope);
        }
        self.integrate_inputs(damping, inputs, slope);
        self.assemble(damping, form);
        self.pack(form.reach);
    }

    /// Returns the number of terms in the transition of one covariance row.
    pub(super) fn term_count(&self) -> usize {
        self.by_transition.term_count()
    }

    /// Computes `Z = −G h²` and its powers, transposed.
    fn raise_to_powers(&mut self, form: &ProportionalForm<'_>) {
        let [z, z_2, z_3, z_4] = &mut self.powers;
        let (free, band) = (z.nrows(), form.half_bandwidth);
        let factor = -self.substep_s * self.substep_s;
        for column in 0..free {
            for row in around(column, band, free) {
                z[(row, column)] = factor * form.stiffness[(column, row)];
            }
        }
        self.by_z.pack_band(z, band);
        // Polynomials of one matrix commute, so the narrower factor is the right one.
        let by_z = |left: &DMatrix<f64>, bands, out: &mut DMatrix<f64>| {
            let extent = Extent::Band(bands * band);
            self.multiplier
                .multiply_to(Left::new(left), &self.by_z, extent, Sum::PLAIN, out);
        };
        by_z(z, 2, z_2);
        by_z(z_2, 3, z_3);
        by_z(z_3, 4, z_4);
    }

    /// Computes `q̂`, `ŝ`, their products with `Z` for the first substep, and the response to a
    /// ramp.
    fn evaluate(
        &mut self,
        form: &ProportionalForm<'_>,
        polynomials: &Polynomials,
        slope: Option<&[f64]>,
    ) {
        let Self {
            powers,
            impulse,
            z_impulse,
            step,
            z_step,
            ramp,
            by_z,
            by_square,
            multiplier,
            ..
        } = self;
        let ([scratch, _], [term, _]) = (&mut self.square, &mut self.column);
        let band = form.half_bandwidth;
        by_square.pack_band(&powers[POWERS - 1], POWERS * band);
        let degree = polynomials.degree();
        for (polynomial, out) in [
            (&polynomials.impulse, &mut *impulse),
            (&polynomials.step, &mut *step),
        ] {
            let coefficients = &polynomial.coefficients;
            // Σ c_j Z^j = (… (c_n + …) Z⁴ + c_4 + … + c_7 Z³) Z⁴ + c_0 + … + c_3 Z³
            let last = degree.saturating_sub(1) / POWERS;
            out.as_mut_slice().fill(0.0); // several times faster than nalgebra's fill
            add_polynomial(
                &coefficients[POWERS * last..=POWERS * (last + 1)],
                powers,
                band,
                out,
            );
            for part in (0..last).rev() {
                let extent = Extent::Band((degree - POWERS * part) * band);
                multiplier.multiply_to(Left::new(out), by_square, extent, Sum::PLAIN, scratch);
                std::mem::swap(out, scratch);
                add_polynomial(
                    &coefficients[POWERS * part..POWERS * (part + 1)],
                    powers,
                    band,
                    out,
                );
            }
        }
        if let Some(slope) = slope {
            ramp.fill(0.0);
            for coefficient in polynomials.ramp.coefficients[..=degree].iter().rev() {
                term.gemv_tr(1.0, &powers[0], ramp, 0.0);
                std::mem::swap(ramp, term);
                for (entry, slope) in ramp.iter_mut().zip(slope) {
                    *entry += coefficient * slope;
                }
            }
        }
        let half_bandwidth = (degree + 1) * band;
        let extent = Extent::Band(half_bandwidth);
        multiplier.multiply_to(Left::new(impulse), by_z, extent, Sum::PLAIN, z_impulse);
        multiplier.multiply_to(Left::new(step), by_z, extent, Sum::PLAIN, z_step);
        self.half_bandwidth = half_bandwidth;
    }

    /// Doubles the time: `Φ(2t) = Φ(t)²`, `Ψ(2t) = Ψ(t) + Φ(t) Ψ(t)`, and the same for the integral
    /// of `Ψ`.
    ///
    /// `Gs` and `Gq` are doubled separately, like `q` and `s`. Multiplying `q` and `s` by `G` again
    /// would raise the rounding errors of slow modes to the level of fast modes.
    fn double(&mut self, [rest, slope_of_z]: [f64; 2], slope: Option<&[f64]>) {
        let Self {
            impulse,
            z_impulse,
            step,
            z_step,
            ramp,
            square: [product, other],
            column,
            by_square: packed,
            ..
        } = self;
        let multiplier = self.multiplier;
        if let Some(slope) = slope {
            // ∫ s(2t) = 2 ∫ s + s (2q + (α + βG) s)
            let [slope_column, growth] = column;
            slope_column.copy_from_slice(slope);
            growth.gemv_tr(2.0, impulse, slope_column, 0.0);
            growth.gemv_tr(-rest, step, slope_column, 1.0);
            growth.gemv_tr(-slope_of_z, z_step, slope_column, 1.0);
            ramp.gemv_tr(1.0, step, growth, 2.0);
        }
        let half_bandwidth = self.half_bandwidth;
        let by_square = |left: &DMatrix<f64>, right: &Right, out: &mut DMatrix<f64>| {
            multiplier.multiply_to(
                Left::new(left),
                right,
                Extent::Band(2 * half_bandwidth),
                Sum::PLAIN,
                out,
            );
        };
        packed.pack_band(z_step, half_bandwidth);
        by_square(step, packed, product);
        by_square(z_step, packed, other);
        let of_step = step.as_mut_slice().iter_mut().zip(z_step.as_mut_slice());
        let of_impulse = impulse.as_slice().iter().zip(z_impulse.as_slice());
        let of_products = product.as_mut_slice().iter_mut().zip(other.as_slice());
        for (((s, z_s), (q, z_q)), (product, z_s_squared)) in
            of_step.zip(of_impulse).zip(of_products)
        {
            *s = 2.0 * *s + *product; // 2s − Gs s
            *product = 2.0 * *z_s + rest * q + slope_of_z * z_q;
            *z_s = 2.0 * *z_s + z_s_squared; // −2Gs + (Gs)²
        }
        // Both diagonal blocks of Φ: 2I − 2Gs − (α + βG) q
        add_to_diagonal(product, 2.0);
        packed.pack_band(impulse, half_bandwidth);
        by_square(impulse, packed, other);
        add_scaled_mut(step, 1.0, other); // s(2t) = 2s − Gs s + q²
        by_square(z_impulse, packed, other);
        add_scaled_mut(z_step, 1.0, other); // −Gs(2t) = −2Gs + (Gs)² − Gq q
        packed.pack_band(product, half_bandwidth);
        by_square(impulse, packed, other);
        std::mem::swap(impulse, other);
        by_square(z_impulse, packed, other);
        std::mem::swap(z_impulse, other); // q(2t) = (2I − 2Gs − (α + βG) q) q
        self.half_bandwidth = (2 * half_bandwidth).min(impulse.nrows());
    }

    /// Replaces `[g, B_y]` by `[Γ g + Γ₂ ramp, Γ B_y]`; the parameter rows at the end stay zero.
    fn integrate_inputs(
        &mut self,
        [rest, slope_of_z]: [f64; 2],
        inputs: &mut DMatrix<f64>,
        slope: Option<&[f64]>,
    ) {
        let Self {
            substep_s: h,
            impulse,
            step,
            z_step,
            ramp,
            column: [velocity, acceleration],
            ..
        } = self;
        let (free, half_bandwidth) = (impulse.nrows(), self.half_bandwidth);
        // The stored matrix is the transpose.
        let times = |matrix: &DMatrix<f64>, row: usize, vector: &DVector<f64>| {
            let terms = around(row, half_bandwidth, free);
            dot(
                &matrix.as_slice()[row * free + terms.start..row * free + terms.end],
                &vector.as_slice()[terms],
            )
        };
        for mut column in inputs.column_iter_mut() {
            velocity.copy_from(&column.rows(0, free));
            acceleration.copy_from(&column.rows(free, free));
            for row in 0..free {
                let turned = times(z_step, row, velocity); // −G s ẋ
                let pushed = times(step, row, velocity);
                let moved = times(impulse, row, velocity) - rest * pushed - slope_of_z * turned;
                // (q + (α + βG) s) ẋ + s ẍ
                column[row] = *h * (moved + *h * times(step, row, acceleration));
                // −G s ẋ + q ẍ
                column[free + row] = turned + *h * times(impulse, row, acceleration);
            }
        }
        if let Some(slope) = slope {
            acceleration.copy_from_slice(slope);
            let mut increment = inputs.column_mut(0);
            for row in 0..free {
                increment[row] += h.powi(3) * ramp[row];
                increment[free + row] += *h * *h * times(step, row, acceleration);
            }
        }
    }

    /// Computes `[Φ, ΨW]ᵀ`.
    fn assemble(&mut self, [rest, slope_of_z]: [f64; 2], form: &ProportionalForm<'_>) {
        let Self {
            substep_s: h,
            impulse,
            z_impulse,
            step,
            z_step,
            transposed,
            by_theta,
            by_square,
            ..
        } = self;
        let free = impulse.nrows();
        let n = transposed.nrows();
        if self.half_bandwidth < self.transposed_half_bandwidth {
            transposed.fill(0.0);
        }
        self.transposed_half_bandwidth = self.half_bandwidth;
        add_to_diagonal(z_step, 1.0); // I − Gs
        let (of_x, of_v) = transposed.as_mut_slice().split_at_mut(n * free);
        for column in 0..free {
            let rows = around(column, self.half_bandwidth, free);
            let of_matrix = column * free + rows.start..column * free + rows.end;
            let of_transition = column * n..(column + 1) * n;
            let (x, v) = (&mut of_x[of_transition.clone()], &mut of_v[of_transition]);
            let (x_by_x, x_by_v) = x.split_at_mut(free);
            let (v_by_x, v_by_v) = v.split_at_mut(free);
            let of_x = x_by_x[rows.clone()]
                .iter_mut()
                .zip(&mut x_by_v[rows.clone()]);
            let of_v = v_by_x[rows.clone()].iter_mut().zip(&mut v_by_v[rows]);
            let entries = impulse.as_slice()[of_matrix.clone()]
                .iter()
                .zip(&z_impulse.as_slice()[of_matrix.clone()]);
            let entries = entries.zip(&z_step.as_slice()[of_matrix]);
            for (((x_by_x, x_by_v), (v_by_x, v_by_v)), ((q, z_q), a)) in of_x.zip(of_v).zip(entries)
            {
                *x_by_x = *a;
                *x_by_v = *h * q;
                *v_by_x = z_q / *h; // −G q
                *v_by_v = a + rest * q + slope_of_z * z_q; // I − Gs − (α + βG) q
            }
        }
        for (parameter, reach) in form.reach.iter().enumerate() {
            for row in reach.clone() {
                self.theta_by_acceleration[(parameter, row)] =
                    form.acceleration_by_theta[(row, parameter)];
            }
        }
        for (response, scale, first) in [(step, *h * *h, 0), (impulse, *h, free)] {
            by_square.pack_band(response, self.half_bandwidth);
            let left = Left::new(&self.theta_by_acceleration);
            self.multiplier.multiply_to(
                left,
                by_square,
                Extent::Full,
                Sum::scaled(scale),
                by_theta,
            );
            let entries = transposed.as_mut_slice()[first * n..].chunks_exact_mut(n);
            for (of_column, entries) in by_theta.column_iter().zip(entries) {
                entries[2 * free..].copy_from_slice(of_column.as_slice()); // (ΨW)ᵀ
            }
        }
    }

    /// Packs `[Φ, ΨW]ᵀ` without its structural zeros.
    fn pack(&mut self, reach: &[Range<usize>]) {
        let (free, half_bandwidth) = (self.impulse.nrows(), self.half_bandwidth);
        self.by_transition
            .pack_runs(&self.transposed, |columns, runs| {
                let mut columns = columns;
                if columns.start < free && columns.end > free {
                    columns = 0..free; // contains columns of both halves
                } else if columns.start >= free {
                    columns = columns.start - free..columns.end - free;
                }
                let of_x = near(&columns, half_bandwidth, free);
                runs.push(of_x.clone());
                runs.push(of_x.start + free..of_x.end + free);
                extend_by_reached(runs, 2 * free, reach, &of_x);
            });
    }

    /// Computes `λ A_i Σ A_iᵀ` (n × n) in `out`, without process noise, equation (2.61).
    ///
    /// Both triangles are bit-identical.
    pub(super) fn propagate_covariance_to(
        &mut self,
        covariance: &DMatrix<f64>,
        fading: f64,
        out: &mut DMatrix<f64>,
    ) {
        let Self {
            half_way,
            by_transition,
            multiplier,
            ..
        } = self;
        let (moving, n) = half_way.shape();
        multiplier.multiply_transposed_to(
            Left::new(covariance),
            by_transition,
            Sum::scaled(fading),
            half_way,
        );
        multiplier.multiply_symmetric_to(Left::new(half_way), by_transition, Sum::PLAIN, out);
        for column in moving..n {
            let (before, rest) = out.as_mut_slice().split_at_mut(column * n);
            let (with_motion, at_rest) = rest[..n].split_at_mut(moving);
            // The blocks of the parameters with the motion, and the parameter block.
            with_motion
                .copy_from_slice(&half_way.as_slice()[column * moving..(column + 1) * moving]);
            for (entry, of_motion) in before.chunks_exact_mut(n).zip(&*with_motion) {
                entry[column] = *of_motion;
            }
            for (entry, value) in at_rest
                .iter_mut()
                .zip(&covariance.as_slice()[column * n + moving..])
            {
                *entry = fading * value;
            }
        }
    }

    /// Replaces `X` (n × c) by `A_i X`.
    pub(super) fn mul_mut(&mut self, x: &mut DMatrix<f64>) {
        let Self {
            motion,
            transposed,
            half_bandwidth,
            ..
        } = self;
        let (n, moving) = transposed.shape();
        let free = moving / 2;
        for mut column in x.column_iter_mut() {
            let transition = transposed.as_slice().chunks_exact(n);
            for (index, (entry, transition)) in motion.iter_mut().zip(transition).enumerate() {
                let of_x = around(index % free, *half_bandwidth, free);
                let of_v = of_x.start + free..of_x.end + free;
                let x = column.as_slice();
                *entry = [of_x, of_v, moving..n]
                    .map(|rows| dot(&transition[rows.clone()], &x[rows]))
                    .iter()
                    .sum();
            }
            column.rows_mut(0, moving).copy_from(motion);
        }
    }
}

/// Adds `c_0 I + c_1 Z + …` from the powers of `Z`; there are at most `POWERS + 1` coefficients.
fn add_polynomial(
    coefficients: &[f64],
    powers: &[DMatrix<f64>; POWERS],
    half_bandwidth: usize,
    out: &mut DMatrix<f64>,
) {
    let n = out.nrows();
    let c: [f64; POWERS + 1] = std::array::from_fn(|j| coefficients.get(j).copied().unwrap_or(0.0));
    for column in 0..n {
        let start = column.saturating_sub(POWERS * half_bandwidth);
        let end = (column + POWERS * half_bandwidth + 1).min(n);
        let entries = column * n + start..column * n + end;
        let [z, z_2, z_3, z_4] = powers
            .each_ref()
            .map(|power| &power.as_slice()[entries.clone()]);
        for (j, entry) in out.as_mut_slice()[entries].iter_mut().enumerate() {
            *entry += c[1] * z[j] + c[2] * z_2[j] + c[3] * z_3[j] + c[4] * z_4[j];
        }
    }
    add_to_diagonal(out, c[0]);
}

fn add_to_diagonal(matrix: &mut DMatrix<f64>, value: f64) {
    for j in 0..matrix.nrows() {
        matrix[(j, j)] += value;
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
