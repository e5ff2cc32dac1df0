//! Display values: parameters and noise levels at the display rate, decimated in measurement time.

use spandrel_bus::{Name, NoiseDisplay, ParameterDisplay};
use spandrel_structure::Structure;

/// Selects the displayed frames: the first one in each interval of measurement time.
///
/// The selection depends on frame numbers only. Block sizes and speed therefore do not affect it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decimation {
    frames_per_display: f64,
}

impl Decimation {
    pub(crate) fn new(sampling_rate_hz: f64, display_rate_hz: f64) -> Self {
        Self {
            frames_per_display: (sampling_rate_hz / display_rate_hz).max(1.0),
        }
    }

    /// Returns a decimation that shows one in `times` of these frames.
    pub(crate) fn one_in(self, times: u32) -> Self {
        Self {
            frames_per_display: self.frames_per_display * f64::from(times),
        }
    }

    pub(crate) fn shows(self, frame: u64) -> bool {
        let interval = |frame: u64| (frame as f64 / self.frames_per_display).floor();
        frame == 0 || interval(frame) > interval(frame - 1)
    }
}

/// The display settings of one parameter.
#[derive(Debug, Clone)]
pub(crate) struct ParameterView {
    name: Name,
    loss: f64,
    reference: f64,
}

impl ParameterView {
    /// Reads the display settings of the parameter from the structure file.
    pub(crate) fn new(name: Name, index: usize, structure: &Structure) -> Self {
        let (loss, reference) = structure.displayed_loss(index);
        Self {
            name,
            loss,
            reference,
        }
    }

    pub(crate) fn name(&self) -> &Name {
        &self.name
    }

    pub(crate) fn display(
        &self,
        structure: &Name,
        time_ns: i64,
        mean: f64,
        variance: f64,
    ) -> ParameterDisplay {
        let names = (structure, &self.name);
        ParameterDisplay::of_gaussian(
            names,
            time_ns,
            (mean, variance),
            (self.loss, self.reference),
        )
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimation_shows_the_display_rate_whatever_the_ratio() {
        for (rate, display, expected) in [
            (100.0, 10.0, 100),
            (120.0, 10.0, 100),
            (256.0, 7.0, 70),
            (5.0, 10.0, 50),
        ] {
            let decimation = Decimation::new(rate, display);
            let shown = (0..(10.0 * rate) as u64)
                .filter(|frame| decimation.shows(*frame))
                .count();
            assert_eq!(shown, expected, "{rate} Hz shown at {display} Hz");
            let thinned = decimation.one_in(10);
            let kept = (0..(10.0 * rate) as u64)
                .filter(|frame| thinned.shows(*frame))
                .count();
            assert_eq!(
                kept,
                expected / 10,
                "{rate} Hz shown at a tenth of {display} Hz"
            );
        }
    }
}
