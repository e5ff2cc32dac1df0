//! Every frame on the disk before anybody hears of it.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use spandrel_bus::{Archive, Block, FrameBlock, Header, StreamState};
use spandrel_record::{
    FrameLog, FrameLogReader, LogLayout, LogSettings, LogSyncer, LoggedFrames, NodePosition, RecordError,
};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tracing::{info, warn};

use crate::align::NodePlace;
use crate::error::IngestError;
use crate::layout::Layout;

/// Frames that wait for a disk that refuses, at most; more are lost to the recording, and counted.
const MOST_WAITING: u64 = 131_072;
/// Pause before a disk that has refused is tried again.
const RETRY: Duration = Duration::from_millis(500);

/// Where and how frames are recorded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordingSettings {
    /// Folder of the segments of this structure.
    pub folder: PathBuf,
    /// How large segments are, and how long they are kept.
    pub log: LogSettings,
    /// How often what has been written is forced to the disk itself: what a power cut may cost. A killed process costs nothing.
    pub sync_every: Duration,
}

/// Where an earlier life of the recording ended.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Past {
    /// Its last frames.
    pub(crate) last: FrameBlock,
    /// Where the streams of the nodes stood then.
    pub(crate) nodes: Vec<NodePlace>,
    /// Whether nobody can have heard of frames after the last ones: numbers go on then, in the same epoch.
    pub(crate) is_whole: bool,
}

/// The recording of one structure.
#[derive(Debug)]
pub(crate) struct Recorder {
    structure: String,
    /// never locked: a writer of MCAP may be sent to another thread, but not shared
    log: Mutex<FrameLog>,
    reader: FrameLogReader,
    /// blocks that the disk has refused, oldest first
    waiting: VecDeque<LoggedFrames>,
    frames_waiting: u64,
    frames_lost: u64,
    refused_at: Option<Instant>,
    sync_every: Duration,
    synced: Instant,
    syncing: Option<JoinHandle<Result<(), RecordError>>>,
}

impl Recorder {
    /// Opens the recording, and tells where it ended.
    pub(crate) fn open(
        structure: &str,
        layout: &Layout,
        channels: Vec<String>,
        settings: &RecordingSettings,
    ) -> Result<(Self, Option<Past>), IngestError> {
        let of = LogLayout {
            structure: structure.to_owned(),
            channels,
            nodes: layout.nodes().iter().map(|node| node.name.to_string()).collect(),
            sampling_rate_hz: layout.sampling_rate_hz(),
        };
        let (log, opened) = FrameLog::open(&settings.folder, of, settings.log)?;
        if opened.torn_bytes > 0 {
            warn!(structure, bytes = opened.torn_bytes, "the recording was torn: what was half written is cut off");
        }
        for path in &opened.set_aside {
            warn!(structure, file = %path.display(), "no part of this recording can be read; it is set aside");
        }
        let is_whole = opened.was_closed || opened.same_boot;
        let past = opened.last.map(|last| Past { nodes: places(&last), last: to_block(last), is_whole });
        let recorder = Self {
            structure: structure.to_owned(),
            reader: log.reader(),
            log: Mutex::new(log),
            waiting: VecDeque::new(),
            frames_waiting: 0,
            frames_lost: 0,
            refused_at: None,
            sync_every: settings.sync_every,
            synced: Instant::now(),
            syncing: None,
        };
        Ok((recorder, past))
    }

    /// What gives frames to those who ask for more than is in memory.
    pub(crate) fn archive(&self) -> RecordedFrames {
        RecordedFrames { reader: self.reader.clone() }
    }

    /// Writes blocks, which may be put from then on. A disk that refuses keeps nobody from seeing them: they wait here, and are
    /// written when it takes them.
    pub(crate) fn write(&mut self, blocks: &[FrameBlock], places: &[NodePlace]) {
        let last = blocks.len().saturating_sub(1);
        for (number, block) in blocks.iter().enumerate() {
            let nodes = if number == last { places } else { &[] };
            self.frames_waiting += block.count();
            self.waiting.push_back(to_logged(block, nodes));
        }
        if self.refused_at.is_none_or(|refused| refused.elapsed() >= RETRY) {
            self.write_waiting();
        }
        while self.frames_waiting > MOST_WAITING {
            let Some(oldest) = self.waiting.pop_front() else { break };
            let frames = count(&oldest);
            self.frames_waiting -= frames;
            self.frames_lost += frames;
        }
    }

