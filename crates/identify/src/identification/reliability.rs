//! Reliability of a measured excitation: the share of its variance that is motion, not noise of
//! its sensor.
//!
//! The samples are `f + w` with the noise `w` of the sensor. A filter that takes them for `f ± σ`
//! assumes that every `f` is equally probable. Its likelihood then contains `−½ ln |S|` with a
//! covariance `S` that grows with the stiffness through which `w` would move the structure. In
//! strong motion, this term is negligible. While the ground is quiet, it is the only term that
//! depends on the stiffness, and the estimate falls towards zero.
//!
//! With the reliability `κ = s²/(s² + σ²)`, where `s²` is the variance of the motion, the
//! excitation is `κ (f + w) ± √κ σ`: the mean and the standard deviation of `f` given the sample.
//! While the ground is at rest, `κ` is 0, and the filter lets the structure move freely.
//!
//! The mean square `P` of the samples estimates `s² + σ²`. If the sensor is noisier than stated, it
//! seems to show a motion of the ground. But the ground moves the floors, which amplify its motion,
//! so that `s²` is at most a share of their mean square.
//!
//! Below a reliability of a half, the level of the excitation is uncertain by as much as the motion
//! of the structure would be informative. The parameters then learn only from a free vibration that
//! is far above the noise.
//!
//! Sources:
//!
//! - W. A. Fuller, *Measurement Error Models*, 1987, §1.1 (reliability ratio)
//! - N. Wiener, *Extrapolation, Interpolation, and Smoothing of Stationary Time Series*, 1949

use super::Identification;
use serde::{Deserialize, Serialize};
use spandrel_filter::FilterError;
use spandrel_structure::{Quantity, Structure};
use std::f64::consts::TAU;

/// Corner frequencies of the band in which the mean squares are measured, as multiples of the
/// fundamental frequency.
const BAND: (f64, f64) = (0.2, 4.0);

/// Number of fundamental periods over which a mean square is averaged, while it changes and while
/// it does not.
const PERIODS: (usize, usize) = (4, 16);

/// Largest ratio between the averages over both numbers of periods of a steady mean square.
///
/// The shorter average of noise scatters by a quarter.
const STEADY: f64 = 1.6;

/// Mean square of an eighth of a period, as a multiple of the variance of the noise, that begins a
/// motion at once.
const ONSET: f64 = 9.0;

/// Factor on the smallest mean square, which chance makes too small.
const OF_QUIETEST: f64 = 1.15;

/// Mean square, as a share of the stated variance of the noise, below which a channel is silent
/// unless all of them are at rest.
///
/// An unplugged sensor measures less than its noise. The noise of the connected one must not look
/// like an onset, and must not exceed [`CONFIRMED`].
const LEAST_OF_STATED: f64 = 0.25;

/// Mean square, as a multiple of the variance of the noise, up to which the floors must confirm a
/// motion of the ground.
const CONFIRMED: f64 = 16.0;

/// Smallest ratio of the mean square of a floor to that of the ground below it, in the band.
///
/// White noise moves the top of a structure with a damping ratio of 10 % this much.
const AMPLIFICATION: f64 = 4.0;

/// Reliability below which most of the excitation is unknown.
///
/// How much the structure then moves shows the level of the excitation instead of a stiffness.
const RELIABLE: f64 = 0.5;

/// Mean square of the response, as a multiple of the variance of its noise, above which a free
/// vibration shows the stiffness although the excitation is unknown.
const FREE_VIBRATION: f64 = 100.0;

/// Constants of the mean squares of one channel.
#[derive(Debug, Clone, Copy)]
struct Band {
    /// Fundamental period in samples.
    period_steps: f64,
    /// Coefficients of the low-pass filter and of the high-pass filter.
    low: f64,
    high: f64,
    /// Share of the variance of white noise that passes the band.
    passes: f64,
    /// Number of frames per sample.
    stride: u64,
}

