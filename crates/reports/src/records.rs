//! The folder of the recordings and reports of one structure.
//!
//! A recording `T` consists of `T.csv` and `T.record`, which says why it was recorded. Its report
//! is `STRUCTURE_T.html` and `STRUCTURE_T.json`. Every file is written under another name first, so
//! a file with one of these names is complete. The CSV file comes after `T.record`, and the JSON
//! file after the HTML file.

use crate::cutting::{About, Recorded};
use crate::maker::MadeReport;
use crate::name::{report_name, stem};
use spandrel_bus::{Name, is_without_date};
use spandrel_checkpoint::sync_name;
use spandrel_record::{CsvWriter, RecordError};
use std::fs::{DirBuilder, File};
use std::io::{self, Write as _};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};

/// Permissions of the folder. Only the owner has access.
const FOLDER_MODE: u32 = 0o700;
/// Share of the recordings that remain when there are too many. The history of the earlier events
/// is then computed again, so this must be rare.
const REMAINING: f64 = 0.9;

/// Reason why a recording or a report is not kept.
#[derive(Debug, thiserror::Error)]
pub(crate) enum KeepError {
    #[error("{reason}{}", cause(.reason))]
    Record { reason: RecordError },
    #[error("cannot write {}: {reason}", path.display())]
    Write { path: PathBuf, reason: io::Error },
}

// Not a source, because the text contains it.
impl From<RecordError> for KeepError {
    fn from(reason: RecordError) -> Self {
        Self::Record { reason }
    }
}

/// Returns the cause of an error, such as a full disk, as the end of its text.
fn cause(error: &RecordError) -> String {
    let cause = std::error::Error::source(error);
    cause.map_or_else(String::new, |cause| format!(": {cause}"))
}

/// A recording that is kept.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Kept {
    pub(crate) stem: String,
    pub(crate) about: About,
}

/// The folder of one structure.
#[derive(Clone, Debug)]
pub(crate) struct Records {
    folder: PathBuf,
    structure: Name,
    /// Names of the channels, in frame order.
    channels: Vec<String>,
}

impl Records {
    /// Creates the folder if it is missing.
    pub(crate) fn open(
        folder: &Path,
        structure: &Name,
        channels: Vec<String>,
    ) -> Result<Self, io::Error> {
        let mut builder = DirBuilder::new();
        builder.recursive(true).mode(FOLDER_MODE).create(folder)?;
        Ok(Self {
            folder: folder.to_owned(),
            structure: structure.clone(),
            channels,
        })
    }

    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Keeps a recording. A repetition after a crash replaces it.
    pub(crate) fn keep(&self, recorded: &Recorded) -> Result<Kept, KeepError> {
        let part = self.record(&stem(recorded.about.start_ns));
        let part = part.with_extension("csv.part");
        let written = self.write_rows(&part, recorded);
        let kept = written.and_then(|()| self.settle_record(&part, &recorded.about));
        if kept.is_err() {
            // What was written of it must not fill the disk.
            let _ = std::fs::remove_file(&part);
        }
        kept
    }

    /// Gives the written rows of a recording their name.
    fn settle_record(&self, part: &Path, about: &About) -> Result<Kept, KeepError> {
        let stem = self.stem(about.start_ns, part);
        let json = serde_json::to_vec(about).map_err(|error| KeepError::Write {
            path: self.about(&stem),
            reason: error.into(),
        })?;
        self.write(&self.about(&stem), &json)?;
        settle(part, &self.record(&stem))?;
        Ok(Kept {
            stem,
            about: about.clone(),
        })
    }

    /// Returns the name of a recording whose rows are in `part`. Records without dates begin at the
    /// same time, so a recording of another one has a number, as in `1970-01-01T00-00-10Z-2`.
    fn stem(&self, start_ns: i64, part: &Path) -> String {
        let first = stem(start_ns);
        let numbered = (2..).map(|number| format!("{first}-{number}"));
        let is_same = |stem: &String| match (std::fs::read(self.record(stem)), std::fs::read(part))
        {
            (Ok(kept), Ok(new)) => kept == new,
            _ => !self.has(stem),
        };
        let mut all = std::iter::once(first.clone()).chain(numbered);
        match is_without_date(start_ns) {
            true => all.find(is_same).unwrap_or(first),
            false => first,
        }
    }

    /// Returns `true` if a recording of this name is kept.
    pub(crate) fn has(&self, stem: &str) -> bool {
        self.record(stem).exists()
    }

    fn write_rows(&self, part: &Path, recorded: &Recorded) -> Result<(), KeepError> {
        let mut writer = CsvWriter::create(part, &self.channels)?;
        for (time_ns, values) in &recorded.rows {
            writer.write_row(*time_ns, values)?;
        }
        writer.finish()?;
        Ok(())
    }

