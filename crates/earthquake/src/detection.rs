//! Finds earthquakes in a stream of frames, and selects the frames of the recordings for a report.
//!
//! - The offset of each channel is its mean while nothing shakes, with a memory of 30 s.
//! - Strong motion: within one window ([`window_s`]), two channels differ from their offset by more
//!   than the trigger. With one channel, this channel suffices. Two channels are required because a
//!   spike in one channel is no earthquake.
//! - The recording of an earthquake begins 30 s (or four windows) before the strong motion. It ends
//!   when no motion has been strong for three windows, from 20 to 40 s.
//! - Motion that stays strong, as after a step of a sensor, is recorded up to a limit. Its mean
//!   then becomes the new offset.
//! - Weak motion is recorded again at set times after an earthquake, while there is no strong
//!   motion. Only weak motion can show a lasting loss.
//!
//! Frames have increasing numbers. Missing ones are left out.

use crate::error::{EarthquakeError, require};
use crate::phase::window_s;
use serde::{Deserialize, Serialize};

/// Memory of the offsets (s).
const OFFSET_S: f64 = 30.0;
/// Shortest time before the strong motion that is recorded (s), and the same in windows.
const BEFORE_S: f64 = 30.0;
const BEFORE_WINDOWS: f64 = 4.0;
/// Time without strong motion that ends an earthquake: windows, and limits (s).
///
/// The report has to be ready within a minute after the motion.
const CALM_WINDOWS: f64 = 3.0;
const CALM_S: (f64, f64) = (20.0, 40.0);
/// Length of a later recording of weak motion: windows, and limits (s).
const LATER_WINDOWS: f64 = 20.0;
const LATER_S: (f64, f64) = (120.0, 600.0);
/// Longest recording of an earthquake (s).
const LONGEST_S: f64 = 600.0;
/// Maximum number of later recordings that wait. One recording serves all that are due.
const MOST_DUE: usize = 64;

/// Limits of the motion that counts as an earthquake, and of the recordings.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectionSettings {
    /// Sampling rate (Hz).
    pub rate_hz: f64,
    /// Fundamental frequency of the structure (Hz).
    pub fundamental_hz: f64,
    /// Number of channels.
    pub channels: usize,
    /// Deviation from the offset above which motion is an earthquake (unit of the channels).
    pub trigger: f64,
    /// Deviation above which motion is strong, so that it is judged again later.
    pub strong: f64,
    /// Times after an earthquake at which weak motion is recorded (s).
    pub again_after_s: Vec<f64>,
    /// Maximum number of frames of a recording, which bounds the memory.
    pub most_frames: u64,
}

/// Weak motion that is to be recorded.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Due {
    /// Measurement time of the first frame in the recording of the earthquake (ns since the Unix
    /// epoch).
    pub of_ns: i64,
    /// Time from the end of the recording of the earthquake to this recording of weak motion (s).
    pub after_s: f64,
    /// Earliest measurement time of a frame that the recording can contain (ns since the Unix
    /// epoch). It is `after_s` after the end of the recording of the earthquake.
    pub at_ns: i64,
}

/// Reason why the recording of an earthquake ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// The motion became weak.
    Calm,
    /// The motion is still strong, but the recording has its maximum length.
    Longest,
    /// No more frames of this run arrived.
    Interrupted,
}

/// Reason why frames are recorded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CutKind {
    /// An earthquake.
    Earthquake {
        /// How it ended.
        ending: Ending,
        /// Whether its motion was strong, so that it is judged again later.
        is_strong: bool,
    },
    /// Weak motion after earthquakes.
    Later {
        /// What it was due for.
        due: Vec<Due>,
    },
}

/// Frames that belong into a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Cut {
    /// First frame.
    pub first: u64,
    /// Frame behind the last one.
    pub end: u64,
    /// Reason for the recording.
    pub kind: CutKind,
}

/// What a frame has shown.
#[derive(Debug, Clone, PartialEq)]
pub enum Detected {
    /// An earthquake has begun. Its recording will begin at this frame.
    Began {
        /// First frame of the recording.
        first: u64,
    },
    /// A recording is complete.
    Complete(Cut),
}

/// The offset of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Offset {
    mean: f64,
    samples: u64,
    /// Last frame that differed from the offset by more than the trigger.
    above: Option<u64>,
}

/// What is recorded at present.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum Doing {
    Watching,
    Shaking {
        first: u64,
        last_strong: u64,
        is_strong: bool,
        /// Whether the recording is complete, although the motion continues.
        is_cut: bool,
    },
    Later {
        first: u64,
        end: u64,
        /// Number of recordings that it serves, from the front of those that are due.
        serves: usize,
    },
}

/// The whole state between two frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DetectionState {
    offsets: Vec<Offset>,
    doing: Doing,
    /// First frame that belongs to no recording yet.
    free: u64,
    /// Frame behind the last one.
    next: u64,
    /// What is due, in the order of time.
    due: Vec<Due>,
}

