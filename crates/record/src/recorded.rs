//! A recording as stored in a file: channels with name, unit, sampling rate, start and samples.

use crate::{Quantity, rate::rate_from_times};

/// The reference of the times of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeOrigin {
    /// 1970, UTC. Dates without a time zone count as UTC.
    Epoch,
    /// The start of the recording, because the file has no date.
    Start,
}

/// How reliably a file dates the first sample of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StartTime {
    /// As reliably as its format requires.
    Stated,
    /// By a clock that the file itself calls one of low quality.
    LowQuality,
    /// Not at all, although files of its format usually do.
    Missing,
}

/// Evenly spaced samples, one per time step, without a gap in time.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    start_ns: i64,
    samples: Vec<f64>,
}

impl Segment {
    /// Creates a segment whose first sample was taken at `start_ns` (ns since the [`TimeOrigin`] of
    /// its channel). The samples are in the unit of the channel, `NaN` if missing.
    pub fn new(start_ns: i64, samples: Vec<f64>) -> Self {
        Self { start_ns, samples }
    }

    /// Returns the time of the first sample, in ns since the [`TimeOrigin`] of the channel.
    pub fn start_ns(&self) -> i64 {
        self.start_ns
    }

    /// Returns the samples in the unit of the channel, `NaN` if missing.
    pub fn samples(&self) -> &[f64] {
        &self.samples
    }
}

/// A run of missing samples between two existing ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    /// Time of the last sample before the gap, in ns since the [`TimeOrigin`] of the channel.
    pub after_ns: i64,
    /// Number of missing samples.
    pub samples: u64,
}

/// One channel of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedChannel {
    name: String,
    unit: Option<String>,
    description: Option<String>,
    sampling_rate_hz: Option<f64>,
    origin: TimeOrigin,
    start_time: StartTime,
    event_ns: Option<i64>,
    clock_quality: Option<u8>,
    segments: Vec<Segment>,
}

impl RecordedChannel {
    /// Creates a channel with a sampling rate in Hz. Segments must be in time order and must not
    /// overlap.
    ///
    /// Without a sampling rate, the file contains no times, and there must be one segment.
    pub fn new(
        name: impl Into<String>,
        sampling_rate_hz: Option<f64>,
        segments: Vec<Segment>,
    ) -> Self {
        Self {
            name: name.into(),
            unit: None,
            description: None,
            sampling_rate_hz,
            origin: TimeOrigin::Start,
            start_time: StartTime::Stated,
            event_ns: None,
            clock_quality: None,
            segments: segments
                .into_iter()
                .filter(|segment| !segment.samples.is_empty())
                .collect(),
        }
    }

    /// Creates a channel from single samples with increasing times.
    ///
    /// The times determine the rate if it is not stated. A sample that is off the grid of the rate
    /// by more than half a step begins a new segment.
    pub fn from_times(
        name: impl Into<String>,
        stated_rate_hz: Option<f64>,
        times_ns: &[i64],
        values: &[f64],
    ) -> Self {
        let Some(rate_hz) = stated_rate_hz.or_else(|| rate_from_times(times_ns)) else {
            let segment = times_ns
                .first()
                .map(|time_ns| Segment::new(*time_ns, values.to_vec()));
            return Self::new(name, None, segment.into_iter().collect());
        };
        let mut segments: Vec<Segment> = Vec::new();
        for (time_ns, value) in times_ns.iter().zip(values) {
            let expected_ns = segments
                .last()
                .map(|segment| time_of(segment, segment.samples.len(), rate_hz));
            let off_steps = expected_ns
                .map(|expected_ns| time_ns.saturating_sub(expected_ns) as f64 * rate_hz / 1e9);
            match (segments.last_mut(), off_steps) {
                (Some(segment), Some(off_steps)) if off_steps.abs() <= 0.5 => {
                    segment.samples.push(*value)
                }
                _ => segments.push(Segment::new(*time_ns, vec![*value])),
            }
        }
        Self::new(name, Some(rate_hz), segments)
    }

