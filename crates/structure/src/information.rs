//! Information of the sensors of a structure about its parameters and noise levels, before
//! measurement.
//!
//! The innovations `ν` of a Kalman filter are independent and normal with covariance `S`. The data
//! of `N` frames therefore contain the Fisher information
//! `I = Σ ∂νᵀ S⁻¹ ∂ν + N/2 tr(S⁻¹ ∂S S⁻¹ ∂S)` about all quantities on which the filter depends. All
//! derivatives run with the filter on simulated data.
//!
//! The extended filter does not use all of this information. It differentiates the innovations with
//! constant gain, `ψ = ∂ν|_K`, and counts the information `J_θ = Σ ψᵀ S⁻¹ ψ`. An error `δ` of
//! parameters and levels pulls its parameters by `ψᵀ S⁻¹ ∂ν δ` (Ljung 1979, *IEEE Trans. Automatic
//! Control* 24, 36). A noise level uses only its own part `U` of `S`. It counts
//! `J_ψ = N/2 tr(S⁻¹ U S⁻¹ U)` and is pulled by `N/2 tr(S⁻¹ U S⁻¹ ∂S) δ`. If the pull is much
//! smaller than the counted information, the filter underestimates its uncertainty.

use crate::linear_form::LinearForm;
use crate::model::StructureModel;
use crate::noise_level::NoiseSource;
use crate::simulator::Simulator;
use crate::steady_filter::{NoiseCovariances, SampledModel, SteadyFilter, Tangent};
use crate::structure::Structure;
use nalgebra::{DMatrix, DMatrixView, DMatrixViewMut, DVector};
use rayon::prelude::*;

/// Number of parameters between two reports of the completed share.
const AT_ONCE: usize = 16;

/// Half the distance of two structures in a parameter.
///
/// A thousandth shifts a resonance by far less than its width.
const DIFFERENCE: f64 = 1e-3;

/// Information per frame about the parameters (ratios to nominal) and the logarithms of all noise
/// variances, in this order.
#[derive(Debug, Clone)]
pub(crate) struct Information {
    /// `I`, the information in the data.
    pub(crate) held: DMatrix<f64>,
    /// `J`, the information that the extended filter counts, separately for parameters and levels.
    pub(crate) counted: DMatrix<f64>,
    /// Pull of an error (column) on the estimates (rows).
    pub(crate) pull: DMatrix<f64>,
}

impl Information {
    /// Returns an estimate of the memory that the matrices for [`Self::expected`] take (bytes).
    pub(crate) fn bytes(structure: &Structure) -> usize {
        let parameters = structure.parameters.len();
        let unknowns = parameters + structure.noise_levels.len();
        let (rows, states) = (
            structure.observation_channels.len(),
            2 * structure.most_shapes(),
        );
        // The derivative by an unknown has two covariances of the data, two gains, and the effect
        // of the motion on state and data.
        let of_filter = 2 * rows * rows + 2 * states * rows + (states + rows) * states;
        // The derivatives of the data of a block are there twice, for a parameter also as the
        // extended filter sees them.
        let of_block = 2 * BLOCK as usize * rows * (unknowns + parameters);
        // Measured checks of 100 and of 240 parameters and channels took 20 and 8 % more: the
        // program, and the products of each thread.
        (unknowns * of_filter + of_block) * size_of::<f64>() * 6 / 5
    }

