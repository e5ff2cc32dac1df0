//! The measured modes of one epoch, for a structure with a model.

use crate::identify::Mode;
use nalgebra::{Complex, DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// Smallest standard deviation of a value of a shape with unit norm. The channel by which a shape
/// was scaled has none of its own.
const LEAST_SHAPE_STD: f64 = 0.002;

/// A mode of one epoch, as the update of stiffnesses uses it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SeenMode {
    pub(crate) ln_frequency: f64,
    /// Variance of ln f.
    pub(crate) variance: f64,
    pub(crate) shape: Option<SeenShape>,
}

/// A real shape of unit norm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SeenShape {
    pub(crate) values: DVector<f64>,
    /// Variances of the values.
    pub(crate) variances: DVector<f64>,
}

impl SeenMode {
    /// Creates a mode from its frequency (Hz) and its standard deviation (Hz), without a shape.
    #[must_use]
    pub fn new(frequency_hz: f64, frequency_std_hz: f64) -> Self {
        Self {
            ln_frequency: frequency_hz.ln(),
            variance: (frequency_std_hz / frequency_hz).powi(2),
            shape: None,
        }
    }

    /// Adds the shape at the channels of the model, with the standard deviations of its values.
    ///
    /// The shape may have any scale and phase. A shape of another number of values than there are
    /// standard deviations, or a zero shape, is left out.
    #[must_use]
    pub fn with_shape(mut self, values: &[Complex<f64>], std: &[f64]) -> Self {
        // The phase in which the real part is largest: half that of Σ z².
        let squares: Complex<f64> = values.iter().map(|value| value * value).sum();
        let turn = Complex::from_polar(1.0, -0.5 * squares.arg());
        let real = values.iter().map(|value| (value * turn).re);
        let real = DVector::from_iterator(values.len(), real);
        let norm = real.norm();
        if values.len() == std.len() && norm > 0.0 && norm.is_finite() {
            let variance = |std: &f64| (std / norm).max(LEAST_SHAPE_STD).powi(2);
            self.shape = Some(SeenShape {
                values: real / norm,
                variances: DVector::from_iterator(std.len(), std.iter().map(variance)),
            });
        }
        self
    }
}

impl From<&Mode> for SeenMode {
    fn from(mode: &Mode) -> Self {
        Self::new(mode.frequency_hz, mode.frequency_std_hz)
            .with_shape(mode.shape.as_slice(), &mode.shape_std)
    }
}

/// A shape of unit norm, and an orthonormal basis of what is orthogonal to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Frame {
    pub(crate) shape: DVector<f64>,
    pub(crate) basis: DMatrix<f64>,
}

impl Frame {
    /// Creates the frame of a shape that is not zero. `None` for less than two channels.
    pub(crate) fn new(shape: &DVector<f64>) -> Option<Self> {
        let len = shape.len();
        let norm = shape.norm();
        if len < 2 || !norm.is_finite() || norm == 0.0 {
            return None;
        }
        // The reflection of Householder that turns the first axis to the shape has the basis in its
        // other columns.
        let shape = shape / norm;
        let sign = if shape[0] < 0.0 { -1.0 } else { 1.0 };
        let mut mirror = shape.clone() * sign;
        mirror[0] += 1.0;
        let square = mirror.norm_squared();
        let reflection =
            DMatrix::identity(len, len) - (&mirror * mirror.transpose()) * (2.0 / square);
        Some(Self {
            shape,
            basis: reflection.columns(1, len - 1).into_owned(),
        })
    }

    /// Returns the part of a shape that is orthogonal to the frame's, per its part along it.
    /// `None` if the shapes are orthogonal.
    pub(crate) fn deviation(&self, shape: &DVector<f64>) -> Option<DVector<f64>> {
        let along = shape.dot(&self.shape);
        (along.abs() > LEAST_LIKENESS * shape.norm()).then(|| self.basis.tr_mul(shape) / along)
    }

    /// Returns the covariance of [`Self::deviation()`] from the variances of the values.
    pub(crate) fn covariance(&self, variances: &DVector<f64>) -> DMatrix<f64> {
        let mut weighted = self.basis.clone();
        for (mut row, variance) in weighted.row_iter_mut().zip(variances.iter()) {
            row *= *variance;
        }
        self.basis.tr_mul(&weighted)
    }
}

/// Smallest √MAC of a shape with that of the reference. Below it, it is another mode.
const LEAST_LIKENESS: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn basis_of_a_frame_is_orthonormal_and_orthogonal_to_its_shape() {
        for values in [[1.0, 2.0, -0.5], [-1.0, 0.0, 0.0], [0.0, 0.0, 3.0]] {
            let shape = DVector::from_column_slice(&values);
            let frame = Frame::new(&shape).unwrap();
            assert!((frame.basis.tr_mul(&frame.basis) - DMatrix::identity(2, 2)).norm() < 1e-14);
            assert!(frame.basis.tr_mul(&shape).norm() < 1e-14);
            assert!(frame.deviation(&(shape * -2.0)).unwrap().norm() < 1e-14);
        }
    }

    #[test]
    fn shape_does_not_depend_on_scale_and_phase() {
        let values = [(1.0, 0.1), (-0.5, 0.0), (0.2, -0.05)];
        let values: Vec<_> = values
            .iter()
            .map(|(re, im)| Complex::new(*re, *im))
            .collect();
        let turned: Vec<_> = values.iter().map(|z| z * Complex::new(-1.0, 2.0)).collect();
        let seen = |values: &[Complex<f64>]| {
            let seen = SeenMode::new(1.0, 0.01).with_shape(values, &[0.01; 3]);
            seen.shape.unwrap().values
        };
        let (one, other) = (seen(&values), seen(&turned));
        assert!((one.dot(&other).abs() - 1.0).abs() < 1e-14, "{one} {other}");
    }
}
