use super::*;
use crate::batch::Collector;
use spandrel_bus::{
    Acknowledgement, AlertMessage, AlertState, ConditionDisplay, CredibleInterval, Event,
    EventKind, LossDisplay, Message as _, ModeDisplay, ModeEstimate, ModeState, ParameterDisplay,
};
use spandrel_listener::Input;
use spandrel_structure::Structure;
use std::path::Path;
use std::time::Duration;

const START_NS: i64 = 1_763_730_000 * SECOND_NS;
const STRUCTURE: &str = "spandrel/demo";

fn demo() -> Structure {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    Structure::read(&file).unwrap()
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn loss(name_of: &str, time_ns: i64, mean: f64) -> Input {
    Input::Loss(LossDisplay {
        structure: name("demo"),
        parameter: name(name_of),
        time_ns,
        loss: 1.0 - mean,
        interval: CredibleInterval::of_normal(1.0 - mean, 0.01),
        probability_of_loss: if mean < 0.9 { 0.99 } else { 0.0 },
        rule_loss: 0.05,
        rule_credibility: 0.95,
        reference: 1.0,
        reference_std: 0.0,
    })
}

fn parameter(name_of: &str, time_ns: i64, mean: f64) -> Input {
    Input::Parameter(ParameterDisplay {
        structure: name("demo"),
        parameter: name(name_of),
        time_ns,
        mean,
        std: 0.01,
        interval: CredibleInterval {
            level: 0.95,
            low: mean - 0.02,
            high: mean + 0.02,
        },
    })
}

fn storey_2() -> Series {
    Series {
        kind: Kind::Parameter,
        name: "storey-2".to_owned(),
    }
}

fn from_s(seconds: i64) -> SpanQuery {
    SpanQuery {
        from_ns: START_NS + seconds * SECOND_NS,
        ..SpanQuery::default()
    }
}

/// Returns ten minutes of storey 2 at 10 Hz in batches of one second. The storey loses 20 % after
/// five minutes.
fn ten_minutes(collector: &mut Collector) -> Vec<Arc<Batch>> {
    let mut batches = Vec::new();
    for second in 0..600 {
        for tenth in 0..10 {
            let mean = if second < 300 { 1.0 } else { 0.8 };
            let time_ns = START_NS + (second * 10 + tenth) * DISPLAY_NS;
            collector.handle(parameter("storey-2", time_ns, mean));
            collector.handle(loss("storey-2", time_ns, mean));
        }
        batches.extend(collector.take(second + 1).map(Arc::new));
    }
    batches
}

async fn file(folder: &Path) -> Database {
    let database = Database::new(&Address::Sqlite(folder.join("history.sqlite"))).unwrap();
    database.ready().await.unwrap();
    database
}

async fn keeps_and_answers(database: &Database) {
    let mut collector = Collector::new(&demo(), "spandrel");
    let batches = ten_minutes(&mut collector);
    for some in batches.chunks(50) {
        database.write("life", some).await.unwrap();
        // The confirmation was lost, so the same batches are written again.
        database.write("life", some).await.unwrap();
    }
    let structure = name("demo");
    let span = |query: SpanQuery| async move {
        database
            .span(STRUCTURE, &name("demo"), &storey_2(), &query)
            .await
            .unwrap()
    };
    let all = span(SpanQuery {
        points: 20_000,
        ..SpanQuery::default()
    })
    .await;
    assert_eq!((all.resolution_s, all.rows.time_s.len()), (None, 6_000));
    assert_eq!(all.kept_from_s, Some(START_NS as f64 / 1e9));
    let few = span(SpanQuery {
        points: 4,
        ..from_s(120)
    })
    .await;
    assert_eq!(few.rows.count.iter().sum::<u64>(), 4_800);
    assert_eq!(few.rows.mean.first().copied(), Some(1.0));
    let of_loss = Series {
        kind: Kind::Loss,
        ..storey_2()
    };
    let losses = database
        .span(STRUCTURE, &name("demo"), &of_loss, &from_s(120))
        .await
        .unwrap();
    assert_eq!(losses.rows.probability_of_loss.last().copied(), Some(0.99));
    let lost = losses.rows.mean.last().copied().unwrap();
    let (low, high) = (losses.rows.low.last(), losses.rows.high.last());
    assert!((lost - 0.2).abs() < 1e-12, "{lost}");
    assert!((high.unwrap() - low.unwrap() - 0.039_2).abs() < 1e-4);

    // After an hour the values are deleted, and their minutes remain.
    let keep = Keep {
        display_s: Some(60),
        ..Keep::default()
    };
    database
        .prune(STRUCTURE, START_NS + 600 * SECOND_NS, &keep)
        .await
        .unwrap();
    let old = span(SpanQuery::default()).await;
    assert_eq!((old.resolution_s, old.rows.time_s.len()), (Some(60), 10));
    assert_eq!(old.rows.count, [600; 10], "nothing is counted twice");
    let change = old.rows.mean[4] + old.rows.mean[5];
    assert!((change - 1.8).abs() < 1e-9, "{:?}", old.rows.mean);
    assert!((old.rows.std[3] - 0.01).abs() < 1e-9 && old.rows.spread[3] < 1e-6);
    let new = span(from_s(580)).await;
    assert_eq!((new.resolution_s, new.rows.time_s.len()), (None, 200));
    // When the minutes are deleted, the hour and the day remain.
    let keep = Keep {
        display_s: Some(0),
        minute_s: Some(0),
        hour_s: None,
        ..Keep::default()
    };
    database
        .prune(STRUCTURE, START_NS + 100_000 * SECOND_NS, &keep)
        .await
        .unwrap();
    let oldest = span(SpanQuery::default()).await;
    assert_eq!(oldest.resolution_s, Some(3_600));
    assert_eq!(oldest.rows.count.iter().sum::<u64>(), 6_000);
    let nothing = database
        .span(
            STRUCTURE,
            &structure,
            &Series {
                kind: Kind::Noise,
                name: "x".into(),
            },
            &from_s(0),
        )
        .await;
    assert_eq!(nothing.unwrap().kept_from_s, None);
}

/// Regression: the rows of a display rate above ten per second were cut off at a limit, so that the
/// newest were missing.
#[tokio::test(flavor = "multi_thread")]
async fn the_newest_values_of_a_high_display_rate_are_returned() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    let mut collector = Collector::new(&demo(), "spandrel");
    let batches = ten_minutes(&mut collector);
    database.write("life", &batches).await.unwrap();
    // 200 values per second, which are more rows than are read.
    let between = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 19) \
                   INSERT INTO point (series, time_ns, mean, std, probability) \
                   SELECT series, time_ns + 5000000 * i, mean, std, probability FROM point, n";
    let pool = database.pool().await.unwrap();
    sqlx::query(between).execute(&pool).await.unwrap();
    let query = SpanQuery::default();
    let all = database
        .span(STRUCTURE, &name("demo"), &storey_2(), &query)
        .await
        .unwrap();
    assert_eq!(all.resolution_s, Some(60));
    let last_s = all.rows.time_s.last().unwrap() - START_NS as f64 / 1e9;
    assert!(last_s > 540.0, "{last_s}");
}

