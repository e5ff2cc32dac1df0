use super::*;
use nalgebra::DVector;

/// ẏ = A y + g with a dense, singular, non-normal A: an oscillator with a column for a parameter.
struct Dense {
    a: DMatrix<f64>,
}

fn oscillator(frequency: f64) -> Dense {
    let a = DMatrix::from_row_slice(
        3,
        3,
        &[
            0.0,
            1.0,
            0.0,
            -frequency * frequency,
            -0.02 * frequency,
            7.0,
            0.0,
            0.0,
            0.0,
        ],
    );
    Dense { a }
}

impl ProcessModel for Dense {
    fn state_len(&self) -> usize {
        3
    }
    fn parameter_len(&self) -> usize {
        1
    }
    fn excitation_len(&self) -> usize {
        1
    }
    fn linearise_process(&mut self, _: &[f64], _: &[f64]) {}
    fn derivative(&self, out: &mut [f64]) {
        out.copy_from_slice(&[0.3, -2.0, 0.0]);
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        out.copy_from(&(&self.a * columns));
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.copy_from_slice(&[0.0, 1.0, 0.0]);
    }
    fn rate_bound(&self) -> f64 {
        1.01 * self.a[(1, 0)].abs().sqrt()
    }
}

/// Returns A, Γg, B and Γ₂b from one exponential of a larger matrix.
fn by_augmented_exponential(
    model: &Dense,
    step_s: f64,
    slope: &[f64; 3],
) -> (DMatrix<f64>, DMatrix<f64>) {
    let mut g = [0.0; 3];
    model.derivative(&mut g);
    // y' = A y + g u1 + b u2 + s t: the states y, one constant for g, one for b, and a ramp (t, 1).
    let mut big = DMatrix::zeros(7, 7);
    big.view_mut((0, 0), (3, 3)).copy_from(&model.a);
    for i in 0..3 {
        big[(i, 3)] = g[i];
        big[(i, 5)] = slope[i];
    }
    big[(1, 4)] = 1.0;
    big[(5, 6)] = 1.0;
    let exponential = (big * step_s).exp();
    let transition = exponential.view((0, 0), (3, 3)).into_owned();
    let mut inputs = DMatrix::zeros(3, 2);
    inputs.set_column(
        0,
        &(exponential.view((0, 3), (3, 1)).column(0) + exponential.view((0, 6), (3, 1)).column(0)),
    );
    inputs.set_column(1, &exponential.view((0, 4), (3, 1)).column(0));
    (transition, inputs)
}

#[test]
fn series_agrees_with_the_augmented_exponential() {
    // ch2 §5 check 2, from fine steps to steps of five periods (substeps).
    for reach in [0.01, 0.4, 1.4, 6.0, 31.0] {
        let model = oscillator(reach / 0.01);
        let slope = [0.0, 40.0, 0.0];
        let (transition, inputs) = by_augmented_exponential(&model, 0.01, &slope);
        let series = Series::choose(model.rate_bound(), 0.01);
        let mut work = Workspace::new(3, 1);
        let mut found = DMatrix::identity(3, 3);
        transition_mul(&model, 0.01, series, &mut found, &mut work);
        let scale = DMatrix::from_diagonal(&DVector::from_row_slice(&[reach / 0.01, 1.0, 1.0]));
        let error = (&scale * (&found - &transition)).amax() / (&scale * &transition).amax();
        assert!(
            error < 1e-12,
            "reach {reach}: transition off by {error:e} with {series:?}"
        );
        let mut columns = DMatrix::zeros(3, 2);
        model.derivative(&mut columns.as_mut_slice()[..3]);
        columns[(1, 1)] = 1.0;
        integrate_inputs(&model, 0.01, series, &mut columns, Some(&slope), &mut work);
        let error = (&scale * (&columns - &inputs)).amax() / (&scale * &inputs).amax();
        assert!(
            error < 1e-12,
            "reach {reach}: inputs off by {error:e} with {series:?}"
        );
    }
}

#[test]
fn increment_of_the_mean_agrees_with_the_remainder_form() {
    // ch2 §5 check 2: y + Γ g = A_i y + δ_i with δ_i = Γ (g − A_y y).
    let model = oscillator(40.0);
    let y = DVector::from_row_slice(&[0.4, -1.0, 0.7]);
    let mut g = DVector::zeros(3);
    model.derivative(g.as_mut_slice());
    let series = Series::choose(model.rate_bound(), 0.01);
    let mut work = Workspace::new(3, 1);
    let mut direct = DMatrix::zeros(3, 2);
    direct.set_column(0, &g);
    integrate_inputs(&model, 0.01, series, &mut direct, None, &mut work);
    let mut remainder = DMatrix::zeros(3, 2);
    remainder.set_column(0, &(&g - &model.a * &y));
    integrate_inputs(&model, 0.01, series, &mut remainder, None, &mut work);
    let mut transition = DMatrix::identity(3, 3);
    transition_mul(&model, 0.01, series, &mut transition, &mut work);
    let left = &y + direct.column(0);
    let right = transition * &y + remainder.column(0);
    assert!((left - right).amax() < 1e-12);
}

#[test]
fn covariance_is_that_of_two_dense_products() {
    let model = oscillator(60.0);
    let covariance =
        DMatrix::from_row_slice(3, 3, &[2.0, 0.3, 0.1, 0.3, 1.0, -0.2, 0.1, -0.2, 0.5]);
    let series = Series::choose(model.rate_bound(), 0.01);
    let mut work = Workspace::new(3, 1);
    let mut found = DMatrix::zeros(3, 3);
    propagate_covariance(&model, 0.01, series, &covariance, &mut found, &mut work);
    let transition = (&model.a * 0.01).exp();
    let expected = &transition * covariance * transition.transpose();
    assert!((&found - &expected).amax() < 1e-12 * expected.amax());
}

#[test]
fn step_above_the_maximum_is_divided() {
    assert_eq!(Series::choose(10.0, 0.01).substeps, 1);
    assert_eq!(Series::choose(1000.0, 0.01).substeps, 7);
    assert_eq!(Series::choose(f64::NAN, 0.01).substeps, 1);
}
