//! Comparison of the blocks with the series that applies the Jacobian to columns.

use super::band::{Band, Evaluate, Padded};
use super::polynomials::economise_mut;
use super::*;
use crate::discretise::{
    self, Series, integrate_inputs, propagate_covariance, transition_mul_narrow,
};
use crate::model::ProcessModel;
use crate::product::{Extent, Left, Right, Sum, all_instructions};
use nalgebra::DVector;
use pulp::Arch;

const STEP_S: f64 = 0.01;
const INPUTS: usize = 2;

/// A moving structure defined by its matrices; the parameters change the accelerations by `W`.
struct Structure {
    stiffness: DMatrix<f64>,
    half_bandwidth: usize,
    alpha_per_s: f64,
    beta_s: f64,
    by_theta: DMatrix<f64>,
    reach: Vec<Range<usize>>,
}

fn wave(rows: usize, columns: usize) -> DMatrix<f64> {
    DMatrix::from_fn(rows, columns, |i, j| ((5 * i + 3 * j + 1) as f64).sin())
}

/// Returns a chain of unequal masses and springs, with `reach` radians of its fastest mode per
/// step.
fn chain(masses: usize, parameters: usize, reach: f64) -> Structure {
    let frequency = 0.5 * reach / STEP_S;
    let spring = |j: usize| frequency * frequency * (0.7 + 0.3 * (j as f64).cos());
    let stiffness = DMatrix::from_fn(masses, masses, |i, j| {
        let above = if i + 1 < masses { spring(i + 1) } else { 0.0 };
        let entry = match i.abs_diff(j) {
            0 => spring(i) + above,
            1 => -spring(i.max(j)),
            _ => 0.0,
        };
        entry / (1.0 + 0.2 * (i as f64).sin())
    });
    Structure {
        stiffness,
        half_bandwidth: 1,
        alpha_per_s: 0.3,
        beta_s: 1e-3 / frequency,
        by_theta: wave(masses, parameters),
        reach: vec![0..masses; parameters],
    }
}

/// Returns a structure with a fully coupled mass matrix: `G` is full and not symmetric.
fn coupled(masses: usize, parameters: usize, reach: f64) -> Structure {
    let mut structure = chain(masses, parameters, reach);
    let factor = DMatrix::identity(masses, masses) + wave(masses, masses) * 0.1;
    let mass = &factor * factor.transpose();
    structure.stiffness = mass
        .cholesky()
        .unwrap()
        .solve(&(0.5 * (&structure.stiffness + structure.stiffness.transpose())));
    let fastest = structure
        .stiffness
        .complex_eigenvalues()
        .iter()
        .map(|s| s.re)
        .fold(0.0, f64::max);
    structure.stiffness *= (reach / STEP_S).powi(2) / fastest;
    structure.half_bandwidth = masses - 1;
    structure
}

impl Structure {
    fn stiffness_bound(&self) -> f64 {
        let eigenvalues = self.stiffness.complex_eigenvalues();
        assert!(
            eigenvalues
                .iter()
                .all(|s| s.re >= 0.0 && s.im.abs() < 1e-9 * s.re)
        );
        1.001 * eigenvalues.iter().map(|s| s.re).fold(0.0, f64::max)
    }

    fn free(&self) -> usize {
        self.stiffness.nrows()
    }
}

impl ProcessModel for Structure {
    fn state_len(&self) -> usize {
        2 * self.free() + self.parameter_len()
    }
    fn parameter_len(&self) -> usize {
        self.by_theta.ncols()
    }
    fn excitation_len(&self) -> usize {
        INPUTS
    }
    fn linearise_process(&mut self, _: &[f64], _: &[f64]) {}
    fn derivative(&self, out: &mut [f64]) {
        out.fill(0.0);
        for (j, entry) in out[..2 * self.free()].iter_mut().enumerate() {
            *entry = (1.0 + j as f64).cos();
        }
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let free = self.free();
        let (x, v) = (columns.rows(0, free), columns.rows(free, free));
        out.fill(0.0);
        out.rows_mut(0, free).copy_from(&v);
        out.rows_mut(free, free).copy_from(
            &(&self.by_theta * columns.rows(2 * free, self.parameter_len())
                - &self.stiffness * (x + v * self.beta_s)
                - v * self.alpha_per_s),
        );
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        out.fill(0.0);
        out.rows_mut(self.free(), self.free())
            .copy_from(&wave(self.free(), INPUTS));
    }
    fn rate_bound(&self) -> f64 {
        let k = self.stiffness_bound();
        let c = self.alpha_per_s + self.beta_s * k;
        k.sqrt().max((c + (c * c - 4.0 * k).max(0.0).sqrt()) / 2.0)
    }
    fn proportional_form(&self) -> Option<ProportionalForm<'_>> {
        Some(ProportionalForm {
            stiffness: &self.stiffness,
            stiffness_bound: self.stiffness_bound(),
            half_bandwidth: self.half_bandwidth,
            alpha_per_s: self.alpha_per_s,
            beta_s: self.beta_s,
            acceleration_by_theta: &self.by_theta,
            reach: &self.reach,
        })
    }
}

