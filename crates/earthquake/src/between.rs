//! Scatter of one quantity between events, and the prediction for a further event.
//!
//! Sources: R. DerSimonian and N. Laird, *Meta-analysis in clinical trials*, Controlled Clinical
//! Trials 7 (1986), 177-188, for τ². J. P. T. Higgins, S. G. Thompson and D. J. Spiegelhalter, *A
//! re-evaluation of random-effects meta-analysis*, J. R. Statist. Soc. A 172 (2009), 137-159, for
//! the interval of a further study with K − 2 degrees of freedom. Notation:
//!
//! - θᵢ, sᵢ: value of event i and its standard deviation within the record, i = 1 … K
//! - w = 1/s², Q = Σ w (θ − θ̄)², C = Σw − Σw²/Σw
//! - τ² = max(0, (Q − (K − 1))/C): variance between events
//! - w* = 1/(s² + τ²), θ̄* = Σ w*θ/Σw*, se² = 1/Σw*

use serde::Serialize;
use statrs::distribution::{ContinuousCDF, StudentsT};

/// Minimum number of events from which the next event can be predicted. K events leave K − 2
/// degrees of freedom, so three events leave one.
pub const FEWEST_EVENTS: usize = 3;

/// The value of a quantity in one event, with its uncertainty within the record.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EventValue {
    /// Value of the quantity in the event (θ), in the unit of the quantity.
    pub value: f64,
    /// Standard deviation of the value within the record (s), in the unit of the quantity. Must be
    /// above 0.
    pub std: f64,
}

/// The values of several events, combined by a random-effects model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pooled {
    /// Number of events (K).
    pub events: usize,
    /// Weighted mean over the events (θ̄*), in the unit of the quantity.
    pub mean: f64,
    /// Standard error of the weighted mean (se), in the unit of the quantity.
    pub mean_std: f64,
    /// Standard deviation of the true values between events (τ), in the unit of the quantity.
    pub between_std: f64,
    /// Cochran's Q: weighted sum of the squared deviations from the mean, without unit.
    pub q: f64,
}

/// An interval that contains a value with a stated probability.
///
/// The interval does not store this probability.
/// [`JudgeSettings::level`](crate::JudgeSettings::level) sets it for the judgement of events.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// Lower bound of the interval, in the unit of the value.
    pub low: f64,
    /// Upper bound of the interval, in the unit of the value.
    pub high: f64,
}

impl Interval {
    /// Returns `true` if the interval contains a value.
    #[must_use]
    pub fn contains(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// Returns the interval of a function that is increasing over it.
    #[must_use]
    pub fn map(self, increasing: impl Fn(f64) -> f64) -> Self {
        Self {
            low: increasing(self.low),
            high: increasing(self.high),
        }
    }
}

impl Pooled {
    /// Pools events, with the scatter between them estimated. Returns `None` without events.
    ///
    /// One event shows no scatter: τ is then 0.
    #[must_use]
    pub fn new(events: &[EventValue]) -> Option<Self> {
        let (mean, weight) = weighted(events, 0.0)?;
        let squares = events.iter().map(|event| event.std.powi(-2).powi(2));
        let c = weight - squares.sum::<f64>() / weight;
        let q: f64 = events
            .iter()
            .map(|event| ((event.value - mean) / event.std).powi(2))
            .sum();
        let degrees = events.len() as f64 - 1.0;
        let variance = if events.len() > 1 {
            ((q - degrees) / c).max(0.0)
        } else {
            0.0
        };
        Self::with_scatter(events, variance.sqrt()).map(|pooled| Self { q, ..pooled })
    }

    /// Pools events with a stated scatter τ between them. Returns `None` without events.
    #[must_use]
    pub fn with_scatter(events: &[EventValue], between_std: f64) -> Option<Self> {
        let (mean, weight) = weighted(events, between_std)?;
        Some(Self {
            events: events.len(),
            mean,
            mean_std: weight.sqrt().recip(),
            between_std,
            q: 0.0,
        })
    }

    /// Returns the degrees of freedom K − 2. `None` with fewer than [`FEWEST_EVENTS`] events.
    #[must_use]
    pub fn degrees_of_freedom(&self) -> Option<f64> {
        (self.events >= FEWEST_EVENTS).then_some(self.events as f64 - 2.0)
    }

