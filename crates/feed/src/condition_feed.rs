//! Values of one condition: their times, their order and their plausibility.

use crate::core_input::Moment;
use crate::packet::Packet;
use crate::source_plan::{ConditionPlan, Stamps};
use spandrel_bus::ConditionDisplay;

/// Highest sampling rate of a condition, Hz. Faster channels belong to a node.
const MAX_RATE_HZ: f64 = 10.0;

/// One condition of one source.
#[derive(Clone, Debug, Default)]
pub(crate) struct ConditionFeed {
    /// Time of the newest value that the history has, or that was published, ns.
    newest_ns: Option<i64>,
    /// Number of values that were not newer.
    repeated: u64,
    /// Number of published values.
    published: u64,
    /// Last published value, in the unit of the condition.
    last: Option<f64>,
}

/// A value to publish.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Reading {
    pub(crate) time_ns: i64,
    /// Value, in the unit of the condition.
    pub(crate) value: f64,
}

impl ConditionFeed {
    /// Skips values up to this time, because the history has them.
    pub(crate) fn set_stored(&mut self, newest_ns: i64) {
        self.newest_ns = self.newest_ns.max(Some(newest_ns));
    }

    /// Returns the number of values that were repeated.
    pub(crate) fn repeated(&self) -> u64 {
        self.repeated
    }

    /// Returns the number of published values, and the last one.
    pub(crate) fn published(&self) -> (u64, Option<f64>) {
        (self.published, self.last)
    }

    /// Converts the values of a packet, and appends those to publish to `readings`. Skips missing
    /// values, and values that are not newer than the last one.
    ///
    /// # Errors
    /// Returns the first fault of the packet. All other values are appended.
    pub(crate) fn take(
        &mut self,
        packet: &Packet,
        plan: &ConditionPlan,
        stamps: Stamps,
        at: Moment,
        readings: &mut Vec<Reading>,
    ) -> Result<(), String> {
        let label = &packet.label;
        let step_ns = match packet.rate_hz {
            Some(rate_hz) if rate_hz > MAX_RATE_HZ => {
                return Err(format!(
                    "{label}: sampling rate is {rate_hz} Hz, must be at most {MAX_RATE_HZ} Hz for \
                     a condition"
                ));
            }
            Some(rate_hz) => 1e9 / rate_hz,
            None if packet.values.len() > 1 => {
                return Err(format!(
                    "{label}: has {} values with one time, must have one value for a condition",
                    packet.values.len()
                ));
            }
            None => 0.0,
        };
        let start_ns = match stamps {
            Stamps::Source { .. } => packet.start_ns.ok_or_else(|| {
                format!("{label}: no time, must state the time of its first sample")
            })?,
            Stamps::Arrival { .. } => {
                let steps = packet.values.len().saturating_sub(1) as f64;
                at.wall_ns.saturating_sub((steps * step_ns) as i64)
            }
        };
        let mut fault = None;
        for (index, number) in (0_u32..).zip(&packet.values) {
            let time_ns = start_ns.saturating_add((f64::from(index) * step_ns).round() as i64);
            match self.reading(*number, time_ns, plan, at) {
                Ok(reading) => readings.extend(reading),
                Err(why) => fault = fault.or(Some(format!("{label}: {why}"))),
            }
        }
        fault.map_or(Ok(()), Err)
    }

    /// Converts one value. Returns `None` if it is missing or not newer than the last one.
    fn reading(
        &mut self,
        number: f64,
        time_ns: i64,
        plan: &ConditionPlan,
        at: Moment,
    ) -> Result<Option<Reading>, String> {
        if number.is_nan() {
            return Ok(None);
        }
        if self.newest_ns.is_some_and(|newest_ns| time_ns <= newest_ns) {
            self.repeated += 1;
            return Ok(None);
        }
        if time_ns > at.wall_ns.saturating_add(ConditionDisplay::MAX_AHEAD_NS) {
            let ahead_s = time_ns.saturating_sub(at.wall_ns) as f64 / 1e9;
            return Err(format!(
                "time is {ahead_s:.0} s ahead of the clock of the feed, must be at most {} s",
                ConditionDisplay::MAX_AHEAD_NS / 1_000_000_000
            ));
        }
        let value = plan.value_from_number(number, time_ns);
        let value = value.map_err(|why| format!("{} {why}", plan.name))?;
        self.newest_ns = Some(time_ns);
        self.published += 1;
        self.last = Some(value);
        Ok(Some(Reading { time_ns, value }))
    }
}

