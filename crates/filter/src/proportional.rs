//! The exact step of a linear structure with proportional damping, from few products of half-size matrices.
//!
//! Notation: Huang & Yuen (2023), §2.4, with `G = M⁻¹K` and `C = αM + βK`. With the parameters at rest, the Jacobian (2.50) is
//! `A_y = [[A_s, (0; W)], [0, 0]]`, `A_s = [[0, I], [−G, −(αI + βG)]]`. All blocks of `A_s` are polynomials of `G`, so that they
//! commute and `A_s` solves its own characteristic equation as if they were numbers: `A_s² = −(α + βG) A_s − G`. Hence all
//! blocks of `exp(A_s t)` and of its integrals follow from two functions of `G`, the impulse response `q` (displacement after
//! a unit velocity) and the step response `s = ∫ q dt` (displacement under a unit acceleration):
//!
//! ```text
//! Φ = exp(A_s t) = [[I − Gs, q], [−Gq, I − Gs − (α + βG) q]]     (2.54)
//! ∫ Φ dt         = [[q + (α + βG) s, s], [−Gs, q]]                Γ of (2.55), (2.56); its right half is Ψ
//! A_i            = [[Φ, ΨW], [0, I]]
//! ```
//!
//! `q` and `s` are the Taylor series that [`discretise`](crate::discretise) applies to columns, here as polynomials of
//! `Z = −G h²` with numbers as coefficients: `q = h q̂(Z)`, `s = h² ŝ(Z)`. They are evaluated by Paterson & Stockmeyer (1973,
//! *SIAM J. Comput.* 2, 60). A step too long for one series is halved to `h` often enough, and doubled again by
//! `Φ(2t) = Φ(t)²`, `Ψ(2t) = Ψ(t) + Φ(t) Ψ(t)`. Where `G` has a narrow band, as of a shear building, so have its powers.
//!
//! All polynomials are kept transposed: they are right factors of products with the symmetric covariance.

use crate::dense::add_scaled_mut;
use crate::discretise::{LARGEST_STEP, Series};
use crate::product::{Left, NOTHING, Spans, Strip};
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// Polynomials are shortened by no more than this, relative to their values: the rounding of a double.
const LARGEST_LOSS: f64 = 1e-16;

/// Largest degree of the polynomials, a multiple of [`POWERS`] not below the longest series.
const LARGEST_DEGREE: usize = 44;

/// Powers of `Z` that are made beforehand: about the root of the usual degree, which makes the fewest products.
const POWERS: usize = 4;

/// The Jacobian of a linear structure with proportional damping in its parts, at the point of linearisation.
///
/// For a state of displacements, velocities and parameters `[x, ẋ, θ]`, equation (2.50) with `C = αM + βK`:
/// `A_y = [[0, I, 0], [−G, −(αI + βG), W], [0, 0, 0]]`.
#[derive(Debug, Clone, Copy)]
pub struct ProportionalForm<'m> {
    /// `G = M⁻¹K` (N_d × N_d, 1/s²), with `M` and `K` positive (semi)definite.
    pub stiffness: &'m DMatrix<f64>,
    /// Upper bound of the eigenvalues of `G` (1/s²).
    pub stiffness_bound: f64,
    /// Entries of `G` farther from its diagonal than this are zero.
    pub half_bandwidth: usize,
    /// `α` (1/s).
    pub alpha_per_s: f64,
    /// `β` (s).
    pub beta_s: f64,
    /// `W = ∂ẍ/∂θ` (N_d × N_θ, m/s²).
    pub acceleration_by_theta: &'m DMatrix<f64>,
}

/// The transition over one time step, made anew from the form at every step in the same storage.
#[derive(Debug, Clone)]
pub(crate) struct Transition {
    /// `h` (s): the time step, halved until one series spans it.
    substep_s: f64,
    /// Entries of the polynomials of `G` farther from the diagonal than this are zero.
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
    /// scratch (N_d × N_d)
    square: [DMatrix<f64>; 2],
    /// scratch (N_d)
    column: [DVector<f64>; 2],
    /// `[Φ, ΨW]ᵀ` (n × 2N_d)
    transposed: DMatrix<f64>,
    /// `Σ [Φ, ΨW]ᵀ` (n × 2N_d)
    half_way: DMatrix<f64>,
    /// `Wᵀ sᵀ` or `Wᵀ qᵀ` (N_θ × N_d)
    by_theta: DMatrix<f64>,
    /// scratch (2N_d)
    motion: DVector<f64>,
    strip: Strip,
}

