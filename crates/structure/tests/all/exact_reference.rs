//! Compares whole runs of the filter with the plainest form of its equations.
//!
//! The reference uses dense matrices, one exponential per step, and explicit gains. Notation:
//! Huang & Yuen (2023), §2.4, with the joint vector `[y, w]` of the state and the unknown
//! excitation of the same frame. Before a frame, `w` is white and independent of `y`. A frame is a
//! datum of both, `[H, D]`. The next state is `A y + B w`, for means and covariances. If `D = 0`,
//! the frame contains no information about `w`.

use crate::structures::{building_with_masses, example, portal, small_truss, smallest_tower};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    ExtendedKalmanFilter, FilterSettings, Frame, InputHold, NoiseTarget, ObservationModel,
    ProcessModel,
};
use spandrel_structure::{Structure, StructureModel};

/// The reference filter.
struct Exact {
    model: StructureModel,
    settings: FilterSettings,
    /// `y` (n), `w` (N_f), and their joint covariance.
    state: DVector<f64>,
    excitation: DVector<f64>,
    covariance: DMatrix<f64>,
    last_known: DVector<f64>,
    steps: u64,
}

impl Exact {
    fn new(structure: &Structure, settings: FilterSettings) -> Self {
        let (n, inputs) = (
            settings.prior_mean.len(),
            structure.excitation_channels().len(),
        );
        let mut covariance = DMatrix::zeros(n + inputs, n + inputs);
        covariance
            .view_mut((0, 0), (n, n))
            .copy_from(&DMatrix::from_diagonal(
                &settings.prior_std.map(|std| std * std),
            ));
        Self {
            model: structure.model(),
            state: settings.prior_mean.clone(),
            excitation: DVector::zeros(inputs),
            covariance,
            last_known: DVector::zeros(inputs),
            steps: 0,
            settings,
        }
    }

    fn step(&mut self, samples: &[f64], known: &[f64]) {
        if self.steps > 0 {
            self.predict(known);
        }
        self.last_known.copy_from_slice(known);
        let (n, inputs) = (self.state.len(), self.excitation.len());
        self.excitation.fill(0.0);
        self.covariance.view_mut((0, n), (n, inputs)).fill(0.0);
        self.covariance.view_mut((n, 0), (inputs, n)).fill(0.0);
        self.covariance
            .view_mut((n, n), (inputs, inputs))
            .copy_from(&self.settings.noise.excitation);
        self.update(samples, known);
        self.keep_within_bounds();
        self.steps += 1;
    }

    fn keep_within_bounds(&mut self) {
        for j in 0..self.state.len() {
            self.state[j] = self.state[j].clamp(self.settings.lower[j], self.settings.upper[j]);
            let (variance, bound) = (self.covariance[(j, j)], self.settings.variance_bound[j]);
            if variance > bound {
                // The covariance with the excitation remains that of the update, without the bound.
                let n = self.state.len();
                let shrink = (bound / variance).sqrt();
                self.covariance.view_mut((0, j), (n, 1)).scale_mut(shrink);
                self.covariance.view_mut((j, 0), (1, n)).scale_mut(shrink);
            }
        }
    }

