//! Information of the sensors of a structure about its parameters and noise levels, before
//! measurement.
//!
//! The innovations `ν` of a Kalman filter are independent and normal with covariance `S`. The data
//! of `N` frames therefore contain the Fisher information
//! `I = Σ ∂νᵀ S⁻¹ ∂ν + N/2 tr(S⁻¹ ∂S S⁻¹ ∂S)` about all quantities on which the filter depends. The
//! derivatives are central differences between filters that run on the same simulated data.
//!
//! The extended filter does not use all of this information. It differentiates the innovations with
//! constant gain, `ψ = ∂ν|_K`, and counts the information `J_θ = Σ ψᵀ S⁻¹ ψ`. An error `δ` of
//! parameters and levels pulls its parameters by `ψᵀ S⁻¹ ∂ν δ` (Ljung 1979, *IEEE Trans. Automatic
//! Control* 24, 36). A noise level uses only its own part `U` of `S`. It counts
//! `J_ψ = N/2 tr(S⁻¹ U S⁻¹ U)` and is pulled by `N/2 tr(S⁻¹ U S⁻¹ ∂S) δ`. If the pull is much
//! smaller than the counted information, the filter underestimates its uncertainty.

use crate::linear_form::LinearForm;
use crate::noise_level::NoiseSource;
use crate::ritz_basis::RitzBasis;
use crate::steady_filter::{NoiseCovariances, SteadyFilter};
use crate::structure::Structure;
use nalgebra::{DMatrix, DVector};

/// Half the distance of two filters, in a parameter or in the logarithm of a variance.
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

/// A quantity with respect to which the filters are differentiated.
#[derive(Debug, Clone, Copy)]
enum Unknown {
    Parameter(usize),
    Level(usize),
}

/// A change of one unknown: of a parameter, or of the logarithm of a variance.
#[derive(Debug, Clone, Copy)]
struct Change {
    unknown: Unknown,
    by: f64,
}

/// Two filters with one unknown increased and decreased.
type Pair = [SteadyFilter; 2];

impl Information {
    /// Simulates `frames` frames of the undamaged structure at its prior means and sums their
    /// information. Reports the completed share (0 to 1) to `on_share`.
    pub(crate) fn expected(
        structure: &Structure,
        frames: u64,
        seed: u64,
        on_share: &dyn Fn(f64),
    ) -> Option<Self> {
        let parameters = (0..structure.parameters.len()).map(Unknown::Parameter);
        let levels = (0..structure.noise_levels.len()).map(Unknown::Level);
        let unknowns: Vec<Unknown> = parameters.clone().chain(levels).collect();
        let basis = structure.analysis_basis();
        let basis = basis.as_ref();
        let nominal = Moved::new(structure, basis, None);
        let filter = nominal.filter()?;
        let pair = |(done, unknown): (usize, Unknown)| {
            on_share(0.5 * done as f64 / unknowns.len() as f64);
            let [up, down] = [DIFFERENCE, -DIFFERENCE]
                .map(|by| Moved::new(structure, basis, Some(Change { unknown, by })).filter());
            Some([up?, down?])
        };
        let held_pair = |unknown| {
            [DIFFERENCE, -DIFFERENCE].map(|by| {
                let change = Some(Change { unknown, by });
                Moved::new(structure, basis, change).filter_with_update_of(&filter)
            })
        };
        let mut pairs: Vec<Pair> = unknowns
            .iter()
            .copied()
            .enumerate()
            .map(pair)
            .collect::<Option<_>>()?;
        let mut held_pairs: Vec<Pair> = parameters.map(held_pair).collect();
        let lower = filter.innovation_covariance.clone().cholesky()?.l();
        let whole: Vec<DMatrix<f64>> = pairs
            .iter()
            .map(|pair| whitened(covariance_difference(pair), &lower))
            .collect();
        let own: Vec<DMatrix<f64>> = nominal
            .level_patterns(structure)
            .map(|u| whitened(u, &lower))
            .collect();
        let traces = |a: &[DMatrix<f64>], b: &[DMatrix<f64>]| {
            DMatrix::from_fn(a.len(), b.len(), |i, j| 0.5 * a[i].dot(&b[j])) // ½ tr(S⁻¹ A S⁻¹ B)
        };
        let (theta, all) = (held_pairs.len(), pairs.len());
        let of_frames = |share: f64| on_share(0.5 + 0.5 * share);
        let simulated = Simulated {
            structure,
            frames,
            seed,
            on_share: &of_frames,
        };
        let means = simulated.means(&mut pairs, &mut held_pairs, &lower);
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

/// The structure with one unknown changed.
struct Moved {
    form: LinearForm,
    recursion: crate::linear_form::Recursion,
    noise: NoiseCovariances,
}

impl Moved {
    fn new(structure: &Structure, basis: Option<&RitzBasis>, change: Option<Change>) -> Self {
        let mut theta: Vec<f64> = structure
            .parameters
            .iter()
            .map(crate::Parameter::mean)
            .collect();
        let levels = structure.noise_levels.len();
        let mut variances: Vec<f64> = (0..levels)
            .map(|level| structure.expected_level_std(level).powi(2))
            .collect();
        if let Some(Change { unknown, by }) = change {
            match unknown {
                Unknown::Parameter(parameter) => theta[parameter] += by,
                Unknown::Level(level) => variances[level] *= by.exp(),
            }
        }
        let inputs = structure.excitation_channels.len();
        let mut noise = NoiseCovariances {
            excitation: DMatrix::zeros(inputs, inputs),
            sensors: DVector::zeros(structure.observation_channels.len()),
        };
        let frames_per_sample = structure.frames_per_sample();
        let every = |row: usize| frames_per_sample[structure.observation_channels[row]] as f64;
        for (level, variance) in structure.noise_levels.iter().zip(variances) {
            match level.source() {
                NoiseSource::Excitation(index) => {
                    noise.excitation += structure.excitation_pattern(*index) * variance
                }
                // The simulation distributes the information of a slower node over all frames.
                NoiseSource::Sensors(rows) => rows
                    .iter()
                    .for_each(|row| noise.sensors[*row] = variance * every(*row)),
            }
        }
        let form = LinearForm::moving_in(&mut structure.model(), &theta, basis);
        let recursion = form.recursion(structure.step_s(), &structure.input_holds());
        Self {
            form,
            recursion,
            noise,
        }
    }

    fn filter(&self) -> Option<SteadyFilter> {
        SteadyFilter::new(&self.form, self.recursion.clone(), &self.noise)
    }

    fn filter_with_update_of(&self, filter: &SteadyFilter) -> SteadyFilter {
        filter.with_frozen_update(&self.form, self.recursion.clone())
    }

    /// Returns `U` of each level, the contribution of its variance to `S` within one step.
    fn level_patterns<'m>(
        &'m self,
        structure: &'m Structure,
    ) -> impl Iterator<Item = DMatrix<f64>> + 'm {
        let one_step = &self.form.observation * &self.recursion.input; // H B
        structure
            .noise_levels
            .iter()
            .enumerate()
            .map(move |(number, level)| match level.source() {
                NoiseSource::Excitation(index) => {
                    let (hb, d) = (&one_step, &self.form.direct);
                    let variance = structure.expected_level_std(number).powi(2);
                    let covariance = structure.excitation_pattern(*index) * variance;
                    hb * &covariance * hb.transpose() + d * covariance * d.transpose()
                }
                NoiseSource::Sensors(rows) => {
                    let variance = |row| {
                        if rows.contains(&row) {
                            self.noise.sensors[row]
                        } else {
                            0.0
                        }
                    };
                    DMatrix::from_diagonal(&DVector::from_fn(self.noise.sensors.len(), |row, _| {
                        variance(row)
                    }))
                }
            })
    }
}

