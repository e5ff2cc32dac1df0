//! Draws of indices with probabilities proportional to weights.

use super::settings::Resampling;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Draws `N` particle indices in ascending order; `weights` (N) sum to 1.
///
/// `cumulative`: scratch (N). A particle with weight zero is never drawn, despite rounding of the
/// sums.
pub(super) fn draw_indices(
    scheme: Resampling,
    weights: &[f64],
    rng: &mut ChaCha8Rng,
    cumulative: &mut [f64],
    indices: &mut [u32],
) {
    let mut total = 0.0;
    let mut last = 0;
    for (i, (sum, weight)) in cumulative.iter_mut().zip(weights).enumerate() {
        total += weight;
        *sum = total;
        if *weight > 0.0 {
            last = i;
        }
    }
    let count = weights.len() as f64;
    match scheme {
        Resampling::Systematic => {
            let offset: f64 = rng.random();
            let mut j = 0;
            for (i, index) in indices.iter_mut().enumerate() {
                let point = total * (i as f64 + offset) / count;
                while j < last && cumulative[j] <= point {
                    j += 1;
                }
                *index = j as u32;
            }
        }
        Resampling::Multinomial => {
            for index in indices.iter_mut() {
                let point = total * rng.random::<f64>();
                *index = cumulative.partition_point(|sum| *sum <= point).min(last) as u32;
            }
            indices.sort_unstable();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;

    fn counts(scheme: Resampling, weights: &[f64], seed: u64) -> Vec<usize> {
        let mut indices = vec![0; weights.len()];
        let mut cumulative = vec![0.0; weights.len()];
        draw_indices(
            scheme,
            weights,
            &mut ChaCha8Rng::seed_from_u64(seed),
            &mut cumulative,
            &mut indices,
        );
        (0..weights.len() as u32)
            .map(|i| indices.iter().filter(|index| **index == i).count())
            .collect()
    }

    #[test]
    fn systematic_counts_differ_from_the_expected_ones_by_less_than_one() {
        let weights = [0.0, 0.31, 0.0, 0.02, 0.47, 0.2, 0.0, 0.0, 0.0, 0.0];
        for seed in [1, 2, 3] {
            for (count, weight) in counts(Resampling::Systematic, &weights, seed)
                .into_iter()
                .zip(weights)
            {
                assert!(
                    (count as f64 - 10.0 * weight).abs() < 1.0,
                    "{count} for weight {weight}"
                );
                assert!(weight > 0.0 || count == 0);
            }
        }
    }

    #[test]
    fn multinomial_counts_are_unbiased() {
        let weights = [0.0, 0.5, 0.3, 0.2, 0.0];
        let mut sums = [0.0; 5];
        let runs = 4000;
        for seed in 0..runs {
            for (sum, count) in sums
                .iter_mut()
                .zip(counts(Resampling::Multinomial, &weights, seed))
            {
                *sum += count as f64;
            }
        }
        for (sum, weight) in sums.iter().zip(weights) {
            // Five standard deviations of a binomial mean.
            let allowed = 5.0 * (5.0 * weight * (1.0 - weight) / runs as f64).sqrt();
            assert!(
                (sum / runs as f64 - 5.0 * weight).abs() <= allowed,
                "{sum} for {weight}"
            );
        }
    }
}
