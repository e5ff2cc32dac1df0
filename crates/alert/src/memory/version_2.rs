//! The state in the layout of Spandrel 0.1.0, which is version 2 of the checkpoint of alert.
//!
//! A converted state keeps active alerts, acknowledgements and the log. Fields that 0.1.0 did not
//! have receive the values of a service that has never been undecided.

use std::collections::VecDeque;

use serde::Deserialize;
use spandrel_checkpoint::Position;

use super::Basis;
use crate::decision::version_2::{Alert, Decision};

/// The version that these types read.
pub(super) const VERSION: u16 = 2;

/// [`super::AlertState`] of version 2.
#[derive(Debug, Deserialize)]
pub(super) struct AlertState {
    basis: Basis,
    watch: Watch,
    unsent: Vec<Alert>,
    log: VecDeque<Alert>,
    last_time_ns: Option<i64>,
}

impl From<AlertState> for super::AlertState {
    fn from(former: AlertState) -> Self {
        Self {
            basis: former.basis,
            watch: former.watch.into(),
            unsent: former.unsent.into_iter().map(Into::into).collect(),
            log: former.log.into_iter().map(Into::into).collect(),
            last_time_ns: former.last_time_ns,
        }
    }
}

/// [`crate::Watch`] of version 2.
#[derive(Debug, Deserialize)]
struct Watch {
    parameter_count: usize,
    decisions: Vec<Decision>,
    expected: Option<Position>,
}

impl From<Watch> for crate::Watch {
    fn from(former: Watch) -> Self {
        let decisions = former.decisions.into_iter().map(Into::into).collect();
        let mut watch = Self::from_decisions(former.parameter_count, decisions);
        watch.expected = former.expected;
        watch
    }
}

#[cfg(test)]
mod tests {
    use super::super::AlertState;
    use super::super::tests::{recalled_from, second_of};
    use crate::{Decision, Reference};
    use spandrel_bus::AlertState::{Acknowledged, Cleared, Learning, Normal, Pending, Raised};
    use spandrel_bus::Name;
    use spandrel_structure::Structure;
    use std::path::{Path, PathBuf};

