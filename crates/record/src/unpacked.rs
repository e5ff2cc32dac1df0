//! Decompresses data up to a limit, because a small file may expand to a huge one.

use std::io::{self, Read, Seek, SeekFrom};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::fault::Fault;

/// Maximum number of bytes that are read into memory from an archive.
///
/// Content may be stored without compression, so that the ratio does not limit it. The numbers of a
/// table take up to four times the memory of their text.
const MOST_OF_ARCHIVE: u64 = 24 << 20;

/// Maximum number of decompressed bytes of a file whose parts are compressed. A person cannot
/// extract such a file.
const MOST_OF_FILE: u64 = 4 << 30;

/// Number of bytes that may be decompressed from any file, regardless of its compressed size.
const FREE_BYTES: u64 = 16 << 20;

/// Maximum ratio of decompressed to compressed size beyond [`FREE_BYTES`].
///
/// The format of gzip and zip allows about 1000, which only repeated bytes reach. Samples with
/// noise and increasing times do not repeat.
const MOST_RATIO: u64 = 100;

/// The numbers of compressed and decompressed bytes of a file, including nested archives.
///
/// Clones share the numbers.
#[derive(Debug, Clone)]
pub(crate) struct UnpackingBudget {
    packed: Arc<AtomicU64>,
    unpacked: Arc<AtomicU64>,
    most_bytes: u64,
}

/// Decompressed data exceed their limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("decompressed content is {}, must be {}", self.found(), self.allowed())]
pub(crate) struct TooMuch {
    /// The limit that the data exceed, in bytes.
    limit: u64,
    most_bytes: u64,
}

impl UnpackingBudget {
    /// Creates the budget of the content of an archive, which is kept in memory.
    pub(crate) fn of_archive() -> Self {
        Self::up_to(MOST_OF_ARCHIVE)
    }

    /// Creates the budget of a file whose parts are compressed, and which is kept in memory.
    pub(crate) fn of_file() -> Self {
        Self::up_to(MOST_OF_FILE)
    }

    /// Creates the budget of data that are processed as a stream, of any length.
    pub(crate) fn streamed() -> Self {
        Self::up_to(u64::MAX)
    }

    fn up_to(most_bytes: u64) -> Self {
        Self {
            packed: Arc::default(),
            unpacked: Arc::default(),
            most_bytes,
        }
    }

    /// Adds compressed bytes of the outermost file.
    pub(crate) fn count_packed(&self, bytes: u64) {
        self.packed.fetch_add(bytes, Relaxed);
    }

    /// Returns a reader that counts what is read from the outermost compressed file.
    pub(crate) fn packed<R>(&self, input: R) -> Packed<R> {
        Packed {
            input,
            budget: self.clone(),
        }
    }

    /// Returns a reader of the output of a decoder. It fails with [`TooMuch`] above the limit.
    pub(crate) fn unpacked<R>(&self, decoder: R) -> Unpacked<R> {
        Unpacked {
            decoder,
            budget: self.clone(),
        }
    }

    /// Checks that this number of further bytes, as a header states it, is within the absolute
    /// limit. Data that exceed it need not be read.
    pub(crate) fn check_stated(&self, bytes: u64) -> io::Result<()> {
        let limit = self.most_bytes;
        match self.unpacked.load(Relaxed).saturating_add(bytes) > limit {
            true => Err(io::Error::other(TooMuch {
                limit,
                most_bytes: limit,
            })),
            false => Ok(()),
        }
    }

    /// Reads all output of a decoder. Memory grows with the actual output, not with the size in a
    /// header.
    pub(crate) fn unpack(&self, decoder: impl Read) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.unpacked(decoder).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn count_unpacked(&self, bytes: u64) -> Result<(), TooMuch> {
        let unpacked = self.unpacked.fetch_add(bytes, Relaxed) + bytes;
        let packed = self.packed.load(Relaxed);
        let by_ratio = FREE_BYTES.max(packed.saturating_mul(MOST_RATIO));
        let limit = by_ratio.min(self.most_bytes);
        match unpacked > limit {
            true => Err(TooMuch {
                limit,
                most_bytes: self.most_bytes,
            }),
            false => Ok(()),
        }
    }
}

impl TooMuch {
    fn found(&self) -> String {
        match self.limit == self.most_bytes {
            true => format!("more than {} MiB in total", self.limit >> 20),
            false => format!("more than {} MiB", self.limit >> 20),
        }
    }

