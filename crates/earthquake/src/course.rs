//! The history of one stiffness parameter over the windows of a record.
//!
//! Notation: y = ln k, the logarithm of the stiffness as a ratio to nominal, and s its standard
//! deviation. A change Δy is a relative change of stiffness e^Δy − 1.

use crate::between::{EventValue, Pooled};
use crate::phase::{Phase, Window};
use serde::Serialize;

/// The estimate at one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameEstimate {
    /// Stiffness (ratio to nominal, above 0).
    pub mean: f64,
    /// Standard deviation within the record (ratio to nominal).
    pub std: f64,
    /// Whether the frame informs about the parameter.
    pub is_learning: bool,
    /// Whether the data contradict the model.
    pub is_contradicted: bool,
}

/// The stiffness parameter in one window of a record.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CoursePoint {
    /// Start of the window since the first frame (s).
    pub start_s: f64,
    /// End of the window since the first frame (s).
    pub end_s: f64,
    /// Phase of the motion in the window.
    pub phase: Phase,
    /// Amplitude of the response in the window: log10 of its root mean square (unit of the
    /// channels).
    pub amplitude: f64,
    /// Mean of ln(stiffness) over the frames that inform about the parameter (y; stiffness as a
    /// ratio to nominal).
    pub y: f64,
    /// Standard deviation of ln(stiffness) within the record (s).
    pub s: f64,
    /// Whether the data contradict the model in most of the frames that inform about the parameter.
    pub is_contradicted: bool,
}

/// Returns one point for each window in which at least half of the frames inform about the
/// parameter.
///
/// `estimates` has one element per frame.
#[must_use]
pub fn course(windows: &[Window], estimates: &[FrameEstimate]) -> Vec<CoursePoint> {
    windows
        .iter()
        .filter_map(|window| {
            let frames = estimates.get(window.first..window.end.min(estimates.len()))?;
            let learning: Vec<&FrameEstimate> = frames
                .iter()
                .filter(|frame| frame.is_learning && frame.mean > 0.0)
                .collect();
            if learning.is_empty() || 2 * learning.len() < window.end - window.first {
                return None;
            }
            let count = learning.len() as f64;
            let y = learning.iter().map(|frame| frame.mean.ln()).sum::<f64>() / count;
            let relative = |frame: &&FrameEstimate| (frame.std / frame.mean).powi(2);
            let variance = learning.iter().map(relative).sum::<f64>() / count;
            let contradicted = learning.iter().filter(|frame| frame.is_contradicted);
            Some(CoursePoint {
                start_s: window.start_s,
                end_s: window.end_s,
                phase: window.phase,
                amplitude: window.rms.log10(),
                y,
                s: variance.sqrt(),
                is_contradicted: 2 * contradicted.count() > learning.len(),
            })
        })
        .collect()
}

/// The lasting stiffness that the weak motion of a record shows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WeakMotion {
    /// Mean of ln(stiffness) over the windows of weak motion (y; stiffness as a ratio to nominal).
    pub y: f64,
    /// Standard deviation of the mean of ln(stiffness) within the record (s).
    pub s: f64,
    /// Number of windows of weak motion.
    pub windows: usize,
}

/// What neighbouring windows have in common.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Memory {
    /// A filter remembers earlier windows.
    Shared,
    /// Each window is estimated on its own.
    Separate,
}

/// Number of windows at the end of a record that show the regained stiffness.
const LAST_WINDOWS: usize = 4;

/// The history of one stiffness parameter over the record of one event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventCourse {
    #[serde(skip)]
    pub(crate) memory: Memory,
    /// All windows that inform about the parameter, in order of time.
    pub points: Vec<CoursePoint>,
    /// Whether the record contains shaking, even if no window of it informs about the parameter.
    pub has_shaking: bool,
    /// Weak motion before the shaking. `None` without shaking.
    pub before: Option<WeakMotion>,
    /// Weak motion after the shaking, or of the whole record without shaking.
    pub after: Option<WeakMotion>,
}

