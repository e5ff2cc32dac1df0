//! From frames to recordings.

use serde::{Deserialize, Serialize};
use spandrel_bus::{Block, Delivery, FrameBlock, Start, TimeGrid};
use spandrel_checkpoint::Position;
use spandrel_earthquake::{Cut, CutKind, Detected, Detection, DetectionState, Due};
use std::collections::VecDeque;

/// A recording to store.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Recorded {
    pub(crate) about: About,
    /// Time of each frame (ns since 1970-01-01 UTC) with one value per channel (SI, `NaN` where one
    /// is missing).
    pub(crate) rows: Vec<(i64, Vec<f64>)>,
}

/// Description of a recording.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct About {
    /// Time of the first frame (ns since 1970-01-01 UTC).
    pub(crate) start_ns: i64,
    /// Time of the last frame (ns since 1970-01-01 UTC).
    pub(crate) end_ns: i64,
    /// Why it was recorded.
    pub(crate) kind: CutKind,
}

/// What frames have led to.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum CutOutput {
    /// Strong motion has begun.
    Began {
        /// Time of the first frame in the recording to come (ns since 1970-01-01 UTC).
        start_ns: i64,
        /// Time of the deciding frame (ns since 1970-01-01 UTC).
        time_ns: i64,
    },
    /// A recording is complete.
    Record(Recorded),
    /// A later recording has too few samples, and will be repeated.
    TooFew {
        /// What it was due for.
        due: Vec<Due>,
        /// Number of frames with samples.
        found: usize,
        /// Number required.
        required: u64,
    },
}

/// The run of frames that is read.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Run {
    epoch: u64,
    /// Time of frame 0 (ns since the Unix epoch, UTC). `None` before its first frames.
    t0_ns: Option<i64>,
}

/// The state for a restart, which also needs the frames from [`Cutting::needed_from`] on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct CuttingState {
    detection: DetectionState,
    run: Option<Run>,
}

impl CuttingState {
    /// Version of the layout. Every change of a field here or in the nested states must increase
    /// it.
    pub(crate) const VERSION: u16 = 1;
}

/// Cuts recordings from the frames of one structure.
#[derive(Debug)]
pub(crate) struct Cutting {
    detection: Detection,
    /// Indices of the channels that are watched.
    channels: Vec<usize>,
    rate_hz: f64,
    run: Option<Run>,
    /// The frames that a recording may still need.
    frames: VecDeque<(u64, Vec<f64>)>,
    /// Frame behind the last one or behind the last gap.
    next: u64,
}

impl Cutting {
    pub(crate) fn new(detection: Detection, channels: Vec<usize>, rate_hz: f64) -> Self {
        Self {
            detection,
            channels,
            rate_hz,
            run: None,
            frames: VecDeque::new(),
            next: 0,
        }
    }

    pub(crate) fn state(&self) -> CuttingState {
        CuttingState {
            detection: self.detection.state().clone(),
            run: self.run,
        }
    }

