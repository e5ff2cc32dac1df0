//! The seeds of the fuzz targets, decoded by the code of the targets, as they are and damaged.
//!
//! No input may cause a panic, or take more memory than its size explains.

#[path = "../fuzz/decoders/checkpoint.rs"]
mod checkpoint;
#[path = "../fuzz/decoders/frame_log.rs"]
mod frame_log;
#[path = "../fuzz/decoders/messages.rs"]
mod messages;
#[path = "../fuzz/decoders/recording.rs"]
mod recording;
#[path = "../fuzz/decoders/structure_file.rs"]
mod structure_file;

use crate::mutated::{Raw, identity, keep_silent_of_what_is_caught, of_identification};
use crate::support::mutation::{SEEDS, damaged};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use spandrel_checkpoint::Refusal;
use spandrel_identify::IdentificationState;
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Reason for the rejection of a state whose decoder panics, as the product of huge sizes does.
const IMPLAUSIBLE: &str = "it contains an implausible number";

/// One input of a fuzz target.
struct Seed {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl Seed {
    fn name(&self) -> &str {
        self.path.file_name().unwrap().to_str().unwrap()
    }
}

/// The memory that a decoder may take.
struct Memory {
    /// For buffers of fixed size, bytes.
    fixed_bytes: u64,
    /// For each byte of the input, bytes.
    per_byte: u64,
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Returns all files below a folder, in the order of their names.
fn seeds(folder: &str) -> Vec<Seed> {
    let mut paths = vec![repository().join(folder)];
    let mut seeds = Vec::new();
    while let Some(path) = paths.pop() {
        if path.is_dir() {
            let entries = std::fs::read_dir(path).unwrap();
            paths.extend(entries.map(|entry| entry.unwrap().path()));
        } else {
            let bytes = std::fs::read(&path).unwrap();
            seeds.push(Seed { path, bytes });
        }
    }
    seeds.sort_by(|a, b| a.path.cmp(&b.path));
    assert!(!seeds.is_empty(), "{folder} is empty");
    seeds
}

/// Returns a folder in memory if possible, because these tests write thousands of files.
fn quick_folder() -> TempDir {
    tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap()
}

/// Decodes each seed, and `copies` damaged copies of it for each number in [`SEEDS`]. Returns the
/// names of the seeds that are accepted.
fn replay<'a>(
    seeds: &'a [Seed],
    copies: usize,
    memory: &Memory,
    decode: impl Fn(&[u8]) -> Result<(), String>,
) -> Vec<&'a str> {
    let (mut most_bytes, mut decoded) = (0, 0);
    let mut bounded = |case: &str, bytes: &[u8]| {
        let mut found = None;
        let taken = allocation_counter::measure(|| found = Some(decode(bytes)));
        let allowed = memory.fixed_bytes + memory.per_byte * bytes.len() as u64;
        assert!(
            taken.bytes_max <= allowed,
            "{case}: {} bytes took {} in memory, allowed are {allowed}",
            bytes.len(),
            taken.bytes_max
        );
        most_bytes = most_bytes.max(taken.bytes_max);
        let found = found.unwrap();
        assert_ne!(found, Err(String::new()), "{case}: a reason");
        found.is_ok()
    };
    let mut accepted = Vec::new();
    for seed in seeds {
        let path = seed.path.display();
        if bounded(&path.to_string(), &seed.bytes) {
            accepted.push(seed.name());
        }
        for number in SEEDS {
            let mut random = ChaCha8Rng::seed_from_u64(number);
            for copy in 0..copies {
                let case = format!("{path}, copy {copy} of seed {number}");
                let bytes = damaged(&seed.bytes, &mut random);
                decoded += usize::from(bounded(&case, &bytes));
            }
        }
    }
    println!(
        "{} of {} seeds accepted, and {decoded} of {} damaged copies; at most {most_bytes} bytes \
         of memory",
        accepted.len(),
        seeds.len(),
        seeds.len() * SEEDS.len() * copies
    );
    accepted
}

/// A target or a folder of seeds without a test here would never be replayed.
#[test]
fn each_fuzz_target_and_each_folder_of_seeds_is_replayed() {
    let names = |folder: &str| -> Vec<String> {
        let entries = std::fs::read_dir(repository().join(folder)).unwrap();
        let paths = entries.map(|entry| entry.unwrap().path());
        let mut names: Vec<String> = paths
            .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        names.sort();
        names
    };
    let replayed = [
        "checkpoint",
        "frame_log",
        "messages",
        "recording",
        "structure_file",
    ];
    assert_eq!(names("fuzz/fuzz_targets"), replayed);
    assert_eq!(names("fuzz/seeds"), replayed);
}

