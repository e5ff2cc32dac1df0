//! The file of the epochs of one structure: a CSV series, to which each epoch appends one line.
//!
//! The last column is a check value over the line and the check value of the line before. The file
//! therefore reveals a damaged, missing or added line. `spandrel judge --series` ignores this
//! column, as it ignores the deviations.

use crate::configurations::Place;
use crate::epochs::ClosedEpoch;
use crate::error::JudgingError;
use spandrel_checkpoint::{Failures, fingerprint, sync_name};
use spandrel_judge::Epoch;
use spandrel_record::{ChannelColumn, ColumnMapping, CsvReader, RecordReader, write_whole};
use spandrel_structure::JudgePlan;
use std::fmt::Write as _;
use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{Cursor, ErrorKind, Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use tracing::{info, warn};

/// Name of the file, below the folder of the checkpoints of a structure.
pub(crate) const FILE: &str = "judge-epochs.csv";
/// Name of the column that is 1 if all samples were measured, and otherwise 0.
const MEASURED: &str = "spandrel-measured";
/// Name of the last column.
const CHECK: &str = "spandrel-check";
/// Number of bytes of a check value.
const CHECK_BYTES: usize = 8;
/// Maximum number of epochs that wait for a disk that cannot be written.
const MOST_WAITING: usize = 10_000;
/// Maximum number of files that were set aside.
const MOST_ASIDE: u32 = 1000;
/// Permissions of a new folder. Only the owner has access.
const FOLDER_MODE: u32 = 0o700;
const NS_PER_S: i64 = 1_000_000_000;

/// Appends epochs to a file.
#[derive(Debug)]
pub(crate) struct EpochLog {
    path: PathBuf,
    header: String,
    /// Check value of the last line.
    check: String,
    /// Size of the file up to the last complete line (bytes).
    length: u64,
    /// Number of epochs in the file.
    lines: u64,
    /// Name of the file into which the former epochs were set aside at the start.
    aside: Option<String>,
    /// The last line before epochs were lost, or of a file that has taken the place of another one.
    incomplete: Option<Place>,
    /// Lines that are not written yet, without their check values.
    waiting: Vec<String>,
    /// Number of epochs that are lost, because too many were waiting.
    lost: u64,
    failures: Failures,
}

impl EpochLog {
    /// Opens or creates the file in a folder. Calls `judge` for each epoch in it.
    ///
    /// A last line that is incomplete is removed. If another line is damaged, or if the columns
    /// have changed, the file is set aside. The epochs before a damaged line are copied.
    ///
    /// # Errors
    /// The file cannot be read or written, or a line is not an epoch of `plan`.
    pub(crate) fn open(
        folder: &Path,
        plan: &JudgePlan,
        judge: impl FnMut(ClosedEpoch),
    ) -> Result<Self, JudgingError> {
        let path = folder.join(FILE);
        let mut builder = DirBuilder::new();
        let created = builder.recursive(true).mode(FOLDER_MODE).create(folder);
        created.map_err(|source| JudgingError::File {
            what: "write",
            path: path.clone(),
            source,
        })?;
        let header = header(plan);
        let Begun { text, found, aside } = begin(&path, &header)?;
        if found.lines > 0 {
            replay(&path, &text, plan, judge)?;
            info!(file = %path.display(), epochs = found.lines, "resumed from the epochs");
        }
        Ok(Self {
            check: found.check,
            length: found.length as u64,
            lines: found.lines as u64,
            aside,
            incomplete: None,
            path,
            header,
            waiting: Vec::new(),
            lost: 0,
            failures: Failures::default(),
        })
    }

    /// Appends an epoch. On return it is on disk, or the failure is logged and the line waits.
    ///
    /// The call blocks the thread during the write.
    pub(crate) fn append(&mut self, closed: &ClosedEpoch) {
        match self.waiting.len() < MOST_WAITING {
            true => self.waiting.push(line(closed)),
            false => {
                self.lost += 1;
                self.incomplete = Some(self.place());
            }
        }
        self.flush();
    }

    /// Tries to write the lines that wait. If there are none, looks whether the file still exists.
    pub(crate) fn flush(&mut self) {
        if self.waiting.is_empty() {
            self.look();
            return;
        }
        match self.write() {
            Ok(()) => {
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "epochs are saved again");
                }
            }
            Err(error) if self.failures.failed() => {
                let failures = self.failures.consecutive();
                let cause = std::error::Error::source(&error).map(ToString::to_string);
                warn!(%error, cause, failures, "cannot save epochs; a restart would lose them");
            }
            Err(_) => {}
        }
    }

    /// Counts a file that is gone, so that this does not remain unnoticed until the end of an
    /// epoch.
    fn look(&mut self) {
        let was_lost = self.failures.consecutive() > 0;
        let file = self.path.display();
        match self.path.exists() {
            true => {
                if let Some(failures) = self.failures.succeeded() {
                    info!(%file, failures, "the file of the epochs is back");
                }
            }
            false if !was_lost && self.failures.failed() => {
                warn!(%file, "the file of the epochs is gone; a restart would lose them");
            }
            false => {}
        }
    }

    /// Returns `true` if epochs wait for a disk that cannot be written.
    pub(crate) fn is_behind(&self) -> bool {
        !self.waiting.is_empty() || self.lost > 0
    }

    /// Returns the line after which the file lacks epochs that were judged. `None` if it contains
    /// all of them, or will.
    pub(crate) fn incomplete(&self) -> Option<Place> {
        self.incomplete.clone()
    }

    /// Returns the last line of the file, or that of [`Self::incomplete`].
    pub(crate) fn place(&self) -> Place {
        self.incomplete().unwrap_or_else(|| Place {
            epochs: self.lines,
            check: self.check.clone(),
        })
    }

    /// Returns the name of the file into which the former epochs were set aside at the start. Each
    /// later call returns `None`.
    pub(crate) fn take_aside(&mut self) -> Option<String> {
        self.aside.take()
    }

    /// Returns the counts of failed writes and of lost epochs.
    pub(crate) fn drops(&self) -> impl Iterator<Item = (String, u64)> {
        let lost = (self.lost > 0).then(|| ("epochs-not-kept".to_owned(), self.lost));
        self.failures.drops().into_iter().chain(lost)
    }

    fn write(&mut self) -> Result<(), JudgingError> {
        let path = self.path.clone();
        let failed = |source| JudgingError::File {
            what: "write",
            path: path.clone(),
            source,
        };
        if !self.is_own_file().map_err(failed)? {
            let Begun { found, .. } = begin(&path, &self.header)?;
            (self.length, self.check) = (found.length as u64, found.check);
            self.lines = found.lines as u64;
            self.incomplete = Some(Place {
                epochs: self.lines,
                check: self.check.clone(),
            });
            warn!(
                file = %path.display(), epochs = found.lines,
                "the file of the epochs was replaced; a restart knows only the epochs in it"
            );
        }
        let (text, check) = self.text();
        self.append_text(&text).map_err(failed)?;
        (self.length, self.check) = (self.length + text.len() as u64, check);
        self.lines += self.waiting.len() as u64;
        self.waiting.clear();
        Ok(())
    }

    /// Returns the waiting lines with their check values, and the last check value.
    fn text(&self) -> (String, String) {
        let (mut text, mut end) = (String::new(), self.check.clone());
        for line in &self.waiting {
            end = check(line, &end);
            text.push_str(line);
            text.push_str(&end);
            text.push('\n');
        }
        (text, end)
    }

    /// Returns `true` if the file ends with the last line of this process. After it, the file may
    /// contain a part of the waiting lines, from an earlier attempt.
    ///
    /// While a disk is unmounted, its folder contains another file. Neither file may be cut to the
    /// length of the other one.
    fn is_own_file(&self) -> std::io::Result<bool> {
        let mut file = match File::open(&self.path) {
            Ok(file) => file,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(false),
            Err(error) => return Err(error),
        };
        let last = match self.length == self.header.len() as u64 {
            true => self.header.clone(),
            false => format!("{}\n", self.check),
        };
        let (text, _) = self.text();
        file.seek(SeekFrom::Start(self.length - last.len() as u64))?;
        let mut found = Vec::new();
        let most = (last.len() + text.len()) as u64 + 1;
        file.take(most).read_to_end(&mut found)?;
        let after = found.strip_prefix(last.as_bytes());
        Ok(after.is_some_and(|after| text.as_bytes().starts_with(after)))
    }

    /// Replaces what follows the last complete line with a text.
    fn append_text(&self, text: &str) -> std::io::Result<()> {
        let mut file = OpenOptions::new().append(true).open(&self.path)?;
        file.set_len(self.length)?;
        file.write_all(text.as_bytes())?;
        file.sync_data()
    }
}

