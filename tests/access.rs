//! Access rights: every role against every key, through a real router with the configuration that
//! `spandrel site` writes.
//!
//! The test compares its results with the table of docs/access.md. To rewrite the table, run
//! `UPDATE_DOCS=1 cargo test --workspace --test program access::`.

use crate::support::{DEADLINE, Process, Secured, five_storeys, spandrel, within};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, date_time_ymd};
use spandrel_access::{Party, Right, is_of_node, rights};
use spandrel_bus::{AlertMessage, AlertState, Bus, BusError, KeyFamily, Name, Status, TlsConfig};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::time::Duration;
use zenoh::Session;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Sample, SampleKind};

/// One party of each role. Parties of a structure or node belong to structure `demo` and node
/// `ground`.
const PARTIES: [&str; 11] = [
    "sensor.demo.ground",
    "gateway.demo",
    "node-worker.demo.ground",
    "worker.main",
    "alert.main",
    "history.main",
    "notify.main",
    "dashboard.main",
    "viewer.ada",
    "operator.grace",
    "server.main",
];
/// Party that observes the effect of every attempt. Its own rule is added to the router file.
const PROBE: &str = "viewer.probe";

/// Owner of a key, relative to the party.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum KeyOwner {
    /// Structure and node of the party.
    Own,
    /// Another node of that structure.
    OtherNode,
    /// Another structure.
    OtherStructure,
}

/// A key that a party tries to use.
type Key = (KeyOwner, KeyFamily);

fn key((owner, family): Key) -> String {
    let name = |text: &str| Name::new(text).unwrap();
    let structure = if owner == KeyOwner::OtherStructure {
        "other"
    } else {
        "demo"
    };
    let node = if owner == KeyOwner::OtherNode {
        "floor-1"
    } else {
        "ground"
    };
    family.expression(&name("spandrel"), Some(&name(structure)), Some(&name(node)))
}

/// Returns `true` if a name in the keys of this family can be a node.
fn has_node(family: KeyFamily) -> bool {
    Right::ALL
        .into_iter()
        .any(|right| is_of_node(right, family))
}

fn keys() -> Vec<Key> {
    let mut keys = Vec::new();
    for family in KeyFamily::all() {
        keys.push((KeyOwner::Own, family));
        keys.extend(has_node(family).then_some((KeyOwner::OtherNode, family)));
        keys.push((KeyOwner::OtherStructure, family));
    }
    keys
}

/// Returns `true` if the role of a party is meant to have this right.
fn is_meant(party: &Party, right: Right, (owner, family): Key) -> bool {
    let in_reach = match owner {
        KeyOwner::Own => true,
        KeyOwner::OtherNode => party.node().is_none() || !is_of_node(right, family),
        KeyOwner::OtherStructure => party.structure().is_none(),
    };
    in_reach && rights(party.role()).contains(&(right, family))
}

/// Adds a party with all rights to the router file. The rules of all others stay as `spandrel site`
/// wrote them.
fn admit_probe(site: &Secured) {
    let text = std::fs::read_to_string(site.router_file()).unwrap();
    let json: String = text
        .lines()
        .filter(|line| !line.starts_with("//"))
        .collect();
    let mut config: serde_json::Value = serde_json::from_str(&json).unwrap();
    let every: Vec<String> = keys().into_iter().map(key).collect();
    let control = &mut config["access_control"];
    control["rules"].as_array_mut().unwrap().push(serde_json::json!({
        "id": "everything", "permission": "allow", "flows": ["ingress", "egress"], "key_exprs": every,
        "messages": ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
                     "liveliness_token", "liveliness_query", "declare_liveliness_subscriber"],
    }));
    control["policies"]
        .as_array_mut()
        .unwrap()
        .push(serde_json::json!({ "rules": ["everything"], "subjects": [PROBE] }));
    std::fs::write(site.router_file(), config.to_string()).unwrap();
}

/// Waits until the router has processed all data from this session, and this session all data sent
/// to it. Zenoh answers queries in order, including rejected ones.
async fn data_settled(session: &Session) {
    let end = session
        .get("spandrel/nobody/answers")
        .timeout(DEADLINE)
        .await
        .unwrap();
    within("end of a query", async {
        while end.recv_async().await.is_ok() {}
    })
    .await;
}

/// Waits as [`data_settled`] does, for declarations.
async fn declarations_settled(session: &Session) {
    let end = session
        .liveliness()
        .get("spandrel/nobody/lives")
        .timeout(DEADLINE)
        .await
        .unwrap();
    within("end of a liveliness query", async {
        while end.recv_async().await.is_ok() {}
    })
    .await;
}

/// Rights that a party has shown in the test.
type Seen = BTreeSet<(Right, Key)>;

