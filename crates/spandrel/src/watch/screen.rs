//! The terminal as a screen: taken, drawn on, read for keys, and given back whatever happens.

use super::draw::draw;
use super::held_stderr::HeldBack;
use super::view::View;
use crate::error::AppError;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event};
use std::io;
use std::thread::JoinHandle;
use std::time::Duration;

/// Keys that wait; nobody types more between two redraws.
const KEYS_WAITING: usize = 64;
/// How soon the thread that reads keys notices that nobody wants them any more.
const KEY_PATIENCE: Duration = Duration::from_millis(50);

/// A terminal that shows a view until this is dropped.
pub struct Screen {
    keys: Option<flume::Receiver<io::Result<Event>>>,
    reader: Option<JoinHandle<()>>,
    // dropped in this order: the cursor comes back, then the screen of before, then what was held back
    terminal: DefaultTerminal,
    _taken: TakenTerminal,
    _held: HeldBack,
}

/// Gives the terminal back when dropped, also when it was taken in part only.
struct TakenTerminal;

impl Drop for TakenTerminal {
    fn drop(&mut self) {
        // there is nobody left to tell, and nothing else to try
        let _ = ratatui::try_restore();
    }
}

impl Screen {
    /// Takes the terminal.
    ///
    /// # Errors
    /// It is none, or does not let itself be taken.
    pub fn open() -> Result<Self, AppError> {
        let cannot = |what: &str| {
            let what = what.to_owned();
            move |source| AppError::Io { what, source }
        };
        let held = HeldBack::start();
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

    /// Waits for a key, or a change of the size.
    ///
    /// # Errors
    /// The terminal is gone.
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

    /// Draws.
    ///
    /// # Errors
    /// The terminal is gone.
    pub fn draw(&mut self, view: &View) -> Result<(), AppError> {
        // a terminal that is slow, or stopped with Ctrl-S, holds up this thread
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
        // first nobody reads the terminal any more, then it is given back
        self.keys = None;
        if let Some(reader) = self.reader.take() {
            // a reader that panicked has told so itself
            let _ = reader.join();
        }
    }
}

/// Hands over keys until nobody wants them, or the terminal is gone.
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
