//! One record through the cores of the services, in the order and with the numbers of
//! `spandrel estimate`.

use super::RecordsError;
use spandrel_alert::{Alert, Baseline, RecordSummary, ReferenceRule, Watch};
use spandrel_bus::{
    AlertState, EstimateBlock, Event, EventKind, FitVerdict, FrameBlock, Phase, UndecidedBecause,
};
use spandrel_faults::ObservedRelation;
use spandrel_identify::{Identification, IdentificationInput, Output};
use spandrel_ingest::{Alignment, Layout};
use spandrel_sensor::{Clocks, Cutter, NodePlan, Row, open_record, recorded_rows};
use spandrel_structure::Structure;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Number of samples in a block of `spandrel estimate`.
const BLOCK_SAMPLES: u64 = 256;

/// Maximum number of estimates per call of the decision. The state is read after each call, and the
/// cuts do not change any alert.
const DECIDED_AT_ONCE: usize = 10;

/// Time for which the structure counts as moving after its last large sample (s).
const STILL_MOVING_S: f64 = 1.0;

/// A record as read with the structure file.
#[derive(Debug, Clone)]
pub(super) struct Recorded {
    pub(super) name: String,
    pub(super) rows: Vec<Row>,
}

impl Recorded {
    /// Reads a record with the columns, units and rate of the structure file.
    pub(super) fn read(structure: &Structure, path: &Path) -> Result<Self, RecordsError> {
        let name = path
            .file_stem()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default();
        let rows =
            recorded_rows(open_record(structure, path)?, 0).collect::<Result<Vec<_>, _>>()?;
        Ok(Self { name, rows })
    }

    /// Returns the largest absolute value of a channel (SI).
    pub(super) fn peak(&self, channel: usize) -> f64 {
        self.rows
            .iter()
            .filter_map(|row| row.values.get(channel))
            .fold(0.0, |peak, value| peak.max(value.abs()))
    }
}

/// State of the identification and decision after one frame.
#[derive(Debug, Clone)]
pub(super) struct Point {
    /// Time since the first frame (s).
    pub(super) time_s: f64,
    /// Ratios to nominal.
    pub(super) mean: Vec<f64>,
    pub(super) std: Vec<f64>,
    /// Fit verdict, or `None` if nothing judges the fit.
    pub(super) verdict: Option<FitVerdict>,
    /// Whether the motion exceeded the threshold within the last second.
    pub(super) moves: bool,
    /// Whether the noise levels are trained, so that the estimate may be used.
    pub(super) works: bool,
    /// Reason why a rule has not decided on one of its parameters, or `None` if rules have decided
    /// on all of them.
    pub(super) hindrance: Option<Hindrance>,
}

/// Reason why a rule cannot decide on a parameter.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Hindrance {
    /// Reason, or `None` while the reference is being learnt.
    pub(super) because: Option<UndecidedBecause>,
    /// Name of the first parameter without a decision.
    pub(super) parameter: String,
}

impl std::fmt::Display for Hindrance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} of {}",
            self.because.map_or("learning", UndecidedBecause::as_str),
            self.parameter
        )
    }
}

/// Estimates and alerts of one record.
#[derive(Debug, Clone)]
pub(super) struct Course {
    pub(super) points: Vec<Point>,
    /// Each notified change (raised, acknowledged or cleared), with its time since the first frame
    /// (s).
    pub(super) alerts: Vec<(f64, Alert)>,
    /// Number of alerts that are still active at the end.
    pub(super) standing: usize,
    /// Channels that were excluded, in doubt or used again, with the time since the first frame
    /// (s).
    pub(super) sensors: Vec<(f64, EventKind, String)>,
    /// What the sensors have shown.
    pub(super) observed: Vec<Option<ObservedRelation>>,
}

impl Course {
    /// Identifies the rows of a record. The structure moves while an observed channel exceeds
    /// `motion` (SI).
    pub(super) fn run(
        structure: &Structure,
        rows: &[Row],
        baseline: Option<&Baseline>,
        motion: f64,
    ) -> Result<Self, RecordsError> {
        Self::run_without(structure, rows, baseline, motion, None)
    }

    /// Identifies the rows of a record without the channel `left_out`.
    pub(super) fn run_without(
        structure: &Structure,
        rows: &[Row],
        baseline: Option<&Baseline>,
        motion: f64,
        left_out: Option<&str>,
    ) -> Result<Self, RecordsError> {
        let layout = Layout::of(structure)?;
        let nodes = NodePlan::of(structure, Clocks::Right)?;
        let mut alignment = Alignment::new(layout, "ingest".to_owned(), 1);
        let mut cutter = Cutter::new(nodes, 1, BLOCK_SAMPLES);
        let mut chain = Chain::new(structure, baseline, motion)?;
        if let Some(left_out) = left_out {
            chain.identification.leave_out(left_out);
        }
        let (mut samples, mut frames) = (Vec::new(), Vec::new());
        for row in rows {
            cutter.push(row.time_ns, &row.values, &mut samples);
            for (node, block) in samples.drain(..) {
                alignment.handle(
                    spandrel_ingest::AlignmentInput::Samples { node, block },
                    &mut frames,
                );
            }
            frames.drain(..).try_for_each(|block| chain.handle(block))?;
        }
        cutter.end(&mut samples);
        for (node, block) in samples {
            alignment.handle(
                spandrel_ingest::AlignmentInput::Samples { node, block },
                &mut frames,
            );
        }
        frames.drain(..).try_for_each(|block| chain.handle(block))?;
        Ok(chain.finish())
    }

