//! Writes every frame to disk before it is published.

use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use spandrel_bus::{Archive, Block as _, FrameBlock, Header, StreamState};
use spandrel_checkpoint::{may_become_writable, moment_within};
use spandrel_record::{
    FrameLog, FrameLogReader, LogLayout, LogSettings, LogSyncer, LoggedFrames, NodePosition,
    OpenedLog, RecordError,
};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tracing::{error, info, warn};

use crate::align::NodePlace;
use crate::disk::DiskThread;
use crate::error::IngestError;
use crate::layout::Layout;
use crate::unrecorded::UnrecordedFrames;

/// Pause before a failed write is retried.
const RETRY: Duration = Duration::from_millis(500);

/// Interval between checks that the files of the recording are at their paths.
const CHECK_EVERY: Duration = Duration::from_secs(1);

/// Settings for recording frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordingSettings {
    /// Folder for the segments of this structure.
    pub folder: PathBuf,
    /// Size and retention of segments.
    pub log: LogSettings,
    /// Interval at which written frames are synced to disk: the maximum loss in a power failure. A
    /// killed process loses no frames.
    pub sync_every: Duration,
}

/// The end of the recording of an earlier run.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Past {
    /// The last frames.
    pub(crate) last: FrameBlock,
    /// The positions in the streams of the nodes at that time.
    pub(crate) nodes: Vec<NodePlace>,
    /// Whether all published frames are recorded. If so, numbering continues in the same epoch.
    pub(crate) is_whole: bool,
}

impl Past {
    /// Returns the time of the last frame (ns since the Unix epoch, UTC).
    pub(crate) fn last_time_ns(&self) -> Option<i64> {
        let number = self.last.end().checked_sub(1)?;
        Some(self.last.grid()?.time_ns(number))
    }
}

/// The reader of the recording, or `None` before the recording could be opened.
type SharedReader = Arc<RwLock<Option<FrameLogReader>>>;

/// A change of the folder of the recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FolderChange {
    /// The folder or its files are gone, or the folder cannot be written at the start.
    Lost,
    /// The recording continues in the folder.
    Back,
}

/// The recording of one structure.
#[derive(Debug)]
pub(crate) struct Recorder {
    structure: String,
    of: LogLayout,
    settings: RecordingSettings,
    disk: DiskThread,
    /// `None` while the folder is lost or cannot be written.
    log: Option<FrameLog>,
    reader: SharedReader,
    /// Whether the folder is back, but no frame has been written to it.
    is_back: bool,
    /// The last epoch in the recording when it was opened again, 0 before. Frames of lower epochs
    /// cannot be appended.
    recorded_epoch: u64,
    /// Changes that are not yet reported.
    changes: Vec<FolderChange>,
    checked: Instant,
    waiting: UnrecordedFrames,
    /// The completeness mark on disk: whether all published frames are recorded. `None` if there is
    /// no mark.
    is_noted_complete: Option<bool>,
    refused_at: Option<Instant>,
    /// The cause of the last failure, as logged.
    failure: String,
    sync_every: Duration,
    synced: Instant,
    syncing: Option<JoinHandle<Result<(), RecordError>>>,
}

impl Recorder {
    /// Opens the recording, and returns where it ended.
    ///
    /// If the folder cannot be written, frames wait in memory until it can.
    pub(crate) fn open(
        structure: &str,
        layout: &Layout,
        channels: Vec<String>,
        settings: &RecordingSettings,
    ) -> Result<(Self, Option<Past>), IngestError> {
        let of = LogLayout {
            structure: structure.to_owned(),
            channels,
            nodes: layout
                .nodes()
                .iter()
                .map(|node| node.name.to_string())
                .collect(),
            sampling_rate_hz: layout.sampling_rate_hz(),
        };
        let mut failure = String::new();
        let opened = match FrameLog::open(&settings.folder, of.clone(), settings.log) {
            Ok(opened) => Some(opened),
            Err(error) if may_be_opened_later(&error) => {
                failure = with_cause(&error);
                warn!(structure, %error, "the recording cannot be opened; frames stay in memory \
                                          and monitoring continues");
                None
            }
            Err(error) => return Err(error.into()),
        };
        let (log, opened) = opened.unzip();
        if let Some(opened) = &opened {
            log_repairs(structure, opened);
        }
        let is_noted_complete = opened.as_ref().and_then(|opened| opened.is_complete);
        let past = opened.and_then(|opened| {
            let is_whole =
                opened.is_complete != Some(false) && (opened.was_closed || opened.same_boot);
            opened.last.map(|last| Past {
                nodes: places(&last),
                last: to_block(last),
                is_whole,
            })
        });
        let recorder = Self {
            structure: structure.to_owned(),
            of,
            disk: DiskThread::start().map_err(IngestError::NoThread)?,
            reader: Arc::new(RwLock::new(log.as_ref().map(FrameLog::reader))),
            changes: if log.is_some() {
                Vec::new()
            } else {
                vec![FolderChange::Lost]
            },
            refused_at: log.is_none().then(Instant::now),
            failure,
            is_back: false,
            recorded_epoch: 0,
            log,
            checked: Instant::now(),
            waiting: UnrecordedFrames::default(),
            is_noted_complete,
            sync_every: settings.sync_every,
            synced: moment_within(settings.sync_every),
            syncing: None,
            settings: settings.clone(),
        };
        Ok((recorder, past))
    }

