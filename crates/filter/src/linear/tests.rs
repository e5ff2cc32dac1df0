use super::*;
use crate::{
    ExtendedKalmanFilter, FadingFactor, FilterSettings, Frame, InputHold, NoiseModel,
    NoiseParameter, NoisePhase, NoiseRule, NoiseSettings, NoiseTarget, OutlierSettings,
};

/// Three unequal masses in a row with Rayleigh damping and two forces. The first and the last have
/// absolute accelerometers.
fn matrices() -> ([DMatrix<f64>; 3], DMatrix<f64>, DMatrix<f64>) {
    let mass = DMatrix::from_diagonal(&DVector::from_row_slice(&[2.0, 1.0, 0.5]));
    let stiffness = DMatrix::from_row_slice(
        3,
        3,
        &[90.0, -40.0, 0.0, -40.0, 60.0, -20.0, 0.0, -20.0, 20.0],
    );
    let damping = &mass * 0.1 + &stiffness * 0.004;
    let distribution = DMatrix::from_row_slice(3, 2, &[1.0, 0.0, 0.0, 0.5, 0.0, 1.0]);
    let mut observation = DMatrix::zeros(2, 6);
    for (row, floor) in [(0, 0), (1, 2)] {
        for j in 0..3 {
            observation[(row, j)] = -stiffness[(floor, j)] / mass[(floor, floor)];
            observation[(row, 3 + j)] = -damping[(floor, j)] / mass[(floor, floor)];
        }
    }
    ([mass, damping, stiffness], distribution, observation)
}

fn pair() -> (StateSpace, ModalModel) {
    let ([mass, damping, stiffness], distribution, observation) = matrices();
    let of = [&mass, &damping, &stiffness];
    (
        StateSpace::second_order(of, &distribution, observation.clone(), DirectTerm::None).unwrap(),
        ModalModel::new(of, &distribution, &observation, DirectTerm::None).unwrap(),
    )
}

#[test]
fn both_coordinates_have_the_same_derivative_and_the_same_datum() {
    let (mut physical, mut modal) = pair();
    let modal_from_physical = modal.modal_from_physical();
    assert!(
        (modal.physical_from_modal() * &modal_from_physical - DMatrix::identity(6, 6)).amax()
            < 1e-13
    );
    let y = DVector::from_row_slice(&[0.3, -0.2, 0.7, 1.1, -0.4, 0.2]);
    let q = &modal_from_physical * &y;
    let f = [0.6, -1.3];
    physical.linearise_process(y.as_slice(), &f);
    modal.linearise_process(q.as_slice(), &f);
    let (mut rate, mut modal_rate) = (DVector::zeros(6), DVector::zeros(6));
    physical.derivative(rate.as_mut_slice());
    modal.derivative(modal_rate.as_mut_slice());
    assert!((modal_from_physical * rate - modal_rate).amax() < 1e-11);
    physical.linearise_observation(y.as_slice(), &f);
    modal.linearise_observation(q.as_slice(), &f);
    let (mut z, mut modal_z) = ([0.0; 2], [0.0; 2]);
    physical.observe(&mut z);
    modal.observe(&mut modal_z);
    assert!(z.iter().zip(modal_z).all(|(a, b)| (a - b).abs() < 1e-11));
}

#[test]
fn bound_of_the_rate_is_close_to_the_spectral_radius_and_above_it() {
    let (physical, modal) = pair();
    let largest = modal.angular_frequencies().max(); // underdamped: |λ| = ω
    for bound in [physical.rate_bound(), modal.rate_bound()] {
        assert!(
            bound >= largest * (1.0 - 1e-12) && bound < 1.2 * largest,
            "{bound} for {largest}"
        );
    }
}

