//! Screening of outliers: samples that must not be used because they are too far from their
//! prediction.
//!
//! Source: Huang & Yuen (2023), chapter 4. Each channel compares its residual with its own running
//! scale `σ`. It computes the probability that the Gaussian tail beyond the residual contains no
//! more points than observed there. If this probability is at least one half, the sample is an
//! outlier and does not take part in the update. The method has no threshold to choose: the limit
//! grows with the number of observed samples.
//!
//! Two rules extend the source:
//!
//! - If a channel rejects samples for long, its scale may be too small, and it is estimated again.
//!   Otherwise, the sensor is faulty. Its samples are ignored until the residuals agree with the
//!   model again.
//! - If several sensors reject samples at the same time, the structure or its motion has changed
//!   and not the sensors. The screening pauses, and rejects only samples far beyond the latest
//!   residuals. If most channels reject samples for long, all their scales are estimated again.

mod common;
mod probability;
mod window;

use crate::error::FilterError;
use common::{CommonChange, CommonStep};
use serde::{Deserialize, Serialize};
use window::{Recent, Window};

pub use probability::{outlier_probability, upper_bound};

/// Share of a sorted sample of absolute residuals that is below their standard deviation.
const ONE_SIGMA: f64 = 0.68;

/// Largest ratio of the scale to the filter's own standard deviation at which the scale, not the
/// sensor, is wrong.
const FAULT_FACTOR: f64 = 5.0;

/// Largest ratio of the scale to the filter's own standard deviation at which a faulty channel has
/// recovered.
const RECOVERY_FACTOR: f64 = 3.0;

/// Smallest scale, relative to the filter's own standard deviation. Without it, a dead channel
/// would have a scale of zero.
const LEAST_SCALE: f64 = 1e-3;

/// Smallest number of residuals from which a scale is estimated.
const FEWEST_RESIDUALS: usize = 10;

/// Method for the first scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutlierTraining {
    /// Residuals beyond this many of the filter's own standard deviations are left out of the
    /// update during training.
    ///
    /// An outlier that occurs while the covariance is wide can otherwise spoil the filter and the
    /// scale permanently.
    Gated(f64),
    /// All samples are used, as in the source.
    Raw,
}

/// Settings of the outlier screening.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OutlierSettings {
    /// Method for the first scale.
    pub training: OutlierTraining,
    /// `N_tr`, number of samples of a channel that determine its first scale.
    pub training_steps: usize,
    /// `N_win`, number of regular samples in the window of a channel.
    pub window: usize,
    /// `ε_l`: residuals of up to this many scales are regular.
    ///
    /// This is more than a shortcut. With 0, half of a clean stream is rejected.
    pub lower: f64,
    /// `ε_u`: residuals of at least this many scales are outliers, (4.27).
    ///
    /// If it is infinite, the screening rejects nothing after training.
    pub upper: f64,
    /// Share of rejected samples among the recent ones above which a channel is examined.
    pub fault_share: f64,
    /// Interval at which such a channel is examined, in samples, and the minimum number of recent
    /// samples.
    pub fault_window: usize,
    /// Number of steps for which several sensors must reject samples before the structure or its
    /// motion counts as changed.
    pub change_steps: usize,
}

impl OutlierSettings {
    /// Creates the settings that the source recommends for a fundamental period (in steps).
    ///
    /// Training lasts ten periods, and at least 50 samples. The window covers a hundred periods,
    /// and at least 1000 samples. `ε_l` is 2, and `ε_u` follows from (4.27). A common change lasts
    /// for a quarter of a period, in which the motion rises to a peak.
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
            change_steps: periods(0.25).max(1),
        }
    }

    /// Returns the number of recent residuals that a channel stores.
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

/// Classification of the last sample of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verdict {
    /// The sample took part in the update.
    Regular,
    /// The sample was too far from its prediction.
    Outlier,
    /// The sensor is faulty, so its sample was not used.
    Faulty,
    /// The sample was missing.
    Missing,
}

/// Change of a channel due to its last sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum OutlierChange {
    /// The scale is known, and the screening has started or resumed.
    Trained,
    /// The scale was too small and has been estimated again.
    Rescaled,
    /// The channel has become faulty.
    FaultBegan,
    /// The channel has recovered from a fault.
    FaultEnded,
}

