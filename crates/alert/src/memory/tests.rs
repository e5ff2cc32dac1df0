use spandrel_bus::AlertState::{Acknowledged as Seen, Cleared, Learning, Normal, Pending, Raised};
use spandrel_bus::{Estimate, EstimateBlock, EstimateFlags, Header, StreamState};

use super::*;
use crate::Acknowledged;
use std::path::Path;

const TOWER: &str = include_str!("../../tests/tower.toml");
const RULE: &str = "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
                    credibility = 0.95\nsustain-s = 0.5\n";

/// Returns the tower file with both storeys identified and these alert rules.
fn tower(rules: &str) -> String {
    let without_rule = TOWER.split("[[alert]]").next().unwrap();
    format!(
        "{without_rule}{rules}[[parameter]]\nname = \"storey-2\"\nscales = \"stiffness\"\n\
         of = [\"storey-2\"]\nstd = 0.2\n"
    )
}

fn structure(text: &str) -> Structure {
    Structure::parse(text, "tower.toml".as_ref()).unwrap_or_else(|error| panic!("{error}"))
}

fn new(text: &str) -> AlertState {
    AlertState::new(&structure(text), None).unwrap()
}

/// Processes a second of estimates with these means and a standard deviation of 0.01.
pub(super) fn second_of(state: &mut AlertState, means: [f64; 2]) -> Vec<Alert> {
    let estimate = Estimate {
        mean: means.to_vec(),
        covariance: vec![1e-4, 0.0, 1e-4],
        noise_mean: vec![],
        noise_covariance: vec![],
        innovations: vec![0.0],
        normalised_innovation_squared: 0.0,
        log_evidence: 0.0,
        used_channels: 1,
        flags: EstimateFlags::working(),
        excluded: spandrel_bus::Excluded::None,
        sustained_information: Vec::new(),
    };
    let sequence = state.watch.position().map_or(0, |at| at.sequence);
    let block = EstimateBlock {
        header: Header {
            source: "identify".into(),
            epoch: 1,
            sequence,
            time_ns: sequence as i64 * 10_000_000,
        },
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 100.0,
        parameters: 2,
        noise_parameters: 0,
        channels: 1,
        estimates: vec![estimate; 100],
        state: StreamState::Running,
    };
    let mut alerts = Vec::new();
    state.watch.handle_block(&block, &mut alerts).unwrap();
    state.log.extend(alerts.iter().cloned());
    alerts
}

/// Returns the state in the newest checkpoint of a folder, of any version.
pub(super) fn recalled_from(kept: &Path, structure: &Structure) -> AlertState {
    let folder = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(kept).unwrap() {
        let path = entry.unwrap().path();
        std::fs::copy(&path, folder.path().join(path.file_name().unwrap())).unwrap();
    }
    let remembering = Remembering {
        folder: folder.path().to_owned(),
        every: Duration::from_secs(5),
    };
    let memory = Memory::open(structure, &remembering).unwrap().recall();
    memory.expect("a checkpoint that is read")
}

/// Returns a state in which storey 2 has lost 14 %. Ada has acknowledged the alert if
/// `acknowledged`.
fn raised(text: &str, acknowledged: bool) -> AlertState {
    let mut state = new(text);
    second_of(&mut state, [1.0, 0.86]);
    if acknowledged {
        let by = Acknowledged {
            who: "Ada".into(),
            note: String::new(),
        };
        assert!(state.watch.acknowledge(1, &by, &mut Vec::new()));
    }
    state
}

fn stands(state: &AlertState) -> Option<(spandrel_bus::AlertState, f64)> {
    state
        .watch
        .standing(1)
        .map(|alert| (alert.state, alert.rule_loss))
}

/// Returns state, parameter name and words of each alert caused by the change.
fn told(state: &AlertState) -> Vec<(spandrel_bus::AlertState, &str, &str)> {
    let name = |alert: &Alert| state.basis.parameters[alert.parameter].as_str();
    state
        .unsent
        .iter()
        .map(|alert| (alert.state, name(alert), alert.why.as_str()))
        .collect()
}

