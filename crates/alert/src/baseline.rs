//! Reference values of the parameters of an undamaged structure, learnt from several records, and
//! their file.
//!
//! Notation: n records; m_i, v_i mean and variance of the parameter from record i
//! ([`SpanSummary`]).
//!
//! The reference predicts the estimate from a further sound record. Temperature and the strength of
//! the shaking change a structure between records, and these changes must not look like damage. The
//! one-way random model (S. R. Searle, G. Casella, C. E. McCulloch, *Variance Components*, 1992,
//! chapter 3) assumes that m_i is normal about the mean of the structure. Its variance is v_i plus
//! the variance σ_b² between records:
//!
//! m̄ = Σ m_i/n,  b² = Σ (m_i − m̄)²/(n − 1),  v̄ = Σ v_i/n
//!
//! b² has the expectation σ_b² + v̄ and n − 1 degrees of freedom. The difference between a further
//! record and m̄ has two parts. The first is a Student variable with the scale b·√(1 + 1/n), and
//! the second is the uncertainty of that record. The further record counts v̄ again, although b²
//! already includes it. This errs on the safe side.
//!
//! The parameters of a sound structure rarely scatter by more than a quarter between records. With
//! few degrees of freedom, this limits the tail of the Student variable (`scatter`).
//!
//! A single record contains no information about σ_b, but the owner can state it. A further record
//! then differs from m̄ by a normal variable with the variance σ_b²·(1 + 1/n) + v̄/n.

use serde::{Deserialize, Serialize};
use spandrel_bus::CredibleInterval;
use spandrel_faults::SensorReference;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::reference::largest_usual_scatter;
use crate::scatter::NormalPlusStudent;
use crate::{AlertError, Learning, ParameterEstimate, Reference, Scatter, SpanSummary};

mod file;

/// Reference values of the parameters of one structure, learnt from records of the undamaged
/// structure.
///
/// A baseline also contains the reference behaviour of the sensors in these records, and the effect
/// of leaving out a channel. It replaces the learnt references of the alert rules for the
/// parameters that it contains.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    structure: String,
    records: usize,
    parameters: Vec<ParameterBaseline>,
    sensors: Vec<SensorReference>,
    without_sensor: Vec<WithoutSensor>,
    is_old_file: bool,
}

/// Effect of leaving out one channel on the parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WithoutSensor {
    /// Name of the channel.
    pub channel: String,
    /// Root mean square of the change of each parameter over the records, as ratios to nominal, in
    /// the order of the parameters of the baseline.
    pub changes: Vec<f64>,
}

/// Reference value of one parameter of the undamaged structure, as ratios to nominal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterBaseline {
    /// Name of the parameter.
    pub parameter: String,
    /// Mean of the estimates of all records, as a ratio to nominal.
    pub mean: f64,
    /// Root mean square of the standard deviations within the records, as a ratio to nominal.
    pub within_std: f64,
    /// Standard deviation between records, as a ratio to nominal. `None` if there is a single
    /// record and no stated value.
    pub between_std: Option<f64>,
    /// Degrees of freedom of the estimate `between_std`. `None` if it was stated or is unknown.
    pub degrees_of_freedom: Option<f64>,
}

/// Prior knowledge of the scatter between records.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BetweenRecords {
    /// None: the scatter is estimated from the records.
    Estimated,
    /// The stated standard deviation, as a ratio to nominal.
    Stated(f64),
}

/// Summary of one record, with one entry per parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordSummary {
    parameters: Vec<SpanSummary>,
}

impl RecordSummary {
    /// Summarises a record. Each frame contains mean and standard deviation of each parameter, as
    /// ratios to nominal.
    ///
    /// Returns `None` if there are no frames, or if their numbers of parameters differ.
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

    /// Returns the summary of these parameters, by their indices in this summary. Other indices are
    /// skipped.
    #[must_use]
    pub fn of_parameters(&self, indices: &[usize]) -> Self {
        let found = indices
            .iter()
            .filter_map(|index| self.parameters.get(*index));
        Self {
            parameters: found.copied().collect(),
        }
    }
}

