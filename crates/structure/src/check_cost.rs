//! Estimate of the processor time of a check, before it is started.
//!
//! The time of each kind of work is a number of operations times the time of one. These times were
//! fitted to 18 measured checks of 100 to 1,000 storeys with 5 to 590 parameters and 3 to 400
//! channels on two cores of a server. The estimates were 0.87 to 1.13 times the measured times. A
//! model of at most 100 degrees of freedom can take twice its estimate, because the search for the
//! estimates under a wrong model then takes several steps.

use crate::structure::Structure;

/// Time of the natural modes, for each cubed degree of freedom (s).
const MODES_S: f64 = 2.7e-9;

/// Time of following a derivative over a frame, for each entry of its matrices (s).
const FOLLOWING_S: f64 = 0.114e-9;

/// Time of the products of the derivatives of a frame, for each pair and channel (s).
const PRODUCTS_S: f64 = 0.15e-9;

/// Time of the spectra of the responses, for each state and channel (s).
const RESPONSES_S: f64 = 300e-6;

/// Time of the whitened spectra, for each cubed channel (s).
const WHITENING_S: f64 = 630e-9;

/// Time of their derivatives by a parameter, for each squared channel (s).
const BY_PARAMETER_S: f64 = 2.7e-6;

/// Time of the products of their derivatives by two noise levels, for each squared channel (s).
const BY_LEVELS_S: f64 = 300e-9;

impl Structure {
    /// Returns an estimate of the processor time (s) of a check with `duration_s` (s) of simulated
    /// data.
    #[must_use]
    pub fn check_processor_s(&self, duration_s: f64) -> f64 {
        let frames = duration_s * self.sampling_rate_hz;
        let freedoms = self.system.len() as f64;
        let parameters = self.parameters.len() as f64;
        let levels = self.noise_levels.len() as f64;
        let is_adapted = |level: &&crate::NoiseLevel| level.adapted;
        let adapted = self.noise_levels.iter().filter(is_adapted).count() as f64;
        let channels = self.observation_channels.len() as f64;
        let states = 2.0 * self.most_shapes() as f64;
        let followed = 2.0 * parameters + levels; // a parameter also as the extended filter sees it
        MODES_S * freedoms.powi(3)
            + FOLLOWING_S * frames * followed * states * (states + channels)
            + PRODUCTS_S * frames * followed.powi(2) * channels
            + RESPONSES_S * states * channels
            + WHITENING_S * channels.powi(3)
            + BY_PARAMETER_S * parameters * channels.powi(2)
            + BY_LEVELS_S * adapted.powi(2) * channels.powi(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn time_grows_with_the_data_and_the_sampling_rate() {
        let text = include_str!("../../../docs/examples/demo.toml");
        let structure = Structure::parse(text, Path::new("demo.toml")).unwrap();
        let [short, long] =
            [60.0, 6000.0].map(|duration_s| structure.check_processor_s(duration_s));
        assert!(short < 1.0 && long > 2.0 * short, "{short} s, {long} s");
    }
}
