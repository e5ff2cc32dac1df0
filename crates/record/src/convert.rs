//! Writes a recording that is in memory to another file, in SI units where its own are known.

use std::path::Path;

use crate::{
    ChannelColumn, ColumnMapping, CsvWriter, McapChannel, McapWriter, RecordError, RecordReader, RecordedChannel,
    RecordedFile, RecordedRows, formats::table::unit_of, resample::resampled,
};

/// Ends of names of files that can be written.
const OUTPUTS: &[&str] = &[".csv", ".mcap"];

/// A format that recordings are written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputFormat {
    /// Comma-separated: rows of all channels, which must be sampled alike.
    Csv,
    /// MCAP: every channel by itself.
    Mcap,
}

impl OutputFormat {
    /// The format that a file name tells.
    ///
    /// # Errors
    /// It tells none.
    pub fn of(path: &Path) -> Result<Self, RecordError> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
        match ending.as_str() {
            "csv" => Ok(Self::Csv),
            "mcap" => Ok(Self::Mcap),
            _ => Err(RecordError::UnknownOutput { path: path.to_owned(), allowed: OUTPUTS }),
        }
    }
}

impl RecordedFile {
    /// The same recording with all channels at this rate in Hz, on one grid of time; see [`crate::resample`] for the filter.
    ///
    /// # Errors
    /// The rate is not positive and finite, or a channel has no rate.
    pub fn resampled(self, rate_hz: f64) -> Result<Self, RecordError> {
        if !(rate_hz.is_finite() && rate_hz > 0.0) {
            return Err(RecordError::DeclaredRate { found_hz: rate_hz });
        }
        if let Some(channel) = self.channels().iter().find(|channel| channel.sampling_rate_hz().is_none()) {
            return Err(RecordError::NoSamplingRate {
                path: self.path().to_owned(),
                channel: channel.name().to_owned(),
            });
        }
        let grid_ns = self.channels().iter().filter_map(RecordedChannel::start_ns).min().unwrap_or(0);
        let channels = self.channels().iter().map(|channel| resampled(channel, rate_hz, grid_ns)).collect();
        Ok(self.with_channels(channels))
    }

    /// Writes the recording to a file of the format that its name tells: `.csv` or `.mcap`.
    ///
    /// Values of a unit that is known become SI, and a name loses it: `roof [g]` is `roof`. Others stay as they are. In CSV the
    /// times of dated channels are seconds since 1970.
    ///
    /// # Errors
    /// The name tells no format, the file cannot be written, or the channels do not fit: in CSV all must have the same rate.
    pub fn write(&self, path: &Path) -> Result<(), RecordError> {
        match OutputFormat::of(path)? {
            OutputFormat::Csv => self.write_csv(path),
            OutputFormat::Mcap => self.write_mcap(path),
        }
    }

    fn write_csv(&self, path: &Path) -> Result<(), RecordError> {
        let column = |channel: &RecordedChannel| {
            let column = ChannelColumn::new(name_in_si(channel)).with_column(channel.name());
            match channel.quantity() {
                Some((quantity, _)) => column.in_unit_of_file(quantity),
                None => column,
            }
        };
        let mapping = ColumnMapping::new(self.channels().iter().map(column).collect());
        let mut rows = RecordedRows::new(self, &mapping)?;
        let mut writer = CsvWriter::create(path, rows.channels())?;
        while let Some(row) = rows.next_row()? {
            writer.write_row(row.time_ns, row.values)?;
        }
        writer.finish()
    }

    fn write_mcap(&self, path: &Path) -> Result<(), RecordError> {
        if let Some(channel) = self.channels().iter().find(|channel| channel.sampling_rate_hz().is_none()) {
            return Err(RecordError::NoSamplingRate {
                path: self.path().to_owned(),
                channel: channel.name().to_owned(),
            });
        }
        let stated = |channel: &RecordedChannel| McapChannel {
            name: name_in_si(channel).to_owned(),
            unit: match channel.quantity() {
                Some((quantity, _)) => quantity.si_unit().to_owned(),
                None => channel.unit().unwrap_or_default().to_owned(),
            },
            description: channel.description().unwrap_or_default().to_owned(),
            sampling_rate_hz: channel.sampling_rate_hz(),
            origin: channel.origin(),
        };
        let mut writer = McapWriter::create(path, &self.channels().iter().map(stated).collect::<Vec<_>>())?;
        let mut channels: Vec<_> = self
            .channels()
            .iter()
            .map(|channel| (channel.quantity().map_or(1.0, |(_, factor)| factor), channel.timed_samples().peekable()))
            .collect();
        // in the order of time, as it was measured; channels in the order of the file where times are the same
        loop {
            let times =
                channels.iter_mut().enumerate().filter_map(|(place, (_, samples))| Some((samples.peek()?.0, place)));
            let Some((_, place)) = times.min() else { break };
            let (factor, samples) = &mut channels[place];
            if let Some((time_ns, sample)) = samples.next() {
                writer.write(place, time_ns, sample * *factor)?;
            }
        }
        writer.finish()
    }
}

