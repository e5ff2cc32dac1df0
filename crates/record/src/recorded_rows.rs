//! Rows of a recording in memory, with the channels that a mapping selects.

use std::path::{Path, PathBuf};

use crate::{
    ChannelColumn, ColumnMapping, RecordError, RecordReader, RecordedChannel, RecordedFile, Row,
    TimeSource, column_mapping::places_of, rate::SAME_RATE,
};

/// A reader of the rows of a recording in memory.
///
/// Rows are on the time grid of the first channel. Samples of the other channels go to the nearest
/// row and are not interpolated. A channel without a sample in a row has a missing value.
pub struct RecordedRows {
    path: PathBuf,
    names: Vec<String>,
    columns: Vec<Column>,
    rate_hz: f64,
    start_ns: i64,
    values: Vec<f64>,
}

/// The remaining samples of a channel: row number and value in SI units.
struct Column {
    samples: std::iter::Peekable<Box<dyn Iterator<Item = (i64, f64)> + Send>>,
}

impl RecordedRows {
    /// Selects the channels of the mapping.
    ///
    /// # Errors
    /// Returns an error if channels are missing, have different sampling rates or none, or have
    /// units of another quantity. Also returns an error if some channels have dates and others do
    /// not.
    pub fn new(file: &RecordedFile, mapping: &ColumnMapping) -> Result<Self, RecordError> {
        let path = || file.path().to_owned();
        let channels = find_channels(file, mapping)?;
        let declared_hz = match mapping.time() {
            TimeSource::Counted { rate_hz } => Some(*rate_hz),
            TimeSource::Column { .. } => None,
        };
        let rate = |channel: &RecordedChannel| {
            let channel_name = || channel.name().to_owned();
            let none = || RecordError::NoSamplingRate {
                path: path(),
                channel: channel_name(),
            };
            channel.sampling_rate_hz().or(declared_hz).ok_or_else(none)
        };
        let first = channels.first().map(|(_, channel)| *channel);
        let first_rate_hz = first.map_or(Ok(1.0), rate)?;
        for (_, channel) in &channels {
            let (found_hz, first) = (rate(channel)?, first.unwrap_or(channel));
            if (found_hz - first_rate_hz).abs() > SAME_RATE * first_rate_hz {
                let (channel, first) = (channel.name().to_owned(), first.name().to_owned());
                return Err(RecordError::UnequalRates {
                    path: path(),
                    channel,
                    found_hz,
                    first,
                    first_hz: first_rate_hz,
                });
            }
            if channel.origin() != first.origin() {
                let (channel, first) = (channel.name().to_owned(), first.name().to_owned());
                return Err(RecordError::UnequalOrigins {
                    path: path(),
                    channel,
                    first,
                });
            }
        }
        let start_ns = first.and_then(RecordedChannel::start_ns).unwrap_or(0);
        let mut columns = Vec::new();
        for (column, channel) in &channels {
            let rate_hz = rate(channel)?;
            let si_from_file = column.si_from_file(channel)?;
            let channel = (*channel).clone().with_declared_rate(rate_hz);
            let column = (*column).clone();
            let samples = owned_samples(channel).map(move |(time_ns, sample)| {
                let row =
                    (time_ns.saturating_sub(start_ns) as f64 * first_rate_hz / 1e9).round() as i64;
                (row, column.si_from_number(sample * si_from_file))
            });
            let samples: Box<dyn Iterator<Item = (i64, f64)> + Send> = Box::new(samples);
            columns.push(Column {
                samples: samples.peekable(),
            });
        }
        let names = mapping
            .channels()
            .iter()
            .map(|column| column.channel().to_owned())
            .collect();
        let values = vec![f64::NAN; columns.len()];
        Ok(Self {
            path: path(),
            names,
            columns,
            rate_hz: first_rate_hz,
            start_ns,
            values,
        })
    }
}

/// Returns the channels of the mapping, in its order.
fn find_channels<'a>(
    file: &'a RecordedFile,
    mapping: &'a ColumnMapping,
) -> Result<Vec<(&'a ChannelColumn, &'a RecordedChannel)>, RecordError> {
    let of_name =
        |name: &str| match places_of(name, file.channels().iter().map(RecordedChannel::name))[..] {
            [place] => file.channels().get(place),
            // Several channels can match only if the unit follows the name.
            _ => None,
        };
    let missing: Vec<String> = mapping
        .channels()
        .iter()
        .map(|column| column.column().to_owned())
        .filter(|name| of_name(name).is_none())
        .collect();
    if !missing.is_empty() {
        let found = file
            .channels()
            .iter()
            .map(|channel| channel.name().to_owned())
            .collect();
        return Err(RecordError::MissingChannels {
            path: file.path().to_owned(),
            missing,
            found,
        });
    }
    let columns = mapping.channels().iter();
    Ok(columns
        .filter_map(|column| Some((column, of_name(column.column())?)))
        .collect())
}

/// Returns times and samples of a channel as an iterator that owns them.
fn owned_samples(channel: RecordedChannel) -> impl Iterator<Item = (i64, f64)> + Send {
    let rate_hz = channel.sampling_rate_hz().unwrap_or(1.0);
    let segments: Vec<(i64, Vec<f64>)> = channel
        .segments()
        .iter()
        .map(|segment| (segment.start_ns(), segment.samples().to_vec()))
        .collect();
    segments.into_iter().flat_map(move |(start_ns, samples)| {
        let time_ns = move |index: usize| {
            start_ns.saturating_add((index as f64 * 1e9 / rate_hz).round() as i64)
        };
        samples
            .into_iter()
            .enumerate()
            .map(move |(index, sample)| (time_ns(index), sample))
    })
}

impl RecordReader for RecordedRows {
    fn path(&self) -> &Path {
        &self.path
    }

