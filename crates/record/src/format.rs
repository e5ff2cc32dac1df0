//! The supported formats of recordings, detected by content and then by file name.

use std::path::Path;

use crate::formats::{
    at2, cosmos, csmip, matlab, mcap, mini_seed, smc, tdms, text_lines::text_of, uff58,
};
use crate::table_layout::TableLayout;

/// The format of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Text table with commas, semicolons, tabs or blanks as separators.
    Table,
    /// miniSEED 2 or 3.
    MiniSeed,
    /// COSMOS V0 to V2.
    Cosmos,
    /// CSMIP volume 2.
    Csmip,
    /// MATLAB level 5.
    Matlab,
    /// Universal file, datasets 58 and 58b.
    Uff58,
    /// PEER AT2, VT2 or DT2.
    At2,
    /// USGS SMC.
    Smc,
    /// National Instruments TDMS.
    Tdms,
    /// MCAP.
    Mcap,
    /// One recording, compressed by gzip.
    Gzip,
    /// ZIP archive of recordings.
    Zip,
    /// Folder of recordings.
    Folder,
}

/// All formats, for error messages.
const ALL: [Format; 13] = [
    Format::Table,
    Format::MiniSeed,
    Format::Cosmos,
    Format::Csmip,
    Format::Matlab,
    Format::Uff58,
    Format::At2,
    Format::Smc,
    Format::Tdms,
    Format::Mcap,
    Format::Gzip,
    Format::Zip,
    Format::Folder,
];

/// File name extensions of text tables. Their content is not conclusive.
const TABLE_NAMES: [&str; 5] = ["csv", "tsv", "txt", "dat", "asc"];

impl Format {
    /// Returns the format of a file, based on its first bytes and its name. Returns `None` if the
    /// format is unknown.
    pub fn of(head: &[u8], path: &Path) -> Option<Self> {
        Self::of_content(head).or_else(|| {
            let ending = path.extension()?.to_str()?.to_ascii_lowercase();
            (TABLE_NAMES.contains(&ending.as_str()) && is_text(head)).then_some(Self::Table)
        })
    }

    /// Returns the format that the first bytes of a file prove, or `None` if they prove none.
    pub fn of_content(head: &[u8]) -> Option<Self> {
        let binary = [
            (mcap::is_mcap(head), Self::Mcap),
            (tdms::is_tdms(head), Self::Tdms),
            (matlab::is_matlab(head), Self::Matlab),
            (mini_seed::is_mini_seed(head), Self::MiniSeed),
            (
                head.starts_with(b"PK\x03\x04") || head.starts_with(b"PK\x05\x06"),
                Self::Zip,
            ),
            (head.starts_with(&[0x1f, 0x8b]), Self::Gzip),
        ];
        if let Some((_, format)) = binary.into_iter().find(|(is_format, _)| *is_format) {
            return Some(format);
        }
        let text = text_of(head);
        let in_text = [
            (uff58::is_uff(&text), Self::Uff58),
            (cosmos::is_cosmos(&text), Self::Cosmos),
            (csmip::is_csmip(&text), Self::Csmip),
            (smc::is_smc(&text), Self::Smc),
            (at2::is_at2(&text), Self::At2),
            (is_text(head) && TableLayout::is_table(head), Self::Table),
        ];
        in_text
            .into_iter()
            .find(|(is_format, _)| *is_format)
            .map(|(_, format)| format)
    }

    /// Returns the name of the format.
    pub fn name(self) -> &'static str {
        match self {
            Self::Table => "text table (CSV)",
            Self::MiniSeed => "miniSEED",
            Self::Cosmos => "COSMOS",
            Self::Csmip => "CSMIP volume 2",
            Self::Matlab => "MATLAB level 5",
            Self::Uff58 => "universal file (58)",
            Self::At2 => "PEER AT2",
            Self::Smc => "SMC",
            Self::Tdms => "TDMS",
            Self::Mcap => "MCAP",
            Self::Gzip => "gzip",
            Self::Zip => "zip archive",
            Self::Folder => "folder",
        }
    }

    /// Returns the names of all formats.
    pub(crate) fn names() -> Vec<&'static str> {
        ALL.into_iter().map(Self::name).collect()
    }
}

