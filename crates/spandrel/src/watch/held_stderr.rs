//! Standard error for the log, held back while the screen is taken: a log line would stand across it.

use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tracing_subscriber::fmt::MakeWriter;

/// Bytes held back at most; of more the first are lost, and that is said.
const MOST_HELD: usize = 64 * 1024;

/// What is held back; `None` while nothing is to be.
static HELD: Mutex<Option<Held>> = Mutex::new(None);

/// Lines that wait for the terminal.
#[derive(Debug, Default)]
struct Held {
    bytes: Vec<u8>,
    lost: usize,
}

/// Writes to standard error, or holds back what is written while a screen is shown.
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
            // whole lines go
            let end = self.bytes[surplus..].iter().position(|byte| *byte == b'\n');
            let gone = end.map_or(self.bytes.len(), |end| surplus + end + 1);
            self.bytes.drain(..gone);
            self.lost += gone;
        }
    }
}

/// Holds back the log until dropped.
#[derive(Debug)]
pub struct HeldBack(());

impl HeldBack {
    /// Starts to hold back what would go to a terminal; a log that goes to a file goes on.
    pub fn start() -> Self {
        if io::stderr().is_terminal() {
            held().get_or_insert_default();
        }
        Self(())
    }
}

impl Drop for HeldBack {
    fn drop(&mut self) {
        if let Some(held) = held().take() {
            let mut stderr = io::stderr().lock();
            // a terminal that is gone cannot be told
            if held.lost > 0 {
                let _ = writeln!(stderr, "… {} bytes of the log are lost", held.lost);
            }
            let _ = stderr.write_all(&held.bytes);
        }
    }
}

fn held() -> MutexGuard<'static, Option<Held>> {
    // nothing that panics runs under this lock
    HELD.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_lines_are_bounded_and_stay_whole() {
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
