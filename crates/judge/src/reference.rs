//! The reference, which is learnt in the commissioning.

use crate::calibration::{Calibration, Performance, Steps};
use crate::choice::Choice;
use crate::climate::implausible;
use crate::course::Frame;
use crate::cumulant::Cumulant;
use crate::day::Day;
use crate::extremes::Extremes;
use crate::frost::KNOTS;
use crate::inertia::Past;
use crate::interval::INTERVAL;
use crate::model::{Columns, DEVIATIONS, Deviation, Row, Structure};
use crate::regression::{Posterior, Series, Taught, weight};
use crate::settings::Season;
use crate::spread::Spread;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

/// A season (days): the shortest commissioning with a temperature, and the shortest time without
/// frost between two winters.
const SEASON_DAYS: i64 = 90;
/// Smallest share of the days of the commissioning that must have data.
const SMALLEST_SHARE: f64 = 0.5;
/// Smallest coverage of the 95 % interval over the weeks of the commissioning.
const SMALLEST_COVERAGE: f64 = 0.9;
/// First day of the commissioning that is predicted from the days before it.
const FIRST_DAY: usize = 30;
/// Distance of the origins from which the coverage is measured (days).
const ORIGIN_DISTANCE: usize = 7;
/// Number of days as cold as today that make a frost known.
///
/// The hinge is a simplification. A frost may develop differently after its first day.
pub(crate) const FROST_DAYS: usize = 5;
/// Depth of frost (°C, mean over a day) below which a day counts as free of frost.
const FROST_DEPTH: f64 = 0.05;

/// A learnt reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Reference {
    pub(crate) columns: Columns,
    pub(crate) structure: Structure,
    /// The interior on the last day.
    past: Past,
    /// Mean of ln(value) in the commissioning, subtracted from every value.
    pub(crate) centre: f64,
    /// Mean regressors of the commissioning: the reference conditions.
    pub(crate) conditions: DVector<f64>,
    pub(crate) posterior: Posterior,
    pub(crate) guard: Guard,
    /// Scatter of the commissioning.
    pub(crate) spread: Spread,
    pub(crate) cumulant: Cumulant,
    /// The coldest frost days that have been learnt, per temperature, in ascending order.
    coldest: Vec<Vec<f64>>,
    /// The same at the end of the commissioning, or of a later winter.
    coldest_of_past: Vec<Vec<f64>>,
    /// Number of learnt days without frost since the last one with frost.
    frost_free_days: i64,
    /// First day of frost of the last winter. Without one, the first day of the commissioning.
    winter_from: i64,
    /// The lowest and highest learnt values of each condition.
    extremes: Vec<Extremes>,
    /// q at the end of the commissioning: half of the 95 % interval of a day, in units of its
    /// scatter.
    pub(crate) quantile: f64,
    pub(crate) coverage: f64,
    /// First and last day of the commissioning.
    pub(crate) from_day: i64,
    pub(crate) to_day: i64,
    /// ln of the threshold of the detector.
    pub(crate) ln_threshold: f64,
    pub(crate) performance: Performance,
}

/// Reason why a commissioning does not yet give a reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Missing {
    /// The commissioning is shorter than a season, or than a year without a temperature.
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
    /// The unit of a temperature is probably wrong: the commissioning is too hot.
    Hot {
        /// Name of the temperature.
        condition: String,
        /// Median of the days (°C).
        median: f64,
    },
    /// The unit of a temperature is probably wrong: the commissioning is too cold.
    Cold {
        /// Name of the temperature.
        condition: String,
        /// Temperature below which nine of ten days are (°C).
        warm: f64,
    },
}

/// What to do about an implausible temperature.
const CHECK_UNIT: &str = "its unit is probably wrong; if the values are right, declare the unit \
                          \"other\"";

