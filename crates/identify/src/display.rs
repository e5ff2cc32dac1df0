//! What people look at: parameters and noise levels at display rate, decimated in measurement time.

use spandrel_bus::{CredibleInterval, Name, NoiseDisplay, ParameterDisplay};
use spandrel_structure::{AlertRule, Reference};

/// Level of the displayed interval, and its half-width in standard deviations of a Gaussian.
const INTERVAL: (f64, f64) = (0.95, 1.959_963_984_540_054);

/// What a display asks of a parameter that no alert rule watches.
const UNWATCHED_LOSS: f64 = 0.05;

/// Decides which frames are displayed: the first one in each interval of measurement time.
///
/// It knows frame numbers only, so that the same frames are displayed whatever the block sizes and the speed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decimation {
    frames_per_display: f64,
}

impl Decimation {
    pub(crate) fn new(sampling_rate_hz: f64, display_rate_hz: f64) -> Self {
        Self { frames_per_display: (sampling_rate_hz / display_rate_hz).max(1.0) }
    }

    pub(crate) fn shows(self, frame: u64) -> bool {
        let interval = |frame: u64| (frame as f64 / self.frames_per_display).floor();
        frame == 0 || interval(frame) > interval(frame - 1)
    }
}

/// How one parameter is displayed.
#[derive(Debug, Clone)]
pub(crate) struct ParameterView {
    name: Name,
    loss: f64,
    reference: f64,
}

impl ParameterView {
    /// Takes the loss and, where it is known beforehand, the reference of the first rule that watches the parameter.
    pub(crate) fn new(name: Name, index: usize, rules: &[AlertRule]) -> Self {
        let rule = rules.iter().find_map(|rule| {
            let position = rule.parameters.iter().position(|watched| *watched == index)?;
            Some((rule, position))
        });
        let loss = rule.map_or(UNWATCHED_LOSS, |(rule, _)| rule.loss);
        let reference = match rule.map(|(rule, position)| (&rule.reference, position)) {
            Some((Reference::Given { mean, .. }, position)) => mean.get(position).copied().unwrap_or(1.0),
            // a baseline is learnt by the alert service; until then a loss is counted from the design
            Some((Reference::Design | Reference::Baseline { .. }, _)) | None => 1.0,
        };
        Self { name, loss, reference }
    }

    pub(crate) fn name(&self) -> &Name {
        &self.name
    }

    pub(crate) fn display(&self, structure: &Name, time_ns: i64, mean: f64, variance: f64) -> ParameterDisplay {
        let std = variance.max(0.0).sqrt();
        let (level, half_width) = INTERVAL;
        let threshold = (1.0 - self.loss) * self.reference;
        ParameterDisplay {
            structure: structure.clone(),
            parameter: self.name.clone(),
            time_ns,
            mean,
            std,
            interval: CredibleInterval { level, low: mean - half_width * std, high: mean + half_width * std },
            probability_of_loss: probability_below(threshold, mean, std),
            loss: self.loss,
            reference: self.reference,
        }
    }
}

/// Makes the display message of one noise level.
pub(crate) fn noise_display(structure: &Name, name: &Name, time_ns: i64, mean: f64, variance: f64) -> NoiseDisplay {
    NoiseDisplay { structure: structure.clone(), name: name.clone(), time_ns, mean, std: variance.max(0.0).sqrt() }
}

/// Returns `Φ((threshold − mean)/std)` without loss of precision near 0.
fn probability_below(threshold: f64, mean: f64, std: f64) -> f64 {
    if std > 0.0 {
        0.5 * libm::erfc((mean - threshold) / (std * std::f64::consts::SQRT_2))
    } else if mean < threshold {
        1.0
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimation_shows_the_display_rate_whatever_the_ratio() {
        for (rate, display, expected) in [(100.0, 10.0, 100), (120.0, 10.0, 100), (256.0, 7.0, 70), (5.0, 10.0, 50)] {
            let decimation = Decimation::new(rate, display);
            let shown = (0..(10.0 * rate) as u64).filter(|frame| decimation.shows(*frame)).count();
            assert_eq!(shown, expected, "{rate} Hz shown at {display} Hz");
        }
    }

    #[test]
    fn probability_is_that_of_the_gaussian_tables() {
        assert!((probability_below(0.95, 0.95, 0.1) - 0.5).abs() < 1e-15);
        // Φ(−1.959964) = 0.025 and Φ(−6) = 9.865876e-10
        assert!((probability_below(0.0, 1.959_963_984_540_054, 1.0) - 0.025).abs() < 1e-12);
        assert!((probability_below(0.0, 6.0, 1.0) / 9.865_876_450e-10 - 1.0).abs() < 1e-8);
        assert_eq!(probability_below(0.95, 0.90, 0.0), 1.0);
    }
}
