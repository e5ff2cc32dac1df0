//! Which channels of a group have a fault: the probability of each hypothesis.
//!
//! With the responses `Tᵢ` of the model, the motion of a sound channel is `xᵢ = Tᵢ u` with one
//! common `u`. A faulty channel is `xᵢ = g exp(−iωτ) Tᵢ u` with an unknown factor `g` and delay
//! `τ`, or does not contain `u` at all. The responses depend little on the stiffness in this band.
//! What remains of the dependence is one unknown, the frequency scale of the structure, so that
//! softening is not mistaken for a fault of the ground sensor. The resonances limit it, so that a
//! fault of the ground sensor is not mistaken for softening.

use crate::channel::Fault;
use crate::memory::Memory;
use crate::resonance::{OfScales, Resonances, ln_prior};
use nalgebra::Complex;

/// Prior odds of a sound channel against a faulty one.
pub(crate) const PRIOR_ODDS: f64 = 100.0;

/// Frequency scales of the structure: designed frequency divided by the present one.
const SCALES: [f64; 13] = [
    0.82, 0.90, 1.0, 1.1, 1.22, 1.35, 1.49, 1.65, 1.82, 2.01, 2.23, 2.46, 2.72,
];

/// Standard deviation of the logarithm of the frequency scale.
const SCALE_STD: f64 = 0.3;

/// Standard deviation of the logarithm of the factor of a faulty channel.
const FAULTY_GAIN_STD: f64 = 1.0;

/// Standard deviation of the delay of a faulty channel, in periods of the fundamental.
const FAULTY_DELAY_STD: f64 = 0.2;

/// Largest delay of the search, in periods of the fundamental, and the number of steps up to it.
const LONGEST_DELAY: (f64, i32) = (0.5, 25);

/// Share of the amplitude that a sound channel may leave unexplained, and the scatter of this
/// share.
const UNEXPLAINED: (f64, f64) = (0.45, 0.1);

/// Logarithm of the likelihood ratio of a wrong sign. A sound channel has none.
const WRONG_SIGN: f64 = 50.0;

/// Independent values per bin and window, which overlap.
const INDEPENDENT: f64 = 0.2;

/// Share of the variance of the incoherent part that moves the factor and the delay from one record
/// to the next.
///
/// Most of the incoherent part is the same in all records. In 18 records of Painter Street, the
/// factors scatter by less than half of what an independent incoherent part would cause.
pub(crate) const INCOHERENT_SHARE: f64 = 0.25;

/// The same share if the incoherent part is noise, which differs between comparisons.
///
/// The delays of simulated sensors with white noise vary within a record by 0.3 to 0.5 of it.
const NOISE_SHARE: f64 = 0.5;

/// Scatter of the delay between records, in periods of the fundamental, below which the incoherent
/// part is noise.
const NOISE_BELOW: f64 = 0.015;

/// Standard deviation of the elastic part of the designed response, as a share of it.
const MODEL_STD: f64 = 0.1;

/// Least coherence of the channels that count as sound. Below it, they have no common motion.
const COHERENT: f64 = 0.6;

/// Share of the power of the others below which a channel that does not follow them counts as
/// dead.
const DEAD_BELOW: f64 = 0.5;

/// The expected factor and delay of a sound channel, with their scatter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Expected {
    /// Mean and standard deviation of the logarithm of the factor.
    pub(crate) ln_gain: (f64, f64),
    /// Mean and standard deviation of the delay (s).
    pub(crate) delay_s: (f64, f64),
    /// Share of the variance of the incoherent part that moves the delay.
    pub(crate) delay_share: f64,
}

/// The designed responses of a group.
#[derive(Debug, Clone)]
pub(crate) struct Responses {
    /// Response per frequency scale, channel and bin.
    of_scales: Vec<Vec<Vec<Complex<f64>>>>,
    /// Mean elastic part of the response per frequency scale and channel, as a share of the rigid
    /// one.
    elastic: Vec<Vec<f64>>,
    frequencies_hz: Vec<f64>,
    fundamental_hz: f64,
    /// Step between two delays of the search (s).
    delay_step_s: f64,
    /// `exp(iωτ)` per tried delay and bin.
    turns: Vec<Vec<Complex<f64>>>,
}

