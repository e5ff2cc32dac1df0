//! Softening in strong motion, and what is judged after it.

use super::*;
use spandrel_bus::AlertState::SofteningInMotion;

/// Returns a decision of a structure whose motion is strong above 1 m/s².
fn drive(rule: Rule) -> Drive {
    let mut drive = Drive::new(rule);
    drive.decision = drive.decision.with_strong_motion(Some(1.0));
    drive
}

fn strong(peak_m_per_s2: f32) -> EstimateFlags {
    EstimateFlags {
        strong_motion: Some(peak_m_per_s2),
        ..EstimateFlags::working()
    }
}

#[test]
fn loss_in_strong_motion_is_softening_and_raises_nothing() {
    let mut drive = drive(rule());
    drive
        .estimates(0..5, SOUND, SURE)
        .flagged(5..40, SOFT, SURE, strong(2.0))
        .estimates(40..600, SOUND, SURE);
    assert_eq!(drive.states(), [(SofteningInMotion, 5), (Normal, 40)]);
    let why = &drive.alerts[0].why;
    for part in [
        "storey-2 is softer by 14.0 % of its stiffness",
        "in strong motion of up to 2.00 m/s²: whether this amplitude explains it is not known yet",
        "this alone shows no damage; a lasting loss is judged from weak motion, 5 minutes after \
         the strong motion",
    ] {
        assert!(why.contains(part), "{why}");
    }
}

/// Regression test: with a probability just below the required one, the state changed between
/// `softening-in-motion` and `normal`.
#[test]
fn softening_ends_at_the_probability_that_clears_an_alert() {
    let mut drive = drive(rule());
    drive
        .estimates(0..5, SOUND, SURE)
        .flagged(5..20, SOFT, SURE, strong(2.0))
        .flagged(20..40, 0.945, SURE, strong(2.0)) // more than 5 % with probability 0.69
        .estimates(40..60, SOUND, SURE);
    assert_eq!(drive.states(), [(SofteningInMotion, 5), (Normal, 40)]);
}

#[test]
fn loss_that_remains_is_pending_five_minutes_after_the_motion_and_then_raised() {
    let mut drive = drive(rule());
    drive
        .estimates(0..5, SOUND, SURE)
        .flagged(5..20, SOFT, SURE, strong(2.0))
        .estimates(20..400, SOFT, SURE);
    assert_eq!(
        drive.states(),
        [(SofteningInMotion, 5), (Pending, 319), (Raised, 329)]
    );
    assert_eq!(drive.alerts.last().unwrap().since_ns, Some(319 * S));
    // The largest amplitude is known once the strong motion has ended.
    assert_eq!(drive.revisions(SofteningInMotion), [(1, 20)]);
}

#[test]
fn loss_that_begins_while_the_structure_settles_waits_as_well() {
    let mut drive = drive(rule());
    drive
        .flagged(0..20, SOUND, SURE, strong(2.0))
        .estimates(20..100, SOUND, SURE)
        .estimates(100..400, SOFT, SURE);
    assert_eq!(
        drive.states(),
        [(SofteningInMotion, 100), (Pending, 319), (Raised, 329)]
    );
}

#[test]
fn strong_motion_without_a_limit_changes_nothing() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..5, SOUND, SURE)
        .flagged(5..30, SOFT, SURE, strong(9.0));
    assert_eq!(drive.states(), [(Pending, 5), (Raised, 15)]);
}

#[test]
fn pending_alert_is_softening_as_soon_as_the_motion_is_strong() {
    let mut drive = drive(rule());
    drive
        .estimates(0..5, SOFT, SURE)
        .flagged(5..30, SOFT, SURE, strong(2.0));
    assert_eq!(drive.states(), [(Pending, 0), (SofteningInMotion, 5)]);
}

#[test]
fn raised_alert_is_neither_revised_nor_cleared_in_strong_motion() {
    let mut drive = drive(rule());
    drive
        .estimates(0..20, SOFT, SURE)
        .flagged(20..60, 0.6, SURE, strong(2.0))
        .estimates(60..400, SOUND, SURE);
    assert_eq!(drive.states(), [(Pending, 0), (Raised, 10), (Cleared, 369)]);
    assert!(drive.revisions(Raised).iter().all(|(_, at)| *at >= 359));
}

#[test]
fn sentence_compares_the_softening_with_earlier_motions() {
    let mut drive = drive(rule());
    let mut at = 0;
    let mut shake = |drive: &mut Drive, mean: f64| {
        let first = drive.alerts.len();
        drive
            .flagged(at..at + 20, mean, SURE, strong(10.0))
            .estimates(at + 20..at + 400, SOUND, SURE);
        at += 400;
        drive.alerts[first].why.clone()
    };
    let why = shake(&mut drive, SOFT);
    assert!(why.contains("is not known yet"), "{why}");
    let why = shake(&mut drive, SOFT);
    assert!(
        why.contains("as expected at this amplitude, by one earlier motion"),
        "{why}"
    );
    let why = shake(&mut drive, 0.3);
    assert!(
        why.contains("more than expected at this amplitude, by 2 earlier motions"),
        "{why}"
    );
}

#[test]
fn reference_is_learnt_from_weak_motion() {
    let rule = rule().with_learnt_reference(10.0).unwrap();
    let mut drive = drive(rule);
    drive
        .flagged(0..20, SOFT, SURE, strong(2.0))
        .estimates(20..400, SOUND, SURE);
    assert_eq!(drive.states(), [(Learns, 0), (Normal, 329)]);
    assert_eq!(drive.alerts[1].reference.unwrap().mean(), SOUND);
}

#[test]
fn record_that_is_replayed_does_not_wait_for_the_motion_of_its_first_run() {
    let mut drive = drive(rule());
    drive
        .flagged(500..510, SOUND, SURE, strong(2.0))
        .input(DecisionInput::NewSource)
        .estimates(0..20, SOFT, SURE);
    assert_eq!(drive.states(), [(Pending, 0), (Raised, 10)]);
}

#[test]
fn decision_from_a_checkpoint_within_the_motion_goes_on_with_the_same_alerts() {
    let run = |is_restarted: bool| {
        let mut drive = drive(rule());
        drive.flagged(0..10, SOFT, SURE, strong(2.0));
        if is_restarted {
            let bytes = postcard::to_stdvec(&drive.decision).unwrap();
            let decision: Decision = postcard::from_bytes(&bytes).unwrap();
            drive.decision = decision.with_strong_motion(Some(1.0));
        }
        drive.flagged(10..20, SOFT, SURE, strong(3.0));
        drive.estimates(20..400, SOFT, SURE).alerts.clone()
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn softening_ends_with_its_rule() {
    let mut drive = drive(rule());
    drive.flagged(0..10, SOFT, SURE, strong(2.0));
    let end = drive
        .decision
        .clone()
        .ended(&crate::wording::End::Unwatched);
    let end = end.unwrap();
    assert_eq!((end.state, end.since_ns), (Normal, None));
    let other = Rule::new(0.10, 0.95, 0.5, 10.0).unwrap();
    let mut heir = Decision::new(0, other, subject()).with_strong_motion(Some(1.0));
    let mut alerts = Vec::new();
    heir.succeed(&drive.decision, Model::Same, &mut alerts);
    assert_eq!((alerts[0].state, alerts[0].since_ns), (Normal, None));
}
