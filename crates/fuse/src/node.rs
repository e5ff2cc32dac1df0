//! A node as seen by the station: its messages, its agreement with other nodes, and its events.

use serde::{Deserialize, Serialize};
use spandrel_bus::{
    EventKind, LocalMessage, MaskedSpan, Name, NodeDisplay, NodeHealth, OutlierDisplay, Pace,
};
use spandrel_filter::fusion::NodeReport;
use std::collections::BTreeMap;

/// Share of fusions that must exclude a node before the station publishes an event. The event that
/// the node is back follows at half this share.
const OFTEN: f64 = 0.5;

/// Number of fusions over which that share is averaged.
const SHARE_MEMORY: f64 = 20.0;

/// Number of consecutive fusions without data after which a silent node causes an event.
///
/// Later messages compensate for one that is lost or late.
pub(crate) const SILENT_FUSIONS: u64 = 3;

/// A node as known to the station. Fields that checkpoints skip apply to one run of the station
/// only.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Node {
    pub(crate) name: Name,
    pub(crate) epoch: u64,
    #[serde(skip)]
    pub(crate) present: bool,
    pub(crate) heard_ever: bool,
    #[serde(skip)]
    pub(crate) ended: bool,
    pub(crate) pace: Pace,
    /// Fusion period of the last message, counted in measurement time since 1970, and the time of
    /// that message in ns.
    #[serde(skip)]
    pub(crate) last: Option<(i64, i64)>,
    pub(crate) messages: u64,
    pub(crate) bytes_received: u64,
    pub(crate) bytes_sent: u64,
    #[serde(skip)]
    pub(crate) refused: BTreeMap<&'static str, u64>,
    pub(crate) restarts: u64,
    channels: Vec<Channel>,
    /// Displayed time of the last message, in ns.
    heard_ns: Option<i64>,
    /// Number of sampled time steps that the messages since the last fusion have reported.
    #[serde(skip)]
    samples: u64,
    /// Report of the last fusion.
    report: NodeReport,
    quiet: Quiet,
    excluded_since_ns: Option<i64>,
    excluded_share: f64,
    often_excluded: bool,
}

/// An observed channel of a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Channel {
    name: Name,
    /// Number of rejected samples in the last report.
    told: u64,
    masked: Option<MaskedSpan>,
}

/// How long a node has been silent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Quiet {
    /// Time of the first fusion without the node, in ns.
    since_ns: Option<i64>,
    fusions: u64,
    is_told: bool,
}

