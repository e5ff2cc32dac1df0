//! The sound values of the parameters of a structure, learnt from several records, and their file.
//!
//! Notation: n records; m_i, v_i mean and variance of the parameter from record i ([`SpanSummary`]).
//!
//! The reference is what a further sound record would show: between records a structure differs by temperature and by the
//! strength of the shaking, and that must not look like damage. With the one-way random model
//! (S. R. Searle, G. Casella, C. E. McCulloch, *Variance Components*, 1992, chapter 3) m_i is normal about the mean of the
//! structure, with the variance σ_b² between records plus v_i:
//!
//! m̄ = Σ m_i/n,  b² = Σ (m_i − m̄)²/(n − 1),  v̄ = Σ v_i/n
//!
//! b² has the expectation σ_b² + v̄ and n − 1 degrees of freedom. A further record differs from m̄ by a Student variable with the
//! scale b·√(1 + 1/n), and by its own uncertainty. b² holds v̄, which the further record counts again: that is the safe side.
//!
//! A sound structure rarely scatters by more than a quarter between records. With few degrees of freedom that bounds the tail of
//! the Student variable (`scatter`).
//!
//! One record knows nothing of σ_b. The owner may state it: then a further record differs from m̄ by a normal variable with
//! the variance σ_b²·(1 + 1/n) + v̄/n.

use serde::{Deserialize, Serialize};
use spandrel_bus::CredibleInterval;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::reference::largest_usual_scatter;
use crate::scatter::NormalPlusStudent;
use crate::{AlertError, Learning, ParameterEstimate, Reference, Scatter, SpanSummary};

mod file;

/// The sound values of the parameters of one structure.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    structure: String,
    records: usize,
    parameters: Vec<ParameterBaseline>,
    is_old_file: bool,
}

/// The sound value of one parameter, ratios to nominal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterBaseline {
    /// Name of the parameter.
    pub parameter: String,
    /// Mean of the records.
    pub mean: f64,
    /// What a record leaves open on average: standard deviation.
    pub within_std: f64,
    /// Standard deviation from record to record; `None` if one record is all there is, and nothing was stated.
    pub between_std: Option<f64>,
    /// How many deviations `between_std` was estimated from; `None` if it was stated, or is unknown.
    pub degrees_of_freedom: Option<f64>,
}

/// What is known of the scatter between records beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BetweenRecords {
    /// Nothing: the records must show it.
    Estimated,
    /// Its standard deviation, ratio to nominal.
    Stated(f64),
}

/// What one record has taught, an entry per parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordSummary {
    parameters: Vec<SpanSummary>,
}

impl RecordSummary {
    /// Summarises the estimates of a record: per frame mean and standard deviation of each parameter, ratios to nominal.
    ///
    /// `None` if there is no frame, or if a frame has another number of parameters than the first.
    pub fn from_estimates<I>(frames: I) -> Option<Self>
    where
        I: IntoIterator,
        I::Item: IntoIterator<Item = (f64, f64)>,
    {
        let mut frames = frames.into_iter();
        let mut learnings: Vec<Learning> = frames
            .next()?
            .into_iter()
            .map(|(mean, std)| {
                let mut learning = Learning::new();
                learning.add(mean, std);
                learning
            })
            .collect();
        for frame in frames {
            let mut count = 0;
            for (mean, std) in frame {
                learnings.get_mut(count)?.add(mean, std);
                count += 1;
            }
            if count != learnings.len() {
                return None;
            }
        }
        let parameters = learnings
            .iter()
            .map(Learning::summary)
            .collect::<Option<_>>()?;
        Some(Self { parameters })
    }
}

impl Baseline {
    /// Joins what several records have taught about the `parameters` (names in state order) of `structure`.
    ///
    /// # Errors
    /// There is no record, a record has another number of parameters, a parameter is too uncertain within its records, or the
    /// records differ by more than a stated scatter allows.
    pub fn from_records(
        structure: &str,
        parameters: &[&str],
        records: &[RecordSummary],
        between: BetweenRecords,
    ) -> Result<Self, AlertError> {
        if records.is_empty() {
            return Err(AlertError::NoRecords);
        }
        if let Some(other) = records
            .iter()
            .find(|record| record.parameters.len() != parameters.len())
        {
            return Err(AlertError::ParameterCount {
                found: other.parameters.len(),
                expected: parameters.len(),
            });
        }
        let joined = parameters.iter().enumerate().map(|(index, name)| {
            let spans: Vec<SpanSummary> = records
                .iter()
                .map(|record| record.parameters[index])
                .collect();
            join_spans(name, &spans, between).map_err(|error| of_parameter(name, error))
        });
        let parameters = joined.collect::<Result<_, _>>()?;
        let baseline = Self {
            structure: structure.to_owned(),
            records: records.len(),
            parameters,
            is_old_file: false,
        };
        baseline.check()?;
        Ok(baseline)
    }

    /// Name of the structure.
    pub fn structure(&self) -> &str {
        &self.structure
    }

    /// Number of records that it was learnt from.
    pub fn records(&self) -> usize {
        self.records
    }

    /// Returns `true` if the file was written in version 1, which did not state how many records its scatter rests on for each
    /// parameter: it is then taken as estimated from all records but one.
    pub fn is_old_file(&self) -> bool {
        self.is_old_file
    }

    /// The sound value of a parameter in any further record; `None` if the baseline does not know the parameter, or knows
    /// it from too few records ([`Baseline::claim`] says which).
    pub fn reference(&self, parameter: &str) -> Option<Reference> {
        self.claim(parameter)?.ok()
    }

