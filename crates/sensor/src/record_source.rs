//! Opens a recording as the structure file describes it: columns, units, offsets and sampling rate.

use spandrel_record::{
    ChannelColumn, ColumnMapping, OffsetRemoval, RecordError, Recording, Resampling, TimeSource,
    TimeUnit,
};
use spandrel_structure::{Quantity, Structure};
use std::path::Path;
use tracing::warn;

/// Returns the column and unit of each channel of a structure in its recordings.
///
/// # Errors
/// Returns [`RecordError::Calibration`] if a calibration cannot be inverted.
pub fn column_mapping(structure: &Structure) -> Result<ColumnMapping, RecordError> {
    let map = structure.record();
    let columns = structure
        .channels()
        .zip(map.columns())
        .map(|(channel, column)| {
            // The structure file has already included its unit in the factor.
            let mapped = ChannelColumn::new(channel.name())
                .with_column(column.column())
                .with_calibration(column.factor(), column.offset())?;
            Ok(if column.states_unit() {
                mapped
            } else {
                mapped.in_unit_of_file(quantity(channel.quantity()))
            })
        })
        .collect::<Result<Vec<_>, RecordError>>()?;
    let time = match map.time_column() {
        "" => TimeSource::Counted {
            rate_hz: structure.sampling_rate_hz(),
        },
        name => {
            let unit = TimeUnit::of_symbol(map.time_unit()).unwrap_or(TimeUnit::Seconds);
            TimeSource::Column {
                name: name.to_owned(),
                unit,
            }
        }
    };
    Ok(ColumnMapping::new(columns).with_time(time))
}

/// Converts the quantity of a channel to that of a recording, which does not specify the reference
/// of an acceleration.
fn quantity(of_channel: Quantity) -> spandrel_record::Quantity {
    match of_channel {
        Quantity::AbsoluteAcceleration
        | Quantity::RelativeAcceleration
        | Quantity::RestoringAcceleration
        | Quantity::GroundAcceleration => spandrel_record::Quantity::Acceleration,
        Quantity::Force => spandrel_record::Quantity::Force,
        Quantity::Velocity => spandrel_record::Quantity::Velocity,
        Quantity::Displacement => spandrel_record::Quantity::Displacement,
        Quantity::Strain => spandrel_record::Quantity::Strain,
    }
}

/// Opens a recording for a structure.
///
/// Resamples it if the structure file specifies that, and checks that it has the structure's
/// sampling rate.
///
/// # Errors
/// Returns an error if the file cannot be read, lacks columns or has another sampling rate. The
/// error names what the file contains.
pub fn open_record(structure: &Structure, path: &Path) -> Result<Recording, RecordError> {
    let offset = match structure.record().remove_offset_s() {
        seconds if seconds > 0.0 => OffsetRemoval::MeanOfFirst { seconds },
        _ => OffsetRemoval::Keep,
    };
    let resampling = match structure.record().resamples() {
        true => Resampling::To {
            rate_hz: structure.sampling_rate_hz(),
        },
        false => Resampling::None,
    };
    let recording =
        Recording::open_resampled(path, &column_mapping(structure)?, offset, resampling)?;
    recording.check_sampling_rate(structure.sampling_rate_hz())?;
    for doubt in recording.doubts() {
        warn!(record = %path.display(), doubt, "times of channels are in doubt");
    }
    Ok(recording)
}
