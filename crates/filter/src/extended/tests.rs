use super::*;
use crate::kalman::{KalmanFilter, LinearModel};
use crate::noise::{NoiseRule, NoiseTarget};
use crate::outlier::{OutlierTraining, Verdict};
use crate::{CovarianceForm, FadingFactor, NoiseModel, NoiseSettings, OutlierSettings};
use nalgebra::{DMatrix, DVector};

/// A linear system without parameters, sparse enough to check by hand: two coupled oscillators,
/// both with a sensor.
#[derive(Debug, Clone)]
struct Linear {
    system: DMatrix<f64>,
    input: DMatrix<f64>,
    observation: DMatrix<f64>,
    direct: Option<DMatrix<f64>>,
    state: DVector<f64>,
    excitation: DVector<f64>,
}

fn two_oscillators() -> Linear {
    let system = DMatrix::from_row_slice(
        4,
        4,
        &[
            0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, -50.0, 20.0, -0.4, 0.1, 20.0, -30.0, 0.1, -0.3,
        ],
    );
    let input = DMatrix::from_row_slice(4, 1, &[0.0, 0.0, 1.0, 1.0]);
    let observation = DMatrix::from_row_slice(2, 4, &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    Linear {
        state: DVector::zeros(4),
        excitation: DVector::zeros(1),
        system,
        input,
        observation,
        direct: None,
    }
}

impl ProcessModel for Linear {
    fn state_len(&self) -> usize {
        self.system.nrows()
    }
    fn parameter_len(&self) -> usize {
        0
    }
    fn excitation_len(&self) -> usize {
        self.input.ncols()
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.excitation.copy_from_slice(excitation);
    }
    fn derivative(&self, out: &mut [f64]) {
        out.copy_from_slice(
            (&self.system * &self.state + &self.input * &self.excitation).as_slice(),
        );
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.copy_from(&(&self.system * columns));
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.copy_from(&self.input);
    }
    fn rate_bound(&self) -> f64 {
        10.0
    }
}

impl ObservationModel for Linear {
    fn observation_len(&self) -> usize {
        self.observation.nrows()
    }
    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
        self.state.copy_from_slice(state);
        self.excitation.copy_from_slice(excitation);
    }
    fn observe(&self, out: &mut [f64]) {
        let mut observed = &self.observation * &self.state;
        if let Some(direct) = &self.direct {
            observed += direct * &self.excitation;
        }
        out.copy_from_slice(observed.as_slice());
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.copy_from(&(&self.observation * columns));
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        self.direct.as_ref()
    }
}

fn settings() -> FilterSettings {
    let noise = NoiseModel::known(
        DMatrix::from_element(1, 1, 0.5),
        DMatrix::identity(2, 2) * 1e-4,
    );
    FilterSettings::new(0.01, DVector::zeros(4), DVector::repeat(4, 0.1), noise)
}

fn datum(k: usize) -> [f64; 2] {
    [(0.3 * k as f64).sin() * 0.02, (0.17 * k as f64).cos() * 0.1]
}

fn run(filter: &mut ExtendedKalmanFilter<Linear>, frames: std::ops::Range<usize>) {
    for k in frames {
        filter
            .step(Frame {
                observations: &datum(k),
                excitation: &[0.0],
            })
            .unwrap();
    }
}

#[test]
fn filter_without_parameters_and_fading_is_the_kalman_filter() {
    // ch2 §5 check 3
    let linear = two_oscillators();
    let (transition, input) = LinearModel::discretise(&linear.system, &linear.input, 0.01);
    let mut plain = KalmanFilter::new(
        LinearModel {
            transition,
            input,
            observation: linear.observation.clone(),
            excitation_covariance: DMatrix::from_element(1, 1, 0.5),
            sensor_covariance: DMatrix::identity(2, 2) * 1e-4,
        },
        DVector::zeros(4),
        DMatrix::identity(4, 4) * 0.01,
    )
    .unwrap();
    let mut extended = ExtendedKalmanFilter::new(linear, settings()).unwrap();
    for k in 0..500 {
        if k > 0 {
            plain.predict(&[0.0]);
        }
        let reference = plain.update(&datum(k)).unwrap();
        let step = extended
            .step(Frame {
                observations: &datum(k),
                excitation: &[0.0],
            })
            .unwrap();
        assert!(
            (extended.mean() - plain.mean()).amax() < 1e-12,
            "mean at step {k}"
        );
        assert!(
            (extended.covariance() - plain.covariance()).amax() < 1e-13,
            "covariance at step {k}"
        );
        assert!(
            (step.log_evidence - reference.log_evidence).abs()
                < 1e-8 * reference.log_evidence.abs()
        );
    }
}

