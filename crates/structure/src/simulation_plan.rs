//! What a simulated structure goes through: damage, modulated excitation, and the faults of its sensors.

/// A simulated course of events.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulationPlan {
    pub(crate) seed: u64,
    pub(crate) modulation: Option<Modulation>,
    pub(crate) damage: Vec<Damage>,
    pub(crate) dropped_share: f64,
    pub(crate) spikes: Spikes,
    /// One per node, s.
    pub(crate) clock_offsets_s: Vec<f64>,
    /// One per node, parts per million.
    pub(crate) clock_drifts_ppm: Vec<f64>,
    /// Noise levels (from 0) that are not what the file states: their actual standard deviations.
    pub(crate) levels: Vec<(usize, f64)>,
    pub(crate) faults: Vec<Fault>,
}

/// What is wrong with a node for a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fault {
    pub(crate) node: usize,
    pub(crate) kind: FaultKind,
    /// From when until when (s).
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    /// Of a bias, in standard deviations of the channel's noise.
    pub(crate) height: f64,
}

/// What a fault does to the samples of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FaultKind {
    /// All channels are off by a constant.
    Bias,
    /// There are none.
    Silence,
}

impl Fault {
    /// Returns what a sample of the node becomes at a time.
    pub(crate) fn apply(&self, sample: f64, noise_std: f64, time_s: f64) -> f64 {
        if !(self.from_s..self.until_s).contains(&time_s) {
            return sample;
        }
        match self.kind {
            FaultKind::Bias => sample + self.height * noise_std,
            FaultKind::Silence => f64::NAN,
        }
    }
}

/// Swells the excitation once: amplitude `W(t) = 1 + s exp(1 − s)`, `s = (t − t_a)/t_b` from `t_a` on, 1 before.
///
/// Largest, 2, at `t_a + t_b`. Huang & Yuen (2023), §3.4.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Modulation {
    /// `t_a` (s)
    pub(crate) start_s: f64,
    /// `t_b` (s)
    pub(crate) rise_s: f64,
}

impl Modulation {
    pub(crate) fn amplitude(self, time_s: f64) -> f64 {
        let s = ((time_s - self.start_s) / self.rise_s).max(0.0);
        1.0 + s * (1.0 - s).exp()
    }
}

/// A ramp of damage is simulated in this many equal steps, each with its own exact recursion.
const RAMP_STEPS: f64 = 256.0;

/// A loss of one parameter (share of nominal), at once or as a ramp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Damage {
    pub(crate) parameter: usize,
    pub(crate) at_s: f64,
    pub(crate) over_s: f64,
    pub(crate) loss: f64,
}

impl Damage {
    /// Returns the share of nominal that is lost at `time_s`.
    pub(crate) fn lost(&self, time_s: f64) -> f64 {
        let progress = if self.over_s > 0.0 {
            (time_s - self.at_s) / self.over_s
        } else {
            1.0
        };
        let reached = (progress.clamp(0.0, 1.0) * RAMP_STEPS).floor() / RAMP_STEPS;
        if time_s < self.at_s {
            0.0
        } else {
            self.loss * reached
        }
    }
}

/// Single samples that are off by far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Spikes {
    /// Share of the samples.
    pub(crate) share: f64,
    /// Height in standard deviations of the channel's noise.
    pub(crate) height: f64,
    /// What a spike does to the sample.
    pub(crate) kind: SpikeKind,
}

/// What a spike does to a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SpikeKind {
    /// It adds its height, with either sign.
    Added,
    /// It takes the place of the sample, anywhere up to its height on either side of zero.
    Replaced,
}

impl SimulationPlan {
    /// Height of a spike in standard deviations of the noise, unless the file says otherwise: beyond any doubt.
    pub(crate) const SPIKE_HEIGHT: f64 = 50.0;

    /// Height of a bias in standard deviations of the noise, unless the file says otherwise: hidden in a single sample.
    pub(crate) const BIAS_HEIGHT: f64 = 4.0;

    /// Makes a plan in which nothing happens to a structure with `nodes` sensor nodes.
    pub(crate) fn uneventful(nodes: usize) -> Self {
        Self {
            seed: 0,
            modulation: None,
            damage: Vec::new(),
            dropped_share: 0.0,
            spikes: Spikes {
                share: 0.0,
                height: Self::SPIKE_HEIGHT,
                kind: SpikeKind::Added,
            },
            clock_offsets_s: vec![0.0; nodes],
            clock_drifts_ppm: vec![0.0; nodes],
            faults: Vec::new(),
            levels: Vec::new(),
        }
    }

    /// Returns the seed of the file.
    #[must_use]
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Returns how far the clock of each node runs ahead (s), in the order of the nodes.
    #[must_use]
    pub fn clock_offsets_s(&self) -> &[f64] {
        &self.clock_offsets_s
    }

    /// Returns how much faster the clock of each node runs (parts per million), in the order of the nodes.
    #[must_use]
    pub fn clock_drifts_ppm(&self) -> &[f64] {
        &self.clock_drifts_ppm
    }
}
