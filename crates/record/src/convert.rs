//! Writes a recording in memory to a file, in SI units where the original units are known.

use std::io::{BufWriter, Seek, Write};
use std::path::Path;

use crate::new_file;
use crate::{
    ChannelColumn, ColumnMapping, CsvWriter, McapChannel, McapWriter, RecordError, RecordReader,
    RecordedChannel, RecordedFile, RecordedRows, formats::table::unit_of,
    mini_seed_writer::MiniSeedWriter, resample::resampled,
};

/// Extensions of supported output files.
const OUTPUTS: &[&str] = &[".csv", ".mcap", ".mseed"];

/// A format for writing recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputFormat {
    /// Comma-separated rows of all channels, which must have the same sampling rate.
    Csv,
    /// MCAP, with independent channels.
    Mcap,
    /// miniSEED 2, with independent channels.
    MiniSeed,
}

impl OutputFormat {
    /// Returns the format that a file name indicates.
    ///
    /// # Errors
    /// Returns an error if the extension is not supported.
    pub fn of(path: &Path) -> Result<Self, RecordError> {
        let ending = path
            .extension()
            .and_then(|ending| ending.to_str())
            .unwrap_or_default()
            .to_ascii_lowercase();
        match ending.as_str() {
            "csv" => Ok(Self::Csv),
            "mcap" => Ok(Self::Mcap),
            "mseed" => Ok(Self::MiniSeed),
            _ => Err(RecordError::UnknownOutput {
                path: path.to_owned(),
                allowed: OUTPUTS,
            }),
        }
    }
}

/// Maximum ratio of the larger to the smaller rate of a conversion. The filter of such a ratio has
/// a million weights.
const MOST_RATIO: f64 = 1e4;

/// Maximum number of samples of all channels after a conversion to a higher rate: 4 GiB.
const MOST_SAMPLES: u64 = 1 << 29;

impl RecordedFile {
    /// Converts all channels to the sampling rate `rate_hz` (Hz), on one time grid that contains
    /// the time of the earliest sample. [`crate::resample`] describes the filter.
    ///
    /// Channels that already have this rate to 0.1 % remain unchanged, with their own times.
    ///
    /// # Errors
    /// Returns an error if the rate is not positive and finite, or if a channel has no sampling
    /// rate. Also returns an error if the rates differ by a factor above 10,000, or a higher rate
    /// would give more than 2²⁹ samples.
    pub fn resampled(self, rate_hz: f64) -> Result<Self, RecordError> {
        if !(rate_hz.is_finite() && rate_hz > 0.0) {
            return Err(RecordError::DeclaredRate { found_hz: rate_hz });
        }
        self.check_resampling(rate_hz)?;
        let grid_ns = self
            .channels()
            .iter()
            .filter_map(RecordedChannel::start_ns)
            .min()
            .unwrap_or(0);
        let channels = self
            .channels()
            .iter()
            .map(|channel| resampled(channel, rate_hz, grid_ns))
            .collect();
        Ok(self.with_channels(channels))
    }

    /// Checks the size of the filters and of the samples at a rate of `to_hz` (Hz).
    fn check_resampling(&self, to_hz: f64) -> Result<(), RecordError> {
        let (mut before, mut after) = (0.0, 0.0);
        for channel in self.channels() {
            let (path, name) = (self.path().to_owned(), channel.name().to_owned());
            let Some(from_hz) = channel.sampling_rate_hz() else {
                return Err(RecordError::NoSamplingRate {
                    path,
                    channel: name,
                });
            };
            let ratio = to_hz / from_hz;
            if !(1.0 / MOST_RATIO..=MOST_RATIO).contains(&ratio) {
                return Err(RecordError::Resampling {
                    path,
                    channel: name,
                    from_hz,
                    to_hz,
                    largest: MOST_RATIO,
                });
            }
            let lengths = channel.segments().iter().map(|one| one.samples().len());
            let samples = lengths.sum::<usize>() as f64;
            before += samples;
            after += samples * ratio;
        }
        if after > before.max(MOST_SAMPLES as f64) {
            return Err(RecordError::TooManySamples {
                path: self.path().to_owned(),
                samples: after,
                to_hz,
                most: MOST_SAMPLES,
            });
        }
        Ok(())
    }

    /// Writes the recording as CSV, MCAP or miniSEED, depending on the extension `.csv`, `.mcap` or
    /// `.mseed`. An existing file is replaced when the new one is complete.
    ///
    /// # Errors
    /// Returns an error if the extension is not supported, or if one of the errors of
    /// [`Self::write_to`] occurs.
    pub fn write(&self, path: &Path) -> Result<(), RecordError> {
        let format = OutputFormat::of(path)?;
        let mut output = BufWriter::new(new_file::create(path)?);
        self.write_to(format, path, &mut output)?;
        new_file::finish_buffered(output)
    }

