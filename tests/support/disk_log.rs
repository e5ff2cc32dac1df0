//! What a disk can hold after a power failure.
//!
//! `disk_log.c` logs every change that a process makes below a folder. [`DiskLog`] rebuilds the
//! folder as it may be found after a power failure at any moment of this log.
//!
//! The model promises no more than POSIX, with one exception. A sync keeps the data of a file, or
//! the names in a folder, but not the name of the file or folder itself. Of the changes that no
//! sync covers:
//!
//! - each sector of a write survives or not, whatever its order;
//! - a file can have grown although the data is lost, and then contains zeros;
//! - names survive in the order of their changes within a folder, as in a journal. This is the
//!   exception.

use super::preload::compile_or_skip;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Number of bytes of the head of a record: seven numbers.
const HEAD: usize = 56;
/// Ending of the shared memory of SQLite, which it writes through a mapping and never trusts after
/// a restart.
const SHARED_MEMORY: &str = "-shm";

/// The library that logs, and the folder and files that it uses.
pub struct Disk {
    library: PathBuf,
    folder: PathBuf,
}

impl Disk {
    /// Compiles the library into a folder. Skips the test without a C compiler.
    pub fn or_skip(folder: &Path) -> Option<Self> {
        let folder = folder.canonicalize().unwrap();
        let library = compile_or_skip("disk_log", &folder)?;
        let disk = Self { library, folder };
        std::fs::create_dir(disk.path()).unwrap();
        Some(disk)
    }

    /// Returns the folder whose changes are logged. It is empty at first.
    pub fn path(&self) -> PathBuf {
        self.folder.join("disk")
    }

    fn log(&self) -> PathBuf {
        self.folder.join("changes.log")
    }

    /// Returns the present length of the log: what has happened by now is before it.
    pub fn now(&self) -> usize {
        std::fs::metadata(self.log()).map_or(0, |log| log.len() as usize)
    }

    /// Makes a command log its changes.
    pub fn watch(&self, command: &mut Command) {
        command
            .env("LD_PRELOAD", &self.library)
            .env("DISK_LOG_FOLDER", self.path())
            .env("DISK_LOG_FILE", self.log());
    }

    /// Lets a command find that the machine has started since.
    pub fn restart_machine(&self, command: &mut Command) {
        let boot = self.folder.join("boot_id");
        std::fs::write(&boot, "another-boot\n").unwrap();
        command
            .env("LD_PRELOAD", &self.library)
            .env("DISK_LOG_BOOT", boot);
    }

    /// Reads the log.
    pub fn read(&self) -> DiskLog {
        DiskLog::parse(&std::fs::read(self.log()).unwrap(), &self.path())
    }
}

/// How a change was made.
#[derive(Clone, Debug)]
enum Change {
    Write { at: usize, data: Vec<u8> },
    Length(usize),
}

/// A change of the names in a folder.
#[derive(Clone, Debug)]
enum Naming {
    File { name: String, file: usize },
    Folder { name: String },
    Rename { from: String, to: String },
    Remove { name: String },
}

/// Number of the record in the log, and what it changed.
type Numbered<T> = (usize, T);

/// Something whose changes are numbered as in the log, with its syncs.
#[derive(Debug)]
struct Synced<T> {
    changes: Vec<Numbered<T>>,
    /// The record with which each sync begins and ends.
    syncs: Vec<Range<usize>>,
}

impl<T> Synced<T> {
    fn new() -> Self {
        Self {
            changes: Vec::new(),
            syncs: Vec::new(),
        }
    }

    /// Splits the changes before `moment` into those that a sync covers, and the others.
    fn at(&self, moment: usize) -> (&[Numbered<T>], &[Numbered<T>]) {
        let done = self.syncs.iter().filter(|sync| sync.end < moment);
        let covered = done.map(|sync| sync.start).max().unwrap_or(0);
        let before = |number: usize| self.changes.partition_point(|(at, _)| *at < number);
        self.changes[..before(moment)].split_at(before(covered.min(moment)))
    }
}

/// One record of the log.
#[derive(Clone, Debug)]
pub struct Moment {
    /// Length of the log after the record (bytes).
    pub end: usize,
    /// Time of the record on the clock of the machine (s).
    pub time_s: f64,
    /// Whether it is about names or a sync, not data.
    pub is_order: bool,
    /// What was done, for messages.
    pub what: String,
}

/// All changes of a folder.
#[derive(Debug)]
pub struct DiskLog {
    moments: Vec<Moment>,
    files: Vec<Synced<Change>>,
    folders: BTreeMap<PathBuf, Synced<Naming>>,
    /// Names under which each file was created.
    created_as: Vec<String>,
}

/// How much of the changes that are not synced survives.
#[derive(Clone, Copy, Debug)]
pub struct Luck {
    /// Share of the sectors that survive.
    pub data: f64,
    /// Share of the changes of names that survive.
    pub names: f64,
    /// Whether files keep their length even where the data is lost.
    pub grows: bool,
    /// Bytes that survive together.
    pub sector: usize,
}

