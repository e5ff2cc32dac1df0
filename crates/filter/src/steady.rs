//! Stationary gain and error covariance of a linear filter, also for a gain designed with wrong
//! noise levels.
//!
//! Notation of [`LinearModel`]: `u_{i+1} = A u_i + B f_i`, `z_i = H u_i + n_i`. The covariance `P`
//! of the predicted state solves the Riccati equation `P = A P (I + Hᵀ Σ_n⁻¹ H P)⁻¹ Aᵀ + B Σ_f Bᵀ`.
//! The solution is by doubling (Chu, Fan, Lin & Wang 2004, *Int. J. Control* 77, 767): each
//! iteration covers twice as many steps as the previous one. The functions do not apply to a filter
//! with a direct term, because its state noise and sensor noise are correlated.

use crate::dense::symmetrise_mut;
use crate::error::FilterError;
use crate::kalman::LinearModel;
use nalgebra::{Cholesky, DMatrix};

/// Maximum number of doublings; 2⁶⁰ steps are practically infinite.
const LARGEST_DOUBLINGS: usize = 60;
/// Relative change of the covariance at which the doubling ends.
const CONVERGED: f64 = 1e-13;

/// A Kalman filter in its stationary state.
#[derive(Debug, Clone, PartialEq)]
pub struct StationaryGain {
    /// `G = P Hᵀ S⁻¹` (n × N_0).
    pub gain: DMatrix<f64>,
    /// `P`, the covariance of the predicted state (n × n).
    pub predicted: DMatrix<f64>,
    /// `(I − G H) P`, the covariance of the filtered state (n × n).
    pub filtered: DMatrix<f64>,
    /// `S = H P Hᵀ + Σ_n` (N_0 × N_0).
    pub innovation_covariance: DMatrix<f64>,
}

/// Returns the stationary filter of a model with correct noise covariances.
///
/// # Errors
/// Returns an error if a size does not fit or `Σ_n` is not positive definite. It also fails if
/// there is no stationary filter, because a mode is neither damped nor observed.
pub fn stationary_gain(model: &LinearModel) -> Result<StationaryGain, FilterError> {
    model.check()?;
    let (a, b, h) = (&model.transition, &model.input, &model.observation);
    let sensors = &model.sensor_covariance;
    let factor = Cholesky::new(sensors.clone()).ok_or(FilterError::NoStationaryFilter)?;
    let information = h.transpose() * factor.solve(h); // Hᵀ Σ_n⁻¹ H
    let process_noise = b * &model.excitation_covariance * b.transpose();
    let predicted = riccati_by_doubling(a.transpose(), information, process_noise)
        .ok_or(FilterError::NoStationaryFilter)?;
    let h_p = h * &predicted;
    let mut innovation_covariance = &h_p * h.transpose() + sensors;
    symmetrise_mut(&mut innovation_covariance);
    let factor =
        Cholesky::new(innovation_covariance.clone()).ok_or(FilterError::NoStationaryFilter)?;
    let gain = factor.solve(&h_p).transpose();
    let mut filtered = &predicted - &gain * &h_p;
    symmetrise_mut(&mut filtered);
    Ok(StationaryGain {
        gain,
        predicted,
        filtered,
        innovation_covariance,
    })
}

/// Returns the stationary error covariance of the filtered state (n × n) for a constant gain `G`
/// (n × N_0).
///
/// The noise covariances are those of `model`; the gain may be designed with others. The error
/// obeys `e_{i+1} = (I − G H)(A e_i − B f_i) + G n_{i+1}`, so its covariance solves a Lyapunov
/// equation.
///
/// # Errors
/// Returns an error if a size does not fit or the filter is not stable.
pub fn stationary_error_covariance(
    model: &LinearModel,
    gain: &DMatrix<f64>,
) -> Result<DMatrix<f64>, FilterError> {
    model.check()?;
    let (n, channels) = (model.transition.nrows(), model.observation.nrows());
    FilterError::check_sizes([
        ("rows of the gain", gain.nrows(), n),
        ("columns of the gain", gain.ncols(), channels),
    ])?;
    let correction = DMatrix::identity(n, n) - gain * &model.observation; // I − G H
    let b = &correction * &model.input;
    let noise = &b * &model.excitation_covariance * b.transpose()
        + gain * &model.sensor_covariance * gain.transpose();
    lyapunov_by_doubling(correction * &model.transition, noise)
        .ok_or(FilterError::NoStationaryFilter)
}

/// Solves `X = Aᵀ X (I + G X)⁻¹ A + Q` for symmetric `G`, `Q` (all n × n); `None` if the doubling
/// does not converge.
#[must_use]
pub fn riccati_by_doubling(
    mut a: DMatrix<f64>,
    mut g: DMatrix<f64>,
    mut q: DMatrix<f64>,
) -> Option<DMatrix<f64>> {
    let n = a.nrows();
    for _ in 0..LARGEST_DOUBLINGS {
        let factor = (DMatrix::identity(n, n) + &g * &q).lu();
        let w_a = factor.solve(&a)?; // W⁻¹ A
        let w_g = factor.solve(&g)?; // W⁻¹ G
        let change = a.transpose() * (&q * &w_a);
        g += &a * w_g * a.transpose();
        a = &a * w_a;
        q += &change;
        q = (&q + q.transpose()) * 0.5;
        g = (&g + g.transpose()) * 0.5;
        let size = q.norm();
        if !size.is_finite() {
            return None;
        }
        if change.norm() <= CONVERGED * size {
            return Some(q);
        }
    }
    None
}

