//! Folders for recordings and checkpoints, one for each structure.

use crate::error::AppError;
use crate::settings::{NOTHING, default_folder};
use serde::Deserialize;
use spandrel_bus::Keys;
use spandrel_checkpoint::Remembering;
use spandrel_ingest::RecordingSettings;
use spandrel_record::LogSettings;
use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tracing::{debug, info};

/// Folders of a structure.
const RECORDING: &str = "recording";
const CHECKPOINTS: &str = "checkpoints";
const EVENTS: &str = "events";
/// Permissions of a new folder. Only the owner has access.
const FOLDER_MODE: u32 = 0o700;

/// Settings of persistent state.
#[derive(Debug, Clone, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct StateSettings {
    /// Folder of recordings and checkpoints, or [`NOTHING`].
    ///
    /// `None` means the system's folder for persistent state. A path in a configuration file is
    /// relative to that file.
    pub folder: Option<String>,
    /// Interval between two checkpoints (s).
    pub checkpoint_s: Checkpointing,
    /// Settings for recording frames.
    pub recording: RecordedFrames,
    /// Folder of the configuration file.
    #[serde(skip)]
    pub(crate) beside: PathBuf,
}

/// Interval between two checkpoints (s).
#[derive(Debug, Clone, Copy, Deserialize, PartialEq)]
#[serde(try_from = "f64")]
pub struct Checkpointing(f64);

impl Default for Checkpointing {
    fn default() -> Self {
        Self(5.0)
    }
}

impl TryFrom<f64> for Checkpointing {
    type Error = String;

    fn try_from(seconds: f64) -> Result<Self, String> {
        match (0.01..=3600.0).contains(&seconds) {
            true => Ok(Self(seconds)),
            false => Err(format!(
                "checkpoint-s is {seconds}, must lie between 0.01 and 3600 s"
            )),
        }
    }
}

/// Recording and retention of frames.
#[derive(Debug, Clone, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct RecordedFrames {
    /// Retention period of frames (s of measurement time).
    pub keep_s: u64,
    /// Maximum size of the recording of a structure (bytes).
    pub keep_bytes: u64,
    /// Size of a segment (bytes).
    pub segment_bytes: u64,
    /// Duration of a segment (s of measurement time).
    pub segment_s: u64,
    /// Interval at which written data is flushed to disk (s). It is at most half of that between
    /// two checkpoints.
    pub sync_s: f64,
}

impl Default for RecordedFrames {
    fn default() -> Self {
        let LogSettings {
            segment_bytes,
            segment_s,
            keep_bytes,
            keep_s,
        } = LogSettings::default();
        Self {
            keep_s,
            keep_bytes,
            segment_bytes,
            segment_s,
            sync_s: 1.0,
        }
    }
}

/// Folders for the persistent state of one process.
#[derive(Debug, Clone)]
pub struct State {
    folder: PathBuf,
    checkpoint_every: Duration,
    log: LogSettings,
    sync_every: Duration,
}

impl StateSettings {
    /// Returns the folder of the state, or `None` if the state is switched off.
    ///
    /// # Errors
    /// Returns an error if there is no folder for the state.
    pub(crate) fn root(&self) -> Result<Option<PathBuf>, AppError> {
        match self.folder.as_deref() {
            Some(NOTHING) => Ok(None),
            Some(folder) => Ok(Some(self.beside.join(folder))),
            None => default_folder().map(Some),
        }
    }

    /// Returns the folders, or `None` if the state is switched off.
    ///
    /// # Errors
    /// Returns an error if there is no folder for the state, or if a duration is not valid.
    pub fn state(&self) -> Result<Option<State>, AppError> {
        let Some(folder) = self.root()? else {
            return Ok(None);
        };
        let RecordedFrames {
            keep_s,
            keep_bytes,
            segment_bytes,
            segment_s,
            sync_s,
        } = self.recording;
        let sync_every = Duration::try_from_secs_f64(sync_s)
            .map_err(|_| AppError::SyncTime { found: sync_s })?;
        let checkpoint_every = Duration::from_secs_f64(self.checkpoint_s.0);
        Ok(Some(State {
            folder,
            checkpoint_every,
            log: LogSettings {
                segment_bytes,
                segment_s,
                keep_bytes,
                keep_s,
            },
            // A service resumes from a checkpoint that is at least one interval old. The frames
            // before it must not get lost in a power failure.
            sync_every: sync_every.min(checkpoint_every / 2),
        }))
    }
}

impl State {
    /// Returns the settings for recording the frames of a structure.
    pub fn recording(&self, keys: &Keys) -> RecordingSettings {
        RecordingSettings {
            folder: self.of(keys).join(RECORDING),
            log: self.log,
            sync_every: self.sync_every,
        }
    }

