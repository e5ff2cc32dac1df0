use proptest::collection::vec;
use proptest::prelude::*;

use super::*;
use crate::message::{Estimate, EstimateBlock, EstimateFlags, FrameBlock, Header};
use crate::ring::{Keep, Ring};
use crate::testing::{frames, push};

/// A source with its ring, a reader, and the deliveries of the reader.
struct Rig {
    ring: Ring<FrameBlock>,
    follower: Follower<FrameBlock>,
    actions: VecDeque<Action<FrameBlock>>,
    fetch: Option<QueryRange>,
    got: Vec<Delivery<FrameBlock>>,
}

impl Rig {
    fn new(start: Start, capacity: u64, limit: u64) -> Self {
        Self {
            ring: Ring::new("source".into(), 1, Keep::last(capacity)),
            follower: Follower::new(start, limit, Patience::Limited),
            actions: VecDeque::new(),
            fetch: None,
            got: Vec::new(),
        }
    }

    fn put(&mut self, count: u64) -> FrameBlock {
        let block = frames(1, self.ring.next(), count);
        push(&mut self.ring, &block).unwrap();
        block
    }

    fn live(&mut self, block: FrameBlock) {
        self.follower.live(block, &mut self.actions);
        self.work();
    }

    fn idle(&mut self) {
        self.follower.idle(&mut self.actions);
        self.work();
    }

    fn work(&mut self) {
        while let Some(action) = self.actions.pop_front() {
            match action {
                Action::Deliver(delivery) => self.got.push(delivery),
                Action::Fetch { range, .. } => {
                    assert!(self.fetch.is_none(), "two fetches at a time");
                    self.fetch = Some(range);
                }
            }
        }
    }

    fn answer(&mut self) {
        if let Some(range) = self.fetch.take() {
            let answer = self.ring.answer(&range);
            self.follower.answered(answer, &mut self.actions);
            self.work();
        }
    }

    fn fail(&mut self) {
        self.fail_with(Silence::NoAnswer);
    }

    fn fail_with(&mut self, silence: Silence) {
        if self.fetch.take().is_some() {
            self.follower.unanswered(silence, &mut self.actions);
            self.work();
        }
    }

    fn settle(&mut self) {
        self.idle();
        for _ in 0..10_000 {
            if self.fetch.is_none() {
                return;
            }
            self.answer();
        }
        panic!("the reader never stops fetching");
    }

    /// Returns the delivered numbers, or `None` for each lost number. Checks order and
    /// completeness.
    fn items(&self) -> Vec<Option<u64>> {
        let mut items = Vec::new();
        let mut next = None;
        for delivery in &self.got {
            let (from, to) = match delivery {
                Delivery::Block(block) => {
                    let values = block.values.iter().map(|v| Some(*v as u64));
                    items.extend(values);
                    (block.header.sequence, block.end())
                }
                Delivery::Gap(gap) => {
                    items.extend((gap.from..gap.to).map(|_| None));
                    (gap.from, gap.to)
                }
            };
            assert_eq!(from, next.unwrap_or(from), "out of order");
            next = Some(to);
        }
        items
    }
}

fn all(numbers: std::ops::Range<u64>) -> Vec<Option<u64>> {
    numbers.map(Some).collect()
}

#[test]
fn blocks_in_order_are_delivered_at_once_and_nothing_is_fetched() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    for _ in 0..3 {
        let block = rig.put(2);
        rig.live(block);
    }
    assert_eq!(rig.items(), all(0..6));
    assert_eq!(rig.fetch, None);
}

#[test]
fn lost_block_is_fetched_and_later_blocks_are_kept() {
    let mut rig = Rig::new(Start::Beginning, 100, 2);
    let first = rig.put(2);
    rig.put(2);
    let third = rig.put(2);
    rig.live(first);
    rig.live(third);
    assert_eq!(rig.fetch.map(|range| range.after), Some(2));
    rig.answer();
    assert_eq!(rig.items(), all(0..6));
    assert_eq!(rig.follower.counts().fetched_items, 4);
}

#[test]
fn repeated_block_is_delivered_once() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let block = rig.put(3);
    rig.live(block.clone());
    rig.live(block);
    assert_eq!(rig.items(), all(0..3));
    assert_eq!(rig.follower.counts().duplicate_items, 3);
}

