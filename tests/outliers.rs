//! Wrong samples through the services: they are flagged on their topic, and the stiffness is as
//! accurate as without them.
//!
//! The oscillator of Huang & Yuen (2023), chapter 4, shortened to 300 s with the damage at 200 s.
//! The rates are those of a correct implementation with this generator. The published rates count
//! only grossly wrong samples.

use crate::support::{
    EstimateReader, Identified, Record, Site, assert_same_bits, two_storeys, within,
};
use spandrel_bus::{ChannelState, Event, EventKind, Name, OutlierDisplay, Subscription};
use std::path::{Path, PathBuf};

const SECONDS: f64 = 300.0;
const DAMAGE_S: f64 = 200.0;

fn example() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/corrupted-oscillator.toml")
}

/// Returns the same motion and noise without wrong samples, and a filter without screening.
fn sound() -> String {
    let text = std::fs::read_to_string(example()).unwrap();
    let sound = text
        .replace("spike-share = 0.01", "spike-share = 0")
        .replace("[outliers]\nwindow-s = 50\n", "");
    assert!(
        !sound.contains("[outliers]") && !sound.contains("0.01 "),
        "the example has changed"
    );
    sound
}

fn name(text: &str) -> Name {
    text.parse().unwrap()
}

/// Returns the root mean square error of the stiffness from 10 s on.
fn stiffness_error(estimates: &[Identified]) -> f64 {
    let start = estimates[0].time_ns;
    let errors = estimates.iter().filter_map(|frame| {
        let time_s = (frame.time_ns - start) as f64 * 1e-9;
        let truth = if time_s < DAMAGE_S { 1.0 } else { 0.95 };
        (time_s >= 10.0).then(|| (frame.mean_and_std[0].0 - truth).powi(2))
    });
    let (sum, count) = errors.fold((0.0, 0.0), |(sum, count), square| {
        (sum + square, count + 1.0)
    });
    f64::sqrt(sum / count)
}

/// Returns the number of rows in which two records differ.
fn different_rows(a: &Record, b: &Record) -> usize {
    (0..a.len())
        .filter(|&row| a.value(row, "roof") != b.value(row, "roof"))
        .count()
}

async fn last_display(displays: &Subscription<OutlierDisplay>, time_ns: i64) -> OutlierDisplay {
    loop {
        let (_, display) = within("the last display", displays.messages().recv_async())
            .await
            .unwrap();
        if display.time_ns >= time_ns {
            return display;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_samples_are_flagged_and_hardly_affect_the_estimate() {
    let site = Site::of(&example());
    let record = site.simulate(SECONDS);
    let sound_site = Site::with(&sound());
    let sound_record = sound_site.simulate(SECONDS);
    let wrong = different_rows(&record, &sound_record) as f64;
    let frames = record.len() as f64;
    assert!(
        (0.009..0.011).contains(&(wrong / frames)),
        "{wrong} wrong samples of {frames}"
    );

    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let displays = bus
        .subscribe(site.keys().outlier(&name("roof")), 1 << 14)
        .await
        .unwrap();
    let mut reader = EstimateReader::join_patiently(&bus, &site.keys()).await;
    // At this speed, the source keeps its estimates for longer than several fetches take.
    site.replay(&record, "15").wait().expect_code(0);
    let streamed = reader.read_to_end(1).await;
    let offline = site.estimate(&record);
    assert_same_bits(
        "the services",
        &offline.parameters,
        &offline.frames,
        streamed,
    );

    let display = last_display(&displays, record.time_ns(record.len() - 20)).await;
    let rejected = display.rejected as f64;
    println!(
        "{wrong} wrong of {frames}, rejected {rejected}, scale {:.5}",
        display.scale
    );
    assert_eq!(display.state, ChannelState::Screening);
    assert!(display.screened as f64 > 0.999 * frames);
    // Masking is 8 to 15 % and swamping 0.3 to 1.3 %.
    assert!(rejected > 0.85 * wrong + 0.003 * frames, "{display:?}");
    assert!(rejected < 0.92 * wrong + 0.013 * frames, "{display:?}");
    assert!(
        display
            .masked
            .is_some_and(|span| span.samples >= 1 && span.to_ns >= span.from_ns)
    );

    let (with, without) = (
        stiffness_error(streamed),
        stiffness_error(&sound_site.estimate(&sound_record).frames),
    );
    println!("rms error of the stiffness {with:.4} with wrong samples, {without:.4} without");
    assert!(with <= 1.25 * without, "{with} against {without}");
}

#[tokio::test(flavor = "multi_thread")]
async fn broken_sensor_is_reported_and_excluded() {
    let site = Site::with(&two_storeys(
        "[outliers]\nfault-window-s = 2\ntraining-s = 2\n",
    ));
    let mut record = site.simulate(60.0);
    // The accelerometer of the first floor comes loose at 20 s and rattles.
    record.change("floor-1", 2000..record.len(), |row, value| {
        value + if row % 2 == 0 { 3.0 } else { -2.5 }
    });
    record.save_as("broken.csv");
    let _services = site.run();
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let events = bus
        .subscribe::<Event>(site.keys().event(), 1024)
        .await
        .unwrap();
    let displays = bus
        .subscribe(site.keys().outlier(&name("floor-1")), 1 << 14)
        .await
        .unwrap();
    let mut reader = EstimateReader::join_patiently(&bus, &site.keys()).await;
    site.replay(&record, "max").wait().expect_code(0);
    let (mean, _) = reader.read_to_end(1).await.last().unwrap().mean_and_std[0];
    let excluded = loop {
        let (_, event) = within("the event", events.messages().recv_async())
            .await
            .unwrap();
        if event.kind == EventKind::ChannelExcluded {
            break event;
        }
    };
    assert_eq!(excluded.subject, "floor-1");
    let after_s = (excluded.time_ns - record.time_ns(2000)) as f64 * 1e-9;
    assert!(
        (0.0..=6.0).contains(&after_s),
        "told {after_s} s after it broke"
    );
    let display = last_display(&displays, record.time_ns(record.len() - 20)).await;
    assert_eq!(display.state, ChannelState::Faulty);
    assert!(
        (mean - 1.0).abs() < 0.02,
        "storey-1 is taken as {mean} because of a broken sensor"
    );
}
