use super::*;
use crate::bench::{Bench, Saved};
use crate::epoch_log::EpochLog;
use crate::testing::{S, closed, name, of_day, plan};
use spandrel_bus::{Annotation, AnnotationEffect, AnnotationKind};
use spandrel_service::Clock;
use spandrel_structure::JudgePlan;
use std::ops::Range;

/// Wall-clock time of all records (s).
const NOW_S: i64 = 1_700_000_000;

fn bench(folder: &Path, plan: &JudgePlan) -> Bench {
    let saved = Saved {
        folder: folder.to_owned(),
        plan: plan.clone(),
    };
    let blank = Judging::of_plan(name("bridge"), plan).unwrap();
    Bench::open(blank, Some(saved), Clock::fixed(NOW_S * S)).unwrap()
}

fn with_loss(loss: f64) -> JudgePlan {
    let mut plan = plan();
    plan.settings.loss = loss;
    plan
}

fn run(bench: &mut Bench, days: Range<i64>) {
    for day in days {
        for third in 0..3 {
            bench.judge(&[of_day(day, third, 1.0)]);
        }
    }
}

/// What the service states at present.
#[derive(Debug)]
struct Stated {
    epoch_ns: i64,
    displays: Vec<JudgementDisplay>,
}

impl Stated {
    fn now(bench: &Bench) -> Self {
        let epoch_ns = bench.judging.epoch_ns().unwrap();
        Self {
            epoch_ns,
            displays: bench.judging.displays(epoch_ns),
        }
    }

    fn configuration(&self) -> &str {
        self.displays[0].configuration.as_deref().unwrap()
    }
}

fn past(folder: &Path, at_ns: i64, wanted: Option<&str>) -> Result<PastJudgement, JudgingError> {
    judge_past(folder, &name("bridge"), at_ns, wanted)
}

fn why(folder: &Path, at_ns: i64, wanted: Option<&str>) -> NoPast {
    match past(folder, at_ns, wanted) {
        Err(JudgingError::NoPast { why, .. }) => why,
        other => panic!("{other:?}"),
    }
}

/// Regression: a loss that had been raised vanished without a word.
#[test]
fn a_change_that_other_settings_do_not_find_is_told_once() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut service = bench(folder, &with_loss(0.02));
    run(&mut service, 0..60);
    for day in 60..90 {
        for third in 0..3 {
            service.judge(&[of_day(day, third, 0.95)]);
        }
    }
    assert!(Stated::now(&service).displays[0].change.is_some());
    let told = |loss| bench(folder, &with_loss(loss)).take_told();
    assert_eq!(told(0.02), []);
    let vanished = told(0.1);
    assert_eq!(vanished.len(), 1, "{vanished:?}");
    assert_eq!(vanished[0].what, "lasting-loss no longer found");
    let why = &vanished[0].why;
    assert!(why.contains(" stated: pier has lost "), "{why}");
    assert_eq!(told(0.1), []);
    let found = told(0.02);
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found[0].what, "lasting-loss");
}

#[test]
fn each_configuration_repeats_what_it_stated_with_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut all = Vec::new();
    let mut service = bench(folder, &with_loss(0.02));
    run(&mut service, 0..20);
    all.push(Stated::now(&service));
    run(&mut service, 20..40);
    all.push(Stated::now(&service));
    // A restart with another setting judges the same epochs again.
    let mut service = bench(folder, &with_loss(0.05));
    all.push(Stated::now(&service));
    run(&mut service, 40..45);
    all.push(Stated::now(&service));
    // A new reference in the past does so as well.
    let repair = Annotation {
        structure: name("bridge"),
        quantity: None,
        time_ns: 45 * 86_400 * S,
        from_ns: 42 * 86_400 * S,
        to_ns: None,
        kind: AnnotationKind::Repair,
        effect: AnnotationEffect::NewReference,
        who: "ada".to_owned(),
        text: "new bearings".to_owned(),
    };
    service.annotate(repair.clone()).unwrap();
    all.push(Stated::now(&service));
    run(&mut service, 45..50);
    all.push(Stated::now(&service));

    let names: Vec<&str> = all.iter().map(Stated::configuration).collect();
    let [first, second, third] = [names[0], names[2], names[4]];
    assert_eq!(names, [first, first, second, second, third, third]);
    assert!(first != second && second != third && first != third);
    assert_ne!(all[3].displays, all[4].displays);
    for stated in &all {
        let found = past(folder, stated.epoch_ns, Some(stated.configuration())).unwrap();
        assert_eq!(found.displays, stated.displays);
        assert_eq!(
            (found.epoch_ns, found.since_ns),
            (stated.epoch_ns, NOW_S * S)
        );
    }
    // Without a name, that counts which judged the epoch first.
    for (index, expected) in [first, first, first, second, second, third]
        .into_iter()
        .enumerate()
    {
        let found = past(folder, all[index].epoch_ns + S, None).unwrap();
        assert_eq!(found.name, expected, "{index}");
        assert_eq!(found.epoch_ns, all[index].epoch_ns);
    }
    let last = past(folder, all[5].epoch_ns, None).unwrap();
    assert_eq!(last.configuration.references, [repair]);
    assert_eq!(last.configuration.judge, with_loss(0.05));
    assert_eq!(last.epochs, 150);

    let expected = NoPast::NotInForce {
        found: third.to_owned(),
        in_force: first.to_owned(),
    };
    assert_eq!(why(folder, all[0].epoch_ns, Some(third)), expected);
    let first_ns = of_day(0, 0, 1.0).middle_ns;
    assert_eq!(
        why(folder, first_ns - 1, None),
        NoPast::BeforeEpochs { first_ns }
    );
}