#[test]
fn a_late_reader_gets_everything_from_the_beginning() {
    let mut rig = Rig::new(Start::Beginning, 100, 3);
    rig.put(5);
    rig.put(5);
    rig.settle();
    assert_eq!(rig.items(), all(0..10));
}

#[test]
fn reader_that_starts_now_gets_only_new_items() {
    let mut rig = Rig::new(Start::Now, 100, 3);
    rig.put(5);
    rig.settle();
    rig.put(2); // lost
    rig.settle();
    assert_eq!(rig.items(), all(5..7));
}

#[test]
fn reader_resumes_from_its_checkpoint() {
    let start = Start::At {
        epoch: 1,
        sequence: 4,
    };
    let mut rig = Rig::new(start, 100, 3);
    rig.put(6);
    rig.settle();
    assert_eq!(rig.items(), all(4..6));
}

#[test]
fn a_checkpoint_of_an_older_epoch_starts_the_new_one_from_its_beginning() {
    let start = Start::At {
        epoch: 0,
        sequence: 4,
    };
    let mut rig = Rig::new(start, 100, 9);
    rig.put(6);
    rig.settle();
    assert_eq!(rig.items(), all(0..6));
}

#[test]
fn a_lost_last_block_is_found_when_idle() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(1);
    rig.live(first);
    rig.put(1);
    rig.settle();
    assert_eq!(rig.items(), all(0..2));
}

#[test]
fn a_lost_end_without_items_is_found_when_idle() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(1);
    rig.live(first);
    let mut end = frames(1, 1, 0);
    end.state = StreamState::Ended;
    push(&mut rig.ring, &end).unwrap();
    rig.settle();
    rig.settle();
    let ends = rig.got.iter().filter(|delivery| match delivery {
        Delivery::Block(block) => block.state == StreamState::Ended,
        Delivery::Gap(_) => false,
    });
    assert_eq!(ends.count(), 1);
}

#[test]
fn items_dropped_by_the_source_are_an_explicit_gap() {
    let mut rig = Rig::new(Start::Beginning, 2, 10);
    rig.put(2);
    rig.put(2);
    rig.settle();
    assert_eq!(
        rig.got[0],
        Delivery::Gap(Gap {
            epoch: 1,
            from: 0,
            to: 2
        })
    );
    assert_eq!(rig.items().split_off(2), all(2..4));
}

#[test]
fn absent_source_leaves_a_gap_after_the_maximum_number_of_failures() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(1);
    rig.put(1);
    let third = rig.put(1);
    rig.live(first);
    rig.live(third);
    for _ in 0..MAX_FAILURES {
        rig.fail();
    }
    assert_eq!(rig.items(), [Some(0), None, Some(2)]);
    assert_eq!(rig.fetch, None);
}

// Regression test: eight attempts took 5.5 s, and the items buffered after the gap were too late
// for their frames.
#[test]
fn source_without_buffer_leaves_a_gap_after_three_queries() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(1);
    rig.put(1);
    let third = rig.put(1);
    rig.live(first);
    rig.live(third);
    for tries in 0..3 {
        assert_eq!(rig.items(), [Some(0)], "after {tries} tries");
        rig.fail_with(Silence::NoBuffer);
    }
    assert_eq!(rig.items(), [Some(0), None, Some(2)]);
    assert_eq!(rig.fetch, None);
}

#[test]
fn a_stale_epoch_is_dropped_and_counted() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(2, 0, 1));
    rig.live(frames(1, 1, 1));
    assert_eq!(rig.items(), all(0..1));
    assert_eq!(rig.follower.counts().stale_blocks, 1);
}

#[test]
fn another_source_in_the_same_epoch_is_dropped_and_counted() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(1, 0, 1));
    let mut other = frames(1, 1, 1);
    other.header.source = "other".into();
    rig.live(other);
    assert_eq!(rig.items(), all(0..1));
    assert_eq!(rig.follower.counts().foreign_blocks, 1);
}

#[test]
fn a_new_epoch_ends_the_wait_for_the_old_one() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(1, 0, 1));
    rig.live(frames(1, 2, 1));
    rig.live(frames(2, 0, 1));
    let gap = Gap {
        epoch: 1,
        from: 1,
        to: 2,
    };
    let expected = [
        Delivery::Block(frames(1, 0, 1)),
        Delivery::Gap(gap),
        Delivery::Block(frames(1, 2, 1)),
        Delivery::Block(frames(2, 0, 1)),
    ];
    assert_eq!(rig.got, expected);
}

