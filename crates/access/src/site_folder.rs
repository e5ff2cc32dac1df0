//! The authority of a site and the certificates that it has issued, as files in one folder.

use std::fs::DirBuilder;
use std::net::IpAddr;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Timestamp, ToSpan};
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose, SanType, date_time_ymd,
};
use spandrel_bus::{AUTHORITY_FILE, TlsConfig, read_small_text};
use spandrel_checkpoint::replace_private_file;

use crate::error::AccessError;
use crate::role::{Party, Role};

/// File name of the authority's private key.
const AUTHORITY_KEY_FILE: &str = "authority.key";
/// Permissions of the folder. Only the owner has access.
const FOLDER_MODE: u32 = 0o700;
/// Number of days before today on which validity starts, for parties whose clock is slow.
const VALID_BEFORE_DAYS: i64 = 2;
/// Maximum validity period of a certificate, in days.
const MAX_DAYS: u32 = 36_500;

/// The folder of a site.
#[derive(Clone, Debug)]
pub struct SiteFolder {
    folder: PathBuf,
}

/// Files of an issued certificate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Issued {
    /// Path of the issued certificate.
    pub certificate: PathBuf,
    /// Path of the private key of the certificate.
    pub key: PathBuf,
    /// Day on which the certificate expires, at 0:00 UTC.
    pub expires: Date,
}

/// Treatment of files that already exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// Keep them and return an error.
    Keep,
    /// Overwrite them.
    Replace,
}

impl SiteFolder {
    /// Creates an authority with this name in a folder. Creates the folder if it is missing.
    ///
    /// # Errors
    /// Returns an error if the authority already exists and must not be replaced, or if the folder
    /// cannot be written.
    pub fn create(
        folder: &Path,
        name: &str,
        days: u32,
        existing: Existing,
    ) -> Result<(Self, Issued), AccessError> {
        let site = Self {
            folder: folder.to_owned(),
        };
        let made = DirBuilder::new()
            .recursive(true)
            .mode(FOLDER_MODE)
            .create(folder);
        made.map_err(|source| AccessError::File {
            what: "made",
            path: folder.to_owned(),
            source,
        })?;
        let (not_before, expires) = life(days)?;
        let key = new_key()?;
        let mut params = CertificateParams::default();
        params.distinguished_name = common_name(&format!("authority.{name}"));
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        set_life(&mut params, not_before, expires);
        let made = params.self_signed(&key);
        let certificate = made.map_err(|source| AccessError::Make {
            what: "authority",
            source,
        })?;
        let issued = Issued {
            certificate: site.authority(),
            key: folder.join(AUTHORITY_KEY_FILE),
            expires,
        };
        issued.write(&certificate.pem(), &key.serialize_pem(), existing)?;
        Ok((site, issued))
    }

    /// Opens the existing folder of a site.
    ///
    /// # Errors
    /// Returns an error if the folder lacks the certificate or the private key of an authority.
    pub fn open(folder: &Path) -> Result<Self, AccessError> {
        for file in [AUTHORITY_FILE, AUTHORITY_KEY_FILE] {
            if !folder.join(file).is_file() {
                return Err(AccessError::NoSite {
                    folder: folder.to_owned(),
                    file,
                });
            }
        }
        Ok(Self {
            folder: folder.to_owned(),
        })
    }

    /// Returns the path of the authority's certificate.
    #[must_use]
    pub fn authority(&self) -> PathBuf {
        self.folder.join(AUTHORITY_FILE)
    }

    /// Returns the path of a party's certificate, which need not exist.
    #[must_use]
    pub fn certificate(&self, party: &Party) -> PathBuf {
        self.folder.join(format!("{}.pem", party.common_name()))
    }

    /// Returns the path of a party's private key, which need not exist.
    #[must_use]
    pub fn key(&self, party: &Party) -> PathBuf {
        self.folder.join(format!("{}.key", party.common_name()))
    }

    /// Issues a certificate.
    ///
    /// With `hosts`, the certificate is valid for servers and clients. Without them it is valid for
    /// clients only, so that the certificate of a sensor cannot impersonate the router.
    ///
    /// # Errors
    /// - The certificate already exists and must not be replaced.
    /// - The authority cannot be used or has expired.
    /// - A router or database has no hosts.
    /// - A file cannot be written.
    pub fn issue(
        &self,
        party: &Party,
        hosts: &[String],
        days: u32,
        existing: Existing,
    ) -> Result<Issued, AccessError> {
        if matches!(party.role(), Role::Router | Role::Database) && hosts.is_empty() {
            return Err(AccessError::NoHost { role: party.role() });
        }
        let (issuer, authority_expires) = self.issuer()?;
        let (not_before, expires) = life(days)?;
        let expires = expires.min(authority_expires);
        let key = new_key()?;
        let mut params = CertificateParams::default();
        params.distinguished_name = common_name(&party.common_name());
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        if !hosts.is_empty() {
            params
                .extended_key_usages
                .push(ExtendedKeyUsagePurpose::ServerAuth);
        }
        params.subject_alt_names = hosts
            .iter()
            .map(|host| alternative_name(host))
            .collect::<Result<_, _>>()?;
        params.use_authority_key_identifier_extension = true;
        set_life(&mut params, not_before, expires);
        let made = params.signed_by(&key, &issuer);
        let certificate = made.map_err(|source| AccessError::Make {
            what: "certificate",
            source,
        })?;
        let issued = Issued {
            certificate: self.certificate(party),
            key: self.key(party),
            expires,
        };
        issued.write(&certificate.pem(), &key.serialize_pem(), existing)?;
        // An authority certificate with a different key would issue certificates that no party
        // accepts.
        TlsConfig::beside(issued.certificate.clone()).check()?;
        Ok(issued)
    }