/// The name without the unit in brackets, if the values are taken to SI.
fn name_in_si(channel: &RecordedChannel) -> &str {
    let name = channel.name();
    let is_in_brackets = channel.quantity().is_some() && !unit_of(name).is_empty();
    let bracket = name.rfind(['[', '(']).filter(|_| is_in_brackets);
    bracket.map_or(name, |bracket| name[..bracket].trim_end())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Format, OffsetRemoval, ReadOptions, Recording, Segment, TimeOrigin};

    fn file() -> RecordedFile {
        let start_ns = 1_709_208_000_500_000_000;
        let roof = Segment::new(start_ns, vec![0.1, -2.5, f64::NAN, 1e-17, 7.0]);
        let base = [Segment::new(start_ns, vec![1.0, 2.0]), Segment::new(start_ns + 40_000_000, vec![5.0])];
        let channels = vec![
            RecordedChannel::new("roof", Some(100.0), vec![roof]).with_unit("m/s2").with_description("up"),
            RecordedChannel::new("it's/base", Some(100.0), base.to_vec()).with_unit("counts"),
        ];
        let channels = channels.into_iter().map(|channel| channel.with_origin(TimeOrigin::Epoch)).collect();
        RecordedFile::from_channels(Path::new("hall.mseed"), Format::MiniSeed, channels)
    }

    /// Times and bits of all samples that are there.
    fn present(channel: &RecordedChannel) -> Vec<(i64, u64)> {
        channel
            .timed_samples()
            .filter(|(_, value)| !value.is_nan())
            .map(|(time_ns, value)| (time_ns, value.to_bits()))
            .collect()
    }

    #[test]
    fn both_formats_read_back_the_same_samples_at_the_same_times() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["out.csv", "out.mcap"] {
            let path = folder.path().join(name);
            file().write(&path).unwrap();
            let read = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
            for (written, read) in file().channels().iter().zip(read.channels()) {
                assert_eq!((read.name(), read.sampling_rate_hz()), (written.name(), Some(100.0)), "{name}");
                assert_eq!(present(read), present(written), "{name}");
            }
        }
    }

    #[test]
    fn mcap_keeps_unit_description_and_gap() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.mcap");
        file().write(&path).unwrap();
        let read = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
        let (roof, base) = (&read.channels()[0], &read.channels()[1]);
        assert_eq!((roof.unit(), roof.description(), roof.origin()), (Some("m/s2"), Some("up"), TimeOrigin::Epoch));
        assert_eq!((base.unit(), base.gaps()), (Some("counts"), file().channels()[1].gaps()));
    }

    #[test]
    fn known_units_become_si() {
        let folder = tempfile::tempdir().unwrap();
        let channel =
            RecordedChannel::new("a", Some(100.0), vec![Segment::new(0, vec![250.0, -50.0])]).with_unit("cm/sec2");
        let file = RecordedFile::from_channels(Path::new("hall.v2"), Format::Csmip, vec![channel]);
        for name in ["out.csv", "out.mcap"] {
            let path = folder.path().join(name);
            file.write(&path).unwrap();
            let mapping = ColumnMapping::by_name(["a"]);
            let mut recording = Recording::open(&path, &mapping, OffsetRemoval::Keep).unwrap();
            assert_eq!(recording.next_row().unwrap().unwrap().values, [2.5], "{name}");
        }
    }

    #[test]
    fn unit_in_a_name_goes_when_the_values_become_si() {
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("table.csv");
        std::fs::write(&table, "time,roof [g],mood [1-5]\n0,1,3\n0.01,2,4\n").unwrap();
        let file = RecordedFile::read(&table, &ReadOptions::default()).unwrap();
        for name in ["out.csv", "out.mcap"] {
            let path = folder.path().join(name);
            file.write(&path).unwrap();
            let read = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
            let channels: Vec<_> =
                read.channels().iter().map(|channel| (channel.name(), channel.samples().next().unwrap())).collect();
            assert_eq!(channels, [("roof", 9.80665), ("mood [1-5]", 3.0)], "{name}");
        }
    }

    #[test]
    fn other_ends_of_names_are_refused() {
        let told = file().write(Path::new("out.xlsx")).unwrap_err().to_string();
        assert_eq!(told, "out.xlsx: cannot be written, its name must end in .csv or .mcap");
    }

    #[test]
    fn channels_of_several_rates_can_be_written_when_resampled() {
        let folder = tempfile::tempdir().unwrap();
        let channel =
            |name, rate_hz, count| RecordedChannel::new(name, Some(rate_hz), vec![Segment::new(0, vec![1.5; count])]);
        let file = RecordedFile::from_channels(
            Path::new("x"),
            Format::Tdms,
            vec![channel("a", 100.0, 200), channel("b", 60.0, 120)],
        );
        let path = folder.path().join("out.csv");
        assert!(matches!(file.write(&path), Err(RecordError::UnequalRates { .. })));
        file.resampled(50.0).unwrap().write(&path).unwrap();
        let mut recording = Recording::open(&path, &ColumnMapping::by_name(["a", "b"]), OffsetRemoval::Keep).unwrap();
        assert_eq!(recording.check_sampling_rate(50.0).unwrap(), 50.0);
        while let Some(row) = recording.next_row().unwrap() {
            assert!(row.values.iter().all(|value| (value - 1.5).abs() < 1e-12));
        }
    }
}