#[test]
fn joseph_form_agrees_with_the_symmetric_form() {
    // ch2 §5 check 1
    let mut joseph = settings();
    joseph.covariance_form = CovarianceForm::Joseph;
    let mut joseph = ExtendedKalmanFilter::new(two_oscillators(), joseph).unwrap();
    let mut symmetric = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut joseph, 0..200);
    run(&mut symmetric, 0..200);
    assert!((joseph.covariance() - symmetric.covariance()).amax() < 1e-12);
    assert!((joseph.mean() - symmetric.mean()).amax() < 1e-12);
}

#[test]
fn missing_channel_is_a_channel_of_infinite_variance() {
    let mut missing = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    let mut wide = settings();
    wide.noise.sensors[(1, 1)] = 1e18;
    let mut wide = ExtendedKalmanFilter::new(two_oscillators(), wide).unwrap();
    for k in 0..100 {
        let [first, second] = datum(k);
        let step = missing
            .step(Frame {
                observations: &[first, f64::NAN],
                excitation: &[0.0],
            })
            .unwrap();
        assert_eq!(step.used_channels, 1);
        wide.step(Frame {
            observations: &[first, second],
            excitation: &[0.0],
        })
        .unwrap();
    }
    assert!((missing.mean() - wide.mean()).amax() < 1e-9);
    assert!((missing.covariance() - wide.covariance()).amax() < 1e-9);
}

#[test]
fn frame_without_channels_is_a_prediction() {
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut filter, 0..50);
    let before = filter.mean().clone();
    let step = filter
        .step(Frame {
            observations: &[f64::NAN; 2],
            excitation: &[0.0],
        })
        .unwrap();
    assert_eq!((step.used_channels, step.log_evidence), (0, 0.0));
    let linear = two_oscillators();
    let (transition, _) = LinearModel::discretise(&linear.system, &linear.input, 0.01);
    assert!((filter.mean() - transition * before).amax() < 1e-13);
}

#[test]
fn checkpoint_gives_the_same_bits_as_an_unbroken_run() {
    let mut unbroken = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut unbroken, 0..300);
    let mut first = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut first, 0..117);
    let bytes = postcard::to_stdvec(first.state()).unwrap();
    let mut second = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    second
        .restore(postcard::from_bytes(&bytes).unwrap())
        .unwrap();
    run(&mut second, 117..300);
    assert_eq!(unbroken.state(), second.state());
}

#[test]
fn direct_term_agrees_with_an_augmented_kalman_filter() {
    // Second route: the excitation of the coming step is a separate state, drawn again at every
    // step.
    let mut linear = two_oscillators();
    let direct = DMatrix::from_row_slice(2, 1, &[0.0, 0.8]);
    linear.direct = Some(direct.clone());
    let (transition, input) = LinearModel::discretise(&linear.system, &linear.input, 0.01);
    let mut augmented = DMatrix::zeros(5, 5);
    augmented.view_mut((0, 0), (4, 4)).copy_from(&transition);
    augmented.view_mut((0, 4), (4, 1)).copy_from(&input);
    let mut observation = DMatrix::zeros(2, 5);
    observation
        .view_mut((0, 0), (2, 4))
        .copy_from(&linear.observation);
    observation.view_mut((0, 4), (2, 1)).copy_from(&direct);
    let mut prior = DMatrix::identity(5, 5) * 0.01;
    prior[(4, 4)] = 0.5;
    let mut reference = KalmanFilter::new(
        LinearModel {
            transition: augmented,
            input: DMatrix::from_row_slice(5, 1, &[0.0, 0.0, 0.0, 0.0, 1.0]),
            observation,
            excitation_covariance: DMatrix::from_element(1, 1, 0.5),
            sensor_covariance: DMatrix::identity(2, 2) * 1e-4,
        },
        DVector::zeros(5),
        prior,
    )
    .unwrap();
    let mut filter = ExtendedKalmanFilter::new(linear, settings()).unwrap();
    for k in 0..300 {
        if k > 0 {
            reference.predict(&[0.0]);
        }
        reference.update(&datum(k)).unwrap();
        filter
            .step(Frame {
                observations: &datum(k),
                excitation: &[0.0],
            })
            .unwrap();
        assert!(
            (filter.mean() - reference.mean().rows(0, 4)).amax() < 1e-11,
            "mean at step {k}"
        );
        let covariance = reference.covariance().view((0, 0), (4, 4)).into_owned();
        assert!(
            (filter.covariance() - covariance).amax() < 1e-12,
            "covariance at step {k}"
        );
    }
}