#[test]
fn reply_of_the_old_epoch_does_not_affect_the_new_one() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(1, 0, 1));
    rig.live(frames(1, 2, 1));
    rig.live(frames(2, 0, 1));
    rig.fetch = None;
    let late = Answer::Block(frames(1, 1, 1));
    rig.follower.answered(late, &mut rig.actions);
    rig.work();
    rig.live(frames(2, 1, 1));
    assert_eq!(rig.got.len(), 5);
    assert_eq!(rig.got[4], Delivery::Block(frames(2, 1, 1)));
}

#[test]
fn block_that_its_source_does_not_have_is_dropped() {
    // A source stores everything in its buffer before publishing it.
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(1, 5, 1)); // never in the ring
    let at = CaughtUp {
        header: Header {
            source: "source".into(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        state: StreamState::Running,
    };
    assert!(rig.fetch.take().is_some());
    rig.follower
        .answered(Answer::CaughtUp(at), &mut rig.actions);
    rig.work();
    assert_eq!((rig.items(), rig.fetch), (vec![], None));
    assert_eq!(rig.follower.counts().impossible_blocks, 1);
}

#[derive(Clone, Debug)]
enum Step {
    Arrives(u64),
    Lost(u64),
    Doubled(u64),
    Overtaken(u64),
    Answer,
    Fail,
    Idle,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (1u64..6).prop_map(Step::Arrives),
        3 => (1u64..6).prop_map(Step::Lost),
        1 => (1u64..6).prop_map(Step::Doubled),
        1 => (1u64..6).prop_map(Step::Overtaken),
        4 => Just(Step::Answer),
        1 => Just(Step::Fail),
        1 => Just(Step::Idle),
    ]
}

fn run(rig: &mut Rig, steps: &[Step]) {
    let mut overtaken = None;
    let mut failures = 0;
    for step in steps {
        match *step {
            Step::Arrives(count) => {
                let block = rig.put(count);
                rig.live(block);
                if let Some(block) = overtaken.take() {
                    rig.live(block);
                }
            }
            Step::Lost(count) => drop(rig.put(count)),
            Step::Doubled(count) => {
                let block = rig.put(count);
                rig.live(block.clone());
                rig.live(block);
            }
            Step::Overtaken(count) => overtaken = Some(rig.put(count)),
            Step::Answer => rig.answer(),
            Step::Fail if failures < 5 => {
                failures += 1;
                rig.fail();
            }
            Step::Fail => {}
            Step::Idle => rig.idle(),
        }
    }
    rig.settle();
    rig.settle();
}

proptest! {
    #[test]
    fn every_item_is_delivered_once_and_in_order_despite_losses(
        steps in vec(step(), 0..120),
        limit in 1u64..20,
    ) {
        let mut rig = Rig::new(Start::Beginning, 10_000, limit);
        run(&mut rig, &steps);
        prop_assert_eq!(rig.items(), all(0..rig.ring.next()));
    }

    #[test]
    fn every_item_is_delivered_or_in_a_gap(
        steps in vec(step(), 0..120),
        limit in 1u64..20,
        capacity in 1u64..20,
    ) {
        let mut rig = Rig::new(Start::Beginning, capacity, limit);
        run(&mut rig, &steps);
        let items = rig.items();
        prop_assert_eq!(items.len() as u64, rig.ring.next());
        for (number, item) in items.into_iter().enumerate() {
            prop_assert!(item.is_none_or(|found| found == number as u64));
        }
    }
}

#[test]
fn block_beyond_the_end_of_its_source_is_dropped() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(2);
    rig.live(first);
    rig.live(frames(1, 1 << 40, 5));
    rig.answer();
    assert_eq!(
        (rig.fetch, rig.follower.counts().impossible_blocks),
        (None, 1)
    );
    let second = rig.put(2);
    rig.live(second);
    assert_eq!(rig.items(), all(0..4));
}

#[test]
fn reply_to_an_earlier_query_does_not_discard_a_later_block() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(2);
    rig.live(first);
    rig.idle();
    let range = rig.fetch.unwrap();
    let early = rig.ring.answer(&range);
    rig.put(2); // lost
    let third = rig.put(2);
    rig.live(third);
    rig.fetch = None;
    rig.follower.answered(early, &mut rig.actions);
    rig.work();
    rig.settle();
    assert_eq!(
        (rig.items(), rig.follower.counts().impossible_blocks),
        (all(0..6), 0)
    );
}