    /// Returns the settings for the checkpoints of a structure's services.
    pub fn remembering(&self, keys: &Keys) -> Remembering {
        Remembering {
            folder: self.of(keys).join(CHECKPOINTS),
            every: self.checkpoint_every,
        }
    }

    /// Returns the folder of a structure's recordings and reports of earthquakes.
    pub fn events(&self, keys: &Keys) -> PathBuf {
        self.of(keys).join(EVENTS)
    }

    /// Creates the folders of a structure again if they are missing and the state folder exists.
    ///
    /// A missing state folder may return, for example with its disk. It is therefore never created
    /// here.
    pub fn restore_folders(&self, keys: &Keys) {
        let of_structure = self.of(keys);
        for name in [RECORDING, CHECKPOINTS] {
            let folder = of_structure.join(name);
            if self.folder.is_dir() && !folder.is_dir() {
                let mut builder = DirBuilder::new();
                let created = builder.recursive(true).mode(FOLDER_MODE).create(&folder);
                match created {
                    Ok(()) => info!(folder = %folder.display(), "created the folder again"),
                    // The services that need the folder report that they cannot write.
                    Err(error) => debug!(folder = %folder.display(), %error, "no folder"),
                }
            }
        }
    }

    fn of(&self, keys: &Keys) -> PathBuf {
        let (root, structure): (&Path, &Path) = (
            keys.root().as_str().as_ref(),
            keys.structure().as_str().as_ref(),
        );
        self.folder.join(root).join(structure)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_structure_has_a_folder_below_its_bus_root() {
        let settings = StateSettings {
            folder: Some("kept".into()),
            beside: "/etc/spandrel".into(),
            ..Default::default()
        };
        let state = settings.state().unwrap().unwrap();
        let keys = Keys::parse("city", "bridge").unwrap();
        assert_eq!(
            state.recording(&keys).folder,
            Path::new("/etc/spandrel/kept/city/bridge/recording")
        );
        assert_eq!(
            state.remembering(&keys).folder,
            Path::new("/etc/spandrel/kept/city/bridge/checkpoints")
        );
        let none = StateSettings {
            folder: Some("none".into()),
            ..Default::default()
        };
        assert!(none.state().unwrap().is_none());
    }

    #[test]
    fn folders_of_a_structure_are_created_again_and_the_state_folder_is_not() {
        let beside = tempfile::tempdir().unwrap();
        let settings = StateSettings {
            folder: Some("kept".into()),
            beside: beside.path().to_owned(),
            ..Default::default()
        };
        let state = settings.state().unwrap().unwrap();
        let keys = Keys::parse("city", "bridge").unwrap();
        state.restore_folders(&keys);
        assert!(!beside.path().join("kept").exists());
        std::fs::create_dir(beside.path().join("kept")).unwrap();
        state.restore_folders(&keys);
        assert!(state.recording(&keys).folder.is_dir());
        assert!(state.remembering(&keys).folder.is_dir());
    }

    #[test]
    fn frames_are_flushed_before_the_checkpoint_from_which_a_service_resumes() {
        let sync_s_with = |text: &str| {
            let mut settings: StateSettings = toml::from_str(text).unwrap();
            settings.folder = Some("kept".into());
            let state = settings.state().unwrap().unwrap();
            let keys = Keys::parse("city", "bridge").unwrap();
            state.recording(&keys).sync_every.as_secs_f64()
        };
        assert_eq!(sync_s_with(""), 1.0);
        assert_eq!(sync_s_with("checkpoint-s = 0.5"), 0.25);
        assert_eq!(sync_s_with("recording.sync-s = 60"), 2.5);
        assert_eq!(sync_s_with("checkpoint-s = 1\nrecording.sync-s = 0.1"), 0.1);
    }

    #[test]
    fn invalid_times_are_rejected() {
        let read = |text: &str| toml::from_str::<StateSettings>(text);
        assert_eq!(
            read("checkpoint-s = 2").unwrap().checkpoint_s,
            Checkpointing(2.0)
        );
        for seconds in ["0", "-1", "nan", "1e9"] {
            let error = read(&format!("checkpoint-s = {seconds}"))
                .unwrap_err()
                .to_string();
            assert!(error.contains("0.01 and 3600"), "{error}");
        }
        let endless = StateSettings {
            folder: Some("kept".into()),
            recording: RecordedFrames {
                sync_s: -1.0,
                ..Default::default()
            },
            ..Default::default()
        };
        assert!(endless.state().unwrap_err().report().contains("sync-s"));
    }
}
