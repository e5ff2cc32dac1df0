use super::*;
use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

const NODES: usize = 16;
const PARAMETERS: usize = 8;

#[test]
fn limits_are_those_of_the_chi_squared_distribution() {
    let detector = GlobalDetector::default();
    assert!(
        (detector.limit(6) - 3.5485).abs() < 5e-5,
        "{}",
        detector.limit(6)
    );
    assert!(
        (detector.limit(8) - 3.9379).abs() < 5e-5,
        "{}",
        detector.limit(8)
    );
}

/// Returns the shares of trials in which the detector excludes shifted and healthy nodes.
///
/// The nodes in `shifted` are off by six standard deviations.
fn shares(detector: GlobalDetector, shifted: &[usize], seed: u64) -> (f64, f64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut hits, mut false_alarms) = (0_usize, 0_usize);
    const TRIALS: usize = 2000;
    for _ in 0..TRIALS {
        let densities: Vec<Gaussian> = (0..NODES)
            .map(|node| {
                let mut mean = DVector::zeros(PARAMETERS);
                let mut covariance = DMatrix::zeros(PARAMETERS, PARAMETERS);
                for m in 0..PARAMETERS {
                    let std = 0.5 + random.random::<f64>();
                    let noise: f64 = random.sample(StandardNormal);
                    let sign = if random.random::<bool>() { 1.0 } else { -1.0 };
                    mean[m] = std
                        * (noise
                            + if shifted.contains(&node) {
                                6.0 * sign
                            } else {
                                0.0
                            });
                    covariance[(m, m)] = std * std;
                }
                Gaussian { mean, covariance }
            })
            .collect();
        let found = detector.judge(&densities.iter().collect::<Vec<_>>(), Sharing::Nothing);
        for (node, found) in found.iter().enumerate().filter(|(_, found)| found.excluded) {
            let _ = found;
            if shifted.contains(&node) {
                hits += 1
            } else {
                false_alarms += 1
            }
        }
    }
    let rate = |count: usize, of: usize| count as f64 / (of.max(1) * TRIALS) as f64;
    (
        rate(hits, shifted.len()),
        rate(false_alarms, NODES - shifted.len()),
    )
}

#[test]
fn shifted_nodes_are_excluded_and_healthy_nodes_mostly_kept() {
    // ch7 §5, check 4
    let published = GlobalDetector::default();
    let stepwise = GlobalDetector {
        one_at_a_time: true,
        ..published
    };
    for seed in [1, 2, 3] {
        let (_, clean) = shares(published, &[], seed);
        assert!((0.04..0.06).contains(&clean), "seed {seed}: {clean}");
        let (hit, healthy) = shares(published, &[4], seed);
        assert!(
            hit > 0.999 && healthy < 0.13,
            "seed {seed}: {hit} {healthy}"
        );
        let (hit, healthy) = shares(published, &[1, 7, 12], seed);
        assert!(
            hit > 0.999 && (0.18..0.22).contains(&healthy),
            "seed {seed}: {hit} {healthy}"
        );
        for shifted in [&[][..], &[4], &[1, 7, 12]] {
            let (hit, healthy) = shares(stepwise, shifted, seed);
            assert!(
                healthy < 0.07 && (shifted.is_empty() || hit > 0.999),
                "seed {seed}: {hit} {healthy}"
            );
        }
    }
}

#[test]
fn at_least_two_nodes_remain() {
    let at = |mean: f64| Gaussian {
        mean: DVector::from_element(1, mean),
        covariance: DMatrix::identity(1, 1),
    };
    let (near, far, farther) = (at(0.0), at(100.0), at(-100.0));
    let detector = GlobalDetector {
        one_at_a_time: true,
        ..GlobalDetector::default()
    };
    assert!(
        detector
            .judge(&[&near, &far], Sharing::All)
            .iter()
            .all(|node| !node.excluded)
    );
    let found = detector.judge(&[&near, &far, &farther], Sharing::All);
    assert_eq!(found.iter().filter(|node| !node.excluded).count(), 2);
    assert!(detector.judge(&[], Sharing::All).is_empty());
}

/// Regression: a node whose distance is not a number counted as regular, with weight 1.
#[test]
fn node_without_a_distance_is_excluded() {
    let at = |mean: f64| Gaussian {
        mean: DVector::from_element(1, mean),
        covariance: DMatrix::identity(1, 1),
    };
    let (near, next, nan) = (at(0.0), at(0.1), at(f64::NAN));
    let detector = GlobalDetector {
        one_at_a_time: true,
        ..GlobalDetector::default()
    };
    let found = detector.judge(&[&near, &next, &nan], Sharing::All);
    let judged = found.iter().map(|node| (node.excluded, node.weight));
    assert_eq!(
        judged.collect::<Vec<_>>(),
        [(false, 1.0), (false, 1.0), (true, 0.0)]
    );
}

