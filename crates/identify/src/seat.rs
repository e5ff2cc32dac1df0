//! Where one of several processes that can identify the same structure stands: it leads, stands by, or is about to.

use crate::identification::Output;
use spandrel_bus::{
    Claim, Description, EstimateBlock, LatestPublisher, LiveToken, NumberedPublisher,
    NumberedStandby, Progress, ProgressPublisher, Question, Questions, Standing,
};
use std::collections::VecDeque;

/// Whether an identification leads as soon as it starts, whoever led before, or once nobody else does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precedence {
    /// It leads as soon as it starts.
    Leads,
    /// It stands by as long as another one leads.
    StandsBy,
}

/// Where an identification stands.
#[derive(Debug)]
pub(crate) enum Seat {
    /// Another one leads, whose state has not been taken yet: nothing is identified here.
    Joining,
    /// It identifies what the one that leads does, and puts nothing.
    StandingBy(StandingBy),
    /// It puts what it identifies.
    Leading(Leading),
}

/// What one that stands by keeps for the time when it leads.
#[derive(Debug)]
pub(crate) struct StandingBy {
    pub(crate) estimates: NumberedStandby<EstimateBlock>,
    pub(crate) held: Held,
    /// The claim of the one whose state it has taken; none of one that has begun with what it remembers itself.
    pub(crate) in_step_with: Option<Claim>,
}

/// What only the one that leads puts and answers.
#[derive(Debug)]
pub(crate) struct Leading {
    pub(crate) claim: Claim,
    pub(crate) token: LiveToken,
    pub(crate) estimates: NumberedPublisher<EstimateBlock>,
    pub(crate) progress: ProgressPublisher,
    pub(crate) questions: Questions,
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

    /// Takes how far alert has come: what it needs no more need not stay in memory for it.
    pub(crate) fn release(&mut self, decided: &Progress) {
        let (epoch, first) = (decided.header.epoch, decided.kept);
        match self {
            Self::Joining => {}
            Self::StandingBy(own) => own.estimates.release(epoch, first),
            Self::Leading(own) => own.estimates.release(epoch, first),
        }
    }

    /// Waits for somebody who asks for the state; for ever where it is not for this one to answer.
    pub(crate) async fn question(&self) -> Question {
        if let Self::Leading(leading) = self
            && let Some(question) = leading.questions.next().await
        {
            return question;
        }
        std::future::pending().await
    }
}

/// Most display values and events that wait: those of a minute of a structure of some twenty parameters.
const MOST_HELD: usize = 16_384;

/// Display values and events of frames of which nobody has said that they are done: they are put by the one that takes over.
///
/// What has been put and not yet been said to be done is put twice then; its readers know it by its time.
#[derive(Debug, Default)]
pub(crate) struct Held {
    /// with epoch and number of the frame after those that they came of
    waiting: VecDeque<((u64, u64), Output)>,
}

impl Held {
    /// Keeps what came of the frames before number `end` of an epoch; the oldest is forgotten when too much waits.
    pub(crate) fn keep(&mut self, epoch: u64, end: u64, output: Output) {
        self.waiting.push_back(((epoch, end), output));
        while self.waiting.len() > MOST_HELD {
            self.waiting.pop_front();
        }
    }

    /// Forgets what the one that leads has done.
    pub(crate) fn done(&mut self, progress: &Progress) {
        let done = (progress.header.epoch, progress.done);
        while self.waiting.front().is_some_and(|(end, _)| *end <= done) {
            self.waiting.pop_front();
        }
    }

    /// Gives back what waits, the oldest first.
    pub(crate) fn take(self) -> impl Iterator<Item = Output> {
        self.waiting.into_iter().map(|(_, output)| output)
    }
}

/// The term in which to claim the lead: above all that has been heard of, here or in an earlier life, and by the clock on the wall where
/// nothing has.
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
        ends.into_iter().for_each(|(epoch, end)| {
            held.keep(epoch, end, Output::Responses(vec![vec![(end as f64, 0.0)]]))
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
    fn what_the_leader_has_done_is_not_put_by_the_next_one() {
        let mut held = held([(1, 40), (1, 80), (1, 80), (1, 120)]);
        held.done(&progress(1, 79));
        held.done(&progress(1, 80));
        held.done(&progress(1, 40)); // one that comes late
        assert_eq!(numbers(held), [120]);
    }

    #[test]
    fn an_epoch_that_is_over_is_done() {
        let mut of_two = held([(1, 900), (2, 40)]);
        of_two.done(&progress(2, 0));
        assert_eq!(numbers(of_two), [40]);
        let mut ahead = held([(2, 40)]);
        ahead.done(&progress(1, 900));
        assert_eq!(numbers(ahead), [40], "the leader is in the epoch before");
    }

    #[test]
    fn no_more_than_a_minute_waits() {
        let first = numbers(held((0..MOST_HELD as u64 + 5).map(|end| (1, end))))[0];
        assert_eq!(first, 5);
    }

    #[test]
    fn a_term_is_above_all_that_are_known_whatever_the_clock_says() {
        assert_eq!(next_term(100, 0, 0), 100);
        assert_eq!(next_term(100, 500, 0), 501);
        assert_eq!(next_term(100, 500, 700), 701);
        assert_eq!(next_term(100, u64::MAX, 0), u64::MAX);
    }
}