#[test]
fn comments_formatting_and_what_concerns_no_alert_change_nothing() {
    let former = raised(&tower(RULE), true);
    let with_comment = format!(
        "# seen by the owner\n{}",
        tower(RULE).replace("storeys = 2", "storeys   =   2")
    );
    assert_eq!(new(&with_comment).succeed(former.clone()), former);
    let with_simulation = format!("{}[simulation]\nseed = 7\n", tower(RULE));
    assert_eq!(new(&with_simulation).succeed(former.clone()), former);
}

#[test]
fn checkpoint_read_under_the_same_rules_is_not_a_change() {
    let mut state = new(&tower(RULE));
    let mut decisions = state.watch.decisions().to_vec();
    decisions[1] = decisions[1]
        .clone()
        .with_changes_without(vec![None, Some(0.04)]);
    state.watch = Watch::from_decisions(2, decisions);
    second_of(&mut state, [1.0, 0.86]);
    let read: AlertState = postcard::from_bytes(&postcard::to_stdvec(&state).unwrap()).unwrap();
    assert_ne!(state, read);
    assert!(state.is_stored_like(&read));
    second_of(&mut state, [1.0, 0.86]);
    assert!(!state.is_stored_like(&read));
}

/// A service of version 4 has resumed from the checkpoint of 0.1.0, and published its unsent
/// alerts.
#[test]
fn state_of_version_4_holds_what_its_service_had_read() {
    let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kept");
    let structure = Structure::read(&kept.join("0.1.0/structure.toml")).unwrap();
    let oldest = recalled_from(&kept.join("0.1.0"), &structure);
    let mut expected = AlertState::new(&structure, None).unwrap().succeed(oldest);
    let mut read = recalled_from(&kept.join("4"), &structure);
    assert_eq!(read.log.len(), 10);
    expected.unsent.clear();
    assert!(read.is_stored_like(&expected), "{read:?}\n{expected:?}");
    for second in 4..=60 {
        let (found, expected) = (
            second_of(&mut read, [0.86, 1.0]),
            second_of(&mut expected, [0.86, 1.0]),
        );
        assert_eq!(found, expected, "{second} s");
    }
}

#[test]
fn a_rule_beside_it_or_before_it_costs_no_acknowledgement() {
    let other = RULE.replace("0.05", "0.3");
    for rules in [format!("{other}{RULE}"), format!("{RULE}{other}")] {
        let state = new(&tower(&rules)).succeed(raised(&tower(RULE), true));
        assert_eq!(
            (stands(&state), told(&state)),
            (Some((Seen, 0.05)), vec![]),
            "{rules}"
        );
    }
}

#[test]
fn an_alert_that_the_changed_rule_does_not_raise_ends_with_a_reason() {
    let changed = tower(&RULE.replace("0.05", "0.2"));
    let state = new(&changed).succeed(raised(&tower(RULE), false));
    let why = "alert of storey-2 has ended: its rule changed from more than 5 % with probability \
               0.950 for 0.5 s to more than 20 % with probability 0.950 for 0.5 s; the probability \
               of that loss by the last estimate is below 0.001";
    assert_eq!(told(&state), [(Cleared, "storey-2", why)]);
    assert_eq!(stands(&state), Some((Cleared, 0.2)));
    assert_eq!(state.log.back().map(|alert| alert.state), Some(Cleared));
    // An acknowledged alert becomes normal without a further acknowledgement.
    let state = new(&changed).succeed(raised(&tower(RULE), true));
    assert_eq!(
        told(&state).iter().map(|told| told.0).collect::<Vec<_>>(),
        [Cleared, Normal]
    );
}

#[test]
fn an_alert_that_ends_by_another_reference_says_what_the_loss_counts_from() {
    let counted_from = |mean, std| {
        tower(&format!(
            "{}reference = {{ mean = {mean}, std = {std} }}\n",
            RULE.replace("reference.design-std = 1e-9\n", "")
        ))
    };
    let state = new(&counted_from(0.87, 0.02)).succeed(raised(&counted_from(1.045, 0.046), false));
    let why = "alert of storey-2 has ended: its rule changed from more than 5 % below 1.045 ± \
               0.046 with probability 0.950 for 0.5 s to more than 5 % below 0.870 ± 0.020 with \
               probability 0.950 for 0.5 s; the probability of that loss by the last estimate is \
               0.059";
    assert_eq!(told(&state), [(Cleared, "storey-2", why)]);
}

