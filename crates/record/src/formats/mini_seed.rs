//! miniSEED 2 and 3: records of one channel each, in any order, joined to series.
//!
//! Layout: FDSN, *SEED reference manual* v2.4 (2012), chapter 8 and appendix B (Steim compression), and *miniSEED 3* (2023). No crate
//! is used: those that are no C bindings loop for ever on a blockette that points at itself, read headers of one byte
//! order only, and leave out the microseconds of blockette 1001.

mod record;
mod record2;
mod record3;
mod series;
mod steim;

use crate::bytes::Bytes;
use crate::fault::Fault;
use crate::recorded::RecordedChannel;

/// Whether a file begins as miniSEED of either version.
pub(crate) fn is_mini_seed(head: &[u8]) -> bool {
    record3::is_record(head) || record2::is_record(head)
}

/// Reads all series; text channels such as logs are left out.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let mut records = Vec::new();
    let mut start = 0;
    while start < bytes.len() {
        let rest = &bytes[start..];
        let (record, length) = match record3::is_record(rest) {
            true => record3::read(rest),
            false => record2::read(rest),
        }
        .map_err(|fault| fault.moved_by(start))?;
        // a record has at least its header, so that this ends
        records.extend(record.map(|record| (start, record)));
        start += length;
    }
    let channels = series::join(records)?;
    match channels.is_empty() {
        true => Err(Fault::of_file(
            "number of records with samples",
            0,
            "at least 1",
        )),
        false => Ok(channels),
    }
}

/// Reads values that are not compressed.
fn plain_values<'a>(
    data: &mut Bytes<'a>,
    count: usize,
    value: impl Fn(&mut Bytes<'a>) -> Result<f64, Fault>,
) -> Result<Vec<f64>, Fault> {
    let mut values = Vec::new();
    for _ in 0..count {
        values.push(value(data)?);
    }
    Ok(values)
}

#[cfg(test)]
mod tests;
