//! The latest frames, from which a filter learns again when it restarts without a faulty sensor.

use std::collections::VecDeque;

/// Number of windows of the sensor check that are kept. The motion settles in the first one. The
/// check names most faults within three.
const WINDOWS: f64 = 4.0;

/// Maximum number of frames, so that a large structure does not fall behind while it repeats them.
const MOST: usize = 10_000;

/// A frame as the filter received it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inputs<'a> {
    /// One value per observation row (SI units), NaN where missing.
    pub(super) observations: &'a [f64],
    /// One value per component of the excitation (SI units), NaN where missing.
    pub(super) excitation: &'a [f64],
    /// Reliability of each component.
    pub(super) shares: &'a [f64],
    /// Whether the motion contains information about the parameters.
    pub(super) teaches: bool,
}

/// The latest frames.
#[derive(Debug, Clone)]
pub(super) struct Recent {
    observations: usize,
    excitation: usize,
    /// Maximum number of frames.
    most: usize,
    /// The values of one frame after the other. The noise of every sensor exceeds the rounding.
    values: VecDeque<f32>,
}

impl Recent {
    /// Creates an empty memory for frames with this many observation rows and components of the
    /// excitation. It contains [`WINDOWS`] of the sensor check, each with `window` frames.
    pub(super) fn new(observations: usize, excitation: usize, window: f64) -> Self {
        Self {
            observations,
            excitation,
            most: ((WINDOWS * window) as usize).min(MOST),
            values: VecDeque::new(),
        }
    }

    /// Returns the number of values of a frame.
    fn width(&self) -> usize {
        self.observations + 2 * self.excitation + 1
    }

    /// Adds a frame. It replaces the oldest one if the memory is full.
    pub(super) fn add(&mut self, inputs: Inputs<'_>) {
        if self.most == 0 {
            return;
        }
        if self.values.len() >= self.most * self.width() {
            self.values.drain(..self.width());
        }
        let of_excitation = inputs.excitation.iter().chain(inputs.shares);
        let values = inputs.observations.iter().chain(of_excitation);
        self.values.extend(values.map(|value| *value as f32));
        self.values
            .push_back(if inputs.teaches { 1.0 } else { 0.0 });
    }

    /// Discards all frames.
    pub(super) fn forget(&mut self) {
        self.values.clear();
    }

    /// Returns the number of frames.
    pub(super) fn len(&self) -> usize {
        self.values.len() / self.width()
    }

    /// Returns `true` if no frames are kept, because the sensors are not compared.
    pub(super) fn is_off(&self) -> bool {
        self.most == 0
    }

    /// Calls `take` with each of the latest `count` frames, or all of them if they are fewer, the
    /// oldest first, until it fails.
    ///
    /// # Errors
    /// Returns the error of `take`.
    pub(super) fn repeat<E>(
        &self,
        count: usize,
        mut take: impl FnMut(Inputs<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut frame = Vec::with_capacity(self.width());
        let first = self.len().saturating_sub(count);
        let values = self.values.range(first * self.width()..);
        let mut values = values.map(|value| f64::from(*value));
        for _ in first..self.len() {
            frame.clear();
            frame.extend(values.by_ref().take(self.width()));
            let (observations, rest) = frame.split_at(self.observations);
            let (excitation, rest) = rest.split_at(self.excitation);
            let (shares, teaches) = rest.split_at(self.excitation);
            take(Inputs {
                observations,
                excitation,
                shares,
                teaches: teaches == [1.0],
            })?;
        }
        Ok(())
    }

    /// Returns the values for a checkpoint.
    pub(super) fn state(&self) -> Vec<f32> {
        self.values.iter().copied().collect()
    }

    /// Restores the values of a checkpoint. Returns `false`, and changes nothing, if they belong to
    /// other frames.
    pub(super) fn restore(&mut self, values: Vec<f32>) -> bool {
        let fits =
            values.len().is_multiple_of(self.width()) && values.len() <= self.most * self.width();
        if fits {
            self.values = values.into();
        }
        fits
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn add(recent: &mut Recent, number: u32) {
        let value = f64::from(number);
        recent.add(Inputs {
            observations: &[value, f64::NAN],
            excitation: &[-value],
            shares: &[0.5],
            teaches: number.is_multiple_of(2),
        });
    }

    fn numbers(recent: &Recent) -> Vec<f64> {
        let mut numbers = Vec::new();
        let repeated: Result<(), ()> = recent.repeat(usize::MAX, |frame| {
            let value = frame.observations[0];
            assert!(frame.observations[1].is_nan());
            assert_eq!(
                (frame.excitation, frame.shares),
                (&[-value][..], &[0.5][..])
            );
            assert_eq!(frame.teaches, value % 2.0 == 0.0);
            numbers.push(value);
            Ok(())
        });
        assert_eq!(repeated, Ok(()));
        numbers
    }

    #[test]
    fn four_windows_are_kept_and_restored() {
        let mut recent = Recent::new(2, 1, 2.0);
        for number in 0..11 {
            add(&mut recent, number);
        }
        let latest: Vec<f64> = (3..11).map(f64::from).collect();
        assert_eq!(numbers(&recent), latest);
        let mut restored = Recent::new(2, 1, 2.0);
        assert!(restored.restore(recent.state()));
        assert_eq!(numbers(&restored), latest);
        assert!(!Recent::new(3, 1, 2.0).restore(recent.state()));
        assert!(!Recent::new(2, 1, 1.0).restore(recent.state()));
        recent.forget();
        assert_eq!(numbers(&recent), [] as [f64; 0]);
    }

    #[test]
    fn structure_without_a_check_of_its_sensors_keeps_no_frames() {
        let mut recent = Recent::new(2, 1, 0.0);
        add(&mut recent, 1);
        assert_eq!(numbers(&recent), [] as [f64; 0]);
    }
}