/// Returns `true` if the bytes are text: they contain no control characters except white space.
fn is_text(head: &[u8]) -> bool {
    !head.is_empty()
        && !head
            .iter()
            .any(|byte| byte.is_ascii_control() && !byte.is_ascii_whitespace())
}

/// Returns the encoding of text in UTF-16 or UTF-32, by its byte order mark or by the zeros between
/// its first two characters. Such text is of no known format.
pub(crate) fn wide_encoding(head: &[u8]) -> Option<&'static str> {
    let is_letters = |a: u8, b: u8| a.is_ascii_graphic() && b.is_ascii_graphic();
    match *head {
        // The mark of UTF-32 begins like that of UTF-16.
        [0xff, 0xfe, 0, 0, ..] => Some("UTF-32 (little-endian)"),
        [0, 0, 0xfe, 0xff, ..] => Some("UTF-32 (big-endian)"),
        [0xff, 0xfe, ..] => Some("UTF-16 (little-endian)"),
        [0xfe, 0xff, ..] => Some("UTF-16 (big-endian)"),
        [a, 0, 0, 0, b, 0, 0, 0, ..] if is_letters(a, b) => Some("UTF-32 (little-endian)"),
        [0, 0, 0, a, 0, 0, 0, b, ..] if is_letters(a, b) => Some("UTF-32 (big-endian)"),
        [a, 0, b, 0, ..] if is_letters(a, b) => Some("UTF-16 (little-endian)"),
        [0, a, 0, b, ..] if is_letters(a, b) => Some("UTF-16 (big-endian)"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utf_16_and_utf_32_are_named_with_and_without_their_mark() {
        let wide = |width: usize, is_little: bool, mark: bool| {
            let text = if mark { "\u{feff}time,a\n" } else { "time,a\n" };
            let number = |letter: char| {
                let bytes = (letter as u32).to_be_bytes()[4 - width..].to_vec();
                match is_little {
                    true => bytes.into_iter().rev().collect(),
                    false => bytes,
                }
            };
            text.chars().flat_map(number).collect::<Vec<u8>>()
        };
        for (width, is_little, expected) in [
            (2, true, "UTF-16 (little-endian)"),
            (2, false, "UTF-16 (big-endian)"),
            (4, true, "UTF-32 (little-endian)"),
            (4, false, "UTF-32 (big-endian)"),
        ] {
            for mark in [true, false] {
                let head = wide(width, is_little, mark);
                assert_eq!(wide_encoding(&head), Some(expected), "mark: {mark}");
                assert_eq!(Format::of(&head, Path::new("a.csv")), None);
            }
        }
        for other in [
            &b"time,a\n"[..],
            b"\x05\0\x09\0",
            b"\x01\0\0\0\x02\0\0\0",
            b"a",
        ] {
            assert_eq!(wide_encoding(other), None);
        }
    }

    #[test]
    fn content_precedes_the_name_in_format_detection() {
        for (head, name, expected) in [
            (&b"TDSm\x0e\0\0\0"[..], "x.csv", Some(Format::Tdms)),
            (b"MS\x03\0", "x.dat", Some(Format::MiniSeed)),
            (b"000001M COLA 00LHZIU", "x", Some(Format::MiniSeed)),
            (b"    -1\n    58\n", "x", Some(Format::Uff58)),
            (b"time,a\n0,1\n", "x", Some(Format::Table)),
            (b"a b\nc d\n", "x", None),
            (b"a b\nc d\n", "x.csv", Some(Format::Table)),
            (b"\x00\x01\x02", "x.csv", None),
            (b"", "x.mseed", None),
            (b"PK\x03\x04", "x.csv", Some(Format::Zip)),
        ] {
            assert_eq!(
                Format::of(head, Path::new(name)),
                expected,
                "{name}: {}",
                head.escape_ascii()
            );
        }
    }
}
