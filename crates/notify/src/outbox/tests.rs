use super::*;
use crate::testing::{alert, content, maintenance, monitoring, name, of_alert, s};
use spandrel_bus::{AlertState, MonitoringState};

/// Returns the alert of a notice.
fn of(notice: &Notice) -> &AlertMessage {
    match &notice.content.report {
        Report::Alert(alert) => alert,
        report => panic!("{report:?}"),
    }
}

fn at(now: Duration) -> Moment {
    Moment {
        now,
        wall_ns: i64::try_from(now.as_nanos()).unwrap(),
    }
}

fn take(outbox: &mut Outbox, alert: &AlertMessage, now: Duration) {
    outbox.take(&of_alert(alert), at(now));
}

fn outbox(repeats: bool) -> Outbox {
    let states = vec![NoticeState::Raised, NoticeState::Cleared];
    let wish = |name: &str, states, repeats| Wish {
        name: name.to_owned(),
        states,
        repeats,
        ..Wish::default()
    };
    Outbox::new(vec![
        wish("hook", states, repeats),
        wish("mail", vec![NoticeState::Acknowledged], false),
    ])
}

#[test]
fn each_change_is_sent_once_to_its_receivers() {
    let mut outbox = outbox(false);
    for _ in 0..3 {
        take(&mut outbox, &alert(10, AlertState::Pending), s(0));
        take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    }
    let due = outbox.due(s(0));
    assert_eq!(
        due.iter()
            .map(|notice| (notice.receiver, of(notice).state))
            .collect::<Vec<_>>(),
        [(0, AlertState::Raised)]
    );
    assert!(
        due[0].content.key.ends_with("/storey-2/20000000000/raised"),
        "{}",
        due[0].content.key
    );
    assert_eq!(outbox.due(s(1)), [], "it is on its way");
    outbox.done(0, true, s(1));
    take(&mut outbox, &alert(30, AlertState::Acknowledged), s(2));
    assert_eq!(
        outbox
            .due(s(2))
            .iter()
            .map(|notice| notice.receiver)
            .collect::<Vec<_>>(),
        [1]
    );
    assert_eq!((outbox.sent, outbox.waiting()), (1, 1));
}

#[test]
fn failed_notices_are_retried_in_order_at_growing_intervals() {
    let mut outbox = outbox(false);
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    take(&mut outbox, &alert(40, AlertState::Cleared), s(0));
    let mut attempts = Vec::new();
    for second in 0..4_000 {
        for notice in outbox.due(s(second)) {
            assert_eq!(
                of(&notice).state,
                AlertState::Raised,
                "the second waits for the first"
            );
            attempts.push(second);
            outbox.done(0, false, s(second));
        }
    }
    assert_eq!(attempts[..6], [0, 2, 6, 14, 30, 62]);
    assert!(attempts.windows(2).all(|pair| pair[1] - pair[0] <= 300));
    for notice in outbox.due(s(5_000)) {
        outbox.done(notice.receiver, true, s(5_000));
    }
    assert_eq!(of(&outbox.due(s(5_000))[0]).state, AlertState::Cleared);
    outbox.done(0, false, s(5_000));
    // A receiver that never recovers is given up after a day.
    for second in (5_000..200_000).step_by(100) {
        let due = outbox.due(s(second));
        for notice in due {
            outbox.done(notice.receiver, false, s(second));
        }
    }
    assert_eq!((outbox.given_up, outbox.waiting()), (1, 0));
    assert_eq!(outbox.take_lost(), [(0, 1)]);
    assert_eq!(outbox.take_lost(), []);
}