/// The relation of one channel to the common motion of others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Relation {
    /// Factor, negative for the opposite sign.
    pub(crate) gain: f64,
    pub(crate) delay_s: f64,
    /// 0 to 1.
    pub(crate) coherence: f64,
    /// Power of the channel divided by the power of the others.
    power: f64,
    /// Variance of the logarithm of the factor by the incoherent part.
    variance: f64,
    /// Variance of the delay (s²) by the incoherent part.
    delay_variance: f64,
    /// Variance of the logarithm of the factor by the error of the model.
    model_variance: f64,
}

/// The result of one comparison.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Comparison {
    /// Probability of a fault of each channel.
    pub(crate) probabilities: Vec<f64>,
    /// Relation of each channel to the sound ones. `None` for an absent channel.
    pub(crate) relations: Vec<Option<Relation>>,
}

impl Responses {
    /// Tabulates `response`, a function of channel and frequency (Hz).
    pub(crate) fn new(
        channels: usize,
        frequencies_hz: Vec<f64>,
        fundamental_hz: f64,
        response: impl Fn(usize, f64) -> Complex<f64>,
    ) -> Self {
        let of_channel = |channel: usize, scale: f64| {
            let bins = frequencies_hz.iter();
            bins.map(|hz| response(channel, scale * hz)).collect()
        };
        let of_scale = |scale: f64| -> Vec<Vec<Complex<f64>>> {
            (0..channels).map(|one| of_channel(one, scale)).collect()
        };
        let of_scales: Vec<Vec<Vec<Complex<f64>>>> = SCALES.into_iter().map(of_scale).collect();
        let elastic = |(channel, row): (usize, &Vec<Complex<f64>>)| {
            let rigid = response(channel, 0.0);
            let parts = row.iter().map(|one| (one / rigid - 1.0).norm());
            parts.sum::<f64>() / row.len() as f64
        };
        let elastic = of_scales
            .iter()
            .map(|scale| scale.iter().enumerate().map(elastic).collect())
            .collect();
        let (longest, steps) = LONGEST_DELAY;
        let delay_step_s = longest / (fundamental_hz * f64::from(steps));
        let turns = (-steps..=steps).map(|step| {
            let delay_s = f64::from(step) * delay_step_s;
            frequencies_hz.iter().map(|hz| turn(*hz, delay_s)).collect()
        });
        Self {
            of_scales,
            elastic,
            delay_step_s,
            turns: turns.collect(),
            frequencies_hz,
            fundamental_hz,
        }
    }

    /// Returns the fundamental frequency (Hz).
    pub(crate) fn fundamental_hz(&self) -> f64 {
        self.fundamental_hz
    }
}

impl Comparison {
    /// Returns `true` if the first channel does not follow the motion of the others at all.
    pub(crate) fn is_without_first(&self) -> bool {
        let first = self.relations.first().copied().flatten();
        let is_faulty = self.probabilities.first().is_some_and(|one| *one > 0.5);
        is_faulty && first.is_some_and(|relation| relation.is_unrelated())
    }
}

/// Compares the channels of a memory. `None` if the channels have no common motion.
pub(crate) fn compare(
    memory: &Memory,
    responses: &Responses,
    resonances: &Resonances,
    expected: &[Expected],
) -> Option<Comparison> {
    let present = memory.present();
    let everything: Vec<Spectra> = responses
        .of_scales
        .iter()
        .map(|scale| Spectra::new(memory, scale))
        .collect();
    let judge = Judge {
        spectra: &everything,
        responses,
        expected,
        of_resonances: resonances.ln_likelihoods(memory.wide(), memory.effective_windows()),
        effective_windows: memory.effective_windows(),
    };
    let mut used: Vec<bool> = present.to_vec();
    let mut probabilities = vec![0.0; used.len()];
    let scale = loop {
        let count = used.iter().filter(|used| **used).count();
        let (sound, scale) = judge.best_scale(&used, None);
        let candidates = (0..used.len()).filter(|channel| used[*channel] && count > 1);
        let alternatives: Vec<(usize, f64)> = candidates
            .map(|faulty| (faulty, judge.best_scale(&used, Some(faulty)).0))
            .collect();
        let most = alternatives
            .iter()
            .map(|(_, one)| *one)
            .fold(sound, f64::max);
        let weight = |likelihood: f64| libm::exp(likelihood - most);
        let total = weight(sound)
            + alternatives
                .iter()
                .map(|(_, one)| weight(*one))
                .sum::<f64>();
        for (channel, likelihood) in &alternatives {
            probabilities[*channel] = weight(*likelihood) / total;
        }
        let worst = alternatives.into_iter().max_by(|a, b| a.1.total_cmp(&b.1));
        match worst {
            // Two channels that disagree cannot tell which of them is faulty.
            Some((channel, _)) if probabilities[channel] > 0.5 && count > 2 => {
                used[channel] = false
            }
            _ => break scale,
        }
    };
    let spectra = &everything[scale];
    let sums = spectra.sums(&used);
    let relations: Vec<Option<Relation>> = (0..used.len())
        .map(|channel| present[channel].then(|| judge.relation(scale, &sums, &used, channel)))
        .collect();
    let sound = relations.iter().zip(&used).filter(|(_, used)| **used);
    let least = sound
        .filter_map(|(relation, _)| relation.as_ref())
        .map(|relation| relation.coherence)
        .fold(1.0, f64::min);
    (least >= COHERENT).then_some(Comparison {
        probabilities,
        relations,
    })
}

