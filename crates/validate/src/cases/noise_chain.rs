//! Chapter 3, §3.1: the effect of wrong noise levels on a filter for a chain of five masses, and
//! the identification of these levels.
//!
//! A white force acts on the last mass. All accelerations are observed without the direct term, as
//! in the source. The start value of `θ` is deliberately poor. The start-up aid of chapter 2
//! softens its effect, because without it one record in three locks the filter at wrong parameters.

use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::{Outcome, Plot, Series, SeriesKind};
use crate::run::Run;
use crate::statistics::{Accuracy, Mean, Normal, rms};
use crate::systems::chain::Chain;
use crate::systems::linear;
use nalgebra::{DMatrix, DVector};
use spandrel_filter::{
    Annealing, ExtendedKalmanFilter, FadingFactor, FilterSettings, Frame, LinearModel, NoiseModel,
    NoiseParameter, NoisePhase, NoiseRule, NoiseSettings, NoiseTarget,
};
use std::f64::consts::PI;

const MASSES: usize = 5;
const STIFFNESS: f64 = 5000.0;
const STEP_S: f64 = 0.0025;
const ALPHA: f64 = 0.2998;
const BETA: f64 = 2.536e-4;
/// Fundamental period (s).
const PERIOD_S: f64 = 1.0 / 3.203;

struct Record {
    data: Vec<DVector<f64>>,
    noise_variance: f64,
}

fn excitation_variance() -> f64 {
    2.0 * PI * 5.0e-5 / STEP_S
}

fn simulate(seed: u64, seconds: f64) -> Record {
    let (system, _) = linear::under_ground_motion(&linear::chain(MASSES, STIFFNESS), ALPHA, BETA);
    let input = DMatrix::from_fn(
        2 * MASSES,
        1,
        |i, _| if i + 1 == 2 * MASSES { 1.0 } else { 0.0 },
    );
    let (transition, held) = LinearModel::discretise(&system, &input, STEP_S);
    let observation = system.rows(MASSES, MASSES).into_owned();
    let (mut force, mut noise) = (Normal::stream(seed, 0), Normal::stream(seed, 1));
    let mut u = DVector::zeros(2 * MASSES);
    let mut data: Vec<DVector<f64>> = (0..(seconds / STEP_S) as usize)
        .map(|_| {
            u = &transition * &u + &held * (excitation_variance().sqrt() * force.draw());
            &observation * &u
        })
        .collect();
    let noise_std = 0.05 * rms(data.iter().map(|z| z[MASSES - 1]));
    for z in &mut data {
        z.iter_mut()
            .for_each(|value| *value += noise_std * noise.draw());
    }
    Record {
        data,
        noise_variance: noise_std * noise_std,
    }
}

fn settings(noise: NoiseModel) -> Result<FilterSettings, ValidateError> {
    let mut prior = DVector::zeros(2 * MASSES + 3);
    let mut std = DVector::repeat(2 * MASSES + 3, 1e-2);
    for j in 0..MASSES {
        std[MASSES + j] = 1e-1;
    }
    for (j, (mean, deviation)) in [(0.5, 0.3), (1.0, 0.3), (1e-3, 1e-3)]
        .into_iter()
        .enumerate()
    {
        prior[2 * MASSES + j] = mean;
        std[2 * MASSES + j] = deviation;
    }
    let mut settings = FilterSettings::new(STEP_S, prior, std, noise);
    settings.fading = FadingFactor::from_half_life(2000.0).map_err(ValidateError::setting)?;
    settings.annealing = Some(Annealing {
        amount: 100.0,
        time_constant_s: 1.0,
    });
    for j in 2 * MASSES..2 * MASSES + 3 {
        settings.lower[j] = 0.05 * settings.prior_mean[j];
    }
    Ok(settings)
}

/// Results of a case of table 3.1 with fixed levels.
struct Fixed {
    misfit: f64,
    stiffness: Accuracy,
    beta: Accuracy,
    curve: Vec<(f32, f32)>,
}

