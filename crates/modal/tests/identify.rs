//! Modes of chains of masses, simulated by code that shares nothing with the method.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

mod chain;

use chain::Chain;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_modal::{
    BandLadder, Identified, ModalSettings, ModalStream, Mode, Source, identify,
    smallest_uncertainty,
};
use std::f64::consts::TAU;

fn single(settings: &ModalSettings, frames: &[Vec<f64>]) -> Identified {
    let mut stream = ModalStream::new(settings).unwrap();
    let epoch = frames
        .iter()
        .find_map(|frame| stream.push(frame).unwrap())
        .unwrap();
    identify(&epoch).unwrap()
}

fn nearest(modes: &[Mode], frequency_hz: f64) -> &Mode {
    modes
        .iter()
        .min_by(|a, b| {
            let distance = |mode: &Mode| (mode.frequency_hz - frequency_hz).abs();
            distance(a).total_cmp(&distance(b))
        })
        .unwrap()
}

fn three_storeys() -> (Chain, ModalSettings) {
    let chain = Chain::new(&[1600.0, 1300.0, 1000.0], 0.01);
    let settings = ModalSettings {
        epoch_s: 600.0,
        ..ModalSettings::new(3, 50.0)
    };
    (chain, settings)
}

#[test]
fn frequencies_damping_and_shapes_of_a_chain_lie_within_four_deviations() {
    let (chain, settings) = three_storeys();
    let frames = chain.record(50.0, 620.0, 11);
    let found = single(&settings, &frames);
    for (number, (truth, shape)) in chain
        .frequencies_hz()
        .iter()
        .zip(chain.shapes())
        .enumerate()
    {
        let mode = nearest(&found.modes, *truth);
        let error = (mode.frequency_hz - truth).abs() / mode.frequency_std_hz;
        assert!(error < 4.0, "mode {number}: {mode:?}, true {truth} Hz");
        let error = (mode.damping - 0.01).abs() / mode.damping_std;
        assert!(error < 4.0, "mode {number}: {mode:?}");
        let mac = spandrel_modal::mac(
            &mode.shape,
            &nalgebra::DVector::from_iterator(3, shape.iter().map(|v| (*v).into())),
        );
        assert!(
            mac > 0.99 && mode.collinearity > 0.98,
            "mode {number}: MAC {mac}"
        );
    }
}

#[test]
fn deviations_are_never_below_the_law() {
    let (chain, settings) = three_storeys();
    let frames = chain.record(50.0, 620.0, 12);
    for mode in single(&settings, &frames).modes {
        let law = smallest_uncertainty(mode.frequency_hz, mode.damping, 600.0);
        assert!(
            mode.frequency_std_hz >= 0.999 * law.frequency_hz
                && mode.damping_std >= 0.999 * law.damping,
            "{mode:?}"
        );
    }
}

/// The jackknife identifies the epoch without each of its blocks. It shares the covariances with
/// the perturbation of first order, and nothing else.
#[test]
fn deviations_of_the_perturbation_agree_with_a_jackknife() {
    let (chain, mut settings) = three_storeys();
    settings.highest_order = 6; // that of the chain: higher orders offer a choice of poles
    let mut sums = [[0.0; 2]; 2]; // frequency, damping ratio: perturbation, jackknife
    for seed in 21..24 {
        let frames = chain.record(50.0, 620.0, seed);
        let mut stream = ModalStream::new(&settings).unwrap();
        let push = |frame: &Vec<f64>| stream.push(frame).unwrap();
        let epoch = frames.iter().find_map(push).unwrap();
        let whole = identify(&epoch).unwrap();
        let rest: Vec<Identified> = (0..epoch.covariances.blocks())
            .map(|block| {
                let mut epoch = epoch.clone();
                epoch.covariances = epoch.covariances.without_block(block);
                identify(&epoch).unwrap()
            })
            .collect();
        let n = rest.len() as f64;
        for truth in chain.frequencies_hz() {
            let found = nearest(&whole.modes, truth);
            let stated = [found.frequency_std_hz / truth, found.damping_std];
            let without = |of: fn(&Mode) -> f64| -> f64 {
                let values: Vec<f64> = rest
                    .iter()
                    .map(|rest| of(nearest(&rest.modes, truth)))
                    .collect();
                let mean = values.iter().sum::<f64>() / n;
                let squares = values.iter().map(|value| (value - mean).powi(2));
                ((n - 1.0) / n * squares.sum::<f64>()).sqrt()
            };
            let jackknife = [
                without(|mode| mode.frequency_hz) / truth,
                without(|mode| mode.damping),
            ];
            println!("seed {seed}, {truth:.2} Hz: {stated:.5?}, jackknife {jackknife:.5?}");
            for (sum, pair) in sums.iter_mut().zip(stated.iter().zip(jackknife)) {
                sum[0] += pair.0 * pair.0;
                sum[1] += pair.1 * pair.1;
            }
        }
    }
    for [perturbation, jackknife] in sums {
        let ratio = f64::sqrt(perturbation / jackknife);
        println!("{ratio:.3}");
        assert!((0.95..=1.05).contains(&ratio), "{ratio}");
    }
}