/// Returns a value of the temperature of the air (°C) after `minute` minutes.
fn air(minute: i64, value: f64) -> ConditionDisplay {
    ConditionDisplay {
        structure: name("demo"),
        name: name("air"),
        time_ns: START_NS + minute * 60 * SECOND_NS,
        value,
        unit: "degC".to_owned(),
        interval_s: None,
        instrument: None,
    }
}

/// Returns a collector of the demo with an air temperature from -40 to 60 °C.
fn collector_of_air() -> Collector {
    let text = include_str!("../../../../docs/examples/demo.toml");
    let text =
        format!("{text}\n[[condition]]\nname = \"air\"\nunit = \"degC\"\nrange = [-40, 60]\n");
    let structure = Structure::parse(&text, Path::new("demo.toml")).unwrap();
    Collector::new(&structure, "spandrel")
}

/// Writes values of a condition, some of them again by a second run of the service.
async fn keeps_a_repeated_condition_once(database: &Database) {
    for (life, minutes) in [("first", 0..90), ("second", 60..120)] {
        let mut collector = collector_of_air();
        let mut batches = Vec::new();
        for (number, minute) in (1..).zip(minutes) {
            collector.handle(Input::Condition(air(minute, minute as f64 / 2.0)));
            batches.extend(collector.take(number).map(Arc::new));
        }
        database.write(life, &batches).await.unwrap();
    }
    assert_eq!(database.repeated(), 30);
    let series = Series {
        kind: Kind::Condition,
        name: "air".to_owned(),
    };
    let keep = Keep {
        display_s: Some(0),
        minute_s: Some(0),
        ..Keep::default()
    };
    let read = |query: SpanQuery| {
        let series = series.clone();
        async move {
            let demo = name("demo");
            let read = database.span(STRUCTURE, &demo, &series, &query);
            read.await.unwrap()
        }
    };
    let shown = read(SpanQuery::default()).await;
    assert_eq!(
        (shown.kind.as_str(), shown.rows.mean.len()),
        ("condition", 120)
    );
    assert_eq!(shown.rows.mean[119], 59.5);
    let later_ns = START_NS + 86_400 * SECOND_NS;
    database.prune(STRUCTURE, later_ns, &keep).await.unwrap();
    let hours = read(SpanQuery::default()).await;
    assert_eq!(hours.resolution_s, Some(3_600));
    assert_eq!(hours.rows.count.iter().sum::<u64>(), 120);
    let sum: f64 = hours
        .rows
        .mean
        .iter()
        .zip(&hours.rows.count)
        .map(|(mean, count)| mean * *count as f64)
        .sum();
    assert!(
        (sum - f64::from((0..120).sum::<i32>()) / 2.0).abs() < 1e-6,
        "{sum}"
    );
}

