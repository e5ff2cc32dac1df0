//! Summary of distributed nodes.

use serde::Serialize;
use spandrel_bus::{NodeDisplay, NodeHealth, OutlierDisplay};
use spandrel_structure::Structure;
use std::collections::BTreeMap;

/// Summary of one node, as seen by the station.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NodeSummary {
    /// Name of the node.
    pub node: String,
    /// State in the last fusion.
    pub state: NodeHealth,
    /// Number of fusions in which the node was judged.
    pub fusions: u64,
    /// Number of fusions that excluded the node because it disagreed with the others.
    pub excluded: u64,
    /// Start of the exclusion that lasts to the end, in measurement time since the first fusion
    /// (s).
    pub excluded_since_s: Option<f64>,
    /// Spans of fusions without usable messages of the node.
    pub silent: Vec<Silence>,
    /// Number of rejected samples of all channels of the node. 0 if outliers are not screened.
    pub rejected: u64,
    /// Number of rejected samples of each channel with any.
    pub rejected_by_channel: BTreeMap<String, u64>,
}

/// A span without messages of a node, in measurement time since the first fusion (s).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Silence {
    /// First fusion without the node.
    pub from_s: f64,
    /// First fusion with the node again. `None` if it stayed silent.
    pub until_s: Option<f64>,
}

impl NodeSummary {
    /// Returns the summary in words.
    pub fn words(&self) -> String {
        let mut words = Vec::new();
        match (self.excluded, self.excluded_since_s) {
            (0, _) => {}
            (excluded, None) => words.push(format!(
                "excluded from {excluded} of {} fusions",
                self.fusions
            )),
            (excluded, Some(since_s)) => {
                words.push(format!(
                    "excluded from {excluded} of {} fusions, and at the end since {since_s:.0} s",
                    self.fusions
                ));
            }
        }
        words.extend(
            self.silent
                .iter()
                .map(|Silence { from_s, until_s }| match until_s {
                    Some(until_s) => format!("silent from {from_s:.0} to {until_s:.0} s"),
                    None => format!("silent since {from_s:.0} s"),
                }),
        );
        if self.rejected > 0 {
            let counts = self
                .rejected_by_channel
                .iter()
                .map(|(channel, count)| format!("{channel} {count}"));
            words.push(format!(
                "samples rejected: {}",
                counts.collect::<Vec<_>>().join(", ")
            ));
        }
        if words.is_empty() {
            "present in all fusions".to_owned()
        } else {
            words.join("; ")
        }
    }
}

/// Collects messages about the nodes.
#[derive(Debug, Clone)]
pub(super) struct NodeCollector {
    /// Nodes in file order.
    nodes: Vec<NodeSeen>,
    t0_ns: Option<i64>,
}

/// One node, in measurement time (ns).
#[derive(Debug, Clone, Default)]
struct NodeSeen {
    name: String,
    channels: Vec<String>,
    state: Option<NodeHealth>,
    fusions: u64,
    excluded: u64,
    excluded_since_ns: Option<i64>,
    silent: Vec<(i64, Option<i64>)>,
    rejected: BTreeMap<String, u64>,
}

impl NodeCollector {
    /// Creates an empty collector. It stays empty without distributed identification.
    pub(super) fn new(structure: &Structure) -> Self {
        let nodes = structure.nodes().iter().map(|node| NodeSeen {
            name: node.name().to_owned(),
            channels: node
                .channels()
                .iter()
                .map(|channel| channel.name().to_owned())
                .collect(),
            ..NodeSeen::default()
        });
        Self {
            nodes: nodes.collect(),
            t0_ns: None,
        }
    }

    /// Processes the state of a node after a fusion.
    pub(super) fn take_node(&mut self, display: &NodeDisplay) {
        self.t0_ns.get_or_insert(display.time_ns);
        let name = display.node.as_str();
        let Some(seen) = self.nodes.iter_mut().find(|seen| seen.name == name) else {
            return;
        };
        if display.state == NodeHealth::Ended {
            return; // happens to all nodes
        }
        seen.state = Some(display.state);
        seen.fusions += 1;
        seen.excluded += u64::from(display.state == NodeHealth::Excluded);
        seen.excluded_since_ns = display.excluded_since_ns;
        match (display.silent_since_ns, seen.silent.last_mut()) {
            (Some(_), Some((_, None))) => {}
            (Some(since_ns), _) => seen.silent.push((since_ns, None)),
            (None, Some((_, until_ns @ None))) => *until_ns = Some(display.time_ns),
            (None, _) => {}
        }
    }

    /// Processes the screening of a channel.
    pub(super) fn take_outliers(&mut self, display: &OutlierDisplay) {
        let channel = display.channel.as_str();
        let has_it = |seen: &&mut NodeSeen| seen.channels.iter().any(|own| own == channel);
        if let Some(seen) = self
            .nodes
            .iter_mut()
            .find(has_it)
            .filter(|_| display.flagged > 0)
        {
            *seen.rejected.entry(channel.to_owned()).or_default() += display.flagged;
        }
    }

    /// Returns the summary of the nodes with at least one message.
    pub(super) fn finish(self) -> Vec<NodeSummary> {
        let t0_ns = self.t0_ns.unwrap_or(0);
        let time_s = |time_ns: i64| time_ns.saturating_sub(t0_ns) as f64 / 1e9;
        let summary = |seen: NodeSeen| {
            let silent = seen.silent.iter();
            Some(NodeSummary {
                state: seen.state?,
                fusions: seen.fusions,
                excluded: seen.excluded,
                excluded_since_s: seen.excluded_since_ns.map(time_s),
                silent: silent
                    .map(|(from_ns, until_ns)| Silence {
                        from_s: time_s(*from_ns),
                        until_s: until_ns.map(time_s),
                    })
                    .collect(),
                rejected: seen.rejected.values().sum(),
                rejected_by_channel: seen.rejected,
                node: seen.name,
            })
        };
        self.nodes.into_iter().filter_map(summary).collect()
    }
}
