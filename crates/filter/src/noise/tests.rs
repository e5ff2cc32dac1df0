use super::*;

fn random_problem() -> (NoiseModel, Objective) {
    let entry = |i: usize, j: usize| (2.1 * i as f64 - 1.3 * j as f64 + 0.4).sin();
    let known = DMatrix::from_fn(4, 4, entry);
    let known = &known * known.transpose() * 0.1 + DMatrix::identity(4, 4) * 0.2;
    let h_b = DMatrix::from_fn(4, 2, |i, j| (i as f64 + 3.0 * j as f64).cos());
    let parameter = |name: &str, target, pattern: DMatrix<f64>, start| NoiseParameter {
        name: name.to_owned(),
        target,
        pattern,
        start,
        start_std: start / 3.0,
    };
    let first = DMatrix::from_diagonal(&DVector::from_row_slice(&[1.0, 0.0]));
    let second = DMatrix::from_diagonal(&DVector::from_row_slice(&[0.0, 1.0]));
    let model = NoiseModel {
        excitation: DMatrix::zeros(2, 2),
        sensors: DMatrix::zeros(4, 4),
        parameters: vec![
            parameter("horizontal", NoiseTarget::Excitation, first, 0.7),
            parameter("vertical", NoiseTarget::Excitation, second, 0.4),
            parameter("sensors", NoiseTarget::Sensors, DMatrix::identity(4, 4), 0.05),
        ],
    };
    let mut objective = Objective::new(4, 3);
    let innovation = DVector::from_row_slice(&[0.8, -0.3, 0.5, 1.1]);
    objective.set_frame(&model, &known, ExcitationPath::Input(&h_b), None, 1.0007, &innovation);
    (model, objective)
}

fn shifted(psi: &DVector<f64>, shifts: &[(usize, f64)]) -> DVector<f64> {
    let mut moved = psi.clone();
    for (l, relative) in shifts {
        moved[*l] += relative * psi[*l];
    }
    moved
}

#[test]
fn exact_derivatives_agree_with_the_printed_differences() {
    // ch3 §5 A3: below 1e-5 relative with Δψ = 1e-3 ψ, equations (3.34), (3.37), (3.38)
    let (_, mut objective) = random_problem();
    let psi = DVector::from_row_slice(&[0.7, 0.4, 0.05]);
    assert!(objective.differentiate(&psi));
    let gradient = objective.gradient.clone();
    let hessian = objective.observed.clone();
    let d = 1e-3;
    let (mut worst_gradient, mut worst_hessian) = (0.0_f64, 0.0_f64);
    for l in 0..3 {
        let mut value = |shifts: &[(usize, f64)]| objective.value(&shifted(&psi, shifts));
        let step = d * psi[l];
        let slope = (value(&[(l, d)]) - value(&[(l, -d)])) / (2.0 * step);
        worst_gradient = worst_gradient.max((slope - gradient[l]).abs() * psi[l]);
        for m in 0..3 {
            let other = d * psi[m];
            let curvature = if l == m {
                (value(&[(l, d)]) - 2.0 * value(&[]) + value(&[(l, -d)])) / (step * step)
            } else {
                (value(&[(l, d), (m, d)]) - value(&[(l, -d), (m, d)]) - value(&[(l, d), (m, -d)])
                    + value(&[(l, -d), (m, -d)]))
                    / (4.0 * step * other)
            };
            worst_hessian = worst_hessian.max((curvature - hessian[(l, m)]).abs() * psi[l] * psi[m]);
        }
    }
    let scaled_gradient = gradient.component_mul(&psi).amax();
    let scaled_hessian = (0..3)
        .flat_map(|l| (0..3).map(move |m| (l, m)))
        .map(|(l, m)| (hessian[(l, m)] * psi[l] * psi[m]).abs())
        .fold(0.0, f64::max);
    assert!(worst_gradient / scaled_gradient < 1e-5, "gradient off by {:e}", worst_gradient / scaled_gradient);
    assert!(worst_hessian / scaled_hessian < 1e-5, "Hessian off by {:e}", worst_hessian / scaled_hessian);
}