impl std::fmt::Display for Missing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Season { days, needed } => {
                write!(
                    f,
                    "the commissioning spans {days} days, must span at least {needed}"
                )?;
                match i64::from(*needed) == YEAR_DAYS {
                    true => f.write_str(", because no temperature is measured"),
                    false => Ok(()),
                }
            }
            Self::Days { days, needed } => write!(
                f,
                "{days} days have the quantity and all conditions, must be at least {needed}"
            ),
            Self::Coverage { found, needed } => write!(
                f,
                "the 95 % interval contains {:.0} % of the later days of the commissioning, must \
                 contain at least {:.0} %; a condition may be missing, or the structure may have \
                 changed during the commissioning",
                100.0 * found,
                100.0 * needed
            ),
            Self::Hot { condition, median } => write!(
                f,
                "the median of {condition} in the commissioning is {median:.1} °C; {CHECK_UNIT}"
            ),
            Self::Cold { condition, warm } => write!(
                f,
                "nine of ten days of the commissioning have {condition} below {warm:.1} °C; \
                 {CHECK_UNIT}"
            ),
        }
    }
}

/// Quantile of the 95 % interval of errors with ν degrees of freedom, in units of σ.
fn interval_quantile(freedom: f64) -> f64 {
    StudentsT::new(0.0, 1.0, freedom).map_or(1.96, |t| t.inverse_cdf(0.975))
}

impl Reference {
    /// Learns from the days of a commissioning, in ascending order.
    ///
    /// # Errors
    /// The data do not suffice for a reference. The error states the reason.
    pub(crate) fn learn(days: &[Day], frame: Frame<'_>) -> Result<Self, Missing> {
        let Frame {
            settings, quantity, ..
        } = frame;
        let explanation = frame.explanation();
        let (from_day, to_day) = span(days);
        let spans = (to_day - from_day + 1).max(0);
        // Without a temperature, a season looks like a lasting change.
        let has_temperature = settings.conditions.iter().any(|c| c.kind.is_temperature());
        let season = if has_temperature {
            SEASON_DAYS
        } else {
            YEAR_DAYS
        };
        if settings.season == Season::Required && spans < season {
            return Err(Missing::Season {
                days: spans as u32,
                needed: season as u32,
            });
        }
        let needed = ((spans as f64 * SMALLEST_SHARE).ceil() as usize).max(SMALLEST_DAYS);
        if days.len() < needed {
            return Err(Missing::Days {
                days: days.len() as u32,
                needed: needed as u32,
            });
        }
        if let Some(missing) = implausible(days, &settings.conditions) {
            return Err(missing);
        }
        let centre = days.iter().map(|day| day.y).sum::<f64>() / days.len() as f64;
        let columns = Columns::new(quantity, explanation, days);
        let Choice {
            columns,
            structure,
            rows,
            past,
            taught,
        } = Choice::best(columns, days, centre);
        let Taught {
            posterior,
            residuals,
            ..
        } = taught;
        let series = Series {
            columns: &columns,
            structure: &structure,
            days,
            rows: &rows,
        };
        let coverage = coverage(series, posterior.sigma);
        if coverage < SMALLEST_COVERAGE {
            return Err(Missing::Coverage {
                found: coverage,
                needed: SMALLEST_COVERAGE,
            });
        }
        let quantile = quantile(series, posterior.sigma);
        let cumulant = Cumulant::new(&residuals);
        let mut conditions = DVector::zeros(columns.count());
        for row in &rows {
            conditions += &row.x / days.len() as f64;
        }
        let conditions = columns.lasting(&conditions);
        let calibration = Calibration {
            residuals: &centred(&residuals),
            cumulant: &cumulant,
            steps: &Steps::new(&columns, &structure, &posterior, &conditions),
            unit: -quantity.kind.per_stiffness() * (1.0 - settings.loss).ln(),
            deviation: deviation(&columns, &structure, spans),
            seed: frame.index as u64,
        };
        let per_stiffness = quantity.kind.per_stiffness();
        let (ln_threshold, performance) = calibration.run(frame.per_year(), per_stiffness);
        let mut reference = Self {
            coldest: vec![Vec::new(); columns.temperatures.len()],
            coldest_of_past: Vec::new(),
            frost_free_days: 0,
            winter_from: from_day,
            extremes: vec![Extremes::default(); explanation.count()],
            columns,
            structure,
            past,
            centre,
            conditions,
            guard: Guard::new(structure.freedom, &residuals),
            spread: Spread::new(&residuals, spans >= YEAR_DAYS),
            posterior,
            cumulant,
            quantile,
            coverage,
            from_day,
            to_day,
            ln_threshold,
            performance,
        };
        for day in days {
            reference.remember(day);
        }
        reference.coldest_of_past = reference.coldest.clone();
        Ok(reference)
    }

