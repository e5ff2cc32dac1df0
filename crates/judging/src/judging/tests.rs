use super::*;
use crate::testing::{name, of_day, plan};

fn judging() -> Judging {
    let names = vec![name("pier"), name("girder")];
    Judging::new(name("bridge"), names, vec![name("deck")], plan().settings).unwrap()
}

fn run(judging: &mut Judging, days: std::ops::Range<i64>, stiffness: f64) -> Vec<Event> {
    let mut events = Vec::new();
    for day in days {
        for third in 0..3 {
            judging
                .handle(&of_day(day, third, stiffness), &mut events)
                .unwrap();
        }
    }
    events
}

#[test]
fn the_first_state_is_learning_before_any_epoch() {
    let displays = judging().displays(7);
    assert_eq!(displays.len(), 2);
    assert_eq!(displays[0].word(), "learning");
    assert_eq!(
        displays[0].sentence,
        "pier is being learnt; 30 days of commissioning remain."
    );
    assert_eq!((displays[0].day_ns, displays[0].epoch_ns), (None, None));
}

#[test]
fn a_loss_is_one_event_and_remains_the_word_of_the_state() {
    let mut judging = judging();
    assert_eq!(run(&mut judging, 0..60, 1.0), []);
    assert_eq!(judging.displays(0)[0].word(), "judged");
    assert_eq!(judging.displays(0)[1].word(), "no-statement");
    let events = run(&mut judging, 60..90, 0.95);
    assert_eq!(events.len(), 1, "{events:?}");
    assert_eq!(events[0].kind, EventKind::LastingChange);
    assert_eq!(events[0].what, "lasting-loss");
    let display = &judging.displays(0)[0];
    let change = display.change.unwrap();
    assert_eq!(display.word(), "lasting-loss");
    assert!(display.sentence.contains("pier has lost"));
    let warning = " days does not contain all seasons; a seasonal change can look like a lasting \
                   one.";
    assert!(display.sentence.ends_with(warning), "{display:?}");
    assert!(events[0].why.ends_with(warning), "{events:?}");
    assert!((0.03..0.07).contains(&change.loss), "{change:?}");
    let since = change.since_ns / start_ns(1);
    assert!((58..63).contains(&since), "{since}");
    assert_eq!(change.interval.level, 0.95);
    let spent = display.spent.unwrap();
    assert!((40..60).contains(&spent.judged_days), "{spent:?}");
    assert_eq!((spent.alarms, spent.alarms_in_last_year), (1, 1));
    let promised = 0.1 * f64::from(spent.judged_days) / 365.25;
    assert!((spent.promised - promised).abs() < 1e-12, "{spent:?}");
}

/// Regression: the last judgement remained for ever.
#[test]
fn a_judgement_is_withdrawn_a_day_after_the_last_epoch() {
    let mut judging = judging();
    run(&mut judging, 0..60, 1.0);
    let last_ns = judging.epoch_ns().unwrap();
    let at = |judging: &Judging, time_ns: i64| {
        let mut display = judging.displays(time_ns).remove(0);
        withdraw_old(&mut display, time_ns);
        display
    };
    assert_eq!(at(&judging, last_ns + DAY_NS).word(), "judged");
    let silent = at(&judging, last_ns + DAY_NS + 1);
    assert_eq!(silent.word(), "no-statement");
    assert_eq!(silent.sentence, "pier has no value since 1970-03-01."); // the 60th day
    run(&mut judging, 60..90, 0.95);
    let lost = at(&judging, 100 * DAY_NS);
    assert_eq!(
        (lost.word(), lost.state),
        ("lasting-loss", JudgementState::NoStatement)
    );
    let end = ". It has no value since 1970-03-31.";
    assert!(lost.sentence.ends_with(end), "{}", lost.sentence);
    let replayed = ClosedEpoch {
        is_measured: false,
        ..of_day(90, 0, 1.0)
    };
    judging.handle(&replayed, &mut Vec::new()).unwrap();
    let last = judging.displays(0).remove(0);
    assert_eq!(at(&judging, 200 * DAY_NS).sentence, last.sentence);
}

/// Regression: a blind structure remained `judged`, because its epochs were left out.
#[test]
fn days_of_epochs_without_a_value_have_no_statement() {
    let mut judging = judging();
    run(&mut judging, 0..60, 1.0);
    assert_eq!(judging.displays(0)[0].word(), "judged");
    for day in 60..62 {
        let mut blind = of_day(day, 0, 1.0);
        blind.epoch.quantities = vec![None, None];
        judging.handle(&blind, &mut Vec::new()).unwrap();
    }
    let display = &judging.displays(0)[0];
    assert_eq!(display.word(), "no-statement");
    assert_eq!(display.sentence, "pier has no value on this day.");
}

#[test]
fn one_epoch_that_is_not_measured_marks_all_judgements() {
    let mut judging = judging();
    run(&mut judging, 0..2, 1.0);
    assert!(judging.displays(0)[0].measured);
    let replayed = ClosedEpoch {
        is_measured: false,
        ..of_day(2, 0, 1.0)
    };
    judging.handle(&replayed, &mut Vec::new()).unwrap();
    run(&mut judging, 3..5, 1.0);
    assert!(!judging.displays(0)[0].measured);
}

#[test]
fn an_epoch_out_of_order_is_refused_and_changes_nothing() {
    let mut judging = judging();
    run(&mut judging, 5..7, 1.0);
    let before = judging.displays(0);
    assert!(judging.handle(&of_day(3, 0, 1.0), &mut Vec::new()).is_err());
    assert_eq!(judging.displays(0), before);
}