/// Cross-spectra divided by the responses at one frequency scale: `Σ x̄ᵢ xⱼ / (T̄ᵢ Tⱼ)`.
struct Spectra {
    channels: usize,
    bins: usize,
    values: Vec<Complex<f64>>,
}

/// Sums over the channels in use.
struct Sums {
    count: f64,
    /// `Σᵢ` of the cross-spectra to each channel, per bin and channel.
    to_channel: Vec<Complex<f64>>,
    /// Sum of all, per bin.
    total: Vec<f64>,
}

impl Spectra {
    fn new(memory: &Memory, responses: &[Vec<Complex<f64>>]) -> Self {
        let (channels, bins) = (responses.len(), memory.bins());
        let mut values = Vec::with_capacity(bins * channels * channels);
        for bin in 0..bins {
            for (i, row) in responses.iter().enumerate() {
                for (j, column) in responses.iter().enumerate() {
                    values.push(memory.cross(bin, i, j) / (row[bin].conj() * column[bin]));
                }
            }
        }
        Self {
            channels,
            bins,
            values,
        }
    }

    fn at(&self, bin: usize, i: usize, j: usize) -> Complex<f64> {
        self.values[(bin * self.channels + i) * self.channels + j]
    }

    fn sums(&self, used: &[bool]) -> Sums {
        let mut to_channel = Vec::with_capacity(self.bins * self.channels);
        let mut total = Vec::with_capacity(self.bins);
        for bin in 0..self.bins {
            let to = |j: usize| {
                let rows = (0..self.channels).filter(|i| used[*i]);
                rows.map(|i| self.at(bin, i, j)).sum::<Complex<f64>>()
            };
            let row: Vec<Complex<f64>> = (0..self.channels).map(to).collect();
            let of_used = row.iter().zip(used).filter(|(_, used)| **used);
            total.push(of_used.map(|(sum, _)| sum.re).sum());
            to_channel.extend(row);
        }
        Sums {
            count: used.iter().filter(|used| **used).count() as f64,
            to_channel,
            total,
        }
    }
}

struct Judge<'a> {
    spectra: &'a [Spectra],
    responses: &'a Responses,
    expected: &'a [Expected],
    /// What the resonances of each channel show of the frequency scale.
    of_resonances: Vec<Option<OfScales>>,
    effective_windows: f64,
}

