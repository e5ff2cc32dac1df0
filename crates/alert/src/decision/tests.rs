use spandrel_bus::AlertState::{
    Acknowledged as Seen, Cleared, Learning as Learns, Normal, Pending, Raised, Unconfirmed,
    Undecided,
};
use spandrel_bus::FitReason;

use super::*;

const S: i64 = 1_000_000_000;

fn subject() -> Subject {
    Subject {
        parameter: 1,
        name: "storey-2".into(),
        quantity: "stiffness".into(),
        prior_std: 0.3,
        bounds: (0.1, 2.0),
    }
}

/// Returns a rule for more than 5 % with 95 % credibility for 10 s.
fn rule() -> Rule {
    Rule::new(0.05, 0.95, 0.5, 10.0).unwrap()
}

/// A decision with the alerts that it has produced.
struct Drive {
    decision: Decision,
    alerts: Vec<Alert>,
}

impl Drive {
    fn new(rule: Rule) -> Self {
        Self {
            decision: Decision::new(0, rule, subject()),
            alerts: Vec::new(),
        }
    }

    /// Processes one estimate per second.
    fn estimates(&mut self, seconds: std::ops::Range<i64>, mean: f64, std: f64) -> &mut Self {
        self.flagged(seconds, mean, std, EstimateFlags::working())
    }

    /// Processes one estimate per second with these flags.
    fn flagged(
        &mut self,
        seconds: std::ops::Range<i64>,
        mean: f64,
        std: f64,
        flags: EstimateFlags,
    ) -> &mut Self {
        for second in seconds {
            let estimate = ParameterEstimate {
                time_ns: second * S,
                mean,
                std,
            };
            self.decision
                .handle(DecisionInput::Estimate(estimate, flags), &mut self.alerts);
        }
        self
    }

    fn input(&mut self, input: DecisionInput) -> &mut Self {
        self.decision.handle(input, &mut self.alerts);
        self
    }

    fn acknowledge(&mut self) -> bool {
        let by = Acknowledged {
            who: "Ada".into(),
            note: "crew is under way".into(),
        };
        self.decision
            .handle(DecisionInput::Acknowledge(by), &mut self.alerts)
    }

    /// Returns the states with their times in s, without revisions.
    fn states(&self) -> Vec<(AlertState, i64)> {
        let changes = self.alerts.iter().filter(|alert| alert.revision == 0);
        changes
            .map(|alert| (alert.state, alert.estimate.time_ns / S))
            .collect()
    }

    /// Returns the revisions of a state with their times in s.
    fn revisions(&self, state: AlertState) -> Vec<(u32, i64)> {
        let revisions = self
            .alerts
            .iter()
            .filter(|alert| alert.revision > 0 && alert.state == state);
        revisions
            .map(|alert| (alert.revision, alert.estimate.time_ns / S))
            .collect()
    }
}

const SOUND: f64 = 1.0;
const SOFT: f64 = 0.86;
const SURE: f64 = 0.01;

/// Returns the flags of a frame whose data contradict the model.
fn contradicted() -> EstimateFlags {
    let fit_reasons = [FitReason::ExcessNoise].into_iter().collect();
    EstimateFlags {
        fit: Some(FitVerdict::Contradicted),
        fit_reasons,
        ..EstimateFlags::working()
    }
}

fn jumping() -> EstimateFlags {
    EstimateFlags {
        follows_jump: true,
        ..EstimateFlags::working()
    }
}

#[test]
fn sound_parameter_gives_no_alert() {
    let mut drive = Drive::new(rule());
    assert_eq!(drive.estimates(0..100, SOUND, SURE).states(), []);
}

#[test]
fn sustained_loss_is_pending_then_raised_after_the_sustain_time() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..5, SOUND, SURE)
        .estimates(5..30, SOFT, SURE);
    assert_eq!(drive.states(), [(Pending, 5), (Raised, 15)]);
    assert_eq!(drive.alerts[1].since_ns, Some(5 * S));
}

#[test]
fn interrupted_loss_restarts_its_sustain_time() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..9, SOFT, SURE)
        .estimates(9..10, SOUND, SURE)
        .estimates(10..30, SOFT, SURE);
    assert_eq!(
        drive.states(),
        [(Pending, 0), (Normal, 9), (Pending, 10), (Raised, 20)]
    );
}

#[test]
fn loss_of_too_low_probability_is_not_raised() {
    // 7 % loss with 2 % standard deviation: Φ((0.95 − 0.93)/0.02) = Φ(1) = 0.84.
    let mut drive = Drive::new(rule());
    assert_eq!(drive.estimates(0..100, 0.93, 0.02).states(), []);
}

#[test]
fn sustain_time_of_zero_raises_at_once() {
    let mut drive = Drive::new(Rule::new(0.05, 0.95, 0.5, 0.0).unwrap());
    assert_eq!(drive.estimates(3..5, SOFT, SURE).states(), [(Raised, 3)]);
}