impl Band {
    /// Creates the constants of a channel with a sample in every `stride`-th frame.
    fn new(structure: &Structure, stride: u64) -> Self {
        let frames = structure.fundamental_period_s() * structure.sampling_rate_hz();
        let period_steps = (frames / stride as f64).max(2.0);
        let coefficient = |multiple: f64| 1.0 - (-TAU * multiple / period_steps).exp();
        let mut band = Self {
            period_steps,
            low: coefficient(BAND.1),
            high: coefficient(BAND.0),
            passes: 1.0,
            stride,
        };
        let mut probe = BandPower {
            offset: Some(0.0),
            ..BandPower::default()
        };
        // The impulse response has faded after ten time constants of the slower filter.
        let steps = (10.0 / band.high) as usize;
        band.passes = (0..steps)
            .map(|step| probe.pass(if step == 0 { 1.0 } else { 0.0 }, &band).powi(2))
            .sum();
        band
    }
}

/// Mean square of one channel in the band.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
struct BandPower {
    /// First sample. An offset of the sensor is neither motion nor noise.
    offset: Option<f64>,
    /// States of the low-pass filter and of the high-pass filter.
    low: f64,
    high: f64,
    /// Sum of squares and number of samples in the present period.
    present: (f64, u64),
    /// Mean squares of the latest complete periods, as a ring.
    periods: [f64; PERIODS.1],
    /// Number of complete periods.
    complete: u64,
    /// Mean square over the latest complete periods.
    mean_square: f64,
    /// Mean square over an eighth of a period.
    onset: f64,
    /// Smallest mean square over the larger number of periods. `None` before the first.
    quietest: Option<f64>,
    /// Number of frames since the last sample.
    missing: u64,
}

impl BandPower {
    fn pass(&mut self, value: f64, band: &Band) -> f64 {
        let offset = *self.offset.get_or_insert(value);
        self.low += band.low * (value - offset - self.low);
        self.high += band.high * (self.low - self.high);
        self.low - self.high
    }

    /// Processes the sample of a frame, NaN if missing. `stated` is the variance of the noise, and
    /// `is_at_rest` states whether no channel moves.
    fn take(&mut self, value: f64, stated: f64, is_at_rest: bool, band: &Band) {
        if value.is_nan() {
            self.missing += 1;
            return;
        }
        self.missing = 0;
        let square = self.pass(value, band).powi(2);
        self.onset += (8.0 / band.period_steps).min(1.0) * (square - self.onset);
        self.present.0 += square;
        self.present.1 += 1;
        if (self.present.1 as f64) < band.period_steps {
            return;
        }
        let len = self.periods.len() as u64;
        self.periods[(self.complete % len) as usize] = self.present.0 / self.present.1 as f64;
        self.present = (0.0, 0);
        self.complete += 1;
        let (short, long) = (self.mean(PERIODS.0), self.mean(PERIODS.1));
        let is_steady = short < STEADY * long && long < STEADY * short;
        self.mean_square = if is_steady { long } else { short };
        let is_noise = is_at_rest || long > LEAST_OF_STATED * stated * band.passes;
        if self.complete >= len && is_noise {
            self.quietest = Some(self.quietest.map_or(long, |least| least.min(long)));
        }
    }

    /// Returns the mean square over the latest complete periods, at most `count`.
    fn mean(&self, count: usize) -> f64 {
        let count = self.complete.min(count as u64);
        let len = self.periods.len() as u64;
        let latest = (1..=count).map(|age| self.periods[((self.complete - age) % len) as usize]);
        latest.sum::<f64>() / count as f64
    }

    /// Returns the variance of the noise in the band. It is at most the stated variance and at most
    /// the smallest mean square.
    fn noise(&self, stated: f64, band: &Band) -> f64 {
        let in_band = stated * band.passes;
        self.quietest
            .map_or(in_band, |least| in_band.min(OF_QUIETEST * least))
    }

