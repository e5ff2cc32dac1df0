//! Which column of a file is which channel, and how its numbers become SI.

use crate::{Quantity, RecordError, RecordedChannel};

/// Name of the time column where a mapping names no other.
const DEFAULT_TIME_COLUMN: &str = "time";

/// The unit of times that are numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeUnit {
    /// s.
    Seconds,
    /// ms.
    Milliseconds,
    /// µs.
    Microseconds,
    /// ns.
    Nanoseconds,
}

/// Where the times of a file come from.
#[derive(Debug, Clone, PartialEq)]
pub enum TimeSource {
    /// From a column of this name; formats that state their times themselves have none, and the name is not used.
    Column {
        /// Its name.
        name: String,
        /// The unit of its numbers.
        unit: TimeUnit,
    },
    /// The file has no times: its rows are counted at this rate.
    Counted {
        /// Sampling rate in Hz.
        rate_hz: f64,
    },
}

/// Says where each channel and the time stand in a file; the order of the channels is that of the rows read.
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnMapping {
    time: TimeSource,
    channels: Vec<ChannelColumn>,
}

impl ColumnMapping {
    /// Maps the given channels, with the time in column `time`.
    pub fn new(channels: Vec<ChannelColumn>) -> Self {
        Self {
            time: TimeSource::Column {
                name: DEFAULT_TIME_COLUMN.to_owned(),
                unit: TimeUnit::Seconds,
            },
            channels,
        }
    }

    /// Takes each channel from the column of its own name, in SI units.
    pub fn by_name<S: Into<String>>(channels: impl IntoIterator<Item = S>) -> Self {
        Self::new(channels.into_iter().map(ChannelColumn::new).collect())
    }

    /// Takes the time from the column of this name.
    pub fn with_time_column(self, name: impl Into<String>) -> Self {
        Self {
            time: TimeSource::Column {
                name: name.into(),
                unit: TimeUnit::Seconds,
            },
            ..self
        }
    }

    /// Takes the time from wherever `time` says.
    pub fn with_time(self, time: TimeSource) -> Self {
        Self { time, ..self }
    }

    /// Where the time comes from.
    pub fn time(&self) -> &TimeSource {
        &self.time
    }

    /// Name of the column of the time, which a file that is written has in any case.
    pub fn time_column(&self) -> &str {
        match &self.time {
            TimeSource::Column { name, .. } => name,
            TimeSource::Counted { .. } => DEFAULT_TIME_COLUMN,
        }
    }

    /// The channels in the order of the values of a row.
    pub fn channels(&self) -> &[ChannelColumn] {
        &self.channels
    }
}

/// One channel: its column, and the way from the number in the file to SI.
///
/// value in SI = SI unit from unit of the column × (scale × number in the file + offset)
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelColumn {
    channel: String,
    column: String,
    si_from_unit: f64,
    scale: f64,
    offset: f64,
    file_unit: Option<Quantity>,
}

impl ChannelColumn {
    /// Takes `channel` from the column of the same name, in SI units.
    pub fn new(channel: impl Into<String>) -> Self {
        let channel = channel.into();
        Self {
            column: channel.clone(),
            channel,
            si_from_unit: 1.0,
            scale: 1.0,
            offset: 0.0,
            file_unit: None,
        }
    }

    /// Takes the channel from the column of this name.
    pub fn with_column(self, name: impl Into<String>) -> Self {
        Self {
            column: name.into(),
            ..self
        }
    }

    /// Declares that the channel is a `quantity` in `unit`.
    ///
    /// # Errors
    /// [`RecordError::Unit`] if it is no unit of this quantity.
    pub fn with_unit(self, unit: &str, quantity: Quantity) -> Result<Self, RecordError> {
        match quantity.si_from(unit) {
            Some(si_from_unit) => Ok(Self {
                si_from_unit,
                ..self
            }),
            None => Err(RecordError::Unit {
                channel: self.channel,
                found: unit.to_owned(),
                quantity: quantity.name(),
                allowed: quantity.allowed_units(),
            }),
        }
    }

    /// Declares that the channel is a `quantity` in the unit that the recording states; in SI units if it states none that
    /// is known. The calibration acts after it.
    pub fn in_unit_of_file(self, quantity: Quantity) -> Self {
        Self {
            file_unit: Some(quantity),
            ..self
        }
    }

    /// Factor from the numbers of a recorded channel to SI, by the unit that the recording states, if that counts.
    pub(crate) fn si_from_file(&self, recorded: &RecordedChannel) -> Result<f64, RecordError> {
        self.si_from_stated(recorded.unit().unwrap_or_default())
    }

    /// As [`Self::si_from_file`], of a unit as a file writes it; 1 if it is no unit that is known.
    pub(crate) fn si_from_stated(&self, unit: &str) -> Result<f64, RecordError> {
        match (self.file_unit, Quantity::of_unit(unit)) {
            (Some(quantity), Some((found, _))) if found != quantity => Err(RecordError::Unit {
                channel: self.channel.clone(),
                found: unit.to_owned(),
                quantity: quantity.name(),
                allowed: quantity.allowed_units(),
            }),
            (Some(_), Some((_, si_from_unit))) => Ok(si_from_unit),
            (Some(_) | None, _) => Ok(1.0),
        }
    }

