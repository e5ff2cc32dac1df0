//! Reduces innovations from the sampling rate to the display rate. It keeps the minimum and maximum
//! of each interval, so that no spike is lost.

use spandrel_bus::{Estimate, EstimateBlock, Phase};

/// Innovations of one interval of the display rate.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Interval {
    /// Time of the last frame (ns since the Unix epoch, UTC).
    pub(crate) time_ns: i64,
    /// Minimum and maximum innovation of each observed channel (unit of the channel). NaN if no
    /// sample was used.
    pub(crate) ends: Vec<(f64, f64)>,
    /// Mean of the normalised innovation squared per used channel. NaN if no channel was used.
    pub(crate) consistency: f64,
    /// Working if all estimates of the interval are in the working phase, otherwise another phase
    /// that occurred.
    pub(crate) phase: Phase,
}

/// Collects estimates into intervals.
#[derive(Clone, Debug)]
pub(crate) struct Innovations {
    interval_ns: i64,
    open: Option<Open>,
}

#[derive(Clone, Debug)]
struct Open {
    number: i64,
    interval: Interval,
    squares: f64,
    used: f64,
}

impl Innovations {
    /// Creates a collector with intervals of `1/display_rate_hz` s.
    pub(crate) fn new(display_rate_hz: f64) -> Self {
        Self {
            interval_ns: (1e9 / display_rate_hz).round().max(1.0) as i64,
            open: None,
        }
    }

    /// Processes a block and appends every completed interval to `done`.
    pub(crate) fn handle(&mut self, block: &EstimateBlock, done: &mut Vec<Interval>) {
        let Some(grid) = block.grid() else { return };
        for (number, estimate) in block.iter() {
            self.take(grid.time_ns(number), estimate, done);
        }
    }

    fn take(&mut self, time_ns: i64, estimate: &Estimate, done: &mut Vec<Interval>) {
        let number = time_ns.div_euclid(self.interval_ns);
        if self
            .open
            .as_ref()
            .is_some_and(|open| open.number != number || !open.fits(estimate))
        {
            done.extend(self.open.take().map(Open::close));
        }
        let open = self
            .open
            .get_or_insert_with(|| Open::new(number, time_ns, estimate.innovations.len()));
        open.interval.time_ns = time_ns;
        if estimate.flags.phase != Phase::Working {
            open.interval.phase = estimate.flags.phase;
        }
        for (ends, innovation) in open.interval.ends.iter_mut().zip(&estimate.innovations) {
            // `min` and `max` return the number if the other value is NaN.
            *ends = (ends.0.min(*innovation), ends.1.max(*innovation));
        }
        open.squares += estimate.normalised_innovation_squared;
        open.used += f64::from(estimate.used_channels);
    }
}

impl Open {
    fn new(number: i64, time_ns: i64, channels: usize) -> Self {
        let ends = vec![(f64::NAN, f64::NAN); channels];
        let interval = Interval {
            time_ns,
            ends,
            consistency: f64::NAN,
            phase: Phase::Working,
        };
        Self {
            number,
            interval,
            squares: 0.0,
            used: 0.0,
        }
    }

    fn fits(&self, estimate: &Estimate) -> bool {
        self.interval.ends.len() == estimate.innovations.len()
    }

    fn close(self) -> Interval {
        let consistency = if self.used > 0.0 {
            self.squares / self.used
        } else {
            f64::NAN
        };
        Interval {
            consistency,
            ..self.interval
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::{EstimateFlags, Header, StreamState};

    fn block(first: u64, innovations: &[[f64; 2]]) -> EstimateBlock {
        let estimate = |values: &[f64; 2]| Estimate {
            mean: vec![],
            covariance: vec![],
            noise_mean: vec![],
            noise_covariance: vec![],
            innovations: values.to_vec(),
            normalised_innovation_squared: 4.0,
            log_evidence: 0.0,
            used_channels: 2,
            flags: EstimateFlags::working(),
            excluded: spandrel_bus::Excluded::None,
            sustained_information: Vec::new(),
        };
        EstimateBlock {
            header: Header {
                source: "identify".into(),
                epoch: 1,
                sequence: first,
                time_ns: 0,
            },
            term: 0,
            t0_ns: 1_000_000_000,
            sampling_rate_hz: 100.0,
            parameters: 0,
            noise_parameters: 0,
            channels: 2,
            estimates: innovations.iter().map(estimate).collect(),
            state: StreamState::Running,
        }
    }

    #[test]
    fn each_interval_has_its_extremes_for_any_block_size() {
        let values: Vec<[f64; 2]> = (0..25).map(|frame| [f64::from(frame), f64::NAN]).collect();
        let mut whole = Vec::new();
        Innovations::new(10.0).handle(&block(0, &values), &mut whole);
        let mut cut = Vec::new();
        let mut innovations = Innovations::new(10.0);
        for (start, part) in [(0, &values[..7]), (7, &values[7..19]), (19, &values[19..])] {
            innovations.handle(&block(start, part), &mut cut);
        }
        let ends = |intervals: &[Interval]| {
            intervals
                .iter()
                .map(|interval| interval.ends[0])
                .collect::<Vec<_>>()
        };
        assert_eq!(ends(&whole), [(0.0, 9.0), (10.0, 19.0)]);
        assert_eq!(ends(&cut), ends(&whole));
        assert!(whole[0].ends[1].0.is_nan());
        assert_eq!(whole[0].consistency, 2.0);
    }
}
