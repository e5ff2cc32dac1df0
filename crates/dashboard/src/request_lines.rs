//! Checks that each line of a request head ends with CR LF.
//!
//! The HTTP library also accepts a bare LF, as RFC 9112 permits (section 2.2). A proxy in front of
//! the page may read such a head in another way, and then one of the two mistakes a part of a
//! request for another request. This module turns a bare LF into a byte that no head may contain,
//! so that the library rejects the request.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// Replaces a bare LF. No head may contain it.
const INVALID: u8 = 0;
/// Number of bytes of a line that are read: longer than each header that matters here.
const LINE_START: usize = 64;

/// The place in a sequence of requests.
#[derive(Debug)]
enum Within {
    /// A head.
    Head,
    /// A body, of which this number of bytes is missing.
    Body(u64),
    /// Bytes that have no known end: chunks, or another protocol.
    Unchecked,
}

/// Reads a sequence of requests, and marks each bare LF of a head.
#[derive(Debug)]
pub(crate) struct RequestLines {
    within: Within,
    line: Vec<u8>,
    is_after_cr: bool,
    /// Whether the request line of the current head is complete.
    has_begun: bool,
    body: u64,
    has_no_known_end: bool,
}

impl Default for RequestLines {
    fn default() -> Self {
        Self {
            within: Within::Head,
            line: Vec::with_capacity(LINE_START),
            is_after_cr: false,
            has_begun: false,
            body: 0,
            has_no_known_end: false,
        }
    }
}

impl RequestLines {
    /// Reads the next bytes. Returns `true` if it has replaced a bare LF.
    pub(crate) fn read(&mut self, bytes: &mut [u8]) -> bool {
        let mut rest = bytes;
        while let Some((byte, after)) = rest.split_first_mut() {
            match &mut self.within {
                Within::Unchecked => return false,
                Within::Body(left) => {
                    // Both lengths fit, because one of them is that of a slice.
                    let skipped = (*left).min(1 + after.len() as u64);
                    *left -= skipped;
                    if *left == 0 {
                        self.within = Within::Head;
                    }
                    rest = &mut after[skipped as usize - 1..];
                    continue;
                }
                Within::Head => {}
            }
            if *byte == b'\n' && !self.is_after_cr {
                *byte = INVALID;
                self.within = Within::Unchecked;
                return true;
            }
            self.is_after_cr = *byte == b'\r';
            match *byte {
                b'\n' => self.end_line(),
                b'\r' => {}
                other if self.line.len() < LINE_START => self.line.push(other),
                _ => {}
            }
            rest = after;
        }
        false
    }

    /// Returns `true` if the rest of the connection is not checked.
    fn is_unchecked(&self) -> bool {
        matches!(self.within, Within::Unchecked)
    }

    fn end_line(&mut self) {
        let line = std::mem::take(&mut self.line);
        if !line.is_empty() {
            if std::mem::replace(&mut self.has_begun, true) {
                self.take_header(&line);
            }
        } else if self.has_begun {
            self.within = match (self.has_no_known_end, self.body) {
                (true, _) => Within::Unchecked,
                (false, 0) => Within::Head,
                (false, body) => Within::Body(body),
            };
            (self.has_begun, self.body) = (false, 0);
        }
    }

    fn take_header(&mut self, line: &[u8]) {
        let Some((name, value)) = str::from_utf8(line)
            .ok()
            .and_then(|line| line.split_once(':'))
        else {
            return;
        };
        if name.eq_ignore_ascii_case("content-length") {
            // The library rejects a length that is not a number.
            self.body = value.trim().parse().unwrap_or(0);
        }
        self.has_no_known_end |= ["transfer-encoding", "upgrade"]
            .iter()
            .any(|known| name.eq_ignore_ascii_case(known));
    }
}

/// What has been found out about the requests of a connection.
#[derive(Clone, Debug, Default)]
pub(crate) struct Findings(Arc<(AtomicBool, AtomicBool)>);

impl Findings {
    /// Returns `true` if the connection must end after the current request, because later requests
    /// would not be checked.
    pub(crate) fn must_end(&self) -> bool {
        self.0.0.load(Ordering::Relaxed)
    }

    /// Returns `true` if a head had a line that does not end with CR LF.
    pub(crate) fn has_bare_line_feed(&self) -> bool {
        self.0.1.load(Ordering::Relaxed)
    }
}

/// A connection whose requests are checked by [`RequestLines`].
#[derive(Debug)]
pub(crate) struct Checked<S> {
    stream: S,
    lines: RequestLines,
    findings: Findings,
}

impl<S> Checked<S> {
    pub(crate) fn new(stream: S) -> (Self, Findings) {
        let findings = Findings::default();
        let checked = Self {
            stream,
            lines: RequestLines::default(),
            findings: findings.clone(),
        };
        (checked, findings)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Checked<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if matches!(read, Poll::Ready(Ok(()))) {
            if self.lines.read(&mut buffer.filled_mut()[before..]) {
                self.findings.0.1.store(true, Ordering::Relaxed);
            }
            if self.lines.is_unchecked() {
                self.findings.0.0.store(true, Ordering::Relaxed);
            }
        }
        read
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Checked<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffers: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, buffers)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns whether each way to cut the text into two reads finds a bare LF, and the result.
    fn read(text: &str) -> (bool, Vec<u8>) {
        let cut_at = |cut: usize| {
            let (mut lines, mut bytes) = (RequestLines::default(), text.as_bytes().to_vec());
            let found = lines.read(&mut bytes[..cut]);
            (lines.read(&mut bytes[cut..]) || found, bytes)
        };
        let whole = cut_at(0);
        for cut in 1..=text.len() {
            assert_eq!(cut_at(cut), whole, "{text:?} cut at {cut}");
        }
        whole
    }

    #[test]
    fn a_bare_line_feed_in_a_head_is_made_invalid() {
        for text in [
            "GET / HTTP/1.1\nHost: a\r\n\r\n",
            "GET / HTTP/1.1\r\nHost: a\n\r\n",
            "GET / HTTP/1.1\r\nHost: a\r\n\n",
            "\nGET / HTTP/1.1\r\nHost: a\r\n\r\n",
            "GET / HTTP/1.1\r\n\r\nGET / HTTP/1.1\n",
            "POST / HTTP/1.1\r\nContent-Length: 2\r\n\r\n{}GET / HTTP/1.1\n",
        ] {
            let (found, bytes) = read(text);
            assert!(found && bytes.contains(&INVALID), "{text:?}");
        }
    }

    #[test]
    fn a_head_with_proper_lines_and_any_body_stay_as_they_are() {
        for text in [
            "\r\nGET / HTTP/1.1\r\nHost: a\r\n\r\nGET / HTTP/1.1\r\nHost: a\r\n\r\n",
            "POST / HTTP/1.1\r\ncontent-length:  5 \r\n\r\n{\n\n\n}GET / HTTP/1.1\r\n\
             Host: a\r\n\r\n",
            "POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n\n\r\n0\r\n\r\n",
            "GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n\n\u{81}\n",
        ] {
            let (found, bytes) = read(text);
            assert!(!found && bytes == text.as_bytes(), "{text:?}");
        }
    }
}
