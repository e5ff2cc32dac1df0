//! The configuration of the feed: `[[feed.source]]`.

mod calibrated;
mod condition;
mod kind;
mod mqtt;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Map, Value};
use spandrel_structure::Structure;

use crate::error::FeedError;
use crate::mistake::Mistake;
use crate::section::Section;
use crate::source_plan::{ChannelPlan, NodePlan, SourceKind, SourcePlan, StructurePlan};
use crate::station_xml::StationXml;
use kind::{KINDS, Stamped};

/// Default time that a row waits for other channels of its node, s. Packets of the common
/// instruments cover less.
const WAIT_S: f64 = 1.0;
/// The same for SeedLink, s. Records of 512 bytes cover some seconds at 100 Hz.
const SEEDLINK_WAIT_S: f64 = 30.0;
/// Longest allowed waiting time, s.
const MAX_WAIT_S: f64 = 600.0;
/// The configuration of the feed, as read.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FeedSettings {
    /// The sources. Their keys are checked together by [`FeedSettings::check`].
    source: Vec<Map<String, Value>>,
    /// Configuration file, for error messages.
    #[serde(skip)]
    file: PathBuf,
}

/// The configuration of the feed, checked against the structures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FeedConfig {
    /// The structures, in the order in which they were given.
    pub structures: Vec<StructurePlan>,
    /// The nodes with at least one channel that a source feeds.
    pub nodes: Vec<NodePlan>,
    /// The sources.
    pub sources: Vec<SourcePlan>,
    /// Remarks for people, such as channels without a source.
    pub remarks: Vec<String>,
}

impl FeedConfig {
    /// Returns `true` if a source feeds a node or a condition of a structure.
    pub(crate) fn feeds(&self, structure: usize) -> bool {
        let mut conditions = self.sources.iter().flat_map(|source| &source.conditions);
        self.nodes.iter().any(|node| node.structure == structure)
            || conditions.any(|condition| condition.structure == structure)
    }

    /// Splits the configuration into parts that have no structure and no source in common.
    pub(crate) fn parts(&self) -> Vec<Self> {
        // The part of each structure is the first one that it is connected to by sources.
        let mut part_of: Vec<usize> = (0..self.structures.len()).collect();
        for source in &self.sources {
            let structures = self.all_structures_of(source);
            let joined: BTreeSet<usize> = structures
                .iter()
                .filter_map(|structure| part_of.get(*structure).copied())
                .collect();
            let Some(first) = joined.first() else {
                continue;
            };
            for part in &mut part_of {
                if joined.contains(part) {
                    *part = *first;
                }
            }
        }
        let numbers: BTreeSet<usize> = part_of.iter().copied().collect();
        let parts = numbers.into_iter().map(|number| {
            let is_part = |structure: &usize| part_of.get(*structure) == Some(&number);
            self.part(is_part)
        });
        parts.filter(|part| !part.sources.is_empty()).collect()
    }

    /// Returns the sources and nodes of some structures. The structures keep their indices.
    fn part(&self, is_part: impl Fn(&usize) -> bool) -> Self {
        let mut part = Self {
            structures: self.structures.clone(),
            ..Self::default()
        };
        let mut index_of = BTreeMap::new();
        let nodes = self.nodes.iter().enumerate();
        for (index, node) in nodes.filter(|(_, node)| is_part(&node.structure)) {
            index_of.insert(index, part.nodes.len());
            part.nodes.push(node.clone());
        }
        for source in &self.sources {
            if !self.all_structures_of(source).iter().any(&is_part) {
                continue;
            }
            let mut source = source.clone();
            for channel in &mut source.channels {
                channel.node = index_of.get(&channel.node).copied().unwrap_or(channel.node);
            }
            part.sources.push(source);
        }
        part
    }

    /// Returns the structures with a node or condition that a source feeds.
    pub(crate) fn all_structures_of(&self, source: &SourcePlan) -> BTreeSet<usize> {
        let conditions = source.conditions.iter();
        let of_conditions = conditions.map(|condition| condition.structure);
        let mut structures = self.structures_of(source);
        structures.extend(of_conditions);
        structures
    }

    /// Returns the structures whose nodes a source feeds.
    pub(crate) fn structures_of(&self, source: &SourcePlan) -> BTreeSet<usize> {
        let channels = source.channels.iter();
        let nodes = channels.filter_map(|channel| self.nodes.get(channel.node));
        nodes.map(|node| node.structure).collect()
    }
}