    /// Tries again what the disk has refused, and forces to the disk what it has taken, when it is time to.
    pub(crate) async fn tend(&mut self) {
        if self.refused_at.is_some_and(|refused| refused.elapsed() >= RETRY) {
            tokio::task::block_in_place(|| self.write_waiting());
        }
        if self.synced.elapsed() < self.sync_every
            || self.syncing.as_ref().is_some_and(|syncing| !syncing.is_finished())
        {
            return;
        }
        self.report_sync().await;
        self.synced = Instant::now();
        let syncer: LogSyncer = self.log.get_mut().unwrap_or_else(PoisonError::into_inner).syncer();
        self.syncing = Some(tokio::task::spawn_blocking(move || syncer.sync()));
    }

    /// Ends the recording in order.
    pub(crate) async fn close(mut self) -> Result<(), IngestError> {
        self.report_sync().await;
        self.write_waiting();
        Ok(self.log.into_inner().unwrap_or_else(PoisonError::into_inner).close()?)
    }

    /// What a status tells of it.
    pub(crate) fn drops(&self) -> impl Iterator<Item = (String, u64)> {
        let counts = [("frames-waiting-for-the-disk", self.frames_waiting), ("frames-not-recorded", self.frames_lost)];
        counts.into_iter().filter(|(_, count)| *count > 0).map(|(reason, count)| (reason.to_owned(), count))
    }

    fn write_waiting(&mut self) {
        if self.waiting.is_empty() {
            return;
        }
        let structure = self.structure.as_str();
        let log = self.log.get_mut().unwrap_or_else(PoisonError::into_inner);
        match log.append(self.waiting.make_contiguous()) {
            Ok(()) => {
                if self.refused_at.take().is_some() {
                    let (written, lost) = (self.frames_waiting, self.frames_lost);
                    info!(structure, written, lost, "the disk takes the recording again");
                }
                self.waiting.clear();
                self.frames_waiting = 0;
            }
            Err(error) => {
                if self.refused_at.is_none() {
                    warn!(structure, %error, "the recording cannot be written: frames wait in memory and are watched all the same");
                }
                self.refused_at = Some(Instant::now());
            }
        }
    }

    async fn report_sync(&mut self) {
        let Some(syncing) = self.syncing.take() else { return };
        if let Ok(Err(error)) = syncing.await {
            warn!(structure = self.structure, %error, "the recording cannot be forced to the disk");
        }
    }
}

/// The frames of a recording, for those who ask for more than is in memory.
#[derive(Debug, Clone)]
pub(crate) struct RecordedFrames {
    reader: FrameLogReader,
}

impl Archive<FrameBlock> for RecordedFrames {
    fn read(&self, epoch: u64, after: u64, limit: u64, bytes: usize) -> Option<FrameBlock> {
        match self.reader.read(epoch, after, limit, bytes) {
            Ok(frames) => frames.map(to_block),
            Err(error) => {
                warn!(%error, "the recording cannot be read");
                None
            }
        }
    }

    fn epoch_after(&self, epoch: u64) -> Option<u64> {
        self.reader.next_epoch(Some(epoch))
    }
}

fn count(frames: &LoggedFrames) -> u64 {
    (frames.values.len() / usize::from(frames.channels).max(1)) as u64
}

fn places(frames: &LoggedFrames) -> Vec<NodePlace> {
    let place = |node: &NodePosition| NodePlace { epoch: node.epoch, sequence: node.sequence, ended: node.ended };
    frames.nodes.iter().map(place).collect()
}

fn to_logged(block: &FrameBlock, nodes: &[NodePlace]) -> LoggedFrames {
    let position =
        |place: &NodePlace| NodePosition { epoch: place.epoch, sequence: place.sequence, ended: place.ended };
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
        header: Header { source: frames.source, epoch: frames.epoch, sequence: frames.sequence, time_ns: frames.t0_ns },
        t0_ns: frames.t0_ns,
        sampling_rate_hz: frames.sampling_rate_hz,
        channels: frames.channels,
        values: frames.values,
        state: if frames.ended { StreamState::Ended } else { StreamState::Running },
    };
    if let Some(grid) = block.grid() {
        block.header.time_ns = grid.time_ns(frames.sequence);
    }
    block
}
