//! The file of the configurations of one structure: one JSON object per line.
//!
//! Each line states with which configuration the structure is judged from an epoch on. A check
//! value reveals a damaged line, and the numbers reveal a missing one. If the file becomes too
//! large, the oldest lines are removed.

use crate::epoch_log::{check, set_aside};
use crate::error::JudgingError;
use serde::{Deserialize, Serialize};
use spandrel_bus::Annotation;
use spandrel_checkpoint::{Failures, replace_private_file};
use spandrel_structure::JudgePlan;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use tracing::{info, warn};

/// Name of the file, in the folder of the epochs.
pub(crate) const FILE: &str = "judge-configurations.jsonl";
/// Maximum size of the file (bytes): thousands of configurations. The last one always remains.
const MOST_BYTES: usize = 4 << 20;
/// Beginning and end of the last field of a line.
const CHECK: (&str, &str) = (",\"check\":\"", "\"}");

/// A configuration with which a structure is judged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Configuration {
    /// Version of Spandrel, because another version may compute other numbers.
    pub version: String,
    /// The table `[judge]`, with its defaults.
    pub judge: JudgePlan,
    /// The annotations that start a new reference, in the order of their arrival.
    pub references: Vec<Annotation>,
}

impl Configuration {
    /// Returns the name, which depends on the content alone.
    pub(crate) fn name(&self) -> io::Result<String> {
        Ok(check(&serde_json::to_string(self)?, ""))
    }
}

/// A line in the file of the epochs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Place {
    /// Number of epochs up to the line.
    pub(crate) epochs: u64,
    /// Check value of the line.
    pub(crate) check: String,
}

/// The beginning of a configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Record {
    /// Number of the line since the first one.
    pub(crate) number: u64,
    /// Wall-clock time (ns since 1970-01-01 UTC).
    pub(crate) time_ns: i64,
    /// Name of the configuration.
    pub(crate) name: String,
    /// The last epoch before it.
    pub(crate) since: Place,
    /// Whether the file contains all epochs that are judged.
    pub(crate) is_complete: bool,
    /// Name of the file into which the epochs before were set aside just now.
    pub(crate) aside: Option<String>,
    pub(crate) configuration: Configuration,
}

/// What begins to be in force.
#[derive(Debug)]
pub(crate) struct Begun {
    pub(crate) time_ns: i64,
    pub(crate) since: Place,
    pub(crate) is_complete: bool,
    pub(crate) aside: Option<String>,
    pub(crate) configuration: Configuration,
}

/// Records configurations in a file.
#[derive(Debug)]
pub(crate) struct ConfigurationLog {
    path: PathBuf,
    /// The lines of the file, each with its end.
    lines: Vec<String>,
    last: Option<Record>,
    is_saved: bool,
    failures: Failures,
}

impl ConfigurationLog {
    /// Reads the file in a folder, if it exists. If a line is damaged, the file is set aside, and
    /// the lines before are copied.
    ///
    /// # Errors
    /// The file cannot be read or set aside.
    pub(crate) fn open(folder: &Path) -> Result<Self, JudgingError> {
        let path = folder.join(FILE);
        let text = text(&path)?.unwrap_or_default();
        let (mut records, damaged) = parse(&text);
        if let Some(line) = damaged {
            let aside = set_aside(&path).map_err(|source| JudgingError::Configurations {
                what: "set aside",
                path: path.clone(),
                source,
            })?;
            warn!(
                file = %path.display(), line, aside = %aside.display(),
                "a configuration of the judgement is damaged; only those before it are kept"
            );
        }
        let lines = text.lines().take(records.len());
        Ok(Self {
            lines: lines.map(|line| format!("{line}\n")).collect(),
            last: records.pop(),
            is_saved: damaged.is_none(),
            failures: Failures::default(),
            path,
        })
    }