    /// Returns the deviation between a further event of standard deviation `std` and the mean:
    /// √(τ² + se² + s²).
    #[must_use]
    pub fn further_std(&self, std: f64) -> f64 {
        self.between_std.hypot(self.mean_std).hypot(std)
    }

    /// Returns the interval of a further event: θ̄* ± t(K−2)·√(τ² + se² + s²).
    ///
    /// Returns `None` with fewer than [`FEWEST_EVENTS`] events.
    #[must_use]
    pub fn prediction(&self, std: f64, level: f64) -> Option<Interval> {
        let degrees = self.degrees_of_freedom()?;
        let half = student_quantile(degrees, 0.5 + 0.5 * level) * self.further_std(std);
        Some(Interval {
            low: self.mean - half,
            high: self.mean + half,
        })
    }
}

/// Returns the mean with weights 1/(s² + τ²) and the sum of the weights. `None` without events.
fn weighted(events: &[EventValue], between_std: f64) -> Option<(f64, f64)> {
    let weight = |event: &EventValue| 1.0 / (event.std.powi(2) + between_std.powi(2));
    let sum: f64 = events.iter().map(weight).sum();
    let mean = events
        .iter()
        .map(|event| weight(event) * event.value)
        .sum::<f64>()
        / sum;
    (!events.is_empty()).then_some((mean, sum))
}

/// How often the events lie in the interval that the others predict.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Coverage {
    /// Number of events inside.
    pub inside: usize,
    /// Number of events.
    pub events: usize,
}

impl Coverage {
    /// Returns the share inside, 0 to 1. `None` without events.
    #[must_use]
    pub fn share(&self) -> Option<f64> {
        (self.events > 0).then(|| self.inside as f64 / self.events as f64)
    }
}

/// Predicts each event from all others, and counts how many lie in their interval.
///
/// Counts nothing with [`FEWEST_EVENTS`] events or fewer.
#[must_use]
pub fn leave_one_out(events: &[EventValue], level: f64) -> Coverage {
    let mut coverage = Coverage {
        inside: 0,
        events: 0,
    };
    for (index, event) in events.iter().enumerate() {
        let others: Vec<EventValue> = events
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != index)
            .map(|(_, other)| *other)
            .collect();
        let predicted = Pooled::new(&others).and_then(|pooled| pooled.prediction(event.std, level));
        if let Some(interval) = predicted {
            coverage.events += 1;
            coverage.inside += usize::from(interval.contains(event.value));
        }
    }
    coverage
}

/// Returns the quantile of Student's t. Many degrees of freedom are normal.
pub(crate) fn student_quantile(degrees: f64, probability: f64) -> f64 {
    StudentsT::new(0.0, 1.0, degrees).map_or(f64::NAN, |student| student.inverse_cdf(probability))
}

