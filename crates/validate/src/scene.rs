//! The structure of an example with its simulated record and its filter.

use crate::error::ValidateError;
use crate::network::Network;
use crate::outcome::{Plot, Series, SeriesKind};
use crate::run::Run;
use crate::statistics::{Accuracy, Mean, Normal, rms};
use spandrel_filter::{
    ClassBank, ClassSettings, ExtendedKalmanFilter, FilterSettings, Frame, Step,
};
use spandrel_structure::{Structure, StructureClasses, StructureModel};
use std::path::Path;

/// Number of frames between two checks whether the run should continue.
const LOOK_EVERY: usize = 1000;

/// A record with the true values behind it.
pub(crate) struct Scene {
    pub(crate) structure: Structure,
    pub(crate) step_s: f64,
    pub(crate) frames: usize,
    /// Standard deviation of the noise of each observation channel, a share of its clean rms.
    pub(crate) noise_std: Vec<f64>,
    /// Clean samples (frames × observation channels).
    clean: Vec<f64>,
    data: Vec<f64>,
    /// Watched states (frames × watched states).
    states: Vec<f64>,
    watched: Vec<usize>,
    /// Excitation (frames × excitation components), 0 for unmeasured components.
    excitation: Vec<f64>,
    /// Standard deviation of the noise of each excitation component, 0 for unmeasured components.
    excitation_noise_std: Vec<f64>,
}

/// Parameters for making a scene from a structure file.
pub(crate) struct Plan<'p> {
    /// Text of the file.
    pub(crate) text: &'p str,
    /// Length (s).
    pub(crate) seconds: f64,
    /// Noise of each channel as a share of its clean rms.
    pub(crate) noise_share: f64,
    /// Indices of the states whose truth is stored: displacements first, then velocities.
    pub(crate) watched: &'p dyn Fn(&Structure) -> Vec<usize>,
}

/// Returns the state indices of the displacements (or velocities) of the named degrees of freedom.
pub(crate) fn states_of(structure: &Structure, names: &[&str], velocities: bool) -> Vec<usize> {
    let all = structure.degrees_of_freedom();
    let shift = if velocities { all.len() } else { 0 };
    names
        .iter()
        .filter_map(|name| all.iter().position(|known| known == name))
        .map(|at| at + shift)
        .collect()
}

impl Scene {
    /// Simulates the structure without noise, then adds noise in proportion to the rms of each
    /// channel.
    pub(crate) fn simulate(plan: &Plan<'_>, run: &Run<'_>) -> Result<Self, ValidateError> {
        Self::simulate_seeded(plan, run.seed, run)
    }

    /// Simulates as [`Scene::simulate`] does, with another seed than the run's.
    pub(crate) fn simulate_seeded(
        plan: &Plan<'_>,
        seed: u64,
        run: &Run<'_>,
    ) -> Result<Self, ValidateError> {
        let structure = Structure::parse(plan.text, Path::new("example.toml"))?;
        let step_s = structure.step_s();
        let frames = (plan.seconds / step_s).round() as usize;
        let rows = structure.observation_channels().to_vec();
        let watched = (plan.watched)(&structure);
        let (mut clean, mut states) = (Vec::with_capacity(frames * rows.len()), Vec::new());
        let inputs = structure.excitation_channels().to_vec();
        let mut excitation = Vec::with_capacity(frames * inputs.len());
        let mut simulator = structure.clean_simulator(seed);
        for frame in 0..frames {
            states.extend(watched.iter().map(|state| simulator.state()[*state]));
            let Some(values) = simulator.next() else {
                break;
            };
            clean.extend(rows.iter().map(|row| values.values[*row]));
            excitation.extend(
                inputs
                    .iter()
                    .map(|input| input.map_or(0.0, |channel| values.values[channel])),
            );
            if frame % LOOK_EVERY == 0 && !run.advance(0.0) {
                return Err(ValidateError::Stopped);
            }
        }
        let channels = rows.len();
        let noise_std: Vec<f64> = (0..channels)
            .map(|c| plan.noise_share * rms(clean.iter().skip(c).step_by(channels).copied()))
            .collect();
        let mut noise = Normal::stream(seed, 7);
        let data = clean
            .iter()
            .enumerate()
            .map(|(i, value)| value + noise_std[i % channels] * noise.draw())
            .collect();
        let excitation_noise_std: Vec<f64> = (0..inputs.len())
            .map(|j| {
                plan.noise_share * rms(excitation.iter().skip(j).step_by(inputs.len()).copied())
            })
            .collect();
        for (i, value) in excitation.iter_mut().enumerate() {
            let std = excitation_noise_std[i % inputs.len()];
            if std > 0.0 {
                *value += std * noise.draw();
            }
        }
        Ok(Self {
            structure,
            step_s,
            frames,
            noise_std,
            clean,
            data,
            states,
            watched,
            excitation,
            excitation_noise_std,
        })
    }

