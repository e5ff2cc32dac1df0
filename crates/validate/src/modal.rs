//! Natural frequencies from ambient vibration: how many of the 95 % intervals contain the truth.
//!
//! A run simulates many epochs of modal oscillators under random forces, by their exact solution
//! over a step. `spandrel-modal` identifies each epoch from covariances alone. The two share no
//! equation.

use crate::cases::Case;
use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::Outcome;
use crate::run::{Length, Run};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_modal::{CERTAIN_DAMPING, ModalSettings, ModalStream, Mode, Source, identify};
use std::f64::consts::TAU;

const SOURCE: &str = "Modes from ambient vibration, simulated";
/// Number of epochs of a run, each from its own seed.
const EPOCHS: u64 = 200;
const RATE_HZ: f64 = 20.0;
/// Steps of the simulation per sample, so that the force is white up to the sampling rate.
const SUBSTEPS: usize = 4;
const CHANNELS: usize = 4;
/// Standard deviation of the noise of a sensor. The accelerations have about 1.
const NOISE: f64 = 0.05;
/// Time in which the motion from rest settles (s).
const SETTLE_S: f64 = 60.0;
/// Half the width of a 95 % interval, in standard deviations.
const QUANTILE: f64 = 1.959_963_984_540_054;
/// Largest distance of an identified mode from a true one, relative to the frequency.
const NEAR: f64 = 0.04;
/// The same of a machine.
const NEAR_MACHINE: f64 = 0.01;

/// Required share of the intervals of a frequency, and of a damping ratio, with the truth.
const FREQUENCIES: Required = Required::Between {
    low: 0.90,
    high: 0.98,
};
const DAMPING_RATIOS: Required = Required::AtLeast(0.85);
/// Required mean error of a frequency, in stated standard deviations.
const BIAS: Required = Required::Within {
    of: 0.0,
    by: 1.0 / 3.0,
};
/// Required share of the epochs in which a machine is named as one, and not as a mode.
const MACHINES: Required = Required::AtLeast(0.95);

/// What is simulated.
#[derive(Clone, Copy)]
struct Scene {
    /// True frequencies (Hz) and damping ratios.
    modes: &'static [(f64, f64)],
    epoch_s: f64,
    /// Time constant of the force at each channel (s); 0 for a white force.
    force_s: f64,
    /// A channel without samples.
    missing: Option<usize>,
    /// Frequency of a machine (Hz).
    machine_hz: Option<f64>,
}

const WHITE: Scene = Scene {
    modes: &[(0.9, 0.01), (2.4, 0.02), (4.1, 0.01)],
    epoch_s: 600.0,
    force_s: 0.0,
    missing: None,
    machine_hz: None,
};

/// Time of a run at full length (s).
const WEIGHT: f64 = 60.0;

pub(crate) static CASES: &[Case] = &[
    Case {
        name: "modal.white",
        title: "Three modes under white forces, damping ratios of 1 and 2 %",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| measure(run, &WHITE),
    },
    Case {
        name: "modal.coloured",
        title: "The same under coloured forces",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| {
            let scene = Scene {
                force_s: 0.2,
                ..WHITE
            };
            measure(run, &scene)
        },
    },
    Case {
        name: "modal.low-damping",
        title: "Three modes with damping ratios of 0.5 %",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| {
            let scene = Scene {
                modes: &[(0.9, 0.005), (2.4, 0.005), (4.1, 0.005)],
                ..WHITE
            };
            measure(run, &scene)
        },
    },
    Case {
        name: "modal.high-damping",
        title: "Three modes with damping ratios of 5 %",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| {
            let scene = Scene {
                modes: &[(0.9, 0.05), (2.4, 0.05), (4.1, 0.05)],
                ..WHITE
            };
            measure(run, &scene)
        },
    },
    Case {
        name: "modal.close-modes",
        title: "Two modes 4 % apart, damping ratios of 1 %",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| {
            let scene = Scene {
                modes: &[(2.3, 0.01), (2.4, 0.01), (4.1, 0.01)],
                ..WHITE
            };
            measure(run, &scene)
        },
    },
    Case {
        name: "modal.short-epochs",
        title: "Epochs of 200 s",
        source: SOURCE,
        weight: WEIGHT / 3.0,
        run: |run| {
            let scene = Scene {
                epoch_s: 200.0,
                ..WHITE
            };
            measure(run, &scene)
        },
    },
    Case {
        name: "modal.missing-sensor",
        title: "One of four sensors delivers no samples",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| {
            let scene = Scene {
                missing: Some(2),
                ..WHITE
            };
            measure(run, &scene)
        },
    },
    Case {
        name: "modal.machine",
        title: "A machine in the band, stronger than the ambient vibration",
        source: SOURCE,
        weight: WEIGHT,
        run: |run| {
            let scene = Scene {
                machine_hz: Some(3.3),
                ..WHITE
            };
            measure(run, &scene)
        },
    },
];

