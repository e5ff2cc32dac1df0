//! The knots of a temperature: where frost begins, where it is complete, and where warmth counts.

/// Candidates of T0 (°C).
pub(crate) const KNOTS: [f64; 9] = [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
/// Index of 0 °C among the candidates.
pub(crate) const FREEZING: usize = 3;
/// Below this (°C), all water is frozen and a further fall may count less.
const SATURATED: f64 = -4.0;
/// Number of knots of a day: the candidates of T0, and the saturation.
pub(crate) const DAY_KNOTS: usize = KNOTS.len() + 1;
/// Above these (°C), asphalt and other materials may have another slope.
pub(crate) const BENDS: [f64; 2] = [8.0, 22.0];

/// Prior standard deviation of T0 (°C). Thermometers are not where the water freezes.
const KNOT_STD: f64 = 2.0;
/// The frost zone begins this many candidates (°C) above T0, because ice melts slowly. It is
/// complete this much (°C) lower.
const ZONE: usize = 4;
const ZONE_DEPTH: f64 = 2.0;

/// Returns min(T − T0, 0) (°C).
pub(crate) fn below(temperature: f64, knot: f64) -> f64 {
    (temperature - knot).min(0.0)
}

/// Returns min(T − T0, 0) (°C) for every knot of a day.
pub(crate) fn below_all(temperature: f64) -> [f64; DAY_KNOTS] {
    std::array::from_fn(|index| below(temperature, KNOTS.get(index).copied().unwrap_or(SATURATED)))
}

/// Returns how far a day is in the frost zone, from 0 to 1. Water freezes and melts anywhere in it.
pub(crate) fn zone(below: &[f32; DAY_KNOTS], knot: usize) -> f64 {
    let top = (knot + ZONE).min(KNOTS.len() - 1);
    (-f64::from(below[top]) / ZONE_DEPTH).min(1.0)
}

/// Returns the logarithm of the prior density of T0 around the freezing point, up to a constant.
///
/// Without it, a commissioning without frost would choose any T0 that fits its noise.
pub(crate) fn ln_prior(knot: f64) -> f64 {
    -0.5 * (knot / KNOT_STD).powi(2)
}
