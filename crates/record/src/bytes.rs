//! A cursor over the bytes of a file. Missing bytes are a fault and never cause a panic.

use crate::fault::Fault;

/// The byte order of numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ByteOrder {
    Little,
    Big,
}

/// A position in a byte slice, with the byte order of numbers.
#[derive(Debug, Clone)]
pub(crate) struct Bytes<'a> {
    data: &'a [u8],
    position: usize,
    pub(crate) order: ByteOrder,
}

macro_rules! numbers {
    ($($name:ident: $number:ty),*) => {$(
        pub(crate) fn $name(&mut self) -> Result<$number, Fault> {
            let bytes = self.array()?;
            Ok(match self.order {
                ByteOrder::Little => <$number>::from_le_bytes(bytes),
                ByteOrder::Big => <$number>::from_be_bytes(bytes),
            })
        }
    )*};
}

impl<'a> Bytes<'a> {
    pub(crate) fn new(data: &'a [u8], order: ByteOrder) -> Self {
        Self {
            data,
            position: 0,
            order,
        }
    }

    /// Returns the number of bytes before the cursor.
    pub(crate) fn position(&self) -> usize {
        self.position
    }

    /// Returns the number of remaining bytes.
    pub(crate) fn left(&self) -> usize {
        self.data.len() - self.position
    }

    pub(crate) fn is_at_end(&self) -> bool {
        self.left() == 0
    }

    /// Returns the next `count` bytes, and advances the cursor past them.
    pub(crate) fn take(&mut self, count: usize) -> Result<&'a [u8], Fault> {
        if count > self.left() {
            let (left, position) = (self.left(), self.position);
            let found = format!("{left} bytes");
            return Err(Fault::at_byte(
                position,
                "remaining data",
                found,
                format!("at least {count}"),
            ));
        }
        let bytes = &self.data[self.position..self.position + count];
        self.position += count;
        Ok(bytes)
    }

    /// Moves the cursor to `position`. The end of the bytes is a valid position.
    pub(crate) fn seek(&mut self, position: usize) -> Result<(), Fault> {
        if position > self.data.len() {
            let found = format!("byte {position}");
            return Err(Fault::at_byte(
                self.position,
                "next position",
                found,
                format!("at most {}", self.data.len()),
            ));
        }
        self.position = position;
        Ok(())
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    numbers! { u8: u8, u16: u16, u32: u32, u64: u64, i16: i16, i32: i32, i64: i64, f32: f32, f64: f64 }
}

/// Decodes text as UTF-8, or as Latin-1 if it is not valid UTF-8, and removes padding.
pub(crate) fn text(bytes: &[u8]) -> String {
    let padding = |symbol: char| symbol.is_whitespace() || symbol == '\0';
    match std::str::from_utf8(bytes) {
        Ok(text) => text.trim_matches(padding).to_owned(),
        Err(_) => bytes
            .iter()
            .map(|byte| char::from(*byte))
            .collect::<String>()
            .trim_matches(padding)
            .to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_requested_byte_order() {
        let mut bytes = Bytes::new(&[0, 1, 0, 1], ByteOrder::Big);
        assert_eq!(bytes.u16().unwrap(), 1);
        bytes.order = ByteOrder::Little;
        assert_eq!(bytes.u16().unwrap(), 256);
    }

    #[test]
    fn error_names_the_position_of_missing_bytes() {
        let mut bytes = Bytes::new(&[0, 1, 2], ByteOrder::Big);
        bytes.u16().unwrap();
        let fault = bytes.u32().unwrap_err();
        assert_eq!(
            fault.to_string(),
            "byte 2: remaining data is 1 bytes, must be at least 4"
        );
        assert!(bytes.seek(4).is_err());
    }

    #[test]
    fn text_without_utf_8_is_latin_1() {
        assert_eq!(text(b" m/s\xb2 \0"), "m/s²");
    }
}
