//! Certificates: checks before a session opens, and diagnosis if it does not open.

use std::io::ErrorKind;
use std::net::{Ipv4Addr, Ipv6Addr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use quinn::ConnectionError;
use quinn::crypto::rustls::QuicClientConfig;
use rustls::client::WebPkiServerVerifier;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::{Error as PemError, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::CertifiedKey;
use rustls::{AlertDescription, CertificateError, ClientConfig, RootCertStore};
use serde::{Deserialize, Serialize};
use tokio::time::timeout;
use tracing::warn;

use crate::small_file::read_small_file;

/// Name of the authority's certificate file, in the folder of the certificates that it has issued.
pub const AUTHORITY_FILE: &str = "authority.pem";
/// Application protocol that Zenoh uses on QUIC links with one stream.
const ZENOH_OVER_QUIC: &[u8] = b"zenoh";
/// Time before the expiry of a certificate from which on a warning is logged.
const WARNED_BEFORE: Duration = Duration::from_secs(30 * 86_400);

/// Certificate of this session, and the authority that it trusts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// Certificate of this session (PEM), as `spandrel site issue` writes it.
    pub certificate: PathBuf,
    /// Private key of the certificate (PEM). `None`: the file with the same name and the extension
    /// `.key`.
    #[serde(default)]
    pub key: Option<PathBuf>,
    /// Certificate of the site's authority (PEM). `None`: [`AUTHORITY_FILE`] in the folder of the
    /// certificate.
    #[serde(default)]
    pub authority: Option<PathBuf>,
}

/// Reason why a certificate cannot be used. It never contains any part of a private key.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("{what} {} cannot be read", path.display())]
    File {
        /// Kind of the file.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error from the operating system.
        source: std::io::Error,
    },
    /// A file has no PEM section of the required kind.
    #[error("{what} {}: has no PEM section of that kind, must have at least one", path.display())]
    Empty {
        /// Kind of the file.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
    },
    /// A file is damaged or of another kind.
    #[error("{what} {}: is damaged or of another type", path.display())]
    Damaged {
        /// Kind of the file.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
    },
    /// The key does not belong to the certificate.
    #[error("key {} does not match certificate {}", key.display(), certificate.display())]
    KeyOfAnother {
        /// The key.
        key: PathBuf,
        /// The certificate.
        certificate: PathBuf,
    },
    /// The certificate has expired or is not yet valid. A correct clock or a new certificate in the
    /// same file solves this.
    #[error("certificate {} is not accepted: {why} (authority \
             {})", certificate.display(), authority.display())]
    NotInTime {
        /// The certificate.
        certificate: PathBuf,
        /// The authority.
        authority: PathBuf,
        /// The reason in words.
        why: String,
    },
    /// The authority has not issued the certificate.
    #[error("certificate {} is not accepted: {why} (authority \
             {})", certificate.display(), authority.display())]
    NotAccepted {
        /// The certificate.
        certificate: PathBuf,
        /// The authority.
        authority: PathBuf,
        /// The reason in words.
        why: String,
    },
}

impl TlsConfig {
    /// Creates the settings for a certificate whose key and authority are in the same folder.
    #[must_use]
    pub fn beside(certificate: PathBuf) -> Self {
        Self {
            certificate,
            key: None,
            authority: None,
        }
    }

    /// Returns the path of the private key.
    #[must_use]
    pub fn key(&self) -> PathBuf {
        self.key
            .clone()
            .unwrap_or_else(|| self.certificate.with_extension("key"))
    }

    /// Returns the path of the authority's certificate.
    #[must_use]
    pub fn authority(&self) -> PathBuf {
        self.authority
            .clone()
            .unwrap_or_else(|| self.certificate.with_file_name(AUTHORITY_FILE))
    }

    /// Makes relative paths relative to a folder.
    pub fn resolve(&mut self, folder: &Path) {
        let paths = [
            Some(&mut self.certificate),
            self.key.as_mut(),
            self.authority.as_mut(),
        ];
        for path in paths.into_iter().flatten() {
            *path = folder.join(&path);
        }
    }

