//! Share of the 95 % intervals that contain the truth, over many simulated epochs.
//!
//! The simulation shares nothing with the method: modal oscillators under random forces, with the exact
//! solution over a step. The quick test has few seeds and only finds a gross error of the deviations. The
//! ignored test prints a table from 200 seeds:
//!
//! ```sh
//! cargo test -p spandrel-modal --test coverage -- --ignored --nocapture
//! ```

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "a test that fails panics, and the table of the long test is printed"
)]

mod oscillator;

use oscillator::exact_step;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_modal::{CERTAIN_DAMPING, ModalSettings, ModalStream, Mode, Source, identify};
use std::f64::consts::TAU;

const RATE_HZ: f64 = 20.0;
/// Steps of the integration per sample.
const SUBSTEPS: usize = 4;
const CHANNELS: usize = 4;
/// Half the width of a 95 % interval, in standard deviations.
const QUANTILE: f64 = 1.96;
/// Largest distance of a mode from the truth that it can belong to, relative to the frequency.
const NEAR: f64 = 0.04;

/// What is simulated.
struct Scene {
    name: &'static str,
    /// Frequencies (Hz) and damping ratios.
    modes: &'static [(f64, f64)],
    epoch_s: f64,
    /// Time constant of the force on each channel (s); 0 for a white force.
    force_s: f64,
    /// Channel without samples.
    missing: Option<usize>,
    /// Frequency of a machine (Hz).
    machine_hz: Option<f64>,
}

const PLAIN: Scene = Scene {
    name: "white force, damping 1 and 2 %",
    modes: &[(0.9, 0.01), (2.4, 0.02), (4.1, 0.01)],
    epoch_s: 600.0,
    force_s: 0.0,
    missing: None,
    machine_hz: None,
};

const SCENES: [Scene; 7] = [
    PLAIN,
    Scene {
        name: "coloured force",
        force_s: 0.2,
        ..PLAIN
    },
    Scene {
        name: "damping 0.5 %",
        modes: &[(0.9, 0.005), (2.4, 0.005), (4.1, 0.005)],
        ..PLAIN
    },
    Scene {
        name: "damping 5 %",
        modes: &[(0.9, 0.05), (2.4, 0.05), (4.1, 0.05)],
        ..PLAIN
    },
    Scene {
        name: "two close modes",
        modes: &[(2.3, 0.01), (2.4, 0.01), (4.1, 0.01)],
        ..PLAIN
    },
    Scene {
        name: "epoch of 200 s",
        epoch_s: 200.0,
        ..PLAIN
    },
    Scene {
        name: "a sensor missing, a machine at 3.3 Hz",
        missing: Some(2),
        machine_hz: Some(3.3),
        ..PLAIN
    },
];

/// Shape of each mode at the channels: a cosine with one more half wave per mode.
fn shape(mode: usize, channel: usize) -> f64 {
    let position = (channel as f64 + 0.5) / CHANNELS as f64;
    (0.5 * TAU * mode as f64 * position).cos() + 0.3
}

impl Scene {
    /// Simulates accelerations until the first epoch is complete, and returns its modes.
    fn identify(&self, seed: u64) -> Vec<Mode> {
        let settings = ModalSettings {
            epoch_s: self.epoch_s,
            ..ModalSettings::new(CHANNELS, RATE_HZ)
        };
        let mut stream = ModalStream::new(&settings).unwrap();
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let step_s = 1.0 / (RATE_HZ * SUBSTEPS as f64);
        let keep = if self.force_s > 0.0 {
            (-step_s / self.force_s).exp()
        } else {
            0.0
        };
        let mut force = [0.0; CHANNELS];
        let mut states = vec![[0.0; 2]; self.modes.len()];
        for sample in 0_i32.. {
            let mut accelerations = vec![0.0; self.modes.len()];
            for _ in 0..SUBSTEPS {
                for value in &mut force {
                    *value = keep * *value + (1.0 - keep * keep).sqrt() * normal();
                }
                for (number, (frequency_hz, damping)) in self.modes.iter().enumerate() {
                    let omega = TAU * frequency_hz;
                    let forces = force.iter().enumerate();
                    let p: f64 = forces.map(|(at, f)| shape(number, at) * f).sum();
                    states[number] = exact_step(states[number], p, omega, *damping, step_s);
                    let [q, v] = states[number];
                    accelerations[number] = p - 2.0 * damping * omega * v - omega * omega * q;
                }
            }
            let time_s = f64::from(sample) / RATE_HZ;
            let machine = self
                .machine_hz
                .map_or(0.0, |hz| 2.0 * (TAU * hz * time_s).sin());
            let frame: Vec<f64> = (0..CHANNELS)
                .map(|at| {
                    let moved = accelerations.iter().enumerate();
                    let motion: f64 = moved.map(|(mode, a)| shape(mode, at) * a).sum();
                    let seen = motion + machine * shape(1, at) + 0.05 * normal();
                    if self.missing == Some(at) {
                        f64::NAN
                    } else {
                        seen
                    }
                })
                .collect();
            // The motion from rest settles in the first 60 s.
            if time_s >= 60.0
                && let Some(epoch) = stream.push(&frame).unwrap()
            {
                return identify(&epoch).unwrap().modes;
            }
        }
        unreachable!("the stream completes an epoch")
    }
}

