//! Share of the 95 % intervals that contain the truth, over a few simulated epochs.
//!
//! The simulation shares nothing with the method: modal oscillators under random forces, with the
//! exact solution over a step. A few seeds only find a gross error of the deviations. `spandrel
//! validate modal` has many seeds and conditions. A machine beside a mode is named.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
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

/// Amplitude of a machine, 1.8 times the standard deviation of the acceleration of mode 2.
const MACHINE: f64 = 5.0;

/// True frequencies (Hz) and damping ratios.
const MODES: [(f64, f64); 3] = [(0.9, 0.01), (2.4, 0.02), (4.1, 0.01)];

/// Shape of each mode at the channels: a cosine with one more half wave per mode.
fn shape(mode: usize, channel: usize) -> f64 {
    let position = (channel as f64 + 0.5) / CHANNELS as f64;
    (0.5 * TAU * mode as f64 * position).cos() + 0.3
}

/// Simulates accelerations until the first epoch is complete, and returns its modes. A machine at
/// `machine_hz` adds a sine.
fn epoch(seed: u64, machine_hz: Option<f64>) -> Vec<Mode> {
    let mut stream = ModalStream::new(&ModalSettings::new(CHANNELS, RATE_HZ)).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let step_s = 1.0 / (RATE_HZ * SUBSTEPS as f64);
    let mut force = [0.0; CHANNELS];
    let mut states = [[0.0; 2]; MODES.len()];
    for sample in 0_i32.. {
        let mut accelerations = [0.0; MODES.len()];
        for _ in 0..SUBSTEPS {
            force = force.map(|_| normal());
            for (number, (frequency_hz, damping)) in MODES.iter().enumerate() {
                let omega = TAU * frequency_hz;
                let forces = force.iter().enumerate();
                let p: f64 = forces.map(|(at, f)| shape(number, at) * f).sum();
                states[number] = exact_step(states[number], p, omega, *damping, step_s);
                let [q, v] = states[number];
                accelerations[number] = p - 2.0 * damping * omega * v - omega * omega * q;
            }
        }
        let time_s = f64::from(sample) / RATE_HZ;
        let sine = |hz: f64| MACHINE * (TAU * hz * time_s).sin();
        let machine = machine_hz.map_or(0.0, sine);
        let frame: Vec<f64> = (0..CHANNELS)
            .map(|at| {
                let moved = accelerations.iter().enumerate();
                let motion: f64 = moved.map(|(mode, a)| shape(mode, at) * a).sum();
                motion + machine * shape(1, at) + 0.05 * normal()
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

#[test]
fn most_intervals_of_a_few_epochs_contain_the_truth() {
    let (mut found, mut frequencies, mut damping_ratios) = (0, 0, 0);
    for seed in 1..=6 {
        let modes = epoch(seed, None);
        let is_listed = |mode: &&Mode| mode.damping > CERTAIN_DAMPING * mode.damping_std;
        for (frequency_hz, damping) in MODES {
            let distance = |mode: &&Mode| (mode.frequency_hz - frequency_hz).abs();
            let listed = modes.iter().filter(is_listed);
            let nearest = listed.min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let Some(mode) = nearest.filter(|mode| distance(mode) < NEAR * frequency_hz) else {
                continue;
            };
            let inside = |error: f64, std: f64| usize::from(error.abs() < QUANTILE * std);
            found += 1;
            frequencies += inside(mode.frequency_hz - frequency_hz, mode.frequency_std_hz);
            damping_ratios += inside(mode.damping - damping, mode.damping_std);
        }
    }
    assert_eq!(found, 18);
    // Of 18 intervals, fewer than 14 contain the truth with a probability of 0.002, if 95 % should.
    assert!(frequencies >= 14, "{frequencies}");
    assert!(damping_ratios >= 13, "{damping_ratios}");
}

/// The machine and the mode share a pole, which has the damping of neither.
#[test]
fn a_machine_beside_a_mode_is_named_as_a_machine() {
    let machine_hz = 1.008 * MODES[1].0;
    let named = (1..=6).filter(|seed| {
        let modes = epoch(*seed, Some(machine_hz));
        let mut near = modes
            .iter()
            .filter(|mode| (mode.frequency_hz / machine_hz - 1.0).abs() < 0.01);
        near.any(|mode| mode.source == Source::Machine)
    });
    // In 60 epochs, 54 named it.
    assert!(named.count() >= 4);
}
