//! Probability of an outlier, and its bound.

use std::f64::consts::{LN_2, SQRT_2};

/// Returns the probability that a sample at a distance of `epsilon` scales is an outlier, (4.18).
///
/// At least as far out are `beyond` (`κ`) of the `regular` (`N`) samples in the window. `q` is the
/// two-sided Gaussian tail beyond `epsilon`, and `η` is binomial with `N + 1` trials. The result
/// `P(η ≤ κ)` is the probability that the tail contains no more samples than observed.
#[must_use]
pub fn outlier_probability(epsilon: f64, beyond: usize, regular: usize) -> f64 {
    let q = libm::erfc(epsilon.abs() / SQRT_2); // (4.11)
    let (trials, count) = ((regular + 1) as f64, beyond as f64);
    if beyond > regular || q <= 0.0 {
        return 1.0;
    }
    if q >= 1.0 {
        return 0.0; // the tail contains all N + 1 trials, more than were observed
    }
    // The terms decrease on both sides of the mean. The sum therefore starts at `count` and
    // proceeds away from the mean.
    let ratio = q / (1.0 - q);
    if count <= trials * q {
        let (mut term, mut sum, mut k) = (1.0, 1.0, count);
        while k > 0.0 && term > sum * f64::EPSILON {
            term *= k / ((trials - k + 1.0) * ratio);
            sum += term;
            k -= 1.0;
        }
        sum * ln_term(trials, count, q).exp()
    } else {
        let (mut term, mut sum, mut k) = (1.0, 1.0, count + 1.0);
        while k < trials && term > sum * f64::EPSILON {
            term *= (trials - k) * ratio / (k + 1.0);
            sum += term;
            k += 1.0;
        }
        1.0 - sum * ln_term(trials, count + 1.0, q).exp()
    }
}

/// Returns the logarithm of the probability that exactly `count` of `trials` are in a tail of
/// probability `q`, (4.16).
fn ln_term(trials: f64, count: f64, q: f64) -> f64 {
    let ln_choose =
        libm::lgamma(trials + 1.0) - libm::lgamma(count + 1.0) - libm::lgamma(trials - count + 1.0);
    ln_choose + count * q.ln() + (trials - count) * (-q).ln_1p()
}

/// Returns `ε_u` of a window, (4.27). Beyond it, every sample is an outlier with a probability of
/// at least one half.
#[must_use]
pub fn upper_bound(window: usize) -> f64 {
    let q = -(-LN_2 / (window as f64 + 1.0)).exp_m1(); // two-sided: (1 − q)^(N + 1) = ½, (4.26)
    let (mut low, mut high) = (0.0_f64, 40.0_f64);
    while high - low > f64::EPSILON * high {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break; // adjacent floating-point numbers
        }
        if libm::erfc(middle / SQRT_2) > q {
            low = middle
        } else {
            high = middle
        }
    }
    0.5 * (low + high)
}
