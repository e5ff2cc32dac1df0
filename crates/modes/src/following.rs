//! From frames to the messages of the declared modes.

use crate::declared::{DeclaredModes, DeclaredState, EpochOver, ModesOutput};
use crate::error::ModesError;
use crate::stiffness::Stiffnesses;
use serde::{Deserialize, Serialize};
use spandrel_bus::{Block, Delivery, FrameBlock, Gap, Name, Start, TimeGrid};
use spandrel_checkpoint::Position;
use spandrel_modal::EpochStream;
use spandrel_structure::ModalPlan;

/// Follows the modes of one structure through its frames.
#[derive(Debug, Clone)]
pub(crate) struct Following {
    plan: ModalPlan,
    declared: DeclaredModes,
    epochs: EpochStream,
    reached: Option<Reached>,
    unidentified: u64,
    /// The used channels of one frame.
    frame: Vec<f64>,
}

/// The run of the frames, and the first frame that is not processed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Reached {
    epoch: u64,
    next: u64,
    /// Time of frame 0 (ns since the Unix epoch, UTC). `None` before the first frames of the run.
    t0_ns: Option<i64>,
}

/// The whole state between two inputs, as stored in a checkpoint. With it, the results are
/// bit-identical to those of an uninterrupted run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct FollowingState {
    declared: DeclaredState,
    epochs: EpochStream,
    reached: Option<Reached>,
    unidentified: u64,
}

impl FollowingState {
    /// Version of the layout. Every change of a field here or in the nested states must increase
    /// it.
    pub(crate) const VERSION: u16 = 2;
}

impl Following {
    pub(crate) fn new(
        structure: &Name,
        plan: &ModalPlan,
        stiffnesses: Option<Stiffnesses>,
    ) -> Result<Self, ModesError> {
        Ok(Self {
            declared: DeclaredModes::new(structure, plan)?.updating(stiffnesses),
            epochs: plan.stream()?,
            reached: None,
            unidentified: 0,
            frame: vec![f64::NAN; plan.channels.len()],
            plan: plan.clone(),
        })
    }

    pub(crate) fn state(&self) -> FollowingState {
        FollowingState {
            declared: self.declared.state(),
            epochs: self.epochs.clone(),
            reached: self.reached,
            unidentified: self.unidentified,
        }
    }

    /// Restores the state of a checkpoint.
    ///
    /// # Errors
    /// Returns an error if the state belongs to other modes or bands.
    pub(crate) fn restore(&mut self, state: FollowingState) -> Result<(), &'static str> {
        if !state.epochs.settings().eq(self.epochs.settings()) {
            return Err("the state has other bands than the structure file");
        }
        if !self.declared.restore(state.declared) {
            return Err("the state has other modes than the structure file");
        }
        self.epochs = state.epochs;
        self.reached = state.reached;
        self.unidentified = state.unidentified;
        Ok(())
    }

    pub(crate) fn declared(&self) -> &DeclaredModes {
        &self.declared
    }

    /// Returns the number of epochs that could not be identified, because too few channels were
    /// usable.
    pub(crate) fn unidentified(&self) -> u64 {
        self.unidentified
    }

    /// Returns the position of the first frame that is not processed. `None` before the first.
    pub(crate) fn position(&self) -> Option<Position> {
        self.reached.map(|reached| Position {
            epoch: reached.epoch,
            sequence: reached.next,
        })
    }

    /// Returns the position from which frames are needed.
    pub(crate) fn start(&self) -> Start {
        match self.position() {
            Some(Position { epoch, sequence }) => Start::At { epoch, sequence },
            None => Start::Beginning,
        }
    }

    /// Returns the time of the last processed frame (ns since the Unix epoch, UTC).
    pub(crate) fn last_time_ns(&self) -> Option<i64> {
        let reached = self.reached?;
        self.time_ns(reached.next.checked_sub(1)?)
    }

    fn time_ns(&self, frame: u64) -> Option<i64> {
        let t0_ns = self.reached?.t0_ns?;
        Some(TimeGrid::new(t0_ns, self.plan.settings.rate_hz)?.time_ns(frame))
    }

    /// Processes frames or a gap, and appends the messages of the epochs that are over to
    /// `outputs`.
    pub(crate) fn handle(&mut self, input: &Delivery<FrameBlock>, outputs: &mut Vec<ModesOutput>) {
        match input {
            Delivery::Block(block) => self.take(block, outputs),
            Delivery::Gap(gap) => self.skip(*gap, outputs),
        }
    }

    fn take(&mut self, block: &FrameBlock, outputs: &mut Vec<ModesOutput>) {
        let (epoch, first) = (block.header.epoch, block.header.sequence);
        self.enter(epoch);
        if let Some(reached) = &mut self.reached {
            reached.t0_ns = Some(block.t0_ns);
        }
        // The follower delivers a gap before frames that do not continue the previous ones.
        let next = self.reached.map_or(first, |reached| reached.next);
        if next < first {
            let (from, to) = (next, first);
            self.skip(Gap { epoch, from, to }, outputs);
        }
        for (number, values) in block.iter() {
            for (value, channel) in self.frame.iter_mut().zip(&self.plan.channels) {
                *value = values.get(*channel).copied().unwrap_or(f64::NAN);
            }
            self.push(number, outputs);
        }
        self.advance(block.end());
    }

    fn skip(&mut self, gap: Gap, outputs: &mut Vec<ModesOutput>) {
        self.enter(gap.epoch);
        let noticed = gap.from.saturating_add(self.epochs.longest_gap());
        for number in gap.from..gap.to.min(noticed) {
            self.frame.fill(f64::NAN);
            self.push(number, outputs);
        }
        self.advance(gap.to);
    }

    /// Restarts if the frames belong to another run.
    fn enter(&mut self, epoch: u64) {
        if self.reached.is_some_and(|reached| reached.epoch == epoch) {
            return;
        }
        if let (Some(_), Ok(fresh)) = (self.reached, self.plan.stream()) {
            self.epochs = fresh;
            self.declared.clear();
        }
        self.reached = Some(Reached {
            epoch,
            next: 0,
            t0_ns: None,
        });
    }

    fn advance(&mut self, end: u64) {
        if let Some(reached) = &mut self.reached {
            reached.next = end;
        }
    }

    /// Processes [`Self::frame`].
    fn push(&mut self, number: u64, outputs: &mut Vec<ModesOutput>) {
        // The frame has one value per channel, so that the stream accepts it.
        let Ok(Some(epoch)) = self.epochs.push(&self.frame) else {
            return;
        };
        let (Some(time_ns), Ok(found)) = (self.time_ns(number), epoch.identify()) else {
            self.unidentified += 1;
            return;
        };
        let over = EpochOver {
            time_ns,
            epoch: &epoch,
            found: &found,
        };
        self.declared.handle(over, outputs);
    }
}

#[cfg(test)]
mod tests;
