//! The checkpoints of one service and structure: one file per stream position.

use crate::envelope::Identity;
use crate::error::{CheckpointError, Refusal};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::fmt::Display;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _, fchown};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tracing::{info, warn};

/// Extension of checkpoint files.
const ENDING: &str = "checkpoint";
/// Extension that is appended to a rejected file.
const SET_ASIDE: &str = "refused";
/// Maximum size of a file that is read, in bytes. A state with a thousand entries takes 8 MB.
const MAX_BYTES: u64 = 1 << 30;
/// Maximum number of files kept, so that a permanently absent reader cannot fill the disk.
const MOST_KEPT: usize = 64;

/// Permissions of a new folder and of a checkpoint. Only the owner has access.
const FOLDER_MODE: u32 = 0o700;
const FILE_MODE: u32 = 0o600;

/// A position in a numbered stream, such as the first item that is not part of the state. A later
/// epoch is after all positions of an earlier one.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Position {
    /// Epoch of the stream.
    pub epoch: u64,
    /// Sequence number of the item within the epoch.
    pub sequence: u64,
}

/// Folder and interval of the checkpoints of a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Remembering {
    /// Folder of the checkpoints of one structure.
    pub folder: PathBuf,
    /// Time between two checkpoints: the maximum work to repeat after a crash.
    pub every: Duration,
}

/// The checkpoints of one service and structure in a folder.
#[derive(Debug, Clone)]
pub struct Checkpoints {
    folder: PathBuf,
    identity: Identity,
}

/// The result of loading a checkpoint.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded<T> {
    /// The restored state with its position in the stream. `None` if there is no usable checkpoint.
    pub found: Option<(Position, T)>,
    /// Rejected files, each with its path after it was renamed and the reason for the rejection.
    pub refused: Vec<(PathBuf, Refusal)>,
}

impl Checkpoints {
    /// Opens a folder of checkpoints and creates it if it does not exist.
    ///
    /// A folder on a read-only disk, or without permission, may become writable later. Monitoring
    /// does not wait for that: the checkpoints are then empty.
    ///
    /// # Errors
    /// Returns an error if the folder cannot be created or read for another reason.
    pub fn open(folder: &Path, identity: Identity) -> Result<Self, CheckpointError> {
        let checkpoints = Self {
            folder: folder.to_owned(),
            identity,
        };
        match create_folder(folder) {
            Ok(()) => {}
            Err(error) if may_become_writable(&error) => {
                warn!(folder = %folder.display(), %error, "the folder of the checkpoints cannot be \
                    used; a crash now would lose more results");
                return Ok(checkpoints);
            }
            Err(reason) => {
                return Err(CheckpointError::Io {
                    what: "create the folder",
                    path: folder.to_owned(),
                    reason,
                });
            }
        }
        // An unreadable folder must be reported at the start.
        if checkpoints.positions()?.is_empty() {
            sync_name(folder);
        }
        Ok(checkpoints)
    }

    /// Returns `true` if the folder exists at its path. Otherwise it was moved or deleted, or its
    /// disk is not mounted.
    #[must_use]
    pub fn has_folder(&self) -> bool {
        self.folder.is_dir()
    }

    /// Saves a state. On return, the state is synced to disk.
    ///
    /// A missing folder is created if one of the two folders above it exists. If both are missing,
    /// the disk with the state is probably not mounted, and a new folder would hide that.
    ///
    /// # Errors
    /// Returns an error if the disk is full, or if the file system reports another error. Earlier
    /// checkpoints remain intact.
    pub fn save<T: Serialize>(&self, position: Position, state: &T) -> Result<(), CheckpointError> {
        let bytes = self.identity.seal(state)?;
        let mut above = self.folder.ancestors().skip(1).take(2);
        if !self.has_folder() && above.any(Path::is_dir) {
            // If this fails, the write below reports the reason.
            let _ = create_folder(&self.folder);
            sync_name(&self.folder);
        }
        let path = self.path(position);
        let beside = path.with_extension("new");
        let written = write_whole(&beside, &path, &bytes, &self.folder);
        if written.is_err() {
            // The incomplete file may occupy the last free space.
            let _ = fs::remove_file(&beside);
        }
        written
    }