    /// Returns the raised alerts with their times (s).
    pub(super) fn raised(&self) -> impl Iterator<Item = &(f64, Alert)> {
        self.alerts
            .iter()
            .filter(|(_, alert)| alert.state == AlertState::Raised)
    }

    /// Returns the last point, or `None` for an empty record.
    pub(super) fn end(&self) -> Option<&Point> {
        self.points.last()
    }

    /// Returns the last point in motion.
    pub(super) fn last_moving(&self) -> Option<&Point> {
        self.points
            .iter()
            .rev()
            .find(|point| point.moves && point.works)
    }

    /// Returns the shares of the moving points with the verdicts supported, doubtful and
    /// contradicted.
    pub(super) fn verdict_shares(&self) -> [f64; 3] {
        let share = |verdict| self.moving_share(|point| point.verdict == Some(verdict));
        [
            FitVerdict::Supported,
            FitVerdict::Doubtful,
            FitVerdict::Contradicted,
        ]
        .map(share)
    }

    /// Returns the share of the moving points with a decision on every parameter.
    pub(super) fn decided_share(&self) -> f64 {
        self.moving_share(|point| point.hindrance.is_none())
    }

    /// Returns the share of the moving points without a decision, for each hindrance.
    pub(super) fn hindrance_shares(&self) -> BTreeMap<Hindrance, f64> {
        let found: BTreeSet<Hindrance> = self
            .moving()
            .filter_map(|point| point.hindrance.clone())
            .collect();
        let share =
            |one: &Hindrance| self.moving_share(|point| point.hindrance.as_ref() == Some(one));
        found
            .into_iter()
            .map(|one| (share(&one), one))
            .map(|(share, one)| (one, share))
            .collect()
    }

    fn moving(&self) -> impl Iterator<Item = &Point> {
        self.points.iter().filter(|point| point.moves)
    }

    /// Returns the share of the moving points that fulfil a condition, 0 without motion.
    fn moving_share(&self, condition: impl Fn(&Point) -> bool) -> f64 {
        self.moving().filter(|point| condition(point)).count() as f64
            / self.moving().count().max(1) as f64
    }

    /// Returns what `spandrel baseline --skip` learns from this record.
    pub(super) fn summary(&self, skip_s: f64) -> Option<RecordSummary> {
        let learnt = self
            .points
            .iter()
            .filter(|point| point.works && point.time_s >= skip_s);
        RecordSummary::from_estimates(learnt.map(|point| {
            point
                .mean
                .iter()
                .copied()
                .zip(point.std.iter().copied())
                .collect::<Vec<_>>()
        }))
    }
}

/// Identification, decision and the collected results.
struct Chain {
    identification: Identification,
    watch: Watch,
    observed: Vec<usize>,
    motion: f64,
    rate_hz: f64,
    /// Number of frames since the last large sample.
    since_motion: Option<u64>,
    moves: std::collections::VecDeque<bool>,
    start_ns: Option<i64>,
    points: Vec<Point>,
    alerts: Vec<(f64, Alert)>,
    sensors: Vec<(f64, EventKind, String)>,
}

impl Chain {
    fn new(
        structure: &Structure,
        baseline: Option<&Baseline>,
        motion: f64,
    ) -> Result<Self, RecordsError> {
        let mut identification = Identification::new(structure, "identify")?;
        identification.expect_sensors(baseline.map_or(&[], Baseline::sensors));
        Ok(Self {
            identification,
            watch: Watch::new(structure, baseline)?,
            observed: structure.observation_channels().to_vec(),
            motion,
            rate_hz: structure.sampling_rate_hz(),
            since_motion: None,
            moves: std::collections::VecDeque::new(),
            start_ns: None,
            points: Vec::new(),
            alerts: Vec::new(),
            sensors: Vec::new(),
        })
    }

    fn handle(&mut self, block: FrameBlock) -> Result<(), RecordsError> {
        self.start_ns.get_or_insert(block.t0_ns);
        for (_, values) in block.iter() {
            let is_large = self
                .observed
                .iter()
                .any(|channel| values[*channel].abs() > self.motion);
            self.since_motion = if is_large {
                Some(0)
            } else {
                self.since_motion.map(|frames| frames + 1)
            };
            let moves = self
                .since_motion
                .is_some_and(|frames| (frames as f64) < STILL_MOVING_S * self.rate_hz);
            self.moves.push_back(moves);
        }
        let mut outputs = Vec::new();
        self.identification
            .handle(IdentificationInput::Frames(block), &mut outputs);
        for output in outputs {
            match output {
                Output::Estimates(estimates) => {
                    for piece in pieces(&estimates) {
                        self.decide(&piece)?;
                    }
                }
                Output::Event(event) => self.hear(event),
                _ => {}
            }
        }
        Ok(())
    }

