//! The frames that are displayed, decimated in measurement time.

/// Selects the displayed frames: the first one in each interval of measurement time.
///
/// The selection depends on frame numbers only. Block sizes and speed therefore do not affect it.
#[derive(Debug, Clone, Copy)]
pub struct Decimation {
    frames_per_display: f64,
}

impl Decimation {
    /// Creates the selection for frames and displays at these rates.
    #[must_use]
    pub fn new(sampling_rate_hz: f64, display_rate_hz: f64) -> Self {
        Self {
            frames_per_display: (sampling_rate_hz / display_rate_hz).max(1.0),
        }
    }

    /// Returns a decimation that shows one in `times` of these frames.
    #[must_use]
    pub fn one_in(self, times: u32) -> Self {
        Self {
            frames_per_display: self.frames_per_display * f64::from(times),
        }
    }

    /// Returns `true` if the frame of this number is displayed.
    #[must_use]
    pub fn shows(self, frame: u64) -> bool {
        let interval = |frame: u64| (frame as f64 / self.frames_per_display).floor();
        frame == 0 || interval(frame) > interval(frame - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimation_gives_the_display_rate_for_any_ratio() {
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
