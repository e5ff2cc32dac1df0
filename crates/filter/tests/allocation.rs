//! Checks that a step does not allocate, in any phase and with every stage enabled.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_filter::{
    Annealing, BandLimit, CovarianceForm, DirectTerm, ExtendedKalmanFilter, FadingFactor,
    FilterSettings, Frame, InputHold, ModalModel, NoiseModel, NoiseParameter, NoisePhase,
    NoiseRule, NoiseSettings, NoiseTarget, ObservationModel, OutlierSettings, ProcessModel,
    StateSpace,
};

const MASSES: usize = 8; // n = 19: all dimensions above the size from which nalgebra's products allocate
const STIFFNESS: f64 = 5000.0;

/// Masses of 1 kg, each on its own spring: `ẍ = −θ k (x + β ẋ) − α ẋ + f`, with the state `y = [x,
/// ẋ, θ, α, β]`. The sensors measure all accelerations, without `f`.
#[derive(Debug, Clone)]
struct Springs {
    state: DVector<f64>,
    force: f64,
}

impl Springs {
    fn new() -> Self {
        Self {
            state: DVector::zeros(2 * MASSES + 3),
            force: 0.0,
        }
    }

    fn acceleration(&self, i: usize) -> f64 {
        let (y, n) = (&self.state, 2 * MASSES);
        -y[n] * STIFFNESS * (y[i] + y[n + 2] * y[MASSES + i]) - y[n + 1] * y[MASSES + i]
    }

    /// Derivative of that acceleration along a column.
    fn along(&self, columns: &DMatrix<f64>, j: usize, i: usize) -> f64 {
        let (y, n) = (&self.state, 2 * MASSES);
        let (x, v, along) = (y[i], y[MASSES + i], columns.column(j));
        -y[n] * STIFFNESS * (along[i] + y[n + 2] * along[MASSES + i] + along[n + 2] * v)
            - along[n] * STIFFNESS * (x + y[n + 2] * v)
            - y[n + 1] * along[MASSES + i]
            - along[n + 1] * v
    }
}

impl ProcessModel for Springs {
    fn state_len(&self) -> usize {
        2 * MASSES + 3
    }
    fn parameter_len(&self) -> usize {
        3
    }
    fn excitation_len(&self) -> usize {
        1
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.force = excitation[0];
    }
    fn derivative(&self, out: &mut [f64]) {
        out.fill(0.0);
        for i in 0..MASSES {
            out[i] = self.state[MASSES + i];
            out[MASSES + i] = self.acceleration(i) + self.force;
        }
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        for j in 0..columns.ncols() {
            for i in 0..MASSES {
                out[(i, j)] = columns[(MASSES + i, j)];
                out[(MASSES + i, j)] = self.along(columns, j, i);
            }
        }
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        out.rows_mut(MASSES, MASSES).fill(1.0);
    }
    fn rate_bound(&self) -> f64 {
        let n = 2 * MASSES;
        let omega = (STIFFNESS * self.state[n].abs()).sqrt();
        omega * (1.0 + self.state[n + 2].abs() * omega) + self.state[n + 1].abs()
    }
}

