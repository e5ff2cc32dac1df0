//! Converts the settings of the structure file to the settings of the filter.

use crate::filter_plan::OutlierPlan;
use crate::noise_level::NoiseSource;
use crate::structure::Structure;
use nalgebra::{DMatrix, DVector};
use spandrel_filter::outlier::upper_bound;
use spandrel_filter::{
    Annealing, FadingFactor, FilterError, FilterSettings, MisfitSettings, NoiseModel,
    NoiseParameter, NoiseRule, NoiseSettings, NoiseTarget, OutlierSettings, OutlierTraining,
};
use std::ops::RangeInclusive;

/// Minimum training of the noise levels in fundamental periods: Huang & Yuen (2023), (3.31).
const TRAINING_PERIODS: f64 = 10.0;

/// Minimum training with the rule half-or-double in fundamental periods: Yuen, Liang & Kuok (2013).
const HALF_OR_DOUBLE_PERIODS: f64 = 1.0;

/// Maximum training as a multiple of the minimum training.
///
/// With one level and few channels, the source's own rule may never end the training.
const TRAINING_LIMIT: u64 = 4;

/// Maximum length over which scores are summed, in memories of the filter.
///
/// Longer sums follow the estimate itself.
const LONGEST_BLOCK: f64 = 0.7;

/// Time constant of the misfit, in memories of the filter.
///
/// It covers several tens of independent sums at the default half-life.
const MISFIT_MEMORY: f64 = 8.0;

/// Standard deviations at which a sum of scores counts as a jump.
///
/// A structure with ten parameters has about 10⁸ independent sums a year at 1 Hz, half of them
/// almost quiet. White sums reach 5 standard deviations sixty times in 10⁸. A false jump widens the
/// intervals for some periods and causes no other harm.
const JUMP_THRESHOLD: f64 = 5.0;

/// Number of fundamental periods for which the filter follows a jump.
const JUMP_PERIODS: f64 = 4.0;

impl Structure {
    /// Returns the settings of the filter for [`Structure::model`].
    ///
    /// # Errors
    /// Returns an error if a half-life is too short to have a fading factor.
    pub fn filter_settings(&self) -> Result<FilterSettings, FilterError> {
        let (plan, free) = (&self.plan, self.system.len());
        let of_parameters = |value: &dyn Fn(&crate::Parameter) -> f64| -> Vec<f64> {
            self.parameters.iter().map(value).collect()
        };
        let state = |physical: [f64; 2], parameters: Vec<f64>| {
            let [x, v] = physical.map(|value| std::iter::repeat_n(value, free));
            DVector::from_iterator(2 * free + parameters.len(), x.chain(v).chain(parameters))
        };
        let fading =
            |half_life_s: f64| FadingFactor::from_half_life(half_life_s * self.sampling_rate_hz);
        let mut mean = state([0.0, 0.0], of_parameters(&|p| p.mean()));
        mean.rows_mut(0, 2 * free)
            .copy_from(&self.static_state(&of_parameters(&|p| p.mean())));
        let std = state(
            [plan.displacement_std_m, plan.velocity_std_m_per_s],
            of_parameters(&|p| p.std()),
        );
        let mut settings = FilterSettings::new(self.step_s(), mean, std, self.noise_model());
        settings.fading = self.fading()?;
        settings.variance_bound = state(
            [f64::INFINITY; 2],
            of_parameters(&|p| plan.variance_bound * p.std().powi(2)),
        );
        settings.lower = state([f64::NEG_INFINITY; 2], of_parameters(&|p| p.bounds().0));
        settings.upper = state([f64::INFINITY; 2], of_parameters(&|p| p.bounds().1));
        settings.noise_settings = NoiseSettings {
            rule: plan.noise_rule,
            fading: fading(plan.noise_half_life_s)?.value(),
            training_steps: self.training_steps(),
            training_limit_steps: TRAINING_LIMIT * self.training_steps(),
            // A level is a variance. A level of zero would never change.
            floor: self
                .plan
                .noise_floor
                .powi(2)
                .max(NoiseSettings::default().floor),
            ..NoiseSettings::default()
        };
        settings.annealing = (plan.annealing.amount > 0.0).then_some(Annealing {
            amount: plan.annealing.amount,
            time_constant_s: plan.annealing.time_s,
        });
        settings.input_hold = plan.input_hold;
        settings.misfit = self.misfit_settings(settings.fading);
        for (considered, error) in settings
            .considered_std
            .iter_mut()
            .skip(2 * free)
            .zip(self.errors_by_unmeasured_excitation())
        {
            *considered = error;
        }
        settings.outliers = plan
            .outliers
            .map(|outliers| self.outlier_settings(&outliers));
        settings.sensors = self.sensors();
        Ok(settings)
    }

    /// Returns the number of the sensor of each observation: the channels of a node can fail
    /// together.
    ///
    /// If one node measures everything, each channel is a sensor, because nothing else could then
    /// confirm that the structure has changed.
    fn sensors(&self) -> Vec<usize> {
        let nodes = self.nodes.iter().enumerate();
        let of_channels: Vec<usize> = nodes
            .flat_map(|(position, node)| node.channels().iter().map(move |_| position))
            .collect();
        let measuring = self
            .observation_channels
            .iter()
            .map(|channel| of_channels[*channel]);
        let mut nodes: Vec<usize> = measuring.clone().collect();
        nodes.dedup(); // in the order of the nodes
        match nodes.len() {
            1 => (0..self.observation_channels.len()).collect(),
            _ => measuring
                .map(|node| nodes.iter().take_while(|other| **other != node).count())
                .collect(),
        }
    }