impl Luck {
    /// Everything survives, as if the machine had stopped in order.
    pub const ALL: Self = Self {
        data: 1.0,
        names: 1.0,
        grows: true,
        sector: 4096,
    };

    /// Draws any luck. Nothing and everything are as probable as something between.
    pub fn any(random: &mut ChaCha8Rng) -> Self {
        let mut share = || match random.random_range(0..4) {
            0 => 0.0,
            1 => 1.0,
            _ => random.random_range(0.0..1.0),
        };
        let (data, names) = (share(), share());
        Self {
            data,
            names,
            grows: random.random_bool(0.5),
            sector: if random.random_bool(0.5) { 512 } else { 4096 },
        }
    }
}

impl DiskLog {
    fn parse(bytes: &[u8], folder: &Path) -> Self {
        let mut log = Self {
            moments: Vec::new(),
            files: Vec::new(),
            folders: BTreeMap::from([(PathBuf::new(), Synced::new())]),
            created_as: Vec::new(),
        };
        let mut open: BTreeMap<u64, usize> = BTreeMap::new();
        let mut syncing: BTreeMap<u64, (Option<PathBuf>, usize)> = BTreeMap::new();
        let mut at = 0;
        while at < bytes.len() {
            let number = |index: usize| {
                let from = at + 8 * index;
                u64::from_ne_bytes(bytes[from..from + 8].try_into().unwrap())
            };
            let [kind, time_ns, inode, offset] = [0, 1, 2, 3].map(number);
            let mut rest = at + HEAD;
            let mut part = |index: usize| {
                let range = rest..rest + number(index) as usize;
                rest = range.end;
                &bytes[range]
            };
            let [path, to, data] = [4, 5, 6].map(&mut part);
            at = rest;
            let relative = |path: &[u8]| {
                let path = PathBuf::from(String::from_utf8(path.to_vec()).unwrap());
                path.strip_prefix(folder).unwrap_or(&path).to_owned()
            };
            let (path, to, index) = (relative(path), relative(to), log.moments.len());
            let file = |open: &BTreeMap<u64, usize>| {
                *open.get(&inode).unwrap_or_else(|| {
                    panic!("record {index} is about a file that the log does not know")
                })
            };
            let mut what = path.display().to_string();
            match kind {
                1 => {
                    open.insert(inode, log.files.len());
                    let naming = Naming::File {
                        name: name_of(&path),
                        file: log.files.len(),
                    };
                    log.files.push(Synced::new());
                    log.created_as.push(name_of(&path));
                    log.name(&path, index, naming);
                    what.insert_str(0, "create ");
                }
                2 => {
                    let name = name_of(&path);
                    log.name(&path, index, Naming::Folder { name });
                    log.folders.insert(path.clone(), Synced::new());
                    what.insert_str(0, "make folder ");
                }
                3 => {
                    let (at, data) = (offset as usize, data.to_vec());
                    what = format!("write {} bytes at {at}", data.len());
                    let change = Change::Write { at, data };
                    log.files[file(&open)].changes.push((index, change));
                }
                4 => {
                    what = format!("set the length to {offset}");
                    let change = Change::Length(offset as usize);
                    log.files[file(&open)].changes.push((index, change));
                }
                5 => {
                    assert_eq!(path.parent(), to.parent(), "renamed to another folder");
                    let (from, to) = (name_of(&path), name_of(&to));
                    what = format!("rename {what} to {to}");
                    log.name(&path, index, Naming::Rename { from, to });
                }
                6 => {
                    let name = name_of(&path);
                    log.name(&path, index, Naming::Remove { name });
                    what.insert_str(0, "remove ");
                }
                7 => {
                    // Only a folder has a path here, and the watched folder an empty one.
                    let of_folder = number_is_of_folder(&open, inode, &path);
                    what.insert_str(0, "sync ");
                    syncing.insert(offset, (of_folder.then(|| path.clone()), index));
                }
                8 => {
                    let (path, from) = syncing.remove(&offset).unwrap();
                    what = "synced".to_owned();
                    match path {
                        // A folder that existed before has no records.
                        Some(path) => {
                            let folder = log.folders.entry(path).or_insert_with(Synced::new);
                            folder.syncs.push(from..index);
                        }
                        None => log.files[file(&open)].syncs.push(from..index),
                    }
                }
                _ => panic!(
                    "the program uses a call that disk_log.c does not log: {} {}",
                    path.display(),
                    to.display()
                ),
            }
            log.moments.push(Moment {
                end: at,
                time_s: time_ns as f64 * 1e-9,
                is_order: kind != 3,
                what,
            });
        }
        log
    }

    fn name(&mut self, path: &Path, index: usize, naming: Naming) {
        let folder = path.parent().unwrap();
        let folder = self
            .folders
            .get_mut(folder)
            .unwrap_or_else(|| panic!("{} is not in a known folder", path.display()));
        folder.changes.push((index, naming));
    }

    /// Returns the records in order.
    pub fn moments(&self) -> &[Moment] {
        &self.moments
    }

