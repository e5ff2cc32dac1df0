//! Detection of silent and stuck excitation sensors.

use serde::{Deserialize, Serialize};

/// Thresholds for consecutive frames.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spans {
    /// Number of frames without samples after which an excitation is silent, and of frames with
    /// samples after which it is trusted again.
    pub(super) long: u64,
    /// Number of frames without samples that interrupt a return.
    pub(super) short: u64,
    /// Number of repetitions after which a sensor counts as stuck.
    pub(super) stuck: u64,
}

/// The state of a measured excitation: whether its samples arrive and change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Hearing {
    /// Whether repeated zeros are valid measurements.
    may_rest: bool,
    /// Whether any sample has arrived.
    known: bool,
    /// Number of consecutive frames without a sample.
    silent: u64,
    /// Number of frames since the samples returned.
    heard: u64,
    /// The last sample.
    last: f64,
    /// Number of its bit-identical repetitions while the structure moved.
    repeats: u64,
    /// Whether the excitation was silent or stuck, and has not been back for long enough.
    lost: bool,
}

/// A change of [`Hearing`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Heard {
    Silent,
    Stuck,
    Again,
}

impl Hearing {
    pub(super) fn new(may_rest: bool) -> Self {
        Self {
            may_rest,
            known: false,
            silent: 0,
            heard: 0,
            last: f64::NAN,
            repeats: 0,
            lost: false,
        }
    }

    /// Processes the measured sample of a frame, NaN if missing. `moves` states whether any
    /// response has changed.
    ///
    /// An unmeasured excitation has the `value` `None` and never changes.
    pub(super) fn take(&mut self, value: Option<f64>, moves: bool, spans: Spans) -> Option<Heard> {
        let value = value?;
        self.count_repeats(value, moves);
        let is_heard = !value.is_nan() && !self.is_stuck(spans);
        self.known |= is_heard;
        self.silent = if is_heard { 0 } else { self.silent + 1 };
        // Single lost samples, and the frames between those of a slower node, do not interrupt a
        // return.
        let is_interrupted = self.is_stuck(spans) || self.silent >= spans.short;
        let has_returned = is_heard || self.heard > 0;
        self.heard = match has_returned && !is_interrupted {
            true => self.heard + 1,
            false => 0,
        };
        if !self.lost && (self.is_stuck(spans) || self.silent >= spans.long) {
            self.lost = true;
            return Some(if self.is_stuck(spans) {
                Heard::Stuck
            } else {
                Heard::Silent
            });
        }
        if self.lost && self.heard >= spans.long {
            self.lost = false;
            return Some(Heard::Again);
        }
        None
    }

    fn count_repeats(&mut self, value: f64, moves: bool) {
        if value.is_nan() {
            // A slower node or a gap is neither a repetition nor a new value.
            return;
        }
        if value.to_bits() != self.last.to_bits() || (self.may_rest && value == 0.0) {
            self.repeats = 0;
            self.last = value;
        } else if moves {
            self.repeats += 1;
        }
    }

    /// Returns `true` if the last sample has repeated too often to be a measurement.
    pub(super) fn is_stuck(&self, spans: Spans) -> bool {
        self.repeats >= spans.stuck
    }

    /// Returns `true` if the strength of the excitation is unknown.
    ///
    /// This is the case before the first sample and after a long silence. In a short gap, the
    /// filter relies on the strength so far.
    pub(super) fn is_silent(&self) -> bool {
        self.lost || (!self.known && self.silent > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPANS: Spans = Spans {
        long: 10,
        short: 3,
        stuck: 5,
    };

    /// Processes samples while the structure moves. Returns the changes and the indices of their
    /// samples.
    fn changes(
        hearing: &mut Hearing,
        values: impl IntoIterator<Item = f64>,
        moves: bool,
    ) -> Vec<(usize, Heard)> {
        let changes = values
            .into_iter()
            .map(|value| hearing.take(Some(value), moves, SPANS))
            .enumerate();
        changes
            .filter_map(|(index, change)| Some((index, change?)))
            .collect()
    }

    #[test]
    fn repeated_sample_is_stuck_until_enough_new_samples_arrive() {
        let mut hearing = Hearing::new(false);
        assert_eq!(
            changes(
                &mut hearing,
                [1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0],
                true
            ),
            [(7, Heard::Stuck)]
        );
        assert!(hearing.is_silent() && hearing.is_stuck(SPANS));
        assert_eq!(
            changes(&mut hearing, (0..12).map(f64::from), true),
            [(9, Heard::Again)]
        );
        assert!(!hearing.is_silent());
    }

    #[test]
    fn constant_samples_at_rest_and_zero_force_are_not_stuck() {
        assert_eq!(changes(&mut Hearing::new(false), [0.5; 30], false), []);
        assert_eq!(changes(&mut Hearing::new(true), [0.0; 30], true), []);
        assert_eq!(
            changes(&mut Hearing::new(true), [0.5; 30], true),
            [(5, Heard::Stuck)]
        );
        assert_eq!(Hearing::new(false).take(None, true, SPANS), None);
    }

    #[test]
    fn slower_node_returns_and_a_short_silence_interrupts_a_return() {
        let silence = [f64::NAN; 10];
        let slow = (0..5).flat_map(|value| [f64::from(value), f64::NAN]);
        let found = changes(
            &mut Hearing::new(false),
            silence.into_iter().chain(slow),
            true,
        );
        assert_eq!(found, [(9, Heard::Silent), (19, Heard::Again)]);
        let moving = |count: i32| (0..count).map(f64::from);
        let interrupted = silence.into_iter().chain(moving(5)).chain([f64::NAN; 3]);
        let found = changes(
            &mut Hearing::new(false),
            interrupted.chain(moving(12)),
            true,
        );
        assert_eq!(found, [(9, Heard::Silent), (27, Heard::Again)]);
    }

    #[test]
    fn missing_samples_neither_hide_nor_cause_a_stuck_sensor() {
        let slow = |value: f64| [value, f64::NAN];
        let stuck = std::iter::repeat_with(|| slow(2.0)).take(6).flatten();
        assert_eq!(
            changes(&mut Hearing::new(false), stuck, true),
            [(10, Heard::Stuck)]
        );
        let moving = (0..20).map(f64::from).flat_map(slow);
        assert_eq!(changes(&mut Hearing::new(false), moving, true), []);
    }
}
