//! q: half of the 95 % interval of a day, in units of its scatter, as the judged days teach it.
//!
//! - q ← q + γ (m − 0.05), m = 1 for a day outside its interval, and 0 for one inside it
//!
//! After n days, the share outside is 0.05 + (q − q0)/(γ n), regardless of the errors, as long as q
//! is within its limits. Source: Gibbs & Candès (2021), Adaptive conformal inference under
//! distribution shift, Advances in Neural Information Processing Systems 34. They adapt the level.
//! This form adapts q itself, so that the interval remains finite: the quantile tracking of
//! Angelopoulos, Candès & Tibshirani (2023), Conformal PID control for time series prediction,
//! Advances in Neural Information Processing Systems 36.

/// Share of the days in their interval.
pub(crate) const INTERVAL: f64 = 0.95;
/// γ: what one day outside its interval adds to q, nearly. A hundred days inside it take away half
/// of a usual q, so that q follows the seasons.
const STEP: f64 = 0.25;
/// q remains within these multiples of that of the commissioning.
const LIMITS: (f64, f64) = (0.25, 2.0);

/// Returns q after a day with this error, in units of its scatter. `first` is q of the
/// commissioning.
pub(crate) fn next(quantile: f64, first: f64, error: f64) -> f64 {
    let outside = f64::from(u8::from(error.abs() > quantile));
    let next = quantile + STEP * (outside - (1.0 - INTERVAL));
    next.clamp(LIMITS.0 * first, LIMITS.1 * first)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Errors whose absolute values are uniform up to `largest`.
    fn errors(largest: f64) -> impl Iterator<Item = f64> {
        (0..4000).map(move |day| largest * (f64::from(day) * 0.618_034).fract())
    }

    #[test]
    fn the_share_inside_is_that_of_the_interval_whatever_the_first_quantile_is() {
        for largest in [1.2, 2.0, 3.5] {
            let (mut quantile, mut inside) = (2.0, 0.0);
            for error in errors(largest) {
                inside += f64::from(u8::from(error <= quantile));
                quantile = next(quantile, 2.0, error);
            }
            let share = inside / 4000.0;
            assert!((share - INTERVAL).abs() < 0.005, "{largest}: {share}");
        }
    }

    #[test]
    fn the_quantile_remains_within_its_limits() {
        let last = |error: f64| (0..4000).fold(2.0, |quantile, _| next(quantile, 2.0, error));
        assert_eq!((last(0.0), last(-100.0)), (0.5, 4.0));
    }
}