    /// Renames the checkpoint at `position`, whose content is invalid although its file is intact,
    /// so that it is not read again. Returns the path of the file and the reason `why`.
    pub fn refuse(&self, position: Position, why: String) -> (PathBuf, Refusal) {
        let why = Refusal::Content(why);
        (set_aside(&self.path(position), &why), why)
    }

    /// Returns the newest usable state. Unusable files are renamed.
    #[must_use]
    pub fn load_latest<T: DeserializeOwned>(&self) -> Loaded<T> {
        self.load(
            self.positions().unwrap_or_default().into_iter().rev(),
            |bytes| self.identity.open(bytes),
        )
    }

    /// Returns the newest usable state, and converts it if its layout has version `former`.
    ///
    /// `F` is the state as laid out in version `former`. Otherwise this function works like
    /// [`Checkpoints::load_latest`].
    #[must_use]
    pub fn load_latest_or_former<T, F>(&self, former: u16) -> Loaded<T>
    where
        T: DeserializeOwned,
        F: DeserializeOwned + Into<T>,
    {
        let open = |bytes: &[u8]| match self.identity.open(bytes) {
            Err(Refusal::Version { found, .. }) if found == former => {
                self.convert::<T, F>(bytes, former)
            }
            opened => opened,
        };
        self.load(self.positions().unwrap_or_default().into_iter().rev(), open)
    }

    /// Works like [`Checkpoints::load_latest_or_former`] for two former layouts: `F` of version
    /// `formers[0]`, and `G` of version `formers[1]`.
    #[must_use]
    pub fn load_latest_or_formers<T, F, G>(&self, formers: [u16; 2]) -> Loaded<T>
    where
        T: DeserializeOwned,
        F: DeserializeOwned + Into<T>,
        G: DeserializeOwned + Into<T>,
    {
        let [newer, older] = formers;
        let open = |bytes: &[u8]| match self.identity.open(bytes) {
            Err(Refusal::Version { found, .. }) if found == newer => {
                self.convert::<T, F>(bytes, newer)
            }
            Err(Refusal::Version { found, .. }) if found == older => {
                self.convert::<T, G>(bytes, older)
            }
            opened => opened,
        };
        self.load(self.positions().unwrap_or_default().into_iter().rev(), open)
    }

    fn convert<T, F>(&self, bytes: &[u8], former: u16) -> Result<T, Refusal>
    where
        F: DeserializeOwned + Into<T>,
    {
        let identity = Identity {
            version: former,
            ..self.identity.clone()
        };
        let state = identity.open::<F>(bytes)?;
        info!(
            kind = identity.kind,
            of = identity.of,
            version = former,
            "converted a checkpoint of an earlier layout"
        );
        Ok(state.into())
    }

    /// Passes usable states to `restore`, newest first, until it accepts one. Returns the position
    /// of this state and the result of `restore`, or `None` if it accepts no state.
    ///
    /// A file that is unusable, or whose state `restore` rejects, is renamed and logged.
    pub fn recall<T: DeserializeOwned, R, E: Display>(
        &self,
        mut restore: impl FnMut(T) -> Result<R, E>,
    ) -> Option<(Position, R)> {
        self.positions()
            .unwrap_or_default()
            .into_iter()
            .rev()
            .find_map(|position| {
                let path = self.path(position);
                let state = read(&path).and_then(|bytes| self.identity.open(&bytes));
                let restored = state.and_then(|state| {
                    restore(state).map_err(|why| Refusal::Content(why.to_string()))
                });
                restored
                    .map_err(|why| set_aside(&path, &why))
                    .ok()
                    .map(|restored| (position, restored))
            })
    }