    /// Returns the settings of the file with the true sensor noise.
    pub(crate) fn settings(&self) -> Result<FilterSettings, ValidateError> {
        let mut settings = self
            .structure
            .filter_settings()
            .map_err(ValidateError::setting)?;
        settings.misfit = None; // the published method
        settings.noise.sensors.fill(0.0);
        for (channel, std) in self.noise_std.iter().enumerate() {
            settings.noise.sensors[(channel, channel)] = std * std;
        }
        for (input, std) in self
            .excitation_noise_std
            .iter()
            .enumerate()
            .filter(|(_, std)| **std > 0.0)
        {
            settings.noise.excitation[(input, input)] = std * std;
        }
        Ok(settings)
    }

    /// Returns the nodes of the structure, with `data` as the samples by frame and channel.
    pub(crate) fn network<'s>(&'s self, data: &'s dyn Fn(usize, usize) -> f64) -> Network<'s> {
        Network {
            structure: &self.structure,
            frames: self.frames,
            noise_std: &self.noise_std,
            data,
        }
    }

    /// Returns the measured excitation at a frame, 0 for unmeasured components.
    pub(crate) fn excitation(&self, frame: usize) -> &[f64] {
        let inputs = self.excitation_noise_std.len();
        &self.excitation[frame * inputs..(frame + 1) * inputs]
    }

    /// Runs the model classes over the data, while the progress of the case rises between the two
    /// given shares.
    ///
    /// `look` receives the bank after each frame.
    pub(crate) fn compare(
        &self,
        settings: FilterSettings,
        classes: ClassSettings,
        shares: (f64, f64),
        run: &Run<'_>,
        mut look: impl FnMut(usize, &ClassBank<StructureClasses>),
    ) -> Result<(), ValidateError> {
        let mut bank = ClassBank::new(self.structure.class_system(), settings, classes)
            .map_err(ValidateError::setting)?;
        for frame in 0..self.frames {
            bank.step(Frame {
                observations: self.data(frame),
                excitation: self.excitation(frame),
            })
            .map_err(ValidateError::at(self.time_s(frame)))?;
            look(frame, &bank);
            let done = frame as f64 / self.frames as f64;
            if frame % LOOK_EVERY == 0 && !run.advance(shares.0 + (shares.1 - shares.0) * done) {
                return Err(ValidateError::Stopped);
            }
        }
        Ok(())
    }

    /// Returns the time of a frame (s).
    pub(crate) fn time_s(&self, frame: usize) -> f64 {
        frame as f64 * self.step_s
    }

    pub(crate) fn clean(&self, frame: usize) -> &[f64] {
        let channels = self.noise_std.len();
        &self.clean[frame * channels..(frame + 1) * channels]
    }

    pub(crate) fn data(&self, frame: usize) -> &[f64] {
        let channels = self.noise_std.len();
        &self.data[frame * channels..(frame + 1) * channels]
    }

    /// Returns the true values of the watched states at a frame.
    pub(crate) fn states(&self, frame: usize) -> &[f64] {
        &self.states[frame * self.watched.len()..(frame + 1) * self.watched.len()]
    }

    pub(crate) fn watched(&self) -> &[usize] {
        &self.watched
    }