/// Regression: the failures of all receivers since the start had one counter, so that the first
/// failures of a second receiver were not logged.
#[test]
fn first_failure_in_a_row_of_each_receiver_is_logged() {
    let mut outbox = outbox(false);
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    take(&mut outbox, &alert(30, AlertState::Acknowledged), s(0));
    let fail = |outbox: &mut Outbox, receiver| outbox.done(receiver, false, s(0));
    let hook: Vec<bool> = (0..5).map(|_| fail(&mut outbox, 0)).collect();
    assert_eq!(hook, [true, true, false, true, false]);
    assert!(fail(&mut outbox, 1), "the first failure of the second");
    assert!(!outbox.done(0, true, s(1)));
    take(&mut outbox, &alert(40, AlertState::Cleared), s(2));
    assert!(fail(&mut outbox, 0), "the first failure after a success");
}

#[test]
fn active_alert_is_repeated_to_receivers_with_repetition() {
    let mut outbox = outbox(true);
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    let mut sent = Vec::new();
    for second in 0..200 {
        if second == 150 {
            take(&mut outbox, &alert(170, AlertState::Cleared), s(second));
        }
        for notice in outbox.due(s(second)) {
            sent.push((second, of(&notice).state));
            outbox.done(notice.receiver, true, s(second));
        }
    }
    let raised = AlertState::Raised;
    assert_eq!(
        sent,
        [
            (0, raised),
            (60, raised),
            (120, raised),
            (150, AlertState::Cleared)
        ]
    );
}

/// Returns the notices sent for one alert with these states and losses.
fn sent(states: &[(AlertState, f64)]) -> Vec<(AlertState, f64)> {
    let mut outbox = outbox(false);
    let mut sent = Vec::new();
    for (second, (state, loss)) in (20..).zip(states) {
        take(
            &mut outbox,
            &AlertMessage {
                loss: Some(*loss),
                ..alert(second, *state)
            },
            s(0),
        );
        while let Some(notice) = outbox.due(s(0)).pop() {
            sent.push((of(&notice).state, of(&notice).loss.unwrap()));
            outbox.done(notice.receiver, true, s(0));
        }
    }
    sent
}

#[test]
fn revision_is_sent_when_the_loss_has_doubled() {
    use AlertState::{Acknowledged, Cleared, Raised};
    let losses = [0.12, 0.15, 0.2, 0.25, 0.4, 0.49, 0.51].map(|loss| (Raised, loss));
    assert_eq!(
        sent(&losses),
        [(Raised, 0.12), (Raised, 0.25), (Raised, 0.51)]
    );
    let seen = [
        (Raised, 0.12),
        (Acknowledged, 0.12),
        (Acknowledged, 0.2),
        (Cleared, 0.0),
        (Raised, 0.12),
    ];
    assert_eq!(sent(&seen), [seen[0], seen[1], seen[3], seen[4]]);
}

#[test]
fn confirmed_alert_and_repeated_end_are_not_sent_again() {
    use AlertState::{Cleared, Raised, Unconfirmed};
    let states = [Raised, Unconfirmed, Raised, Cleared, Cleared, Raised].map(|state| (state, 0.12));
    assert_eq!(sent(&states), [states[0], states[3], states[5]]);
}

#[test]
fn acknowledged_alert_that_is_raised_again_is_sent() {
    use AlertState::{Acknowledged, Raised};
    let states = [
        (Raised, 0.12),
        (Acknowledged, 0.12),
        (Acknowledged, 0.13),
        (Raised, 0.16),
    ];
    let expected = [(Raised, 0.12), (Raised, 0.16)];
    let mut found = sent(&states);
    found.retain(|(state, _)| *state == Raised);
    assert_eq!(found, expected);
}

/// Regression: receivers learnt that a structure is watched again, but not that it had not been.
#[test]
fn end_of_a_blindness_is_sent_to_those_who_know_of_it() {
    let wish = |states: &[NoticeState]| Wish {
        states: states.to_vec(),
        ..Wish::default()
    };
    use NoticeState::{Blind, Degraded, Watching};
    let mut outbox = Outbox::new(vec![
        wish(&[Blind, Watching]),
        wish(&[Blind, Degraded, Watching]),
    ]);
    let mut sent = Vec::new();
    let spans = [
        MonitoringState::Degraded,
        MonitoringState::Watching,
        MonitoringState::Blind,
        MonitoringState::Degraded,
        MonitoringState::Watching,
    ];
    for (number, state) in spans.into_iter().enumerate() {
        let second = 10 * number as i64;
        let report = monitoring(second, state, second, &[]);
        let now = s(10 * number as u64);
        outbox.take(&content(Report::Monitoring(report)), at(now));
        for notice in outbox.due(now) {
            sent.push((number, notice.receiver));
            outbox.done(notice.receiver, true, now);
        }
    }
    assert_eq!(
        sent,
        [(0, 1), (1, 1), (2, 0), (2, 1), (3, 1), (4, 0), (4, 1)]
    );
}

