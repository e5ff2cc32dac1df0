//! The configuration of the feed: `[[feed.source]]`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Map, Value};
use spandrel_record::{ReadOptions, TimeUnit};
use spandrel_structure::Structure;

use crate::calibration::Calibration;
use crate::error::FeedError;
use crate::lines::{LineFormat, TimeField};
use crate::mistake::Mistake;
use crate::section::Section;
use crate::source_plan::{
    ChannelPlan, DropFolder, GrowingFile, NodePlan, SeedLinkServer, SourceKind, SourcePlan, Stamps,
    StartAt, StructurePlan,
};
use crate::station_xml::StationXml;

/// Default time that a row waits for other channels of its node, s. Packets of the common
/// instruments cover less.
const WAIT_S: f64 = 1.0;
/// The same for SeedLink, s. Records of 512 bytes cover some seconds at 100 Hz.
const SEEDLINK_WAIT_S: f64 = 30.0;
/// Longest allowed waiting time, s.
const MAX_WAIT_S: f64 = 600.0;
/// Units of numeric times.
const TIME_UNITS: [(&str, TimeUnit); 4] = [
    ("s", TimeUnit::Seconds),
    ("ms", TimeUnit::Milliseconds),
    ("us", TimeUnit::Microseconds),
    ("ns", TimeUnit::Nanoseconds),
];

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
    /// StationXML files by their path. `None` for a file with an error.
    files: BTreeMap<PathBuf, Option<StationXml>>,
    mistakes: Vec<Mistake>,
}

/// Kinds of sources.
#[derive(Clone, Copy)]
enum Kind {
    Udp,
    Tcp,
    TcpServer,
    Stdin,
    File,
    Folder,
    SeedLink,
}

/// Formats of lines.
#[derive(Clone, Copy, PartialEq)]
enum Format {
    RaspberryShake,
    Json,
    Csv,
}

/// Origins of times.
#[derive(Clone, Copy, PartialEq)]
enum Origin {
    Source,
    Arrival,
}

