//! Reads the keys that depend on the kind of a source.

use spandrel_record::{ReadOptions, TimeUnit};

use super::Reading;
use crate::lines::{LineFormat, TimeField};
use crate::mistake::Mistake;
use crate::section::Section;
use crate::source_plan::{
    DropFolder, GrowingFile, MqttTopic, Payload, SeedLinkServer, SeedLinkVersion, SourceKind,
    Stamps, StartAt,
};

/// Units of numeric times.
const TIME_UNITS: [(&str, TimeUnit); 4] = [
    ("s", TimeUnit::Seconds),
    ("ms", TimeUnit::Milliseconds),
    ("us", TimeUnit::Microseconds),
    ("ns", TimeUnit::Nanoseconds),
];

/// Kinds of sources.
#[derive(Clone, Copy)]
pub(super) enum Kind {
    Udp,
    Tcp,
    TcpServer,
    Stdin,
    File,
    Folder,
    SeedLink,
    Mqtt,
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

/// What the times of a source belong to.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Stamped {
    /// At least one channel of a node.
    Channels,
    /// Conditions only. Their times need no rate, so arrival times may deviate.
    Conditions,
}

/// Names of the kinds.
pub(super) const KINDS: [(&str, Kind); 8] = [
    ("udp", Kind::Udp),
    ("tcp", Kind::Tcp),
    ("tcp-server", Kind::TcpServer),
    ("stdin", Kind::Stdin),
    ("file", Kind::File),
    ("folder", Kind::Folder),
    ("seedlink", Kind::SeedLink),
    ("mqtt", Kind::Mqtt),
];
const FORMATS: [(&str, Format); 3] = [
    ("raspberry-shake", Format::RaspberryShake),
    ("json", Format::Json),
    ("csv", Format::Csv),
];
const STARTS: [(&str, StartAt); 2] = [("start", StartAt::Start), ("end", StartAt::End)];
/// Versions of SeedLink.
const VERSIONS: [(&str, SeedLinkVersion); 2] =
    [("3", SeedLinkVersion::Three), ("4", SeedLinkVersion::Four)];
/// Default name of the file with the names of the recordings that were read.
const MEMORY: &str = ".spandrel-feed";
const ORIGINS: [(&str, Origin); 2] = [("source", Origin::Source), ("arrival", Origin::Arrival)];

impl Reading<'_> {
    /// Reads the keys that depend on the kind. `labels` are the names of the channels.
    pub(super) fn kind(
        &mut self,
        kind: Kind,
        section: &mut Section<'_>,
        labels: Vec<String>,
    ) -> Option<SourceKind> {
        let mistakes = &mut self.mistakes;
        match kind {
            Kind::Udp => {
                let (listen, format) = address_and_format(section, labels, mistakes)?;
                Some(SourceKind::Udp { listen, format })
            }
            Kind::Tcp => {
                let (address, format) = address_and_format(section, labels, mistakes)?;
                Some(SourceKind::Tcp { address, format })
            }
            Kind::TcpServer => {
                let (listen, format) = address_and_format(section, labels, mistakes)?;
                Some(SourceKind::TcpServer { listen, format })
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
            Kind::SeedLink => seed_link(section, &labels, mistakes).map(SourceKind::SeedLink),
            Kind::Mqtt => {
                let address = read_address(section, mistakes);
                self.mqtt(section, address, labels)
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

    /// Reads the origin of the times.
    pub(super) fn stamps(
        &mut self,
        section: &mut Section<'_>,
        kind: Option<&SourceKind>,
        stamped: Stamped,
    ) -> Option<Stamps> {
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
            (Origin::Arrival, None) if stamped == Stamped::Conditions => {
                Some(Stamps::Arrival { jitter_s: 0.0 })
            }
            (Origin::Arrival, None) => {
                let allowed = "must state how far arrival times may deviate, in seconds, because \
                               the time of the samples is their arrival";
                section.report("jitter-s", "is missing", allowed, mistakes);
                None
            }
        }
    }
}

fn read_address(section: &mut Section<'_>, mistakes: &mut Vec<Mistake>) -> Option<String> {
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
}

/// Reads the address of a connection that carries lines, and their format.
fn address_and_format(
    section: &mut Section<'_>,
    labels: Vec<String>,
    mistakes: &mut Vec<Mistake>,
) -> Option<(String, LineFormat)> {
    let address = read_address(section, mistakes);
    let format = line_format(section, labels, Columns::Declared, mistakes);
    Some((address?, format?))
}

/// Reads the server and checks that every channel has the name of a SeedLink stream.
fn seed_link(
    section: &mut Section<'_>,
    labels: &[String],
    mistakes: &mut Vec<Mistake>,
) -> Option<SeedLinkServer> {
    let address = read_address(section, mistakes);
    let newest = section.choice("protocol", &VERSIONS, mistakes);
    let is_id = |label: &&String| {
        let codes: Vec<&str> = label.split('.').collect();
        matches!(codes[..], [network, station, location, channel]
            if !network.is_empty() && !station.is_empty()
                && location.len() <= 2 && channel.len() == 3)
    };
    for label in labels.iter().filter(|label| !is_id(label)) {
        let found = format!("has source \"{label}\"");
        let allowed = "must be NETWORK.STATION.LOCATION.CHANNEL, such as AM.R1234.00.ENZ";
        section.report("channel", found, allowed, mistakes);
    }
    Some(SeedLinkServer {
        address: address?,
        newest: newest.unwrap_or(SeedLinkVersion::Four),
    })
}

impl LineFormat {
    /// Returns `true` if the lines have times.
    fn states_time(&self) -> bool {
        match self {
            Self::RaspberryShake => true,
            Self::Json { time, .. } | Self::Csv { time, .. } => time.is_some(),
        }
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
            | Self::File(GrowingFile { format, .. }) => format.states_time(),
            Self::Mqtt(MqttTopic { payload, .. }) => match payload {
                Payload::Lines(format) => format.states_time(),
                Payload::Raw(_) => false,
            },
            Self::Folder(_) | Self::SeedLink(_) => true,
        }
    }
}

/// Where the names of the columns are if the configuration does not state them.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Columns {
    /// The configuration must state them.
    Declared,
    /// The first line of a file states them.
    OfHeader,
}

/// Reads the format of the lines.
pub(super) fn line_format(
    section: &mut Section<'_>,
    fields: Vec<String>,
    source_of_columns: Columns,
    mistakes: &mut Vec<Mistake>,
) -> Option<LineFormat> {
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
