//! Simulates the response of a structure with damage, excitation and sensor faults.
//!
//! For a linear structure, the recursion is exact for an excitation that is constant or linear over
//! a step. A change of a parameter creates a new recursion. Hysteretic springs are integrated in
//! substeps. Between two frames, the parameters of the older frame apply. The seed determines
//! every random value.

mod motion;

use crate::excitation::Action;
use crate::noise_level::NoiseSource;
use crate::simulation_plan::{SimulationPlan, SpikeKind, Spikes};
use crate::structure::Structure;
use motion::{Amplitude, Motion};
use nalgebra::{DMatrix, DVector};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::StandardNormal;

/// One simulated frame.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedFrame {
    /// Index of the frame, from 0. Its time is the index times [`Structure::step_s`].
    pub index: u64,
    /// One value per channel in frame order (SI); NaN for a missing sample.
    pub values: Vec<f64>,
}

/// Quantity that a channel shows.
#[derive(Debug, Clone, Copy)]
enum Source {
    /// An observation row.
    Response(usize),
    /// A component of the excitation.
    Excitation(usize),
}

/// Generation of the samples of one channel.
#[derive(Debug, Clone, Copy)]
struct SimulatedChannel {
    source: Source,
    noise_std: f64,
    /// Number of frames per sample of the node.
    every: u64,
    /// Index of its node in the file.
    node: usize,
}

/// Generation of the samples of one excitation.
#[derive(Debug, Clone)]
enum Shaking {
    /// One component with this standard deviation.
    Single { std: f64 },
    /// Components that are drawn together: `m + σ L w` with white `w`.
    Field {
        mean: DVector<f64>,
        factor: DMatrix<f64>,
        white: DVector<f64>,
        std: f64,
    },
}

/// An endless simulation of a structure, frame by frame.
///
/// The structure starts at rest, or in equilibrium with the mean forces.
#[derive(Debug, Clone)]
pub struct Simulator {
    motion: Motion,
    plan: SimulationPlan,
    undamaged: Vec<f64>,
    step_s: f64,
    shaking: Vec<Shaking>,
    channels: Vec<SimulatedChannel>,
    theta: Vec<f64>,
    /// `f` and the next `f` (N_f), `z` (N_0).
    excitation: DVector<f64>,
    next_excitation: DVector<f64>,
    response: DVector<f64>,
    index: u64,
    excitation_random: ChaCha8Rng,
    noise_random: ChaCha8Rng,
    fault_random: ChaCha8Rng,
}

impl Structure {
    /// Creates a simulation of the structure that depends only on the file and `seed`.
    #[must_use]
    pub fn simulator(&self, seed: u64) -> Simulator {
        Simulator::new(
            self,
            self.simulation.clone(),
            vec![1.0; self.parameters.len()],
            Amplitude::Any,
            seed,
        )
    }

    /// Creates a simulation of the same motion without missing samples and without noise.
    #[must_use]
    pub fn clean_simulator(&self, seed: u64) -> Simulator {
        let mut plan = self.simulation.clone();
        (plan.dropped_share, plan.spikes.share) = (0.0, 0.0);
        plan.faults.clear();
        let mut simulator = Simulator::new(
            self,
            plan,
            vec![1.0; self.parameters.len()],
            Amplitude::Any,
            seed,
        );
        for channel in &mut simulator.channels {
            (channel.noise_std, channel.every) = (0.0, 1);
        }
        simulator
    }

    /// Creates a simulation of the structure at its prior means, with white noise only.
    ///
    /// It has no mean forces and treats hysteretic springs as linear, as for small motions. A
    /// slower node measures at each frame, with a proportionally larger variance
    /// ([`Structure::frames_per_sample`]). Both contain the same information if the motion is
    /// slower than the samples of the node.
    pub(crate) fn undamaged_simulator(&self, seed: u64) -> Simulator {
        let plan = SimulationPlan::uneventful(self.nodes.len());
        let means = self.parameters.iter().map(crate::Parameter::mean).collect();
        let mut simulator = Simulator::new(self, plan, means, Amplitude::Small, seed);
        for channel in &mut simulator.channels {
            channel.noise_std *= (channel.every as f64).sqrt();
            channel.every = 1;
        }
        simulator
    }