    /// Returns the oldest usable state. Unusable files are renamed.
    #[must_use]
    pub fn load_oldest<T: DeserializeOwned>(&self) -> Loaded<T> {
        self.load(self.positions().unwrap_or_default().into_iter(), |bytes| {
            self.identity.open(bytes)
        })
    }

    /// Removes the checkpoints that are no longer required.
    ///
    /// Keeps the last two checkpoints, the newest one at or before `needed`, and all later ones,
    /// but at most `MOST_KEPT` files. With `None`, earlier ones are not needed, and only the last
    /// two are kept.
    ///
    /// # Errors
    /// Returns an error if a file cannot be removed.
    pub fn forget_before(&self, needed: Option<Position>) -> Result<(), CheckpointError> {
        let positions = self.positions()?;
        let last_two = positions.len().saturating_sub(2);
        let base = match needed {
            Some(needed) => positions
                .partition_point(|position| *position <= needed)
                .saturating_sub(1),
            None => last_two,
        };
        let first = base
            .min(last_two)
            .max(positions.len().saturating_sub(MOST_KEPT));
        for position in &positions[..first] {
            let path = self.path(*position);
            match fs::remove_file(&path) {
                // A user has already deleted the file.
                Err(source) if source.kind() == io::ErrorKind::NotFound => {}
                removed => removed.map_err(|reason| CheckpointError::Io {
                    what: "remove",
                    path,
                    reason,
                })?,
            }
        }
        Ok(())
    }

    /// Returns the positions of the existing files in ascending order.
    ///
    /// # Errors
    /// Returns an error if the folder cannot be read.
    pub fn positions(&self) -> Result<Vec<Position>, CheckpointError> {
        let failed = |reason| CheckpointError::Io {
            what: "read",
            path: self.folder.clone(),
            reason,
        };
        let mut positions = Vec::new();
        for entry in fs::read_dir(&self.folder).map_err(failed)? {
            let name = entry.map_err(failed)?.file_name();
            positions.extend(name.to_str().and_then(|name| self.position(name)));
        }
        positions.sort_unstable();
        Ok(positions)
    }

    fn load<T>(
        &self,
        positions: impl Iterator<Item = Position>,
        open: impl Fn(&[u8]) -> Result<T, Refusal>,
    ) -> Loaded<T> {
        let mut refused = Vec::new();
        for position in positions {
            let path = self.path(position);
            match read(&path).and_then(|bytes| open(&bytes)) {
                Ok(state) => {
                    return Loaded {
                        found: Some((position, state)),
                        refused,
                    };
                }
                Err(why) => refused.push((set_aside(&path, &why), why)),
            }
        }
        Loaded {
            found: None,
            refused,
        }
    }

    fn path(&self, position: Position) -> PathBuf {
        let Position { epoch, sequence } = position;
        self.folder.join(format!(
            "{}-{epoch:020}-{sequence:020}.{ENDING}",
            self.identity.kind
        ))
    }

    fn position(&self, name: &str) -> Option<Position> {
        let stem = name.strip_suffix(ENDING)?.strip_suffix('.')?;
        let numbers = stem.strip_prefix(self.identity.kind)?.strip_prefix('-')?;
        let (epoch, sequence) = numbers.split_once('-')?;
        Some(Position {
            epoch: epoch.parse().ok()?,
            sequence: sequence.parse().ok()?,
        })
    }
}

/// Returns `true` if `error` means that the file system is read-only or that permission is missing.
///
/// A folder with such an error can become writable while the program runs, so a later attempt is
/// useful.
#[must_use]
pub fn may_become_writable(error: &io::Error) -> bool {
    let kinds = [
        io::ErrorKind::ReadOnlyFilesystem,
        io::ErrorKind::PermissionDenied,
    ];
    kinds.contains(&error.kind())
}

