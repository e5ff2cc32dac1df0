//! Checkpoints of each identifying service, damaged in many ways.
//!
//! The service must set a damaged checkpoint aside and use the preceding one. Even an invalid state
//! with a correct checksum must not cause a panic. It must not need more memory than the size of
//! the file explains.

use crate::support::mutation::{SEEDS, damaged};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::de::DeserializeOwned;
use serde::ser::SerializeTuple;
use serde::{Serialize, Serializer};
use spandrel_bus::{
    FrameBlock, Header, LocalDensity, LocalMessage, NodeLineage, Pace, SampleBlock, StreamState,
};
use spandrel_checkpoint::{Checkpoints, Identity, Position, Refusal};
use spandrel_fuse::{Fusion, FusionState};
use spandrel_identify::{
    Identification, IdentificationState, NodeIdentification, NodeIdentificationState, NodeInput,
};
use spandrel_structure::Structure;
use std::path::Path;
use std::sync::Once;

/// Number of damaged files for each seed and kind.
const FILES: usize = 200;
/// Limits of the memory for decoding: a fixed number of bytes, and bytes per byte of the file.
/// Messages have the same limits.
const RESERVED_BYTES: u64 = 4 << 20;
const BYTES_PER_BYTE: u64 = 40;

const BEFORE: Position = Position {
    epoch: 1,
    sequence: 100,
};
const NEWEST: Position = Position {
    epoch: 1,
    sequence: 200,
};

pub fn identity(kind: &'static str, version: u16, structure: &Structure) -> Identity {
    Identity {
        kind,
        version,
        of: structure.name().to_owned(),
        basis: structure.identification_basis(),
    }
}

fn distributed() -> Structure {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo-distributed.toml");
    Structure::read(&path).unwrap()
}

/// Returns the state of the identification after three seconds of frames.
pub fn of_identification(structure: &Structure) -> IdentificationState {
    let mut core = Identification::new(structure, "identify").unwrap();
    let block = FrameBlock {
        header: Header {
            source: "ingest".into(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        t0_ns: 0,
        sampling_rate_hz: structure.sampling_rate_hz(),
        channels: structure.channel_count() as u16,
        values: structure
            .simulator(1)
            .take(300)
            .flat_map(|frame| frame.values)
            .collect(),
        state: StreamState::Running,
    };
    core.handle(
        spandrel_identify::IdentificationInput::Frames(block),
        &mut Vec::new(),
    );
    assert_eq!(core.done(), 300);
    core.state()
}

/// Returns the state of a worker after three seconds of samples.
fn of_node(structure: &Structure) -> NodeIdentificationState {
    let mut core = NodeIdentification::new(structure, 0, 5).unwrap();
    let node = &structure.nodes()[0];
    let rate_hz = structure.of_node(node.name()).unwrap().sampling_rate_hz();
    let channels = node.channels().len();
    let samples = (0..(3.3 * rate_hz) as usize * channels)
        .map(|number| 1e-3 * (number as f64 * 0.1).sin())
        .collect();
    let block = SampleBlock {
        header: Header {
            source: "node".into(),
            epoch: 1,
            sequence: 0,
            time_ns: 0,
        },
        sampling_rate_hz: rate_hz,
        pace: Pace::Live,
        channels: channels as u16,
        samples,
        state: StreamState::Running,
        clock_quality: None,
    };
    core.handle(NodeInput::Samples(block), &mut Vec::new());
    assert!(core.done() > 100);
    core.state()
}

/// Returns the state of a station after three fusions.
fn of_station(structure: &Structure) -> FusionState {
    let mut core = Fusion::new(structure, "fuse", 5).unwrap();
    let parameters = structure.parameters().len();
    let covariance: Vec<f64> = (0..parameters)
        .flat_map(|j| (0..=j).map(move |i| if i == j { 0.005 } else { 0.0 }))
        .collect();
    let message = |index: u64| LocalMessage {
        header: Header {
            source: "node".into(),
            epoch: 2,
            sequence: index,
            time_ns: index as i64 * 1_000_000_000,
        },
        pace: Pace::Replayed,
        density: Some(LocalDensity {
            mean: vec![0.95; parameters],
            covariance: covariance
                .iter()
                .map(|entry| entry / index as f64)
                .collect(),
            lineage: Some(NodeLineage {
                own: index - 1,
                answers: Vec::new(),
            }),
            motion: None,
        }),
        restarts: 0,
        samples: 50,
        screening: Vec::new(),
        state: StreamState::Running,
    };
    let all = vec![true; structure.nodes().len()];
    core.handle(spandrel_fuse::FusionInput::Present(all), &mut Vec::new());
    for index in 1..=3 {
        for node in 0..structure.nodes().len() {
            let input = spandrel_fuse::FusionInput::Local {
                node,
                message: Box::new(message(index)),
                bytes: 500,
                arrived_ns: index as i64 * 1_000_000_000,
            };
            core.handle(input, &mut Vec::new());
        }
    }
    assert_eq!(core.done(), 3);
    core.state()
}

/// Bytes that are written unchanged.
pub struct Raw(pub Vec<u8>);

impl Serialize for Raw {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let mut tuple = to.serialize_tuple(self.0.len())?;
        self.0
            .iter()
            .try_for_each(|byte| tuple.serialize_element(byte))?;
        tuple.end()
    }
}

/// Suppresses the backtrace of panics that are caught while a state is decoded (the dimensions of a
/// matrix can overflow). A backtrace would allocate memory.
pub fn keep_silent_of_what_is_caught() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let told = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if panic
                .location()
                .is_none_or(|at| !at.file().contains("nalgebra"))
            {
                told(panic);
            }
        }));
    });
}

