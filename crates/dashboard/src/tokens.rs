//! Tokens of people and programs. The file stores hashes, so that its readers cannot use the
//! tokens.

use crate::error::DashboardError;
use rustls::crypto::ring::default_provider;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use spandrel_bus::{Name, read_small_text};
use spandrel_checkpoint::replace_private_file;
use std::fmt::Write as _;
use std::io::ErrorKind;
use std::path::Path;

/// Number of random bytes in a token. It is too large to guess, so a single fast hash suffices for
/// storage.
const TOKEN_BYTES: usize = 32;
/// Prefix of a token, by which people and scanners recognise it.
const PREFIX: &str = "spandrel-";

/// Rights of a visitor on the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PageRole {
    /// Read access.
    Viewer,
    /// Read access and the right to acknowledge alerts and annotate structures.
    Operator,
}

/// A token as stored in the file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Token {
    /// Name of the holder.
    pub name: Name,
    /// Rights of the holder.
    pub role: PageRole,
    /// SHA-256 of the token, hexadecimal.
    sha256: String,
}

/// All tokens of a page.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tokens(Vec<Token>);

impl Tokens {
    /// Reads the file that [`Tokens::issue`] writes.
    ///
    /// # Errors
    /// The file cannot be read or is not a token file.
    pub fn read(path: &Path) -> Result<Self, DashboardError> {
        let text = read_small_text(path);
        let text = text.map_err(|source| DashboardError::TokenFile {
            path: path.to_owned(),
            source,
        })?;
        match serde_json::from_str(&text) {
            Ok(tokens) => Ok(Self(tokens)),
            // The text of the error could quote the file.
            Err(error) => Err(DashboardError::NotTokens {
                path: path.to_owned(),
                line: error.line(),
            }),
        }
    }

    /// Creates a token, adds its hash to a file, and returns the token.
    ///
    /// Creates the file if it is missing. The token itself is not stored.
    ///
    /// # Errors
    /// The name has a token that must not be replaced, or the file cannot be read or written.
    pub fn issue(
        path: &Path,
        name: Name,
        role: PageRole,
        replace: bool,
    ) -> Result<String, DashboardError> {
        let mut all = match Self::read(path) {
            Ok(all) => all,
            Err(DashboardError::TokenFile { source, .. })
                if source.kind() == ErrorKind::NotFound =>
            {
                Self::default()
            }
            Err(error) => return Err(error),
        };
        if all.0.iter().any(|token| token.name == name) {
            if !replace {
                return Err(DashboardError::TokenExists {
                    name,
                    path: path.to_owned(),
                });
            }
            all.0.retain(|token| token.name != name);
        }
        let secret = format!("{PREFIX}{}", hexadecimal(&random()?));
        all.0.push(Token {
            name,
            role,
            sha256: hash(&secret),
        });
        all.write(path)?;
        Ok(secret)
    }

    /// Replaces the file, so that no reader sees half of it. On return, it is on disk.
    fn write(&self, path: &Path) -> Result<(), DashboardError> {
        let failed = |source| DashboardError::TokenFile {
            path: path.to_owned(),
            source,
        };
        let text = serde_json::to_string_pretty(&self.0).map_err(|error| failed(error.into()))?;
        replace_private_file(path, text.as_bytes()).map_err(failed)
    }

    /// Returns `true` if there are no tokens.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the stored token that matches a secret.
    ///
    /// The comparison uses hashes only, so its duration reveals nothing about a token.
    pub(crate) fn find(&self, secret: &str) -> Option<&Token> {
        let hash = hash(secret);
        self.0.iter().find(|token| token.sha256 == hash)
    }
}

/// Returns random bytes for a token or session.
pub(crate) fn random() -> Result<[u8; TOKEN_BYTES], DashboardError> {
    let mut bytes = [0; TOKEN_BYTES];
    default_provider()
        .secure_random
        .fill(&mut bytes)
        .map_err(|_| DashboardError::NoRandom)?;
    Ok(bytes)
}

/// Returns the SHA-256 of a text, hexadecimal.
pub(crate) fn hash(text: &str) -> String {
    hexadecimal(&Sha256::digest(text.as_bytes()))
}

pub(crate) fn hexadecimal(bytes: &[u8]) -> String {
    bytes
        .iter()
        .fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
            // Writing to a string cannot fail.
            let _ = write!(text, "{byte:02x}");
            text
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    fn name(text: &str) -> Name {
        Name::new(text).unwrap()
    }

    #[test]
    fn token_is_found_and_the_file_does_not_contain_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens.json");
        let ada = Tokens::issue(&path, name("ada"), PageRole::Viewer, false).unwrap();
        let grace = Tokens::issue(&path, name("grace"), PageRole::Operator, false).unwrap();
        assert_ne!(ada, grace);
        let text = std::fs::read_to_string(&path).unwrap();
        for secret in [&ada, &grace] {
            assert!(!text.contains(&secret[PREFIX.len()..]), "{text}");
        }
        assert_eq!(
            std::fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o600
        );
        let tokens = Tokens::read(&path).unwrap();
        assert_eq!(
            tokens.find(&ada).map(|token| token.role),
            Some(PageRole::Viewer)
        );
        assert_eq!(
            tokens.find(&grace).map(|token| token.name.as_str()),
            Some("grace")
        );
        for wrong in ["", "spandrel-", &ada[..ada.len() - 1], &text] {
            assert_eq!(tokens.find(wrong), None);
        }
    }

    #[test]
    fn token_is_replaced_only_on_request() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens.json");
        let first = Tokens::issue(&path, name("ada"), PageRole::Viewer, false).unwrap();
        let again = Tokens::issue(&path, name("ada"), PageRole::Operator, false);
        assert!(
            matches!(again, Err(DashboardError::TokenExists { .. })),
            "{again:?}"
        );
        let second = Tokens::issue(&path, name("ada"), PageRole::Operator, true).unwrap();
        let tokens = Tokens::read(&path).unwrap();
        assert_eq!(tokens.find(&first), None);
        assert_eq!(
            tokens.find(&second).map(|token| token.role),
            Some(PageRole::Operator)
        );
    }

    #[test]
    fn error_names_an_invalid_file_without_quoting_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens.json");
        std::fs::write(
            &path,
            "[{\"name\": \"ada\", \"secret\": \"quoted-secret\"}]",
        )
        .unwrap();
        let error = Tokens::read(&path).unwrap_err();
        let told = format!("{error} {error:?}");
        assert!(
            told.contains("tokens.json") && !told.contains("quoted-secret"),
            "{told}"
        );
    }
}
