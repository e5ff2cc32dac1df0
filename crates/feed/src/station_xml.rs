//! Reads the sensitivity of channels from a StationXML file.
//!
//! The file states one number per channel and epoch: the ratio of counts to the unit of the ground
//! motion at one frequency (`InstrumentSensitivity`). The frequency response itself is not read,
//! so it is not removed from the samples.
//!
//! Source: FDSN StationXML 1.2, elements `Network`, `Station`, `Channel` and `Response`.

use std::path::Path;

use roxmltree::{Document, Node};
use spandrel_bus::read_text_up_to;
use spandrel_record::TimeUnit;
use spandrel_record::record_time::parse_time_ns;

/// Largest accepted file. Files of a network with all responses have up to some hundred MB; a file
/// of one station has less than 1 MB.
const MAX_FILE_BYTES: u64 = 64 << 20;

/// The channels of a StationXML file.
#[derive(Clone, Debug, PartialEq)]
pub struct StationXml {
    channels: Vec<ChannelEpoch>,
}

/// One epoch of one channel.
#[derive(Clone, Debug, PartialEq)]
struct ChannelEpoch {
    /// Network, station, location and channel, separated by dots.
    id: String,
    start_ns: i64,
    end_ns: i64,
    /// Counts per unit. `None` if the file does not state it.
    value: Option<f64>,
    unit: String,
}

/// The sensitivities of one channel by epoch, counts per SI unit.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sensitivities(Vec<SensitivityEpoch>);

#[derive(Clone, Debug, PartialEq)]
struct SensitivityEpoch {
    start_ns: i64,
    end_ns: i64,
    per_si: f64,
}

impl Sensitivities {
    /// Returns the sensitivity at a time, or `None` if no epoch contains it.
    pub(crate) fn at(&self, time_ns: i64) -> Option<f64> {
        let epoch = self
            .0
            .iter()
            .find(|epoch| (epoch.start_ns..epoch.end_ns).contains(&time_ns))?;
        Some(epoch.per_si)
    }
}

/// An error in a StationXML file.
#[derive(Debug, thiserror::Error)]
pub enum StationXmlError {
    /// The file cannot be read, is not a regular file, or is too large.
    #[error("cannot be read: {0}")]
    Read(std::io::Error),
    /// The file is not XML.
    #[error("is not XML: {0}")]
    Xml(roxmltree::Error),
    /// The file has no channel.
    #[error("has no channel, must be StationXML of level channel or response")]
    Empty,
}

impl StationXml {
    /// Reads a file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, is not XML or has no channel.
    pub fn read(path: &Path) -> Result<Self, StationXmlError> {
        let read = read_text_up_to(path, MAX_FILE_BYTES);
        Self::parse(&read.map_err(StationXmlError::Read)?)
    }

    /// Reads the text of a file.
    ///
    /// # Errors
    /// Returns an error if the text is not XML or has no channel.
    pub fn parse(text: &str) -> Result<Self, StationXmlError> {
        let document = Document::parse(text).map_err(StationXmlError::Xml)?;
        let mut channels = Vec::new();
        for network in children(document.root_element(), "Network") {
            for station in children(network, "Station") {
                for channel in children(station, "Channel") {
                    channels.push(ChannelEpoch::read(network, station, channel));
                }
            }
        }
        match channels.is_empty() {
            true => Err(StationXmlError::Empty),
            false => Ok(Self { channels }),
        }
    }

    /// Returns the identifiers of the channels, each once.
    #[must_use]
    pub fn ids(&self) -> Vec<&str> {
        let mut ids: Vec<&str> = self
            .channels
            .iter()
            .map(|epoch| epoch.id.as_str())
            .collect();
        ids.dedup();
        ids
    }

    /// Returns the identifier that a name selects: the same identifier, or the only identifier with
    /// this channel code.
    pub(crate) fn id_of(&self, name: &str) -> Option<&str> {
        let ids = self.ids();
        if let Some(same) = ids.iter().find(|id| **id == name) {
            return Some(same);
        }
        let mut with_code = ids
            .into_iter()
            .filter(|id| id.rsplit('.').next() == Some(name));
        let only = with_code.next()?;
        with_code.next().is_none().then_some(only)
    }

    /// Returns the sensitivities of a channel in counts per `unit`, a unit of structure files.
    ///
    /// The error states a unit that differs.
    pub(crate) fn sensitivities(&self, id: &str, unit: &str) -> Result<Sensitivities, String> {
        let mut epochs = Vec::new();
        for epoch in self.channels.iter().filter(|epoch| epoch.id == id) {
            let Some(value) = epoch.value else {
                continue;
            };
            let factor = si_factor(&epoch.unit, unit)
                .ok_or_else(|| format!("has counts per {}", epoch.unit))?;
            epochs.push(SensitivityEpoch {
                start_ns: epoch.start_ns,
                end_ns: epoch.end_ns,
                per_si: value / factor,
            });
        }
        match epochs.is_empty() {
            true => Err("has no sensitivity of this channel".to_owned()),
            false => Ok(Sensitivities(epochs)),
        }
    }
}