    /// Returns `true` if the present mean square does not exceed the stated noise. A silent channel
    /// shows no motion.
    fn rests(&self, stated: f64, band: &Band) -> bool {
        let in_band = stated * band.passes;
        let present = self.present_mean_square(in_band, band);
        present.is_none_or(|mean_square| mean_square <= in_band)
    }

    /// Returns the present mean square for this variance of the noise, or `None` in the first
    /// period and without samples for a period.
    fn present_mean_square(&self, noise: f64, band: &Band) -> Option<f64> {
        if self.complete == 0 || self.missing as f64 > band.period_steps * band.stride as f64 {
            return None;
        }
        Some(if self.onset > ONSET * noise {
            self.mean_square.max(self.onset)
        } else {
            self.mean_square
        })
    }
}

/// State of the reliability, as stored in a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ReliabilityState {
    /// One entry per component of the excitation.
    excitations: Vec<BandPower>,
    /// One entry per observation row.
    responses: Vec<BandPower>,
}

/// What the structure file states of a channel.
#[derive(Debug, Clone, Copy)]
struct Measured {
    /// Variance of the noise.
    variance: f64,
    /// Whether it measures the acceleration of the ground, or of a floor, which follows the ground.
    is_acceleration: bool,
    band: Band,
}

/// The reliability of each component of the excitation.
#[derive(Debug, Clone)]
pub(super) struct Reliability {
    /// Measured components.
    measured: Vec<Option<Measured>>,
    /// Observation rows.
    responses: Vec<Measured>,
    state: ReliabilityState,
    /// `κ` of each component.
    shares: Vec<f64>,
    /// Whether the present motion contains information about the parameters.
    teaches: bool,
}

impl Reliability {
    pub(super) fn new(structure: &Structure) -> Self {
        let channels: Vec<_> = structure.channels().collect();
        let strides = structure.frames_per_sample();
        let measured = |channel: usize, acceleration: Quantity| {
            let stated = channels.get(channel)?;
            Some(Measured {
                variance: stated.noise_std().powi(2),
                is_acceleration: stated.quantity() == acceleration,
                band: Band::new(structure, *strides.get(channel)?),
            })
        };
        let excitations = structure.excitation_channels().iter();
        let excitations: Vec<_> = excitations
            .map(|channel| measured((*channel)?, Quantity::GroundAcceleration))
            .collect();
        let responses = structure.observation_channels().iter();
        let responses: Vec<_> = responses
            .filter_map(|channel| measured(*channel, Quantity::AbsoluteAcceleration))
            .collect();
        Self {
            state: ReliabilityState {
                excitations: vec![BandPower::default(); excitations.len()],
                responses: vec![BandPower::default(); responses.len()],
            },
            shares: vec![1.0; excitations.len()],
            teaches: true,
            measured: excitations,
            responses,
        }
    }

    /// Returns the reliability of each component of the excitation.
    pub(super) fn shares(&self) -> &[f64] {
        &self.shares
    }

    /// Returns `true` if the present motion contains information about the parameters.
    pub(super) fn teaches(&self) -> bool {
        self.teaches
    }

    /// Returns the state for a checkpoint.
    pub(super) fn state(&self) -> &ReliabilityState {
        &self.state
    }

    /// Restores the state of a checkpoint.
    ///
    /// # Errors
    /// Returns an error if it belongs to other channels.
    pub(super) fn restore(&mut self, state: ReliabilityState) -> Result<(), FilterError> {
        FilterError::check_sizes([
            (
                "measured excitations of a checkpoint",
                state.excitations.len(),
                self.measured.len(),
            ),
            (
                "measured responses of a checkpoint",
                state.responses.len(),
                self.responses.len(),
            ),
        ])?;
        self.state = state;
        Ok(())
    }

