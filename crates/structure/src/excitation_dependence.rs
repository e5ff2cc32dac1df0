//! Dependence of each parameter on the stated properties of unmeasured excitations.
//!
//! The filter assumes that such an excitation is white and has the stated or adapted level. A real
//! excitation differs: each octave of its spectrum is off by a separate factor. To first order, an
//! error `δ` of the logarithms of the spectrum moves the estimates by `F⁻¹ I_δ δ`
//! (`spectral_information`). `F` is the information on parameters and adapted levels.

use crate::noise_level::NoiseSource;
use crate::spectral_information::{Direction, SpectralModel};
use crate::structure::Structure;
use nalgebra::DMatrix;
use spandrel_filter::FadingFactor;
use std::f64::consts::PI;

/// Standard deviation of the logarithm of the variance in one octave.
///
/// It corresponds to a factor of two in the motion, up or down. Ground motion on rock differs from
/// white noise by about this factor, and on soil by more.
const COLOUR: f64 = 2.0 * std::f64::consts::LN_2;

/// Ratio of the first natural frequency to the start of the first separate octave.
const BELOW_FIRST: f64 = 4.0;

/// Maximum error of a usable parameter, as a share of the loss in its alert rule.
///
/// If a realistic excitation colour shifts the parameter by more, the parameter cannot indicate
/// that loss.
const SPOILING: f64 = 0.5;

impl Structure {
    /// Returns the standard deviation of the error of each parameter due to unmeasured excitations.
    ///
    /// The errors (ratios to nominal, in state order) come from the level and the colour of these
    /// excitations. An error is 0 if every excitation is measured, or known by `level-factor = 1`.
    /// A level that is not adapted is uncertain by its `level-factor`. An adapted level takes its
    /// information from the parameters. The colour is uncertain by an independent factor of two in
    /// each octave.
    ///
    /// The error does not decrease with more data of the same kind. Add its square to the variance
    /// that a filter reports. The result is linearised at the prior means, and empty if it is not
    /// finite.
    #[must_use]
    pub fn errors_by_unmeasured_excitation(&self) -> Vec<f64> {
        self.excitation_errors
            .get_or_init(|| self.compute_excitation_errors().unwrap_or_default())
            .clone()
    }

    /// Returns for each parameter, in state order, whether unmeasured excitations make it unusable.
    ///
    /// A parameter is unusable if the level and colour of these excitations may shift it by half of
    /// the loss in its alert rule.
    #[must_use]
    pub fn parameters_spoilt_by_unmeasured_excitation(&self) -> Vec<bool> {
        let errors = self.errors_by_unmeasured_excitation();
        let pairs = self.parameters.iter().zip(&errors);
        let mut spoilt: Vec<bool> = pairs
            .map(|(parameter, error)| self.spoils(parameter, *error))
            .collect();
        spoilt.resize(self.parameters.len(), true); // no finite result, so not trustworthy
        spoilt
    }

    /// Returns `true` if an error (ratio to nominal) exceeds half of the loss in the parameter's
    /// alert rule.
    pub(crate) fn spoils(&self, parameter: &crate::Parameter, error: f64) -> bool {
        let index = self
            .parameters
            .iter()
            .position(|own| own.name == parameter.name);
        index.is_some_and(|index| error > SPOILING * self.loss_of_interest(index))
    }

    fn compute_excitation_errors(&self) -> Option<Vec<f64>> {
        let theta = self.parameters.len();
        let unmeasured: Vec<usize> = (0..self.noise_levels.len())
            .filter(|level| self.is_unknown(*level))
            .collect();
        if unmeasured.is_empty() {
            return Some(vec![0.0; theta]);
        }
        let adapted =
            (0..self.noise_levels.len()).filter(|level| self.noise_levels[*level].adapted);
        let mut directions: Vec<Direction> = (0..theta).map(Direction::Parameter).collect();
        directions.extend(adapted.map(Direction::Level));
        let estimated = directions.len();
        let mut deviations = Vec::new();
        for level in unmeasured {
            if !self.noise_levels[level].adapted {
                directions.push(Direction::Level(level));
                deviations.push(self.level_prior_std(level));
            }
            for octave in 0..self.octaves() {
                directions.push(Direction::Colour { level, octave });
                deviations.push(COLOUR);
            }
        }
        let model = SpectralModel::new(self, &self.prior_means(), &self.expected_variances());
        let information = model.sums(None, &directions)?.information;
        let mut own = information
            .view((0, 0), (estimated, estimated))
            .into_owned();
        let memory_frames = self.memory_frames()?;
        for (index, parameter) in self.parameters.iter().enumerate() {
            own[(index, index)] += 1.0 / (memory_frames * parameter.std().powi(2));
        }
        let mut errors = information
            .view((0, estimated), (estimated, deviations.len()))
            .into_owned();
        for (mut column, deviation) in errors.column_iter_mut().zip(&deviations) {
            column *= *deviation;
        }
        let shifts: DMatrix<f64> = own.cholesky()?.solve(&errors);
        Some(
            (0..theta)
                .map(|parameter| shifts.row(parameter).norm())
                .collect(),
        )
    }

    /// Returns `true` if a noise level (from 0) belongs to an unmeasured excitation.
    pub(crate) fn is_unmeasured(&self, level: usize) -> bool {
        match self.noise_levels[level].source() {
            NoiseSource::Excitation(index) => self.excitations[*index].channel().is_none(),
            NoiseSource::Sensors(_) => false,
        }
    }

    /// Returns `true` if the file leaves the level and colour of an unmeasured excitation open.
    pub(crate) fn is_unknown(&self, level: usize) -> bool {
        match self.noise_levels[level].source() {
            NoiseSource::Excitation(index) => self.excitations[*index].level_factor() > 1.0,
            NoiseSource::Sensors(_) => false,
        }
    }

    /// Returns the expected variance of each noise level.
    pub(crate) fn expected_variances(&self) -> Vec<f64> {
        (0..self.noise_levels.len())
            .map(|level| self.expected_level_std(level).powi(2))
            .collect()
    }

    /// Returns the memory of the filter (frames), `1/(λ − 1)`; infinite if the filter forgets
    /// nothing.
    pub(crate) fn memory_frames(&self) -> Option<f64> {
        let fading = self.fading().ok()?;
        Some(if fading == FadingFactor::NONE {
            f64::INFINITY
        } else {
            1.0 / (fading.value() - 1.0)
        })
    }

    /// Returns the lowest frequency (rad/s) with a separate octave.
    fn lowest_octave(&self) -> f64 {
        2.0 * PI / (BELOW_FIRST * self.fundamental_period_s().max(2.0 * self.step_s()))
    }

    /// Returns the number of octaves. The centre of the last one is above half the sampling rate.
    fn octaves(&self) -> usize {
        2 + (PI / self.step_s() / self.lowest_octave()).log2().floor() as usize
    }

    /// Returns the weight of an octave (from 0) at a frequency (rad/s).
    ///
    /// The weight is 1 at the frequency of the octave and falls to 0 at its neighbours.
    pub(crate) fn octave_share(&self, octave: usize, omega: f64) -> f64 {
        let place = (omega / self.lowest_octave())
            .log2()
            .clamp(0.0, (self.octaves() - 1) as f64);
        (1.0 - (place - octave as f64).abs()).max(0.0)
    }
}
