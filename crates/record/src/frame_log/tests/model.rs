//! Compares the log with a simple model: a list.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;

/// An action on a log.
#[derive(Debug, Clone)]
enum Act {
    /// Appends blocks: number of frames to go back or to skip, number of frames, and whether the
    /// epoch ends.
    Append(Vec<(i64, u64, bool)>),
    /// Restarts the writer. The value tells whether it closes the log first.
    Reopen(bool),
}

fn act() -> impl Strategy<Value = Act> {
    let block = (-6_i64..4, 0_u64..6, prop::bool::weighted(0.1));
    prop_oneof![
        6 => prop::collection::vec(block, 1..4).prop_map(Act::Append),
        1 => any::<bool>().prop_map(Act::Reopen),
    ]
}

/// Frames by epoch and number, and the end of each ended epoch.
#[derive(Default)]
struct Model {
    frames: BTreeMap<(u64, u64), Vec<u64>>,
    ended: BTreeMap<u64, u64>,
}

impl Model {
    /// Adds the frames from number `next` on. Earlier frames exist already, or are permanently
    /// missing.
    fn append(&mut self, block: &LoggedFrames, next: u64) {
        for (number, row) in rows_of(std::slice::from_ref(block)) {
            if number >= next {
                self.frames.insert((block.epoch, number), row);
            }
        }
        if block.ended {
            self.ended.insert(block.epoch, block.end());
        }
    }

    /// Returns the number of the first frame, the rows, and whether the epoch ends.
    fn read(&self, epoch: u64, after: u64, limit: u64) -> Option<(u64, Vec<Vec<u64>>, bool)> {
        let from = self
            .frames
            .range((epoch, after)..(epoch + 1, 0))
            .next()
            .map(|((_, number), _)| *number);
        let ended_at = self.ended.get(&epoch).copied();
        let first = match (from, ended_at) {
            (Some(first), _) => first,
            (None, Some(end)) if end >= after => end,
            (None, _) => return None,
        };
        let rows = (first..).map_while(|number| self.frames.get(&(epoch, number)).cloned());
        let rows: Vec<Vec<u64>> = rows.take(limit as usize).collect();
        let end = first + rows.len() as u64;
        Some((first, rows, ended_at == Some(end)))
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]
    #[test]
    fn log_agrees_with_a_list_model(
        acts in prop::collection::vec(act(), 1..25),
        segment_bytes in prop_oneof![Just(1), Just(3000), Just(u64::MAX)],
        reads in prop::collection::vec((0_u64..5, 0_u64..60, 1_u64..20), 30),
    ) {
        let folder = quick_folder();
        let settings = LogSettings { segment_bytes, ..LogSettings::default() };
        let mut log = open_with(folder.path(), settings);
        let mut model = Model::default();
        let (mut epoch, mut next) = (1, 0);
        for act in acts {
            match act {
                Act::Append(blocks) => {
                    let mut appended = Vec::new();
                    for (shift, count, is_end) in blocks {
                        let from = (next as i64 + shift).max(0) as u64;
                        // An end mark before the last frame does not count.
                        let is_end = is_end && from + count >= next;
                        let block = LoggedFrames { ended: is_end, ..frames(epoch, from, count) };
                        if count > 0 || is_end {
                            model.append(&block, next);
                            next = next.max(block.end());
                        }
                        appended.push(block);
                        if is_end {
                            (epoch, next) = (epoch + 1, 0);
                        }
                    }
                    log.append(&appended).unwrap();
                }
                Act::Reopen(is_closed) => {
                    if is_closed {
                        log.close().unwrap();
                    } else {
                        drop(log);
                    }
                    log = open_with(folder.path(), settings);
                }
            }
        }
        let reader = log.reader();
        for (epoch, after, limit) in reads {
            let found = reader.read(epoch, after, limit, usize::MAX).unwrap();
            let found = found.map(|found| {
                let rows: Vec<Vec<u64>> = found.values.chunks_exact(3).map(bits).collect();
                // At the limit, the next result may contain an end mark that was appended later.
                let is_told_next = !found.ended && rows.len() as u64 == limit;
                let next = reader.read(epoch, found.end(), 1, usize::MAX).unwrap().filter(|_| is_told_next);
                let is_end = next.is_some_and(|next| (next.sequence, next.count(), next.ended) == (found.end(), 0, true));
                (found.sequence, rows, found.ended || is_end)
            });
            prop_assert_eq!(found, model.read(epoch, after, limit), "epoch {} after {} limit \
                                                                     {}", epoch, after, limit);
        }
        let epochs: Vec<u64> = std::iter::successors(reader.next_epoch(None), |epoch| reader.next_epoch(Some(*epoch))).collect();
        let mut expected: Vec<u64> = model.frames.keys().map(|(epoch, _)| *epoch).chain(model.ended.keys().copied()).collect();
        expected.sort_unstable();
        expected.dedup();
        prop_assert_eq!(epochs, expected);
        for span in reader.spans() {
            let numbers: Vec<u64> = model.frames.range((span.epoch, 0)..(span.epoch + 1, 0)).map(|((_, number), _)| *number).collect();
            if let (Some(first), Some(last)) = (numbers.first(), numbers.last()) {
                let missing = last + 1 - first - numbers.len() as u64;
                let to = model.ended.get(&span.epoch).copied().unwrap_or(last + 1);
                prop_assert_eq!(span, LogSpan { epoch: span.epoch, from: *first, to, missing: missing + (to - last - 1) });
            }
        }
    }
}
