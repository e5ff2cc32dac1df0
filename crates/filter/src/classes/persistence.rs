//! Detection of leads that have lasted long enough to act on.

use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// The criterion for a lasting lead.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PersistenceRule {
    /// The same class leads for `N_t` consecutive steps: Huang & Yuen (2023), (5.45), (5.46).
    Consecutive,
    /// [`PersistenceRule::Consecutive`] or one of two conditions on the share of steps.
    ///
    /// - A class leads in at least 90 % of the last `2 N_t` steps.
    /// - The baseline leads in at most 10 % of the last `4 N_t` steps. The class with the largest
    ///   share then wins.
    ///
    /// The second condition covers two simultaneous damages, whose classes alternate.
    #[default]
    Share,
}

/// Minimum share of a window for a lasting lead.
const NEARLY_ALL: f64 = 0.9;

/// Counts the leads of each class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Persistence {
    leader: Option<usize>,
    run: usize,
    /// Leaders of the last 4 N_t steps, the newest last.
    recent: VecDeque<u16>,
    /// Leads of each class in the last 4 N_t steps and in the last 2 N_t steps.
    counts: Vec<[usize; 2]>,
}

impl Persistence {
    pub(super) fn new(classes: usize) -> Self {
        Self {
            leader: None,
            run: 0,
            recent: VecDeque::new(),
            counts: vec![[0; 2]; classes],
        }
    }

    /// Returns the number of classes, or 0 if `recent` contains an unknown class.
    pub(super) fn classes(&self) -> usize {
        let known = |class: &u16| usize::from(*class) < self.counts.len();
        if self.recent.iter().all(known) {
            self.counts.len()
        } else {
            0
        }
    }

    /// Counts the leader of one step and returns the class whose lead has lasted.
    ///
    /// `None` as the leader means a tie, which resets all counts.
    pub(super) fn update(
        &mut self,
        leader: Option<usize>,
        steps: usize,
        rule: PersistenceRule,
    ) -> Option<usize> {
        let Some(class) = leader else {
            *self = Self::new(self.counts.len());
            return None;
        };
        self.run = if self.leader == leader {
            self.run + 1
        } else {
            1
        };
        self.leader = leader;
        if rule == PersistenceRule::Share {
            self.remember(class, steps);
        }
        if self.run >= steps {
            return Some(class);
        }
        if rule == PersistenceRule::Consecutive {
            return None;
        }
        let most =
            |window: usize| (0..self.counts.len()).max_by_key(|class| self.counts[*class][window]);
        if self.recent.len() >= 2 * steps {
            let lasting = most(1)
                .filter(|class| self.counts[*class][1] as f64 >= NEARLY_ALL * (2 * steps) as f64);
            if lasting.is_some() {
                return lasting;
            }
        }
        if self.recent.len() >= 4 * steps {
            let baseline = self.counts[0][0] as f64;
            if baseline <= (1.0 - NEARLY_ALL) * (4 * steps) as f64 {
                return most(0);
            }
        }
        None
    }

    fn remember(&mut self, class: usize, steps: usize) {
        self.recent.push_back(class as u16);
        for window in 0..2 {
            self.counts[class][window] += 1;
        }
        let len = self.recent.len();
        if len > 2 * steps {
            self.counts[usize::from(self.recent[len - 1 - 2 * steps])][1] -= 1;
        }
        if len > 4 * steps
            && let Some(oldest) = self.recent.pop_front()
        {
            self.counts[usize::from(oldest)][0] -= 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the step (from 1) and the class of the first lasting lead.
    fn first_lead(
        leaders: impl Iterator<Item = Option<usize>>,
        rule: PersistenceRule,
    ) -> Option<(usize, usize)> {
        let mut persistence = Persistence::new(3);
        leaders
            .zip(1..)
            .find_map(|(leader, step)| Some((step, persistence.update(leader, 10, rule)?)))
    }

    #[test]
    fn lead_persists_after_the_required_number_of_consecutive_steps() {
        let leaders = [0; 5].into_iter().chain([1; 20]).map(Some);
        for rule in [PersistenceRule::Consecutive, PersistenceRule::Share] {
            assert_eq!(first_lead(leaders.clone(), rule), Some((15, 1)));
        }
    }

    #[test]
    fn tie_restarts_the_count() {
        let leaders = [Some(1); 9].into_iter().chain([None]).chain([Some(1); 10]);
        assert_eq!(
            first_lead(leaders, PersistenceRule::Consecutive),
            Some((20, 1))
        );
    }

    #[test]
    fn alternating_classes_persist_only_by_share() {
        // Class 1 leads in two of three steps, class 2 in the third.
        let leaders = (0..400).map(|step| Some(if step % 3 == 2 { 2 } else { 1 }));
        assert_eq!(
            first_lead(leaders.clone(), PersistenceRule::Consecutive),
            None
        );
        assert_eq!(first_lead(leaders, PersistenceRule::Share), Some((40, 1)));
    }

    #[test]
    fn rare_interruptions_delay_no_decision_by_share() {
        let leaders = (1..400).map(|step| Some(if step % 10 == 0 { 0 } else { 2 }));
        assert_eq!(
            first_lead(leaders.clone(), PersistenceRule::Consecutive),
            None
        );
        assert_eq!(first_lead(leaders, PersistenceRule::Share), Some((20, 2)));
    }

    #[test]
    fn baseline_leading_in_between_prevents_a_decision_by_share() {
        let leaders = (0..400).map(|step| Some([1, 2, 0][step % 3]));
        assert_eq!(first_lead(leaders, PersistenceRule::Share), None);
    }
}
