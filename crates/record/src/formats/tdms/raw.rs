//! Raw data of a segment: chunks that contain the channels one after the other, or interleaved
//! value by value.

use std::collections::BTreeMap;

use super::Object;
use super::metadata::{Index, Scaler, StridePosition, daqmx_size, number, size};
use crate::bytes::{ByteOrder, Bytes};
use crate::fault::Fault;

/// Adds the samples of a segment to its channels. If `is_unfinished`, an incomplete end is the
/// result of a crash and is ignored.
pub(super) fn read(
    mut data: Bytes<'_>,
    is_interleaved: bool,
    is_unfinished: bool,
    objects: &mut BTreeMap<String, Object>,
    order: &[String],
) -> Result<(), Fault> {
    let index = |path: &String| objects.get(path).and_then(|object| object.index.clone());
    let indices: Vec<(String, Index)> = order
        .iter()
        .filter_map(|path| Some((path.clone(), index(path)?)))
        .collect();
    let is_daqmx = indices
        .iter()
        .any(|(_, index)| matches!(index, Index::Daqmx { .. }));
    if is_daqmx {
        return read_daqmx(data, is_unfinished, &indices, objects);
    }
    let chunk_bytes = indices
        .iter()
        .try_fold(0_u64, |sum, (_, index)| match index {
            Index::Values { bytes, .. } => sum.checked_add(*bytes),
            Index::Daqmx { .. } => Some(sum),
        });
    let chunk_bytes = chunk_bytes
        .ok_or_else(|| Fault::at_byte(0, "bytes of a chunk", "too large", "fewer than 2^64"))?;
    if chunk_bytes == 0 {
        return expect_no_data(&data);
    }
    while !data.is_at_end() {
        expect_chunk(&data, chunk_bytes, is_unfinished)?;
        match is_interleaved {
            true => read_interleaved(&mut data, &indices, objects)?,
            false => read_contiguous(&mut data, &indices, objects)?,
        }
    }
    Ok(())
}

/// Reports data of a segment whose channels have no values.
fn expect_no_data(data: &Bytes<'_>) -> Result<(), Fault> {
    match data.left() {
        0 => Ok(()),
        left => Err(Fault::at_byte(
            0,
            "raw data",
            format!("{left} bytes"),
            "empty: no channel has values here",
        )),
    }
}

/// Reports a last chunk that is too short, unless the segment is unfinished.
fn expect_chunk(data: &Bytes<'_>, bytes: u64, is_unfinished: bool) -> Result<(), Fault> {
    if (data.left() as u64) < bytes && !is_unfinished {
        let found = format!("{} bytes", data.left());
        return Err(Fault::at_byte(
            data.position(),
            "last chunk of raw data",
            found,
            format!("{bytes} bytes"),
        ));
    }
    Ok(())
}

fn add(
    objects: &mut BTreeMap<String, Object>,
    path: &str,
    scaler: u32,
    values: impl IntoIterator<Item = f64>,
) {
    if let Some(object) = objects.get_mut(path) {
        let finite = values
            .into_iter()
            .map(|value| if value.is_finite() { value } else { f64::NAN });
        object.samples.entry(scaler).or_default().extend(finite);
    }
}

fn read_contiguous(
    data: &mut Bytes<'_>,
    indices: &[(String, Index)],
    objects: &mut BTreeMap<String, Object>,
) -> Result<(), Fault> {
    for (path, index) in indices {
        let Index::Values { kind, bytes, .. } = index else {
            continue;
        };
        let length = usize::try_from(*bytes)
            .unwrap_or(usize::MAX)
            .min(data.left());
        let mut values = Bytes::new(data.take(length)?, data.order);
        let size = size(*kind).unwrap_or(u64::MAX) as usize;
        let mut numbers = Vec::new();
        while values.left() >= size {
            match number(&mut values, *kind)? {
                Some(number) => numbers.push(number),
                // Text, times and complex numbers are not samples.
                None => break,
            }
        }
        if !numbers.is_empty() {
            add(objects, path, 0, numbers);
        }
    }
    Ok(())
}