/// Lengths in frames.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lengths {
    window: u64,
    offset: u64,
    before: u64,
    calm: u64,
    later: u64,
    longest: u64,
}

/// Finds earthquakes in the frames of one structure.
#[derive(Debug, Clone)]
pub struct Detection {
    settings: DetectionSettings,
    lengths: Lengths,
    state: DetectionState,
}

impl Detection {
    /// Creates a detection before the first frame.
    ///
    /// # Errors
    /// Returns an error if a setting is out of range.
    pub fn new(settings: DetectionSettings) -> Result<Self, EarthquakeError> {
        for (setting, found) in [
            ("sampling rate", settings.rate_hz),
            ("fundamental frequency", settings.fundamental_hz),
            ("trigger", settings.trigger),
            ("limit of strong motion", settings.strong),
            ("number of channels", settings.channels as f64),
        ] {
            require(found > 0.0 && found.is_finite(), setting, found, "above 0")?;
        }
        let window = window_s(settings.fundamental_hz);
        let frames = |seconds: f64| ((seconds * settings.rate_hz).round() as u64).max(1);
        let most = settings.most_frames.max(1);
        let before = frames(BEFORE_S.max(BEFORE_WINDOWS * window)).min(most / 2);
        let lengths = Lengths {
            window: frames(window),
            offset: frames(OFFSET_S),
            before,
            calm: frames((CALM_WINDOWS * window).clamp(CALM_S.0, CALM_S.1)),
            later: frames((LATER_WINDOWS * window).clamp(LATER_S.0, LATER_S.1)).min(most),
            longest: frames(LONGEST_S).max(2 * before).min(most),
        };
        let state = DetectionState {
            offsets: vec![Offset::default(); settings.channels],
            doing: Doing::Watching,
            free: 0,
            next: 0,
            due: Vec::new(),
        };
        Ok(Self {
            settings,
            lengths,
            state,
        })
    }

    /// Returns the state, for a checkpoint.
    #[must_use]
    pub fn state(&self) -> &DetectionState {
        &self.state
    }

    /// Restores a state. Returns `false` if it belongs to other channels.
    pub fn restore(&mut self, state: DetectionState) -> bool {
        let fits = state.offsets.len() == self.settings.channels;
        if fits {
            self.state = state;
        }
        fits
    }

    /// Returns `true` while nothing is recorded. Only such a state, with the frames from
    /// [`Self::needed_from`] on, suffices for a restart.
    #[must_use]
    pub fn is_watching(&self) -> bool {
        self.state.doing == Doing::Watching
    }

    /// Returns `true` while an earthquake is recorded.
    #[must_use]
    pub fn is_shaking(&self) -> bool {
        matches!(self.state.doing, Doing::Shaking { is_cut: false, .. })
    }

    /// Returns the first frame that a recording may still need.
    #[must_use]
    pub fn needed_from(&self) -> u64 {
        let next = self.state.next.saturating_sub(self.lengths.before);
        match self.state.doing {
            Doing::Shaking { first, .. } if self.is_shaking() => first,
            Doing::Watching | Doing::Shaking { .. } => next.max(self.state.free),
            Doing::Later { first, .. } => next.max(self.state.free).min(first),
        }
    }

    /// Returns the frame behind the last one.
    #[must_use]
    pub fn next(&self) -> u64 {
        self.state.next
    }

    /// Returns the minimum number of frames that a later recording must contain.
    #[must_use]
    pub fn fewest_later(&self) -> u64 {
        self.lengths.later / 2
    }

    /// Returns the scheduled recordings of weak motion, in the order of time.
    #[must_use]
    pub fn due(&self) -> &[Due] {
        &self.state.due
    }

    /// Schedules the later recordings of an earthquake whose recording began and ended at these
    /// times (ns).
    pub fn schedule(&mut self, of_ns: i64, ended_ns: i64) {
        for after_s in &self.settings.again_after_s {
            let at_ns = ended_ns.saturating_add((after_s * 1e9) as i64);
            self.state.due.push(Due {
                of_ns,
                after_s: *after_s,
                at_ns,
            });
        }
        self.state.due.sort_by_key(|due| due.at_ns);
        self.state.due.truncate(MOST_DUE);
    }

    /// Schedules the recordings of weak motion again, because the last one has too few frames.
    pub fn put_back(&mut self, due: Vec<Due>) {
        self.state.due.splice(0..0, due);
        self.state.due.truncate(MOST_DUE);
    }

    /// Restarts with the frames of another run. Scheduled recordings remain.
    pub fn restart(&mut self, found: &mut Vec<Detected>) {
        self.interrupt(found);
        self.state.offsets.fill(Offset::default());
        self.state.doing = Doing::Watching;
        self.state.free = 0;
        self.state.next = 0;
    }