/// Checks that a node with much less uncertainty than all others stays regular, and that a faulty
/// node is found.
///
/// The standard deviation of node 0 is a quarter of the others'. The other nodes have its
/// information and one common additional error, as after an exchange of samples. With (7.52), which
/// counts 1/15 of their variance, the mean `d²` of node 0 is 60. This exceeds the limit of 26. With
/// the whole variance, the mean `d²` is 7. Node 9 is faulty.
#[test]
fn node_with_a_smaller_variance_than_all_others_is_not_suspicious() {
    let detector = GlobalDetector {
        screening: 0.999,
        one_at_a_time: true,
        ..GlobalDetector::default()
    };
    for seed in [1, 2, 3] {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut left_out = [[0_usize; 2]; 2];
        for _ in 0..1000 {
            let mut normal =
                || DVector::from_fn(PARAMETERS, |_, _| random.sample::<f64, _>(StandardNormal));
            let (of_all, of_surest) = (2.0 * normal(), 0.5 * normal());
            let mut densities: Vec<Gaussian> = (0..NODES)
                .map(|_| Gaussian {
                    mean: &of_all + &of_surest + 0.1 * normal(),
                    covariance: DMatrix::identity(PARAMETERS, PARAMETERS) * 4.26,
                })
                .collect();
            densities[0] = Gaussian {
                mean: of_surest,
                covariance: DMatrix::identity(PARAMETERS, PARAMETERS) * 0.25,
            };
            densities[9].mean.add_scalar_mut(10.0);
            let nodes: Vec<&Gaussian> = densities.iter().collect();
            for (left_out, sharing) in left_out.iter_mut().zip([Sharing::All, Sharing::Nothing]) {
                let found = detector.judge(&nodes, sharing);
                left_out[0] += usize::from(found[0].excluded);
                left_out[1] += usize::from(found[9].excluded);
            }
        }
        let [[surest, off], [surest_as_published, _]] = left_out;
        assert!(surest <= 1 && off == 1000, "seed {seed}: {left_out:?}");
        assert!(surest_as_published > 500, "seed {seed}: {left_out:?}");
    }
}

/// Returns nodes with one parameter of standard deviation 1, all at 0 except the first.
fn one_node_at(mean: f64) -> Vec<Gaussian> {
    let at = |mean: f64| Gaussian {
        mean: DVector::from_element(1, mean),
        covariance: DMatrix::identity(1, 1),
    };
    (0..NODES)
        .map(|node| at(if node == 0 { mean } else { 0.0 }))
        .collect()
}

#[test]
fn weight_scales_the_distance_to_the_limit() {
    for one_at_a_time in [true, false] {
        let detector = GlobalDetector {
            screening: 0.999,
            one_at_a_time,
            ..GlobalDetector::default()
        };
        let limit = detector.limit(1);
        // Two-sided 0.999 quantile of the normal distribution.
        assert!((limit - 3.2905).abs() < 5e-5, "{limit}");
        // Compared with the mean of the fifteen other nodes.
        let variance = 1.0 + 1.0 / 15.0;
        for times in [0.5, 0.99, 1.01, 2.0, 5.0, 100.0] {
            let nodes = one_node_at(times * limit * f64::sqrt(variance));
            let found = detector.judge(&nodes.iter().collect::<Vec<_>>(), Sharing::Nothing);
            let expected = if times < 1.0 {
                1.0
            } else {
                1.0 / (times * times)
            };
            assert!(
                (found[0].weight - expected).abs() < 1e-12,
                "{times}: {:?}",
                found[0]
            );
            assert_eq!(found[0].excluded, times > 1.0, "{times}");
            assert!(
                found[1..]
                    .iter()
                    .all(|node| node.weight == 1.0 && !node.excluded),
                "{times}"
            );
        }
    }
}

#[test]
fn healthy_nodes_are_rarely_and_only_slightly_discounted() {
    let stepwise = GlobalDetector {
        one_at_a_time: true,
        ..GlobalDetector::default()
    };
    // The limits mean 5 % and 0.1 %. For 0.1 %, 32 excluded nodes of 32 000 are expected.
    for (screening, most) in [(0.95, 0.06), (0.999, 0.002)] {
        let detector = GlobalDetector {
            screening,
            ..stepwise
        };
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let (mut discounted, mut least, mut lost) = (0, 1.0_f64, 0.0);
        const TRIALS: usize = 2000;
        for _ in 0..TRIALS {
            let nodes: Vec<Gaussian> = (0..NODES)
                .map(|_| Gaussian {
                    mean: DVector::from_fn(PARAMETERS, |_, _| {
                        random.sample::<f64, _>(StandardNormal)
                    }),
                    covariance: DMatrix::identity(PARAMETERS, PARAMETERS),
                })
                .collect();
            for found in detector.judge(&nodes.iter().collect::<Vec<_>>(), Sharing::Nothing) {
                discounted += usize::from(found.weight < 1.0);
                least = least.min(found.weight);
                lost += 1.0 - found.weight;
            }
        }
        let share = discounted as f64 / (NODES * TRIALS) as f64;
        assert!(share > 0.0 && share < most, "{screening}: {share}");
        assert!(least > 3.0 * LEAST_WEIGHT, "{screening}: {least}");
        // The discounted information is a fraction of the loss from exclusion.
        assert!(
            lost < 0.4 * discounted as f64,
            "{screening}: {lost} of {discounted}"
        );
    }
}
