//! Decides which lasting changes require a notice, and ends notices that are no longer needed.

use crate::content::judgement_key;
use crate::outbox::Outbox;
use spandrel_bus::{JudgementDisplay, MAX_CHANNELS, Name};
use std::collections::BTreeMap;

/// The lasting changes that are known. Room for [`MAX_CHANNELS`] quantities; the changes of further
/// quantities cause no notice.
#[derive(Debug, Default)]
pub(crate) struct LastingChanges {
    /// Key of the last change of each quantity.
    known: BTreeMap<Name, String>,
}

impl LastingChanges {
    /// Processes a judgement, which arrives every few seconds. Returns `true` if its change needs a
    /// notice.
    ///
    /// A change that is over, or that somebody has seen, is no longer repeated or escalated.
    pub(crate) fn take(&mut self, display: &JudgementDisplay, outbox: &mut Outbox) -> bool {
        let quantity = &display.quantity;
        if display.change.is_none() || display.seen.is_some() {
            outbox.forget_change(&display.structure, quantity);
        }
        if display.change.is_none() {
            self.known.remove(quantity);
            return false;
        }
        let key = judgement_key(display);
        let has_room = self.known.len() < MAX_CHANNELS || self.known.contains_key(quantity);
        if !has_room || self.known.get(quantity) == Some(&key) {
            return false;
        }
        self.known.insert(quantity.clone(), key);
        display.seen.is_none()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::content::Report;
    use crate::outbox::{Moment, Wish};
    use crate::state::NoticeState;
    use crate::testing::{content, s};
    use spandrel_bus::ChangeSeen;
    use std::time::Duration;

    fn at(now: Duration) -> Moment {
        Moment {
            now,
            wall_ns: i64::try_from(now.as_nanos()).unwrap(),
        }
    }

    fn loss() -> JudgementDisplay {
        let sample = crate::samples::samples("house").pop().unwrap();
        match sample.report {
            Report::Judgement(display) => display,
            report => panic!("{report:?}"),
        }
    }

    fn seen() -> JudgementDisplay {
        JudgementDisplay {
            seen: Some(ChangeSeen {
                who: "ada".to_owned(),
                text: "on my way".to_owned(),
                time_ns: 0,
            }),
            ..loss()
        }
    }

    /// Returns the seconds at which notices are sent if somebody sees the loss after 90 s.
    fn sent(wish: Wish) -> Vec<u64> {
        let mut outbox = Outbox::new(vec![Wish {
            states: vec![NoticeState::LastingLoss],
            ..wish
        }]);
        let mut changes = LastingChanges::default();
        let mut sent = Vec::new();
        for second in (0..300).step_by(5) {
            let display = if second < 90 { loss() } else { seen() };
            if changes.take(&display, &mut outbox) {
                outbox.take(&content(Report::Judgement(display)), at(s(second)));
            }
            outbox.release(at(s(second)));
            for notice in outbox.due(s(second)) {
                sent.push(second);
                outbox.done(notice.receiver, true, s(second));
            }
        }
        sent
    }

    #[test]
    fn a_loss_that_somebody_has_seen_is_neither_escalated_nor_repeated() {
        let after = |seconds| Wish {
            after: s(seconds),
            ..Wish::default()
        };
        assert_eq!(sent(after(60)), [60]);
        assert!(sent(after(120)).is_empty());
        let repeating = Wish {
            repeats: true,
            ..Wish::default()
        };
        assert_eq!(sent(repeating), [0, 60]);
    }

    #[test]
    fn a_loss_causes_one_notice_and_another_one_once_it_is_found_again() {
        let (mut outbox, mut changes) = (Outbox::new(Vec::new()), LastingChanges::default());
        let mut again = loss();
        again.change.as_mut().unwrap().found_ns += 1;
        let taken = [loss(), loss(), seen(), again.clone(), again]
            .map(|display| changes.take(&display, &mut outbox));
        assert_eq!(taken, [true, false, false, true, false]);
        let mut changes = LastingChanges::default();
        assert!(!changes.take(&seen(), &mut outbox), "somebody knows it");
    }
}
