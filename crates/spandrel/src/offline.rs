//! The cores of the services in sequence, without a bus. Their results are bit-identical to those
//! of the services.

use crate::error::AppError;
use crate::summary::{Collector, Samples};
use spandrel_alert::{Baseline, Watch};
use spandrel_bus::EstimateBlock;
use spandrel_identify::{Estimator, Identification, IdentificationInput, Output};
use spandrel_ingest::{Alignment, IngestError, Layout};
use spandrel_record::RecordError;
use spandrel_sensor::{Clocks, Cutter, NodePlan, Row, SensorError};
use spandrel_structure::Structure;

/// Number of samples per block. Blocks are long enough to be cheap and short enough for the cache.
const BLOCK_SAMPLES: u64 = 256;

/// Name that the alignment uses for a missing sample in a frame.
const MISSING: &str = "missing-samples";

/// Identifies the rows of a record and decides on alerts.
///
/// `take` receives the estimates in order, each block with the responses of its frames. There are
/// none if the structure file specifies none. Returns the collected results.
///
/// # Errors
/// Returns an error if the structure cannot be identified, the record cannot be read, or `take`
/// fails.
pub fn identify(
    structure: &Structure,
    mut identification: Identification,
    rows: impl Iterator<Item = Result<Row, RecordError>>,
    baseline: Option<&Baseline>,
    mut take: impl FnMut(&EstimateBlock, &[Vec<(f64, f64)>]) -> Result<(), AppError>,
) -> Result<Collector, AppError> {
    let layout = Layout::of(structure).map_err(|source| IngestError::Layout {
        structure: structure.name().to_owned(),
        source,
    })?;
    let nodes = NodePlan::of(structure, Clocks::Right).map_err(SensorError::from)?;
    identification.expect_sensors(baseline.map_or(&[], Baseline::sensors));
    let mut chain = Chain {
        alignment: Alignment::new(layout, "ingest".to_owned(), 1),
        collector: Collector::new(structure).with_baseline(baseline),
        identification,
        watch: Watch::new(structure, baseline)?,
        channels: structure
            .channels()
            .map(|channel| channel.name().to_owned())
            .collect(),
        samples: Samples::default(),
        frames: Vec::new(),
        outputs: Vec::new(),
        alerts: Vec::new(),
        start_ns: None,
        last_ns: 0,
    };
    let mut cutter = Cutter::new(nodes, 1, BLOCK_SAMPLES);
    let mut samples = Vec::new();
    for row in rows {
        let row = row?;
        cutter.push(row.time_ns, &row.values, &mut samples);
        for (node, block) in samples.drain(..) {
            chain.handle(node, block, &mut take)?;
        }
    }
    cutter.end(&mut samples);
    for (node, block) in samples {
        chain.handle(node, block, &mut take)?;
    }
    chain.samples.discarded = chain.alignment.counts().drops();
    chain.samples.discarded.remove(MISSING); // counted by channel
    if chain.samples != Samples::default() {
        chain.collector.take_samples(chain.samples);
    }
    if let Some(display) = chain.identification.class_display(chain.last_ns) {
        chain.collector.take_classes(&display);
    }
    if let Estimator::Particles(particles) = chain.identification.estimator() {
        chain
            .collector
            .take_effective_share(particles.effective_share());
    }
    chain.collector.take_decided(&chain.watch);
    let check = chain.identification.sensor_check();
    chain
        .collector
        .take_sensors(check.observed(), check.suspected().collect());
    Ok(chain.collector)
}

struct Chain {
    alignment: Alignment,
    identification: Identification,
    watch: Watch,
    collector: Collector,
    channels: Vec<String>,
    samples: Samples,
    frames: Vec<spandrel_bus::FrameBlock>,
    outputs: Vec<Output>,
    alerts: Vec<spandrel_alert::Alert>,
    /// Time of the first frame.
    start_ns: Option<i64>,
    /// Time of the last frame.
    last_ns: i64,
}

impl Chain {
    fn handle(
        &mut self,
        node: usize,
        block: spandrel_bus::SampleBlock,
        take: &mut impl FnMut(&EstimateBlock, &[Vec<(f64, f64)>]) -> Result<(), AppError>,
    ) -> Result<(), AppError> {
        self.alignment.handle(
            spandrel_ingest::AlignmentInput::Samples { node, block },
            &mut self.frames,
        );
        for frames in self.frames.drain(..) {
            self.samples.take_frames(&self.channels, &frames);
            self.start_ns.get_or_insert(frames.t0_ns);
            if let (Some(grid), Some((last, _))) = (frames.grid(), frames.iter().last()) {
                self.last_ns = grid.time_ns(last);
            }
            self.identification
                .handle(IdentificationInput::Frames(frames), &mut self.outputs);
        }
        let mut responses = Vec::new();
        for output in self.outputs.drain(..) {
            match output {
                Output::Responses(of_block) => responses = of_block,
                Output::Estimates(estimates) => {
                    self.watch.handle_block(&estimates, &mut self.alerts)?;
                    self.collector.take_estimates(&estimates);
                    let suspected = self.identification.sensor_check().suspected();
                    self.collector
                        .take_suspected(suspected, estimates.estimates.len());
                    take(&estimates, &std::mem::take(&mut responses))?;
                }
                Output::Event(event) => spandrel_service::log_event(&event, self.start_ns),
                Output::Classes(display) => self.collector.take_classes(&display),
                // only for display on a bus
                Output::Parameter(_)
                | Output::Noise(_)
                | Output::Outliers(_)
                | Output::SensorHealth(_)
                | Output::Fit(_) => {}
            }
        }
        for alert in self.alerts.drain(..) {
            self.collector.take_alert(&alert);
        }
        Ok(())
    }
}
