//! The sound values of the parameters of a structure, learnt from several records, and their file.
//!
//! Notation: n records; m_i, v_i mean and variance of the parameter from record i ([`SpanSummary`]).
//!
//! The reference is what a further sound record would show: between records a structure differs by temperature and by the
//! strength of the shaking, and that must not look like damage. With the one-way random model
//! (S. R. Searle, G. Casella, C. E. McCulloch, *Variance Components*, 1992, chapter 3):
//!
//! m̄ = Σ m_i/n,  b² = Σ (m_i − m̄)²/(n − 1),  s_r² = Σ v_i/n + b²·(1 + 1/n)
//!
//! b² holds the errors of the m_i too, which v_i counts again: with few records that is the safe side.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{AlertError, Learning, Reference, SpanSummary};

/// Type and version in the file.
const FORMAT: &str = "spandrel.baseline.v1";

/// The sound values of the parameters of one structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    format: String,
    structure: String,
    records: usize,
    parameters: Vec<ParameterBaseline>,
}

/// The sound value of one parameter, ratios to nominal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ParameterBaseline {
    parameter: String,
    mean: f64,
    /// Of what a further record would show.
    std: f64,
    /// Part of it that the filter does not know within a record.
    within_std: f64,
    /// Part of it from record to record (before the factor 1 + 1/n).
    between_std: f64,
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
        let parameters = learnings.iter().map(Learning::summary).collect::<Option<_>>()?;
        Some(Self { parameters })
    }
}

impl Baseline {
    /// Joins what several records have taught about the `parameters` (names in state order) of `structure`.
    ///
    /// # Errors
    /// There is no record, a record has another number of parameters, or a parameter is too uncertain to be a reference.
    pub fn from_records(structure: &str, parameters: &[&str], records: &[RecordSummary]) -> Result<Self, AlertError> {
        if records.is_empty() {
            return Err(AlertError::NoRecords);
        }
        if let Some(other) = records.iter().find(|record| record.parameters.len() != parameters.len()) {
            return Err(AlertError::ParameterCount { found: other.parameters.len(), expected: parameters.len() });
        }
        let joined = parameters.iter().enumerate().map(|(index, name)| {
            let spans: Vec<SpanSummary> = records.iter().map(|record| record.parameters[index]).collect();
            join_spans(name, &spans)
        });
        let baseline = Self {
            format: FORMAT.to_owned(),
            structure: structure.to_owned(),
            records: records.len(),
            parameters: joined.collect(),
        };
        baseline.check()?;
        Ok(baseline)
    }

    /// Reads a baseline file.
    ///
    /// # Errors
    /// The file cannot be read, is no baseline of this version, or holds a value that cannot be a reference.
    pub fn read(path: &Path) -> Result<Self, AlertError> {
        let text =
            std::fs::read_to_string(path).map_err(|source| AlertError::File { path: path.to_owned(), source })?;
        let baseline: Self = serde_json::from_str(&text)
            .map_err(|source| AlertError::BaselineSyntax { path: path.to_owned(), source })?;
        if baseline.format != FORMAT {
            return Err(AlertError::BaselineFormat { path: path.to_owned(), found: baseline.format, expected: FORMAT });
        }
        baseline.check()?;
        Ok(baseline)
    }

    /// Writes the baseline file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), AlertError> {
        let text = serde_json::to_string_pretty(self)
            .map_err(|source| AlertError::BaselineSyntax { path: path.to_owned(), source })?;
        std::fs::write(path, text + "\n").map_err(|source| AlertError::File { path: path.to_owned(), source })
    }

    /// Name of the structure.
    pub fn structure(&self) -> &str {
        &self.structure
    }

    /// The sound value of a parameter; `None` if the baseline does not know it.
    pub fn reference(&self, parameter: &str) -> Option<Reference> {
        let found = self.parameters.iter().find(|entry| entry.parameter == parameter)?;
        Reference::new(found.mean, found.std).ok()
    }

    /// Names of the parameters that the baseline knows.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.parameters.iter().map(|entry| entry.parameter.as_str())
    }

    fn check(&self) -> Result<(), AlertError> {
        for entry in &self.parameters {
            Reference::new(entry.mean, entry.std).map_err(|error| AlertError::Parameter {
                parameter: entry.parameter.clone(),
                source: Box::new(error),
            })?;
        }
        Ok(())
    }
}