    /// Sets the unit as stated in the file.
    pub fn with_unit(self, unit: impl Into<String>) -> Self {
        Self {
            unit: Some(unit.into()).filter(|unit| !unit.is_empty()),
            ..self
        }
    }

    /// Sets the description of location and direction from the file.
    pub fn with_description(self, description: impl Into<String>) -> Self {
        Self {
            description: Some(description.into()).filter(|text| !text.is_empty()),
            ..self
        }
    }

    /// Sets the reference of the times.
    pub fn with_origin(self, origin: TimeOrigin) -> Self {
        Self { origin, ..self }
    }

    /// Sets how reliably the file dates the first sample.
    pub(crate) fn with_start_time(self, start_time: StartTime) -> Self {
        Self { start_time, ..self }
    }

    /// Returns how reliably the file dates the first sample.
    pub(crate) fn start_time(&self) -> StartTime {
        self.start_time
    }

    /// Moves the first sample to `start_ns` (ns since `origin`), and all others with it.
    pub(crate) fn starting_at(self, start_ns: i64, origin: TimeOrigin) -> Self {
        let later_ns = start_ns.saturating_sub(self.start_ns().unwrap_or(start_ns));
        let moved = |segment: Segment| Segment {
            start_ns: segment.start_ns.saturating_add(later_ns),
            ..segment
        };
        Self {
            origin,
            segments: self.segments.into_iter().map(moved).collect(),
            ..self
        }
    }

    /// Sets the lowest quality of the times, per cent.
    pub(crate) fn with_clock_quality(self, clock_quality: Option<u8>) -> Self {
        Self {
            clock_quality,
            ..self
        }
    }

    /// Returns the lowest quality of the times that the recorder states, per cent. `None` if it
    /// states none.
    #[must_use]
    pub fn clock_quality(&self) -> Option<u8> {
        self.clock_quality
    }

    /// Sets the time of the recorded earthquake.
    pub(crate) fn with_event_ns(self, event_ns: Option<i64>) -> Self {
        Self { event_ns, ..self }
    }

    /// Returns the same channel with other samples, at another rate in Hz.
    pub(crate) fn with_samples(&self, rate_hz: f64, segments: Vec<Segment>) -> Self {
        Self {
            sampling_rate_hz: Some(rate_hz),
            segments,
            ..self.clone()
        }
    }

    pub(crate) fn with_name(self, name: String) -> Self {
        Self { name, ..self }
    }

    /// Sets the rate in Hz if the file does not state one.
    pub(crate) fn with_declared_rate(self, rate_hz: f64) -> Self {
        Self {
            sampling_rate_hz: self.sampling_rate_hz.or(Some(rate_hz)),
            ..self
        }
    }

    /// Returns the name of the channel, which is unique in the recording.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the unit as spelled in the file, or `None` if the file does not state it.
    pub fn unit(&self) -> Option<&str> {
        self.unit.as_deref()
    }

    /// Returns the quantity of the unit, and the factor to SI. Returns `None` if the unit is
    /// missing or unknown.
    pub fn quantity(&self) -> Option<(Quantity, f64)> {
        self.unit.as_deref().and_then(Quantity::of_unit)
    }

    /// Returns the description of location and direction from the file, or `None` if the file has
    /// none.
    pub fn description(&self) -> Option<&str> {
        self.description.as_deref()
    }

    /// Returns the sampling rate in Hz, or `None` if the file does not state it.
    pub fn sampling_rate_hz(&self) -> Option<f64> {
        self.sampling_rate_hz
    }

    /// Returns the reference of the times.
    pub fn origin(&self) -> TimeOrigin {
        self.origin
    }

    /// Returns the time of the recorded earthquake at its source (ns since 1970, UTC), or `None` if
    /// the file does not state it. The recording begins at an unknown time within about a minute
    /// of it.
    pub fn event_ns(&self) -> Option<i64> {
        self.event_ns
    }

    /// Returns the segments in time order.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// Returns the number of samples that are not missing.
    pub fn present(&self) -> u64 {
        self.samples().filter(|sample| !sample.is_nan()).count() as u64
    }

