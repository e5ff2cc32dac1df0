//! Tests of the files that an authority writes and of the requests that it rejects.

use super::*;
use spandrel_bus::TlsError;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;

fn mode(path: &Path) -> u32 {
    std::fs::metadata(path).unwrap().permissions().mode() & 0o777
}

fn site() -> (tempfile::TempDir, SiteFolder) {
    let folder = tempfile::tempdir().unwrap();
    let (site, _) =
        SiteFolder::create(&folder.path().join("site"), "bridge", 3650, Existing::Keep).unwrap();
    (folder, site)
}

fn party(common_name: &str) -> Party {
    common_name.parse().unwrap()
}

#[test]
fn only_the_owner_can_read_the_files() {
    let (_folder, site) = site();
    let issued = site
        .issue(&party("worker.main"), &[], 365, Existing::Keep)
        .unwrap();
    assert_eq!(mode(&site.folder), 0o700);
    for file in [
        site.authority(),
        site.folder.join(AUTHORITY_KEY_FILE),
        issued.certificate,
        issued.key,
    ] {
        assert_eq!(mode(&file), 0o600, "{}", file.display());
    }
}

#[test]
fn existing_files_are_overwritten_only_on_request() {
    let (_folder, site) = site();
    let worker = party("worker.main");
    let first = site.issue(&worker, &[], 365, Existing::Keep).unwrap();
    let before = std::fs::read(&first.key).unwrap();
    let again = site.issue(&worker, &[], 365, Existing::Keep);
    assert!(
        matches!(again, Err(AccessError::Exists { .. })),
        "{again:?}"
    );
    assert_eq!(std::fs::read(&first.key).unwrap(), before);
    let authority = SiteFolder::create(&site.folder, "other", 10, Existing::Keep);
    assert!(matches!(authority, Err(AccessError::Exists { .. })));
    std::fs::set_permissions(&first.key, Permissions::from_mode(0o644)).unwrap();
    site.issue(&worker, &[], 365, Existing::Replace).unwrap();
    assert_ne!(std::fs::read(&first.key).unwrap(), before);
    assert_eq!(mode(&first.key), 0o600);
}

#[test]
fn only_router_certificates_permit_server_use() {
    let (_folder, site) = site();
    let server_use = |issued: &Issued| {
        let text = std::fs::read(&issued.certificate).unwrap();
        let (_, pem) = x509_parser::pem::parse_x509_pem(&text).unwrap();
        pem.parse_x509()
            .unwrap()
            .extended_key_usage()
            .unwrap()
            .unwrap()
            .value
            .server_auth
    };
    let router = site.issue(
        &party("router.main"),
        &["10.0.0.5".into(), "site.example".into()],
        365,
        Existing::Keep,
    );
    assert!(server_use(&router.unwrap()));
    assert!(!server_use(
        &site
            .issue(&party("sensor.tower.roof"), &[], 365, Existing::Keep)
            .unwrap()
    ));
    let nameless = site.issue(&party("router.second"), &[], 365, Existing::Keep);
    assert!(matches!(nameless, Err(AccessError::NoHost { .. })));
    let wrong = site.issue(
        &party("router.second"),
        &["a b".into()],
        365,
        Existing::Keep,
    );
    assert!(matches!(wrong, Err(AccessError::Host { .. })));
}

#[test]
fn no_certificate_outlives_its_authority() {
    let folder = tempfile::tempdir().unwrap();
    let (site, authority) = SiteFolder::create(folder.path(), "short", 10, Existing::Keep).unwrap();
    let issued = site
        .issue(&party("viewer.ada"), &[], 365, Existing::Keep)
        .unwrap();
    assert_eq!(issued.expires, authority.expires);
    for days in [0, 36_501] {
        let refused = site.issue(&party("viewer.bob"), &[], days, Existing::Keep);
        assert!(matches!(refused, Err(AccessError::Days { .. })), "{days}");
    }
}

#[test]
fn all_parties_with_a_certificate_are_listed() {
    let (_folder, site) = site();
    for name in ["worker.main", "sensor.tower.roof", "gateway.bridge"] {
        site.issue(&party(name), &[], 365, Existing::Keep).unwrap();
    }
    std::fs::write(site.folder.join("notes.pem"), "not ours").unwrap();
    let found: Vec<String> = site
        .parties()
        .unwrap()
        .iter()
        .map(Party::common_name)
        .collect();
    assert_eq!(
        found,
        ["worker.main", "gateway.bridge", "sensor.tower.roof"]
    );
}

#[test]
fn key_of_another_authority_is_rejected() {
    let ((_folder, site), (_other, other)) = (site(), site());
    std::fs::copy(
        other.folder.join(AUTHORITY_KEY_FILE),
        site.folder.join(AUTHORITY_KEY_FILE),
    )
    .unwrap();
    let issued = site.issue(&party("viewer.ada"), &[], 365, Existing::Keep);
    assert!(
        matches!(issued, Err(AccessError::Tls(TlsError::NotAccepted { .. }))),
        "{issued:?}"
    );
}

#[test]
fn folder_without_an_authority_is_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let error = SiteFolder::open(folder.path()).unwrap_err().to_string();
    assert!(
        error.contains("authority.pem") && error.contains("spandrel site create"),
        "{error}"
    );
}

#[test]
fn several_routers_require_a_router_name() {
    let (_folder, site) = site();
    assert!(matches!(
        site.router(None),
        Err(AccessError::NoRouter { .. })
    ));
    let hosts = ["localhost".to_owned()];
    site.issue(&party("router.east"), &hosts, 365, Existing::Keep)
        .unwrap();
    assert_eq!(site.router(None).unwrap(), party("router.east"));
    site.issue(&party("router.west"), &hosts, 365, Existing::Keep)
        .unwrap();
    assert!(matches!(
        site.router(None),
        Err(AccessError::SeveralRouters { .. })
    ));
    assert_eq!(site.router(Some("west")).unwrap(), party("router.west"));
}
