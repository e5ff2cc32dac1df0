//! Recordings that are dropped into a folder, each read once, in the order of their times.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use spandrel_bus::is_without_date;
use spandrel_record::{ReadOptions, RecordedChannel, RecordedFile, TimeOrigin, write_whole};
use tokio::time::sleep;

use crate::connect::Outlet;
use crate::connect::growing_file::modified_ns;
use crate::connect::retry::Retry;
use crate::core_input::Link;
use crate::packet::Packet;
use crate::source_plan::DropFolder;

/// Interval at which the folder is listed. A file that has not changed since the last time is
/// complete.
const POLL: Duration = Duration::from_secs(1);
/// Maximum number of samples in a packet.
const PACKET: usize = 256;
/// Maximum number of files in the list of files that were read. The oldest are removed first.
const MAX_REMEMBERED: usize = 100_000;

/// A file that was read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Done {
    size: u64,
    modified_ns: i64,
    /// Time of its last sample, ns. Its samples are read again after a restart if ingest has not
    /// recorded them.
    end_ns: i64,
}

/// The names of the files that were read.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Memory {
    files: BTreeMap<String, Done>,
}

/// Reads recordings until the feed stops.
pub(crate) async fn read(plan: DropFolder, since_ns: Option<i64>, outlet: Outlet) {
    let mut retry = Retry::new();
    let mut memory = match Memory::read(&plan.memory) {
        Ok(memory) => memory,
        Err(why) => {
            outlet.failed(why).await;
            Memory::default()
        }
    };
    // A file whose samples ingest may lack is read again, once.
    if let Some(since_ns) = since_ns {
        memory.files.retain(|_, done| done.end_ns <= since_ns);
    }
    let mut seen = BTreeMap::new();
    let mut is_open = false;
    while !outlet.is_closed() {
        let present = match files(&plan.path, &plan.memory) {
            Ok(present) => present,
            Err(why) => {
                is_open = false;
                outlet.failed(why).await;
                retry.pause().await;
                continue;
            }
        };
        retry.reset();
        if !std::mem::replace(&mut is_open, true) {
            outlet.link(Link::Open).await;
        }
        let is_new = |name: &String, done: &Done| {
            memory.files.get(name).is_none_or(|known| {
                (known.size, known.modified_ns) != (done.size, done.modified_ns)
            })
        };
        let complete: Vec<(String, Done)> = present
            .iter()
            .filter(|(name, done)| seen.get(*name) == Some(*done) && is_new(name, done))
            .map(|(name, done)| (name.clone(), done.clone()))
            .collect();
        seen = present;
        if complete.is_empty() {
            sleep(POLL).await;
            continue;
        }
        if !read_all(&plan, complete, &mut memory, &outlet).await {
            return;
        }
    }
}

/// Reads files in the order of their times. Returns `false` if the feed stops.
///
/// Reads each of several files twice, first for its times and then for its samples. A folder can
/// contain more samples than fit into memory.
async fn read_all(
    plan: &DropFolder,
    complete: Vec<(String, Done)>,
    memory: &mut Memory,
    outlet: &Outlet,
) -> bool {
    let is_only = complete.len() == 1;
    let mut ordered = Vec::new();
    for (name, done) in complete {
        if is_only {
            ordered.push((0, name, done));
            continue;
        }
        match read_apart(plan, &name).await {
            Ok((_, start_ns, _)) => ordered.push((start_ns, name, done)),
            Err(why) => {
                if !refuse(why, name, done, memory, outlet).await {
                    return false;
                }
            }
        }
    }
    ordered.sort_by(|a, b| (a.0, &a.1).cmp(&(b.0, &b.1)));
    for (_, name, mut done) in ordered {
        let (channels, _, end_ns) = match read_apart(plan, &name).await {
            Ok(read) => read,
            Err(why) => match refuse(why, name, done, memory, outlet).await {
                true => continue,
                false => return false,
            },
        };
        for packet in packets(&channels) {
            if !outlet.packets(vec![packet]).await {
                return false;
            }
        }
        done.end_ns = end_ns;
        memory.files.insert(name, done);
        if let Err(why) = memory.write(&plan.memory) {
            outlet.malformed(why).await;
        }
    }
    true
}