#[test]
fn both_transitions_are_the_same_map() {
    let (physical, modal) = pair();
    let dense = physical.constant_transition(0.05).unwrap();
    let diagonal = modal.constant_transition(0.05).unwrap();
    let (to_physical, to_modal) = (modal.physical_from_modal(), modal.modal_from_physical());
    assert!((dense.held_input() - &to_physical * diagonal.held_input()).amax() < 1e-14);
    let covariance = DMatrix::from_fn(6, 6, |i, j| (1.0 + (i * j) as f64).sin());
    let covariance = &covariance * covariance.transpose();
    let mut column = DVector::zeros(6);
    let (mut out, mut modal_out) = (DMatrix::zeros(6, 6), DMatrix::zeros(6, 6));
    dense.propagate_covariance_to(&covariance, &mut out, &mut column);
    let modal_covariance = &to_modal * &covariance * to_modal.transpose();
    diagonal.propagate_covariance_to(&modal_covariance, &mut modal_out, &mut column);
    assert!((&out - &to_physical * modal_out * to_physical.transpose()).amax() < 1e-11);
    let mut columns = DMatrix::identity(6, 6);
    let mut modal_columns = to_modal.clone();
    dense.mul_mut(&mut columns, &mut column);
    diagonal.mul_mut(&mut modal_columns, &mut column);
    assert!((&columns * covariance * columns.transpose() - out).amax() < 1e-11);
    assert!((columns - to_physical * modal_columns).amax() < 1e-12);
}

#[test]
fn damping_that_couples_the_modes_is_refused() {
    let ([mass, mut damping, stiffness], distribution, observation) = matrices();
    damping[(2, 2)] += 1.0;
    let error = ModalModel::new(
        [&mass, &damping, &stiffness],
        &distribution,
        &observation,
        DirectTerm::None,
    )
    .unwrap_err();
    assert!(error.to_string().contains("classical"), "{error}");
}

#[test]
fn wrong_sizes_are_rejected() {
    let ([mass, damping, stiffness], distribution, observation) = matrices();
    let of = [&mass, &damping, &stiffness];
    let short = observation.columns(0, 5).into_owned();
    assert!(ModalModel::new(of, &distribution, &short, DirectTerm::None).is_err());
    assert!(StateSpace::second_order(of, &distribution, short, DirectTerm::None).is_err());
    let wide = DirectTerm::Known(DMatrix::zeros(2, 3));
    assert!(ModalModel::new(of, &distribution, &observation, wide).is_err());
    let indefinite = -&mass;
    assert!(
        ModalModel::new(
            [&indefinite, &damping, &stiffness],
            &distribution,
            &observation,
            DirectTerm::None
        )
        .is_err()
    );
}

/// The same model without its constant transition, so that every step is discretised.
#[derive(Debug, Clone)]
struct Stepwise(StateSpace);

impl ProcessModel for Stepwise {
    fn state_len(&self) -> usize {
        self.0.state_len()
    }
    fn parameter_len(&self) -> usize {
        0
    }
    fn excitation_len(&self) -> usize {
        self.0.excitation_len()
    }
    fn linearise_process(&mut self, state: &[f64], excitation: &[f64]) {
        self.0.linearise_process(state, excitation);
    }
    fn derivative(&self, out: &mut [f64]) {
        self.0.derivative(out);
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        self.0.jacobian_mul(columns, out);
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        self.0.excitation_matrix(out);
    }
    fn rate_bound(&self) -> f64 {
        self.0.rate_bound()
    }
}

impl ObservationModel for Stepwise {
    fn observation_len(&self) -> usize {
        self.0.observation_len()
    }
    fn linearise_observation(&mut self, state: &[f64], excitation: &[f64]) {
        self.0.linearise_observation(state, excitation);
    }
    fn observe(&self, out: &mut [f64]) {
        ObservationModel::observe(&self.0, out);
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        self.0.observation_jacobian_mul(columns, out);
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        self.0.feedthrough()
    }
}

fn settings(model: &impl ProcessModel, rule: NoiseRule, hold: InputHold) -> FilterSettings {
    let n = model.state_len();
    let correlated = DMatrix::from_row_slice(2, 2, &[1.0, 0.4, 0.4, 0.7]);
    let parameter = |name: &str, target, pattern, start: f64| NoiseParameter {
        name: name.to_owned(),
        target,
        pattern,
        start,
        start_std: start / 3.0,
    };
    let mut noise = NoiseModel::known(DMatrix::identity(2, 2) * 0.1, DMatrix::zeros(2, 2));
    noise.parameters = vec![
        parameter("forces", NoiseTarget::Excitation, correlated, 3.0),
        parameter(
            "sensors",
            NoiseTarget::Sensors,
            DMatrix::identity(2, 2),
            0.5,
        ),
    ];
    let mut settings = FilterSettings::new(
        0.05,
        DVector::repeat(n, 0.1),
        DVector::repeat(n, 0.3),
        noise,
    );
    settings.fading = FadingFactor::from_half_life(500.0).unwrap();
    settings.input_hold = hold;
    settings.noise_settings = NoiseSettings {
        rule,
        training_steps: 40,
        ..NoiseSettings::default()
    };
    settings
}