impl Baseline {
    /// Combines several records into the baseline of `structure`. `parameters` contains the names
    /// of the parameters of each record, in their order.
    ///
    /// # Errors
    /// Returns an error if there are no records, or if a record has a different number of
    /// parameters. Also fails if a parameter is too uncertain within its records, or if the records
    /// differ by more than a stated scatter permits.
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
            sensors: Vec::new(),
            without_sensor: Vec::new(),
            is_old_file: false,
        };
        baseline.check()?;
        Ok(baseline)
    }

    /// Adds the references of the sensors, as measured in the records.
    #[must_use]
    pub fn with_sensors(mut self, sensors: Vec<SensorReference>) -> Self {
        self.sensors = sensors;
        self
    }

    /// Adds the records without the channel `channel`, in the order of the records of the baseline.
    /// A record without a summary is left out.
    #[must_use]
    pub fn with_left_out(
        mut self,
        channel: &str,
        records: &[RecordSummary],
        without: &[Option<RecordSummary>],
    ) -> Self {
        let change = |index: usize| {
            let pairs = records.iter().zip(without);
            let changes: Vec<f64> = pairs
                .filter_map(|(with, without)| {
                    let without = without.as_ref()?.parameters.get(index)?;
                    Some(without.mean - with.parameters.get(index)?.mean)
                })
                .collect();
            // One more record scatters about the mean as much as these. Without a record, the
            // change is unknown.
            let count = changes.len() as f64;
            let squares: f64 = changes.iter().map(|change| change * change).sum();
            (count > 0.0).then(|| (squares / count * (1.0 + 1.0 / count)).sqrt())
        };
        let changes: Option<Vec<f64>> = (0..self.parameters.len()).map(change).collect();
        let without = changes.map(|changes| WithoutSensor {
            channel: channel.to_owned(),
            changes,
        });
        self.without_sensor.extend(without);
        self
    }

    /// Returns the reference behaviour of the sensors in the records: gain, delay and spectral
    /// profile relative to the other channels. Each reference states the name of its channel.
    pub fn sensors(&self) -> &[SensorReference] {
        &self.sensors
    }

    /// Returns the usual change of a parameter if a channel is left out (ratio to nominal). `None`
    /// if it is unknown.
    pub fn change_without(&self, channel: &str, parameter: &str) -> Option<f64> {
        let mut all = self.without_sensor.iter();
        let found = all.find(|without| without.channel == channel)?;
        let index = self.parameters().position(|name| name == parameter)?;
        found.changes.get(index).copied()
    }

    /// Returns the name of the structure.
    pub fn structure(&self) -> &str {
        &self.structure
    }

    /// Returns the number of records in the baseline.
    pub fn records(&self) -> usize {
        self.records
    }

    /// Returns `true` if the file has version 1.
    ///
    /// That version does not store the degrees of freedom of each scatter. The scatter then counts
    /// as estimated, with one degree of freedom less than records.
    pub fn is_old_file(&self) -> bool {
        self.is_old_file
    }

    /// Returns the reference value of a parameter of the undamaged structure, for any further
    /// record.
    ///
    /// Returns `None` if the parameter is not in the baseline, or if there are too few records.
    /// [`Baseline::claim`] distinguishes the two cases.
    pub fn reference(&self, parameter: &str) -> Option<Reference> {
        self.claim(parameter)?.ok()
    }

    /// Returns the reference value of a parameter of the undamaged structure, for any further
    /// record, or the reason why the records do not support one.
    ///
    /// Returns `None` if the parameter is not in the baseline.
    ///
    /// # Errors
    /// The inner result is [`AlertError::OneRecord`] without a scatter between records, or
    /// [`AlertError::FewRecords`] if the scatter is too large for so few records.
    pub fn claim(&self, parameter: &str) -> Option<Result<Reference, AlertError>> {
        Some(self.parameter(parameter)?.reference(self.records))
    }

    /// Returns the interval of a parameter over further records of the structure.
    ///
    /// The interval combines an estimate within one record with the scatter between records.
    /// Returns `None` if the parameter is not in the baseline, or if its scatter is unknown.
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

    /// Returns the entry of a parameter, or `None` if it is not in the baseline.
    pub fn parameter(&self, parameter: &str) -> Option<&ParameterBaseline> {
        self.parameters
            .iter()
            .find(|entry| entry.parameter == parameter)
    }

    /// Returns the names of the parameters in the baseline.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.parameters.iter().map(|entry| entry.parameter.as_str())
    }

    /// Checks that the uncertainty of each parameter within its records is small enough. Too few
    /// records are not an error.
    fn check(&self) -> Result<(), AlertError> {
        for entry in &self.parameters {
            Reference::new(entry.mean, entry.within_std)
                .map_err(|error| of_parameter(&entry.parameter, error))?;
        }
        if let Some(sensor) = self.sensors.iter().find(|sensor| !sensor.is_valid()) {
            return Err(AlertError::SensorReference {
                channel: sensor.channel.clone(),
            });
        }
        for without in &self.without_sensor {
            let is_valid = |change: &f64| change.is_finite() && *change >= 0.0;
            if without.changes.len() != self.parameters.len()
                || !without.changes.iter().all(is_valid)
            {
                return Err(AlertError::WithoutSensor {
                    channel: without.channel.clone(),
                    expected: self.parameters.len(),
                });
            }
        }
        Ok(())
    }
}

impl ParameterBaseline {
    /// Returns the reference for a further record, from this number of records.
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

/// Level of the parameter intervals.
const LEVEL: f64 = 0.95;

/// Combines the spans of one parameter by the equations in the module documentation. There must be
/// at least one span.
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

/// Checks that the records do not contradict a stated scatter.
///
/// (n − 1)·b²/(σ_b² + v̄) has a χ² distribution with n − 1 degrees of freedom.
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

/// Returns the 0.999 quantile of χ²/ν. It is infinite without degrees of freedom.
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