#[test]
fn known_excitation_moves_the_prediction() {
    let linear = two_oscillators();
    let (transition, input) = LinearModel::discretise(&linear.system, &linear.input, 0.01);
    let mut filter = ExtendedKalmanFilter::new(linear, settings()).unwrap();
    let none = [f64::NAN; 2];
    filter
        .step(Frame {
            observations: &none,
            excitation: &[2.0],
        })
        .unwrap();
    filter
        .step(Frame {
            observations: &none,
            excitation: &[-1.0],
        })
        .unwrap();
    assert!((filter.mean() - &input * 2.0).amax() < 1e-14);
    let expected = transition * filter.mean() - &input;
    filter
        .step(Frame {
            observations: &none,
            excitation: &[0.0],
        })
        .unwrap();
    assert!((filter.mean() - expected).amax() < 1e-14);
}

#[test]
fn variance_stays_bounded_without_data() {
    let mut settings = settings();
    settings.fading = FadingFactor::from_half_life(20.0).unwrap();
    settings.variance_bound = DVector::repeat(4, 0.04);
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings).unwrap();
    for _ in 0..5000 {
        filter
            .step(Frame {
                observations: &[f64::NAN; 2],
                excitation: &[0.0],
            })
            .unwrap();
    }
    assert!(filter.covariance().diagonal().max() <= 0.04);
}

#[test]
fn variance_of_forgotten_motion_is_its_mean_square() {
    // The prior is much narrower than the motion, so that the motion determines the result.
    const PRIOR_STD: f64 = 1e-4;
    let mut settings = settings();
    settings.prior_std.fill(PRIOR_STD);
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings).unwrap();
    let mut sum_of_squares = [0.0; 4];
    for k in 0..500 {
        run(&mut filter, k..k + 1);
        for (sum, mean) in sum_of_squares.iter_mut().zip(filter.mean().iter()) {
            *sum += mean * mean;
        }
    }
    filter.forget_motion();
    assert_eq!(filter.mean().amax(), 0.0);
    for (j, sum) in sum_of_squares.into_iter().enumerate() {
        let root_mean_square = (sum / 500.0).sqrt();
        assert!(
            root_mean_square > 10.0 * PRIOR_STD,
            "state {j} moves by {root_mean_square}"
        );
        let std = filter.covariance()[(j, j)].sqrt();
        let expected = PRIOR_STD.hypot(root_mean_square);
        assert!(
            (std / expected - 1.0).abs() < 0.05,
            "state {j}: standard deviation {std}, expected {expected}"
        );
        assert!(
            filter
                .covariance()
                .row(j)
                .iter()
                .enumerate()
                .all(|(k, entry)| k == j || *entry == 0.0)
        );
    }
    run(&mut filter, 500..700);
}

#[test]
fn frame_of_the_wrong_size_is_rejected_and_the_filter_is_unchanged() {
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut filter, 0..10);
    let before = filter.state().clone();
    let error = filter
        .step(Frame {
            observations: &[0.0; 3],
            excitation: &[0.0],
        })
        .unwrap_err();
    assert_eq!(
        error,
        FilterError::Dimension {
            what: "observations of a frame",
            found: 3,
            expected: 2
        }
    );
    assert_eq!(&before, filter.state());
}

