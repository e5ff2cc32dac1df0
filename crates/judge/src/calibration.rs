//! The threshold that keeps false alarms within the budget, and the losses that it detects.
//!
//! The e-detector alone guarantees the budget if the residuals are independent. The
//! calibration checks this with the residuals of the commissioning: it draws blocks of seven days,
//! with replacement, and joins them to years. Source: Künsch (1989), Annals of Statistics 17,
//! 1217–1241, for the block bootstrap.

use crate::cumulant::{CLIP, Cumulant, LARGEST_SHIFT};
use crate::detector::{HELD_DAYS, SHORTEST_STEP_DAYS, SIZES, StepEstimate};
use crate::model::{Columns, Deviation, Structure};
use crate::regression::Posterior;
use nalgebra::DVector;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, Gamma};

/// Number of simulated years.
const YEARS: usize = 1000;
/// Number of simulated years with a loss, for each size.
const LOSS_YEARS: usize = 200;
const DAYS: usize = 365;
/// Day of a simulated year on which the loss begins.
const ONSET: usize = 60;
/// Length of a block (days): longer than the weather that φ does not explain.
const BLOCK: usize = 7;
/// Probability that the budget holds.
const CREDIBILITY: f64 = 0.9;
/// Losses of stiffness whose delay is reported.
pub(crate) const LOSSES: [f64; 6] = [0.01, 0.02, 0.03, 0.05, 0.10, 0.20];

/// Performance of the detector of a quantity: false alarms and detection delays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Performance {
    /// False alarms per year that this quantity may raise.
    pub promised_per_year: f64,
    /// False alarms per year, in 1000 simulated years that are drawn from the commissioning.
    pub achieved_per_year: f64,
    /// Detection delays of losses of stiffness, one for each size of loss.
    pub delays: Vec<Delay>,
}

/// Time from a loss of stiffness of one size to its detection.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Delay {
    /// Size of the loss, as a share of the stiffness (0 to 1).
    pub loss: f64,
    /// Median time from the loss to the alarm (days), or `None` if fewer than half of the losses
    /// are found within 305 days.
    pub median_days: Option<u32>,
    /// Share of the simulated losses that are found within 30 days, 0 to 1.
    pub found_in_a_month: f64,
}

/// What remains of a unit step in the residuals of the days after it, under the mean conditions.
pub(crate) struct Steps {
    /// h/scale (1/ln(value)) of each day.
    remainders: Vec<f64>,
    /// Mean of h/scale over the first days, which the simulated detector uses for all of them.
    mean: f64,
}

/// Days of a step from which the simulated detector takes the mean of h.
const FIRST_DAYS: usize = 10;

impl Steps {
    pub(crate) fn new(
        columns: &Columns,
        structure: &Structure,
        posterior: &Posterior,
        conditions: &DVector<f64>,
    ) -> Self {
        let (mut known, mut x) = (posterior.clone(), conditions.clone());
        let mut response = DVector::zeros(columns.count());
        x[columns.count() - 1] = 1.0; // the deviation
        let remainders: Vec<f64> = (ONSET..DAYS)
            .map(|_| {
                known.evolve(columns, structure, 1);
                for forgetful in columns.forgetful(structure) {
                    response[forgetful.column] *= forgetful.kept(1);
                }
                let h = 1.0 - x.dot(&response);
                let scale = known.sigma * (1.0 + known.leverage(&x)).sqrt();
                let gain = known.learn(&x, 0.0, 1.0);
                response.axpy(h, &gain, 1.0);
                h / scale
            })
            .collect();
        let first = remainders.iter().take(FIRST_DAYS);
        Self {
            mean: first.sum::<f64>() / FIRST_DAYS as f64,
            remainders,
        }
    }
}

/// A detector whose regression does not change.
pub(crate) struct Calibration<'r> {
    pub(crate) residuals: &'r [f64],
    pub(crate) cumulant: &'r Cumulant,
    pub(crate) steps: &'r Steps,
    /// Change of ln(value) of the loss that matters, positive.
    pub(crate) unit: f64,
    /// Deviation that a step must exceed.
    pub(crate) deviation: Deviation,
    /// Seed of the blocks.
    pub(crate) seed: u64,
}