#[test]
fn missing_channel_adds_nothing() {
    let (model, mut objective) = random_problem();
    let psi = DVector::from_row_slice(&[0.7, 0.4, 0.05]);
    let known = DMatrix::identity(4, 4);
    let h_b = DMatrix::from_element(4, 2, 0.5);
    let innovation = DVector::from_row_slice(&[0.8, f64::NAN, 0.5, f64::NAN]);
    objective.set_frame(&model, &known, ExcitationPath::Input(&h_b), None, 1.0, &innovation);
    assert_eq!(objective.used_channels(), 2);
    let found = objective.value(&psi);
    // the same frame with two channels only
    let sigma_z = DMatrix::from_fn(2, 2, |i, j| {
        let diagonal = if i == j { 1.0 + 0.05 } else { 0.0 };
        diagonal + 0.25 * (0.7 + 0.4)
    });
    let e = DVector::from_row_slice(&[0.8, 0.5]);
    let factor = nalgebra::Cholesky::new(sigma_z).unwrap();
    let expected: f64 = 0.5 * (factor.ln_determinant() + e.dot(&factor.solve(&e)));
    assert!((found - expected).abs() < 1e-12);
}

/// ch3 §5 A5: white residuals with Σ_z = ψ I₁₂, truth 2e-4, start 1.
fn white_residuals(rule: NoiseRule, seed: u64) -> (f64, f64, u64) {
    use rand_distr::{Distribution, StandardNormal};
    let model = NoiseModel {
        excitation: DMatrix::zeros(0, 0),
        sensors: DMatrix::zeros(12, 12),
        parameters: vec![NoiseParameter {
            name: "sensors".to_owned(),
            target: NoiseTarget::Sensors,
            pattern: DMatrix::identity(12, 12),
            start: 1.0,
            start_std: 1.0 / 3.0,
        }],
    };
    let settings = NoiseSettings { rule, seed, training_steps: 1000, ..NoiseSettings::default() };
    let mut state = NoiseState::start(&model, &settings);
    let mut objective = Objective::new(12, 1);
    let mut rng = ChaCha8Rng::seed_from_u64(1000 + seed);
    let truth = 2e-4_f64;
    let zero = DMatrix::zeros(12, 12);
    let (mut sum, mut count, mut ended) = (0.0, 0, 0);
    for k in 0..30_000u64 {
        let residual = DVector::from_fn(12, |_, _| {
            let draw: f64 = StandardNormal.sample(&mut rng);
            truth.sqrt() * draw
        });
        objective.set_frame(&model, &zero, ExcitationPath::Felt, None, 1.0, &residual);
        if state.update(&model, &settings, &mut objective).training_ended {
            ended = k;
        }
        if k >= 10_000 {
            sum += state.mean[0] / truth;
            count += 1;
        }
    }
    (sum / f64::from(count), state.largest_relative_std(), ended)
}

#[test]
fn white_residuals_give_their_level_and_its_deviation() {
    for rule in [NoiseRule::Published, NoiseRule::Fisher] {
        for seed in 1..=3 {
            let (mean, relative_std, ended) = white_residuals(rule, seed);
            let expected = (2.0 * (1.0 - 2f64.powf(-1.0 / 1000.0)) / 12.0_f64).sqrt();
            assert!((mean - 1.0).abs() < 0.02, "{rule:?} seed {seed}: mean {mean}, training ended at {ended}");
            // the observed Hessian scatters by a few per cent around the expected information
            assert!((relative_std / expected - 1.0).abs() < 0.05, "{rule:?} seed {seed}: deviation {relative_std}");
        }
    }
}

#[test]
fn start_of_zero_is_refused() {
    let (mut model, _) = random_problem();
    model.parameters[1].start = 0.0;
    let error = model.check(2, 4).unwrap_err();
    assert!(matches!(error, FilterError::Setting { what: "start of a noise parameter", .. }), "{error}");
}

#[test]
fn lasting_misfit_sends_the_parameters_back_to_training() {
    let (model, mut objective) = random_problem();
    let settings = NoiseSettings { rule: NoiseRule::Published, training_steps: 100, ..NoiseSettings::default() };
    let mut state = NoiseState::start(&model, &settings);
    state.phase = NoisePhase::Working;
    // a gain that has frozen: information far above what any frame can still move
    state.covariance.fill_with_identity();
    state.covariance *= 1e-14;
    let innovation = DVector::repeat(4, 100.0);
    let known = DMatrix::identity(4, 4);
    let restarted = (0..2000).any(|_| {
        objective.set_frame(&model, &known, ExcitationPath::Felt, None, 1.0, &innovation);
        state.update(&model, &settings, &mut objective).training_restarted
    });
    assert!(restarted);
    assert_eq!(state.phase, NoisePhase::Training);
}