/// Shape of a mode at a channel: a cosine with one more half wave per mode, and a common part.
fn shape(mode: usize, channel: usize) -> f64 {
    let position = (channel as f64 + 0.5) / CHANNELS as f64;
    (0.5 * TAU * mode as f64 * position).cos() + 0.3
}

/// A modal oscillator of unit mass.
struct Oscillator {
    number: usize,
    /// Angular frequency (rad/s).
    omega: f64,
    damping: f64,
    displacement: f64,
    velocity: f64,
    acceleration: f64,
}

impl Oscillator {
    /// Makes a step of `step_s` under constant forces at the channels. The solution is exact.
    fn step(&mut self, forces: &[f64], step_s: f64) {
        let of_channels = forces.iter().enumerate();
        let force: f64 = of_channels
            .map(|(channel, force)| shape(self.number, channel) * force)
            .sum();
        let (omega, decay_rate) = (self.omega, self.damping * self.omega);
        let damped = omega * (1.0 - self.damping * self.damping).sqrt();
        let (sin, cos) = (damped * step_s).sin_cos();
        let decay = (-decay_rate * step_s).exp();
        let rest = force / (omega * omega);
        let distance = self.displacement - rest;
        let swing = (self.velocity + decay_rate * distance) / damped;
        let slope = (decay_rate * self.velocity + omega * omega * distance) / damped;
        self.displacement = rest + decay * (distance * cos + swing * sin);
        self.velocity = decay * (self.velocity * cos - slope * sin);
        self.acceleration =
            force - 2.0 * decay_rate * self.velocity - omega * omega * self.displacement;
    }
}

impl Scene {
    /// Simulates accelerations until an epoch is complete, and returns its modes and machines.
    fn epoch(&self, seed: u64) -> Result<Vec<Mode>, ValidateError> {
        let settings = ModalSettings {
            epoch_s: self.epoch_s,
            ..ModalSettings::new(CHANNELS, RATE_HZ)
        };
        let mut stream = ModalStream::new(&settings)?;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let step_s = 1.0 / (RATE_HZ * SUBSTEPS as f64);
        let keep = match self.force_s > 0.0 {
            true => (-step_s / self.force_s).exp(),
            false => 0.0,
        };
        let oscillators = self.modes.iter().enumerate();
        let mut oscillators: Vec<Oscillator> = oscillators
            .map(|(number, (frequency_hz, damping))| Oscillator {
                number,
                omega: TAU * frequency_hz,
                damping: *damping,
                displacement: 0.0,
                velocity: 0.0,
                acceleration: 0.0,
            })
            .collect();
        let mut forces = [0.0; CHANNELS];
        let mut frame = [0.0; CHANNELS];
        // Twice the length contains the start-up of the filters.
        let samples = ((SETTLE_S + 2.0 * self.epoch_s) * RATE_HZ) as u32;
        for sample in 0..samples {
            for _ in 0..SUBSTEPS {
                for force in &mut forces {
                    *force = keep * *force + (1.0 - keep * keep).sqrt() * normal();
                }
                for oscillator in &mut oscillators {
                    oscillator.step(&forces, step_s);
                }
            }
            let time_s = f64::from(sample) / RATE_HZ;
            let machine = self
                .machine_hz
                .map_or(0.0, |hz| 2.0 * (TAU * hz * time_s).sin());
            for (channel, value) in frame.iter_mut().enumerate() {
                let modes = oscillators.iter();
                let motion: f64 = modes
                    .map(|one| shape(one.number, channel) * one.acceleration)
                    .sum();
                *value = motion + machine * shape(1, channel) + NOISE * normal();
            }
            if let Some(channel) = self.missing {
                frame[channel] = f64::NAN;
            }
            if time_s >= SETTLE_S
                && let Some(epoch) = stream.push(&frame)?
            {
                return Ok(identify(&epoch)?.modes);
            }
        }
        Err(ValidateError::Example { what: "epoch" })
    }
}

/// What the epochs show about one true mode.
#[derive(Debug, Default, Clone)]
struct Counts {
    found: f64,
    frequencies_inside: f64,
    damping_ratios_inside: f64,
    /// Sum of the errors of the frequency, in stated standard deviations.
    errors: f64,
}

impl Counts {
    fn take(&mut self, mode: &Mode, (frequency_hz, damping): (f64, f64)) {
        let error = (mode.frequency_hz - frequency_hz) / mode.frequency_std_hz;
        let damping_error = (mode.damping - damping) / mode.damping_std;
        let inside = |error: f64| f64::from(u8::from(error.abs() < QUANTILE));
        self.found += 1.0;
        self.frequencies_inside += inside(error);
        self.damping_ratios_inside += inside(damping_error);
        self.errors += error;
    }
}