const KINDS: [(&str, Kind); 7] = [
    ("udp", Kind::Udp),
    ("tcp", Kind::Tcp),
    ("tcp-server", Kind::TcpServer),
    ("stdin", Kind::Stdin),
    ("file", Kind::File),
    ("folder", Kind::Folder),
    ("seedlink", Kind::SeedLink),
];
const FORMATS: [(&str, Format); 3] = [
    ("raspberry-shake", Format::RaspberryShake),
    ("json", Format::Json),
    ("csv", Format::Csv),
];
const STARTS: [(&str, StartAt); 2] = [("start", StartAt::Start), ("end", StartAt::End)];
/// Default name of the file with the names of the recordings that were read.
const MEMORY: &str = ".spandrel-feed";
const ORIGINS: [(&str, Origin); 2] = [("source", Origin::Source), ("arrival", Origin::Arrival)];

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
        if channels.is_empty() {
            let allowed = "must have at least one channel: [[feed.source.channel]]";
            section.report("channel", "is missing", allowed, mistakes);
        }
        let labels: Vec<String> = channels.iter().filter_map(Section::label).collect();
        let kind = kind.and_then(|kind| self.kind(kind, &mut section, labels));
        let stamps = self.stamps(&mut section, kind.as_ref());
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
        section.finish(&mut self.mistakes);
        let default_wait_s = match kind {
            Some(SourceKind::SeedLink(_)) => SEEDLINK_WAIT_S,
            _ => WAIT_S,
        };
        if let (Some(name), Some(kind), Some(stamps)) = (name, kind, stamps) {
            self.config.sources.push(SourcePlan {
                name,
                kind,
                stamps,
                wait_s: wait_s.unwrap_or(default_wait_s),
                channels,
            });
        }
    }

    /// Reads the keys that depend on the kind. `labels` are the names of the channels.
    fn kind(
        &mut self,
        kind: Kind,
        section: &mut Section<'_>,
        labels: Vec<String>,
    ) -> Option<SourceKind> {
        let mistakes = &mut self.mistakes;
        let address = |section: &mut Section<'_>, mistakes: &mut Vec<Mistake>| {
            let allowed = "must be HOST:PORT, such as \"0.0.0.0:8888\"";
            let address = section.required_text("address", allowed, mistakes)?;
            let is_address = address
                .rsplit_once(':')
                .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok());
            if !is_address {
                section.report("address", format!("is \"{address}\""), allowed, mistakes);
                return None;
            }
            Some(address)
        };
        match kind {
            Kind::Udp => {
                let (listen, format) = (
                    address(section, mistakes),
                    line_format(section, labels, Columns::Declared, mistakes),
                );
                Some(SourceKind::Udp {
                    listen: listen?,
                    format: format?,
                })
            }
            Kind::Tcp => {
                let (address, format) = (
                    address(section, mistakes),
                    line_format(section, labels, Columns::Declared, mistakes),
                );
                Some(SourceKind::Tcp {
                    address: address?,
                    format: format?,
                })
            }
            Kind::TcpServer => {
                let (listen, format) = (
                    address(section, mistakes),
                    line_format(section, labels, Columns::Declared, mistakes),
                );
                Some(SourceKind::TcpServer {
                    listen: listen?,
                    format: format?,
                })
            }
            Kind::Stdin => {
                let format = line_format(section, labels, Columns::Declared, mistakes)?;
                Some(SourceKind::Stdin { format })
            }
            Kind::File => {
                let allowed = "must be a file; a * in its name stands for any text, such as a date";
                let path = section.required_text("path", allowed, mistakes);
                let start = section.choice("from", &STARTS, mistakes);
                let format = line_format(section, labels, Columns::OfHeader, mistakes);
                Some(SourceKind::File(GrowingFile {
                    path: self.folder.join(path?),
                    format: format?,
                    start: start.unwrap_or(StartAt::End),
                }))
            }
            Kind::SeedLink => {
                let address = address(section, mistakes);
                let is_id = |label: &&String| {
                    let codes: Vec<&str> = label.split('.').collect();
                    matches!(codes[..], [network, station, location, channel]
                        if !network.is_empty() && !station.is_empty()
                            && location.len() <= 2 && channel.len() == 3)
                };
                for label in labels.iter().filter(|label| !is_id(label)) {
                    let found = format!("has source \"{label}\"");
                    let allowed =
                        "must be NETWORK.STATION.LOCATION.CHANNEL, such as AM.R1234.00.ENZ";
                    section.report("channel", found, allowed, mistakes);
                }
                Some(SourceKind::SeedLink(SeedLinkServer { address: address? }))
            }
            Kind::Folder => {
                let path = section.required_text("path", "must be a folder", mistakes);
                let memory = section.text("memory", mistakes);
                let time_column = section.text("time-field", mistakes);
                let time_unit = section.choice("time-unit", &TIME_UNITS, mistakes);
                let path = self.folder.join(path?);
                Some(SourceKind::Folder(DropFolder {
                    memory: match memory {
                        Some(memory) => self.folder.join(memory),
                        None => path.join(MEMORY),
                    },
                    path,
                    options: ReadOptions {
                        time_column,
                        time_unit,
                        sampling_rate_hz: None,
                    },
                }))
            }
        }
    }

    fn stamps(&mut self, section: &mut Section<'_>, kind: Option<&SourceKind>) -> Option<Stamps> {
        let mistakes = &mut self.mistakes;
        let stated = section.choice("time", &ORIGINS, mistakes);
        let jitter_s = section.number(
            "jitter-s",
            |jitter_s| jitter_s >= 0.0,
            "must be a number of seconds, 0 or more",
            mistakes,
        );
        // A source whose kind is wrong has no further mistakes.
        let has_time = kind?.states_time();
        let origin = stated.unwrap_or(match has_time {
            true => Origin::Source,
            false => Origin::Arrival,
        });
        match (origin, jitter_s) {
            (Origin::Source, _) if !has_time => {
                let allowed = "must be \"arrival\" for lines without a time-field";
                section.report("time", "is \"source\"", allowed, mistakes);
                None
            }
            (Origin::Source, jitter_s) => Some(Stamps::Source {
                jitter_s: jitter_s.unwrap_or(0.0),
            }),
            (Origin::Arrival, Some(jitter_s)) => Some(Stamps::Arrival { jitter_s }),
            (Origin::Arrival, None) => {
                let allowed = "must state how far arrival times may deviate, in seconds, because \
                               the time of the samples is their arrival";
                section.report("jitter-s", "is missing", allowed, mistakes);
                None
            }
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
        let Place {
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
    fn place(&mut self, section: &Section<'_>, structure: usize, channel: String) -> Option<Place> {
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
        Some(Place {
            node: index,
            position,
            channel,
            unit,
        })
    }

    fn calibration(
        &mut self,
        section: &mut Section<'_>,
        label: Option<&str>,
        place: Option<&Place>,
    ) -> Option<Calibration> {
        let mistakes = &mut self.mistakes;
        let is_factor = |number: f64| number != 0.0;
        let allowed = "must be a finite number except 0: counts per SI unit";
        let sensitivity = section.number("sensitivity", is_factor, allowed, mistakes);
        let offset = section.number("offset", |_| true, "must be a finite number", mistakes);
        let is_sign = |number: f64| number == 1.0 || number == -1.0;
        let sign = section.number("sign", is_sign, "must be 1 or -1", mistakes);
        let file = section.text("stationxml", mistakes);
        let id = section.text("stationxml-id", mistakes);
        let (offset, sign) = (offset.unwrap_or(0.0), sign.unwrap_or(1.0));
        match (sensitivity, file) {
            (Some(_), Some(_)) => {
                let allowed = "must be absent if sensitivity is given";
                section.report("stationxml", "is given too", allowed, mistakes);
                None
            }
            (Some(sensitivity), None) => Some(Calibration::new(sensitivity, offset, sign)),
            (None, Some(file)) => {
                let name = id.as_deref().or(label)?.to_owned();
                let path = self.folder.join(file);
                let place = place?;
                self.of_station_xml(section, &path, &name, place.unit)
                    .map(|epochs| Calibration::of_epochs(epochs, offset, sign))
            }
            (None, None) => {
                let key = section.key("sensitivity");
                if !mistakes.iter().any(|mistake| mistake.key == key) {
                    let allowed = "must be the counts per SI unit of the channel, or use \
                                   stationxml = \"FILE\"";
                    section.report("sensitivity", "is missing", allowed, mistakes);
                }
                None
            }
        }
    }

    fn of_station_xml(
        &mut self,
        section: &Section<'_>,
        path: &Path,
        name: &str,
        unit: &str,
    ) -> Option<crate::station_xml::Sensitivities> {
        if !self.files.contains_key(path) {
            let read = StationXml::read(path);
            if let Err(error) = &read {
                let found = format!("is \"{}\", which {error}", path.display());
                let allowed = "must be a StationXML file";
                section.report("stationxml", found, allowed, &mut self.mistakes);
            }
            self.files.insert(path.to_owned(), read.ok());
        }
        let file = self.files.get(path)?.as_ref()?;
        let Some(id) = file.id_of(name) else {
            let found = format!(
                "does not select one channel of {} by {name}",
                path.display()
            );
            let allowed = format!("must be one of {}", file.ids().join(", "));
            section.report("stationxml-id", found, allowed, &mut self.mistakes);
            return None;
        };
        match file.sensitivities(id, unit) {
            Ok(epochs) => Some(epochs),
            Err(found) => {
                let found = format!("{found} for {id}");
                let allowed = format!("must have counts per {unit}");
                section.report("stationxml", found, allowed, &mut self.mistakes);
                None
            }
        }
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

/// A channel of a structure.
struct Place {
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

impl SourceKind {
    /// Returns `true` if the samples have times of the source.
    fn states_time(&self) -> bool {
        match self {
            Self::Udp { format, .. }
            | Self::Tcp { format, .. }
            | Self::TcpServer { format, .. }
            | Self::Stdin { format }
            | Self::File(GrowingFile { format, .. }) => match format {
                LineFormat::RaspberryShake => true,
                LineFormat::Json { time, .. } | LineFormat::Csv { time, .. } => time.is_some(),
            },
            Self::Folder(_) | Self::SeedLink(_) => true,
        }
    }
}

/// Where the names of the columns are if the configuration does not state them.
#[derive(Clone, Copy, PartialEq)]
enum Columns {
    /// The configuration must state them.
    Declared,
    /// The first line of a file states them.
    OfHeader,
}

/// Reads the format of the lines.
fn line_format(
    section: &mut Section<'_>,
    mut fields: Vec<String>,
    source_of_columns: Columns,
    mistakes: &mut Vec<Mistake>,
) -> Option<LineFormat> {
    fields.dedup();
    let before = mistakes.len();
    let format = section.choice("format", &FORMATS, mistakes);
    if format.is_none() && mistakes.len() == before {
        let allowed = crate::section::one_of(&FORMATS);
        section.report("format", "is missing", allowed, mistakes);
    }
    let format = format?;
    if format == Format::RaspberryShake {
        return Some(LineFormat::RaspberryShake);
    }
    let name = section.text("time-field", mistakes);
    let unit = section.choice("time-unit", &TIME_UNITS, mistakes);
    let time = name.map(|name| TimeField {
        name,
        unit: unit.unwrap_or(TimeUnit::Seconds),
    });
    if format == Format::Json {
        return Some(LineFormat::Json { time, fields });
    }
    let separator = section.text("separator", mistakes);
    let separator = separator.map(|text| (text.chars().next(), text.chars().count(), text));
    let separator = match separator {
        None => ',',
        Some((Some(separator), 1, _)) => separator,
        Some((_, _, text)) => {
            let found = format!("is \"{text}\"");
            section.report("separator", found, "must be one character", mistakes);
            return None;
        }
    };
    let before = mistakes.len();
    let columns = section.texts("columns", mistakes);
    let Some(columns) = columns else {
        if mistakes.len() == before && source_of_columns == Columns::OfHeader {
            return Some(LineFormat::Csv {
                separator,
                columns: Vec::new(),
                time,
                fields,
            });
        }
        if mistakes.len() == before {
            let allowed =
                "must name the columns in their order, such as [\"time\", \"ax\", \"ay\"]";
            section.report("columns", "is missing", allowed, mistakes);
        }
        return None;
    };
    let allowed = format!("must be one of the columns {}", columns.join(", "));
    if let Some(time) = &time
        && !columns.contains(&time.name)
    {
        let found = format!("is \"{}\"", time.name);
        section.report("time-field", found, allowed.clone(), mistakes);
    }
    for field in fields.iter().filter(|field| !columns.contains(field)) {
        let found = format!("has source \"{field}\"");
        section.report("channel", found, allowed.clone(), mistakes);
    }
    Some(LineFormat::Csv {
        separator,
        columns,
        time,
        fields,
    })
}

#[cfg(test)]
mod tests;