#[test]
fn an_alert_that_the_changed_rule_raises_too_stands_with_its_acknowledgement() {
    let mut state = new(&tower(&RULE.replace("0.05", "0.1"))).succeed(raised(&tower(RULE), true));
    assert_eq!((stands(&state), told(&state)), (Some((Seen, 0.1)), vec![]));
    assert_eq!(second_of(&mut state, [1.0, 0.86]), []);
}

#[test]
fn an_alert_that_no_rule_watches_ends_with_a_reason() {
    let rule = RULE.replace("\"all\"", "[\"storey-1\"]");
    let state = new(&tower(&rule)).succeed(raised(&tower(RULE), false));
    let why = "alert of storey-2 has ended: the structure file no longer contains a rule for it";
    assert_eq!(
        (told(&state), stands(&state)),
        (vec![(Cleared, "storey-2", why)], None)
    );
}

#[test]
fn an_alert_of_a_parameter_that_is_gone_ends_under_its_name() {
    let state = new(TOWER).succeed(raised(&tower(RULE), false));
    let why = "alert of storey-2 has ended: the structure file no longer contains the parameter";
    assert_eq!(told(&state), [(Cleared, "storey-2", why)]);
    assert!(state.is_consistent() && state.watch.parameter_count() == 1);
    // The name disappears with the last alert that mentions it.
    let mut later = state;
    (later.unsent, later.log) = (Vec::new(), VecDeque::new());
    assert_eq!(new(TOWER).succeed(later).basis.parameters, ["storey-1"]);
}

#[test]
fn parameters_that_change_places_keep_their_alerts() {
    let text = tower(RULE);
    let swapped = text
        .replace("storey-1", "storey-x")
        .replace("storey-2", "storey-1")
        .replace("storey-x", "storey-2");
    let state = new(&swapped).succeed(raised(&text, true));
    assert_eq!(
        state
            .watch
            .standing(0)
            .map(|alert| (alert.state, alert.parameter)),
        Some((Seen, 0))
    );
    assert_eq!(told(&state), []);
}

#[test]
fn what_was_pending_is_told_to_be_normal_by_the_changed_rule() {
    let mut former = new(&tower(&RULE.replace("0.5\n", "60\n")));
    assert_eq!(second_of(&mut former, [1.0, 0.86])[0].state, Pending);
    let state = new(&tower(&RULE.replace("0.05", "0.2"))).succeed(former);
    assert_eq!(
        told(&state).iter().map(|told| told.0).collect::<Vec<_>>(),
        [Normal]
    );
}

#[test]
fn another_model_clears_an_alert_only_by_what_it_identifies() {
    let heavier = tower(RULE).replace("mass-kg = 1000", "mass-kg = 1100");
    let mut state = new(&heavier).succeed(raised(&tower(RULE), true));
    assert_eq!((stands(&state), told(&state)), (Some((Seen, 0.05)), vec![]));
    let states: Vec<_> = second_of(&mut state, [1.0, 1.0])
        .iter()
        .map(|alert| alert.state)
        .collect();
    assert_eq!(states, [Cleared, Normal]);
}

#[test]
fn a_reference_that_was_learnt_ends_with_its_model() {
    let learning = tower(&format!(
        "{}reference = {{ learn-s = 0.5 }}\n",
        RULE.replace("reference.design-std = 1e-9\n", "")
    ));
    let mut former = new(&learning);
    second_of(&mut former, [1.0, 1.0]);
    let raised = second_of(&mut former, [1.0, 0.8]);
    assert_eq!(raised.last().map(|alert| alert.state), Some(Raised));
    assert_eq!(told(&new(&learning).succeed(former.clone())), []);
    // A rule with another loss keeps the learnt reference.
    let other_loss = learning.replace("loss = 0.05", "loss = 0.1");
    assert_eq!(
        stands(&new(&other_loss).succeed(former.clone())),
        Some((Raised, 0.1))
    );
    let state = new(&learning.replace("mass-kg = 1000", "mass-kg = 1100")).succeed(former);
    assert_eq!(
        told(&state).iter().map(|told| told.0).collect::<Vec<_>>(),
        [Cleared, Learning]
    );
    assert!(
        told(&state)[0]
            .2
            .contains("is being learnt again because the rule or the model changed")
    );
}