    /// Simulates `frames` frames of the undamaged structure at its prior means and sums their
    /// information. Reports the completed share (0 to 1) to `on_share`.
    pub(crate) fn expected(
        structure: &Structure,
        frames: u64,
        seed: u64,
        on_share: &dyn Fn(f64),
    ) -> Option<Self> {
        let levels: Vec<NoiseCovariances> = level_parts(structure);
        let means = structure.prior_means();
        let nominal = sampled(structure, &mut structure.model(), &means);
        let filter = SteadyFilter::new(nominal, sum_of(structure, &levels))?;
        let (theta, all) = (
            structure.parameters.len(),
            structure.parameters.len() + levels.len(),
        );
        let by_parameter = |model: &mut StructureModel, parameter: &usize| {
            filter.by_parameter(&slope(structure, model, &means, *parameter))
        };
        let parameters: Vec<usize> = (0..theta).collect();
        let mut tangents: Vec<Tangent> = Vec::with_capacity(all);
        for some in parameters.chunks(AT_ONCE) {
            on_share(0.5 * tangents.len() as f64 / all as f64);
            let some = some.par_iter();
            tangents.par_extend(some.map_init(|| structure.model(), by_parameter));
        }
        tangents.par_extend(levels.par_iter().map(|part| filter.by_level(part)));
        let lower = filter.innovation_covariance.clone().cholesky()?.l();
        let whole: Vec<DMatrix<f64>> = tangents
            .iter()
            .map(|tangent| whitened(tangent.innovation_covariance.clone(), &lower))
            .collect();
        let own: Vec<DMatrix<f64>> = levels
            .iter()
            .map(|part| whitened(part.within_a_step(filter.model()), &lower))
            .collect();
        let traces = |a: &[DMatrix<f64>], b: &[DMatrix<f64>]| {
            DMatrix::from_fn(a.len(), b.len(), |i, j| 0.5 * a[i].dot(&b[j])) // ½ tr(S⁻¹ A S⁻¹ B)
        };
        let of_frames = |share: f64| on_share(0.5 + 0.5 * share);
        let simulated = Simulated {
            structure,
            frames,
            seed,
            on_share: &of_frames,
        };
        let means = simulated.means(filter, tangents, &lower);
        let mut counted = DMatrix::zeros(all, all);
        counted
            .view_mut((0, 0), (theta, theta))
            .copy_from(&means.counted);
        counted
            .view_mut((theta, theta), (all - theta, all - theta))
            .copy_from(&traces(&own, &own));
        let mut pull = DMatrix::zeros(all, all);
        pull.rows_mut(0, theta).copy_from(&means.pull);
        pull.rows_mut(theta, all - theta)
            .copy_from(&traces(&own, &whole));
        Some(Self {
            held: means.held + traces(&whole, &whole),
            counted,
            pull,
        })
    }
}

/// Returns the structure with the parameters `theta` (ratios to nominal).
fn sampled(structure: &Structure, model: &mut StructureModel, theta: &[f64]) -> SampledModel {
    let form = LinearForm::moving_in(model, theta, structure.analysis_basis());
    let recursion = form.recursion(structure.step_s(), &structure.input_holds());
    SampledModel::new(form, recursion)
}

/// Returns the derivative of the structure with respect to a parameter.
fn slope(
    structure: &Structure,
    model: &mut StructureModel,
    means: &[f64],
    parameter: usize,
) -> SampledModel {
    let [up, down] = [DIFFERENCE, -DIFFERENCE].map(|by| {
        let mut theta = means.to_vec();
        theta[parameter] += by;
        sampled(structure, model, &theta)
    });
    up.difference(&down, 2.0 * DIFFERENCE)
}

/// Returns the contribution of each noise level to the covariances.
fn level_parts(structure: &Structure) -> Vec<NoiseCovariances> {
    let frames_per_sample = structure.frames_per_sample();
    let every = |row: usize| frames_per_sample[structure.observation_channels[row]] as f64;
    let levels = structure.noise_levels.iter().enumerate();
    let part = |(number, level): (usize, &crate::NoiseLevel)| {
        let variance = structure.expected_level_std(number).powi(2);
        let mut part = no_noise(structure);
        match level.source() {
            NoiseSource::Excitation(index) => {
                part.excitation = structure.excitation_pattern(*index) * variance;
            }
            // The simulation distributes the information of a slower node over all frames.
            NoiseSource::Sensors(rows) => rows
                .iter()
                .for_each(|row| part.sensors[*row] = variance * every(*row)),
        }
        part
    };
    levels.map(part).collect()
}

fn no_noise(structure: &Structure) -> NoiseCovariances {
    let inputs = structure.excitation_channels.len();
    NoiseCovariances {
        excitation: DMatrix::zeros(inputs, inputs),
        sensors: DVector::zeros(structure.observation_channels.len()),
    }
}

fn sum_of(structure: &Structure, parts: &[NoiseCovariances]) -> NoiseCovariances {
    parts.iter().fold(no_noise(structure), |mut sum, part| {
        sum.excitation += &part.excitation;
        sum.sensors += &part.sensors;
        sum
    })
}

/// Returns `L⁻¹ X L⁻ᵀ` for a symmetric `X`, with `S = L Lᵀ`.
fn whitened(mut x: DMatrix<f64>, lower: &DMatrix<f64>) -> DMatrix<f64> {
    lower.solve_lower_triangular_mut(&mut x);
    x.transpose_mut();
    lower.solve_lower_triangular_mut(&mut x);
    x
}

