//! miniSEED 2 and 3: records of one channel each, in any order, joined to series.
//!
//! No crate is used. The crates that are not C bindings loop forever on a blockette that points to
//! itself. They also read only one byte order of headers, and ignore the microseconds of blockette
//! 1001.
//!
//! Source: FDSN, *SEED reference manual* v2.4 (2012), chapter 8 and appendix B (Steim compression),
//! and *miniSEED 3* (2023).

mod record;
mod record2;
mod record3;
mod series;
mod steim;

use crate::bytes::Bytes;
use crate::fault::Fault;
use crate::recorded::RecordedChannel;

/// Returns `true` if a file begins like miniSEED of either version.
pub(crate) fn is_mini_seed(head: &[u8]) -> bool {
    record3::is_record(head) || record2::is_record(head)
}

/// Reads all series of miniSEED records of version 2 or 3, as in a file or in the packets of
/// SeedLink. Skips text channels such as logs.
///
/// # Errors
/// Returns an error if a record is damaged, or if no record has samples.
pub fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let mut records = Vec::new();
    let mut start = 0;
    while start < bytes.len() {
        let rest = &bytes[start..];
        let (record, length) = match record3::is_record(rest) {
            true => record3::read(rest),
            false => record2::read(rest),
        }
        .map_err(|fault| fault.moved_by(start))?;
        // A record has at least the length of its header, so the loop terminates.
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

/// Reads uncompressed values.
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
