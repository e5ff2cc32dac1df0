//! The files of deploy/prometheus and deploy/grafana: Prometheus accepts configuration and rules,
//! and each query of the dashboard finds values of running systems. The test does not run Grafana.

use crate::support::{DEADLINE, Process, skip, spandrel};
use serde_json::Value;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Interval between queries to Prometheus, which scrapes every 5 s.
const ASK_EVERY: Duration = Duration::from_millis(500);
/// Target of the page in deploy/prometheus/prometheus.yml.
const TARGET: &str = r#"["127.0.0.1:8080"]"#;

fn deploy(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../deploy")
        .join(file)
}

/// Returns `true` if Prometheus is installed. Fails if all tests are required.
fn is_installed() -> bool {
    let folders = std::env::var_os("PATH").unwrap_or_default();
    let is_there = |program: &str| {
        std::env::split_paths(&folders).any(|folder| folder.join(program).is_file())
    };
    let missing = ["promtool", "prometheus"]
        .into_iter()
        .find(|program| !is_there(program));
    if let Some(missing) = missing {
        skip(&format!(
            "{missing} is not installed (apt-get install prometheus)"
        ));
    }
    missing.is_none()
}

#[test]
fn promtool_accepts_configuration_and_rules() {
    if !is_installed() {
        return;
    }
    for (check, file) in [
        ("config", "prometheus/prometheus.yml"),
        ("rules", "prometheus/rules.yml"),
    ] {
        let checked = Command::new("promtool")
            .args(["check", check])
            .arg(deploy(file))
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&checked.stdout).into_owned()
            + &String::from_utf8_lossy(&checked.stderr);
        assert!(checked.status.success(), "{file}:\n{told}");
    }
}

/// Course of a count over ten minutes, by reason and service, and the rule that must fire by then.
const DISKS: [(&str, &str, &str, &str); 6] = [
    (
        "frames-waiting-for-the-disk",
        "ingest",
        "0x4 500+10x16",
        "SpandrelRecordingWaits",
    ),
    (
        "frames-not-recorded",
        "ingest",
        "_x4 40+10x16",
        "SpandrelFramesNotRecorded",
    ),
    (
        "failed-writes",
        "history",
        "_x4 1+2x16",
        "SpandrelHistoryNotWritten",
    ),
    (
        "checkpoints-not-kept",
        "alert",
        "_x4 1+6x16",
        "SpandrelCheckpointsNotKept",
    ),
    // Long past: the rule must not keep firing.
    ("checkpoints-not-kept", "identify", "7x20", ""),
    ("failed-writes", "notify", "3x20", ""),
];

#[test]
fn the_disk_rules_fire_only_while_data_are_not_stored() {
    if !is_installed() {
        return;
    }
    // promtool also compares the texts for people, which are therefore removed.
    let rules = std::fs::read_to_string(deploy("prometheus/rules.yml")).unwrap();
    let is_word = |line: &&str| {
        ["annotations:", "summary:"]
            .iter()
            .any(|word| line.trim().starts_with(word))
    };
    let rules: Vec<&str> = rules.lines().filter(|line| !is_word(line)).collect();
    let mut text = "rule_files: [rules.yml]\nevaluation_interval: 30s\ntests:\n".to_owned();
    for (reason, service, values, fires) in DISKS {
        let labels =
            format!("structure=\"tower\", service=\"{service}\", id=\"one\", reason=\"{reason}\"");
        text += &format!(
            "  - interval: 30s\n    input_series:\n      - series: \
             'spandrel_dropped_total{{{labels}}}'\n"
        );
        text += &format!("        values: '{values}'\n    alert_rule_test:\n");
        for (_, _, _, rule) in DISKS.iter().filter(|(_, _, _, rule)| !rule.is_empty()) {
            text += &format!(
                "      - eval_time: 10m\n        alertname: {rule}\n        exp_alerts: ["
            );
            if *rule == fires {
                let severity = if fires == "SpandrelFramesNotRecorded" {
                    "critical"
                } else {
                    "warning"
                };
                text += &format!(
                    "{{ exp_labels: {{ structure: tower, service: {service}, id: one, reason: \
                     {reason}, severity: {severity} }} }}"
                );
            }
            text += "]\n";
        }
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rules.yml"), rules.join("\n")).unwrap();
    let file = folder.path().join("test.yml");
    std::fs::write(&file, &text).unwrap();
    let tested = Command::new("promtool")
        .args(["test", "rules"])
        .arg(&file)
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&tested.stdout).into_owned()
        + &String::from_utf8_lossy(&tested.stderr);
    assert!(tested.status.success(), "{told}\n{text}");
}