impl FeedSettings {
    /// Returns `true` if there is no source.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.source.is_empty()
    }

    /// Sets the configuration file. Relative paths then start at its folder.
    pub fn resolve(&mut self, file: &Path) {
        file.clone_into(&mut self.file);
    }

    /// Checks the sources against the structures.
    ///
    /// # Errors
    /// Returns all mistakes at once.
    pub fn check(&self, structures: &[&Structure]) -> Result<FeedConfig, FeedError> {
        let mut reading = Reading {
            structures,
            folder: self.file.parent().map(Path::to_owned).unwrap_or_default(),
            config: FeedConfig {
                structures: structures
                    .iter()
                    .map(|structure| StructurePlan {
                        name: structure.name().to_owned(),
                        file: PathBuf::new(),
                    })
                    .collect(),
                ..FeedConfig::default()
            },
            names: BTreeSet::new(),
            fed: BTreeMap::new(),
            fed_conditions: BTreeMap::new(),
            files: BTreeMap::new(),
            mistakes: Vec::new(),
        };
        for (index, table) in self.source.iter().enumerate() {
            reading.source(Section::new(format!("feed.source[{index}]"), table));
        }
        reading.note_unfed();
        let Reading {
            config, mistakes, ..
        } = reading;
        match mistakes.is_empty() {
            true => Ok(config),
            false => Err(FeedError::Settings {
                file: self.file.display().to_string(),
                mistakes,
            }),
        }
    }
}

/// The state of a check.
struct Reading<'a> {
    structures: &'a [&'a Structure],
    folder: PathBuf,
    config: FeedConfig,
    /// Names of all sources.
    names: BTreeSet<String>,
    /// Key of the channel of a source, by structure and channel.
    fed: BTreeMap<(usize, String), String>,
    /// The same for conditions.
    fed_conditions: BTreeMap<(usize, String), String>,
    /// StationXML files by their path. `None` for a file with an error.
    files: BTreeMap<PathBuf, Option<StationXml>>,
    mistakes: Vec<Mistake>,
}