#[tokio::test]
async fn a_condition_that_a_source_repeats_is_kept_once() {
    let folder = tempfile::tempdir().unwrap();
    keeps_a_repeated_condition_once(&file(folder.path()).await).await;
}

/// Returns the frequency of the mode `bending` in an epoch.
fn bending(minute: i64, frequency_hz: f64) -> ModeDisplay {
    ModeDisplay {
        structure: name("demo"),
        mode: name("bending"),
        time_ns: START_NS + minute * 60 * SECOND_NS,
        epoch_s: 600.0,
        epochs: 1,
        state: ModeState::Tracked,
        partner: None,
        estimate: Some(ModeEstimate {
            frequency_hz,
            frequency_std_hz: 0.01,
            damping: 0.02,
            damping_std: 0.002,
            shape: Vec::new(),
            amplitude: 0.1,
        }),
        presence: 1.0,
        machine: false,
        declared_hz: 1.25,
    }
}

/// The service repeats its last messages every few seconds, and after a restart.
#[tokio::test]
async fn a_frequency_that_is_repeated_is_kept_once_with_its_deviation() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    let text = include_str!("../../../../docs/examples/demo.toml");
    let text =
        format!("{text}\n[modal]\n[[modal.mode]]\nname = \"bending\"\nfrequency-hz = 1.25\n");
    let structure = Structure::parse(&text, Path::new("demo.toml")).unwrap();
    for (life, minutes) in [("first", [0, 10, 10]), ("second", [10, 20, 30])] {
        let mut collector = Collector::new(&structure, "spandrel");
        for minute in minutes {
            collector.handle(Input::Mode(Box::new(bending(minute, 1.25))));
        }
        let missing = ModeDisplay {
            estimate: None,
            ..bending(40, 1.0)
        };
        collector.handle(Input::Mode(Box::new(missing)));
        let batch = Arc::new(collector.take(1).unwrap());
        database.write(life, &[batch]).await.unwrap();
    }
    assert_eq!(database.repeated(), 1);
    let series = Series {
        kind: Kind::Mode,
        name: "bending".to_owned(),
    };
    let demo = name("demo");
    let query = SpanQuery::default();
    let span = database.span(STRUCTURE, &demo, &series, &query);
    let span = span.await.unwrap();
    assert_eq!(span.kind, "mode");
    assert_eq!(span.rows.mean, [1.25; 4]);
    assert_eq!(span.rows.std, [0.01; 4]);
}