#[test]
fn end_of_each_alert_is_sent() {
    use AlertState::{Cleared, Raised};
    let states = [Raised, Cleared, Raised, Cleared].map(|state| (state, 0.12));
    assert_eq!(sent(&states), states);
}

#[test]
fn change_is_not_sent_again_after_a_restart() {
    let mut first = outbox(false);
    take(&mut first, &alert(20, AlertState::Raised), s(0));
    let house = alert(20, AlertState::Raised).structure;
    let mut second = outbox(false);
    second.recall(&house, first.remembered(&house, s(0)), s(0), s(0));
    take(
        &mut second,
        &AlertMessage {
            revision: 1,
            ..alert(21, AlertState::Raised)
        },
        s(0),
    );
    assert_eq!(second.waiting(), 1);
}

#[test]
fn unconfirmed_alert_is_repeated_and_a_revision_does_not_delay_it() {
    let mut outbox = outbox(true);
    for (second, state) in [
        (20, AlertState::Raised),
        (50, AlertState::Raised),
        (70, AlertState::Unconfirmed),
    ] {
        take(&mut outbox, &alert(second, state), s(second as u64));
        for notice in outbox.due(s(second as u64)) {
            outbox.done(notice.receiver, true, s(second as u64));
        }
    }
    assert_eq!(outbox.due(s(79)), []);
    assert_eq!(of(&outbox.due(s(80))[0]).state, AlertState::Unconfirmed);
}

#[test]
fn number_of_waiting_notices_is_bounded() {
    let mut outbox = outbox(false);
    for second in 0..5_000 {
        take(
            &mut outbox,
            &AlertMessage {
                since_ns: Some(second),
                ..alert(second, AlertState::Raised)
            },
            s(0),
        );
    }
    assert_eq!((outbox.waiting(), outbox.given_up), (MOST_WAITING, 4_000));
    assert_eq!(outbox.take_lost(), [(0, 4_000)]);
}

#[test]
fn undelivered_notices_are_sent_once_after_a_restart() {
    let mut first = outbox(false);
    for (second, state) in [
        (20, AlertState::Raised),
        (30, AlertState::Cleared),
        (40, AlertState::Raised),
    ] {
        take(&mut first, &alert(second, state), s(0));
    }
    let told = first.due(s(0)).remove(0);
    first.done(0, true, s(1));
    let house = alert(20, AlertState::Raised).structure;
    assert_eq!(
        first.take_changed().into_iter().collect::<Vec<_>>(),
        std::slice::from_ref(&house)
    );
    let remembered = first.remembered(&house, s(10));
    assert_eq!(remembered.waiting(), 2);

    let mut second = outbox(false);
    assert_eq!(second.recall(&house, remembered.clone(), s(100), s(5)), 0);
    take(&mut second, of(&told), s(100));
    let mut keys = Vec::new();
    while let Some(notice) = second.due(s(100)).pop() {
        keys.push(notice.content.key);
        second.done(0, true, s(100));
    }
    assert_eq!(
        keys,
        [
            "house/storey-2/30000000000/cleared",
            "house/storey-2/40000000000/raised"
        ]
    );
    assert_eq!(second.remembered(&house, s(100)).waiting(), 0);

    // Notices for one receiver do not go to a receiver with another name or other states.
    let wish = Wish {
        name: "another".to_owned(),
        states: vec![NoticeState::Raised],
        repeats: false,
        ..Wish::default()
    };
    let mut other = Outbox::new(vec![wish]);
    assert_eq!(
        (
            other.recall(&house, remembered, s(0), s(0)),
            other.waiting(),
            other.given_up
        ),
        (2, 0, 2)
    );
}

