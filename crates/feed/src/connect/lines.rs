//! Reads lines from a stream of bytes.

use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::time::timeout;

use crate::connect::Outlet;
use crate::lines::{LineFormat, LineSplitter, Split};
use crate::packet::Packet;

/// Size of a read in bytes.
const READ_BYTES: usize = 64 << 10;

/// The end of a stream.
#[derive(Debug)]
pub(crate) enum StreamEnd {
    /// The other side has closed the connection.
    Closed,
    /// No data arrived for so long.
    Silent(Duration),
    /// The stream cannot be read.
    Broken(std::io::Error),
    /// The feed stops.
    Stopped,
}

/// Parses lines. Returns the packets and the faults.
pub(crate) fn parse_all(format: &LineFormat, lines: Vec<Split>) -> (Vec<Packet>, Vec<String>) {
    let (mut packets, mut faults) = (Vec::new(), Vec::new());
    for line in lines {
        match line {
            Split::TooLong => faults.push("line: is too long, must have at most 1 MiB".to_owned()),
            Split::Line(line) => match format.parse(&line) {
                Ok(of_line) => packets.extend(of_line),
                Err(fault) => faults.push(fault.to_string()),
            },
        }
    }
    (packets, faults)
}

/// Passes lines on. Returns `false` if the feed stops.
pub(crate) async fn pass_on(format: &LineFormat, lines: Vec<Split>, outlet: &Outlet) -> bool {
    let (packets, faults) = parse_all(format, lines);
    for fault in faults {
        if !outlet.malformed(fault).await {
            return false;
        }
    }
    outlet.packets(packets).await
}

/// Reads lines until the stream ends, or until nothing arrives for `patience`.
pub(crate) async fn read_stream(
    mut stream: impl AsyncRead + Unpin,
    format: &LineFormat,
    patience: Duration,
    outlet: &Outlet,
) -> StreamEnd {
    let mut splitter = LineSplitter::default();
    let mut bytes = vec![0; READ_BYTES];
    loop {
        let read = match timeout(patience, stream.read(&mut bytes)).await {
            Err(_elapsed) => return StreamEnd::Silent(patience),
            Ok(Err(error)) => return StreamEnd::Broken(error),
            Ok(Ok(read)) => read,
        };
        let mut lines = Vec::new();
        match bytes.get(..read) {
            Some(arrived) if !arrived.is_empty() => splitter.push(arrived, &mut lines),
            _ => lines.extend(splitter.end()),
        }
        if !pass_on(format, lines, outlet).await {
            return StreamEnd::Stopped;
        }
        if read == 0 {
            return StreamEnd::Closed;
        }
    }
}
