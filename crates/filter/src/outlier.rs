//! Screening of outliers: which samples are too far off to be used.
//!
//! Source: Huang & Yuen (2023), chapter 4. Each channel compares its residual with a running scale `σ` of its own, and asks
//! how probable it is that the Gaussian tail beyond the residual holds no more points than were seen there; at one half or
//! more the sample is an outlier and leaves the update of its step. No threshold has to be chosen: what counts as far off
//! grows with the number of samples seen.
//!
//! Beyond the source: a channel that is rejected for long is either measured by a scale that is too small, which is then
//! estimated anew, or it is a faulty sensor, which stays out until its residuals are those of the model again. When most
//! channels are rejected together, it is the motion that has changed and not the sensors: scales are estimated anew.

mod probability;
mod window;

use crate::error::FilterError;
use serde::{Deserialize, Serialize};
use window::{Recent, Window};

pub use probability::{outlier_probability, upper_bound};

/// Of a sorted sample of absolute residuals this share lies below their standard deviation.
const ONE_SIGMA: f64 = 0.68;

/// A channel whose residuals exceed the filter's own deviation by this factor is no channel with a small scale.
const FAULT_FACTOR: f64 = 5.0;

/// A faulty channel is taken back when its residuals are below this many of the filter's own deviations.
const RECOVERY_FACTOR: f64 = 3.0;

/// No scale falls below this share of the filter's own deviation: a dead channel would have none.
const LEAST_SCALE: f64 = 1e-3;

/// How the first scale is found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutlierTraining {
    /// While it is found, residuals beyond this many of the filter's own deviations leave the update.
    ///
    /// One outlier that hits the filter while its covariance is wide can spoil both filter and scale for good.
    Gated(f64),
    /// All samples are used, as in the source.
    Raw,
}

/// Settings of the screening.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OutlierSettings {
    /// How the first scale is found.
    pub training: OutlierTraining,
    /// `N_tr`, samples of a channel from which its first scale is found.
    pub training_steps: usize,
    /// `N_win`, regular samples that a channel remembers.
    pub window: usize,
    /// `ε_l`: residuals up to this many scales are regular. It is no mere shortcut: with 0 half of a clean stream is rejected.
    pub lower: f64,
    /// `ε_u`: residuals from this many scales on are outliers, (4.27); infinite to screen nothing.
    pub upper: f64,
    /// Share of rejected samples of the recent ones from which on a channel is looked into.
    pub fault_share: f64,
    /// Number of those recent samples.
    pub fault_window: usize,
}

impl OutlierSettings {
    /// Makes the settings that the source recommends for a fundamental period (steps).
    ///
    /// Ten periods of training, a window of a hundred periods and at least 1000 samples, `ε_l = 2`, `ε_u` by (4.27).
    #[must_use]
    pub fn for_period(period_steps: f64) -> Self {
        let periods = |count: f64| (count * period_steps).round() as usize;
        let window = periods(100.0).max(1000);
        Self {
            training: OutlierTraining::Gated(4.0),
            training_steps: periods(10.0).max(50),
            window,
            lower: 2.0,
            upper: upper_bound(window),
            fault_share: 0.2,
            fault_window: periods(10.0).max(100),
        }
    }

    /// Returns how many recent residuals a channel remembers.
    pub(crate) fn recent_len(&self) -> usize {
        self.training_steps.max(self.fault_window)
    }

    pub(crate) fn check(&self) -> Result<(), FilterError> {
        let refuse = |what, found, allowed| {
            Err(FilterError::Setting {
                what,
                found,
                allowed,
            })
        };
        if self.window < 3 {
            return refuse(
                "window of the outlier screening",
                self.window as f64,
                "at least 3",
            );
        }
        if self.training_steps < 3 {
            return refuse(
                "training of the outlier screening",
                self.training_steps as f64,
                "at least 3 samples",
            );
        }
        if self.fault_window < 1 {
            return refuse(
                "fault window of the outlier screening",
                self.fault_window as f64,
                "at least 1",
            );
        }
        if !(self.lower >= 0.0 && self.lower <= self.upper) {
            return refuse(
                "lower bound of the outlier screening",
                self.lower,
                "from 0 to the upper bound",
            );
        }
        if let OutlierTraining::Gated(gate) = self.training
            && (gate.is_nan() || gate <= 0.0)
        {
            return refuse("gate of the outlier training", gate, "positive");
        }
        if !(self.fault_share > 0.0 && self.fault_share < 1.0) {
            return refuse(
                "fault share of the outlier screening",
                self.fault_share,
                "between 0 and 1",
            );
        }
        Ok(())
    }
}

