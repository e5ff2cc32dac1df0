//! Assigns times to the packets of one channel.

use crate::core_input::Moment;
use crate::packet::Packet;
use crate::source_plan::Stamps;

/// The clock of one channel.
#[derive(Clone, Debug)]
pub(crate) struct Timing {
    stamps: Stamps,
    step_ns: f64,
    /// Time of the next sample if samples are counted, ns.
    expected_ns: Option<i64>,
    /// Wall clock minus monotonic clock at the previous packet, ns.
    clock_ns: Option<i64>,
}

/// A packet with a time.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Timed {
    /// Time of the first sample that counts, ns.
    pub(crate) start_ns: i64,
    /// Number of samples at the beginning that have no place and are dropped.
    pub(crate) skip: usize,
    /// Number of samples without a place: the time was set again.
    pub(crate) resynchronised: u64,
}

impl Timing {
    pub(crate) fn new(stamps: Stamps, rate_hz: f64) -> Self {
        Self {
            stamps,
            step_ns: 1e9 / rate_hz,
            expected_ns: None,
            clock_ns: None,
        }
    }

    /// Returns `true` if the times are those of the source.
    pub(crate) fn is_of_source(&self) -> bool {
        matches!(self.stamps, Stamps::Source { .. })
    }

    /// Returns the deviation from the time of the previous packet that is not a gap, ns.
    pub(crate) fn tolerance_ns(&self) -> i64 {
        let half_step_ns = 0.5 * self.step_ns;
        match self.stamps {
            Stamps::Source { jitter_s } => half_step_ns.max(jitter_s * 1e9) as i64,
            // Counted times are exact.
            Stamps::Arrival { .. } => half_step_ns as i64,
        }
    }

    /// Returns the time of a packet. Returns `None` if the source states no time but must.
    pub(crate) fn time(&mut self, packet: &Packet, at: Moment) -> Option<Timed> {
        let Stamps::Arrival { jitter_s } = self.stamps else {
            return Some(Timed {
                start_ns: packet.start_ns?,
                skip: 0,
                resynchronised: 0,
            });
        };
        let count = packet.values.len();
        // The last sample of a packet arrives when it is measured.
        let before_last_ns = (count.saturating_sub(1) as f64 * self.step_ns) as i64;
        let arrived_ns = at.wall_ns.saturating_sub(before_last_ns);
        let clock_ns = at.wall_ns.saturating_sub(at.elapsed_ns);
        let before_ns = self.clock_ns.replace(clock_ns).unwrap_or(clock_ns);
        if before_ns.saturating_sub(clock_ns) as f64 > jitter_s * 1e9 {
            // The clock of this computer was set back. Samples would otherwise have no place until
            // it reaches the former time.
            self.expected_ns = None;
        }
        let expected_ns = self.expected_ns.unwrap_or(arrived_ns);
        let off_ns = arrived_ns.saturating_sub(expected_ns);
        let steps = || (off_ns.unsigned_abs() as f64 / self.step_ns).round() as u64;
        let is_regular = off_ns.unsigned_abs() as f64 <= jitter_s * 1e9;
        let timed = match (is_regular, off_ns > 0) {
            (true, _) => Timed {
                start_ns: expected_ns,
                skip: 0,
                resynchronised: 0,
            },
            (false, true) => Timed {
                start_ns: arrived_ns,
                skip: 0,
                resynchronised: steps(),
            },
            // Samples arrive faster than they can be measured. Those without a place are dropped.
            (false, false) => {
                let skip = usize::try_from(steps()).unwrap_or(count).min(count);
                Timed {
                    start_ns: expected_ns,
                    skip,
                    resynchronised: skip as u64,
                }
            }
        };
        let kept = (count - timed.skip) as f64;
        self.expected_ns = Some(timed.start_ns + (kept * self.step_ns).round() as i64);
        Some(timed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn arriving(timing: &mut Timing, count: usize, wall_ms: i64) -> Timed {
        let packet = Packet {
            label: "a".to_owned(),
            start_ns: None,
            rate_hz: None,
            values: vec![0.0; count],
            clock_quality: None,
        };
        let at = Moment {
            wall_ns: wall_ms * MS,
            elapsed_ns: wall_ms * MS,
        };
        timing.time(&packet, at).unwrap()
    }

    #[test]
    fn samples_after_the_clock_was_set_back_are_used() {
        let mut timing = Timing::new(Stamps::Arrival { jitter_s: 0.05 }, 100.0);
        arriving(&mut timing, 10, 3_600_090);
        let packet = Packet {
            label: "a".to_owned(),
            start_ns: None,
            rate_hz: None,
            values: vec![0.0; 10],
            clock_quality: None,
        };
        let at = Moment {
            wall_ns: 190 * MS,
            elapsed_ns: 3_600_190 * MS,
        };
        let timed = timing.time(&packet, at).unwrap();
        assert_eq!((timed.start_ns, timed.skip), (100 * MS, 0));
    }

    #[test]
    fn arrival_within_the_jitter_does_not_move_counted_samples() {
        let mut timing = Timing::new(Stamps::Arrival { jitter_s: 0.05 }, 100.0);
        assert_eq!(arriving(&mut timing, 10, 1090).start_ns, 1000 * MS);
        assert_eq!(arriving(&mut timing, 10, 1230).start_ns, 1100 * MS);
        assert_eq!(arriving(&mut timing, 10, 1245).start_ns, 1200 * MS);
    }

    #[test]
    fn arrival_beyond_the_jitter_sets_the_time_again_and_counts() {
        let mut timing = Timing::new(Stamps::Arrival { jitter_s: 0.05 }, 100.0);
        arriving(&mut timing, 10, 1090); // 1000 to 1090 ms
        let late = arriving(&mut timing, 10, 1390);
        assert_eq!((late.start_ns, late.resynchronised), (1300 * MS, 20));
        // Ten more samples at once would lie 80 ms in the future: eight of them have no place.
        let early = arriving(&mut timing, 10, 1410);
        assert_eq!(early.start_ns, 1400 * MS);
        assert_eq!((early.skip, early.resynchronised), (8, 8));
    }
}
