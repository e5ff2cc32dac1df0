//! The sum of a normal variable and a Student variable. It describes a difference if a part of its
//! scatter was estimated from few records.
//!
//! Notation:
//!
//! - X = s·Z + τ·T, with Z standard normal and T Student with ν degrees of freedom
//! - c: largest usual scatter
//! - Φ: standard normal distribution function
//!
//! T = Z'/√w with w = χ²_ν/ν. For a given w, X is therefore normal with variance s² + τ²/w, and
//!
//! P(X ≤ x) = ∫ p(w)·Φ(x/√(s² + τ²/w)) dw.
//!
//! A Student variable assumes the prior 1/σ for the scatter σ = τ/√w, without an upper limit. With
//! one degree of freedom, its tail comes from scatters that no structure has. The prior here is
//! therefore exp(−σ²/(2c²))/σ, which multiplies p(w) by exp(−τ²/(2c²w)). The factor has almost no
//! effect with many degrees of freedom, or if τ is far below c.
//!
//! This is the Behrens–Fisher distribution with one of its two variances known (R. A. Fisher, *The
//! fiducial argument in statistical inference*, Ann. Eugenics 6 (1935), 391-398). The
//! Welch–Satterthwaite approximation, a Student variable of the same variance, is less suitable.
//! With two records, up to 4.7 % of sound records exceed its bound of 0.99. For this distribution
//! without a limit on the scatter, the share is at most 1 %.

use spandrel_modal::normal_cdf;

/// X = `normal_std`·Z + `student_scale`·T.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct NormalPlusStudent {
    /// s
    pub(crate) normal_std: f64,
    /// τ
    pub(crate) student_scale: f64,
    /// ν, above 0
    pub(crate) degrees_of_freedom: f64,
    /// c, above 0. Infinite without a limit on the scatter. A larger `student_scale` replaces it.
    pub(crate) largest_usual: f64,
}

/// Number of nodes of the integral over ln w.
///
/// The integrand is analytic, so the trapezoidal rule converges exponentially. With 64 nodes and
/// one degree of freedom, the error is below 1e-5 of either tail. It is far smaller with more
/// degrees of freedom.
const NODES: u32 = 64;

/// Twice the decrease of the exponent at the ends of the integral, where the density is e^−37/2
/// (1e-8) of its peak.
const LOG_CUT: f64 = 37.0;

impl NormalPlusStudent {
    /// Returns `true` if X has a positive variance.
    pub(crate) fn is_wide(&self) -> bool {
        self.normal_std > 0.0 || self.student_scale > 0.0
    }

    /// Returns P(X ≤ x).
    ///
    /// With u = ln w, p(u) ∝ exp(ν/2·(u − eᵘ)). At the ends, the exponent has decreased by at least
    /// [`LOG_CUT`]/2: from u − eᵘ + 1 ≥ −c it follows that −(c + √2c) ≤ u ≤ ln(1 + c + √2c).
    pub(crate) fn cdf(&self, x: f64) -> f64 {
        let half_nu = 0.5 * self.degrees_of_freedom;
        let cut = LOG_CUT / self.degrees_of_freedom;
        let reach = cut + (2.0 * cut).sqrt();
        let (low, high) = (-reach, reach.ln_1p());
        let step = (high - low) / f64::from(NODES - 1);
        let (known, estimated) = (self.normal_std.powi(2), self.student_scale.powi(2));
        // τ²/(2c²)
        let excess =
            0.5 * (self.student_scale / self.largest_usual.max(self.student_scale)).powi(2);
        let excess = if excess.is_finite() { excess } else { 0.0 }; // without scatter
        let (mut sum, mut total) = (0.0, 0.0);
        for node in 0..NODES {
            let u = low + step * f64::from(node);
            let w = u.exp();
            let density = (half_nu * (u - w + 1.0) - excess / w).exp(); // p(u), to a factor
            let std = (known + estimated / w).sqrt(); //                   √(s² + τ²/w)
            sum += density * normal_cdf(x / std);
            total += density;
        }
        sum / total
    }

    /// Returns the x with P(X ≤ x) = `probability`, which must be above 0 and below 1.
    pub(crate) fn quantile(&self, probability: f64) -> f64 {
        if !self.is_wide() {
            return 0.0;
        }
        let scale = self.normal_std.hypot(self.student_scale);
        let (mut low, mut high) = (-scale, scale);
        while self.cdf(low) > probability && low.is_finite() {
            low *= 2.0;
        }
        while self.cdf(high) < probability && high.is_finite() {
            high *= 2.0;
        }
        bisect(low, high, |x| self.cdf(x) >= probability)
    }
}