#[test]
fn active_alert_is_repeated_after_a_restart_and_repetitions_are_not_stored() {
    let mut first = outbox(true);
    take(&mut first, &alert(20, AlertState::Raised), s(0));
    first.due(s(0));
    first.done(0, true, s(0));
    first.take_changed();
    assert_eq!(first.due(s(60)).len(), 1);
    let house = alert(20, AlertState::Raised).structure;
    let remembered = first.remembered(&house, s(60));
    assert_eq!(remembered.waiting(), 0);
    first.done(0, true, s(60));
    assert!(first.take_changed().is_empty());

    let mut second = outbox(true);
    second.recall(&house, remembered, s(0), s(0));
    assert_eq!(second.due(s(0)).len(), 1, "it stands");
    second.done(0, true, s(0));
    take(&mut second, &alert(50, AlertState::Cleared), s(1));
    assert_eq!(of(&second.due(s(1))[0]).state, AlertState::Cleared);
    second.done(0, true, s(1));
    // A missed change that arrives late does not make the alert active again.
    take(&mut second, &alert(30, AlertState::Raised), s(2));
    second.due(s(2));
    second.done(0, true, s(2));
    assert_eq!(second.due(s(200)), []);
}

#[test]
fn downtime_counts_towards_the_expiry_of_a_notice() {
    let mut first = outbox(false);
    take(&mut first, &alert(20, AlertState::Raised), s(0));
    let house = alert(20, AlertState::Raised).structure;
    let (start, day) = (GIVE_UP_AFTER, GIVE_UP_AFTER);
    let mut second = outbox(false);
    second.recall(
        &house,
        first.remembered(&house, s(3_600)),
        start,
        day - s(3_600),
    );
    assert_eq!(second.due(start).len(), 1);
    second.done(0, false, start);
    assert_eq!(second.waiting(), 1, "exactly a day");
    assert_eq!(second.due(start + s(2)).len(), 1);
    second.done(0, false, start + s(2));
    assert_eq!((second.waiting(), second.given_up), (0, 1));
}

#[test]
fn stored_state_is_bounded() {
    let mut outbox = outbox(false);
    for second in 0..5_000 {
        take(
            &mut outbox,
            &AlertMessage {
                since_ns: Some(second),
                ..alert(second, AlertState::Raised)
            },
            s(0),
        );
    }
    let remembered = outbox.remembered(&alert(0, AlertState::Raised).structure, s(0));
    assert_eq!(
        (
            remembered.keys.len(),
            remembered.waiting(),
            remembered.last.len()
        ),
        (KEYS_REMEMBERED, MOST_WAITING, 1)
    );
}

/// Returns the outbox of one receiver.
fn outbox_of(wish: Wish) -> Outbox {
    Outbox::new(vec![Wish {
        name: "person".to_owned(),
        states: NoticeState::ALL.to_vec(),
        ..wish
    }])
}

/// Sends all notices that are due. Returns the state of each; a summary has its lines.
fn send(outbox: &mut Outbox, moment: Moment) -> Vec<String> {
    outbox.release(moment);
    let mut sent = Vec::new();
    while let Some(notice) = outbox.due(moment.now).pop() {
        outbox.done(notice.receiver, true, moment.now);
        let content = notice.content;
        let state = content.state().map_or("summary", NoticeState::as_str);
        match &content.report {
            Report::Summary(summary) => {
                // Start and end of each line, without its sentence.
                let short = |line: &String| {
                    let start = line.split(": ").next().unwrap_or_default();
                    let end = line.rsplit_once("; ").map_or("lasts", |(_, end)| end);
                    format!("{start} ({end})")
                };
                let lines: Vec<String> = summary.lines.iter().map(short).collect();
                sent.push(format!("{}: {}", summary.cause, lines.join("; ")));
            }
            Report::Alert(_)
            | Report::Monitoring(_)
            | Report::Judgement(_)
            | Report::Earthquake(_)
            | Report::Clock(_) => {
                sent.push(state.to_owned());
            }
        }
    }
    sent
}