/// The epochs of a file, read without a change to it.
#[derive(Debug)]
pub(crate) struct SavedEpochs<'p> {
    path: PathBuf,
    plan: &'p JudgePlan,
    text: Vec<u8>,
    sound: Sound,
}

/// The epochs of a file up to a time.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Known {
    /// Their number.
    pub(crate) epochs: u64,
    /// Middle of the first epoch in the file (ns since 1970-01-01 UTC).
    pub(crate) first_ns: Option<i64>,
    /// Middle of the last epoch up to the time (ns since 1970-01-01 UTC).
    pub(crate) last_ns: Option<i64>,
    /// Whether a later epoch follows.
    pub(crate) is_followed: bool,
}

impl<'p> SavedEpochs<'p> {
    /// Reads a file with the columns of `plan`.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(crate) fn read(path: PathBuf, plan: &'p JudgePlan) -> Result<Self, JudgingError> {
        let text = std::fs::read(&path).map_err(|source| JudgingError::File {
            what: "read",
            path: path.clone(),
            source,
        })?;
        let sound = Sound::find(&text, &header(plan));
        Ok(Self {
            path,
            plan,
            text,
            sound,
        })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns `true` if a line is damaged, or if the columns are others. Only the epochs before
    /// are read.
    pub(crate) fn is_damaged(&self) -> bool {
        self.sound.end == End::Damaged
    }

