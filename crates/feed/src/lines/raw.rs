//! Arrays of little-endian numbers: sample 0 of all columns, sample 1 of all columns, and so on.

use super::LineFault;
use crate::packet::Packet;

/// The type of the numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RawNumber {
    /// Signed integers of 16 bits.
    I16,
    /// Signed integers of 32 bits.
    I32,
    /// Floating-point numbers of 32 bits.
    F32,
    /// Floating-point numbers of 64 bits.
    F64,
}

/// The format of an array.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawFormat {
    /// Type of the numbers.
    pub number: RawNumber,
    /// Names of the columns.
    pub columns: Vec<String>,
}

impl RawNumber {
    fn bytes(self) -> usize {
        match self {
            Self::I16 => 2,
            Self::I32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Reads a number. Returns `None` if the bytes have another length.
    fn read(self, bytes: &[u8]) -> Option<f64> {
        Some(match self {
            Self::I16 => f64::from(i16::from_le_bytes(bytes.try_into().ok()?)),
            Self::I32 => f64::from(i32::from_le_bytes(bytes.try_into().ok()?)),
            Self::F32 => f64::from(f32::from_le_bytes(bytes.try_into().ok()?)),
            Self::F64 => f64::from_le_bytes(bytes.try_into().ok()?),
        })
    }
}

impl RawFormat {
    /// Reads the samples of one message, one packet per column.
    ///
    /// # Errors
    /// Returns an error if the length is not a multiple of the length of a row.
    pub fn parse(&self, bytes: &[u8]) -> Result<Vec<Packet>, LineFault> {
        let row = self.number.bytes() * self.columns.len();
        if row == 0 || bytes.is_empty() || !bytes.len().is_multiple_of(row) {
            return Err(LineFault::new(
                "message",
                format!("{} bytes", bytes.len()),
                format!("must have a multiple of {row} bytes, the length of a row"),
            ));
        }
        let packet = |(index, column): (usize, &String)| Packet {
            label: column.clone(),
            start_ns: None,
            rate_hz: None,
            values: bytes
                .chunks_exact(self.number.bytes())
                .skip(index)
                .step_by(self.columns.len())
                .filter_map(|number| self.number.read(number))
                .collect(),
            clock_quality: None,
        };
        Ok(self.columns.iter().enumerate().map(packet).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn format() -> RawFormat {
        RawFormat {
            number: RawNumber::I16,
            columns: ["x", "y"].map(str::to_owned).to_vec(),
        }
    }

    #[test]
    fn rows_are_split_into_columns() {
        let packets = format().parse(&[1, 0, 0xFF, 0xFF, 0, 1, 2, 0]).unwrap();
        assert_eq!(packets[0].label, "x");
        assert_eq!(packets[0].values, [1.0, 256.0]);
        assert_eq!(packets[1].values, [-1.0, 2.0]);
    }

    #[test]
    fn incomplete_row_is_rejected() {
        for bytes in [&[][..], &[1, 0, 2]] {
            assert!(format().parse(bytes).is_err());
        }
    }
}
