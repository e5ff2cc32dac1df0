//! Runs the simulation of a structure file through the cores of the services: samples, alignment,
//! identification.

use super::shares::{Judgement, Shares};
use crate::error::ValidateError;
use crate::run::Run;
use spandrel_bus::{Estimate, EstimateBlock, Phase};
use spandrel_filter::ChannelFit;
use spandrel_identify::{Identification, IdentificationInput, Output};
use spandrel_ingest::{Alignment, Layout};
use spandrel_sensor::{Clocks, Cutter, NodePlan, simulated_rows};
use spandrel_structure::Structure;

/// Rate at which the samples are cut into blocks (Hz). The estimates do not depend on it.
const LOOKS_HZ: f64 = 10.0;

/// Number of frames between two progress reports.
const TOLD: u64 = 1000;

/// Number of half-lives in which an error of an estimate falls to a sixteenth.
const FOLLOWING_HALF_LIVES: f64 = 2.0;

/// Simulates `seconds` of a structure with all simulation settings of its file, and identifies it.
pub(super) fn run(
    structure: &Structure,
    seconds: f64,
    run: &Run<'_>,
) -> Result<Shares, ValidateError> {
    let frames = (seconds * structure.sampling_rate_hz()) as u64;
    let block_samples = ((structure.sampling_rate_hz() / LOOKS_HZ) as u64).max(1);
    let layout = Layout::of(structure).map_err(ValidateError::fit)?;
    let nodes = NodePlan::of(structure, Clocks::AsSimulated).map_err(ValidateError::fit)?;
    let mut alignment = Alignment::new(layout, "ingest".to_owned(), 1);
    let mut cutter = Cutter::new(nodes, 1, block_samples);
    let mut judged = Judged::new(structure)?;
    let (mut samples, mut aligned) = (Vec::new(), Vec::new());
    for (row, frame) in simulated_rows(structure, run.seed, 0, Some(frames)).zip(0u64..) {
        cutter.push(row.time_ns, &row.values, &mut samples);
        for (node, block) in samples.drain(..) {
            alignment.handle(
                spandrel_ingest::AlignmentInput::Samples { node, block },
                &mut aligned,
            );
        }
        aligned
            .drain(..)
            .for_each(|block| judged.take(IdentificationInput::Frames(block)));
        if frame.is_multiple_of(TOLD) && !run.advance(frame as f64 / frames as f64) {
            return Err(ValidateError::Stopped);
        }
    }
    cutter.end(&mut samples);
    for (node, block) in samples {
        alignment.handle(
            spandrel_ingest::AlignmentInput::Samples { node, block },
            &mut aligned,
        );
    }
    aligned
        .drain(..)
        .for_each(|block| judged.take(IdentificationInput::Frames(block)));
    Ok(judged.shares)
}

/// An identification and the shares of its fit verdicts.
struct Judged<'s> {
    structure: &'s Structure,
    identification: Identification,
    /// Scratch space.
    outputs: Vec<Output>,
    /// True parameters of the last frame, and the frame of their last change.
    truth: Vec<f64>,
    changed: Option<u64>,
    following_frames: f64,
    shares: Shares,
}

impl<'s> Judged<'s> {
    fn new(structure: &'s Structure) -> Result<Self, ValidateError> {
        let fading = structure
            .filter_settings()
            .map_err(ValidateError::setting)?
            .fading;
        // This half-life applies to the weight of a residual. Information fades twice as fast.
        let half_life_frames = 2.0 * std::f64::consts::LN_2 * fading.memory_steps();
        Ok(Self {
            structure,
            identification: Identification::new(structure, "identify")
                .map_err(ValidateError::fit)?,
            outputs: Vec::new(),
            truth: structure.true_parameters(0),
            changed: None,
            following_frames: FOLLOWING_HALF_LIVES * half_life_frames,
            shares: Shares::default(),
        })
    }

    fn take(&mut self, input: IdentificationInput) {
        let mut outputs = std::mem::take(&mut self.outputs);
        self.identification.handle(input, &mut outputs);
        let unmeasured = ChannelFit::default();
        let is_measured = self
            .identification
            .estimator()
            .channel_fits()
            .iter()
            .any(|channel| *channel != unmeasured);
        for output in outputs.drain(..) {
            if let Output::Estimates(block) = output {
                self.look(&block, is_measured);
            }
        }
        self.outputs = outputs;
    }

    fn look(&mut self, block: &EstimateBlock, is_measured: bool) {
        for (frame, estimate) in block.iter() {
            let truth = self.structure.true_parameters(frame);
            if truth != self.truth {
                (self.truth, self.changed) = (truth, Some(frame));
            }
            if estimate.flags.phase != Phase::Working {
                continue;
            }
            let follows_a_change = self
                .changed
                .is_some_and(|changed| ((frame - changed) as f64) < self.following_frames);
            self.shares.take(Judgement {
                verdict: estimate.flags.fit,
                reasons: estimate.flags.fit_reasons,
                is_measured,
                follows_a_change,
                held: held(estimate, &self.truth),
            });
        }
    }
}

/// Counts the parameters whose 95 % interval contains the truth, and all parameters.
fn held(estimate: &Estimate, truth: &[f64]) -> (u64, u64) {
    let holds = |(index, (mean, truth)): &(usize, (&f64, &f64))| {
        estimate
            .variance(*index)
            .is_some_and(|variance| (*mean - *truth).powi(2) <= 1.96f64.powi(2) * variance)
    };
    let parameters = estimate.mean.iter().zip(truth).enumerate();
    (parameters.filter(holds).count() as u64, truth.len() as u64)
}
