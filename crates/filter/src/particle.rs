//! The particle filter: weighted samples represent the distribution of state, parameters and noise
//! levels.
//!
//! Source: Ching, Beck, Porter & Shaikhutdinov (2006), real-time Bayesian estimation of uncertain
//! dynamical systems. The method requires neither linearity nor a Gaussian shape, but costs `N`
//! model integrations per step. Where the extended Kalman filter is adequate, it is hundreds of
//! times cheaper.
//!
//! Notation: particles `x^i` (n) with normalised weights `W^i`, `i = 1..N`.
//! [`ParticleFilter::step`] performs these operations in order:
//!
//! - resample if the coefficient of variation of the weights is above its threshold; with
//!   `N_eff = 1/Σ W²`, `N_eff = N/(1 + c.o.v.²)`
//! - draw `x_k^i` from the importance density around `f(x_{k−1}^i, u, ·)`, either one extended
//!   Kalman step or the prior
//! - `ω^i = W^i p(ŷ_k | x_k^i) p(x_k^i | x_{k−1}^i) / p_G(x_k^i | x_{k−1}^i, ŷ_k)`, equation (10),
//!   in logarithms
//! - `ln p(ŷ_k | Ŷ_{k−1}) = ln Σ ω^i`, then `W^i = ω^i / Σ ω^j`
//! - estimates are weighted sums over the particles
//!
//! Resampling happens at the start of the next step instead of the end of this step. Estimates
//! therefore always come from the weighted sample, which is more accurate. Each draw of a particle
//! has its own random stream, determined by seed, step and particle index. Results are therefore
//! bit-identical for any number of threads and after a checkpoint.

mod drifting;
mod estimates;
mod excited;
mod innovation;
mod model;
mod moments;
mod resampling;
mod settings;
mod warm_started;
mod worker;

pub use drifting::{ContinuousSystem, Drifting, IncrementTime};
pub use excited::ExcitedSystem;
pub use model::{DifferenceWorkspace, Interval, ParticleModel};
pub use settings::{ImportanceDensity, ParticleSettings, Resampling};
pub use warm_started::{WarmStartState, WarmStartedParticleFilter};

use crate::error::FilterError;
use crate::extended::Frame;
use innovation::Innovation;
use moments::SquareRoot;
use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use worker::Worker;

/// Binary logarithm of the random words available to one particle in one step, far more than any
/// disturbance needs.
const WORDS_PER_STEP_LOG2: u32 = 20;

/// The Gaussian density of the initial particles.
///
/// With accurate sensors, a wide density leaves only a few particles with weight. In this case,
/// start from the estimate of another filter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GaussianStart {
    /// Mean (n).
    pub mean: DVector<f64>,
    /// Covariance (n × n).
    pub covariance: DMatrix<f64>,
    /// The input at the time of this Gaussian (p), one step before the first frame.
    ///
    /// `None` if the Gaussian applies to the time of the first frame.
    pub previous_input: Option<DVector<f64>>,
}

/// The result of one step of a particle filter, without the estimates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParticleStep {
    /// `ln p(ŷ_k | Ŷ_{k−1})`, zero if all channels are missing.
    pub log_evidence: f64,
    /// Number of used channels; 0 if the step is only a prediction.
    pub used_channels: usize,
    /// `νᵀ S⁻¹ ν` of the innovation against the prediction of the particles.
    ///
    /// It is about the number of used channels while the particles follow the data.
    pub normalised_innovation_squared: f64,
    /// Effective sample size after this frame: `N_eff = 1/Σ W²` with the weights `W`, from 1 to the
    /// number of particles.
    pub effective_size: f64,
    /// Standard deviation of the weights over their mean after this frame.
    pub coefficient_of_variation: f64,
    /// `true` if the particles were resampled before this frame.
    pub resampled: bool,
}