#[test]
fn an_epoch_is_stated_as_it_is_judged() {
    let mut settings = plan().settings;
    let condition = |name: &str, kind| spandrel_judge::Condition {
        name: name.to_owned(),
        kind,
    };
    settings.conditions = vec![
        condition("deck", ConditionKind::Fahrenheit),
        condition("rms", ConditionKind::Amplitude),
        condition("air", ConditionKind::Celsius),
    ];
    let names = |of: &[&str]| of.iter().map(|of| name(of)).collect::<Vec<_>>();
    let (quantities, conditions) = (names(&["pier", "girder"]), names(&["deck", "rms", "air"]));
    let judging = Judging::new(name("bridge"), quantities, conditions, settings);
    let mut closed = of_day(3, 0, 1.0);
    closed.epoch.quantities = vec![Some(0.5), None];
    closed.epoch.conditions = vec![Some(50.0), Some(0.01), Some(400.0)];
    let displays = judging.unwrap().epoch_displays(&closed, 900.0);
    assert_eq!(displays.len(), 2);
    let [pier, girder] = [&displays[0], &displays[1]];
    assert_eq!((pier.ln_mean, girder.ln_mean), (Some(0.5_f64.ln()), None));
    assert_eq!(pier.ln_std, closed.deviations[0]);
    assert_eq!((pier.time_ns, pier.epoch_s), (closed.middle_ns, 900.0));
    assert_eq!(pier.amplitude, Some(-2.0));
    let conditions = pier.conditions.iter();
    let found: Vec<_> = conditions.map(|of| (of.unit.as_str(), of.value)).collect();
    // 400 °C is not plausible.
    assert_eq!(
        found,
        [("degC", Some(10.0)), ("log10", Some(-2.0)), ("degC", None)]
    );
    for display in &displays {
        spandrel_bus::Message::check(display).unwrap();
    }
}

fn annotation(day: i64, effect: AnnotationEffect) -> Annotation {
    Annotation {
        structure: name("bridge"),
        quantity: Some(name("pier")),
        time_ns: start_ns(day),
        from_ns: start_ns(day),
        to_ns: None,
        kind: spandrel_bus::AnnotationKind::Repair,
        effect,
        who: "ada".to_owned(),
        text: "new bearings".to_owned(),
    }
}

#[test]
fn a_change_is_seen_by_who_notes_it_after_it_was_found() {
    let mut judging = judging();
    run(&mut judging, 0..60, 1.0);
    judging.annotate(annotation(60, AnnotationEffect::Seen));
    run(&mut judging, 60..90, 0.95);
    let display = &judging.displays(0)[0];
    assert!(display.change.is_some());
    assert_eq!(display.seen, None, "noted before the change was found");
    judging.annotate(Annotation {
        time_ns: display.change.unwrap().found_ns + 1,
        ..annotation(90, AnnotationEffect::Seen)
    });
    assert_eq!(judging.displays(0)[0].seen, None, "the day had not ended");
    judging.annotate(annotation(90, AnnotationEffect::None));
    assert_eq!(judging.displays(0)[0].seen, None);
    judging.annotate(annotation(90, AnnotationEffect::Seen));
    let seen = judging.displays(0)[0].seen.clone().unwrap();
    assert_eq!((seen.who.as_str(), seen.time_ns), ("ada", start_ns(90)));
    assert_eq!(judging.displays(0)[1].seen, None, "another quantity");
}

#[test]
fn a_new_reference_clears_the_change_at_once_and_learns_anew() {
    let mut judging = judging();
    run(&mut judging, 0..60, 1.0);
    run(&mut judging, 60..90, 0.95);
    let new = annotation(90, AnnotationEffect::NewReference);
    assert!(!judging.is_past(&new));
    assert!(judging.is_past(&annotation(89, AnnotationEffect::NewReference)));
    assert!(!judging.is_past(&annotation(89, AnnotationEffect::Seen)));
    judging.annotate(new);
    let display = &judging.displays(0)[0];
    assert_eq!((display.change, display.word()), (None, "learning"));
    assert_eq!(judging.displays(0)[1].word(), "no-statement");
    // The first epoch ends the last day of the former reference.
    let first = of_day(90, 0, 0.95);
    assert_eq!(judging.handle(&first, &mut Vec::new()), Ok(true));
    let display = &judging.displays(0)[0];
    assert_eq!((display.change, display.word()), (None, "learning"));
    run(&mut judging, 91..130, 0.95);
    let display = &judging.displays(0)[0];
    assert_eq!((display.change, display.word()), (None, "judged"));
}

#[test]
fn annotations_of_others_are_not_known() {
    let judging = judging();
    let own = annotation(1, AnnotationEffect::None);
    assert!(judging.knows(&own));
    for (structure, quantity) in [("tower", "pier"), ("bridge", "deck")] {
        let other = Annotation {
            structure: name(structure),
            quantity: Some(name(quantity)),
            ..own.clone()
        };
        assert!(!judging.knows(&other), "{other:?}");
    }
}

#[test]
fn every_state_and_course_can_be_a_message() {
    use spandrel_bus::Message as _;
    let mut judging = judging();
    for day in 0..60 {
        run(&mut judging, day..day + 1, 1.0);
        for display in judging.displays(0) {
            display.check().unwrap();
        }
    }
    // On the first judged day, no step is possible yet, so the evidence of a loss is zero.
    let course = judging
        .course(&name("pier"), &SpanQuery::default())
        .unwrap();
    course.check().unwrap();
    let first = course.rows.iter().find_map(|row| row.expectation);
    assert_eq!(first.unwrap().ln_evidence, -10.0);
}
