//! The deployments of deploy/README.md: their commands run as printed, on computers that are
//! network namespaces.

use crate::support::{Computers, DEADLINE, packaged_postgresql, skip};
use std::time::{Duration, Instant};

/// Alert of the demo in the log.
const OF_DEMO: &str = "alert raised structure=\"demo\" parameter=\"storey-2\"";
/// Alert of the building with dashpots in the log.
const OF_DASHPOTS: &str = "alert raised structure=\"dashpot-building\" parameter=\"storey-2\"";
/// Interval between checks of a condition that cannot be awaited.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Repeats a query until the reply is correct.
#[track_caller]
#[expect(
    clippy::disallowed_methods,
    reason = "a deadline that only ends a hang"
)]
fn until(what: &str, ask: impl Fn() -> String, is_right: impl Fn(&str) -> bool) -> String {
    let start = Instant::now();
    loop {
        let said = ask();
        if is_right(&said) {
            return said;
        }
        assert!(
            start.elapsed() < DEADLINE,
            "waited {} s in vain: {what}\n{said}",
            DEADLINE.as_secs()
        );
        std::thread::sleep(LOOK_EVERY);
    }
}

#[test]
fn one_server_is_installed_as_printed_and_reports_the_damage() {
    let Some(mut computers) = Computers::or_skip("one", &[("server", "10.0.0.5")]) else {
        return;
    };
    computers.follow("server");
    computers.follow("server");
    computers
        .process("server", "run")
        .wait_for_log("ready structures=1");
    computers.follow("server");
    computers.process("server", "run").wait_for_log(OF_DEMO);
    computers.take("server", "run").stop().expect_code(0);

    computers.follow("server");
    computers.follow("server");
    computers
        .process("server", "spandrel")
        .wait_for_log(OF_DEMO);
    let page = computers.said(
        "server",
        "curl --silent --show-error --fail http://127.0.0.1:8080/api/alerts",
    );
    assert!(
        page.contains("storey-2") && page.contains("raised"),
        "{page}"
    );
    assert!(computers.is_through());
    computers.take("server", "spandrel").stop().expect_code(0);
    assert!(
        computers
            .file("server", "var/lib/spandrel/history.sqlite")
            .is_file()
    );
}

#[test]
fn remote_sensor_nodes_reach_a_server_and_people_through_its_router() {
    let at = [
        ("desk", "10.0.0.2"),
        ("server", "10.0.0.5"),
        ("node-ground", "10.0.0.11"),
        ("node-floor-1", "10.0.0.12"),
    ];
    let Some(mut computers) = Computers::or_skip("two", &at) else {
        return;
    };
    for computer in [
        "desk",
        "desk",
        "server",
        "server",
        "node-ground",
        "node-floor-1",
        "desk",
    ] {
        computers.follow(computer);
    }
    assert!(computers.is_through());
    computers
        .process("desk", "watch")
        .wait_for_output("estimates", |said| said.contains("storey-2"));
    // The readable files in the folders of the server do not include keys.
    let keys = computers.said("server", "find /etc/spandrel -name '*.key' -perm /077");
    assert_eq!(keys, "");
    for (computer, name) in [
        ("desk", "watch"),
        ("node-ground", "simulate"),
        ("node-floor-1", "simulate"),
        ("server", "spandrel"),
    ] {
        computers.take(computer, name).stop().expect_code(0);
    }
    computers
        .take("server", "spandrel-router@main")
        .stop()
        .expect_code(0);
}

#[test]
fn workers_behind_two_routers_share_a_station_pages_and_postgresql() {
    let at = [
        ("desk", "10.0.0.2"),
        ("north", "10.0.0.5"),
        ("south", "10.0.0.6"),
        ("worker-1", "10.0.0.11"),
        ("worker-2", "10.0.0.12"),
        ("station", "10.0.0.20"),
        ("database", "10.0.0.21"),
        ("hall", "10.0.0.22"),
        ("sensors-2", "10.0.0.31"),
        ("sensors-1", "10.0.0.32"),
    ];
    let Some(postgresql) = packaged_postgresql() else {
        skip("no PostgreSQL server as Debian packages it (pg_createcluster)");
        return;
    };
    let Some(mut computers) = Computers::or_skip("three", &at) else {
        return;
    };
    computers.follow("desk");
    let tokens = computers.follow("desk");
    computers.follow("desk");
    computers.install_postgresql("database", &postgresql);
    for computer in [
        "database",
        "north",
        "south",
        "worker-1",
        "worker-2",
        "station",
        "hall",
        "sensors-2",
        "sensors-1",
    ] {
        computers.follow(computer);
    }
    for alert in [OF_DEMO, OF_DASHPOTS] {
        computers
            .process("station", "spandrel@alert")
            .wait_for_log(alert);
    }
    // The pages, each with its token, under the certificate of the site.
    let tokens: Vec<&str> = tokens.lines().filter(|line| !line.contains(' ')).collect();
    assert_eq!(tokens.len(), 2, "{tokens:?}");
    for (address, token) in ["10.0.0.20", "10.0.0.22"].iter().zip(tokens) {
        let ask = format!(
            "curl --silent --show-error --fail --cacert my-site/authority.pem \
             --header 'Authorization: Bearer {token}' https://{address}:8443/api/alerts"
        );
        let both = |said: &str| {
            ["demo", "dashpot-building"]
                .iter()
                .all(|name| said.contains(name))
        };
        until(
            &format!("both alerts on the page at {address}"),
            || computers.said("desk", &ask),
            both,
        );
    }
    // People, through the other router.
    computers.follow("desk");
    computers
        .process("desk", "watch")
        .wait_for_output("both", |said| {
            said.contains("demo") && said.contains("dashpot-building")
        });
    // The database: its contents, and the protection of its connections.
    let kept = "sudo -u postgres psql spandrel -Atc \"SELECT structure FROM happened WHERE kind = \
                'alert'\"";
    let both = |said: &str| {
        ["spandrel/demo", "spandrel/dashpot-building"]
            .iter()
            .all(|name| said.contains(name))
    };
    until(
        "both alerts in the database",
        || computers.said("database", kept),
        both,
    );
    computers.follow("database");
    assert!(computers.is_through());
    let connected = "sudo -u postgres psql -Atc \"SELECT DISTINCT version, client_dn FROM \
                     pg_stat_ssl JOIN pg_stat_activity USING (pid) WHERE usename = 'spandrel'\"";
    assert_eq!(
        computers.said("database", connected).trim(),
        "TLSv1.3|/CN=history.main"
    );
    let without =
        "! psql 'host=10.0.0.21 user=spandrel dbname=spandrel sslmode=require' -c 'SELECT 1' 2>&1";
    let refused = computers.said("station", without);
    assert!(refused.contains("certificate"), "{refused}");
    for (computer, services) in [
        ("desk", &["watch"][..]),
        ("worker-1", &["spandrel@ingest", "spandrel@identify"]),
        ("worker-2", &["spandrel@ingest", "spandrel@identify"]),
        (
            "station",
            &["spandrel@alert", "spandrel@history", "spandrel@dashboard"],
        ),
        ("hall", &["spandrel@dashboard"]),
        ("north", &["spandrel-router@north"]),
        ("south", &["spandrel-router@south"]),
    ] {
        services
            .iter()
            .for_each(|service| drop(computers.take(computer, service).stop().expect_code(0)));
    }
}