#[test]
fn epochs_that_were_set_aside_are_judged_with_their_own_columns() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut service = bench(folder, &plan());
    run(&mut service, 0..2);
    let first = Stated::now(&service);
    let mut other = plan();
    other.condition_columns = vec!["air".to_owned()];
    let mut service = bench(folder, &other);
    run(&mut service, 2..4);
    let second = Stated::now(&service);
    // The first columns again begin a third file.
    let mut service = bench(folder, &plan());
    run(&mut service, 4..6);
    let third = Stated::now(&service);
    assert_eq!(first.configuration(), third.configuration());
    for stated in [&first, &second, &third] {
        let found = past(folder, stated.epoch_ns, None).unwrap();
        assert_eq!(found.displays, stated.displays);
        assert_eq!(found.epochs, 6);
    }
    std::fs::remove_file(folder.join("judge-epochs.1.csv")).unwrap();
    let error = past(folder, first.epoch_ns, None).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("judge-epochs.1.csv: cannot read"),
        "{error}"
    );
    assert!(past(folder, second.epoch_ns, None).is_ok());
}

#[test]
fn epochs_that_are_damaged_changed_or_not_saved_are_not_judged() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut service = bench(folder, &plan());
    run(&mut service, 0..2);
    let path = folder.join(FILE);
    // The file of a running service is deleted. It begins another one.
    std::fs::remove_file(&path).unwrap();
    run(&mut service, 2..3);
    let stated = Stated::now(&service);
    assert_eq!(why(folder, stated.epoch_ns, None), NoPast::UnsavedEpochs);
    let mut service = bench(folder, &plan());
    run(&mut service, 3..5);
    let stated = Stated::now(&service);
    let found = past(folder, stated.epoch_ns, None).unwrap();
    assert_eq!(found.displays, stated.displays);

    let text = std::fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let damaged = [&lines[..6], &lines[7..]].concat().concat();
    std::fs::write(&path, damaged).unwrap();
    let last_ns = of_day(3, 1, 1.0).middle_ns;
    assert_eq!(past(folder, last_ns, None).unwrap().epochs, 5);
    let expected = NoPast::DamagedEpochs {
        path: path.clone(),
        last_ns,
    };
    assert_eq!(why(folder, stated.epoch_ns, None), expected);
    // Epochs of another structure with the same columns.
    std::fs::remove_file(&path).unwrap();
    let mut log = EpochLog::open(folder, &plan(), |_| {}).unwrap();
    (0..9).for_each(|number| log.append(&closed(number)));
    let expected = NoPast::OtherEpochs { path };
    assert_eq!(why(folder, stated.epoch_ns, None), expected);
}

#[test]
fn without_a_record_of_then_nothing_is_judged() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let error = past(folder, 0, None).unwrap_err();
    assert!(matches!(error, JudgingError::NoConfiguration { .. }));
    // An earlier version has saved epochs.
    let mut log = EpochLog::open(folder, &plan(), |_| {}).unwrap();
    (0..3).for_each(|third| log.append(&of_day(0, third, 1.0)));
    let mut service = bench(folder, &plan());
    run(&mut service, 1..2);
    let expected = NoPast::BeforeConfigurations { from_ns: NOW_S * S };
    assert_eq!(why(folder, of_day(0, 2, 1.0).middle_ns, None), expected);
    assert_eq!(
        past(folder, of_day(1, 0, 1.0).middle_ns, None)
            .unwrap()
            .epochs,
        4
    );
    assert_eq!(
        expected.to_string(),
        "the epochs of that time were judged before the first recorded configuration, which is \
         in force since 2023-11-14T22:13:20Z"
    );
}
