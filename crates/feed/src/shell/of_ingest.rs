//! Queries of the feed to ingest: the last frame at the start, and the progress afterwards.

use std::collections::BTreeMap;
use std::time::Duration;

use spandrel_bus::{Block, FrameBlock, POSITION_TIMEOUT, Service, StreamState, is_without_date};
use tokio::time::timeout;
use tracing::{info, warn};

use super::{FedStructure, Part};
use crate::core_input::Recorded;
use crate::source_plan::SourcePlan;

/// Number of such queries while ingest is present.
const POSITION_ATTEMPTS: u32 = 5;
/// Longest wait at a stop until ingest has processed the last samples.
const PATIENCE_AFTER_STOP: Duration = Duration::from_secs(2);

impl Part {
    /// Queries the frames that exist already, for each structure that ingest records.
    pub(super) async fn recorded(&self) -> BTreeMap<usize, Recorded> {
        let mut recorded = BTreeMap::new();
        let has_nodes = |of: &&FedStructure| {
            let mut nodes = self.core.config().nodes.iter();
            nodes.any(|node| node.structure == of.index)
        };
        let ingested = self.structures.iter().filter(|of| !of.is_distributed);
        for of in ingested.filter(has_nodes) {
            let found = self.recorded_of(of).await;
            let structure = of.keys.structure().as_str();
            match found {
                Some(found) => {
                    info!(
                        structure,
                        frame = found.next,
                        "feed resumes where the frames end"
                    );
                    recorded.insert(of.index, found);
                }
                None => info!(structure, "no frames to resume from"),
            }
        }
        recorded
    }

    async fn recorded_of(&self, of: &FedStructure) -> Option<Recorded> {
        let structure = of.keys.structure().as_str();
        let needs_it = self.core.config().sources.iter().any(|source| {
            source.kind.can_repeat()
                && source.channels.iter().any(|channel| {
                    let node = self.core.config().nodes.get(channel.node);
                    node.is_some_and(|node| node.structure == of.index)
                })
        });
        let live = of.keys.all_live(Service::Ingest);
        if needs_it {
            // The samples stay at the source until ingest can say what it has.
            let mut watch = self.bus.watch_live(live.clone()).await.ok()?;
            if watch.present().is_empty() && timeout(POSITION_TIMEOUT, watch.some()).await.is_err()
            {
                warn!(structure, "waiting for the ingest service on this bus");
                watch.some().await;
            }
        }
        let recording = of.keys.recording();
        for _ in 0..POSITION_ATTEMPTS {
            if let Some(at) = self.bus.stream_position(&recording, POSITION_TIMEOUT).await {
                if at.state == StreamState::Ended || at.header.sequence == 0 {
                    return None;
                }
                let last = self
                    .bus
                    .last_item::<FrameBlock>(&recording, POSITION_TIMEOUT)
                    .await;
                if let Some((block, _)) = last {
                    let recorded = Recorded {
                        frames: block.grid()?,
                        next: block.end(),
                    };
                    return self.is_plausible(structure, &recorded).then_some(recorded);
                }
            }
            let present = self.bus.query_tokens(&live, POSITION_TIMEOUT).await.ok()?;
            if present.is_empty() {
                break;
            }
        }
        None
    }

    /// Returns `true` if frames can be continued by samples that are measured now.
    fn is_plausible(&self, structure: &str, recorded: &Recorded) -> bool {
        let last_ns = last_ns(recorded);
        let now_ns = self.clocks.now().wall_ns;
        if is_without_date(last_ns) || last_ns > now_ns {
            warn!(
                structure,
                last_ns,
                now_ns,
                "the last frame is in the future or has no date; the feed does not resume"
            );
            return false;
        }
        true
    }

    /// Returns for each source whether it must wait for ingest.
    pub(super) fn held(&mut self) -> Vec<bool> {
        for of in self.structures.iter().filter(|of| !of.is_distributed) {
            let Some(progress) = of.progress.latest() else {
                continue;
            };
            let nodes = self.core.config().nodes.iter().zip(&mut self.ahead);
            for (_, ahead) in nodes.filter(|(node, _)| node.structure == of.index) {
                ahead.processed(progress.header.time_ns);
            }
        }
        let config = self.core.config();
        let is_ahead = |node: usize| {
            let of = config.nodes.get(node).map(|node| node.structure);
            let is_ingested = self
                .structures
                .iter()
                .any(|structure| Some(structure.index) == of && !structure.is_distributed);
            is_ingested && self.ahead.get(node).is_some_and(|ahead| !ahead.has_room())
        };
        let is_held = |source: &SourcePlan| {
            source.kind.can_repeat() && source.channels.iter().any(|channel| is_ahead(channel.node))
        };
        config.sources.iter().map(is_held).collect()
    }

    /// Waits until ingest has processed the last samples, because it can fetch samples only while
    /// this process runs.
    pub(super) async fn wait_for_ingest(&mut self) {
        for of in &mut self.structures {
            let Some(last_ns) = self.core.published(of.index).0 else {
                continue;
            };
            let done = of.progress.latest();
            let is_done = |time_ns: i64| time_ns >= last_ns;
            if done.is_none_or(|progress| !is_done(progress.header.time_ns)) {
                let reached = of
                    .progress
                    .wait_for(|progress| is_done(progress.header.time_ns));
                // Another node may be missing, so that frames wait for it.
                let _ = timeout(PATIENCE_AFTER_STOP, reached).await;
            }
        }
    }
}

/// Returns the time of the last frame, ns.
pub(super) fn last_ns(recorded: &Recorded) -> i64 {
    recorded.frames.time_ns(recorded.next.saturating_sub(1))
}
