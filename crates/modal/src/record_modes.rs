//! The modes of a whole record: the modes of its epochs, tracked and combined.

use crate::ModalError;
use crate::identify::{Mode, Source};
use crate::ladder::{LadderEpoch, LadderModes};
use crate::tracking::{LEAST_PRESENCE, ModeId, Tracker};
use serde::Serialize;
use std::collections::BTreeMap;

/// Relative difference of the frequencies of one machine in two epochs.
pub const SAME_MACHINE: f64 = 0.005;

/// The modes of one epoch of a record.
#[derive(Debug, Clone, PartialEq)]
pub struct EpochModes {
    /// Position of the frame after the epoch.
    pub end: u64,
    /// Length of the epoch (s).
    pub length_s: f64,
    /// Modes that were identified in the epoch.
    pub found: LadderModes,
    /// For each mode of `found`, the tracked mode to which it belongs.
    pub of_mode: Vec<Option<ModeId>>,
}

/// A mode over all epochs of a record.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModeSummary {
    /// Number of the tracked mode; `None` for a machine.
    #[serde(skip)]
    pub id: Option<ModeId>,
    /// Mode or machine.
    pub source: Source,
    /// Mean frequency of the epochs, weighted by their variances (Hz).
    pub frequency_hz: f64,
    /// Standard deviation of the frequency of one epoch, as stated: root mean square (Hz).
    pub frequency_std_hz: f64,
    /// Standard deviation of the frequencies of the epochs; `None` with one epoch (Hz).
    pub frequency_scatter_hz: Option<f64>,
    /// Mean damping ratio of the epochs, weighted by their variances.
    pub damping: f64,
    /// Standard deviation of the damping ratio of one epoch, as stated.
    pub damping_std: f64,
    /// Standard deviation of `damping`, from the stated ones of the epochs.
    pub damping_of_mean_std: f64,
    /// Share of the epochs in which the mode was found, 0 to 1.
    pub epochs: f64,
    /// Mean modal phase collinearity, 0 to 1. A real mode shape has 1.
    pub collinearity: f64,
    /// Mean spectral kurtosis at the frequency: 0 for random motion, −1 for a sine.
    pub kurtosis: Option<f64>,
    /// The mode of the epoch with the smallest standard deviation, for its shape.
    #[serde(skip)]
    pub best: Mode,
}

/// Tracks the modes of the epochs of a record.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordModes {
    tracker: Tracker,
    epochs: Vec<EpochModes>,
}

impl Default for RecordModes {
    fn default() -> Self {
        Self {
            tracker: Tracker::new(1),
            epochs: Vec::new(),
        }
    }
}

impl RecordModes {
    /// Identifies an epoch and assigns its modes. Every new mode is adopted, because a record is
    /// judged as a whole.
    ///
    /// # Errors
    /// Returns an error if too few channels are usable, or if a decomposition does not converge.
    pub fn push(&mut self, epoch: &LadderEpoch) -> Result<(), ModalError> {
        self.take(epoch, epoch.identify()?);
        Ok(())
    }

    /// Assigns the modes of an epoch that [`LadderEpoch::identify()`] has found, as
    /// [`Self::push()`] does.
    pub fn take(&mut self, epoch: &LadderEpoch, found: LadderModes) {
        let assignment = self.tracker.update(&found.modes);
        for id in assignment.of_mode.iter().flatten() {
            self.tracker.adopt(*id);
        }
        let first = epoch.bands.first();
        self.epochs.push(EpochModes {
            end: first.map_or(0, |epoch| epoch.end),
            length_s: first.map_or(0.0, |epoch| epoch.length_s),
            found,
            of_mode: assignment.of_mode,
        });
    }

    /// Returns the epochs.
    #[must_use]
    pub fn epochs(&self) -> &[EpochModes] {
        &self.epochs
    }

    /// Returns the modes that are present in at least 30 % of the epochs, and the machines, in
    /// order of frequency.
    #[must_use]
    pub fn summary(&self) -> Vec<ModeSummary> {
        let mut groups: BTreeMap<ModeId, Vec<&Mode>> = BTreeMap::new();
        let mut machines: Vec<Vec<&Mode>> = Vec::new();
        for epoch in &self.epochs {
            for (mode, id) in epoch.found.modes.iter().zip(&epoch.of_mode) {
                match id {
                    Some(id) => groups.entry(*id).or_default().push(mode),
                    None => add_machine(&mut machines, mode),
                }
            }
        }
        let all = self.epochs.len() as f64;
        let groups = groups.into_iter().map(|(id, modes)| (Some(id), modes));
        let machines = machines.into_iter().map(|modes| (None, modes));
        let mut summaries: Vec<ModeSummary> = groups
            .chain(machines)
            .filter(|(_, modes)| modes.len() as f64 >= LEAST_PRESENCE * all)
            .filter_map(|(id, modes)| summary(id, &modes, all))
            .collect();
        summaries.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
        summaries
    }
}

fn add_machine<'m>(machines: &mut Vec<Vec<&'m Mode>>, mode: &'m Mode) {
    let is_same = |group: &&mut Vec<&Mode>| {
        group.iter().any(|known| {
            (known.frequency_hz - mode.frequency_hz).abs() < SAME_MACHINE * mode.frequency_hz
        })
    };
    match machines.iter_mut().find(is_same) {
        Some(group) => group.push(mode),
        None => machines.push(vec![mode]),
    }
}

/// Combines the estimates of several epochs. Returns `None` without an epoch.
fn summary(id: Option<ModeId>, modes: &[&Mode], epochs: f64) -> Option<ModeSummary> {
    let best = modes
        .iter()
        .min_by(|a, b| a.frequency_std_hz.total_cmp(&b.frequency_std_hz))?;
    let n = modes.len() as f64;
    let weight = |std: f64| std.max(f64::MIN_POSITIVE.sqrt()).powi(-2);
    let weights = |std: fn(&Mode) -> f64| modes.iter().map(|mode| weight(std(mode))).sum::<f64>();
    let weighted = |value: fn(&Mode) -> f64, std: fn(&Mode) -> f64| {
        let sum = modes.iter().map(|mode| value(mode) * weight(std(mode)));
        sum.sum::<f64>() / weights(std)
    };
    let rms = |std: fn(&Mode) -> f64| {
        (modes.iter().map(|mode| std(mode).powi(2)).sum::<f64>() / n).sqrt()
    };
    let mean = modes.iter().map(|mode| mode.frequency_hz).sum::<f64>() / n;
    let squares: f64 = modes
        .iter()
        .map(|mode| (mode.frequency_hz - mean).powi(2))
        .sum();
    let kurtoses: Vec<f64> = modes.iter().filter_map(|mode| mode.kurtosis).collect();
    Some(ModeSummary {
        id,
        source: best.source,
        frequency_hz: weighted(|mode| mode.frequency_hz, |mode| mode.frequency_std_hz),
        frequency_std_hz: rms(|mode| mode.frequency_std_hz),
        frequency_scatter_hz: (modes.len() > 1).then(|| (squares / (n - 1.0)).sqrt()),
        damping: weighted(|mode| mode.damping, |mode| mode.damping_std),
        damping_std: rms(|mode| mode.damping_std),
        damping_of_mean_std: weights(|mode| mode.damping_std).powf(-0.5),
        epochs: n / epochs,
        collinearity: modes.iter().map(|mode| mode.collinearity).sum::<f64>() / n,
        kurtosis: (!kurtoses.is_empty())
            .then(|| kurtoses.iter().sum::<f64>() / kurtoses.len() as f64),
        best: (*best).clone(),
    })
}