/// What became of the last sample of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verdict {
    /// It took part in the update.
    Regular,
    /// It was too far off.
    Outlier,
    /// It may have been right, but its sensor is faulty.
    Faulty,
    /// There was none.
    Missing,
}

/// What the last sample changed for its channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum OutlierChange {
    /// Its first scale is known; the screening works.
    Trained,
    /// Its scale had been too small and was estimated anew.
    Rescaled,
    /// It is faulty from now on.
    FaultBegan,
    /// It is no longer faulty.
    FaultEnded,
}

/// What is known of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelScreen {
    window: Window,
    recent: Recent,
    scale: f64,
    trained: bool,
    faulty: bool,
    verdict: Verdict,
    change: Option<OutlierChange>,
    residual: f64,
    seen: u64,
    rejected: u64,
    evaluated: u64,
}

impl ChannelScreen {
    fn new(settings: &OutlierSettings) -> Self {
        Self {
            window: Window::new(settings.window),
            recent: Recent::new(settings.recent_len()),
            scale: 0.0,
            trained: false,
            faulty: false,
            verdict: Verdict::Missing,
            change: None,
            residual: f64::NAN,
            seen: 0,
            rejected: 0,
            evaluated: 0,
        }
    }

    /// What became of the last sample.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// What the last sample changed.
    #[must_use]
    pub fn change(&self) -> Option<OutlierChange> {
        self.change
    }

    /// Residual of the last sample (sensor units), also of a rejected one; NaN where it was missing.
    #[must_use]
    pub fn residual(&self) -> f64 {
        self.residual
    }

    /// `σ`, the running scale of the residuals (sensor units); 0 before the training ended.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Whether the screening of this channel works.
    #[must_use]
    pub fn trained(&self) -> bool {
        self.trained
    }

    /// Whether the sensor is faulty.
    #[must_use]
    pub fn faulty(&self) -> bool {
        self.faulty
    }

    /// Samples screened since the start of the filter.
    #[must_use]
    pub fn seen(&self) -> u64 {
        self.seen
    }

    /// Samples rejected, as outliers or of a faulty sensor.
    #[must_use]
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// Samples that lay between the bounds, so that their probability was evaluated.
    #[must_use]
    pub fn evaluated(&self) -> u64 {
        self.evaluated
    }

    /// Share of rejected samples among the recent ones.
    #[must_use]
    pub fn rejected_share(&self) -> f64 {
        self.recent.rejected_share()
    }

    fn retrain(&mut self) {
        self.window.clear();
        self.recent.clear();
        self.trained = false;
    }

    /// Takes a scale that was estimated anew.
    fn rescale(&mut self, scale: f64) {
        self.scale = scale;
        self.window.clear();
        self.recent.forgive();
    }

    /// Classifies a residual by (4.19) and (4.23), then updates window and scale by (4.28) and (4.29).
    fn screen(&mut self, settings: &OutlierSettings, deviation: f64) -> bool {
        self.scale = self.scale.max(LEAST_SCALE * deviation);
        let epsilon = self.residual.abs() / self.scale;
        let outlier = if epsilon <= settings.lower {
            false
        } else if epsilon >= settings.upper {
            true
        } else if settings.upper.is_infinite() {
            false // nothing is to be screened
        } else {
            self.evaluated += 1;
            outlier_probability(epsilon, self.window.at_least(epsilon), self.window.len()) >= 0.5
        };
        if !outlier {
            self.window.push(epsilon, settings.lower);
            let n = settings.window as f64;
            let mean_square = ((n - 2.0) * self.scale.powi(2) + self.residual.powi(2)) / (n - 1.0);
            self.scale = mean_square.sqrt();
        }
        outlier
    }
}

/// What is known of all channels, between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutlierState {
    channels: Vec<ChannelScreen>,
}

impl OutlierState {
    pub(crate) fn new(settings: &OutlierSettings, channels: usize) -> Self {
        // one by one: a clone would not keep the reserved room
        Self {
            channels: (0..channels)
                .map(|_| ChannelScreen::new(settings))
                .collect(),
        }
    }

    /// The channels, in the order of the observations.
    #[must_use]
    pub fn channels(&self) -> &[ChannelScreen] {
        &self.channels
    }