/// Solves `X = A X Aᵀ + Q` for a symmetric `Q` (n × n).
///
/// Returns `None` if the doubling does not converge, because `A` is not stable.
#[must_use]
pub fn lyapunov_by_doubling(mut a: DMatrix<f64>, mut q: DMatrix<f64>) -> Option<DMatrix<f64>> {
    for _ in 0..LARGEST_DOUBLINGS {
        let change = &a * &q * a.transpose();
        a = &a * &a;
        q += &change;
        symmetrise_mut(&mut q);
        let size = q.norm();
        if !size.is_finite() {
            return None;
        }
        if change.norm() <= CONVERGED * size {
            return Some(q);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kalman::KalmanFilter;
    use nalgebra::DVector;

    /// Two masses under one white force, with both displacements observed.
    fn model(excitation: f64, sensors: f64) -> LinearModel {
        let mut system = DMatrix::zeros(4, 4);
        system.view_mut((0, 2), (2, 2)).fill_with_identity();
        system
            .view_mut((2, 0), (2, 4))
            .copy_from_slice(&[-8.0, 4.0, 4.0, -4.0, -0.2, 0.1, 0.1, -0.1]);
        let input = DMatrix::from_column_slice(4, 1, &[0.0, 0.0, 0.0, 1.0]);
        let (transition, input) = LinearModel::discretise(&system, &input, 0.05);
        LinearModel {
            transition,
            input,
            observation: DMatrix::identity(2, 4),
            excitation_covariance: DMatrix::from_element(1, 1, excitation),
            sensor_covariance: DMatrix::identity(2, 2) * sensors,
        }
    }

    /// A scalar with `a = 1` and unit noises: `P² = P + 1`, the golden ratio.
    #[test]
    fn a_random_walk_has_the_golden_ratio_as_its_variance() {
        let one = || DMatrix::from_element(1, 1, 1.0);
        let p = riccati_by_doubling(one(), one(), one()).unwrap();
        assert!((p[(0, 0)] - (1.0 + 5.0_f64.sqrt()) / 2.0).abs() < 1e-12);
    }

    #[test]
    fn stationary_filter_is_the_limit_of_the_recursion() {
        let model = model(2.0, 1e-3);
        let found = stationary_gain(&model).unwrap();
        let mut filter =
            KalmanFilter::new(model.clone(), DVector::zeros(4), DMatrix::identity(4, 4)).unwrap();
        for _ in 0..3000 {
            filter.predict(&[0.0]);
            filter.update(&[0.0, 0.0]).unwrap();
        }
        let scale = filter.covariance().amax();
        assert!((filter.covariance() - &found.filtered).amax() < 1e-11 * scale);
        filter.predict(&[0.0]);
        assert!((filter.covariance() - &found.predicted).amax() < 1e-11 * scale);
        // With the right gain, both ways to the error covariance agree.
        let error = stationary_error_covariance(&model, &found.gain).unwrap();
        assert!((error - found.filtered).amax() < 1e-11 * scale);
    }

    #[test]
    fn error_of_a_wrong_gain_satisfies_the_recursion() {
        let (truth, believed) = (model(2.0, 1e-3), model(0.5, 0.1));
        let gain = stationary_gain(&believed).unwrap().gain;
        let found = stationary_error_covariance(&truth, &gain).unwrap();
        // Joseph's form holds for any gain.
        let correction = DMatrix::identity(4, 4) - &gain * &truth.observation;
        let mut error = DMatrix::identity(4, 4);
        for _ in 0..3000 {
            let predicted = &truth.transition * &error * truth.transition.transpose()
                + &truth.input * &truth.excitation_covariance * truth.input.transpose();
            error = &correction * predicted * correction.transpose()
                + &gain * &truth.sensor_covariance * gain.transpose();
        }
        assert!((&error - &found).amax() < 1e-11 * found.amax());
        let best = stationary_gain(&truth).unwrap().filtered;
        assert!(
            found.trace() > 1.05 * best.trace(),
            "a wrong gain costs something"
        );
    }

    #[test]
    fn an_unstable_filter_is_refused() {
        let mut growing = model(1.0, 1.0);
        growing.transition *= 2.0;
        let no_gain = DMatrix::zeros(4, 2);
        assert_eq!(
            stationary_error_covariance(&growing, &no_gain),
            Err(FilterError::NoStationaryFilter)
        );
        assert!(stationary_error_covariance(&growing, &DMatrix::zeros(3, 2)).is_err());
    }
}