    /// Returns the folder with the checkpoint that 0.1.0 left on disk, and its last published
    /// messages.
    fn kept() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/kept/0.1.0")
    }

    /// Returns the structure file of 0.1.0, with this line added to its rule.
    fn structure(line: &str) -> Structure {
        let text = std::fs::read_to_string(kept().join("structure.toml")).unwrap();
        let text = text.replace("loss = 0.05\n", &format!("loss = 0.05\n{line}\n"));
        Structure::parse(&text, "structure.toml".as_ref()).unwrap_or_else(|error| panic!("{error}"))
    }

    fn recalled(structure: &Structure) -> AlertState {
        recalled_from(
            &kept().join("state/spandrel/kept/house/checkpoints"),
            structure,
        )
    }

    fn states(alerts: impl IntoIterator<Item = crate::Alert>) -> Vec<spandrel_bus::AlertState> {
        alerts.into_iter().map(|alert| alert.state).collect()
    }

    /// Asserts that an alert equals the last alert of storey 2 published by 0.1.0, field by field.
    fn assert_is_known(alert: &crate::Alert) {
        let message = alert.to_message(
            &Name::new("house").unwrap(),
            &Name::new("storey-2").unwrap(),
        );
        let found = serde_json::to_value(message).unwrap();
        let known = std::fs::read_to_string(kept().join("known.json")).unwrap();
        let known: serde_json::Value = serde_json::from_str(&known).unwrap();
        for (field, expected) in known["alert"].as_object().unwrap() {
            assert_eq!(&found[field], expected, "{field}");
        }
    }

    #[test]
    fn state_that_0_1_0_left_holds_what_it_published() {
        let state = recalled(&structure(""));
        assert!(state.is_consistent());
        assert_eq!(state.basis.parameters, ["storey-1", "storey-2"]);
        assert_eq!(state.watch.position().map(|at| at.sequence), Some(800));
        assert_eq!(state.last_time_ns, Some(7_990_000_000));
        assert_is_known(state.watch.standing(1).unwrap());
        assert_eq!(states(state.log), [Pending, Raised, Acknowledged]);
    }

    #[test]
    fn alert_of_0_1_0_stands_on_where_the_file_gives_its_reference() {
        let structure = structure("reference = { mean = 1.0, std = 0.0 }");
        let former = recalled(&structure);
        let state = AlertState::new(&structure, None)
            .unwrap()
            .succeed(former.clone());
        assert_is_known(state.watch.standing(1).unwrap());
        assert_eq!((&state.log, &state.unsent), (&former.log, &former.unsent));
        // An almost equal reference raises it too.
        let structure = self::structure("reference.design-std = 1e-9");
        let state = AlertState::new(&structure, None)
            .unwrap()
            .succeed(former.clone());
        let alert = state.watch.standing(1).unwrap();
        assert_eq!(
            (alert.state, alert.since_ns),
            (Acknowledged, Some(4_990_000_000))
        );
        assert_eq!((&state.log, &state.unsent), (&former.log, &former.unsent));
    }

    #[test]
    fn alert_of_0_1_0_ends_in_words_where_the_rule_learns_its_reference_now() {
        let structure = structure("");
        let former = recalled(&structure);
        let unsent = former.unsent.len();
        let state = AlertState::new(&structure, None).unwrap().succeed(former);
        let told: Vec<_> = state
            .unsent
            .iter()
            .skip(unsent)
            .filter(|alert| alert.parameter == 1)
            .cloned()
            .collect();
        assert_eq!(states(told.clone()), [Cleared, Learning]);
        let why = &told[0].why;
        assert!(
            why.contains("alert of storey-2 has ended: its reference is being learnt again"),
            "{why}"
        );
        let seen = state
            .log
            .iter()
            .find(|alert| alert.state == Acknowledged)
            .unwrap();
        assert_eq!(
            seen.acknowledgement
                .as_ref()
                .map(|by| (by.who.as_str(), by.note.as_str())),
            Some(("Ada", "seen"))
        );
    }

    // 0.1.0 left four rules. The first one learns its reference, and the second one has a pending
    // alert of storey 1. The others have cleared an alert of storey 2, the last one against a
    // learnt reference.
    #[test]
    fn decisions_of_0_1_0_go_on_in_their_stages() {
        let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kept/0.1.0");
        let structure = Structure::read(&kept.join("structure.toml")).unwrap();
        let former = recalled_from(&kept, &structure);
        let present = AlertState::new(&structure, None).unwrap();
        let rules = |state: &AlertState| -> Vec<crate::Rule> {
            state
                .watch
                .decisions()
                .iter()
                .map(|decision| decision.rule().clone())
                .collect()
        };
        assert_eq!(rules(&former), rules(&present));
        let last: Vec<_> = former
            .watch
            .decisions()
            .iter()
            .map(|decision| decision.last_alert().unwrap())
            .collect();
        assert_eq!(
            states(last.iter().copied().cloned()),
            [Learning, Pending, Cleared, Cleared]
        );
        let reference = |mean, std| Some(Reference::new(mean, std).unwrap());
        let references: Vec<_> = last.iter().map(|alert| alert.reference).collect();
        assert_eq!(
            references,
            [
                None,
                reference(1.0, 0.0),
                reference(1.0, 0.0),
                reference(1.0, 0.01)
            ]
        );
        assert_eq!(former.log.len(), 10);
        assert!(
            former.unsent.iter().eq(former.log.iter().skip(7)),
            "{:?}",
            former.unsent
        );

        let mut state = present.succeed(former.clone());
        assert_eq!((&state.log, &state.unsent), (&former.log, &former.unsent));
        // Another filter now computes the estimates, so the sustain time of a pending alert starts
        // again.
        let alerts = second_of(&mut state, [0.86, 1.0]);
        assert_eq!(
            alerts
                .iter()
                .map(|alert| (alert.rule, alert.since_ns))
                .collect::<Vec<_>>(),
            [(1, Some(3_000_000_000))]
        );
        // The reference is learnt until 60 s. Of 6001 frames, 100 had a loss of 14 %.
        let alerts: Vec<_> = (4..=60)
            .flat_map(|_| second_of(&mut state, [0.86, 1.0]))
            .collect();
        let [normal] = &alerts[..] else {
            panic!("{alerts:?}")
        };
        assert_eq!(
            (normal.rule, normal.state, normal.estimate.time_ns),
            (0, Normal, 60_000_000_000)
        );
        let mean = normal.reference.unwrap().mean();
        assert!(
            (mean - (1.0 - 0.14 * 100.0 / 6001.0)).abs() < 1e-12,
            "{mean}"
        );
        assert_eq!(
            state
                .watch
                .decisions()
                .iter()
                .filter_map(Decision::last_alert)
                .count(),
            4
        );
    }
}
