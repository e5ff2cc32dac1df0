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
    ///
    /// `of_group_s` is the result of [`delay_scatter_s`]. It limits the scatter of the delay,
    /// because half a record of the usual scatter can be larger than all that the records have
    /// shown.
    pub(crate) fn of(
        channel: &str,
        records: &[ObservedRelation],
        usual: &Expected,
        of_group_s: Option<f64>,
    ) -> Self {
        let gains: Vec<f64> = records.iter().map(|one| libm::log(one.gain)).collect();
        let delays: Vec<f64> = records.iter().map(|one| one.delay_s).collect();
        let (ln_gain, ln_gain_std) = mean_and_std(&gains, usual.ln_gain.1);
        let (delay_s, pooled_std_s) = mean_and_std(&delays, usual.delay_s.1);
        let further = (1.0 + 1.0 / delays.len() as f64).sqrt();
        let measured = of_group_s.zip(std(&delays));
        let measured_std_s = measured.map(|(of_group_s, own_s)| of_group_s.max(own_s) * further);
        let delay_std_s = measured_std_s.map_or(pooled_std_s, |std_s| std_s.min(pooled_std_s));
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

/// Least scatter of the delays, in periods of the fundamental.
///
/// A loss of stiffness and more damping also move the delays. In a building of five storeys whose
/// frequency falls by a fifth, and whose damping ratio grows from 2 to 10 %, they move by up to
/// 0.36 %.
const LEAST_DELAY_STD: f64 = 0.003;

/// Returns an upper bound of the standard deviation of a delay between records (s), from the delays
/// of all channels of a group in the records. `None` if no channel has two records.
///
/// The channels are assumed to have a common scatter σ. Their sum of squares divided by σ² then has
/// a χ² distribution. Its degrees of freedom are those of the records times those of the channels,
/// because each channel is compared with the mean of the others. The bound holds with a probability
/// of 95 %.
pub(crate) fn delay_scatter_s(of_channels: &[Vec<f64>], period_s: f64) -> Option<f64> {
    let channels = of_channels.len() as f64;
    let of_channels = of_channels.iter().filter(|delays| delays.len() > 1);
    let (mut squares, mut freedom) = (0.0, 0.0);
    for delays in of_channels {
        squares += sum_of_squares(delays);
        freedom += (delays.len() - 1) as f64 * (channels - 1.0) / channels;
    }
    (freedom > 0.0).then(|| {
        let bound = (squares / low_chi_square(freedom)).sqrt();
        bound.max(LEAST_DELAY_STD * period_s)
    })
}

/// Returns the 0.05 quantile of the χ² distribution, slightly too low for few degrees of freedom.
///
/// Source: E. B. Wilson and M. M. Hilferty, *The distribution of chi-square*, 1931.
fn low_chi_square(freedom: f64) -> f64 {
    const QUANTILE: f64 = -1.644_854; // of the standard normal distribution
    let part = 2.0 / (9.0 * freedom);
    freedom * (1.0 - part + QUANTILE * part.sqrt()).powi(3)
}

/// Returns the mean of some values, and the standard deviation of a further one.
fn mean_and_std(values: &[f64], usual_std: f64) -> (f64, f64) {
    let count = values.len() as f64;
    let squares = sum_of_squares(values);
    let variance =
        (squares + USUAL_RECORDS * usual_std * usual_std) / (count - 1.0 + USUAL_RECORDS);
    (mean(values), (variance * (1.0 + 1.0 / count)).sqrt())
}

/// Returns the standard deviation of some values. `None` if there are fewer than two.
fn std(values: &[f64]) -> Option<f64> {
    let freedom = values.len().checked_sub(1).filter(|freedom| *freedom > 0)?;
    Some((sum_of_squares(values) / freedom as f64).sqrt())
}

/// Returns the sum of the squared deviations from the mean.
fn sum_of_squares(values: &[f64]) -> f64 {
    let mean = mean(values);
    values.iter().map(|value| (value - mean).powi(2)).sum()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Source: any table of the χ² distribution.
    #[test]
    fn quantiles_of_chi_square_are_those_of_tables_and_never_above_them() {
        for (freedom, of_table) in [(3.0, 0.352), (5.0, 1.145), (10.0, 3.940), (30.0, 18.493)] {
            let ratio = low_chi_square(freedom) / of_table;
            assert!((0.93..=1.0).contains(&ratio), "{freedom}: {ratio}");
        }
    }

    #[test]
    fn scatter_of_delays_is_that_of_all_channels_with_an_upper_bound() {
        let (early, late) = (vec![0.001, 0.003, 0.002], vec![-0.001, -0.003, -0.002]);
        let channels = [early.clone(), late.clone(), early, late, vec![0.5]];
        // Each channel has the sum of squares 2e-6 s². 4 channels with 2 degrees of freedom, each
        // of them 4/5, are 6.4: √(8e-6/1.82) = 2.1 ms, with the quantile 1.82 of the distribution.
        let found_s = delay_scatter_s(&channels, 0.1).unwrap();
        assert!((found_s - 0.0021).abs() < 1e-4, "{found_s}");
        // A period of 1 s: the least scatter is 3 ms.
        assert_eq!(delay_scatter_s(&channels, 1.0), Some(0.003));
        assert_eq!(delay_scatter_s(&[vec![0.1], vec![0.2]], 1.0), None);
    }
}
