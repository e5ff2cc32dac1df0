//! Whether the natural frequencies of the model agree with the measured ones.
//!
//! After each epoch of the declared modes, the means of the estimates over this epoch give the
//! frequencies of the model. A mode contradicts the model if their frequencies differ in several
//! consecutive epochs ([`PartModel::compare`]). This module has no clock and no network.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{Complex, DMatrix, DVector};
use spandrel_bus::{Estimate, EstimateBlock, FitVerdict, ModeDisplay, ModeState, Name, Phase};
use spandrel_modal::{Comparison, PartModel, SeenMode};
use spandrel_structure::Structure;

use crate::AlertError;

/// Number of consecutive epochs in which a mode must differ from the model. After a change of the
/// structure, both can differ for two epochs, because the filter follows the change sooner.
const EPOCHS_APART: u32 = 3;
/// Number of estimates of an epoch that are averaged.
const SAMPLES: i64 = 32;
/// Smallest number of them with which an epoch is compared. Gaps of the estimates cost some.
const LEAST_SAMPLES: usize = 24;
/// Number of epochs for which estimates are kept. During a replay at full speed, the modes of an
/// epoch arrive late.
const EPOCHS_KEPT: i64 = 4;

/// The comparison of the model of one structure with its declared modes.
#[derive(Debug)]
pub(crate) struct ModelCheck {
    model: PartModel,
    /// The parameter of each part of the model.
    parts: Vec<Part>,
    /// Names of the channels of the model.
    channels: Vec<String>,
    declared_modes: usize,
    /// Interval of the samples (ns).
    step_ns: i64,
    /// Oldest first.
    samples: VecDeque<Sample>,
    /// The modes of the newest epoch that have arrived.
    epoch: BTreeMap<Name, ModeDisplay>,
    /// End of the last compared epoch (ns).
    compared_ns: Option<i64>,
    /// Number of consecutive epochs in which a mode differed from the model.
    epochs_apart: BTreeMap<Name, u32>,
    /// The modes that contradict the model, in words.
    contradicting: Option<String>,
    /// Whether the contradiction comes from a checkpoint, which contains no numbers of epochs.
    is_resumed: bool,
}

/// A parameter that scales a stiffness.
#[derive(Debug)]
struct Part {
    /// Index of the parameter in state order.
    parameter: usize,
    /// Its prior mean, at which the change of ln k is 0.
    prior_mean: f64,
}

/// The estimate at one frame.
#[derive(Debug)]
struct Sample {
    time_ns: i64,
    /// Stiffness parameters, and their covariance. `None` if the estimate has no meaning.
    stiffness: Option<(DVector<f64>, DMatrix<f64>)>,
}

/// Whether the model agrees with the modes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Agreement {
    Agrees,
    Contradicted,
}

/// A change of the agreement.
#[derive(Debug, PartialEq)]
pub(crate) struct Change {
    /// End of the epoch (ns).
    pub(crate) time_ns: i64,
    pub(crate) agreement: Agreement,
    /// The first mode that contradicts the model, or the structure.
    pub(crate) subject: String,
    pub(crate) why: String,
}

impl ModelCheck {
    /// Creates the comparison before any data. `None` if the structure has no model or no mode to
    /// compare.
    ///
    /// # Errors
    /// Returns an error if the matrices of the model do not fit, which reading the structure file
    /// has excluded.
    pub(crate) fn new(structure: &Structure) -> Result<Option<Self>, AlertError> {
        let (Some(plan), Some(model)) = (structure.modal(), structure.compared_model()) else {
            return Ok(None);
        };
        let parameters = structure.parameters().iter().enumerate();
        let stiffnesses = parameters.filter(|(_, parameter)| parameter.is_stiffness());
        let parts = stiffnesses.map(|(index, parameter)| Part {
            parameter: index,
            prior_mean: parameter.mean(),
        });
        Ok(Some(Self {
            model: model?,
            parts: parts.collect(),
            channels: plan.names.clone(),
            declared_modes: plan.modes.len(),
            step_ns: (plan.settings.epoch_s * 1e9) as i64 / SAMPLES,
            samples: VecDeque::new(),
            epoch: BTreeMap::new(),
            compared_ns: None,
            epochs_apart: BTreeMap::new(),
            contradicting: None,
            is_resumed: false,
        }))
    }

