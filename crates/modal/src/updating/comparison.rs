//! Whether the modes of a model with estimated stiffnesses agree with measured ones.
//!
//! With x the estimates of ln k and C their covariance, ln f_j of the model has the variance
//! g_jᵀ C g_j, where g_j = ∂ ln f_j/∂x is the sensitivity of Fox & Kapoor (1968).

use super::observation::{SeenMode, SeenShape};
use super::part_model::PartModel;
use crate::ModalError;
use nalgebra::{DMatrix, DVector};

/// Smallest MAC between a measured mode and the mode of the model.
const LEAST_MAC: f64 = 0.8;
/// Smallest distance in MAC to every other mode of the model nearby. Below it, the sensors cannot
/// tell which mode it is.
const LEAST_MARGIN: f64 = 0.2;
/// Largest |Δ ln f| between them: a factor of 2. A mode of the model farther away is another one.
const LARGEST_DISTANCE: f64 = std::f64::consts::LN_2;
/// Quantile of the normal distribution of a two-sided interval of 99.9 %.
const QUANTILE: f64 = 3.290_526_731_491_895;
/// |Δ ln f| that neither interval contains: the error of a usable model, and of the identification
/// of a mode that is hardly excited.
const MODEL_ERROR: f64 = 0.05;

/// A measured mode and the mode of the model that it resembles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Comparison {
    /// Natural frequency of the model (Hz).
    pub model_hz: f64,
    /// Standard deviation of the natural frequency of the model (Hz), from the covariance of the
    /// stiffnesses.
    pub model_std_hz: f64,
    /// Whether the frequencies differ by more than both 99.9 % intervals and the error of a usable
    /// model, 5 %.
    pub is_apart: bool,
}

impl PartModel {
    /// Compares the modes at estimated stiffnesses with measured ones.
    ///
    /// - `ln_stiffness`: ln of the stiffness of each part, relative to nominal
    /// - `covariance`: its covariance
    ///
    /// Returns a comparison for each measured mode. It is `None` if the shape is unknown, does not
    /// clearly resemble one mode of the model, or resembles the same one as another measured shape.
    ///
    /// # Errors
    /// Returns an error if the eigenvalue problem has no finite solution.
    pub fn compare(
        &self,
        ln_stiffness: &DVector<f64>,
        covariance: &DMatrix<f64>,
        seen: &[Option<SeenMode>],
    ) -> Result<Vec<Option<Comparison>>, ModalError> {
        let (frequencies_hz, shapes) = self.whole_modes(ln_stiffness)?;
        let at_sensors = self.seen(&shapes);
        let resembled = |seen: &Option<SeenMode>| {
            let seen = seen.as_ref()?;
            let shape = seen.shape.as_ref()?;
            resembled(seen.ln_frequency, shape, &frequencies_hz, &at_sensors)
        };
        let matches: Vec<Option<usize>> = seen.iter().map(resembled).collect();
        let is_single = |mode: &usize| {
            let same = matches.iter().flatten().filter(|other| *other == mode);
            same.count() == 1
        };
        let compared = seen.iter().zip(&matches).map(|(seen, mode)| {
            let (Some(seen), Some(mode)) = (seen, mode.filter(is_single)) else {
                return Ok(None);
            };
            let followed = [shapes.column(mode).into_owned()];
            let lines = self.lines(ln_stiffness, &followed)?;
            Ok(lines.first().map(|line| {
                let by = &line.ln_frequency_by;
                let std = by.dot(&(covariance * by)).max(0.0).sqrt();
                let distance = (seen.ln_frequency - line.ln_frequency).abs();
                let model_hz = line.ln_frequency.exp();
                Comparison {
                    model_hz,
                    model_std_hz: model_hz * std,
                    is_apart: distance > MODEL_ERROR + QUANTILE * (seen.variance.sqrt() + std),
                }
            }))
        });
        compared.collect()
    }
}