/// State of the screening of one channel.
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

    /// Returns the classification of the last sample.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// Returns the change due to the last sample, or `None` without a change.
    #[must_use]
    pub fn change(&self) -> Option<OutlierChange> {
        self.change
    }

    /// Returns the residual of the last sample (sensor units), even if the sample was rejected.
    ///
    /// It is not finite if the sample was missing.
    #[must_use]
    pub fn residual(&self) -> f64 {
        self.residual
    }

    /// Returns `σ`, the running scale of the residuals (sensor units); 0 before the first training
    /// has ended.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Returns `true` if the first scale is known, so that the screening is active.
    #[must_use]
    pub fn trained(&self) -> bool {
        self.trained
    }

    /// Returns `true` if the sensor is faulty.
    #[must_use]
    pub fn faulty(&self) -> bool {
        self.faulty
    }

    /// Returns the number of samples since the start of the filter, without missing ones.
    #[must_use]
    pub fn seen(&self) -> u64 {
        self.seen
    }

    /// Returns the number of rejected samples: outliers and samples of a faulty sensor.
    #[must_use]
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// Returns the number of samples between the two bounds, for which the probability was
    /// evaluated.
    #[must_use]
    pub fn evaluated(&self) -> u64 {
        self.evaluated
    }

    /// Returns the share of rejected samples among the recent ones.
    #[must_use]
    pub fn rejected_share(&self) -> f64 {
        self.recent.rejected_share()
    }

    fn retrain(&mut self) {
        self.window.clear();
        self.recent.clear();
        self.trained = false;
    }

    /// Sets a new estimate of the scale.
    fn rescale(&mut self, scale: f64) {
        self.scale = scale;
        self.window.clear();
        self.recent.forgive();
    }

    /// Classifies the last residual during a common change, whose residuals grow within a fraction
    /// of a period: only a sample far beyond the latest residuals is an outlier.
    fn screen_coarsely(
        &self,
        settings: &OutlierSettings,
        deviation: f64,
        sorted: &mut Vec<f64>,
    ) -> Verdict {
        let count = settings.change_steps.max(FEWEST_RESIDUALS);
        let scale = self.recent.percentile(ONE_SIGMA, count, sorted);
        if self.residual.abs() > settings.upper * scale.max(LEAST_SCALE * deviation) {
            Verdict::Outlier
        } else {
            Verdict::Regular
        }
    }

    /// Classifies the last residual by (4.19) and (4.23), then updates window and scale by (4.28)
    /// and (4.29).
    ///
    /// Returns `true` for an outlier.
    fn screen(&mut self, settings: &OutlierSettings, deviation: f64) -> bool {
        self.scale = self.scale.max(LEAST_SCALE * deviation);
        let epsilon = self.residual.abs() / self.scale;
        let outlier = if epsilon <= settings.lower {
            false
        } else if epsilon >= settings.upper {
            true
        } else if settings.upper.is_infinite() {
            false // screening is disabled
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

/// State of the screening of all channels between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutlierState {
    channels: Vec<ChannelScreen>,
    common: CommonChange,
}

impl OutlierState {
    /// `sensors` (N_0) is the number of the sensor of each channel.
    pub(crate) fn new(settings: &OutlierSettings, sensors: &[usize]) -> Self {
        // One by one, because a clone would not keep the reserved capacity.
        Self {
            channels: sensors
                .iter()
                .map(|_| ChannelScreen::new(settings))
                .collect(),
            common: CommonChange::new(settings, sensors),
        }
    }

    /// Returns the numbers of channels and sensors, or 0 if they disagree, as in a damaged
    /// checkpoint.
    pub(crate) fn shape(&self) -> (usize, usize) {
        let shape = self.common.shape();
        if shape.0 == self.channels.len() {
            shape
        } else {
            (0, 0)
        }
    }

    /// Returns the channels, in the order of the observations.
    #[must_use]
    pub fn channels(&self) -> &[ChannelScreen] {
        &self.channels
    }

    /// Returns `true` if the last step revealed a common change.
    ///
    /// Samples of several sensors then disagree with the model at the same time, because the
    /// structure or its motion has changed. The screening pauses.
    #[must_use]
    pub fn change_began(&self) -> bool {
        self.common.began()
    }

    /// Returns `true` if the training of a channel ended with the last step and it contains
    /// outliers.
    pub(crate) fn trained_with_outliers(&self, settings: &OutlierSettings) -> bool {
        self.channels.iter().any(|channel| {
            channel.change == Some(OutlierChange::Trained)
                && channel.recent.largest() > settings.upper * channel.scale
        })
    }

    /// Restarts the training of all channels that are not faulty, because residuals are large for
    /// some time after a reset of the motion. Only its own samples can make a faulty channel sound
    /// again.
    pub(crate) fn retrain(&mut self) {
        let sound = self.channels.iter_mut().filter(|channel| !channel.faulty);
        sound.for_each(ChannelScreen::retrain);
    }

    /// Estimates the scales again from the recent residuals, because the residuals were larger
    /// during annealing.
    ///
    /// `sorted` is scratch space.
    pub(crate) fn rescale(&mut self, sorted: &mut Vec<f64>) {
        for channel in self
            .channels
            .iter_mut()
            .filter(|channel| channel.trained && !channel.faulty)
        {
            let scale = channel.recent.percentile(ONE_SIGMA, usize::MAX, sorted);
            if scale > 0.0 {
                channel.rescale(scale);
            }
        }
    }

    /// Screens the residuals (N_0) of one step and sets those that must not be used to NaN.
    ///
    /// `variances` is the diagonal of the filter's own `S` (N_0). `follows_jump` is `true` while
    /// the filter follows a jump of the parameters. `sorted` is scratch space. Returns the number
    /// of rejected residuals.
    pub(crate) fn screen(
        &mut self,
        settings: &OutlierSettings,
        residuals: &mut [f64],
        variances: &[f64],
        follows_jump: bool,
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
            let is_paused = self.common.is_paused() && !channel.faulty;
            channel.verdict = if is_paused {
                channel.screen_coarsely(settings, deviation, sorted)
            } else if !channel.trained {
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
        match self.common.take(settings, &self.channels, follows_jump) {
            CommonStep::Absent => self.look_into(settings, variances, sorted),
            CommonStep::Lasts => {}
            CommonStep::Ended => self.resume(settings, variances, sorted),
        }
        rejected
    }

    /// Resumes the screening after a common change, with the scales of the residuals since then.
    fn resume(&mut self, settings: &OutlierSettings, variances: &[f64], sorted: &mut Vec<f64>) {
        let sound = self.channels.iter_mut().zip(variances);
        for (channel, variance) in sound.filter(|(channel, _)| !channel.faulty) {
            let count = settings.training_steps;
            let scale = channel.recent.percentile(ONE_SIGMA, count, sorted);
            channel.rescale(scale.max(LEAST_SCALE * variance.max(0.0).sqrt()));
            if !channel.trained {
                channel.trained = true;
                channel.change = Some(OutlierChange::Trained);
            }
        }
    }

    /// Examines the channels with too many rejected samples, including the faulty ones.
    fn look_into(&mut self, settings: &OutlierSettings, variances: &[f64], sorted: &mut Vec<f64>) {
        let suspicious = |channel: &ChannelScreen| {
            channel.trained
                && channel.recent.is_full()
                && channel.recent.rejected_share() > settings.fault_share
        };
        if !self.channels.iter().any(suspicious) {
            return;
        }
        // With one or two channels, a change of the sensors cannot be distinguished from a change
        // of the motion.
        let count = self
            .channels
            .iter()
            .filter(|channel| suspicious(channel))
            .count();
        let motion_changed = self.channels.len() > 2 && 2 * count > self.channels.len();
        // After a reset of the motion, everything agrees with a prediction that knows nothing. A
        // silent channel does not train.
        let sound = || self.channels.iter().filter(|channel| !channel.faulty);
        let mut delivering = sound()
            .filter(|channel| channel.recent.taken() > 0)
            .peekable();
        let has_witness = delivering.peek().is_some() || sound().next().is_none();
        let is_settled = has_witness && delivering.all(|channel| channel.trained);
        for (channel, variance) in self.channels.iter_mut().zip(variances) {
            if !suspicious(channel) || !channel.recent.is_due(settings.fault_window) {
                continue;
            }
            let deviation = variance.max(0.0).sqrt();
            let scale = channel
                .recent
                .percentile(ONE_SIGMA, usize::MAX, sorted)
                .max(LEAST_SCALE * deviation);
            if channel.faulty {
                if is_settled && (scale <= RECOVERY_FACTOR * deviation || motion_changed) {
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

/// Processes one training sample, §4.4.1, and returns whether it is used.
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
            .percentile(ONE_SIGMA, usize::MAX, sorted)
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