    /// Resumes the contradiction that a checkpoint contains. The next compared epoch confirms or
    /// ends it.
    pub(crate) fn resume_contradicted(&mut self) {
        self.is_resumed = true;
        self.contradicting = Some("as before the restart".to_owned());
    }

    /// Returns the modes that contradict the model, in words. `None` if none does.
    pub(crate) fn contradicting(&self) -> Option<&str> {
        self.contradicting.as_deref()
    }

    /// Takes samples of the estimates of a block.
    pub(crate) fn take_estimates(&mut self, block: &EstimateBlock) {
        let Some(grid) = block.grid() else {
            return; // a checked block has a grid
        };
        for (number, estimate) in block.iter() {
            let time_ns = grid.time_ns(number);
            if let Some(last) = self.samples.back() {
                if time_ns < last.time_ns {
                    self.samples.clear(); // a record is replayed again
                } else if time_ns - last.time_ns < self.step_ns {
                    // One estimate without a meaning counts for its whole interval.
                    let is_usable = last.stiffness.is_none() || is_usable(estimate);
                    if !is_usable && let Some(last) = self.samples.back_mut() {
                        last.stiffness = None;
                    }
                    continue;
                }
            }
            let stiffness = match is_usable(estimate) {
                true => self.stiffness(estimate),
                false => None,
            };
            self.samples.push_back(Sample { time_ns, stiffness });
            let oldest_ns = time_ns.saturating_sub(EPOCHS_KEPT * SAMPLES * self.step_ns);
            while self
                .samples
                .front()
                .is_some_and(|first| first.time_ns < oldest_ns)
            {
                self.samples.pop_front();
            }
        }
    }

    /// Takes one mode. Repeated messages have no effect.
    pub(crate) fn take_mode(&mut self, display: ModeDisplay) {
        let newest_ns = self.epoch.values().map(|mode| mode.time_ns).next();
        if newest_ns != Some(display.time_ns) {
            self.epoch.clear();
        }
        self.epoch.insert(display.mode.clone(), display);
    }

    /// Compares the newest epoch with the model, once all its modes and estimates have arrived.
    /// Returns a change of the agreement.
    pub(crate) fn compare(&mut self) -> Option<Change> {
        let first = self.epoch.values().next()?;
        let (time_ns, epoch_s) = (first.time_ns, first.epoch_s);
        let structure = first.structure.to_string();
        let last_ns = self.samples.back()?.time_ns;
        // Samples at a low rate are up to two intervals apart.
        if self.epoch.len() < self.declared_modes
            || self.compared_ns == Some(time_ns)
            || last_ns < time_ns.saturating_sub(2 * self.step_ns)
        {
            return None;
        }
        self.compared_ns = Some(time_ns);
        let (mean, covariance) = self.mean(time_ns, (epoch_s * 1e9) as i64)?;
        let modes: Vec<&ModeDisplay> = self.epoch.values().collect();
        let seen: Vec<Option<SeenMode>> = modes.iter().map(|mode| self.seen(mode)).collect();
        let compared = self.model.compare(&mean, &covariance, &seen).ok()?;
        let mut why = Vec::new();
        let mut subject = None;
        let is_compared = compared.iter().any(Option::is_some);
        for (mode, compared) in modes.into_iter().zip(compared) {
            let count = self.epochs_apart.entry(mode.mode.clone()).or_default();
            match compared {
                Some(found) if found.is_apart && self.is_resumed => *count = EPOCHS_APART,
                Some(found) if found.is_apart => *count = count.saturating_add(1),
                Some(_) => *count = 0,
                None if mode.state == ModeState::Lost => *count = 0, // nothing is stated about it
                None => {}
            }
            if *count >= EPOCHS_APART {
                subject = subject.or_else(|| Some(mode.mode.to_string()));
                why.extend(compared.and_then(|found| in_words(mode, &found)));
            }
        }
        if !is_compared {
            return None;
        }
        self.is_resumed = false;
        let was_contradicted = self.contradicting.is_some();
        match subject {
            Some(subject) => {
                // A mode that is missing now keeps the words of its last epoch.
                if !why.is_empty() {
                    self.contradicting = Some(why.join("; "));
                }
                let why = self.contradicting.clone().unwrap_or_default();
                (!was_contradicted).then_some(Change {
                    time_ns,
                    agreement: Agreement::Contradicted,
                    subject,
                    why,
                })
            }
            None => {
                self.contradicting = None;
                was_contradicted.then(|| Change {
                    time_ns,
                    agreement: Agreement::Agrees,
                    subject: structure,
                    why:
                        "no mode differs from the model by more than both intervals and the error \
                          of a usable model"
                            .to_owned(),
                })
            }
        }
    }