/// Tries every operation as one party, while a party with all rights observes.
async fn try_everything(party: &Session, probe: &Session) -> Seen {
    let mut seen = Seen::new();
    let keys: BTreeMap<String, Key> = keys().into_iter().map(|key_| (key(key_), key_)).collect();
    let settled = async || {
        declarations_settled(party).await;
        declarations_settled(probe).await;
        data_settled(party).await;
        data_settled(probe).await;
        // Data that the other session still had in transit.
        data_settled(party).await;
    };

    // Put, and delete, which no role may do.
    let (heard, hearing) = flume::unbounded::<Sample>();
    let mut subscribers = Vec::new();
    for key in keys.keys() {
        let heard = heard.clone();
        subscribers.push(
            probe
                .declare_subscriber(key)
                .callback(move |sample| heard.send(sample).unwrap())
                .await
                .unwrap(),
        );
    }
    settled().await;
    for key in keys.keys() {
        party.put(key, "message").await.unwrap();
        party.delete(key).await.unwrap();
    }
    settled().await;
    for sample in hearing.drain() {
        assert_eq!(
            sample.kind(),
            SampleKind::Put,
            "{} was deleted",
            sample.key_expr()
        );
        seen.insert((Right::Put, keys[sample.key_expr().as_str()]));
    }
    drop(subscribers);

    // Subscribe.
    let (heard, hearing) = flume::unbounded::<Sample>();
    let mut subscribers = Vec::new();
    for key in keys.keys() {
        let heard = heard.clone();
        subscribers.push(
            party
                .declare_subscriber(key)
                .callback(move |sample| heard.send(sample).unwrap())
                .await
                .unwrap(),
        );
    }
    settled().await;
    for key in keys.keys() {
        probe.put(key, "message").await.unwrap();
    }
    settled().await;
    seen.extend(
        hearing
            .drain()
            .map(|sample| (Right::Subscribe, keys[sample.key_expr().as_str()])),
    );
    drop(subscribers);

    // Query.
    let mut queryables = Vec::new();
    for key in keys.keys() {
        let answer = move |query: zenoh::query::Query| {
            let reply = query.key_expr().clone();
            zenoh::Wait::wait(query.reply(reply, "answer")).unwrap();
        };
        queryables.push(probe.declare_queryable(key).callback(answer).await.unwrap());
    }
    settled().await;
    seen.extend(
        answered(party, &keys)
            .await
            .into_iter()
            .map(|key| (Right::Query, key)),
    );
    drop(queryables);

    // Reply.
    settled().await;
    let mut queryables = Vec::new();
    for key in keys.keys() {
        let answer = move |query: zenoh::query::Query| {
            let reply = query.key_expr().clone();
            zenoh::Wait::wait(query.reply(reply, "answer")).unwrap();
        };
        queryables.push(party.declare_queryable(key).callback(answer).await.unwrap());
    }
    settled().await;
    seen.extend(
        answered(probe, &keys)
            .await
            .into_iter()
            .map(|key| (Right::Answer, key)),
    );
    drop(queryables);

    // Declare liveliness tokens.
    let mut tokens = Vec::new();
    for key in keys.keys() {
        tokens.push(party.liveliness().declare_token(key).await.unwrap());
    }
    settled().await;
    for (key, tried) in &keys {
        let replies = probe.liveliness().get(key).timeout(DEADLINE).await.unwrap();
        let is_alive = within("liveliness", replies.recv_async())
            .await
            .is_ok_and(|reply| reply.result().is_ok());
        seen.extend(is_alive.then_some((Right::Announce, *tried)));
    }
    drop(tokens);
    settled().await;

    // Watch liveliness tokens: existing ones and new ones.
    let mut tokens = Vec::new();
    for key in keys.keys().step_by(2) {
        tokens.push(probe.liveliness().declare_token(key).await.unwrap());
    }
    settled().await;
    let (heard, hearing) = flume::unbounded::<Sample>();
    let mut subscribers = Vec::new();
    for key in keys.keys() {
        let heard = heard.clone();
        let declared = party.liveliness().declare_subscriber(key).history(true);
        subscribers.push(
            declared
                .callback(move |sample| heard.send(sample).unwrap())
                .await
                .unwrap(),
        );
    }
    settled().await;
    for key in keys.keys().skip(1).step_by(2) {
        tokens.push(probe.liveliness().declare_token(key).await.unwrap());
    }
    settled().await;
    seen.extend(
        hearing
            .drain()
            .map(|sample| (Right::Watch, keys[sample.key_expr().as_str()])),
    );
    seen
}

