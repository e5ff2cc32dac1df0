//! The file of a baseline: JSON, version 3. Versions 1 and 2 are also readable.

use std::path::Path;

use serde::{Deserialize, Serialize};
use spandrel_bus::read_text_up_to;
use spandrel_faults::SensorReference;
use spandrel_record::write_whole;

use super::{Baseline, ParameterBaseline, WithoutSensor};
use crate::AlertError;

/// Maximum size of a baseline file (bytes). The effects of 1,000 sensors on 1,000 parameters take
/// about 30 MB.
const MOST_BYTES: u64 = 64 << 20;

/// Type and version in the file.
const FORMAT: &str = "spandrel.baseline.v3";

/// Version 2, without sensors.
const FORMAT_2: &str = "spandrel.baseline.v2";

/// Version 1. Its scatter between records counted as known, and as zero for one record.
const FORMAT_1: &str = "spandrel.baseline.v1";

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: String,
    structure: String,
    records: usize,
    parameters: Vec<ParameterBaseline>,
    /// What the sensors have shown in the records.
    #[serde(default)]
    sensors: Vec<SensorReference>,
    /// Effect of leaving out one channel.
    #[serde(default)]
    without_sensor: Vec<WithoutSensor>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File1 {
    #[serde(rename = "format")]
    _format: String,
    structure: String,
    records: usize,
    parameters: Vec<Parameter1>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parameter1 {
    parameter: String,
    mean: f64,
    #[serde(rename = "std")]
    _std: f64,
    within_std: f64,
    between_std: f64,
}

/// The field that all versions have.
#[derive(Debug, Deserialize)]
struct Versioned {
    format: String,
}

impl Baseline {
    /// Reads a baseline file of version 3, 2 or 1.
    ///
    /// The scatter in a file of version 1 counts as estimated from its records. With one record it
    /// is unknown.
    ///
    /// # Errors
    /// Returns an error if the file is unreadable, is not a regular file of at most 64 MiB, is not
    /// a baseline of these versions, or contains an invalid reference.
    pub fn read(path: &Path) -> Result<Self, AlertError> {
        let text = read_text_up_to(path, MOST_BYTES).map_err(|source| AlertError::File {
            path: path.to_owned(),
            source,
        })?;
        let syntax = |source| AlertError::BaselineSyntax {
            path: path.to_owned(),
            source,
        };
        let Versioned { format } = serde_json::from_str(&text).map_err(syntax)?;
        let baseline = match format.as_str() {
            FORMAT | FORMAT_2 => {
                let File {
                    structure,
                    records,
                    parameters,
                    sensors,
                    without_sensor,
                    ..
                } = serde_json::from_str(&text).map_err(syntax)?;
                Self {
                    structure,
                    records,
                    parameters,
                    sensors,
                    without_sensor,
                    is_old_file: false,
                }
            }
            FORMAT_1 => Self::from_version_1(serde_json::from_str(&text).map_err(syntax)?),
            _ => {
                return Err(AlertError::BaselineFormat {
                    path: path.to_owned(),
                    found: format,
                    expected: FORMAT,
                });
            }
        };
        if baseline.records == 0 {
            return Err(AlertError::NoRecords);
        }
        baseline.check()?;
        Ok(baseline)
    }

    fn from_version_1(file: File1) -> Self {
        let records = file.records;
        let parameters = file.parameters.into_iter().map(|old| ParameterBaseline {
            parameter: old.parameter,
            mean: old.mean,
            within_std: old.within_std,
            between_std: (records > 1).then_some(old.between_std),
            degrees_of_freedom: (records > 1).then_some(records as f64 - 1.0),
        });
        Self {
            structure: file.structure,
            records,
            parameters: parameters.collect(),
            sensors: Vec::new(),
            without_sensor: Vec::new(),
            is_old_file: true,
        }
    }

    /// Writes the baseline file in version 3. An existing file is replaced when the new one is
    /// complete.
    ///
    /// # Errors
    /// Returns an error if the file is not writable.
    pub fn write(&self, path: &Path) -> Result<(), AlertError> {
        let file = File {
            format: FORMAT.to_owned(),
            structure: self.structure.clone(),
            records: self.records,
            parameters: self.parameters.clone(),
            sensors: self.sensors.clone(),
            without_sensor: self.without_sensor.clone(),
        };
        let text =
            serde_json::to_string_pretty(&file).map_err(|source| AlertError::BaselineSyntax {
                path: path.to_owned(),
                source,
            })?;
        let written = write_whole(path, (text + "\n").as_bytes());
        written.map_err(|source| AlertError::File {
            path: path.to_owned(),
            source,
        })
    }
}
