//! The knot T0 of the frost hinge min(T − T0, 0).

/// Candidates of T0 (°C).
pub(crate) const KNOTS: [f64; 9] = [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0];

/// Prior standard deviation of T0 (°C). Thermometers are not where the water freezes.
const KNOT_STD: f64 = 2.0;

/// Returns min(T − T0, 0) (°C).
pub(crate) fn below(temperature: f64, knot: f64) -> f64 {
    (temperature - knot).min(0.0)
}

/// Returns the logarithm of the prior density of T0 around the freezing point, up to a constant.
///
/// Without it, a commissioning without frost would choose any T0 that fits its noise.
pub(crate) fn ln_prior(knot: f64) -> f64 {
    -0.5 * (knot / KNOT_STD).powi(2)
}