/// An event of a node: its kind, what happened and why.
pub(crate) type News = (EventKind, &'static str, String);

impl Node {
    /// Creates a node without messages, with the observed channels for which it reports outliers.
    pub(crate) fn new(name: Name, channels: Vec<Name>) -> Self {
        Self {
            name,
            epoch: 0,
            present: false,
            heard_ever: false,
            ended: false,
            pace: Pace::Live,
            last: None,
            messages: 0,
            bytes_received: 0,
            bytes_sent: 0,
            refused: BTreeMap::new(),
            restarts: 0,
            channels: channels
                .into_iter()
                .map(|name| Channel {
                    name,
                    told: 0,
                    masked: None,
                })
                .collect(),
            heard_ns: None,
            samples: 0,
            report: NodeReport::default(),
            quiet: Quiet::default(),
            excluded_since_ns: None,
            excluded_share: 0.0,
            often_excluded: false,
        }
    }

    /// Returns `true` if the names of the node and its channels match.
    pub(crate) fn is_as(&self, other: &Self) -> bool {
        self.name == other.name && self.channel_names().eq(other.channel_names())
    }

    /// Returns `true` if no more messages are expected from the node.
    pub(crate) fn is_over(&self) -> bool {
        self.ended || !self.present
    }

    /// Returns `true` if the node sends live estimates and more are expected.
    pub(crate) fn is_live(&self) -> bool {
        self.heard_ever && self.pace == Pace::Live && !self.is_over()
    }

    /// Returns `true` if the messages since the last fusion contain information from samples.
    pub(crate) fn has_samples(&self) -> bool {
        self.samples > 0
    }

    /// Returns the names of the channels for which the node reports outliers.
    pub(crate) fn channel_names(&self) -> impl Iterator<Item = &Name> {
        self.channels.iter().map(|channel| &channel.name)
    }

    /// Records the arrival time of a message (ns by the station's clock) and the number of its
    /// samples.
    pub(crate) fn note(&mut self, message: &LocalMessage, arrived_ns: i64) {
        self.heard_ns = Some(match message.pace {
            Pace::Live => arrived_ns,
            Pace::Replayed => message.header.time_ns,
        });
        self.samples = self.samples.saturating_add(message.samples);
    }

    /// Processes the outlier report of a message. Returns nothing if its channels do not match this
    /// node.
    pub(crate) fn screened(
        &mut self,
        structure: &Name,
        message: &LocalMessage,
    ) -> Vec<OutlierDisplay> {
        if message.screening.len() != self.channels.len() {
            if !message.screening.is_empty() {
                *self.refused.entry("screening").or_default() += 1;
            }
            return Vec::new();
        }
        let displays =
            self.channels
                .iter_mut()
                .zip(&message.screening)
                .map(|(channel, screened)| {
                    channel.masked = screened.masked.or(channel.masked);
                    // A restarted filter counts from zero.
                    let flagged = screened
                        .rejected
                        .checked_sub(channel.told)
                        .unwrap_or(screened.rejected);
                    channel.told = screened.rejected;
                    OutlierDisplay {
                        structure: structure.clone(),
                        channel: channel.name.clone(),
                        time_ns: message.header.time_ns,
                        state: screened.state,
                        flagged,
                        rejected: screened.rejected,
                        screened: screened.screened,
                        recent_share: f64::from(screened.recent_share),
                        scale: f64::from(screened.scale),
                        masked: channel.masked,
                    }
                });
        displays.collect()
    }

    /// Processes the report of a fusion and appends events.
    ///
    /// `is_over` means that no more messages are expected from the node.
    pub(crate) fn judge(
        &mut self,
        report: NodeReport,
        is_over: bool,
        time_ns: i64,
        news: &mut Vec<News>,
    ) {
        if report.out_of_step {
            *self.refused.entry("motion-out-of-step").or_default() += 1;
        }
        if report.heard {
            let excluded = f64::from(u8::from(report.excluded));
            self.excluded_share += (excluded - self.excluded_share) / SHARE_MEMORY;
            self.excluded_since_ns = if report.excluded {
                self.excluded_since_ns.or(Some(time_ns))
            } else {
                None
            };
        }
        let has_samples = self.has_samples();
        self.samples = 0;
        self.report = report;
        if report.heard && has_samples || is_over {
            let quiet = std::mem::take(&mut self.quiet);
            if let Some(since_ns) = quiet.since_ns.filter(|_| quiet.is_told && !is_over) {
                let seconds = time_ns.saturating_sub(since_ns) as f64 * 1e-9;
                news.push((
                    EventKind::NodeBack,
                    "the node sends again",
                    format!("it was silent for {seconds:.0} s"),
                ));
            }
        } else {
            self.quiet.since_ns.get_or_insert(time_ns);
            self.quiet.fusions += 1;
            if self.quiet.fusions >= SILENT_FUSIONS && !self.quiet.is_told {
                self.quiet.is_told = true;
                news.push((
                    EventKind::NodeSilent,
                    "the node is silent",
                    self.why_silent(report.heard).to_owned(),
                ));
            }
        }
        news.extend(self.exclusion());
    }

    fn why_silent(&self, is_heard: bool) -> &'static str {
        match (is_heard, self.heard_ever, self.present) {
            (true, ..) => "its worker has no samples and sends predictions",
            (false, false, false) => "it has not sent anything yet, and its worker is not running",
            (false, true, false) => "its worker is not running: its liveliness token is missing",
            (false, _, true) => {
                "its worker is running, but its messages were rejected or its samples were \
                 dropped; see its status"
            }
        }
    }

    /// Returns an event when the node starts or stops being excluded often.
    fn exclusion(&mut self) -> Option<News> {
        let often = match self.often_excluded {
            false => self.excluded_share > OFTEN,
            true => self.excluded_share > OFTEN / 2.0,
        };
        if often == self.often_excluded {
            return None;
        }
        self.often_excluded = often;
        let (kind, what) = match often {
            true => (
                EventKind::NodeExcluded,
                "the node disagrees with the others and is excluded",
            ),
            false => (EventKind::NodeBack, "the node agrees with the others again"),
        };
        Some((
            kind,
            what,
            format!(
                "recently excluded in {:.0} % of fusions",
                self.excluded_share * 100.0
            ),
        ))
    }

    /// Returns the state of the node after the last fusion. `is_over` is the same as for
    /// [`Self::judge`].
    pub(crate) fn display(
        &self,
        structure: &Name,
        time_ns: i64,
        is_over: bool,
        distance_limit: Option<f64>,
    ) -> NodeDisplay {
        let report = &self.report;
        NodeDisplay {
            structure: structure.clone(),
            node: self.name.clone(),
            time_ns,
            state: match (is_over, self.quiet.since_ns, report.excluded) {
                (true, ..) => NodeHealth::Ended,
                (false, Some(_), _) => NodeHealth::Silent,
                (false, None, true) => NodeHealth::Excluded,
                (false, None, false) => NodeHealth::Used,
            },
            distance: report.distance,
            distance_limit,
            weight: report.distance.map(|_| report.weight),
            excluded_since_ns: self.excluded_since_ns,
            silent_since_ns: self.quiet.since_ns,
            heard_ns: self.heard_ns,
            excluded_share: self.excluded_share,
            messages: self.messages,
            bytes_received: self.bytes_received,
            bytes_sent: self.bytes_sent,
            refused: self
                .refused
                .iter()
                .map(|(reason, count)| ((*reason).to_owned(), *count))
                .collect(),
            restarts: self.restarts,
        }
    }
}