    /// Keeps the report of a recording.
    pub(crate) fn put(&self, stem: &str, made: &MadeReport) -> Result<(), KeepError> {
        self.write(&self.report(stem, "html"), made.html.as_bytes())?;
        self.write(&self.report(stem, "json"), made.json.as_bytes())
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), KeepError> {
        let part = path.with_extension("part");
        let written = File::create(&part).and_then(|mut file| file.write_all(bytes));
        let written = written.map_err(|reason| KeepError::Write {
            path: part.clone(),
            reason,
        });
        let settled = written.and_then(|()| settle(&part, path));
        if settled.is_err() {
            let _ = std::fs::remove_file(&part);
        }
        settled
    }

    /// Returns all recordings in the order of time.
    pub(crate) fn list(&self) -> io::Result<Vec<Kept>> {
        let mut all = Vec::new();
        for file in std::fs::read_dir(&self.folder)? {
            let path = file?.path();
            if path.extension().is_none_or(|extension| extension != "csv") {
                continue;
            }
            let Some(stem) = path.file_stem().and_then(|stem| stem.to_str()) else {
                continue;
            };
            let about = std::fs::read(self.about(stem)).unwrap_or_default();
            if let Ok(about) = serde_json::from_slice(&about) {
                all.push(Kept {
                    stem: stem.to_owned(),
                    about,
                });
            }
        }
        // The number of a recording without a date decides between equal times.
        all.sort_by_key(|kept: &Kept| (kept.about.start_ns, kept.stem.len(), kept.stem.clone()));
        Ok(all)
    }

    pub(crate) fn is_reported(&self, stem: &str) -> bool {
        self.report(stem, "json").exists()
    }

    /// Returns page and numbers of a report. `None` if there is none of this name.
    pub(crate) fn page(&self, report: &Name) -> Option<(String, String)> {
        let kept = self.list().ok()?.into_iter();
        let stem = kept
            .map(|kept| kept.stem)
            .find(|stem| report_name(stem).as_ref() == Some(report))?;
        let read = |extension| std::fs::read_to_string(self.report(&stem, extension)).ok();
        Some((read("html")?, read("json")?))
    }

    /// Removes the recordings that were kept first, with their reports, if there are more than
    /// `most`. Returns whether some were removed.
    ///
    /// The clocks of sensors do not decide this. If they were ahead for a while, the recordings of
    /// the true time would otherwise be the oldest ones.
    pub(crate) fn trim(&self, most: usize) -> io::Result<bool> {
        let mut all = self.list()?;
        if all.len() <= most {
            return Ok(false);
        }
        let kept_at = |kept: &Kept| std::fs::metadata(self.record(&kept.stem))?.modified();
        all.sort_by_cached_key(|kept| kept_at(kept).ok());
        let remaining = (most as f64 * REMAINING) as usize;
        for kept in &all[..all.len() - remaining] {
            let stem = &kept.stem;
            let reports = ["html", "json"].map(|extension| self.report(stem, extension));
            // The recording goes first, because it makes the others count.
            for path in [self.record(stem), self.about(stem)].iter().chain(&reports) {
                match std::fs::remove_file(path) {
                    Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                    _ => {}
                }
            }
        }
        Ok(true)
    }

    /// Returns the path of a recording.
    pub(crate) fn record(&self, stem: &str) -> PathBuf {
        self.folder.join(format!("{stem}.csv"))
    }

    fn about(&self, stem: &str) -> PathBuf {
        self.folder.join(format!("{stem}.record"))
    }

    fn report(&self, stem: &str, extension: &str) -> PathBuf {
        let name = format!("{}_{stem}.{extension}", self.structure);
        self.folder.join(name)
    }
}