fn create_folder(folder: &Path) -> io::Result<()> {
    DirBuilder::new()
        .recursive(true)
        .mode(FOLDER_MODE)
        .create(folder)
}

/// Syncs the name of a file or folder to disk, and the names of the folders above it.
///
/// After a power failure, a synced file can be found only if these names have also been synced.
/// Folders that cannot be opened are omitted.
pub fn sync_name(path: &Path) {
    for folder in path.ancestors().skip(1) {
        let folder = match folder.as_os_str().is_empty() {
            true => Path::new("."),
            false => folder,
        };
        let _ = File::open(folder).and_then(|folder| folder.sync_all());
    }
}

/// Writes a file for its owner alone, and renames it over an existing one. On return, the new file
/// is on disk. A failure, also of the power, leaves the old file or the new one.
///
/// # Errors
/// Returns an error if the file cannot be written or renamed. An existing file is then unchanged.
pub fn replace_private_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut name = path.as_os_str().to_owned();
    name.push(".new");
    let beside = PathBuf::from(name);
    // A file that a failure left behind would keep its permissions.
    if let Err(error) = fs::remove_file(&beside)
        && error.kind() != io::ErrorKind::NotFound
    {
        return Err(error);
    }
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(FILE_MODE);
    let mut file = options.open(&beside)?;
    file.write_all(bytes)?;
    if let Ok(old) = fs::metadata(path) {
        // A service under another user must still read its key. Only root may do this.
        let _ = fchown(&file, Some(old.uid()), Some(old.gid()));
    }
    file.sync_all()?;
    fs::rename(&beside, path)?;
    sync_name(path);
    Ok(())
}

fn write_whole(
    beside: &Path,
    path: &Path,
    bytes: &[u8],
    folder: &Path,
) -> Result<(), CheckpointError> {
    let failed = |what| {
        move |reason| CheckpointError::Io {
            what,
            path: beside.to_owned(),
            reason,
        }
    };
    let created = OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(FILE_MODE)
        .open(beside);
    let mut file = created.map_err(failed("create"))?;
    file.write_all(bytes).map_err(failed("write"))?;
    file.sync_all().map_err(failed("synchronise to disk"))?;
    fs::rename(beside, path).map_err(failed("rename"))?;
    let forced = File::open(folder).and_then(|folder| folder.sync_all());
    forced.map_err(|reason| CheckpointError::Io {
        what: "synchronise to disk",
        path: folder.to_owned(),
        reason,
    })
}

fn read(path: &Path) -> Result<Vec<u8>, Refusal> {
    let unreadable = |error: io::Error| Refusal::Unreadable(error.to_string());
    let length = fs::metadata(path).map_err(unreadable)?.len();
    if length > MAX_BYTES {
        return Err(Refusal::Unreadable(format!(
            "{length} bytes, a state has at most {MAX_BYTES}"
        )));
    }
    fs::read(path).map_err(unreadable)
}