    /// The sound value of a parameter in any further record, or why its records do not support one; `None` if the baseline does
    /// not know the parameter.
    ///
    /// # Errors
    /// Of the inner result: [`AlertError::OneRecord`] without any scatter between records, [`AlertError::FewRecords`] where it
    /// is too large for so few records.
    pub fn claim(&self, parameter: &str) -> Option<Result<Reference, AlertError>> {
        Some(self.parameter(parameter)?.reference(self.records))
    }

    /// Interval of a parameter for this structure: what other records of the same structure would show, from an estimate
    /// within one record and the scatter between records. `None` if the baseline does not know the parameter, or knows no scatter.
    pub fn for_structure(
        &self,
        parameter: &str,
        estimate: &ParameterEstimate,
    ) -> Option<CredibleInterval> {
        let found = self.parameter(parameter)?;
        let (normal_std, student_scale, degrees_of_freedom) =
            match (found.between_std?, found.degrees_of_freedom) {
                (between, Some(degrees_of_freedom)) => (estimate.std, between, degrees_of_freedom),
                (between, None) => (estimate.std.hypot(between), 0.0, 1.0),
            };
        let largest_usual = largest_usual_scatter(found.mean);
        let sum = NormalPlusStudent {
            normal_std,
            student_scale,
            degrees_of_freedom,
            largest_usual,
        };
        let half = sum.quantile(0.5 + LEVEL / 2.0);
        Some(CredibleInterval {
            level: LEVEL,
            low: estimate.mean - half,
            high: estimate.mean + half,
        })
    }

    /// What the baseline holds of a parameter; `None` if it does not know it.
    pub fn parameter(&self, parameter: &str) -> Option<&ParameterBaseline> {
        self.parameters
            .iter()
            .find(|entry| entry.parameter == parameter)
    }

    /// Names of the parameters that the baseline knows.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.parameters.iter().map(|entry| entry.parameter.as_str())
    }

    /// Checks that each parameter is known well enough within its records. Too few records are no mistake.
    fn check(&self) -> Result<(), AlertError> {
        for entry in &self.parameters {
            Reference::new(entry.mean, entry.within_std)
                .map_err(|error| of_parameter(&entry.parameter, error))?;
        }
        Ok(())
    }
}

impl ParameterBaseline {
    /// What a further record would show, from so many records.
    fn reference(&self, records: usize) -> Result<Reference, AlertError> {
        let n = records as f64;
        let further = (1.0 + 1.0 / n).sqrt();
        match (self.between_std, self.degrees_of_freedom) {
            (None, _) => Err(AlertError::OneRecord),
            (Some(between), None) => Reference::new(
                self.mean,
                (between * further).hypot(self.within_std / n.sqrt()),
            ),
            (Some(between), Some(degrees_of_freedom)) => {
                let scatter = Scatter {
                    std: between * further,
                    degrees_of_freedom,
                };
                Reference::new(self.mean, 0.0)?.with_scatter(scatter)
            }
        }
    }
}

/// Level of the intervals of a parameter.
const LEVEL: f64 = 0.95;

/// Joins the spans of one parameter, at least one, by the equations at the head of this file.
fn join_spans(
    parameter: &str,
    spans: &[SpanSummary],
    between: BetweenRecords,
) -> Result<ParameterBaseline, AlertError> {
    let n = spans.len() as f64;
    let mean = spans.iter().map(|span| span.mean).sum::<f64>() / n; //                   m̄
    let within = spans.iter().map(SpanSummary::variance).sum::<f64>() / n; //            v̄
    let squares: f64 = spans.iter().map(|span| (span.mean - mean).powi(2)).sum();
    let found = (spans.len() > 1).then(|| squares / (n - 1.0)); //                       b²
    let (between_std, degrees_of_freedom) = match (between, found) {
        (BetweenRecords::Stated(stated), found) => {
            check_stated(stated, within, found, n - 1.0)?;
            (Some(stated), None)
        }
        (BetweenRecords::Estimated, Some(found)) => (Some(found.sqrt()), Some(n - 1.0)),
        (BetweenRecords::Estimated, None) => (None, None),
    };
    let parameter = parameter.to_owned();
    Ok(ParameterBaseline {
        parameter,
        mean,
        within_std: within.sqrt(),
        between_std,
        degrees_of_freedom,
    })
}

/// Checks that the records do not contradict a stated scatter: (n − 1)·b²/(σ_b² + v̄) has the distribution χ² with n − 1
/// degrees of freedom.
fn check_stated(
    stated: f64,
    within: f64,
    found: Option<f64>,
    degrees_of_freedom: f64,
) -> Result<(), AlertError> {
    if !(stated.is_finite() && stated >= 0.0) {
        return Err(AlertError::Setting {
            setting: "scatter between records",
            found: stated,
            low: 0.0,
            high: f64::MAX,
        });
    }
    let Some(found) = found else { return Ok(()) };
    let allowed = (stated * stated + within) * largest_mean_square(degrees_of_freedom);
    if found <= allowed {
        return Ok(());
    }
    Err(AlertError::StatedScatter {
        found: found.sqrt(),
        stated,
        allowed: allowed.sqrt(),
    })
}

/// The point of χ²/ν that is exceeded with probability 0.001; infinite without degrees of freedom.
fn largest_mean_square(degrees_of_freedom: f64) -> f64 {
    const NOT_EXCEEDED: f64 = 0.999;
    ChiSquared::new(degrees_of_freedom).map_or(f64::INFINITY, |distribution| {
        distribution.inverse_cdf(NOT_EXCEEDED) / degrees_of_freedom
    })
}

fn of_parameter(parameter: &str, source: AlertError) -> AlertError {
    AlertError::Parameter {
        parameter: parameter.to_owned(),
        source: Box::new(source),
    }
}

#[cfg(test)]
mod tests;