#[test]
fn source_without_buffer_loses_only_the_lost_blocks() {
    // The source publishes 40 blocks per second. Missing items are abandoned within 5.5 s.
    const BLOCKS_PER_FAILURE: u64 = 28;
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    push(&mut rig.ring, &frames(1, 0, 1000)).unwrap(); // before the start of the reader
    for round in 0..20 {
        for block in 0..BLOCKS_PER_FAILURE {
            let block_is_lost = round == 12 && block == 3;
            let put = rig.put(1);
            if !block_is_lost {
                rig.live(put);
            }
        }
        rig.fail();
    }
    rig.fail();
    let end = 1000 + 20 * BLOCKS_PER_FAILURE;
    let lost = 1000 + 12 * BLOCKS_PER_FAILURE + 3;
    let came = |number| number >= 1000 && number != lost;
    assert_eq!(
        rig.items(),
        (0..end)
            .map(|number| came(number).then_some(number))
            .collect::<Vec<_>>()
    );
}

/// Creates a rig as [`Rig::new`] does, for a source that stores its items.
fn patient(limit: u64) -> Rig {
    let mut rig = Rig::new(Start::Beginning, 100, limit);
    rig.follower = Follower::new(Start::Beginning, limit, Patience::UntilAnswered);
    rig
}

fn caught_up(epoch: u64, sequence: u64) -> Answer<FrameBlock> {
    let header = Header {
        source: "source".into(),
        epoch,
        sequence,
        time_ns: 0,
    };
    Answer::CaughtUp(CaughtUp {
        header,
        state: StreamState::Running,
    })
}

// Regression test: after eight attempts, the reader abandoned items that ingest, back after ten
// seconds, still had on disk.
#[test]
fn items_of_a_buffering_source_are_not_abandoned_during_its_absence() {
    let mut rig = patient(10);
    let first = rig.put(1);
    rig.put(1);
    let third = rig.put(1);
    rig.live(first);
    rig.live(third);
    for _ in 0..100 {
        rig.fail();
    }
    rig.settle();
    assert_eq!(
        (rig.items(), rig.follower.counts().gap_items),
        (all(0..3), 0)
    );
}

#[test]
fn only_items_missing_at_a_buffering_source_are_abandoned() {
    let mut rig = patient(10);
    rig.live(frames(1, 0, 1));
    rig.live(frames(1, 5, 1));
    for tries in 0..MAX_FAILURES {
        assert_eq!(rig.items(), [Some(0)], "after {tries} tries");
        rig.fail(); // not counted
        assert!(rig.fetch.take().is_some());
        rig.follower.answered(caught_up(1, 6), &mut rig.actions);
        rig.work();
    }
    assert_eq!(rig.items(), [Some(0), None, None, None, None, Some(5)]);
    assert_eq!(rig.fetch, None);
}

#[test]
fn remaining_items_of_an_epoch_precede_the_next_epoch() {
    let mut rig = patient(10);
    rig.live(frames(1, 0, 2));
    rig.live(frames(2, 0, 1)); // two frames before it were lost
    rig.live(frames(2, 1, 1));
    assert_eq!(
        (
            rig.fetch.map(|range| (range.epoch, range.after)),
            rig.items()
        ),
        (Some((Some(1), 2)), all(0..2))
    );
    rig.fail();
    for kept in [frames(1, 2, 2), frames(2, 0, 2)] {
        assert!(rig.fetch.take().is_some());
        rig.follower.answered(Answer::Block(kept), &mut rig.actions);
        rig.work();
    }
    let expected = [
        frames(1, 0, 2),
        frames(1, 2, 2),
        frames(2, 0, 1),
        frames(2, 1, 1),
    ]
    .map(Delivery::Block);
    assert_eq!(rig.got, expected);
}

#[test]
fn later_epoch_unknown_to_its_source_is_dropped() {
    let mut rig = patient(10);
    rig.live(frames(1, 0, 2));
    rig.live(frames(9, 0, 1));
    assert!(rig.fetch.take().is_some());
    rig.follower.answered(caught_up(1, 2), &mut rig.actions);
    rig.work();
    rig.live(frames(1, 2, 1));
    assert_eq!(
        (
            rig.items(),
            rig.fetch,
            rig.follower.counts().impossible_blocks
        ),
        (all(0..3), None, 1)
    );
}