/// Returns a realistic covariance of displacements, velocities and parameters, scaled to the
/// fastest mode.
fn covariance(structure: &Structure) -> DMatrix<f64> {
    let (n, free) = (structure.state_len(), structure.free());
    let rate = structure.stiffness_bound().sqrt();
    let scale = |j: usize| if j < free { 1.0 / rate } else { 1.0 };
    let factor = DMatrix::from_fn(n, n, |i, j| scale(i) * ((3 * i + 7 * j) as f64).sin());
    let mut covariance = &factor * factor.transpose();
    covariance.fill_lower_triangle_with_upper_triangle();
    covariance
}

/// Returns `[g, B_y]` and the ramp.
fn inputs(structure: &Structure) -> (DMatrix<f64>, Vec<f64>) {
    let (n, free) = (structure.state_len(), structure.free());
    let mut inputs = DMatrix::zeros(n, 1 + INPUTS);
    structure.derivative(&mut inputs.as_mut_slice()[..n]);
    let mut excitation = DMatrix::zeros(n, INPUTS);
    structure.excitation_matrix(&mut excitation);
    inputs.columns_mut(1, INPUTS).copy_from(&excitation);
    let ramp = (0..n)
        .map(|j| {
            if (free..2 * free).contains(&j) {
                30.0 * (j as f64).sin()
            } else {
                0.0
            }
        })
        .collect();
    (inputs, ramp)
}

/// Returns the largest difference of two covariances, relative to the standard deviations of row
/// and column.
fn worst_covariance(found: &DMatrix<f64>, expected: &DMatrix<f64>) -> f64 {
    let std = expected.diagonal().map(f64::sqrt);
    (found - expected)
        .component_div(&(&std * std.transpose()))
        .amax()
}

/// Returns the largest difference of two matrices, relative to the largest entry of the same kind.
///
/// The kinds are displacements, velocities and parameters.
fn worst_column(found: &DMatrix<f64>, expected: &DMatrix<f64>, free: usize) -> f64 {
    let kinds = [0..free, free..2 * free, 2 * free..found.nrows()]
        .into_iter()
        .filter(|rows| !rows.is_empty());
    kinds.fold(0.0, |worst: f64, rows| {
        let size = expected
            .rows(rows.start, rows.len())
            .amax()
            .max(f64::MIN_POSITIVE);
        worst.max((found - expected).rows(rows.start, rows.len()).amax() / size)
    })
}

#[track_caller]
fn assert_agreement(what: &str, structure: &Structure, tolerance: f64) {
    for arch in all_instructions() {
        assert_agreement_with(arch, what, structure, tolerance);
    }
}

#[track_caller]
fn assert_agreement_with(arch: Arch, what: &str, structure: &Structure, tolerance: f64) {
    let form = structure.proportional_form().unwrap();
    let series = Series::choose(structure.rate_bound(), STEP_S);
    let (n, sigma) = (structure.state_len(), covariance(structure));
    let (columns, slope) = inputs(structure);
    let mut work = discretise::Workspace::new(n, INPUTS);
    let mut transition = Transition::with(&form, Multiplier::with(arch));
    for ramp in [Some(&slope[..]), None] {
        let (mut expected, mut found) = (columns.clone(), columns.clone());
        integrate_inputs(structure, STEP_S, series, &mut expected, ramp, &mut work);
        transition.discretise(&form, STEP_S, structure.rate_bound(), &mut found, ramp);
        let error = worst_column(&found, &expected, structure.free());
        assert!(
            error < tolerance,
            "{what}, {series:?}, ramp {}: inputs off by {error:e}",
            ramp.is_some()
        );
    }
    let (mut expected, mut found) = (DMatrix::zeros(n, n), DMatrix::zeros(n, n));
    propagate_covariance(structure, STEP_S, series, &sigma, &mut expected, &mut work);
    transition.propagate_covariance_to(&sigma, 1.0, &mut found);
    let error = worst_covariance(&found, &expected);
    assert!(
        error < tolerance,
        "{what}, {series:?}: covariance off by {error:e}"
    );
    assert_eq!(
        found,
        found.transpose(),
        "{what}: the triangles have other bits"
    );
    let columns = sigma.columns(n - INPUTS, INPUTS).into_owned();
    let (mut expected, mut found) = (columns.clone(), columns);
    transition_mul_narrow(structure, STEP_S, series, &mut expected, &mut work);
    transition.mul_mut(&mut found);
    let error = worst_column(&found, &expected, structure.free());
    assert!(
        error < tolerance,
        "{what}, {series:?}: columns off by {error:e}"
    );
}

