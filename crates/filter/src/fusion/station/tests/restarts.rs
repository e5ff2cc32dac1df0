//! Restarts of the station and its nodes: they keep their information and count nothing twice.

use super::*;
use crate::fusion::{LocalState, StationState};
use serde::de::DeserializeOwned;

/// Returns a state after serialisation and deserialisation.
fn kept<T: Serialize + DeserializeOwned>(state: &T) -> T {
    postcard::from_bytes(&postcard::to_stdvec(state).unwrap()).unwrap()
}

fn independent(nodes: usize, feedback: FeedbackRule) -> Station {
    station(nodes, FusionRule::PriorCorrect(Sharing::Nothing), feedback)
}

/// Returns the results of four nodes and a station in twelve periods.
///
/// The station is restored from its checkpoint after each period with `is_restarted`.
fn found(is_restarted: impl Fn(u64) -> bool) -> Vec<Fused> {
    let mut nodes = ROWS.map(|row| node(row, FeedbackRule::Marginal));
    let mut central = independent(4, FeedbackRule::Marginal);
    let (mut begun, mut found) = (0, Vec::new());
    for step in 0..12 * PERIOD {
        for (k, node) in nodes.iter_mut().enumerate() {
            node.step(Frame {
                observations: &[datum(k, step, ROWS[k])],
                excitation: &[],
            })
            .unwrap();
        }
        if !(step + 1).is_multiple_of(PERIOD) {
            continue;
        }
        let period = (step + 1) / PERIOD;
        let at = (period - begun) as f64;
        for (k, node) in nodes.iter_mut().enumerate() {
            central.receive(k, node.report(), at).unwrap();
        }
        let fused = central.fuse(at);
        for (node, answer) in nodes.iter_mut().zip(&fused.feedback) {
            assert_eq!(node.take(answer.as_ref().unwrap()), Taken::Applied);
        }
        found.push(fused);
        if is_restarted(period) {
            let state = kept(&central.state());
            central = independent(4, FeedbackRule::Marginal);
            central.restore(state).unwrap();
            begun = period;
        }
    }
    found
}

#[test]
fn station_restored_after_any_fusion_continues_bit_for_bit() {
    let undisturbed = found(|_| false);
    assert_eq!(found(|period| period.is_multiple_of(3)), undisturbed);
    assert_eq!(found(|_| true), undisturbed);
}

#[test]
fn a_state_of_other_sizes_is_refused_and_changes_nothing() {
    let mut central = independent(4, FeedbackRule::Marginal);
    let before = central.state();
    let refused =
        |result: Result<(), FilterError>| matches!(result, Err(FilterError::Dimension { .. }));
    assert!(refused(
        central.restore(independent(3, FeedbackRule::Marginal).state())
    ));
    let longer = Gaussian {
        mean: DVector::zeros(3),
        covariance: DMatrix::identity(3, 3),
    };
    let mut of_three = before.clone();
    of_three.fused = longer.information().unwrap();
    assert!(refused(central.restore(of_three)));
    let mut of_three = before.clone();
    of_three.known[2].own = Some(Sent {
        index: 1,
        density: longer,
    });
    assert!(refused(central.restore(of_three)));
    let mut flat = before.clone();
    flat.fused.matrix.fill(0.0);
    assert!(central.restore(flat).is_err());
    assert_eq!(central.state(), before);
}

/// The times of checkpoints and outages, in steps; `NEVER` and step `u64::MAX` are never reached.
#[derive(Clone, Copy)]
struct Lives {
    /// Step before which the nodes save their states. `station_kept` is the period after which the
    /// station saves its state.
    node_kept: u64,
    station_kept: u64,
    /// Steps of the outages of the second node, of the first node and of the station.
    second: (u64, u64),
    first: (u64, u64),
    station: (u64, u64),
}

const NEVER: (u64, u64) = (u64::MAX, u64::MAX);

/// Runs two nodes that learn independently for sixty periods.
///
/// Returns the period, the fused covariance and the covariance of the filter with all data, for
/// each fusion.
fn survived(feedback: FeedbackRule, lives: Lives) -> Vec<(u64, DMatrix<f64>, DMatrix<f64>)> {
    let is_away = |(from, to): (u64, u64), step: u64| (from..to).contains(&step);
    let mut nodes = [node(ROWS[0], feedback), node(ROWS[1], feedback)];
    let mut central = independent(2, feedback);
    let mut centralised = Centralised(prior().information().unwrap());
    let mut states: Option<[LocalState; 2]> = None;
    let mut station_state: Option<StationState> = None;
    let (mut begun, mut found) = (0, Vec::new());
    for step in 0..60 * PERIOD {
        centralised.step(step, &ROWS[..2]);
        if step == lives.node_kept {
            states = Some([kept(&nodes[0].state()), kept(&nodes[1].state())]);
        }
        for (k, away) in [lives.first, lives.second].into_iter().enumerate() {
            if step == away.1 {
                let mut anew = node(ROWS[k], feedback);
                anew.restore(states.as_ref().unwrap()[k].clone()).unwrap();
                // The sensor still has the missed samples. The node filters them again, and nothing
                // is sent.
                for missed in lives.node_kept..step {
                    anew.step(Frame {
                        observations: &[datum(k, missed, ROWS[k])],
                        excitation: &[],
                    })
                    .unwrap();
                    if anew.is_due() {
                        drop(anew.report());
                    }
                }
                central.forget(k);
                nodes[k] = anew;
            }
            if !is_away(away, step) {
                nodes[k]
                    .step(Frame {
                        observations: &[datum(k, step, ROWS[k])],
                        excitation: &[],
                    })
                    .unwrap();
            }
        }
        if step == lives.station.1 {
            central = independent(2, feedback);
            central.restore(station_state.take().unwrap()).unwrap();
            for (k, away) in [lives.first, lives.second].into_iter().enumerate() {
                if away != NEVER {
                    central.forget(k);
                }
            }
            // The clock continues as if there had been no restart. Otherwise, missing fading could
            // hide information that counts twice.
            begun = lives.station_kept;
        }
        if !(step + 1).is_multiple_of(PERIOD) {
            continue;
        }
        let period = (step + 1) / PERIOD;
        let at = (period - begun) as f64;
        for (k, away) in [lives.first, lives.second].into_iter().enumerate() {
            if !is_away(away, step) {
                let report = nodes[k].report();
                if !is_away(lives.station, step) {
                    central.receive(k, report, at).unwrap();
                }
            }
        }
        if is_away(lives.station, step) {
            continue;
        }
        let fused = central.fuse(at);
        for (node, answer) in nodes.iter_mut().zip(&fused.feedback) {
            if let Some(answer) = answer {
                assert_eq!(node.take(answer), Taken::Applied, "period {period}");
            }
        }
        if period == lives.station_kept {
            station_state = Some(kept(&central.state()));
        }
        found.push((
            period,
            fused.parameters.covariance,
            centralised.0.gaussian().unwrap().covariance,
        ));
    }
    found
}