fn saved(outbox: &Outbox, wish: Wish, now: Duration) -> Outbox {
    let mut next = outbox_of(wish);
    next.recall(
        &name("house"),
        outbox.remembered(&name("house"), now),
        now,
        s(0),
    );
    next
}

const NONE: [&str; 0] = [];

#[test]
fn simulation_is_sent_only_on_request() {
    let mut content = of_alert(&alert(20, AlertState::Raised));
    for origin in [Origin::Simulated, Origin::Replayed] {
        content.circumstances.origin = origin;
        for (simulations, expected) in [(false, 0), (true, 1)] {
            let mut outbox = outbox_of(Wish {
                simulations,
                repeats: true,
                ..Wish::default()
            });
            outbox.take(&content, at(s(0)));
            assert_eq!(send(&mut outbox, at(s(0))).len(), expected, "{origin:?}");
            assert_eq!(send(&mut outbox, at(s(70))).len(), expected, "repeated");
            assert_eq!(outbox.simulated, 1 - expected as u64);
        }
    }
}

#[test]
fn only_unacknowledged_alerts_are_escalated_after_the_delay() {
    let wish = || Wish {
        after: s(1800),
        ..Wish::default()
    };
    let mut outbox = outbox_of(wish());
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    assert_eq!(send(&mut outbox, at(s(1799))), NONE);
    let mut next = saved(&outbox, wish(), s(1799));
    assert_eq!(send(&mut next, at(s(1799))), NONE);
    assert_eq!(send(&mut next, at(s(1800))), ["raised"], "after a restart");
    assert_eq!(send(&mut outbox, at(s(1800))), ["raised"]);
    // The receiver knows of the alert, so that what follows is sent at once.
    take(&mut outbox, &alert(29, AlertState::Acknowledged), s(1900));
    take(&mut outbox, &alert(30, AlertState::Cleared), s(1900));
    let sent = send(&mut outbox, at(s(1900)));
    assert_eq!(sent, ["acknowledged", "cleared"]);
    // The next alert waits again.
    take(&mut outbox, &alert(40, AlertState::Raised), s(2000));
    assert_eq!(send(&mut outbox, at(s(2001))), NONE);

    let mut outbox = outbox_of(wish());
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    take(&mut outbox, &alert(21, AlertState::Acknowledged), s(60));
    take(&mut outbox, &alert(30, AlertState::Cleared), s(90));
    assert_eq!(send(&mut outbox, at(s(4000))), NONE);
    assert_eq!(outbox.waiting(), 0);
}

#[test]
fn acknowledged_unconfirmed_alert_is_not_escalated() {
    let mut outbox = outbox_of(Wish {
        after: s(1800),
        ..Wish::default()
    });
    let doubted = AlertMessage {
        acknowledged_by: Some("ada".to_owned()),
        ..alert(30, AlertState::Unconfirmed)
    };
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    take(&mut outbox, &doubted, s(1000));
    assert_eq!(send(&mut outbox, at(s(4000))), NONE);
}

#[test]
fn unconfirmed_state_does_not_delay_an_escalation() {
    let mut outbox = outbox_of(Wish {
        after: s(1800),
        ..Wish::default()
    });
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    take(&mut outbox, &alert(30, AlertState::Unconfirmed), s(1000));
    assert_eq!(send(&mut outbox, at(s(1799))), NONE);
    assert_eq!(send(&mut outbox, at(s(1800))), ["unconfirmed"]);
}

fn night() -> Wish {
    let hours = crate::quiet::QuietHours {
        days: vec![crate::quiet::Day::Thu],
        from: "00:00".parse().unwrap(),
        to: "06:00".parse().unwrap(),
        zone: "UTC".to_owned(),
        except: vec![NoticeState::Raised],
    };
    Wish {
        quiet: vec![Quiet::new(&hours).unwrap()],
        ..Wish::default()
    }
}

