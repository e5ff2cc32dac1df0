//! Events in a simulation: damage, modulated excitation, and sensor faults.

/// Events in a simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulationPlan {
    pub(crate) seed: u64,
    pub(crate) modulation: Option<Modulation>,
    pub(crate) damage: Vec<Damage>,
    pub(crate) dropped_share: f64,
    pub(crate) spikes: Spikes,
    /// Clock offset of each node (s).
    pub(crate) clock_offsets_s: Vec<f64>,
    /// Clock drift of each node (parts per million).
    pub(crate) clock_drifts_ppm: Vec<f64>,
    /// Noise levels (from 0) that differ from the stated levels, with their actual standard
    /// deviations.
    pub(crate) levels: Vec<(usize, f64)>,
    pub(crate) faults: Vec<Fault>,
}

/// A temporary fault of a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fault {
    pub(crate) node: usize,
    pub(crate) kind: FaultKind,
    /// Start and end of the fault (s).
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    /// Height of a bias, in standard deviations of the channel's noise.
    pub(crate) height: f64,
}

/// Effect of a fault on the samples of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FaultKind {
    /// All channels are off by a constant.
    Bias,
    /// The node delivers no samples.
    Silence,
}

impl Fault {
    /// Returns a sample of the node with the effect of the fault at a time; NaN if the node is
    /// silent.
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

/// A single swell of the excitation amplitude.
///
/// `W(t) = 1 + s exp(1 − s)` with `s = (t − t_a)/t_b` from `t_a` on, and 1 before. The maximum is 2
/// at `t_a + t_b`. Huang & Yuen (2023), §3.4.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Modulation {
    /// `t_a` (s).
    pub(crate) start_s: f64,
    /// `t_b` (s).
    pub(crate) rise_s: f64,
}

impl Modulation {
    pub(crate) fn amplitude(self, time_s: f64) -> f64 {
        let s = ((time_s - self.start_s) / self.rise_s).max(0.0);
        1.0 + s * (1.0 - s).exp()
    }
}

/// Number of equal steps of a simulated ramp of damage, each with its own exact recursion.
const RAMP_STEPS: f64 = 256.0;

/// A loss of one parameter (share of nominal), sudden or as a ramp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Damage {
    pub(crate) parameter: usize,
    pub(crate) at_s: f64,
    pub(crate) over_s: f64,
    pub(crate) loss: f64,
}

impl Damage {
    /// Returns the lost share of nominal at `time_s`.
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

/// Single samples with large errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Spikes {
    /// Share of samples with a spike.
    pub(crate) share: f64,
    /// Height in standard deviations of the channel's noise.
    pub(crate) height: f64,
    /// Effect of a spike on the sample.
    pub(crate) kind: SpikeKind,
}

/// Effect of a spike on a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SpikeKind {
    /// The spike adds its height, with either sign.
    Added,
    /// The spike replaces the sample by a value of at most its height, with either sign.
    Replaced,
}

impl SimulationPlan {
    /// Default height of a spike in standard deviations of the noise: clearly an outlier.
    pub(crate) const SPIKE_HEIGHT: f64 = 50.0;

    /// Default height of a bias in standard deviations of the noise: hidden in a single sample.
    pub(crate) const BIAS_HEIGHT: f64 = 4.0;

    /// Creates a plan without events for a structure with `nodes` sensor nodes.
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

    /// Returns the seed from the file.
    #[must_use]
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Returns the time (s) by which the clock of each node is ahead, in node order.
    #[must_use]
    pub fn clock_offsets_s(&self) -> &[f64] {
        &self.clock_offsets_s
    }

    /// Returns the rate excess of the clock of each node (parts per million), in node order.
    #[must_use]
    pub fn clock_drifts_ppm(&self) -> &[f64] {
        &self.clock_drifts_ppm
    }
}
