//! The role of one of several processes that can identify the same structure: joining, standby or
//! leader.

use crate::identification::Output;
use spandrel_bus::{
    Claim, Description, EstimateBlock, LatestPublisher, LiveToken, NumberedPublisher,
    NumberedStandby, Progress, ProgressPublisher, Question, Questions, Standing,
};
use spandrel_checkpoint::Position;
use std::collections::VecDeque;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Whether an identification leads as soon as it starts, or only if there is no other leader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precedence {
    /// It leads as soon as it starts.
    Leads,
    /// It is a standby as long as another process leads.
    StandsBy,
}

/// The role of an identification.
#[derive(Debug)]
pub(crate) enum Seat {
    /// Another process leads, but its state has not been received yet. Identification is paused.
    Joining,
    /// A standby: it identifies in step with the leader, but does not publish.
    StandingBy(StandingBy),
    /// The leader: it publishes its results.
    Leading(Leading),
}

/// The results that a standby keeps for a takeover.
#[derive(Debug)]
pub(crate) struct StandingBy {
    pub(crate) estimates: NumberedStandby<EstimateBlock>,
    pub(crate) held: Held,
    /// Claim of the leader whose state was received. `None` for a process that started from its own
    /// checkpoint.
    pub(crate) in_step_with: Option<Claim>,
}

/// The publishers and queries of the leader.
#[derive(Debug)]
pub(crate) struct Leading {
    pub(crate) claim: Claim,
    pub(crate) token: LiveToken,
    pub(crate) estimates: NumberedPublisher<EstimateBlock>,
    pub(crate) progress: ProgressPublisher,
    pub(crate) questions: Questions,
    /// Limit of the states that are sent at once.
    pub(crate) replies: Arc<Semaphore>,
    pub(crate) _description: LatestPublisher<Description>,
}

impl Seat {
    pub(crate) fn standing(&self) -> Standing {
        match self {
            Self::Joining => Standing::Joining,
            Self::StandingBy(_) => Standing::StandingBy,
            Self::Leading(_) => Standing::Leading,
        }
    }

    /// Releases estimates in memory that alert, according to its progress, no longer needs.
    pub(crate) fn release(&mut self, decided: &Progress) {
        let (epoch, first) = (decided.header.epoch, decided.kept);
        match self {
            Self::Joining => {}
            Self::StandingBy(own) => own.estimates.release(epoch, first),
            Self::Leading(own) => own.estimates.release(epoch, first),
        }
    }

    /// Waits until a state may be sent, and for a query for it. Further queries wait in the queue.
    /// Never returns if this process is not the leader.
    pub(crate) async fn question(&self) -> (Question, OwnedSemaphorePermit) {
        if let Self::Leading(leading) = self
            && let Ok(permit) = leading.replies.clone().acquire_owned().await
            && let Some(question) = leading.questions.next().await
        {
            return (question, permit);
        }
        std::future::pending().await
    }
}

/// Maximum number of display values and events in the queue: about a minute of a structure with
/// some twenty parameters.
const MOST_HELD: usize = 16_384;

/// Display values and events of frames that the leader has not reported as done. A takeover
/// publishes them.
///
/// Values that the former leader published but did not report as done are published twice.
/// Subscribers detect duplicates by their time.
#[derive(Debug, Default)]
pub(crate) struct Held {
    /// Outputs with the position of the frame after their frames.
    waiting: VecDeque<(Position, Output)>,
}

impl Held {
    /// Keeps an output of the frames before `end`. Drops the oldest output when the queue is full.
    pub(crate) fn keep(&mut self, end: Position, output: Output) {
        self.waiting.push_back((end, output));
        while self.waiting.len() > MOST_HELD {
            self.waiting.pop_front();
        }
    }

    /// Drops the outputs that the leader has published.
    pub(crate) fn done(&mut self, progress: &Progress) {
        let done = Position {
            epoch: progress.header.epoch,
            sequence: progress.done,
        };
        while self.waiting.front().is_some_and(|(end, _)| *end <= done) {
            self.waiting.pop_front();
        }
    }

    /// Returns the kept outputs, oldest first.
    pub(crate) fn take(self) -> impl Iterator<Item = Output> {
        self.waiting.into_iter().map(|(_, output)| output)
    }
}

/// Returns the term for a new claim.
///
/// It exceeds every known term, from this run or an earlier one, and is at least the wall clock
/// time.
pub(crate) fn next_term(clock_ns: u64, heard: u64, remembered: u64) -> u64 {
    clock_ns
        .max(heard.saturating_add(1))
        .max(remembered.saturating_add(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::Header;

    fn progress(epoch: u64, done: u64) -> Progress {
        let header = Header {
            source: "identify".into(),
            epoch,
            sequence: done,
            time_ns: 0,
        };
        Progress {
            header,
            done,
            kept: done,
        }
    }

    fn held(ends: impl IntoIterator<Item = (u64, u64)>) -> Held {
        let mut held = Held::default();
        ends.into_iter().for_each(|(epoch, sequence)| {
            let end = Position { epoch, sequence };
            held.keep(end, Output::Responses(vec![vec![(sequence as f64, 0.0)]]))
        });
        held
    }

    fn numbers(held: Held) -> Vec<u64> {
        let number = |output: Output| match output {
            Output::Responses(rows) => rows[0][0].0 as u64,
            other => panic!("{other:?}"),
        };
        held.take().map(number).collect()
    }

    #[test]
    fn new_leader_does_not_publish_blocks_of_the_former_leader() {
        let mut held = held([(1, 40), (1, 80), (1, 80), (1, 120)]);
        held.done(&progress(1, 79));
        held.done(&progress(1, 80));
        held.done(&progress(1, 40)); // a late progress message
        assert_eq!(numbers(held), [120]);
    }

    #[test]
    fn all_blocks_of_an_earlier_epoch_are_done() {
        let mut of_two = held([(1, 900), (2, 40)]);
        of_two.done(&progress(2, 0));
        assert_eq!(numbers(of_two), [40]);
        let mut ahead = held([(2, 40)]);
        ahead.done(&progress(1, 900));
        assert_eq!(numbers(ahead), [40], "the leader is in the epoch before");
    }

    #[test]
    fn at_most_one_minute_of_blocks_is_held() {
        let first = numbers(held((0..MOST_HELD as u64 + 5).map(|end| (1, end))))[0];
        assert_eq!(first, 5);
    }

    #[test]
    fn next_term_exceeds_all_known_terms_for_any_clock() {
        assert_eq!(next_term(100, 0, 0), 100);
        assert_eq!(next_term(100, 500, 0), 501);
        assert_eq!(next_term(100, 500, 700), 701);
        assert_eq!(next_term(100, u64::MAX, 0), u64::MAX);
    }
}
