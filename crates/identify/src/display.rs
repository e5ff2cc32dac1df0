//! Messages of noise levels at the display rate.

use spandrel_bus::{Name, NoiseDisplay};

/// Returns the display message of one noise level.
pub(crate) fn noise_display(
    structure: &Name,
    name: &Name,
    time_ns: i64,
    mean: f64,
    variance: f64,
) -> NoiseDisplay {
    NoiseDisplay {
        structure: structure.clone(),
        name: name.clone(),
        time_ns,
        mean,
        std: variance.max(0.0).sqrt(),
    }
}