impl ChannelEpoch {
    fn read(network: Node<'_, '_>, station: Node<'_, '_>, channel: Node<'_, '_>) -> Self {
        let code =
            |node: Node<'_, '_>| node.attribute("code").unwrap_or_default().trim().to_owned();
        let location = channel.attribute("locationCode").unwrap_or_default().trim();
        let date = |name: &str| {
            channel
                .attribute(name)
                .and_then(|text| parse_time_ns(text, TimeUnit::Seconds))
        };
        let sensitivity = children(channel, "Response")
            .flat_map(|response| children(response, "InstrumentSensitivity"))
            .next();
        let value = sensitivity.and_then(|found| children(found, "Value").next());
        let unit = sensitivity
            .and_then(|found| children(found, "InputUnits").next())
            .and_then(|units| children(units, "Name").next());
        Self {
            id: format!(
                "{}.{}.{location}.{}",
                code(network),
                code(station),
                code(channel)
            ),
            start_ns: date("startDate").unwrap_or(i64::MIN),
            end_ns: date("endDate").unwrap_or(i64::MAX),
            value: value
                .and_then(|value| value.text()?.trim().parse().ok())
                .filter(|value: &f64| value.is_finite() && *value != 0.0),
            unit: unit
                .and_then(|unit| unit.text())
                .unwrap_or_default()
                .trim()
                .to_owned(),
        }
    }
}

/// Returns the children with a local name, in any namespace.
fn children<'a, 'input: 'a>(
    node: Node<'a, 'input>,
    name: &'a str,
) -> impl Iterator<Item = Node<'a, 'input>> {
    node.children()
        .filter(move |child| child.is_element() && child.tag_name().name() == name)
}

/// Returns the size of a unit of StationXML in `unit`, a unit of structure files. Returns `None` if
/// they measure different quantities.
fn si_factor(found: &str, unit: &str) -> Option<f64> {
    let found = found.to_ascii_lowercase().replace(' ', "");
    let known: &[(&str, &[(&str, f64)])] = &[
        (
            "m/s2",
            &[
                ("m/s**2", 1.0),
                ("m/s^2", 1.0),
                ("m/s2", 1.0),
                ("m/s/s", 1.0),
                ("cm/s**2", 1e-2),
                ("mm/s**2", 1e-3),
                ("nm/s**2", 1e-9),
                ("g", 9.806_65),
            ],
        ),
        (
            "m/s",
            &[("m/s", 1.0), ("cm/s", 1e-2), ("mm/s", 1e-3), ("nm/s", 1e-9)],
        ),
        ("m", &[("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("nm", 1e-9)]),
        ("1", &[("m/m", 1.0), ("m**3/m**3", 1.0), ("1", 1.0)]),
        ("N", &[("n", 1.0)]),
    ];
    let (_, names) = known.iter().find(|(si, _)| *si == unit)?;
    let (_, factor) = names.iter().find(|(name, _)| *name == found)?;
    Some(*factor)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = r#"<?xml version="1.0"?>
<FDSNStationXML xmlns="http://www.fdsn.org/xml/station/1" schemaVersion="1.2">
  <Network code="AM"><Station code="R1234">
    <Channel code="ENZ" locationCode="00" startDate="2020-01-01T00:00:00Z" endDate="2021-01-01T00:00:00Z">
      <Response><InstrumentSensitivity><Value>384500.0</Value><Frequency>1.0</Frequency>
        <InputUnits><Name>M/S**2</Name></InputUnits></InstrumentSensitivity></Response>
    </Channel>
    <Channel code="ENZ" locationCode="00" startDate="2021-01-01T00:00:00Z">
      <Response><InstrumentSensitivity><Value>400000.0</Value><Frequency>1.0</Frequency>
        <InputUnits><Name>M/S**2</Name></InputUnits></InstrumentSensitivity></Response>
    </Channel>
    <Channel code="EHZ" locationCode="00" startDate="2020-01-01T00:00:00Z">
      <Response><InstrumentSensitivity><Value>3.6e8</Value>
        <InputUnits><Name>M/S</Name></InputUnits></InstrumentSensitivity></Response>
    </Channel>
  </Station></Network>
</FDSNStationXML>"#;

    #[test]
    fn each_epoch_has_its_sensitivity() {
        let file = StationXml::parse(FILE).unwrap();
        let id = file.id_of("ENZ").unwrap();
        assert_eq!(id, "AM.R1234.00.ENZ");
        let sensitivities = file.sensitivities(id, "m/s2").unwrap();
        // 2020-06-01, 2021-06-01 and 2019-06-01.
        assert_eq!(sensitivities.at(1_590_969_600_000_000_000), Some(384_500.0));
        assert_eq!(sensitivities.at(1_622_505_600_000_000_000), Some(400_000.0));
        assert_eq!(sensitivities.at(1_559_347_200_000_000_000), None);
    }

    #[test]
    fn velocity_sensor_is_no_accelerometer() {
        let file = StationXml::parse(FILE).unwrap();
        let wrong = file.sensitivities("AM.R1234.00.EHZ", "m/s2").unwrap_err();
        assert_eq!(wrong, "has counts per M/S");
        assert!(file.sensitivities("AM.R1234.00.EHZ", "m/s").is_ok());
    }

    #[test]
    fn text_that_is_no_station_xml_is_an_error() {
        for text in ["", "<a", "<a/>"] {
            assert!(StationXml::parse(text).is_err(), "{text}");
        }
    }
}