#[test]
fn blocks_agree_with_the_operator_within_one_series() {
    for reach in [1e-3, 0.1, 0.4, 1.0, 1.4] {
        for parameters in [0, 1, 5] {
            assert_agreement("chain", &chain(40, parameters, reach), 1e-12);
            assert_agreement("coupled", &coupled(19, parameters, reach), 1e-12);
            assert_agreement("oscillator", &chain(1, parameters, reach), 1e-12);
            assert_agreement("five storeys", &chain(5, parameters, reach), 1e-12);
        }
    }
}

#[test]
fn blocks_agree_with_the_operator_for_any_damping() {
    for (alpha_per_s, damping_ratio) in [(0.0, 0.0), (5.0, 0.05), (0.0, 0.7), (3.0, 4.0)] {
        for mut structure in [chain(30, 3, 0.3), coupled(12, 3, 0.3)] {
            structure.alpha_per_s = alpha_per_s;
            structure.beta_s = 2.0 * damping_ratio / structure.stiffness_bound().sqrt();
            assert_agreement(
                &format!("α {alpha_per_s}, ζ {damping_ratio}"),
                &structure,
                1e-12,
            );
        }
    }
}

/// The rounding error of the operator grows with its number of substeps.
#[test]
fn doubled_steps_agree_with_substeps_of_the_operator() {
    for reach in [2.0, 6.0, 31.0, 200.0] {
        assert_agreement("chain", &chain(20, 2, reach), 1e-11);
        assert_agreement("coupled", &coupled(12, 2, reach), 1e-11);
    }
}

/// Models a tower with modes in the kilohertz range, damped far above critical.
#[test]
fn doubled_steps_of_overdamped_modes_agree_with_substeps_of_the_operator() {
    let mut structure = coupled(12, 2, 20.0);
    structure.beta_s = 6.0 / structure.stiffness_bound().sqrt();
    assert_agreement("overdamped", &structure, 1e-11);
}

/// Checks narrow and full bands in the same storage, also bands that are wider than the matrix.
#[test]
fn polynomials_of_a_band_are_those_of_its_full_matrix() {
    let mut polynomials = Polynomials::new([-0.1, 0.02], 1.2, 1.1);
    polynomials.velocity.degree = 3;
    polynomials.velocity.coefficients[4..].fill(0.0);
    let wide = [(23, [2, 5, 1]), (6, [4, 1, 3])].into_iter();
    let sizes = wide
        .chain((2..41).map(|n| (n, [1, 1, 1])))
        .flat_map(|size| all_instructions().into_iter().map(move |arch| (size, arch)));
    for ((n, widths), arch) in sizes {
        let widest = *widths.iter().max().unwrap();
        let room = || Band::new(n, 44 * widest, widest);
        let (mut powers, mut sums) = ([room(), room()], [room(), room()]);
        for width in widths {
            let matrix = DMatrix::from_fn(n, n, |i, j| {
                if i.abs_diff(j) <= width {
                    wave(n, n)[(i, j)] / 5.0
                } else {
                    0.0
                }
            });
            let mut z = Band::new(n, widest, widest);
            z.set(&matrix, width, 1.0);
            let [impulse, velocity] = &mut sums;
            arch.dispatch(Evaluate {
                z: &z,
                powers: &mut powers,
                polynomials: [&polynomials.impulse, &polynomials.velocity],
                sums: [impulse, velocity],
            });
            for (polynomial, band) in [&polynomials.impulse, &polynomials.velocity]
                .into_iter()
                .zip(&sums)
            {
                let mut expected = DMatrix::zeros(n, n);
                for coefficient in polynomial.coefficients.iter().rev() {
                    expected = &matrix * expected + DMatrix::identity(n, n) * *coefficient;
                }
                let x = wave(n, 1);
                let (mut padded, mut product) = (Padded::new(n, n), Padded::new(n, n));
                padded.copy_from(x.as_slice());
                band.mul_to(arch, &padded, &mut product);
                let error = (DVector::from_column_slice(product.as_slice()) - &expected * x).amax();
                assert!(error < 1e-14, "{n}, band {width}: product off by {error:e}");
                let mut right = Right::new(n, n, 1);
                right.pack_with(
                    n,
                    |columns, runs| runs.push(near(&columns, band.half_bandwidth(), n)),
                    |columns, run, values| band.transpose_to(2.0, columns, run, values),
                );
                let mut transposed = DMatrix::zeros(n, n);
                let unit = DMatrix::identity(n, n);
                Multiplier::with(arch).multiply_to(
                    Left::new(&unit),
                    &right,
                    Extent::Full,
                    Sum::PLAIN,
                    &mut transposed,
                );
                let error = (transposed - 2.0 * expected.transpose()).amax();
                assert!(
                    error < 1e-14,
                    "{n}, band {width}: transpose off by {error:e}"
                );
            }
        }
    }
}