#[test]
fn a_condition_that_contradicts_the_structure_file_is_rejected_and_counted() {
    let mut collector = collector_of_air();
    collector.set_now(START_NS);
    let wrong_unit = ConditionDisplay {
        unit: "K".to_owned(),
        ..air(0, 20.0)
    };
    let undeclared = ConditionDisplay {
        name: name("wind"),
        ..air(0, 20.0)
    };
    for wrong in [wrong_unit, air(0, 61.0), air(2, 20.0), undeclared] {
        collector.handle(Input::Condition(wrong));
    }
    assert!(collector.take(1).is_none());
    let rejected: Vec<_> = collector
        .rejected
        .iter()
        .map(|(reason, count)| (*reason, *count))
        .collect();
    assert_eq!(
        rejected,
        [
            ("ahead-of-clock", 1),
            ("out-of-range", 1),
            ("wrong-unit", 1)
        ]
    );
    assert_eq!(collector.unknown, 1);
    collector.handle(Input::Condition(air(0, 20.0)));
    let standing = Input::StandingCondition(air(1, 20.0), Duration::from_secs(60));
    collector.handle(standing);
    assert_eq!(collector.take(1).unwrap().repeatable.len(), 2);
}

fn alert(seconds: i64, state: AlertState) -> AlertMessage {
    AlertMessage {
        structure: name("demo"),
        parameter: name("storey-2"),
        time_ns: START_NS + seconds * SECOND_NS,
        state,
        since_ns: None,
        rule_loss: 0.05,
        rule_credibility: 0.99,
        credibility: 0.995,
        loss: Some(0.1),
        loss_interval: None,
        loss_interval_within_record: None,
        mean: 0.9,
        std: 0.01,
        reference: Some(1.0),
        reference_std: None,
        acknowledged_by: None,
        why: "storey-2 has lost 10 %".to_owned(),
        fit: None,
        fit_reasons: spandrel_bus::FitReasons::default(),
        follows_jump: false,
        undecided_because: None,
        revision: 0,
    }
}

async fn keeps_what_happened(database: &Database) {
    let mut collector = Collector::new(&demo(), "spandrel");
    let states = [
        AlertState::Pending,
        AlertState::Raised,
        AlertState::Acknowledged,
        AlertState::Cleared,
    ];
    for (seconds, state) in (0..).zip(states) {
        collector.handle(Input::Alert(alert(seconds, state)));
    }
    let seen = Acknowledgement {
        structure: name("demo"),
        parameter: name("storey-2"),
        time_ns: START_NS + 2 * SECOND_NS,
        who: "Ada; DROP TABLE happened; --".to_owned(),
        note: "on my way".to_owned(),
    };
    collector.handle(Input::Acknowledgement(seen.clone()));
    let event = Event {
        structure: name("demo"),
        time_ns: START_NS,
        kind: EventKind::Restart,
        subject: "filter".to_owned(),
        what: "restarted".to_owned(),
        why: "diverged".to_owned(),
    };
    collector.handle(Input::Event(event.clone()));
    let batch = Arc::new(collector.take(1).unwrap());
    database
        .write("another-life", std::slice::from_ref(&batch))
        .await
        .unwrap();
    // Another run of the service receives the same message again.
    database.write("a-third-life", &[batch]).await.unwrap();
    let log = database
        .log(STRUCTURE, &name("demo"), &from_s(0))
        .await
        .unwrap();
    assert_eq!(
        log.alerts
            .iter()
            .map(|alert| alert.state)
            .collect::<Vec<_>>(),
        states
    );
    assert_eq!(
        (log.acknowledgements, log.events),
        (vec![seen], vec![event])
    );
    let late = database
        .log(STRUCTURE, &name("demo"), &from_s(3))
        .await
        .unwrap();
    assert_eq!((late.alerts.len(), late.events.len()), (1, 0));
    let other = database
        .log("other/demo", &name("demo"), &from_s(0))
        .await
        .unwrap();
    assert!(other.alerts.is_empty(), "another root is another site");
}

