//! Whether the samples of a structure are measured, replayed or simulated.

use serde::{Deserialize, Serialize};
use spandrel_bus::{Name, Pace};
use std::collections::BTreeSet;

/// Origin of the samples of a structure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Origin {
    /// Sensors measure the samples now.
    #[default]
    Measured,
    /// The samples come from a recording.
    Replayed,
    /// A model computes the samples.
    Simulated,
}

impl Origin {
    /// Returns the name of the origin.
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Replayed => "replayed",
            Self::Simulated => "simulated",
        }
    }
}

/// Time after which a partly simulated structure counts as measured, ns. The tokens of a process
/// that was killed do not disappear at the same moment.
const MIXED_FOR_NS: i64 = 5_000_000_000;

/// The origin of the samples of one structure. It remains after the samples have ended, until
/// measured samples arrive.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Origins {
    origin: Origin,
    /// Wall-clock time since which only some of the nodes are simulated, ns since the Unix epoch,
    /// UTC.
    mixed_ns: Option<i64>,
    /// Wall-clock time at which the simulated nodes left, ns since the Unix epoch, UTC.
    left_ns: Option<i64>,
    /// Nodes that have measured and have not been simulated since then. They may be absent.
    measuring: BTreeSet<Name>,
}

/// Present observations of the origin.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Signs<'s> {
    /// Nodes that are present.
    pub(crate) present: &'s BTreeSet<Name>,
    /// Nodes that are marked as simulated.
    pub(crate) simulated: &'s BTreeSet<Name>,
    /// Newest report on the pace of the samples.
    pub(crate) pace: Option<Pace>,
    /// Measurement time of the last estimate, ns since the Unix epoch, UTC.
    pub(crate) measured_ns: Option<i64>,
    /// Wall-clock time, ns since the Unix epoch, UTC.
    pub(crate) wall_ns: i64,
}

impl Origins {
    /// Updates the origin. Returns `true` if it has changed.
    ///
    /// A structure with simulated and measured nodes counts as measured, so that nobody can mute a
    /// real structure by simulating one of its nodes. A measured node counts even while it is
    /// absent, because its link may be broken.
    pub(crate) fn look(&mut self, signs: Signs<'_>) -> bool {
        let before = self.origin;
        self.measuring
            .retain(|node| !signs.simulated.contains(node));
        let is_whole = self.measuring.is_empty() && signs.present.is_subset(signs.simulated);
        if is_whole || signs.simulated.is_empty() {
            self.mixed_ns = None;
        }
        if !signs.simulated.is_empty() {
            self.left_ns = None;
            if is_whole {
                self.origin = Origin::Simulated;
            } else {
                let since_ns = *self.mixed_ns.get_or_insert(signs.wall_ns);
                if signs.wall_ns.saturating_sub(since_ns) >= MIXED_FOR_NS {
                    self.origin = Origin::Measured;
                    let measuring = signs.present.difference(signs.simulated);
                    self.measuring.extend(measuring.cloned());
                }
            }
        } else if self.origin == Origin::Simulated {
            let left_ns = *self.left_ns.get_or_insert(signs.wall_ns);
            let is_new = signs.measured_ns.is_some_and(|measured| measured > left_ns);
            match signs.pace {
                Some(Pace::Replayed) if !signs.present.is_empty() => self.origin = Origin::Replayed,
                Some(Pace::Live) if is_new => self.origin = Origin::Measured,
                _ => {}
            }
        } else {
            match signs.pace {
                Some(Pace::Replayed) => self.origin = Origin::Replayed,
                Some(Pace::Live) => {
                    self.origin = Origin::Measured;
                    self.measuring.extend(signs.present.iter().cloned());
                }
                None => {}
            }
        }
        self.origin != before
    }

    /// Returns the origin.
    pub(crate) fn origin(&self) -> Origin {
        self.origin
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::name;

    fn look(
        origins: &mut Origins,
        present: &[&str],
        simulated: &[&str],
        pace: Option<Pace>,
        measured_ns: i64,
    ) -> Origin {
        let set = |names: &[&str]| names.iter().map(|text| name(text)).collect();
        let (present, simulated) = (set(present), set(simulated));
        origins.look(Signs {
            present: &present,
            simulated: &simulated,
            pace,
            measured_ns: Some(measured_ns),
            wall_ns: 100 + measured_ns.max(0),
        });
        origins.origin()
    }

    #[test]
    fn live_simulation_is_no_measurement_even_after_it_has_ended() {
        let (all, live) = (["roof", "ground"], Some(Pace::Live));
        let mut origins = Origins::default();
        assert_eq!(look(&mut origins, &all, &all, live, 90), Origin::Simulated);
        assert_eq!(look(&mut origins, &[], &[], live, 0), Origin::Simulated);
        assert_eq!(look(&mut origins, &all, &[], live, 101), Origin::Measured);
    }

    #[test]
    fn one_simulated_node_does_not_mute_a_measured_structure() {
        let (all, live) = (["roof", "ground"], Some(Pace::Live));
        let mut origins = Origins::default();
        let mut with = |simulated: &[&str], ns| look(&mut origins, &all, simulated, live, ns);
        assert_eq!(with(&["roof"], 0), Origin::Measured);
        // The tokens of a simulation can disappear one after another.
        assert_eq!(with(&all, 1), Origin::Simulated);
        assert_eq!(with(&["roof"], 2), Origin::Simulated);
        assert_eq!(with(&["roof"], 2 + MIXED_FOR_NS), Origin::Measured);
    }

    #[test]
    fn broken_link_to_the_measured_nodes_leaves_no_simulation() {
        let live = Some(Pace::Live);
        let mut origins = Origins::default();
        let mut with = |present: &[&str], simulated: &[&str], ns| {
            look(&mut origins, present, simulated, live, ns)
        };
        with(&["roof", "ground"], &[], 0);
        with(&["roof", "ground", "middle"], &["middle"], 1);
        assert_eq!(with(&["middle"], &["middle"], 2), Origin::Measured);
        // A simulation of the whole structure replaces the measured nodes.
        let all = ["roof", "ground", "middle"];
        assert_eq!(with(&all, &all, 3), Origin::Simulated);
    }

    #[test]
    fn replay_counts_as_replayed_until_live_samples_arrive() {
        let mut origins = Origins::default();
        assert_eq!(
            look(&mut origins, &["roof"], &[], Some(Pace::Replayed), 0),
            Origin::Replayed
        );
        assert_eq!(look(&mut origins, &[], &[], None, 0), Origin::Replayed);
        assert_eq!(
            look(&mut origins, &["roof"], &[], Some(Pace::Live), 0),
            Origin::Measured
        );
    }
}