    /// Returns the fading factor of the state.
    ///
    /// # Errors
    /// Returns an error if the half-life is too short to have a fading factor.
    pub(crate) fn fading(&self) -> Result<FadingFactor, FilterError> {
        // Without parameters, information about the motion needs no forgetting: it decays with the
        // motion.
        if self.parameters.is_empty() {
            return Ok(FadingFactor::NONE);
        }
        FadingFactor::from_half_life(self.plan.half_life_s * self.sampling_rate_hz)
    }

    /// Returns the settings of the misfit, which sums scores over three lengths.
    ///
    /// The lengths range from half a fundamental period to a share of the memory of the filter. The
    /// result is `None` if the filter forgets nothing, because then it identifies no parameter.
    fn misfit_settings(&self, fading: FadingFactor) -> Option<MisfitSettings> {
        let period_steps = self.fundamental_period_s() * self.sampling_rate_hz;
        let memory_steps = fading.memory_steps();
        memory_steps.is_finite().then(|| MisfitSettings {
            block_steps: [
                0.5 * period_steps,
                2.0 * period_steps,
                (LONGEST_BLOCK * memory_steps).max(2.0 * period_steps),
            ],
            memory_steps: MISFIT_MEMORY * memory_steps,
            start_steps: (TRAINING_PERIODS * period_steps) as u64,
            jump_threshold: JUMP_THRESHOLD,
            jump_steps: (JUMP_PERIODS * period_steps) as u64,
            lag_steps: (period_steps as usize).max(1),
            excitation_is_measured: self
                .excitations
                .iter()
                .all(|excitation| excitation.channel().is_some()),
        })
    }

    /// Converts seconds to samples. Missing settings follow from the fundamental period as
    /// designed.
    fn outlier_settings(&self, plan: &OutlierPlan) -> OutlierSettings {
        let steps = |seconds: f64| (seconds * self.sampling_rate_hz).round() as usize;
        let at_most = |count: usize, range: RangeInclusive<usize>| count.min(*range.end());
        let mut settings =
            OutlierSettings::for_period(self.fundamental_period_s() * self.sampling_rate_hz);
        // For a structure that hardly moves, a hundred periods would not fit into memory.
        settings.window = at_most(settings.window, OutlierPlan::WINDOW);
        settings.upper = upper_bound(settings.window);
        settings.training_steps = at_most(settings.training_steps, OutlierPlan::RESIDUALS);
        settings.fault_window = at_most(settings.fault_window, OutlierPlan::RESIDUALS);
        if !plan.gated {
            settings.training = OutlierTraining::Raw;
        }
        if let Some(training_s) = plan.training_s {
            settings.training_steps = steps(training_s);
        }
        if let Some(window_s) = plan.window_s {
            settings.window = steps(window_s);
            settings.upper = upper_bound(settings.window);
        }
        if let Some(fault_window_s) = plan.fault_window_s {
            settings.fault_window = steps(fault_window_s);
        }
        settings.fault_share = plan.fault_share;
        settings
    }

    /// Returns `INT(10 T/Δt)`, (3.31), with the fundamental period `T` as designed; one `T` for
    /// half-or-double.
    fn training_steps(&self) -> u64 {
        let periods = match self.plan.noise_rule {
            NoiseRule::HalfOrDouble => HALF_OR_DOUBLE_PERIODS,
            NoiseRule::Fisher | NoiseRule::Published | NoiseRule::Fixed => TRAINING_PERIODS,
        };
        (periods * self.fundamental_period_s() * self.sampling_rate_hz) as u64
    }

    /// Returns the prior standard deviation of the logarithm of the variance of a noise level (from
    /// 0).
    ///
    /// If the standard deviation is known to a factor `F`, the result is `2 ln F`. The published
    /// rules start an unmeasured level like any other, unless the file specifies a factor.
    pub(crate) fn level_prior_std(&self, level: usize) -> f64 {
        let published = matches!(
            self.plan.noise_rule,
            NoiseRule::Published | NoiseRule::HalfOrDouble
        );
        match self.noise_levels[level].source() {
            NoiseSource::Excitation(index) if self.is_unmeasured(level) => {
                let excitation = &self.excitations[*index];
                if published && excitation.level_factor.is_none() {
                    return self.plan.noise_prior_std;
                }
                2.0 * excitation.level_factor().ln()
            }
            NoiseSource::Excitation(_) | NoiseSource::Sensors(_) => self.plan.noise_prior_std,
        }
    }

    /// Returns the noise levels, separated into known and adapted variances.
    fn noise_model(&self) -> NoiseModel {
        let (inputs, rows) = (
            self.excitation_channels.len(),
            self.observation_channels.len(),
        );
        let mut model =
            NoiseModel::known(DMatrix::zeros(inputs, inputs), DMatrix::zeros(rows, rows));
        for (index, level) in self.noise_levels.iter().enumerate() {
            let variance = level.std.powi(2);
            let (target, pattern) = match &level.source {
                NoiseSource::Excitation(excitation) => (
                    NoiseTarget::Excitation,
                    self.excitation_pattern(*excitation),
                ),
                NoiseSource::Sensors(rows_of_group) => {
                    let mut pattern = DMatrix::zeros(rows, rows);
                    rows_of_group
                        .iter()
                        .for_each(|row| pattern[(*row, *row)] = 1.0);
                    (NoiseTarget::Sensors, pattern)
                }
            };
            if level.adapted {
                model.parameters.push(NoiseParameter {
                    name: level.name.clone(),
                    target,
                    pattern,
                    start: variance,
                    start_std: self.level_prior_std(index) * variance,
                });
            } else {
                match target {
                    NoiseTarget::Excitation => model.excitation += pattern * variance,
                    NoiseTarget::Sensors => model.sensors += pattern * variance,
                }
            }
        }
        model
    }
}
