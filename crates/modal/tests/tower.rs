//! The natural frequencies of a full-scale test tower update the stiffnesses of a shear chain. What
//! shakes the tower is not used.
//!
//! The records are in `shared/data` beside the repository. Each is judged against the other two,
//! with one epoch per record. A loss of one storey is added by the calibrated model: its change of
//! each frequency and shape is added to the identified ones, whose residuals stay.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

#[path = "../../../tests/support/skip.rs"]
#[expect(dead_code, reason = "the other tests that can be skipped")]
mod skip;

use nalgebra::{Complex, DMatrix, DVector};
use skip::records_or_skip;
use spandrel_modal::{
    Entry, ModalSettings, ModalStream, Mode, PartModel, SeenMode, Source, StiffnessChange,
    UpdateReference, UpdateSettings, identify,
};

const MASS_KG: f64 = 19_370.0;
/// Stiffnesses of the storeys with about the frequencies of the tower (N/m).
const STIFFNESSES: [f64; 5] = [1.65e6, 4.06e6, 4.04e6, 3.45e6, 9.75e6];
/// Sway modes of the tower (Hz). Others are torsion.
const MODES_HZ: [f64; 5] = [0.52, 1.73, 2.95, 4.16, 5.37];
/// Column (from 0) and scale of each floor, from the lowest up (m/s² per volt).
const FLOORS: [(usize, f64); 5] = [(4, 2.0), (5, 1.0), (6, 1.0), (3, 2.0), (2, -9.8)];
const RATE_HZ: f64 = 100.0;
const LOSS: f64 = 0.15;

fn model() -> PartModel {
    let storey = |(storey, stiffness): (usize, &f64)| {
        let entry = |row, column, value| Entry { row, column, value };
        let mut entries = vec![entry(storey, storey, *stiffness)];
        if let Some(below) = storey.checked_sub(1) {
            entries.push(entry(below, below, *stiffness));
            entries.push(entry(below, storey, -stiffness));
            entries.push(entry(storey, below, -stiffness));
        }
        entries
    };
    PartModel::new(
        DMatrix::identity(5, 5) * MASS_KG,
        DMatrix::zeros(5, 5),
        STIFFNESSES.iter().enumerate().map(storey).collect(),
        DMatrix::identity(5, 5),
    )
    .unwrap()
}

/// Returns the sway modes of one record.
fn modes(text: &str) -> Vec<Mode> {
    let settings = ModalSettings {
        epoch_s: 380.0,
        lowest_hz: 0.3,
        highest_hz: 8.0,
        ..ModalSettings::new(5, RATE_HZ)
    };
    let mut stream = ModalStream::new(&settings).unwrap();
    let epoch = text.lines().find_map(|line| {
        let volts: Vec<f64> = line
            .split_whitespace()
            .map(|volt| volt.parse().unwrap())
            .collect();
        stream
            .push(&FLOORS.map(|(column, scale)| scale * volts[column]))
            .unwrap()
    });
    let found = identify(&epoch.unwrap()).unwrap().modes;
    let of = |near_hz: f64| {
        let modes = found.iter().filter(|mode| mode.source == Source::Mode);
        let distance = |mode: &Mode| (mode.frequency_hz / near_hz).ln().abs();
        modes
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .unwrap()
            .clone()
    };
    MODES_HZ.map(of).to_vec()
}

fn seen(modes: &[Mode]) -> Vec<Option<SeenMode>> {
    modes.iter().map(|mode| Some(mode.into())).collect()
}

/// Adds the effect of a loss of one storey to the modes of a record.
fn with_loss(modes: &[Mode], reference: &UpdateReference, storey: usize) -> Vec<Mode> {
    let mut lossy = reference.ln_stiffness.clone();
    lossy[storey] += f64::ln(1.0 - LOSS);
    let (before_hz, before) = model().modes(&reference.ln_stiffness).unwrap();
    let (after_hz, after) = model().modes(&lossy).unwrap();
    let mut modes = modes.to_vec();
    for (number, mode) in modes.iter_mut().enumerate() {
        mode.frequency_hz *= after_hz[number] / before_hz[number];
        let before = before.column(number).normalize();
        let after = after.column(number).normalize();
        let change = &after * after.dot(&before).signum() - &before;
        let real: DVector<f64> = mode.shape.map(|value| value.re);
        let scale = real.norm() * real.dot(&before).signum();
        mode.shape += change.map(|value| Complex::from(scale * value));
    }
    modes
}

