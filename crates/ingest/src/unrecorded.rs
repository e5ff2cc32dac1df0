//! Frames that wait for the disk, limited in number and bytes. Dropped frames are counted.

use std::collections::VecDeque;

use spandrel_record::LoggedFrames;

/// Maximum number of waiting frames. Beyond it, the oldest frames are lost to the recording.
const MOST_FRAMES: u64 = 131_072;
/// Maximum size of waiting samples, in bytes: the maximum number of frames with 128 channels.
const MOST_BYTES: usize = 128 << 20;
/// Maximum size of samples written at once, in bytes. Writing temporarily requires the same amount
/// of memory again.
const PIECE_BYTES: usize = 4 << 20;

/// Blocks that are not yet recorded, oldest first.
#[derive(Debug, Default)]
pub(crate) struct UnrecordedFrames {
    blocks: VecDeque<LoggedFrames>,
    frames: u64,
    bytes: usize,
    lost: u64,
}

impl UnrecordedFrames {
    /// Returns the number of waiting frames.
    pub(crate) fn frames(&self) -> u64 {
        self.frames
    }

    /// Returns the number of frames lost to the recording.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }

    /// Adds a block.
    pub(crate) fn push(&mut self, block: LoggedFrames) {
        self.frames += frames(&block);
        self.bytes += bytes(&block);
        self.blocks.push_back(block);
    }

    /// Returns the oldest blocks, at most as many as are written at once. The slice is empty if
    /// none wait.
    pub(crate) fn piece(&mut self) -> &[LoggedFrames] {
        let mut sum = 0;
        let fits = |block: &&LoggedFrames| {
            let is_first = sum == 0;
            sum += bytes(block).max(1);
            is_first || sum <= PIECE_BYTES
        };
        let count = self.blocks.iter().take_while(fits).count();
        &self.blocks.make_contiguous()[..count]
    }

    /// Removes the oldest blocks after they have been written.
    pub(crate) fn written(&mut self, blocks: usize) {
        for block in self.blocks.drain(..blocks) {
            self.frames -= frames(&block);
            self.bytes -= bytes(&block);
        }
    }

    /// Drops the blocks of epochs before `epoch`, and counts their frames as lost. Returns their
    /// number.
    pub(crate) fn drop_before(&mut self, epoch: u64) -> u64 {
        let before = self.lost;
        while self.blocks.front().is_some_and(|block| block.epoch < epoch) {
            self.drop_oldest();
        }
        self.lost - before
    }

    /// Drops the oldest blocks while a limit is exceeded, and counts their frames as lost.
    pub(crate) fn drop_excess(&mut self) {
        while self.frames > MOST_FRAMES || self.bytes > MOST_BYTES {
            self.drop_oldest();
        }
    }

    fn drop_oldest(&mut self) {
        if let Some(oldest) = self.blocks.pop_front() {
            self.frames -= frames(&oldest);
            self.bytes -= bytes(&oldest);
            self.lost += frames(&oldest);
        }
    }
}

fn frames(block: &LoggedFrames) -> u64 {
    (block.values.len() / usize::from(block.channels).max(1)) as u64
}

fn bytes(block: &LoggedFrames) -> usize {
    size_of_val(block.values.as_slice())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(sequence: u64, frames: usize, channels: u16) -> LoggedFrames {
        LoggedFrames {
            source: "ingest".to_owned(),
            epoch: 1,
            sequence,
            t0_ns: 0,
            sampling_rate_hz: 100.0,
            channels,
            values: vec![0.0; frames * usize::from(channels)],
            ended: false,
            nodes: Vec::new(),
        }
    }

    #[test]
    fn pieces_are_small_ordered_and_complete() {
        let mut waiting = UnrecordedFrames::default();
        // Half a mebibyte each: 65,536 values.
        (0..20).for_each(|k| waiting.push(block(k * 64, 64, 1024)));
        let mut found = Vec::new();
        loop {
            let piece = waiting.piece();
            let (count, bytes) = (piece.len(), piece.iter().map(bytes).sum::<usize>());
            if count == 0 {
                break;
            }
            assert!(bytes <= PIECE_BYTES, "{bytes}");
            found.extend(piece.iter().map(|block| block.sequence));
            waiting.written(count);
        }
        assert_eq!(found, (0..20).map(|k| k * 64).collect::<Vec<_>>());
        assert_eq!((waiting.frames(), waiting.bytes, waiting.lost()), (0, 0, 0));
        // A block larger than a piece is written alone. A block without frames must not stop the
        // loop.
        waiting.push(block(0, 1024, 1024));
        waiting.push(block(1024, 0, 1024));
        assert_eq!(waiting.piece().len(), 1);
        waiting.written(1);
        assert_eq!(waiting.piece().len(), 1);
    }

    #[test]
    fn many_channels_are_bounded_by_bytes_and_few_by_frames() {
        let mut waiting = UnrecordedFrames::default();
        for k in 0..40 {
            waiting.push(block(k * 128, 128, 4096));
            waiting.drop_excess();
        }
        assert!(
            waiting.bytes <= MOST_BYTES && waiting.frames() == 32 * 128,
            "{}",
            waiting.frames()
        );
        assert_eq!(waiting.lost(), 8 * 128);
        assert_eq!(waiting.piece()[0].sequence, 8 * 128, "the oldest are gone");
        let mut waiting = UnrecordedFrames::default();
        for k in 0..3 {
            waiting.push(block(k * 65_536, 65_536, 2));
            waiting.drop_excess();
        }
        assert_eq!((waiting.frames(), waiting.lost()), (131_072, 65_536));
    }
}
