//! Noise covariances, and the identification of their levels while the filter runs.
//!
//! Notation: Huang & Yuen (2023), chapter 3. `ψ` are the noise parameters, `Σ_ψ` is their
//! covariance and `e` is the innovation. `Σ_z(ψ) = S₀ + Σ_l ψ_l U_l` (3.26) is the covariance of
//! the predicted datum, linear in `ψ`. With `L Lᵀ = Σ_z`, every derivative of the objective `J`
//! (3.28) follows from `V_l = L⁻¹ U_l L⁻ᵀ` and `ẽ = L⁻¹ e`.
//!
//! The rule of Yuen, Liang & Kuok (2013) for the linear filter uses the same objective.

mod half_or_double;
mod objective;
mod training;
mod working;

use crate::error::FilterError;
use crate::fading::FadingFactor;
use half_or_double::{MOST_PARAMETERS, UNCHANGED_STEPS};
use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};

pub(crate) use objective::{ExcitationPath, Objective};

/// Covariance that a noise parameter scales.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum NoiseTarget {
    /// `Σ_f`, the covariance of the excitation samples (N_f × N_f).
    Excitation,
    /// `Σ_n`, the covariance of the measurement noise (N_0 × N_0).
    Sensors,
}

/// One identified noise level `ψ`. The target covariance contains `ψ · pattern`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NoiseParameter {
    /// Name of the level.
    pub name: String,
    /// The covariance that it scales.
    pub target: NoiseTarget,
    /// The symmetric positive semidefinite matrix that the level multiplies (N_f × N_f or N_0 ×
    /// N_0).
    pub pattern: DMatrix<f64>,
    /// Start value, positive.
    pub start: f64,
    /// Standard deviation of the start value, in the same unit.
    pub start_std: f64,
}

/// Covariances of excitation and sensor noise: a known part and the identified levels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NoiseModel {
    /// The known part of `Σ_f` (N_f × N_f, excitation unit²).
    pub excitation: DMatrix<f64>,
    /// The known part of `Σ_n` (N_0 × N_0, sensor unit²).
    pub sensors: DMatrix<f64>,
    /// The identified levels; empty if both covariances are known.
    pub parameters: Vec<NoiseParameter>,
}

impl NoiseModel {
    /// Creates a model of known noise covariances.
    #[must_use]
    pub fn known(excitation: DMatrix<f64>, sensors: DMatrix<f64>) -> Self {
        Self {
            excitation,
            sensors,
            parameters: Vec::new(),
        }
    }

    pub(crate) fn check(
        &self,
        excitation_len: usize,
        observation_len: usize,
    ) -> Result<(), FilterError> {
        check_square(
            "noise covariance of the excitation",
            &self.excitation,
            excitation_len,
        )?;
        check_square(
            "noise covariance of the sensors",
            &self.sensors,
            observation_len,
        )?;
        for parameter in &self.parameters {
            let expected = match parameter.target {
                NoiseTarget::Excitation => excitation_len,
                NoiseTarget::Sensors => observation_len,
            };
            check_square("pattern of a noise parameter", &parameter.pattern, expected)?;
            // A start of zero could never move, because candidates and steps are multiplicative.
            check_positive("start of a noise parameter", parameter.start)?;
            check_positive(
                "standard deviation of a noise parameter",
                parameter.start_std,
            )?;
        }
        Ok(())
    }

    /// Writes the whole target covariance for the noise parameters `psi`.
    pub(crate) fn covariance_to(
        &self,
        target: NoiseTarget,
        psi: &DVector<f64>,
        out: &mut DMatrix<f64>,
    ) {
        out.copy_from(match target {
            NoiseTarget::Excitation => &self.excitation,
            NoiseTarget::Sensors => &self.sensors,
        });
        for (parameter, level) in self.parameters.iter().zip(psi.iter()) {
            if parameter.target == target {
                for (entry, pattern) in out.iter_mut().zip(parameter.pattern.iter()) {
                    *entry += level * pattern;
                }
            }
        }
    }
}

fn check_square(
    what: &'static str,
    matrix: &DMatrix<f64>,
    expected: usize,
) -> Result<(), FilterError> {
    let lengths = [matrix.nrows(), matrix.ncols()];
    FilterError::check_sizes(lengths.map(|found| (what, found, expected)))
}