    /// Returns `true` if no channel moves more than its stated noise.
    fn is_at_rest(&self) -> bool {
        let rests = |(power, measured): (&BandPower, &Measured)| {
            power.rests(measured.variance, &measured.band)
        };
        let excitations = self.state.excitations.iter().zip(&self.measured);
        let mut excitations = excitations.filter_map(|(power, one)| Some((power, one.as_ref()?)));
        let mut responses = self.state.responses.iter().zip(&self.responses);
        excitations.all(rests) && responses.all(rests)
    }

    /// Processes the samples of a frame, NaN where missing.
    pub(super) fn take(&mut self, excitation: &[f64], observations: &[f64]) {
        let is_at_rest = self.is_at_rest();
        let (mut of_floors, mut response) = (None, 0.0f64);
        let responses = self.state.responses.iter_mut().zip(&self.responses);
        for ((power, measured), value) in responses.zip(observations) {
            let band = &measured.band;
            power.take(*value, measured.variance, is_at_rest, band);
            let noise = power.noise(measured.variance, band);
            let Some(mean_square) = power.present_mean_square(noise, band) else {
                continue;
            };
            response = response.max(mean_square / noise);
            if measured.is_acceleration {
                of_floors = Some(mean_square.max(of_floors.unwrap_or(0.0)));
            }
        }
        let mut most_reliable: Option<f64> = None;
        let components = self.state.excitations.iter_mut().zip(&self.measured);
        for ((share, (power, measured)), value) in
            self.shares.iter_mut().zip(components).zip(excitation)
        {
            let Some(measured) = measured else {
                continue;
            };
            let band = &measured.band;
            power.take(*value, measured.variance, is_at_rest, band);
            let noise = power.noise(measured.variance, band);
            let Some(mean_square) = power.present_mean_square(noise, band) else {
                *share = 1.0;
                continue;
            };
            let motion = (mean_square - noise).max(0.0);
            let confirmed = match of_floors {
                _ if mean_square > CONFIRMED * noise => motion,
                Some(most) if measured.is_acceleration => motion.min(most / AMPLIFICATION),
                Some(_) | None => motion,
            };
            *share = if confirmed > 0.0 {
                confirmed / mean_square
            } else {
                0.0
            };
            most_reliable = Some(share.max(most_reliable.unwrap_or(0.0)));
        }
        let is_reliable = most_reliable.is_none_or(|share| share >= RELIABLE);
        self.teaches = is_reliable || response > FREE_VIBRATION;
    }
}

impl Identification {
    /// Determines which share of the measured excitation is motion.
    pub(super) fn weigh_excitation(&mut self) -> Result<(), FilterError> {
        let reliability = &mut self.reliability;
        reliability.take(&self.excitation, &self.observations);
        self.estimator.set_teaching(reliability.teaches);
        self.estimator.set_reliability(&reliability.shares)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// Stated standard deviation of the noise of all channels (m/s²).
    const NOISE: f64 = 0.01;

    /// A storey of 1 Hz with two floors on a measured ground, at 100 samples per second.
    fn reliability() -> Reliability {
        Reliability::new(&structure(""))
    }

    /// The structure of [`reliability`] with this line in the node of the ground.
    fn structure(of_ground: &str) -> Structure {
        let channel = |name: &str, measures: &str| {
            let of_node = if name == "ground" { of_ground } else { "" };
            format!(
                "[[node]]\nname = \"{name}\"\n{of_node}[[node.channel]]\nname = \"{name}\"\n\
                 {measures}\n\
                 unit = \"m/s2\"\nnoise-std = {NOISE}\n"
            )
        };
        let floor = |floor: usize| {
            let name = format!("floor-{floor}");
            let measures = format!("quantity = \"absolute-acceleration\"\ndof = \"{name}\"");
            channel(&name, &measures)
        };
        let text = [
            "[structure]\nname = \"house\"\nsampling-rate-hz = 100\n\
             [model]\nkind = \"shear-building\"\nstoreys = 2\nmass-kg = 1000\n\
             first-frequency-hz = 1\n\
             [damping]\nkind = \"rayleigh\"\nratio = 0.05\nmodes = [1, 2]\n\
             [[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = 1\n\
             measured-on = \"ground\"\n"
                .to_owned(),
            channel("ground", "quantity = \"ground-acceleration\""),
            floor(1),
            floor(2),
        ];
        Structure::parse(&text.concat(), std::path::Path::new("house.toml")).unwrap()
    }

    /// Standard deviations of the motion of ground and floors, and of the noise of the ground.
    #[derive(Clone, Copy)]
    struct Level {
        ground: f64,
        floors: f64,
        noise: f64,
    }

    const STRONG: Level = Level {
        ground: 1.0,
        floors: 3.0,
        noise: NOISE,
    };
    const REST: Level = Level {
        ground: 0.0,
        floors: 0.0,
        noise: NOISE,
    };

    /// Processes white motion of these durations (s) and levels, and returns `κ` and whether the
    /// frame teaches after each frame of the last level.
    fn run(reliability: &mut Reliability, levels: &[(f64, Level)], seed: u64) -> Vec<(f64, bool)> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let mut last = Vec::new();
        for (duration_s, level) in levels {
            last.clear();
            for _ in 0..(duration_s * 100.0) as usize {
                let ground = level.ground * normal() + level.noise * normal();
                let floors = [(); 2].map(|()| level.floors * normal() + NOISE * normal());
                reliability.take(&[ground], &floors);
                last.push((reliability.shares[0], reliability.teaches));
            }
        }
        last
    }