impl Transition {
    /// Makes room for the transitions of a model of that form.
    pub(crate) fn new(form: &ProportionalForm<'_>) -> Self {
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
            half_way: DMatrix::zeros(n, 2 * free),
            by_theta: DMatrix::zeros(parameters, free),
            motion: DVector::zeros(2 * free),
            strip: Strip::new(n),
        }
    }

    /// Discretises a step of `step_s` (s); replaces `[g, B_y]` in `inputs` (n × (1 + N_f)) by `[Γ g + Γ₂ ramp, Γ B_y]`.
    ///
    /// `rate_bound` (1/s) and `ramp` (n) are as for [`integrate_inputs`](crate::discretise::integrate_inputs).
    pub(crate) fn discretise(
        &mut self,
        form: &ProportionalForm<'_>,
        step_s: f64,
        rate_bound: f64,
        inputs: &mut DMatrix<f64>,
        ramp: Option<&[f64]>,
    ) {
        let free = self.impulse.nrows();
        let mut doublings = 0;
        self.substep_s = step_s;
        // A bound that is not finite is met by the check of the filtered state, which comes next.
        while rate_bound.is_finite() && rate_bound * self.substep_s > LARGEST_STEP {
            self.substep_s *= 0.5;
            doublings += 1;
        }
        let h = self.substep_s;
        let damping = [-form.alpha_per_s * h, form.beta_s / h];
        let polynomials = Polynomials::new(damping, rate_bound * h, form.stiffness_bound * h * h);
        let slope = ramp.map(|ramp| &ramp[free..2 * free]);
        self.raise_to_powers(form);
        self.evaluate(form, &polynomials, slope);
        for _ in 0..doublings {
            self.double(damping, slope);
        }
        self.integrate_inputs(damping, inputs, slope);
        self.assemble(damping, form.acceleration_by_theta);
    }

    /// Writes `Z = −G h²` and its powers, transposed.
    fn raise_to_powers(&mut self, form: &ProportionalForm<'_>) {
        let [z, z_2, z_3, z_4] = &mut self.powers;
        form.stiffness.transpose_to(z);
        *z *= -self.substep_s * self.substep_s;
        let band = form.half_bandwidth;
        self.strip.multiply_to(Left::Plain(z), z, banded(z.nrows(), band, band), z_2);
        self.strip.multiply_to(Left::Plain(z), z_2, banded(z.nrows(), band, 2 * band), z_3);
        self.strip.multiply_to(Left::Plain(z), z_3, banded(z.nrows(), band, 3 * band), z_4);
    }

    /// Writes `q̂`, `ŝ` and what `Z` makes of them for the first substep, and the response to a ramp.
    fn evaluate(&mut self, form: &ProportionalForm<'_>, polynomials: &Polynomials, slope: Option<&[f64]>) {
        let Self { powers, impulse, z_impulse, step, z_step, ramp, strip, .. } = self;
        let ([scratch, _], [term, _]) = (&mut self.square, &mut self.column);
        let (free, band) = (impulse.nrows(), form.half_bandwidth);
        for (coefficients, out) in [(&polynomials.impulse, &mut *impulse), (&polynomials.step, &mut *step)] {
            // Σ c_j Z^j = (… (c_n + …) Z⁴ + c_4 + … + c_7 Z³) Z⁴ + c_0 + … + c_3 Z³
            let last = polynomials.degree.saturating_sub(1) / POWERS;
            out.fill(0.0);
            add_polynomial(&coefficients[POWERS * last..=POWERS * (last + 1)], powers, band, out);
            for part in (0..last).rev() {
                let reach = (polynomials.degree - POWERS * (part + 1)) * band;
                strip.multiply_to(Left::Plain(&powers[POWERS - 1]), out, banded(free, POWERS * band, reach), scratch);
                std::mem::swap(out, scratch);
                add_polynomial(&coefficients[POWERS * part..POWERS * (part + 1)], powers, band, out);
            }
        }
        if let Some(slope) = slope {
            ramp.fill(0.0);
            for coefficient in polynomials.ramp[..=polynomials.degree].iter().rev() {
                term.gemv_tr(1.0, &powers[0], ramp, 0.0);
                std::mem::swap(ramp, term);
                for (entry, slope) in ramp.iter_mut().zip(slope) {
                    *entry += coefficient * slope;
                }
            }
        }
        let spans = banded(free, band, polynomials.degree * band);
        strip.multiply_to(Left::Plain(&powers[0]), impulse, &spans, z_impulse);
        strip.multiply_to(Left::Plain(&powers[0]), step, &spans, z_step);
        self.half_bandwidth = (polynomials.degree + 1) * band;
    }

    /// Doubles the time: `Φ(2t) = Φ(t)²`, `Ψ(2t) = Ψ(t) + Φ(t) Ψ(t)`, and the same for the integral of `Ψ`.
    ///
    /// `Gs` and `Gq` are doubled like `q` and `s`: to multiply these by `G` once more would raise the rounding of the slow modes to
    /// the size of the fast ones.
    fn double(&mut self, [rest, slope_of_z]: [f64; 2], slope: Option<&[f64]>) {
        let Self { impulse, z_impulse, step, z_step, ramp, square: [product, other], column, strip, .. } = self;
        if let Some(slope) = slope {
            // ∫ s(2t) = 2 ∫ s + s (2q + (α + βG) s)
            let [slope_column, growth] = column;
            slope_column.copy_from_slice(slope);
            growth.gemv_tr(2.0, impulse, slope_column, 0.0);
            growth.gemv_tr(-rest, step, slope_column, 1.0);
            growth.gemv_tr(-slope_of_z, z_step, slope_column, 1.0);
            ramp.gemv_tr(1.0, step, growth, 2.0);
        }
        let free = impulse.nrows();
        let spans = banded(free, self.half_bandwidth, self.half_bandwidth);
        strip.multiply_to(Left::Plain(z_step), step, &spans, product);
        strip.multiply_to(Left::Plain(impulse), impulse, &spans, other);
        *step *= 2.0;
        *step += &*product;
        *step += &*other; // s(2t) = 2s − Gs s + q²
        strip.multiply_to(Left::Plain(z_step), z_step, &spans, product);
        strip.multiply_to(Left::Plain(z_impulse), impulse, &spans, other);
        *other += &*product;
        product.copy_from(z_step);
        *product *= 2.0;
        add_scaled_mut(product, rest, impulse);
        add_scaled_mut(product, slope_of_z, z_impulse);
        add_to_diagonal(product, 2.0); // both blocks on the diagonal of Φ: 2I − 2Gs − (α + βG) q
        *z_step *= 2.0;
        *z_step += &*other; // −Gs(2t) = −2Gs + (Gs)² − Gq q
        strip.multiply_to(Left::Plain(product), impulse, &spans, other);
        std::mem::swap(impulse, other);
        strip.multiply_to(Left::Plain(product), z_impulse, &spans, other);
        std::mem::swap(z_impulse, other); // q(2t) = (2I − 2Gs − (α + βG) q) q
        self.half_bandwidth = (2 * self.half_bandwidth).min(free);
    }

    /// Replaces `[g, B_y]` by `[Γ g + Γ₂ ramp, Γ B_y]`; the parameters at their ends stay zero.
    fn integrate_inputs(&mut self, [rest, slope_of_z]: [f64; 2], inputs: &mut DMatrix<f64>, slope: Option<&[f64]>) {
        let Self { substep_s: h, impulse, step, z_step, ramp, column: [velocity, acceleration], .. } = self;
        let free = impulse.nrows();
        for mut column in inputs.column_iter_mut() {
            velocity.copy_from(&column.rows(0, free));
            acceleration.copy_from(&column.rows(free, free));
            let mut moved = column.rows_mut(0, free);
            moved.gemv_tr(*h, impulse, velocity, 0.0);
            moved.gemv_tr(-*h * rest, step, velocity, 1.0);
            moved.gemv_tr(-*h * slope_of_z, z_step, velocity, 1.0);
            moved.gemv_tr(*h * *h, step, acceleration, 1.0); // (q + (α + βG) s) ẋ + s ẍ
            let mut quickened = column.rows_mut(free, free);
            quickened.gemv_tr(1.0, z_step, velocity, 0.0);
            quickened.gemv_tr(*h, impulse, acceleration, 1.0); // −G s ẋ + q ẍ
        }
        if let Some(slope) = slope {
            acceleration.copy_from_slice(slope);
            let mut increment = inputs.column_mut(0);
            increment.rows_mut(0, free).axpy(h.powi(3), ramp, 1.0);
            increment.rows_mut(free, free).gemv_tr(*h * *h, step, acceleration, 1.0);
        }
    }

    /// Writes `[Φ, ΨW]ᵀ`.
    fn assemble(&mut self, [rest, slope_of_z]: [f64; 2], acceleration_by_theta: &DMatrix<f64>) {
        let Self { substep_s: h, impulse, z_impulse, step, z_step, transposed, by_theta, strip, .. } = self;
        let free = impulse.nrows();
        let n = transposed.nrows();
        add_to_diagonal(z_step, 1.0); // I − Gs
        let (of_x, of_v) = transposed.as_mut_slice().split_at_mut(n * free);
        for column in 0..free {
            let of_matrix = column * free..(column + 1) * free;
            let of_transition = column * n..(column + 1) * n;
            let (x, v) = (&mut of_x[of_transition.clone()], &mut of_v[of_transition]);
            let entries = impulse.as_slice()[of_matrix.clone()].iter().zip(&z_impulse.as_slice()[of_matrix.clone()]);
            for (row, ((q, z_q), a)) in entries.zip(&z_step.as_slice()[of_matrix]).enumerate() {
                x[row] = *a;
                x[free + row] = *h * q;
                v[row] = z_q / *h; // −G q
                v[free + row] = a + rest * q + slope_of_z * z_q; // I − Gs − (α + βG) q
            }
        }
        let spans = banded_right(free, self.half_bandwidth);
        for (response, scale, first) in [(step, *h * *h, 0), (impulse, *h, free)] {
            strip.multiply_to(Left::Transposed(acceleration_by_theta), response, &spans, by_theta);
            for (column, of_column) in by_theta.column_iter().enumerate() {
                for (parameter, entry) in of_column.iter().enumerate() {
                    transposed[(2 * free + parameter, first + column)] = scale * entry; // (ΨW)ᵀ
                }
            }
        }
    }

    /// Writes `A_i Σ A_iᵀ` (n × n) into `out`, without fading and process noise, equation (2.61); both triangles get the same
    /// bits.
    pub(crate) fn propagate_covariance_to(&mut self, covariance: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let Self { half_bandwidth, transposed, half_way, strip, .. } = self;
        let (n, moving) = transposed.shape();
        let free = moving / 2;
        let spans = |column: usize| {
            let [of_x, ..] = banded_right(free, *half_bandwidth)(0..0, column % free);
            let of_v = of_x.start + free..of_x.end + free;
            [of_x, of_v, moving..n]
        };
        strip.multiply_to(Left::Plain(covariance), transposed, |_, column| spans(column), half_way);
        out.copy_from(covariance); // the parameters among themselves
        let lower = |rows: Range<usize>, column| if rows.end <= column { NOTHING } else { spans(column) };
        strip.multiply_to(Left::Transposed(half_way), transposed, lower, out);
        out.view_mut((moving, 0), (n - moving, moving)).copy_from(&half_way.rows(moving, n - moving));
        for column in 0..moving {
            for row in column + 1..n {
                out[(column, row)] = out[(row, column)];
            }
        }
    }

    /// Replaces `X` (n × c) by `A_i X`.
    pub(crate) fn mul_mut(&mut self, x: &mut DMatrix<f64>) {
        let moving = self.motion.len();
        for mut column in x.column_iter_mut() {
            self.motion.gemv_tr(1.0, &self.transposed, &column, 0.0);
            column.rows_mut(0, moving).copy_from(&self.motion);
        }
    }
}