    /// Writes the recording in a format to `output`. Errors name `path`.
    ///
    /// Values with a known unit are converted to SI units. Other values remain unchanged. In CSV,
    /// the unit follows the name in brackets: `roof [g]` becomes `roof [m/s2]`. In MCAP, the unit
    /// is part of the metadata. In CSV, the times of dated channels are seconds since 1970.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written, or if the channels do not match the
    /// format. In CSV, all channels must have the same sampling rate.
    pub fn write_to(
        &self,
        format: OutputFormat,
        path: &Path,
        output: impl Write + Seek,
    ) -> Result<(), RecordError> {
        match format {
            OutputFormat::Csv => self.write_csv(path, output),
            OutputFormat::Mcap => self.write_mcap(path, output),
            OutputFormat::MiniSeed => self.write_mini_seed(path, output),
        }
    }

    fn write_csv(&self, path: &Path, output: impl Write) -> Result<(), RecordError> {
        let column = |channel: &RecordedChannel| {
            let column = ChannelColumn::new(name_with_unit(channel)).with_column(channel.name());
            match channel.quantity() {
                Some((quantity, _)) => column.in_unit_of_file(quantity),
                None => column,
            }
        };
        let mapping = ColumnMapping::new(self.channels().iter().map(column).collect());
        let mut rows = RecordedRows::new(self, &mapping)?;
        let columns = ColumnMapping::by_name(rows.channels());
        let mut writer = CsvWriter::new(output, path, &columns)?;
        while let Some(row) = rows.next_row()? {
            writer.write_row(row.time_ns, row.values)?;
        }
        writer.finish().map(drop)
    }

    /// Checks that all channels have times.
    fn check_rates(&self) -> Result<(), RecordError> {
        if let Some(channel) = self
            .channels()
            .iter()
            .find(|channel| channel.sampling_rate_hz().is_none())
        {
            return Err(RecordError::NoSamplingRate {
                path: self.path().to_owned(),
                channel: channel.name().to_owned(),
            });
        }
        Ok(())
    }

    fn write_mini_seed(&self, path: &Path, output: impl Write) -> Result<(), RecordError> {
        self.check_rates()?;
        let refused = |source| RecordError::WriteMiniSeed {
            path: path.to_owned(),
            source,
        };
        let mut writer = MiniSeedWriter::new(output);
        for (index, channel) in self.channels().iter().enumerate() {
            let factor = channel.quantity().map_or(1.0, |(_, factor)| factor);
            writer.write(index + 1, channel, factor).map_err(refused)?;
        }
        writer.finish().map_err(refused)
    }

    fn write_mcap(&self, path: &Path, output: impl Write + Seek) -> Result<(), RecordError> {
        self.check_rates()?;
        let stated = |channel: &RecordedChannel| McapChannel {
            name: name_in_si(channel).to_owned(),
            unit: written_unit(channel).to_owned(),
            description: channel.description().unwrap_or_default().to_owned(),
            sampling_rate_hz: channel.sampling_rate_hz(),
            origin: channel.origin(),
        };
        let mut writer = McapWriter::new(
            output,
            path,
            &self.channels().iter().map(stated).collect::<Vec<_>>(),
        )?;
        let mut channels: Vec<_> = self
            .channels()
            .iter()
            .map(|channel| {
                (
                    channel.quantity().map_or(1.0, |(_, factor)| factor),
                    channel.timed_samples().peekable(),
                )
            })
            .collect();
        // Write samples in the order of measurement. Simultaneous samples follow the order of
        // channels in the file.
        loop {
            let times = channels
                .iter_mut()
                .enumerate()
                .filter_map(|(place, (_, samples))| Some((samples.peek()?.0, place)));
            let Some((_, place)) = times.min() else { break };
            let (factor, samples) = &mut channels[place];
            if let Some((time_ns, sample)) = samples.next() {
                writer.write(place, time_ns, sample * *factor)?;
            }
        }
        writer.finish().map(drop)
    }
}

/// Returns the unit of the written values: the SI unit if the original unit is known, otherwise the
/// original unit. The result is empty if the recording states no unit.
fn written_unit(channel: &RecordedChannel) -> &str {
    channel
        .quantity()
        .map_or(channel.unit().unwrap_or_default(), |(quantity, _)| {
            quantity.si_unit()
        })
}

/// Returns the name of a column, followed by the unit of its values in brackets if the unit permits
/// that.
fn name_with_unit(channel: &RecordedChannel) -> String {
    /// Characters that would end the brackets or the field.
    const NOT_IN_BRACKETS: [char; 9] = ['[', ']', '(', ')', ',', ';', '"', '\t', '\n'];
    let (name, unit) = (name_in_si(channel), written_unit(channel));
    let is_there = unit.is_empty() || unit_of(name) == unit;
    if is_there || unit.contains(NOT_IN_BRACKETS) {
        name.to_owned()
    } else {
        format!("{name} [{unit}]")
    }
}