    fn hear(&mut self, event: Event) {
        let concerns_sensor = matches!(
            event.kind,
            EventKind::ChannelExcluded | EventKind::ChannelInDoubt | EventKind::ChannelBack
        );
        if concerns_sensor {
            let start_ns = self.start_ns.unwrap_or(event.time_ns);
            let time_s = event.time_ns.saturating_sub(start_ns) as f64 / 1e9;
            self.sensors.push((time_s, event.kind, event.subject));
        }
    }

    fn decide(&mut self, block: &EstimateBlock) -> Result<(), RecordsError> {
        let start_ns = self.start_ns.unwrap_or(block.t0_ns);
        let since_start_s = |time_ns: i64| time_ns.saturating_sub(start_ns) as f64 / 1e9;
        let mut alerts = Vec::new();
        self.watch.handle_block(block, &mut alerts)?;
        let tells = |state| {
            matches!(
                state,
                AlertState::Raised | AlertState::Acknowledged | AlertState::Cleared
            )
        };
        let told = alerts.into_iter().filter(|alert| tells(alert.state));
        self.alerts
            .extend(told.map(|alert| (since_start_s(alert.estimate.time_ns), alert)));
        let hindrance = self.watch.decisions().iter().find_map(hindrance);
        let in_training = || self.watch.decisions().first().map(without_levels);
        let Some(grid) = block.grid() else {
            return Ok(());
        };
        for (number, estimate) in block.iter() {
            let std = |index| estimate.variance(index).unwrap_or(0.0).max(0.0).sqrt();
            let works = estimate.flags.phase == Phase::Working;
            self.points.push(Point {
                time_s: since_start_s(grid.time_ns(number)),
                std: (0..estimate.mean.len()).map(std).collect(),
                mean: estimate.mean.clone(),
                verdict: estimate.flags.fit,
                moves: self.moves.pop_front().unwrap_or(false),
                works,
                hindrance: hindrance
                    .clone()
                    .or_else(|| in_training().filter(|_| !works)),
            });
        }
        Ok(())
    }

    fn finish(self) -> Course {
        let stands = |decision: &&spandrel_alert::Decision| {
            let state = decision.last_alert().map(|alert| alert.state);
            matches!(state, Some(AlertState::Raised | AlertState::Acknowledged))
        };
        let standing = self.watch.decisions().iter().filter(stands).count();
        Course {
            points: self.points,
            alerts: self.alerts,
            standing,
            sensors: self.sensors,
            observed: self.identification.sensor_check().observed(),
        }
    }
}

/// Returns the reason why a rule cannot compare its parameter with the reference.
fn hindrance(decision: &spandrel_alert::Decision) -> Option<Hindrance> {
    let is_learning = match decision.last_alert() {
        Some(alert) => alert.state == AlertState::Learning,
        // A learnt reference is announced from the start. A known reference is compared without an
        // announcement.
        None => matches!(decision.rule().reference(), ReferenceRule::Learnt { .. }),
    };
    let because = decision.undecided_because();
    (is_learning || because.is_some()).then(|| Hindrance {
        because,
        parameter: decision.subject().name.clone(),
    })
}

/// Returns the hindrance of a frame in training, which the decision states only after some time.
fn without_levels(decision: &spandrel_alert::Decision) -> Hindrance {
    Hindrance {
        because: Some(UndecidedBecause::NoiseTraining),
        parameter: decision.subject().name.clone(),
    }
}

/// Cuts a block so that the state of a decision can be read in between.
fn pieces(block: &EstimateBlock) -> impl Iterator<Item = EstimateBlock> + '_ {
    let sequence = block.header.sequence;
    block
        .estimates
        .chunks(DECIDED_AT_ONCE)
        .enumerate()
        .map(move |(piece, estimates)| {
            let mut header = block.header.clone();
            header.sequence = sequence + (piece * DECIDED_AT_ONCE) as u64;
            if let Some(grid) = block.grid() {
                header.time_ns = grid.time_ns(header.sequence);
            }
            EstimateBlock {
                header,
                estimates: estimates.to_vec(),
                ..without_estimates(block)
            }
        })
}

fn without_estimates(block: &EstimateBlock) -> EstimateBlock {
    EstimateBlock {
        header: block.header.clone(),
        term: block.term,
        t0_ns: block.t0_ns,
        sampling_rate_hz: block.sampling_rate_hz,
        parameters: block.parameters,
        noise_parameters: block.noise_parameters,
        channels: block.channels,
        estimates: Vec::new(),
        state: block.state,
    }
}
