//! The adapted noise levels, compared with the structure file.

use super::Level;
use serde::Serialize;
use spandrel_structure::{NoiseSource, Structure};

/// Ratio of identified to stated standard deviation above which noise is an unlikely cause.
const SUSPECT: f64 = 5.0;

/// An adapted noise level as stated in the structure file.
#[derive(Debug, Clone, PartialEq)]
pub struct StatedLevel {
    pub name: String,
    /// Standard deviation (`unit`).
    std: f64,
    unit: &'static str,
    is_excitation: bool,
}

/// An adapted noise level at the end.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NoiseLevelSummary {
    /// Mean and standard deviation of the variance (`unit`²).
    #[serde(flatten)]
    pub variance: Level,
    /// Identified standard deviation of the noise (`unit`).
    pub found_std: f64,
    /// Standard deviation stated in the structure file (`unit`).
    pub stated_std: f64,
    /// Identified divided by stated standard deviation.
    pub ratio: f64,
    /// Unit of the noise source.
    pub unit: &'static str,
}

impl StatedLevel {
    /// Returns the adapted levels of a structure, in the order of the estimates.
    pub fn adapted_of(structure: &Structure) -> Vec<Self> {
        let adapted = structure
            .noise_levels()
            .iter()
            .filter(|level| level.is_adapted());
        let stated = adapted.map(|level| Self {
            name: level.name().to_owned(),
            std: level.std(),
            unit: structure.noise_unit(level),
            is_excitation: matches!(level.source(), NoiseSource::Excitation(_)),
        });
        stated.collect()
    }

    /// Compares the stated level with the estimate of its `variance` (`unit`²).
    pub fn found(&self, variance: Level) -> NoiseLevelSummary {
        let found_std = variance.mean.max(0.0).sqrt();
        NoiseLevelSummary {
            variance,
            found_std,
            stated_std: self.std,
            ratio: found_std / self.std,
            unit: self.unit,
        }
    }

    /// Returns a warning with possible causes if the identified level is far above the stated one.
    pub fn warning(&self, found: &NoiseLevelSummary) -> Option<String> {
        let causes = match self.is_excitation {
            true => {
                "an excitation stronger than stated, a channel with a wrong sign or unit, or a \
                 model that does not fit"
            }
            false => {
                "a swapped channel, a channel with a wrong sign or unit, or a model that does not \
                 fit"
            }
        };
        let Self { name, .. } = self;
        let told = || {
            format!(
                "noise of {name} is {:.0} times what the file states: {causes}",
                found.ratio
            )
        };
        (found.ratio > SUSPECT).then(told)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn floors(found_std: f64) -> Option<String> {
        let stated = StatedLevel {
            name: "floors".to_owned(),
            std: 0.005,
            unit: "m/s2",
            is_excitation: false,
        };
        stated.warning(&stated.found(Level {
            mean: found_std * found_std,
            std: 0.0,
        }))
    }

    #[test]
    fn noise_far_above_the_stated_level_gives_a_warning() {
        assert_eq!(floors(0.02), None);
        let told = "noise of floors is 28 times what the file states: a swapped channel, a channel \
                    with a wrong sign or unit, or a model that does not fit";
        assert_eq!(floors(0.14).as_deref(), Some(told));
    }
}