#[tokio::test]
async fn sqlite_file_stores_and_returns_the_history() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    keeps_and_answers(&database).await;
    keeps_what_happened(&database).await;
    database.close().await;
    // The next run finds the log in the file.
    let database = file(folder.path()).await;
    let log = database
        .log(STRUCTURE, &name("demo"), &from_s(0))
        .await
        .unwrap();
    assert_eq!(log.alerts.len(), 4);
}

/// Writes revisions of an alert in several batches.
async fn keeps_the_last_revision(database: &Database) {
    let revised = |seconds, revision, since_ns| AlertMessage {
        since_ns,
        revision,
        loss: Some(0.1 + 0.01 * f64::from(revision)),
        ..alert(seconds, AlertState::Raised)
    };
    // A second alert starts at 30 s.
    let first = [
        (10, 0, Some(1)),
        (11, 1, Some(1)),
        (12, 2, Some(1)),
        (15, 5, Some(1)),
    ];
    let second = [(30, 0, Some(2)), (31, 1, Some(2)), (33, 2, Some(2))];
    // A service that restarts sends earlier messages again.
    let repeated = [(11, 1, Some(1)), (31, 1, Some(2))];
    let all = first.into_iter().chain(second).chain(repeated);
    for (number, (seconds, revision, since_ns)) in (1..).zip(all) {
        let mut collector = Collector::new(&demo(), "spandrel");
        collector.handle(Input::Alert(revised(seconds, revision, since_ns)));
        database
            .write("revisions", &[Arc::new(collector.take(number).unwrap())])
            .await
            .unwrap();
    }
    let log = database
        .log(STRUCTURE, &name("demo"), &from_s(0))
        .await
        .unwrap();
    let kept: Vec<_> = log
        .alerts
        .iter()
        .map(|alert| (alert.time_ns - START_NS, alert.revision))
        .collect();
    assert_eq!(
        kept,
        [(10, 0), (15, 5), (30, 0), (33, 2)]
            .map(|(seconds, revision)| (seconds * SECOND_NS, revision))
    );
}

#[tokio::test]
async fn an_alert_that_is_revised_has_two_rows() {
    let folder = tempfile::tempdir().unwrap();
    keeps_the_last_revision(&file(folder.path()).await).await;
}

/// A PostgreSQL server for the tests, in its own folder, with a socket there.
mod server;

#[tokio::test]
async fn postgresql_stores_and_returns_the_history_and_may_be_absent() {
    let Some(mut server) = server::Server::start_or_skip() else {
        return;
    };
    let database = Database::new(&Address::Postgres(server.url())).unwrap();
    keeps_and_answers(&database).await;
    keeps_what_happened(&database).await;
    keeps_a_repeated_condition_once(&database).await;
    server.stop();
    let mut collector = Collector::new(&demo(), "spandrel");
    collector.handle(Input::Alert(alert(10, AlertState::Raised)));
    let batch = [Arc::new(collector.take(1).unwrap())];
    let error = database.write("late", &batch).await.unwrap_err();
    assert!(matches!(error, HistoryError::Database { .. }), "{error:?}");
    server.start();
    database.write("late", &batch).await.unwrap();
    let log = database
        .log(STRUCTURE, &name("demo"), &from_s(10))
        .await
        .unwrap();
    assert_eq!(log.alerts.len(), 1);
}