/// Identifies the epochs of a run. A short run has one epoch, and only reports.
fn measure(run: &Run<'_>, scene: &Scene) -> Result<Outcome, ValidateError> {
    let epochs = run.pick(EPOCHS, 1);
    let mut counts = vec![Counts::default(); scene.modes.len()];
    let (mut false_modes, mut machines) = (0.0, 0.0);
    for epoch in 0..epochs {
        if !run.advance(epoch as f64 / epochs as f64) {
            return Err(ValidateError::Stopped);
        }
        let found = scene.epoch(EPOCHS * run.seed + epoch)?;
        let mut modes: Vec<&Mode> = found.iter().filter(|mode| is_listed(mode)).collect();
        for (truth, counts) in scene.modes.iter().zip(&mut counts) {
            let distance = |mode: &Mode| (mode.frequency_hz / truth.0 - 1.0).abs();
            let nearest =
                (0..modes.len()).min_by(|a, b| distance(modes[*a]).total_cmp(&distance(modes[*b])));
            // Two true modes cannot be the same identified one.
            if let Some(nearest) = nearest.filter(|nearest| distance(modes[*nearest]) < NEAR) {
                counts.take(modes.swap_remove(nearest), *truth);
            }
        }
        false_modes += modes.len() as f64;
        machines += f64::from(u8::from(is_named_as_machine(&found, scene.machine_hz)));
    }
    run.advance(1.0);
    let required = |required: Required| match run.length {
        Length::Full => required,
        Length::Quick => Required::Reported,
    };
    let epochs = epochs as f64;
    let mut figures = Vec::new();
    for ((frequency_hz, _), counts) in scene.modes.iter().zip(&counts) {
        let of = |what: &str, sum: f64, all: f64, of: Required| {
            Figure::new(
                format!("{frequency_hz} Hz: {what}"),
                sum / all,
                required(of),
            )
        };
        figures.extend([
            of(
                "share of 95 % intervals of the frequency that hold the truth",
                counts.frequencies_inside,
                counts.found,
                FREQUENCIES,
            ),
            of(
                "share of 95 % intervals of the damping ratio that hold the truth",
                counts.damping_ratios_inside,
                counts.found,
                DAMPING_RATIOS,
            ),
            of(
                "mean error of the frequency (stated standard deviations)",
                counts.errors,
                counts.found,
                BIAS,
            ),
            of(
                "share of the epochs with the mode",
                counts.found,
                epochs,
                Required::Reported,
            ),
        ]);
    }
    figures.push(Figure::new(
        "listed modes per epoch that do not exist",
        false_modes / epochs,
        Required::Reported,
    ));
    if scene.machine_hz.is_some() {
        figures.push(Figure::new(
            "share of the epochs in which the machine is a machine and no mode",
            machines / epochs,
            required(MACHINES),
        ));
    }
    Ok(Outcome {
        figures,
        ..Outcome::default()
    })
}

/// Returns `true` if the table of a recording lists a mode.
fn is_listed(mode: &Mode) -> bool {
    mode.source == Source::Mode && mode.damping > CERTAIN_DAMPING * mode.damping_std
}

/// Returns `true` if there is something at the frequency of a machine, and all of it is a machine.
fn is_named_as_machine(found: &[Mode], machine_hz: Option<f64>) -> bool {
    let is_near = |mode: &&Mode| {
        machine_hz.is_some_and(|hz| (mode.frequency_hz / hz - 1.0).abs() < NEAR_MACHINE)
    };
    let mut near = found.iter().filter(is_near).peekable();
    near.peek().is_some() && near.all(|mode| mode.source == Source::Machine)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::Length;
    use std::sync::atomic::AtomicBool;

    /// A step of the free oscillation: x = e^(−ζωt) cos(ω_d t) + …, from rest at 1 under no force.
    #[test]
    fn free_oscillation_is_the_known_one() {
        let (omega, damping) = (TAU * 0.9, 0.05);
        let mut oscillator = Oscillator {
            number: 0,
            omega,
            damping,
            displacement: 1.0,
            velocity: 0.0,
            acceleration: 0.0,
        };
        for _ in 0..100 {
            oscillator.step(&[0.0; CHANNELS], 0.01);
        }
        let damped = omega * (1.0_f64 - damping * damping).sqrt();
        let ratio = damping / (1.0_f64 - damping * damping).sqrt();
        let expected = (-damping * omega).exp() * (damped.cos() + ratio * damped.sin());
        assert!((oscillator.displacement - expected).abs() < 1e-12);
    }

    #[test]
    fn one_epoch_of_each_case_has_all_its_modes() {
        for case in CASES {
            let outcome = (case.run)(&Run {
                seed: 1,
                length: Length::Quick,
                records: None,
                advanced: &|_| {},
                stopped: &AtomicBool::new(false),
            });
            let figures = outcome.unwrap().figures;
            let found = figures
                .iter()
                .filter(|figure| figure.name.ends_with("with the mode"));
            let found: Vec<Option<f64>> = found.map(|figure| figure.measured).collect();
            assert_eq!(found, [Some(1.0); 3], "{}", case.name);
        }
    }
}