/// The complete state of a particle filter between two steps, for a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParticleState {
    /// x (n × N), one column per particle.
    states: Vec<f64>,
    /// ln W, minus infinity for a lost particle (N).
    log_weights: Vec<f64>,
    /// Initial particle from which each particle descends (N).
    ancestors: Vec<u32>,
    steps: u64,
    seed: u64,
    /// `true` if the particles already belong to the time of the next frame, so that there is no
    /// previous input.
    fresh: bool,
    /// Input of the last frame, NaN where it was missing (p).
    previous_input: DVector<f64>,
    /// Running mean square of the input (p).
    input_mean_square: DVector<f64>,
    log_evidence: f64,
}

/// The index of a worker, and the worker with its particles, their weights and their predictions.
type Share<'a, M> = (
    usize,
    (
        ((&'a mut Worker<M>, &'a mut [f64]), &'a mut [f64]),
        &'a mut [f64],
    ),
);

/// The purpose of a random stream.
#[derive(Debug, Clone, Copy)]
enum Purpose {
    Start,
    Disturbance,
    Resampling,
    Kernel,
}

/// A particle filter of one model.
///
/// The filter assumes neither linearity nor a Gaussian shape, but each step costs one integration
/// of the model per particle. Where an extended Kalman filter is adequate, it is hundreds of times
/// cheaper.
///
/// One call of [`ParticleFilter::step`] is one time step. With one thread, a step does not
/// allocate. Results are bit-identical for any number of threads and after a restored checkpoint.
///
/// If no particle has any weight, `step` returns an error. The caller must then call
/// [`ParticleFilter::restart`] or [`ParticleFilter::restart_from`].
#[derive(Debug, Clone)]
pub struct ParticleFilter<M> {
    settings: ParticleSettings,
    start: GaussianStart,
    state: ParticleState,
    workers: Vec<Worker<M>>,
    pool: Option<Arc<rayon::ThreadPool>>,
    /// W (N).
    weights: Vec<f64>,
    mean: DVector<f64>,
    std: DVector<f64>,
    /// Scratch: x (n × N), ancestors, an order of the particles, their cumulative weights (N).
    spare_states: Vec<f64>,
    spare_ancestors: Vec<u32>,
    order: Vec<u32>,
    cumulative: Vec<f64>,
    covariance: DMatrix<f64>,
    root: SquareRoot,
    innovation: Innovation,
}

impl<M: ParticleModel> ParticleFilter<M> {
    /// Creates a filter with particles drawn from `start`.
    ///
    /// # Errors
    /// Returns an error if a setting is out of range or a size does not fit the model.
    pub fn new(
        model: M,
        settings: ParticleSettings,
        start: GaussianStart,
    ) -> Result<Self, FilterError> {
        settings.check()?;
        let (n, p, count) = (model.state_len(), model.input_len(), settings.particles);
        if n == 0 {
            return Err(FilterError::Dimension {
                what: "state of a particle",
                found: 0,
                expected: 1,
            });
        }
        check_start(&start, n, p)?;
        let pool = if settings.threads > 1 {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(settings.threads)
                .build();
            Some(Arc::new(pool.map_err(|error| FilterError::Threads {
                reason: error.to_string(),
            })?))
        } else {
            None
        };
        let worker_channels = model.observation_len();
        let worker = Worker::new(model);
        let mut filter = Self {
            state: ParticleState {
                states: vec![0.0; n * count],
                log_weights: vec![0.0; count],
                ancestors: vec![0; count],
                steps: 0,
                seed: settings.seed,
                fresh: true,
                previous_input: DVector::zeros(p),
                input_mean_square: DVector::zeros(p),
                log_evidence: 0.0,
            },
            workers: vec![worker; settings.threads],
            pool,
            weights: vec![0.0; count],
            mean: DVector::zeros(n),
            std: DVector::zeros(n),
            spare_states: vec![0.0; n * count],
            spare_ancestors: vec![0; count],
            order: vec![0; count],
            cumulative: vec![0.0; count],
            covariance: DMatrix::zeros(n, n),
            root: SquareRoot::new(n),
            innovation: Innovation::new(worker_channels, count),
            settings,
            start,
        };
        filter.restart();
        Ok(filter)
    }

