//! Decides which changes of the state of the database are reported to users.

use crate::database::CorruptFile;
use crate::error::HistoryError;
use tracing::warn;

/// A change of the state of the database.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum News {
    /// The database cannot be used. The reason is in words.
    Unavailable(String),
    /// The database can be used again.
    Back,
    /// The file was corrupt. It has a new name, and a new file replaces it.
    SetAside(CorruptFile),
}

/// Decides which changes cause an event and a line in the log.
#[derive(Debug, Default)]
pub(crate) struct Trouble {
    /// Number of failures since the last success.
    consecutive: u64,
    failures: u64,
    files_set_aside: u64,
    news: Vec<News>,
}

impl Trouble {
    /// Notes a failure.
    pub(crate) fn failed(&mut self, error: &HistoryError, rows_waiting: usize) {
        self.failures += 1;
        self.consecutive += 1;
        let reason = error.reason();
        if self.consecutive == 1 {
            let colon = if reason.is_empty() { "" } else { ": " };
            self.news
                .push(News::Unavailable(format!("{error}{colon}{reason}")));
        }
        if self.consecutive.is_power_of_two() {
            warn!(%error, reason, rows_waiting, "history write failed; retrying");
        }
    }

    /// Notes a success.
    pub(crate) fn succeeded(&mut self) {
        if std::mem::take(&mut self.consecutive) > 0 {
            self.news.push(News::Back);
        }
    }

    /// Notes a file that was set aside.
    pub(crate) fn set_aside(&mut self, file: CorruptFile) {
        self.files_set_aside += 1;
        self.news.push(News::SetAside(file));
    }

    /// Returns the changes since the last call.
    pub(crate) fn take_news(&mut self) -> Vec<News> {
        std::mem::take(&mut self.news)
    }

    /// Returns the counters for a status message.
    pub(crate) fn drops(&self) -> [(&'static str, u64); 2] {
        [
            ("failed-writes", self.failures),
            ("files-set-aside", self.files_set_aside),
        ]
    }
}