    /// Forgets the syncs of files that were created with this ending, as if the program had none.
    pub fn forget_syncs(&mut self, ending: &str) {
        for (file, name) in self.files.iter_mut().zip(&self.created_as) {
            if name.ends_with(ending) {
                file.syncs.clear();
            }
        }
    }

    /// Writes the folder into `place` as it can be after a power failure just after the first
    /// `moment` records.
    pub fn rebuild(&self, moment: usize, luck: Luck, random: &mut ChaCha8Rng, place: &Path) {
        self.rebuild_folder(Path::new(""), moment, luck, random, place);
    }

    fn rebuild_folder(
        &self,
        folder: &Path,
        moment: usize,
        luck: Luck,
        random: &mut ChaCha8Rng,
        place: &Path,
    ) {
        std::fs::create_dir_all(place.join(folder)).unwrap();
        let (kept, open) = self.folders[folder].at(moment);
        let lucky = (0..open.len()).take_while(|_| random.random_bool(luck.names));
        let lucky = lucky.count();
        let mut names: BTreeMap<&str, Option<usize>> = BTreeMap::new();
        for (_, naming) in kept.iter().chain(&open[..lucky]) {
            match naming {
                Naming::File { name, file } => {
                    names.insert(name, Some(*file));
                }
                Naming::Folder { name } => {
                    names.insert(name, None);
                }
                Naming::Rename { from, to } => {
                    let renamed = names
                        .remove(from.as_str())
                        .expect("a name before its change");
                    names.insert(to, renamed);
                }
                Naming::Remove { name } => {
                    names.remove(name.as_str());
                }
            }
        }
        for (name, file) in names {
            let path = folder.join(name);
            match file {
                Some(file) => {
                    let content = self.content(file, moment, luck, random);
                    std::fs::write(place.join(path), content).unwrap();
                }
                None => self.rebuild_folder(&path, moment, luck, random, place),
            }
        }
    }

    fn content(&self, file: usize, moment: usize, luck: Luck, random: &mut ChaCha8Rng) -> Vec<u8> {
        let (kept, open) = self.files[file].at(moment);
        let mut content = Vec::new();
        for (_, change) in kept {
            change.apply(&mut content);
        }
        let mut whole = content.clone();
        for (_, change) in open {
            change.apply(&mut whole);
            match change {
                Change::Length(_) if random.random_bool(luck.data) => change.apply(&mut content),
                Change::Length(_) => {}
                Change::Write { at, data } => {
                    let mut from = 0;
                    while from < data.len() {
                        let sector_end = (at + from) / luck.sector * luck.sector + luck.sector;
                        let to = data.len().min(sector_end - at);
                        if random.random_bool(luck.data) {
                            write_at(&mut content, at + from, &data[from..to]);
                        }
                        from = to;
                    }
                }
            }
        }
        if luck.grows && content.len() < whole.len() {
            content.resize(whole.len(), 0);
        }
        content
    }
}

impl Change {
    fn apply(&self, content: &mut Vec<u8>) {
        match self {
            Self::Write { at, data } => write_at(content, *at, data),
            Self::Length(length) => content.resize(*length, 0),
        }
    }
}

fn write_at(content: &mut Vec<u8>, at: usize, data: &[u8]) {
    let end = at + data.len();
    if content.len() < end {
        content.resize(end, 0);
    }
    content[at..end].copy_from_slice(data);
}

fn number_is_of_folder(open: &BTreeMap<u64, usize>, inode: u64, path: &Path) -> bool {
    path != Path::new("") || !open.contains_key(&inode)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap().to_str().unwrap().to_owned()
}

/// Compares two folders with all their files. Returns what differs.
pub fn differences(expected: &Path, found: &Path) -> Vec<String> {
    let (expected, found) = (files(expected), files(found));
    let names: BTreeSet<&PathBuf> = expected.keys().chain(found.keys()).collect();
    let differs = |name: &&PathBuf| {
        expected.get(*name) != found.get(*name) && !name.to_str().unwrap().ends_with(SHARED_MEMORY)
    };
    let length = |file: Option<&Option<Vec<u8>>>| match file {
        None => "absent".to_owned(),
        Some(None) => "a folder".to_owned(),
        Some(Some(content)) => format!("{} bytes", content.len()),
    };
    let tell = |name: &PathBuf| {
        let (expected, found) = (length(expected.get(name)), length(found.get(name)));
        format!("{}: {expected}, rebuilt: {found}", name.display())
    };
    names.into_iter().filter(differs).map(tell).collect()
}

/// Returns all files below a folder with their content, and the folders without.
fn files(folder: &Path) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(path) = open.pop() {
        let relative = path.strip_prefix(folder).unwrap().to_owned();
        if path.is_dir() {
            found.insert(relative, None);
            open.extend(
                std::fs::read_dir(path)
                    .unwrap()
                    .map(|entry| entry.unwrap().path()),
            );
        } else {
            found.insert(relative, Some(std::fs::read(path).unwrap()));
        }
    }
    found
}
