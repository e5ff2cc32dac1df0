//! One run of the robustness benchmark: simulated samples through the cores of `identify` and
//! `alert`.

use super::building::{Building, SUBSTEPS, Samples};
use super::file::{LEARN_S, STOREYS, Stated};
use crate::error::ValidateError;
use spandrel_alert::{Learning, ParameterEstimate, Reference, Watch, loss_estimate};
use spandrel_bus::{AlertState, FrameBlock, Header, Pace, SampleBlock, StreamState};
use spandrel_identify::{Identification, IdentificationInput, Output};
use spandrel_ingest::{Alignment, AlignmentInput, Layout, LayoutError};
use spandrel_structure::{Node, Structure};
use std::path::Path;

/// Number of frames in a block. The results do not depend on it.
const BLOCK: usize = 100;

/// Results of one run.
#[derive(Debug, Clone, Default)]
pub(super) struct Trial {
    /// Estimates inside their 95 % interval and all examined estimates, of the value and of the
    /// loss.
    pub(super) value_inside: (u64, u64),
    pub(super) loss_inside: (u64, u64),
    /// Storeys (from 0) with a false alarm.
    pub(super) false_alerts: Vec<usize>,
    /// Time from the loss to its alert (s).
    pub(super) delay_s: Option<f64>,
    /// Whether the loss interval contained the truth when the alert was raised, and 5, 20 and 60 s
    /// later.
    pub(super) alert_inside: [Option<bool>; 4],
    /// Number of blocks of estimates with each verdict.
    pub(super) verdicts: [u64; 3],
    /// Number of frames with a decision, and of all frames, summed over the parameters.
    pub(super) decided: (u64, u64),
    /// References learnt from the first estimates, whether the alerts use them or not.
    learnt: [Learning; STOREYS],
}

/// Times after an alert at which its interval is examined (s).
pub(super) const AFTER_ALERT_S: [f64; 4] = [0.0, 5.0, 20.0, 60.0];

/// Identifies `duration_s` of samples of `building` with the file that `stated` describes.
pub(super) fn run(
    building: &Building,
    stated: &Stated,
    duration_s: f64,
    seed: u64,
) -> Result<Trial, ValidateError> {
    let structure = Structure::parse(&stated.text(), Path::new("building.toml"))
        .map_err(|error| ValidateError::Robustness(error.to_string()))?;
    let failed = |error: &dyn std::fmt::Display| ValidateError::Robustness(error.to_string());
    let mut identification =
        Identification::new(&structure, "identify").map_err(|error| failed(&error))?;
    let mut watch = Watch::new(&structure, None).map_err(|error| failed(&error))?;
    let samples = building.measure(duration_s, seed);
    let skipped = usize::from(!stated.ground_measured);
    let (mut outputs, mut alerts) = (Vec::new(), Vec::new());
    let mut trial = Trial::default();
    let mut raised = [None::<f64>; STOREYS];
    let frames = frames(&structure, building, &samples, skipped).map_err(|error| failed(&error))?;
    for frames in frames {
        identification.handle(IdentificationInput::Frames(frames), &mut outputs);
        for output in outputs.drain(..) {
            let Output::Estimates(estimates) = output else {
                continue;
            };
            watch
                .handle_block(&estimates, &mut alerts)
                .map_err(|error| failed(&error))?;
            let Some((index, last)) = estimates.iter().last() else {
                continue;
            };
            let time_s = (index + 1) as f64 / stated.rate_hz;
            let std: Vec<f64> = (0..last.mean.len())
                .map(|j| last.variance(j).unwrap_or(f64::NAN).max(0.0).sqrt())
                .collect();
            trial.look(building, &last.mean, &std, time_s, &raised);
            if let Some(verdict) = identification.estimator().fit().verdict() {
                trial.verdicts[verdict as usize] += 1;
            }
        }
        for alert in alerts.drain(..) {
            let time_s = alert.estimate.time_ns as f64 / 1e9;
            if alert.state == AlertState::Raised
                && alert.parameter < STOREYS
                && raised[alert.parameter].is_none()
            {
                trial.take_raised(building, &alert, time_s);
                raised[alert.parameter] = Some(time_s);
            }
        }
    }
    for frames in watch.decided_shares().values() {
        trial.decided.0 +=
            frames.frames() - frames.undecided().map(|(_, count)| count).sum::<u64>();
        trial.decided.1 += frames.frames();
    }
    Ok(trial)
}