impl ConditionPlan {
    /// Converts a number of the source to the unit of the condition, or returns why it is not
    /// plausible.
    fn value_from_number(&self, number: f64, time_ns: i64) -> Result<f64, String> {
        let value = self.calibration.si_from_number(number, time_ns);
        let value = value.filter(|value| value.is_finite());
        let Some(value) = value else {
            return Err(format!("is {number}, must be a finite number"));
        };
        match self.range {
            Some((low, high)) if !(low..=high).contains(&value) => Err(format!(
                "is {value} {unit}, must lie between {low} and {high} {unit}",
                unit = self.unit
            )),
            _ => Ok(value),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Calibration;

    const SOURCE: Stamps = Stamps::Source { jitter_s: 0.0 };
    const NOW_NS: i64 = 1_795_000_000_000_000_000;

    fn plan() -> ConditionPlan {
        ConditionPlan {
            label: "t".to_owned(),
            structure: 0,
            name: "deck-temperature".to_owned(),
            unit: "degC",
            range: Some((-40.0, 60.0)),
            interval_s: None,
            calibration: Calibration::new(100.0, 0.0, 1.0),
        }
    }

    fn packet(start_ns: Option<i64>, rate_hz: Option<f64>, values: &[f64]) -> Packet {
        Packet {
            label: "t".to_owned(),
            start_ns,
            rate_hz,
            values: values.to_vec(),
            clock_quality: None,
        }
    }

    fn take(
        feed: &mut ConditionFeed,
        packet: &Packet,
        stamps: Stamps,
    ) -> Result<Vec<Reading>, String> {
        let at = Moment {
            wall_ns: NOW_NS,
            elapsed_ns: 0,
        };
        let mut readings = Vec::new();
        feed.take(packet, &plan(), stamps, at, &mut readings)?;
        Ok(readings)
    }

    #[test]
    fn values_of_a_slow_channel_follow_at_its_rate() {
        let mut feed = ConditionFeed::default();
        let packet = packet(Some(NOW_NS - 20), Some(0.1), &[2050.0, f64::NAN]);
        let readings = take(&mut feed, &packet, SOURCE).unwrap();
        let reading = Reading {
            time_ns: NOW_NS - 20,
            value: 20.5,
        };
        assert_eq!(readings, [reading]);
    }

    #[test]
    fn values_that_are_not_newer_are_skipped_and_counted() {
        let mut feed = ConditionFeed::default();
        feed.set_stored(NOW_NS - 10);
        for (ago_ns, is_new) in [(11, false), (10, false), (9, true), (9, false), (8, true)] {
            let packet = packet(Some(NOW_NS - ago_ns), None, &[2000.0]);
            let readings = take(&mut feed, &packet, SOURCE).unwrap();
            assert_eq!(readings.len(), usize::from(is_new), "{ago_ns} ns ago");
        }
        assert_eq!(feed.repeated(), 3);
    }

    #[test]
    fn value_outside_its_range_is_an_error_with_the_range() {
        let wrong = packet(Some(NOW_NS), None, &[99_900.0]);
        let told = take(&mut ConditionFeed::default(), &wrong, SOURCE).unwrap_err();
        let expected = "t: deck-temperature is 999 degC, must lie between -40 and 60 degC";
        assert_eq!(told, expected);
    }

    #[test]
    fn time_far_ahead_of_the_clock_is_an_error() {
        let wrong = packet(Some(NOW_NS + 61_000_000_000), None, &[2000.0]);
        let told = take(&mut ConditionFeed::default(), &wrong, SOURCE).unwrap_err();
        assert!(told.contains("time is 61 s ahead"), "{told}");
    }

    #[test]
    fn without_times_of_the_source_the_last_value_was_measured_at_its_arrival() {
        let values = packet(None, Some(1.0), &[2000.0, 2100.0]);
        let arrival = Stamps::Arrival { jitter_s: 0.0 };
        let readings = take(&mut ConditionFeed::default(), &values, arrival).unwrap();
        let times: Vec<i64> = readings.iter().map(|reading| reading.time_ns).collect();
        assert_eq!(times, [NOW_NS - 1_000_000_000, NOW_NS]);
    }

    #[test]
    fn fast_channel_and_values_without_times_are_errors() {
        let mut feed = ConditionFeed::default();
        let fast = packet(Some(NOW_NS), Some(200.0), &[1.0, 2.0]);
        let told = take(&mut feed, &fast, SOURCE).unwrap_err();
        assert!(
            told.contains("sampling rate is 200 Hz, must be at most 10 Hz"),
            "{told}"
        );
        let told = take(&mut feed, &packet(Some(NOW_NS), None, &[1.0, 2.0]), SOURCE).unwrap_err();
        assert!(told.contains("has 2 values with one time"), "{told}");
    }
}