impl EventCourse {
    /// Summarises the history of a parameter over a record.
    ///
    /// Windows in which the data contradict the model say nothing about lasting stiffness.
    #[must_use]
    pub fn new(windows: &[Window], estimates: &[FrameEstimate]) -> Self {
        Self::of(windows, course(windows, estimates), Memory::Shared)
    }

    /// Summarises points of a fit that treats each window on its own.
    #[must_use]
    pub fn of_separate_windows(windows: &[Window], points: Vec<CoursePoint>) -> Self {
        Self::of(windows, points, Memory::Separate)
    }

    fn of(windows: &[Window], points: Vec<CoursePoint>, memory: Memory) -> Self {
        let shaking = |window: &&Window| window.phase == Phase::Shaking;
        let from_s = windows.iter().find(shaking).map(|window| window.start_s);
        let of = |is_after: bool| {
            let weak: Vec<&CoursePoint> = points
                .iter()
                .filter(|point| point.phase.is_weak() && !point.is_contradicted)
                .filter(|point| (point.start_s >= from_s.unwrap_or(0.0)) == is_after)
                .collect();
            weak_motion(&weak, memory)
        };
        Self {
            memory,
            has_shaking: from_s.is_some(),
            before: of(false),
            after: of(true),
            points,
        }
    }

    /// Returns all weak motion of the record.
    #[must_use]
    pub fn weak(&self) -> Option<WeakMotion> {
        let weak = |point: &&CoursePoint| point.phase.is_weak() && !point.is_contradicted;
        let weak: Vec<&CoursePoint> = self.points.iter().filter(weak).collect();
        weak_motion(&weak, self.memory)
    }

    /// Returns the stiffness that the structure had regained at the end of the record, from the
    /// last settling windows.
    #[must_use]
    pub fn regained(&self) -> Option<WeakMotion> {
        let settling =
            |point: &&CoursePoint| point.phase == Phase::Settling && !point.is_contradicted;
        let settling: Vec<&CoursePoint> = self.points.iter().filter(settling).collect();
        let last = settling.len().saturating_sub(LAST_WINDOWS);
        weak_motion(&settling[last..], self.memory)
    }

    /// Returns the softest window of the shaking. Windows in which the data contradict the model
    /// count only if there is no other.
    #[must_use]
    pub fn softest(&self) -> Option<&CoursePoint> {
        let shaking = || {
            self.points
                .iter()
                .filter(|point| matches!(point.phase, Phase::Shaking | Phase::Settling))
        };
        let softest = |points: &mut dyn Iterator<Item = &'_ CoursePoint>| -> Option<f64> {
            points.map(|point| point.y).min_by(f64::total_cmp)
        };
        let reliable = softest(&mut shaking().filter(|point| !point.is_contradicted));
        let y = reliable.or_else(|| softest(&mut shaking()))?;
        shaking().find(|point| {
            point.y.to_bits() == y.to_bits() && (reliable.is_none() || !point.is_contradicted)
        })
    }

    /// Returns the last window that informs about the parameter.
    #[must_use]
    pub fn last(&self) -> Option<&CoursePoint> {
        self.points.last()
    }
}