impl Trial {
    /// Returns the share of the time with a verdict: 0 supported, 1 doubtful, 2 contradicted.
    pub(super) fn verdict_share(&self, verdict: usize) -> f64 {
        self.verdicts[verdict] as f64 / self.verdicts.iter().sum::<u64>() as f64
    }

    /// Compares the estimates of one time with the truth.
    fn look(
        &mut self,
        building: &Building,
        mean: &[f64],
        std: &[f64],
        time_s: f64,
        raised: &[Option<f64>],
    ) {
        for storey in 0..STOREYS {
            let loss = building
                .loss
                .filter(|loss| loss.storey == storey && time_s > loss.at_s);
            // While an estimate moves to its new value, the interval in the alert is judged instead
            // of this one.
            let settled = building
                .loss
                .is_none_or(|loss| time_s < loss.at_s || time_s > loss.at_s + 30.0);
            let kept = 1.0 - loss.map_or(0.0, |loss| loss.share);
            if time_s >= LEARN_S && settled {
                self.value_inside.1 += 1;
                self.value_inside.0 += u64::from((mean[storey] - kept).abs() <= 1.96 * std[storey]);
            }
            if time_s <= LEARN_S {
                self.learnt[storey].add(mean[storey], std[storey]);
                continue;
            }
            let learnt = self.learnt[storey].summary();
            let Some(reference) =
                learnt.and_then(|span| Reference::new(span.mean, span.variance().sqrt()).ok())
            else {
                continue;
            };
            let estimate = ParameterEstimate {
                time_ns: 0,
                mean: mean[storey],
                std: std[storey],
            };
            let interval = loss_estimate(&estimate, &reference);
            let inside = (interval.low..=interval.high).contains(&(1.0 - kept));
            if settled {
                self.loss_inside.1 += 1;
                self.loss_inside.0 += u64::from(inside);
            }
            if loss.is_some()
                && let Some(raised_s) = raised[storey]
            {
                for (slot, after_s) in self.alert_inside.iter_mut().zip(AFTER_ALERT_S).skip(1) {
                    if slot.is_none() && time_s >= raised_s + after_s {
                        *slot = Some(inside);
                    }
                }
            }
        }
    }

    fn take_raised(&mut self, building: &Building, alert: &spandrel_alert::Alert, time_s: f64) {
        match building
            .loss
            .filter(|loss| loss.storey == alert.parameter && time_s >= loss.at_s)
        {
            Some(loss) => {
                self.delay_s = Some(time_s - loss.at_s);
                self.alert_inside[0] = alert
                    .loss
                    .map(|interval| (interval.low..=interval.high).contains(&loss.share));
            }
            None => self.false_alerts.push(alert.parameter),
        }
    }
}

/// Returns the frames of a record. The first `skipped` channels are left out.
fn frames(
    structure: &Structure,
    building: &Building,
    samples: &[Samples],
    skipped: usize,
) -> Result<Vec<FrameBlock>, LayoutError> {
    let mut alignment = Alignment::new(Layout::of(structure)?, "ingest".to_owned(), 1);
    let mut frames = Vec::new();
    for (number, rows) in samples.chunks(BLOCK).enumerate() {
        let sequence = (number * BLOCK) as u64;
        for (node, name) in structure.nodes().iter().map(Node::name).enumerate() {
            let channel = node + skipped;
            let instant = building.instants[channel] as f64 / SUBSTEPS as f64;
            let time_s = (sequence as f64 + instant) / building.rate_hz;
            let block = SampleBlock {
                header: Header {
                    source: name.to_owned(),
                    epoch: 1,
                    sequence,
                    time_ns: (time_s * 1e9).round() as i64,
                },
                sampling_rate_hz: building.rate_hz,
                pace: Pace::Replayed,
                channels: 1,
                samples: rows.iter().map(|row| row[channel]).collect(),
                state: StreamState::Running,
                clock_quality: None,
            };
            alignment.handle(AlignmentInput::Samples { node, block }, &mut frames);
        }
    }
    Ok(frames)
}