#[test]
fn later_epoch_is_accepted_if_the_source_has_no_buffer() {
    let mut rig = patient(10);
    rig.live(frames(1, 0, 2));
    rig.live(frames(2, 0, 3));
    for _ in 0..MAX_FAILURES {
        rig.fail_with(Silence::NoBuffer);
    }
    assert_eq!(
        rig.got,
        [frames(1, 0, 2), frames(2, 0, 3)].map(Delivery::Block)
    );
}

/// Estimates without parameters, published by `source` in the term of a leader.
fn estimates(term: u64, source: &str, sequence: u64, count: usize) -> EstimateBlock {
    let estimate = Estimate {
        mean: Vec::new(),
        covariance: Vec::new(),
        noise_mean: Vec::new(),
        noise_covariance: Vec::new(),
        innovations: Vec::new(),
        normalised_innovation_squared: 0.0,
        log_evidence: 0.0,
        used_channels: 0,
        flags: EstimateFlags::working(),
        excluded: crate::Excluded::None,
        sustained_information: Vec::new(),
    };
    EstimateBlock {
        header: Header {
            source: source.into(),
            epoch: 1,
            sequence,
            time_ns: (sequence * 5_000_000) as i64,
        },
        term,
        t0_ns: 0,
        sampling_rate_hz: 200.0,
        parameters: 0,
        noise_parameters: 0,
        channels: 0,
        estimates: vec![estimate; count],
        state: StreamState::Running,
    }
}

/// Returns the number of the first item, the end and the term of each delivered block.
fn delivered(actions: &mut VecDeque<Action<EstimateBlock>>) -> Vec<(u64, u64, u64)> {
    let delivery = |action: Action<EstimateBlock>| match action {
        Action::Deliver(Delivery::Block(block)) => {
            Some((block.header.sequence, block.end(), block.term))
        }
        Action::Deliver(Delivery::Gap(gap)) => panic!("{gap:?}"),
        Action::Fetch { .. } => None,
    };
    actions.drain(..).filter_map(delivery).collect()
}

#[test]
fn leader_of_a_higher_term_continues_the_stream_and_the_former_leader_is_rejected() {
    let (mut follower, mut actions) = (
        Follower::new(Start::Beginning, 100, Patience::UntilAnswered),
        VecDeque::new(),
    );
    follower.live(estimates(7, "a", 0, 3), &mut actions);
    follower.live(estimates(8, "b", 2, 4), &mut actions);
    // The former leader was frozen and does not know the new leader.
    follower.live(estimates(7, "a", 3, 9), &mut actions);
    follower.live(estimates(8, "b", 6, 1), &mut actions);
    assert_eq!(delivered(&mut actions), [(0, 3, 7), (3, 6, 8), (6, 7, 8)]);
    assert_eq!(
        (
            follower.counts().superseded_blocks,
            follower.counts().foreign_blocks
        ),
        (1, 0)
    );
}

#[test]
fn first_of_two_sources_in_one_term_is_read() {
    let (mut follower, mut actions) = (
        Follower::new(Start::Beginning, 100, Patience::UntilAnswered),
        VecDeque::new(),
    );
    follower.live(estimates(7, "a", 0, 3), &mut actions);
    follower.live(estimates(7, "b", 3, 3), &mut actions);
    assert_eq!(delivered(&mut actions), [(0, 3, 7)]);
    assert_eq!(
        (
            follower.counts().superseded_blocks,
            follower.counts().foreign_blocks
        ),
        (0, 1)
    );
}

#[test]
fn reply_of_the_former_leader_is_queried_again_without_a_gap() {
    let (mut follower, mut actions) = (
        Follower::new(Start::Beginning, 100, Patience::UntilAnswered),
        VecDeque::new(),
    );
    follower.live(estimates(7, "a", 0, 3), &mut actions);
    follower.live(estimates(8, "b", 6, 3), &mut actions); // 3 to 5 were lost with the former leader
    assert_eq!(delivered(&mut actions), [(0, 3, 7)]);
    follower.answered(Answer::Block(estimates(7, "a", 3, 3)), &mut actions);
    assert_eq!(delivered(&mut actions), []);
    follower.answered(Answer::Block(estimates(8, "b", 3, 3)), &mut actions);
    assert_eq!(delivered(&mut actions), [(3, 6, 8), (6, 9, 8)]);
    assert_eq!(
        (
            follower.counts().superseded_blocks,
            follower.counts().gap_items
        ),
        (1, 0)
    );
}