fn percent(ln: f64) -> f64 {
    100.0 * (ln.exp() - 1.0)
}

#[test]
fn records_of_a_sound_tower_agree_and_a_loss_is_found_in_its_storey() {
    let mut records = Vec::new();
    for number in 1..=3 {
        let Some(path) = records_or_skip(&format!("unison-tower/wn_0{number}.dat")) else {
            return;
        };
        records.push(modes(&std::fs::read_to_string(path).unwrap()));
    }
    let (mut beyond_0, mut beyond_5, mut beyond_10, mut largest) = (0, 0, 0, 0);
    for (number, record) in records.iter().enumerate() {
        let others = records
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != number);
        let commissioning: Vec<_> = others.map(|(_, record)| seen(record)).collect();
        let settings = UpdateSettings {
            commissioning_epochs: 2,
            prior_std: vec![0.3; 5],
        };
        let reference = UpdateReference::learn(&model(), &settings, &commissioning).unwrap();
        assert_eq!(
            reference.of_model().flatten().collect::<Vec<_>>(),
            [0, 1, 2, 3, 4]
        );
        let sound = reference.change(&model(), &seen(record)).unwrap();
        println!(
            "record {}: scatter {:.2} % of f, {:.1} % of a shape",
            number + 1,
            100.0 * reference.frequency_scatter(),
            100.0 * reference.shape_scatter()
        );
        for storey in 0..5 {
            let at = sound.cdf(storey, 0.0);
            println!(
                "  storey {}: {:+.1} % [{:+.1}, {:+.1}]",
                storey + 1,
                percent(sound.mean(storey)),
                percent(sound.quantile(storey, 0.025)),
                percent(sound.quantile(storey, 0.975)),
            );
            assert!(
                (0.025..0.975).contains(&at),
                "record {number}, storey {storey}: {at}"
            );
            assert!(sound.probability_of_loss(storey, 0.1) < 0.5);
        }
        for storey in 0..5 {
            let lossy = with_loss(record, &reference, storey);
            let change = reference.change(&model(), &seen(&lossy)).unwrap();
            let probability = |loss: f64| change.probability_of_loss(storey, loss);
            println!(
                "  loss in storey {}: {:+.1} % [{:+.1}, {:+.1}], P > 0, 5, 10 %: {:.4} {:.3} {:.3}",
                storey + 1,
                percent(change.mean(storey)),
                percent(change.quantile(storey, 0.025)),
                percent(change.quantile(storey, 0.975)),
                probability(0.0),
                probability(0.05),
                probability(0.1),
            );
            beyond_0 += usize::from(probability(0.0) >= 0.99);
            beyond_5 += usize::from(probability(0.05) >= 0.95);
            beyond_10 += usize::from(probability(0.1) >= 0.99);
            let is_largest = (0..5).all(|other| change.mean(other) >= change.mean(storey));
            largest += usize::from(is_largest);
            // The interval contains the loss, and no other storey has certainly lost stiffness.
            let at = change.cdf(storey, f64::ln(1.0 - LOSS));
            assert!(
                (0.025..0.975).contains(&at),
                "record {number}, storey {storey}: {at}"
            );
            let certain = |change: &StiffnessChange, other: usize| {
                other != storey && change.probability_of_loss(other, 0.0) >= 0.99
            };
            assert!(
                !(0..5).any(|other| certain(&change, other)),
                "{number} {storey}"
            );
        }
    }
    println!(
        "of 15: largest in its storey {largest}, beyond 0 % (0.99) {beyond_0}, beyond 5 % (0.95) \
         {beyond_5}, beyond 10 % (0.99) {beyond_10}"
    );
    assert_eq!(largest, 15);
    assert!(beyond_0 >= 12, "{beyond_0}");
}
