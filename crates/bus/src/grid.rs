//! Times of evenly spaced samples, in whole nanoseconds and without drift.

/// Minimum sampling rate, in Hz: one sample in about a quarter of an hour.
pub const MIN_RATE_HZ: f64 = 1e-3;
/// Maximum sampling rate, in Hz.
pub const MAX_RATE_HZ: f64 = 1e6;

/// Evenly spaced times. The time of item k is `start_ns + round(k·10⁹/rate)`.
///
/// If the rate is a whole number of microhertz, as in practice, the computation uses integers.
/// Frame 10¹⁰ is then as exact as frame 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeGrid {
    start_ns: i64,
    rate: Rate,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Rate {
    WholeMicrohertz(i128),
    Hertz(f64),
}

/// 10⁹ ns/s times 10⁶ µHz/Hz.
const NANOSECONDS_MICROHERTZ: i128 = 1_000_000_000_000_000;

impl TimeGrid {
    /// Creates a grid from its first time (ns since the Unix epoch) and its rate (Hz).
    ///
    /// Returns `None` if the rate is not within [`MIN_RATE_HZ`] to [`MAX_RATE_HZ`].
    #[must_use]
    pub fn new(start_ns: i64, rate_hz: f64) -> Option<Self> {
        if !(MIN_RATE_HZ..=MAX_RATE_HZ).contains(&rate_hz) {
            return None;
        }
        let microhertz = (rate_hz * 1e6).round();
        let rate = if microhertz / 1e6 == rate_hz {
            Rate::WholeMicrohertz(microhertz as i128)
        } else {
            Rate::Hertz(rate_hz)
        };
        Some(Self { start_ns, rate })
    }

    /// Returns the time of item 0, ns since the Unix epoch.
    #[must_use]
    pub fn start_ns(&self) -> i64 {
        self.start_ns
    }

    /// Returns the time of item `number`, ns since the Unix epoch. The result saturates at the
    /// limits of i64.
    #[must_use]
    pub fn time_ns(&self, number: u64) -> i64 {
        let offset = match self.rate {
            Rate::WholeMicrohertz(rate) => {
                let numerator = i128::from(number) * NANOSECONDS_MICROHERTZ;
                i64::try_from((numerator + rate / 2) / rate).unwrap_or(i64::MAX)
            }
            Rate::Hertz(rate) => (number as f64 * 1e9 / rate).round() as i64,
        };
        self.start_ns.saturating_add(offset)
    }

    /// Returns the time between two consecutive items, in ns, rounded up.
    #[must_use]
    pub fn step_ns(&self) -> i64 {
        match self.rate {
            Rate::WholeMicrohertz(rate) => ((NANOSECONDS_MICROHERTZ + rate - 1) / rate) as i64,
            Rate::Hertz(rate) => (1e9 / rate).ceil() as i64,
        }
    }

    /// Returns the number of the item nearest to a time; negative before the start.
    ///
    /// A time within 2 ns of the midpoint of two items belongs to the earlier item. Block times are
    /// rounded to whole ns, so that the time of a sample can differ by 1 ns between blocks.
    #[must_use]
    pub fn nearest(&self, time_ns: i64) -> i64 {
        const TIE_NS: i128 = 2;
        let offset = i128::from(time_ns) - i128::from(self.start_ns) - TIE_NS;
        match self.rate {
            Rate::WholeMicrohertz(rate) => {
                // ceil(offset·rate − ½)
                let doubled = 2 * offset * rate - NANOSECONDS_MICROHERTZ;
                let divisor = 2 * NANOSECONDS_MICROHERTZ;
                (-(-doubled).div_euclid(divisor)) as i64
            }
            Rate::Hertz(rate) => (offset as f64 * rate / 1e9 - 0.5).ceil() as i64,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fractions_of_a_nanosecond_do_not_accumulate() {
        let grid = TimeGrid::new(1_000, 120.0).unwrap();
        assert_eq!(grid.time_ns(0), 1_000);
        assert_eq!(grid.time_ns(1), 1_000 + 8_333_333);
        assert_eq!(grid.time_ns(2), 1_000 + 16_666_667);
        assert_eq!(
            grid.time_ns(120_000_000_000),
            1_000 + 1_000_000_000_000_000_000
        );
    }

    #[test]
    fn every_item_is_nearest_to_its_own_time() {
        for rate in [0.02, 1.0, 119.88, 120.0, 200.0, 1.0e9 / 7.0e6, 1e6] {
            let grid = TimeGrid::new(-1_700_000_000_000_000_000, rate).unwrap();
            for number in [0, 1, 2, 3, 1000, 123_456_789] {
                assert_eq!(
                    grid.nearest(grid.time_ns(number)),
                    number as i64,
                    "{rate} {number}"
                );
            }
        }
    }

    #[test]
    fn midpoint_belongs_to_the_earlier_item() {
        let grid = TimeGrid::new(0, 100.0).unwrap();
        for nanosecond in -1..=1 {
            assert_eq!(grid.nearest(5_000_000 + nanosecond), 0);
            assert_eq!(grid.nearest(-5_000_000 + nanosecond), -1);
        }
        assert_eq!(grid.nearest(5_000_010), 1);
    }

    #[test]
    fn invalid_rates_are_rejected() {
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e7, 1e-9] {
            assert_eq!(TimeGrid::new(0, rate), None);
        }
    }

    #[test]
    fn extreme_times_do_not_panic() {
        for start in [i64::MIN, 0, i64::MAX] {
            for rate in [MIN_RATE_HZ, 3.0_f64.sqrt(), MAX_RATE_HZ] {
                let grid = TimeGrid::new(start, rate).unwrap();
                for time in [i64::MIN, 0, i64::MAX] {
                    let _ = grid.nearest(time);
                }
                let _ = grid.time_ns(u64::MAX);
            }
        }
    }
}