/// Returns the keys on which a query of this session receives a reply.
async fn answered(session: &Session, keys: &BTreeMap<String, Key>) -> Vec<Key> {
    let mut answered = Vec::new();
    for (key, tried) in keys {
        let replies = session.get(key).timeout(DEADLINE).await.unwrap();
        let is_answered = within("reply", replies.recv_async())
            .await
            .is_ok_and(|reply| reply.result().is_ok());
        answered.extend(is_answered.then_some(*tried));
    }
    answered
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_role_has_only_the_rights_for_its_task() {
    let others: Vec<&str> = PARTIES
        .into_iter()
        .filter(|party| !party.starts_with("sensor."))
        .collect();
    let site = Secured::new(&five_storeys(), &[&others[..], &[PROBE]].concat());
    admit_probe(&site);
    let _router = site.router();
    let probe = site.join(PROBE).await;
    let mut table: BTreeMap<&str, Seen> = BTreeMap::new();
    for name in PARTIES {
        let bus = site.join(name).await;
        table.insert(name, try_everything(bus.session(), probe.session()).await);
        bus.close().await.unwrap();
    }
    probe.close().await.unwrap();
    let mut wrong = String::new();
    for name in PARTIES {
        let party: Party = name.parse().unwrap();
        for (right, tried) in Right::ALL
            .into_iter()
            .flat_map(|right| keys().into_iter().map(move |key| (right, key)))
        {
            let (meant, found) = (
                is_meant(&party, right, tried),
                table[name].contains(&(right, tried)),
            );
            if meant != found {
                let (expected, found) = (may(meant), may(found));
                let _ = writeln!(
                    wrong,
                    "{name} {expected} {} {}, found: {found}",
                    right.as_str(),
                    key(tried)
                );
            }
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
    compare_with_the_page(&written(&table));
}

fn may(may: bool) -> &'static str {
    if may { "may" } else { "may not" }
}

/// Formats the table as in the page: keys in rows, roles in columns.
fn written(table: &BTreeMap<&str, Seen>) -> String {
    let shown = |name: &str| name.split('.').next().unwrap_or_default().to_owned();
    let mut text = format!("| key | {} |\n", PARTIES.map(shown).join(" | "));
    let _ = writeln!(text, "|---|{}", "---|".repeat(PARTIES.len()));
    for tried in keys() {
        let (owner, family) = tried;
        let own = Name::new("own").unwrap();
        let (structure, node) = match owner {
            KeyOwner::Own => ("STRUCTURE", "NAME"),
            KeyOwner::OtherNode => ("STRUCTURE", "OTHER"),
            KeyOwner::OtherStructure => ("ELSEWHERE", "NAME"),
        };
        let expression = family.expression(&own, Some(&own), Some(&own));
        let mut chunks: Vec<&str> = expression.split('/').skip(1).collect();
        chunks[0] = structure;
        chunks
            .iter_mut()
            .skip(1)
            .filter(|chunk| **chunk == "own")
            .for_each(|chunk| *chunk = node);
        let cells = PARTIES.map(|name| {
            let of_key = |right: &Right| table[name].contains(&(*right, tried));
            Right::ALL
                .into_iter()
                .filter(of_key)
                .map(Right::as_str)
                .collect::<Vec<_>>()
                .join(", ")
        });
        let _ = writeln!(text, "| `{}` | {} |", chunks.join("/"), cells.join(" | "));
    }
    text
}

const BEGIN: &str = "<!-- table: written by the test of tests/access.rs -->\n";
const END: &str = "<!-- end of the table -->\n";

fn compare_with_the_page(table: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/access.md");
    let page = std::fs::read_to_string(&path).unwrap();
    let (before, rest) = page.split_once(BEGIN).unwrap();
    let (kept, after) = rest.split_once(END).unwrap();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, format!("{before}{BEGIN}{table}{END}{after}")).unwrap();
        return;
    }
    assert!(
        kept == table,
        "docs/access.md differs from the observed effects; UPDATE_DOCS=1 rewrites it:\n{table}"
    );
}

/// Returns `true` if a plain Zenoh session can connect. Spandrel's own checks before a connection
/// would get in the way.
async fn connects(endpoint: &str, tls: Option<&TlsConfig>, authority: &Path) -> bool {
    let mut config = zenoh::Config::default();
    let mut set =
        |key: &str, value: serde_json::Value| config.insert_json5(key, &value.to_string()).unwrap();
    set("mode", "client".into());
    set("scouting/multicast/enabled", false.into());
    set("connect/endpoints", vec![endpoint].into());
    set("connect/timeout_ms", 3000.into());
    set("connect/exit_on_failure", true.into());
    set(
        "transport/link/tls/root_ca_certificate",
        authority.to_str().unwrap().into(),
    );
    if let Some(tls) = tls {
        set("transport/link/tls/enable_mtls", true.into());
        set(
            "transport/link/tls/connect_certificate",
            tls.certificate.to_str().unwrap().into(),
        );
        set(
            "transport/link/tls/connect_private_key",
            tls.key().to_str().unwrap().into(),
        );
    }
    match zenoh::open(config).await {
        Ok(session) => {
            session.close().await.unwrap();
            true
        }
        Err(_) => false,
    }
}

/// Creates a certificate for `viewer.late` from the site's own authority that expired long ago.
fn expired(site: &Secured) -> TlsConfig {
    let read = |file: &str| std::fs::read_to_string(site.folder().join(file)).unwrap();
    let authority_key = KeyPair::from_pem(&read("authority.key")).unwrap();
    let issuer = Issuer::from_ca_cert_pem(&read("authority.pem"), authority_key).unwrap();
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params
        .distinguished_name
        .push(DnType::CommonName, "viewer.ada");
    (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(2021, 1, 1));
    let certificate = params.signed_by(&key, &issuer).unwrap();
    let tls = TlsConfig::beside(site.folder().join("expired.pem"));
    std::fs::write(&tls.certificate, certificate.pem()).unwrap();
    std::fs::write(tls.key(), key.serialize_pem()).unwrap();
    tls
}