fn check_positive(what: &'static str, found: f64) -> Result<(), FilterError> {
    if found > 0.0 && found.is_finite() {
        Ok(())
    } else {
        Err(FilterError::Setting {
            what,
            found,
            allowed: "positive",
        })
    }
}

/// Rule that updates the noise parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseRule {
    /// The parameters stay at their start values.
    Fixed,
    /// One Newton-like step per sample with the observed Hessian, (3.33) to (3.38).
    Published,
    /// One scoring step per sample in the logarithm of the parameters, with the expected
    /// information.
    ///
    /// The observed Hessian gains false information from a single large innovation, because its
    /// likelihood part grows with `e²`. Its gain then freezes, and the filter diverges under bursts
    /// of shaking. The expected information does not depend on the innovation.
    Fisher,
    /// Two stages as in Yuen, Liang & Kuok (2013).
    ///
    /// In training, the rule halves, keeps or doubles each parameter until the parameters settle.
    /// It then makes one Newton step per sample with the observed Hessian.
    ///
    /// The rule represents the published method. It therefore has no floor, no return to training
    /// and no limit of the training. Choose start values that are rather too large than too small,
    /// with a third of the start value as its standard deviation. The rule accepts at most five
    /// parameters.
    HalfOrDouble,
}

/// Settings for the identification of the noise parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NoiseSettings {
    /// Update rule.
    pub rule: NoiseRule,
    /// Fading factor of the noise parameters, at least 1.
    pub fading: f64,
    /// Minimum number of training steps.
    ///
    /// It is INT(10 T/Δt), (3.31), or one period T/Δt under [`NoiseRule::HalfOrDouble`].
    pub training_steps: u64,
    /// Number of steps after which training can end without ten unchanged estimates; 0 for no
    /// limit.
    ///
    /// Even then, every level must have a relative standard deviation below 10 %. Under
    /// [`NoiseRule::Fisher`], innovations that agree with their covariance suffice instead. Under
    /// [`NoiseRule::HalfOrDouble`], the limit does not end training and only reports that training
    /// is overdue.
    pub training_limit_steps: u64,
    /// `N_τ`, the number of candidates of the local search, including the incumbent.
    pub candidates: usize,
    /// `σ_τ`, the relative step of the local search.
    pub relative_step: f64,
    /// Lower limit of each noise parameter, as a share of its start value.
    ///
    /// If the model explains a motion only in part, a level learnt in a quiet hour gives the first
    /// seconds of shaking far too much weight.
    pub floor: f64,
    /// Largest factor by which one working step can raise or lower a noise parameter under
    /// [`NoiseRule::HalfOrDouble`].
    ///
    /// It must be above 1; infinite disables the limit. The source has no such guard. Without it, a
    /// short half-life or a bad start makes a parameter negative.
    pub positivity_guard: f64,
    /// Seed of the local search.
    pub seed: u64,
}

impl NoiseSettings {
    pub(crate) fn check(&self, parameters: usize) -> Result<(), FilterError> {
        FadingFactor::new(self.fading)?;
        if self.positivity_guard <= 1.0 || self.positivity_guard.is_nan() {
            let what = "positivity guard of the noise parameters";
            return Err(FilterError::Setting {
                what,
                found: self.positivity_guard,
                allowed: "above 1",
            });
        }
        if self.rule == NoiseRule::HalfOrDouble && parameters > MOST_PARAMETERS {
            let what = "number of noise parameters under the rule half-or-double";
            return Err(FilterError::Setting {
                what,
                found: parameters as f64,
                allowed: "at most 5",
            });
        }
        Ok(())
    }
}

impl Default for NoiseSettings {
    fn default() -> Self {
        Self {
            rule: NoiseRule::Fisher,
            fading: 2f64.powf(1.0 / 1000.0),
            training_steps: 0,
            training_limit_steps: 0,
            candidates: 20,
            relative_step: 1.0 / 256.0,
            floor: 1e-14,
            positivity_guard: 2.0,
            seed: 0,
        }
    }
}

/// Phase of the identification of the noise parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum NoisePhase {
    /// The training of the rule: the local search of (3.30) to (3.32), or half-or-double.
    Training,
    /// One update step per sample.
    Working,
}

/// Changes of the noise identification at one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NoiseEvents {
    /// `true` if training ended at this step.
    pub training_ended: bool,
    /// `true` if training reached its limit at this step without ending.
    pub training_overdue: bool,
    /// `true` if training restarted, because the innovations had disagreed with their covariance
    /// for too long.
    pub training_restarted: bool,
}

