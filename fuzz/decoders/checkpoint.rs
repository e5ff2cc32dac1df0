//! Checkpoints: arbitrary files, and files with a valid label and checksum, so that the state is
//! decoded.
//!
//! A panic that the reader of checkpoints catches is a rejection.

use sha2::{Digest, Sha256};
use spandrel_checkpoint::{Checkpoints, Identity, Position};
use spandrel_identify::{Identification, IdentificationState};
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};

const STRUCTURE: &str = include_str!("../../tests/fixtures/kept/0.1.0/structure.toml");
const POSITION: Position = Position {
    epoch: 1,
    sequence: 0,
};
/// Size of the SHA-256 at the end of a file.
const CHECKSUM_BYTES: usize = 32;

/// The checkpoints of one structure in a folder.
pub struct Decoder {
    structure: Structure,
    checkpoints: Checkpoints,
    file: PathBuf,
    /// The bytes of a valid file before the state.
    label: Vec<u8>,
}

impl Decoder {
    pub fn new(folder: &Path) -> Self {
        let structure = Structure::parse(STRUCTURE, Path::new("structure.toml"));
        let structure = structure.expect("the structure file is valid");
        let identity = Identity {
            kind: "identify",
            version: IdentificationState::VERSION,
            of: structure.name().to_owned(),
            basis: structure.identification_basis(),
        };
        let name = format!(
            "identify-{:020}-{:020}.checkpoint",
            POSITION.epoch, POSITION.sequence
        );
        let mut label = identity.seal(&()).expect("no state can be sealed");
        label.truncate(label.len() - CHECKSUM_BYTES);
        let checkpoints = Checkpoints::open(folder, identity);
        Self {
            structure,
            checkpoints: checkpoints.expect("the folder can be written"),
            file: folder.join(name),
            label,
        }
    }

    /// Reads one input as the only checkpoint. The first byte selects what precedes the rest: 0
    /// nothing, 1 the mark of all checkpoints, 2 a valid label. Returns the reason if the
    /// checkpoint is rejected.
    pub fn decode(&self, bytes: &[u8]) -> Result<(), String> {
        let (kind, content) = bytes.split_first().ok_or("no kind")?;
        let mut file = match kind % 3 {
            0 => content.to_vec(),
            1 => [b"spandrel", content].concat(),
            _ => [&self.label, content].concat(),
        };
        if kind % 3 > 0 {
            let checksum: [u8; CHECKSUM_BYTES] = Sha256::digest(&file).into();
            file.extend(checksum);
        }
        std::fs::write(&self.file, &file).expect("the folder can be written");
        let loaded = self.checkpoints.load_latest::<IdentificationState>();
        let Some((position, state)) = loaded.found else {
            assert!(!self.file.exists());
            let reasons = loaded.refused.iter().map(|(_, why)| why.to_string());
            return Err(reasons.collect::<Vec<_>>().join(", "));
        };
        assert_eq!(position, POSITION);
        let core = Identification::new(&self.structure, "identify");
        let mut core = core.expect("the structure is valid");
        core.restore(state).map_err(|error| error.to_string())?;
        drop(core.state());
        Ok(())
    }
}