/// Returns the mode of the model that a shape resembles clearly.
fn resembled(
    ln_frequency: f64,
    shape: &SeenShape,
    frequencies_hz: &[f64],
    at_sensors: &DMatrix<f64>,
) -> Option<usize> {
    if shape.values.len() != at_sensors.nrows() {
        return None;
    }
    let near = frequencies_hz.iter().enumerate();
    let near = near.filter(|(_, hz)| (ln_frequency - hz.ln()).abs() < LARGEST_DISTANCE);
    let mut likeness: Vec<(f64, usize)> = near
        .map(|(mode, _)| {
            let column = at_sensors.column(mode);
            let square = column.norm_squared();
            let along = column.dot(&shape.values);
            match square > 0.0 {
                true => (along * along / square, mode),
                false => (0.0, mode),
            }
        })
        .collect();
    likeness.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (highest, mode) = *likeness.first()?;
    let next = likeness.get(1).map_or(0.0, |(mac, _)| *mac);
    (highest >= LEAST_MAC && highest - next >= LEAST_MARGIN).then_some(mode)
}

#[cfg(test)]
mod tests {
    use super::super::part_model::tests::chain;
    use super::*;
    use nalgebra::Complex;

    const STD: f64 = 0.002;

    /// Returns the modes of a model as an epoch shows them, with frequencies times `factor`.
    fn seen(model: &PartModel, x: &DVector<f64>, factor: f64) -> Vec<Option<SeenMode>> {
        let (frequencies_hz, shapes) = model.modes(x).unwrap();
        let modes = frequencies_hz.iter().zip(shapes.column_iter());
        let modes = modes.map(|(hz, shape)| {
            let values: Vec<_> = shape.iter().map(|value| Complex::from(*value)).collect();
            let hz = hz * factor;
            Some(SeenMode::new(hz, STD * hz).with_shape(&values, &vec![0.01; values.len()]))
        });
        modes.collect()
    }

    fn tower() -> (PartModel, DVector<f64>) {
        (chain(&[2.0; 5], &[300.0; 5]), DVector::zeros(5))
    }

    fn apart(found: &[Option<Comparison>]) -> Vec<Option<bool>> {
        let apart = found.iter().map(|found| found.map(|found| found.is_apart));
        apart.collect()
    }

    /// All stiffnesses together have the standard deviation s of ln k, and ln f has s/2.
    #[test]
    fn intervals_and_the_error_of_a_model_must_all_be_exceeded() {
        let (model, x) = tower();
        let std = 0.02;
        let common = DMatrix::from_element(5, 5, std * std);
        let limit = 0.05 + 3.290_5 * (STD + std / 2.0);
        for (distance, is_apart) in [(0.0, false), (limit - 1e-3, false), (limit + 1e-3, true)] {
            for sign in [1.0, -1.0] {
                let modes = seen(&model, &x, f64::exp(sign * distance));
                let found = model.compare(&x, &common, &modes).unwrap();
                assert_eq!(apart(&found), [Some(is_apart); 5], "{distance}");
                let first = found[0].unwrap();
                assert!((first.model_std_hz / first.model_hz - std / 2.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_mode_is_matched_by_its_shape_and_not_by_its_frequency() {
        let (model, x) = tower();
        // The second mode is then as high as the third mode of the model.
        let modes = seen(&model, &x, 1.6);
        let found = model.compare(&x, &DMatrix::zeros(5, 5), &modes).unwrap();
        let (frequencies_hz, _) = model.modes(&x).unwrap();
        for (found, expected) in found.iter().zip(frequencies_hz) {
            let found = found.unwrap();
            assert!((found.model_hz - expected).abs() < 1e-9 * expected);
            assert!(found.is_apart);
        }
    }

    #[test]
    fn nothing_is_said_about_a_mode_that_could_be_another_one() {
        let (model, x) = tower();
        let none = DMatrix::zeros(5, 5);
        // Torsion has the shape of the sway on each floor, at another frequency.
        let mut twice = seen(&model, &x, 1.0);
        twice.push(seen(&model, &x, 1.4)[0].clone());
        let found = model.compare(&x, &none, &twice).unwrap();
        assert_eq!(apart(&found)[0], None);
        assert_eq!(apart(&found)[5], None);
        assert_eq!(apart(&found)[1..5], [Some(false); 4]);
        // A local mode resembles no mode of the model.
        let local: Vec<_> = (0..5).map(|at| Complex::from(f64::from(at == 2))).collect();
        let local = SeenMode::new(1.5, 0.001).with_shape(&local, &[0.01; 5]);
        let blurred = SeenMode::new(1.5, 0.001);
        let found = model
            .compare(&x, &none, &[Some(local), Some(blurred), None])
            .unwrap();
        assert_eq!(apart(&found), [None; 3]);
    }
}