    /// Ends the recording of an earthquake, because no more frames arrive.
    pub fn interrupt(&mut self, found: &mut Vec<Detected>) {
        if let Doing::Shaking {
            first,
            is_strong,
            is_cut: false,
            ..
        } = self.state.doing
        {
            self.complete(
                first,
                self.state.next,
                is_strong,
                Ending::Interrupted,
                found,
            );
        }
        self.state.doing = Doing::Watching;
    }

    /// Takes one frame at a time (ns) with its values, `NaN` where one is missing. Returns the
    /// largest deviation of a channel from its offset.
    pub fn push(
        &mut self,
        frame: u64,
        time_ns: i64,
        values: &[f64],
        found: &mut Vec<Detected>,
    ) -> f64 {
        let is_new = self.state.next == 0;
        self.state.next = frame + 1;
        if is_new {
            self.state.free = self.state.free.max(frame);
        }
        let deviation = self.deviate(frame, values);
        let is_trigger = self.is_trigger(frame);
        match self.state.doing {
            Doing::Watching | Doing::Later { .. } if is_trigger => {
                let first = frame
                    .saturating_sub(self.lengths.before)
                    .max(self.state.free);
                self.state.doing = Doing::Shaking {
                    first,
                    last_strong: frame,
                    is_strong: deviation > self.settings.strong,
                    is_cut: false,
                };
                found.push(Detected::Began { first });
            }
            Doing::Watching => self.begin_later(frame, time_ns),
            Doing::Shaking {
                first,
                last_strong,
                is_strong,
                is_cut,
            } => {
                let last_strong = if is_trigger { frame } else { last_strong };
                let is_strong = is_strong || deviation > self.settings.strong;
                let is_calm = frame - last_strong >= self.lengths.calm;
                let is_longest = frame + 1 - first >= self.lengths.longest;
                if !is_cut && (is_calm || is_longest) {
                    let ending = if is_calm {
                        Ending::Calm
                    } else {
                        Ending::Longest
                    };
                    self.complete(first, frame + 1, is_strong, ending, found);
                }
                self.state.doing = match is_calm {
                    true => Doing::Watching,
                    false => Doing::Shaking {
                        first,
                        last_strong,
                        is_strong,
                        is_cut: is_cut || is_longest,
                    },
                };
            }
            Doing::Later { first, end, serves } if frame + 1 >= end => {
                let due = self.state.due.drain(..serves.min(self.state.due.len()));
                let due = due.collect();
                self.state.free = frame + 1;
                self.state.doing = Doing::Watching;
                found.push(Detected::Complete(Cut {
                    first,
                    end: frame + 1,
                    kind: CutKind::Later { due },
                }));
            }
            Doing::Later { .. } => {}
        }
        deviation
    }

    fn begin_later(&mut self, frame: u64, time_ns: i64) {
        let serves = self.state.due.iter().take_while(|due| due.at_ns <= time_ns);
        let serves = serves.count();
        if serves > 0 {
            self.state.doing = Doing::Later {
                first: frame,
                end: frame + self.lengths.later,
                serves,
            };
        }
    }

    fn complete(
        &mut self,
        first: u64,
        end: u64,
        is_strong: bool,
        ending: Ending,
        found: &mut Vec<Detected>,
    ) {
        self.state.free = end;
        found.push(Detected::Complete(Cut {
            first,
            end,
            kind: CutKind::Earthquake { ending, is_strong },
        }));
    }

    /// Updates the offsets, and returns the largest deviation from them.
    fn deviate(&mut self, frame: u64, values: &[f64]) -> f64 {
        let is_frozen = self.is_shaking();
        let (window, memory, trigger) = (
            self.lengths.window,
            self.lengths.offset,
            self.settings.trigger,
        );
        let mut largest = 0.0_f64;
        for (offset, value) in self.state.offsets.iter_mut().zip(values) {
            if !value.is_finite() {
                continue;
            }
            let deviation = value - offset.mean;
            // Before, the offset is not known well enough.
            if offset.samples >= window {
                largest = largest.max(deviation.abs());
                if deviation.abs() > trigger {
                    offset.above = Some(frame);
                }
            }
            if !is_frozen {
                offset.samples = (offset.samples + 1).min(memory);
                offset.mean += deviation / offset.samples as f64;
            }
        }
        largest
    }

    /// Returns `true` if enough channels have exceeded the trigger within one window.
    fn is_trigger(&self, frame: u64) -> bool {
        let is_above = |offset: &&Offset| {
            let above = offset.above;
            above.is_some_and(|above| frame - above < self.lengths.window)
        };
        let count = self.state.offsets.iter().filter(is_above).count();
        count >= self.settings.channels.min(2)
    }
}

#[cfg(test)]
mod tests;
