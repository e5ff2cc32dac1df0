//! The systems with drifting parameters of Ching et al. (2006), and helpers of their simulation.

pub(crate) mod building;
pub(crate) mod integrate;
pub(crate) mod numerical_ekf;
pub(crate) mod oscillator;

use crate::statistics;

pub(crate) use crate::statistics::rms;
pub(crate) use integrate::integrate;

/// Generator of independent standard normal numbers.
pub(crate) struct Normal(statistics::Normal);

impl Normal {
    pub(crate) fn seeded(seed: u64) -> Self {
        Self(statistics::Normal::stream(seed, 0))
    }

    pub(crate) fn draw(&mut self) -> f64 {
        self.0.draw()
    }
}
