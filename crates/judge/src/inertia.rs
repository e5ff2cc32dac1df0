//! Thermal inertia: concrete and soil follow the temperature of a thermometer within days.

use serde::{Deserialize, Serialize};

/// Candidates of the time constant (days).
///
/// A concrete wall of thickness L that is heated on both sides follows with L²/(π² α), with
/// α = 0.09 m²/day: one day for 0.9 m. A wall that is heated on one side takes four times as long.
pub(crate) const INERTIAS: [f64; 4] = [1.0, 2.0, 4.0, 8.0];

/// A temperature as the interior of the structure follows it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Interior {
    /// Temperature, and min(T − T0, 0), of a first-order delay (°C).
    pub(crate) celsius: f64,
    pub(crate) below: f64,
    /// How far the last day was in the frost zone, from 0 to 1.
    pub(crate) zone: f64,
}

impl Interior {
    /// Moves to today. `kept` is the share of the former temperature that remains.
    pub(crate) fn follow(&mut self, today: Self, kept: f64) {
        self.celsius += (1.0 - kept) * (today.celsius - self.celsius);
        self.below += (1.0 - kept) * (today.below - self.below);
        self.zone = today.zone;
    }
}

/// The interior on the last day, for each temperature.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Past {
    /// Number of the last day.
    day: Option<i64>,
    pub(crate) interiors: Vec<Interior>,
}

impl Past {
    /// Moves on to a day with these temperatures. Returns how far the day before it was in the
    /// frost zone, for each temperature.
    pub(crate) fn follow(&mut self, day: i64, today: &[Interior], inertia_days: f64) -> Vec<f64> {
        let Some(last) = self.day.replace(day) else {
            self.interiors = today.to_vec();
            return vec![0.0; today.len()];
        };
        let kept = (-((day - last) as f64) / inertia_days).exp();
        let interiors = self.interiors.iter_mut().zip(today);
        interiors
            .map(|(interior, today)| {
                let zone = if last + 1 == day { interior.zone } else { 0.0 };
                interior.follow(*today, kept);
                zone
            })
            .collect()
    }
}
