//! For every example, an identification restored from its checkpoint gives the same results as an
//! uninterrupted one.

use spandrel_bus::{FrameBlock, Header, StreamState};
use spandrel_checkpoint::{Checkpoints, Identity};
use spandrel_identify::{Identification, IdentificationInput, IdentificationState, Output};
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};

const BLOCK: usize = 50;

fn examples() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.retain(|file| {
        file.extension()
            .is_some_and(|extension| extension == "toml")
    });
    files.sort();
    files
}

/// Returns simulated frames in blocks, with a missing block and missing samples.
fn inputs(structure: &Structure, frames: usize) -> Vec<IdentificationInput> {
    let channels = structure.channel_count();
    let rows: Vec<Vec<f64>> = structure
        .simulator(7)
        .take(frames)
        .map(|frame| frame.values)
        .collect();
    let block = |(number, rows): (usize, &[Vec<f64>])| {
        let first = (number * BLOCK) as u64;
        if number == 3 {
            return IdentificationInput::gap(first, first + rows.len() as u64);
        }
        let mut values = rows.concat();
        values
            .iter_mut()
            .step_by(37)
            .for_each(|value| *value = f64::NAN);
        IdentificationInput::Frames(FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch: 7,
                sequence: first,
                time_ns: 0,
            },
            t0_ns: 0,
            sampling_rate_hz: structure.sampling_rate_hz(),
            channels: channels as u16,
            values,
            state: StreamState::Running,
        })
    };
    rows.chunks(BLOCK).enumerate().map(block).collect()
}

/// Returns all outputs after one input, with every digit.
fn said(core: &mut Identification, input: IdentificationInput) -> Vec<String> {
    let mut outputs: Vec<Output> = Vec::new();
    core.handle(input, &mut outputs);
    outputs.iter().map(|output| format!("{output:?}")).collect()
}

#[test]
fn every_example_resumes_from_its_checkpoint_with_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let mut tried = 0;
    for file in examples() {
        let structure = Structure::read(&file).unwrap_or_else(|error| panic!("{error}"));
        if structure.fusion().is_some() {
            continue; // its nodes run their own identification
        }
        let frames = if structure.parameters().len() > 30 {
            6 * BLOCK
        } else {
            16 * BLOCK
        };
        let identity = Identity {
            kind: "identify",
            version: IdentificationState::VERSION,
            of: structure.name().to_owned(),
            basis: structure.identification_basis(),
        };
        let checkpoints =
            Checkpoints::open(&folder.path().join(file.file_stem().unwrap()), identity).unwrap();
        let new = || Identification::new(&structure, "identify").unwrap();
        let (mut unbroken, mut broken) = (new(), new());
        for (number, input) in inputs(&structure, frames).into_iter().enumerate() {
            let expected = said(&mut unbroken, input.clone());
            let found = said(&mut broken, input);
            assert!(
                expected == found,
                "{}: block {number} differs",
                file.display()
            );
            let at = broken.position().unwrap();
            checkpoints.save(at, &broken.state()).unwrap();
            checkpoints.forget_before(None).unwrap();
            let loaded = checkpoints.load_latest::<IdentificationState>();
            let (position, state) = loaded
                .found
                .unwrap_or_else(|| panic!("{}: {:?}", file.display(), loaded.refused));
            assert_eq!(position, at);
            broken = new();
            broken.restore(state).unwrap();
        }
        tried += 1;
    }
    assert!(tried > 15, "{tried} examples");
}

#[test]
fn a_state_of_another_structure_is_refused() {
    let of = |name: &str| {
        Structure::read(
            &Path::new(env!("CARGO_MANIFEST_DIR"))
                .join("../../docs/examples")
                .join(name),
        )
    };
    let demo = Identification::new(&of("demo.toml").unwrap(), "identify").unwrap();
    for other in [
        "sixty-storeys.toml",
        "hysteretic-oscillator.toml",
        "corrupted-oscillator.toml",
        "dome.toml",
    ] {
        let mut other = Identification::new(&of(other).unwrap(), "identify").unwrap();
        let error = other.restore(demo.state()).unwrap_err().to_string();
        assert!(error.contains("checkpoint"), "{error}");
    }
}
