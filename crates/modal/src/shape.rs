//! Mode shapes: assurance criterion, phase collinearity and normalisation.

use nalgebra::{Complex, DVector};

/// Returns the modal assurance criterion of two shapes, from 0 (orthogonal) to 1 (proportional).
///
/// MAC = |φ* ψ|² / (φ* φ · ψ* ψ) (Allemang 2003). Returns 0 if a shape is zero.
#[must_use]
pub fn mac(first: &DVector<Complex<f64>>, second: &DVector<Complex<f64>>) -> f64 {
    let norms = first.norm_squared() * second.norm_squared();
    if norms > 0.0 {
        first.dotc(second).norm_sqr() / norms
    } else {
        0.0
    }
}

/// Returns the modal phase collinearity: 1 if all channels move in phase or in opposite phase, 0
/// if their phases are spread evenly.
///
/// MPC = ((S_xx − S_yy)² + 4 S_xy²) / (S_xx + S_yy)², where x and y are the real and imaginary
/// parts (Pappa, Elliott & Schenk 1993).
#[must_use]
pub fn phase_collinearity(shape: &DVector<Complex<f64>>) -> f64 {
    let xx: f64 = shape.iter().map(|value| value.re * value.re).sum();
    let yy: f64 = shape.iter().map(|value| value.im * value.im).sum();
    let xy: f64 = shape.iter().map(|value| value.re * value.im).sum();
    if xx + yy > 0.0 {
        ((xx - yy).powi(2) + 4.0 * xy * xy) / (xx + yy).powi(2)
    } else {
        0.0
    }
}

/// Returns the channel with the largest amplitude.
pub(crate) fn largest(shape: &DVector<Complex<f64>>) -> usize {
    let norms = shape.iter().map(|value| value.norm_sqr()).enumerate();
    norms
        .max_by(|(_, a), (_, b)| a.total_cmp(b))
        .map_or(0, |(position, _)| position)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(values: &[(f64, f64)]) -> DVector<Complex<f64>> {
        DVector::from_iterator(
            values.len(),
            values.iter().map(|(re, im)| Complex::new(*re, *im)),
        )
    }

    #[test]
    fn assurance_ignores_scale_and_phase_and_is_zero_for_orthogonal_shapes() {
        let one = shape(&[(1.0, 0.0), (-0.5, 0.2)]);
        let turned = &one * Complex::new(-0.3, 2.0);
        assert!((mac(&one, &turned) - 1.0).abs() < 1e-14);
        let across = shape(&[(0.5, 0.2), (1.0, 0.0)]);
        assert!(mac(&one, &across) < 1e-14, "{}", mac(&one, &across));
    }

    #[test]
    fn collinearity_is_1_for_one_phase_and_0_for_a_quarter_turn() {
        let standing = &shape(&[(1.0, 0.0), (-2.0, 0.0), (0.3, 0.0)]) * Complex::new(0.6, 0.8);
        assert!((phase_collinearity(&standing) - 1.0).abs() < 1e-14);
        let travelling = shape(&[(1.0, 0.0), (0.0, 1.0)]);
        assert!(phase_collinearity(&travelling) < 1e-14);
    }
}
