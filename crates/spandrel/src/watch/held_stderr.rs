//! Standard error for the log, buffered while a screen is shown. Log lines would otherwise corrupt
//! the screen.

use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tracing_subscriber::fmt::MakeWriter;

/// Maximum size of the buffer (bytes). If it is full, the oldest lines are dropped, and a message
/// reports this.
const MOST_HELD: usize = 64 * 1024;

/// Buffer for log lines. `None` while standard error is not buffered.
static HELD: Mutex<Option<Held>> = Mutex::new(None);

/// Log lines that wait for the terminal.
#[derive(Debug, Default)]
struct Held {
    bytes: Vec<u8>,
    lost: usize,
}

/// A writer to standard error that buffers its output while a screen is shown.
#[derive(Debug, Clone, Copy, Default)]
pub struct HeldStderr;

impl Write for HeldStderr {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match held().as_mut() {
            Some(held) => held.push(bytes),
            None => io::stderr().write_all(bytes)?,
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

impl MakeWriter<'_> for HeldStderr {
    type Writer = Self;

    fn make_writer(&self) -> Self {
        Self
    }
}

impl Held {
    fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
        if self.bytes.len() > MOST_HELD {
            let surplus = self.bytes.len() - MOST_HELD;
            // Drops whole lines.
            let end = self.bytes[surplus..].iter().position(|byte| *byte == b'\n');
            let gone = end.map_or(self.bytes.len(), |end| surplus + end + 1);
            self.bytes.drain(..gone);
            self.lost += gone;
        }
    }
}

/// Buffers the log until dropped.
#[derive(Debug)]
pub struct BufferedStderr(());

impl BufferedStderr {
    /// Starts buffering if standard error is a terminal. A log that goes to a file continues.
    pub fn start() -> Self {
        if io::stderr().is_terminal() {
            held().get_or_insert_default();
        }
        Self(())
    }
}

impl Drop for BufferedStderr {
    fn drop(&mut self) {
        if let Some(held) = held().take() {
            let mut stderr = io::stderr().lock();
            // If the terminal has closed, no report is possible.
            if held.lost > 0 {
                let _ = writeln!(stderr, "… {} bytes of the log are lost", held.lost);
            }
            let _ = stderr.write_all(&held.bytes);
        }
    }
}

fn held() -> MutexGuard<'static, Option<Held>> {
    // No code that holds this lock panics.
    HELD.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_lines_are_bounded_and_complete() {
        let mut held = Held::default();
        let line = [b"x".repeat(99).as_slice(), b"\n"].concat();
        for _ in 0..1000 {
            held.push(&line);
        }
        assert!(
            held.bytes.len() <= MOST_HELD && held.bytes.len() > MOST_HELD - 2 * line.len(),
            "{}",
            held.bytes.len()
        );
        assert_eq!(
            (held.bytes.len() + held.lost, held.bytes.len() % 100),
            (100_000, 0)
        );
    }
}
