//! Spikes in the values by which the sensors are compared.

use serde::{Deserialize, Serialize};

/// Share of its own size by which a residual may differ from the mean of its neighbours if they
/// share its deviation. A sine with twelve samples per period differs by 0.13.
const SHARED: f64 = 0.25;

/// Removes spikes from a stream of frames, one frame late.
///
/// The screening of the filter also rejects samples of a structure that has changed. Without these
/// samples, its sensors would seem to contradict each other. A rejected sample is therefore no
/// spike if its neighbours in time are rejected as well, and share its deviation from the
/// prediction. Three spikes in a row can share it by chance. Another predicted channel must
/// therefore deviate for as long, if there is one. This does not suffice for a fast motion that the
/// model does not contain. The measured samples are therefore kept beside those without spikes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Spikes {
    /// The newest sample of each channel. Empty before the first frame.
    last: Vec<Sample>,
    /// Residuals of the frame before it.
    before: Vec<Residual>,
}

/// A sample of a channel with its screening.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Sample {
    /// SI units; NaN if the sample is missing.
    pub(super) value: f64,
    /// The value without a spike (SI units).
    pub(super) without_spike: f64,
    /// Difference from the prediction (SI units). NaN if the filter does not predict the sample.
    pub(super) residual: f64,
    pub(super) is_rejected: bool,
}

/// Residual of a sample with and without a spike (SI units); NaN if it is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Residual {
    measured: f64,
    cleaned: f64,
    is_rejected: bool,
}

impl Sample {
    /// Creates a sample that the filter does not predict.
    pub(super) fn unpredicted(value: f64) -> Self {
        Self {
            value,
            without_spike: value,
            residual: f64::NAN,
            is_rejected: false,
        }
    }

    /// Returns the residual without a spike. `is_common`: other channels deviate as well.
    fn cleaned(self, before: Residual, next: Self, is_common: bool) -> f64 {
        if !self.is_rejected {
            return self.residual;
        }
        // The measured neighbours decide. A replaced one would make the whole of a sudden deviation
        // a spike. Of two spikes in a row, each has a neighbour that is not rejected.
        let shared = 0.5 * (before.measured + next.residual);
        let is_shared = (self.residual - shared).abs() < SHARED * self.residual.abs();
        if is_common && self.deviates(before, next) && is_shared {
            return self.residual;
        }
        match next.is_rejected && before.cleaned.is_finite() {
            true => before.cleaned, // the next sample can be a spike, too
            false => mean_of_known(before.cleaned, next.residual),
        }
    }

    /// Returns `true` if the sample and both of its neighbours are rejected.
    fn deviates(self, before: Residual, next: Self) -> bool {
        before.is_rejected && self.is_rejected && next.is_rejected
    }
}

/// Returns the mean of two residuals, or the one that is known. Without any, the prediction is
/// best.
fn mean_of_known(before: f64, next: f64) -> f64 {
    match (before.is_finite(), next.is_finite()) {
        (true, true) => 0.5 * (before + next),
        (true, false) => before,
        (false, true) => next,
        (false, false) => 0.0,
    }
}

impl Spikes {
    /// Takes the samples of the next frame. Replaces them by those of the frame before, and removes
    /// the spikes of these. Returns `false`, and changes nothing, if there is no frame before.
    pub(super) fn take(&mut self, samples: &mut [Sample]) -> bool {
        if self.last.is_empty() {
            self.last.extend_from_slice(samples);
            let unknown = Residual {
                measured: f64::NAN,
                cleaned: f64::NAN,
                is_rejected: false,
            };
            self.before.clear();
            self.before.resize(samples.len(), unknown);
            return false;
        }
        let predicted = self.last.iter().filter(|last| !last.residual.is_nan());
        let rows = self.before.iter().zip(&self.last).zip(samples.iter());
        let deviating = rows.filter(|((before, last), next)| last.deviates(**before, **next));
        let is_common = deviating.count() >= predicted.count().min(2);
        for ((before, last), sample) in self.before.iter_mut().zip(&mut self.last).zip(samples) {
            let next = std::mem::replace(sample, *last);
            *last = next;
            let cleaned = sample.cleaned(*before, next, is_common);
            if sample.is_rejected {
                sample.without_spike = sample.value + cleaned - sample.residual;
            }
            *before = Residual {
                measured: sample.residual,
                cleaned,
                is_rejected: sample.is_rejected,
            };
        }
        true
    }