    /// Returns the true parameters (ratios to nominal) of the simulation at a frame.
    #[must_use]
    pub fn true_parameters(&self, index: u64) -> Vec<f64> {
        true_parameters(
            &self.simulation,
            &vec![1.0; self.parameters.len()],
            index as f64 * self.step_s(),
        )
    }
}

fn true_parameters(plan: &SimulationPlan, undamaged: &[f64], time_s: f64) -> Vec<f64> {
    let mut theta = undamaged.to_vec();
    for damage in &plan.damage {
        theta[damage.parameter] -= damage.lost(time_s);
    }
    theta
}

impl Simulator {
    fn new(
        structure: &Structure,
        plan: SimulationPlan,
        undamaged: Vec<f64>,
        amplitude: Amplitude,
        seed: u64,
    ) -> Self {
        let theta = true_parameters(&plan, &undamaged, 0.0);
        let step_s = structure.step_s();
        let inputs = structure.excitation_channels.len();
        let motion = Motion::new(structure, &theta, amplitude);
        // Separate streams, so that a dropped sample changes neither the motion nor the noise.
        let random = |stream| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(stream);
            random
        };
        let mut simulator = Self {
            motion,
            response: DVector::zeros(structure.observation_channels.len()),
            undamaged,
            step_s,
            shaking: shaking(structure, amplitude),
            channels: simulated_channels(structure),
            plan,
            theta,
            excitation: DVector::zeros(inputs),
            next_excitation: DVector::zeros(inputs),
            index: 0,
            excitation_random: random(0),
            noise_random: random(1),
            fault_random: random(2),
        };
        simulator.draw_excitation(0);
        simulator
    }

    /// Returns the true state (displacements and velocities relative to the ground, m and m/s) at
    /// the next frame.
    ///
    /// For hysteretic springs, hysteretic displacements replace the displacements.
    #[must_use]
    pub fn state(&self) -> &[f64] {
        self.motion.state()
    }

    /// Draws the excitation of frame `index` into `next_excitation`.
    fn draw_excitation(&mut self, index: u64) {
        let time_s = index as f64 * self.step_s;
        let amplitude = self
            .plan
            .modulation
            .map_or(1.0, |modulation| modulation.amplitude(time_s));
        let mut first = 0;
        for shaking in &mut self.shaking {
            match shaking {
                Shaking::Single { std } => {
                    let normal: f64 = self.excitation_random.sample(StandardNormal);
                    self.next_excitation[first] = amplitude * *std * normal;
                    first += 1;
                }
                Shaking::Field {
                    mean,
                    factor,
                    white,
                    std,
                } => {
                    white
                        .iter_mut()
                        .for_each(|entry| *entry = self.excitation_random.sample(StandardNormal));
                    let mut forces = self.next_excitation.rows_mut(first, mean.len());
                    forces.copy_from(mean);
                    forces.gemv(amplitude * *std, factor, white, 1.0);
                    first += mean.len();
                }
            }
        }
    }

    /// Updates the parameters if the damage has changed.
    fn follow_damage(&mut self) {
        let theta = true_parameters(&self.plan, &self.undamaged, self.index as f64 * self.step_s);
        if theta != self.theta {
            self.motion.set_parameters(&theta);
            self.theta = theta;
        }
    }

    /// Returns the values of all channels at this frame, with noise and faults.
    fn sample(&mut self) -> Vec<f64> {
        let (response, excitation) = (&self.response, &self.excitation);
        let mut values = Vec::with_capacity(self.channels.len());
        for channel in &self.channels {
            let truth = match channel.source {
                Source::Response(row) => response[row],
                Source::Excitation(input) => excitation[input],
            };
            let normal: f64 = self.noise_random.sample(StandardNormal);
            let [dropped, spiked, side]: [f64; 3] = self.fault_random.random();
            let Spikes {
                share,
                height,
                kind,
            } = self.plan.spikes;
            let sample = match kind {
                _ if spiked >= share => truth + channel.noise_std * normal,
                SpikeKind::Added => {
                    truth + channel.noise_std * (normal + if side < 0.5 { height } else { -height })
                }
                SpikeKind::Replaced => channel.noise_std * height * (2.0 * side - 1.0),
            };
            let time_s = self.index as f64 * self.step_s;
            let of_node = self
                .plan
                .faults
                .iter()
                .filter(|fault| fault.node == channel.node);
            let sample = of_node.fold(sample, |sample, fault| {
                fault.apply(sample, channel.noise_std, time_s)
            });
            let missing =
                dropped < self.plan.dropped_share || !self.index.is_multiple_of(channel.every);
            values.push(if missing { f64::NAN } else { sample });
        }
        values
    }

    /// Simulates the next frame.
    pub(crate) fn advance_frame(&mut self) -> SimulatedFrame {
        self.follow_damage();
        std::mem::swap(&mut self.excitation, &mut self.next_excitation);
        self.draw_excitation(self.index + 1);
        self.motion.respond(&self.excitation, &mut self.response);
        let values = self.sample();
        self.motion.advance(&self.excitation, &self.next_excitation);
        let index = self.index;
        self.index += 1;
        SimulatedFrame { index, values }
    }
}