    fn update(&mut self, samples: &[f64], known: &[f64]) {
        let (n, inputs) = (self.state.len(), self.excitation.len());
        self.model
            .linearise_observation(self.state.as_slice(), known);
        let mut h = DMatrix::zeros(samples.len(), n);
        self.model
            .observation_jacobian_mul(&DMatrix::identity(n, n), &mut h);
        let mut both = DMatrix::zeros(samples.len(), n + inputs);
        both.columns_mut(0, n).copy_from(&h);
        if let Some(direct) = self.model.feedthrough() {
            both.columns_mut(n, inputs).copy_from(direct);
        }
        let mut predicted = DVector::zeros(samples.len());
        self.model.observe(predicted.as_mut_slice());
        let innovation = DVector::from_column_slice(samples) - predicted;
        let elapsed_s = self.steps as f64 * self.settings.step_s;
        let aid = self.settings.annealing.map_or(0.0, |aid| {
            aid.amount * (-elapsed_s / aid.time_constant_s).exp()
        });
        let sensors = (1.0 + aid) * &self.settings.noise.sensors;
        let s = &both * &self.covariance * both.transpose() + &sensors;
        let gain = s
            .cholesky()
            .unwrap()
            .solve(&(&both * &self.covariance))
            .transpose();
        let correction = &gain * innovation;
        self.state += correction.rows(0, n);
        self.excitation += correction.rows(n, inputs);
        // Joseph's form is the least sensitive to rounding.
        let left = DMatrix::identity(n + inputs, n + inputs) - &gain * both;
        let noise = &gain * sensors * gain.transpose();
        let corrected = &left * &self.covariance * left.transpose() + noise;
        self.covariance = 0.5 * (&corrected + corrected.transpose());
    }

    fn predict(&mut self, known: &[f64]) {
        let (n, inputs, step_s) = (
            self.state.len(),
            self.excitation.len(),
            self.settings.step_s,
        );
        let held = &self.last_known + &self.excitation;
        self.model
            .linearise_process(self.state.as_slice(), held.as_slice());
        let (mut jacobian, mut input) = (DMatrix::zeros(n, n), DMatrix::zeros(n, inputs));
        self.model
            .jacobian_mul(&DMatrix::identity(n, n), &mut jacobian);
        self.model.excitation_matrix(&mut input);
        let mut rate = DVector::zeros(n);
        self.model.derivative(rate.as_mut_slice());
        // [A_y, g, B_y, B_y ḟ, 0] with the ramp as a chain of two: the exponential gives the
        // transition and all integrals.
        let size = n + inputs + 3;
        let mut augmented = DMatrix::zeros(size, size);
        augmented.view_mut((0, 0), (n, n)).copy_from(&jacobian);
        augmented.column_mut(n).rows_mut(0, n).copy_from(&rate);
        augmented
            .view_mut((0, n + 1), (n, inputs))
            .copy_from(&input);
        if self.settings.input_hold == InputHold::First {
            let slope = (DVector::from_column_slice(known) - held) / step_s;
            augmented
                .column_mut(size - 2)
                .rows_mut(0, n)
                .copy_from(&(input * slope));
            augmented[(size - 2, size - 1)] = 1.0;
        }
        // The error of an exponential is relative to the norm of its matrix. Displacements are
        // therefore scaled by the rate of the fastest mode.
        let free = (n - self.model.parameter_len()) / 2;
        let rate = self.model.rate_bound();
        let scale = DVector::from_fn(size, |row, _| if row < free { rate } else { 1.0 });
        let balanced = DMatrix::from_fn(size, size, |i, j| {
            scale[i] * augmented[(i, j)] * step_s / scale[j]
        })
        .exp();
        let exponential =
            DMatrix::from_fn(size, size, |i, j| balanced[(i, j)] * scale[j] / scale[i]);
        self.state += exponential.column(n).rows(0, n) + exponential.column(size - 1).rows(0, n);
        let mut transition = DMatrix::zeros(n, n + inputs);
        transition
            .columns_mut(0, n)
            .copy_from(&exponential.view((0, 0), (n, n)));
        transition
            .columns_mut(n, inputs)
            .copy_from(&exponential.view((0, n + 1), (n, inputs)));
        let predicted =
            &transition * &self.covariance * transition.transpose() * self.settings.fading.value();
        self.covariance
            .view_mut((0, 0), (n, n))
            .copy_from(&predicted);
    }
}

/// Returns the settings of the structure, with all noise levels known.
fn settings(structure: &Structure) -> FilterSettings {
    let mut settings = structure.filter_settings().unwrap();
    settings.misfit = None; // the reference is the published filter
    for parameter in std::mem::take(&mut settings.noise.parameters) {
        match parameter.target {
            NoiseTarget::Excitation => {
                settings.noise.excitation += parameter.start * parameter.pattern
            }
            NoiseTarget::Sensors => settings.noise.sensors += parameter.start * parameter.pattern,
        }
    }
    settings
}