#[test]
fn blocks_stored_as_standby_are_sent_in_the_term_of_the_leader() {
    let mut ring = Ring::<EstimateBlock>::new("b".into(), 1, Keep::last(100))
        .going_on(5, StreamState::Running);
    let block = estimates(0, "b", 5, 3);
    let payload = crate::message::Message::encode(&block).unwrap();
    #[expect(clippy::disallowed_methods, reason = "a publisher goes by the clock")]
    ring.push(&block, &payload, std::time::Instant::now())
        .unwrap();
    ring.lead(9);
    let range = QueryRange {
        after: 0,
        limit: 100,
        epoch: Some(1),
    };
    assert_eq!(ring.answer(&range), Answer::Block(estimates(9, "b", 5, 3)));
}

/// Returns a block of an epoch with a second of items, one per second.
fn second(epoch: u64, number: u64) -> FrameBlock {
    let mut block = frames(epoch, number, 1);
    block.header.time_ns = number as i64 * 1_000_000_000;
    block
}

/// Returns epoch and number of each delivered item.
fn delivered_items(rig: &Rig) -> Vec<(u64, u64)> {
    let item = |delivery: &Delivery<FrameBlock>| match delivery {
        Delivery::Block(block) => Some((block.header.epoch, block.header.sequence)),
        Delivery::Gap(_) => None,
    };
    rig.got.iter().filter_map(item).collect()
}

// The real node was refused after every restart, until its clock passed the epoch.
#[test]
fn source_that_a_higher_epoch_has_locked_out_is_read_again() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(second(7, 0));
    // Another program runs under the same name for a while, with its clock in the future.
    for number in 0..5 {
        rig.live(second(9, number));
        rig.fail_with(Silence::NoBuffer);
        rig.live(second(7, 1 + number));
    }
    let locked_out = rig.follower.counts().clone();
    for number in 6..40 {
        rig.live(second(7, number));
    }
    let items = delivered_items(&rig);
    assert_eq!(items[..6], [(7, 0), (9, 0), (9, 1), (9, 2), (9, 3), (9, 4)]);
    let again = items[6];
    assert!(again.0 == 7 && again.1 <= 16, "{again:?}");
    assert_eq!(
        items[6..],
        (again.1..40).map(|n| (7, n)).collect::<Vec<_>>()
    );
    assert_eq!(locked_out.stale_blocks, 5, "{locked_out:?}");
    assert_eq!(rig.follower.counts().locked_out_blocks, again.1 - 6);
}

#[test]
fn checkpoint_of_a_higher_epoch_locks_a_source_out_for_seconds_only() {
    let start = Start::At {
        epoch: u64::MAX,
        sequence: 4,
    };
    let mut rig = Rig::new(start, 100, 3);
    for number in 0..20 {
        rig.live(second(7, number));
    }
    let first = delivered_items(&rig)[0];
    assert!(first.0 == 7 && first.1 < 10, "{first:?}");
}

#[test]
fn blocks_that_a_former_run_has_in_transit_do_not_bring_it_back() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(second(1, 0));
    rig.live(second(2, 0));
    for number in 1..9 {
        rig.live(second(1, number));
    }
    rig.live(second(2, 1));
    for number in 9..17 {
        rig.live(second(1, number));
    }
    assert_eq!(delivered_items(&rig), [(1, 0), (2, 0), (2, 1)]);
}

#[test]
fn epoch_and_term_after_the_last_possible_one_are_impossible() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(1, 0, 1));
    for epoch in [u64::MAX, 1 << 63] {
        rig.live(frames(epoch, 0, 1));
    }
    rig.live(frames(1, 1, 1));
    assert_eq!(
        (rig.items(), rig.follower.counts().impossible_blocks),
        (all(0..2), 2)
    );
    let (mut follower, mut actions) = (
        Follower::new(Start::Beginning, 100, Patience::UntilAnswered),
        VecDeque::new(),
    );
    follower.live(estimates(7, "a", 0, 3), &mut actions);
    follower.live(estimates(u64::MAX, "b", 3, 3), &mut actions);
    follower.live(estimates(7, "a", 3, 3), &mut actions);
    assert_eq!(delivered(&mut actions), [(0, 3, 7), (3, 6, 7)]);
    assert_eq!(follower.counts().impossible_blocks, 1);
}

