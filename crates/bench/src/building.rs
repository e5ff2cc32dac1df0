//! The shear building of the comparison, with any number of storeys.

use nalgebra::DMatrix;
use spandrel_filter::{
    ExtendedKalmanFilter, FilterError, FilterSettings, Frame, NoiseModel, NoiseTarget,
};
use spandrel_structure::{Structure, StructureModel};
use std::error::Error;
use std::path::Path;

/// Mass of a floor (kg).
///
/// With [`STIFFNESS_N_PER_M`], the phase of the fastest mode advances by 0.8 rad per step.
pub const MASS_KG: f64 = 1.0;
/// Stiffness of a storey (N/m). See [`MASS_KG`].
pub const STIFFNESS_N_PER_M: f64 = 1600.0;
/// Mass-proportional Rayleigh coefficient (1/s).
pub const ALPHA_PER_S: f64 = 0.05;
/// Stiffness-proportional Rayleigh coefficient (s).
pub const BETA_S: f64 = 0.002;
/// Number of frames per second.
pub const RATE_HZ: f64 = 100.0;
/// Standard deviation of one sample of the unmeasured ground motion (m/s²).
pub const GROUND_STD: f64 = 0.5;
/// Standard deviation of the noise of one sensor sample (m/s²).
pub const SENSOR_STD: f64 = 0.02;

/// A building with its samples. It has n = 3N + 2 states, N/5 accelerometers and one ground motion.
#[derive(Debug, Clone)]
pub struct Building {
    /// Number of storeys, `N`.
    pub storeys: usize,
    /// The structure from its structure file.
    pub structure: Structure,
    /// Filter settings with fading memory, which identify the sensor noise.
    pub settings: FilterSettings,
    /// Samples of the accelerometers for each frame (m/s²).
    pub frames: Vec<Vec<f64>>,
}

impl Building {
    /// Creates a building of `storeys` storeys, at least five, and simulates `frames` frames.
    ///
    /// # Errors
    /// Returns an error if the structure file or the settings of its filter are not valid.
    pub fn new(storeys: usize, frames: usize) -> Result<Self, Box<dyn Error>> {
        Self::parse(storeys, frames, &(text(storeys) + &parameters(storeys)))
    }

    /// Creates the same building without parameters to identify, which has 2N states and a linear
    /// filter.
    ///
    /// # Errors
    /// Returns the same errors as [`Self::new`].
    pub fn linear(storeys: usize, frames: usize) -> Result<Self, Box<dyn Error>> {
        Self::parse(storeys, frames, &text(storeys))
    }

    fn parse(storeys: usize, frames: usize, text: &str) -> Result<Self, Box<dyn Error>> {
        let structure = Structure::parse(text, Path::new("shear-building.toml"))?;
        let mut settings = structure.filter_settings()?;
        // A short training, because the benchmark measures a filter after its training.
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

    /// Returns the degrees of freedom with a sensor, counted from 0.
    pub fn sensed(&self) -> impl Iterator<Item = usize> {
        sensed(self.storeys)
    }

    /// Creates Spandrel's filter, which identifies the sensor noise.
    ///
    /// # Errors
    /// Returns an error if the settings do not fit the model.
    pub fn filter(&self) -> Result<ExtendedKalmanFilter<StructureModel>, FilterError> {
        ExtendedKalmanFilter::new(self.structure.model(), self.settings.clone())
    }

    /// Creates the same filter with all noise levels known, without start-up aid and limits. The
    /// filters in Python work like this.
    ///
    /// # Errors
    /// Returns an error if the settings do not fit the model.
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

/// Takes one step with samples of the accelerometers. The ground motion is unknown.
///
/// # Errors
/// Returns an error if the filter has diverged.
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

/// Returns the noise model with its start levels as known levels.
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

/// Returns the parameters in the structure file: every storey and both damping coefficients.
fn parameters(storeys: usize) -> String {
    let storey = |storey| {
        format!(
            "[[parameter]]\nname = \"storey-{storey}\"\nscales = \"stiffness\"\n\
             of = [\"storey-{storey}\"]\nstd = 0.1\n"
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

/// Returns the structure file without its parameters.
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
            "[[node.channel]]\nname = \"floor-{floor}\"\nquantity = \"absolute-acceleration\"\n\
             dof = \"floor-{floor}\"\n\
             unit = \"m/s2\"\nnoise-std = {SENSOR_STD}\nnoise-group = \"floors\"\n\
             adapt-noise = true\n"
        )
    }));
    text
}
