//! Times the frame log beside the writer of the crate `mcap`, with a chunk for each block of live
//! frames, for a hundred structures. Prints a table.
//!
//! ```sh
//! cargo run --release --manifest-path crates/bench/libraries/Cargo.toml --bin recording
//! ```

use mcap::WriteOptions;
use mcap::records::MessageHeader;
use spandrel_record::{FrameLog, LogLayout, LogSettings, LoggedFrames};
use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Instant;

const STRUCTURES: usize = 100;
/// Blocks per structure, which fill no segment.
const BLOCKS: u64 = 4000;
/// Frames of a block: 50 ms at 100 Hz.
const FRAMES: u64 = 5;
const CHANNELS: usize = 6;
/// Bytes of a message before its values, as in the frame log.
const HEAD: usize = 50;

fn block(number: u64) -> LoggedFrames {
    LoggedFrames {
        source: "ingest".to_owned(),
        epoch: 1,
        sequence: number * FRAMES,
        t0_ns: 1_700_000_000_000_000_000,
        sampling_rate_hz: 100.0,
        channels: CHANNELS as u16,
        values: (0..FRAMES as usize * CHANNELS)
            .map(|index| (index as f64 + number as f64).sin())
            .collect(),
        ended: false,
        nodes: Vec::new(),
    }
}

fn names(what: &str, count: usize) -> Vec<String> {
    (0..count).map(|number| format!("{what}{number}")).collect()
}

/// Returns the resident memory of this process, MB.
fn memory_mb() -> Result<f64, Box<dyn Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find(|line| line.starts_with("VmRSS"));
    let kilobytes = line.and_then(|line| line.split_whitespace().nth(1));
    Ok(kilobytes.ok_or("no VmRSS")?.parse::<f64>()? / 1024.0)
}

/// Appends all blocks to all logs, closes the logs, and prints a row.
fn measure<L>(
    name: &str,
    folder: &Path,
    open: impl Fn(&Path) -> Result<L, Box<dyn Error>>,
    append: impl Fn(&mut L, &LoggedFrames) -> Result<(), Box<dyn Error>>,
    close: impl Fn(L) -> Result<(), Box<dyn Error>>,
) -> Result<(), Box<dyn Error>> {
    let before_mb = memory_mb()?;
    let mut logs = names("structure-", STRUCTURES)
        .iter()
        .map(|name| open(&folder.join(name)))
        .collect::<Result<Vec<L>, _>>()?;
    let start = Instant::now();
    for number in 0..BLOCKS {
        let block = block(number);
        for log in &mut logs {
            append(log, &block)?;
        }
    }
    let of_append = start.elapsed().as_secs_f64() / (BLOCKS as f64 * STRUCTURES as f64);
    let more_mb = memory_mb()? - before_mb;
    let start = Instant::now();
    for log in logs {
        close(log)?;
    }
    let of_close = start.elapsed().as_secs_f64() / STRUCTURES as f64;
    println!(
        "| {name} | {:.1} | {more_mb:.1} | {:.1} |",
        of_append * 1e6,
        of_close * 1e3
    );
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let [first, second] = [tempfile::tempdir()?, tempfile::tempdir()?];
    println!("| writer | append µs | memory of {STRUCTURES} MB | close ms |\n|---|---|---|---|");
    measure(
        "frame log",
        first.path(),
        |path| {
            let layout = LogLayout {
                structure: "building".to_owned(),
                channels: names("channel-", CHANNELS),
                nodes: names("node-", 1),
                sampling_rate_hz: 100.0,
            };
            // The first segment of a log is shorter. At ten times the time, it is not full either.
            let settings = LogSettings {
                segment_s: 36_000,
                ..LogSettings::default()
            };
            Ok(FrameLog::open(path, layout, settings)?.0)
        },
        |log, block| Ok(log.append(std::slice::from_ref(block))?),
        |log| Ok(log.close()?),
    )?;
    measure(
        "`mcap::Writer`",
        second.path(),
        |path| {
            let file = BufWriter::new(File::create(path)?);
            let mut writer = WriteOptions::new().compression(None).create(file)?;
            let schema = writer.add_schema("frames", "text/plain", b"frames")?;
            let channel = writer.add_channel(schema, "frames", "frames", &Default::default())?;
            Ok((writer, channel))
        },
        |(writer, channel), block| {
            let mut message = vec![0; HEAD];
            message.extend(block.values.iter().flat_map(|value| value.to_le_bytes()));
            let header = MessageHeader {
                channel_id: *channel,
                sequence: 0,
                log_time: block.sequence,
                publish_time: block.sequence,
            };
            writer.write_to_known_channel(&header, &message)?;
            Ok(writer.flush()?)
        },
        |(mut writer, _)| {
            writer.finish()?;
            Ok(())
        },
    )
}