/// Returns the index ranges of displacements, velocities and parameters in a state.
///
/// The rounding error of each range follows its largest entry, because differences of large
/// displacements cancel in stiff rotations.
fn kinds(n: usize, parameters: usize) -> [std::ops::Range<usize>; 3] {
    let free = (n - parameters) / 2;
    [0..free, free..2 * free, 2 * free..n]
}

/// Returns a vector in which the largest magnitude of its kind replaces every entry.
fn level(entries: &DVector<f64>, parameters: usize) -> DVector<f64> {
    let mut levels = entries.clone();
    for kind in kinds(entries.len(), parameters) {
        let largest = entries.as_slice()[kind.clone()]
            .iter()
            .fold(f64::MIN_POSITIVE, |most, entry| most.max(entry.abs()));
        levels.as_mut_slice()[kind].fill(largest);
    }
    levels
}

/// Asserts that means and covariances agree with the reference.
///
/// Means are relative to the largest value of their kind so far, covariances to the largest
/// standard deviations of their kinds.
#[track_caller]
fn assert_exact(structure: Structure) {
    const FRAMES: usize = 10_000;
    let (settings, parameters) = (settings(&structure), structure.parameters().len());
    let mut filter = ExtendedKalmanFilter::new(structure.model(), settings.clone()).unwrap();
    let mut exact = Exact::new(&structure, settings);
    let n = filter.mean().len();
    let mut largest = DVector::zeros(n);
    for (index, frame) in structure.simulator(1).take(FRAMES).enumerate() {
        let observations: Vec<f64> = structure
            .observation_channels()
            .iter()
            .map(|c| frame.values[*c])
            .collect();
        let excitation: Vec<f64> = structure
            .excitation_channels()
            .iter()
            .map(|c| c.map_or(0.0, |c| frame.values[c]))
            .collect();
        filter
            .step(Frame {
                observations: &observations,
                excitation: &excitation,
            })
            .unwrap();
        exact.step(&observations, &excitation);
        largest.zip_apply(&exact.state, |largest: &mut f64, entry| {
            *largest = largest.max(entry.abs())
        });
        let mean = (filter.mean() - &exact.state)
            .component_div(&level(&largest, parameters))
            .amax();
        let covariance = exact.covariance.view((0, 0), (n, n));
        let std = level(&covariance.diagonal().map(f64::sqrt), parameters);
        let off = (filter.covariance() - covariance)
            .component_div(&(&std * std.transpose()))
            .amax();
        assert!(
            mean < 1e-9 && off < 1e-9,
            "frame {index}: mean off by {mean:e}, covariance by {off:e}"
        );
        if index + 1 == FRAMES {
            println!(
                "{}: mean off by {mean:e}, covariance by {off:e}",
                structure.name()
            );
        }
    }
}

#[test]
fn a_shear_building_is_exact() {
    assert_exact(example("demo"));
}

#[test]
fn a_building_with_scaled_masses_and_a_direct_term_is_exact() {
    assert_exact(building_with_masses());
}

#[test]
fn a_building_with_dashpots_is_exact() {
    assert_exact(example("dashpot-building"));
}

#[test]
fn a_hysteretic_building_is_exact() {
    assert_exact(example("bouc-wen-five"));
}

#[test]
fn matrices_are_exact() {
    assert_exact(example("matrices"));
}

#[test]
fn frames_are_exact() {
    assert_exact(portal("consistent"));
    assert_exact(portal("lumped"));
}

#[test]
fn trusses_are_exact() {
    assert_exact(small_truss("lumped"));
    assert_exact(small_truss("consistent"));
}

/// The highest modes rotate by many radians per step.
#[test]
fn a_tower_is_exact() {
    assert_exact(smallest_tower());
}
