//! The polynomials of `Z` for one series, as numbers.

use crate::discretise::Series;

/// Polynomials are shortened by no more than this, relative to their values: the rounding of a double.
const LARGEST_LOSS: f64 = 1e-16;

/// Largest degree of the polynomials, a multiple of the powers that are made beforehand, not below the longest series.
pub(super) const LARGEST_DEGREE: usize = 44;

/// `1/k`: divisions would take longer than all else of a series.
const RECIPROCALS: [f64; LARGEST_DEGREE + 3] = {
    let mut reciprocals = [0.0; LARGEST_DEGREE + 3];
    let mut k = 1;
    while k < reciprocals.len() {
        reciprocals[k] = 1.0 / k as f64;
        k += 1;
    }
    reciprocals
};

/// For each degree n and k < n, by what the coefficient k of a Chebyshev polynomial on an interval of length 1 follows from that of
/// k + 1: `(k + 1)(2k + 1) / 2(n² − k²)`, without its sign.
static CHEBYSHEV_RATIOS: [[f64; LARGEST_DEGREE]; LARGEST_DEGREE + 1] = {
    let mut ratios = [[0.0; LARGEST_DEGREE]; LARGEST_DEGREE + 1];
    let mut n = 1;
    while n <= LARGEST_DEGREE {
        let mut k = 0;
        while k < n {
            ratios[n][k] = ((k + 1) * (2 * k + 1)) as f64 / (2 * (n * n - k * k)) as f64;
            k += 1;
        }
        n += 1;
    }
    ratios
};

/// `c_0 + c_1 z + …` for numbers `z = −g h²`.
#[derive(Debug, Clone)]
pub(super) struct Polynomial {
    pub(super) degree: usize,
    /// Zero beyond the degree.
    pub(super) coefficients: [f64; LARGEST_DEGREE + 1],
}

impl Polynomial {
    fn zero() -> Self {
        Self {
            degree: 0,
            coefficients: [0.0; LARGEST_DEGREE + 1],
        }
    }

    /// Lowers the degree from `order` as far as nothing but rounding changes for `z` from `−range` to 0.
    fn economise(&mut self, order: usize, range: f64) {
        self.degree = economise_mut(&mut self.coefficients, order, range);
    }
}

/// What a substep makes of displacements and velocities.
pub(super) struct Polynomials {
    /// `q̂(z)`
    pub(super) impulse: Polynomial,
    /// `ŝ(z)`
    pub(super) step: Polynomial,
    /// `1 + z ŝ(z) + (rest + slope z) q̂(z)`: the velocity after a unit velocity
    pub(super) velocity: Polynomial,
    /// the integral of `s` over `h³`
    pub(super) ramp: Polynomial,
}

impl Polynomials {
    /// Sums up the Taylor series of a substep: with `(A_s h)^k = c_k + d_k A_s h`, it is `q̂ = Σ d_k / k!`.
    ///
    /// `rest`, `slope`: `−(α + βg) h = rest + slope z`; `reach`: bound of `|A_s h|`; `range`: bound of `−z`. From
    /// `(A_s h)² = (rest + slope z) A_s h + z` follows `d_{k+1} = (rest + slope z) d_k + z d_{k−1}`.
    pub(super) fn new([rest, slope]: [f64; 2], reach: f64, range: f64) -> Self {
        let [mut impulse, mut step, mut velocity, mut ramp] =
            std::array::from_fn(|_| Polynomial::zero());
        let zero = [0.0; LARGEST_DEGREE + 1];
        let (mut before, mut term) = (zero, zero); // d_0 / 0!, d_1 / 1!
        term[0] = 1.0;
        let order = Series::choose(reach, 1.0).order;
        for k in 1..=order {
            let [by_k, by_next, by_second] = [k, k + 1, k + 2].map(|divisor| RECIPROCALS[divisor]);
            let mut next = zero;
            for j in 0..k {
                impulse.coefficients[j] += term[j];
                step.coefficients[j] += term[j] * by_next;
                ramp.coefficients[j] += term[j] * (by_next * by_second);
                next[j] += rest * by_next * term[j];
                next[j + 1] += by_next * (slope * term[j] + by_k * before[j]);
            }
            (before, term) = (term, next);
        }
        velocity.coefficients[0] = 1.0;
        for j in 0..order {
            velocity.coefficients[j] += rest * impulse.coefficients[j];
            velocity.coefficients[j + 1] += step.coefficients[j] + slope * impulse.coefficients[j];
        }
        for polynomial in [&mut impulse, &mut step, &mut ramp, &mut velocity] {
            polynomial.economise(order, range);
        }
        Self {
            impulse,
            step,
            velocity,
            ramp,
        }
    }

    /// Returns the degree to which the responses are evaluated together.
    pub(super) fn degree(&self) -> usize {
        [&self.impulse, &self.step, &self.ramp]
            .into_iter()
            .map(|polynomial| polynomial.degree)
            .max()
            .unwrap_or(0)
    }
}

/// Lowers the degree of a polynomial as far as its values for `z` from `−range` to 0 stay the same but for rounding, and
/// returns it.
///
/// The term of highest degree is replaced by what remains of it less a Chebyshev polynomial of that interval, which is small
/// all over it: the economisation of power series of Lanczos (1956, *Applied Analysis*, §7.10).
pub(super) fn economise_mut(coefficients: &mut [f64], degree: usize, range: f64) -> usize {
    let mut lost = 0.0;
    for n in (1..=degree).rev() {
        lost += coefficients[n].abs() * (range / 4.0).powi(n as i32) * 2.0;
        if lost > LARGEST_LOSS * coefficients[0].abs() {
            return n;
        }
        // of the Chebyshev polynomial, from its highest coefficient to its lowest
        let mut entry = std::mem::take(&mut coefficients[n]);
        for (coefficient, ratio) in coefficients[..n]
            .iter_mut()
            .zip(&CHEBYSHEV_RATIOS[n][..n])
            .rev()
        {
            entry *= range * ratio;
            *coefficient -= entry;
        }
    }
    0
}