    /// Reads all three files and checks that they match and are valid now.
    ///
    /// Logs a warning if the certificate expires within 30 days.
    ///
    /// # Errors
    /// Returns [`TlsError`] with the path of the file.
    pub fn check(&self) -> Result<(), TlsError> {
        let (chain, _) = read_pair(&self.certificate, &self.key())?;
        let authority = self.authority();
        let roots = read_roots(&authority)?;
        let refused = |why: String| TlsError::NotAccepted {
            certificate: self.certificate.clone(),
            authority: authority.clone(),
            why,
        };
        let verifier =
            WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider()).build();
        let verifier = verifier.map_err(|error| refused(error.to_string()))?;
        let [own, intermediate @ ..] = chain.as_slice() else {
            return Ok(());
        }; // `read_pair` returns at least one certificate
        let valid = |at: UnixTime| verifier.verify_client_cert(own, intermediate, at);
        valid(UnixTime::now()).map_err(|error| match refused(in_words(&error)) {
            TlsError::NotAccepted {
                certificate,
                authority,
                why,
            } if is_of_time(&error) => TlsError::NotInTime {
                certificate,
                authority,
                why,
            },
            refused => refused,
        })?;
        let soon = Duration::from_secs(UnixTime::now().as_secs()).saturating_add(WARNED_BEFORE);
        if valid(UnixTime::since_unix_epoch(soon)).is_err() {
            let certificate = self.certificate.display();
            warn!(%certificate, "certificate expires within 30 days; renew it with spandrel site \
                issue --replace");
        }
        Ok(())
    }

    /// Connects to learn why Zenoh could not. Returns the fault of the certificates, if any.
    ///
    /// # Errors
    /// Fails if there is no reply.
    pub(crate) async fn reach(
        &self,
        address: &str,
        host: &str,
        patience: Duration,
    ) -> std::io::Result<Option<String>> {
        let Some(config) = self.client() else {
            return Ok(None);
        };
        let Some(remote) = tokio::net::lookup_host(address).await?.next() else {
            return Err(std::io::Error::new(ErrorKind::NotFound, "no such host"));
        };
        let any_port = if remote.is_ipv4() {
            (Ipv4Addr::UNSPECIFIED, 0).into()
        } else {
            (Ipv6Addr::UNSPECIFIED, 0).into()
        };
        let endpoint = quinn::Endpoint::client(any_port)?;
        let Ok(connecting) = endpoint.connect_with(config, remote, host) else {
            return Ok(None);
        };
        let no_answer = || std::io::Error::new(ErrorKind::TimedOut, "no reply");
        let error = match timeout(patience, connecting)
            .await
            .map_err(|_elapsed| no_answer())?
        {
            Err(error) => error,
            // The other side rejects our certificate only after the handshake, in an unsolicited
            // message.
            Ok(connection) => match timeout(patience, connection.closed()).await {
                Ok(error) => error,
                Err(_elapsed) => return Ok(None),
            },
        };
        Ok(match error {
            ConnectionError::TransportError(error) => {
                Some(in_words_of_alert(error.code.into(), &error.reason))
            }
            ConnectionError::ConnectionClosed(close) => {
                let reason = in_words_of_alert(
                    close.error_code.into(),
                    &String::from_utf8_lossy(&close.reason),
                );
                Some(format!("the other side rejects the certificate: {reason}"))
            }
            ConnectionError::TimedOut => return Err(no_answer()),
            _ => None,
        })
    }

    /// Returns the QUIC settings with which Zenoh connects.
    fn client(&self) -> Option<quinn::ClientConfig> {
        let (chain, key) = read_pair(&self.certificate, &self.key()).ok()?;
        let roots = Arc::new(read_roots(&self.authority()).ok()?);
        let verifier = WebPkiServerVerifier::builder_with_provider(roots, provider())
            .build()
            .ok()?;
        let mut config = ClientConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .ok()?
            .with_webpki_verifier(verifier)
            .with_client_auth_cert(chain, key)
            .ok()?;
        config.alpn_protocols = vec![ZENOH_OVER_QUIC.to_vec()];
        Some(quinn::ClientConfig::new(Arc::new(
            QuicClientConfig::try_from(config).ok()?,
        )))
    }
}

