//! Certificates, keys, tokens and router files.

use super::files::make_pipe;
use super::table::Table;
use crate::support::{Finished, Process, Secured, five_storeys, free_endpoint, spandrel};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, date_time_ymd};
use std::path::Path;

/// Exit code of bad usage and bad input.
const BAD_INPUT: i32 = 2;
/// Exit code of an error that may disappear on a retry. For example, a certificate seems invalid
/// while the clock is not yet set.
const FAILED: i32 = 1;

/// Writes a certificate for `viewer.ada` from an authority, and its key.
fn write_certificate(folder: &Path, name: &str, issuer: &Issuer<'_, KeyPair>, years: (i32, i32)) {
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params
        .distinguished_name
        .push(DnType::CommonName, "viewer.ada");
    (params.not_before, params.not_after) =
        (date_time_ymd(years.0, 1, 1), date_time_ymd(years.1, 1, 1));
    std::fs::write(
        folder.join(name).with_extension("pem"),
        params.signed_by(&key, issuer).unwrap().pem(),
    )
    .unwrap();
    std::fs::write(folder.join(name).with_extension("key"), key.serialize_pem()).unwrap();
}

/// Removes the number of days, which grows.
fn undated(finished: Finished) -> Finished {
    let stderr = match finished.stderr.split_once(" days ago") {
        Some((before, after)) => format!(
            "{} DAYS ago{after}",
            before.trim_end_matches(|c: char| c.is_ascii_digit())
        ),
        None => return finished,
    };
    Finished { stderr, ..finished }
}

pub fn all(table: &mut Table) {
    table.section("Certificates, keys, tokens and router files");
    let site = Secured::new(&five_storeys(), &["viewer.ada"]);
    let folder = site.folder();
    let read = |file: &str| std::fs::read_to_string(folder.join(file)).unwrap();
    let issuer = Issuer::from_ca_cert_pem(
        &read("authority.pem"),
        KeyPair::from_pem(&read("authority.key")).unwrap(),
    )
    .unwrap();
    write_certificate(&folder, "expired", &issuer, (2020, 2021));
    write_certificate(&folder, "early", &issuer, (2990, 2999));
    let mut authority = CertificateParams::default();
    authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    write_certificate(
        &folder,
        "foreign",
        &Issuer::new(authority, KeyPair::generate().unwrap()),
        (2020, 2999),
    );
    std::fs::write(folder.join("none.pem"), "no certificate").unwrap();
    std::fs::write(folder.join("none.key"), "no key").unwrap();
    make_pipe(&folder.join("pipe.pem"));
    std::fs::copy(folder.join("viewer.ada.pem"), folder.join("swapped.pem")).unwrap();
    std::fs::copy(folder.join("authority.key"), folder.join("swapped.key")).unwrap();
    std::fs::copy(folder.join("viewer.ada.pem"), folder.join("keyless.pem")).unwrap();
    std::fs::copy(folder.join("viewer.ada.pem"), folder.join("halved.pem")).unwrap();
    let key = read("viewer.ada.key");
    std::fs::write(folder.join("halved.key"), &key[..key.len() / 2]).unwrap();
    let finish = |subcommand: &str, arguments: &[&str]| -> Finished {
        Process::start(spandrel(subcommand).current_dir(&folder).args(arguments)).wait()
    };
    let endpoint = free_endpoint().replace("tcp/", "quic/");
    for (given, file, told) in [
        (
            "a missing certificate",
            "nowhere.pem",
            &["nowhere.pem", "No such file"][..],
        ),
        (
            "a file that is not a certificate",
            "none.pem",
            &["none.pem"],
        ),
        (
            "a certificate that is a pipe",
            "pipe.pem",
            &["pipe.pem", "regular file"],
        ),
        (
            "a certificate without its key",
            "keyless.pem",
            &["keyless.key", "No such file"],
        ),
        ("half a key", "halved.pem", &["halved.key"]),
        (
            "the key of another certificate",
            "swapped.pem",
            &["swapped.key", "does not match certificate"],
        ),
        (
            "a certificate that has expired",
            "expired.pem",
            &["expired.pem", "it expired"],
        ),
        (
            "a certificate that is not valid yet",
            "early.pem",
            &["early.pem"],
        ),
        (
            "a certificate of another authority",
            "foreign.pem",
            &["foreign.pem", "did not issue it"],
        ),
    ] {
        let finished = finish("watch", &["--connect", &endpoint, "--certificate", file]);
        assert!(!finished.stderr.contains("PRIVATE"), "{}", finished.stderr);
        let told: Vec<String> = told.iter().map(|part| (*part).to_owned()).collect();
        let code = if ["expired.pem", "early.pem"].contains(&file) {
            FAILED
        } else {
            BAD_INPUT
        };
        table.add_ended(given, (code, &told), &undated(finished));
    }
    std::fs::write(
        folder.join("open.json5"),
        "{ listen: { endpoints: [\"tcp/127.0.0.1:0\"] } }",
    )
    .unwrap();
    std::fs::write(folder.join("half.json5"), "{ mode: ").unwrap();
    std::fs::write(folder.join("half.json"), "[{").unwrap();
    let structure = five_storeys();
    let page = [
        "run",
        structure.to_str().unwrap(),
        "--listen",
        "tcp/127.0.0.1:0",
    ];
    for (given, (subcommand, arguments), told) in [
        (
            "a router file that enables multicast",
            ("router", &["open.json5"][..]),
            &["multicast"][..],
        ),
        (
            "an incomplete router file",
            ("router", &["half.json5"]),
            &["half.json5"],
        ),
        (
            "a router file that is a pipe",
            ("router", &["pipe.pem"]),
            &["pipe.pem", "regular file"],
        ),
        (
            "a token file that is a pipe",
            ("token", &["ada", "--role", "viewer", "--file", "pipe.pem"]),
            &["pipe.pem", "regular file"],
        ),
        (
            "an unknown role",
            ("site", &["issue", ".", "boss", "x"]),
            &["boss", "operator"],
        ),
        (
            "a second certificate with the same name",
            ("site", &["issue", ".", "viewer", "ada"]),
            &["viewer.ada.pem", "--replace"],
        ),
        (
            "a token file that is not JSON",
            (page[0], &page[1..]),
            &["half.json:1", "spandrel token"],
        ),
    ] {
        let mut command = spandrel(subcommand);
        command
            .current_dir(&folder)
            .args(arguments)
            .env("SPANDREL_DASHBOARD__TOKENS", "half.json");
        let told: Vec<String> = told.iter().map(|part| (*part).to_owned()).collect();
        table.add_ended(
            given,
            (BAD_INPUT, &told),
            &Process::start(&mut command).wait(),
        );
    }
}