/// Averages of products of derivatives of `ν` over simulated frames.
struct Means {
    /// `∂νᵀ S⁻¹ ∂ν` (all × all).
    held: DMatrix<f64>,
    /// `ψᵀ S⁻¹ ψ` (N_θ × N_θ).
    counted: DMatrix<f64>,
    /// `ψᵀ S⁻¹ ∂ν` (N_θ × all).
    pull: DMatrix<f64>,
}

/// The frames over which derivatives are averaged.
struct Simulated<'s> {
    structure: &'s Structure,
    frames: u64,
    seed: u64,
    on_share: &'s dyn Fn(f64),
}

/// Number of frames whose derivatives are computed at once.
const BLOCK: u64 = 64;

/// Number of derivatives that one thread computes at once.
const SHARE: usize = 64;

/// The data of the filter in some consecutive frames, a column for each.
struct Block {
    /// `[û, f̄, f̄_{i+1} − f̄]` (2 N_d + 2 N_f rows).
    motion: DMatrix<f64>,
    /// `ν` (N_0 rows).
    innovations: DMatrix<f64>,
}

/// A derivative of the filter whose `∂û` runs from frame to frame.
struct Course {
    /// `∂K`, or what the extended filter adds to it (2 N_d × N_0).
    gain: DMatrix<f64>,
    /// See [`Tangent::by_motion`], with `L⁻¹` before the rows of `∂ν`.
    by_motion: Option<DMatrix<f64>>,
}

impl Simulated<'_> {
    fn means(
        &self,
        mut filter: SteadyFilter,
        tangents: Vec<Tangent>,
        lower: &DMatrix<f64>,
    ) -> Means {
        let mut data = Data::new(self.structure, self.seed);
        let (rows, states) = filter.model().observation.shape();
        let (mut courses, mut held) = (Vec::with_capacity(tangents.len()), Vec::new());
        for mut tangent in tangents {
            if let Some(by_motion) = &mut tangent.by_motion {
                lower.solve_lower_triangular_mut(&mut by_motion.rows_mut(states, rows));
            }
            courses.push(Course {
                gain: tangent.gain,
                by_motion: tangent.by_motion,
            });
            held.extend(tangent.held_gain.map(|gain| Course {
                gain,
                by_motion: None,
            }));
        }
        let (all, theta) = (courses.len(), held.len());
        courses.append(&mut held);
        let mut advance = DMatrix::zeros(states + rows, states); // [Ā; −L⁻¹ H]
        advance.rows_mut(0, states).copy_from(filter.closed());
        let mut seen = advance.rows_mut(states, rows);
        seen.copy_from(&-&filter.model().observation);
        lower.solve_lower_triangular_mut(&mut seen);
        // `∂û` of all unknowns, and how much more it is in the extended filter
        let mut moved = DMatrix::zeros(states, courses.len());
        let mut products = DMatrix::zeros(courses.len(), courses.len());
        for first in (0..self.frames).step_by(BLOCK as usize) {
            (self.on_share)(first as f64 / self.frames as f64);
            let len = BLOCK.min(self.frames - first) as usize;
            let block = data.block(&mut filter, len);
            // `L⁻¹ ∂ν` in all frames below one another, a column for each derivative
            let mut derivatives = DMatrix::zeros(rows * len, courses.len());
            let (of_moved, of_derivatives) = (states * SHARE, rows * len * SHARE);
            let shares = (moved.as_mut_slice().par_chunks_mut(of_moved.max(1)))
                .zip(
                    derivatives
                        .as_mut_slice()
                        .par_chunks_mut(of_derivatives.max(1)),
                )
                .zip(courses.par_chunks(SHARE));
            shares.for_each(|((moved, derivatives), courses)| {
                let width = courses.len();
                let mut moved = DMatrixViewMut::from_slice(moved, states, width);
                let mut derivatives = DMatrixViewMut::from_slice(derivatives, rows * len, width);
                block.follow(courses, &advance, &mut moved, &mut derivatives);
            });
            for parameter in 0..theta {
                let pair = derivatives.columns_range_pair_mut(parameter, all + parameter);
                let (whole, mut more) = pair;
                more += whole;
            }
            add_products(&mut products, &derivatives);
        }
        products /= self.frames as f64;
        products.fill_upper_triangle_with_lower_triangle();
        Means {
            held: products.view((0, 0), (all, all)).into_owned(),
            counted: products.view((all, all), (theta, theta)).into_owned(),
            pull: products.view((all, 0), (theta, all)).into_owned(),
        }
    }
}