impl Judge<'_> {
    /// Returns the logarithm of the posterior of a hypothesis, and its most probable scale.
    fn best_scale(&self, used: &[bool], faulty: Option<usize>) -> (f64, usize) {
        let mut used = used.to_vec();
        if let Some(faulty) = faulty {
            used[faulty] = false;
        }
        let prior = faulty.map_or(0.0, |_| -libm::log(PRIOR_ODDS));
        let resonances = self.of_resonances.iter().zip(&used);
        let resonances = resonances.filter_map(|(one, used)| one.as_ref().filter(|_| *used));
        let of_scales = ln_prior(resonances, &SCALES, SCALE_STD);
        let of_scale = |(index, spectra): (usize, &Spectra)| {
            let sums = spectra.sums(&used);
            let sound = (0..used.len())
                .filter(|channel| used[*channel])
                .map(|channel| {
                    let relation = self.relation(index, &sums, &used, channel);
                    relation.ln_sound(&self.expected[channel], self.responses.fundamental_hz)
                });
            // A channel alone agrees with itself.
            let sound: f64 = if sums.count > 1.0 { sound.sum() } else { 0.0 };
            let faulty = faulty.map_or(0.0, |channel| {
                let relation = self.relation(index, &sums, &used, channel);
                relation.ln_faulty(&self.expected[channel], self.responses.fundamental_hz)
            });
            (sound + faulty + prior + of_scales[index], index)
        };
        let all = self.spectra.iter().enumerate().map(of_scale);
        all.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0))
    }

    /// Relates a channel to the mean of the other channels in use.
    fn relation(&self, scale: usize, sums: &Sums, used: &[bool], channel: usize) -> Relation {
        let spectra = &self.spectra[scale];
        let elastic = &self.responses.elastic[scale];
        let own = usize::from(used[channel]) as f64;
        let others = (sums.count - own).max(1.0);
        let bins = 0..spectra.bins;
        let (mut others_power, mut crossed) = (Vec::new(), Vec::new());
        let mut power = 0.0;
        for bin in bins {
            let to = sums.to_channel[bin * spectra.channels + channel];
            let auto = spectra.at(bin, channel, channel).re;
            let all = sums.total[bin] - own * (2.0 * to.re - auto);
            others_power.push((all / (others * others)).max(0.0));
            crossed.push((to - own * auto) / Complex::from(others));
            power += auto;
        }
        let squares = elastic.iter().zip(used).filter(|(_, used)| **used);
        let of_others: f64 = squares.map(|(one, _)| one * one).sum();
        let of_model = elastic[channel].powi(2) + of_others / sums.count.max(1.0);
        Relation {
            model_variance: MODEL_STD * MODEL_STD * of_model,
            ..Relation::new(
                &others_power,
                &crossed,
                power,
                self.responses,
                self.effective_windows,
            )
        }
    }
}

impl Relation {
    fn new(
        others: &[f64],
        crossed: &[Complex<f64>],
        power: f64,
        responses: &Responses,
        effective_windows: f64,
    ) -> Self {
        let frequencies = &responses.frequencies_hz;
        let aligned = |(sum, turn): (&Complex<f64>, Complex<f64>)| (sum * turn).re;
        let at_delay = |turns: &Vec<Complex<f64>>| {
            crossed
                .iter()
                .zip(turns.iter().copied())
                .map(aligned)
                .sum::<f64>()
        };
        let tried: Vec<f64> = responses.turns.iter().map(at_delay).collect();
        let step_s = responses.delay_step_s;
        let best = (0..tried.len())
            .max_by(|a, b| tried[*a].abs().total_cmp(&tried[*b].abs()))
            .unwrap_or(0);
        let mut delay_s = (best as f64 - f64::from(LONGEST_DELAY.1)) * step_s;
        if let [before, at, after] = tried[best.saturating_sub(1)..tried.len().min(best + 2)] {
            let curvature = before - 2.0 * at + after;
            if curvature != 0.0 {
                delay_s += 0.5 * step_s * (before - after) / curvature;
            }
        }
        let sum: f64 = others.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let turns = frequencies.iter().map(|hz| turn(*hz, delay_s));
        let crossed = crossed.iter().zip(turns).map(aligned).sum::<f64>();
        // A dead channel has no power at all.
        let product = (sum * power).max(f64::MIN_POSITIVE);
        let coherence = (crossed * crossed / product).clamp(1e-6, 0.9999);
        let squares: f64 = others.iter().map(|one| one * one).sum();
        let effective_bins = sum * sum / squares.max(f64::MIN_POSITIVE);
        let count = (INDEPENDENT * effective_windows * effective_bins).max(1.0);
        let variance = (1.0 - coherence) / (2.0 * coherence * count);
        let of_bin = |(power, hz): (&f64, &f64)| power * hz * hz;
        let mean_square = others.iter().zip(frequencies).map(of_bin).sum::<f64>() / sum;
        let angular = std::f64::consts::TAU * mean_square.sqrt();
        Self {
            gain: crossed / sum,
            delay_s,
            coherence,
            power: power / sum,
            variance,
            delay_variance: variance / (angular * angular).max(f64::MIN_POSITIVE),
            model_variance: 0.0,
        }
    }

    /// Returns `true` if the channel mostly measures something else than the motion of the others.
    fn is_unrelated(&self) -> bool {
        (1.0 - self.coherence).sqrt() > UNEXPLAINED.0 + 2.0 * UNEXPLAINED.1
    }