fn with_fixed_levels(
    record: &Record,
    excitation: f64,
    sensors: f64,
) -> Result<Fixed, ValidateError> {
    let noise = NoiseModel::known(
        DMatrix::from_element(1, 1, excitation),
        DMatrix::identity(MASSES, MASSES) * sensors,
    );
    let mut filter = ExtendedKalmanFilter::new(Chain::new(MASSES, STIFFNESS), settings(noise)?)
        .map_err(ValidateError::setting)?;
    let mut misfit = Mean::default();
    let (mut stiffness, mut beta, mut curve) =
        (Accuracy::default(), Accuracy::default(), Vec::new());
    for (i, datum) in record.data.iter().enumerate() {
        let time_s = (i + 1) as f64 * STEP_S;
        let frame = Frame {
            observations: datum.as_slice(),
            excitation: &[0.0],
        };
        let step = filter.step(frame).map_err(ValidateError::at(time_s))?;
        if i % 8 == 0 {
            curve.push((time_s as f32, filter.mean()[2 * MASSES] as f32));
        }
        if time_s > 10.0 {
            misfit.take(step.normalised_innovation_squared / MASSES as f64);
            let std = |j: usize| filter.covariance()[(j, j)].sqrt();
            stiffness.take(filter.mean()[2 * MASSES], std(2 * MASSES), 1.0);
            beta.take(filter.mean()[2 * MASSES + 2], std(2 * MASSES + 2), BETA);
        }
    }
    Ok(Fixed {
        misfit: misfit.value(),
        stiffness,
        beta,
        curve,
    })
}

/// Identifies the level of the sensors from `ψ = 1`, and that of the force if asked.
fn with_identified_levels(
    record: &Record,
    rule: NoiseRule,
    force: bool,
) -> Result<ExtendedKalmanFilter<Chain>, ValidateError> {
    let known = if force { 0.0 } else { excitation_variance() };
    let excitation = DMatrix::from_element(1, 1, known);
    let mut noise = NoiseModel::known(excitation, DMatrix::zeros(MASSES, MASSES));
    let level = |name: &str, target, size| NoiseParameter {
        name: name.to_owned(),
        target,
        pattern: DMatrix::identity(size, size),
        start: 1.0,
        start_std: 1.0 / 3.0,
    };
    if force {
        noise
            .parameters
            .push(level("force", NoiseTarget::Excitation, 1));
    }
    noise
        .parameters
        .push(level("sensors", NoiseTarget::Sensors, MASSES));
    let mut settings = settings(noise)?;
    settings.noise_settings = NoiseSettings {
        rule,
        training_steps: (10.0 * PERIOD_S / STEP_S) as u64,
        training_limit_steps: (40.0 * PERIOD_S / STEP_S) as u64,
        ..NoiseSettings::default()
    };
    let mut filter = ExtendedKalmanFilter::new(Chain::new(MASSES, STIFFNESS), settings)
        .map_err(ValidateError::setting)?;
    for (i, datum) in record.data.iter().enumerate() {
        let frame = Frame {
            observations: datum.as_slice(),
            excitation: &[0.0],
        };
        filter
            .step(frame)
            .map_err(ValidateError::at((i + 1) as f64 * STEP_S))?;
    }
    Ok(filter)
}

