//! Decodes the text of a file, and names its encoding if it is not UTF-8.

use std::fmt;

/// A text in another encoding than UTF-8: its position, the encoding found, and the encoding
/// allowed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WrongEncoding {
    /// Line of the first wrong byte, counted from 1.
    pub line: usize,
    /// Offset of the first wrong byte, counted from 0.
    pub byte: usize,
    /// The encoding or the byte found.
    pub found: String,
}

impl WrongEncoding {
    /// The encoding allowed.
    pub const ALLOWED: &'static str = "must be UTF-8";
}

impl fmt::Display for WrongEncoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "encoding: {}, {}", self.found, Self::ALLOWED)
    }
}

/// Byte order marks with the name of their encoding. The mark of UTF-32 begins like that of UTF-16.
const MARKS: [(&[u8], &str); 4] = [
    (&[0xff, 0xfe, 0, 0], "UTF-32 (little-endian)"),
    (&[0, 0, 0xfe, 0xff], "UTF-32 (big-endian)"),
    (&[0xff, 0xfe], "UTF-16 (little-endian)"),
    (&[0xfe, 0xff], "UTF-16 (big-endian)"),
];

/// Decodes a text as UTF-8.
///
/// # Errors
/// Returns an error if the text has another encoding. UTF-16 and UTF-32 are named by their byte
/// order mark, or by the zeros between the letters of the first word.
pub fn decode(bytes: Vec<u8>) -> Result<String, WrongEncoding> {
    let marked = MARKS.iter().find(|(mark, _)| bytes.starts_with(mark));
    let named = marked.map(|(_, name)| *name).or(match bytes[..] {
        [letter, 0, next, 0, ..] if letter != 0 && next != 0 => Some("UTF-16 (little-endian)"),
        [0, letter, 0, next, ..] if letter != 0 && next != 0 => Some("UTF-16 (big-endian)"),
        _ => None,
    });
    if let Some(name) = named {
        return Err(WrongEncoding {
            line: 1,
            byte: 0,
            found: format!("is {name}"),
        });
    }
    String::from_utf8(bytes).map_err(|error| {
        let byte = error.utf8_error().valid_up_to();
        let (before, rest) = error.as_bytes().split_at(byte);
        let wrong = rest.first().copied().unwrap_or_default();
        let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
        WrongEncoding {
            line,
            byte,
            found: format!("has byte {wrong:#04x} at offset {byte}, as Latin-1 may have"),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(bytes: &[u8]) -> (usize, String) {
        let wrong = decode(bytes.to_vec()).unwrap_err();
        (wrong.line, wrong.to_string())
    }

    #[test]
    fn utf_16_is_named_with_and_without_its_mark() {
        let text = "[structure]\nname = \"a\"\n";
        let little: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        let big: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
        for (mark, bytes, order) in [
            (&[][..], &little, "little"),
            (&[0xff, 0xfe], &little, "little"),
            (&[], &big, "big"),
            (&[0xfe, 0xff], &big, "big"),
        ] {
            let expected = format!("encoding: is UTF-16 ({order}-endian), must be UTF-8");
            assert_eq!(told(&[mark, bytes].concat()), (1, expected));
        }
        let (_, utf_32) = told(&[0xff, 0xfe, 0, 0, b'a', 0, 0, 0]);
        assert_eq!(utf_32, "encoding: is UTF-32 (little-endian), must be UTF-8");
    }

    #[test]
    fn the_first_byte_that_is_not_utf_8_is_named_with_its_line() {
        let expected = "encoding: has byte 0xe9 at offset 5, as Latin-1 may have, must be UTF-8";
        assert_eq!(told(b"a\nb\nc\xe9d\n"), (3, expected.to_owned()));
    }

    #[test]
    fn utf_8_is_decoded() {
        assert_eq!(decode("µ = 1\n".into()).unwrap(), "µ = 1\n");
        assert_eq!(decode(Vec::new()).unwrap(), "");
    }
}
