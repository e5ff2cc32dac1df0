//! Reads the party from a certificate.

use std::path::Path;

use crate::error::AccessError;
use crate::role::Party;
use spandrel_bus::{TlsError, read_small_file};

impl Party {
    /// Reads the party from the common name of a certificate file (PEM).
    ///
    /// Returns `None` if the common name does not have the form `ROLE.NAME`, as in certificates of
    /// another authority.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read or is not a certificate.
    pub fn of_certificate(path: &Path) -> Result<Option<Self>, AccessError> {
        let text = read_small_file(path);
        let text = text.map_err(|source| AccessError::File {
            what: "read",
            path: path.to_owned(),
            source,
        })?;
        let damaged = || {
            AccessError::Tls(TlsError::Damaged {
                what: "certificate",
                path: path.to_owned(),
            })
        };
        let (_, pem) = x509_parser::pem::parse_x509_pem(&text).map_err(|_| damaged())?;
        let certificate = pem.parse_x509().map_err(|_| damaged())?;
        let common_name = certificate.subject().iter_common_name().next();
        Ok(common_name
            .and_then(|name| name.as_str().ok())
            .and_then(|name| name.parse().ok()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Existing, Role, SiteFolder};

    #[test]
    fn certificate_names_its_party_and_an_error_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let (site, _) = SiteFolder::create(folder.path(), "bridge", 365, Existing::Keep).unwrap();
        let roof = Party::new(Role::Sensor, "tower.roof").unwrap();
        site.issue(&roof, &[], 30, Existing::Keep).unwrap();
        let path = folder.path().join("sensor.tower.roof.pem");
        assert_eq!(Party::of_certificate(&path).unwrap(), Some(roof));
        assert_eq!(
            Party::of_certificate(&folder.path().join("authority.pem")).unwrap(),
            None
        );
        let no_certificate = folder.path().join("sensor.tower.roof.key");
        let error = Party::of_certificate(&no_certificate)
            .unwrap_err()
            .to_string();
        assert!(error.contains("sensor.tower.roof.key"), "{error}");
    }
}