    /// Declares the calibration: `scale` in units of the column per number in the file, `offset` in units of the column.
    ///
    /// # Errors
    /// [`RecordError::Calibration`] if one of them is not finite, or the scale is zero.
    pub fn with_calibration(self, scale: f64, offset: f64) -> Result<Self, RecordError> {
        if !scale.is_finite() || scale == 0.0 {
            return Err(RecordError::Calibration {
                channel: self.channel,
                setting: "scale",
                found: scale,
            });
        }
        if !offset.is_finite() {
            return Err(RecordError::Calibration {
                channel: self.channel,
                setting: "offset",
                found: offset,
            });
        }
        Ok(Self {
            scale,
            offset,
            ..self
        })
    }

    /// Name of the channel.
    pub fn channel(&self) -> &str {
        &self.channel
    }

    /// Name of the column in the file.
    pub fn column(&self) -> &str {
        &self.column
    }

    /// The unit that a file which is written can state: that of SI, if the numbers are in it and the quantity is known.
    pub(crate) fn stated_unit(&self) -> &'static str {
        let is_si = self.si_from_unit == 1.0 && self.scale == 1.0 && self.offset == 0.0;
        self.file_unit
            .filter(|_| is_si)
            .map_or("", Quantity::si_unit)
    }

    /// Takes a number in the file to SI.
    pub(crate) fn si_from_number(&self, number: f64) -> f64 {
        let is_si = self.si_from_unit == 1.0 && self.scale == 1.0 && self.offset == 0.0;
        if is_si {
            return number; // and not -0.0 + 0.0, which loses the sign and with it the bits
        }
        self.si_from_unit * (self.scale * number + self.offset)
    }

    /// Takes a value in SI to the number that a file holds for it.
    pub(crate) fn number_from_si(&self, value: f64) -> f64 {
        let is_si = self.si_from_unit == 1.0 && self.scale == 1.0 && self.offset == 0.0;
        if is_si {
            return value; // to the same bits
        }
        (value / self.si_from_unit - self.offset) / self.scale
    }
}

/// Where a column stands among the names of a file: under its own, else in front of a unit in brackets, as `roof` in `roof [m/s2]`.
pub(crate) fn places_of<'n>(
    wanted: &str,
    names: impl Iterator<Item = &'n str> + Clone,
) -> Vec<usize> {
    let places = |is_it: &dyn Fn(&str) -> bool| -> Vec<usize> {
        names
            .clone()
            .enumerate()
            .filter(|(_, name)| is_it(name))
            .map(|(place, _)| place)
            .collect()
    };
    let own = places(&|name| name == wanted);
    if own.is_empty() {
        places(&|name| without_unit(name) == Some(wanted))
    } else {
        own
    }
}

/// The name in front of a unit in brackets, if it has one.
fn without_unit(name: &str) -> Option<&str> {
    let (name, _) = name.trim_end().strip_suffix(']')?.rsplit_once('[')?;
    Some(name.trim_end()).filter(|name| !name.is_empty())
}

impl TimeUnit {
    /// Digits that a number of this unit has after the point when it is known to the nanosecond.
    pub(crate) fn fraction_digits(self) -> usize {
        match self {
            Self::Seconds => 9,
            Self::Milliseconds => 6,
            Self::Microseconds => 3,
            Self::Nanoseconds => 0,
        }
    }

    /// The unit of this symbol: `s`, `ms`, `us`, `µs` or `ns`.
    pub fn of_symbol(symbol: &str) -> Option<Self> {
        match symbol {
            "s" => Some(Self::Seconds),
            "ms" => Some(Self::Milliseconds),
            "us" | "µs" => Some(Self::Microseconds),
            "ns" => Some(Self::Nanoseconds),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calibration_acts_before_the_unit() {
        // 2 V at 0.5 g/V with a bias of -0.1 g are 0.9 g.
        let roof = ChannelColumn::new("roof")
            .with_unit("g", Quantity::Acceleration)
            .and_then(|roof| roof.with_calibration(0.5, -0.1))
            .unwrap();
        assert!((roof.si_from_number(2.0) - 8.825_985).abs() < 1e-12);
    }

    #[test]
    fn number_of_a_value_reads_back_as_that_value() {
        let roof = ChannelColumn::new("roof")
            .with_unit("g", Quantity::Acceleration)
            .unwrap();
        let roof = roof.with_calibration(-0.5, 0.1).unwrap();
        assert!((roof.si_from_number(roof.number_from_si(3.7)) - 3.7).abs() < 1e-12);
    }

    #[test]
    fn negative_zero_in_si_keeps_its_sign() {
        assert!(
            ChannelColumn::new("roof")
                .si_from_number(-0.0)
                .is_sign_negative()
        );
    }

    #[test]
    fn incompatible_unit_names_found_and_allowed() {
        let error = ChannelColumn::new("roof")
            .with_unit("kN", Quantity::Velocity)
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            "channel `roof`: unit is `kN`, must be one of `m/s`, `cm/s`, `mm/s` for velocity"
        );
    }

    #[test]
    fn scale_of_zero_is_refused() {
        let error = ChannelColumn::new("roof")
            .with_calibration(0.0, 0.0)
            .unwrap_err();
        assert!(matches!(
            error,
            RecordError::Calibration {
                setting: "scale",
                ..
            }
        ));
    }
}