/// Checks that no fused density is more certain than the data allow, and that nothing saved is
/// lost.
///
/// Each later density must be at least as certain as the saved density of period `kept` after
/// fading.
#[track_caller]
fn assert_sound(case: &str, kept: u64, found: &[(u64, DMatrix<f64>, DMatrix<f64>)]) {
    let (_, known, _) = found.iter().find(|(period, ..)| *period == kept).unwrap();
    for (period, fused, all) in found {
        let least = (fused - all).symmetric_eigen().eigenvalues.min();
        assert!(
            least > -1e-9,
            "{case}, period {period}: counted twice, {least:e}"
        );
        if *period > kept {
            let faded = fading().value().powf(((period - kept) * PERIOD) as f64);
            let share = fused.diagonal().component_div(&known.diagonal()).mean() / faded;
            assert!(
                share < 1.0 + 1e-9,
                "{case}, period {period}: variances are {share:.3} times what they were"
            );
        }
    }
}

const AFTER: u64 = 24 * PERIOD + 2;
const BACK: u64 = 25 * PERIOD + 1;

#[test]
fn node_resumed_from_its_checkpoint_counts_nothing_twice() {
    for feedback in [
        FeedbackRule::Marginal,
        FeedbackRule::Federated,
        FeedbackRule::None,
        FeedbackRule::Mean,
    ] {
        for node_kept in [AFTER, 22 * PERIOD, 20 * PERIOD + 3] {
            let lives = Lives {
                node_kept,
                station_kept: 0,
                second: (AFTER, BACK),
                first: NEVER,
                station: NEVER,
            };
            assert_sound(
                &format!("{feedback:?}, state of step {node_kept}"),
                24,
                &survived(feedback, lives),
            );
        }
    }
}

#[test]
fn station_resumed_from_its_checkpoint_counts_nothing_twice() {
    for feedback in [
        FeedbackRule::Marginal,
        FeedbackRule::Federated,
        FeedbackRule::None,
        FeedbackRule::Mean,
    ] {
        for station_kept in [24, 20] {
            let lives = Lives {
                node_kept: u64::MAX,
                station_kept,
                second: NEVER,
                first: NEVER,
                station: (AFTER, BACK),
            };
            assert_sound(
                &format!("{feedback:?}, state of period {station_kept}"),
                station_kept,
                &survived(feedback, lives),
            );
        }
    }
}

#[test]
fn station_and_nodes_resume_from_their_checkpoints_after_a_common_crash() {
    for feedback in [
        FeedbackRule::Marginal,
        FeedbackRule::Federated,
        FeedbackRule::None,
        FeedbackRule::Mean,
    ] {
        for (node_kept, station_kept) in [(20 * PERIOD + 3, 24), (AFTER, 20), (22 * PERIOD, 22)] {
            let away = (AFTER, BACK);
            let lives = Lives {
                node_kept,
                station_kept,
                second: away,
                first: away,
                station: away,
            };
            let case =
                format!("{feedback:?}, states of step {node_kept} and period {station_kept}");
            assert_sound(&case, station_kept, &survived(feedback, lives));
        }
    }
}

#[test]
fn node_without_replies_reports_no_lineage_after_a_restart() {
    let mut first = node(ROWS[0], FeedbackRule::Marginal);
    for step in 0..PERIOD {
        first
            .step(Frame {
                observations: &[datum(0, step, ROWS[0])],
                excitation: &[],
            })
            .unwrap();
    }
    assert_eq!(
        first.report().lineage,
        Some(Lineage {
            own: 0,
            answers: Vec::new()
        }),
        "since the prior, which all share"
    );
    let mut second = node(ROWS[0], FeedbackRule::Marginal);
    second.restore(kept(&first.state())).unwrap();
    for step in PERIOD..2 * PERIOD {
        second
            .step(Frame {
                observations: &[datum(0, step, ROWS[0])],
                excitation: &[],
            })
            .unwrap();
    }
    let message = second.report();
    assert_eq!((message.index, message.lineage), (2, None));
}