    /// Returns `true` if the frames have this many channels, or if there are none.
    pub(super) fn fits(&self, channels: usize) -> bool {
        self.last.is_empty() || self.last.len() == channels && self.before.len() == channels
    }

    /// Forgets the newest frame, because the next one does not follow it.
    pub(super) fn forget(&mut self) {
        self.last.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Passes the residuals of a channel, and returns its values without spikes. The prediction is
    /// always 10. `rejected` is the size of residuals from which they are rejected.
    fn cleaned(residuals: &[f64], rejected: f64) -> Vec<f64> {
        let mut spikes = Spikes::default();
        let taken = residuals.iter().filter_map(|residual| {
            let sample = Sample {
                residual: *residual,
                is_rejected: residual.abs() >= rejected,
                ..Sample::unpredicted(10.0 + residual)
            };
            let mut samples = [sample];
            let is_taken = spikes.take(&mut samples);
            is_taken.then_some(samples[0].without_spike)
        });
        taken.collect()
    }

    #[test]
    fn spike_gets_the_deviation_of_its_neighbours() {
        let found = cleaned(&[1.0, 9.0, 2.0, 3.0], 8.0);
        assert_eq!(found, [11.0, 11.5, 12.0]);
    }

    #[test]
    fn successive_spikes_are_removed() {
        let found = cleaned(&[1.0, 9.0, -8.0, 2.0, 0.0], 8.0);
        assert_eq!(found, [11.0, 11.0, 11.5, 12.0]);
    }

    #[test]
    fn three_alike_are_spikes_if_the_other_channels_follow_the_prediction() {
        let of_others = [[0.0; 5], [0.0, 7.0, 8.0, 9.0, 0.0]];
        let found = of_others.map(|other| {
            let mut spikes = Spikes::default();
            let mut found = Vec::new();
            for (residual, other) in [0.0, 8.0, 9.0, 8.0, 0.0].into_iter().zip(other) {
                let mut samples = [residual, other].map(|residual| Sample {
                    residual,
                    is_rejected: residual >= 5.0,
                    ..Sample::unpredicted(residual)
                });
                if spikes.take(&mut samples) {
                    found.push(samples[0].without_spike);
                }
            }
            found
        });
        let [alone, common] = found;
        assert_eq!(alone, [0.0, 0.0, 0.0, 0.0]);
        assert_eq!(common, [0.0, 0.0, 9.0, 4.5]);
    }

    #[test]
    fn motion_that_the_screening_rejects_is_unchanged_except_at_its_edges() {
        let motion = |step: usize| (std::f64::consts::TAU * step as f64 / 25.0).sin();
        let residuals: Vec<f64> = (0..60).map(motion).collect();
        let found = cleaned(&residuals, 0.5);
        let is_rejected = |step: usize| motion(step).abs() >= 0.5;
        for (step, found) in found.into_iter().enumerate() {
            let error = (found - 10.0 - motion(step)).abs();
            let is_edge = is_rejected(step) && !(is_rejected(step - 1) && is_rejected(step + 1));
            // A sine with 25 samples per period changes by up to a quarter between two of them.
            assert!(
                error < if is_edge { 0.25 } else { 1e-12 },
                "{step}: {error}"
            );
        }
    }

    #[test]
    fn spike_without_neighbours_becomes_the_prediction() {
        let mut spikes = Spikes::default();
        let spike = Sample {
            residual: 8.0,
            is_rejected: true,
            ..Sample::unpredicted(9.0)
        };
        assert!(!spikes.take(&mut [Sample::unpredicted(f64::NAN)]));
        let mut taken = [spike];
        assert!(spikes.take(&mut taken));
        assert!(taken[0].value.is_nan(), "a missing sample remains missing");
        let mut taken = [Sample::unpredicted(f64::NAN)];
        assert!(spikes.take(&mut taken));
        assert_eq!((taken[0].value, taken[0].without_spike), (9.0, 1.0));
    }

    #[test]
    fn frame_after_a_gap_has_no_neighbour_before_it() {
        let mut spikes = Spikes::default();
        spikes.take(&mut [Sample::unpredicted(100.0)]);
        spikes.forget();
        let mut taken = [Sample::unpredicted(1.0)];
        assert!(!spikes.take(&mut taken));
        assert_eq!(taken[0].value, 1.0);
    }
}