    fn allowed(&self) -> String {
        match self.limit {
            MOST_OF_ARCHIVE if self.most_bytes == MOST_OF_ARCHIVE => format!(
                "at most {} MiB (extract the archive first)",
                MOST_OF_ARCHIVE >> 20
            ),
            limit if limit == self.most_bytes => format!("at most {} MiB", limit >> 20),
            _ => format!(
                "at most {} MiB, or {MOST_RATIO} times the compressed size",
                FREE_BYTES >> 20
            ),
        }
    }
}

/// The reason why compressed data cannot be used.
pub(crate) struct Refusal {
    what: &'static str,
    found: String,
    allowed: String,
}

impl Refusal {
    /// Creates the reason from an error of a decoder. Valid compressed data are `whole`.
    pub(crate) fn of(error: &io::Error, whole: &str) -> Self {
        let too_much = error
            .get_ref()
            .and_then(|error| error.downcast_ref::<TooMuch>());
        match too_much {
            Some(too_much) => Self {
                what: "decompressed content",
                found: too_much.found(),
                allowed: too_much.allowed(),
            },
            None => Self {
                what: "compressed content",
                found: format!("damaged ({error})"),
                allowed: whole.to_owned(),
            },
        }
    }

    /// Returns the fault of a whole file.
    pub(crate) fn of_file(self) -> Fault {
        Fault::of_file(self.what, self.found, self.allowed)
    }

    /// Returns the fault of the data at a byte.
    pub(crate) fn at_byte(self, byte: usize) -> Fault {
        Fault::at_byte(byte, self.what, self.found, self.allowed)
    }
}

/// A reader of the outermost compressed file.
pub(crate) struct Packed<R> {
    input: R,
    budget: UnpackingBudget,
}

impl<R: Read> Read for Packed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.input.read(buffer)?;
        self.budget.count_packed(count as u64);
        Ok(count)
    }
}

impl<R: Seek> Seek for Packed<R> {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.input.seek(position)
    }
}

/// A reader of decompressed data.
pub(crate) struct Unpacked<R> {
    decoder: R,
    budget: UnpackingBudget,
}

impl<R: Read> Read for Unpacked<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.decoder.read(buffer)?;
        self.budget
            .count_unpacked(count as u64)
            .map_err(io::Error::other)?;
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unpacking_budget_covers_all_members_together() {
        let budget = UnpackingBudget::up_to(10);
        assert_eq!(budget.unpack(&[1; 6][..]).unwrap().len(), 6);
        assert!(budget.unpack(&[1; 5][..]).is_err());
    }

    #[test]
    fn content_that_is_not_compressed_has_an_absolute_limit() {
        for (budget, most, advice) in [
            (
                UnpackingBudget::of_archive(),
                24,
                " (extract the archive first)",
            ),
            (UnpackingBudget::up_to(20 << 20), 20, ""),
        ] {
            budget.count_packed(1 << 40);
            budget.unpack(io::repeat(0).take(most << 20)).unwrap();
            let error = budget.unpack(&[0][..]).unwrap_err();
            let told = Refusal::of(&error, "whole").of_file().to_string();
            assert!(budget.check_stated(0).is_err()); // the rejected byte counts
            assert_eq!(
                told,
                format!(
                    "decompressed content is more than {most} MiB in total, must be at most {most} \
                     MiB{advice}"
                )
            );
        }
    }

    #[test]
    fn ratio_counts_beyond_what_every_file_may_unpack() {
        let budget = UnpackingBudget::streamed();
        let mut packed = budget.packed(io::repeat(1));
        packed.read_exact(&mut [0; 1000]).unwrap();
        let mut unpacked = budget.unpacked(io::repeat(0));
        let mut piece = vec![0; FREE_BYTES as usize];
        unpacked.read_exact(&mut piece).unwrap();
        let told = unpacked.read_exact(&mut [0]).unwrap_err();
        let told = Refusal::of(&told, "whole").of_file().to_string();
        assert_eq!(
            told,
            "decompressed content is more than 16 MiB, must be at most 16 MiB, or 100 times the \
             compressed size"
        );
    }

    #[test]
    fn data_of_a_usual_ratio_have_any_length() {
        let budget = UnpackingBudget::streamed();
        let mut packed = budget.packed(io::repeat(1));
        let mut unpacked = budget.unpacked(io::repeat(0));
        for _ in 0..20 {
            packed.read_exact(&mut vec![0; 1 << 20]).unwrap();
            unpacked.read_exact(&mut vec![0; 50 << 20]).unwrap();
        }
    }
}
