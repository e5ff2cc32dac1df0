//! The layout stated in the channel metadata of each segment.

use std::collections::BTreeMap;
use std::path::Path;

use super::LogLayout;
use crate::RecordError;

/// Topic of the frames.
pub(super) const TOPIC: &str = "frames";
const STRUCTURE: &str = "structure";
const CHANNELS: &str = "channels";
const NODES: &str = "nodes";
const SAMPLING_RATE: &str = "sampling_rate_hz";
const BOOT_ID: &str = "boot_id";

/// The content of the channel metadata.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StatedLayout {
    pub(crate) layout: LogLayout,
    /// Identifier of the machine boot during which the segment was written; empty if unknown.
    pub(super) boot_id: String,
}

impl StatedLayout {
    pub(super) fn metadata(&self) -> BTreeMap<String, String> {
        let names = |names: &[String]| serde_json::Value::from(names.to_vec()).to_string();
        let stated = [
            (STRUCTURE, self.layout.structure.clone()),
            (CHANNELS, names(&self.layout.channels)),
            (NODES, names(&self.layout.nodes)),
            (SAMPLING_RATE, self.layout.sampling_rate_hz.to_string()),
            (BOOT_ID, self.boot_id.clone()),
        ];
        stated
            .into_iter()
            .map(|(key, text)| (key.to_owned(), text))
            .collect()
    }

    /// Parses the metadata. Returns `None` if an entry is missing or invalid.
    pub(crate) fn from_metadata(metadata: &BTreeMap<String, String>) -> Option<Self> {
        let names = |key: &str| serde_json::from_str::<Vec<String>>(metadata.get(key)?).ok();
        let layout = LogLayout {
            structure: metadata.get(STRUCTURE)?.clone(),
            channels: names(CHANNELS)?,
            nodes: names(NODES)?,
            sampling_rate_hz: metadata.get(SAMPLING_RATE)?.parse().ok()?,
        };
        Some(Self {
            layout,
            boot_id: metadata.get(BOOT_ID).cloned().unwrap_or_default(),
        })
    }
}

impl LogLayout {
    /// Returns an error if `found`, the layout of `folder`, differs from this layout.
    pub(super) fn agree(&self, found: &Self, folder: &Path) -> Result<(), RecordError> {
        let list = |names: &[String]| format!("{names:?}");
        let rate = |layout: &Self| format!("{} Hz", layout.sampling_rate_hz);
        let parts = [
            ("structure", found.structure.clone(), self.structure.clone()),
            ("channels", list(&found.channels), list(&self.channels)),
            ("nodes", list(&found.nodes), list(&self.nodes)),
            ("sampling rate", rate(found), rate(self)),
        ];
        match parts
            .into_iter()
            .find(|(_, found, expected)| found != expected)
        {
            None => Ok(()),
            Some((what, found, expected)) => Err(RecordError::OtherLog {
                folder: folder.to_owned(),
                what,
                found,
                expected,
            }),
        }
    }
}

/// Returns the identifier of the current boot, or an empty string if it is unknown.
pub(super) fn boot_id() -> String {
    std::fs::read_to_string("/proc/sys/kernel/random/boot_id")
        .map(|id| id.trim().to_owned())
        .unwrap_or_default()
}
