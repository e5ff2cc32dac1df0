//! Extended Kalman filter of a [`ParticleModel`] with numerical Jacobians, for warm start and
//! comparison (Ching et al. 2006).

use nalgebra::{DMatrix, DVector};
use spandrel_filter::{Interval, ParticleModel};

/// Mean and covariance of the augmented state after the last frame.
pub(crate) struct NumericalEkf<M> {
    model: M,
    pub(crate) mean: DVector<f64>,
    pub(crate) covariance: DMatrix<f64>,
    /// Steps of the central differences.
    steps: DVector<f64>,
}

impl<M: ParticleModel> NumericalEkf<M> {
    pub(crate) fn new(model: M, mean: DVector<f64>, covariance: DMatrix<f64>) -> Self {
        let steps = covariance.diagonal().map(|variance| 1e-5 * variance.sqrt());
        Self {
            model,
            mean,
            covariance,
            steps,
        }
    }

    /// Processes one frame without gaps. `previous` is the input one step earlier, or `None` at the
    /// time of the prior.
    pub(crate) fn step(&mut self, previous: Option<&[f64]>, current: &[f64], datum: &[f64]) {
        let (n, l) = (self.model.state_len(), self.model.disturbance_len());
        let interval = Interval {
            previous,
            current,
            mean_square: &[0.0],
        };
        let still = vec![0.0; l];
        let mut model = self.model.clone();
        let mut move_from = |state: &DVector<f64>, disturbance: &[f64]| {
            let mut moved = state.clone();
            model.propagate(interval, disturbance, moved.as_mut_slice());
            moved
        };
        let a = DMatrix::from_columns(
            &(0..n)
                .map(|j| {
                    let mut sides = [self.mean.clone(), self.mean.clone()];
                    sides[0][j] -= self.steps[j];
                    sides[1][j] += self.steps[j];
                    let [lower, upper] = sides.map(|state| move_from(&state, &still));
                    (upper - lower) / (2.0 * self.steps[j])
                })
                .collect::<Vec<_>>(),
        );
        let g = DMatrix::from_columns(
            &(0..l)
                .map(|j| {
                    let [lower, upper] = [-1e-2, 1e-2].map(|side| {
                        let mut disturbance = still.clone();
                        disturbance[j] = side;
                        move_from(&self.mean, &disturbance)
                    });
                    (upper - lower) / 2e-2
                })
                .collect::<Vec<_>>(),
        );
        self.mean = move_from(&self.mean, &still);
        self.covariance = &a * &self.covariance * a.transpose() + &g * g.transpose();
        self.update(interval, datum);
    }

    fn update(&mut self, interval: Interval<'_>, datum: &[f64]) {
        let (n, q) = (self.mean.len(), datum.len());
        let mut model = self.model.clone();
        let mut output_of = |state: &DVector<f64>| {
            let mut out = DVector::zeros(q);
            model.observe(interval, state.as_slice(), out.as_mut_slice());
            out
        };
        let c = DMatrix::from_columns(
            &(0..n)
                .map(|j| {
                    let mut sides = [self.mean.clone(), self.mean.clone()];
                    sides[0][j] -= self.steps[j];
                    sides[1][j] += self.steps[j];
                    let [lower, upper] = sides.map(|state| output_of(&state));
                    (upper - lower) / (2.0 * self.steps[j])
                })
                .collect::<Vec<_>>(),
        );
        let innovation = DVector::from_column_slice(datum) - output_of(&self.mean);
        let mut r = DMatrix::zeros(q, q);
        self.model.sensor_covariance(self.mean.as_slice(), &mut r);
        let s = &c * &self.covariance * c.transpose() + &r;
        let Some(factor) = s.cholesky() else {
            self.mean.fill(f64::NAN); // visible in every figure
            return;
        };
        let gain = factor.solve(&(&c * &self.covariance)).transpose();
        self.mean += &gain * innovation;
        let rest = DMatrix::identity(n, n) - &gain * c;
        self.covariance =
            &rest * &self.covariance * rest.transpose() + &gain * r * gain.transpose();
        self.covariance = (&self.covariance + self.covariance.transpose()) * 0.5;
    }
}
