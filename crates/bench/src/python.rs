//! The filters in Python for comparison, here called peers: filterpy and NumPy, both with SciPy.
//!
//! They are in `python/peers.py`. The interpreter must have the packages of `requirements.txt`.

use crate::building::{
    ALPHA_PER_S, BETA_S, Building, GROUND_STD, MASS_KG, SENSOR_STD, STIFFNESS_N_PER_M,
};
use crate::timing::Times;
use serde::{Deserialize, Serialize};
use std::error::Error;
use std::path::Path;
use std::process::Command;

/// The building in the input format of the script.
#[derive(Debug, Serialize)]
struct Case<'a> {
    storeys: usize,
    mass: f64,
    stiffness: f64,
    alpha: f64,
    beta: f64,
    step: f64,
    fading: f64,
    ground_std: f64,
    sensor_std: f64,
    sensed: Vec<usize>,
    prior_mean: &'a [f64],
    prior_std: &'a [f64],
    frames: &'a [Vec<f64>],
}

/// The script's output for one filter.
#[derive(Debug, Deserialize)]
struct Line {
    name: String,
    times: Vec<f64>,
    mean: Vec<f64>,
}

/// Result of a filter in Python.
#[derive(Debug, Clone)]
pub struct PythonPeer {
    /// Name of the filter.
    pub name: String,
    /// Times of the steps of the filter, as measured in Python.
    pub times: Times,
    /// Mean of the state after the last frame (one value per state entry).
    pub mean: Vec<f64>,
}

/// Runs the filters of `python/peers.py` on the first `frames` frames of a building, each on one
/// core.
///
/// # Errors
/// Returns an error if the interpreter cannot be run, or if the script fails.
pub fn run(
    interpreter: &Path,
    building: &Building,
    frames: usize,
) -> Result<Vec<PythonPeer>, Box<dyn Error>> {
    let case = Case {
        storeys: building.storeys,
        mass: MASS_KG,
        stiffness: STIFFNESS_N_PER_M,
        alpha: ALPHA_PER_S,
        beta: BETA_S,
        step: building.settings.step_s,
        fading: building.settings.fading.value(),
        ground_std: GROUND_STD,
        sensor_std: SENSOR_STD,
        sensed: building.sensed().collect(),
        prior_mean: building.settings.prior_mean.as_slice(),
        prior_std: building.settings.prior_std.as_slice(),
        frames: &building.frames[..frames],
    };
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("building.json");
    std::fs::write(&path, serde_json::to_vec(&case)?)?;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/peers.py");
    // One core for each filter.
    let single = [
        ("OPENBLAS_NUM_THREADS", "1"),
        ("OMP_NUM_THREADS", "1"),
        ("MKL_NUM_THREADS", "1"),
    ];
    let output = Command::new(interpreter)
        .envs(single)
        .arg(script)
        .arg(&path)
        .output()?;
    if !output.status.success() {
        return Err(format!(
            "{}: {}",
            interpreter.display(),
            String::from_utf8_lossy(&output.stderr)
        )
        .into());
    }
    let lines = String::from_utf8(output.stdout)?;
    lines
        .lines()
        .map(|line| Ok(serde_json::from_str::<Line>(line)?.into()))
        .collect()
}

impl From<Line> for PythonPeer {
    fn from(
        Line {
            name,
            times: seconds,
            mean,
        }: Line,
    ) -> Self {
        let mut times = Times::default();
        seconds.into_iter().for_each(|time_s| times.push(time_s));
        Self { name, times, mean }
    }
}