/// Describes the TLS alert that closed a QUIC connection. Returns `reason` for other errors and for
/// alerts with a text.
fn in_words_of_alert(code: u64, reason: &str) -> String {
    // RFC 9001, section 4.8: the error code is 0x100 plus the alert.
    let alert = code
        .checked_sub(0x100)
        .and_then(|alert| u8::try_from(alert).ok())
        .map(AlertDescription::from);
    match alert {
        Some(AlertDescription::UnknownCA | AlertDescription::DecryptError) => {
            "the authority did not issue it, or not for this use".to_owned()
        }
        Some(AlertDescription::CertificateExpired) => {
            "it has expired, or is not valid yet".to_owned()
        }
        Some(AlertDescription::CertificateRequired) => "none was presented".to_owned(),
        Some(alert) if reason.is_empty() => format!("{alert:?}"),
        Some(_) | None => reason.to_owned(),
    }
}

/// Returns `true` if a certificate was rejected because it has expired or is not yet valid.
fn is_of_time(error: &rustls::Error) -> bool {
    let rustls::Error::InvalidCertificate(error) = error else {
        return false;
    };
    matches!(
        error,
        CertificateError::Expired
            | CertificateError::ExpiredContext { .. }
            | CertificateError::NotValidYet
            | CertificateError::NotValidYetContext { .. }
    )
}

/// Describes why the session's own certificate was rejected.
fn in_words(error: &rustls::Error) -> String {
    match error {
        rustls::Error::InvalidCertificate(
            CertificateError::UnknownIssuer
            | CertificateError::BadSignature
            | CertificateError::InvalidPurpose,
        ) => "the authority did not issue it, or not for this use".to_owned(),
        rustls::Error::InvalidCertificate(CertificateError::ExpiredContext { time, not_after }) => {
            let days = time.as_secs().saturating_sub(not_after.as_secs()) / 86_400;
            format!("it expired {days} days ago")
        }
        rustls::Error::InvalidCertificate(CertificateError::NotValidYetContext { .. }) => {
            "it is not valid yet; check the clock".to_owned()
        }
        rustls::Error::InvalidCertificate(other) => format!("its certificate is rejected: {other}"),
        other => other.to_string(),
    }
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

/// Reads a certificate chain and its private key, and checks that they match.
///
/// # Errors
/// Returns [`TlsError`] with the path of the file.
pub fn read_pair(
    certificate: &Path,
    key: &Path,
) -> Result<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>), TlsError> {
    let chain = read_certificates("certificate", certificate)?;
    let text = read("key", key)?;
    let of_key = |error| pem_error("key", key, &error);
    let private = PrivateKeyDer::from_pem_slice(&text).map_err(of_key)?;
    match CertifiedKey::from_der(
        chain.clone(),
        private.clone_key(),
        &ring::default_provider(),
    ) {
        Ok(_) => Ok((chain, private)),
        Err(rustls::Error::InconsistentKeys(_)) => Err(TlsError::KeyOfAnother {
            key: key.to_owned(),
            certificate: certificate.to_owned(),
        }),
        Err(rustls::Error::InvalidCertificate(_)) => Err(TlsError::Damaged {
            what: "certificate",
            path: certificate.to_owned(),
        }),
        // The text of other errors could contain parts of the key.
        Err(_) => Err(TlsError::Damaged {
            what: "key",
            path: key.to_owned(),
        }),
    }
}

fn read_certificates(
    what: &'static str,
    path: &Path,
) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let text = read(what, path)?;
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    let chain = chain.map_err(|error| pem_error(what, path, &error))?;
    match chain.is_empty() {
        true => Err(TlsError::Empty {
            what,
            path: path.to_owned(),
        }),
        false => Ok(chain),
    }
}

fn read_roots(path: &Path) -> Result<RootCertStore, TlsError> {
    let mut roots = RootCertStore::empty();
    for certificate in read_certificates("authority", path)? {
        roots.add(certificate).map_err(|_| TlsError::Damaged {
            what: "authority",
            path: path.to_owned(),
        })?;
    }
    Ok(roots)
}

fn read(what: &'static str, path: &Path) -> Result<Vec<u8>, TlsError> {
    read_small_file(path).map_err(|source| TlsError::File {
        what,
        path: path.to_owned(),
        source,
    })
}

fn pem_error(what: &'static str, path: &Path, error: &PemError) -> TlsError {
    match error {
        PemError::NoItemsFound => TlsError::Empty {
            what,
            path: path.to_owned(),
        },
        _ => TlsError::Damaged {
            what,
            path: path.to_owned(),
        },
    }
}

#[cfg(test)]
mod tests;