    /// Returns `true` if the file contains a line after the same lines.
    pub(crate) fn contains(&self, place: &Place) -> bool {
        let most = usize::try_from(place.epochs).unwrap_or(usize::MAX);
        let begun = Sound::find_first(&self.text, &header(self.plan), most);
        begun.lines == most && begun.check == place.check
    }

    /// Calls `judge` for each epoch.
    ///
    /// # Errors
    /// A line is not an epoch of the plan.
    pub(crate) fn each(&self, judge: impl FnMut(ClosedEpoch)) -> Result<(), JudgingError> {
        match self.sound.lines {
            0 => Ok(()),
            _ => replay(
                &self.path,
                &self.text[..self.sound.length],
                self.plan,
                judge,
            ),
        }
    }

    /// Counts the epochs up to a time (ns since 1970-01-01 UTC).
    ///
    /// # Errors
    /// As for [`Self::each`].
    pub(crate) fn until(&self, at_ns: i64) -> Result<Known, JudgingError> {
        let mut known = Known::default();
        self.each(|closed| {
            known.first_ns = known.first_ns.or(Some(closed.middle_ns));
            known.is_followed |= closed.middle_ns > at_ns;
            if !known.is_followed {
                known.epochs += 1;
                known.last_ns = Some(closed.middle_ns);
            }
        })?;
        Ok(known)
    }
}

/// A file that was opened or created.
struct Begun {
    /// Its sound part.
    text: Vec<u8>,
    found: Sound,
    /// Name of the file into which a damaged one was set aside.
    aside: Option<String>,
}

/// Reads the file of the epochs, or creates it. Returns its sound part, and what is known of it.
///
/// An incomplete last line is removed. A damaged file is set aside, and the epochs before the
/// damage are copied.
fn begin(path: &Path, header: &str) -> Result<Begun, JudgingError> {
    let failed = |what| {
        move |source| JudgingError::File {
            what,
            path: path.to_owned(),
            source,
        }
    };
    let mut text = match std::fs::read(path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(failed("read")(error)),
    };
    let mut found = Sound::find(&text, header);
    let mut renamed = None;
    if !text.is_empty() && found.end == End::Damaged {
        let aside = set_aside(path).map_err(failed("set aside"))?;
        warn!(
            file = %path.display(), aside = %aside.display(), epochs = found.lines,
            "the file of the epochs has other columns or a damaged line; only the epochs before \
             it are used"
        );
        let name = aside.file_name();
        renamed = name.map(|name| name.to_string_lossy().into_owned());
    }
    let is_whole = found.end == End::Whole && !text.is_empty();
    text.truncate(found.length);
    if text.is_empty() {
        text.extend_from_slice(header.as_bytes());
        found.length = text.len();
    }
    if !is_whole {
        write_whole(path, &text).map_err(failed("write"))?;
        sync_name(path);
    }
    Ok(Begun {
        text,
        found,
        aside: renamed,
    })
}

/// How a file ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// With a sound line.
    Whole,
    /// With a part of a line, as after a crash.
    Torn,
    /// A line is damaged, or the header differs.
    Damaged,
}

/// The sound part of a file.
#[derive(Debug, PartialEq, Eq)]
struct Sound {
    /// Its size (bytes), with the header.
    length: usize,
    /// Number of epochs.
    lines: usize,
    /// Check value of the last line.
    check: String,
    end: End,
}

impl Sound {
    fn find(bytes: &[u8], header: &str) -> Self {
        Self::find_first(bytes, header, usize::MAX)
    }

    /// As [`Sound::find`], for at most this number of epochs.
    fn find_first(bytes: &[u8], header: &str, most: usize) -> Self {
        let mut sound = Self {
            length: 0,
            lines: 0,
            check: check(header, ""),
            end: End::Whole,
        };
        if header.as_bytes().starts_with(bytes) && bytes.len() < header.len() {
            sound.end = End::Torn; // a crash at the first start
            return sound;
        }
        let Some(mut rest) = bytes.strip_prefix(header.as_bytes()) else {
            sound.end = End::Damaged;
            return sound;
        };
        sound.length = header.len();
        while sound.lines < most
            && let Some(end) = rest.iter().position(|byte| *byte == b'\n')
        {
            let (line, after) = rest.split_at(end + 1);
            let Some(found) = checked(line, &sound.check) else {
                sound.end = End::Damaged;
                return sound;
            };
            sound.check = found;
            sound.length += line.len();
            sound.lines += 1;
            rest = after;
        }
        if !rest.is_empty() {
            sound.end = End::Torn;
        }
        sound
    }
}