/// Syncs a file to disk, and renames it. The next checkpoint assumes that both are done.
fn settle(part: &Path, path: &Path) -> Result<(), KeepError> {
    let forced = File::open(part).and_then(|file| file.sync_all());
    let renamed = forced.and_then(|()| std::fs::rename(part, path));
    renamed.map_err(|reason| KeepError::Write {
        path: path.to_owned(),
        reason,
    })?;
    sync_name(path);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_earthquake::{CutKind, Ending};

    fn recorded(start_s: i64) -> Recorded {
        let start_ns = start_s * 1_000_000_000;
        let kind = CutKind::Earthquake {
            ending: Ending::Calm,
            is_strong: true,
        };
        let rows = (0..3).map(|row| (start_ns + row * 10_000_000, vec![0.5, f64::NAN]));
        Recorded {
            about: About {
                start_ns,
                end_ns: start_ns + 20_000_000,
                kind,
            },
            rows: rows.collect(),
        }
    }

    fn records(folder: &Path) -> Records {
        let structure = Name::new("tower").unwrap();
        let channels = vec!["ground".to_owned(), "roof".to_owned()];
        Records::open(folder, &structure, channels).unwrap()
    }

    fn made() -> MadeReport {
        MadeReport {
            html: "<p>".to_owned(),
            json: "{}".to_owned(),
            urgency: "watch".to_owned(),
            headline: "weak".to_owned(),
        }
    }

    #[test]
    fn recordings_and_reports_are_found_again() {
        let folder = tempfile::tempdir().unwrap();
        let records = records(folder.path());
        let later = records.keep(&recorded(2_000_000)).unwrap();
        let first = records.keep(&recorded(1_000_000)).unwrap();
        records.put(&first.stem, &made()).unwrap();
        assert_eq!(records.list().unwrap(), [first.clone(), later.clone()]);
        assert!(records.is_reported(&first.stem) && !records.is_reported(&later.stem));
        let name = report_name(&first.stem).unwrap();
        let page = records.page(&name).unwrap();
        assert_eq!(page, ("<p>".to_owned(), "{}".to_owned()));
        assert_eq!(records.page(&Name::new("index").unwrap()), None);
        let text = std::fs::read_to_string(records.record(&first.stem)).unwrap();
        assert_eq!(text.lines().nth(1), Some("1000000,0.5,"), "{text}");
    }

    /// Regression test: the second of two records without dates replaced the recording of the
    /// first, and was not reported.
    #[test]
    fn records_without_dates_have_their_own_names_and_a_repetition_keeps_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let records = records(folder.path());
        let first = recorded(10);
        let mut second = first.clone();
        second.rows[1].1[0] = 0.25;
        let mut third = first.clone();
        third.rows[1].1[0] = 0.75;
        let stems = [&first, &second, &second, &third, &first]
            .map(|recorded| records.keep(recorded).unwrap().stem);
        let stem = "1970-01-01T00-00-10Z";
        let [numbered, last] = [2, 3].map(|number| format!("{stem}-{number}"));
        assert_eq!(stems, [stem, &numbered, &numbered, &last, stem]);
        let listed = records.list().unwrap().into_iter().map(|kept| kept.stem);
        assert_eq!(listed.collect::<Vec<_>>(), [stem, &numbered, &last]);
        records.put(&numbered, &made()).unwrap();
        assert!(!records.is_reported(stem) && !records.is_reported(&last));
        assert!(records.page(&report_name(&numbered).unwrap()).is_some());
    }

    /// A restart from a checkpoint may end a recording elsewhere. Its date is its name.
    #[test]
    fn a_repetition_of_a_recording_with_a_date_replaces_it() {
        let folder = tempfile::tempdir().unwrap();
        let records = records(folder.path());
        let first = recorded(1_000_000_000);
        let mut shorter = first.clone();
        shorter.rows.pop();
        let kept = [&first, &shorter].map(|recorded| records.keep(recorded).unwrap());
        assert_eq!(kept[0], kept[1]);
        assert_eq!(records.list().unwrap().len(), 1);
        let text = std::fs::read_to_string(records.record(&kept[0].stem)).unwrap();
        assert_eq!(text.lines().count(), 3, "{text}");
    }

    #[test]
    fn a_part_of_a_recording_does_not_count_and_those_kept_first_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let records = records(folder.path());
        std::fs::write(folder.path().join("2020-01-01T00-00-00Z.part"), "time").unwrap();
        // The clock of the sensors was 400 days ahead for the first two recordings.
        for day in [401, 402, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12] {
            records.keep(&recorded(day * 86_400)).unwrap();
            std::thread::sleep(std::time::Duration::from_millis(5)); // times of files are coarse
        }
        assert!(!records.trim(12).unwrap());
        assert!(records.trim(10).unwrap());
        let left = records.list().unwrap();
        let days = left
            .iter()
            .map(|kept| kept.about.start_ns / 86_400_000_000_000);
        assert_eq!(days.collect::<Vec<_>>(), (4..=12).collect::<Vec<_>>());
    }

    #[test]
    fn a_recording_that_cannot_be_written_is_an_error_and_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let records = records(folder.path());
        let mut wrong = recorded(1_000_000);
        wrong.rows[2].1[0] = f64::INFINITY;
        assert!(records.keep(&wrong).is_err());
        assert!(records.list().unwrap().is_empty());
        std::fs::remove_dir_all(folder.path()).unwrap();
        let error = records.keep(&recorded(1_000_000)).unwrap_err();
        assert!(error.to_string().contains("No such file"), "{error}");
    }
}
