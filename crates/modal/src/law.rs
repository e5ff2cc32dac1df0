//! The smallest possible uncertainty of a mode in ambient vibration.
//!
//! Source: S.-K. Au (2014), *Uncertainty law in ambient modal identification – Part I: Theory*,
//! Mech. Syst. Signal Process. 48, 15–33. For separated modes, small damping and long data, the
//! coefficients of variation approach (ζ/(2π N_c B_f))^½ and (1/(2π ζ N_c B_ζ))^½. The factors B_f
//! and B_ζ are at most 1, which they reach with the whole band.

use std::f64::consts::PI;

/// Standard deviations of a frequency and a damping ratio.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Uncertainty {
    /// Of the frequency (Hz).
    pub frequency_hz: f64,
    /// Of the damping ratio.
    pub damping: f64,
}

/// Returns the smallest standard deviations that data of `length_s` allow, with B_f = B_ζ = 1.
///
/// Returns zeros for a damping ratio of 0 or less, for which the law has no meaning.
#[must_use]
pub fn smallest_uncertainty(frequency_hz: f64, damping: f64, length_s: f64) -> Uncertainty {
    if damping <= 0.0 {
        return Uncertainty {
            frequency_hz: 0.0,
            damping: 0.0,
        };
    }
    let periods = length_s * frequency_hz; // N_c
    Uncertainty {
        frequency_hz: frequency_hz * (damping / (2.0 * PI * periods)).sqrt(),
        damping: damping * (1.0 / (2.0 * PI * damping * periods)).sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 3.9 Hz, 1 %, 600 s: 0.0825 % of the frequency, from √(0.01/(2π·2340)).
    #[test]
    fn law_of_au_for_ten_minutes() {
        let found = smallest_uncertainty(3.9, 0.01, 600.0);
        assert!((found.frequency_hz / 3.9 - 8.25e-4).abs() < 1e-6);
        assert!((found.damping / 0.01 - 0.0825).abs() < 1e-4);
    }
}
