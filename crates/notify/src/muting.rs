//! Maintenance of the structures: which notices are muted, and until when.

use crate::content::{Concern, Subject};
use spandrel_bus::{Maintenance, Name};

impl Change {
    /// Returns the period that begins or ends.
    pub(crate) fn period(&self) -> &Maintenance {
        match self {
            Self::Begins(period) | Self::Ended(period, _) | Self::Expired(period) => period,
        }
    }
}

/// Present maintenance. Its checkpoint is the list itself.
#[derive(Debug, Default)]
pub(crate) struct Muting {
    periods: Vec<Maintenance>,
}

/// A beginning or an end of maintenance.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Change {
    Begins(Maintenance),
    /// A person ended it early.
    Ended(Maintenance, String),
    /// Its time is over.
    Expired(Maintenance),
}

impl Muting {
    /// Processes a message. A period replaces an earlier one of the same structure and part.
    ///
    /// `wall_ns` is the wall-clock time, ns since the Unix epoch, UTC. No period lasts longer than
    /// [`Maintenance::LONGEST_NS`] from now, whatever the clock of the sender.
    pub(crate) fn take(&mut self, message: Maintenance, wall_ns: i64) -> Option<Change> {
        let same = |period: &Maintenance| {
            (&period.structure, &period.parameter) == (&message.structure, &message.parameter)
        };
        let former = self.periods.iter().position(same);
        let former = former.map(|index| self.periods.remove(index));
        if message.is_end() {
            return former.map(|former| Change::Ended(former, message.who));
        }
        let latest_ns = wall_ns.saturating_add(Maintenance::LONGEST_NS);
        let period = Maintenance {
            until_ns: message.until_ns.min(latest_ns),
            ..message
        };
        self.periods.push(period.clone());
        Some(Change::Begins(period))
    }

    /// Restores the maintenance of a structure.
    pub(crate) fn recall(&mut self, periods: Vec<Maintenance>) {
        self.periods.extend(periods);
    }

    /// Removes and returns the periods that are over.
    pub(crate) fn expire(&mut self, wall_ns: i64) -> Vec<Change> {
        let over = |period: &mut Maintenance| period.until_ns <= wall_ns;
        self.periods
            .extract_if(.., over)
            .map(Change::Expired)
            .collect()
    }

    /// Returns the period that mutes the notices about a subject.
    ///
    /// Maintenance of a parameter does not mute the clock of a node that has the same name.
    pub(crate) fn of(&self, subject: &Subject) -> Option<&Maintenance> {
        let (structure, part, concern) = subject;
        let part = part.as_ref().filter(|_| *concern != Concern::Clock);
        let mut periods = self.periods.iter();
        periods.find(|period| period.structure == *structure && period.covers(part))
    }

    /// Returns all periods of a structure.
    pub(crate) fn of_structure(&self, structure: &Name) -> Vec<Maintenance> {
        let own = |period: &&Maintenance| period.structure == *structure;
        self.periods.iter().filter(own).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{maintenance, name};

    #[test]
    fn maintenance_mutes_until_its_end_and_for_a_limited_time() {
        let mut muting = Muting::default();
        let period = maintenance(Some("deck"), 10, 100);
        assert_eq!(
            muting.take(period.clone(), 10),
            Some(Change::Begins(period.clone()))
        );
        let house = name("house");
        let is_muted = |part: Option<&str>, concern| {
            let subject = (house.clone(), part.map(name), concern);
            muting.of(&subject).is_some()
        };
        assert!(is_muted(Some("deck"), Concern::Present));
        assert!(!is_muted(Some("deck"), Concern::Clock));
        assert!(!is_muted(Some("pier"), Concern::Present));
        assert!(!is_muted(None, Concern::Present));
        assert_eq!(muting.expire(99), []);
        assert_eq!(muting.expire(100), [Change::Expired(period)]);
        assert!(muting.of_structure(&house).is_empty());
        // The clock of the sender is a year ahead.
        let year = 365 * 86_400_000_000_000;
        muting.take(maintenance(None, year, year + 5), 0);
        let clock = (house, Some(name("roof")), Concern::Clock);
        assert!(muting.of(&clock).is_some());
        assert_eq!(muting.expire(Maintenance::LONGEST_NS).len(), 1);
    }

    #[test]
    fn maintenance_can_end_early_and_a_new_period_replaces_the_former() {
        let mut muting = Muting::default();
        muting.take(maintenance(None, 10, 100), 10);
        muting.take(maintenance(None, 20, 200), 20);
        let periods = muting.of_structure(&name("house"));
        assert_eq!(periods, [maintenance(None, 20, 200)]);
        let ended = muting.take(maintenance(None, 30, 30), 30);
        assert_eq!(
            ended,
            Some(Change::Ended(periods[0].clone(), "ada".to_owned()))
        );
        assert_eq!(muting.take(maintenance(None, 30, 30), 30), None);
    }
}