    /// Draws the particles from the start density again, for example after the loss of all
    /// particles.
    pub fn restart(&mut self) {
        let Self {
            settings,
            start,
            state,
            workers,
            root,
            ..
        } = self;
        root.factorise(&start.covariance);
        let n = start.mean.len();
        state.steps = 0;
        state.seed = settings.seed;
        state.log_evidence = 0.0;
        state.input_mean_square.fill(0.0);
        state.fresh = start.previous_input.is_none();
        if let Some(input) = &start.previous_input {
            state.previous_input.copy_from(input);
        }
        for (i, particle) in state.states.chunks_exact_mut(n).enumerate() {
            let worker = &mut workers[0];
            worker.draw_normals(&mut stream(state.seed, 0, i, Purpose::Start));
            particle.copy_from_slice(start.mean.as_slice());
            root.add_draw(1.0, &worker.normals, particle);
            worker.model.confine(particle);
            state.ancestors[i] = i as u32;
        }
        state.log_weights.fill(-(settings.particles as f64).ln());
        self.summarise();
    }

    /// Draws the particles from another start density, for example the estimate of another filter.
    ///
    /// # Errors
    /// Returns an error if a size does not fit the model. The filter is then unchanged.
    pub fn restart_from(&mut self, start: GaussianStart) -> Result<(), FilterError> {
        check_start(&start, self.mean.len(), self.model().input_len())?;
        self.start = start;
        self.restart();
        Ok(())
    }

    /// Processes one frame; its excitation is the measured input of the model.
    ///
    /// # Errors
    /// Returns an error in these cases:
    ///
    /// - The frame does not fit the model. The filter is then unchanged.
    /// - No particle has any weight, or the estimate is not finite. The caller must then restart
    ///   the filter.
    pub fn step(&mut self, frame: Frame<'_>) -> Result<ParticleStep, FilterError> {
        let sizes = [
            (
                "observations of a frame",
                frame.observations.len(),
                self.model().observation_len(),
            ),
            (
                "excitation of a frame",
                frame.excitation.len(),
                self.model().input_len(),
            ),
        ];
        FilterError::check_sizes(sizes)?;
        let resampled = self.coefficient_of_variation() > self.settings.resampling_threshold;
        if resampled {
            self.resample();
        }
        self.innovation.begin(&self.state.log_weights);
        self.advance(frame);
        let (model, mean) = (&mut self.workers[0].model, &self.mean);
        self.innovation.compare(frame.observations, |out| {
            model.sensor_covariance(mean.as_slice(), out)
        });
        let log_evidence = self.normalise()?;
        self.state.log_evidence += log_evidence;
        self.remember_input(frame);
        self.state.steps += 1;
        self.summarise();
        if let Some(index) = self
            .mean
            .iter()
            .zip(&self.std)
            .position(|(m, s)| !(m.is_finite() && s.is_finite()))
        {
            return Err(FilterError::NotFinite {
                what: "mean or variance of state",
                index,
            });
        }
        Ok(ParticleStep {
            log_evidence,
            used_channels: frame
                .observations
                .iter()
                .filter(|value| !value.is_nan())
                .count(),
            normalised_innovation_squared: self.innovation.squared(),
            effective_size: self.effective_size(),
            coefficient_of_variation: self.coefficient_of_variation(),
            resampled,
        })
    }

    /// Returns the model.
    pub fn model(&self) -> &M {
        &self.workers[0].model
    }

    /// Changes the model of every thread in the same way, for example its noise levels.
    pub fn update_model(&mut self, mut change: impl FnMut(&mut M)) {
        for worker in &mut self.workers {
            change(&mut worker.model);
        }
    }

    /// Returns the settings.
    pub fn settings(&self) -> &ParticleSettings {
        &self.settings
    }

    /// Returns the innovation of the last step (q, sensor units).
    ///
    /// It is NaN for missing channels and before the first step.
    pub fn innovation(&self) -> &[f64] {
        self.innovation.values()
    }