#[test]
fn infinite_datum_is_an_error_and_the_filter_can_restart() {
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut filter, 0..10);
    let error = filter
        .step(Frame {
            observations: &[f64::INFINITY, 0.0],
            excitation: &[0.0],
        })
        .unwrap_err();
    assert!(matches!(error, FilterError::NotFinite { .. }), "{error}");
    filter.restart();
    run(&mut filter, 0..10);
    assert!(filter.mean().iter().all(|entry| entry.is_finite()));
}

/// A random stable system of `n` states with two sensors and one excitation.
fn random_system(n: usize, entries: &[f64]) -> Linear {
    let mut next = entries.iter().copied().cycle();
    let mut random =
        |rows, columns| DMatrix::from_fn(rows, columns, |_, _| next.next().unwrap_or(0.0));
    let system = random(n, n) * 5.0 - DMatrix::identity(n, n) * 2.0;
    let (input, observation) = (random(n, 1), random(2, n));
    Linear {
        state: DVector::zeros(n),
        excitation: DVector::zeros(1),
        system,
        input,
        observation,
        direct: None,
    }
}

fn any_rule() -> impl proptest::strategy::Strategy<Value = NoiseRule> {
    proptest::sample::select(vec![
        NoiseRule::Fisher,
        NoiseRule::Published,
        NoiseRule::HalfOrDouble,
        NoiseRule::Fixed,
    ])
}