    /// Restores the state of a checkpoint.
    ///
    /// # Errors
    /// Returns an error if the state belongs to other channels.
    pub(crate) fn restore(&mut self, state: CuttingState) -> Result<(), &'static str> {
        if !self.detection.restore(state.detection) {
            return Err("the state has other channels than the structure file");
        }
        self.run = state.run;
        self.next = self.detection.next();
        Ok(())
    }

    /// Returns the position of the first frame that a recording may still need. `None` before the
    /// first frame.
    pub(crate) fn needed_from(&self) -> Option<Position> {
        Some(Position {
            epoch: self.run?.epoch,
            sequence: self.detection.needed_from(),
        })
    }

    /// Returns the position from which frames are needed.
    pub(crate) fn start(&self) -> Start {
        match self.needed_from() {
            Some(Position { epoch, sequence }) => Start::At { epoch, sequence },
            None => Start::Beginning,
        }
    }

    /// Returns the number of the first frame that is not processed.
    pub(crate) fn next(&self) -> u64 {
        self.next
    }

    pub(crate) fn detection(&self) -> &Detection {
        &self.detection
    }

    /// Returns the time of the last processed frame (ns since the Unix epoch, UTC).
    pub(crate) fn last_time_ns(&self) -> Option<i64> {
        self.time_ns(self.detection.next().checked_sub(1)?)
    }

    fn time_ns(&self, frame: u64) -> Option<i64> {
        Some(TimeGrid::new(self.run?.t0_ns?, self.rate_hz)?.time_ns(frame))
    }

    /// Processes frames or a gap, and appends what they have led to.
    pub(crate) fn handle(&mut self, input: &Delivery<FrameBlock>, outputs: &mut Vec<CutOutput>) {
        match input {
            Delivery::Block(block) => self.take(block, outputs),
            Delivery::Gap(gap) => {
                self.enter(gap.epoch, outputs);
                self.next = self.next.max(gap.to);
            }
        }
    }

    /// Ends the recording of an earthquake, because no more frames arrive.
    pub(crate) fn interrupt(&mut self, outputs: &mut Vec<CutOutput>) {
        let mut found = Vec::new();
        self.detection.interrupt(&mut found);
        self.tell(found, outputs);
    }

    fn take(&mut self, block: &FrameBlock, outputs: &mut Vec<CutOutput>) {
        self.enter(block.header.epoch, outputs);
        if let Some(run) = &mut self.run {
            run.t0_ns = Some(block.t0_ns);
        }
        let mut watched = vec![f64::NAN; self.channels.len()];
        let mut found = Vec::new();
        for (number, values) in block.iter() {
            self.frames.push_back((number, values.to_vec()));
            // After a restart, earlier frames are only what a recording may need.
            if number < self.detection.next() {
                continue;
            }
            for (value, channel) in watched.iter_mut().zip(&self.channels) {
                *value = values.get(*channel).copied().unwrap_or(f64::NAN);
            }
            let time_ns = self.time_ns(number).unwrap_or_default();
            self.detection.push(number, time_ns, &watched, &mut found);
            if !found.is_empty() {
                self.tell(std::mem::take(&mut found), outputs);
            }
            self.forget();
        }
        self.next = self.next.max(block.end());
    }

    fn enter(&mut self, epoch: u64, outputs: &mut Vec<CutOutput>) {
        if self.run.is_some_and(|run| run.epoch == epoch) {
            return;
        }
        let mut found = Vec::new();
        self.detection.restart(&mut found);
        self.tell(found, outputs);
        self.frames.clear();
        self.next = 0;
        self.run = Some(Run { epoch, t0_ns: None });
    }

    fn forget(&mut self) {
        let needed = self.detection.needed_from();
        while self
            .frames
            .pop_front_if(|(number, _)| *number < needed)
            .is_some()
        {}
    }

    fn tell(&mut self, found: Vec<Detected>, outputs: &mut Vec<CutOutput>) {
        for one in found {
            match one {
                Detected::Began { first } => {
                    let first = self.frames.iter().find(|(number, _)| *number >= first);
                    let start = first.map(|(number, _)| *number);
                    let times = start.and_then(|start| self.time_ns(start));
                    if let Some((start_ns, time_ns)) = times.zip(self.last_time_ns()) {
                        outputs.push(CutOutput::Began { start_ns, time_ns });
                    }
                }
                Detected::Complete(cut) => outputs.extend(self.record(cut)),
            }
        }
    }

    /// Takes the frames of a recording, without those that have no sample.
    fn record(&mut self, cut: Cut) -> Option<CutOutput> {
        let Cut { first, end, kind } = cut;
        let has_sample = |values: &[f64]| values.iter().any(|value| value.is_finite());
        let rows: Vec<(i64, Vec<f64>)> = self
            .frames
            .iter()
            .filter(|(number, values)| (first..end).contains(number) && has_sample(values))
            .filter_map(|(number, values)| Some((self.time_ns(*number)?, values.clone())))
            .collect();
        if let CutKind::Later { due } = &kind {
            let required = self.detection.fewest_later();
            if (rows.len() as u64) < required {
                let due = due.clone();
                self.detection.put_back(due.clone());
                return Some(CutOutput::TooFew {
                    due,
                    found: rows.len(),
                    required,
                });
            }
        }
        let (start_ns, end_ns) = (rows.first()?.0, rows.last()?.0);
        if let CutKind::Earthquake {
            is_strong: true, ..
        } = kind
        {
            self.detection.schedule(start_ns, end_ns);
        }
        let about = About {
            start_ns,
            end_ns,
            kind,
        };
        Some(CutOutput::Record(Recorded { about, rows }))
    }
}

#[cfg(test)]
mod tests;
