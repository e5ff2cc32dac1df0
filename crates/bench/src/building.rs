//! The shear building that every filter of the comparison follows, at any height.

use nalgebra::DMatrix;
use spandrel_filter::{
    ExtendedKalmanFilter, FilterError, FilterSettings, Frame, NoiseModel, NoiseTarget,
};
use spandrel_structure::{Structure, StructureModel};
use std::error::Error;
use std::path::Path;

/// Mass of a floor (kg) and stiffness of a storey (N/m): the fastest mode turns by 0.8 rad a step.
pub const MASS_KG: f64 = 1.0;
/// See [`MASS_KG`].
pub const STIFFNESS_N_PER_M: f64 = 1600.0;
/// Rayleigh damping (1/s).
pub const ALPHA_PER_S: f64 = 0.05;
/// Rayleigh damping (s).
pub const BETA_S: f64 = 0.002;
/// Frames per second.
pub const RATE_HZ: f64 = 100.0;
/// Standard deviation of one sample of the ground motion that nobody measures (m/s²).
pub const GROUND_STD: f64 = 0.5;
/// Standard deviation of one sample of a sensor (m/s²).
pub const SENSOR_STD: f64 = 0.02;

/// A building with its samples: n = 3N + 2 states, N/5 accelerometers, one ground motion.
#[derive(Debug, Clone)]
pub struct Building {
    /// `N`.
    pub storeys: usize,
    /// The structure, as its file says.
    pub structure: Structure,
    /// Fading memory, and the noise of the sensors identified.
    pub settings: FilterSettings,
    /// Samples of the accelerometers, frame by frame (m/s²).
    pub frames: Vec<Vec<f64>>,
}

impl Building {
    /// Makes a building of `storeys` storeys, at least five, and simulates `frames` frames.
    ///
    /// # Errors
    /// When the structure file is not valid, or its filter.
    pub fn new(storeys: usize, frames: usize) -> Result<Self, Box<dyn Error>> {
        Self::parse(storeys, frames, &(text(storeys) + &parameters(storeys)))
    }

    /// Makes the same building with nothing to identify: 2N states, a linear filter.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn linear(storeys: usize, frames: usize) -> Result<Self, Box<dyn Error>> {
        Self::parse(storeys, frames, &text(storeys))
    }

    fn parse(storeys: usize, frames: usize, text: &str) -> Result<Self, Box<dyn Error>> {
        let structure = Structure::parse(text, Path::new("shear-building.toml"))?;
        let mut settings = structure.filter_settings()?;
        // what is measured is a filter at work, not the few minutes before
        settings.noise_settings.training_steps = 50;
        settings.noise_settings.training_limit_steps = 100;
        let frames = structure
            .simulator(1)
            .take(frames)
            .map(|frame| frame.values)
            .collect();
        Ok(Self {
            storeys,
            structure,
            settings,
            frames,
        })
    }

    /// Returns the degrees of freedom that are sensed (from 0).
    pub fn sensed(&self) -> impl Iterator<Item = usize> {
        sensed(self.storeys)
    }

    /// Makes the filter of Spandrel, with the noise of the sensors identified.
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn filter(&self) -> Result<ExtendedKalmanFilter<StructureModel>, FilterError> {
        ExtendedKalmanFilter::new(self.structure.model(), self.settings.clone())
    }

    /// Makes the same filter with all noises known and without start-up aid or limits: what the peers do.
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn plain_filter(&self) -> Result<ExtendedKalmanFilter<StructureModel>, FilterError> {
        ExtendedKalmanFilter::new(self.structure.model(), self.plain_settings())
    }

    /// Returns the settings of [`Self::plain_filter`].
    #[must_use]
    pub fn plain_settings(&self) -> FilterSettings {
        let (step_s, mean, std) = (
            self.settings.step_s,
            self.settings.prior_mean.clone(),
            self.settings.prior_std.clone(),
        );
        let mut settings = FilterSettings::new(step_s, mean, std, known(&self.settings.noise));
        settings.fading = self.settings.fading;
        settings
    }
}

/// Takes one step with samples of the accelerometers; the ground motion is not known.
///
/// # Errors
/// When the filter has diverged.
pub fn step(
    filter: &mut ExtendedKalmanFilter<StructureModel>,
    samples: &[f64],
) -> Result<(), FilterError> {
    filter
        .step(Frame {
            observations: samples,
            excitation: &[0.0],
        })
        .map(|_| ())
}

/// Returns the noises at the levels from which they would be identified.
fn known(noise: &NoiseModel) -> NoiseModel {
    let mut known = NoiseModel::known(noise.excitation.clone(), noise.sensors.clone());
    for parameter in &noise.parameters {
        let target: &mut DMatrix<f64> = match parameter.target {
            NoiseTarget::Excitation => &mut known.excitation,
            NoiseTarget::Sensors => &mut known.sensors,
        };
        *target += parameter.start * &parameter.pattern;
    }
    known
}

fn sensed(storeys: usize) -> impl Iterator<Item = usize> {
    (4..storeys).step_by(5)
}

/// Returns the parameters of the structure file: every storey, and the damping.
fn parameters(storeys: usize) -> String {
    let storey = |storey| {
        format!(
            "[[parameter]]\nname = \"storey-{storey}\"\nscales = \"stiffness\"\nof = [\"storey-{storey}\"]\nstd = 0.1\n"
        )
    };
    let damping = |name| {
        format!("[[parameter]]\nname = \"{name}\"\nscales = \"damping-{name}\"\nstd = 0.1\n")
    };
    (1..=storeys)
        .map(storey)
        .chain(["alpha", "beta"].map(damping))
        .collect()
}

/// Returns the structure file but for its parameters.
fn text(storeys: usize) -> String {
    let mut text = format!(
        r#"
        [structure]
        name = "shear-building"
        sampling-rate-hz = {RATE_HZ}
        [model]
        kind = "shear-building"
        storeys = {storeys}
        mass-kg = {MASS_KG}
        stiffness-n-per-m = {STIFFNESS_N_PER_M}
        [damping]
        kind = "rayleigh"
        alpha-per-s = {ALPHA_PER_S}
        beta-s = {BETA_S}
        [filter]
        half-life-s = 10
        [[excitation]]
        name = "ground"
        kind = "ground"
        std = {GROUND_STD}
        "#
    );
    text.push_str("[[node]]\nname = \"node\"\n");
    text.extend(sensed(storeys).map(|dof| {
        let floor = dof + 1;
        format!(
            "[[node.channel]]\nname = \"floor-{floor}\"\nquantity = \"absolute-acceleration\"\ndof = \"floor-{floor}\"\n\
             unit = \"m/s2\"\nnoise-std = {SENSOR_STD}\nnoise-group = \"floors\"\nadapt-noise = true\n"
        )
    }));
    text
}
