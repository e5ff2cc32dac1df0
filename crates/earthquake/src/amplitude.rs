//! How much a structure softens at which amplitude, learnt from its earlier events.
//!
//! Notation:
//!
//! - h = max(a − a₀, 0): decades of amplitude above the limit a₀ of weak motion
//! - d: softest y of the shaking minus y of the weak motion; v its variance
//! - c: scatter of the softening between motions of the same amplitude, which is assumed
//! - b: softening per decade, d = −b h, with the prior b ~ N(0, σ²)
//!
//! The posterior of b is normal with the variance 1/(1/σ² + Σ h²/(v + c²)) and the mean −Σ h d/(v +
//! c²) times this variance.

use serde::Serialize;

/// σ: standard deviation of the softening per decade (Δ ln k). Half a decade of ln f, as stiffness
/// is the square of frequency.
const PRIOR_STD: f64 = 1.0;

/// c: motions of the same amplitude differ in duration and frequency (Δ ln k).
const SCATTER: f64 = 0.25;

/// One event with shaking.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Softened {
    /// Amplitude above the limit of weak motion, in decades (h).
    pub decades: f64,
    /// Change of ln(stiffness) from weak motion to the softest moment (d), negative if the
    /// structure softened.
    pub change: f64,
    /// Variance of the change of ln(stiffness) (v).
    pub variance: f64,
}

/// Softening predicted from the earlier events at the amplitude of the present event.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Expected {
    /// Expected relative change of the stiffness, such as −0.3 for a softening by 30 %.
    pub change: f64,
    /// Observed minus expected change of ln(stiffness), in standard deviations. Negative if the
    /// structure softened more than expected.
    pub deviations: f64,
    /// Number of earlier events with shaking, on which the prediction is based.
    pub events: usize,
    /// Whether the observed change differs from the expected change by less than 2 standard
    /// deviations.
    pub is_as_expected: bool,
}

/// Difference to the expected softening that is still as expected (standard deviations).
const AS_EXPECTED: f64 = 2.0;

/// Compares the softening of an event with the softening predicted from the earlier events. Returns
/// `None` if there is no earlier event with shaking.
#[must_use]
pub fn compare(earlier: &[Softened], now: &Softened) -> Option<Expected> {
    if earlier.is_empty() {
        return None;
    }
    let variance = |event: &Softened| event.variance + SCATTER * SCATTER;
    let information = PRIOR_STD.powi(-2)
        + earlier
            .iter()
            .map(|event| event.decades.powi(2) / variance(event))
            .sum::<f64>();
    let score: f64 = earlier
        .iter()
        .map(|event| event.decades * event.change / variance(event))
        .sum();
    let per_decade = score / information; // −b
    let expected = per_decade * now.decades;
    let std = (now.decades.powi(2) / information + variance(now)).sqrt();
    let deviations = (now.change - expected) / std;
    Some(Expected {
        change: expected.exp_m1(),
        deviations,
        events: earlier.len(),
        is_as_expected: deviations.abs() < AS_EXPECTED,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn softened(decades: f64, change: f64) -> Softened {
        Softened {
            decades,
            change,
            variance: 0.01,
        }
    }

    #[test]
    fn softening_on_the_line_of_earlier_events_is_as_expected() {
        let earlier = [softened(0.5, -0.4), softened(1.0, -0.8)];
        let now = compare(&earlier, &softened(0.8, -0.64)).unwrap();
        assert!(now.is_as_expected, "{now:?}");
        // Σh²/v = 1.25/0.0725, and the prior shrinks the slope of 0.8 accordingly.
        let information: f64 = 1.25 / 0.0725;
        let expected: f64 = -0.64 * information / (1.0 + information);
        assert!((now.change - expected.exp_m1()).abs() < 1e-9);
    }

    #[test]
    fn softening_far_below_the_line_is_not_as_expected() {
        let earlier = [softened(0.5, -0.2), softened(1.0, -0.4)];
        let now = compare(&earlier, &softened(0.5, -1.4)).unwrap();
        assert!(!now.is_as_expected && now.deviations < -2.0, "{now:?}");
        assert_eq!(compare(&[], &softened(0.5, -0.8)), None);
    }

    #[test]
    fn one_weakly_shaking_event_says_little_about_a_strong_one() {
        let earlier = [softened(0.05, -0.02)];
        let now = compare(&earlier, &softened(1.2, -1.0)).unwrap();
        assert!(now.is_as_expected, "{now:?}");
    }
}
