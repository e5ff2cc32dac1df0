//! Lower bound of the time of a step.
//!
//! A step takes at least its operations at the processor's rate, or its bytes at the rate of the
//! memory into which they fit.

use crate::building::Building;
use crate::timing::seconds;
use pulp::{Arch, Simd, WithSimd};
use std::hint::black_box;

/// Operations and bytes of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Count {
    /// Number of multiplications and additions in double precision.
    pub flops: f64,
    /// Size of the covariance in bytes, read once and written once.
    pub bytes: f64,
}

impl Count {
    /// Counts a step of the filter of a [`Building`]. In its prediction, a row of the covariance
    /// takes `terms` products.
    ///
    /// A row changes by `ρ = (−G x + W θ) h²` and by four bands. `ρ` has three terms of a chain and
    /// the terms of the parameters. Each band has the width of its polynomial. The prediction
    /// changes all n rows from the right. It changes half of the 2N rows of the motion from the
    /// left, because the result is symmetric.
    ///
    /// The update has rank N_0 and the ground motion rank one, both for half of the covariance. The
    /// count omits the terms of the structure's own matrices, of the parameters and noise levels,
    /// and all terms of lower order.
    #[must_use]
    pub fn of(building: &Building, terms: usize) -> Self {
        let storeys = building.storeys as f64;
        let (n, channels) = (3.0 * storeys + 2.0, building.sensed().count() as f64);
        let predicted = (n + storeys) * terms as f64;
        // A row of H has the terms of its floor: three of x and of ẋ, two storeys and two damping
        // parameters.
        let observed = n * channels * 10.0 + n * channels * (channels + 1.0) / 2.0;
        let updated = n * (n + 1.0) / 2.0 * (channels + 1.0);
        Self {
            flops: 2.0 * (predicted + observed + updated),
            bytes: 2.0 * 8.0 * n * n,
        }
    }
}

/// Speed of this machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Multiplications and additions of doubles in registers per second, with the fastest
    /// instructions.
    pub flops_per_s: f64,
    /// Bytes read and written per second by a copy of the requested size.
    pub bytes_per_s: f64,
}

impl Rates {
    /// Measures both rates. The source and target of the copies take `bytes` in total.
    #[must_use]
    pub fn measure(bytes: f64) -> Self {
        Self {
            flops_per_s: vector_rate(),
            bytes_per_s: copy_rate(bytes),
        }
    }

    /// Returns the minimum time of a step (s).
    #[must_use]
    pub fn least_seconds(&self, count: Count) -> f64 {
        (count.flops / self.flops_per_s).max(count.bytes / self.bytes_per_s)
    }
}

/// Returns the highest rate of 20 trials, because other load on the machine can only reduce a rate.
fn best(mut rate: impl FnMut() -> f64) -> f64 {
    (0..20).map(|_| rate()).fold(0.0, f64::max)
}

fn vector_rate() -> f64 {
    const ROUNDS: usize = 20_000;
    let arch = Arch::new();
    best(|| {
        let (time_s, flops) = seconds(|| {
            arch.dispatch(MultiplyAndAdd {
                rounds: black_box(ROUNDS),
            })
        });
        flops / time_s
    })
}

fn copy_rate(bytes: f64) -> f64 {
    let len = (bytes / 16.0).max(1.0) as usize;
    let (from, mut to) = (vec![1.0_f64; len], vec![0.0_f64; len]);
    let repeats = (4_000_000 / len).max(1);
    best(|| {
        let (time_s, ()) = seconds(|| {
            for _ in 0..repeats {
                to.copy_from_slice(black_box(&from));
                black_box(&mut to);
            }
        });
        (16 * len * repeats) as f64 / time_s
    })
}

/// Number of independent sums, enough to fill both pipelines of current processors.
const SUMS: usize = 12;

struct MultiplyAndAdd {
    rounds: usize,
}

impl WithSimd for MultiplyAndAdd {
    type Output = f64;

    /// Returns the number of operations.
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let (factor, addend) = (
            simd.splat_f64s(black_box(0.999)),
            simd.splat_f64s(black_box(1e-3)),
        );
        let mut sums = [simd.splat_f64s(1.0); SUMS];
        for _ in 0..self.rounds {
            for sum in &mut sums {
                *sum = simd.mul_add_e_f64s(*sum, factor, addend);
            }
        }
        black_box(sums.map(|sum| simd.reduce_sum_f64s(sum)));
        (2 * SUMS * S::F64_LANES * self.rounds) as f64
    }
}