/// A Prometheus process that ends with its test.
struct Prometheus {
    child: Child,
    address: String,
    _folder: tempfile::TempDir,
}

impl Drop for Prometheus {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Prometheus {
    /// Starts Prometheus with the configuration and rules of deploy/ and these pages as targets.
    fn start(pages: &[String]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let text = std::fs::read_to_string(deploy("prometheus/prometheus.yml")).unwrap();
        assert!(
            text.contains(TARGET),
            "the configuration does not ask {TARGET}"
        );
        let configuration = folder.path().join("prometheus.yml");
        std::fs::write(&configuration, text.replace(TARGET, &format!("{pages:?}"))).unwrap();
        std::fs::copy(
            deploy("prometheus/rules.yml"),
            folder.path().join("rules.yml"),
        )
        .unwrap();
        let address = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap()
            .to_string();
        let mut command = Command::new("prometheus");
        command.arg(format!("--config.file={}", configuration.display()));
        command.arg(format!(
            "--storage.tsdb.path={}",
            folder.path().join("data").display()
        ));
        command.arg(format!("--web.listen-address={address}"));
        let child = command
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        Self {
            child,
            address,
            _folder: folder,
        }
    }

    /// Returns the reply to a request, or `None` without a connection.
    fn ask(&self, path: &str, name: &str, expression: &str) -> Option<Value> {
        let mut stream = TcpStream::connect(&self.address).ok()?;
        // HTTP version 1.0, so that the reply arrives in one piece.
        write!(
            stream,
            "GET /api/v1/{path}?{name}={} HTTP/1.0\r\n\r\n",
            encoded(expression)
        )
        .ok()?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer).ok()?;
        let (head, body) = answer.split_once("\r\n\r\n")?;
        if head.starts_with("HTTP/1.0 503") {
            return None; // still starting
        }
        let mut body: Value =
            serde_json::from_str(body).unwrap_or_else(|error| panic!("{path}: {error}\n{answer}"));
        assert_eq!(body["status"], "success", "{path} {expression}: {body}");
        Some(body["data"].take())
    }

    /// Waits until a reply is as required.
    fn wait(
        &self,
        path: &str,
        name: &str,
        expression: &str,
        is_right: impl Fn(&Value) -> bool,
    ) -> Value {
        let start = now();
        let mut last = None;
        while start.elapsed() < DEADLINE {
            last = self.ask(path, name, expression);
            if let Some(answer) = last.take_if(|answer| is_right(answer)) {
                return answer;
            }
            std::thread::sleep(ASK_EVERY);
        }
        panic!(
            "waited {} s in vain: {path} {expression}\n  last answer: {last:?}",
            DEADLINE.as_secs()
        );
    }
}

/// Returns the number of values in a reply.
fn count(answer: &Value) -> usize {
    answer["result"].as_array().map_or(0, Vec::len)
}

fn now() -> Instant {
    #[expect(clippy::disallowed_methods, reason = "a deadline that ends a hang")]
    let now = Instant::now();
    now
}

fn encoded(text: &str) -> String {
    text.bytes().map(|byte| format!("%{byte:02X}")).collect()
}

/// Starts a demo that keeps running, and returns the address of its page.
fn demo(more: &[&str]) -> (Process, String) {
    let mut command = spandrel("demo");
    command
        .args([
            "--stay",
            "--http",
            "127.0.0.1:0",
            "--listen",
            "tcp/127.0.0.1:0",
        ])
        .args(more);
    let process = Process::start(&mut command);
    let page = page_of(&process);
    (process, page)
}

fn page_of(process: &Process) -> String {
    process.wait_for_output("the address of a page", |said| {
        said.contains("page: http://") && said.contains('\n')
    });
    let output = process.output();
    let address = output
        .lines()
        .find_map(|line| line.strip_prefix("page: http://"))
        .unwrap();
    address.trim_end_matches('/').to_owned()
}

/// Returns all queries of the dashboard with the titles of their panels.
fn queries(dashboard: &Value) -> Vec<(String, String)> {
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels.iter().flat_map(|panel| {
        let title = panel["title"].as_str().unwrap();
        panel["targets"]
            .as_array()
            .into_iter()
            .flatten()
            .map(move |target| (title.to_owned(), target))
    });
    targets
        .map(|(title, target)| (title, target["expr"].as_str().unwrap().to_owned()))
        .collect()
}

fn dashboard() -> Value {
    serde_json::from_str(
        &std::fs::read_to_string(deploy("grafana/dashboards/spandrel.json")).unwrap(),
    )
    .unwrap()
}