    /// Returns all samples one after the other, `NaN` where one is missing within a segment.
    pub fn samples(&self) -> impl Iterator<Item = f64> + '_ {
        self.segments
            .iter()
            .flat_map(|segment| segment.samples.iter().copied())
    }

    /// Returns the time of the first sample, in ns since [`Self::origin`]. Returns `None` without
    /// samples.
    pub fn start_ns(&self) -> Option<i64> {
        self.segments.first().map(|segment| segment.start_ns)
    }

    /// Returns the time of the last sample, in ns since [`Self::origin`]. Returns `None` without
    /// samples or without a rate.
    pub fn end_ns(&self) -> Option<i64> {
        let (segment, rate_hz) = (self.segments.last()?, self.sampling_rate_hz?);
        Some(time_of(segment, segment.samples.len() - 1, rate_hz))
    }

    /// Returns times (ns since [`Self::origin`]) and values in order, including missing samples.
    /// Without a rate, the iterator is empty.
    pub fn timed_samples(&self) -> impl Iterator<Item = (i64, f64)> + '_ {
        self.sampling_rate_hz.into_iter().flat_map(move |rate_hz| {
            self.segments.iter().flat_map(move |segment| {
                let timed = segment.samples.iter().enumerate();
                timed.map(move |(index, value)| (time_of(segment, index, rate_hz), *value))
            })
        })
    }

    /// Returns all runs of missing samples between two existing ones. Without a rate, the result is
    /// empty.
    pub fn gaps(&self) -> Vec<Gap> {
        let Some(rate_hz) = self.sampling_rate_hz else {
            return Vec::new();
        };
        let mut gaps = Vec::new();
        let mut previous_ns: Option<i64> = None;
        for (time_ns, _) in self.timed_samples().filter(|(_, value)| !value.is_nan()) {
            if let Some(after_ns) = previous_ns {
                let steps =
                    (time_ns.saturating_sub(after_ns) as f64 * rate_hz / 1e9).round() as u64;
                if steps > 1 {
                    gaps.push(Gap {
                        after_ns,
                        samples: steps - 1,
                    });
                }
            }
            previous_ns = Some(time_ns);
        }
        gaps
    }
}

/// Returns the time in ns of sample `index` of a segment: start + round(index · 10⁹ / rate).
fn time_of(segment: &Segment, index: usize, rate_hz: f64) -> i64 {
    segment
        .start_ns
        .saturating_add((index as f64 * 1e9 / rate_hz).round() as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_in_time_and_missing_samples_are_gaps() {
        let first = Segment::new(0, vec![1.0, f64::NAN, f64::NAN, 2.0]);
        // From 30 ms to 80 ms, four samples are missing.
        let second = Segment::new(80_000_000, vec![3.0, 4.0]);
        let channel = RecordedChannel::new("a", Some(100.0), vec![first, second]);
        let expected = [
            Gap {
                after_ns: 0,
                samples: 2,
            },
            Gap {
                after_ns: 30_000_000,
                samples: 4,
            },
        ];
        assert_eq!(channel.gaps(), expected);
        assert_eq!((channel.present(), channel.end_ns()), (4, Some(90_000_000)));
    }

    #[test]
    fn times_rounded_to_milliseconds_are_one_segment() {
        let times_ns: Vec<i64> = (0..5000_i64)
            .map(|row| (row as f64 * 1000.0 / 120.0).round() as i64 * 1_000_000)
            .collect();
        let channel = RecordedChannel::from_times("a", None, &times_ns, &vec![0.0; times_ns.len()]);
        assert_eq!(channel.segments().len(), 1);
        assert!((channel.sampling_rate_hz().unwrap() - 120.0).abs() < 0.01);
    }

    #[test]
    fn hole_begins_a_segment() {
        let times_ns = [0, 10, 20, 50, 60].map(|milliseconds: i64| milliseconds * 1_000_000);
        let channel = RecordedChannel::from_times("a", None, &times_ns, &[1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(channel.segments().len(), 2);
        assert_eq!(
            channel.gaps(),
            [Gap {
                after_ns: 20_000_000,
                samples: 2
            }]
        );
    }
}