/// Joins the spans of one parameter, at least one, by the equations at the head of this file.
fn join_spans(parameter: &str, spans: &[SpanSummary]) -> ParameterBaseline {
    let n = spans.len() as f64;
    let mean = spans.iter().map(|span| span.mean).sum::<f64>() / n; //                   m̄
    let within = spans.iter().map(SpanSummary::variance).sum::<f64>() / n; //            Σ v_i/n
    let squares: f64 = spans.iter().map(|span| (span.mean - mean).powi(2)).sum();
    let between = if spans.len() > 1 { squares / (n - 1.0) } else { 0.0 }; //            b²
    ParameterBaseline {
        parameter: parameter.to_owned(),
        mean,
        std: (within + between * (1.0 + 1.0 / n)).sqrt(), //                             s_r
        within_std: within.sqrt(),
        between_std: between.sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(mean: f64, std: f64) -> RecordSummary {
        RecordSummary::from_estimates(vec![[(mean, std)]; 50]).unwrap()
    }

    #[test]
    fn spread_between_records_widens_the_reference() {
        // m = 0.9, 1.0, 1.1: b² = 0.01; v = 0.0004: s_r² = 0.0004 + 0.01·4/3.
        let records = [record(0.9, 0.02), record(1.0, 0.02), record(1.1, 0.02)];
        let reference =
            Baseline::from_records("tower", &["storey-1"], &records).unwrap().reference("storey-1").unwrap();
        assert!((reference.mean() - 1.0).abs() < 1e-12);
        assert!((reference.std().powi(2) - 0.013_733_333_333).abs() < 1e-9, "{}", reference.std());
    }

    #[test]
    fn one_record_keeps_its_own_uncertainty() {
        let baseline = Baseline::from_records("tower", &["storey-1"], &[record(0.9, 0.02)]).unwrap();
        let reference = baseline.reference("storey-1").unwrap();
        assert!((reference.std() - 0.02).abs() < 1e-12);
    }

    #[test]
    fn file_reads_back_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("baseline.json");
        let records = [record(0.9, 0.02), record(0.95, 0.03)];
        let written = Baseline::from_records("tower", &["storey-1"], &records).unwrap();
        written.write(&path).unwrap();
        let read = Baseline::read(&path).unwrap();
        assert_eq!(read.structure(), "tower");
        let (a, b) = (read.reference("storey-1").unwrap(), written.reference("storey-1").unwrap());
        assert!((a.mean() - b.mean()).abs() < 1e-15 && (a.std() - b.std()).abs() < 1e-15);
    }

    #[test]
    fn file_of_another_version_is_refused_with_both_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("baseline.json");
        std::fs::write(&path, r#"{"format":"spandrel.baseline.v9","structure":"a","records":1,"parameters":[]}"#)
            .unwrap();
        let message = Baseline::read(&path).unwrap_err().to_string();
        assert!(message.contains("spandrel.baseline.v9") && message.contains("spandrel.baseline.v1"), "{message}");
    }

    #[test]
    fn parameter_too_uncertain_to_be_a_reference_is_named() {
        let error = Baseline::from_records("tower", &["storey-1"], &[record(0.9, 0.5)]).unwrap_err();
        assert!(error.to_string().contains("storey-1"), "{error}");
    }

    #[test]
    fn frames_of_unequal_length_are_no_record() {
        assert!(RecordSummary::from_estimates([vec![(1.0, 0.1)], vec![]]).is_none());
        assert!(RecordSummary::from_estimates([vec![(1.0, 0.1)], vec![(1.0, 0.1); 2]]).is_none());
        assert!(RecordSummary::from_estimates(Vec::<Vec<(f64, f64)>>::new()).is_none());
    }
}
