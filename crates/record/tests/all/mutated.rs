//! Damages a segment of a real recording in many ways. Reading must return only frames that were
//! written, and memory must stay in proportion to the file size.

use crate::mutation::{SEEDS, damaged};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use spandrel_record::{FrameLog, LogLayout, LogSettings, ReadOptions, RecordedFile};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Number of damaged files per seed.
const FILES: usize = 300;
/// Memory for buffers of fixed size while reading, in bytes.
const BUFFERS_BYTES: u64 = 6 << 20;
/// Maximum ratio of other memory to the file size: its bytes, its values, and lists that have
/// doubled.
const TIMES_THE_FILE: u64 = 12;

/// Bits of the values of each frame, by epoch and number.
type Frames = BTreeMap<(u64, u64), Vec<u64>>;

/// Returns the segment written by version 0.1.0.
fn kept() -> (String, Vec<u8>) {
    let folder = "../../tests/fixtures/kept/0.1.0/state/spandrel/kept/house/recording";
    let files = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)).unwrap();
    let paths = files.map(|file| file.unwrap().path());
    let path = paths
        .filter(|path| path.extension().is_some_and(|ending| ending == "mcap"))
        .max()
        .unwrap();
    (
        path.file_name().unwrap().to_str().unwrap().to_owned(),
        std::fs::read(path).unwrap(),
    )
}

/// Returns the layout of its structure file.
fn layout() -> LogLayout {
    let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    LogLayout {
        structure: "house".to_owned(),
        channels: names(&["ground", "floor-1", "roof", "roof-velocity"]),
        nodes: names(&["ground", "floor-1", "roof"]),
        sampling_rate_hz: 100.0,
    }
}

/// Returns a folder in memory if possible, because these tests open and repair hundreds of logs.
fn quick_folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap()
}

/// Returns all frames in a log with this single segment, or an error message if it is rejected as a
/// whole.
fn read(folder: &Path, name: &str, bytes: &[u8]) -> Result<Frames, String> {
    std::fs::write(folder.join(name), bytes).unwrap();
    let (log, _) = FrameLog::open(folder, layout(), LogSettings::default())
        .map_err(|error| error.to_string())?;
    let reader = log.reader();
    let mut frames = Frames::new();
    for span in reader.spans() {
        let mut after = span.from;
        while let Some(answer) = reader.read(span.epoch, after, 100, 1 << 20).unwrap() {
            assert!(answer.epoch == span.epoch && answer.sequence >= after);
            let rows = answer.values.chunks_exact(usize::from(answer.channels));
            let rows = rows.map(|row| row.iter().map(|value| value.to_bits()).collect());
            frames.extend(
                (answer.sequence..)
                    .map(|number| (span.epoch, number))
                    .zip(rows),
            );
            if answer.end() <= after {
                // Only the end of the epoch is left.
                break;
            }
            after = answer.end();
        }
    }
    Ok(frames)
}

/// Runs `work` and checks its memory use.
#[track_caller]
fn within_memory<T>(what: &str, file_bytes: usize, work: impl FnOnce() -> T) -> T {
    let mut result = None;
    let taken = allocation_counter::measure(|| result = Some(work()));
    let allowed = BUFFERS_BYTES + TIMES_THE_FILE * file_bytes as u64;
    assert!(
        taken.bytes_max <= allowed,
        "{what}: {file_bytes} bytes took {} in memory",
        taken.bytes_max
    );
    result.unwrap()
}

#[test]
fn a_damaged_segment_is_read_unchanged_or_rejected() {
    let (name, bytes) = kept();
    let folder = quick_folder();
    let truth = read(folder.path(), &name, &bytes).unwrap();
    assert_eq!(truth.len(), 800);
    let (mut whole, mut in_part, mut without) = (0, 0, 0);
    for seed in SEEDS {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        for number in 0..FILES {
            let file = damaged(&bytes, &mut random);
            let case = format!("file {number} of seed {seed}");
            let folder = quick_folder();
            match within_memory(&case, file.len(), || read(folder.path(), &name, &file)) {
                Ok(frames) => {
                    for (place, row) in &frames {
                        assert_eq!(truth.get(place), Some(row), "{case}: frame {place:?}");
                    }
                    match frames.len() {
                        0 => without += 1,
                        800 => whole += 1,
                        _ => in_part += 1,
                    }
                }
                Err(error) => {
                    assert!(
                        error.contains(folder.path().to_str().unwrap()),
                        "{case}: {error}"
                    );
                    without += 1;
                }
            }
        }
    }
    println!("{whole} segments had all of their frames, {in_part} some, {without} none");
    assert!(
        whole > 0 && in_part > FILES && without < in_part,
        "{whole} {in_part} {without}"
    );
}

#[test]
fn a_damaged_segment_gives_a_recording_or_an_error_message() {
    let (name, bytes) = kept();
    let folder = quick_folder();
    let path: PathBuf = folder.path().join(name);
    let (mut read, mut refused) = (0, 0);
    for seed in SEEDS {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        for number in 0..FILES {
            let file = damaged(&bytes, &mut random);
            std::fs::write(&path, &file).unwrap();
            let case = format!("file {number} of seed {seed}");
            match within_memory(&case, file.len(), || {
                RecordedFile::read(&path, &ReadOptions::default())
            }) {
                Ok(_) => read += 1,
                Err(error) => {
                    assert!(
                        error.to_string().contains(path.to_str().unwrap()),
                        "{case}: {error}"
                    );
                    refused += 1;
                }
            }
        }
    }
    println!("{read} segments were recordings, {refused} were refused");
    assert!(read > 0 && refused > 0, "{read} {refused}");
}
