//! The reference: what the commissioning has taught, or what is missing.

use crate::calibration::{Calibration, Performance};
use crate::cumulant::Cumulant;
use crate::day::Day;
use crate::frost::{KNOTS, ln_prior};
use crate::model::Columns;
use crate::regression::{Errors, FREEDOM, Posterior, fit};
use crate::settings::{Quantity, Season, Settings};
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

/// Candidates of φ, the correlation of two successive days.
const CORRELATIONS: [f64; 12] = [
    0.0, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98,
];
/// Shortest commissioning (days): a season.
const SEASON_DAYS: i64 = 90;
/// Smallest share of the days of the commissioning that must have data.
const SMALLEST_SHARE: f64 = 0.5;
/// Smallest coverage of the 95 % interval over the weeks of the commissioning.
const SMALLEST_COVERAGE: f64 = 0.9;
/// First day, and distance (days), of the origins from which the coverage is measured.
const FIRST_ORIGIN: usize = 30;
const ORIGIN_DISTANCE: usize = 7;
/// Number of days as cold as today that must have been learnt before a frost is judged.
///
/// The hinge is a simplification. A frost may have another course than its first day.
pub(crate) const FROST_DAYS: usize = 5;
/// Depth of frost (°C, mean over a day) below which a day counts as free of frost.
const FROST_DEPTH: f64 = 0.05;

/// A learnt reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Reference {
    pub(crate) columns: Columns,
    /// Index of T0 among the candidates.
    pub(crate) knot: usize,
    pub(crate) phi: f64,
    /// Mean of ln(value) in the commissioning, subtracted from every value.
    pub(crate) centre: f64,
    /// Mean regressors of the commissioning: the reference conditions.
    pub(crate) conditions: DVector<f64>,
    pub(crate) posterior: Posterior,
    pub(crate) cumulant: Cumulant,
    /// The coldest frost days that have been learnt, per temperature, in ascending order.
    pub(crate) coldest: Vec<Vec<f64>>,
    pub(crate) coverage: f64,
    /// First and last day of the commissioning.
    pub(crate) from_day: i64,
    pub(crate) to_day: i64,
    /// ln of the threshold of the detector.
    pub(crate) ln_threshold: f64,
    pub(crate) performance: Performance,
}

/// What is missing in a commissioning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Missing {
    /// The commissioning is shorter than a season.
    Season {
        /// Days since its start.
        days: u32,
        /// Days needed.
        needed: u32,
    },
    /// Too few days have the quantity and all conditions.
    Days {
        /// Days with data.
        days: u32,
        /// Days needed.
        needed: u32,
    },
    /// The model predicts later weeks of the commissioning badly.
    Coverage {
        /// Share of the days within the 95 % interval.
        found: f64,
        /// Smallest share allowed.
        needed: f64,
    },
}

impl std::fmt::Display for Missing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Season { days, needed } => {
                write!(f, "the commissioning spans {days} days and needs {needed}")
            }
            Self::Days { days, needed } => write!(
                f,
                "{days} days have the quantity and all conditions, {needed} are needed"
            ),
            Self::Coverage { found, needed } => write!(
                f,
                "the 95 % interval holds {:.0} % of the later days of the commissioning and must \
                 hold {:.0} %; a condition may be missing",
                100.0 * found,
                100.0 * needed
            ),
        }
    }
}

/// Quantile of the 95 % interval, in units of σ.
pub(crate) fn interval_quantile() -> f64 {
    StudentsT::new(0.0, 1.0, FREEDOM).map_or(2.776, |t| t.inverse_cdf(0.975))
}

impl Reference {
    /// Learns from the days of a commissioning, in ascending order.
    ///
    /// # Errors
    /// Returns what is missing.
    pub(crate) fn learn(
        days: &[Day],
        quantity: &Quantity,
        settings: &Settings,
        seed: u64,
    ) -> Result<Self, Missing> {
        let (from_day, to_day) = span(days);
        let spans = (to_day - from_day + 1).max(0);
        if settings.season == Season::Required && spans < SEASON_DAYS {
            return Err(Missing::Season {
                days: spans as u32,
                needed: SEASON_DAYS as u32,
            });
        }
        let needed = ((spans as f64 * SMALLEST_SHARE).ceil() as usize).max(SMALLEST_DAYS);
        let too_few = Missing::Days {
            days: days.len() as u32,
            needed: needed as u32,
        };
        if days.len() < needed {
            return Err(too_few);
        }
        let columns = Columns::new(quantity, &settings.conditions);
        let centre = days.iter().map(|day| day.y).sum::<f64>() / days.len() as f64;
        let (knot, phi) = choose(&columns, days, centre).ok_or(too_few.clone())?;
        let coverage = coverage(&columns, days, centre, knot, phi);
        if coverage < SMALLEST_COVERAGE {
            return Err(Missing::Coverage {
                found: coverage,
                needed: SMALLEST_COVERAGE,
            });
        }
        let rows = columns.whitened(days, knot, centre, phi);
        let fitted = fit(&rows, &columns.prior, Errors::StudentT).ok_or(too_few)?;
        let posterior = fitted.posterior;
        let residuals: Vec<f64> = rows
            .iter()
            .map(|row| (row.y - posterior.expected(&row.x)) / posterior.sigma)
            .collect();
        let cumulant = Cumulant::new(&residuals);
        let mut conditions = DVector::zeros(columns.prior.len());
        for day in days {
            conditions += columns.row(day, knot, centre).x / days.len() as f64;
        }
        let calibration = Calibration {
            residuals: &residuals,
            cumulant: &cumulant,
            phi,
            sigma: posterior.sigma,
            unit: -quantity.kind.per_stiffness() * (1.0 - settings.loss).ln(),
            seed,
        };
        let share = settings.false_alarms_per_year / settings.quantities.len() as f64;
        let (ln_threshold, performance) = calibration.run(share, quantity.kind.per_stiffness());
        let mut reference = Self {
            coldest: vec![Vec::new(); columns.temperatures.len()],
            columns,
            knot,
            phi,
            centre,
            conditions,
            posterior,
            cumulant,
            coverage,
            from_day,
            to_day,
            ln_threshold,
            performance,
        };
        for day in days {
            reference.remember_frost(day);
        }
        Ok(reference)
    }