/// Covers strings that the message checks reject, and sums that overflow, which no check of
/// messages can detect.
#[tokio::test]
async fn invalid_rows_are_set_aside_and_all_others_are_written() {
    let Some(server) = server::Server::start_or_skip() else {
        return;
    };
    let database = Database::new(&Address::Postgres(server.url())).unwrap();
    let mut collector = Collector::new(&demo(), "spandrel");
    let event = |seconds: i64, subject: &str| {
        Input::Event(Event {
            structure: name("demo"),
            time_ns: START_NS + seconds * SECOND_NS,
            kind: EventKind::Restart,
            subject: subject.to_owned(),
            what: "restarted".to_owned(),
            why: "diverged".to_owned(),
        })
    };
    let batches = |collector: &mut Collector| vec![Arc::new(collector.take(1).unwrap())];
    // No two adjacent bytes are equal, so that compression gains nothing.
    let long: String = (0..20_000_u32)
        .map(|k| char::from(b'!' + (k.wrapping_mul(2_654_435_761) >> 25) as u8 % 90))
        .collect();
    for (seconds, subject) in [
        (0, "filter"),
        (1, "fil\0ter"),
        (2, "node"),
        (3, long.as_str()),
        (4, "channel"),
    ] {
        collector.handle(event(seconds, subject));
    }
    collector.handle(Input::Alert(alert(5, AlertState::Raised)));
    (0..250).for_each(|k| collector.handle(parameter("storey-2", START_NS + k * DISPLAY_NS, 1.0)));
    database
        .write("life", &batches(&mut collector))
        .await
        .unwrap();
    let log = database
        .log(STRUCTURE, &name("demo"), &from_s(0))
        .await
        .unwrap();
    let subjects: Vec<&str> = log
        .events
        .iter()
        .map(|event| event.subject.as_str())
        .collect();
    assert_eq!(
        (subjects, log.alerts.len()),
        (vec!["filter", "node", "channel"], 1)
    );
    assert_eq!(database.set_aside(), 2);
    // The squares of these values are finite, but their sum is not.
    for k in 0..2 {
        collector.handle(parameter("storey-1", START_NS + k * DISPLAY_NS, 1.2e154));
        collector.handle(parameter("storey-3", START_NS + k * DISPLAY_NS, 1.0));
        database
            .write(&format!("life-{k}"), &batches(&mut collector))
            .await
            .unwrap();
    }
    assert_eq!(database.set_aside(), 2 + RESOLUTIONS_S.len() as u64);
    let count = |of: &'static str| {
        let series = Series {
            kind: Kind::Parameter,
            name: of.to_owned(),
        };
        let database = &database;
        async move {
            let span = database
                .span(STRUCTURE, &name("demo"), &series, &SpanQuery::default())
                .await
                .unwrap();
            span.rows.count.iter().sum::<u64>()
        }
    };
    assert_eq!(
        (
            count("storey-1").await,
            count("storey-2").await,
            count("storey-3").await
        ),
        (2, 250, 2)
    );
}

/// Covers entries from before names were limited: replies contain them in a form that readers
/// accept.
#[tokio::test]
async fn stored_names_with_control_characters_are_returned_in_valid_form() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    let mut collector = Collector::new(&demo(), "spandrel");
    collector.handle(Input::Acknowledgement(Acknowledgement {
        structure: name("demo"),
        parameter: name("storey-2"),
        time_ns: START_NS,
        who: "Ada\0".to_owned(),
        note: "first\nsecond".to_owned(),
    }));
    let named = AlertMessage {
        acknowledged_by: Some("Ada\0".to_owned()),
        ..alert(0, AlertState::Acknowledged)
    };
    collector.handle(Input::Alert(named));
    database
        .write("life", &[Arc::new(collector.take(1).unwrap())])
        .await
        .unwrap();
    let log = database
        .log(STRUCTURE, &name("demo"), &from_s(0))
        .await
        .unwrap();
    assert!(log.check().is_ok(), "{log:?}");
    assert_eq!(log.acknowledgements[0].who, "Ada\u{fffd}");
    assert_eq!(log.acknowledgements[0].note, "first\nsecond");
    assert_eq!(
        log.alerts[0].acknowledged_by.as_deref(),
        Some("Ada\u{fffd}")
    );
}