    #[test]
    fn band_passes_the_share_of_white_noise_that_it_measures() {
        let mut reliability = reliability();
        run(&mut reliability, &[(400.0, REST)], 1);
        let measured = reliability.state.excitations[0].mean_square;
        let expected = NOISE * NOISE * reliability.responses[0].band.passes;
        assert!(
            (measured / expected - 1.0).abs() < 0.5,
            "{measured} {expected}"
        );
    }

    /// Returns the share of the frames after the first ten periods that satisfy a condition. By
    /// then, the mean squares have followed the last change.
    fn share_of(frames: &[(f64, bool)], is_right: impl Fn(f64, bool) -> bool) -> f64 {
        let settled = &frames[1000..];
        let right = settled
            .iter()
            .filter(|(share, teaches)| is_right(*share, *teaches));
        right.count() as f64 / settled.len() as f64
    }

    #[test]
    fn strong_motion_is_reliable_and_rest_teaches_nothing() {
        for seed in 1..=20 {
            let mut reliability = reliability();
            let strong = run(&mut reliability, &[(30.0, STRONG)], seed);
            assert!(
                strong
                    .iter()
                    .all(|(share, teaches)| *share > 0.99 && *teaches)
            );
            let rest = run(&mut reliability, &[(60.0, REST)], seed);
            let right = share_of(&rest, |share, teaches| share < 0.5 && !teaches);
            assert!(right > 0.99, "seed {seed}: {right}");
        }
    }

    #[test]
    fn reliability_of_weak_motion_is_its_share_of_the_variance() {
        let weak = Level {
            ground: 2.0 * NOISE,
            floors: 8.0 * NOISE,
            noise: NOISE,
        };
        let mut sum = 0.0;
        for seed in 1..=20 {
            let mut reliability = reliability();
            let shares = run(&mut reliability, &[(30.0, STRONG), (60.0, weak)], seed);
            sum += shares[3000..].iter().map(|(share, _)| share).sum::<f64>() / 3000.0;
        }
        let mean = sum / 20.0;
        assert!((mean - 0.8).abs() < 0.03, "{mean}"); // 4/(4 + 1)
    }

    #[test]
    fn floors_at_rest_refute_a_motion_that_is_noise() {
        let noisy = Level {
            noise: 2.0 * NOISE,
            ..REST
        };
        for seed in 1..=20 {
            let levels = [(30.0, STRONG), (60.0, noisy)];
            let rest = run(&mut reliability(), &levels, seed);
            let right = share_of(&rest, |share, teaches| share < 0.5 && !teaches);
            assert!(right > 0.99, "seed {seed}: {right}");
        }
    }

