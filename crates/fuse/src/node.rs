//! A node in the eyes of the station: what it sent, whether it is heard and agrees, and what of that is worth an event.

use serde::{Deserialize, Serialize};
use spandrel_bus::{
    EventKind, LocalMessage, MaskedSpan, Name, NodeDisplay, NodeHealth, OutlierDisplay, Pace,
};
use spandrel_filter::fusion::NodeReport;
use std::collections::BTreeMap;

/// A node that has been left out in this share of its fusions, and a node that comes back from it, are worth an event.
const OFTEN: f64 = 0.5;

/// Fusions over which that share is taken.
const SHARE_MEMORY: f64 = 20.0;

/// A node is worth an event once so many fusions on end had nothing of it: a message that was lost or is late is soon made up for.
pub(crate) const SILENT_FUSIONS: u64 = 3;

/// A node as the station knows it. What is left out of a checkpoint is of one life of the station.
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
    /// number of the fusion period of its last message, since 1970 by measurement time; and its time
    #[serde(skip)]
    pub(crate) last: Option<(i64, i64)>,
    pub(crate) messages: u64,
    pub(crate) bytes_received: u64,
    pub(crate) bytes_sent: u64,
    #[serde(skip)]
    pub(crate) refused: BTreeMap<&'static str, u64>,
    pub(crate) restarts: u64,
    channels: Vec<Channel>,
    /// when it was last heard, as it is displayed
    heard_ns: Option<i64>,
    /// instants with a sample that its messages since the last fusion told of
    #[serde(skip)]
    samples: u64,
    /// of the last fusion
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
    /// samples rejected when it was last told of
    told: u64,
    masked: Option<MaskedSpan>,
}

/// How long nothing has come of a node.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Quiet {
    /// time of the first fusion without it
    since_ns: Option<i64>,
    fusions: u64,
    is_told: bool,
}

/// What of a node is worth an event: its kind, what and why.
pub(crate) type News = (EventKind, &'static str, String);

impl Node {
    /// A node of which nothing was heard, with the observed channels of which it tells outliers.
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

    /// Whether it has the name and the channels of another.
    pub(crate) fn is_as(&self, other: &Self) -> bool {
        self.name == other.name && self.channel_names().eq(other.channel_names())
    }

    /// Nothing more will come of it.
    pub(crate) fn is_over(&self) -> bool {
        self.ended || !self.present
    }

    /// The names of its channels whose outliers are told.
    pub(crate) fn channel_names(&self) -> impl Iterator<Item = &Name> {
        self.channels.iter().map(|channel| &channel.name)
    }

    /// Notes when a message came (ns by the station's clock) and what it was made of.
    pub(crate) fn note(&mut self, message: &LocalMessage, arrived_ns: i64) {
        self.heard_ns = Some(match message.pace {
            Pace::Live => arrived_ns,
            Pace::Replayed => message.header.time_ns,
        });
        self.samples = self.samples.saturating_add(message.samples);
    }

    /// Takes what a message says of outliers; nothing when it is not of the channels of this node.
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
                    // a filter that began anew counts from zero
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

    /// Takes what a fusion found of it; `is_over` says that nobody expects anything more of it. What is worth an event is added.
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
        let has_samples = std::mem::take(&mut self.samples) > 0;
        self.report = report;
        if report.heard && has_samples || is_over {
            let quiet = std::mem::take(&mut self.quiet);
            if let Some(since_ns) = quiet.since_ns.filter(|_| quiet.is_told && !is_over) {
                let seconds = time_ns.saturating_sub(since_ns) as f64 * 1e-9;
                news.push((
                    EventKind::NodeBack,
                    "the node is heard again",
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
            (true, ..) => "its worker has no samples: what it sends is predicted",
            (false, false, false) => "nothing was heard of it yet, and its worker is not there",
            (false, true, false) => "its worker is gone: its liveliness token is not there",
            (false, _, true) => "its worker is there, but nothing came that could be fused",
        }
    }

    /// Tells once that the node is left out often, and once that it is not any more.
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
                "the node disagrees with the others and is left out",
            ),
            false => (EventKind::NodeBack, "the node agrees with the others again"),
        };
        Some((
            kind,
            what,
            format!("left out in {:.0} % of late", self.excluded_share * 100.0),
        ))
    }

    /// How it stands after the last fusion; `is_over` as when it was judged.
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