#[test]
fn sine_of_a_machine_is_not_a_mode() {
    let (chain, settings) = three_storeys();
    let mut frames = chain.record(50.0, 620.0, 13);
    for (number, frame) in frames.iter_mut().enumerate() {
        let sine = (2.0 * std::f64::consts::PI * 4.3 * number as f64 / 50.0).sin();
        for (value, share) in frame.iter_mut().zip([0.3, 0.5, 0.8]) {
            *value += share * chain.excitation_std() * sine;
        }
    }
    let found = single(&settings, &frames);
    let near: Vec<&Mode> = found
        .modes
        .iter()
        .filter(|mode| (mode.frequency_hz - 4.3).abs() < 0.05)
        .collect();
    assert!(
        matches!(near[..], [one] if one.source == Source::Machine),
        "{near:?}"
    );
    for truth in chain.frequencies_hz() {
        let mode = nearest(&found.modes, truth);
        assert!(
            mode.source == Source::Mode && (mode.frequency_hz - truth).abs() < 0.05,
            "{truth} Hz: {mode:?}"
        );
    }
}

#[test]
fn ladder_finds_modes_far_below_the_sampling_rate() {
    let chain = Chain::new(&[16.0, 13.0, 10.0], 0.02); // first mode near 0.28 Hz
    let settings = ModalSettings {
        epoch_s: 1200.0,
        ..ModalSettings::new(3, 100.0)
    };
    let mut ladder = BandLadder::new(&settings).unwrap();
    let frames = chain.record(100.0, 1300.0, 14);
    let epoch = frames
        .iter()
        .find_map(|frame| ladder.push(frame).unwrap())
        .unwrap();
    let found = epoch.identify().unwrap();
    for truth in chain.frequencies_hz() {
        let mode = nearest(&found.modes, truth);
        assert!(
            (mode.frequency_hz - truth).abs() < 4.0 * mode.frequency_std_hz,
            "{truth} Hz: {mode:?}"
        );
    }
}

/// Two modes after one blow at the start of the epoch, with a thousandth of the first amplitude as
/// noise.
#[test]
fn modes_of_a_free_decay_are_found() {
    const RATE_HZ: f64 = 200.0;
    const DAMPING: f64 = 0.01;
    const SHAPES: [(f64, [f64; 3]); 2] = [(15.0, [0.4, 0.8, 1.0]), (42.0, [1.0, 0.3, -0.6])];
    let settings = ModalSettings {
        epoch_s: 16.0,
        ..ModalSettings::new(3, RATE_HZ)
    };
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let frames: Vec<Vec<f64>> = (0..20 * RATE_HZ as usize)
        .map(|sample| {
            let time_s = sample as f64 / RATE_HZ;
            let motion = SHAPES.map(|(frequency_hz, shape)| {
                let omega = TAU * frequency_hz;
                (
                    shape,
                    (-DAMPING * omega * time_s).exp() * (omega * time_s).sin(),
                )
            });
            (0..3)
                .map(|at| {
                    motion.iter().map(|(shape, q)| shape[at] * q).sum::<f64>() + 0.001 * normal()
                })
                .collect()
        })
        .collect();
    let found = single(&settings, &frames);
    for (frequency_hz, _) in SHAPES {
        let mode = nearest(&found.modes, frequency_hz);
        assert!(
            (mode.frequency_hz / frequency_hz - 1.0).abs() < 0.002,
            "{mode:?}"
        );
        assert!((mode.damping / DAMPING - 1.0).abs() < 0.2, "{mode:?}");
    }
}

#[test]
fn wrong_settings_are_named_with_what_is_allowed() {
    let good = ModalSettings::new(4, 100.0);
    let cases: [(ModalSettings, &str); 5] = [
        (
            ModalSettings {
                channels: 1,
                references: vec![0],
                ..good.clone()
            },
            "at least 2",
        ),
        (
            ModalSettings {
                highest_hz: 45.0,
                ..good.clone()
            },
            "at most at 40 Hz",
        ),
        (
            ModalSettings {
                references: vec![7],
                ..good.clone()
            },
            "channels 0 to 3",
        ),
        (
            ModalSettings {
                epoch_s: 5.0,
                ..good.clone()
            },
            "must be at least 24",
        ),
        (
            ModalSettings {
                overlap: 1.0,
                ..good
            },
            "below 1",
        ),
    ];
    for (settings, expected) in cases {
        let error = ModalStream::new(&settings).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}