/// Adds the part of `Xᵀ X` below and around the diagonal.
fn add_products(sum: &mut DMatrix<f64>, x: &DMatrix<f64>) {
    let (rows, width) = x.shape();
    let transposed = x.transpose();
    // Without sensors, there are no rows. A chunk must not be empty.
    let shares = sum.as_mut_slice().par_chunks_mut((width * SHARE).max(1));
    let shares = shares.zip(x.as_slice().par_chunks((rows * SHARE).max(1)));
    shares.enumerate().for_each(|(number, (sum, x))| {
        let (first, own) = (number * SHARE, sum.len() / width);
        let mut sum = DMatrixViewMut::from_slice(sum, width, own);
        let mut below = sum.rows_mut(first, width - first);
        let x = DMatrixView::from_slice(x, rows, own);
        below.gemm(1.0, &transposed.rows(first, width - first), &x, 1.0);
    });
}

impl Block {
    /// Follows some derivatives through the frames of the block.
    ///
    /// Advances their `∂û` (`moved`) by `advance`, `[Ā; −L⁻¹ H]`, and writes their `L⁻¹ ∂ν` of all
    /// frames below one another.
    fn follow(
        &self,
        courses: &[Course],
        advance: &DMatrix<f64>,
        moved: &mut DMatrixViewMut<'_, f64>,
        derivatives: &mut DMatrixViewMut<'_, f64>,
    ) {
        let (len, states) = advance.shape();
        let rows = len - states;
        let pushes: Vec<DMatrix<f64>> = courses.iter().map(|course| self.pushes(course)).collect();
        let mut next = DMatrix::zeros(len, courses.len());
        for frame in 0..self.motion.ncols() {
            next.gemm(1.0, advance, moved, 0.0);
            for (mut column, push) in next.column_iter_mut().zip(&pushes) {
                let mut pushed = column.rows_mut(0, push.nrows());
                pushed += push.column(frame);
            }
            moved.copy_from(&next.rows(0, states));
            let mut shown = derivatives.rows_mut(frame * rows, rows);
            shown.copy_from(&next.rows(states, rows));
        }
    }

    /// Returns what the data add to `∂û_{i+1}` and, for a parameter, to `L⁻¹ ∂ν_i` below it.
    fn pushes(&self, course: &Course) -> DMatrix<f64> {
        let by_gain = &course.gain * &self.innovations; // ∂K ν
        match &course.by_motion {
            None => by_gain,
            Some(by_motion) => {
                let mut pushes = by_motion * &self.motion;
                let mut upper = pushes.rows_mut(0, by_gain.nrows());
                upper += by_gain;
                pushes
            }
        }
    }
}

/// Simulated data of the sensors.
struct Data<'s> {
    structure: &'s Structure,
    simulator: Simulator,
    /// `z` (N_0) and the known excitation `f̄` (N_f) of the next frame.
    z: DVector<f64>,
    known: DVector<f64>,
}

impl<'s> Data<'s> {
    fn new(structure: &'s Structure, seed: u64) -> Self {
        let mut data = Self {
            structure,
            simulator: structure.undamaged_simulator(seed),
            z: DVector::zeros(0),
            known: DVector::zeros(0),
        };
        data.advance();
        data
    }

    /// Replaces the data by those of the next frame, and returns the former.
    fn advance(&mut self) -> (DVector<f64>, DVector<f64>) {
        let values = self.simulator.advance_frame().values;
        let observed = &self.structure.observation_channels;
        let z = DVector::from_fn(observed.len(), |row, _| values[observed[row]]);
        let excited = &self.structure.excitation_channels;
        let known = DVector::from_fn(excited.len(), |input, _| {
            excited[input].map_or(0.0, |channel| values[channel])
        });
        (
            std::mem::replace(&mut self.z, z),
            std::mem::replace(&mut self.known, known),
        )
    }

