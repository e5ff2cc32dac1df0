//! Statistics shared by the cases.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

/// Generator of independent standard normal numbers.
#[derive(Debug, Clone)]
pub(crate) struct Normal(ChaCha8Rng);

impl Normal {
    /// Starts a random stream of a seed. Truth, noise and faults of a record use different streams.
    pub(crate) fn stream(seed: u64, stream: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(stream);
        Self(random)
    }

    pub(crate) fn draw(&mut self) -> f64 {
        StandardNormal.sample(&mut self.0)
    }
}

/// Returns the root mean square of a sequence.
pub(crate) fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| {
        (sum + value * value, count + 1.0)
    });
    (sum / count).sqrt()
}

/// Comparison of estimates and their deviations with the truth.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Accuracy {
    count: f64,
    squared_error: f64,
    absolute_error: f64,
    squared_truth: f64,
    squared_ratio: f64,
    inside: f64,
    std: f64,
    estimate: f64,
    truth: f64,
    squared_estimate: f64,
    product: f64,
}

impl Accuracy {
    /// Adds one comparison. `std` is the stated deviation, and the interval is ± 3 of it.
    pub(crate) fn take(&mut self, estimate: f64, std: f64, truth: f64) {
        let error = (estimate - truth).abs();
        self.count += 1.0;
        self.squared_error += error * error;
        self.absolute_error += error;
        self.squared_truth += truth * truth;
        self.squared_ratio += (error / std).powi(2);
        self.inside += f64::from(u8::from(error <= 3.0 * std));
        self.std += std;
        self.estimate += estimate;
        self.truth += truth;
        self.squared_estimate += estimate * estimate;
        self.product += estimate * truth;
    }

    /// Returns the root mean square error.
    pub(crate) fn rms_error(&self) -> f64 {
        (self.squared_error / self.count).sqrt()
    }

    /// Returns the root mean square error relative to the root mean square of the truth.
    pub(crate) fn relative_error(&self) -> f64 {
        (self.squared_error / self.squared_truth).sqrt()
    }

    /// Returns the mean absolute error.
    pub(crate) fn mean_absolute_error(&self) -> f64 {
        self.absolute_error / self.count
    }

    /// Returns the root mean square ratio of error to stated deviation, which is 1 if the intervals
    /// are correct.
    pub(crate) fn normalised_error(&self) -> f64 {
        (self.squared_ratio / self.count).sqrt()
    }

    /// Returns the share of the comparisons inside ± 3 stated deviations.
    pub(crate) fn coverage(&self) -> f64 {
        self.inside / self.count
    }

    /// Returns the distance of the mean estimate from the mean truth, in mean deviations. Above 3,
    /// the interval misses the truth.
    pub(crate) fn bias(&self) -> f64 {
        (self.estimate - self.truth).abs() / self.std
    }

    /// Returns the correlation of estimate and truth.
    pub(crate) fn correlation(&self) -> f64 {
        let centred = |sum: f64, a: f64, b: f64| sum - a * b / self.count;
        let estimate = centred(self.squared_estimate, self.estimate, self.estimate);
        let truth = centred(self.squared_truth, self.truth, self.truth);
        centred(self.product, self.estimate, self.truth) / (estimate * truth).sqrt()
    }

    /// Returns the mean stated deviation.
    pub(crate) fn mean_std(&self) -> f64 {
        self.std / self.count
    }
}

/// Mean of the added values.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    pub(crate) fn take(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    pub(crate) fn value(&self) -> f64 {
        self.sum / self.count
    }
}

/// Returns the larger of two values. Unlike [`f64::max`], it returns NaN if one of them is NaN, so
/// that a fold over values contains an unknown one.
pub(crate) fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() {
        f64::NAN
    } else {
        a.max(b)
    }
}

/// Returns the smallest of some shares, at most 1. Returns NaN, which meets no requirement, if a
/// share is NaN.
pub(crate) fn least(shares: impl Iterator<Item = f64>) -> f64 {
    shares.fold(1.0, |least: f64, share| {
        if least.is_nan() || share.is_nan() {
            f64::NAN
        } else {
            least.min(share)
        }
    })
}

/// Generator of independent numbers, uniform between 0 and 1.
#[derive(Debug, Clone)]
pub(crate) struct Uniform(ChaCha8Rng);

impl Uniform {
    /// Starts a random stream of a seed.
    pub(crate) fn stream(seed: u64, stream: u64) -> Self {
        Self(Normal::stream(seed, stream).0)
    }

    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        let unit: f64 = rand_distr::StandardUniform.sample(&mut self.0);
        low + (high - low) * unit
    }

    /// Draws `count` different numbers below `len`.
    pub(crate) fn positions(&mut self, count: usize, len: usize) -> Vec<usize> {
        let mut all: Vec<usize> = (0..len).collect();
        for i in 0..count.min(len) {
            let j = i + self.between(0.0, (len - i) as f64) as usize;
            all.swap(i, j.min(len - 1));
        }
        all.truncate(count.min(len));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn correlation_is_independent_of_offset_and_scale() {
        let mut same = Accuracy::default();
        let mut unrelated = Accuracy::default();
        for i in 0..1000 {
            let truth = (f64::from(i) * 0.02 * std::f64::consts::PI).sin();
            same.take(3.0 + 0.5 * truth, 1.0, truth);
            unrelated.take(
                (f64::from(i) * 0.04 * std::f64::consts::PI).sin(),
                1.0,
                truth,
            );
        }
        assert!((same.correlation() - 1.0).abs() < 1e-12 && unrelated.correlation().abs() < 1e-12);
    }
}