    #[test]
    fn free_vibration_teaches_without_excitation() {
        let free = Level {
            floors: 0.5,
            ..REST
        };
        for seed in 1..=20 {
            let levels = [(30.0, STRONG), (60.0, free)];
            let after = run(&mut reliability(), &levels, seed);
            assert_eq!(share_of(&after, |_, teaches| teaches), 1.0);
            let right = share_of(&after, |share, _| share < 0.5);
            assert!(right > 0.95, "seed {seed}: {right}");
        }
    }

    #[test]
    fn onset_is_reliable_within_a_quarter_of_a_period() {
        for seed in 1..=20 {
            let mut reliability = reliability();
            run(&mut reliability, &[(30.0, REST)], seed);
            let onset = run(&mut reliability, &[(1.0, STRONG)], seed + 100);
            assert!(onset[25..].iter().all(|(share, _)| *share > 0.9), "{seed}");
        }
    }

    #[test]
    fn sensor_with_less_noise_than_stated_is_recognised_after_a_quiet_stretch() {
        let quiet = Level {
            noise: 0.1 * NOISE,
            ..REST
        };
        let weak = Level {
            ground: NOISE,
            floors: 4.0 * NOISE,
            noise: 0.1 * NOISE,
        };
        let shares = run(&mut reliability(), &[(30.0, quiet), (30.0, weak)], 1);
        assert!(shares[1000..].iter().all(|(share, _)| *share > 0.95));
    }

    #[test]
    fn unplugged_sensor_does_not_make_later_noise_a_motion() {
        let unplugged = Level {
            ground: 0.0,
            noise: 1e-6,
            ..STRONG
        };
        for seed in 1..=20 {
            let levels = [(30.0, STRONG), (20.0, unplugged), (60.0, REST)];
            let rest = run(&mut reliability(), &levels, seed);
            let right = share_of(&rest, |share, teaches| share < 0.5 && !teaches);
            assert!(right > 0.99, "ground, seed {seed}: {right}");

            let mut reliability = reliability();
            run(&mut reliability, &[(30.0, STRONG)], seed);
            for step in 0..2000 {
                let moves = (f64::from(step) / 5.0).sin();
                reliability.take(&[moves], &[3.0 * moves, 1e-6 * moves]);
            }
            let rest = run(&mut reliability, &[(60.0, REST)], seed);
            let right = share_of(&rest, |_, teaches| !teaches);
            assert!(right > 0.99, "floor, seed {seed}: {right}");
        }
    }

    #[test]
    fn slower_channel_has_the_same_band() {
        let structure = structure("sampling-rate-hz = 25\n");
        let mut reliability = Reliability::new(&structure);
        // Half the fundamental frequency lies in the band, and a sixteenth of it does not.
        for (multiple, least, most) in [(0.5, 0.5, 1.0), (0.0625, 0.0, 0.2)] {
            for frame in 0..40_000 {
                let value = (TAU * multiple * f64::from(frame) / 100.0).sin();
                let slow = if frame % 4 == 0 { value } else { f64::NAN };
                reliability.take(&[slow], &[value, value]);
            }
            let [ground] = &reliability.state.excitations[..] else {
                panic!("one excitation");
            };
            let floor = &reliability.state.responses[0];
            for power in [ground, floor] {
                let share = power.mean_square / 0.5;
                assert!((least..most).contains(&share), "{multiple}: {share}");
            }
        }
    }

    #[test]
    fn missing_samples_leave_the_excitation_as_reliable_as_unmeasured() {
        let mut reliability = reliability();
        run(&mut reliability, &[(30.0, REST)], 1);
        for _ in 0..150 {
            reliability.take(&[f64::NAN], &[f64::NAN; 2]);
        }
        assert_eq!((reliability.shares[0], reliability.teaches), (1.0, true));
    }
}