#[test]
fn probability_near_the_credibility_does_not_toggle_a_raised_alert() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..11, SOFT, SURE);
    for second in 11..100 {
        // P alternates between 0.93 and 0.97 (z = 1.5 and 1.9), each for longer than the sustain
        // time. The clear credibility is 0.5.
        let mean = if second % 40 < 20 { 0.935 } else { 0.931 };
        drive.estimates(second..second + 1, mean, SURE);
    }
    assert_eq!(drive.states(), [(Pending, 0), (Raised, 10)]);
}

#[test]
fn recovery_must_be_sustained_to_clear() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..11, SOFT, SURE);
    drive
        .estimates(11..20, SOUND, SURE)
        .estimates(20..21, SOFT, SURE)
        .estimates(21..40, SOUND, SURE);
    assert_eq!(drive.states(), [(Pending, 0), (Raised, 10), (Cleared, 31)]);
}

#[test]
fn acknowledged_alert_clears_to_normal() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..11, SOFT, SURE);
    assert!(drive.acknowledge());
    drive.estimates(11..40, SOUND, SURE);
    assert_eq!(
        drive.states(),
        [
            (Pending, 0),
            (Raised, 10),
            (Seen, 10),
            (Cleared, 21),
            (Normal, 21)
        ]
    );
}

/// Regression: the growth of a loss that somebody had seen was silent.
#[test]
fn acknowledged_alert_is_raised_again_when_its_loss_has_grown() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..11, SOFT, SURE);
    assert!(drive.acknowledge());
    drive.estimates(11..20, SOFT, SURE);
    drive.estimates(20..30, SOFT - 0.1, SURE);
    assert_eq!(
        drive.states(),
        [(Pending, 0), (Raised, 10), (Seen, 10), (Raised, 20)]
    );
    assert!(drive.acknowledge());
    drive.estimates(30..50, SOFT - 0.1, SURE);
    assert_eq!(drive.states()[4..], [(Seen, 29)]);
}

/// The error of the model is the same in both losses, so it cannot hide that one is larger.
#[test]
fn error_of_the_model_does_not_delay_a_second_alert() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..11, 0.4, SURE);
    assert!(drive.acknowledge());
    drive.estimates(11..20, 0.4, SURE);
    drive.estimates(20..30, 0.34, SURE);
    assert_eq!(
        drive.states(),
        [(Pending, 0), (Raised, 10), (Seen, 10), (Raised, 20)]
    );
}

#[test]
fn unacknowledged_cleared_alert_stays_cleared_until_its_acknowledgement() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..11, SOFT, SURE)
        .estimates(11..40, SOUND, SURE);
    assert_eq!(
        drive.decision.last_alert().map(|alert| alert.state),
        Some(Cleared)
    );
    assert!(drive.acknowledge());
    assert_eq!(
        drive.decision.last_alert().map(|alert| alert.state),
        Some(Normal)
    );
}

#[test]
fn unacknowledged_cleared_alert_can_be_raised_again() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..11, SOFT, SURE)
        .estimates(11..40, SOUND, SURE)
        .estimates(40..60, SOFT, SURE);
    assert_eq!(
        drive.states()[2..],
        [(Cleared, 21), (Pending, 40), (Raised, 50)]
    );
}

#[test]
fn acknowledgement_without_a_raised_alert_has_no_effect() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..5, SOFT, SURE);
    assert!(!drive.acknowledge());
    assert_eq!(drive.states(), [(Pending, 0)]);
}

#[test]
fn second_acknowledgement_does_not_replace_the_first() {
    let mut drive = Drive::new(rule());
    drive.estimates(0..11, SOFT, SURE);
    assert!(drive.acknowledge());
    let other = Acknowledged {
        who: "Bob".into(),
        note: String::new(),
    };
    assert!(
        !drive
            .decision
            .handle(DecisionInput::Acknowledge(other), &mut drive.alerts)
    );
    assert_eq!(
        drive
            .decision
            .last_alert()
            .and_then(|alert| alert.acknowledgement.clone())
            .unwrap()
            .who,
        "Ada"
    );
}

#[test]
fn gap_and_restart_reset_a_pending_alert() {
    for interruption in [DecisionInput::Gap, DecisionInput::Restart] {
        let mut drive = Drive::new(rule());
        drive
            .estimates(0..9, SOFT, SURE)
            .input(interruption)
            .estimates(9..25, SOFT, SURE);
        assert_eq!(drive.states(), [(Pending, 0), (Pending, 9), (Raised, 19)]);
    }
}

#[test]
fn pending_alert_is_announced_as_normal_after_a_gap() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..9, SOFT, SURE)
        .input(DecisionInput::Gap)
        .estimates(9..25, SOUND, SURE);
    assert_eq!(drive.states(), [(Pending, 0), (Normal, 9)]);
}

#[test]
fn raised_alert_stays_through_gap_and_restart() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..11, SOFT, SURE)
        .input(DecisionInput::Gap)
        .estimates(100..110, SOFT, SURE)
        .input(DecisionInput::Restart);
    drive.estimates(110..200, SOFT, SURE);
    assert_eq!(drive.states(), [(Pending, 0), (Raised, 10)]);
}