    /// Returns an archive that serves frames older than those in memory.
    pub(crate) fn archive(&self) -> RecordedFrames {
        RecordedFrames {
            reader: self.reader.clone(),
        }
    }

    /// Writes blocks on the disk thread, and returns the recorder and the blocks.
    ///
    /// The blocks may be published after this call, even if the write failed. In that case, they
    /// wait in memory until the disk accepts them.
    ///
    /// # Errors
    /// Returns an error if the thread has panicked.
    pub(crate) async fn record(
        mut self: Box<Self>,
        blocks: Vec<FrameBlock>,
        places: Vec<NodePlace>,
    ) -> Result<(Box<Self>, Vec<FrameBlock>), IngestError> {
        let (disk, structure) = (self.disk.clone(), self.structure.clone());
        let work = disk.run(move || {
            self.write(&blocks, &places);
            (self, blocks)
        });
        work.await.ok_or(IngestError::RecordingLost { structure })
    }

    fn write(&mut self, blocks: &[FrameBlock], places: &[NodePlace]) {
        self.check_folder();
        let last = blocks.len().saturating_sub(1);
        for (number, block) in blocks.iter().enumerate() {
            let nodes = if number == last { places } else { &[] };
            self.waiting.push(to_logged(block, nodes));
        }
        self.waiting.drop_before(self.recorded_epoch);
        if self
            .refused_at
            .is_none_or(|refused| refused.elapsed() >= RETRY)
        {
            self.write_waiting();
        }
        self.waiting.drop_excess();
    }

    /// Returns the last epoch in the recording when it was opened again, 0 before. If it is later
    /// than the present epoch, a new run must begin after it.
    pub(crate) fn recorded_epoch(&self) -> u64 {
        self.recorded_epoch
    }

    /// Returns `true` if no frames wait for the disk.
    pub(crate) fn has_written_all(&self) -> bool {
        self.waiting.frames() == 0
    }

    /// Returns the changes of the folder since the last call.
    pub(crate) fn take_changes(&mut self) -> Vec<FolderChange> {
        std::mem::take(&mut self.changes)
    }

    /// Checks the folder, retries failed writes and syncs written frames to disk, each when due.
    pub(crate) async fn tend(&mut self) {
        let is_due = |refused: Instant| refused.elapsed() >= RETRY;
        if self.checked.elapsed() >= CHECK_EVERY || self.refused_at.is_some_and(is_due) {
            tokio::task::block_in_place(|| {
                self.check_folder();
                if self.refused_at.is_some_and(is_due) {
                    self.write_waiting();
                }
            });
        }
        if self.synced.elapsed() < self.sync_every
            || self
                .syncing
                .as_ref()
                .is_some_and(|syncing| !syncing.is_finished())
        {
            return;
        }
        self.report_sync().await;
        self.synced = Instant::now();
        let Some(log) = &self.log else {
            return;
        };
        let syncer: LogSyncer = log.syncer();
        self.syncing = Some(tokio::task::spawn_blocking(move || syncer.sync()));
    }