/// Renames a file, so that it is neither read again nor lost. Returns its new path.
fn set_aside(path: &Path, why: &Refusal) -> PathBuf {
    let aside = path.with_extension(format!("{ENDING}.{SET_ASIDE}"));
    match fs::rename(path, &aside) {
        Ok(()) => {
            warn!(file = %path.display(), renamed = %aside.display(), %why, "checkpoint rejected");
            aside
        }
        Err(error) => {
            warn!(file = %path.display(), %why, %error, "checkpoint rejected, and it cannot be \
                renamed");
            path.to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt as _;

    fn checkpoints(folder: &Path) -> Checkpoints {
        let identity = Identity {
            kind: "identify",
            version: 1,
            of: "tower".into(),
            basis: "text".into(),
        };
        Checkpoints::open(folder, identity).unwrap()
    }

    fn at(epoch: u64, sequence: u64) -> Position {
        Position { epoch, sequence }
    }

    #[test]
    fn private_file_is_replaced_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("main.key");
        replace_private_file(&path, b"first").unwrap();
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let beside = folder.path().join("main.key.new");
        fs::create_dir(&beside).unwrap();
        replace_private_file(&path, b"second").unwrap_err();
        assert_eq!(fs::read(&path).unwrap(), b"first");
        fs::remove_dir(&beside).unwrap();
        // A failure left this file behind, readable for others.
        fs::write(&beside, "half").unwrap();
        fs::set_permissions(&beside, fs::Permissions::from_mode(0o644)).unwrap();
        replace_private_file(&path, b"second").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        assert!(!beside.exists());
    }

    #[test]
    fn newest_and_oldest_checkpoint_are_found_by_epoch_and_number() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = checkpoints(&folder.path().join("not/yet/there"));
        assert_eq!(
            checkpoints.load_latest::<u64>(),
            Loaded {
                found: None,
                refused: vec![]
            }
        );
        for position in [at(2, 5), at(1, 900), at(2, 40)] {
            checkpoints.save(position, &position.sequence).unwrap();
        }
        assert_eq!(
            checkpoints.load_latest::<u64>().found,
            Some((at(2, 40), 40))
        );
        assert_eq!(
            checkpoints.load_oldest::<u64>().found,
            Some((at(1, 900), 900))
        );
    }

    #[test]
    fn state_of_a_former_version_is_converted_and_of_other_versions_set_aside() {
        /// Version 2 stored the count in tens.
        #[derive(serde::Deserialize)]
        struct Tens(u8);
        impl From<Tens> for u64 {
            fn from(Tens(tens): Tens) -> Self {
                10 * Self::from(tens)
            }
        }
        let folder = tempfile::tempdir().unwrap();
        let of_version = |version| Checkpoints {
            identity: Identity {
                version,
                ..checkpoints(folder.path()).identity
            },
            ..checkpoints(folder.path())
        };
        of_version(2).save(at(1, 1), &7_u8).unwrap();
        of_version(1).save(at(1, 2), &7_u8).unwrap();
        of_version(4).save(at(1, 3), &7_u8).unwrap();
        let loaded = of_version(3).load_latest_or_former::<u64, Tens>(2);
        assert_eq!(loaded.found, Some((at(1, 1), 70)));
        let refused: Vec<_> = loaded.refused.into_iter().map(|(_, why)| why).collect();
        assert_eq!(
            refused,
            [4, 1].map(|found| Refusal::Version { found, expected: 3 })
        );
        of_version(3).save(at(1, 4), &7_u64).unwrap();
        assert_eq!(
            of_version(3).load_latest_or_former::<u64, Tens>(2).found,
            Some((at(1, 4), 7))
        );
    }

    #[test]
    fn needed_checkpoints_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = checkpoints(folder.path());
        let kept = |needed: Option<Position>| {
            for sequence in [10, 20, 30, 40, 50] {
                checkpoints.save(at(1, sequence), &sequence).unwrap();
            }
            checkpoints.forget_before(needed).unwrap();
            checkpoints
                .positions()
                .unwrap()
                .iter()
                .map(|position| position.sequence)
                .collect::<Vec<_>>()
        };
        assert_eq!(kept(Some(at(1, 25))), [20, 30, 40, 50]);
        assert_eq!(kept(Some(at(1, 30))), [30, 40, 50]);
        assert_eq!(kept(Some(at(1, 5))), [10, 20, 30, 40, 50]);
        assert_eq!(kept(Some(at(0, 500))), [10, 20, 30, 40, 50]);
        assert_eq!(kept(Some(at(2, 0))), [40, 50]);
        assert_eq!(kept(None), [40, 50]);
    }

    #[test]
    fn number_of_needed_checkpoints_is_bounded() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = checkpoints(folder.path());
        for sequence in 0..70 {
            checkpoints.save(at(1, sequence), &sequence).unwrap();
        }
        checkpoints.forget_before(Some(at(1, 0))).unwrap();
        assert_eq!(checkpoints.positions().unwrap().len(), MOST_KEPT);
    }

    #[test]
    fn damaged_file_is_set_aside_and_the_previous_file_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = checkpoints(folder.path());
        checkpoints.save(at(1, 1), &1_u64).unwrap();
        checkpoints.save(at(1, 2), &2_u64).unwrap();
        let newest = checkpoints.path(at(1, 2));
        let bytes = fs::read(&newest).unwrap();
        fs::write(&newest, &bytes[..bytes.len() - 1]).unwrap();
        let loaded = checkpoints.load_latest::<u64>();
        assert_eq!(loaded.found, Some((at(1, 1), 1)));
        let [(aside, Refusal::Damaged)] = &loaded.refused[..] else {
            panic!("{:?}", loaded.refused)
        };
        assert!(aside.is_file() && !newest.exists());
        assert_eq!(checkpoints.load_latest::<u64>().refused, []);
    }

    #[test]
    fn rejected_state_is_set_aside_and_the_previous_state_is_used() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = checkpoints(folder.path());
        for sequence in [1, 2, 3] {
            checkpoints.save(at(1, sequence), &sequence).unwrap();
        }
        fs::write(checkpoints.path(at(1, 3)), "no checkpoint").unwrap();
        let odd = |state: u64| {
            if state % 2 == 1 {
                Ok(10 * state)
            } else {
                Err("it is even")
            }
        };
        assert_eq!(checkpoints.recall(odd), Some((at(1, 1), 10)));
        assert_eq!(checkpoints.positions().unwrap(), [at(1, 1)]);
        for sequence in [2, 3] {
            let aside = checkpoints
                .path(at(1, sequence))
                .with_extension(format!("{ENDING}.{SET_ASIDE}"));
            assert!(aside.is_file(), "{}", aside.display());
        }
        assert_eq!(checkpoints.recall(|_: u64| Err::<(), _>("never")), None);
    }

    // The product of matrix dimensions may overflow, and the panic must not terminate the service.
    #[test]
    fn state_is_set_aside_if_its_decoding_panics() {
        #[derive(Debug, PartialEq)]
        struct Sized(u64);
        impl<'de> Deserialize<'de> for Sized {
            fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
                let size = u64::deserialize(from)?;
                Ok(Self(size.checked_mul(size).expect("a size")))
            }
        }
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = checkpoints(folder.path());
        checkpoints.save(at(1, 1), &3_u64).unwrap();
        checkpoints.save(at(1, 2), &u64::MAX).unwrap();
        let loaded = checkpoints.load_latest::<Sized>();
        assert_eq!(loaded.found, Some((at(1, 1), Sized(9))));
        assert!(
            matches!(&loaded.refused[..], [(_, Refusal::Content(_))]),
            "{:?}",
            loaded.refused
        );
        assert_eq!(checkpoints.positions().unwrap(), [at(1, 1)]);
    }

    #[test]
    fn foreign_and_incomplete_files_are_ignored() {
        let folder = tempfile::tempdir().unwrap();
        for name in [
            "identify-1.checkpoint",
            "identify-a-b.checkpoint",
            "alert-1-1.checkpoint",
            "identify-1-1.new",
        ] {
            fs::write(folder.path().join(name), "x").unwrap();
        }
        let loaded = checkpoints(folder.path()).load_latest::<u64>();
        assert_eq!((loaded.found, loaded.refused.len()), (None, 0));
    }

    #[test]
    fn error_names_a_folder_that_cannot_be_created() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        let identity = Identity {
            kind: "identify",
            version: 1,
            of: "tower".into(),
            basis: String::new(),
        };
        let error = Checkpoints::open(&file.join("below"), identity)
            .unwrap_err()
            .to_string();
        assert!(error.contains("file/below"), "{error}");
    }
}