fn read_interleaved(
    data: &mut Bytes<'_>,
    indices: &[(String, Index)],
    objects: &mut BTreeMap<String, Object>,
) -> Result<(), Fault> {
    let mut kinds = Vec::new();
    for (path, index) in indices {
        let Index::Values { kind, .. } = index else {
            continue;
        };
        let size = size(*kind).ok_or_else(|| {
            Fault::at_byte(
                data.position(),
                format!("type of {path}"),
                "text",
                "numbers, for interleaved data",
            )
        })?;
        kinds.push((path, *kind, size as usize));
    }
    let stride: usize = kinds.iter().map(|(_, _, size)| size).sum();
    while data.left() >= stride {
        for (path, kind, size) in &kinds {
            let mut value = Bytes::new(data.take(*size)?, data.order);
            if let Some(number) = number(&mut value, *kind)? {
                add(objects, path, 0, [number]);
            }
        }
    }
    // A crash may leave an incomplete stride.
    data.take(data.left()).map(|_| ())
}

fn read_daqmx(
    mut data: Bytes<'_>,
    is_unfinished: bool,
    indices: &[(String, Index)],
    objects: &mut BTreeMap<String, Object>,
) -> Result<(), Fault> {
    let mut widths: &[u32] = &[];
    let mut counts = Vec::new();
    for (path, index) in indices {
        let Index::Daqmx {
            count,
            scalers,
            widths: own,
        } = index
        else {
            return Err(Fault::at_byte(
                0,
                format!("raw data of {path}"),
                "plain values",
                "DAQmx data like the adjacent channels",
            ));
        };
        // All channels state the widths of the same buffers.
        widths = own;
        for scaler in scalers {
            check_place(path, scaler, own)?;
        }
        counts.push(*count);
    }
    let strides = counts.iter().copied().max().unwrap_or(0);
    let chunk = widths.iter().try_fold(0_u64, |sum, width| {
        sum.checked_add(strides.checked_mul(u64::from(*width))?)
    });
    let Some(chunk) = chunk.filter(|chunk| *chunk > 0) else {
        return expect_no_data(&data);
    };
    while !data.is_at_end() {
        expect_chunk(&data, chunk, is_unfinished)?;
        for (buffer, width) in widths.iter().enumerate() {
            let length = usize::try_from(strides * u64::from(*width))
                .unwrap_or(usize::MAX)
                .min(data.left());
            let rows = data.take(length)?;
            for (path, index) in indices {
                let Index::Daqmx { count, scalers, .. } = index else {
                    continue;
                };
                let own = scalers
                    .iter()
                    .filter(|scaler| scaler.buffer as usize == buffer);
                for scaler in own {
                    let rows = rows
                        .chunks_exact((*width).max(1) as usize)
                        .take(usize::try_from(*count).unwrap_or(usize::MAX));
                    add(
                        objects,
                        path,
                        scaler.id,
                        rows.filter_map(|row| scaled_value(row, scaler, data.order)),
                    );
                }
            }
        }
    }
    Ok(())
}

/// Checks that the values of a scaler lie within their buffer, which has one of `widths` in bytes.
fn check_place(path: &str, scaler: &Scaler, widths: &[u32]) -> Result<(), Fault> {
    let buffer = scaler.buffer;
    let width = widths.get(buffer as usize).copied().unwrap_or(0);
    let end = match scaler.place {
        StridePosition::Byte(byte) => u64::from(byte) + daqmx_size(scaler.kind).unwrap_or(0) as u64,
        StridePosition::Bit(bit) => u64::from(bit / 8) + 1,
    };
    if end > u64::from(width) {
        let found = format!("up to byte {end} of buffer {buffer}");
        return Err(Fault::at_byte(
            0,
            format!("place of {path}"),
            found,
            format!("within its {width} bytes"),
        ));
    }
    Ok(())
}

/// Returns the value of a scaler in a stride.
fn scaled_value(row: &[u8], scaler: &Scaler, order: ByteOrder) -> Option<f64> {
    let byte = match scaler.place {
        StridePosition::Bit(bit) => {
            return row
                .get(bit as usize / 8)
                .map(|byte| f64::from(byte >> (bit % 8) & 1));
        }
        StridePosition::Byte(byte) => byte as usize,
    };
    let mut value = Bytes::new(row.get(byte..)?, order);
    match scaler.kind {
        0 => value.u8().ok().map(f64::from),
        1 => value.u8().ok().map(|value| f64::from(value as i8)),
        2 => value.u16().ok().map(f64::from),
        3 => value.i16().ok().map(f64::from),
        4 => value.u32().ok().map(f64::from),
        5 => value.i32().ok().map(f64::from),
        _ => None,
    }
}