    /// Stops writing if the files of the recording are no longer at their paths.
    ///
    /// Frames written since then are in files without a path, and may be lost.
    fn check_folder(&mut self) {
        if self.checked.elapsed() < CHECK_EVERY {
            return;
        }
        self.checked = Instant::now();
        let Some(mut log) = self.log.take_if(|log| log.is_lost()) else {
            return;
        };
        // The files may come back, for example with their disk. They then lack the frames of the
        // time between.
        if log.note_complete(false).is_ok() {
            self.is_noted_complete = Some(false);
        }
        let (structure, folder) = (self.structure.as_str(), self.settings.folder.display());
        warn!(structure, %folder, "the folder of the recording is gone; frames stay in memory and \
            monitoring continues");
        if !std::mem::take(&mut self.is_back) {
            self.changes.push(FolderChange::Lost);
        }
        self.refused_at = Some(Instant::now());
    }

    /// Opens the recording again if its folder is back. A missing folder is not created, because it
    /// would hide the former one.
    fn open_again(&mut self) -> Result<(), RecordError> {
        if self.log.is_some() {
            return Ok(());
        }
        let folder = &self.settings.folder;
        if let Err(source) = std::fs::read_dir(folder) {
            let path = folder.clone();
            return Err(RecordError::WriteLog { path, source });
        }
        let (log, opened) = FrameLog::open(folder, self.of.clone(), self.settings.log)?;
        log_repairs(&self.structure, &opened);
        *self.reader.write().unwrap_or_else(PoisonError::into_inner) = Some(log.reader());
        self.is_noted_complete = opened.is_complete;
        self.recorded_epoch = opened.last.map_or(0, |last| last.epoch);
        self.log = Some(log);
        self.is_back = true;
        let frames = self.waiting.drop_before(self.recorded_epoch);
        if frames > 0 {
            let (structure, epoch) = (self.structure.as_str(), self.recorded_epoch);
            warn!(
                structure,
                epoch,
                frames,
                "the recording contains a later epoch; a new run begins \
                after it, and the waiting frames are not recorded"
            );
        }
        Ok(())
    }

    /// Writes the waiting frames and closes the recording.
    pub(crate) async fn close(mut self) -> Result<(), IngestError> {
        self.report_sync().await;
        self.write_waiting();
        let (structure, frames) = (self.structure, self.waiting.frames());
        if frames > 0 {
            error!(
                structure,
                frames,
                error = self.failure,
                "waiting frames not recorded"
            );
        }
        self.log.map_or(Ok(()), |log| Ok(log.close()?))
    }

    /// Returns the counters of waiting and lost frames for a status message.
    pub(crate) fn drops(&self) -> impl Iterator<Item = (String, u64)> {
        let (waiting, lost) = (self.waiting.frames(), self.waiting.lost());
        let counts = [
            ("frames-waiting-for-the-disk", waiting),
            ("frames-not-recorded", lost),
        ];
        counts
            .into_iter()
            .filter(|(_, count)| *count > 0)
            .map(|(reason, count)| (reason.to_owned(), count))
    }

    /// Writes the waiting blocks in pieces until the disk reports an error.
    fn write_waiting(&mut self) {
        let opened = self.open_again();
        let structure = self.structure.as_str();
        let Some(log) = &mut self.log else {
            if let Err(error) = opened
                && is_new(&mut self.failure, &error)
            {
                let error = &self.failure;
                warn!(
                    structure,
                    error, "the recording cannot be opened again; retrying"
                );
            }
            self.refused_at = Some(Instant::now());
            return;
        };
        let before = self.waiting.frames();
        loop {
            let piece = self.waiting.piece();
            if piece.is_empty() {
                break;
            }
            let blocks = piece.len();
            match log.append(piece) {
                Ok(()) => self.waiting.written(blocks),
                Err(error) => {
                    if is_new(&mut self.failure, &error) {
                        let error = &self.failure;
                        warn!(
                            structure,
                            error,
                            "recording write failed; retrying, frames stay \
                            in memory and monitoring continues"
                        );
                    }
                    self.refused_at = Some(Instant::now());
                    // Save the mark before publishing any of these frames, because their numbers
                    // must not be reused for other samples.
                    if self.is_noted_complete != Some(false) {
                        match log.note_complete(false) {
                            Ok(()) => self.is_noted_complete = Some(false),
                            Err(error) => {
                                warn!(structure, %error, "recording not marked as incomplete; a \
                                    crash before the next successful write stays undetected")
                            }
                        }
                    }
                    return;
                }
            }
        }
        if before > 0 && std::mem::take(&mut self.is_back) {
            self.changes.push(FolderChange::Back);
        }
        self.failure.clear();
        if self.refused_at.take().is_some() {
            info!(
                structure,
                written = before,
                lost = self.waiting.lost(),
                "recording write succeeded again"
            );
        }
        // If this write fails, it is retried. Until it succeeds, a crash leads to a new epoch.
        if before > 0 && self.is_noted_complete != Some(true) && log.note_complete(true).is_ok() {
            self.is_noted_complete = Some(true);
        }
    }