#[test]
fn quiet_hours_end_with_active_alerts_and_one_summary_of_ended_alerts() {
    // 1970-01-01 was a Thursday.
    let mut outbox = outbox_of(night());
    let of = |parameter: &str, seconds, state| AlertMessage {
        parameter: name(parameter),
        ..alert(seconds, state)
    };
    take(&mut outbox, &of("storey-1", 20, AlertState::Pending), s(20));
    take(&mut outbox, &of("storey-2", 20, AlertState::Pending), s(20));
    take(&mut outbox, &of("storey-1", 30, AlertState::Normal), s(30));
    take(&mut outbox, &of("storey-3", 40, AlertState::Raised), s(40));
    assert_eq!(send(&mut outbox, at(s(40))), ["raised"], "an exception");
    assert_eq!(send(&mut outbox, at(s(6 * 3600 - 1))), NONE);
    let mut outbox = saved(&outbox, night(), s(6 * 3600 - 1));
    assert_eq!(
        send(&mut outbox, at(s(6 * 3600))),
        [
            "quiet hours: 1970-01-01T00:00:20Z storey-1 pending (normal at 1970-01-01T00:00:30Z)",
            "pending"
        ]
    );
    assert_eq!(send(&mut outbox, at(s(6 * 3600 + 1))), NONE);
}

#[test]
fn maintenance_ends_with_a_summary_and_active_alerts() {
    let second = 1_000_000_000;
    let mut outbox = outbox_of(Wish::default());
    outbox.maintain(maintenance(None, 0, 3600 * second), 0);
    take(&mut outbox, &alert(20, AlertState::Raised), s(20));
    take(&mut outbox, &alert(30, AlertState::Cleared), s(30));
    let blind = monitoring(40, MonitoringState::Blind, 40, &["x"]);
    outbox.take(&content(Report::Monitoring(blind)), at(s(40)));
    assert_eq!(send(&mut outbox, at(s(3599))), NONE);
    assert_eq!(outbox.muted, 2);
    let mut outbox = saved(&outbox, Wish::default(), s(3599));
    let sent = send(&mut outbox, at(s(3600)));
    let summary = "maintenance by ada (new bearings): \
                   1970-01-01T00:00:20Z storey-2 raised (cleared at 1970-01-01T00:00:30Z); \
                   1970-01-01T00:00:40Z monitoring blind (lasts)";
    assert_eq!(sent, [summary, "blind"]);
    assert_eq!(outbox.maintenance(&name("house")), []);
}

#[test]
fn maintenance_of_one_part_mutes_only_this_part_and_its_repetitions() {
    let mut outbox = outbox_of(Wish {
        repeats: true,
        ..Wish::default()
    });
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    assert_eq!(send(&mut outbox, at(s(0))), ["raised"]);
    outbox.maintain(maintenance(Some("storey-2"), 0, 200 * 1_000_000_000), 0);
    assert_eq!(send(&mut outbox, at(s(100))), NONE);
    let other = AlertMessage {
        parameter: name("storey-1"),
        ..alert(20, AlertState::Raised)
    };
    take(&mut outbox, &other, s(100));
    assert_eq!(send(&mut outbox, at(s(100))), ["raised"]);
    // The repetition of each.
    assert_eq!(send(&mut outbox, at(s(200))), ["raised", "raised"]);
}

/// Returns the lasting loss of storey 2, found on a day.
fn lasting_loss(day: i64) -> Content {
    let sample = crate::samples::samples("house").pop().unwrap();
    let Report::Judgement(mut display) = sample.report else {
        panic!("{sample:?}")
    };
    display.quantity = name("storey-2");
    display.change.as_mut().unwrap().found_ns = day * 86_400_000_000_000;
    content(Report::Judgement(display))
}