/// Returns the mean of windows.
///
/// Separate windows are pooled with the scatter between them, like events. The windows of a filter
/// share most of its memory, so their number does not reduce the standard deviation within the
/// record. The scatter between the windows is added to it.
fn weak_motion(points: &[&CoursePoint], memory: Memory) -> Option<WeakMotion> {
    if memory == Memory::Separate {
        let values = points.iter().map(|point| EventValue {
            value: point.y,
            std: point.s,
        });
        let pooled = Pooled::new(&values.collect::<Vec<_>>())?;
        return Some(WeakMotion {
            y: pooled.mean,
            s: pooled.mean_std,
            windows: points.len(),
        });
    }
    if points.is_empty() {
        return None;
    }
    let count = points.len() as f64;
    let y = points.iter().map(|point| point.y).sum::<f64>() / count;
    let within = points.iter().map(|point| point.s.powi(2)).sum::<f64>() / count;
    let scatter = if points.len() > 1 {
        let squares = points.iter().map(|point| (point.y - y).powi(2));
        squares.sum::<f64>() / (count * (count - 1.0))
    } else {
        0.0
    };
    Some(WeakMotion {
        y,
        s: (within + scatter).sqrt(),
        windows: points.len(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn window(index: usize, phase: Phase) -> Window {
        Window {
            first: 10 * index,
            end: 10 * (index + 1),
            start_s: 3.0 * index as f64,
            end_s: 3.0 * (index + 1) as f64,
            rms: 0.1,
            peak: 0.3,
            phase,
        }
    }

    fn frames(windows: &[(f64, bool, bool)]) -> Vec<FrameEstimate> {
        windows
            .iter()
            .flat_map(|(mean, is_learning, is_contradicted)| {
                let frame = FrameEstimate {
                    mean: *mean,
                    std: 0.02 * mean,
                    is_learning: *is_learning,
                    is_contradicted: *is_contradicted,
                };
                [frame; 10]
            })
            .collect()
    }

    #[test]
    fn only_weak_windows_that_teach_and_fit_count_for_lasting_stiffness() {
        use Phase::{Quiet, Settling, Shaking, Weak};
        let phases = [Quiet, Weak, Shaking, Settling, Weak, Weak, Weak, Quiet];
        let windows: Vec<Window> = (0..).zip(phases).map(|(i, p)| window(i, p)).collect();
        let estimates = frames(&[
            (1.0, false, false),
            (1.2, true, false),
            (0.5, true, false),
            (0.7, true, false),
            (1.1, true, false),
            (1.1, true, false),
            (9.0, true, true),
            (7.0, false, false),
        ]);
        let event = EventCourse::new(&windows, &estimates);
        let before = event.before.unwrap();
        assert!((before.y - 1.2_f64.ln()).abs() < 1e-12 && before.windows == 1);
        let after = event.after.unwrap();
        assert!((after.y - 1.1_f64.ln()).abs() < 1e-12 && after.windows == 2);
        assert!((after.s - 0.02).abs() < 1e-12, "{after:?}");
        let softest = event.softest().unwrap();
        assert!((softest.y - 0.5_f64.ln()).abs() < 1e-12 && softest.phase == Shaking);
        assert!((event.weak().unwrap().y - (1.2_f64 * 1.1 * 1.1).ln() / 3.0).abs() < 1e-12);
    }

    #[test]
    fn contradicted_shaking_is_softest_only_without_other_shaking() {
        let windows = [window(0, Phase::Shaking), window(1, Phase::Shaking)];
        let both = EventCourse::new(&windows, &frames(&[(0.3, true, true), (0.6, true, false)]));
        assert!((both.softest().unwrap().y - 0.6_f64.ln()).abs() < 1e-12);
        let only = EventCourse::new(&windows, &frames(&[(0.3, true, true), (0.6, false, false)]));
        assert!(only.softest().unwrap().is_contradicted);
    }

    #[test]
    fn record_without_shaking_is_weak_motion_after() {
        let windows = [window(0, Phase::Weak), window(1, Phase::Weak)];
        let event = EventCourse::new(&windows, &frames(&[(1.0, true, false), (1.2, true, false)]));
        assert!(event.before.is_none() && !event.has_shaking);
        let weak = event.after.unwrap();
        // Half of the difference is the scatter of the mean of two.
        let scatter = 0.5 * 1.2_f64.ln();
        assert!(
            (weak.s - f64::hypot(0.02, scatter)).abs() < 1e-12,
            "{weak:?}"
        );
    }
}