    /// Returns all holders of a certificate in this folder, sorted by role and name.
    ///
    /// # Errors
    /// Returns an error if the folder cannot be read.
    pub fn parties(&self) -> Result<Vec<Party>, AccessError> {
        let unread = |source| AccessError::File {
            what: "read",
            path: self.folder.clone(),
            source,
        };
        let mut parties = Vec::new();
        for entry in std::fs::read_dir(&self.folder).map_err(unread)? {
            let name = entry.map_err(unread)?.file_name();
            let common_name = name.to_str().and_then(|name| name.strip_suffix(".pem"));
            parties.extend(common_name.and_then(|name| name.parse::<Party>().ok()));
        }
        parties.sort();
        Ok(parties)
    }

    /// Returns the router with this name, or the only router if `name` is `None`.
    ///
    /// # Errors
    /// Returns an error if there is no such router, or if there are several and `name` is `None`.
    pub fn router(&self, name: Option<&str>) -> Result<Party, AccessError> {
        let routers = self
            .parties()?
            .into_iter()
            .filter(|party| party.role() == Role::Router);
        let wanted = name
            .map(|name| Party::new(Role::Router, name))
            .transpose()?;
        let mut found: Vec<Party> = routers
            .filter(|party| wanted.as_ref().is_none_or(|name| name == party))
            .collect();
        match (found.pop(), found.is_empty()) {
            (Some(router), true) => Ok(router),
            (Some(last), false) => {
                found.push(last);
                Err(AccessError::SeveralRouters {
                    folder: self.folder.clone(),
                    found,
                })
            }
            (None, _) => Err(AccessError::NoRouter {
                folder: self.folder.clone(),
            }),
        }
    }

    /// Returns the authority and the day on which it expires.
    fn issuer(&self) -> Result<(Issuer<'static, KeyPair>, Date), AccessError> {
        let (path, key_path) = (self.authority(), self.folder.join(AUTHORITY_KEY_FILE));
        let read = |path: &Path| {
            let read = read_small_text(path);
            read.map_err(|source| AccessError::File {
                what: "read",
                path: path.to_owned(),
                source,
            })
        };
        let no_authority = || AccessError::NoAuthority { path: path.clone() };
        let (certificate, key) = (read(&path)?, read(&key_path)?);
        // The original error might contain part of the key.
        let key = KeyPair::from_pem(&key).map_err(|_| AccessError::Tls(damaged(&key_path)))?;
        let (_, pem) =
            x509_parser::pem::parse_x509_pem(certificate.as_bytes()).map_err(|_| no_authority())?;
        let parsed = pem.parse_x509().map_err(|_| no_authority())?;
        let ends = Timestamp::from_second(parsed.validity().not_after.timestamp())
            .map_err(|_| no_authority())?;
        let expires = ends.to_zoned(TimeZone::UTC).date();
        if expires <= today() {
            return Err(AccessError::AuthorityExpired {
                path,
                expired: expires.to_string(),
            });
        }
        let issuer = Issuer::from_ca_cert_pem(&certificate, key).map_err(|_| no_authority())?;
        Ok((issuer, expires))
    }
}

fn damaged(path: &Path) -> spandrel_bus::TlsError {
    spandrel_bus::TlsError::Damaged {
        what: "key",
        path: path.to_owned(),
    }
}

fn today() -> Date {
    Timestamp::now().to_zoned(TimeZone::UTC).date()
}

/// Sets the first and the last day of a certificate, each at 0:00 UTC.
fn set_life(params: &mut CertificateParams, not_before: Date, expires: Date) {
    let midnight = |day: Date| {
        date_time_ymd(
            i32::from(day.year()),
            day.month().unsigned_abs(),
            day.day().unsigned_abs(),
        )
    };
    params.not_before = midnight(not_before);
    params.not_after = midnight(expires);
}

/// Returns the first day and the day of expiry of a certificate that is valid for `days`.
fn life(days: u32) -> Result<(Date, Date), AccessError> {
    let refused = AccessError::Days { days };
    if days == 0 || days > MAX_DAYS {
        return Err(refused);
    }
    let today = today();
    match (
        today.checked_sub(VALID_BEFORE_DAYS.days()),
        today.checked_add(i64::from(days).days()),
    ) {
        (Ok(from), Ok(until)) => Ok((from, until)),
        (Err(_), _) | (_, Err(_)) => Err(refused),
    }
}

fn new_key() -> Result<KeyPair, AccessError> {
    KeyPair::generate().map_err(|source| AccessError::Make {
        what: "key",
        source,
    })
}

fn common_name(name: &str) -> DistinguishedName {
    let mut distinguished_name = DistinguishedName::new();
    distinguished_name.push(DnType::CommonName, name);
    distinguished_name
}

fn alternative_name(host: &str) -> Result<SanType, AccessError> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return Ok(SanType::IpAddress(address));
    }
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '.');
    let refused = || AccessError::Host {
        host: host.to_owned(),
    };
    if host.is_empty() || !host.chars().all(allowed) {
        return Err(refused());
    }
    host.try_into().map(SanType::DnsName).map_err(|_| refused())
}

impl Issued {
    /// Writes both files. The key is first, so that no certificate exists without its key.
    fn write(&self, certificate: &str, key: &str, existing: Existing) -> Result<(), AccessError> {
        if existing == Existing::Keep {
            for path in [&self.certificate, &self.key] {
                if path.exists() {
                    return Err(AccessError::Exists { path: path.clone() });
                }
            }
        }
        write_private(&self.key, key)?;
        write_private(&self.certificate, certificate)
    }
}

fn write_private(path: &Path, text: &str) -> Result<(), AccessError> {
    replace_private_file(path, text.as_bytes()).map_err(|source| AccessError::File {
        what: "written",
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests;