    /// Returns ln of the stiffnesses relative to the prior means, averaged over an epoch, and their
    /// covariance with the scatter within the epoch. `None` if too few estimates have a meaning.
    fn mean(&self, end_ns: i64, length_ns: i64) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let start_ns = end_ns.saturating_sub(length_ns);
        let within = self
            .samples
            .iter()
            .filter(|sample| (start_ns..=end_ns).contains(&sample.time_ns));
        // A jump or a silent excitation leaves estimates that do not belong to the whole epoch.
        let stiffnesses: Option<Vec<_>> = within.map(|sample| sample.stiffness.as_ref()).collect();
        let stiffnesses = stiffnesses.filter(|all| all.len() >= LEAST_SAMPLES)?;
        let parts = self.parts.len();
        let share = 1.0 / stiffnesses.len() as f64;
        let mut mean = DVector::zeros(parts);
        for (of_sample, _) in &stiffnesses {
            mean += of_sample * share;
        }
        let mut covariance = DMatrix::zeros(parts, parts);
        for (of_sample, own) in &stiffnesses {
            let deviation = of_sample - &mean;
            covariance += (own + &deviation * deviation.transpose()) * share;
        }
        let relative = DMatrix::from_diagonal(&mean.map(f64::recip));
        let prior = self.parts.iter().map(|part| part.prior_mean);
        let ratio = mean.component_div(&DVector::from_iterator(parts, prior));
        let is_positive = ratio.iter().all(|ratio| *ratio > 0.0);
        is_positive.then(|| (ratio.map(f64::ln), &relative * covariance * &relative))
    }

    fn stiffness(&self, estimate: &Estimate) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let indices: Vec<usize> = self.parts.iter().map(|part| part.parameter).collect();
        let mean: Option<Vec<f64>> = indices
            .iter()
            .map(|index| estimate.mean.get(*index).copied())
            .collect();
        let covariance: Option<Vec<f64>> = indices
            .iter()
            .flat_map(|column| indices.iter().map(move |row| (*row, *column)))
            .map(|(row, column)| estimate.covariance(row, column))
            .collect();
        let len = indices.len();
        Some((
            DVector::from_vec(mean?),
            DMatrix::from_vec(len, len, covariance?),
        ))
    }

    /// Returns a mode as the model is compared with it. `None` if the mode is missing or cannot be
    /// distinguished from another one, or if a machine runs at its frequency.
    fn seen(&self, display: &ModeDisplay) -> Option<SeenMode> {
        let is_reliable = display.state == ModeState::Tracked && !display.machine;
        let estimate = display.estimate.as_ref().filter(|_| is_reliable)?;
        let of = |channel: &String| {
            let mut values = estimate.shape.iter();
            values.find(|value| value.channel == *channel)
        };
        let shape: Vec<_> = self.channels.iter().map(of).collect::<Option<_>>()?;
        let complex = |[re, im]: [f64; 2]| Complex::new(re, im);
        let values: Vec<_> = shape.iter().map(|value| complex(value.value)).collect();
        let std: Vec<f64> = shape.iter().map(|value| value.std).collect();
        let seen = SeenMode::new(estimate.frequency_hz, estimate.frequency_std_hz);
        Some(seen.with_shape(&values, &std))
    }
}

/// Returns `true` if an estimate has a meaning and belongs to weak motion.
fn is_usable(estimate: &Estimate) -> bool {
    let flags = &estimate.flags;
    flags.phase == Phase::Working
        && !flags.restarted
        && !flags.follows_jump
        && flags.fit != Some(FitVerdict::Contradicted)
        && flags.strong_motion.is_none()
}

fn in_words(mode: &ModeDisplay, found: &Comparison) -> Option<String> {
    let estimate = mode.estimate.as_ref()?;
    Some(format!(
        "mode {} was measured at {:.4} ± {:.4} Hz, and the model has it at {:.4} ± {:.4} Hz",
        mode.mode,
        estimate.frequency_hz,
        estimate.frequency_std_hz,
        found.model_hz,
        found.model_std_hz,
    ))
}

#[cfg(test)]
mod tests;
