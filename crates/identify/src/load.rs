//! How the identification keeps up with ingest, and what it leaves out where it does not.

use spandrel_bus::{Load, Pace};

/// Frames on the way on purpose where a source waits for identification: the window of a replay. Live samples wait for nobody.
const WINDOW: u64 = 4_096;
/// Frames behind, beyond those on purpose, from which values for people are put less often.
const SHED: u64 = 1_024;
/// Frames behind, beyond those on purpose, from which all is as ever again.
const RESUME: u64 = 256;
/// Frames behind from which they are read from the recording of ingest: it keeps no more in memory.
const BEHIND: u64 = 8_192;

/// The load of one identification: it goes through its states one at a time, so that each is told.
#[derive(Debug)]
pub(crate) struct LoadState {
    load: Load,
    behind: Option<u64>,
    /// most frames behind since it fell behind
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

    /// Frames behind, where that is known.
    pub(crate) fn behind(&self) -> Option<u64> {
        self.behind
    }

    /// Takes how many frames wait for identification, of a source of this pace where that is known; returns whether the state has
    /// changed.
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
            // A quarter: what comes and goes with the blocks is no trend.
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

    /// The states told while so many frames wait, one after the other.
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
    fn each_state_is_told_however_fast_it_comes() {
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
    fn a_source_that_waits_is_no_overload() {
        for pace in [None, Some(Pace::Replayed)] {
            assert_eq!(told(pace, &[0, 4_096, 4_224, 5_120, 4_000]), []);
            assert_eq!(
                told(pace, &[5_121, 4_353, 4_352]),
                [Load::DisplayShed, Load::Normal]
            );
        }
    }

    #[test]
    fn what_is_shed_comes_back_only_where_it_has_caught_up() {
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
    fn who_is_overtaken_again_is_behind_again() {
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
