//! Detection of a common change: the structure or its motion has changed, and not a sensor.
//!
//! Samples of several sensors then disagree with the model at the same time and for long.
//!
//! Two hypotheses compete at each step:
//!
//! - Outliers occur independently of each other, each channel with its own rate `ε`.
//! - The model is wrong for the present motion, and each channel rejects half of its samples.
//!
//! The logarithm of their likelihood ratio is summed and kept positive (E. S. Page, *Continuous
//! inspection schemes*, Biometrika 41 (1954), 100-115). One faulty sensor explains the rejections
//! of its own channels. There is therefore one sum for each sensor, which leaves that sensor out,
//! and a common change must be credible in all of these sums.

use super::{ChannelScreen, OutlierSettings, Verdict};
use serde::{Deserialize, Serialize};

/// Rate of rejections of a channel during a common change.
const RATE_IN_CHANGE: f64 = 0.5;

/// Limits of the rate of outliers of a channel: that of good samples that are rejected, and a rate
/// at which rejections no longer distinguish the two hypotheses.
const RATES: std::ops::RangeInclusive<f64> = 0.01..=0.4;

/// Sum above which a common change is credible, `ln 10⁹`.
///
/// Independent outliers reach it once in 10⁹ steps or less often, by Page's bound on the average
/// run length.
const CREDIBLE: f64 = 20.7;

/// Largest sum, so that a sum falls below [`CREDIBLE`] within some tens of regular steps.
const LARGEST: f64 = 2.0 * CREDIBLE;

/// Phase of the detection after one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CommonStep {
    /// No common change is credible.
    Absent,
    /// A common change is credible, and the screening is paused.
    Lasts,
    /// The pause has ended with this step.
    Ended,
}

/// State of the detection between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct CommonChange {
    /// Number of the sensor of each channel, and its rate of outliers.
    channels: Vec<(usize, f64)>,
    /// For each sensor: the evidence of the last step, and the sum over all other sensors.
    sensors: Vec<(f64, f64)>,
    /// Number of steps since all sums have been credible.
    credible_steps: usize,
    /// Number of steps that remain until the screening resumes.
    paused_steps: usize,
    began: bool,
}

impl CommonChange {
    pub(super) fn new(settings: &OutlierSettings, sensors: &[usize]) -> Self {
        let sensor_len = sensors.iter().max().map_or(0, |last| last + 1);
        Self {
            channels: sensors
                .iter()
                .map(|sensor| (*sensor, settings.fault_share))
                .collect(),
            sensors: vec![(0.0, 0.0); sensor_len],
            credible_steps: 0,
            paused_steps: 0,
            began: false,
        }
    }

    /// Returns the numbers of channels and sensors, or 0 if a channel has no sensor, as in a
    /// damaged checkpoint.
    pub(super) fn shape(&self) -> (usize, usize) {
        let is_whole = self
            .channels
            .iter()
            .all(|(sensor, _)| *sensor < self.sensors.len());
        if is_whole {
            (self.channels.len(), self.sensors.len())
        } else {
            (0, 0)
        }
    }

    /// Returns `true` if a common change became credible at the last step.
    pub(super) fn began(&self) -> bool {
        self.began
    }

    /// Returns `true` while the screening is paused.
    pub(super) fn is_paused(&self) -> bool {
        self.paused_steps > 0
    }

    /// Processes the verdicts of one step.
    ///
    /// A common change must last for [`OutlierSettings::change_steps`], because a disturbance of
    /// the data acquisition can affect all channels for a moment. The screening then pauses for the
    /// time in which a channel learns its scale, or as long as the filter follows a jump.
    pub(super) fn take(
        &mut self,
        settings: &OutlierSettings,
        channels: &[ChannelScreen],
        follows_jump: bool,
    ) -> CommonStep {
        self.began = false;
        if self.is_paused() {
            if self.paused_steps > 1 || !follows_jump {
                self.paused_steps -= 1;
            }
            return if self.is_paused() {
                CommonStep::Lasts
            } else {
                CommonStep::Ended
            };
        }
        self.sensors.iter_mut().for_each(|(own, _)| *own = 0.0);
        let memory = (settings.fault_window as f64).recip();
        let mut total = 0.0;
        for ((sensor, rate), channel) in self.channels.iter_mut().zip(channels) {
            let evidence = evidence(*rate, channel.verdict);
            total += evidence;
            self.sensors[*sensor].0 += evidence;
            match channel.verdict {
                Verdict::Outlier => *rate += memory * (1.0 - *rate),
                Verdict::Regular => *rate -= memory * *rate,
                Verdict::Faulty | Verdict::Missing => {}
            }
        }
        let mut smallest = f64::INFINITY;
        for (own, of_others) in &mut self.sensors {
            *of_others = (*of_others + total - *own).clamp(0.0, LARGEST);
            smallest = smallest.min(*of_others);
        }
        self.credible_steps = if smallest > CREDIBLE {
            self.credible_steps + 1
        } else {
            0
        };
        if self.credible_steps < settings.change_steps {
            return CommonStep::Absent;
        }
        self.sensors.fill((0.0, 0.0));
        self.credible_steps = 0;
        self.paused_steps = settings.training_steps;
        self.began = true;
        CommonStep::Lasts
    }
}

/// Returns the logarithm of the likelihood ratio of a verdict, for a channel with this rate of
/// outliers.
fn evidence(rate: f64, verdict: Verdict) -> f64 {
    let rate = rate.clamp(*RATES.start(), *RATES.end());
    match verdict {
        Verdict::Outlier => (RATE_IN_CHANGE / rate).ln(),
        Verdict::Regular => ((1.0 - RATE_IN_CHANGE) / (1.0 - rate)).ln(),
        Verdict::Faulty | Verdict::Missing => 0.0,
    }
}
