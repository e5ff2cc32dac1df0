//! Model classes through the services: the leading class changes with the damage, and the alert
//! names the right storeys.
//!
//! The structures are the fifty-storey building of Huang & Yuen (2023), section 5.6.1, with its
//! damages at 12 s and 32 s, and a shortened form of the chain of hysteretic springs of section
//! 5.6.2.

use crate::support::{EstimateReader, Site, assert_same_bits, within};
use spandrel_bus::{AlertMessage, AlertState, Event, EventKind, ModelClassDisplay};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

fn example(name: &str) -> String {
    let path: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name);
    std::fs::read_to_string(path).unwrap()
}

#[track_caller]
fn replaced(text: &str, pairs: &[(&str, &str)]) -> String {
    let mut text = text.to_owned();
    for (old, new) in pairs {
        assert!(text.contains(old), "the example has no {old:?}");
        text = text.replacen(old, new, 1);
    }
    text
}

#[tokio::test(flavor = "multi_thread")]
async fn leading_class_follows_the_damage_of_the_high_rise_and_the_alert_names_its_storeys() {
    const SECONDS: f64 = 50.0;
    const DAMAGE_S: [f64; 2] = [12.0, 32.0];
    let text = replaced(
        &example("high-rise.toml"),
        &[
            ("at-s = 80\n", "at-s = 12\n"),
            ("at-s = 150\n", "at-s = 32\n"),
        ],
    );
    let site = Site::with(&text);
    let record = site.simulate(SECONDS);
    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let displays = bus
        .subscribe::<ModelClassDisplay>(site.keys().model_class(), 1 << 14)
        .await
        .unwrap();
    let events = bus
        .subscribe::<Event>(site.keys().event(), 1 << 10)
        .await
        .unwrap();
    let alerts = bus
        .subscribe::<AlertMessage>(site.keys().all_alerts(), 1 << 10)
        .await
        .unwrap();
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let replay = site.replay(&record, "max");
    reader.read_frames(record.len()).await;
    replay.wait().expect_code(0);

    let start_ns = record.time_ns(0);
    let time_s = |time_ns: i64| (time_ns - start_ns) as f64 * 1e-9;
    let mut shown = Vec::new();
    while shown
        .last()
        .is_none_or(|display: &ModelClassDisplay| time_s(display.time_ns) < SECONDS - 0.15)
    {
        let (_, display) = within("the last display", displays.messages().recv_async())
            .await
            .unwrap();
        assert!(
            (display
                .classes
                .iter()
                .map(|class| class.plausibility)
                .sum::<f64>()
                - 1.0)
                .abs()
                < 1e-9
        );
        shown.push(display);
    }
    let share = |from_s: f64, to_s: f64, classes: &[&str]| {
        let inside = shown
            .iter()
            .filter(|display| (from_s..to_s).contains(&time_s(display.time_ns)));
        let leads: Vec<bool> = inside
            .map(|display| classes.contains(&&display.leading[..]))
            .collect();
        leads.iter().filter(|leads| **leads).count() as f64 / leads.len() as f64
    };
    let first = |from_s: f64, classes: &[&str]| {
        let found = shown
            .iter()
            .find(|display| {
                time_s(display.time_ns) >= from_s && classes.contains(&&display.leading[..])
            })
            .map(|display| time_s(display.time_ns) - from_s);
        found.unwrap_or(f64::INFINITY)
    };
    // Classes that have the damaged storey on its own. A richer class may lead if the jump at the
    // damage decides.
    let (storey_1, storey_3) = (
        ["one-single", "two-single"],
        ["three-single", "five-single"],
    );
    println!(
        "first damage: leads after {:.1} s; second: after {:.1} s",
        first(DAMAGE_S[0], &storey_1),
        first(DAMAGE_S[1], &storey_3)
    );
    assert!(share(6.0, DAMAGE_S[0], &["all-alike"]) >= 0.95);
    assert!(first(DAMAGE_S[0], &storey_1) <= 10.0);
    assert!(share(DAMAGE_S[0] + 10.0, DAMAGE_S[1], &storey_1) >= 0.95);
    assert!(first(DAMAGE_S[1], &storey_3) <= 8.0);
    assert!(share(DAMAGE_S[1] + 8.0, SECONDS, &storey_3) >= 0.95);

    let events: Vec<Event> = events.messages().drain().map(|(_, event)| event).collect();
    let led: Vec<(f64, &str)> = events
        .iter()
        .filter(|event| event.kind == EventKind::LeadingClass)
        .map(|event| (time_s(event.time_ns), &event.what[..]))
        .collect();
    println!("{led:?}");
    for (damage_s, class) in [
        (DAMAGE_S[0], "one-single leads"),
        (DAMAGE_S[1], "-single leads"),
    ] {
        let told = led
            .iter()
            .any(|(at, what)| (damage_s..damage_s + 11.0).contains(at) && what.contains(class));
        assert!(
            told,
            "no event tells of {class} after {damage_s} s: {led:?}"
        );
    }
    let heard: Vec<AlertMessage> = alerts.messages().drain().map(|(_, alert)| alert).collect();
    let raised: Vec<(&str, f64)> = heard
        .iter()
        .filter(|alert| alert.state == AlertState::Raised && alert.revision == 0)
        .map(|alert| (alert.parameter.as_str(), time_s(alert.time_ns)))
        .collect();
    println!("raised {raised:?}");
    assert_eq!(
        raised.iter().map(|(storey, _)| *storey).collect::<Vec<_>>(),
        ["storey-1", "storey-3"]
    );
    assert!(
        raised
            .iter()
            .zip(DAMAGE_S)
            .all(|((_, at), damage_s)| (0.0..=18.0).contains(&(at - damage_s)))
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn calibration_of_a_class_is_an_event_and_estimates_equal_those_of_the_record() {
    let text = replaced(
        &example("bouc-wen-five.toml"),
        &[
            ("at-s = 150\n", "at-s = 12\n"),
            ("at-s = 250\n", "at-s = 500\n"),
            ("at-s = 250\n", "at-s = 500\n"),
        ],
    );
    let site = Site::with(&text);
    let record = site.simulate(22.0);
    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let events = bus
        .subscribe::<Event>(site.keys().event(), 1 << 10)
        .await
        .unwrap();
    let displays = bus
        .subscribe::<ModelClassDisplay>(site.keys().model_class(), 1 << 14)
        .await
        .unwrap();
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    site.replay(&record, "max").wait().expect_code(0);
    let streamed = reader.read_to_end(1).await;
    let offline = site.estimate(&record);
    assert_same_bits(
        "the services",
        &offline.parameters,
        &offline.frames,
        streamed,
    );

    let damage_ns = record.time_ns(12 * 500);
    let notice = loop {
        let (_, event) = within("the notice", events.messages().recv_async())
            .await
            .unwrap();
        if event.kind == EventKind::Calibration && event.time_ns > damage_ns {
            break event;
        }
    };
    println!(
        "{:.2} s after the damage: {}",
        (notice.time_ns - damage_ns) as f64 * 1e-9,
        notice.what
    );
    assert!(
        notice.what.starts_with("class storey-1 recalibrated by −"),
        "{}",
        notice.what
    );
    assert!((1e9..4e9).contains(&((notice.time_ns - damage_ns) as f64)));
    let shown = loop {
        let (_, display) = within("the display", displays.messages().recv_async())
            .await
            .unwrap();
        if display
            .calibration
            .as_ref()
            .is_some_and(|calibration| calibration.time_ns == notice.time_ns)
        {
            break display;
        }
    };
    let names: BTreeSet<&str> = shown.classes.iter().map(|class| &class.class[..]).collect();
    assert!(
        names.contains("baseline") && names.contains("storey-5") && names.len() == 6,
        "{names:?}"
    );
    let (mean, std) = streamed.last().unwrap().mean_and_std[offline
        .parameters
        .iter()
        .position(|name| name == "storey-1")
        .unwrap()];
    assert!(
        (mean - 0.95).abs() < 4.0 * std && std < 0.02,
        "storey-1 {mean} ± {std}"
    );
}