    /// Records a configuration if it differs from the last one, or if its epochs are in another
    /// file or are not complete any more. Returns its name. If it cannot be written, it waits.
    ///
    /// # Errors
    /// The configuration cannot be encoded.
    pub(crate) fn begin(&mut self, begun: Begun) -> io::Result<String> {
        let Begun {
            time_ns,
            since,
            is_complete,
            aside,
            configuration,
        } = begun;
        let name = configuration.name()?;
        let same = |last: &Record| {
            let is_gap_known = is_complete || last.since == since;
            last.name == name && last.is_complete == is_complete && is_gap_known
        };
        if aside.is_some() || !self.last.as_ref().is_some_and(same) {
            let number = self
                .last
                .as_ref()
                .map_or(1, |last| last.number.saturating_add(1));
            let record = Record {
                number,
                time_ns,
                name: name.clone(),
                since,
                is_complete,
                aside,
                configuration,
            };
            self.lines.push(line(&record)?);
            let configuration = name.as_str();
            info!(
                configuration,
                number, "the judgement has another configuration"
            );
            self.last = Some(record);
            self.is_saved = false;
            self.forget();
        }
        self.flush();
        Ok(name)
    }

    /// Returns the name of the last configuration.
    pub(crate) fn last_name(&self) -> Option<&str> {
        self.last.as_ref().map(|last| last.name.as_str())
    }

    /// Tries to write what waits. The call blocks the thread during the write.
    pub(crate) fn flush(&mut self) {
        if self.is_saved {
            return;
        }
        match replace_private_file(&self.path, self.lines.concat().as_bytes()) {
            Ok(()) => {
                self.is_saved = true;
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "configurations of the judgement are saved again");
                }
            }
            Err(error) if self.failures.failed() => {
                let (file, failures) = (self.path.display(), self.failures.consecutive());
                warn!(%file, %error, failures, "cannot save the configuration of the judgement");
            }
            Err(_) => {}
        }
    }

    /// Returns the count of failed writes.
    pub(crate) fn drops(&self) -> Option<(String, u64)> {
        self.failures.drops()
    }

    /// Removes the oldest lines beyond the maximum size.
    fn forget(&mut self) {
        let mut bytes: usize = self.lines.iter().map(String::len).sum();
        let mut oldest = 0;
        for line in self.lines.iter().take(self.lines.len().saturating_sub(1)) {
            if bytes <= MOST_BYTES {
                break;
            }
            bytes -= line.len();
            oldest += 1;
        }
        self.lines.drain(..oldest);
    }
}

/// Reads the records in a folder, without a change to the file.
///
/// # Errors
/// There is no record, or a line is damaged.
pub(crate) fn read(folder: &Path) -> Result<Vec<Record>, JudgingError> {
    let path = folder.join(FILE);
    match text(&path)?.map(|text| parse(&text)) {
        Some((_, Some(line))) => Err(JudgingError::DamagedConfiguration { path, line }),
        Some((records, None)) if !records.is_empty() => Ok(records),
        _ => Err(JudgingError::NoConfiguration { path }),
    }
}

/// Returns the text of the file, or `None` if there is no file.
fn text(path: &Path) -> Result<Option<String>, JudgingError> {
    match std::fs::read(path) {
        // A byte that is no UTF-8 becomes a damaged line.
        Ok(bytes) => Ok(Some(String::from_utf8_lossy(&bytes).into_owned())),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(source) => Err(JudgingError::Configurations {
            what: "read",
            path: path.to_owned(),
            source,
        }),
    }
}

/// Returns the records up to the first damaged line, and the number of this line.
fn parse(text: &str) -> (Vec<Record>, Option<usize>) {
    let mut records: Vec<Record> = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let expected = records.last().map(|last| last.number.checked_add(1));
        let found = record(line);
        match found.filter(|found| expected.is_none_or(|number| number == Some(found.number))) {
            Some(record) => records.push(record),
            None => return (records, Some(index + 1)),
        }
    }
    (records, None)
}

fn line(record: &Record) -> io::Result<String> {
    let text = serde_json::to_string(record)?;
    let text = text.strip_suffix('}').unwrap_or(&text);
    let (begins, ends) = CHECK;
    Ok(format!("{text}{begins}{}{ends}\n", check(text, "")))
}

