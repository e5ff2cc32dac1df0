//! The past of the lasting losses of one structure.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

use super::{
    AlertState, ChangeSeen, Format, JudgementDisplay, LastingChange, Malformed, Message,
    check_count, check_label, check_text,
};
use crate::name::Name;

/// A change of the lasting loss of a quantity as an alert.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LossChange {
    /// The quantity.
    pub quantity: Name,
    /// State after the change: raised, acknowledged, or cleared. A loss is cleared by a new
    /// reference, by settings with which it is not found, if the epochs are lost, or if its
    /// quantity is not judged any more.
    pub state: AlertState,
    /// Time of the change, ns since the Unix epoch, UTC: the start of the day on which the loss was
    /// found, or the wall-clock time of its acknowledgement or end. It is later than that of the
    /// change of the quantity before.
    pub time_ns: i64,
    /// The loss. If it is over, the loss before.
    pub change: LastingChange,
    /// The person who has seen the loss. `None` if nobody has.
    pub seen: Option<ChangeSeen>,
    /// The judgement after the change in one sentence.
    pub sentence: String,
}

impl LossChange {
    /// Maximum number of changes of a structure that are kept.
    pub const MOST: usize = 256;

    /// Shortest time between two changes of a quantity (ns). A reader with floating-point numbers,
    /// such as a browser, distinguishes times that are at least 256 ns apart.
    const STEP_NS: i64 = 1_000;

    /// Appends the change that a judgement reveals to those known before, oldest first. If there
    /// are more than [`Self::MOST`], drops the oldest. Returns `false` if nothing has changed.
    pub fn note(known: &mut Vec<Self>, now: &JudgementDisplay) -> bool {
        let mut former = known.iter().rev();
        let last = former.find(|former| former.quantity == now.quantity);
        let Some(next) = Self::next(last, now) else {
            return false;
        };
        Self::append(known, next);
        true
    }

    /// Appends the end of the losses whose quantity is not judged any more. `now` contains the
    /// judgements of all quantities of the structure. Returns `false` if nothing has changed.
    pub fn end_unjudged(known: &mut Vec<Self>, now: &[JudgementDisplay]) -> bool {
        let Some(first) = now.first() else {
            return false;
        };
        let is_judged = |name: &Name| now.iter().any(|display| display.quantity == *name);
        let last: BTreeMap<&Name, &Self> = known
            .iter()
            .map(|change| (&change.quantity, change))
            .collect();
        let ended: Vec<Self> = last
            .into_values()
            .filter(|last| last.state != AlertState::Cleared && !is_judged(&last.quantity))
            .map(|last| {
                let sentence = format!("{} is no longer judged.", last.quantity);
                last.cleared(first.time_ns, sentence)
            })
            .collect();
        let has_changed = !ended.is_empty();
        for change in ended {
            Self::append(known, change);
        }
        has_changed
    }

    /// Appends a change, and drops the oldest ones above [`Self::MOST`].
    fn append(known: &mut Vec<Self>, mut next: Self) {
        let mut former = known.iter().rev();
        let last = former.find(|former| former.quantity == next.quantity);
        // A loss can be found again on the day on which it was acknowledged, or in a replay, whose
        // days have long passed.
        if let Some(last) = last.filter(|last| next.time_ns <= last.time_ns) {
            next.time_ns = last.time_ns.saturating_add(Self::STEP_NS);
        }
        known.push(next);
        let surplus = known.len().saturating_sub(Self::MOST);
        known.drain(..surplus);
    }

    /// Returns the end of this loss.
    fn cleared(&self, time_ns: i64, sentence: String) -> Self {
        Self {
            state: AlertState::Cleared,
            time_ns,
            sentence,
            ..self.clone()
        }
    }

    /// Returns the change from the last one of the quantity. `None` if nothing has changed.
    fn next(last: Option<&Self>, now: &JudgementDisplay) -> Option<Self> {
        let open = last.filter(|last| last.state != AlertState::Cleared);
        let Some((state, change)) = now.alert_state().zip(now.change) else {
            return open.map(|open| open.cleared(now.time_ns, now.sentence.clone()));
        };
        // A further loss is found again.
        let is_same = |open: &Self| (open.state, open.change.found_ns) == (state, change.found_ns);
        if open.is_some_and(is_same) {
            return None;
        }
        let seen = now.seen.clone();
        Some(Self {
            quantity: now.quantity.clone(),
            state,
            time_ns: seen.as_ref().map_or(change.found_ns, |seen| seen.time_ns),
            change,
            seen,
            sentence: now.sentence.clone(),
        })
    }

    fn check(&self) -> Result<(), Malformed> {
        self.change.check()?;
        if let Some(seen) = &self.seen {
            check_label("who", &seen.who)?;
            check_text("text", &seen.text)?;
        }
        check_text("sentence", &self.sentence)
    }
}

/// The last changes of the lasting losses of a structure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JudgementLog {
    /// Name of the structure.
    pub structure: Name,
    /// The changes, oldest first; at most [`LossChange::MOST`].
    pub changes: Vec<LossChange>,
}

