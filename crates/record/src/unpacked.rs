//! Decompresses data up to a limit, because a small file may expand to a huge one.

use std::io::Read;

/// Maximum number of decompressed bytes per file: more than a day of 20 channels at 200 Hz as text.
const MOST_BYTES: u64 = 4 << 30;

/// The number of bytes that may still be decompressed from a file, including nested archives.
#[derive(Debug)]
pub(crate) struct UnpackingBudget {
    left: u64,
}

impl UnpackingBudget {
    pub(crate) fn new() -> Self {
        Self { left: MOST_BYTES }
    }

    /// Reads all output of a decoder. Memory grows with the actual output, not with the size in a
    /// header. The error describes the problem found.
    pub(crate) fn unpack(&mut self, decoder: impl Read) -> Result<Vec<u8>, String> {
        let mut bytes = Vec::new();
        decoder
            .take(self.left + 1)
            .read_to_end(&mut bytes)
            .map_err(|error| format!("damaged ({error})"))?;
        match self.left.checked_sub(bytes.len() as u64) {
            Some(left) => {
                self.left = left;
                Ok(bytes)
            }
            None => Err(format!("more than {} GiB in total", MOST_BYTES >> 30)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unpacking_budget_covers_all_members_together() {
        let mut budget = UnpackingBudget { left: 10 };
        assert_eq!(budget.unpack(&[1; 6][..]).unwrap().len(), 6);
        assert!(budget.unpack(&[1; 5][..]).is_err());
        assert_eq!(budget.unpack(&[1; 4][..]).unwrap().len(), 4);
        assert!(
            budget
                .unpack(std::io::repeat(0))
                .unwrap_err()
                .starts_with("more than 4 GiB")
        );
    }
}
