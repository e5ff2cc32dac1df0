//! Tracks a vehicle, as an example of a system that is not a structure. Only its position is
//! measured. The filter estimates position, velocity and acceleration.
//!
//! The vehicle drives straight, then on two semicircles: Huang & Yuen (2023), §2.3.1. The model of
//! the filter is a constant acceleration, disturbed by an unknown jerk. The filter also identifies
//! the variance of the position noise. Run with `cargo run -p spandrel-filter --example vehicle`.

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_filter::{
    ExtendedKalmanFilter, FilterError, FilterSettings, Frame, NoiseModel, NoiseParameter,
    NoiseTarget, ObservationModel, ProcessModel,
};
use std::f64::consts::PI;

/// Number of measured positions, one per second.
const SECONDS: usize = 462;
/// Start of the first semicircle (s).
const TURN: f64 = 60.0;
/// Angular velocity on the semicircles (rad/s): 201 s for each.
const ANGULAR_VELOCITY: f64 = PI / 201.0;
/// Standard deviation of the noise of a measured position (m). The filter does not know it.
const POSITION_STD: f64 = 5.0;

/// `y = [x, ẋ, ẍ, y, ẏ, ÿ]` (m, m/s, m/s²), driven by the jerk in both directions (m/s³).
#[derive(Debug, Clone, Default)]
struct Vehicle {
    state: [f64; 6],
    jerk: [f64; 2],
    observed: [f64; 2],
}

impl ProcessModel for Vehicle {
    fn state_len(&self) -> usize {
        6
    }

    fn parameter_len(&self) -> usize {
        0
    }

    fn excitation_len(&self) -> usize {
        2
    }

    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.jerk.copy_from_slice(excitation);
    }

    fn derivative(&self, out: &mut [f64]) {
        let [_, vx, ax, _, vy, ay] = self.state;
        out.copy_from_slice(&[vx, ax, self.jerk[0], vy, ay, self.jerk[1]]);
    }

    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        for (row, of) in [(0, 1), (1, 2), (3, 4), (4, 5)] {
            for column in 0..columns.ncols() {
                out[(row, column)] = columns[(of, column)];
            }
        }
    }

    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        (out[(2, 0)], out[(5, 1)]) = (1.0, 1.0);
    }

    /// Returns 1/s although all eigenvalues are zero, so that the series has enough terms for a
    /// step of 1 s.
    fn rate_bound(&self) -> f64 {
        1.0
    }
}

impl ObservationModel for Vehicle {
    fn observation_len(&self) -> usize {
        2
    }

    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.observed = [state[0], state[3]];
    }

    fn observe(&self, out: &mut [f64]) {
        out.copy_from_slice(&self.observed);
    }

    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for column in 0..columns.ncols() {
            (out[(0, column)], out[(1, column)]) = (columns[(0, column)], columns[(3, column)]);
        }
    }

    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

/// Returns the true position (m) and velocity (m/s) at `time_s` (s).
fn truth(time_s: f64) -> ([f64; 2], [f64; 2]) {
    let angle = ANGULAR_VELOCITY * (time_s - TURN);
    let speed = 100.0 * ANGULAR_VELOCITY;
    if angle <= 0.0 {
        return ([10.0 * time_s, 0.0], [10.0, 0.0]);
    }
    if angle <= PI {
        let (sin, cos) = angle.sin_cos();
        return (
            [600.0 + 100.0 * sin, -100.0 + 100.0 * cos],
            [speed * cos, -speed * sin],
        );
    }
    let (sin, cos) = (angle - PI).sin_cos();
    (
        [600.0 - 100.0 * sin, -300.0 + 100.0 * cos],
        [-speed * cos, -speed * sin],
    )
}

/// Returns a random jerk with the known standard deviation 0.14 m/s³, and a position noise to be
/// identified. Its initial standard deviation is 10 m.
fn noise() -> NoiseModel {
    let mut noise = NoiseModel::known(DMatrix::identity(2, 2) * 0.02, DMatrix::zeros(2, 2));
    noise.parameters.push(NoiseParameter {
        name: "position".to_owned(),
        target: NoiseTarget::Sensors,
        pattern: DMatrix::identity(2, 2),
        start: 100.0,
        start_std: 100.0,
    });
    noise
}

fn main() -> Result<(), FilterError> {
    let prior_std = DVector::repeat(6, 500.0_f64.sqrt());
    let settings = FilterSettings::new(1.0, DVector::zeros(6), prior_std, noise());
    let mut filter = ExtendedKalmanFilter::new(Vehicle::default(), settings)?;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut squares = [0.0; 3];
    println!(
        "time s   position error m   its std m   velocity error m/s   its std m/s   noise of a \
         position m"
    );
    for second in 1..=SECONDS {
        let (position, velocity) = truth(second as f64);
        let seen = position.map(|x| {
            let normal: f64 = StandardNormal.sample(&mut random);
            x + POSITION_STD * normal
        });
        filter.step(Frame {
            observations: &seen,
            excitation: &[0.0; 2],
        })?;
        let (mean, covariance) = (filter.mean(), filter.covariance());
        let distance = |at: [f64; 2], of: [f64; 2]| (at[0] - of[0]).hypot(at[1] - of[1]);
        let std = |entries: [usize; 2]| {
            (covariance[(entries[0], entries[0])] + covariance[(entries[1], entries[1])]).sqrt()
        };
        let position_error = distance([mean[0], mean[3]], position);
        let velocity_error = distance([mean[1], mean[4]], velocity);
        for (square, error) in
            squares
                .iter_mut()
                .zip([position_error, distance(seen, position), velocity_error])
        {
            *square += error * error;
        }
        if second % 33 == 0 {
            println!(
                "{second:6} {position_error:18.2} {:11.2} {velocity_error:20.2} {:13.2} {:23.2}",
                std([0, 3]),
                std([1, 4]),
                filter.noise().mean[0].sqrt()
            );
        }
    }
    let [tracked, raw, velocity] = squares.map(|square| (square / SECONDS as f64).sqrt());
    println!(
        "rms error: position {tracked:.2} m (as observed {raw:.2} m), velocity {velocity:.2} m/s"
    );
    Ok(())
}