    /// Finds all scales anew: after the motion was forgotten, residuals are large for a while.
    pub(crate) fn retrain(&mut self) {
        self.channels.iter_mut().for_each(ChannelScreen::retrain);
    }

    /// Takes the scales of the recent residuals: while the noise was annealed, residuals were larger. `sorted` is scratch.
    pub(crate) fn rescale(&mut self, sorted: &mut Vec<f64>) {
        for channel in self
            .channels
            .iter_mut()
            .filter(|channel| channel.trained && !channel.faulty)
        {
            let scale = channel.recent.percentile(ONE_SIGMA, sorted);
            if scale > 0.0 {
                channel.rescale(scale);
            }
        }
    }

    /// Screens the residuals (N_0) of one step and replaces those that must not be used by NaN.
    ///
    /// `variances` are the filter's own, the diagonal of `S` (N_0); `sorted` is scratch. Returns how many were rejected.
    pub(crate) fn screen(
        &mut self,
        settings: &OutlierSettings,
        residuals: &mut [f64],
        variances: &[f64],
        sorted: &mut Vec<f64>,
    ) -> usize {
        let mut rejected = 0;
        for ((channel, residual), variance) in self
            .channels
            .iter_mut()
            .zip(residuals.iter_mut())
            .zip(variances)
        {
            channel.change = None;
            channel.residual = *residual;
            if !residual.is_finite() {
                channel.verdict = Verdict::Missing;
                *residual = f64::NAN;
                continue;
            }
            let deviation = variance.max(0.0).sqrt();
            channel.seen += 1;
            channel.verdict = if !channel.trained {
                train(channel, settings, deviation, sorted)
            } else if channel.faulty {
                Verdict::Faulty
            } else if channel.screen(settings, deviation) {
                Verdict::Outlier
            } else {
                Verdict::Regular
            };
            let dropped = channel.verdict != Verdict::Regular;
            channel
                .recent
                .push(residual.abs(), dropped && channel.trained);
            if dropped {
                *residual = f64::NAN;
                channel.rejected += 1;
                rejected += 1;
            }
        }
        self.look_into(settings, variances, sorted);
        rejected
    }

    /// Looks into the channels of which too much was rejected, and into the faulty ones.
    fn look_into(&mut self, settings: &OutlierSettings, variances: &[f64], sorted: &mut Vec<f64>) {
        let suspicious = |channel: &ChannelScreen| {
            channel.trained
                && channel.recent.is_full()
                && channel.recent.rejected_share() > settings.fault_share
        };
        if !self.channels.iter().any(suspicious) {
            return;
        }
        // with one or two channels nobody can tell whether the sensors or the motion have changed
        let count = self
            .channels
            .iter()
            .filter(|channel| suspicious(channel))
            .count();
        let motion_changed = self.channels.len() > 2 && 2 * count > self.channels.len();
        for (channel, variance) in self.channels.iter_mut().zip(variances) {
            if !suspicious(channel) || !channel.recent.is_due(settings.fault_window) {
                continue;
            }
            let deviation = variance.max(0.0).sqrt();
            let scale = channel
                .recent
                .percentile(ONE_SIGMA, sorted)
                .max(LEAST_SCALE * deviation);
            if channel.faulty {
                if scale <= RECOVERY_FACTOR * deviation || motion_changed {
                    channel.faulty = false;
                    channel.rescale(scale);
                    channel.change = Some(OutlierChange::FaultEnded);
                }
            } else if scale <= FAULT_FACTOR * deviation || motion_changed {
                channel.rescale(scale);
                channel.change = Some(OutlierChange::Rescaled);
            } else {
                channel.faulty = true;
                channel.change = Some(OutlierChange::FaultBegan);
            }
        }
    }
}

/// Takes one sample of the training, §4.4.1, and says whether it may be used.
fn train(
    channel: &mut ChannelScreen,
    settings: &OutlierSettings,
    deviation: f64,
    sorted: &mut Vec<f64>,
) -> Verdict {
    let residual = channel.residual.abs();
    if channel.recent.taken() + 1 >= settings.training_steps as u64 {
        channel.scale = channel
            .recent
            .percentile(ONE_SIGMA, sorted)
            .max(LEAST_SCALE * deviation);
        channel.trained = true;
        channel.change = Some(OutlierChange::Trained);
    }
    match settings.training {
        OutlierTraining::Gated(gate) if residual > gate * deviation => Verdict::Outlier,
        OutlierTraining::Gated(_) | OutlierTraining::Raw => Verdict::Regular,
    }
}

#[cfg(test)]
mod tests;
