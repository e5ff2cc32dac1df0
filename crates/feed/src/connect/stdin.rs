//! Lines from standard input.

use std::io::Read;

use crate::connect::Outlet;
use crate::connect::lines::parse_all;
use crate::core_input::{FeedInput, Link};
use crate::lines::{LineFormat, LineSplitter};

/// Size of a read in bytes.
const READ_BYTES: usize = 64 << 10;

/// Reads until standard input ends.
///
/// A read of standard input cannot be cancelled. It therefore has its own thread, which does not
/// delay the end of the process.
pub(crate) async fn read(format: LineFormat, outlet: Outlet) {
    let (source, of_thread) = (outlet.source(), outlet.clone());
    let thread = std::thread::Builder::new().name("stdin".to_owned());
    let spawned = thread.spawn(move || {
        let link = |link: Link| FeedInput::Link { source, link };
        of_thread.put_blocking(link(Link::Open));
        let mut splitter = LineSplitter::default();
        let mut bytes = vec![0; READ_BYTES];
        let mut input = std::io::stdin().lock();
        loop {
            let read = match input.read(&mut bytes) {
                Ok(read) => read,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(error) => {
                    let why = format!("cannot read standard input: {error}");
                    of_thread.put_blocking(link(Link::Failed { why }));
                    return;
                }
            };
            let mut lines = Vec::new();
            match bytes.get(..read) {
                Some(arrived) if !arrived.is_empty() => splitter.push(arrived, &mut lines),
                _ => lines.extend(splitter.end()),
            }
            let (packets, faults) = parse_all(&format, lines);
            for fault in faults {
                of_thread.put_blocking(FeedInput::Malformed { source, fault });
            }
            let passed = packets.is_empty()
                || of_thread.put_blocking(FeedInput::Packets { source, packets });
            if !passed {
                return;
            }
            if read == 0 {
                of_thread.put_blocking(link(Link::Ended));
                return;
            }
        }
    });
    if let Err(error) = spawned {
        outlet
            .failed(format!("cannot start a thread for standard input: {error}"))
            .await;
    }
}