/// Assigns the level of both sensors to a rule that trains for 20 steps.
fn with_unknown_sensors(settings: &mut FilterSettings, rule: NoiseRule) {
    settings.noise.sensors.fill(0.0);
    settings
        .noise
        .parameters
        .push(crate::noise::NoiseParameter {
            name: "sensors".to_owned(),
            target: NoiseTarget::Sensors,
            pattern: DMatrix::identity(2, 2),
            start: 1e-4,
            start_std: 3e-5,
        });
    settings.noise_settings = NoiseSettings {
        rule,
        training_steps: 20,
        ..NoiseSettings::default()
    };
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(64))]

    #[test]
    fn covariance_stays_symmetric_and_positive(
        n in 2_usize..7,
        entries in proptest::collection::vec(-1.0_f64..1.0, 64),
        data in proptest::collection::vec(proptest::option::weighted(0.8, -3.0_f64..3.0), 120),
        joseph in proptest::bool::ANY,
        memory in 20.0_f64..5000.0,
        rule in proptest::option::of(any_rule()),
        screens: bool,
    ) {
        let noise = NoiseModel::known(DMatrix::from_element(1, 1, 0.3), DMatrix::identity(2, 2) * 1e-3);
        let mut settings = FilterSettings::new(0.02, DVector::zeros(n), DVector::repeat(n, 1.0), noise);
        if let Some(rule) = rule {
            with_unknown_sensors(&mut settings, rule);
        }
        // Screening is trained after 20 of 60 frames.
        settings.outliers = screens.then(|| OutlierSettings { training_steps: 20, ..OutlierSettings::for_period(20.0) });
        settings.fading = FadingFactor::from_half_life(memory).unwrap();
        settings.covariance_form = if joseph { CovarianceForm::Joseph } else { CovarianceForm::Symmetric };
        let mut filter = ExtendedKalmanFilter::new(random_system(n, &entries), settings).unwrap();
        for pair in data.chunks_exact(2) {
            let datum = [0, 1].map(|c| pair[c].unwrap_or(f64::NAN));
            filter.step(Frame { observations: &datum, excitation: &[0.0] }).unwrap();
            let covariance = filter.covariance();
            proptest::prop_assert_eq!(covariance, &covariance.transpose());
            // Relative, because the smallest eigenvalue of a wide prior is at rounding level in
            // every form.
            let eigenvalues = covariance.clone().symmetric_eigenvalues();
            proptest::prop_assert!(eigenvalues.min() >= -1e-12 * eigenvalues.max(), "eigenvalues {eigenvalues}");
        }
    }

    /// With λ = 1, known noise covariances and a linear model, the extended filter equals the
    /// Kalman filter.
    #[test]
    fn linear_chain_is_the_kalman_filter(
        n in 2_usize..7,
        entries in proptest::collection::vec(-1.0_f64..1.0, 64),
        data in proptest::collection::vec(-3.0_f64..3.0, 160),
    ) {
        let mut system = random_system(n, &entries);
        // Stable, because an unbounded response cannot agree to twelve digits.
        system.system -= DMatrix::identity(n, n) * 6.0;
        let (transition, input) = LinearModel::discretise(&system.system, &system.input, 0.02);
        let (excitation, sensors) = (DMatrix::from_element(1, 1, 0.3), DMatrix::identity(2, 2) * 1e-2);
        let linear = LinearModel {
            transition,
            input,
            observation: system.observation.clone(),
            excitation_covariance: excitation.clone(),
            sensor_covariance: sensors.clone(),
        };
        let mut plain = KalmanFilter::new(linear, DVector::zeros(n), DMatrix::identity(n, n)).unwrap();
        let noise = NoiseModel::known(excitation, sensors);
        let settings = FilterSettings::new(0.02, DVector::zeros(n), DVector::repeat(n, 1.0), noise);
        let mut chain = ExtendedKalmanFilter::new(system, settings).unwrap();
        for (k, pair) in data.chunks_exact(2).enumerate() {
            if k > 0 {
                plain.predict(&[0.0]);
            }
            plain.update(pair).unwrap();
            chain.step(Frame { observations: pair, excitation: &[0.0] }).unwrap();
            let scale = 1.0 + plain.mean().amax();
            proptest::prop_assert!((chain.mean() - plain.mean()).amax() < 1e-12 * scale, "mean at {k}");
            proptest::prop_assert!((chain.covariance() - plain.covariance()).amax() < 1e-12, "covariance at {k}");
        }
    }

    /// Limits that nothing exceeds leave every bit unchanged, for any linear system, memory and
    /// rule.
    #[test]
    fn infinite_thresholds_change_no_bit(
        n in 2_usize..7,
        entries in proptest::collection::vec(-1.0_f64..1.0, 64),
        data in proptest::collection::vec(proptest::option::weighted(0.9, -3.0_f64..3.0), 120),
        memory in 20.0_f64..5000.0,
        rule in proptest::option::of(any_rule()),
    ) {
        let mut settings = FilterSettings::new(
            0.02,
            DVector::zeros(n),
            DVector::repeat(n, 1.0),
            NoiseModel::known(DMatrix::from_element(1, 1, 0.3), DMatrix::identity(2, 2) * 1e-3),
        );
        if let Some(rule) = rule {
            with_unknown_sensors(&mut settings, rule);
        }
        settings.fading = FadingFactor::from_half_life(memory).unwrap();
        let mut plain = ExtendedKalmanFilter::new(random_system(n, &entries), settings.clone()).unwrap();
        let outliers = OutlierSettings { training_steps: 20, ..screened(f64::INFINITY).outliers.unwrap() };
        settings.outliers = Some(outliers);
        let mut screening = ExtendedKalmanFilter::new(random_system(n, &entries), settings).unwrap();
        for pair in data.chunks_exact(2) {
            let datum = [0, 1].map(|c| pair[c].unwrap_or(f64::NAN));
            let frame = Frame { observations: &datum, excitation: &[0.0] };
            let (one, other) = (plain.step(frame).unwrap(), screening.step(frame).unwrap());
            proptest::prop_assert_eq!(other.rejected_channels, 0);
            proptest::prop_assert_eq!(one.log_evidence, other.log_evidence);
        }
        proptest::prop_assert_eq!(plain.mean(), screening.mean());
        proptest::prop_assert_eq!(plain.covariance(), screening.covariance());
    }

    #[test]
    fn dropped_channel_is_one_of_infinite_variance(
        n in 2_usize..7,
        entries in proptest::collection::vec(-1.0_f64..1.0, 64),
        data in proptest::collection::vec(-3.0_f64..3.0, 120),
        memory in 20.0_f64..5000.0,
    ) {
        let filter = |second: f64| {
            let sensors = DMatrix::from_diagonal(&DVector::from_row_slice(&[1e-2, second]));
            let noise = NoiseModel::known(DMatrix::from_element(1, 1, 0.3), sensors);
            let mut settings = FilterSettings::new(0.02, DVector::zeros(n), DVector::repeat(n, 1.0), noise);
            settings.fading = FadingFactor::from_half_life(memory).unwrap();
            let mut system = random_system(n, &entries);
            // Stable, because a variance of 1e16 is not infinite beside that of an unbounded
            // response.
            system.system -= DMatrix::identity(n, n) * 6.0;
            ExtendedKalmanFilter::new(system, settings).unwrap()
        };
        let (mut dropped, mut wide) = (filter(1e-2), filter(1e16));
        for pair in data.chunks_exact(2) {
            dropped.step(Frame { observations: &[pair[0], f64::NAN], excitation: &[0.0] }).unwrap();
            wide.step(Frame { observations: pair, excitation: &[0.0] }).unwrap();
        }
        let scale = 1.0 + dropped.mean().amax();
        proptest::prop_assert!((dropped.mean() - wide.mean()).amax() < 1e-9 * scale);
        let scale = 1.0 + dropped.covariance().amax();
        proptest::prop_assert!((dropped.covariance() - wide.covariance()).amax() < 1e-9 * scale);
    }

    /// A filter that is stopped at any step, saved, loaded and resumed is bit-identical in all
    /// stages.
    ///
    /// This covers the noise levels under each rule and the outlier screening.
    #[test]
    fn resuming_at_any_step_is_bit_identical(
        stop in 1_usize..600,
        rule in any_rule(),
        screens: bool,
    ) {
        let settings = || {
            let mut settings = if screens { screened(3.5) } else { settings() };
            settings.fading = FadingFactor::from_half_life(500.0).unwrap();
            settings.annealing = Some(Annealing { amount: 10.0, time_constant_s: 1.0 });
            with_unknown_sensors(&mut settings, rule);
            settings.noise_settings.training_steps = 100;
            settings
        };
        let mut unbroken = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
        run(&mut unbroken, 0..stop);
        let bytes = postcard::to_stdvec(unbroken.state()).unwrap();
        let mut resumed = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
        resumed.restore(postcard::from_bytes(&bytes).unwrap()).unwrap();
        run(&mut unbroken, stop..600);
        run(&mut resumed, stop..600);
        proptest::prop_assert_eq!(unbroken.state(), resumed.state());
    }

    #[test]
    fn order_of_channels_changes_only_rounding(
        entries in proptest::collection::vec(-1.0_f64..1.0, 64),
        data in proptest::collection::vec(-3.0_f64..3.0, 80),
    ) {
        let straight = random_system(4, &entries);
        let mut swapped = straight.clone();
        swapped.observation.swap_rows(0, 1);
        let filter = |system| {
            let noise = NoiseModel::known(DMatrix::from_element(1, 1, 0.3), DMatrix::identity(2, 2) * 1e-2);
            let settings = FilterSettings::new(0.02, DVector::zeros(4), DVector::repeat(4, 1.0), noise);
            ExtendedKalmanFilter::new(system, settings).unwrap()
        };
        let (mut first, mut second) = (filter(straight), filter(swapped));
        for pair in data.chunks_exact(2) {
            first.step(Frame { observations: pair, excitation: &[0.0] }).unwrap();
            second.step(Frame { observations: &[pair[1], pair[0]], excitation: &[0.0] }).unwrap();
        }
        let scale = 1.0 + first.mean().amax();
        proptest::prop_assert!((first.mean() - second.mean()).amax() < 1e-9 * scale);
        proptest::prop_assert!((first.covariance() - second.covariance()).amax() < 1e-9);
    }
}

