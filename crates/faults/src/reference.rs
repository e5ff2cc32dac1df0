//! Behaviour of working sensors, learnt from earlier records.

use crate::hypothesis::Expected;
use crate::profile::{BANDS, ProfileReference};
use serde::{Deserialize, Serialize};

/// The mean relation of a channel to the other channels in one record.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ObservedRelation {
    /// Ratio of the channel to the motion that the other channels imply, always positive.
    pub gain: f64,
    /// Delay of the channel relative to the other channels (s), positive if the channel is later.
    pub delay_s: f64,
    /// Natural logarithms of the power in bands around the first natural frequency, relative to the
    /// median of the channels. `None` if a channel was missing.
    pub profile: Option<[f64; BANDS]>,
}

/// Expected behaviour of a working channel relative to the other channels, learnt from records.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorReference {
    /// Name of the channel.
    pub channel: String,
    /// Ratio of the channel to the motion that the other channels imply, always positive.
    pub gain: f64,
    /// Standard deviation of ln(gain) from record to record.
    pub ln_gain_std: f64,
    /// Delay of the channel relative to the other channels (s), positive if the channel is later.
    pub delay_s: f64,
    /// Standard deviation of the delay from record to record (s).
    pub delay_std_s: f64,
    /// Expected spectral profile around the first natural frequency. `None` in files without a
    /// profile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub profile: Option<ProfileReference>,
}

impl SensorReference {
    /// Combines records with the usual scatter, which counts as half a record. There must be at
    /// least one record.
    pub(crate) fn of(channel: &str, records: &[ObservedRelation], usual: &Expected) -> Self {
        let gains: Vec<f64> = records.iter().map(|one| libm::log(one.gain)).collect();
        let delays: Vec<f64> = records.iter().map(|one| one.delay_s).collect();
        let (ln_gain, ln_gain_std) = mean_and_std(&gains, usual.ln_gain.1);
        let (delay_s, delay_std_s) = mean_and_std(&delays, usual.delay_s.1);
        let profiles: Vec<[f64; BANDS]> = records.iter().filter_map(|one| one.profile).collect();
        let of_band = |band: usize| {
            let values: Vec<f64> = profiles.iter().map(|profile| profile[band]).collect();
            mean_and_std(&values, USUAL_PROFILE_STD)
        };
        let profile = (!profiles.is_empty()).then(|| ProfileReference {
            mean: std::array::from_fn(|band| of_band(band).0),
            std: std::array::from_fn(|band| of_band(band).1),
        });
        Self {
            channel: channel.to_owned(),
            gain: libm::exp(ln_gain),
            ln_gain_std,
            delay_s,
            delay_std_s,
            profile,
        }
    }

    /// Returns `true` if the values are possible.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let is_positive = |value: f64| value.is_finite() && value > 0.0;
        is_positive(self.gain)
            && is_positive(self.ln_gain_std)
            && is_positive(self.delay_std_s)
            && self.delay_s.is_finite()
            && self.profile.is_none_or(|profile| {
                let of_bands = profile.mean.iter().zip(profile.std);
                { of_bands }.all(|(mean, std)| mean.is_finite() && is_positive(std))
            })
    }
}

/// Number of records that the usual scatter counts as.
const USUAL_RECORDS: f64 = 0.5;

/// Usual scatter of a profile between records: standard deviation of the logarithm of a power.
///
/// Painter Street: 0.1 to 0.4 between weak earthquakes.
const USUAL_PROFILE_STD: f64 = 0.25;

/// Returns the mean of some values, and the standard deviation of a further one.
fn mean_and_std(values: &[f64], usual_std: f64) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let variance =
        (squares + USUAL_RECORDS * usual_std * usual_std) / (count - 1.0 + USUAL_RECORDS);
    (mean, (variance * (1.0 + 1.0 / count)).sqrt())
}