    /// Returns T0 (°C).
    pub(crate) fn knot_celsius(&self) -> f64 {
        KNOTS[self.knot]
    }

    /// Returns `true` if fewer than five learnt days were as cold as this one.
    pub(crate) fn is_new_frost(&self, day: &Day) -> bool {
        let frost = self.columns.frost(day, self.knot);
        frost.zip(&self.coldest).any(|(depth, coldest)| {
            depth < -FROST_DEPTH
                && coldest
                    .get(FROST_DAYS - 1)
                    .is_none_or(|known| depth < *known)
        })
    }

    /// Returns `true` if the learnt days include five of frost, for every temperature.
    pub(crate) fn knows_frost(&self) -> bool {
        let is_frost = |depth: &f64| *depth < -FROST_DEPTH;
        let enough =
            |coldest: &Vec<f64>| coldest.iter().filter(|d| is_frost(d)).count() >= FROST_DAYS;
        self.coldest.iter().all(enough)
    }

    /// Counts a learnt day among the coldest.
    pub(crate) fn remember_frost(&mut self, day: &Day) {
        let depths: Vec<f64> = self.columns.frost(day, self.knot).collect();
        for (coldest, depth) in self.coldest.iter_mut().zip(depths) {
            let place = coldest.partition_point(|known| *known <= depth);
            coldest.insert(place, depth);
            coldest.truncate(FROST_DAYS);
        }
    }
}

/// Smallest number of days with data.
const SMALLEST_DAYS: usize = 10;

fn span(days: &[Day]) -> (i64, i64) {
    let first = days.first().map_or(0, |day| day.number);
    (first, days.last().map_or(first - 1, |day| day.number))
}

/// Returns the T0 and φ with the largest evidence (profile likelihood with the prior of T0).
///
/// The errors are normal here: heavy-tailed errors would explain a long frost as many outliers
/// instead of as a correlation.
fn choose(columns: &Columns, days: &[Day], centre: f64) -> Option<(usize, f64)> {
    let knots = if columns.temperatures.is_empty() {
        // Without a temperature, T0 has no effect.
        3..4
    } else {
        0..KNOTS.len()
    };
    let mut best: Option<(f64, usize, f64)> = None;
    for knot in knots {
        for phi in CORRELATIONS {
            let rows = columns.whitened(days, knot, centre, phi);
            let fitted = fit(&rows, &columns.prior, Errors::Normal)?;
            let jacobian: f64 = days
                .windows(2)
                .map(|pair| {
                    crate::whitening::Step::over(phi, pair[1].number - pair[0].number)
                        .root
                        .ln()
                })
                .sum();
            let score = fitted.ln_evidence - jacobian + ln_prior(KNOTS[knot]);
            if best.is_none_or(|(found, ..)| score > found) {
                best = Some((score, knot, phi));
            }
        }
    }
    best.map(|(_, knot, phi)| (knot, phi))
}

/// Returns the share of the days of the commissioning within the 95 % interval that the days before
/// the last origin predict, or 1 if there are no such days.
///
/// Days outside the experience of the origin do not count, because they would not be judged.
fn coverage(columns: &Columns, days: &[Day], centre: f64, knot: usize, phi: f64) -> f64 {
    let quantile = interval_quantile();
    let (mut inside, mut all) = (0_u32, 0_u32);
    let mut origin = FIRST_ORIGIN.max(days.len() / 3);
    while origin < days.len() {
        let rows = columns.whitened(&days[..origin], knot, centre, phi);
        let Some(fitted) = fit(&rows, &columns.prior, Errors::StudentT) else {
            break;
        };
        for day in days.iter().skip(origin).take(ORIGIN_DISTANCE) {
            let row = columns.row(day, knot, centre);
            let leverage = fitted.posterior.leverage(&row.x);
            let frost = columns.frost(day, knot).any(|depth| depth < -FROST_DEPTH);
            if leverage > 1.0 || (frost && !has_frost(columns, &days[..origin], knot)) {
                continue;
            }
            let std = fitted.posterior.sigma * (1.0 + leverage).sqrt();
            let error = (row.y - fitted.posterior.expected(&row.x)).abs();
            all += 1;
            inside += u32::from(error <= quantile * std);
        }
        origin += ORIGIN_DISTANCE;
    }
    match all {
        0 => 1.0,
        _ => f64::from(inside) / f64::from(all),
    }
}

fn has_frost(columns: &Columns, days: &[Day], knot: usize) -> bool {
    let frosty = |day: &&Day| columns.frost(day, knot).any(|depth| depth < -FROST_DEPTH);
    days.iter().filter(frosty).count() >= FROST_DAYS
}