fn screened(upper: f64) -> FilterSettings {
    let mut settings = settings();
    settings.fading = FadingFactor::from_half_life(500.0).unwrap();
    settings.outliers = Some(OutlierSettings {
        lower: if upper.is_finite() { 2.0 } else { upper },
        upper,
        training: if upper.is_finite() {
            OutlierTraining::Gated(4.0)
        } else {
            OutlierTraining::Raw
        },
        ..OutlierSettings::for_period(20.0)
    });
    settings
}

#[test]
fn screening_without_rejections_changes_no_bit() {
    let plain = FilterSettings {
        outliers: None,
        ..screened(f64::INFINITY)
    };
    let mut with = ExtendedKalmanFilter::new(two_oscillators(), screened(f64::INFINITY)).unwrap();
    let mut without = ExtendedKalmanFilter::new(two_oscillators(), plain).unwrap();
    run(&mut with, 0..600);
    run(&mut without, 0..600);
    assert_eq!(with.mean(), without.mean());
    assert_eq!(with.covariance(), without.covariance());
    assert!(
        with.outliers()
            .unwrap()
            .channels()
            .iter()
            .all(|channel| channel.trained() && channel.rejected() == 0)
    );
}

#[test]
fn spike_is_rejected_and_a_frame_of_spikes_is_a_prediction() {
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), screened(3.5)).unwrap();
    run(&mut filter, 0..600);
    let mut spiked = filter.clone();
    let data = datum(600);
    let step = spiked
        .step(Frame {
            observations: &[data[0] + 10.0, data[1]],
            excitation: &[0.0],
        })
        .unwrap();
    assert_eq!((step.used_channels, step.rejected_channels), (1, 1));
    let mut missing = filter.clone();
    missing
        .step(Frame {
            observations: &[f64::NAN, data[1]],
            excitation: &[0.0],
        })
        .unwrap();
    assert_eq!(
        spiked.mean(),
        missing.mean(),
        "a rejected sample is a missing one"
    );
    assert_eq!(spiked.covariance(), missing.covariance());
    let channels = spiked.outliers().unwrap().channels();
    assert_eq!(
        [0, 1].map(|c| channels[c].verdict()),
        [Verdict::Outlier, Verdict::Regular]
    );
    assert!((channels[0].residual() - 10.0).abs() < 1.0 && spiked.innovation()[0].is_nan());

    let step = filter
        .step(Frame {
            observations: &[10.0, -10.0],
            excitation: &[0.0],
        })
        .unwrap();
    assert_eq!((step.used_channels, step.rejected_channels), (0, 2));
}