    /// Runs a filter over `data`, while the progress of the case rises between the two given
    /// shares.
    ///
    /// `look` receives the filter after each frame.
    pub(crate) fn filter<'d>(
        &self,
        settings: FilterSettings,
        data: impl Fn(usize) -> &'d [f64],
        shares: (f64, f64),
        run: &Run<'_>,
        look: impl FnMut(usize, &ExtendedKalmanFilter<StructureModel>, &Step),
    ) -> Result<(), ValidateError> {
        self.filter_for(self.frames, settings, data, shares, run, look)
    }

    /// Runs a filter as [`Scene::filter`] does, over a limited number of first frames.
    pub(crate) fn filter_for<'d>(
        &self,
        frames: usize,
        settings: FilterSettings,
        data: impl Fn(usize) -> &'d [f64],
        shares: (f64, f64),
        run: &Run<'_>,
        mut look: impl FnMut(usize, &ExtendedKalmanFilter<StructureModel>, &Step),
    ) -> Result<(), ValidateError> {
        let mut filter = ExtendedKalmanFilter::new(self.structure.model(), settings)
            .map_err(ValidateError::setting)?;
        for frame in 0..frames {
            let step = filter
                .step(Frame {
                    observations: data(frame),
                    excitation: self.excitation(frame),
                })
                .map_err(ValidateError::at(self.time_s(frame)))?;
            look(frame, &filter, &step);
            let done = frame as f64 / frames as f64;
            if frame % LOOK_EVERY == 0 && !run.advance(shares.0 + (shares.1 - shares.0) * done) {
                return Err(ValidateError::Stopped);
            }
        }
        Ok(())
    }
}

/// Estimates of one parameter over time.
#[derive(Debug, Clone, Default)]
pub(crate) struct Course {
    /// Time, mean, deviation and truth, sampled at regular intervals.
    pub(crate) points: Vec<[f64; 4]>,
}

impl Course {
    pub(crate) fn take(&mut self, time_s: f64, mean: f64, variance: f64, truth: f64) {
        self.points
            .push([time_s, mean, variance.max(0.0).sqrt(), truth]);
    }

    /// Returns the mean of the estimate over a window (s).
    pub(crate) fn mean(&self, from_s: f64, to_s: f64) -> f64 {
        self.over(from_s, to_s, |point| point[1])
    }

    /// Returns the mean of the stated deviation over a window (s).
    pub(crate) fn std(&self, from_s: f64, to_s: f64) -> f64 {
        self.over(from_s, to_s, |point| point[2])
    }

    /// Returns the mean absolute error over a window (s).
    pub(crate) fn error(&self, from_s: f64, to_s: f64) -> f64 {
        self.over(from_s, to_s, |point| (point[1] - point[3]).abs())
    }

    fn over(&self, from_s: f64, to_s: f64, of: impl Fn(&[f64; 4]) -> f64) -> f64 {
        let mut mean = Mean::default();
        self.points
            .iter()
            .filter(|point| (from_s..to_s).contains(&point[0]))
            .for_each(|point| mean.take(of(point)));
        mean.value()
    }

    /// Returns the accuracy from a time (s) on.
    pub(crate) fn accuracy(&self, from_s: f64) -> Accuracy {
        let mut accuracy = Accuracy::default();
        for [_, mean, std, truth] in self.points.iter().filter(|point| point[0] >= from_s) {
            accuracy.take(*mean, *std, *truth);
        }
        accuracy
    }

    /// Returns the time (s) from `jump_s` until the estimate has first covered this share of the
    /// way between two values.
    pub(crate) fn delay(&self, jump_s: f64, from: f64, to: f64, share: f64) -> f64 {
        let gone =
            |point: &&[f64; 4]| point[0] >= jump_s && (point[1] - from) / (to - from) >= share;
        self.points
            .iter()
            .find(gone)
            .map_or(f64::NAN, |point| point[0] - jump_s)
    }

    /// Plots the truth, the estimate and its interval of three deviations.
    pub(crate) fn plot(&self, title: &str, unit: &str, range: (f32, f32)) -> Plot {
        let every = (self.points.len() / 1200).max(1);
        let curve = |of: &dyn Fn(&[f64; 4]) -> f64| {
            self.points
                .iter()
                .step_by(every)
                .map(|point| (point[0] as f32, of(point) as f32))
                .collect()
        };
        let series = vec![
            Series::new(
                "99.7 %",
                SeriesKind::Bound,
                curve(&|[_, mean, std, _]| mean - 3.0 * std),
            ),
            Series::new(
                "",
                SeriesKind::Bound,
                curve(&|[_, mean, std, _]| mean + 3.0 * std),
            ),
            Series::new("true", SeriesKind::Truth, curve(&|point| point[3])),
            Series::new("estimated", SeriesKind::Estimate, curve(&|point| point[1])),
        ];
        Plot::over_time(title, unit, series).within(range.0, range.1)
    }
}