/// What the epochs of a scene show about one mode.
#[derive(Debug, Default, Clone)]
struct Shares {
    found: usize,
    frequencies_inside: usize,
    damping_inside: usize,
    /// Sum of the errors of the frequency, in standard deviations.
    bias: f64,
}

/// What the epochs of a scene show.
struct Result {
    modes: Vec<Shares>,
    /// Number of epochs in which the machine is a machine, and no mode lies within 1 % of it.
    machines: usize,
    /// Number of modes that do not exist, among the listed ones.
    false_modes: usize,
}

fn is_listed(mode: &&Mode) -> bool {
    mode.damping > CERTAIN_DAMPING * mode.damping_std
}

fn epochs(scene: &Scene, seeds: u64) -> Result {
    let mut result = Result {
        modes: vec![Shares::default(); scene.modes.len()],
        machines: 0,
        false_modes: 0,
    };
    for seed in 1..=seeds {
        let found = scene.identify(seed);
        let mut real = 0;
        for ((frequency_hz, damping), shares) in scene.modes.iter().zip(&mut result.modes) {
            let distance = |mode: &&Mode| (mode.frequency_hz - frequency_hz).abs();
            let nearest = found
                .iter()
                .filter(is_listed)
                .min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let Some(mode) = nearest.filter(|mode| distance(mode) < NEAR * frequency_hz) else {
                continue;
            };
            real += 1;
            let error = (mode.frequency_hz - frequency_hz) / mode.frequency_std_hz;
            shares.found += 1;
            shares.bias += error;
            shares.frequencies_inside += usize::from(error.abs() < QUANTILE);
            let error = (mode.damping - damping) / mode.damping_std;
            shares.damping_inside += usize::from(error.abs() < QUANTILE);
        }
        let is_mode = |mode: &&Mode| mode.source == Source::Mode && is_listed(mode);
        result.false_modes += found.iter().filter(is_mode).count().saturating_sub(real);
        if let Some(machine_hz) = scene.machine_hz {
            let near = |mode: &&Mode| (mode.frequency_hz / machine_hz - 1.0).abs() < 0.01;
            let mut near = found.iter().filter(near);
            let is_machine = |mode: &Mode| mode.source == Source::Machine;
            result.machines +=
                usize::from(near.next().is_some_and(is_machine) && near.all(is_machine));
        }
    }
    result
}

#[test]
fn most_intervals_of_a_few_epochs_contain_the_truth() {
    const SEEDS: u64 = 6;
    let result = epochs(&PLAIN, SEEDS);
    let sum = |part: fn(&Shares) -> usize| result.modes.iter().map(part).sum::<usize>();
    assert_eq!(sum(|shares| shares.found), 18);
    // Of 18 intervals, fewer than 14 contain the truth with a probability of 0.002, if 95 % should.
    assert!(
        sum(|shares| shares.frequencies_inside) >= 14,
        "{:?}",
        result.modes
    );
    assert!(
        sum(|shares| shares.damping_inside) >= 13,
        "{:?}",
        result.modes
    );
}

#[test]
#[ignore = "takes many minutes and prints a table"]
fn coverage_over_200_seeds() {
    let seeds = 200;
    for scene in SCENES {
        let result = epochs(&scene, seeds);
        println!(
            "{}: {:.1} false modes per epoch",
            scene.name,
            result.false_modes as f64 / seeds as f64
        );
        if scene.machine_hz.is_some() {
            println!("  machine named in {} of {seeds} epochs", result.machines);
        }
        for ((frequency_hz, damping), shares) in scene.modes.iter().zip(&result.modes) {
            let share = |count: usize| count as f64 / shares.found.max(1) as f64;
            println!(
                "  {frequency_hz} Hz, {:.1} %: found {}, frequency {:.3}, damping {:.3}, bias {:+.2}",
                100.0 * damping,
                shares.found,
                share(shares.frequencies_inside),
                share(shares.damping_inside),
                shares.bias / shares.found.max(1) as f64,
            );
        }
    }
}
