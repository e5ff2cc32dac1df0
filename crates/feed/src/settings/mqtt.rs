//! Reads the keys of an MQTT source.

use std::path::Path;

use serde_json::Value;
use spandrel_bus::read_small_text;

use super::Reading;
use super::kind::{Columns, line_format};
use crate::lines::{RawFormat, RawNumber};
use crate::mistake::Mistake;
use crate::section::Section;
use crate::source_plan::{Login, MqttSession, MqttTopic, Payload, SourceKind};

impl Reading<'_> {
    /// Reads the keys of an MQTT topic.
    pub(super) fn mqtt(
        &mut self,
        section: &mut Section<'_>,
        address: Option<String>,
        labels: Vec<String>,
    ) -> Option<SourceKind> {
        let mistakes = &mut self.mistakes;
        let topic = section.required_text("topic", "must be a topic filter", mistakes);
        let client_id = section.text("client-id", mistakes);
        let login = login(section, &self.folder, mistakes);
        let payload = match section.peek("format").and_then(Value::as_str) {
            Some("raw") => raw_format(section, &labels, mistakes).map(Payload::Raw),
            _ => line_format(section, labels, Columns::Declared, mistakes).map(Payload::Lines),
        };
        let address = address?;
        let (host, port) = address.rsplit_once(':')?;
        Some(SourceKind::Mqtt(MqttTopic {
            host: host.to_owned(),
            port: port.parse().ok()?,
            topic: topic?,
            client_id: client_id.unwrap_or_default(),
            session: MqttSession::Kept,
            login: login?,
            payload: payload?,
        }))
    }
}

/// Types of the numbers of an array.
const NUMBERS: [(&str, RawNumber); 4] = [
    ("i16", RawNumber::I16),
    ("i32", RawNumber::I32),
    ("f32", RawNumber::F32),
    ("f64", RawNumber::F64),
];

/// Reads the format of an array of numbers.
fn raw_format(
    section: &mut Section<'_>,
    labels: &[String],
    mistakes: &mut Vec<Mistake>,
) -> Option<RawFormat> {
    section.text("format", mistakes);
    let before = mistakes.len();
    let number = section.choice("number", &NUMBERS, mistakes);
    if number.is_none() && mistakes.len() == before {
        let allowed = crate::section::one_of(&NUMBERS);
        section.report("number", "is missing", allowed, mistakes);
    }
    let before = mistakes.len();
    let columns = section.texts("columns", mistakes);
    if columns.is_none() && mistakes.len() == before {
        let allowed = "must name the numbers of a row in their order, such as [\"ax\", \"ay\"]";
        section.report("columns", "is missing", allowed, mistakes);
    }
    let columns = columns?;
    for label in labels.iter().filter(|label| !columns.contains(label)) {
        let found = format!("has source \"{label}\"");
        let allowed = format!("must be one of the columns {}", columns.join(", "));
        section.report("channel", found, allowed, mistakes);
    }
    Some(RawFormat {
        number: number?,
        columns,
    })
}

/// Reads user and password. Returns `None` after a mistake.
fn login(
    section: &mut Section<'_>,
    folder: &Path,
    mistakes: &mut Vec<Mistake>,
) -> Option<Option<Login>> {
    let user = section.text("user", mistakes);
    let file = section.text("password-file", mistakes);
    let (user, file) = match (user, file) {
        (None, None) => return Some(None),
        (Some(user), Some(file)) => (user, folder.join(file)),
        (Some(_), None) => {
            let allowed = "must be a file with the password of the user";
            section.report("password-file", "is missing", allowed, mistakes);
            return None;
        }
        (None, Some(_)) => {
            section.report(
                "user",
                "is missing",
                "must be the user of the password",
                mistakes,
            );
            return None;
        }
    };
    match read_small_text(&file) {
        Ok(password) => Some(Some(Login {
            user,
            password: password.trim_end_matches(['\n', '\r']).to_owned(),
        })),
        Err(error) => {
            let found = format!("is {}, which cannot be read: {error}", file.display());
            let allowed = "must be a file with the password of the user";
            section.report("password-file", found, allowed, mistakes);
            None
        }
    }
}