#[test]
fn a_narrow_band_is_stepped_through_the_accelerations() {
    for (structure, through_accelerations) in
        [(chain(40, 3, 0.4), true), (coupled(12, 3, 0.4), false)]
    {
        let form = structure.proportional_form().unwrap();
        let mut transition = Transition::new(&form);
        transition.discretise(
            &form,
            STEP_S,
            structure.rate_bound(),
            &mut inputs(&structure).0,
            None,
        );
        assert_eq!(transition.through_accelerations, through_accelerations);
    }
}

#[test]
fn limited_reach_gives_the_same_covariance() {
    // Parameters with two rows each, with none and with all, not in the order of the rows.
    let reach = vec![30..32, 0..2, 12..14, 13..15, 0..0, 0..40];
    let mut narrow = chain(40, reach.len(), 0.4);
    for (parameter, reach) in reach.iter().enumerate() {
        for row in (0..40).filter(|row| !reach.contains(row)) {
            narrow.by_theta[(row, parameter)] = 0.0;
        }
    }
    let wide = Structure {
        reach: narrow.reach.clone(),
        by_theta: narrow.by_theta.clone(),
        ..chain(40, reach.len(), 0.4)
    };
    narrow.reach = reach;
    let propagated = [&narrow, &wide].map(|structure| {
        let form = structure.proportional_form().unwrap();
        let mut transition = Transition::new(&form);
        transition.discretise(
            &form,
            STEP_S,
            structure.rate_bound(),
            &mut inputs(structure).0,
            None,
        );
        let mut out = DMatrix::zeros(structure.state_len(), structure.state_len());
        transition.propagate_covariance_to(&covariance(structure), 1.0, &mut out);
        out
    });
    assert!(worst_covariance(&propagated[0], &propagated[1]) < 1e-15);
}

/// A shorter step has narrower polynomials. No entries of the wider ones may remain.
#[test]
fn rediscretised_transition_equals_a_new_one() {
    let (fast, slow) = (chain(40, 3, 1.4), chain(40, 3, 1e-3));
    let mut used = Transition::new(&fast.proportional_form().unwrap());
    let propagated = |transition: &mut Transition, structure: &Structure| {
        let form = structure.proportional_form().unwrap();
        transition.discretise(
            &form,
            STEP_S,
            structure.rate_bound(),
            &mut inputs(structure).0,
            None,
        );
        let mut out = DMatrix::zeros(structure.state_len(), structure.state_len());
        transition.propagate_covariance_to(&covariance(structure), 1.0, &mut out);
        out
    };
    propagated(&mut used, &fast);
    let mut new = Transition::new(&slow.proportional_form().unwrap());
    assert_eq!(propagated(&mut used, &slow), propagated(&mut new, &slow));
}

/// `exp` on an interval: to double precision, its Taylor series needs degree 17, a Chebyshev
/// expansion degree 12.
#[test]
fn an_economised_polynomial_has_the_same_values_and_a_lower_degree() {
    let (range, order) = (1.3, 25);
    let mut coefficients = [0.0; 26];
    let mut factorial = 1.0;
    for (j, coefficient) in coefficients.iter_mut().enumerate() {
        factorial *= j.max(1) as f64;
        *coefficient = 1.0 / factorial;
    }
    let degree = economise_mut(&mut coefficients, order, range);
    assert!(degree <= 12, "{degree}");
    assert!(
        coefficients[degree + 1..]
            .iter()
            .all(|coefficient| *coefficient == 0.0)
    );
    for place in 0..=50 {
        let z = -range * f64::from(place) / 50.0;
        let found = coefficients
            .iter()
            .rev()
            .fold(0.0, |sum, coefficient| sum * z + coefficient);
        assert!(
            (found - z.exp()).abs() < 1e-15,
            "{z}: {found} instead of {}",
            z.exp()
        );
    }
}