fn covariance_difference(pair: &Pair) -> DMatrix<f64> {
    (&pair[0].innovation_covariance - &pair[1].innovation_covariance) / (2.0 * DIFFERENCE)
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

/// Number of frames between two reports of the completed share.
const FRAMES_PER_REPORT: u64 = 64;

impl Simulated<'_> {
    fn means(&self, pairs: &mut [Pair], held_pairs: &mut [Pair], lower: &DMatrix<f64>) -> Means {
        let Self {
            structure,
            frames,
            seed,
            on_share,
        } = *self;
        let (rows, all, theta) = (lower.nrows(), pairs.len(), held_pairs.len());
        let mut simulator = structure.undamaged_simulator(seed);
        let split = |values: &[f64]| {
            let z = structure
                .observation_channels
                .iter()
                .map(|channel| values[*channel]);
            let known = structure
                .excitation_channels
                .iter()
                .map(|channel| channel.map_or(0.0, |channel| values[channel]));
            (
                DVector::from_iterator(z.len(), z),
                DVector::from_iterator(known.len(), known),
            )
        };
        let mut derivatives = DMatrix::zeros(rows, all + theta);
        let mut products = DMatrix::zeros(all + theta, all + theta);
        let (mut z, mut known) = split(&simulator.advance_frame().values);
        for frame in 0..frames {
            if frame.is_multiple_of(FRAMES_PER_REPORT) {
                on_share(frame as f64 / frames as f64);
            }
            let (next_z, next_known) = split(&simulator.advance_frame().values);
            let every_pair = pairs.iter_mut().chain(held_pairs.iter_mut());
            for (pair, mut column) in every_pair.zip(derivatives.column_iter_mut()) {
                for filter in pair.iter_mut() {
                    filter.step(&z, &known, &next_known);
                }
                column.copy_from(&pair[0].innovation);
                column -= &pair[1].innovation;
            }
            lower.solve_lower_triangular_mut(&mut derivatives);
            products.gemm_tr(1.0, &derivatives, &derivatives, 1.0);
            (z, known) = (next_z, next_known);
        }
        products /= frames as f64 * (2.0 * DIFFERENCE).powi(2);
        Means {
            held: products.view((0, 0), (all, all)).into_owned(),
            counted: products.view((all, all), (theta, theta)).into_owned(),
            pull: products.view((all, 0), (theta, all)).into_owned(),
        }
    }
}