/// Regression: a corrupt file ended the program.
#[tokio::test]
async fn foreign_file_is_set_aside_and_a_new_database_created() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("history.sqlite");
    let text =
        "a letter, and no database at all; long enough to be taken for one by whoever only looks \
         at its length. "
            .repeat(20);
    std::fs::write(&path, &text).unwrap();
    let database = Database::new(&Address::Sqlite(path.clone())).unwrap();
    keeps_and_answers(&database).await;
    let corrupt = database.take_corrupt();
    assert_eq!(corrupt.len(), 1);
    assert_eq!(corrupt[0].path, path);
    assert_eq!(std::fs::read_to_string(&corrupt[0].aside).unwrap(), text);
    assert!(database.take_corrupt().is_empty());
}

#[tokio::test]
async fn a_file_that_is_damaged_while_it_is_open_is_set_aside() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    let path = folder.path().join("history.sqlite");
    let batches = ten_minutes(&mut Collector::new(&demo(), "spandrel"));
    database.write("life", &batches[..300]).await.unwrap();
    database.close().await; // moves the last rows to the file
    let database = file(folder.path()).await;
    let length = std::fs::metadata(&path).unwrap().len();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[4096..].fill(0xa5);
    std::fs::write(&path, bytes).unwrap();
    let error = database.write("life", &batches[300..]).await.unwrap_err();
    assert!(error.is_of_a_corrupt_file(&database.address), "{error:?}");
    let corrupt = database.take_corrupt();
    assert_eq!(std::fs::metadata(&corrupt[0].aside).unwrap().len(), length);
    database.write("life", &batches[300..]).await.unwrap();
}

/// Regression: rows went to a file that no path led to, until the next start.
#[tokio::test]
async fn a_file_that_disappears_is_noticed_and_its_folder_is_not_created() {
    let folder = tempfile::tempdir().unwrap();
    let (home, away) = (folder.path().join("home"), folder.path().join("away"));
    let database = file(&home).await;
    let batches = ten_minutes(&mut Collector::new(&demo(), "spandrel"));
    database.write("life", &batches[..300]).await.unwrap();
    std::fs::rename(&home, &away).unwrap();
    for _ in 0..2 {
        database.write("life", &batches[300..]).await.unwrap_err();
    }
    assert!(!home.exists());
    std::fs::rename(&away, &home).unwrap();
    database.write("life", &batches[300..]).await.unwrap();
    let query = SpanQuery {
        points: 20_000,
        ..SpanQuery::default()
    };
    let all = database
        .span(STRUCTURE, &name("demo"), &storey_2(), &query)
        .await
        .unwrap();
    assert_eq!(all.rows.time_s.len(), 6_000);
}

/// Regression: "database is locked" when old rows were deleted during a write.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn writes_deletions_and_another_process_wait_for_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    // Another process has its own connections to the same file.
    let other = file(folder.path()).await;
    let batches = ten_minutes(&mut Collector::new(&demo(), "spandrel"));
    let keep = Keep {
        display_s: Some(60),
        ..Keep::default()
    };
    let mut tasks = tokio::task::JoinSet::new();
    for (database, life) in [(database.clone(), "first"), (other, "second")] {
        let batches = batches.clone();
        tasks.spawn(async move {
            for batch in batches.chunks(2) {
                database.write(life, batch).await?;
            }
            Ok::<(), HistoryError>(())
        });
    }
    tasks.spawn(async move {
        for second in 0..200 {
            let newest_ns = START_NS + second * SECOND_NS;
            database.prune(STRUCTURE, newest_ns, &keep).await?;
        }
        Ok(())
    });
    for ended in tasks.join_all().await {
        ended.unwrap();
    }
}

