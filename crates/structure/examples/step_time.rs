//! Measures the step time of the filters of example structures.
//!
//! It compares the route that suits the structure with the Jacobian as an operator.
//!
//! `cargo run --release -p spandrel-structure --example step_time [name…]`, where a name is a file
//! name in `docs/examples`.

#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]

#[path = "../tests/all/by_operator/mod.rs"]
mod by_operator;

use by_operator::ByOperator;
use spandrel_filter::{
    ExtendedKalmanFilter, FilterSettings, Frame, ObservationModel, ProcessModel,
};
use spandrel_structure::Structure;
use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

const EXAMPLES: [&str; 5] = [
    "demo",
    "high-rise",
    "three-pier-bridge",
    "fourteen-bay-truss",
    "tower",
];
const FRAMES: usize = 1500;
const LONGEST: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error>> {
    let named: Vec<String> = std::env::args().skip(1).collect();
    let names = if named.is_empty() {
        EXAMPLES.map(str::to_owned).to_vec()
    } else {
        named
    };
    for name in names {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../docs/examples")
            .join(&name)
            .with_extension("toml");
        let structure = Structure::read(&path)?;
        let n = structure.model().state_len();
        let settings = structure.filter_settings()?;
        let trusting = FilterSettings {
            misfit: None,
            ..settings.clone()
        };
        let by_structure = median_step(&structure, structure.model(), settings.clone())?;
        let without_misfit = median_step(&structure, structure.model(), trusting)?;
        let by_operator = median_step(&structure, ByOperator(structure.model()), settings)?;
        println!(
            "{name}, n = {n}: {by_structure:?}, without the measure of misfit {without_misfit:?}, \
             by operator {by_operator:?}"
        );
    }
    Ok(())
}

fn median_step(
    structure: &Structure,
    model: impl ProcessModel + ObservationModel,
    settings: FilterSettings,
) -> Result<Duration, Box<dyn Error>> {
    let mut filter = ExtendedKalmanFilter::new(model, settings)?;
    let mut times = Vec::new();
    for frame in structure.simulator(1).take(FRAMES) {
        let observations: Vec<f64> = structure
            .observation_channels()
            .iter()
            .map(|c| frame.values[*c])
            .collect();
        let excitation: Vec<f64> = structure
            .excitation_channels()
            .iter()
            .map(|c| c.map_or(0.0, |c| frame.values[c]))
            .collect();
        let start = Instant::now();
        filter.step(Frame {
            observations: &observations,
            excitation: &excitation,
        })?;
        times.push(start.elapsed());
        if times.iter().sum::<Duration>() > LONGEST {
            break;
        }
    }
    times.remove(0); // the first frame has no prediction
    times.sort();
    Ok(times[times.len() / 2])
}