/// Estimates of the noise parameters, with the state that later steps require.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NoiseState {
    /// `ψ` (N_ψ).
    pub mean: DVector<f64>,
    /// `Σ_ψ` (N_ψ × N_ψ).
    pub covariance: DMatrix<f64>,
    /// Current phase of the identification.
    pub phase: NoisePhase,
    /// Number of training steps at which the Hessian was not positive definite and `Σ_ψ` remained
    /// unchanged.
    pub fallbacks: u64,
    /// Number of such steps in the working phase, where they should not occur.
    pub working_fallbacks: u64,
    /// Number of steps of the working phase that were shortened.
    pub limited: u64,
    training_step: u64,
    unchanged: u32,
    floored: bool,
    misfit: Misfit,
    rng: ChaCha8Rng,
}

/// Monitors whether the innovations agree with their covariance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
struct Misfit {
    /// Running mean of the normalised innovation squared per channel; 1 if the covariance is right.
    mean: f64,
    /// Number of consecutive steps with the mean outside [`MISFIT_RANGE`].
    steps: u64,
}

/// Range of the mean normalised innovation squared per channel that random variation can explain.
const MISFIT_RANGE: (f64, f64) = (0.1, 10.0);

/// Range of the same mean in which training can end under [`NoiseRule::Fisher`].
const SETTLED_RANGE: (f64, f64) = (0.5, 2.0);

/// Relative standard deviation that every noise parameter must fall below before training can end.
const TRAINED_RELATIVE_STD: f64 = 0.10;

/// Window of the misfit in training, and its minimum in the working phase, in steps.
const LEAST_WINDOW_STEPS: u64 = 100;

impl NoiseState {
    pub(crate) fn start(model: &NoiseModel, settings: &NoiseSettings) -> Self {
        let count = model.parameters.len();
        let mut state = Self {
            mean: DVector::from_fn(count, |l, _| model.parameters[l].start),
            covariance: DMatrix::zeros(count, count),
            phase: NoisePhase::Training,
            fallbacks: 0,
            working_fallbacks: 0,
            limited: 0,
            training_step: 0,
            unchanged: 0,
            floored: false,
            misfit: Misfit {
                mean: 1.0,
                steps: 0,
            },
            rng: ChaCha8Rng::seed_from_u64(settings.seed),
        };
        for (l, parameter) in model.parameters.iter().enumerate() {
            state.covariance[(l, l)] = parameter.start_std * parameter.start_std;
        }
        if settings.rule == NoiseRule::Fixed || count == 0 {
            state.phase = NoisePhase::Working;
        }
        state
    }

    /// Returns the largest relative standard deviation of the noise parameters.
    ///
    /// It is infinite if a variance is not positive.
    #[must_use]
    pub fn largest_relative_std(&self) -> f64 {
        (0..self.mean.len())
            .map(|l| {
                let variance = self.covariance[(l, l)];
                if variance > 0.0 {
                    variance.sqrt() / self.mean[l]
                } else {
                    f64::INFINITY
                }
            })
            .fold(0.0, f64::max)
    }

    /// Processes one frame: updates `ψ` and `Σ_ψ`, and switches between the phases.
    pub(crate) fn update(
        &mut self,
        model: &NoiseModel,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) -> NoiseEvents {
        let mut events = NoiseEvents::default();
        if settings.rule == NoiseRule::Fixed || self.mean.is_empty() {
            return events;
        }
        if objective.used_channels() == 0 {
            if settings.rule == NoiseRule::HalfOrDouble {
                self.covariance *= settings.fading; // information also fades without a datum
            }
            return events;
        }
        match self.phase {
            NoisePhase::Training => {
                match settings.rule {
                    NoiseRule::HalfOrDouble => self.halve_or_double(settings, objective),
                    NoiseRule::Published | NoiseRule::Fisher | NoiseRule::Fixed => {
                        self.search(model, settings, objective);
                    }
                }
                self.training_step += 1;
                self.watch_misfit(LEAST_WINDOW_STEPS, objective);
                if self.training_is_over(settings) {
                    self.phase = NoisePhase::Working;
                    self.misfit = Misfit {
                        mean: 1.0,
                        steps: 0,
                    };
                    events.training_ended = true;
                } else {
                    let limit = settings.training_limit_steps;
                    events.training_overdue = limit > 0 && self.training_step == limit;
                }
            }
            NoisePhase::Working => {
                match settings.rule {
                    NoiseRule::Published => self.newton_step(model, settings, objective),
                    NoiseRule::Fisher => self.scoring_step(model, settings, objective),
                    NoiseRule::HalfOrDouble => {
                        self.guarded_newton_step(settings, objective);
                        return events; // the published method has no return to training
                    }
                    NoiseRule::Fixed => {}
                }
                if self.innovations_keep_disagreeing(settings, objective) {
                    self.restart_training(model);
                    events.training_restarted = true;
                }
            }
        }
        events
    }

