//! Checks printed constants and message sizes of structures with distributed identification.
//!
//! Source: Huang & Yuen (2023), chapters 6 and 7. Models without printed numbers are recomputed
//! from the description.

use spandrel_structure::{PeriodNumbers, Structure};
use std::path::Path;

fn text(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .with_extension("toml");
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{error}"))
}

fn parse(text: &str) -> Structure {
    Structure::parse(text, Path::new("example.toml")).unwrap_or_else(|error| panic!("{error}"))
}

/// Reads the example with another `[fusion]` table.
fn with_fusion(name: &str, fusion: &str) -> Structure {
    let text = text(name);
    let (start, end) = (
        text.find("[fusion]").unwrap(),
        text.find("[simulation]").unwrap(),
    );
    parse(&format!(
        "{}[fusion]\n{fusion}\n\n{}",
        &text[..start],
        &text[end..]
    ))
}

#[track_caller]
fn assert_close(what: &str, found: f64, expected: f64, tolerance: f64) {
    assert!(
        (found - expected).abs() <= tolerance,
        "{what}: {found}, expected {expected} ± {tolerance}"
    );
}

#[test]
fn frequencies_and_damping_are_as_recomputed() {
    for (name, degrees, frequencies, tolerance, damping) in [
        (
            "forty-storey-building",
            40,
            &[0.2530, 0.7586, 1.2631, 1.7656, 2.2656][..],
            1e-4,
            Some([0.0099, 0.0097]),
        ),
        (
            "two-pier-bridge",
            49,
            &[0.315, 0.790, 0.968, 1.087, 1.110, 1.202, 1.872],
            1e-3,
            Some([0.0203, 0.0206]),
        ),
        (
            "two-degrees-of-freedom",
            2,
            &[3.111],
            5e-4,
            Some([0.01, 0.01]),
        ),
        (
            "sixteen-bay-truss",
            58,
            &[2.1757, 2.3440, 5.2496, 5.6024, 8.3385],
            5e-5,
            None,
        ),
        ("forty-storey-spikes", 40, &[0.2869], 5e-5, None),
    ] {
        let structure = parse(&text(name));
        assert_eq!(structure.degrees_of_freedom().len(), degrees, "{name}");
        let found = structure.natural_frequencies_hz();
        for (mode, (found, expected)) in found.iter().zip(frequencies).enumerate() {
            assert_close(
                &format!("{name}, frequency {}", mode + 1),
                *found,
                *expected,
                tolerance,
            );
        }
        let Some(damping) = damping else { continue };
        let modes = structure.check(0.1, 1).modes;
        for (mode, (found, expected)) in modes.iter().zip(damping).enumerate() {
            assert_close(
                &format!("{name}, damping ratio {}", mode + 1),
                found.damping_ratio,
                expected,
                5e-5,
            );
        }
    }
}

fn both_ways(numbers: usize) -> Option<PeriodNumbers> {
    Some(PeriodNumbers {
        sent: numbers,
        received: numbers,
    })
}

#[test]
fn messages_have_as_many_numbers_as_the_weights_of_the_source() {
    // Mixed weights use the full covariance of the parameters and the variances of the modes;
    // vector weights use only variances. The sizes are 4 N_m + N_θ (N_θ + 3) / 2 and 4 N_m + 2 N_θ.
    for (name, nodes, modes, mixed, vector, seconds, total) in [
        ("forty-storey-building", 16, 5, 85, 40, 300, 408_000),
        ("two-pier-bridge", 15, 6, 68, 40, 300, 306_000),
    ] {
        let motion = format!("motion = \"modes\"\nmodes = {modes}");
        let structure = with_fusion(name, &motion);
        assert_eq!(structure.sent_modes().map(|modes| modes.count), Some(modes));
        assert_eq!(structure.numbers_per_period(0), both_ways(mixed), "{name}");
        assert_eq!(
            structure.nodes().len() * mixed * seconds,
            total,
            "{name}, all nodes for {seconds} s"
        );
        assert_eq!(structure.nodes().len(), nodes);
        let structure = with_fusion(name, &format!("{motion}\ncovariance = \"variances\""));
        assert_eq!(structure.numbers_per_period(0), both_ways(vector), "{name}");
    }
    // Chapter 7: 128 bytes with variances and 352 with a full covariance, up and down; 0.8 and
    // 3.2 % of the raw samples.
    for (name, seconds, rate_hz, share) in [
        ("sixteen-bay-truss", 200.0, 1000.0, 0.008),
        ("forty-storey-spikes", 500.0, 250.0, 0.032),
    ] {
        let structure = with_fusion(name, "covariance = \"variances\"");
        assert_eq!(
            structure.numbers_per_period(0),
            both_ways(128 / 8),
            "{name}"
        );
        let nodes = structure.nodes().len() as f64;
        let (sent, raw) = (nodes * 16.0 * seconds, nodes * 2.0 * rate_hz * seconds);
        assert_close(
            &format!("{name}, share of the raw samples"),
            sent / raw,
            share,
            1e-12,
        );
        assert_eq!(
            (structure.sampling_rate_hz(), raw),
            (rate_hz, 4e6),
            "{name}"
        );
        let structure = with_fusion(name, "covariance = \"full\"");
        assert_eq!(
            structure.numbers_per_period(0),
            both_ways(352 / 8),
            "{name}"
        );
    }
}

#[test]
fn modes_are_selected_by_their_mass() {
    // Building: 0.82, 0.09, 0.03, 0.02, 0.01. Bridge: 0.018, 0.214, 0.677 in modes 2, 4, 7, and
    // zero in the other modes up to the eighth.
    let missed = |name: &str, modes: usize| {
        let structure = with_fusion(name, &format!("motion = \"modes\"\nmodes = {modes}"));
        structure.sent_modes().unwrap().missed_mass
    };
    for (modes, kept) in [(1, 0.82), (2, 0.91), (5, 0.97)] {
        assert_close(
            &format!("building, {modes} modes"),
            1.0 - missed("forty-storey-building", modes),
            kept,
            0.01,
        );
    }
    for (modes, kept) in [(1, 0.677), (2, 0.891), (3, 0.909)] {
        assert!(
            1.0 - missed("two-pier-bridge", modes) >= kept - 1e-3,
            "bridge, {modes} modes"
        );
    }
}