    /// Returns `ln p(Ŷ_k)`, the sum over all processed frames.
    pub fn log_evidence(&self) -> f64 {
        self.state.log_evidence
    }

    /// Returns the number of processed frames.
    pub fn steps(&self) -> u64 {
        self.state.steps
    }

    /// Returns the state for a checkpoint.
    pub fn state(&self) -> &ParticleState {
        &self.state
    }

    /// Restores the state of a checkpoint; subsequent steps are bit-identical to an uninterrupted
    /// run.
    ///
    /// # Errors
    /// Returns an error if the state does not fit the model or the settings. The filter is then
    /// unchanged.
    pub fn restore(&mut self, state: ParticleState) -> Result<(), FilterError> {
        let (n, p, count) = (
            self.mean.len(),
            self.model().input_len(),
            self.settings.particles,
        );
        let sizes = [
            ("particles of a checkpoint", state.states.len(), n * count),
            ("weights of a checkpoint", state.log_weights.len(), count),
            ("ancestors of a checkpoint", state.ancestors.len(), count),
            ("input of a checkpoint", state.previous_input.len(), p),
            (
                "mean square of the input of a checkpoint",
                state.input_mean_square.len(),
                p,
            ),
        ];
        FilterError::check_sizes(sizes)?;
        self.state = state;
        self.summarise();
        Ok(())
    }

    /// Moves every particle to the frame, and adds the logarithm of its weight factor.
    fn advance(&mut self, frame: Frame<'_>) {
        let Self {
            settings,
            state,
            workers,
            pool,
            mean,
            innovation,
            ..
        } = self;
        let ParticleState {
            states,
            log_weights,
            steps,
            seed,
            fresh,
            previous_input,
            input_mean_square,
            ..
        } = state;
        let interval = Interval {
            previous: (!*fresh).then_some(previous_input.as_slice()),
            current: frame.excitation,
            mean_square: input_mean_square.as_slice(),
        };
        let (n, share) = (mean.len(), settings.particles.div_ceil(workers.len()));
        let (seed, step, density) = (*seed, *steps + 1, settings.density);
        let q = frame.observations.len();
        let run = |(part, (((worker, states), log_weights), predicted)): Share<'_, M>| {
            let particles = states.chunks_exact_mut(n).zip(log_weights);
            for (i, (particle, log_weight)) in particles.enumerate() {
                if *log_weight > f64::NEG_INFINITY {
                    let mut rng = stream(seed, step, part * share + i, Purpose::Disturbance);
                    let predicted = &mut predicted[i * q..(i + 1) * q];
                    *log_weight += worker.advance(
                        density,
                        interval,
                        frame.observations,
                        &mut rng,
                        particle,
                        predicted,
                    );
                }
            }
        };
        match pool {
            None => workers
                .iter_mut()
                .zip(states.chunks_mut(n * share))
                .zip(log_weights.chunks_mut(share))
                .zip(innovation.predicted.chunks_mut(q.max(1) * share))
                .enumerate()
                .for_each(run),
            Some(pool) => pool.install(|| {
                workers
                    .par_iter_mut()
                    .zip(states.par_chunks_mut(n * share))
                    .zip(log_weights.par_chunks_mut(share))
                    .zip(innovation.predicted.par_chunks_mut(q.max(1) * share))
                    .enumerate()
                    .for_each(run);
            }),
        }
    }

    /// Normalises the weights and returns the logarithm of their sum.
    fn normalise(&mut self) -> Result<f64, FilterError> {
        let log_weights = &mut self.state.log_weights;
        let largest = log_weights
            .iter()
            .fold(f64::NEG_INFINITY, |largest, value| largest.max(*value));
        if !largest.is_finite() {
            return Err(FilterError::Depleted {
                particles: log_weights.len(),
            });
        }
        let sum: f64 = log_weights
            .iter()
            .map(|value| (value - largest).exp())
            .sum();
        let log_sum = largest + sum.ln();
        for value in log_weights {
            *value -= log_sum;
        }
        Ok(log_sum)
    }

    /// Stores the input of this frame for the next step.
    fn remember_input(&mut self, frame: Frame<'_>) {
        let ParticleState {
            fresh,
            previous_input,
            input_mean_square,
            steps,
            ..
        } = &mut self.state;
        let weight = 1.0 / (*steps as f64 + 1.0);
        for (mean_square, value) in input_mean_square.iter_mut().zip(frame.excitation) {
            if !value.is_nan() {
                *mean_square += weight * (value * value - *mean_square);
            }
        }
        previous_input.copy_from_slice(frame.excitation);
        *fresh = false;
    }

    /// Computes the weights, the mean and the standard deviation of the current particles.
    fn summarise(&mut self) {
        let Self {
            state,
            weights,
            mean,
            std,
            ..
        } = self;
        for (weight, value) in weights.iter_mut().zip(&state.log_weights) {
            *weight = value.exp();
        }
        moments::mean_and_std_to(&state.states, weights, mean, std);
    }

    /// Resamples the particles with equal weights, and disperses them with the kernel.
    fn resample(&mut self) {
        let kernel = self.settings.kernel;
        if kernel < 1.0 {
            moments::covariance_to(
                &self.state.states,
                &self.weights,
                &self.mean,
                &mut self.covariance,
            );
            self.root.factorise(&self.covariance);
        }
        let Self {
            settings,
            state,
            workers,
            weights,
            mean,
            spare_states,
            spare_ancestors,
            order,
            cumulative,
            ..
        } = self;
        let step = state.steps + 1;
        let mut rng = stream(state.seed, step, 0, Purpose::Resampling);
        resampling::draw_indices(settings.resampling, weights, &mut rng, cumulative, order);
        let n = mean.len();
        for (i, index) in order.iter().enumerate() {
            let from = *index as usize;
            spare_states[i * n..(i + 1) * n]
                .copy_from_slice(&state.states[from * n..(from + 1) * n]);
            spare_ancestors[i] = state.ancestors[from];
        }
        std::mem::swap(spare_states, &mut state.states);
        std::mem::swap(spare_ancestors, &mut state.ancestors);
        state.log_weights.fill(-(settings.particles as f64).ln());
        if kernel < 1.0 {
            let spread = (1.0 - kernel * kernel).sqrt();
            let worker = &mut workers[0];
            for (i, particle) in state.states.chunks_exact_mut(n).enumerate() {
                worker.draw_normals(&mut stream(state.seed, step, i, Purpose::Kernel));
                for (value, mean) in particle.iter_mut().zip(mean.iter()) {
                    // x ← m + a (x − m) + √(1 − a²) V^{1/2} z
                    *value = mean + kernel * (*value - mean);
                }
                self.root.add_draw(spread, &worker.normals, particle);
                worker.model.confine(particle);
            }
        }
    }
}

