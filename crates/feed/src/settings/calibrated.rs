//! Reads the conversion of a channel to SI units.

use std::path::Path;

use super::{ChannelPlace, Reading};
use crate::calibration::Calibration;
use crate::section::Section;
use crate::station_xml::StationXml;

impl Reading<'_> {
    /// Reads the conversion. The unit is that of `place`.
    pub(super) fn calibration(
        &mut self,
        section: &mut Section<'_>,
        label: Option<&str>,
        place: Option<&ChannelPlace>,
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
}