#[test]
fn seeds_of_messages_are_decoded_or_rejected() {
    let memory = Memory {
        fixed_bytes: 4 << 20,
        per_byte: 40,
    };
    let seeds = seeds("fuzz/seeds/messages");
    let accepted = replay(&seeds, 40, &memory, messages::decode);
    assert!(accepted.len() >= messages::TYPES.len(), "{accepted:?}");
}

#[test]
fn seeds_of_structure_files_and_all_examples_are_parsed_or_rejected() {
    let memory = Memory {
        fixed_bytes: 4 << 20,
        per_byte: 40,
    };
    let mut seeds = seeds("fuzz/seeds/structure_file");
    seeds.extend(self::seeds("docs/examples"));
    let accepted = replay(&seeds, 10, &memory, structure_file::decode);
    assert!(accepted.contains(&"demo.toml"), "{accepted:?}");
}

#[test]
fn seeds_of_recordings_are_read_or_rejected() {
    let memory = Memory {
        fixed_bytes: 6 << 20,
        per_byte: 12,
    };
    let folder = quick_folder();
    let seeds = seeds("fuzz/seeds/recording");
    let decode = |bytes: &[u8]| recording::decode(folder.path(), bytes);
    let accepted = replay(&seeds, 100, &memory, decode);
    assert_eq!(accepted.len(), seeds.len(), "{accepted:?}");
}

#[test]
fn seeds_of_segments_are_repaired_or_rejected() {
    let memory = Memory {
        fixed_bytes: 6 << 20,
        per_byte: 12,
    };
    let folder = quick_folder();
    let seeds = seeds("fuzz/seeds/frame_log");
    let decode = |bytes: &[u8]| frame_log::decode(folder.path(), bytes);
    let accepted = replay(&seeds, 50, &memory, decode);
    assert_eq!(accepted, ["closed", "torn"]);
}

/// The seeds are states in the present layout. `UPDATE_DOCS=1` writes them.
#[test]
fn seeds_of_checkpoints_are_restored_or_rejected() {
    keep_silent_of_what_is_caught();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        write_checkpoint_seeds();
    }
    let memory = Memory {
        fixed_bytes: 4 << 20,
        per_byte: 40,
    };
    let folder = quick_folder();
    let decoder = checkpoint::Decoder::new(folder.path());
    let seeds = seeds("fuzz/seeds/checkpoint");
    let accepted = replay(&seeds, 100, &memory, |bytes| decoder.decode(bytes));
    assert_eq!(
        accepted,
        ["identify-sealed", "identify-state", "identify-whole"]
    );
    // Regression: with overflow checks, such a state terminated the service at each start.
    let overflowing = seeds.iter().find(|seed| seed.name() == "identify-overflow");
    let reason = decoder.decode(&overflowing.unwrap().bytes).unwrap_err();
    assert!(reason.contains(IMPLAUSIBLE), "{reason}");
}

/// Writes a checkpoint of `identify` in each form that the decoder takes, and a state in which the
/// sizes of a matrix overflow.
fn write_checkpoint_seeds() {
    /// Encoding of a length of 2⁶⁴−1.
    const HUGE: [u8; 10] = [0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x01];
    let structure =
        Structure::read(&repository().join("tests/fixtures/kept/0.1.0/structure.toml")).unwrap();
    let identity = identity("identify", IdentificationState::VERSION, &structure);
    let state = of_identification(&structure);
    let whole = identity.seal(&state).unwrap();
    let content = postcard::to_stdvec(&state).unwrap();
    let with_huge_length = |at: usize| {
        let mut content = content.clone();
        content.splice(at..=at, HUGE);
        content
    };
    let overflows = |content: &Vec<u8>| {
        let sealed = identity.seal(&Raw(content.clone())).unwrap();
        let opened = identity.open::<IdentificationState>(&sealed);
        matches!(opened, Err(Refusal::Content(reason)) if reason == IMPLAUSIBLE)
    };
    let mut damaged = (0..content.len()).map(with_huge_length);
    let overflow = damaged.find(overflows).unwrap();
    let folder = repository().join("fuzz/seeds/checkpoint");
    for (name, kind, bytes) in [
        ("identify-whole", 0, &whole[..]),
        ("identify-sealed", 1, &whole[8..whole.len() - 32]),
        ("identify-state", 2, &content),
        ("identify-overflow", 2, &overflow),
    ] {
        std::fs::write(folder.join(name), [&[kind], bytes].concat()).unwrap();
    }
}
