//! Assigns columns of a file to channels, and defines the conversion of their numbers to SI.

use crate::{Quantity, RecordError, RecordedChannel};

/// Default name of the time column.
const DEFAULT_TIME_COLUMN: &str = "time";

/// The unit of numeric times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeUnit {
    /// Times in seconds.
    Seconds,
    /// Times in milliseconds.
    Milliseconds,
    /// Times in microseconds.
    Microseconds,
    /// Times in nanoseconds.
    Nanoseconds,
}

/// The source of the times of a file.
#[derive(Debug, Clone, PartialEq)]
pub enum TimeSource {
    /// A column. Formats that state their times in another way ignore it.
    Column {
        /// Name of the column.
        name: String,
        /// Unit of numeric times.
        unit: TimeUnit,
    },
    /// A row counter, for a file without times.
    Counted {
        /// Sampling rate in Hz.
        rate_hz: f64,
    },
}

/// The columns of the channels and of the time in a file. The order of the channels is that of the
/// values in a row.
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnMapping {
    time: TimeSource,
    channels: Vec<ChannelColumn>,
}

impl ColumnMapping {
    /// Creates a mapping of channels, with the time in s in column `time`.
    pub fn new(channels: Vec<ChannelColumn>) -> Self {
        Self {
            time: TimeSource::Column {
                name: DEFAULT_TIME_COLUMN.to_owned(),
                unit: TimeUnit::Seconds,
            },
            channels,
        }
    }

    /// Maps each channel to the column of its own name, in SI units.
    pub fn by_name<S: Into<String>>(channels: impl IntoIterator<Item = S>) -> Self {
        Self::new(channels.into_iter().map(ChannelColumn::new).collect())
    }

    /// Sets the name of the time column, with times in s.
    pub fn with_time_column(self, name: impl Into<String>) -> Self {
        Self {
            time: TimeSource::Column {
                name: name.into(),
                unit: TimeUnit::Seconds,
            },
            ..self
        }
    }

    /// Sets the source of the times.
    pub fn with_time(self, time: TimeSource) -> Self {
        Self { time, ..self }
    }

    /// Returns the source of the times.
    pub fn time(&self) -> &TimeSource {
        &self.time
    }

    /// Returns the name of the time column. Written files always have one, so the default name
    /// applies to counted times.
    pub fn time_column(&self) -> &str {
        match &self.time {
            TimeSource::Column { name, .. } => name,
            TimeSource::Counted { .. } => DEFAULT_TIME_COLUMN,
        }
    }

    /// Returns the channels, in the order of the values of a row.
    pub fn channels(&self) -> &[ChannelColumn] {
        &self.channels
    }
}

/// The column of one channel, and the conversion of its numbers to SI.
///
/// value in SI = SI unit per column unit × (scale × number in the file + offset)
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
    /// Maps `channel` to the column of the same name, in SI units.
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

    /// Sets the name of the column.
    pub fn with_column(self, name: impl Into<String>) -> Self {
        Self {
            column: name.into(),
            ..self
        }
    }

    /// Declares that the channel is a `quantity` in `unit`.
    ///
    /// # Errors
    /// Returns [`RecordError::Unit`] if `unit` does not belong to the quantity.
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

    /// Declares that the channel is a `quantity` in the unit that the recording states. If that
    /// unit is missing or unknown, the numbers are in SI units. The conversion to SI precedes the
    /// calibration, which then applies to numbers in SI units.
    pub fn in_unit_of_file(self, quantity: Quantity) -> Self {
        Self {
            file_unit: Some(quantity),
            ..self
        }
    }

    /// Returns the factor from the numbers of a recorded channel to SI, if its stated unit applies.
    /// Otherwise returns 1.
    pub(crate) fn si_from_file(&self, recorded: &RecordedChannel) -> Result<f64, RecordError> {
        self.si_from_stated(recorded.unit().unwrap_or_default())
    }

    /// Works like [`Self::si_from_file`] for a unit as spelled in a file. Returns 1 if the unit is
    /// unknown.
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

    /// Sets the calibration: the value in column units is `scale` × number in the file + `offset`.
    ///
    /// # Errors
    /// Returns [`RecordError::Calibration`] if a value is not finite or the scale is zero.
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

    /// Returns the name of the channel.
    pub fn channel(&self) -> &str {
        &self.channel
    }

    /// Returns the name of the column in the file.
    pub fn column(&self) -> &str {
        &self.column
    }

    /// Returns the unit for the metadata of a written file: the SI unit if the numbers are in SI
    /// and the quantity is known. Otherwise the result is empty.
    pub(crate) fn stated_unit(&self) -> &'static str {
        let is_si = self.si_from_unit == 1.0 && self.scale == 1.0 && self.offset == 0.0;
        self.file_unit
            .filter(|_| is_si)
            .map_or("", Quantity::si_unit)
    }

    /// Converts a number in the file to SI.
    pub(crate) fn si_from_number(&self, number: f64) -> f64 {
        let is_si = self.si_from_unit == 1.0 && self.scale == 1.0 && self.offset == 0.0;
        if is_si {
            // The calculation -0.0 + 0.0 would lose the sign, so the result would not be
            // bit-identical.
            return number;
        }
        self.si_from_unit * (self.scale * number + self.offset)
    }

    /// Converts a value in SI to the number in the file.
    pub(crate) fn number_from_si(&self, value: f64) -> f64 {
        let is_si = self.si_from_unit == 1.0 && self.scale == 1.0 && self.offset == 0.0;
        if is_si {
            // The result must be bit-identical.
            return value;
        }
        (value / self.si_from_unit - self.offset) / self.scale
    }
}

/// Returns the indices of the columns named `wanted` in a file.
///
/// If there is none, returns the columns with this name in front of a unit in brackets, such as
/// `roof [m/s2]` for `roof`.
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

/// Returns the name in front of a unit in brackets, or `None` if there are no brackets.
fn without_unit(name: &str) -> Option<&str> {
    let (name, _) = name.trim_end().strip_suffix(']')?.rsplit_once('[')?;
    Some(name.trim_end()).filter(|name| !name.is_empty())
}

impl TimeUnit {
    /// Returns the number of decimals of this unit that resolve a nanosecond.
    pub(crate) fn fraction_digits(self) -> usize {
        match self {
            Self::Seconds => 9,
            Self::Milliseconds => 6,
            Self::Microseconds => 3,
            Self::Nanoseconds => 0,
        }
    }

    /// Returns the unit for a symbol: `s`, `ms`, `us`, `µs` or `ns`. Returns `None` for any other
    /// text.
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
        // 2 V at 0.5 g/V with a bias of -0.1 g is 0.9 g.
        let roof = ChannelColumn::new("roof")
            .with_unit("g", Quantity::Acceleration)
            .and_then(|roof| roof.with_calibration(0.5, -0.1))
            .unwrap();
        assert!((roof.si_from_number(2.0) - 8.825_985).abs() < 1e-12);
    }

    #[test]
    fn written_number_converts_back_to_its_value() {
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
