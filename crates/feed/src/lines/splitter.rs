//! Splits bytes into lines of bounded length.

/// Maximum length of a line in bytes. A longer line is dropped.
const MAX_LINE_BYTES: usize = 1 << 20;

/// Splits a stream of bytes into lines.
#[derive(Debug, Default)]
pub(crate) struct LineSplitter {
    open: Vec<u8>,
    /// Whether the open line is already too long.
    is_too_long: bool,
}

/// A line, or its replacement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Split {
    /// A line without its end. Invalid UTF-8 is replaced.
    Line(String),
    /// A line that was too long.
    TooLong,
}

impl LineSplitter {
    /// Adds bytes, and appends all lines that they complete to `lines`.
    pub(crate) fn push(&mut self, bytes: &[u8], lines: &mut Vec<Split>) {
        for (index, part) in bytes.split(|byte| *byte == b'\n').enumerate() {
            if index > 0 {
                lines.extend(self.end());
            }
            if self.open.len() + part.len() > MAX_LINE_BYTES {
                self.is_too_long = true;
                self.open.clear();
            }
            if !self.is_too_long {
                self.open.extend_from_slice(part);
            }
        }
    }

    /// Ends the open line, and returns it unless it is empty.
    pub(crate) fn end(&mut self) -> Option<Split> {
        if std::mem::take(&mut self.is_too_long) {
            self.open.clear();
            return Some(Split::TooLong);
        }
        let line = String::from_utf8_lossy(&self.open).into_owned();
        self.open.clear();
        (!line.trim().is_empty()).then_some(Split::Line(line))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(parts: &[&[u8]]) -> Vec<Split> {
        let (mut splitter, mut lines) = (LineSplitter::default(), Vec::new());
        for part in parts {
            splitter.push(part, &mut lines);
        }
        lines.extend(splitter.end());
        lines
    }

    #[test]
    fn lines_do_not_depend_on_how_the_bytes_arrive() {
        let line = |text: &str| Split::Line(text.to_owned());
        let expected = vec![line("a,1\r"), line("b,2"), line("c")];
        assert_eq!(split(&[b"a,1\r\n\nb,2\nc"]), expected);
        assert_eq!(split(&[b"a,", b"1\r", b"\n\n", b"b,2\n", b"c"]), expected);
    }

    #[test]
    fn endless_line_takes_no_more_memory_and_ends_at_its_end() {
        let (mut splitter, mut lines) = (LineSplitter::default(), Vec::new());
        for _ in 0..40 {
            splitter.push(&[b'x'; 1 << 16], &mut lines);
            assert!(splitter.open.capacity() <= 2 * MAX_LINE_BYTES);
        }
        splitter.push(b"\nok\n", &mut lines);
        assert_eq!(lines, [Split::TooLong, Split::Line("ok".to_owned())]);
    }
}