#[test]
fn every_panel_of_the_dashboard_uses_the_provisioned_source_and_none_overlap() {
    let source =
        std::fs::read_to_string(deploy("grafana/provisioning/datasources/prometheus.yml")).unwrap();
    let dashboard = dashboard();
    let mut taken = std::collections::BTreeMap::new();
    for panel in dashboard["panels"].as_array().unwrap() {
        let title = panel["title"].as_str().unwrap();
        if panel["type"] != "row" {
            let uid = panel["datasource"]["uid"].as_str().unwrap();
            assert!(
                source.contains(&format!("uid: {uid}\n")),
                "{title}: source {uid} is not provisioned"
            );
        }
        let place = |key: &str| panel["gridPos"][key].as_u64().unwrap();
        assert!(
            place("x") + place("w") <= 24,
            "{title} is wider than the page"
        );
        for x in place("x")..place("x") + place("w") {
            for y in place("y")..place("y") + place("h") {
                let other = taken.insert((x, y), title);
                assert_eq!(other, None, "{title} lies on another panel at {x}, {y}");
            }
        }
    }
    assert!(queries(&dashboard).len() >= 15, "{:?}", queries(&dashboard));
}

#[test]
fn each_query_of_the_dashboard_finds_values_and_the_rules_are_active() {
    if !is_installed() {
        return;
    }
    let (_whole, whole) = demo(&["--speed", "10"]);
    let (_distributed, distributed) = demo(&["--distributed", "--speed", "10"]);
    let classes = crate::support::Site::of(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/bouc-wen-five.toml"),
    );
    let mut run = classes.listening("run");
    let run = Process::start(run.args(["--http", "127.0.0.1:0"]));
    let page = page_of(&run);
    let mut simulate = spandrel("simulate");
    simulate.arg(classes.structure_file()).args([
        "--root",
        classes.keys().root().as_str(),
        "--connect",
        classes.endpoint(),
    ]);
    // Live samples, because no lag is published for others.
    let _simulation = Process::start(simulate.args(["--duration", "600", "--live"]));
    let prometheus = Prometheus::start(&[whole, distributed, page]);

    let names = ["demo", "demo-distributed", classes.structure().name()];
    for variable in dashboard()["templating"]["list"].as_array().unwrap() {
        let query = variable["query"]["query"].as_str().unwrap();
        let (series, label) = query
            .strip_prefix("label_values(")
            .unwrap()
            .strip_suffix(')')
            .unwrap()
            .rsplit_once(", ")
            .unwrap();
        let series = series.replace("$structure", "demo");
        let found = prometheus.wait(
            &format!("label/{label}/values"),
            "match[]",
            &series,
            |found| {
                found
                    .as_array()
                    .is_some_and(|found| found.len() >= names.len())
            },
        );
        let expected = if label == "structure" {
            "demo-distributed"
        } else {
            "storey-2"
        };
        assert!(
            found.as_array().unwrap().iter().any(|one| one == expected),
            "{query}: {found}"
        );
    }
    for (title, query) in queries(&dashboard()) {
        // Structures differ in their features: nodes that identify their own parameters, model
        // classes.
        let any = query.replace("=\"$structure\"", &format!("=~\"{}\"", names.join("|")));
        let any = any.replace("=\"$parameter\"", "=~\".+\"");
        assert!(!any.contains('$'), "{title}: {query}");
        // A panel is empty if nothing was dropped.
        let may_be_empty = any.contains("spandrel_dropped_total");
        let found = prometheus.wait("query", "query", &any, |answer| {
            may_be_empty || count(answer) > 0
        });
        let found = count(&found);
        println!("{found:3} values: {title}: {query}");
    }
    let rules = prometheus.wait("rules", "type", "alert", |rules| {
        let rules = rules["groups"][0]["rules"].as_array();
        rules.is_some_and(|rules| {
            !rules.is_empty() && rules.iter().all(|rule| rule["health"] == "ok")
        })
    });
    let rules: Vec<&str> = rules["groups"][0]["rules"]
        .as_array()
        .unwrap()
        .iter()
        .map(|rule| rule["name"].as_str().unwrap())
        .collect();
    let expected = [
        "SpandrelDown",
        "SpandrelNothingMeasured",
        "SpandrelBlind",
        "SpandrelDegraded",
        "SpandrelServiceGone",
        "SpandrelBehind",
        "SpandrelRecordingWaits",
        "SpandrelFramesNotRecorded",
        "SpandrelHistoryNotWritten",
        "SpandrelCheckpointsNotKept",
    ];
    assert_eq!(rules, expected);
}