#[test]
fn wrong_samples_before_the_screening_raise_the_noise_level_only_for_seconds() {
    let mut settings = screened(3.5);
    with_unknown_sensors(&mut settings, NoiseRule::Fisher);
    if let Some(outliers) = &mut settings.outliers {
        outliers.training = OutlierTraining::Raw;
    }
    let level_after = |frames: usize, is_wrong: &dyn Fn(usize) -> bool| {
        let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings.clone()).unwrap();
        for k in 0..frames {
            let mut data = datum(k);
            if is_wrong(k) {
                data.iter_mut().for_each(|sample| *sample += 1.0);
            }
            filter
                .step(Frame {
                    observations: &data,
                    excitation: &[0.0],
                })
                .unwrap();
        }
        filter.noise().mean[0]
    };
    let seldom = |k: usize| k % 20 == 7;
    let (right, raised) = (level_after(190, &|_| false), level_after(190, &seldom));
    assert!(raised > 30.0 * right, "{raised:e} against {right:e}");
    let (right, fallen) = (level_after(600, &|_| false), level_after(600, &seldom));
    assert!(fallen < 10.0 * right, "{fallen:e} against {right:e}");
}

#[test]
fn screened_filter_resumes_bit_for_bit() {
    for stop in [1, 150, 199, 200, 201, 450] {
        let mut unbroken = ExtendedKalmanFilter::new(two_oscillators(), screened(3.5)).unwrap();
        run(&mut unbroken, 0..stop);
        let bytes = postcard::to_stdvec(unbroken.state()).unwrap();
        let mut resumed = ExtendedKalmanFilter::new(two_oscillators(), screened(3.5)).unwrap();
        resumed
            .restore(postcard::from_bytes(&bytes).unwrap())
            .unwrap();
        run(&mut unbroken, stop..600);
        run(&mut resumed, stop..600);
        assert_eq!(unbroken.state(), resumed.state(), "stopped at {stop}");
    }
}

