//! The coefficients of the polynomials of `Z` for one series.

use crate::discretise::Series;

/// Maximum relative change of a polynomial by economisation, equal to the rounding of a double.
const LARGEST_LOSS: f64 = 1e-16;

/// Maximum degree of the polynomials.
///
/// It is a multiple of the number of precomputed powers and at least the order of the longest
/// series.
pub(super) const LARGEST_DEGREE: usize = 44;

/// `1/k`, precomputed, because divisions would dominate the time of a series.
const RECIPROCALS: [f64; LARGEST_DEGREE + 3] = {
    let mut reciprocals = [0.0; LARGEST_DEGREE + 3];
    let mut k = 1;
    while k < reciprocals.len() {
        reciprocals[k] = 1.0 / k as f64;
        k += 1;
    }
    reciprocals
};

/// Magnitudes of the ratios between successive Chebyshev coefficients on an interval of length 1.
///
/// For each degree n and k < n, the entry is the ratio of coefficient k to coefficient k + 1:
/// `(k + 1)(2k + 1) / 2(n² − k²)`.
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

/// A polynomial `c_0 + c_1 z + …` of numbers `z = −g h²`.
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

    /// Lowers the degree from `order` as far as only rounding changes for `z` from `−range` to 0.
    fn economise(&mut self, order: usize, range: f64) {
        self.degree = economise_mut(&mut self.coefficients, order, range);
    }
}

/// The polynomials that describe the effect of a substep on displacements and velocities.
pub(super) struct Polynomials {
    /// `q̂(z)`.
    pub(super) impulse: Polynomial,
    /// `ŝ(z)`.
    pub(super) step: Polynomial,
    /// `1 + z ŝ(z) + (rest + slope z) q̂(z)`: the velocity after a unit velocity.
    pub(super) velocity: Polynomial,
    /// The integral of `s`, divided by `h³`.
    pub(super) ramp: Polynomial,
}

impl Polynomials {
    /// Sums the Taylor series of a substep: with `(A_s h)^k = c_k + d_k A_s h`, it is
    /// `q̂ = Σ d_k / k!`.
    ///
    /// - `rest`, `slope`: `−(α + βg) h = rest + slope z`
    /// - `reach`: bound of `|A_s h|`
    /// - `range`: bound of `−z`
    ///
    /// `d_{k+1} = (rest + slope z) d_k + z d_{k−1}` follows from
    /// `(A_s h)² = (rest + slope z) A_s h + z`.
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

    /// Returns the common degree for the evaluation of the responses.
    pub(super) fn degree(&self) -> usize {
        [&self.impulse, &self.step, &self.ramp]
            .into_iter()
            .map(|polynomial| polynomial.degree)
            .max()
            .unwrap_or(0)
    }
}

/// Lowers the degree of a polynomial as far as only rounding changes for `z` from `−range` to 0,
/// and returns it.
///
/// Each step subtracts a Chebyshev polynomial of this interval that cancels the term of highest
/// degree. This polynomial is small on the whole interval. The method is the economisation of power
/// series of Lanczos (1956, *Applied Analysis*, §7.10).
pub(super) fn economise_mut(coefficients: &mut [f64], degree: usize, range: f64) -> usize {
    let mut lost = 0.0;
    for n in (1..=degree).rev() {
        lost += coefficients[n].abs() * (range / 4.0).powi(n as i32) * 2.0;
        if lost > LARGEST_LOSS * coefficients[0].abs() {
            return n;
        }
        // Coefficients of the Chebyshev polynomial, from the highest to the lowest degree.
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