/// Returns the point between `low` and `high` where `is_above` changes from false to true.
pub(crate) fn bisect(mut low: f64, mut high: f64, is_above: impl Fn(f64) -> bool) -> f64 {
    /// Maximum number of halvings, enough for floating-point precision from any bracket that occurs
    /// here.
    const MOST_HALVINGS: usize = 100;
    for _ in 0..MOST_HALVINGS {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if is_above(middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    0.5 * (low + high)
}

/// Returns the point between `a` and `b` where an increasing function is zero, to `accuracy`.
///
/// This is false position with the Illinois modification (M. Dowell and P. Jarratt, *A modified
/// regula falsi method*, BIT 11 (1971), 168-174). It needs about ten values of a smooth function,
/// where bisection needs fifty.
pub(crate) fn root(a: f64, b: f64, accuracy: f64, function: impl Fn(f64) -> f64) -> f64 {
    /// Maximum number of values of the function.
    const MOST_VALUES: usize = 200;
    let (mut a, mut b) = (a, b);
    let (mut at_a, mut at_b) = (function(a), function(b));
    for _ in 0..MOST_VALUES {
        let next = b - at_b * (b - a) / (at_b - at_a);
        if at_b == 0.0 || !next.is_finite() {
            break;
        }
        if (next - b).abs() <= accuracy {
            return next;
        }
        let at_next = function(next);
        if (at_next < 0.0) == (at_b < 0.0) {
            at_a *= 0.5; // the same end has moved twice
        } else {
            (a, at_a) = (b, at_b);
        }
        (b, at_b) = (next, at_next);
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;

    fn student(degrees_of_freedom: f64) -> NormalPlusStudent {
        NormalPlusStudent {
            normal_std: 0.0,
            student_scale: 1.0,
            degrees_of_freedom,
            largest_usual: f64::INFINITY,
        }
    }

    #[test]
    fn quantiles_without_a_normal_part_are_those_of_student() {
        // Abramowitz & Stegun (1964), table 26.10: one-sided points of 0.975 and 0.99.
        for (nu, at_975, at_99) in [
            (1.0, 12.706, 31.821),
            (2.0, 4.303, 6.965),
            (4.0, 2.776, 3.747),
            (9.0, 2.262, 2.821),
            (120.0, 1.980, 2.358),
        ] {
            assert!(
                (student(nu).quantile(0.975) / at_975 - 1.0).abs() < 3e-4,
                "{nu}: {}",
                student(nu).quantile(0.975)
            );
            assert!(
                (student(nu).quantile(0.99) / at_99 - 1.0).abs() < 3e-4,
                "{nu}: {}",
                student(nu).quantile(0.99)
            );
        }
    }

    #[test]
    fn one_degree_of_freedom_is_the_distribution_of_cauchy() {
        for x in [-200.0, -1.0, 0.0, 0.3, 5.0] {
            let cauchy = 0.5 + f64::atan(x) / std::f64::consts::PI;
            let found = student(1.0).cdf(x);
            assert!(
                (found - cauchy).abs() < 1e-5 * cauchy.min(1.0 - cauchy) + 1e-7,
                "{x}: {found} {cauchy}"
            );
        }
    }

    #[test]
    fn root_is_found_with_few_evaluations() {
        for exact in [-3.0, -0.2, 0.0, 0.7, 6.0] {
            let values = std::cell::Cell::new(0);
            let found = root(-8.0, 8.0, 1e-12, |x: f64| {
                values.set(values.get() + 1);
                (x - exact).tanh() + 0.1 * (x - exact).powi(3)
            });
            assert!((found - exact).abs() < 1e-9, "{found} {exact}");
            assert!(values.get() < 40, "{} values for {exact}", values.get());
        }
    }

    #[test]
    fn distribution_is_normal_without_a_student_part_or_with_many_degrees_of_freedom() {
        let sharp = NormalPlusStudent {
            normal_std: 2.0,
            student_scale: 0.0,
            degrees_of_freedom: 1.0,
            ..student(1.0)
        };
        assert!((sharp.cdf(2.0) - normal_cdf(1.0)).abs() < 1e-12);
        let known = NormalPlusStudent {
            normal_std: 0.6,
            student_scale: 0.8,
            ..student(1e7)
        };
        assert!((known.cdf(2.0) - normal_cdf(2.0)).abs() < 1e-6);
    }

    #[test]
    fn sum_with_one_degree_of_freedom_is_the_profile_of_voigt() {
        // The centre of the Voigt profile: Re w(i/√2)/√(2π), with w(i/√2) = e^(1/2)·erfc(1/√2) =
        // 0.523 157 (Abramowitz & Stegun 1964, 7.1.3 and table 7.1).
        let sum = NormalPlusStudent {
            normal_std: 1.0,
            ..student(1.0)
        };
        let density = (sum.cdf(1e-3) - sum.cdf(-1e-3)) / 2e-3;
        assert!(
            (density - 0.523_157 / (2.0 * std::f64::consts::PI).sqrt()).abs() < 1e-5,
            "{density}"
        );
    }

    #[test]
    fn largest_usual_deviation_shortens_the_tail_of_few_records() {
        // P(X ≤ x) by a fine sum over σ instead of w: density exp(−τ²/(2σ²) − σ²/(2c²))/σ²,
        // variance σ², τ = 0.05, c = 0.25.
        let cut = NormalPlusStudent {
            student_scale: 0.05,
            largest_usual: 0.25,
            ..student(1.0)
        };
        let by_sum = |x: f64| {
            let (mut sum, mut total) = (0.0, 0.0);
            for step in 1..200_000 {
                let sigma = f64::from(step) * 1e-5;
                let density = (-0.5 * (0.05 / sigma).powi(2) - 0.5 * (sigma / 0.25).powi(2)).exp()
                    / sigma.powi(2);
                sum += density * normal_cdf(x / sigma);
                total += density;
            }
            sum / total
        };
        for x in [-0.6, -0.3, -0.05, 0.1, 0.4] {
            assert!(
                (cut.cdf(x) - by_sum(x)).abs() < 1e-5,
                "{x}: {} {}",
                cut.cdf(x),
                by_sum(x)
            );
        }
        let uncut = NormalPlusStudent {
            largest_usual: f64::INFINITY,
            ..cut
        };
        assert!(cut.quantile(0.99) < 0.3 * uncut.quantile(0.99));
        let many = NormalPlusStudent {
            degrees_of_freedom: 20.0,
            ..cut
        };
        let uncut = NormalPlusStudent {
            degrees_of_freedom: 20.0,
            ..uncut
        };
        assert!((many.quantile(0.99) / uncut.quantile(0.99) - 1.0).abs() < 0.02);
    }
}
