//! The terminal as a screen with keys. It is always restored, even after an error.

use super::draw::draw;
use super::held_stderr::BufferedStderr;
use super::view::View;
use crate::error::AppError;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event};
use std::io;
use std::thread::JoinHandle;
use std::time::Duration;

/// Queue length for keys, more than anyone types between two redraws.
const KEYS_WAITING: usize = 64;
/// Interval at which the key reader checks whether it must end.
const KEY_PATIENCE: Duration = Duration::from_millis(50);

/// A terminal that shows a view until dropped.
pub struct Screen {
    keys: Option<flume::Receiver<io::Result<Event>>>,
    reader: Option<JoinHandle<()>>,
    // Fields drop in this order: the cursor reappears, then the previous screen, then the buffered
    // log.
    terminal: DefaultTerminal,
    _taken: TakenTerminal,
    _held: BufferedStderr,
}

/// Restores the terminal when dropped, even if it was only partly initialised.
struct TakenTerminal;

impl Drop for TakenTerminal {
    fn drop(&mut self) {
        // An error here can be neither reported nor handled.
        let _ = ratatui::try_restore();
    }
}

impl Screen {
    /// Initialises the terminal.
    ///
    /// # Errors
    /// Returns an error if standard output is not a terminal, or if it cannot be initialised.
    pub fn open() -> Result<Self, AppError> {
        let cannot = |what: &str| {
            let what = what.to_owned();
            move |source| AppError::Io { what, source }
        };
        let held = BufferedStderr::start();
        let taken = TakenTerminal;
        let terminal = ratatui::try_init().map_err(cannot("cannot draw on the terminal"))?;
        let (sender, keys) = flume::bounded(KEYS_WAITING);
        let reader = std::thread::Builder::new()
            .name("keys".to_owned())
            .spawn(move || read_keys(&sender));
        let reader = reader.map_err(cannot("cannot start a thread for the keys"))?;
        Ok(Self {
            keys: Some(keys),
            reader: Some(reader),
            terminal,
            _taken: taken,
            _held: held,
        })
    }

    /// Waits for a key or a change of the window size.
    ///
    /// # Errors
    /// Returns an error if the terminal has failed.
    pub async fn event(&self) -> Result<Event, AppError> {
        let gone = || io::Error::from(io::ErrorKind::BrokenPipe);
        let read = match &self.keys {
            Some(keys) => keys.recv_async().await.unwrap_or_else(|_| Err(gone())),
            None => Err(gone()),
        };
        read.map_err(|source| AppError::Io {
            what: "cannot read keys from the terminal".to_owned(),
            source,
        })
    }

    /// Draws the view.
    ///
    /// # Errors
    /// Returns an error if the terminal has failed.
    pub fn draw(&mut self, view: &View) -> Result<(), AppError> {
        // A slow terminal, or one stopped with Ctrl-S, blocks this thread.
        let drawn =
            tokio::task::block_in_place(|| self.terminal.draw(|frame| draw(view, frame)).map(drop));
        drawn.map_err(|source| AppError::Io {
            what: "cannot draw on the terminal".to_owned(),
            source,
        })
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // Stop reading the terminal before it is restored.
        self.keys = None;
        if let Some(reader) = self.reader.take() {
            // A panicked reader has already printed its message.
            let _ = reader.join();
        }
    }
}

/// Sends keys until the receiver is dropped or the terminal fails.
fn read_keys(keys: &flume::Sender<io::Result<Event>>) {
    while !keys.is_disconnected() {
        let read = match event::poll(KEY_PATIENCE) {
            Ok(false) => continue,
            Ok(true) => event::read(),
            Err(error) => Err(error),
        };
        let is_last = read.is_err();
        if keys.send(read).is_err() || is_last {
            return;
        }
    }
}
