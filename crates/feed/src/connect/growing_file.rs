//! Lines of a file that grows and is rotated.
//!
//! The folder is polled, because notifications of the operating system do not cover network file
//! systems. A file is followed by its handle, so that a renamed file is read to its end.

use std::collections::VecDeque;
use std::fs::{File, Metadata};
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use spandrel_bus::check_regular_file;
use tokio::time::sleep;

use crate::connect::Outlet;
use crate::connect::lines::pass_on;
use crate::connect::retry::Retry;
use crate::core_input::Link;
use crate::lines::{LineFormat, LineSplitter, Split, cells};
use crate::source_plan::{GrowingFile, StartAt};

/// Interval at which a file is checked for new data.
const POLL: Duration = Duration::from_millis(200);
/// Size of a read in bytes.
const READ_BYTES: usize = 64 << 10;
/// Longest header in bytes.
const MAX_HEADER_BYTES: u64 = 64 << 10;
/// A file that was last modified so long before the last recorded frame contains nothing new, ns.
/// Clocks of file systems may differ from those of instruments.
const MARGIN_NS: i64 = 60_000_000_000;

/// Follows a file until the feed stops.
pub(crate) async fn read(plan: GrowingFile, since_ns: Option<i64>, outlet: Outlet) {
    let mut retry = Retry::new();
    let mut follower = Follower::new(plan, since_ns);
    outlet.link(Link::Connecting).await;
    while !outlet.is_closed() {
        match follower.step(&outlet).await {
            Ok(Step::Read) => retry.reset(),
            Ok(Step::AtEnd) => sleep(POLL).await,
            Ok(Step::Missing) => follower.wait_for_a_file(&outlet).await,
            Err(why) => {
                outlet.failed(why).await;
                retry.pause().await;
            }
        }
    }
}

/// Result of one check of the file.
enum Step {
    /// Bytes were read.
    Read,
    /// Nothing new.
    AtEnd,
    /// No file has existed yet.
    Missing,
}

/// The position in a sequence of files.
struct Follower {
    plan: GrowingFile,
    /// Start position of the first file.
    start: Start,
    open: Option<OpenFile>,
    /// Files that follow, in order.
    next: VecDeque<PathBuf>,
    /// Device and inode of the last file, and its path.
    last: Option<(Identity, PathBuf)>,
}

/// Where to start when the feed starts.
#[derive(Clone, Copy)]
enum Start {
    /// With all files that may have samples after this time, ns.
    Since(i64),
    /// At the beginning of the oldest file.
    Beginning,
    /// At the end of the newest file.
    End,
    /// The feed has started already.
    Started,
}

/// Device and inode.
type Identity = (u64, u64);

struct OpenFile {
    path: PathBuf,
    identity: Identity,
    file: File,
    position: u64,
    splitter: LineSplitter,
    format: LineFormat,
}

impl Follower {
    fn new(plan: GrowingFile, since_ns: Option<i64>) -> Self {
        let start = match (since_ns, plan.start) {
            (Some(since_ns), _) => Start::Since(since_ns),
            (None, StartAt::Start) => Start::Beginning,
            (None, StartAt::End) => Start::End,
        };
        Self {
            plan,
            start,
            open: None,
            next: VecDeque::new(),
            last: None,
        }
    }

    /// Reports once that no file exists, and waits until one does or the feed stops.
    async fn wait_for_a_file(&mut self, outlet: &Outlet) {
        outlet.failed(self.plan.missing()).await;
        // Everything in a file that appears later is new.
        if matches!(self.start, Start::End) {
            self.start = Start::Beginning;
        }
        while !outlet.is_closed() && self.successors().is_ok_and(|files| files.is_empty()) {
            sleep(POLL).await;
        }
    }

    async fn step(&mut self, outlet: &Outlet) -> Result<Step, String> {
        if self.open.is_none() && !self.open_next(outlet).await? {
            return Ok(match self.last.is_none() && self.next.is_empty() {
                true => Step::Missing,
                false => Step::AtEnd,
            });
        }
        let Some(open) = &mut self.open else {
            return Ok(Step::AtEnd);
        };
        let lines = open.read()?;
        if let Some(lines) = lines {
            if !pass_on(&open.format, lines, outlet).await {
                self.open = None;
            }
            return Ok(Step::Read);
        }
        // The writer may have appended between the read and this look. Only a file that has a
        // successor is complete, and it is read once more before it is left.
        if self.has_successor()? && open_is_at_end(self.open.as_ref())? {
            if let Some(mut left) = self.open.take() {
                let rest: Vec<Split> = left.splitter.end().into_iter().collect();
                pass_on(&left.format, rest, outlet).await;
            }
            return Ok(Step::Read);
        }
        Ok(Step::AtEnd)
    }