#[test]
fn a_lasting_loss_is_sent_once_beside_the_alert_of_the_same_part() {
    let wish = Wish {
        name: "pager".to_owned(),
        states: vec![NoticeState::Raised, NoticeState::LastingLoss],
        repeats: true,
        ..Wish::default()
    };
    let mut outbox = Outbox::new(vec![wish]);
    let mut keys = Vec::new();
    let mut send = |outbox: &mut Outbox, second| {
        while let Some(notice) = outbox.due(s(second)).pop() {
            keys.push((second, notice.content.key));
            outbox.done(0, true, s(second));
        }
    };
    outbox.take(&lasting_loss(7), at(s(0)));
    outbox.take(&lasting_loss(7), at(s(0)));
    take(&mut outbox, &alert(20, AlertState::Raised), s(0));
    send(&mut outbox, 0);
    // Both are repeated, until the reference starts anew.
    send(&mut outbox, 61);
    outbox.forget_change(&name("house"), &name("storey-2"));
    send(&mut outbox, 122);
    let of_loss = "house/storey-2/604800000000000/lasting-loss".to_owned();
    let of_alert = "house/storey-2/20000000000/raised".to_owned();
    assert_eq!(
        keys,
        [
            (0, of_loss.clone()),
            (0, of_alert.clone()),
            (61, of_alert.clone()),
            (61, of_loss),
            (122, of_alert),
        ]
    );
}

#[test]
fn a_lasting_loss_of_replayed_samples_is_sent_to_nobody() {
    let mut outbox = Outbox::new(vec![Wish {
        states: vec![NoticeState::LastingLoss],
        ..Wish::default()
    }]);
    let mut replayed = lasting_loss(7);
    replayed.circumstances.origin = Origin::Replayed;
    outbox.take(&replayed, at(s(0)));
    assert_eq!((outbox.due(s(0)), outbox.simulated), (Vec::new(), 1));
}

/// Returns a notice about the clock of the roof.
fn clock(second: u64, is_wrong: bool) -> Content {
    content(Report::Clock(crate::clocks::ClockChange {
        structure: name("house"),
        node: name("roof"),
        time_ns: i64::try_from(s(second).as_nanos()).unwrap(),
        is_wrong,
        what: "the clock of the node is 3600.0 s ahead of most nodes".to_owned(),
        why: "2 of 3 nodes agree on another time".to_owned(),
    }))
}

#[test]
fn wrong_clock_is_repeated_to_alertmanager_until_it_is_right() {
    let wish = Wish {
        name: "manager".to_owned(),
        states: vec![NoticeState::ClockWrong, NoticeState::ClockRight],
        repeats: true,
        ..Wish::default()
    };
    let mut outbox = Outbox::new(vec![wish]);
    outbox.take(&clock(0, true), at(s(0)));
    assert_eq!(outbox.wrong_clocks(&name("house")), [name("roof")]);
    let mut sent = Vec::new();
    for second in 0..200 {
        if second == 90 {
            outbox.take(&clock(90, false), at(s(second)));
        }
        for notice in outbox.due(s(second)) {
            sent.push((second, notice.content.state().unwrap()));
            outbox.done(notice.receiver, true, s(second));
        }
    }
    let wrong = NoticeState::ClockWrong;
    assert_eq!(
        sent,
        [(0, wrong), (60, wrong), (90, NoticeState::ClockRight)]
    );
    assert!(outbox.wrong_clocks(&name("house")).is_empty());
}

#[test]
fn maintenance_of_the_structure_mutes_a_wrong_clock_and_that_of_a_parameter_does_not() {
    let sent_during = |part: Option<&str>| {
        let wish = Wish {
            states: vec![NoticeState::ClockWrong],
            ..Wish::default()
        };
        let mut outbox = Outbox::new(vec![wish]);
        outbox.maintain(maintenance(part, 0, 100_000_000_000), 0);
        outbox.take(&clock(10, true), at(s(10)));
        (outbox.due(s(10)).len(), outbox.muted)
    };
    assert_eq!(sent_during(Some("roof")), (1, 0));
    assert_eq!(sent_during(None), (0, 1));
}