#[test]
fn prior_of_a_restarted_filter_clears_no_alert() {
    let mut drive = Drive::new(rule());
    drive
        .estimates(0..11, SOFT, SURE)
        .input(DecisionInput::Restart)
        .estimates(11..60, SOUND, 0.3);
    assert_eq!(
        drive.states(),
        [(Pending, 0), (Raised, 10), (Unconfirmed, 12)]
    );
    // After a restart, the estimate is measured again, and a decision follows a second later.
    drive.estimates(60..80, SOUND, SURE);
    assert_eq!(drive.states()[3..], [(Unconfirmed, 61), (Cleared, 71)]);
}

#[test]
fn learnt_reference_carries_its_uncertainty() {
    // Learnt 0.9 ± 0.04. m = 0.80: Φ((0.855 − 0.80)/√(0.01² + 0.038²)) = Φ(1.40) = 0.919 < 0.95.
    // Against an exact 0.9 it would be Φ(5.5).
    let learning = rule().with_learnt_reference(60.0).unwrap();
    let mut drive = Drive::new(learning);
    drive
        .estimates(0..61, 0.9, 0.04)
        .estimates(61..100, 0.80, SURE);
    assert_eq!(drive.states(), [(Learns, 0), (Normal, 60), (Undecided, 62)]);
    let reference = drive.alerts[1].reference.unwrap();
    assert!((reference.mean() - 0.9).abs() < 1e-12 && (reference.std() - 0.04).abs() < 1e-12);
    // m = 0.78: Φ(0.075/0.0393) = Φ(1.91) = 0.972.
    drive.estimates(100..120, 0.78, SURE);
    assert_eq!(drive.states()[3..], [(Pending, 101), (Raised, 111)]);
}

#[test]
fn restart_while_learning_restarts_the_reference() {
    let mut drive = Drive::new(rule().with_learnt_reference(60.0).unwrap());
    drive
        .estimates(0..50, 0.2, 0.01)
        .input(DecisionInput::Restart)
        .estimates(50..111, 0.9, 0.01);
    assert_eq!(drive.states(), [(Learns, 0), (Normal, 110)]);
    assert!((drive.alerts[1].reference.unwrap().mean() - 0.9).abs() < 1e-12);
}

#[test]
fn learning_continues_while_the_reference_is_too_uncertain() {
    let mut drive = Drive::new(rule().with_learnt_reference(10.0).unwrap());
    drive.estimates(0..20, 0.9, 0.5);
    assert_eq!(drive.states(), [(Learns, 0), (Undecided, 10)]);
    drive.estimates(20..30, 0.9, 0.01);
    // The second span has ten uncertain estimates and a certain one: √(11/(10/0.5² + 1/0.01²)) =
    // 0.033. Against 0.9 ± 0.033 no estimate shows a loss of 10 %, but 0.9 excludes it: Φ((0.9 −
    // 0.81)/√(0.01² + (0.9·0.033)²)) = 0.998.
    assert_eq!(drive.states()[2..], [(Normal, 20)]);
    drive.estimates(30..40, 0.85, 0.01); // Φ(0.04/0.031) = 0.90
    assert_eq!(drive.states()[3..], [(Undecided, 31)]);
}

#[test]
fn alert_states_part_loss_probability_and_start() {
    let mut drive = Drive::new(rule());
    // Loss 14.2 % ± 1.1 % of the estimate and ± 0.05·14.2 % of the model, together ± 1.31 %:
    // interval 14.2 ∓ 1.96·1.31 = 11.6 to 16.8 %. m = 0.858 against 0.95.
    drive.estimates(61..72, 0.858, 0.011);
    assert_eq!(
        drive.alerts[1].why,
        "storey-2 has lost 14.2 % of its stiffness (95 % interval 11.6 to 16.8 %), more than 5 % \
         with probability above 0.999, since 61.00 s"
    );
    drive.acknowledge();
    assert!(
        drive.alerts[2]
            .why
            .ends_with("since 61.00 s; acknowledged by Ada: crew is under way"),
        "{}",
        drive.alerts[2].why
    );
}

#[test]
fn state_restored_at_any_second_gives_the_same_alerts() {
    let run = |restore_at: Option<i64>| {
        let mut drive = Drive::new(rule().with_learnt_reference(5.0).unwrap());
        for second in 0..60 {
            if restore_at == Some(second) {
                let bytes = postcard::to_stdvec(&drive.decision).unwrap();
                drive.decision = postcard::from_bytes(&bytes).unwrap();
            }
            let mean = if (20..40).contains(&second) {
                SOFT
            } else {
                SOUND
            };
            drive.estimates(second..second + 1, mean, SURE);
        }
        drive.alerts
    };
    let whole = run(None);
    let changes = whole.iter().filter(|alert| alert.revision == 0).count();
    assert_eq!(changes, 5); // learning, normal, pending, raised, cleared
    for second in 0..60 {
        assert_eq!(run(Some(second)), whole, "restored at {second} s");
    }
}

mod motion;
mod support;