/// Returns the distribution function of Student's t.
pub(crate) fn student_cdf(degrees: f64, x: f64) -> f64 {
    StudentsT::new(0.0, 1.0, degrees).map_or(f64::NAN, |student| student.cdf(x))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Risk ratios of 13 trials of the BCG vaccine: cases and others with vaccine, cases and others
    /// without. G. A. Colditz et al., JAMA 271 (1994), 698-702.
    const BCG: [[f64; 4]; 13] = [
        [4.0, 119.0, 11.0, 128.0],
        [6.0, 300.0, 29.0, 274.0],
        [3.0, 228.0, 11.0, 209.0],
        [62.0, 13536.0, 248.0, 12619.0],
        [33.0, 5036.0, 47.0, 5761.0],
        [180.0, 1361.0, 372.0, 1079.0],
        [8.0, 2537.0, 10.0, 619.0],
        [505.0, 87886.0, 499.0, 87892.0],
        [29.0, 7470.0, 45.0, 7232.0],
        [17.0, 1699.0, 65.0, 1600.0],
        [186.0, 50448.0, 141.0, 27197.0],
        [5.0, 2493.0, 3.0, 2338.0],
        [27.0, 16886.0, 29.0, 17825.0],
    ];

    fn bcg() -> Vec<EventValue> {
        BCG.iter()
            .map(|[a, b, c, d]| EventValue {
                value: (a / (a + b) / (c / (c + d))).ln(),
                std: (1.0 / a - 1.0 / (a + b) + 1.0 / c - 1.0 / (c + d)).sqrt(),
            })
            .collect()
    }

    #[test]
    fn pooled_bcg_trials_have_the_published_figures() {
        // W. Viechtbauer, J. Stat. Softw. 36(3) (2010), and the reference of the R package metafor,
        // method DL: estimate −0.7141, standard error 0.1787, τ² 0.3088, Q 152.2330.
        let pooled = Pooled::new(&bcg()).unwrap();
        let near = |found: f64, published: f64| (found - published).abs() < 6e-5;
        assert!(near(pooled.mean, -0.7141), "{pooled:?}");
        assert!(near(pooled.mean_std, 0.1787), "{pooled:?}");
        assert!(near(pooled.between_std.powi(2), 0.3088), "{pooled:?}");
        assert!(near(pooled.q, 152.2330), "{pooled:?}");
    }

    #[test]
    fn interval_of_a_further_event_has_k_minus_2_degrees_of_freedom() {
        let pooled = Pooled::new(&bcg()).unwrap();
        // t(11) at 0.975 is 2.201 (Abramowitz & Stegun 1964, table 26.10).
        let half = 2.201 * (0.3088_f64 + 0.1787 * 0.1787).sqrt();
        let interval = pooled.prediction(0.0, 0.95).unwrap();
        assert!(
            (interval.low - (-0.7141 - half)).abs() < 1e-3,
            "{interval:?}"
        );
        assert!(
            (interval.high - (-0.7141 + half)).abs() < 1e-3,
            "{interval:?}"
        );
        let few = Pooled::new(&bcg()[..2]).unwrap();
        assert_eq!(few.prediction(0.0, 0.95), None);
    }

    #[test]
    fn equal_deviations_give_the_plain_mean_and_the_variance_of_the_events() {
        // With equal s, τ² is the sample variance minus s².
        let values = [1.0, 1.4, 0.8, 1.2, 1.1];
        let events = values.map(|value| EventValue { value, std: 0.1 });
        let pooled = Pooled::new(&events).unwrap();
        assert!((pooled.mean - 1.1).abs() < 1e-12);
        let variance = values.iter().map(|v| (v - 1.1_f64).powi(2)).sum::<f64>() / 4.0;
        assert!((pooled.between_std.powi(2) - (variance - 0.01)).abs() < 1e-12);
        assert!((pooled.mean_std.powi(2) - variance / 5.0).abs() < 1e-12);
    }

    #[test]
    fn coverage_counts_the_events_outside_the_interval_of_the_others() {
        let mut events: Vec<EventValue> = (0..10)
            .map(|i| EventValue {
                value: 0.01 * f64::from(i % 5),
                std: 0.01,
            })
            .collect();
        assert_eq!(leave_one_out(&events, 0.95).share(), Some(1.0));
        events[3].value = 1.0;
        let coverage = leave_one_out(&events, 0.95);
        assert_eq!((coverage.inside, coverage.events), (9, 10));
        assert_eq!(leave_one_out(&events[..3], 0.95).share(), None);
    }

    fn events() -> impl Strategy<Value = Vec<EventValue>> {
        let event =
            (-1.0..1.0_f64, 0.01..0.3_f64).prop_map(|(value, std)| EventValue { value, std });
        prop::collection::vec(event, 1..12)
    }

    proptest! {
        #[test]
        fn pooling_follows_shift_and_scale_and_ignores_the_order(
            mut events in events(),
            shift in -5.0..5.0_f64,
            scale in 0.1..10.0_f64,
        ) {
            let pooled = Pooled::new(&events).unwrap();
            events.reverse();
            for event in &mut events {
                event.value = scale * event.value + shift;
                event.std *= scale;
            }
            let moved = Pooled::new(&events).unwrap();
            prop_assert!((moved.mean - (scale * pooled.mean + shift)).abs() < 1e-9 * scale);
            prop_assert!((moved.between_std - scale * pooled.between_std).abs() < 1e-7 * scale);
            prop_assert!((moved.mean_std - scale * pooled.mean_std).abs() < 1e-9 * scale);
        }

        #[test]
        fn mean_lies_among_the_events_and_its_deviation_is_below_each_of_theirs(events in events()) {
            let pooled = Pooled::new(&events).unwrap();
            let low = events.iter().map(|e| e.value).fold(f64::INFINITY, f64::min);
            let high = events.iter().map(|e| e.value).fold(f64::NEG_INFINITY, f64::max);
            prop_assert!(pooled.mean >= low - 1e-12 && pooled.mean <= high + 1e-12);
            for event in &events {
                prop_assert!(pooled.mean_std <= event.std.hypot(pooled.between_std) + 1e-12);
            }
        }
    }
}