/// Returns the random stream of one particle in one step.
///
/// Its position in the sequence of the seed is used by no other draw.
fn stream(seed: u64, step: u64, particle: usize, purpose: Purpose) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream((particle as u64) << 2 | purpose as u64);
    rng.set_word_pos(u128::from(step) << WORDS_PER_STEP_LOG2);
    rng
}

fn check_start(start: &GaussianStart, n: usize, inputs: usize) -> Result<(), FilterError> {
    let sizes = [
        ("mean of the start", start.mean.len(), n),
        (
            "rows of the covariance of the start",
            start.covariance.nrows(),
            n,
        ),
        (
            "columns of the covariance of the start",
            start.covariance.ncols(),
            n,
        ),
        (
            "input before the start",
            start.previous_input.as_ref().map_or(inputs, DVector::len),
            inputs,
        ),
    ];
    FilterError::check_sizes(sizes)?;
    if let Some(index) = start.mean.iter().position(|value| !value.is_finite()) {
        return Err(FilterError::NotFinite {
            what: "mean of the start",
            index,
        });
    }
    if let Some(index) = start.covariance.iter().position(|value| !value.is_finite()) {
        return Err(FilterError::NotFinite {
            what: "entry of the covariance of the start",
            index,
        });
    }
    Ok(())
}