    async fn report_sync(&mut self) {
        let Some(syncing) = self.syncing.take() else {
            return;
        };
        if let Ok(Err(error)) = syncing.await {
            warn!(structure = self.structure, %error, "recording not synchronised to disk");
        }
    }
}

/// Returns an error with its cause.
fn with_cause(error: &RecordError) -> String {
    match std::error::Error::source(error) {
        Some(cause) => format!("{error}: {cause}"),
        None => error.to_string(),
    }
}

/// Stores the text of a failure. Returns `true` if it differs from that of the last failure.
fn is_new(last: &mut String, error: &RecordError) -> bool {
    let text = with_cause(error);
    let is_new = *last != text;
    *last = text;
    is_new
}

/// Returns `true` if the cause is a folder that may become writable while the program runs.
fn may_be_opened_later(error: &RecordError) -> bool {
    let source = std::error::Error::source(error);
    let source = source.and_then(|source| source.downcast_ref::<std::io::Error>());
    source.is_some_and(may_become_writable)
}

fn log_repairs(structure: &str, opened: &OpenedLog) {
    if opened.torn_bytes > 0 {
        warn!(
            structure,
            bytes = opened.torn_bytes,
            "the recording ended in an incomplete record, which was removed"
        );
    }
    for path in &opened.set_aside {
        warn!(structure, file = %path.display(), "no part of this recording is readable; file set \
            aside");
    }
}

/// The archive of recorded frames, for queries that go back further than the frames in memory.
#[derive(Debug, Clone)]
pub(crate) struct RecordedFrames {
    reader: SharedReader,
}