impl Iterator for Simulator {
    type Item = SimulatedFrame;

    /// Returns the next frame; never `None`.
    fn next(&mut self) -> Option<SimulatedFrame> {
        Some(self.advance_frame())
    }
}

/// Creates the sample generator of each excitation.
fn shaking(structure: &Structure, amplitude: Amplitude) -> Vec<Shaking> {
    let shaking = |(index, excitation): (usize, &crate::Excitation)| {
        // The level of a measured excitation is the noise of its channel.
        let is_own = |source: &NoiseSource| {
            excitation.measured.is_none() && *source == NoiseSource::Excitation(index)
        };
        let std = actual_std(structure, is_own).unwrap_or(excitation.std());
        match &excitation.action {
            Action::Ground { .. } | Action::Force { .. } => Shaking::Single { std },
            Action::ForceField(field) => {
                let mut mean = DVector::from_column_slice(&field.mean);
                if amplitude == Amplitude::Small {
                    mean.fill(0.0);
                }
                Shaking::Field {
                    white: mean.clone(),
                    mean,
                    factor: field.factor.clone(),
                    std,
                }
            }
        }
    };
    structure
        .excitations
        .iter()
        .enumerate()
        .map(shaking)
        .collect()
}

/// Returns the actual standard deviation of the noise level for which `is_meant` returns `true`.
fn actual_std(structure: &Structure, is_meant: impl Fn(&NoiseSource) -> bool) -> Option<f64> {
    let level = structure
        .noise_levels
        .iter()
        .position(|level| is_meant(&level.source));
    level.map(|level| structure.expected_level_std(level))
}

fn simulated_channels(structure: &Structure) -> Vec<SimulatedChannel> {
    let mut channels = Vec::new();
    let frames_per_sample = structure.frames_per_sample();
    for (place, node) in structure.nodes().iter().enumerate() {
        for channel in node.channels() {
            let frame_channel = channels.len();
            let position = |of: &[usize]| of.iter().position(|channel| *channel == frame_channel);
            let row = position(&structure.observation_channels);
            let input = structure
                .excitation_channels
                .iter()
                .position(|channel| *channel == Some(frame_channel));
            let measured = structure
                .excitations
                .iter()
                .position(|e| e.channel() == Some(frame_channel));
            let is_own = |source: &NoiseSource| match source {
                NoiseSource::Sensors(rows) => row.is_some_and(|row| rows.contains(&row)),
                NoiseSource::Excitation(index) => measured == Some(*index),
            };
            let noise_std = actual_std(structure, is_own).unwrap_or(channel.noise_std());
            // A channel is either a response or an excitation, as checked when the file was read.
            if let Some(source) = row.map(Source::Response).or(input.map(Source::Excitation)) {
                let every = frames_per_sample[frame_channel];
                channels.push(SimulatedChannel {
                    source,
                    noise_std,
                    every,
                    node: place,
                });
            }
        }
    }
    channels
}

#[cfg(test)]
mod tests;