impl Reading<'_> {
    fn source(&mut self, mut section: Section<'_>) {
        let mistakes = &mut self.mistakes;
        let name = section.required_text("name", "must be a name for this source", mistakes);
        if let Some(name) = &name
            && !self.names.insert(name.clone())
        {
            let found = format!("is \"{name}\" again");
            section.report(
                "name",
                found,
                "must differ from those of other sources",
                mistakes,
            );
        }
        let kind = section.choice("kind", &KINDS, mistakes);
        if kind.is_none() && !mistakes.iter().any(|m| m.key == section.key("kind")) {
            let allowed = crate::section::one_of(&KINDS);
            section.report("kind", "is missing", allowed, mistakes);
        }
        let channels = section.tables("channel", mistakes);
        let conditions = section.tables("condition", mistakes);
        if channels.is_empty() && conditions.is_empty() {
            let allowed = "must have at least one channel, [[feed.source.channel]], or condition, \
                           [[feed.source.condition]]";
            section.report("channel", "is missing", allowed, mistakes);
        }
        let labels = channels.iter().chain(&conditions);
        let mut known = BTreeSet::new();
        // A channel of the source can be both a channel and a condition. It is read once.
        let labels: Vec<String> = labels
            .filter_map(Section::label)
            .filter(|label| known.insert(label.clone()))
            .collect();
        let kind = kind.and_then(|kind| self.kind(kind, &mut section, labels));
        let stamped = match channels.is_empty() {
            true => Stamped::Conditions,
            false => Stamped::Channels,
        };
        let stamps = self.stamps(&mut section, kind.as_ref(), stamped);
        let mistakes = &mut self.mistakes;
        let wait_s = section.number(
            "wait-s",
            |wait_s| (0.0..=MAX_WAIT_S).contains(&wait_s),
            "must be a number of seconds from 0 to 600",
            mistakes,
        );
        let channels = channels
            .into_iter()
            .filter_map(|channel| self.channel(channel))
            .collect();
        let conditions = conditions
            .into_iter()
            .filter_map(|condition| self.condition(condition))
            .collect();
        section.finish(&mut self.mistakes);
        let default_wait_s = match kind {
            Some(SourceKind::SeedLink(_)) => SEEDLINK_WAIT_S,
            _ => WAIT_S,
        };
        if let (Some(name), Some(kind), Some(stamps)) = (name, kind, stamps) {
            let kind = with_client_id(kind, &name);
            self.config.sources.push(SourcePlan {
                name,
                kind,
                stamps,
                wait_s: wait_s.unwrap_or(default_wait_s),
                channels,
                conditions,
            });
        }
    }

    fn channel(&mut self, mut section: Section<'_>) -> Option<ChannelPlan> {
        let mistakes = &mut self.mistakes;
        let allowed = "must be the name of the channel in the source";
        let label = section.required_text("source", allowed, mistakes);
        let structure = section.text("structure", mistakes);
        let allowed = "must be the name of a channel in the structure file";
        let channel = section.required_text("channel", allowed, mistakes);
        let structure = self.structure_index(&section, structure);
        let place = structure
            .zip(channel)
            .and_then(|(structure, channel)| self.place(&section, structure, channel));
        let calibration = self.calibration(&mut section, label.as_deref(), place.as_ref());
        section.finish(&mut self.mistakes);
        let ChannelPlace {
            node,
            position,
            channel,
            unit,
        } = place?;
        Some(ChannelPlan {
            label: label?,
            node,
            position,
            channel,
            calibration: calibration?,
            unit,
        })
    }

    /// Returns the index of a structure. The name is optional if there is only one.
    fn structure_index(&mut self, section: &Section<'_>, name: Option<String>) -> Option<usize> {
        let known = || {
            let names: Vec<&str> = self.structures.iter().map(|s| s.name()).collect();
            format!("must be one of {}", names.join(", "))
        };
        match name {
            None if self.structures.len() == 1 => Some(0),
            None => {
                let allowed = known();
                section.report("structure", "is missing", allowed, &mut self.mistakes);
                None
            }
            Some(name) => {
                let found = self.structures.iter().position(|s| s.name() == name);
                if found.is_none() {
                    let allowed = known();
                    let found = format!("is \"{name}\"");
                    section.report("structure", found, allowed, &mut self.mistakes);
                }
                found
            }
        }
    }

    /// Finds a channel in a structure, and adds its node to the configuration.
    fn place(
        &mut self,
        section: &Section<'_>,
        structure: usize,
        channel: String,
    ) -> Option<ChannelPlace> {
        let of = self.structures.get(structure)?;
        let found = of.nodes().iter().find_map(|node| {
            let position = node.channels().iter().position(|c| c.name() == channel)?;
            Some((node, position))
        });
        let Some((node, position)) = found else {
            let names: Vec<&str> = of.channels().map(|channel| channel.name()).collect();
            let allowed = format!("must be one of {} ({})", names.join(", "), of.name());
            let found = format!("is \"{channel}\"");
            section.report("channel", found, allowed, &mut self.mistakes);
            return None;
        };
        let key = (structure, channel.clone());
        if let Some(first) = self.fed.get(&key) {
            let allowed = format!("must be a channel that {first} does not feed");
            let found = format!("is \"{channel}\" again");
            section.report("channel", found, allowed, &mut self.mistakes);
            return None;
        }
        self.fed.insert(key, section.key("channel"));
        let known = |plan: &NodePlan| plan.structure == structure && plan.name == node.name();
        let index = self.config.nodes.iter().position(known);
        let index = index.unwrap_or_else(|| {
            self.config.nodes.push(NodePlan {
                structure,
                name: node.name().to_owned(),
                channels: node.channels().len(),
                rate_hz: node.sampling_rate_hz().unwrap_or(of.sampling_rate_hz()),
            });
            self.config.nodes.len() - 1
        });
        let unit = node.channels().get(position)?.quantity().unit();
        Some(ChannelPlace {
            node: index,
            position,
            channel,
            unit,
        })
    }

    /// Adds remarks on channels of fed nodes that no source feeds.
    fn note_unfed(&mut self) {
        for plan in &self.config.nodes {
            let Some(structure) = self.structures.get(plan.structure) else {
                continue;
            };
            let node = structure
                .nodes()
                .iter()
                .find(|node| node.name() == plan.name);
            for channel in node.into_iter().flat_map(|node| node.channels()) {
                let key = (plan.structure, channel.name().to_owned());
                if !self.fed.contains_key(&key) {
                    self.config.remarks.push(format!(
                        "channel {} of node {} ({}) has no source; its samples are missing",
                        channel.name(),
                        plan.name,
                        structure.name()
                    ));
                }
            }
        }
    }
}

/// Sets the default of the client identifier of an MQTT source, which must be unique.
fn with_client_id(mut kind: SourceKind, name: &str) -> SourceKind {
    if let SourceKind::Mqtt(topic) = &mut kind
        && topic.client_id.is_empty()
    {
        topic.client_id = format!("spandrel-{name}");
    }
    kind
}

/// A channel of a structure.
struct ChannelPlace {
    node: usize,
    position: usize,
    channel: String,
    unit: &'static str,
}

impl Section<'_> {
    /// Returns the name of the channel in the source, without reporting mistakes.
    fn label(&self) -> Option<String> {
        self.peek("source")
            .and_then(Value::as_str)
            .map(str::to_owned)
    }
}

#[cfg(test)]
mod tests;
