//! Detects whether identification keeps up with ingest, and thins display values if it does not.

use spandrel_bus::{Load, Pace};

/// Number of frames in transit by design if a source waits for identification: the window of a
/// replay. Live sources do not wait.
const WINDOW: u64 = 4_096;
/// Number of frames behind, beyond the window, above which display values are thinned.
const SHED: u64 = 1_024;
/// Number of frames behind, beyond the window, at which normal operation resumes.
const RESUME: u64 = 256;
/// Number of frames behind above which they come from the recording of ingest, which keeps no more
/// in memory.
const BEHIND: u64 = 8_192;

/// The load of one identification. It changes by one state at a time, so that each state is
/// published.
#[derive(Debug)]
pub(crate) struct LoadState {
    load: Load,
    behind: Option<u64>,
    /// Maximum number of frames behind since identification fell behind.
    most_behind: u64,
}

impl LoadState {
    pub(crate) fn new() -> Self {
        Self {
            load: Load::Normal,
            behind: None,
            most_behind: 0,
        }
    }

    pub(crate) fn load(&self) -> Load {
        self.load
    }

    /// Returns the number of frames behind, if known.
    pub(crate) fn behind(&self) -> Option<u64> {
        self.behind
    }

    /// Updates the load from the number of waiting frames and the pace of the source, if known.
    /// Returns `true` if the state has changed.
    pub(crate) fn observe(&mut self, behind: u64, pace: Option<Pace>) -> bool {
        let on_purpose = if pace == Some(Pace::Live) { 0 } else { WINDOW };
        let is_over = behind <= on_purpose + RESUME;
        self.behind = Some(behind);
        self.most_behind = self.most_behind.max(behind);
        let before = self.load;
        self.load = match before {
            Load::Normal if behind > on_purpose + SHED => Load::DisplayShed,
            Load::DisplayShed if behind > BEHIND => {
                self.most_behind = behind;
                Load::Behind
            }
            // A quarter, because smaller changes come from the block size and are no trend.
            Load::Behind if behind <= self.most_behind / 4 * 3 => Load::CatchingUp,
            Load::CatchingUp if behind >= self.most_behind => Load::Behind,
            Load::DisplayShed | Load::CatchingUp if is_over => Load::Normal,
            unchanged => unchanged,
        };
        self.load != before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the successive states for these numbers of waiting frames.
    fn told(pace: Option<Pace>, behind: &[u64]) -> Vec<Load> {
        let mut state = LoadState::new();
        let mut told = Vec::new();
        for behind in behind {
            if state.observe(*behind, pace) {
                told.push(state.load());
            }
        }
        told
    }

    #[test]
    fn every_load_state_is_reported_even_at_fast_changes() {
        let all = [
            Load::DisplayShed,
            Load::Behind,
            Load::CatchingUp,
            Load::Normal,
        ];
        assert_eq!(
            told(
                Some(Pace::Live),
                &[0, 20_000, 20_000, 15_001, 15_000, 257, 256, 0]
            ),
            all
        );
        assert_eq!(told(Some(Pace::Live), &[20_000, 20_000, 0, 0]), all);
    }

    #[test]
    fn backlog_of_a_waiting_source_is_no_overload() {
        for pace in [None, Some(Pace::Replayed)] {
            assert_eq!(told(pace, &[0, 4_096, 4_224, 5_120, 4_000]), []);
            assert_eq!(
                told(pace, &[5_121, 4_353, 4_352]),
                [Load::DisplayShed, Load::Normal]
            );
        }
    }

    #[test]
    fn display_returns_only_after_catching_up() {
        assert_eq!(
            told(Some(Pace::Live), &[1_024, 1_025, 300, 1_025, 257]),
            [Load::DisplayShed]
        );
        assert_eq!(
            told(Some(Pace::Live), &[1_025, 256, 300]),
            [Load::DisplayShed, Load::Normal]
        );
    }

    #[test]
    fn growing_backlog_while_catching_up_means_behind_again() {
        let states = told(Some(Pace::Live), &[9_000, 10_000, 7_500, 9_999, 10_000]);
        assert_eq!(
            states,
            [
                Load::DisplayShed,
                Load::Behind,
                Load::CatchingUp,
                Load::Behind
            ]
        );
    }
}