impl ObservationModel for Springs {
    fn observation_len(&self) -> usize {
        MASSES
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.state.copy_from_slice(state);
    }
    fn observe(&self, out: &mut [f64]) {
        (0..MASSES).for_each(|i| out[i] = self.acceleration(i));
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        for j in 0..columns.ncols() {
            (0..MASSES).for_each(|i| out[(i, j)] = self.along(columns, j, i));
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

fn fill_with_noise(datum: &mut [f64], rng: &mut ChaCha8Rng) {
    let draw = |value: &mut f64| *value = StandardNormal.sample(rng);
    datum.iter_mut().for_each(draw);
}

fn filter(rule: NoiseRule, form: CovarianceForm) -> ExtendedKalmanFilter<Springs> {
    let n = 2 * MASSES + 3;
    let noise = NoiseModel {
        excitation: DMatrix::identity(1, 1),
        sensors: DMatrix::zeros(MASSES, MASSES),
        parameters: vec![NoiseParameter {
            name: "sensors".to_owned(),
            target: NoiseTarget::Sensors,
            pattern: DMatrix::identity(MASSES, MASSES),
            start: 1e-2,
            start_std: 3e-3,
        }],
    };
    let mut mean = DVector::zeros(n);
    let mut std = DVector::repeat(n, 1e-3);
    for j in 0..3 {
        mean[2 * MASSES + j] = [1.0, 0.3, 3e-4][j];
        std[2 * MASSES + j] = [0.1, 0.1, 1e-4][j];
    }
    let mut settings = FilterSettings::new(0.0025, mean, std, noise);
    settings.fading = FadingFactor::from_half_life(1000.0).unwrap();
    settings.annealing = Some(Annealing {
        amount: 10.0,
        time_constant_s: 0.1,
    });
    settings.input_hold = InputHold::First;
    settings.covariance_form = form;
    settings.outliers = Some(OutlierSettings::for_period(30.0));
    settings.variance_bound = DVector::repeat(n, 1.0);
    settings.noise_settings = NoiseSettings {
        rule,
        training_steps: 200,
        training_limit_steps: 400,
        ..NoiseSettings::default()
    };
    ExtendedKalmanFilter::new(Springs::new(), settings).unwrap()
}

#[test]
fn step_allocates_nothing() {
    for rule in [
        NoiseRule::Fixed,
        NoiseRule::Published,
        NoiseRule::Fisher,
        NoiseRule::HalfOrDouble,
    ] {
        for form in [CovarianceForm::Symmetric, CovarianceForm::Joseph] {
            let mut filter = filter(rule, form);
            let mut rng = ChaCha8Rng::seed_from_u64(3);
            let mut band_limit = BandLimit::low_pass(4, 50.0, 400.0, MASSES).unwrap();
            let mut datum = vec![0.0; MASSES];
            let mut phases = [0, 0];
            let counted = allocation_counter::measure(|| {
                for k in 0..1500 {
                    fill_with_noise(&mut datum, &mut rng);
                    band_limit.apply(&mut datum);
                    if k % 7 == 0 {
                        datum[2] = f64::NAN; // a channel with occasional dropouts
                    }
                    let excitation = [if k % 11 == 0 { f64::NAN } else { 0.1 }];
                    let step = filter
                        .step(Frame {
                            observations: &datum,
                            excitation: &excitation,
                        })
                        .unwrap();
                    phases[usize::from(step.noise_phase == NoisePhase::Working)] += 1;
                }
            });
            assert_eq!(counted.count_total, 0, "{rule:?}, {form:?}");
            assert!(
                phases[1] > 0,
                "{rule:?}: the working phase was never reached"
            );
            assert!(
                rule == NoiseRule::Fixed || phases[0] > 0,
                "{rule:?}: the training phase was never seen"
            );
        }
    }
}

/// Checks a chain without parameters under a force on every mass, in physical or modal coordinates.
fn linear_step_allocates_nothing<M: ProcessModel + ObservationModel>(model: M) {
    let n = model.state_len();
    let parameter = |target, start| NoiseParameter {
        name: format!("{target:?}"),
        target,
        pattern: DMatrix::identity(MASSES, MASSES),
        start,
        start_std: start / 3.0,
    };
    let mut noise = NoiseModel::known(
        DMatrix::zeros(MASSES, MASSES),
        DMatrix::zeros(MASSES, MASSES),
    );
    noise.parameters = vec![
        parameter(NoiseTarget::Excitation, 10.0),
        parameter(NoiseTarget::Sensors, 10.0),
    ];
    let mut settings =
        FilterSettings::new(0.0025, DVector::zeros(n), DVector::repeat(n, 1e-2), noise);
    settings.noise_settings = NoiseSettings {
        rule: NoiseRule::HalfOrDouble,
        training_steps: 50,
        ..NoiseSettings::default()
    };
    settings.input_hold = InputHold::First;
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let (mut datum, mut force) = (vec![0.0; MASSES], vec![0.1; MASSES]);
    let mut phases = [0, 0];
    let counted = allocation_counter::measure(|| {
        for k in 0..400 {
            fill_with_noise(&mut datum, &mut rng);
            if k % 7 == 0 {
                datum[2] = f64::NAN;
            }
            if k % 50 == 49 {
                datum.fill(f64::NAN);
            }
            force[1] = if k % 11 == 0 { f64::NAN } else { 0.1 };
            let step = filter
                .step(Frame {
                    observations: &datum,
                    excitation: &force,
                })
                .unwrap();
            phases[usize::from(step.noise_phase == NoisePhase::Working)] += 1;
        }
    });
    assert_eq!(counted.count_total, 0);
    assert!(phases.iter().all(|&count| count > 0), "phases {phases:?}");
}

#[test]
fn step_of_a_linear_model_allocates_nothing() {
    let mass = DMatrix::identity(MASSES, MASSES);
    let stiffness = DMatrix::from_fn(MASSES, MASSES, |i, j| match i.abs_diff(j) {
        0 => 2.0 * STIFFNESS,
        1 => -STIFFNESS,
        _ => 0.0,
    });
    let damping = &mass * 0.3 + &stiffness * 2.5e-4;
    let mut observation = DMatrix::zeros(MASSES, 2 * MASSES);
    observation.columns_mut(0, MASSES).copy_from(&-&stiffness);
    observation
        .columns_mut(MASSES, MASSES)
        .copy_from(&-&damping);
    for direct in [
        DirectTerm::None,
        DirectTerm::Known(mass.clone()),
        DirectTerm::Whole(mass.clone()),
    ] {
        let of = [&mass, &damping, &stiffness];
        let physical =
            StateSpace::second_order(of, &mass, observation.clone(), direct.clone()).unwrap();
        linear_step_allocates_nothing(physical);
        linear_step_allocates_nothing(ModalModel::new(of, &mass, &observation, direct).unwrap());
    }
}
