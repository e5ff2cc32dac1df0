use crate::updating::part_model::tests::chain;
use crate::updating::{
    Entry, PartModel, SeenMode, StiffnessChange, StiffnessUpdate, UpdateReference, UpdateSettings,
};
use nalgebra::{Complex, DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard deviations of what makes epochs differ.
#[derive(Clone, Copy)]
struct Noise {
    /// Of ln f, that all modes have in common, and that each has for itself.
    common: f64,
    own: f64,
    /// Of the values of a shape of unit norm.
    shape: f64,
    /// Of ln f and of the shape, as stated.
    stated: f64,
    stated_shape: f64,
}

const STILL: Noise = Noise {
    common: 0.0,
    own: 0.0,
    shape: 0.0,
    stated: 0.003,
    stated_shape: 0.01,
};
const USUAL: Noise = Noise {
    common: 0.01,
    own: 0.005,
    shape: 0.02,
    ..STILL
};

struct Truth {
    model: PartModel,
    noise: Noise,
    random: ChaCha8Rng,
    modes: usize,
}

impl Truth {
    fn draw(&mut self, std: f64) -> f64 {
        let normal: f64 = StandardNormal.sample(&mut self.random);
        std * normal
    }

    fn epoch(&mut self, change: &DVector<f64>) -> Vec<Option<SeenMode>> {
        let (frequencies, shapes) = self.model.modes(change).unwrap();
        let noise = self.noise;
        let is_still = noise.common == 0.0;
        let common = self.draw(noise.common);
        (0..self.modes)
            .map(|mode| {
                let stated = if is_still { 0.0 } else { noise.stated };
                let by = common + self.draw(noise.own) + self.draw(stated);
                let frequency_hz = frequencies[mode] * by.exp();
                let shape = shapes.column(mode).normalize();
                let stated = if is_still { 0.0 } else { noise.stated_shape };
                let values: Vec<Complex<f64>> = shape
                    .iter()
                    .map(|value| value + self.draw(noise.shape.hypot(stated)))
                    .map(|value| Complex::new(value, 0.0))
                    .collect();
                let seen = SeenMode::new(frequency_hz, noise.stated * frequency_hz);
                Some(seen.with_shape(&values, &vec![noise.stated_shape; values.len()]))
            })
            .collect()
    }
}

fn truth(masses: &[f64], stiffnesses: &[f64], noise: Noise, seed: u64) -> Truth {
    Truth {
        model: chain(masses, stiffnesses),
        noise,
        random: ChaCha8Rng::seed_from_u64(seed),
        modes: masses.len(),
    }
}

fn settings(parts: usize, commissioning_epochs: usize) -> UpdateSettings {
    UpdateSettings {
        commissioning_epochs,
        prior_std: vec![0.3; parts],
    }
}

fn loss(parts: usize, part: usize, loss: f64) -> DVector<f64> {
    let mut change = DVector::zeros(parts);
    change[part] = f64::ln(1.0 - loss);
    change
}

/// Returns the change of an epoch after a commissioning of sound epochs.
fn followed(
    truth: &mut Truth,
    model: PartModel,
    epochs: usize,
    to: &DVector<f64>,
) -> StiffnessChange {
    let parts = model.parts();
    let mut update = StiffnessUpdate::new(model, settings(parts, epochs)).unwrap();
    for _ in 0..epochs {
        let epoch = truth.epoch(&DVector::zeros(parts));
        assert_eq!(update.handle(epoch).unwrap(), None);
    }
    let epoch = truth.epoch(to);
    update.handle(epoch).unwrap().unwrap()
}

#[test]
fn a_loss_is_found_in_its_storey_by_a_model_that_starts_with_other_stiffnesses() {
    let stiffnesses = [300.0, 250.0, 400.0, 210.0, 150.0];
    for part in 0..5 {
        let mut truth = truth(&[2.0; 5], &stiffnesses, STILL, 1);
        let nominal = chain(&[2.0; 5], &[250.0; 5]);
        let change = followed(&mut truth, nominal, 20, &loss(5, part, 0.15));
        for other in 0..5 {
            let expected = if other == part { 0.85_f64.ln() } else { 0.0 };
            let (mean, std) = (change.mean(other), change.std(other));
            assert!(
                (mean - expected).abs() < 2.0 * std,
                "{part} {other}: {mean} ± {std}"
            );
            let probability = change.probability_of_loss(other, 0.05);
            assert_eq!(
                probability > 0.9,
                other == part,
                "{part} {other}: {probability}"
            );
        }
    }
}

#[test]
fn calibration_finds_the_stiffnesses_of_the_structure() {
    let stiffnesses = [300.0, 250.0, 400.0, 210.0, 180.0];
    let mut truth = truth(&[2.0; 5], &stiffnesses, STILL, 1);
    let epochs: Vec<_> = (0..3).map(|_| truth.epoch(&DVector::zeros(5))).collect();
    let nominal = chain(&[2.0; 5], &[250.0; 5]);
    let reference = UpdateReference::learn(&nominal, &settings(5, 3), &epochs).unwrap();
    for (part, stiffness) in stiffnesses.iter().enumerate() {
        let error = reference.ln_stiffness[part] - (stiffness / 250.0).ln();
        assert!(
            error.abs() < reference.ln_stiffness_std[part],
            "{part}: {error}"
        );
    }
    assert_eq!(
        reference.of_model().flatten().collect::<Vec<_>>(),
        [0, 1, 2, 3, 4]
    );
}

/// With one degree of freedom, ln f = x/2 exactly. The posterior is then an integral over the
/// levels of the scatter that can be summed directly.
#[test]
fn posterior_of_one_part_equals_a_direct_sum() {
    let entry = Entry {
        row: 0,
        column: 0,
        value: 400.0,
    };
    let one = DMatrix::from_element(1, 1, 1.0);
    let model = PartModel::new(one.clone(), one.clone() * 0.0, vec![vec![entry]], one).unwrap();
    let frequency = |ln: f64| 20.0 / std::f64::consts::TAU * ln.exp();
    let seen = |ln: f64| vec![Some(SeenMode::new(frequency(ln), 0.002 * frequency(ln)))];
    let sound = [0.004, -0.006, 0.002, 0.0];
    let epochs: Vec<_> = sound.iter().map(|ln| seen(*ln)).collect();
    let reference = UpdateReference::learn(&model, &settings(1, 4), &epochs).unwrap();
    let measured = -0.03;
    let change = reference.change(&model, &seen(measured)).unwrap();

    let normal = |x: f64, variance: f64| (-0.5 * x * x / variance).exp() / variance.sqrt();
    // κ = 4 adds to the only mode: the scatter is 5 τ². Deviations are scaled by √(4/3).
    let levels = [1.0 / 16.0, 0.25, 1.0, 4.0, 16.0, 64.0].map(|factor| factor * 0.004_f64.powi(2));
    let weights = levels.map(|t| {
        let prior = (-2.0 * (t.ln() + 0.004_f64.powi(2) / t)).exp();
        let stated = 0.002_f64.powi(2) + 5.0 * t;
        let of_epochs = sound.map(|ln| normal(ln * (4.0_f64 / 3.0).sqrt(), stated).powf(0.75));
        prior * of_epochs.iter().product::<f64>()
    });
    let effect = 0.3 * change.mean(0) / 2.0; // of the last linearisation, within its accuracy
    let (mut sum, mut mean, mut square) = (0.0, 0.0, 0.0);
    for step in -4000..4000 {
        let d = f64::from(step) * 2e-4;
        for (t, weight) in levels.iter().zip(weights) {
            let stated = 0.002_f64.powi(2) * 1.25 + 5.0 * t * 1.25 + effect * effect;
            let density = weight * normal(measured - d / 2.0, stated) * normal(d, 0.0225);
            sum += density;
            mean += density * d;
            square += density * d * d;
        }
    }
    let mean = mean / sum;
    let std = (square / sum - mean * mean).sqrt();
    assert!(
        (change.mean(0) - mean).abs() < 2e-3 * mean.abs(),
        "{} {mean}",
        change.mean(0)
    );
    assert!(
        (change.std(0) - std).abs() < 5e-3 * std,
        "{} {std}",
        change.std(0)
    );
}

#[test]
fn quantiles_and_probabilities_are_inverse() {
    let mut truth = truth(&[2.0; 3], &[300.0; 3], USUAL, 4);
    let nominal = chain(&[2.0; 3], &[280.0; 3]);
    let change = followed(&mut truth, nominal, 5, &loss(3, 1, 0.1));
    for probability in [0.001, 0.025, 0.5, 0.975] {
        let value = change.quantile(1, probability);
        assert!((change.cdf(1, value) - probability).abs() < 1e-12);
    }
}

/// 95 % intervals of changes with masses that are wrong by 10 %, stiffnesses that are wrong by 25
/// %, and sound epochs that scatter.
#[test]
fn intervals_contain_the_change_although_the_model_is_wrong() {
    let (mut inside, mut all, mut found, mut wrong) = (0.0, 0.0, 0.0, 0.0);
    let runs = 60;
    for seed in 0..runs {
        let mut draws = ChaCha8Rng::seed_from_u64(1000 + seed);
        let mut of = |nominal: f64, share: f64| -> Vec<f64> {
            (0..5)
                .map(|_| {
                    let normal: f64 = StandardNormal.sample(&mut draws);
                    nominal * (share * normal).exp()
                })
                .collect()
        };
        let (masses, stiffnesses) = (of(2.0, 0.1), of(250.0, 0.25));
        let part = draws.random_range(0..5);
        let mut truth = truth(&masses, &stiffnesses, USUAL, seed);
        let expected = loss(5, part, 0.15);
        let nominal = chain(&[2.0; 5], &[250.0; 5]);
        let change = followed(&mut truth, nominal, 12, &expected);
        for other in 0..5 {
            let at = change.cdf(other, expected[other]);
            all += 1.0;
            inside += f64::from(u8::from((0.025..0.975).contains(&at)));
            let told = change.probability_of_loss(other, 0.0) > 0.99;
            match other == part {
                true => found += f64::from(u8::from(told)),
                false => wrong += f64::from(u8::from(told)),
            }
        }
    }
    let runs = runs as f64;
    println!(
        "inside {} found {} wrong {}",
        inside / all,
        found / runs,
        wrong / runs
    );
    assert!(inside / all > 0.9, "{}", inside / all);
    assert!(found / runs > 0.8, "{}", found / runs);
    assert!(wrong / runs < 0.05, "{}", wrong / runs);
}

#[test]
fn an_epoch_without_used_modes_tells_only_the_prior() {
    let mut truth = truth(&[2.0; 3], &[300.0; 3], STILL, 4);
    let epochs: Vec<_> = (0..4).map(|_| truth.epoch(&DVector::zeros(3))).collect();
    let nominal = chain(&[2.0; 3], &[300.0; 3]);
    let reference = UpdateReference::learn(&nominal, &settings(3, 4), &epochs).unwrap();
    let change = reference.change(&nominal, &[None, None, None]).unwrap();
    for part in 0..3 {
        assert!(change.mean(part).abs() < 1e-12);
        assert!((change.std(part) - 0.15).abs() < 1e-12);
    }
    let partly = truth.epoch(&DVector::zeros(3)).into_iter().take(1);
    let change = reference
        .change(&nominal, &partly.collect::<Vec<_>>())
        .unwrap();
    assert!(change.std(0) < 0.14);
}

#[test]
fn a_mode_far_from_those_of_the_model_is_not_used() {
    let model = chain(&[2.0; 3], &[300.0; 3]);
    let settings = settings(3, 1);
    let epoch = vec![Some(SeenMode::new(100.0, 0.1))];
    let refused = UpdateReference::learn(&model, &settings, &[epoch]).unwrap_err();
    assert_eq!(refused, crate::ModalError::NoModelMode);
}

/// With one frequency and no shape, the parts cannot be told from each other.
#[test]
fn parts_that_no_mode_tells_apart_have_no_smallest_loss() {
    let model = chain(&[2.0; 3], &[300.0; 3]);
    let (frequencies, _) = model.modes(&DVector::zeros(3)).unwrap();
    let of = |modes: usize, shape_std: Option<f64>| {
        let modes: Vec<(f64, f64)> = frequencies[..modes]
            .iter()
            .map(|f| (*f, 0.002 * f))
            .collect();
        let settings = settings(3, 50);
        let reference = UpdateReference::expected(&model, &settings, &modes, shape_std).unwrap();
        reference.precision(&model).unwrap()
    };
    let one = of(1, None);
    assert_eq!(one.smallest_loss(2), None);
    assert!(one.correlation(0, 1) < -0.5, "{}", one.correlation(0, 1));
    let all = of(3, Some(0.01));
    for part in 0..3 {
        let loss = all.smallest_loss(part).unwrap();
        assert!((0.02..0.3).contains(&loss), "{part}: {loss}");
    }
}