/// Returns the check value of a sound line.
fn checked(line: &[u8], before: &str) -> Option<String> {
    let line = std::str::from_utf8(line).ok()?.strip_suffix('\n')?;
    let split = line.rfind(',')? + 1;
    let expected = check(&line[..split], before);
    (line[split..] == expected).then_some(expected)
}

/// Returns the check value of the text of a line, which follows a line with the value `before`.
pub(crate) fn check(text: &str, before: &str) -> String {
    let all = fingerprint(&format!("{before}{text}"));
    let mut value = String::new();
    for byte in &all[..CHECK_BYTES] {
        // Writing to a string cannot fail.
        let _ = write!(value, "{byte:02x}");
    }
    value
}

/// Returns the first line, with its end.
fn header(plan: &JudgePlan) -> String {
    let columns = plan.quantity_columns.iter().chain(&plan.condition_columns);
    let mut fields = vec![quoted(&plan.time_column)];
    fields.extend(columns.map(|column| quoted(column)));
    let quantities = plan.settings.quantities.iter();
    fields.extend(quantities.map(|quantity| format!("deviation({})", quantity.name)));
    fields.extend([MEASURED, CHECK].map(str::to_owned));
    fields.join(",") + "\n"
}

/// Returns a text as a field of a CSV file.
fn quoted(text: &str) -> String {
    match text.contains(['"', ',', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
}

/// Returns the line of an epoch up to its check value. A missing value is empty.
fn line(closed: &ClosedEpoch) -> String {
    let (s, ns) = (
        closed.middle_ns.div_euclid(NS_PER_S),
        closed.middle_ns.rem_euclid(NS_PER_S),
    );
    let mut line = format!("{s}.{ns:09},");
    let values = closed.epoch.quantities.iter();
    let values = values.chain(&closed.epoch.conditions);
    for value in values.chain(&closed.deviations) {
        if let Some(value) = value {
            // The shortest text that gives the same bits.
            let _ = write!(line, "{value}");
        }
        line.push(',');
    }
    line.push_str(if closed.is_measured { "1," } else { "0," });
    line
}

/// Reads the epochs as `spandrel judge --series` does.
fn replay(
    path: &Path,
    sound: &[u8],
    plan: &JudgePlan,
    mut judge: impl FnMut(ClosedEpoch),
) -> Result<(), JudgingError> {
    let quantities = plan.settings.quantities.iter();
    let names = quantities.map(|quantity| &quantity.name);
    let conditions = plan.settings.conditions.iter();
    let names = names.chain(conditions.map(|condition| &condition.name));
    let columns = plan.quantity_columns.iter().chain(&plan.condition_columns);
    let channels = names
        .zip(columns)
        .map(|(name, column)| ChannelColumn::new(name).with_column(column))
        .chain([ChannelColumn::new(MEASURED)]);
    let mapping = ColumnMapping::new(channels.collect()).with_time_column(&plan.time_column);
    let mut reader = CsvReader::new(Box::new(Cursor::new(sound.to_vec())), path, &mapping)?;
    let (count, columns) = (
        plan.settings.quantities.len(),
        plan.settings.quantities.len() + plan.settings.conditions.len(),
    );
    while let Some(row) = reader.next_row()? {
        let value = |value: &f64| (!value.is_nan()).then_some(*value);
        let (values, is_measured) = row.values.split_at(columns);
        let (quantities, conditions) = values.split_at(count);
        judge(ClosedEpoch {
            middle_ns: row.time_ns,
            epoch: Epoch {
                time_s: ClosedEpoch::time_s(row.time_ns),
                quantities: quantities.iter().map(value).collect(),
                conditions: conditions.iter().map(value).collect(),
            },
            deviations: Vec::new(), // no decision depends on them
            is_measured: is_measured == [1.0],
        });
    }
    Ok(())
}

/// Renames a file, so that a person can look at it.
pub(crate) fn set_aside(path: &Path) -> std::io::Result<PathBuf> {
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    let name = |number: u32| path.with_extension(format!("{number}.{ending}"));
    let mut free = (1..=MOST_ASIDE).map(name);
    let free = free
        .find(|aside| !aside.exists())
        .ok_or_else(|| std::io::Error::from(ErrorKind::AlreadyExists))?;
    std::fs::rename(path, &free)?;
    Ok(free)
}

#[cfg(test)]
mod tests;