/// Reads a file on a thread for blocking calls.
async fn read_apart(plan: &DropFolder, name: &str) -> Result<TimedChannels, String> {
    let (path, options) = (plan.path.join(name), plan.options.clone());
    let read = tokio::task::spawn_blocking(move || read_file(&path, &options)).await;
    // Reading does not panic. If it did, the panic hook has already reported the panic.
    read.unwrap_or_else(|_| Err(format!("{name}: cannot be read")))
}

/// Remembers and reports a file that cannot be read. Returns `false` if the feed stops.
async fn refuse(
    why: String,
    name: String,
    mut done: Done,
    memory: &mut Memory,
    outlet: &Outlet,
) -> bool {
    done.end_ns = i64::MIN;
    memory.files.insert(name, done);
    outlet.malformed(why).await
}

/// The channels of a file, and the times of its first and last sample, ns.
type TimedChannels = (Vec<RecordedChannel>, i64, i64);

/// Returns the channels of a file, and the times of its first and last sample, ns.
fn read_file(path: &Path, options: &ReadOptions) -> Result<TimedChannels, String> {
    let file = RecordedFile::read(path, options).map_err(|error| with_causes(&error))?;
    let channels = file.channels().to_vec();
    let name = path.display();
    // Numeric times of a table may be seconds since 1970 or since its start.
    let has_no_date = |channel: &RecordedChannel| {
        channel.origin() == TimeOrigin::Start && channel.start_ns().is_none_or(is_without_date)
    };
    if channels.iter().any(has_no_date) {
        return Err(format!(
            "{name}: has no date, must state the date of its samples"
        ));
    }
    let start_ns = channels.iter().filter_map(RecordedChannel::start_ns).min();
    let end_ns = channels.iter().filter_map(RecordedChannel::end_ns).max();
    match (start_ns, end_ns) {
        (Some(start_ns), Some(end_ns)) => Ok((channels, start_ns, end_ns)),
        _ => Err(format!("{name}: has no samples with times")),
    }
}

/// Cuts the channels into packets in the order of their times, so that the channels advance
/// together.
fn packets(channels: &[RecordedChannel]) -> Vec<Packet> {
    let mut packets = Vec::new();
    for channel in channels {
        let Some(rate_hz) = channel.sampling_rate_hz() else {
            continue;
        };
        for segment in channel.segments() {
            for (index, values) in segment.samples().chunks(PACKET).enumerate() {
                let offset_ns = ((index * PACKET) as f64 * 1e9 / rate_hz).round() as i64;
                packets.push(Packet {
                    label: channel.name().to_owned(),
                    start_ns: Some(segment.start_ns().saturating_add(offset_ns)),
                    rate_hz: Some(rate_hz),
                    clock_quality: channel.clock_quality(),
                    values: values.to_vec(),
                });
            }
        }
    }
    packets.sort_by_key(|packet| packet.start_ns);
    packets
}

/// Returns an error with all its causes.
fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

/// Returns the files of a folder, without hidden ones.
fn files(folder: &Path, memory: &Path) -> Result<BTreeMap<String, Done>, String> {
    let failed = |error| format!("cannot read the folder {}: {error}", folder.display());
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with('.') || entry.path() == memory {
            continue;
        }
        // A file may disappear meanwhile.
        let Ok(metadata) = std::fs::metadata(entry.path()) else {
            continue;
        };
        if metadata.is_file() {
            let done = Done {
                size: metadata.len(),
                modified_ns: modified_ns(&metadata),
                end_ns: 0,
            };
            files.insert(name, done);
        }
    }
    Ok(files)
}

impl Memory {
    fn read(path: &Path) -> Result<Self, String> {
        let failed = |why: &dyn std::fmt::Display| {
            format!(
                "cannot use {}, so all files are read again: {why}",
                path.display()
            )
        };
        match std::fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|error| failed(&error)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(failed(&error)),
        }
    }

    /// Writes the names to a new file, and replaces the old one by it.
    fn write(&mut self, path: &Path) -> Result<(), String> {
        while self.files.len() > MAX_REMEMBERED {
            let oldest = self.files.iter().min_by_key(|(_, done)| done.end_ns);
            let Some(oldest) = oldest.map(|(name, _)| name.clone()) else {
                break;
            };
            self.files.remove(&oldest);
        }
        let failed =
            |why: &dyn std::fmt::Display| format!("cannot write {}: {why}", path.display());
        let bytes = serde_json::to_vec(self).map_err(|error| failed(&error))?;
        write_whole(path, &bytes).map_err(|error| failed(&error))
    }
}