    /// Opens the next file. Returns `false` if there is none yet.
    async fn open_next(&mut self, outlet: &Outlet) -> Result<bool, String> {
        if self.next.is_empty() {
            self.next = self.successors()?;
        }
        let Some(path) = self.next.pop_front() else {
            return Ok(false);
        };
        let mut opened = match OpenFile::open(&path, &self.plan.format)? {
            Some(opened) => opened,
            None => {
                // The header is not complete yet.
                self.next.push_front(path);
                return Ok(false);
            }
        };
        if matches!(self.start, Start::End) && self.next.is_empty() {
            opened.go_to_end()?;
        }
        self.start = match self.start {
            Start::End if !self.next.is_empty() => Start::End,
            _ => Start::Started,
        };
        self.last = Some((opened.identity, path));
        self.open = Some(opened);
        outlet.link(Link::Open).await;
        Ok(true)
    }

    fn has_successor(&mut self) -> Result<bool, String> {
        if self.next.is_empty() {
            self.next = self.successors()?;
        }
        Ok(!self.next.is_empty())
    }

    /// Returns the files after the last one, in order.
    fn successors(&self) -> Result<VecDeque<PathBuf>, String> {
        match self.plan.is_pattern() {
            true => self.successors_by_name(),
            false => self.successors_by_identity(),
        }
    }

    /// Returns the files of a pattern with a later name.
    fn successors_by_name(&self) -> Result<VecDeque<PathBuf>, String> {
        let mut files = self.files(|name| self.plan.matches(name))?;
        files.sort_unstable_by(|(a, _), (b, _)| a.cmp(b));
        if let Some((_, last)) = &self.last {
            files.retain(|(path, _)| path > last);
        }
        Ok(self.needed_at_start(files))
    }

    /// Returns the file itself if it has been replaced, and at the start the files into which it
    /// was renamed.
    fn successors_by_identity(&self) -> Result<VecDeque<PathBuf>, String> {
        let path = &self.plan.path;
        let name = path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned());
        let name = name.unwrap_or_default();
        if self.last.is_none() {
            let mut files = self.renamed_files(&name)?;
            if matches!(self.start, Start::Beginning) {
                files.retain(|(path, _)| *path == self.plan.path);
            }
            return Ok(self.needed_at_start(files));
        }
        let found = match std::fs::metadata(path) {
            Ok(found) => found,
            // Between the rename and the creation, the file does not exist.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                return Ok(VecDeque::new());
            }
            Err(error) => return Err(format!("cannot access {}: {error}", path.display())),
        };
        let is_same = self
            .last
            .as_ref()
            .is_some_and(|(last, _)| *last == identity(&found));
        let is_shorter = self
            .open
            .as_ref()
            .is_some_and(|open| found.len() < open.position);
        if is_same && !is_shorter {
            return Ok(VecDeque::new());
        }
        // The file can have been renamed several times since it was opened.
        let files = self.renamed_files(&name)?;
        let is_last = |(_, metadata): &(PathBuf, Metadata)| {
            let last = self.last.as_ref();
            last.is_some_and(|(last, _)| *last == identity(metadata))
        };
        Ok(match files.iter().position(is_last) {
            Some(index) if !is_same => {
                let later = files.into_iter().skip(index + 1);
                later.map(|(path, _)| path).collect()
            }
            _ => [path.clone()].into(),
        })
    }

    /// Returns the file and the files into which it was renamed, oldest first.
    fn renamed_files(&self, name: &str) -> Result<Vec<(PathBuf, Metadata)>, String> {
        let renamed = format!("{name}.");
        let mut files = self.files(|other| other == name || other.starts_with(&renamed))?;
        files.sort_by_key(|(path, metadata)| {
            (*path == self.plan.path, modified_ns(metadata), path.clone())
        });
        Ok(files)
    }

    /// Drops the files that are not needed at the start.
    fn needed_at_start(&self, mut files: Vec<(PathBuf, Metadata)>) -> VecDeque<PathBuf> {
        match self.start {
            Start::Since(since_ns) => {
                let newest = files.len().saturating_sub(1);
                let mut index = 0;
                files.retain(|(_, metadata)| {
                    let is_needed = modified_ns(metadata) >= since_ns.saturating_sub(MARGIN_NS);
                    index += 1;
                    is_needed || index > newest
                });
            }
            Start::End => {
                files.drain(..files.len().saturating_sub(1));
            }
            Start::Beginning | Start::Started => {}
        }
        files.into_iter().map(|(path, _)| path).collect()
    }

    fn files(&self, is_wanted: impl Fn(&str) -> bool) -> Result<Vec<(PathBuf, Metadata)>, String> {
        let folder = self.plan.folder();
        let failed = |error| format!("cannot read the folder {}: {error}", folder.display());
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            if !is_wanted(&entry.file_name().to_string_lossy()) {
                continue;
            }
            // The folder of a bare file name is `.`, which the path of the plan lacks.
            let path = self.plan.path.with_file_name(entry.file_name());
            // A file may disappear meanwhile.
            if let Ok(metadata) = std::fs::metadata(&path)
                && metadata.is_file()
            {
                files.push((path, metadata));
            }
        }
        Ok(files)
    }
}