/// Coefficients of `q̂(z)`, `ŝ(z)` and of the integral of `s` over `h³`, for numbers `z = −g h²`.
struct Polynomials {
    degree: usize,
    impulse: [f64; LARGEST_DEGREE + 1],
    step: [f64; LARGEST_DEGREE + 1],
    ramp: [f64; LARGEST_DEGREE + 1],
}

impl Polynomials {
    /// Sums up the Taylor series of a substep: with `(A_s h)^k = c_k + d_k A_s h`, it is `q̂ = Σ d_k / k!`.
    ///
    /// `rest`, `slope`: `−(α + βg) h = rest + slope z`; `reach`: bound of `|A_s h|`; `range`: bound of `−z`. From
    /// `(A_s h)² = (rest + slope z) A_s h + z` follows `d_{k+1} = (rest + slope z) d_k + z d_{k−1}`.
    fn new([rest, slope]: [f64; 2], reach: f64, range: f64) -> Self {
        let zero = [0.0; LARGEST_DEGREE + 1];
        let mut sums = Self { degree: 0, impulse: zero, step: zero, ramp: zero };
        let (mut before, mut term) = (zero, zero); // d_0, d_1
        term[0] = 1.0;
        let mut factorial = 1.0;
        let order = Series::choose(reach, 1.0).order;
        for k in 1..=order {
            factorial *= k as f64;
            let mut next = zero;
            for j in 0..k {
                sums.impulse[j] += term[j] / factorial;
                sums.step[j] += term[j] / factorial / (k + 1) as f64;
                sums.ramp[j] += term[j] / factorial / ((k + 1) * (k + 2)) as f64;
                next[j] += rest * term[j];
                next[j + 1] += slope * term[j] + before[j];
            }
            (before, term) = (term, next);
        }
        let degrees = [&mut sums.impulse, &mut sums.step, &mut sums.ramp].map(|c| economise_mut(c, order, range));
        sums.degree = degrees.into_iter().max().unwrap_or(0);
        sums
    }
}