// A single forged block excluded the node until its clock passed the epoch.
#[test]
fn epoch_that_the_source_denies_is_dropped() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    let first = rig.put(2);
    rig.live(first);
    rig.live(frames(9, 0, 1));
    rig.answer(); // the source has never begun epoch 9
    rig.settle();
    let second = rig.put(2);
    rig.live(frames(9, 1, 1));
    rig.live(second);
    rig.settle();
    let blocks = rig.got.iter().filter_map(|delivery| match delivery {
        Delivery::Block(block) => Some((block.header.epoch, block.header.sequence)),
        Delivery::Gap(_) => None,
    });
    assert_eq!(blocks.collect::<Vec<_>>(), [(1, 0), (9, 0), (1, 2)]);
    assert_eq!(rig.follower.counts().impossible_blocks, 2);
}

// An identification that had just been restarted denied the epoch of its predecessor, then
// identified it again. The reader received the first estimates twice.
#[test]
fn epoch_that_a_new_source_denies_before_it_enters_it_is_not_repeated() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.idle();
    let reply = |rig: &mut Rig, answer| {
        assert!(rig.fetch.take().is_some(), "nothing is asked");
        rig.follower.answered(answer, &mut rig.actions);
        rig.work();
    };
    reply(&mut rig, caught_up(0, 0));
    rig.live(frames(1, 0, 2));
    reply(&mut rig, caught_up(0, 0));
    reply(&mut rig, Answer::Block(frames(1, 0, 4)));
    rig.live(frames(1, 4, 1));
    assert_eq!(delivered_items(&rig), [(1, 0), (1, 2), (1, 4)]);
}

// The reader continued with the next published estimates, and lost those before them without a gap.
#[test]
fn items_of_a_denied_epoch_are_fetched_when_it_is_read_again() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.idle();
    let reply = |rig: &mut Rig, answer| {
        let range = rig.fetch.take().expect("nothing is asked");
        rig.follower.answered(answer, &mut rig.actions);
        rig.work();
        range
    };
    reply(&mut rig, caught_up(0, 0));
    rig.live(second(1, 0));
    for _ in 0..2 {
        reply(&mut rig, caught_up(0, 0));
    }
    for number in 0..20 {
        rig.live(second(1, number));
    }
    let missing = reply(&mut rig, Answer::Block(frames(1, 1, 15)));
    assert_eq!(missing.after, 1);
    let delivered = rig.got.iter().map(|delivery| match delivery {
        Delivery::Block(block) => block.header.sequence..block.end(),
        Delivery::Gap(gap) => panic!("{gap:?}"),
    });
    let items: Vec<u64> = delivered.flatten().collect();
    assert_eq!(items, (0..20).collect::<Vec<_>>());
}

#[test]
fn epoch_that_the_source_confirms_is_read_at_once() {
    let mut rig = Rig::new(Start::Beginning, 100, 10);
    rig.live(frames(0, 0, 2));
    let first = rig.put(1);
    rig.live(first);
    rig.put(1); // lost
    rig.settle();
    assert_eq!(delivered_items(&rig), [(0, 0), (1, 0), (1, 1)]);
    assert_eq!(rig.follower.counts().impossible_blocks, 0);
}

// Alert was deaf until its restart.
#[test]
fn leader_that_a_forged_term_has_excluded_is_read_again_and_nothing_is_lost() {
    let (mut follower, mut actions) = (
        Follower::new(Start::Beginning, 100, Patience::UntilAnswered),
        VecDeque::new(),
    );
    follower.live(estimates(7, "a", 0, 200), &mut actions);
    follower.live(estimates(1 << 62, "b", 200, 1), &mut actions);
    for number in 1..20 {
        follower.live(estimates(7, "a", 200 * number, 200), &mut actions);
    }
    let range = QueryRange {
        after: 201,
        limit: 100,
        epoch: Some(1),
    };
    let fetch = actions.iter().find_map(|action| match action {
        Action::Fetch { range, .. } => Some(*range),
        Action::Deliver(_) => None,
    });
    assert_eq!(fetch, Some(range));
    follower.answered(Answer::Block(estimates(7, "a", 201, 3799)), &mut actions);
    let got = delivered(&mut actions);
    assert_eq!(got[..2], [(0, 200, 7), (200, 201, 1 << 62)]);
    assert_eq!(got[2..].first().map(|(from, ..)| *from), Some(201));
    assert_eq!(got.last().map(|(_, end, _)| *end), Some(4000));
    assert_eq!(follower.counts().gap_items, 0);
}