/// Returns the name of a channel, without a unit in brackets if the values are converted to SI.
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
        let base = [
            Segment::new(start_ns, vec![1.0, 2.0]),
            Segment::new(start_ns + 40_000_000, vec![5.0]),
        ];
        let channels = vec![
            RecordedChannel::new("roof", Some(100.0), vec![roof])
                .with_unit("m/s2")
                .with_description("up"),
            RecordedChannel::new("it's/base", Some(100.0), base.to_vec()).with_unit("counts"),
        ];
        let channels = channels
            .into_iter()
            .map(|channel| channel.with_origin(TimeOrigin::Epoch))
            .collect();
        RecordedFile::from_channels(Path::new("hall.mseed"), Format::MiniSeed, channels)
    }

    /// Returns times and bits of all existing samples.
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
                let of_table = format!("{} [{}]", written.name(), written.unit().unwrap());
                let own = if name == "out.csv" {
                    of_table.as_str()
                } else {
                    written.name()
                };
                assert_eq!(
                    (read.name(), read.sampling_rate_hz()),
                    (own, Some(100.0)),
                    "{name}"
                );
                assert_eq!(read.unit(), written.unit(), "{name}");
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
        assert_eq!(
            (roof.unit(), roof.description(), roof.origin()),
            (Some("m/s2"), Some("up"), TimeOrigin::Epoch)
        );
        assert_eq!(
            (base.unit(), base.gaps()),
            (Some("counts"), file().channels()[1].gaps())
        );
    }

    /// A rate of 1e12 Hz made the allocation of 159 TB abort the program.
    #[test]
    fn rate_that_needs_huge_filters_or_results_is_refused() {
        let told = |rate_hz: f64, length: usize| {
            let channel = |name: &str| {
                let segment = Segment::new(0, vec![1.0; length]);
                RecordedChannel::new(name, Some(100.0), vec![segment])
            };
            let channels = vec![channel("a"), channel("b")];
            let file = RecordedFile::from_channels(Path::new("hall.v2"), Format::Csmip, channels);
            file.resampled(rate_hz).map_err(|error| error.to_string())
        };
        for rate_hz in [1e12, 1e-9] {
            let expected = format!(
                "hall.v2: channel `a` cannot be resampled from 100 Hz to {rate_hz} Hz: the larger \
                 rate must be at most 10000 times the smaller"
            );
            assert_eq!(told(rate_hz, 3), Err(expected));
        }
        let expected = "hall.v2: has 6.000e8 samples at 1000000 Hz, must have at most 536870912; \
                        use a lower rate";
        assert_eq!(told(1e6, 30_000), Err(expected.to_owned()));
        assert_eq!(
            told(1e6, 3).unwrap().channels()[0].sampling_rate_hz(),
            Some(1e6)
        );
    }

    #[test]
    fn known_units_become_si() {
        let folder = tempfile::tempdir().unwrap();
        let channel =
            RecordedChannel::new("a", Some(100.0), vec![Segment::new(0, vec![250.0, -50.0])])
                .with_unit("cm/sec2");
        let file = RecordedFile::from_channels(Path::new("hall.v2"), Format::Csmip, vec![channel]);
        for name in ["out.csv", "out.mcap"] {
            let path = folder.path().join(name);
            file.write(&path).unwrap();
            let mapping = ColumnMapping::by_name(["a"]);
            let mut recording = Recording::open(&path, &mapping, OffsetRemoval::Keep).unwrap();
            assert_eq!(
                recording.next_row().unwrap().unwrap().values,
                [2.5],
                "{name}"
            );
        }
    }

    #[test]
    fn refused_conversion_leaves_an_existing_file_unchanged() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.csv");
        std::fs::write(&path, "before").unwrap();
        let channel = |name: &str, rate_hz| {
            RecordedChannel::new(name, Some(rate_hz), vec![Segment::new(0, vec![1.0, 2.0])])
        };
        let channels = vec![channel("a", 100.0), channel("b", 200.0)];
        let file = RecordedFile::from_channels(Path::new("hall.v2"), Format::Csmip, channels);
        assert!(file.write(&path).is_err());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "before");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn unit_in_a_column_name_is_the_unit_of_the_written_values() {
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("table.csv");
        std::fs::write(&table, "time,roof [g],mood [1-5]\n0,1,3\n0.01,2,4\n").unwrap();
        let file = RecordedFile::read(&table, &ReadOptions::default()).unwrap();
        for name in ["out.csv", "out.mcap"] {
            let path = folder.path().join(name);
            file.write(&path).unwrap();
            let read = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
            let channels: Vec<_> = read
                .channels()
                .iter()
                .map(|channel| (channel.name(), channel.samples().next().unwrap()))
                .collect();
            let roof = if name == "out.csv" {
                "roof [m/s2]"
            } else {
                "roof"
            };
            assert_eq!(channels, [(roof, 9.80665), ("mood [1-5]", 3.0)], "{name}");
            let again = folder.path().join("again.csv");
            read.write(&again).unwrap();
            let header = std::fs::read_to_string(&again)
                .unwrap()
                .lines()
                .next()
                .unwrap()
                .to_owned();
            assert_eq!(header, "time,roof [m/s2],mood [1-5]", "{name}");
        }
    }

    /// A table without units would not distinguish a velocity from a voltage.
    #[test]
    fn units_in_a_table_are_written_and_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let units = ["cm/sec2", "cm/sec", "cm", "Pa", "Volts", "a,b", ""];
        let channel = |(number, unit): (usize, &&str)| {
            let segment = Segment::new(0, vec![1.0, 2.0, 3.0]);
            RecordedChannel::new(format!("c{number}"), Some(100.0), vec![segment]).with_unit(*unit)
        };
        let channels = units.iter().enumerate().map(channel).collect();
        let path = folder.path().join("out.csv");
        RecordedFile::from_channels(Path::new("hall.v2"), Format::Csmip, channels)
            .write(&path)
            .unwrap();
        let read = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
        let found: Vec<_> = read
            .channels()
            .iter()
            .map(|channel| channel.unit().unwrap_or_default())
            .collect();
        assert_eq!(found, ["m/s2", "m/s", "m", "Pa", "Volts", "", ""]);
        let quantities: Vec<_> = read
            .channels()
            .iter()
            .filter_map(|channel| Some(channel.quantity()?.0.name()))
            .collect();
        assert_eq!(
            quantities,
            ["acceleration", "velocity", "displacement", "pressure"]
        );
    }

    #[test]
    fn column_is_found_without_the_unit_after_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.csv");
        std::fs::write(
            &path,
            "time,roof [g],base [m/s2],base [V],deck,deck [g]\n0,1,2,3,4,5\n0.01,1,2,3,4,5\n",
        )
        .unwrap();
        let column =
            |name: &str| ChannelColumn::new(name).in_unit_of_file(crate::Quantity::Acceleration);
        let file = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
        let mapping =
            ColumnMapping::new(vec![column("roof"), column("deck"), column("base [m/s2]")]);
        let mut in_memory = RecordedRows::new(&file, &mapping).unwrap();
        assert_eq!(
            in_memory.next_row().unwrap().unwrap().values,
            [9.80665, 4.0, 2.0]
        );
        let mut by_row = Recording::open(&path, &mapping, OffsetRemoval::Keep).unwrap();
        assert_eq!(
            by_row.next_row().unwrap().unwrap().values,
            [9.80665, 4.0, 2.0]
        );
        let either = ColumnMapping::new(vec![column("base")]);
        let refused = Recording::open(&path, &either, OffsetRemoval::Keep)
            .map(|_| ())
            .unwrap_err();
        assert!(
            matches!(refused, RecordError::RepeatedColumn { .. }),
            "{refused}"
        );
        assert!(matches!(
            RecordedRows::new(&file, &either),
            Err(RecordError::MissingChannels { .. })
        ));
    }

    #[test]
    fn other_file_extensions_are_rejected() {
        let told = file().write(Path::new("out.xlsx")).unwrap_err().to_string();
        assert_eq!(
            told,
            "out.xlsx: cannot be written, its name must end in .csv or .mcap or .mseed"
        );
    }

    #[test]
    fn channels_of_several_rates_can_be_written_when_resampled() {
        let folder = tempfile::tempdir().unwrap();
        let channel = |name, rate_hz, count| {
            RecordedChannel::new(name, Some(rate_hz), vec![Segment::new(0, vec![1.5; count])])
        };
        let file = RecordedFile::from_channels(
            Path::new("x"),
            Format::Tdms,
            vec![channel("a", 100.0, 200), channel("b", 60.0, 120)],
        );
        let path = folder.path().join("out.csv");
        assert!(matches!(
            file.write(&path),
            Err(RecordError::UnequalRates { .. })
        ));
        file.resampled(50.0).unwrap().write(&path).unwrap();
        let mut recording = Recording::open(
            &path,
            &ColumnMapping::by_name(["a", "b"]),
            OffsetRemoval::Keep,
        )
        .unwrap();
        assert_eq!(recording.check_sampling_rate(50.0).unwrap(), 50.0);
        while let Some(row) = recording.next_row().unwrap() {
            assert!(row.values.iter().all(|value| (value - 1.5).abs() < 1e-12));
        }
    }
}