    /// Runs the filter over the next `len` frames.
    fn block(&mut self, filter: &mut SteadyFilter, len: usize) -> Block {
        let (states, inputs) = (filter.state.len(), self.known.len());
        let mut block = Block {
            motion: DMatrix::zeros(states + 2 * inputs, len),
            innovations: DMatrix::zeros(self.z.len(), len),
        };
        for frame in 0..len {
            let (z, known) = self.advance();
            let mut motion = block.motion.column_mut(frame);
            motion.rows_mut(0, states).copy_from(&filter.state);
            motion.rows_mut(states, inputs).copy_from(&known);
            motion
                .rows_mut(states + inputs, inputs)
                .copy_from(&(&self.known - &known));
            filter.step(&z, &known, &self.known);
            block.innovations.set_column(frame, &filter.innovation);
        }
        block
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// Returns the information from central differences of filters that run on the same data, the
    /// plain form of the derivatives.
    fn by_differences(structure: &Structure, frames: u64) -> Information {
        let (levels, means) = (level_parts(structure), structure.prior_means());
        let mut model = structure.model();
        let mut of = |theta: &[f64], levels: &[NoiseCovariances]| {
            let model = sampled(structure, &mut model, theta);
            SteadyFilter::new(model, sum_of(structure, levels)).unwrap()
        };
        let filter = of(&means, &levels);
        let (theta, all) = (means.len(), means.len() + levels.len());
        let mut pairs: Vec<[SteadyFilter; 2]> = Vec::new();
        for unknown in 0..all {
            pairs.push([DIFFERENCE, -DIFFERENCE].map(|by| {
                let (mut means, mut levels) = (means.clone(), levels.clone());
                match unknown.checked_sub(theta) {
                    None => means[unknown] += by,
                    Some(level) => {
                        levels[level].excitation *= by.exp();
                        levels[level].sensors *= by.exp();
                    }
                }
                of(&means, &levels)
            }));
        }
        for parameter in 0..theta {
            pairs.push([0, 1].map(|side| pairs[parameter][side].with_updates_of(&filter)));
        }
        let lower = filter.innovation_covariance.clone().cholesky().unwrap().l();
        let whiten = |x: DMatrix<f64>| whitened(x, &lower);
        let whole: Vec<DMatrix<f64>> = pairs[..all]
            .iter()
            .map(|[up, down]| {
                let change = &up.innovation_covariance - &down.innovation_covariance;
                whiten(change / (2.0 * DIFFERENCE))
            })
            .collect();
        let mut data = Data::new(structure, 1);
        let mut products = DMatrix::zeros(all + theta, all + theta);
        for _ in 0..frames {
            let (z, known) = data.advance();
            let mut derivatives = DMatrix::zeros(z.len(), all + theta);
            for (pair, mut column) in pairs.iter_mut().zip(derivatives.column_iter_mut()) {
                pair.iter_mut()
                    .for_each(|filter| filter.step(&z, &known, &data.known));
                column
                    .copy_from(&((&pair[0].innovation - &pair[1].innovation) / (2.0 * DIFFERENCE)));
            }
            lower.solve_lower_triangular_mut(&mut derivatives);
            products += derivatives.tr_mul(&derivatives) / frames as f64;
        }
        let held = DMatrix::from_fn(all, all, |i, j| {
            products[(i, j)] + 0.5 * whole[i].dot(&whole[j])
        });
        Information {
            held,
            counted: products.view((all, all), (theta, theta)).into_owned(),
            pull: products.view((all, 0), (theta, all)).into_owned(),
        }
    }

    #[test]
    fn derivatives_of_the_filter_are_the_limit_of_differences_between_filters() {
        for text in [
            include_str!("../../../docs/examples/demo.toml"),
            include_str!("../../../docs/examples/output-only.toml"),
        ] {
            let structure = Structure::parse(text, Path::new("example.toml")).unwrap();
            let frames = 300;
            let found = Information::expected(&structure, frames, 1, &|_| {}).unwrap();
            let expected = by_differences(&structure, frames);
            let theta = structure.parameters.len();
            let scale = |i: usize, j: usize| (expected.held[(i, i)] * expected.held[(j, j)]).sqrt();
            let agree = |found: f64, expected: f64, scale: f64, what: &str| {
                // The differences are right to second order in DIFFERENCE.
                assert!(
                    (found - expected).abs() < 1e-4 * scale,
                    "{what}: {found} for {expected}"
                );
            };
            for i in 0..found.held.nrows() {
                for j in 0..found.held.ncols() {
                    let place = (i, j);
                    agree(found.held[place], expected.held[place], scale(i, j), "held");
                    if i < theta {
                        agree(found.pull[place], expected.pull[place], scale(i, j), "pull");
                    }
                    if i < theta && j < theta {
                        let counted = [&found, &expected].map(|of| of.counted[place]);
                        agree(counted[0], counted[1], scale(i, j), "counted");
                    }
                }
            }
        }
    }

    #[test]
    fn products_without_rows_are_zero() {
        let mut sum = DMatrix::zeros(3, 3);
        add_products(&mut sum, &DMatrix::zeros(0, 3));
        assert_eq!(sum, DMatrix::zeros(3, 3));
    }
}