    fn channels(&self) -> &[String] {
        &self.names
    }

    fn next_row(&mut self) -> Result<Option<Row<'_>>, RecordError> {
        let next = self
            .columns
            .iter_mut()
            .filter_map(|column| column.samples.peek().map(|(row, _)| *row))
            .min();
        let Some(row) = next else { return Ok(None) };
        for (column, value) in self.columns.iter_mut().zip(&mut self.values) {
            *value = column
                .samples
                .next_if(|(own, _)| *own == row)
                .map_or(f64::NAN, |(_, sample)| sample);
            // If two samples are nearest to one row, the first one counts.
            while column.samples.next_if(|(own, _)| *own == row).is_some() {}
        }
        let since_start_ns = (row as f64 * 1e9 / self.rate_hz).round() as i64;
        Ok(Some(Row {
            time_ns: self.start_ns.saturating_add(since_start_ns),
            values: &self.values,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Format, Quantity, Segment, TimeOrigin};

    fn channel(name: &str, rate_hz: f64, start_ns: i64, samples: &[f64]) -> RecordedChannel {
        RecordedChannel::new(
            name,
            Some(rate_hz),
            vec![Segment::new(start_ns, samples.to_vec())],
        )
    }

    fn file(channels: Vec<RecordedChannel>) -> RecordedFile {
        RecordedFile::from_channels(Path::new("hall.mseed"), Format::MiniSeed, channels)
    }

    fn rows(
        file: &RecordedFile,
        mapping: &ColumnMapping,
    ) -> Result<Vec<(i64, Vec<f64>)>, RecordError> {
        let mut reader = RecordedRows::new(file, mapping)?;
        let mut rows = Vec::new();
        while let Some(row) = reader.next_row()? {
            rows.push((row.time_ns, row.values.to_vec()));
        }
        Ok(rows)
    }

    #[test]
    fn samples_go_to_the_nearest_row_and_gaps_are_missing() {
        let ahead = channel("a", 100.0, 0, &[1.0, 2.0, 3.0]);
        // The nearest row of 13 ms is 10 ms, and that of 23 ms is 20 ms.
        let late = channel("b", 100.0, 13_000_000, &[5.0, 6.0]);
        let found = rows(
            &file(vec![ahead, late]),
            &ColumnMapping::by_name(["a", "b"]),
        )
        .unwrap();
        assert!(found[0].1[1].is_nan());
        assert_eq!(found[1], (10_000_000, vec![2.0, 5.0]));
        assert_eq!(found[2], (20_000_000, vec![3.0, 6.0]));
        assert_eq!(found.len(), 3);
    }

    #[test]
    fn unit_of_the_file_is_used_if_the_mapping_requests_it() {
        let in_gal = channel("a", 100.0, 0, &[250.0]).with_unit("cm/sec2");
        let column = || {
            ChannelColumn::new("roof")
                .with_column("a")
                .with_calibration(-1.0, 0.5)
                .unwrap()
        };
        let by_file = ColumnMapping::new(vec![column().in_unit_of_file(Quantity::Acceleration)]);
        assert_eq!(
            rows(&file(vec![in_gal.clone()]), &by_file).unwrap(),
            [(0, vec![-2.0])]
        );
        let as_it_stands = ColumnMapping::new(vec![column()]);
        assert_eq!(
            rows(&file(vec![in_gal]), &as_it_stands).unwrap(),
            [(0, vec![-249.5])]
        );
    }

    #[test]
    fn unit_of_another_quantity_is_refused() {
        let displacement = channel("a", 100.0, 0, &[1.0]).with_unit("cm");
        let mapping = ColumnMapping::new(vec![
            ChannelColumn::new("a").in_unit_of_file(Quantity::Acceleration),
        ]);
        let told = rows(&file(vec![displacement]), &mapping)
            .unwrap_err()
            .to_string();
        assert!(
            told.starts_with("channel `a`: unit is `cm`, must be one of `m/s2`"),
            "{told}"
        );
    }

    #[test]
    fn other_rates_and_origins_are_refused_by_name() {
        let mapping = ColumnMapping::by_name(["a", "b"]);
        let unequal = file(vec![
            channel("a", 100.0, 0, &[1.0]),
            channel("b", 200.0, 0, &[1.0]),
        ]);
        let told = rows(&unequal, &mapping).unwrap_err().to_string();
        assert_eq!(
            told,
            "hall.mseed: channel `b` is sampled at 200.0000 Hz, must be 100.0000 Hz like `a`; \
             resample them"
        );
        let dated = channel("b", 100.0, 0, &[1.0]).with_origin(TimeOrigin::Epoch);
        let mixed = file(vec![channel("a", 100.0, 0, &[1.0]), dated]);
        assert!(matches!(
            rows(&mixed, &mapping),
            Err(RecordError::UnequalOrigins { .. })
        ));
        let unknown = rows(&unequal, &ColumnMapping::by_name(["c"]))
            .unwrap_err()
            .to_string();
        assert_eq!(
            unknown,
            "hall.mseed: has no channel `c`; its channels are `a`, `b`"
        );
    }

    #[test]
    fn channel_without_rate_needs_a_declared_one() {
        let untimed = file(vec![RecordedChannel::new(
            "a",
            None,
            vec![Segment::new(0, vec![1.0, 2.0])],
        )]);
        assert!(matches!(
            rows(&untimed, &ColumnMapping::by_name(["a"])),
            Err(RecordError::NoSamplingRate { .. })
        ));
        let mapping =
            ColumnMapping::by_name(["a"]).with_time(TimeSource::Counted { rate_hz: 50.0 });
        assert_eq!(
            rows(&untimed, &mapping).unwrap()[1],
            (20_000_000, vec![2.0])
        );
    }
}