impl Calibration<'_> {
    /// Returns ln of the threshold, and its performance. The threshold starts at the guaranteed
    /// value and increases until the simulated years meet the budget with 90 % credibility.
    ///
    /// `per_year` is the budget of the quantity, `per_stiffness` the change of ln(value) per change
    /// of ln(stiffness).
    pub(crate) fn run(&self, per_year: f64, per_stiffness: f64) -> (f64, Performance) {
        let guaranteed = (365.25 / per_year).ln();
        let mut years = Years::new(self, self.seed);
        let mut largest: Vec<f64> = (0..YEARS).map(|_| years.sound().0).collect();
        largest.sort_by(f64::total_cmp);
        let allowed = allowed_alarms(per_year * YEARS as f64);
        let empirical = largest[YEARS - 1 - allowed.min(YEARS - 1)];
        let threshold = guaranteed.max(empirical);
        let alarms = largest.iter().filter(|value| **value > threshold).count();
        let delays = LOSSES.map(|loss| {
            let shift = -per_stiffness * (1.0 - loss).ln();
            let mut years = Years::new(self, self.seed ^ 1);
            let mut found: Vec<Option<u32>> = (0..LOSS_YEARS)
                .map(|_| years.with_loss(shift, threshold))
                .collect();
            found.sort_by_key(|delay| delay.unwrap_or(u32::MAX));
            let soon = found.iter().flatten().filter(|delay| **delay <= 30).count();
            Delay {
                loss,
                median_days: found[LOSS_YEARS / 2],
                found_in_a_month: soon as f64 / LOSS_YEARS as f64,
            }
        });
        let performance = Performance {
            promised_per_year: per_year,
            achieved_per_year: alarms as f64 / YEARS as f64,
            delays: delays.to_vec(),
        };
        (threshold, performance)
    }

    /// Returns `true` if a step is a loss that is large enough to be raised on a day.
    fn raises(&self, step: StepEstimate, day: usize) -> bool {
        step.size < 0.0 && step.matters(day as i64, self.unit, self.deviation)
    }
}

/// Returns the largest number of alarms that still supports an expected number of `expected` with
/// 90 % credibility, for a Poisson number and the prior 1/√rate.
fn allowed_alarms(expected: f64) -> usize {
    let supports = |alarms: usize| {
        Gamma::new(alarms as f64 + 0.5, 1.0)
            .is_ok_and(|posterior| posterior.cdf(expected) >= CREDIBILITY)
    };
    let mut alarms = 0;
    while supports(alarms + 1) {
        alarms += 1;
    }
    alarms
}

/// Simulated years of one detector.
struct Years<'c> {
    calibration: &'c Calibration<'c>,
    random: ChaCha8Rng,
    sizes: Sizes,
}

/// g and κ(g) of each size.
type Sizes = [(f64, f64); SIZES.len()];

impl<'c> Years<'c> {
    fn new(calibration: &'c Calibration<'c>, seed: u64) -> Self {
        let sizes = SIZES.map(|size| {
            let g = (calibration.steps.mean * size * calibration.unit).min(LARGEST_SHIFT);
            (g, calibration.cumulant.at(g))
        });
        Self {
            calibration,
            random: ChaCha8Rng::seed_from_u64(seed),
            sizes,
        }
    }

    /// Returns the largest ln R of a sound year.
    fn sound(&mut self) -> (f64, Option<u32>) {
        self.year(0.0, f64::INFINITY)
    }

    /// Returns the days from a loss of `shift` (in ln(value)) to R above the threshold.
    fn with_loss(&mut self, shift: f64, threshold: f64) -> Option<u32> {
        self.year(shift, threshold).1
    }

    fn year(&mut self, shift: f64, threshold: f64) -> (f64, Option<u32>) {
        let (mut evidence, mut largest) = ([0.0_f64; SIZES.len()], f64::NEG_INFINITY);
        let residuals = self.calibration.residuals;
        let remainders = &self.calibration.steps.remainders;
        let mut place = 0;
        // Σ h²/scale² and Σ h z/scale of the step, as in the detector.
        let (mut information, mut moment) = (0.0, 0.0);
        for day in 0..DAYS {
            if day % BLOCK == 0 {
                place = (self.random.next_u64() % residuals.len().max(1) as u64) as usize;
            }
            let drawn = residuals.get((place + day % BLOCK) % residuals.len().max(1));
            let remainder = day.checked_sub(ONSET).map_or(0.0, |age| remainders[age]);
            let shifted = drawn.copied().unwrap_or(0.0) - remainder * shift;
            let z = shifted.clamp(-CLIP, CLIP);
            information += remainder * remainder;
            moment += remainder * shifted;
            let mut total = 0.0;
            for (sum, (g, kappa)) in evidence.iter_mut().zip(self.sizes) {
                let begun = *sum + 1.0 / SIZES.len() as f64;
                *sum = (begun * (-g * z - kappa).exp()).min(f64::MAX / 1e10);
                total += *sum;
            }
            let ln_total = f64::ln(total);
            largest = largest.max(ln_total);
            let step = StepEstimate {
                day: ONSET as i64,
                size: moment / information,
                std: f64::sqrt(information).recip(),
            };
            let shows = shift > 0.0 && day >= ONSET && ln_total > threshold;
            if shows && self.calibration.raises(step, day) {
                let delay = (day - ONSET + 1) as u32;
                let shortest = SHORTEST_STEP_DAYS + HELD_DAYS - 1;
                return (largest, Some((delay + HELD_DAYS - 1).max(shortest)));
            }
        }
        (largest, None)
    }
}