    /// Returns the deviation u that a step must exceed.
    pub(crate) fn deviation(&self) -> Deviation {
        let days = self.to_day - self.from_day + 1;
        deviation(&self.columns, &self.structure, days)
    }

    /// Returns the standard deviation of a day under known conditions, in ln(value).
    pub(crate) fn scatter(&self) -> f64 {
        self.columns.scatter(&self.structure, self.posterior.sigma)
    }

    /// Returns the row of the next day.
    pub(crate) fn next_row(&mut self, day: &Day) -> Row {
        self.columns
            .row(day, &mut self.past, &self.structure, self.centre)
    }

    /// Returns r0 of each amplitude, log10 of its unit.
    pub(crate) fn hinges(&self) -> impl Iterator<Item = f64> {
        let candidates = self.columns.hinges.iter();
        candidates.map(move |candidates| candidates[self.structure.hinge])
    }

    /// Returns T0 (°C).
    pub(crate) fn knot_celsius(&self) -> f64 {
        KNOTS[self.structure.knot]
    }

    /// Returns `true` if fewer than five learnt days were as cold as this one.
    pub(crate) fn is_new_frost(&self, day: &Day) -> bool {
        self.exceeds(day, &self.coldest)
    }

    /// Returns `true` if fewer than five days were as cold as this one, in the commissioning and the
    /// winters that are over.
    ///
    /// The present winter does not count. Ice grows as long as a frost lasts, so that a later day
    /// can have more of it without being colder.
    pub(crate) fn lacks_frost(&self, day: &Day) -> bool {
        self.exceeds(day, &self.coldest_of_past)
    }

    /// Returns `true` if it is a day of frost and fewer than five of the `coldest` were as cold.
    fn exceeds(&self, day: &Day, coldest: &[Vec<f64>]) -> bool {
        let frost = day.frost(self.structure.knot);
        frost.zip(coldest).any(|(depth, coldest)| {
            depth < -FROST_DEPTH
                && coldest
                    .get(FROST_DAYS - 1)
                    .is_none_or(|known| depth < *known)
        })
    }

    /// Returns `true` if the commissioning and the winters that are over include five days of frost,
    /// for every temperature.
    pub(crate) fn knows_frost(&self) -> bool {
        let is_frost = |depth: &f64| *depth < -FROST_DEPTH;
        let enough =
            |coldest: &Vec<f64>| coldest.iter().filter(|d| is_frost(d)).count() >= FROST_DAYS;
        self.coldest_of_past.iter().all(enough)
    }

    /// Returns `true` if fewer than five learnt days had a condition like that of this day.
    pub(crate) fn is_beyond(&self, day: &Day) -> bool {
        let mut values = day.conditions.iter().zip(&self.extremes);
        values.any(|(value, known)| known.is_beyond(*value))
    }