    fn ln_gain(&self) -> f64 {
        libm::log(self.gain.abs().max(1e-3))
    }

    /// Returns the variances of the logarithm of the factor and of the delay (s²) of a sound
    /// channel.
    fn variances(&self, expected: &Expected) -> (f64, f64) {
        (
            expected.ln_gain.1.powi(2) + INCOHERENT_SHARE * self.variance + self.model_variance,
            expected.delay_s.1.powi(2) + expected.delay_share * self.delay_variance,
        )
    }

    /// Returns the logarithms of the likelihoods of a sound channel: of its factor, of its delay,
    /// and of its coherence.
    fn ln_sound_parts(&self, expected: &Expected, fundamental_hz: f64) -> [f64; 3] {
        let (of_gain, of_delay) = self.variances(expected);
        let gain = ln_normal(self.ln_gain() - expected.ln_gain.0, of_gain);
        let delay = ln_normal(
            (self.delay_s - expected.delay_s.0) * fundamental_hz,
            of_delay * fundamental_hz * fundamental_hz,
        );
        let (allowed, scatter) = UNEXPLAINED;
        let unexplained = ((1.0 - self.coherence).sqrt() - allowed).max(0.0) / scatter;
        [gain, delay, -0.5 * unexplained * unexplained]
    }

    /// Returns the logarithm of the likelihood if the channel is sound.
    fn ln_sound(&self, expected: &Expected, fundamental_hz: f64) -> f64 {
        let sound: f64 = self.ln_sound_parts(expected, fundamental_hz).iter().sum();
        sound - self.wrong_sign()
    }

    fn wrong_sign(&self) -> f64 {
        if self.gain < 0.0 { WRONG_SIGN } else { 0.0 }
    }

    /// Returns the logarithm of the likelihood if the channel has a fault of unknown size.
    ///
    /// The fault changes the factor, the delay, both, or only the coherence, with equal
    /// probability.
    fn ln_faulty(&self, expected: &Expected, fundamental_hz: f64) -> f64 {
        let [gain, delay, coherence] = self.ln_sound_parts(expected, fundamental_hz);
        let ln_gain = self.ln_gain().clamp(-2.0, 2.0);
        let any_gain = ln_normal(ln_gain, FAULTY_GAIN_STD * FAULTY_GAIN_STD);
        let any_delay = ln_normal(
            self.delay_s * fundamental_hz,
            FAULTY_DELAY_STD * FAULTY_DELAY_STD,
        );
        let faults = [
            any_gain + any_delay,
            any_gain + delay + coherence,
            gain + any_delay + coherence - self.wrong_sign(),
            gain + delay,
        ];
        let most = faults.into_iter().fold(f64::NEG_INFINITY, f64::max);
        let weights = faults.iter().map(|one| libm::exp(one - most));
        most + libm::log(weights.sum::<f64>() / faults.len() as f64)
    }

    /// Returns the fault that explains the relation best.
    pub(crate) fn fault(&self, expected: &Expected) -> Fault {
        if self.is_unrelated() {
            return match self.power < DEAD_BELOW {
                true => Fault::Dead,
                false => Fault::Disturbed,
            };
        }
        if self.gain < 0.0 {
            return Fault::Sign(-self.gain);
        }
        let (gain_variance, delay_variance) = self.variances(expected);
        let of_gain = (self.ln_gain() - expected.ln_gain.0).powi(2) / gain_variance;
        let of_delay = (self.delay_s - expected.delay_s.0).powi(2) / delay_variance;
        match of_delay > of_gain {
            true => Fault::Delay(self.delay_s),
            false => Fault::Gain(self.gain),
        }
    }
}

/// Returns the share of the variance of the incoherent part that moves the delay, for a scatter of
/// the delay between records in periods of the fundamental.
pub(crate) fn delay_share(scatter: f64) -> f64 {
    if scatter < NOISE_BELOW {
        NOISE_SHARE
    } else {
        INCOHERENT_SHARE
    }
}

/// Returns `exp(iωτ)`.
fn turn(frequency_hz: f64, delay_s: f64) -> Complex<f64> {
    let (sin, cos) = libm::sincos(std::f64::consts::TAU * frequency_hz * delay_s);
    Complex::new(cos, sin)
}

/// Returns the logarithm of a normal density, without its constant.
fn ln_normal(deviation: f64, variance: f64) -> f64 {
    -0.5 * (deviation * deviation / variance + libm::log(variance))
}