pub(super) fn run(run: &Run<'_>) -> Result<Outcome, ValidateError> {
    let record = simulate(run.seed, 20.0);
    let (force, sensors) = (excitation_variance(), record.noise_variance);
    let right = with_fixed_levels(&record, force, sensors)?;
    let weak = with_fixed_levels(&record, 0.001, sensors)?;
    let noisy = with_fixed_levels(&record, force, 10.0 * sensors)?;
    run.advance(0.4);
    let omega = linear::chain(MASSES, STIFFNESS)
        .symmetric_eigenvalues()
        .min()
        .sqrt();
    let mut figures = vec![
        Figure::new(
            "variance of the force (N²)",
            force,
            Required::Within {
                of: 0.12566,
                by: 1e-5,
            },
        )
        .published(0.126),
        Figure::new(
            "f1 (Hz)",
            omega / (2.0 * PI),
            Required::Within {
                of: 3.203,
                by: 1e-3,
            },
        )
        .published(3.20),
        Figure::new(
            "variance of the sensors ((m/s²)²)",
            sensors,
            Required::Reported,
        )
        .published(2.62e-4),
        Figure::new(
            "case 1: mean misfit",
            right.misfit,
            Required::Within { of: 1.0, by: 0.05 },
        ),
        Figure::new("case 2: mean misfit", weak.misfit, Required::AtLeast(3.0)),
        Figure::new("case 3: mean misfit", noisy.misfit, Required::AtMost(0.2)),
        Figure::new(
            "deviation of θ, case 3 over case 1",
            noisy.stiffness.mean_std() / right.stiffness.mean_std(),
            Required::Between {
                low: 2.0,
                high: 3.5,
            },
        ),
        // The interval is expected to miss the truth.
        Figure::new(
            "case 2: distance of β from the truth in deviations",
            weak.beta.bias(),
            Required::AtLeast(3.0),
        ),
        Figure::new(
            "case 2: share of time in which β is covered",
            weak.beta.coverage(),
            Required::AtMost(0.0),
        )
        .known_miss_within(
            Required::AtMost(0.5),
            "in some records the estimate passes the truth on its way, for up to 3 of the 10 s",
        ),
        Figure::new(
            "case 2: share of time in which θ is covered",
            weak.stiffness.coverage(),
            Required::Reported,
        ),
        Figure::new(
            "case 1: share of time in which θ is covered",
            right.stiffness.coverage(),
            Required::Reported,
        ),
    ];
    // With a force a thousand times too strong, divergence depends on the start and the record. It
    // is therefore shown and not judged.
    let wild = with_fixed_levels(&record, 1000.0 * force, sensors);
    let (misfit, error) = wild.as_ref().map_or((f64::NAN, f64::NAN), |wild| {
        (wild.misfit, wild.stiffness.relative_error())
    });
    figures.extend([
        Figure::new("case 4: mean misfit", misfit, Required::Reported),
        Figure::new(
            "case 4: error of θ over its value",
            error,
            Required::Reported,
        ),
        Figure::new(
            "case 1: error of θ over its value",
            right.stiffness.relative_error(),
            Required::Reported,
        ),
    ]);
    let long = simulate(run.seed, run.pick(100.0, 60.0));
    for (name, rule) in [
        ("published", NoiseRule::Published),
        ("fisher", NoiseRule::Fisher),
    ] {
        let filter = with_identified_levels(&long, rule, false)?;
        let noise = filter.noise();
        let level = noise.mean[0] / long.noise_variance;
        let trained = f64::from(u8::from(noise.phase == NoisePhase::Working));
        figures.extend([
            Figure::new(
                format!("{name}: training ended"),
                trained,
                Required::AtLeast(1.0),
            ),
            Figure::new(
                format!("{name}: fallbacks in the working phase"),
                noise.working_fallbacks as f64,
                Required::AtMost(0.0),
            ),
            Figure::new(
                format!("{name}: shortened steps in the working phase"),
                noise.limited as f64,
                Required::AtMost(0.0),
            ),
            Figure::new(
                format!("{name}: level of the sensors over the truth"),
                level,
                Required::Within { of: 1.0, by: 0.1 },
            ),
        ]);
        run.advance(0.7);
    }
    let mut curves = vec![
        ("case 1", right.curve),
        ("case 2", weak.curve),
        ("case 3", noisy.curve),
    ];
    curves.extend(wild.map(|wild| ("case 4", wild.curve)));
    let series = curves
        .into_iter()
        .map(|(name, points)| Series::new(name, SeriesKind::Estimate, points))
        .collect();
    let plots = vec![
        Plot::over_time("Stiffness with the fixed levels of table 3.1", "θ", series)
            .within(0.4, 1.6),
    ];
    Ok(Outcome {
        figures,
        tables: Vec::new(),
        plots,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn level_with_little_information_stays_uncertain() {
        // Chapter 3, §5, failure signatures: a force needs more than one sample to reach the
        // sensors, but the likelihood covers one step. The published rule treats a level as known
        // after its training, so it must stay in training. The scoring rule continues to learn. Its
        // training ends at the limit of 40 periods (12.5 s), and the level remains uncertain.
        for (rule, seconds, phase) in [
            (NoiseRule::Published, 20.0, NoisePhase::Training),
            (NoiseRule::Fisher, 12.0, NoisePhase::Training),
            (NoiseRule::Fisher, 20.0, NoisePhase::Working),
        ] {
            let filter = with_identified_levels(&simulate(1, seconds), rule, true).unwrap();
            let (found, std) = (filter.noise().phase, filter.noise().largest_relative_std());
            println!("{rule:?}, {seconds} s: relative sd {std:.3}");
            assert_eq!(found, phase, "{rule:?}, {seconds} s");
            assert!(std > 0.1, "{rule:?}, {seconds} s: {std}");
        }
    }
}