#[test]
fn limits_without_a_value_between_them_are_rejected() {
    for limit in [1.0, f64::NAN] {
        let mut settings = settings();
        settings.lower[2] = limit;
        settings.upper[2] = 0.5;
        let error = ExtendedKalmanFilter::new(two_oscillators(), settings).unwrap_err();
        assert!(
            error.to_string().contains("lower limit of the state"),
            "{error}"
        );
    }
}

#[test]
fn restart_in_mid_motion_does_not_assume_rest() {
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    run(&mut filter, 0..400);
    let motion: Vec<f64> = filter.mean().iter().copied().collect();
    filter.restart();
    assert!(filter.mean().iter().all(|mean| *mean == 0.0));
    let prior = settings().prior_std[0].powi(2);
    assert!(
        (0..4).all(|j| filter.covariance()[(j, j)] > prior),
        "{motion:?}"
    );
}

#[test]
fn jitter_repairs_a_singular_innovation_covariance() {
    // Two channels with the same signal and no noise: `S` has rank 1.
    let mut model = two_oscillators();
    model.observation = DMatrix::from_row_slice(2, 4, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
    let mut settings = settings();
    settings.noise.sensors.fill(0.0);
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    for k in 0..50 {
        let z = 0.01 * f64::from(k).sin();
        filter
            .step(Frame {
                observations: &[z, z],
                excitation: &[0.0],
            })
            .unwrap();
    }
    assert!(filter.mean().iter().all(|mean| mean.is_finite()));
}

/// Runs a filter of two oscillators that identifies the level of its excitation, whose pattern is
/// `share`, on frames with the excitation `scale · f`. `direct` adds a direct effect on the data.
fn run_with_reliability(
    reliability: f64,
    scale: f64,
    share: f64,
    direct: bool,
) -> ExtendedKalmanFilter<Linear> {
    let mut model = two_oscillators();
    model.direct = direct.then(|| DMatrix::from_row_slice(2, 1, &[0.2, 0.1]));
    let mut settings = settings();
    settings.noise.excitation.fill(0.3 * share);
    settings.noise.parameters = vec![crate::noise::NoiseParameter {
        name: "ground".to_owned(),
        target: NoiseTarget::Excitation,
        pattern: DMatrix::from_element(1, 1, share),
        start: 0.5,
        start_std: 0.5,
    }];
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    filter.set_reliability(&[reliability]).unwrap();
    for k in 0..400 {
        let excitation = [scale * 2.0 * (0.07 * k as f64).sin()];
        let observations = datum(k);
        filter
            .step(Frame {
                observations: &observations,
                excitation: &excitation,
            })
            .unwrap();
    }
    filter
}

#[test]
fn reliability_scales_the_excitation_and_the_covariance_of_its_noise() {
    for direct in [false, true] {
        let reliable = run_with_reliability(0.3, 1.0, 1.0, direct);
        let scaled = run_with_reliability(1.0, 0.3, 0.3, direct);
        let trusted = run_with_reliability(1.0, 1.0, 1.0, direct);
        let distance = (reliable.mean() - scaled.mean()).amax();
        assert!(distance < 1e-9 * scaled.mean().amax(), "{distance:e}");
        let distance = (reliable.covariance() - scaled.covariance()).amax();
        assert!(distance < 1e-9 * scaled.covariance().amax());
        let (level, expected) = (reliable.noise().mean[0], scaled.noise().mean[0]);
        assert!((level - expected).abs() < 1e-9 * expected);
        assert!((reliable.mean() - trusted.mean()).amax() > 1e-3 * trusted.mean().amax());
    }
}

#[test]
fn reliability_outside_its_range_or_of_other_excitations_is_refused() {
    let mut filter = ExtendedKalmanFilter::new(two_oscillators(), settings()).unwrap();
    for (reliability, said) in [
        (&[1.5][..], "reliability of the excitation"),
        (&[f64::NAN], "reliability of the excitation"),
        (&[1.0, 1.0], "reliabilities of the excitation"),
    ] {
        let error = filter.set_reliability(reliability).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}