    /// Counts a learnt day among the coldest and among the extremes.
    pub(crate) fn remember(&mut self, day: &Day) {
        let depths: Vec<f64> = day.frost(self.structure.knot).collect();
        // Where no summer is long enough, a winter is over after a year.
        let is_over =
            self.frost_free_days >= SEASON_DAYS || day.number - self.winter_from >= YEAR_DAYS;
        if is_over {
            self.coldest_of_past.clone_from(&self.coldest);
        }
        if depths.iter().any(|depth| *depth < -FROST_DEPTH) {
            self.frost_free_days = 0;
            if is_over {
                self.winter_from = day.number;
            }
        } else {
            self.frost_free_days += 1;
        }
        for (coldest, depth) in self.coldest.iter_mut().zip(depths) {
            let place = coldest.partition_point(|known| *known <= depth);
            coldest.insert(place, depth);
            coldest.truncate(FROST_DAYS);
        }
        for (known, value) in self.extremes.iter_mut().zip(&day.conditions) {
            known.remember(*value);
        }
    }
}

/// Smallest number of days with data.
const SMALLEST_DAYS: usize = 10;

fn span(days: &[Day]) -> (i64, i64) {
    let first = days.first().map_or(0, |day| day.number);
    (first, days.last().map_or(first - 1, |day| day.number))
}

/// Returns residuals without their mean: those of a sound structure have none.
fn centred(residuals: &[f64]) -> Vec<f64> {
    let mean = residuals.iter().sum::<f64>() / residuals.len().max(1) as f64;
    residuals.iter().map(|z| z - mean).collect()
}

/// Guarded learning limits residuals at these numbers of standard deviations: a loss is learnt
/// slowly.
const LEARNT_LOSS: f64 = -1.0;
const LEARNT_GAIN: f64 = 3.0;

/// Limits what is learnt from a residual.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Guard {
    /// Mean of the limited residuals of a sound structure, which would be learnt as a gain.
    mean: f64,
}

impl Guard {
    /// The residuals are mirrored, because their sign carries no information.
    fn new(freedom: f64, residuals: &[f64]) -> Self {
        let (mut sum, mut weights) = (0.0, f64::MIN_POSITIVE);
        for z in residuals.iter().flat_map(|z| [*z, -z]) {
            sum += weight(freedom, z) * z.clamp(LEARNT_LOSS, LEARNT_GAIN);
            weights += weight(freedom, z);
        }
        Self {
            mean: sum / weights,
        }
    }

    /// Returns the residual to learn. Its weighted mean is zero while the structure is sound.
    pub(crate) fn limit(self, z: f64) -> f64 {
        z.clamp(LEARNT_LOSS, LEARNT_GAIN) - self.mean
    }
}

/// Returns the share of the days of the commissioning within the 95 % interval that the conditions
/// and the days before the last origin give, or 1 if there are no such days.
///
/// The deviation of the last days before an origin does not count: an interval that follows every
/// deviation would hide a missing condition. Days outside the experience of the origin do not
/// count, because they would not be judged.
fn coverage(series: Series<'_>, sigma: f64) -> f64 {
    let Series {
        columns,
        structure,
        days,
        rows,
    } = series;
    let first = FIRST_DAY.max(days.len() / 3);
    let quantile = interval_quantile(structure.freedom);
    let (mut inside, mut all) = (0_u32, 0_u32);
    series.learn(sigma, |origin, known| {
        if origin < first || !(origin - first).is_multiple_of(ORIGIN_DISTANCE) {
            return;
        }
        let knows_frost = has_frost(&days[..origin], structure.knot);
        for (day, row) in days.iter().zip(rows).skip(origin).take(ORIGIN_DISTANCE) {
            let mut frost = day.frost(structure.knot);
            let is_frost = frost.any(|depth| depth < -FROST_DEPTH);
            let expected = Expected::new(columns, structure, known, row);
            if expected.is_unknown || (is_frost && !knows_frost) {
                continue;
            }
            let x = columns.lasting(&row.x);
            let std = sigma * (expected.scatter + known.leverage(&x)).sqrt();
            all += 1;
            inside += u32::from((row.y - known.expected(&x)).abs() <= quantile * std);
        }
    });
    match all {
        0 => 1.0,
        _ => f64::from(inside) / f64::from(all),
    }
}

/// Length of a commissioning that contains all seasons (days).
pub(crate) const YEAR_DAYS: i64 = 330;

