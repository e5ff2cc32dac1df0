//! Identification of a distributed structure without a bus.
//!
//! The nodes and the station exchange their messages in memory. The results are bit-identical to
//! those of the services.

use crate::error::AppError;
use crate::summary::Collector;
use spandrel_alert::{Baseline, Watch};
use spandrel_bus::{EstimateBlock, LocalMessage};
use spandrel_fuse::{Fusion, FusionInput, Output};
use spandrel_identify::{NodeIdentification, NodeInput, NodeOutput};
use spandrel_record::RecordError;
use spandrel_sensor::{Clocks, Cutter, NodePlan, Row, SensorError};
use spandrel_structure::Structure;
use std::collections::VecDeque;

/// Number of samples per block, as from a node at full speed.
const BLOCK_SAMPLES: u64 = 128;

/// Identifies the rows of a record as the nodes and the station of a distributed structure would,
/// and decides on alerts.
///
/// `take` receives the fused estimates in order. Returns the collected results.
///
/// # Errors
/// Returns an error if the nodes cannot identify the structure, the record cannot be read, or
/// `take` fails.
pub fn fuse(
    structure: &Structure,
    rows: impl Iterator<Item = Result<Row, RecordError>>,
    baseline: Option<&Baseline>,
    mut take: impl FnMut(&EstimateBlock, &[Vec<(f64, f64)>]) -> Result<(), AppError>,
) -> Result<Collector, AppError> {
    const EPOCH: u64 = 1;
    let plans = NodePlan::of(structure, Clocks::Right).map_err(SensorError::from)?;
    let workers =
        (0..plans.len()).map(|position| NodeIdentification::new(structure, position, EPOCH));
    let mut network = Network {
        fusion: Fusion::new(structure, "fuse", EPOCH)?,
        workers: workers.collect::<Result<_, _>>()?,
        watch: Watch::new(structure, baseline)?,
        collector: Collector::new(structure).with_baseline(baseline),
        start_ns: None,
        local: VecDeque::new(),
    };
    network.fusion.handle(
        FusionInput::Present(vec![true; plans.len()]),
        &mut Vec::new(),
    );
    let mut cutter = Cutter::new(plans, EPOCH, BLOCK_SAMPLES);
    let mut samples = Vec::new();
    for row in rows {
        let row = row?;
        network.start_ns.get_or_insert(row.time_ns);
        cutter.push(row.time_ns, &row.values, &mut samples);
        for (node, block) in samples.drain(..) {
            network.work(node, NodeInput::Samples(block));
            network.settle(&mut take)?;
        }
    }
    cutter.end(&mut samples);
    for (node, block) in samples {
        network.work(node, NodeInput::Samples(block));
        network.settle(&mut take)?;
    }
    network.collector.take_decided(&network.watch);
    Ok(network.collector)
}

/// The nodes and the station, connected without a bus.
struct Network {
    fusion: Fusion,
    workers: Vec<NodeIdentification>,
    watch: Watch,
    collector: Collector,
    /// Time of the first sample.
    start_ns: Option<i64>,
    /// Messages in transit to the station.
    local: VecDeque<(usize, LocalMessage)>,
}

impl Network {
    fn work(&mut self, node: usize, input: NodeInput) {
        let mut outputs = Vec::new();
        self.workers[node].handle(input, &mut outputs);
        for output in outputs {
            match output {
                NodeOutput::Local(message) => self.local.push_back((node, message)),
                NodeOutput::Event(event) => spandrel_service::log_event(&event, self.start_ns),
                NodeOutput::Frames(_) => {} // nobody displays them
            }
        }
    }

    /// Delivers messages until none are in transit.
    fn settle(
        &mut self,
        take: &mut impl FnMut(&EstimateBlock, &[Vec<(f64, f64)>]) -> Result<(), AppError>,
    ) -> Result<(), AppError> {
        while let Some((node, message)) = self.local.pop_front() {
            let arrived_ns = message.header.time_ns;
            let mut outputs = Vec::new();
            self.fusion.handle(
                FusionInput::Local {
                    node,
                    message: Box::new(message),
                    bytes: 0,
                    arrived_ns,
                },
                &mut outputs,
            );
            for output in outputs {
                match output {
                    Output::Estimates(block) => {
                        let mut alerts = Vec::new();
                        self.watch.handle_block(&block, &mut alerts)?;
                        self.collector.take_estimates(&block);
                        alerts
                            .iter()
                            .for_each(|alert| self.collector.take_alert(alert));
                        take(&block, &[])?;
                    }
                    Output::Feedback(node, feedback) => {
                        self.work(node, NodeInput::Feedback(feedback))
                    }
                    Output::Event(event) => spandrel_service::log_event(&event, self.start_ns),
                    Output::Node(display) => self.collector.take_node(&display),
                    Output::Outliers(_, display) => self.collector.take_outliers(&display),
                    Output::Parameter(_) => {} // only for display on a bus
                }
            }
        }
        Ok(())
    }
}