/// Damages the newer of two checkpoints, and then a state that is sealed as if it were valid.
/// `restore` decodes a state.
fn try_damages<T>(identity: &Identity, state: &T, restore: impl Fn(T) -> Result<(), String>)
where
    T: Serialize + DeserializeOwned,
{
    keep_silent_of_what_is_caught();
    let kind = identity.kind;
    let folder = tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap();
    let checkpoints = Checkpoints::open(folder.path(), identity.clone()).unwrap();
    checkpoints.save(BEFORE, state).unwrap();
    let newest = folder.path().join(format!(
        "{kind}-{:020}-{:020}.checkpoint",
        NEWEST.epoch, NEWEST.sequence
    ));
    let aside = newest.with_extension("checkpoint.refused");
    let whole = identity.seal(state).unwrap();
    let content = postcard::to_stdvec(state).unwrap();
    let allowed = |bytes: usize| RESERVED_BYTES + BYTES_PER_BYTE * bytes as u64;
    let (mut decoded, mut restored) = (0, 0);
    for seed in SEEDS {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        for number in 0..FILES {
            let case = format!("{kind}, file {number} of seed {seed}");
            let file = damaged(&whole, &mut random);
            std::fs::write(&newest, &file).unwrap();
            let mut loaded = None;
            let taken =
                allocation_counter::measure(|| loaded = Some(checkpoints.load_latest::<T>()));
            assert!(
                taken.bytes_max <= allowed(file.len() + whole.len()),
                "{case}: took {}",
                taken.bytes_max
            );
            let loaded = loaded.unwrap();
            if file == whole {
                assert_eq!(loaded.found.unwrap().0, NEWEST, "{case}");
                continue; // the damages cancelled out
            }
            let [(path, why)] = &loaded.refused[..] else {
                panic!("{case}: {:?}", loaded.refused)
            };
            let (position, found) = loaded.found.unwrap_or_else(|| panic!("{case}: {why}"));
            assert!(
                position == BEFORE && identity.seal(&found).unwrap() == whole,
                "{case}: the previous checkpoint is unchanged"
            );
            assert!(
                *path == aside && aside.is_file() && !newest.exists(),
                "{case}: {}",
                path.display()
            );
            assert!(
                matches!(why, Refusal::Damaged | Refusal::Foreign),
                "{case}: {why}"
            );

            let sealed = identity.seal(&Raw(damaged(&content, &mut random))).unwrap();
            let mut opened = None;
            let taken = allocation_counter::measure(|| opened = Some(identity.open::<T>(&sealed)));
            assert!(
                taken.bytes_max <= allowed(sealed.len()),
                "{case}, sealed: took {}",
                taken.bytes_max
            );
            match opened.unwrap() {
                Ok(state) => {
                    decoded += 1;
                    match restore(state) {
                        Ok(()) => restored += 1,
                        Err(why) => assert!(!why.is_empty(), "{case}"),
                    }
                }
                Err(why) => assert!(!why.to_string().is_empty(), "{case}"),
            }
        }
    }
    println!(
        "{kind}: {} bytes; {decoded} damaged states behind a right checksum decoded, {restored} \
         were taken",
        whole.len()
    );
    assert!(decoded > 0 && restored <= decoded);
}

#[test]
fn damaged_checkpoints_of_identify_are_set_aside_for_the_previous_one() {
    let structure = Structure::read(
        &Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/fixtures/kept/0.1.0/structure.toml"),
    );
    let structure = structure.unwrap();
    let identity = identity("identify", IdentificationState::VERSION, &structure);
    let state = of_identification(&structure);
    try_damages(&identity, &state, |state| {
        let mut core = Identification::new(&structure, "identify").unwrap();
        core.restore(state).map_err(|why| why.to_string())
    });
}

#[test]
fn damaged_checkpoints_of_nodes_are_set_aside_for_the_previous_one() {
    let structure = distributed();
    let state = of_node(&structure);
    try_damages(
        &identity("node", NodeIdentificationState::VERSION, &structure),
        &state,
        |state| {
            let mut core = NodeIdentification::new(&structure, 0, 6).unwrap();
            core.restore(state).map_err(|why| why.to_string())
        },
    );
}

#[test]
fn damaged_checkpoints_of_the_station_are_set_aside_for_the_previous_one() {
    let structure = distributed();
    let state = of_station(&structure);
    try_damages(
        &identity("fuse", FusionState::VERSION, &structure),
        &state,
        |state| {
            let mut core = Fusion::new(&structure, "fuse", 6).unwrap();
            core.restore(state).map_err(|why| why.to_string())
        },
    );
}