/// Smallest standard deviation of u in ln(frequency) that a step must exceed, after a commissioning
/// that does not contain all seasons. Other seasons can bring larger deviations.
const DEVIATION_OF_OTHER_SEASONS: f64 = DEVIATIONS[1];

/// Returns the deviation u that a step must exceed, after a commissioning of a number of days.
fn deviation(columns: &Columns, structure: &Structure, days: i64) -> Deviation {
    let least = match days < YEAR_DAYS {
        true => DEVIATION_OF_OTHER_SEASONS,
        false => 0.0,
    };
    columns.deviation(structure, least)
}

/// Returns half of the 95 % interval of a day, in units of its scatter.
///
/// It is the quantile that holds 95 % of the days if they contain all seasons. Otherwise it is that
/// of the model. The judged days adapt it.
///
/// The quantile of n days is exceeded by more than its share of further days, by a factor of 1 +
/// 1/n for independent days. Successive errors are correlated by ρ, and their squares by ρ². The
/// days count as n (1 − ρ²)/(1 + ρ²) independent ones.
///
/// Source: the split conformal interval of Lei et al. (2018), Journal of the American Statistical
/// Association 113, 1094–1111.
fn quantile(series: Series<'_>, sigma: f64) -> f64 {
    let Series {
        columns,
        structure,
        days,
        rows,
    } = series;
    let of_model = interval_quantile(structure.freedom);
    let (from, to) = span(days);
    if to - from + 1 < YEAR_DAYS {
        return of_model;
    }
    let mut errors = Vec::with_capacity(days.len());
    series.learn(sigma, |index, known| {
        if index >= FIRST_DAY {
            let expected = Expected::new(columns, structure, known, &rows[index]);
            errors.push((rows[index].y - expected.value).abs() / expected.scatter_std);
        }
    });
    errors.sort_by(f64::total_cmp);
    let n = errors.len() as f64;
    let of_squares = columns.correlation(structure, sigma).powi(2);
    let independent = n * (1.0 - of_squares) / (1.0 + of_squares);
    let place = (INTERVAL * (1.0 + 1.0 / independent) * n).ceil() as usize;
    let found = errors.get(place.saturating_sub(1)).or(errors.last());
    found.copied().unwrap_or(of_model)
}

fn has_frost(days: &[Day], knot: usize) -> bool {
    let frosty = |day: &&Day| day.frost(knot).any(|depth| depth < -FROST_DEPTH);
    days.iter().filter(frosty).count() >= FROST_DAYS
}

/// Prediction of a day from its conditions and the days before it.
pub(crate) struct Expected {
    /// ln(value), relative to the mean of the commissioning.
    pub(crate) value: f64,
    /// Standard deviation of a day around it.
    pub(crate) std: f64,
    /// The same if the deviation of the days before were not known. The interval has this width,
    /// because a new season can bring larger deviations.
    pub(crate) scatter_std: f64,
    /// Variance of a day under known conditions, with the deviation, relative to σ².
    scatter: f64,
    /// The uncertainty of the effect of the conditions exceeds the scatter of a day.
    pub(crate) is_unknown: bool,
}

impl Expected {
    pub(crate) fn new(
        columns: &Columns,
        structure: &Structure,
        known: &Posterior,
        row: &Row,
    ) -> Self {
        let variance = columns.variance(row, structure, known.sigma);
        let forgetful = columns.forgetful(structure);
        let stationary = forgetful
            .map(|forgetful| row.x[forgetful.column].powi(2) * forgetful.variance(known.sigma));
        let scatter = variance + stationary.sum::<f64>();
        let ignorance = known.leverage(&columns.lasting(&row.x));
        Self {
            value: known.expected(&row.x),
            scatter_std: known.sigma * (scatter + ignorance).sqrt(),
            std: known.sigma * (variance + known.leverage(&row.x)).sqrt(),
            scatter,
            is_unknown: ignorance > scatter,
        }
    }
}