/// Measures file size and query time for fifty parameters: a month by minute, hour and day, and an
/// hour of values.
#[tokio::test]
#[ignore = "two million rows; its figures are in docs/history.md"]
#[expect(clippy::disallowed_methods, reason = "it tells how long it took")]
async fn month_of_fifty_parameters_needs_less_than_one_gigabyte() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    let start = std::time::Instant::now();
    let month_s = 30 * 86_400;
    let mut hour = Vec::new();
    for minute in 0..month_s / 60 {
        let mut batch = Batch {
            structure: STRUCTURE.to_owned(),
            number: minute + 1,
            points: Vec::new(),
            repeatable: Vec::new(),
            buckets: std::collections::BTreeMap::new(),
            happened: Vec::new(),
        };
        for k in 0..50_i64 {
            let series = Series {
                kind: Kind::Parameter,
                name: format!("p-{k}"),
            };
            let wave = ((minute * 7 + k * 13) as f64).sin();
            let mut sums = Sums::of(
                START_NS + minute * 60 * SECOND_NS,
                [1.0 + 0.01 * wave, 0.01, 0.001],
            );
            sums.count = 600;
            for resolution_s in RESOLUTIONS_S {
                let at =
                    (START_NS / SECOND_NS + minute * 60).div_euclid(resolution_s) * resolution_s;
                batch
                    .buckets
                    .insert((series.clone(), resolution_s, at), sums);
            }
            if minute >= (month_s - 3_600) / 60 {
                let times = (0..600).map(|k| START_NS + minute * 60 * SECOND_NS + k * DISPLAY_NS);
                batch
                    .points
                    .extend(times.map(|time_ns| {
                        (series.clone(), time_ns, [1.0 + 0.01 * wave, 0.01, 0.001])
                    }));
            }
        }
        hour.push(Arc::new(batch));
        if hour.len() == 60 {
            database.write("life", &hour).await.unwrap();
            hour.clear();
        }
    }
    let written = start.elapsed();
    database.close().await;
    let bytes = std::fs::metadata(folder.path().join("history.sqlite"))
        .unwrap()
        .len();
    let database = file(folder.path()).await;
    let series = Series {
        kind: Kind::Parameter,
        name: "p-17".to_owned(),
    };
    let mut slowest = Duration::ZERO;
    for days in [30, 7, 1] {
        let start = std::time::Instant::now();
        let from_ns = START_NS + (month_s - days * 86_400) * SECOND_NS;
        let query = SpanQuery {
            from_ns,
            ..SpanQuery::default()
        };
        let span = database
            .span(STRUCTURE, &name("demo"), &series, &query)
            .await
            .unwrap();
        println!(
            "{days} days: {} rows of {:?} s in {:.0?}",
            span.rows.time_s.len(),
            span.resolution_s,
            start.elapsed()
        );
        slowest = slowest.max(start.elapsed());
    }
    println!(
        "{:.0} MB, written in {written:.0?}, slowest plot {slowest:.0?}",
        bytes as f64 / 1e6
    );
    assert!(bytes < 1_000_000_000);
}

// Covers a rollback: an earlier program must not write into tables of an unknown version.
#[tokio::test]
async fn tables_of_a_later_version_are_rejected_and_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let database = file(folder.path()).await;
    let later = "INSERT INTO _sqlx_migrations (version, description, success, checksum, \
                 execution_time) VALUES (2, 'later', TRUE, x'00', 0)";
    sqlx::query(later)
        .execute(&database.pool().await.unwrap())
        .await
        .unwrap();
    let earlier = Database::new(&database.address).unwrap();
    let mut collector = Collector::new(&demo(), "spandrel");
    let batches = ten_minutes(&mut collector);
    let refused = earlier.write("life", &batches[..1]).await.unwrap_err();
    assert!(
        matches!(refused, HistoryError::Version { .. }),
        "{refused:?}"
    );
    let told = refused.to_string();
    assert!(
        told.contains("history.sqlite") && told.contains("a later version"),
        "{told}"
    );
    let rows = sqlx::query("SELECT COUNT(*) FROM series")
        .fetch_one(&database.pool().await.unwrap())
        .await
        .unwrap();
    assert_eq!(rows.try_get::<i64, _>(0).unwrap(), 0);
}
