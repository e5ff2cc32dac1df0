//! Larger structures whose filters must keep up with the sensors.
//!
//! They are examples of the book, with the size and sampling rate that a monitored structure
//! requires.

use nalgebra::DMatrix;
use spandrel_filter::{
    ClassBank, ClassPlan, ClassSettings, ExtendedKalmanFilter, FilterError, Frame, Grouping,
    ObservationModel, ProcessModel,
};
use spandrel_structure::{Structure, StructureModel};
use std::error::Error;
use std::path::Path;

/// A structure with its samples.
#[derive(Debug, Clone)]
pub struct Monitored {
    /// Name of the structure.
    pub name: &'static str,
    /// The structure from its structure file.
    pub structure: Structure,
    /// Observations and known excitation of each frame.
    pub frames: Vec<(Vec<f64>, Vec<f64>)>,
}

impl Monitored {
    fn new(name: &'static str, structure: Structure, frames: usize) -> Self {
        let frames = structure.simulator(1).take(frames).map(|frame| {
            let observations = structure
                .observation_channels()
                .iter()
                .map(|c| frame.values[*c])
                .collect();
            let known = structure
                .excitation_channels()
                .iter()
                .map(|c| c.map_or(0.0, |c| frame.values[c]))
                .collect();
            (observations, known)
        });
        Self {
            name,
            frames: frames.collect(),
            structure,
        }
    }

    /// Creates the three-pier bridge with `frames` simulated frames of twelve channels at 400
    /// frames per second. It has 127 states.
    ///
    /// # Errors
    /// Returns an error if the structure file is not valid.
    pub fn bridge(frames: usize) -> Result<Self, Box<dyn Error>> {
        let (mut text, path) = example("three-pier-bridge")?;
        text = text.replace("sampling-rate-hz = 250", "sampling-rate-hz = 400");
        text += "\n[[node]]\nname = \"more\"\n";
        for dof in ["node-3-y", "node-7-y", "node-11-y", "node-15-y"] {
            text += &format!(
                "\n[[node.channel]]\nname = \"{dof}\"\nquantity = \"absolute-acceleration\"\n\
                 dof = \"{dof}\"\nunit = \"m/s2\"\n\
                 noise-std = 0.05\n"
            );
        }
        Ok(Self::new(
            "three-pier bridge",
            Structure::parse(&text, &path)?,
            frames,
        ))
    }

    /// Creates the tower with `frames` simulated frames at 50 frames per second. It has 372 states
    /// and modes in the kilohertz range.
    ///
    /// # Errors
    /// Returns an error if the structure file is not valid.
    pub fn tower(frames: usize) -> Result<Self, Box<dyn Error>> {
        let (text, path) = example("tower")?;
        let text = text.replace("sampling-rate-hz = 500", "sampling-rate-hz = 50");
        Ok(Self::new("tower", Structure::parse(&text, &path)?, frames))
    }

    /// Creates the dome of 42 bars with `frames` simulated frames at 500 frames per second. Its
    /// bars are the components that [`Self::bank`] requires.
    ///
    /// # Errors
    /// Returns an error if the structure file is not valid.
    pub fn dome(frames: usize) -> Result<Self, Box<dyn Error>> {
        let (text, path) = example("dome-bars")?;
        Ok(Self::new(
            "dome, eight classes",
            Structure::parse(&text, &path)?,
            frames,
        ))
    }

    /// Creates the filter of the structure.
    ///
    /// # Errors
    /// Returns an error if the filter settings of the structure are not valid.
    pub fn filter(&self) -> Result<ExtendedKalmanFilter<StructureModel>, FilterError> {
        ExtendedKalmanFilter::new(self.structure.model(), self.structure.filter_settings()?)
    }

    /// Creates a bank of eight filters for a structure whose parameters are components. Each filter
    /// separates one component.
    ///
    /// # Errors
    /// Returns an error if the structure has fewer than eight components.
    pub fn bank(&self) -> Result<ClassBank<spandrel_structure::StructureClasses>, FilterError> {
        use spandrel_filter::ComponentSystem;
        let system = self.structure.class_system();
        let components = system.components().len();
        let classes: Result<Vec<_>, _> = (0..8)
            .map(|apart| Grouping::apart(vec![apart], components))
            .collect();
        let settings = ClassSettings::published(ClassPlan::Predefined { classes: classes? }, 100);
        ClassBank::new(system, self.structure.filter_settings()?, settings)
    }

    /// Returns a frame in the form that a filter expects. After the last frame, the frames repeat
    /// from the first.
    #[must_use]
    pub fn frame(&self, index: usize) -> Frame<'_> {
        let (observations, excitation) = &self.frames[index % self.frames.len()];
        Frame {
            observations,
            excitation,
        }
    }
}

fn example(name: &str) -> Result<(String, std::path::PathBuf), Box<dyn Error>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .with_extension("toml");
    Ok((std::fs::read_to_string(&path)?, path))
}

/// A linear system over one step: `y ← F y + w`, `z = H y + n`.
///
/// `y` is the state (n entries), `z` the observation (N_0 channels), `w` the process noise and `n`
/// the measurement noise.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearStep {
    /// State transition matrix `F` of one step (n × n, n = number of states).
    pub transition: DMatrix<f64>,
    /// Covariance of the process noise `w` over one step (n × n, n = number of states).
    pub process_noise: DMatrix<f64>,
    /// Observation matrix `H` (N_0 × n, N_0 = number of channels, n = number of states).
    pub observation: DMatrix<f64>,
}

impl LinearStep {
    /// Discretises a structure without parameters over `step_s` (s). Each white excitation has
    /// variance `level`.
    #[must_use]
    pub fn new(structure: &Structure, step_s: f64, level: f64) -> Self {
        let mut model = structure.model();
        let (n, inputs) = (model.state_len(), model.excitation_len());
        let at_rest = vec![0.0; inputs];
        model.linearise_process(&vec![0.0; n], &at_rest);
        model.linearise_observation(&vec![0.0; n], &at_rest);
        let (mut jacobian, mut input) = (DMatrix::zeros(n, n), DMatrix::zeros(n, inputs));
        model.jacobian_mul(&DMatrix::identity(n, n), &mut jacobian);
        model.excitation_matrix(&mut input);
        let mut augmented = DMatrix::zeros(n + inputs, n + inputs);
        augmented.view_mut((0, 0), (n, n)).copy_from(&jacobian);
        augmented.view_mut((0, n), (n, inputs)).copy_from(&input);
        let exponential = (augmented * step_s).exp();
        let input = exponential.view((0, n), (n, inputs));
        let mut observation = DMatrix::zeros(model.observation_len(), n);
        model.observation_jacobian_mul(&DMatrix::identity(n, n), &mut observation);
        Self {
            transition: exponential.view((0, 0), (n, n)).into_owned(),
            process_noise: level * input * input.transpose(),
            observation,
        }
    }
}