/// Lowers the degree of a polynomial as far as its values for `z` from `−range` to 0 stay the same but for rounding, and
/// returns it.
///
/// The term of highest degree is replaced by what remains of it less a Chebyshev polynomial of that interval, which is small
/// all over it: the economisation of power series of Lanczos (1956, *Applied Analysis*, §7.10).
fn economise_mut(coefficients: &mut [f64], degree: usize, range: f64) -> usize {
    let mut lost = 0.0;
    for n in (1..=degree).rev() {
        lost += coefficients[n].abs() * (range / 4.0).powi(n as i32) * 2.0;
        if lost > LARGEST_LOSS * coefficients[0].abs() {
            return n;
        }
        // of the Chebyshev polynomial, from its highest coefficient to its lowest
        let mut entry = std::mem::take(&mut coefficients[n]);
        for k in (0..n).rev() {
            entry *= range * ((k + 1) * (2 * k + 1)) as f64 / (2 * (n * n - k * k)) as f64;
            coefficients[k] -= entry;
        }
    }
    0
}

/// Adds `c_0 I + c_1 Z + …` by the powers of `Z`; `coefficients` are [`POWERS`] or one more.
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
        let [z, z_2, z_3, z_4] = powers.each_ref().map(|power| &power.as_slice()[entries.clone()]);
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

/// Returns where terms of a product of two banded matrices (n × n) are not zero.
fn banded(n: usize, left: usize, right: usize) -> impl Fn(Range<usize>, usize) -> Spans {
    move |rows, column| {
        let start = column.saturating_sub(right).max(rows.start.saturating_sub(left));
        let end = (column + right + 1).min(rows.end + left).min(n);
        if start < end { [start..end, 0..0, 0..0] } else { NOTHING }
    }
}

/// The same for a left factor without a band.
fn banded_right(n: usize, right: usize) -> impl Fn(Range<usize>, usize) -> Spans {
    move |_, column| [column.saturating_sub(right)..(column + right + 1).min(n), 0..0, 0..0]
}

#[cfg(test)]
mod tests;
