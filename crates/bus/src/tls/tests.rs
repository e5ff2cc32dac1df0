//! Certificates that must be rejected.

use super::*;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, date_time_ymd};

/// An authority and one of its certificates, in a temporary folder.
struct Files {
    folder: tempfile::TempDir,
    tls: TlsConfig,
}

/// Writes an authority, and a certificate that is valid until the end of the year `until`.
fn files(until: i32) -> Files {
    let folder = tempfile::tempdir().unwrap();
    let authority_key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let authority = params.self_signed(&authority_key).unwrap();
    let issuer = Issuer::new(params, authority_key);
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params.not_before = date_time_ymd(2000, 1, 1);
    params.not_after = date_time_ymd(until, 12, 31);
    let certificate = params.signed_by(&key, &issuer).unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at(AUTHORITY_FILE), authority.pem()).unwrap();
    std::fs::write(at("own.pem"), certificate.pem()).unwrap();
    std::fs::write(at("own.key"), key.serialize_pem()).unwrap();
    let tls = TlsConfig::beside(at("own.pem"));
    Files { folder, tls }
}

#[track_caller]
fn refused(tls: &TlsConfig, parts: &[&str]) {
    let error = tls.check().unwrap_err();
    for part in parts {
        assert!(
            error.to_string().contains(part),
            "expected {part:?} in: {error}"
        );
    }
}

#[test]
fn matching_files_are_accepted() {
    files(4000).tls.check().unwrap();
}

#[test]
fn each_missing_file_is_named() {
    for (file, what) in [
        ("own.pem", "certificate"),
        ("own.key", "key"),
        (AUTHORITY_FILE, "authority"),
    ] {
        let files = files(4000);
        std::fs::remove_file(files.folder.path().join(file)).unwrap();
        refused(&files.tls, &[file, what, "cannot be read"]);
    }
}

#[test]
fn error_names_a_file_without_its_pem_section() {
    for (file, what) in [
        ("own.pem", "certificate"),
        ("own.key", "key"),
        (AUTHORITY_FILE, "authority"),
    ] {
        let files = files(4000);
        std::fs::write(files.folder.path().join(file), "no PEM at all\n").unwrap();
        refused(&files.tls, &[file, what, "must have at least one"]);
    }
}

#[test]
fn error_names_a_damaged_file_without_quoting_it() {
    for (file, label) in [
        ("own.pem", "CERTIFICATE"),
        ("own.key", "PRIVATE KEY"),
        (AUTHORITY_FILE, "CERTIFICATE"),
    ] {
        let files = files(4000);
        let text = format!("-----BEGIN {label}-----\nc2VjcmV0\n-----END {label}-----\n");
        std::fs::write(files.folder.path().join(file), text).unwrap();
        let error = files.tls.check().unwrap_err();
        let told = format!("{error} {error:?}");
        assert!(told.contains(file) && !told.contains("c2VjcmV0"), "{told}");
    }
}

#[test]
fn the_key_of_another_certificate_is_refused() {
    let files = files(4000);
    std::fs::write(
        files.tls.key(),
        KeyPair::generate().unwrap().serialize_pem(),
    )
    .unwrap();
    refused(
        &files.tls,
        &["own.key", "does not match certificate", "own.pem"],
    );
}

#[test]
fn an_expired_certificate_is_refused() {
    refused(&files(2001).tls, &["own.pem", "it expired", "days ago"]);
}

#[test]
fn the_certificate_of_another_authority_is_refused() {
    let (ours, theirs) = (files(4000), files(4000));
    let mixed = TlsConfig {
        authority: Some(theirs.tls.authority()),
        ..ours.tls.clone()
    };
    refused(&mixed, &["own.pem", "did not issue it"]);
}
