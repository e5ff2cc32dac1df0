//! Every example of a kind of model can be checked and simulated.
#![expect(clippy::panic, reason = "helpers of tests are no tests to clippy")]

use spandrel_structure::Structure;
use std::path::Path;

fn example(name: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples").join(name).with_extension("toml");
    Structure::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

/// The tower is left to its own tests: its check takes some seconds.
const EXAMPLES: [&str; 8] = [
    "three-pier-bridge",
    "fourteen-bay-truss",
    "dome",
    "bouc-wen-ten",
    "bouc-wen-five",
    "hysteretic-oscillator",
    "dashpot-building",
    "high-rise",
];

#[test]
fn every_example_can_be_checked() {
    for name in EXAMPLES {
        let report = example(name).check(0.5, 1);
        assert!(report.modes.iter().all(|mode| mode.frequency_hz > 0.0 && mode.damping_ratio >= 0.0), "{name}");
        let identification = report.identification.unwrap_or_else(|| panic!("{name} has no stationary filter"));
        assert!(identification.parameters.iter().all(|p| p.std_after <= p.prior_std * (1.0 + 1e-9)), "{name}");
    }
}

#[test]
fn every_example_can_be_simulated() {
    for name in EXAMPLES.into_iter().chain(["tower"]) {
        for frame in example(name).simulator(1).take(100) {
            assert!(frame.values.iter().all(|value| value.is_finite()), "{name}, frame {}", frame.index);
        }
    }
}
