//! Times the steps of the filters of example structures, one after the other.
//!
//! `cargo run --release -p spandrel-structure --example step_time [name…]`; a name is that of a file in `docs/examples`.

#![expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]

use spandrel_filter::{ExtendedKalmanFilter, Frame};
use spandrel_structure::Structure;
use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

const EXAMPLES: [&str; 5] = ["demo", "high-rise", "three-pier-bridge", "fourteen-bay-truss", "tower"];
const FRAMES: usize = 300;
const LONGEST: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error>> {
    let named: Vec<String> = std::env::args().skip(1).collect();
    let names = if named.is_empty() { EXAMPLES.map(str::to_owned).to_vec() } else { named };
    for name in names {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples").join(&name).with_extension("toml");
        let structure = Structure::read(&path)?;
        let mut filter = ExtendedKalmanFilter::new(structure.model(), structure.filter_settings()?)?;
        let mut times = Vec::new();
        for frame in structure.simulator(1).take(FRAMES) {
            let observations: Vec<f64> = structure.observation_channels().iter().map(|c| frame.values[*c]).collect();
            let excitation: Vec<f64> =
                structure.excitation_channels().iter().map(|c| c.map_or(0.0, |c| frame.values[c])).collect();
            let start = Instant::now();
            filter.step(Frame { observations: &observations, excitation: &excitation })?;
            times.push(start.elapsed());
            if times.iter().sum::<Duration>() > LONGEST {
                break;
            }
        }
        let n = filter.mean().len();
        times.remove(0); // the first frame is not predicted
        times.sort();
        println!("{name}, n = {n}: median {:?}, fastest {:?} of {}", times[times.len() / 2], times[0], times.len());
    }
    Ok(())
}