impl RecordedFrames {
    fn reader(&self) -> Option<FrameLogReader> {
        let reader = self.reader.read();
        reader.unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Archive<FrameBlock> for RecordedFrames {
    fn read(&self, epoch: u64, after: u64, limit: u64, bytes: usize) -> Option<FrameBlock> {
        match self.reader()?.read(epoch, after, limit, bytes) {
            Ok(frames) => frames.map(to_block),
            Err(error) => {
                warn!(%error, "recording read failed");
                None
            }
        }
    }

    fn epoch_after(&self, epoch: u64) -> Option<u64> {
        self.reader()?.next_epoch(Some(epoch))
    }
}

fn places(frames: &LoggedFrames) -> Vec<NodePlace> {
    let place = |node: &NodePosition| NodePlace {
        epoch: node.epoch,
        sequence: node.sequence,
        ended: node.ended,
    };
    frames.nodes.iter().map(place).collect()
}

fn to_logged(block: &FrameBlock, nodes: &[NodePlace]) -> LoggedFrames {
    let position = |place: &NodePlace| NodePosition {
        epoch: place.epoch,
        sequence: place.sequence,
        ended: place.ended,
    };
    LoggedFrames {
        source: block.header.source.clone(),
        epoch: block.header.epoch,
        sequence: block.header.sequence,
        t0_ns: block.t0_ns,
        sampling_rate_hz: block.sampling_rate_hz,
        channels: block.channels,
        values: block.values.clone(),
        ended: block.state == StreamState::Ended,
        nodes: nodes.iter().map(position).collect(),
    }
}

fn to_block(frames: LoggedFrames) -> FrameBlock {
    let mut block = FrameBlock {
        header: Header {
            source: frames.source,
            epoch: frames.epoch,
            sequence: frames.sequence,
            time_ns: frames.t0_ns,
        },
        t0_ns: frames.t0_ns,
        sampling_rate_hz: frames.sampling_rate_hz,
        channels: frames.channels,
        values: frames.values,
        state: if frames.ended {
            StreamState::Ended
        } else {
            StreamState::Running
        },
    };
    if let Some(grid) = block.grid() {
        block.header.time_ns = grid.time_ns(frames.sequence);
    }
    block
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::NodeLayout;
    use spandrel_bus::Name;
    use std::path::Path;

    fn opened(folder: &Path) -> Recorder {
        let node = NodeLayout {
            name: Name::new("node").unwrap(),
            ranges: vec![1000.0],
        };
        let layout = Layout::new(vec![node], 100.0, 0.005).unwrap();
        let settings = RecordingSettings {
            folder: folder.to_owned(),
            log: LogSettings::default(),
            sync_every: Duration::from_secs(1),
        };
        let channels = vec!["roof".to_owned()];
        Recorder::open("tower", &layout, channels, &settings)
            .unwrap()
            .0
    }

    /// Returns frame `sequence` of an epoch.
    fn frame(epoch: u64, sequence: u64) -> FrameBlock {
        let time_ns = 1_700_000_000_000_000_000 + 10_000_000 * sequence as i64;
        FrameBlock {
            header: Header {
                source: "ingest".to_owned(),
                epoch,
                sequence,
                time_ns,
            },
            t0_ns: 1_700_000_000_000_000_000,
            sampling_rate_hz: 100.0,
            channels: 1,
            values: vec![0.5],
            state: StreamState::Running,
        }
    }

    /// Writes a frame at a time at which all checks are due.
    fn write(recorder: &mut Recorder, frame: FrameBlock) -> Vec<FolderChange> {
        let before = |pause| Instant::now().checked_sub(pause).unwrap();
        recorder.checked = before(CHECK_EVERY);
        recorder.refused_at = recorder.refused_at.map(|_| before(RETRY));
        recorder.write(&[frame], &[]);
        recorder.take_changes()
    }

    /// Regression: each append of frames with a lower epoch failed until the next start, although
    /// the recording counted as back.
    #[tokio::test(flavor = "multi_thread")]
    async fn folder_with_a_later_epoch_is_back_once_a_frame_after_it_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let (own, later) = (folder.path().join("own"), folder.path().join("later"));
        let mut recorder = opened(&later);
        assert_eq!(write(&mut recorder, frame(9, 0)), []);
        recorder.close().await.unwrap();

        let mut recorder = opened(&own);
        assert_eq!(write(&mut recorder, frame(5, 0)), []);
        std::fs::rename(&own, folder.path().join("away")).unwrap();
        assert_eq!(write(&mut recorder, frame(5, 1)), [FolderChange::Lost]);
        assert_eq!(write(&mut recorder, frame(5, 2)), []);
        let failure = recorder.failure.clone();
        assert!(failure.contains("No such file"), "{failure}");
        std::fs::rename(&later, &own).unwrap();
        assert_eq!(write(&mut recorder, frame(5, 3)), []);
        assert_eq!(recorder.recorded_epoch(), 9);
        assert_eq!(write(&mut recorder, frame(10, 0)), [FolderChange::Back]);
        assert!(recorder.has_written_all());
        let drops: Vec<_> = recorder.drops().collect();
        assert_eq!(drops, [("frames-not-recorded".to_owned(), 3)]);
        recorder.close().await.unwrap();

        let (_, found) = FrameLog::open(&own, opened_layout(), LogSettings::default()).unwrap();
        let last = found.last.unwrap();
        assert_eq!((last.epoch, last.sequence), (10, 0));
    }

    fn opened_layout() -> LogLayout {
        LogLayout {
            structure: "tower".to_owned(),
            channels: vec!["roof".to_owned()],
            nodes: vec!["node".to_owned()],
            sampling_rate_hz: 100.0,
        }
    }

    /// Regression: the folder counted as back when it was opened, although no frame could be
    /// written.
    #[tokio::test(flavor = "multi_thread")]
    async fn folder_is_back_after_the_first_frame() {
        let folder = tempfile::tempdir().unwrap();
        let (own, away) = (folder.path().join("own"), folder.path().join("away"));
        let mut recorder = opened(&own);
        write(&mut recorder, frame(5, 0));
        std::fs::rename(&own, &away).unwrap();
        assert_eq!(write(&mut recorder, frame(5, 1)), [FolderChange::Lost]);
        std::fs::rename(&away, &own).unwrap();
        // A frame of another layout cannot be appended.
        let mut refused = frame(5, 2);
        (refused.channels, refused.values) = (2, vec![0.5, 0.5]);
        assert_eq!(write(&mut recorder, refused), []);
        assert!(!recorder.has_written_all() && !recorder.failure.is_empty());
        recorder.waiting = UnrecordedFrames::default();
        assert_eq!(write(&mut recorder, frame(5, 3)), [FolderChange::Back]);
        assert_eq!(recorder.failure, "");
    }
}