/// Creates a certificate for `viewer.ada` from a self-made authority.
fn of_another_authority(site: &Secured) -> TlsConfig {
    let authority_key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let issuer = Issuer::new(params, authority_key);
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params
        .distinguished_name
        .push(DnType::CommonName, "viewer.ada");
    let certificate = params.signed_by(&key, &issuer).unwrap();
    let tls = TlsConfig::beside(site.folder().join("foreign.pem"));
    std::fs::write(&tls.certificate, certificate.pem()).unwrap();
    std::fs::write(tls.key(), key.serialize_pem()).unwrap();
    tls
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_router_accepts_only_valid_certificates_of_its_authority() {
    let site = Secured::new(&five_storeys(), &["viewer.ada"]);
    let _router = site.router();
    let authority = site.folder().join("authority.pem");
    let valid = TlsConfig::beside(site.certificate("viewer.ada"));
    assert!(
        connects(site.endpoint(), Some(&valid), &authority).await,
        "a valid certificate is refused"
    );
    assert!(
        !connects(site.endpoint(), None, &authority).await,
        "no certificate is needed"
    );
    assert!(
        !connects(site.endpoint(), Some(&expired(&site)), &authority).await,
        "an expired certificate is taken"
    );
    let foreign = of_another_authority(&site);
    assert!(
        !connects(site.endpoint(), Some(&foreign), &authority).await,
        "another authority's certificate is taken"
    );
    let plain = site.endpoint().replace("quic/", "tcp/");
    assert!(
        !connects(&plain, None, &authority).await,
        "plain TCP is taken"
    );
    // The certificate still works for its own parties.
    assert!(connects(site.endpoint(), Some(&valid), &authority).await);
}

/// Regression: ten refused certificates and 100 refused messages left no trace.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_router_logs_refused_certificates_and_messages() {
    const MANY: usize = 100;
    const HANDSHAKES: usize = 10;
    let site = Secured::new(&five_storeys(), &["viewer.ada", "operator.grace"]);
    let router = site.router();
    let authority = site.folder().join("authority.pem");
    let foreign = of_another_authority(&site);
    for _ in 0..HANDSHAKES {
        assert!(!connects(site.endpoint(), Some(&foreign), &authority).await);
    }
    router.wait_for_log("refused what=\"bus-handshake\"");
    router.wait_for_log("UnknownIssuer");

    // What a party may do leaves no trace.
    let grace = site.join("operator.grace").await;
    let keys = viewer_keys();
    let key = keys.acknowledge(&Name::new("storey-2").unwrap());
    for _ in 0..MANY {
        grace.session().put(&key, "x").await.unwrap();
    }
    data_settled(grace.session()).await;

    let ada = site.join("viewer.ada").await;
    // Without a subscriber, a declared publisher sends nothing. A busy machine drops messages of
    // the default congestion control before they are sent.
    let subscriber = grace.session().declare_subscriber(&key).await.unwrap();
    let (session, event) = (ada.session(), keys.event());
    let declared = session.declare_publisher(key.clone());
    let declared = declared.congestion_control(CongestionControl::Block);
    let declared = declared.await.unwrap();
    for _ in 0..MANY {
        session
            .put(&event, "x")
            .congestion_control(CongestionControl::Block)
            .await
            .unwrap();
        declared.put("x").await.unwrap();
    }
    let named = "what=\"bus-right\" who=\"viewer.ada (127.0.0.1)\" why=\"Put on ";
    router.wait_for_log(named);
    data_settled(ada.session()).await;
    drop((declared, subscriber));
    for bus in [ada, grace] {
        bus.close().await.unwrap();
    }
    let log = router.stop().expect_code(0).stderr;
    let lines = log.lines().filter(|line| line.contains("refused what="));
    let lines: Vec<&str> = lines.collect();
    assert!(lines.len() <= 20, "{} lines\n{log}", lines.len());
    // A router has no metrics. Its lines account for every refusal.
    let counted = |what: &str, who: &str| {
        let of_kind = lines
            .iter()
            .filter(|line| line.contains(what) && line.contains(who));
        let times = of_kind.filter_map(|line| line.rsplit_once("times="));
        times
            .map(|(_, times)| times.trim().parse::<usize>().unwrap())
            .sum::<usize>()
    };
    // A client may try more than once to connect.
    assert!(counted("what=\"bus-handshake\"", "") >= HANDSHAKES, "{log}");
    assert!(
        counted("what=\"bus-right\"", "viewer.ada") >= 2 * MANY,
        "{log}"
    );
    let of_grace = |line: &&&str| line.contains("operator.grace") && line.contains("Put");
    assert_eq!(lines.iter().find(of_grace), None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_metrics_count_refused_certificates() {
    const HANDSHAKES: u64 = 3;
    let site = Secured::new(&five_storeys(), &[]);
    site.tool(&["issue"], &["server", "main", "--host", "127.0.0.1"]);
    let mut run = spandrel("run");
    run.arg(five_storeys()).arg("-v");
    run.args(["--listen", site.endpoint(), "--http", "127.0.0.1:0"]);
    run.arg("--certificate")
        .arg(site.certificate("server.main"));
    let services = Process::start(&mut run);
    services.wait_for_log("ready structures=1");
    let page = address_of(&services);
    assert_eq!(refused_handshakes(&page), 0);
    let authority = site.folder().join("authority.pem");
    let foreign = of_another_authority(&site);
    for _ in 0..HANDSHAKES {
        assert!(!connects(site.endpoint(), Some(&foreign), &authority).await);
    }
    services.wait_for_log("refused what=\"bus-handshake\" who=\"unknown address\"");
    within("the count of all handshakes", async {
        while refused_handshakes(&page) < HANDSHAKES {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    })
    .await;
    services.stop().expect_code(0);
}

/// Reads the count of failed handshakes from the metrics of a page.
fn refused_handshakes(address: &str) -> u64 {
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    let request = "GET /metrics HTTP/1.1\r\nConnection: close\r\n";
    write!(stream, "{request}Host: {address}\r\n\r\n").unwrap();
    let mut metrics = String::new();
    stream.read_to_string(&mut metrics).unwrap();
    let start = "spandrel_refused_total{reason=\"bus-handshake\"} ";
    let count = metrics.lines().find_map(|line| line.strip_prefix(start));
    count.expect("a count").parse().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_error_explains_a_rejected_session() {
    let site = Secured::new(&five_storeys(), &["viewer.ada"]);
    let other = Secured::new(&five_storeys(), &["viewer.ada"]);
    let _router = site.router();
    let hurried = |party: &str| spandrel_bus::BusConfig {
        connect_timeout_s: Some(3.0),
        ..site.config(party)
    };
    let told = async |config: &spandrel_bus::BusConfig| match Bus::open(config).await {
        Ok(_) => panic!("{config:?} has connected"),
        Err(error) => error.to_string(),
    };

    let mut config = hurried("viewer.ada");
    config.tls = Some(expired(&site));
    let text = told(&config).await;
    assert!(
        text.contains("expired.pem") && text.contains("it expired"),
        "{text}"
    );

    config.tls = Some(TlsConfig::beside(other.certificate("viewer.ada")));
    let text = told(&config).await;
    assert!(
        text.contains(site.endpoint()) && text.contains("the authority did not issue it"),
        "{text}"
    );

    // The authority of the router with a certificate of another authority: the error comes from the
    // router.
    let mixed = TlsConfig {
        authority: Some(site.folder().join("authority.pem")),
        ..of_another_authority(&site)
    };
    let error = TlsConfig::check(&mixed).unwrap_err().to_string();
    assert!(
        error.contains("foreign.pem") && error.contains("did not issue it"),
        "{error}"
    );

    let mut config = hurried("viewer.ada");
    config.tls = None;
    assert!(matches!(
        Bus::open(&config).await,
        Err(BusError::NoCertificates { .. })
    ));

    // An address that is missing in the certificate of the router.
    let mut config = hurried("viewer.ada");
    config.connect = vec![site.endpoint().replace("127.0.0.1", "127.0.0.2")];
    let text = told(&config).await;
    assert!(text.contains("127.0.0.2"), "{text}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_removed_from_the_folder_is_revoked() {
    let site = Secured::new(&five_storeys(), &["operator.grace", "viewer.ada"]);
    let kept = site.folder().join("kept");
    std::fs::create_dir(&kept).unwrap();
    for file in ["operator.grace.pem", "operator.grace.key"] {
        std::fs::rename(site.folder().join(file), kept.join(file)).unwrap();
    }
    std::fs::copy(
        site.folder().join("authority.pem"),
        kept.join("authority.pem"),
    )
    .unwrap();
    let structure = five_storeys();
    let listen = ["--listen", site.endpoint(), "--replace"];
    site.tool(
        &["router"],
        &[&[structure.to_str().unwrap()], &listen[..]].concat(),
    );
    let _router = site.router();
    let taken_out = spandrel_bus::BusConfig {
        tls: Some(TlsConfig::beside(kept.join("operator.grace.pem"))),
        ..site.config("viewer.ada")
    };
    let former = Bus::open(&taken_out).await.unwrap();
    let viewer = site.join("viewer.ada").await;
    let keys = viewer_keys();
    let heard = viewer
        .session()
        .declare_subscriber(keys.all_acknowledgements())
        .await
        .unwrap();
    declarations_settled(viewer.session()).await;
    let storey: Name = "storey-2".parse().unwrap();
    former
        .session()
        .put(keys.acknowledge(&storey), "seen")
        .await
        .unwrap();
    data_settled(former.session()).await;
    data_settled(viewer.session()).await;
    assert_eq!(
        heard
            .try_recv()
            .unwrap()
            .map(|sample| sample.key_expr().to_string()),
        None
    );
}

fn viewer_keys() -> spandrel_bus::Keys {
    spandrel_bus::Keys::parse("spandrel", "demo").unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_alert_arrives_over_the_router() {
    let parties = [
        "worker.main",
        "alert.main",
        "viewer.ada",
        "operator.grace",
        "gateway.demo",
        "dashboard.hall",
    ];
    let site = Secured::new(&five_storeys(), &parties);
    let _router = site.router();
    let viewer = site.join("viewer.ada").await;
    let alerts = viewer
        .subscribe::<AlertMessage>(viewer_keys().all_alerts(), 64)
        .await
        .unwrap();
    let services = [
        ("worker.main", "ingest"),
        ("worker.main", "identify"),
        ("alert.main", "alert"),
    ];
    let services =
        services.map(|(party, service)| Process::start(&mut site.connecting(party, service)));
    services
        .iter()
        .for_each(|service| service.wait_for_log("ready structures=1"));
    let page = Process::start(
        site.connecting("dashboard.hall", "dashboard")
            .args(["--http", "127.0.0.1:0"]),
    );
    let mut simulate = site.connecting("gateway.demo", "simulate");
    let simulation = Process::start(simulate.args(["--speed", "max", "--duration", "120"]));
    let raised = within("alert", next(&alerts, AlertState::Raised)).await;
    assert_eq!(raised.parameter.as_str(), "storey-2");

    // A read-only page must report that it cannot acknowledge, because the router would stay
    // silent.
    let refused = within("an answer on a raised alert", async {
        loop {
            match acknowledge_on(&page) {
                // The page has not received the alert yet.
                (409, _) => tokio::time::sleep(Duration::from_millis(200)).await,
                answer => return answer,
            }
        }
    });
    let (status, told) = refused.await;
    assert_eq!(status, 403, "{told}");
    assert!(
        told.contains("role dashboard may not acknowledge; roles that may: server, operator"),
        "{told}"
    );

    // An operator's acknowledgement is accepted.
    let operator = site.join("operator.grace").await;
    let publisher = operator
        .publish_display(viewer_keys().acknowledge(&raised.parameter))
        .await
        .unwrap();
    let acknowledgement = spandrel_bus::Acknowledgement {
        structure: raised.structure.clone(),
        parameter: raised.parameter.clone(),
        time_ns: raised.time_ns,
        who: "Grace".to_owned(),
        note: String::new(),
    };
    publisher.put(&acknowledgement).await.unwrap();
    let acknowledged = within(
        "acknowledged alert",
        next(&alerts, AlertState::Acknowledged),
    )
    .await;
    assert_eq!(acknowledged.acknowledged_by.as_deref(), Some("Grace"));
    simulation.wait().expect_code(0);
    page.stop().expect_code(0);
    for service in services {
        service.stop().expect_code(0);
    }
    viewer.close().await.unwrap();
    operator.close().await.unwrap();
}

/// Waits for the address of a page.
fn address_of(page: &Process) -> String {
    page.wait_for_output("the address of the page", |said| {
        said.contains("page: http://") && said.contains('\n')
    });
    let output = page.output();
    let mut lines = output.lines();
    let address = lines.find_map(|line| line.strip_prefix("page: http://"));
    address.unwrap().trim_end_matches('/').to_owned()
}

/// Acknowledges the alert of storey 2 on a page. Returns the status and the body of the reply.
fn acknowledge_on(page: &Process) -> (u16, String) {
    let address = address_of(page);
    let body = r#"{"who": "Grace"}"#;
    let mut stream = std::net::TcpStream::connect(&address).unwrap();
    let head = format!(
        "POST /api/structures/demo/alerts/storey-2/acknowledge HTTP/1.1\r\nHost: {address}\r\n\
         Connection: close"
    );
    let length = body.len();
    write!(
        stream,
        "{head}\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n\r\n{body}"
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    (answer.split(' ').nth(1).unwrap().parse().unwrap(), answer)
}

async fn next(
    alerts: &spandrel_bus::Subscription<AlertMessage>,
    state: AlertState,
) -> AlertMessage {
    loop {
        let (_, alert) = alerts.messages().recv_async().await.unwrap();
        if alert.state == state {
            return alert;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_publishes_only_with_its_own_certificate() {
    let site = Secured::new(&five_storeys(), &["worker.main", "viewer.ada"]);
    let _router = site.router();
    let viewer = site.join("viewer.ada").await;
    let statuses = viewer
        .subscribe::<Status>(viewer_keys().all_statuses(), 64)
        .await
        .unwrap();
    let ingest = Process::start(&mut site.connecting("worker.main", "ingest"));
    ingest.wait_for_log("ready structures=1");
    let mut node = site.connecting("sensor.demo.ground", "simulate");
    let node = Process::start(node.args(["--live", "--node", "ground"]));
    let done = async { while statuses.messages().recv_async().await.unwrap().1.done == 0 {} };
    within("frames with the samples of this node", done).await;
    node.stop().expect_code(0);
    ingest.stop().expect_code(0);
    viewer.close().await.unwrap();
}

#[test]
fn subcommand_with_a_certificate_of_another_role_lists_the_allowed_roles() {
    let site = Secured::new(
        &five_storeys(),
        &["viewer.ada", "worker.main", "gateway.demo"],
    );
    let _router = site.router();
    let refused = [
        (
            "viewer.ada",
            "simulate",
            "role viewer may not publish samples",
            "gateway, sensor",
        ),
        (
            "gateway.demo",
            "run",
            "role gateway may not publish frames",
            "server",
        ),
        (
            "worker.main",
            "alert",
            "role worker may not publish alerts",
            "server, alert",
        ),
        (
            "sensor.demo.ground",
            "simulate",
            "for node ground of demo only",
            "--node ground",
        ),
    ];
    for (party, subcommand, why, way) in refused {
        let mut command = site.connecting(party, subcommand);
        if subcommand == "simulate" {
            command.args(["--speed", "max", "--duration", "1"]);
        }
        Process::start(&mut command)
            .wait()
            .expect_code(2)
            .expect_told(&[&format!("{party}.pem"), why, way]);
    }
}

#[test]
fn site_commands_list_the_written_files_and_do_not_overwrite_them() {
    let site = Secured::new(&five_storeys(), &[]);
    let folder = site.folder();
    let structure = five_storeys();
    let run = |arguments: &[&str]| {
        let mut command = spandrel("site");
        Process::start(command.arg(arguments[0]).arg(&folder).args(&arguments[1..])).wait()
    };
    let issued = run(&["issue", "worker", "east", "--days", "30"])
        .expect_code(0)
        .stdout;
    assert!(
        issued.contains("worker.east.pem")
            && issued.contains("worker.east.key")
            && issued.contains("until 2")
    );
    run(&["issue", "worker", "east"])
        .expect_code(2)
        .expect_told(&["worker.east.pem", "--replace"]);
    run(&["create"])
        .expect_code(2)
        .expect_told(&["authority.pem", "--replace"]);
    run(&["issue", "router", "second"])
        .expect_code(2)
        .expect_told(&["--host"]);
    run(&["issue", "sensor", "roof"])
        .expect_code(2)
        .expect_told(&["STRUCTURE.NODE"]);
    run(&["issue", "boss", "x"])
        .expect_code(2)
        .expect_told(&["boss", "operator"]);
    run(&["issue", "sensor", "demo.attic"]).expect_code(0);
    let listen = ["--listen", "quic/127.0.0.1:7447", "--replace"];
    let with = |file: &str| run(&[&["router", file][..], &listen[..]].concat());
    with(structure.to_str().unwrap())
        .expect_code(2)
        .expect_told(&["attic", "ground"]);
    run(&[&["router"][..], &listen[..]].concat())
        .expect_code(2)
        .expect_told(&["sensor.demo", "not given"]);
    for file in ["sensor.demo.attic.pem", "sensor.demo.attic.key"] {
        std::fs::remove_file(folder.join(file)).unwrap();
    }
    let plain = ["--listen", "tcp/0.0.0.0:7447", "--replace"];
    run(&[&["router", structure.to_str().unwrap()][..], &plain[..]].concat())
        .expect_code(2)
        .expect_told(&["tcp/0.0.0.0:7447", "quic/"]);
    with(structure.to_str().unwrap()).expect_code(0);
}

#[test]
fn a_router_file_that_admits_strangers_is_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("router.json5");
    let run = |text: &str| {
        std::fs::write(&file, text).unwrap();
        Process::start(spandrel("router").arg(&file)).wait()
    };
    let quiet = "scouting: { multicast: { enabled: false } }";
    run(&format!("{{ {quiet} }}"))
        .expect_code(2)
        .expect_told(&["tcp/[::]:7447", "spandrel site"]);
    run(&format!(
        "{{ listen: {{ endpoints: [\"quic/0.0.0.0:7447\"] }}, {quiet} }}"
    ))
    .expect_code(2)
    .expect_told(&["quic/0.0.0.0:7447", "enable_mtls"]);
    run("{ listen: { endpoints: [\"tcp/127.0.0.1:0\"] } }")
        .expect_code(2)
        .expect_told(&["multicast"]);
    run(&format!("{{ mode: \"client\", {quiet} }}"))
        .expect_code(2)
        .expect_told(&["router.json5", "client"]);
    run("{ listen: { endpoint: [] } }")
        .expect_code(2)
        .expect_told(&["router.json5", "endpoint"]);
    run("{ mode: ")
        .expect_code(2)
        .expect_told(&["router.json5"]);
    let tls = "transport: { link: { tls: { root_ca_certificate: \"/nowhere/a.pem\", enable_mtls: \
               true, listen_certificate: \"/nowhere/r.pem\", \
               listen_private_key: \"/nowhere/r.key\" } } }";
    run(&format!(
        "{{ listen: {{ endpoints: [\"quic/127.0.0.1:0\"] }}, {quiet}, {tls} }}"
    ))
    .expect_code(2)
    .expect_told(&["/nowhere/r.pem"]);
    let nowhere = Process::start(spandrel("router").arg("/nowhere/router.json5")).wait();
    nowhere
        .expect_code(2)
        .expect_told(&["/nowhere/router.json5"]);
}

#[test]
fn services_refuse_to_listen_beyond_this_machine_without_certificates() {
    let run = |arguments: &[&str]| {
        Process::start(spandrel("ingest").arg(five_storeys()).args(arguments))
            .wait()
            .expect_code(2)
    };
    run(&["--listen", "tcp/0.0.0.0:7447"]).expect_told(&[
        "tcp/0.0.0.0:7447",
        "bus.tls",
        "127.0.0.1",
    ]);
    run(&["--listen", "quic/0.0.0.0:7447"]).expect_told(&["quic/0.0.0.0:7447", "bus.tls"]);
    run(&["--connect", "quic/10.0.0.5:7447"]).expect_told(&["quic/10.0.0.5:7447", "--certificate"]);
    let site = Secured::new(&five_storeys(), &["worker.main"]);
    std::fs::copy(
        site.folder().join("authority.key"),
        site.folder().join("worker.main.key"),
    )
    .unwrap();
    let certificate = site.certificate("worker.main");
    let told = run(&[
        "--connect",
        site.endpoint(),
        "--certificate",
        certificate.to_str().unwrap(),
    ])
    .expect_told(&["worker.main.key", "does not match certificate"]);
    assert!(!told.stderr.contains("PRIVATE"), "{}", told.stderr);
}

#[test]
fn certificates_can_be_set_in_the_configuration() {
    let site = Secured::new(&five_storeys(), &["worker.main"]);
    let _router = site.router();
    let file = site.folder().join("spandrel.toml");
    let text = format!(
        "structures = [{:?}]\n[bus]\nmode = \"client\"\nconnect = [{:?}]\n[bus.tls]\n\
         certificate = \"worker.main.pem\"\n",
        five_storeys(),
        site.endpoint()
    );
    std::fs::write(&file, text).unwrap();
    let ingest = Process::start(spandrel("ingest").args(["-v", "--config"]).arg(&file));
    ingest.wait_for_log("ready structures=1");
    ingest.stop().expect_code(0);
    let elsewhere = spandrel("ingest")
        .args(["-v", "--config"])
        .arg(&file)
        .env("SPANDREL_BUS__TLS__CERTIFICATE", "/nowhere/worker.main.pem")
        .output()
        .unwrap();
    assert!(
        String::from_utf8_lossy(&elsewhere.stderr).contains("/nowhere/worker.main.pem"),
        "{elsewhere:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_one_router_forbids_do_not_reach_another() {
    let structure = five_storeys();
    let site = Secured::new(&structure, &["worker.main"]);
    site.tool(&["issue"], &["router", "second", "--host", "127.0.0.1"]);
    let second = std::net::UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let (second, file) = (format!("quic/{second}"), site.folder().join("second.json5"));
    let router = |name: &str, more: &[&str]| {
        let of_each = [
            structure.to_str().unwrap(),
            "--router",
            name,
            "--replace",
            "--listen",
        ];
        site.tool(&["router"], &[&of_each, more].concat());
    };
    router("main", &[site.endpoint()]);
    router(
        "second",
        &[
            &second,
            "--connect",
            site.endpoint(),
            "--output",
            file.to_str().unwrap(),
        ],
    );
    let _router = site.router();
    let other = Process::start(spandrel("router").arg(&file).arg("-v"));
    other.wait_for_log("ready");

    let worker = site.join("worker.main").await;
    let (heard, hearing) = flume::unbounded::<Sample>();
    let all = worker
        .session()
        .declare_subscriber("spandrel/demo/sensor/*/samples");
    let _subscriber = all
        .callback(move |sample| heard.send(sample).unwrap())
        .await
        .unwrap();
    let at_second = spandrel_bus::BusConfig {
        connect: vec![second],
        ..site.config("sensor.demo.ground")
    };
    let sensor = Bus::open(&at_second).await.unwrap();
    let own = sensor
        .session()
        .declare_publisher("spandrel/demo/sensor/ground/samples")
        .await
        .unwrap();
    let matching = own.matching_listener().await.unwrap();
    within("the subscription behind the other router", async {
        while !own.matching_status().await.unwrap().matching()
            && !matching.recv_async().await.unwrap().matching()
        {}
    })
    .await;
    // One link keeps the order: rejected data would arrive before permitted data.
    sensor
        .session()
        .put("spandrel/demo/sensor/floor-1/samples", "message")
        .await
        .unwrap();
    sensor
        .session()
        .put("spandrel/demo/sensor/ground/samples", "message")
        .await
        .unwrap();
    let sample = within("samples from the other router", hearing.recv_async())
        .await
        .unwrap();
    assert_eq!(
        sample.key_expr().as_str(),
        "spandrel/demo/sensor/ground/samples"
    );
    sensor.close().await.unwrap();
    worker.close().await.unwrap();
    other.stop().expect_code(0);
}

#[test]
fn the_router_file_in_deploy_equals_the_output_of_the_program() {
    let others: Vec<&str> = PARTIES
        .into_iter()
        .filter(|party| !party.starts_with("sensor."))
        .collect();
    let site = Secured::new(&five_storeys(), &others);
    let written = site.folder().join("written.json5");
    let structure = five_storeys();
    let credentials = "/run/credentials/spandrel-router@main.service";
    let listen = [
        "--listen",
        "quic/10.0.0.5:7447",
        "--installed-in",
        credentials,
        "--output",
        written.to_str().unwrap(),
    ];
    site.tool(
        &["router"],
        &[&[structure.to_str().unwrap()], &listen[..]].concat(),
    );
    let written = std::fs::read_to_string(written).unwrap();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/router-tls.json5");
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, &written).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        kept == written,
        "deploy/router-tls.json5 differs from the output of the program; UPDATE_DOCS=1 rewrites it"
    );
}
