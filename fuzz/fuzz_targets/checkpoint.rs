//! Reads checkpoints: arbitrary files, and files with a valid label and checksum, so that their content is parsed.

#![no_main]

use libfuzzer_sys::fuzz_target;
use sha2::{Digest, Sha256};
use spandrel_checkpoint::{Checkpoints, Identity, Place};
use spandrel_identify::{Identification, IdentificationState};
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

const STRUCTURE: &str = include_str!("../../tests/fixtures/kept/0.1.0/structure.toml");
const PLACE: Place = Place { epoch: 1, sequence: 0 };
/// Bytes at the end of a file: SHA-256 of all before.
const CHECKSUM_BYTES: usize = 32;

struct Bench {
    structure: Structure,
    checkpoints: Checkpoints,
    file: PathBuf,
    /// The bytes before the state of a file that may be read.
    label: Vec<u8>,
}

static BENCH: LazyLock<Bench> = LazyLock::new(|| {
    // a panic that is caught where a checkpoint is read is a refusal; the fuzzer's own hook would end at it. One that is not
    // caught there ends the fuzzer all the same.
    std::panic::set_hook(Box::new(|_| {}));
    let structure = Structure::parse(STRUCTURE, Path::new("structure.toml")).expect("the structure file is sound");
    let shared = PathBuf::from("/dev/shm");
    let folder = if shared.is_dir() { shared } else { std::env::temp_dir() };
    let folder = folder.join(format!("spandrel-fuzz-checkpoint-{}", std::process::id()));
    let identity = Identity {
        kind: "identify",
        version: IdentificationState::VERSION,
        of: structure.name().to_owned(),
        basis: structure.identification_basis(),
    };
    let checkpoints = Checkpoints::open(&folder, identity).expect("the folder of temporary files can be written");
    checkpoints.save(PLACE, &()).expect("a file can be written");
    let file = folder.join(format!("identify-{:020}-{:020}.checkpoint", PLACE.epoch, PLACE.sequence));
    let mut label = std::fs::read(&file).expect("it is there");
    label.truncate(label.len() - CHECKSUM_BYTES); // the state of it is nothing
    Bench { structure, checkpoints, file, label }
});

fuzz_target!(|bytes: &[u8]| {
    let Some((kind, content)) = bytes.split_first() else { return };
    let bench = &*BENCH;
    let mut file = match kind % 3 {
        0 => content.to_vec(),
        1 => [b"spandrel", content].concat(),
        _ => [&bench.label, content].concat(),
    };
    if kind % 3 > 0 {
        let checksum: [u8; CHECKSUM_BYTES] = Sha256::digest(&file).into();
        file.extend(checksum);
    }
    std::fs::write(&bench.file, &file).expect("the folder of temporary files can be written");
    let loaded = bench.checkpoints.load_latest::<IdentificationState>();
    match loaded.found {
        None => assert!(!bench.file.exists() && loaded.refused.iter().all(|(_, why)| !why.to_string().is_empty())),
        Some((place, state)) => {
            assert_eq!(place, PLACE);
            let mut core = Identification::new(&bench.structure, "identify").expect("the structure is sound");
            match core.restore(state) {
                Ok(()) => drop(core.state()),
                Err(error) => assert!(!error.to_string().is_empty()),
            }
        }
    }
});
