//! The bench frame on a shake table: real records of two known states, and the accuracy of their
//! results.
//!
//! The records and the expected figures are in `shared/data/mini-shake-table` next to the
//! repository, with source and licence. Without that folder these tests are skipped, or fail if
//! `REQUIRE_ALL_TESTS` is set.

use crate::support::records_or_skip;
use nalgebra::{Matrix3, Vector3};
use serde_json::Value;
use spandrel_bus::{FrameBlock, Header, StreamState};
use spandrel_filter::{ExtendedKalmanFilter, Frame as SamplesOfAFrame};
use spandrel_identify::{Identification, IdentificationInput, Output};
use spandrel_record::{ChannelColumn, ColumnMapping, OffsetRemoval, RecordReader, Recording};
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};
use std::process::Command;

const MOTIONS: [&str; 3] = ["sine1.0", "sine2.0", "northridge"];

/// Nominal values of a state, and the expectations in the README of the records.
struct Frame {
    state: &'static str,
    masses_kg: [f64; 3],
    stiffnesses: [f64; 3],
    first_frequency_hz: (f64, f64),
}

const STIFF: Frame = Frame {
    state: "stiff",
    masses_kg: [0.2335, 0.2335, 0.1788],
    stiffnesses: [2720.0, 2300.0, 2360.0],
    first_frequency_hz: (7.8, 8.0),
};

const FLEXIBLE: Frame = Frame {
    state: "flexible",
    masses_kg: [0.1602, 0.1602, 0.1421],
    stiffnesses: [437.0, 392.0, 398.0],
    first_frequency_hz: (3.7, 3.8),
};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/mini-shake-table/aligned")
}

fn records_are_missing() -> bool {
    records_or_skip("mini-shake-table/aligned").is_none()
}

fn example(state: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join(format!("../../docs/examples/shake-table-{state}.toml"))
}

/// Reads the example file of a state, with some of its text replaced.
fn structure(state: &str, changes: &[(&str, &str)]) -> Structure {
    let path = example(state);
    let mut text = std::fs::read_to_string(&path).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "{} has no {from:?}", path.display());
        text = text.replace(from, to);
    }
    Structure::parse(&text, &path).unwrap()
}