/// Runs 120 frames with known excitation. Samples of one channel, of the excitation and of a whole
/// frame are missing.
fn run<M: ProcessModel + ObservationModel>(
    model: M,
    settings: FilterSettings,
) -> ExtendedKalmanFilter<M> {
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    for k in 0..120 {
        let t = 0.05 * f64::from(k);
        let mut observations = [
            2.0 * (3.0 * t).sin() - 0.4 * (29.0 * t).cos(),
            (4.1 * t).cos(),
        ];
        let mut excitation = [(2.0 * t).sin(), 0.3 * (7.0 * t).cos()];
        match k % 17 {
            3 => observations[1] = f64::NAN,
            8 => excitation[0] = f64::NAN,
            13 => observations = [f64::NAN; 2],
            _ => {}
        }
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
fn constant_transition_agrees_with_the_series() {
    let ([mass, damping, stiffness], distribution, observation) = matrices();
    let direct = DMatrix::from_row_slice(2, 2, &[0.5, 0.0, 0.0, 2.0]);
    for direct in [
        DirectTerm::None,
        DirectTerm::Known(direct.clone()),
        DirectTerm::Whole(direct),
    ] {
        for rule in [
            NoiseRule::Fixed,
            NoiseRule::Published,
            NoiseRule::Fisher,
            NoiseRule::HalfOrDouble,
        ] {
            for hold in [InputHold::Zero, InputHold::First] {
                let of = [&mass, &damping, &stiffness];
                let model = StateSpace::second_order(
                    of,
                    &distribution,
                    observation.clone(),
                    direct.clone(),
                )
                .unwrap();
                let settings = settings(&model, rule, hold);
                let constant = run(model.clone(), settings.clone());
                let stepwise = run(Stepwise(model), settings);
                let label = format!("{direct:?}, {rule:?}, {hold:?}");
                let scale = stepwise.mean().amax();
                assert!(
                    (constant.mean() - stepwise.mean()).amax() < 1e-10 * scale,
                    "{label}"
                );
                let scale = stepwise.covariance().amax();
                assert!(
                    (constant.covariance() - stepwise.covariance()).amax() < 1e-10 * scale,
                    "{label}"
                );
                let ratio = constant.noise().mean.component_div(&stepwise.noise().mean);
                assert!(
                    ratio.iter().all(|ratio| (ratio - 1.0).abs() < 1e-9),
                    "{label}"
                );
            }
        }
    }
}

/// With a constant transition, the residual variance must include the excitation noise of the step.
#[test]
fn outliers_are_screened_alike_with_and_without_a_constant_transition() {
    let ([mass, damping, stiffness], distribution, observation) = matrices();
    let of = [&mass, &damping, &stiffness];
    let model = StateSpace::second_order(of, &distribution, observation, DirectTerm::None).unwrap();
    let mut settings = settings(&model, NoiseRule::Fixed, InputHold::Zero);
    settings.outliers = Some(OutlierSettings::for_period(5.0));
    let constant = run(model.clone(), settings.clone());
    let stepwise = run(Stepwise(model), settings);
    let screens = [&constant.outliers().unwrap(), &stepwise.outliers().unwrap()]
        .map(|state| state.channels());
    for (constant, stepwise) in screens[0].iter().zip(screens[1]) {
        assert!(constant.trained() && stepwise.trained());
        for (found, expected) in [
            (constant.scale(), stepwise.scale()),
            (constant.residual(), stepwise.residual()),
        ] {
            assert!((found / expected - 1.0).abs() < 1e-9, "{found}, {expected}");
        }
        assert_eq!(constant.rejected(), stepwise.rejected());
    }
}

/// A datum without noise; the levels are those of `settings`.
fn step_without_excitation<M: ProcessModel + ObservationModel>(
    filter: &mut ExtendedKalmanFilter<M>,
    k: usize,
) {
    let t = 0.05 * k as f64;
    let observations = [(3.0 * t).sin() - 0.4 * (11.0 * t).cos(), (4.1 * t).cos()];
    let frame = Frame {
        observations: &observations,
        excitation: &[0.0; 2],
    };
    filter.step(frame).unwrap();
}

/// Both noise levels times a factor, all deviations of the prior times another.
fn scaled(levels: f64, prior: f64) -> ExtendedKalmanFilter<StateSpace> {
    let (model, _) = pair();
    let mut settings = settings(&model, NoiseRule::Fixed, InputHold::Zero);
    settings.noise.excitation *= levels;
    for parameter in &mut settings.noise.parameters {
        parameter.start *= levels;
    }
    settings.prior_std *= prior;
    ExtendedKalmanFilter::new(model, settings).unwrap()
}

#[test]
fn scaling_all_noises_scales_the_covariances_and_not_the_estimates() {
    // ch3 §5 A4 with ρ = 7, with fading
    let rho = 7.0_f64;
    let (mut plain, mut scaled) = (scaled(1.0, 1.0), scaled(rho, rho.sqrt()));
    for k in 0..800 {
        step_without_excitation(&mut plain, k);
        step_without_excitation(&mut scaled, k);
    }
    let difference = scaled.covariance() - plain.covariance() * rho;
    let std = plain.covariance().diagonal().map(f64::sqrt);
    let scale = &std * std.transpose() * rho;
    assert!(difference.component_div(&scale).amax() < 1e-9);
    assert!((plain.mean() - scaled.mean()).amax() < 1e-9 * plain.mean().amax());
}

#[test]
fn levels_of_the_same_ratio_give_the_same_state() {
    // Yuen et al. (2013), acceptance 10: once the prior is forgotten, the gain depends only on the
    // ratio of the levels.
    let (mut large, mut small) = (scaled(1.0, 1.0), scaled(0.01, 1.0));
    let mut differences = [0.0; 2];
    for k in 0..4000 {
        step_without_excitation(&mut large, k);
        step_without_excitation(&mut small, k);
        let difference = (large.mean() - small.mean()).amax();
        let late = usize::from(k >= 3000);
        differences[late] = f64::max(differences[late], difference);
    }
    assert!(
        differences[0] > 1e-3,
        "the prior was never felt: {differences:?}"
    );
    assert!(differences[1] < 1e-12, "{differences:?}");
}

#[test]
fn modal_and_physical_coordinates_give_the_same_estimates() {
    let (physical, modal) = pair();
    let modal_from_physical = modal.modal_from_physical();
    let physical_from_modal = modal.physical_from_modal();
    // Φᵀ M Φ = I: variances in inverse proportion to the masses are equal ones of the modes
    let mut of_physical = settings(&physical, NoiseRule::HalfOrDouble, InputHold::Zero);
    let masses = matrices().0[0].diagonal();
    of_physical.prior_std = DVector::from_fn(6, |j, _| 0.3 / masses[j % 3].sqrt());
    let mut of_modal = of_physical.clone();
    of_modal.prior_mean = modal_from_physical * &of_physical.prior_mean;
    of_modal.prior_std.fill(0.3);
    let (physical, modal) = (run(physical, of_physical), run(modal, of_modal));
    let difference = physical.mean() - &physical_from_modal * modal.mean();
    assert!(
        difference.amax() < 1e-10 * physical.mean().amax(),
        "{difference}"
    );
    let ratio = physical.noise().mean.component_div(&modal.noise().mean);
    assert!(
        ratio.iter().all(|ratio| (ratio - 1.0).abs() < 1e-8),
        "{ratio}"
    );
}

#[test]
fn gap_only_increases_the_variance_of_the_levels() {
    let (_, model) = pair();
    let mut settings = settings(&model, NoiseRule::HalfOrDouble, InputHold::Zero);
    settings.noise_settings.fading = 2f64.powf(2.0 / 1000.0);
    let mut filter = ExtendedKalmanFilter::new(model, settings).unwrap();
    (0..300).for_each(|k| step_without_excitation(&mut filter, k));
    let before = filter.noise().clone();
    assert_eq!(before.phase, NoisePhase::Working);
    for _ in 0..500 {
        let frame = Frame {
            observations: &[f64::NAN; 2],
            excitation: &[0.0; 2],
        };
        filter.step(frame).unwrap();
    }
    // λ^(N_s/2) = 2
    let after = filter.noise();
    assert_eq!(after.mean, before.mean);
    let difference = &after.covariance - &before.covariance * 2.0;
    assert!(difference.amax() < 1e-10 * before.covariance.amax());
}

#[test]
fn unobserved_displacement_grows_without_effect_on_the_velocity() {
    // Huang & Yuen (2023), chapter 2, §5 check 12: with a half-life of 2000 steps, fading alone
    // multiplies the deviation by 2^75 = 3.8e22 in 150 000 steps. The system is a mass on a
    // dashpot. Its displacement appears in no equation.
    let filter = |kept: usize| {
        let system = DMatrix::from_row_slice(2, 2, &[0.0, 1.0, 0.0, -0.5]);
        let input = DMatrix::from_row_slice(2, 1, &[0.0, 1.0]);
        let first = 1 - kept;
        let model = StateSpace::new(
            system.view((first, first), (1 + kept, 1 + kept)).into(),
            input.rows(first, 1 + kept).into(),
            DMatrix::from_fn(1, 1 + kept, |_, j| if j == kept { 1.0 } else { 0.0 }),
            DirectTerm::None,
        );
        let noise = NoiseModel::known(DMatrix::identity(1, 1), DMatrix::identity(1, 1) * 1e-2);
        let n = 1 + kept;
        let mut settings =
            FilterSettings::new(0.002, DVector::zeros(n), DVector::repeat(n, 1e-2), noise);
        settings.fading = FadingFactor::from_half_life(2000.0).unwrap();
        ExtendedKalmanFilter::new(model.unwrap(), settings).unwrap()
    };
    let (mut with, mut without) = (filter(1), filter(0));
    let mut start = 0.0;
    for k in 0..150_000 {
        let frame = Frame {
            observations: &[(0.01 * f64::from(k)).sin()],
            excitation: &[0.0],
        };
        with.step(frame).unwrap();
        without.step(frame).unwrap();
        if k == 0 {
            start = with.covariance()[(0, 0)].sqrt();
        }
    }
    let growth = with.covariance()[(0, 0)].sqrt() / start;
    assert!((1e22..1e24).contains(&growth), "grew by {growth:e}");
    let (a, b) = (with.mean()[1], without.mean()[0]);
    let std = without.covariance()[(0, 0)].sqrt();
    assert!(
        (a - b).abs() < 0.05 * std,
        "velocity {a} with displacement, {b} ± {std} without"
    );
    assert!((with.covariance()[(1, 1)].sqrt() / std - 1.0).abs() < 1e-3);
}

#[test]
fn checkpoint_in_either_stage_gives_the_same_bits() {
    let filter = || {
        let (_, model) = pair();
        let settings = settings(&model, NoiseRule::HalfOrDouble, InputHold::Zero);
        ExtendedKalmanFilter::new(model, settings).unwrap()
    };
    let (mut unbroken, mut broken) = (filter(), filter());
    for (k, phase) in [(20, NoisePhase::Training), (200, NoisePhase::Working)] {
        (k - 20..k).for_each(|k| step_without_excitation(&mut unbroken, k));
        (k - 20..k).for_each(|k| step_without_excitation(&mut broken, k));
        assert_eq!(unbroken.noise().phase, phase);
        let bytes = postcard::to_stdvec(broken.state()).unwrap();
        broken = filter();
        broken
            .restore(postcard::from_bytes(&bytes).unwrap())
            .unwrap();
        (k..k + 160).for_each(|k| step_without_excitation(&mut unbroken, k));
        (k..k + 160).for_each(|k| step_without_excitation(&mut broken, k));
    }
    assert_eq!(unbroken.state(), broken.state());
}