fn open_is_at_end(open: Option<&OpenFile>) -> Result<bool, String> {
    let Some(open) = open else {
        return Ok(true);
    };
    let found = open.file.metadata().map_err(|error| open.failed(&error))?;
    // A file that was truncated is shorter than what was read.
    Ok(found.len() <= open.position)
}

impl OpenFile {
    /// Opens a file. Returns `None` if its header is not complete yet.
    fn open(path: &Path, format: &LineFormat) -> Result<Option<Self>, String> {
        let failed = |error: std::io::Error| format!("cannot read {}: {error}", path.display());
        check_regular_file(path).map_err(failed)?;
        let mut file = File::open(path).map_err(failed)?;
        let identity = identity(&file.metadata().map_err(failed)?);
        let mut position = 0;
        let format = match format.needs_header() {
            false => format.clone(),
            true => {
                let mut header = String::new();
                let mut head = BufReader::new(&mut file).take(MAX_HEADER_BYTES);
                head.read_line(&mut header).map_err(failed)?;
                if !header.ends_with('\n') {
                    return Ok(None);
                }
                position = header.len() as u64;
                format
                    .with_header(header.trim())
                    .map_err(|fault| format!("{}: {fault}", path.display()))?
            }
        };
        file.seek(SeekFrom::Start(position)).map_err(failed)?;
        Ok(Some(Self {
            path: path.to_owned(),
            identity,
            file,
            position,
            splitter: LineSplitter::default(),
            format,
        }))
    }

    fn failed(&self, error: &std::io::Error) -> String {
        format!("cannot read {}: {error}", self.path.display())
    }

    /// Moves behind the last complete line. Reads only the end of the file, which may be large.
    fn go_to_end(&mut self) -> Result<(), String> {
        let failed = |error| format!("cannot read {}: {error}", self.path.display());
        let mut end = self.file.metadata().map_err(failed)?.len();
        let mut bytes = vec![0; READ_BYTES];
        while end > self.position {
            let begin = end.saturating_sub(READ_BYTES as u64).max(self.position);
            bytes.resize((end - begin) as usize, 0);
            self.file.seek(SeekFrom::Start(begin)).map_err(failed)?;
            self.file.read_exact(&mut bytes).map_err(failed)?;
            if let Some(last) = bytes.iter().rposition(|byte| *byte == b'\n') {
                self.position = begin + last as u64 + 1;
                break;
            }
            end = begin;
        }
        let start = SeekFrom::Start(self.position);
        self.file.seek(start).map_err(failed)?;
        Ok(())
    }

    /// Reads the next lines. Returns `None` at the end of the file.
    fn read(&mut self) -> Result<Option<Vec<Split>>, String> {
        let mut bytes = vec![0; READ_BYTES];
        let read = match self.file.read(&mut bytes) {
            Ok(read) => read,
            Err(error) => return Err(self.failed(&error)),
        };
        if read == 0 {
            return Ok(None);
        }
        self.position += read as u64;
        let mut lines = Vec::new();
        self.splitter
            .push(bytes.get(..read).unwrap_or_default(), &mut lines);
        Ok(Some(lines))
    }
}

impl LineFormat {
    /// Returns `true` if the columns are those of the header.
    fn needs_header(&self) -> bool {
        matches!(self, Self::Csv { columns, .. } if columns.is_empty())
    }

    /// Returns the format with the columns of a header.
    fn with_header(&self, header: &str) -> Result<Self, String> {
        let Self::Csv {
            separator,
            time,
            fields,
            ..
        } = self
        else {
            return Ok(self.clone());
        };
        let columns: Vec<String> = cells(header, *separator).map(str::to_owned).collect();
        let needed = fields.iter().chain(time.iter().map(|time| &time.name));
        for name in needed {
            if !columns.contains(name) {
                let columns = columns.join(", ");
                return Err(format!("has no column {name}, its columns are {columns}"));
            }
        }
        Ok(Self::Csv {
            separator: *separator,
            columns,
            time: time.clone(),
            fields: fields.clone(),
        })
    }
}