/// Returns the frames of a record as ingest would make them: no sample is missing, and all sensors
/// share one clock.
fn frames(structure: &Structure, motion: &str, state: &str) -> FrameBlock {
    let map = structure.record();
    let columns = structure
        .channels()
        .zip(map.columns())
        .map(|(channel, column)| ChannelColumn::new(channel.name()).with_column(column.column()));
    let mapping = ColumnMapping::new(columns.collect()).with_time_column(map.time_column());
    let path = folder().join(format!("{state}-{motion}.csv"));
    let offset = OffsetRemoval::MeanOfFirst {
        seconds: map.remove_offset_s(),
    };
    let mut recording = Recording::open(&path, &mapping, offset).unwrap();
    let mut values = Vec::new();
    while let Some(row) = recording.next_row().unwrap() {
        values.extend_from_slice(row.values);
    }
    FrameBlock {
        header: Header {
            source: "record".to_owned(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: structure.sampling_rate_hz(),
        channels: structure.channel_count() as u16,
        values,
        state: StreamState::Ended,
    }
}

struct Outcome {
    /// Storey stiffnesses of the frames in motion (N/m).
    stiffnesses: Vec<[f64; 3]>,
    /// First frequency of the identified model for the frames in motion (Hz).
    first_frequencies: Vec<f64>,
}

/// Normalised innovations of all frames: mean of νᵀS⁻¹ν/3, and share below the 95 % point of χ²
/// with 3 degrees of freedom.
struct Innovations {
    misfit: f64,
    below_bound: f64,
}

/// 95 % point of χ² with 3 degrees of freedom (from tables).
const CHI_SQUARED_95: f64 = 7.815;

fn identify(structure: &Structure, frame: &Frame, motion: &str) -> Outcome {
    let block = frames(structure, motion, frame.state);
    let top: Vec<f64> = block.iter().map(|(_, values)| values[3]).collect();
    let mut core = Identification::new(structure, "test").unwrap();
    let mut outputs = Vec::new();
    core.handle(IdentificationInput::Frames(block), &mut outputs);
    assert_eq!(
        core.restarts(),
        0,
        "{} {motion}: the filter was restarted",
        frame.state
    );
    let estimates: Vec<_> = outputs
        .iter()
        .flat_map(|output| match output {
            Output::Estimates(block) => block.estimates.as_slice(),
            _ => &[],
        })
        .collect();
    assert_eq!(estimates.len(), top.len());
    let mut outcome = Outcome {
        stiffnesses: vec![],
        first_frequencies: vec![],
    };
    let mut last_motion = None;
    for (k, estimate) in estimates.iter().enumerate() {
        if top[k].abs() > 0.5 {
            last_motion = Some(k);
        }
        if last_motion.is_some_and(|last| k - last < 120) {
            let k = [0, 1, 2].map(|storey| estimate.mean[storey] * frame.stiffnesses[storey]);
            outcome.stiffnesses.push(k);
            outcome
                .first_frequencies
                .push(first_frequency_hz(frame.masses_kg, k));
        }
    }
    outcome
}

/// Returns the innovations of the filter alone, without the reaction to a wrong model, which would
/// reopen the parameters repeatedly here.
fn innovations(structure: &Structure, frame: &Frame, motion: &str) -> Innovations {
    let mut settings = structure.filter_settings().unwrap();
    settings.misfit = None;
    let mut filter = ExtendedKalmanFilter::new(structure.model(), settings).unwrap();
    let block = frames(structure, motion, frame.state);
    let count = block.iter().count() as f64;
    let mut found = Innovations {
        misfit: 0.0,
        below_bound: 0.0,
    };
    for (_, values) in block.iter() {
        let observations: Vec<f64> = structure
            .observation_channels()
            .iter()
            .map(|c| values[*c])
            .collect();
        let excitation: Vec<f64> = structure
            .excitation_channels()
            .iter()
            .map(|c| c.map_or(0.0, |c| values[c]))
            .collect();
        let step = filter
            .step(SamplesOfAFrame {
                observations: &observations,
                excitation: &excitation,
            })
            .unwrap();
        found.misfit += step.normalised_innovation_squared / 3.0 / count;
        found.below_bound += f64::from(u8::from(
            step.normalised_innovation_squared < CHI_SQUARED_95,
        )) / count;
    }
    found
}

fn first_frequency_hz(m: [f64; 3], k: [f64; 3]) -> f64 {
    let stiffness = Matrix3::new(
        k[0] + k[1],
        -k[1],
        0.0,
        -k[1],
        k[1] + k[2],
        -k[2],
        0.0,
        -k[2],
        k[2],
    );
    let scale = Matrix3::from_diagonal(&Vector3::from(m.map(|mass| 1.0 / mass.sqrt())));
    (scale * stiffness * scale)
        .symmetric_eigenvalues()
        .min()
        .max(0.0)
        .sqrt()
        / std::f64::consts::TAU
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn identified_model_has_the_first_frequency_of_the_frame_in_every_motion() {
    if records_are_missing() {
        return;
    }
    for frame in [&STIFF, &FLEXIBLE] {
        let structure = structure(frame.state, &[]);
        let mut storey_1 = Vec::new();
        for motion in MOTIONS {
            let outcome = identify(&structure, frame, motion);
            let frequency = median(outcome.first_frequencies.iter().copied());
            let stiffness =
                [0, 1, 2].map(|storey| median(outcome.stiffnesses.iter().map(|k| k[storey])));
            println!(
                "{} {motion}: {frequency:.3} Hz, {stiffness:.0?} N/m",
                frame.state
            );
            let (low, high) = frame.first_frequency_hz;
            let allowed = (0.96 * low)..=(1.04 * high);
            assert!(
                allowed.contains(&frequency),
                "{} {motion}: first frequency {frequency:.3} Hz, expected {low} to {high} within \
                 4 %",
                frame.state
            );
            storey_1.push(stiffness[0]);
        }
        let (low, high) = storey_1.iter().fold((f64::MAX, 0.0_f64), |(low, high), k| {
            (low.min(*k), high.max(*k))
        });
        assert!(
            high / low <= 1.10,
            "{}: storey 1 has {storey_1:.0?} N/m in the three motions",
            frame.state
        );
    }
}

#[test]
fn default_noise_rule_keeps_innovations_consistent_over_the_whole_band() {
    if records_are_missing() {
        return;
    }
    for frame in [&STIFF, &FLEXIBLE] {
        let corner = if frame.state == "stiff" { "12" } else { "6" };
        let band = format!("[band-limit]\nfrequency-hz = {corner}\norder = 4\n");
        let floor = "noise-floor = 1          # never sure beyond what the model explains";
        let whole_band = structure(frame.state, &[(&band, ""), (floor, "")]);
        let published = structure(
            frame.state,
            &[(&band, ""), (floor, "noise-rule = \"published\"")],
        );
        for motion in MOTIONS {
            let [default, published] =
                [&whole_band, &published].map(|s| innovations(s, frame, motion));
            println!(
                "{} {motion}: misfit {:.3}, {:.1} % below χ² 95 %; published rule {:.1}, {:.1} %",
                frame.state,
                default.misfit,
                100.0 * default.below_bound,
                published.misfit,
                100.0 * published.below_bound
            );
            let Innovations {
                misfit,
                below_bound,
            } = default;
            assert!(
                (0.3..=1.3).contains(&misfit),
                "{} {motion}: misfit {misfit}",
                frame.state
            );
            assert!(
                below_bound >= 0.90,
                "{} {motion}: {below_bound} below the bound",
                frame.state
            );
        }
    }
}

/// Runs the built program and returns its last output as JSON.
fn estimate(record: &str, baseline: &Path) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .arg("estimate")
        .arg(example("stiff"))
        .arg("--record")
        .arg(folder().join(record))
        .arg("--baseline")
        .arg(baseline)
        .arg("--json")
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let text = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(text.lines().last().unwrap()).unwrap()
}

#[test]
fn baseline_of_the_stiff_frame_distinguishes_strong_shaking_from_softer_walls() {
    if records_are_missing() {
        return;
    }
    let scratch = tempfile::tempdir().unwrap();
    let baseline = scratch.path().join("stiff.baseline.json");
    let mut learn = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    learn
        .arg("baseline")
        .arg(example("stiff"))
        .arg("--output")
        .arg(&baseline);
    // Two records contain little information on the scatter between records. Amplitude alone causes
    // 5 % in this frame.
    learn.args(["--between-std", "0.05"]);
    for motion in ["sine1.0", "sine2.0"] {
        learn
            .arg("--record")
            .arg(folder().join(format!("stiff-{motion}.csv")));
    }
    let output = learn.output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    println!("{}", String::from_utf8_lossy(&output.stdout));

    let sound = estimate("stiff-northridge.csv", &baseline);
    println!("stiff-northridge: {}", sound["alerts"]);
    assert_eq!(
        sound["alerts"],
        Value::Array(vec![]),
        "strong shaking of the sound frame raised an alert"
    );

    let softer = estimate("flexible-northridge.csv", &baseline);
    println!("flexible-northridge: {}", softer["alerts"]);
    let alerts = softer["alerts"].as_array().unwrap();
    for storey in ["storey-1", "storey-2", "storey-3"] {
        let raised = alerts
            .iter()
            .any(|alert| alert["parameter"] == storey && alert["state"] == "raised");
        assert!(raised, "{storey} was not raised: {alerts:?}");
    }
}
