use super::*;
use nalgebra::Cholesky;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

fn model() -> LinearModel {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut random = |rows, columns| {
        DMatrix::from_fn(rows, columns, |_, _| {
            let draw: f64 = StandardNormal.sample(&mut rng);
            draw
        })
    };
    LinearModel {
        transition: random(6, 6) * 0.3,
        input: random(6, 6),
        observation: random(3, 6),
        excitation_covariance: DMatrix::identity(6, 6) * 0.3,
        sensor_covariance: DMatrix::from_diagonal(&DVector::from_row_slice(&[0.1, 0.02, 0.3])),
    }
}

#[test]
fn gain_form_agrees_with_the_information_form() {
    // ch2 §5 check 1, equations (2.31) and (2.32)
    let linear = model();
    let mut filter = KalmanFilter::new(
        linear.clone(),
        DVector::repeat(6, 0.2),
        DMatrix::identity(6, 6),
    )
    .unwrap();
    for k in 0..20 {
        filter.predict(&[0.0; 6]);
        let (mean, covariance) = (filter.mean().clone(), filter.covariance().clone());
        let datum = DVector::from_fn(3, |i, _| ((k + i) as f64).cos());
        filter.update(datum.as_slice()).unwrap();
        let prior_information = Cholesky::new(covariance).unwrap().inverse();
        let noise_information = Cholesky::new(linear.sensor_covariance.clone())
            .unwrap()
            .inverse();
        let h_r = linear.observation.transpose() * noise_information;
        let posterior = Cholesky::new(&prior_information + &h_r * &linear.observation).unwrap();
        let expected = posterior.solve(&(prior_information * mean + h_r * datum));
        assert!((filter.mean() - expected).amax() < 1e-12, "mean at {k}");
        assert!(
            (filter.covariance() - posterior.inverse()).amax() < 1e-12,
            "covariance at {k}"
        );
    }
}

#[test]
fn steady_covariance_solves_the_riccati_equation() {
    let linear = model();
    let mut filter =
        KalmanFilter::new(linear.clone(), DVector::zeros(6), DMatrix::identity(6, 6)).unwrap();
    for _ in 0..500 {
        filter.predict(&[0.0; 6]);
        filter.update(&[0.0; 3]).unwrap();
    }
    let updated = filter.covariance().clone();
    let predicted = &linear.transition * &updated * linear.transition.transpose()
        + &linear.input * &linear.excitation_covariance * linear.input.transpose();
    let s = &linear.observation * &predicted * linear.observation.transpose()
        + &linear.sensor_covariance;
    let h_p = &linear.observation * &predicted;
    let again = &predicted - h_p.transpose() * Cholesky::new(s).unwrap().solve(&h_p);
    assert!((again - updated).amax() < 1e-12);
}

#[test]
fn augmented_exponential_agrees_with_the_inverse_form() {
    // ch2 §5 check 2, equation (2.9)
    let system = DMatrix::from_row_slice(2, 2, &[0.0, 1.0, -90.0, -0.4]);
    let input = DMatrix::from_row_slice(2, 1, &[0.0, 1.0]);
    let (transition, held) = LinearModel::discretise(&system, &input, 0.01);
    let inverse = system
        .clone()
        .lu()
        .solve(&((&transition - DMatrix::identity(2, 2)) * &input))
        .unwrap();
    assert!((held - inverse).amax() < 1e-12);
    assert!(((system * 0.01).exp() - transition).amax() < 1e-13);
}

#[test]
fn wrong_sizes_are_rejected() {
    let error = KalmanFilter::new(model(), DVector::zeros(5), DMatrix::identity(6, 6)).unwrap_err();
    assert_eq!(
        error,
        FilterError::Dimension {
            what: "mean",
            found: 5,
            expected: 6
        }
    );
}