impl Message for JudgementLog {
    const TYPE: &'static str = "judgement-log";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_count("changes", self.changes.len(), 0, LossChange::MOST)?;
        self.changes.iter().try_for_each(LossChange::check)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display(text: &str) -> JudgementDisplay {
        let common = "\"structure\":\"bridge\",\"quantity\":\"deck\",\"time_ns\":9,\"day_ns\":0,\
                      \"epoch_ns\":8,\"epochs\":96,\"measured\":true,\"state\":\"judged\",\
                      \"sentence\":\"as judged\",\"expectation\":null,\
                      \"false_alarms_per_year\":0.1";
        serde_json::from_str(&format!("{{{common},{text}}}")).unwrap()
    }

    fn found(kind: &str, found_ns: i64, seen: &str) -> JudgementDisplay {
        display(&format!(
            "\"change\":{{\"kind\":\"{kind}\",\"found_ns\":{found_ns},\"since_ns\":0,\
             \"loss\":0.05,\"interval\":{{\"level\":0.95,\"low\":0.04,\"high\":0.06}}}},\
             \"seen\":{seen}"
        ))
    }

    #[test]
    fn a_loss_is_raised_seen_found_again_and_over_once_each() {
        let seen = "{\"who\":\"ada\",\"text\":\"crack\",\"time_ns\":6}";
        let over = display("\"change\":null");
        let all = [
            over.clone(),
            found("stiffer", 1, "null"),
            found("lasting-loss", 5, "null"),
            found("lasting-loss", 5, "null"),
            found("lasting-loss", 5, seen),
            found("lasting-loss", 5, seen),
            found("learned-away", 7, "null"),
            over.clone(),
            over,
        ];
        let mut changes = Vec::new();
        let noted = all.map(|display| LossChange::note(&mut changes, &display));
        assert_eq!(noted.iter().filter(|noted| **noted).count(), 4);
        let told: Vec<(AlertState, i64, i64)> = changes
            .iter()
            .map(|change| (change.state, change.time_ns, change.change.found_ns))
            .collect();
        let expected = [
            (AlertState::Raised, 5, 5),
            (AlertState::Acknowledged, 6, 5),
            (AlertState::Raised, 7, 7),
            (AlertState::Cleared, 9, 7),
        ];
        assert_eq!(told, expected);
        assert_eq!(changes[1].seen.as_ref().unwrap().who, "ada");
        let log = JudgementLog {
            structure: Name::new("bridge").unwrap(),
            changes,
        };
        let bytes = log.encode().unwrap();
        let decoded = JudgementLog::decode("application/json", &bytes).unwrap();
        assert_eq!(decoded, log);
    }

    #[test]
    fn a_loss_that_is_found_again_is_newer_than_its_acknowledgement() {
        const HOUR_NS: i64 = 3_600_000_000_000;
        let day = |number: i64| 24 * number * HOUR_NS;
        let noon_ns = day(6) + 12 * HOUR_NS;
        let seen = format!("{{\"who\":\"ada\",\"text\":\"crack\",\"time_ns\":{noon_ns}}}");
        let all = [
            found("lasting-loss", day(5), "null"),
            found("lasting-loss", day(5), &seen),
            found("lasting-loss", day(6), "null"),
            // The days of a replay are before the acknowledgement.
            found("lasting-loss", day(6) + 1, "null"),
            found("lasting-loss", day(7), "null"),
        ];
        let mut changes = Vec::new();
        for display in all {
            assert!(LossChange::note(&mut changes, &display));
        }
        let told: Vec<(AlertState, i64)> = changes
            .iter()
            .map(|change| (change.state, change.time_ns))
            .collect();
        let expected = [
            (AlertState::Raised, day(5)),
            (AlertState::Acknowledged, noon_ns),
            (AlertState::Raised, noon_ns + 1_000),
            (AlertState::Raised, noon_ns + 2_000),
            (AlertState::Raised, day(7)),
        ];
        assert_eq!(told, expected);
    }

    #[test]
    fn the_loss_of_a_quantity_that_is_not_judged_any_more_ends_once() {
        let mut changes = Vec::new();
        LossChange::note(&mut changes, &found("lasting-loss", 5, "null"));
        let deck = found("lasting-loss", 5, "null");
        let girder = JudgementDisplay {
            quantity: Name::new("girder").unwrap(),
            ..display("\"change\":null")
        };
        assert!(!LossChange::end_unjudged(&mut changes, &[]));
        assert!(!LossChange::end_unjudged(
            &mut changes,
            &[girder.clone(), deck]
        ));
        assert!(LossChange::end_unjudged(
            &mut changes,
            std::slice::from_ref(&girder)
        ));
        assert!(!LossChange::end_unjudged(
            &mut changes,
            std::slice::from_ref(&girder)
        ));
        assert_eq!(changes.len(), 2);
        let last = &changes[1];
        assert_eq!((last.state, last.time_ns), (AlertState::Cleared, 9));
        assert_eq!(last.quantity.as_str(), "deck");
        assert_eq!(last.sentence, "deck is no longer judged.");
    }

    #[test]
    fn the_oldest_changes_are_dropped() {
        let mut changes = Vec::new();
        for found_ns in 0..300 {
            let display = found("lasting-loss", found_ns, "null");
            assert!(LossChange::note(&mut changes, &display));
        }
        assert_eq!(changes.len(), LossChange::MOST);
        assert_eq!(changes[0].time_ns, 44);
    }
}
