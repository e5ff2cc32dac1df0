//! How much each parameter rests on what the file says of an excitation that nobody measures.
//!
//! The filter takes such an excitation as white, and its level as stated or as found. A real one is neither: each octave of
//! its spectrum is off by a factor of its own. To first order an error `δ` of the logarithms of the spectrum moves the
//! estimates by `F⁻¹ I_δ δ` (`spectral_information`), with `F` the information on parameters and adapted levels.

use crate::noise_level::NoiseSource;
use crate::spectral_information::{Direction, SpectralModel};
use crate::structure::Structure;
use nalgebra::DMatrix;
use spandrel_filter::FadingFactor;
use std::f64::consts::PI;

/// Deviation of the logarithm of the variance in one octave: a factor of two in the motion, up or down. Ground motion on
/// soil differs from white noise by more, on rock by about that.
const COLOUR: f64 = 2.0 * std::f64::consts::LN_2;

/// The spectrum is told apart in octaves from so far below the first natural frequency.
const BELOW_FIRST: f64 = 4.0;

/// A parameter that an excitation as coloured as real ones shifts by more than this share of the loss that its alert rule
/// looks for is no witness of that loss.
const SPOILING: f64 = 0.5;

impl Structure {
    /// Returns the standard deviation (ratio to nominal) of the error of each parameter that comes from the level and the
    /// colour of unmeasured excitations; in state order.
    ///
    /// 0 where every excitation is measured, or known by `level-factor = 1`. A level that is not adapted is uncertain by its
    /// `level-factor`; one that is adapted takes its information from the parameters. The colour is uncertain by a factor of
    /// two in each octave, on its own. The error does not fall with more data of the same kind: add its square to the variance
    /// that a filter reports. Linearised at the prior means; empty where the structure has no finite answer.
    #[must_use]
    pub fn errors_by_unmeasured_excitation(&self) -> Vec<f64> {
        self.excitation_errors().unwrap_or_default()
    }

    /// Returns for each parameter, in state order, whether its estimate rests on the level and the colour of an excitation
    /// that nobody measures: whether they may shift it by half of the loss that its alert rule looks for.
    #[must_use]
    pub fn parameters_spoilt_by_unmeasured_excitation(&self) -> Vec<bool> {
        let errors = self.errors_by_unmeasured_excitation();
        let pairs = self.parameters.iter().zip(&errors);
        let mut spoilt: Vec<bool> = pairs
            .map(|(parameter, error)| self.spoils(parameter, *error))
            .collect();
        spoilt.resize(self.parameters.len(), true); // what has no answer is not to be trusted
        spoilt
    }

    /// Tells whether an error (ratio to nominal) is of the size of the loss that the alert rule of a parameter looks for.
    pub(crate) fn spoils(&self, parameter: &crate::Parameter, error: f64) -> bool {
        let index = self
            .parameters
            .iter()
            .position(|own| own.name == parameter.name);
        index.is_some_and(|index| error > SPOILING * self.displayed_loss(index).0)
    }

    fn excitation_errors(&self) -> Option<Vec<f64>> {
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

    /// Tells whether a noise level (from 0) is that of an excitation that nobody measures.
    pub(crate) fn is_unmeasured(&self, level: usize) -> bool {
        match self.noise_levels[level].source() {
            NoiseSource::Excitation(index) => self.excitations[*index].channel().is_none(),
            NoiseSource::Sensors(_) => false,
        }
    }

    /// Tells whether the file leaves open what an unmeasured excitation is.
    pub(crate) fn is_unknown(&self, level: usize) -> bool {
        match self.noise_levels[level].source() {
            NoiseSource::Excitation(index) => self.excitations[*index].level_factor() > 1.0,
            NoiseSource::Sensors(_) => false,
        }
    }

    /// Returns the variance that each noise level is expected to have.
    pub(crate) fn expected_variances(&self) -> Vec<f64> {
        (0..self.noise_levels.len())
            .map(|level| self.expected_level_std(level).powi(2))
            .collect()
    }

    /// Returns the frames that the memory of the filter amounts to, `1/(λ − 1)`; without limit where nothing is forgotten.
    pub(crate) fn memory_frames(&self) -> Option<f64> {
        let fading = self.fading().ok()?;
        Some(if fading == FadingFactor::NONE {
            f64::INFINITY
        } else {
            1.0 / (fading.value() - 1.0)
        })
    }

    /// Returns the lowest frequency (rad/s) that has an octave of its own.
    fn lowest_octave(&self) -> f64 {
        2.0 * PI / (BELOW_FIRST * self.fundamental_period_s().max(2.0 * self.step_s()))
    }

    /// Returns the number of octaves, the last of which ends at half the sampling rate.
    fn octaves(&self) -> usize {
        2 + (PI / self.step_s() / self.lowest_octave()).log2().floor() as usize
    }

    /// Returns what an octave (from 0) counts at a frequency (rad/s): 1 at its own, falling to 0 at its neighbours'.
    pub(crate) fn octave_share(&self, octave: usize, omega: f64) -> f64 {
        let place = (omega / self.lowest_octave())
            .log2()
            .clamp(0.0, (self.octaves() - 1) as f64);
        (1.0 - (place - octave as f64).abs()).max(0.0)
    }
}
