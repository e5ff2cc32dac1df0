//! Compares the sampling rate of arriving samples with the nominal rate.

use std::collections::VecDeque;

/// Allowed deviation from the nominal rate, as a fraction. Clocks of instruments deviate by less
/// than 0.01 %, and the nearest common rates differ by 20 %.
const TOLERANCE: f64 = 0.02;
/// Number of intervals between packets that are kept.
const MAX_INTERVALS: usize = 256;
/// Minimum number of intervals for a statement.
const MIN_INTERVALS: usize = 8;
/// Minimum number of samples for a statement. Single samples with times in whole milliseconds
/// deviate by 10 % each at 100 Hz, and by 0.2 % over 64 samples.
const MIN_SAMPLES: u64 = 64;
/// Minimum duration for a statement if the times are arrival times, s. A network delays packets by
/// tenths of a second.
const MIN_ARRIVAL_S: f64 = 10.0;
/// Intervals that contain no gap, if the times are those of the source: up to this multiple of a
/// short interval. One lost packet doubles an interval.
const SOURCE: Regular = Regular {
    quantile: 0.2,
    factor: 1.5,
};
/// The same for arrival times. A network delays packets, so that intervals vary.
const ARRIVAL: Regular = Regular {
    quantile: 0.5,
    factor: 3.0,
};

/// Intervals without a gap: at most `factor` times the interval at this quantile.
#[derive(Clone, Copy, Debug)]
struct Regular {
    quantile: f64,
    factor: f64,
}

/// The rate of one channel.
#[derive(Clone, Debug)]
pub(crate) struct RateCheck {
    nominal_hz: f64,
    min_span_s: f64,
    /// Start and number of samples of the previous packet.
    previous: Option<(i64, u64)>,
    /// Time (s) and number of samples from one packet to the next.
    intervals: VecDeque<(f64, u64)>,
    measured_hz: Option<f64>,
}

impl RateCheck {
    /// Creates a check of packets with times of the source.
    pub(crate) fn of_source(nominal_hz: f64) -> Self {
        Self {
            nominal_hz,
            min_span_s: 0.0,
            previous: None,
            intervals: VecDeque::new(),
            measured_hz: None,
        }
    }

    /// Creates a check of packets with arrival times.
    pub(crate) fn of_arrival(nominal_hz: f64) -> Self {
        Self {
            min_span_s: MIN_ARRIVAL_S,
            ..Self::of_source(nominal_hz)
        }
    }

    /// Adds a packet of `samples` samples that starts at `start_ns`.
    pub(crate) fn add(&mut self, start_ns: i64, samples: u64) {
        let is_arrival = self.min_span_s > 0.0;
        if let Some((before_ns, count)) = &mut self.previous
            && is_arrival
            && *before_ns == start_ns
        {
            // Several packets arrived together.
            *count += samples;
            return;
        }
        if let Some((before_ns, count)) = self.previous.replace((start_ns, samples)) {
            let interval_s = start_ns.saturating_sub(before_ns) as f64 / 1e9;
            if interval_s > 0.0 && count > 0 {
                if self.intervals.len() == MAX_INTERVALS {
                    self.intervals.pop_front();
                }
                self.intervals.push_back((interval_s, count));
                self.measured_hz = self.measure();
            }
        }
    }

    fn measure(&self) -> Option<f64> {
        if self.intervals.len() < MIN_INTERVALS {
            return None;
        }
        let per_sample = |(interval_s, count): &(f64, u64)| interval_s / *count as f64;
        let mut sorted: Vec<f64> = self.intervals.iter().map(per_sample).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let Regular { quantile, factor } = match self.min_span_s > 0.0 {
            true => ARRIVAL,
            false => SOURCE,
        };
        let typical = sorted.get((sorted.len() as f64 * quantile) as usize)?;
        let regular = self
            .intervals
            .iter()
            .filter(|interval| per_sample(interval) <= factor * typical);
        let (mut span_s, mut samples) = (0.0, 0);
        for (interval_s, count) in regular {
            span_s += interval_s;
            samples += count;
        }
        (samples >= MIN_SAMPLES && span_s >= self.min_span_s).then(|| samples as f64 / span_s)
    }

    /// Returns the nominal rate in Hz.
    pub(crate) fn nominal_hz(&self) -> f64 {
        self.nominal_hz
    }

    /// Returns the measured rate in Hz, or `None` before there are enough samples.
    pub(crate) fn measured_hz(&self) -> Option<f64> {
        self.measured_hz
    }

    /// Returns the rate of the source in Hz if it is wrong. `stated_hz` is the rate that the packet
    /// states.
    pub(crate) fn wrong_hz(&self, stated_hz: Option<f64>) -> Option<f64> {
        let found_hz = stated_hz.or(self.measured_hz)?;
        let is_wrong = (found_hz / self.nominal_hz - 1.0).abs() > TOLERANCE;
        is_wrong.then_some(found_hz)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// Adds packets of 25 samples at `rate_hz`, except packets with these numbers.
    fn packets(check: &mut RateCheck, rate_hz: f64, count: i64, without: &[i64]) {
        for number in (0..count).filter(|number| !without.contains(number)) {
            check.add((number as f64 * 25e9 / rate_hz) as i64, 25);
        }
    }

    #[test]
    fn half_the_rate_is_wrong_and_lost_packets_are_not() {
        let mut check = RateCheck::of_source(100.0);
        packets(&mut check, 50.0, 30, &[]);
        assert!((check.wrong_hz(None).unwrap() - 50.0).abs() < 0.01);
        let mut check = RateCheck::of_source(100.0);
        packets(&mut check, 100.0, 60, &[7, 8, 9, 10, 20, 33, 34, 35]);
        assert_eq!(check.wrong_hz(None), None);
        assert!(check.measured_hz().is_some());
    }

    #[test]
    fn single_samples_in_whole_milliseconds_have_the_right_rate() {
        let mut check = RateCheck::of_source(120.0);
        for number in 0..200 {
            check.add((f64::from(number) * 1000.0 / 120.0).round() as i64 * MS, 1);
        }
        assert_eq!(check.wrong_hz(None), None);
        assert!((check.measured_hz().unwrap() - 120.0).abs() < 1.0);
    }

    #[test]
    fn stated_rate_counts_at_once() {
        let check = RateCheck::of_source(100.0);
        assert_eq!(check.wrong_hz(Some(200.0)), Some(200.0));
        assert_eq!(check.wrong_hz(Some(100.01)), None);
    }
}
