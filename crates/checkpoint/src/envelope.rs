//! The encoding of a checkpoint: its identity, the state, and a checksum over both.

use crate::error::{CheckpointError, Refusal};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// First bytes of every checkpoint file.
const MAGIC: &[u8; 8] = b"spandrel";
/// Version of the envelope.
///
/// The envelope consists of the magic bytes, this version (u16), the [`Label`] and the state in
/// postcard format, and a SHA-256 of all preceding bytes.
const LAYOUT: u16 = 1;
const CHECKSUM_BYTES: usize = 32;

/// The identity of a checkpoint. A reader uses a checkpoint only if all fields match.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The service, such as `identify`. File names start with it.
    pub kind: &'static str,
    /// Version of the layout of the state. Every change of its fields must increase the version.
    pub version: u16,
    /// Name of the structure.
    pub of: String,
    /// The text that the state depends on, such as the structure file. A change of this text
    /// invalidates the state.
    pub basis: String,
}

impl Identity {
    /// Encodes a state as a checkpoint.
    ///
    /// # Errors
    /// Returns an error if the state cannot be serialised.
    pub fn seal<T: Serialize>(&self, state: &T) -> Result<Vec<u8>, CheckpointError> {
        seal(self, state).map_err(|reason| CheckpointError::Encode {
            kind: self.kind,
            reason,
        })
    }

    /// Decodes the state from a checkpoint of this identity.
    ///
    /// # Errors
    /// Returns an error if the bytes are damaged, or they belong to another identity.
    pub fn open<T: DeserializeOwned>(&self, bytes: &[u8]) -> Result<T, Refusal> {
        // Extreme numbers in a state may panic in the decoder, for example if the product of matrix
        // dimensions overflows. Such a file must not terminate the service at every start.
        let opened = catch_unwind(AssertUnwindSafe(|| open(self, bytes)));
        opened.unwrap_or_else(|_| {
            Err(Refusal::Content(
                "it contains an implausible number".to_owned(),
            ))
        })
    }
}

/// Returns the SHA-256 of a text, for a state that stores the basis of one of its parts itself.
#[must_use]
pub fn fingerprint(text: &str) -> [u8; CHECKSUM_BYTES] {
    Sha256::digest(text).into()
}

/// The encoded form of an [`Identity`].
#[derive(Debug, Serialize, Deserialize)]
struct Label {
    kind: String,
    version: u16,
    of: String,
    basis_sha256: [u8; CHECKSUM_BYTES],
}

fn seal<T: Serialize>(identity: &Identity, state: &T) -> Result<Vec<u8>, postcard::Error> {
    let label = Label {
        kind: identity.kind.to_owned(),
        version: identity.version,
        of: identity.of.clone(),
        basis_sha256: fingerprint(&identity.basis),
    };
    let mut bytes = MAGIC.to_vec();
    bytes.extend(LAYOUT.to_le_bytes());
    bytes.extend(postcard::to_stdvec(&label)?);
    bytes.extend(postcard::to_stdvec(state)?);
    let checksum: [u8; CHECKSUM_BYTES] = Sha256::digest(&bytes).into();
    bytes.extend(checksum);
    Ok(bytes)
}

fn open<T: DeserializeOwned>(identity: &Identity, bytes: &[u8]) -> Result<T, Refusal> {
    let rest = bytes.strip_prefix(MAGIC).ok_or(Refusal::Foreign)?;
    let content = rest
        .len()
        .checked_sub(CHECKSUM_BYTES)
        .ok_or(Refusal::Damaged)?;
    let (content, checksum) = rest.split_at(content);
    let expected: [u8; CHECKSUM_BYTES] =
        Sha256::digest(&bytes[..bytes.len() - CHECKSUM_BYTES]).into();
    if checksum != expected {
        return Err(Refusal::Damaged);
    }
    // The checksum is correct, so lengths in the remaining bytes can be trusted.
    let (layout, content) = content.split_first_chunk::<2>().ok_or(Refusal::Foreign)?;
    let layout = u16::from_le_bytes(*layout);
    if layout != LAYOUT {
        return Err(Refusal::Version {
            found: layout,
            expected: LAYOUT,
        });
    }
    let unreadable = |error: postcard::Error| Refusal::Content(error.to_string());
    let (label, state) = postcard::take_from_bytes::<Label>(content).map_err(unreadable)?;
    if (label.kind.as_str(), label.of.as_str()) != (identity.kind, identity.of.as_str()) {
        let found = format!("{} of {}", label.kind, label.of);
        return Err(Refusal::OfAnother {
            found,
            expected: format!("{} of {}", identity.kind, identity.of),
        });
    }
    if label.version != identity.version {
        return Err(Refusal::Version {
            found: label.version,
            expected: identity.version,
        });
    }
    if label.basis_sha256 != fingerprint(&identity.basis) {
        return Err(Refusal::Basis);
    }
    let (state, left) = postcard::take_from_bytes::<T>(state).map_err(unreadable)?;
    match left.len() {
        0 => Ok(state),
        more => Err(Refusal::Content(format!("{more} bytes follow the state"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity() -> Identity {
        Identity {
            kind: "identify",
            version: 3,
            of: "tower".into(),
            basis: "storeys = 5".into(),
        }
    }

    #[test]
    fn only_a_matching_checkpoint_is_read() {
        let state = vec![1.5_f64, f64::NAN, -0.0];
        let bytes = seal(&identity(), &state).unwrap();
        let bits = |values: &[f64]| {
            values
                .iter()
                .map(|value| value.to_bits())
                .collect::<Vec<_>>()
        };
        assert_eq!(
            bits(&open::<Vec<f64>>(&identity(), &bytes).unwrap()),
            bits(&state)
        );
        let other = |change: fn(&mut Identity)| {
            let mut other = identity();
            change(&mut other);
            open::<Vec<f64>>(&other, &bytes).unwrap_err()
        };
        assert!(matches!(
            other(|other| other.kind = "alert"),
            Refusal::OfAnother { .. }
        ));
        assert!(matches!(
            other(|other| other.of = "bridge".into()),
            Refusal::OfAnother { .. }
        ));
        assert_eq!(
            other(|other| other.version = 4),
            Refusal::Version {
                found: 3,
                expected: 4
            }
        );
        assert_eq!(other(|other| other.basis.push('0')), Refusal::Basis);
        assert!(matches!(
            open::<Vec<[f64; 3]>>(&identity(), &bytes),
            Err(Refusal::Content(_))
        ));
        assert!(matches!(
            open::<u8>(&identity(), &bytes),
            Err(Refusal::Content(_))
        ));
    }

    #[test]
    fn truncation_and_bit_errors_are_detected_at_every_position() {
        let bytes = seal(&identity(), &vec![7_u64; 20]).unwrap();
        for length in 0..bytes.len() {
            assert!(
                open::<Vec<u64>>(&identity(), &bytes[..length]).is_err(),
                "cut to {length} bytes"
            );
        }
        for position in 0..8 * bytes.len() {
            let mut changed = bytes.clone();
            changed[position / 8] ^= 1 << (position % 8);
            assert!(
                open::<Vec<u64>>(&identity(), &changed).is_err(),
                "bit {position} changed"
            );
        }
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_bytes_give_an_error(bytes: Vec<u8>) {
            let mut with_magic = MAGIC.to_vec();
            with_magic.extend(&bytes);
            proptest::prop_assert!(open::<Vec<u64>>(&identity(), &bytes).is_err());
            proptest::prop_assert!(open::<Vec<u64>>(&identity(), &with_magic).is_err());
        }
    }
}