    fn training_is_over(&self, settings: &NoiseSettings) -> bool {
        let settled = match settings.rule {
            NoiseRule::HalfOrDouble => {
                return self.training_step >= settings.training_steps
                    && self.unchanged >= UNCHANGED_STEPS;
            }
            // The scoring step is right from any start near the level. A wait for ten losing draws
            // in succession can last indefinitely with one parameter and few channels.
            NoiseRule::Fisher => self.innovations_agree(),
            NoiseRule::Published | NoiseRule::Fixed => self.unchanged >= UNCHANGED_STEPS,
        };
        let waited = self.training_step >= settings.training_steps.max(1) && settled;
        let limit = settings.training_limit_steps;
        let late = limit > 0 && self.training_step >= limit;
        // Only a positive definite matrix ever replaces Σ_ψ, so its diagonal is sufficient here.
        let known = self.largest_relative_std() < TRAINED_RELATIVE_STD;
        // A level on which the data contain little information, such as that of an unmeasured
        // excitation, never becomes that certain. The scoring step handles this case. A longer wait
        // would only delay decisions about alerts.
        let settled_late = settings.rule == NoiseRule::Fisher && late && settled;
        (waited || late) && known || settled_late
    }

    fn innovations_keep_disagreeing(
        &mut self,
        settings: &NoiseSettings,
        objective: &mut Objective,
    ) -> bool {
        let window = settings.training_steps.max(LEAST_WINDOW_STEPS);
        self.watch_misfit(window, objective);
        let (low, high) = MISFIT_RANGE;
        let too_small = self.misfit.mean < low && !self.floored;
        if too_small || self.misfit.mean > high {
            self.misfit.steps += 1;
        } else {
            self.misfit.steps = 0;
        }
        self.misfit.steps > window
    }

    /// Counts a step at which `Σ_ψ` remained unchanged because no update was possible.
    fn fall_back(&mut self) {
        match self.phase {
            NoisePhase::Training => self.fallbacks += 1,
            NoisePhase::Working => self.working_fallbacks += 1,
        }
    }

    fn innovations_agree(&self) -> bool {
        let large_enough = self.misfit.mean > SETTLED_RANGE.0 || self.floored;
        large_enough && self.misfit.mean < SETTLED_RANGE.1
    }

    /// Raises every level to at least its floor and records whether all levels are at their floor.
    ///
    /// If they are, small innovations are not a misfit.
    fn apply_floor(
        &mut self,
        psi: &mut DVector<f64>,
        model: &NoiseModel,
        settings: &NoiseSettings,
    ) {
        self.floored = true;
        for (level, parameter) in psi.iter_mut().zip(&model.parameters) {
            let floor = settings.floor * parameter.start;
            self.floored &= *level <= floor;
            *level = level.max(floor);
        }
    }

    fn watch_misfit(&mut self, window: u64, objective: &mut Objective) {
        let normalised = objective.normalised_innovation_squared(&self.mean);
        let per_channel = normalised / objective.used_channels() as f64;
        if per_channel.is_finite() {
            self.misfit.mean += (per_channel - self.misfit.mean) / window as f64;
        }
    }

    fn restart_training(&mut self, model: &NoiseModel) {
        self.phase = NoisePhase::Training;
        self.training_step = 0;
        self.unchanged = 0;
        self.misfit = Misfit {
            mean: 1.0,
            steps: 0,
        };
        self.forget_levels(model);
    }

    /// Gives the levels the relative uncertainty of the start, so that they can move fast.
    pub(crate) fn forget_levels(&mut self, model: &NoiseModel) {
        self.covariance.fill(0.0);
        for (l, parameter) in model.parameters.iter().enumerate() {
            let std = self.mean[l] * parameter.start_std / parameter.start;
            self.covariance[(l, l)] = std * std;
        }
    }
}

#[cfg(test)]
mod tests;