fn identity(metadata: &Metadata) -> Identity {
    (metadata.dev(), metadata.ino())
}

pub(super) fn modified_ns(metadata: &Metadata) -> i64 {
    let modified = metadata.modified().ok();
    let since = modified.and_then(|modified| modified.duration_since(UNIX_EPOCH).ok());
    since.map_or(0, |since| {
        i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
    })
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use spandrel_service::Clock;

    use super::*;
    use crate::connect::{Arrivals, Clocks};
    use crate::core_input::FeedInput;
    use crate::source_plan::SourceKind;

    fn append(path: &Path, text: &str) {
        let mut file = File::options()
            .create(true)
            .append(true)
            .open(path)
            .unwrap();
        file.write_all(text.as_bytes()).unwrap();
    }

    #[test]
    fn end_of_a_large_file_is_behind_its_last_complete_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.csv");
        let header = "t,a\n";
        append(&path, header);
        append(&path, &"1,2\n".repeat(READ_BYTES));
        append(&path, &"3".repeat(READ_BYTES + 10));
        let format = LineFormat::Json {
            time: None,
            fields: Vec::new(),
        };
        let mut opened = OpenFile::open(&path, &format).unwrap().unwrap();
        opened.go_to_end().unwrap();
        assert_eq!(opened.position, (header.len() + 4 * READ_BYTES) as u64);
        append(&path, "4\n5\n");
        let mut last = Vec::new();
        while let Some(lines) = opened.read().unwrap() {
            last = lines;
        }
        let [Split::Line(first), Split::Line(second)] = &last[..] else {
            panic!("{} lines", last.len());
        };
        assert!(first.ends_with("34") && second == "5");
    }

    /// Regression test: the folder listed `./Cargo.toml`, which differed from the path of the plan.
    #[test]
    fn file_in_the_working_directory_is_found_by_its_bare_name() {
        let path = PathBuf::from("Cargo.toml");
        let plan = GrowingFile {
            path: path.clone(),
            format: LineFormat::RaspberryShake,
            start: StartAt::Start,
        };
        let follower = Follower::new(plan, None);
        assert_eq!(follower.successors().unwrap(), [path]);
    }

    #[tokio::test]
    async fn missing_file_is_reported_once_and_read_as_soon_as_it_appears() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.json");
        let format = LineFormat::Json {
            time: None,
            fields: vec!["a".to_owned()],
        };
        let plan = GrowingFile {
            path: path.clone(),
            format,
            start: StartAt::End,
        };
        let mut arrivals = Arrivals::default();
        let clocks = Clocks::start(Clock::of_machine());
        let outlet = arrivals.add(0, &SourceKind::File(plan.clone()), clocks);
        let mut tasks = tokio::task::JoinSet::new();
        tasks.spawn(read(plan, None, outlet));
        let mut links = Vec::new();
        loop {
            match arrivals.next(&[]).await.unwrap().input {
                FeedInput::Link { link, .. } => {
                    if matches!(link, Link::Failed { .. }) {
                        append(&path, "{\"a\": 5}\n");
                    }
                    links.push(link);
                }
                FeedInput::Packets { packets, .. } => {
                    assert_eq!(packets[0].values, [5.0]);
                    break;
                }
                other => panic!("{other:?}"),
            }
        }
        let why = format!("{} does not exist", path.display());
        let expected = [Link::Connecting, Link::Failed { why }, Link::Open];
        assert_eq!(links, expected);
    }

    #[test]
    fn files_that_were_renamed_while_the_first_was_read_follow_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.csv");
        let named = |suffix: &str| folder.path().join(format!("log.csv{suffix}"));
        for (age, suffix) in [(4, ".4"), (3, ".3"), (2, ".2"), (1, ".1"), (0, "")] {
            append(&named(suffix), suffix);
            let file = File::options().write(true).open(named(suffix)).unwrap();
            let modified = UNIX_EPOCH + Duration::from_secs(1_700_000_000 - 3600 * age);
            file.set_modified(modified).unwrap();
        }
        let plan = GrowingFile {
            path: path.clone(),
            format: LineFormat::RaspberryShake,
            start: StartAt::Start,
        };
        let mut follower = Follower::new(plan, None);
        let opened_as = identity(&std::fs::metadata(named(".3")).unwrap());
        follower.last = Some((opened_as, path.clone()));
        let next = follower.successors().unwrap();
        assert_eq!(next, [named(".2"), named(".1"), path]);
    }
}
