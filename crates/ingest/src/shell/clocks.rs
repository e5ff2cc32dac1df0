//! Reports about the clocks of the nodes.

use std::collections::BTreeMap;

use spandrel_bus::{EventKind, Name, NodeClock};

use super::IngestService;
use crate::clock_watch::describe_move;
use crate::error::IngestError;

impl IngestService {
    /// Counts the votes on the clocks again, and publishes an event for each node whose clock has
    /// become wrong or right, or has moved.
    pub(super) async fn report_clocks(&mut self) -> Result<(), IngestError> {
        let elapsed = self.started.elapsed();
        let Some(timekeeping) = &mut self.timekeeping else {
            return Ok(());
        };
        timekeeping.set_machine_time(self.clock.now_ns(), elapsed);
        let inputs = timekeeping.count_votes(elapsed);
        let reports = timekeeping.reports(elapsed);
        let moves = timekeeping.moves(elapsed);
        for input in inputs {
            self.handle(input).await?;
        }
        for report in reports {
            let kind = match report.is_over {
                true => EventKind::ClockRight,
                false => EventKind::ClockWrong,
            };
            self.put_node_event(report.node, kind, report.what, report.why)
                .await?;
        }
        for moved in moves {
            let (what, why) = describe_move(&moved);
            self.put_node_event(moved.node, EventKind::ClockMoved, what, why)
                .await?;
        }
        Ok(())
    }

    /// Publishes an event for each node whose source has begun to state a low quality of its clock.
    pub(super) async fn report_quality(&mut self) -> Result<(), IngestError> {
        for low in self.quality_watch.read() {
            let (what, why) = low.describe();
            self.put_node_event(low.node, EventKind::ClockDoubtful, what, why)
                .await?;
        }
        Ok(())
    }

    /// Returns the clocks to show: of nodes that do not sample at the times of the frames, of nodes
    /// whose time differs from that of most nodes, and of nodes whose source states a clock
    /// quality.
    pub(super) fn node_clocks(&self) -> BTreeMap<Name, NodeClock> {
        let names = self.layout.nodes().iter().map(|node| node.name.clone());
        let own = names.clone().zip(self.core.node_clocks());
        let mut clocks: BTreeMap<Name, NodeClock> = own
            .filter_map(|(name, clock)| Some((name, clock?)))
            .collect();
        if let Some(timekeeping) = &self.timekeeping {
            let differences = timekeeping.differences_s(self.started.elapsed());
            for (name, difference_s) in names.clone().zip(differences) {
                if difference_s.is_some() {
                    clocks.insert(
                        name,
                        NodeClock {
                            difference_s,
                            ..NodeClock::default()
                        },
                    );
                }
            }
        }
        for (name, quality_percent) in names.zip(self.quality_watch.qualities()) {
            if quality_percent.is_some() {
                clocks.entry(name).or_default().quality_percent = quality_percent;
            }
        }
        clocks
    }
}