/// Returns the record of a sound line.
fn record(line: &str) -> Option<Record> {
    let (begins, ends) = CHECK;
    let (text, found) = line.strip_suffix(ends)?.rsplit_once(begins)?;
    match check(text, "") == found {
        true => serde_json::from_str(line).ok(),
        false => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::plan;

    fn begun(loss: f64) -> Begun {
        let mut judge = plan();
        judge.settings.loss = loss;
        Begun {
            time_ns: 7,
            since: Place {
                epochs: 3,
                check: "abc".to_owned(),
            },
            is_complete: true,
            aside: None,
            configuration: Configuration {
                version: "1".to_owned(),
                judge,
                references: Vec::new(),
            },
        }
    }

    fn losses(folder: &Path) -> Vec<f64> {
        let records = read(folder).unwrap();
        let each = records.iter();
        each.map(|record| record.configuration.judge.settings.loss)
            .collect()
    }

    #[test]
    fn only_a_configuration_that_differs_is_recorded_also_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = ConfigurationLog::open(folder.path()).unwrap();
        let first = log.begin(begun(0.02)).unwrap();
        assert_eq!(log.begin(begun(0.02)).unwrap(), first);
        let mut log = ConfigurationLog::open(folder.path()).unwrap();
        assert_eq!(log.begin(begun(0.02)).unwrap(), first);
        assert_ne!(log.begin(begun(0.1 + 0.2)).unwrap(), first);
        assert_eq!(log.begin(begun(0.02)).unwrap(), first);
        assert_eq!(losses(folder.path()), [0.02, 0.1 + 0.2, 0.02]);
        let records = read(folder.path()).unwrap();
        let numbers: Vec<u64> = records.iter().map(|record| record.number).collect();
        assert_eq!(numbers, [1, 2, 3]);
        assert_eq!(records[0].configuration, begun(0.02).configuration);
    }

    #[test]
    fn other_epochs_are_recorded_with_an_equal_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = ConfigurationLog::open(folder.path()).unwrap();
        log.begin(begun(0.02)).unwrap();
        let aside = Begun {
            aside: Some("judge-epochs.1.csv".to_owned()),
            ..begun(0.02)
        };
        log.begin(aside).unwrap();
        let incomplete = Begun {
            is_complete: false,
            ..begun(0.02)
        };
        log.begin(incomplete).unwrap();
        assert_eq!(losses(folder.path()).len(), 3);
    }

    #[test]
    fn a_damaged_or_missing_line_is_named_and_set_aside_at_the_next_start() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = ConfigurationLog::open(folder.path()).unwrap();
        for loss in [0.01, 0.02, 0.03] {
            log.begin(begun(loss)).unwrap();
        }
        let path = folder.path().join(FILE);
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.split_inclusive('\n').collect();
        let missing = [lines[0], lines[2]].concat();
        let changed = text.replacen("\"loss\":0.02", "\"loss\":0.05", 1);
        assert_ne!(changed, text);
        for damaged in [missing, changed] {
            std::fs::write(&path, &damaged).unwrap();
            let error = read(folder.path()).unwrap_err().to_string();
            assert!(
                error.contains("judge-configurations.jsonl:2: is damaged"),
                "{error}"
            );
            let mut log = ConfigurationLog::open(folder.path()).unwrap();
            log.begin(begun(0.04)).unwrap();
            assert_eq!(losses(folder.path()), [0.01, 0.04]);
        }
        assert!(folder.path().join("judge-configurations.2.jsonl").is_file());
    }

    #[test]
    fn the_oldest_lines_are_removed_from_a_large_file() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = ConfigurationLog::open(folder.path()).unwrap();
        let large = |number: usize| Begun {
            configuration: Configuration {
                version: number.to_string().repeat(MOST_BYTES / 3),
                ..begun(0.02).configuration
            },
            ..begun(0.02)
        };
        for number in 1..=4 {
            log.begin(large(number)).unwrap();
        }
        let records = read(folder.path()).unwrap();
        let numbers: Vec<u64> = records.iter().map(|record| record.number).collect();
        assert_eq!(numbers, [3, 4]);
    }

    #[test]
    fn what_cannot_be_written_waits() {
        let folder = tempfile::tempdir().unwrap();
        let within = folder.path().join("away");
        let mut log = ConfigurationLog::open(&within).unwrap();
        log.begin(begun(0.02)).unwrap();
        assert_eq!(log.drops(), Some(("checkpoints-not-kept".to_owned(), 1)));
        assert!(matches!(
            read(&within),
            Err(JudgingError::NoConfiguration { .. })
        ));
        std::fs::create_dir(&within).unwrap();
        log.flush();
        assert_eq!(losses(&within), [0.02]);
    }
}
