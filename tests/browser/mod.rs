//! Tests of the page in a real browser.
//!
//! The damage of the demo is visible, the alert can be acknowledged, a lost connection is restored,
//! and the page fits a phone. The tests save screenshots in `target/screenshots`.

mod chromium;
mod compare;
mod conditions;
mod language;
mod lasting;
mod layout;
mod map;
mod mistakes;
mod overview;
mod report;
mod samples;
mod trouble;
mod waveforms;
mod workspace;

use crate::support::skip;
use chromium::Browser;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// A program that is killed when its test ends.
struct Program {
    child: Child,
    page: String,
}

impl Program {
    /// Starts a subcommand and reads the address of its page.
    fn start(arguments: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
        let mut child = command
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let line = lines
            .next()
            .expect("a line that says where the page is")
            .unwrap();
        // Reads the output to its end, so that the program never blocks on it.
        std::thread::spawn(move || lines.for_each(drop));
        let page = line
            .strip_prefix("page: ")
            .unwrap_or_else(|| panic!("no address of a page: {line}"))
            .to_owned();
        Self { child, page }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .to_string()
}

/// Starts the browser. Without Chromium it returns `None` with a message, or fails if all tests are
/// required.
async fn browser() -> Option<Browser> {
    let Some(program) = chromium::installed() else {
        skip("Chromium is not installed (apt-get install chromium)");
        return None;
    };
    let screenshots: PathBuf = Path::new(env!("CARGO_TARGET_TMPDIR")).join("../screenshots");
    Some(Browser::start(&program, screenshots).await)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_shows_the_damage_acknowledges_the_alert_and_reconnects() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let demo = Program::start(&[
        "demo",
        "--stay",
        "--speed",
        "10",
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ]);
    browser.resize(1280, 900).await;
    browser.prefer("light").await;

    the_damage_appears(&mut browser, &demo.page).await;
    the_structure_is_drawn_and_plotted(&mut browser).await;
    plots_are_read_and_zoomed_by_keyboard(&mut browser).await;
    what_is_seen_is_a_picture_to_take_away(&mut browser).await;
    a_phone_shows_it_without_scrolling_aside(&mut browser).await;
    the_alert_is_acknowledged_by_keyboard(&mut browser).await;
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
    a_lost_connection_heals(&mut browser, &endpoint).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_page_with_tokens_requires_one() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let tokens = folder.path().join("tokens.json");
    let mut token = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    let issued = token
        .args(["token", "grace", "--role", "operator", "--file"])
        .arg(&tokens)
        .output()
        .unwrap();
    let token = String::from_utf8(issued.stdout).unwrap().trim().to_owned();
    assert!(
        token.starts_with("spandrel-"),
        "{}",
        String::from_utf8_lossy(&issued.stderr)
    );
    let structure = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let configuration = folder.path().join("spandrel.toml");
    let text = format!(
        "structures = [{structure:?}]\n[bus]\nlisten = [\"tcp/{}\"]\n[dashboard]\n\
         listen = \"127.0.0.1:0\"\n\
         tokens = \"tokens.json\"\n[history]\ndatabase = \"none\"\n[state]\nfolder = \"none\"\n",
        free_address()
    );
    std::fs::write(&configuration, text).unwrap();
    let run = Program::start(&["run", "--config", configuration.to_str().unwrap()]);
    browser.open(&run.page).await;
    browser
        .wait(
            "a form for the token",
            "document.querySelector('#entrance #token') !== null",
        )
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('.structure-card').length")
            .await,
        0
    );
    browser.screenshot("entrance").await;
    let show = |token: &str| {
        format!(
            "document.querySelector('#token').value = {token:?}; \
             document.querySelector('#entrance').requestSubmit(); true"
        )
    };
    browser.evaluate(&show("spandrel-wrong")).await;
    let told = "document.querySelector('#entrance [role=alert]').textContent";
    browser
        .wait(
            "a word on the wrong token",
            &format!("{told}.includes('no valid token')"),
        )
        .await;
    browser.evaluate(&show(&token)).await;
    browser
        .wait(
            "the card of the demo",
            "document.querySelector('.structure-card[data-name=demo]') !== null",
        )
        .await;
    assert_eq!(
        browser.evaluate("document.cookie").await,
        "",
        "scripts cannot read the session"
    );
}

/// Regression test: the page did not show which node was silent, excluded or alive.
#[tokio::test(flavor = "multi_thread")]
async fn nodes_with_their_own_filters_are_in_a_table() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let demo = Program::start(&[
        "demo",
        "--distributed",
        "--stay",
        "--speed",
        "4", // the browser may start within 7 s, before the node falls silent
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ]);
    browser.resize(1280, 900).await;
    browser.prefer("light").await;
    browser
        .open(&format!(
            "{}#/structure/demo-distributed/sensors",
            demo.page
        ))
        .await;
    let cell = |node: &str, column: u64| {
        format!(
            "document.querySelector('table.nodes \
             tr[data-node={node}]')?.children[{column}].textContent ?? ''"
        )
    };
    // The samples of floor 8 are missing from 30 to 45 s. Those of floor 20 have a permanent
    // offset.
    browser
        .wait(
            "a node that is silent",
            &format!("({}).startsWith('○ silent since ')", cell("floor-8", 1)),
        )
        .await;
    browser
        .wait(
            "a node that is left out",
            &format!("({}).startsWith('◆ excluded')", cell("floor-20", 1)),
        )
        .await;
    browser
        .evaluate("document.querySelector('#group-nodes').scrollIntoView()")
        .await;
    browser.screenshot("nodes-light").await;
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('table.nodes tbody tr').length")
            .await,
        16
    );
    let heads = browser
        .evaluate("[...document.querySelectorAll('table.nodes th[scope=col]')].length")
        .await;
    assert_eq!(heads, 7);
    // Regression: the table was cut through a row, although the page below was empty.
    let cut = "(() => { const { scrollHeight, clientHeight } = \
               document.querySelector('.scroll:has(.nodes)'); return scrollHeight - \
               clientHeight; })()";
    assert_eq!(browser.evaluate(cut).await, 0, "the table is cut off");
    // A station publishes nothing that the tab of the model shows.
    let model = browser
        .evaluate("document.getElementById('tab-model')")
        .await;
    assert_eq!(model, Value::Null);
    // Names must not break at hyphens, and the lines of different nodes must look different.
    let in_one_line = "(name) => { const text = document.createRange(); \
                       text.selectNodeContents(name); return new \
                       Set([...text.getClientRects()].map((part) => part.top)).size === 1; }";
    let names =
        format!("[...document.querySelectorAll('table.nodes th[scope=row]')].every({in_one_line})");
    assert_eq!(
        browser.evaluate(&names).await,
        true,
        "a name takes more than a line"
    );
    let looks = "[...document.querySelectorAll('#plot-nodes .key-line')].map((key) => \
                 key.style.getPropertyValue('--key') + \
                 key.firstChild.getAttribute('stroke-dasharray'))";
    assert_eq!(
        browser.evaluate(&format!("new Set({looks}).size")).await,
        16
    );
    browser
        .wait(
            "it is heard again",
            &format!("({}).startsWith('● alive')", cell("floor-8", 1)),
        )
        .await;
    for (column, shape) in [
        (2, r"^[\d.]+ \([\d.]+\)$"),
        (
            3,
            r"^\d{4}-\d\d-\d\d .* UTC \(in \d+ % of recent fusions\)$",
        ),
        (4, r"^\d{4}-\d\d-\d\d .* UTC$"),
        (5, r"^[\d.]+ kB$"),
        (6, r"^[\d.]+ kB$"),
    ] {
        let matches = format!("/{shape}/.test({})", cell("floor-20", column));
        browser
            .wait(
                &format!("column {column} of a node that is left out"),
                &matches,
            )
            .await;
    }
    browser.prefer("dark").await;
    browser.screenshot("nodes-dark").await;
    browser.resize(390, 844).await;
    browser
        .evaluate("document.querySelector('#group-nodes').scrollIntoView()")
        .await;
    browser.screenshot("nodes-phone").await;
    // Regression: the time of an exclusion was printed over that of the last message.
    let covered = "[...document.querySelectorAll('table.nodes tbody tr')].filter((row) => { \
                   const [since, last] = [3, 4].map((column) => { \
                   const text = document.createRange(); \
                   text.selectNodeContents(row.children[column]); \
                   return text.getBoundingClientRect(); }); \
                   return Math.max(since.right, last.right) > innerWidth || \
                   (since.right > last.left && since.bottom > last.top); }).length";
    assert_eq!(browser.evaluate(covered).await, 0, "a time is covered");
    let width = browser
        .evaluate("document.documentElement.scrollWidth")
        .await;
    assert_eq!(width, 390, "the page is wider than the phone");
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}

/// Regression test: the plots and files of a record without dates showed dates in 1970.
#[tokio::test(flavor = "multi_thread")]
async fn a_record_without_dates_is_plotted_over_its_own_time() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        folder.path().join("demo.toml"),
        folder.path().join("demo.csv"),
    );
    std::fs::copy(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"),
        &structure,
    )
    .unwrap();
    let (structure, record) = (structure.to_str().unwrap(), record.to_str().unwrap());
    tool(&[
        "simulate",
        structure,
        "--record",
        record,
        "--duration",
        "120",
    ]);
    let (run, endpoint) = run_in(folder.path(), structure);
    tool(&[
        "replay",
        record,
        "--structure",
        structure,
        "--speed",
        "max",
        "--connect",
        &endpoint,
    ]);

    browser.resize(1280, 900).await;
    browser.open(&run.page).await;
    let age = "document.querySelector('.structure-card[data-name=demo] .fact-age dd').textContent";
    browser
        .wait(
            "the time of the record",
            &format!("/, measured 119\\.\\d\\d s$/.test({age})"),
        )
        .await;
    browser.evaluate("location.hash = '#/structure/demo'").await;
    let readout = "document.querySelector('#plot-worst .readout').textContent";
    browser
        .wait(
            "a reading at the end",
            &format!("/^119\\.\\d\\d s · 0\\.8/.test({readout})"),
        )
        .await;
    browser.screenshot("without-dates").await;
    let file = "(async () => (await (await \
                fetch('/api/structures/demo/history?series=parameter/storey-2&format=csv')).text()).split('\\n')[1])()";
    let row = browser.evaluate(file).await;
    assert!(row.as_str().unwrap().starts_with("0"), "{row}");
    // The axis is drawn on a canvas, so the test calls the function that formats its labels.
    let words = "(async () => { const { recordTime } = await import('/words.js'); return [0, \
                 59.9996, 90, 3725.25].map((time) => recordTime(time, time % 1 ? 2 : 0)); })()";
    assert_eq!(
        browser.evaluate(words).await,
        json!(["0:00:00", "0:01:00.00", "0:01:30", "1:02:05.25"])
    );
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}

/// Plots that require additional tables in the structure file.
#[tokio::test(flavor = "multi_thread")]
async fn model_classes_and_rejected_samples_are_plotted() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        folder.path().join("demo.toml"),
        folder.path().join("demo.csv"),
    );
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let text = std::fs::read_to_string(demo)
        .unwrap()
        .replace("seed = 1\n", "seed = 1\nspike-share = 0.01\n");
    let tables = "[outliers]\n[classes]\nkind = \"predefined\"\n\
                  [[classes.class]]\nname = \"lower-two\"\n\
                  groups = [[\"storey-1\"], [\"storey-2\"]]\n\
                  [[classes.class]]\nname = \"upper-two\"\n\
                  groups = [[\"storey-4\"], [\"storey-5\"]]\n[[alert]]";
    assert!(
        text.contains("spike-share") && text.contains("[[alert]]"),
        "the example has changed"
    );
    std::fs::write(&structure, text.replacen("[[alert]]", tables, 1)).unwrap();
    let (structure, record) = (structure.to_str().unwrap(), record.to_str().unwrap());
    tool(&[
        "simulate",
        structure,
        "--record",
        record,
        "--duration",
        "120",
    ]);
    let (run, endpoint) = run_in(folder.path(), structure);
    tool(&[
        "replay",
        record,
        "--structure",
        structure,
        "--speed",
        "max",
        "--connect",
        &endpoint,
    ]);

    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo/model", run.page))
        .await;
    // A plot is filled only while it is visible.
    let shown = |group: &str| {
        format!(
            "!document.querySelector('#group-{group}').hidden && \
             (document.querySelector('#group-{group}').scrollIntoView(), true)"
        )
    };
    browser.wait("classes", &shown("classes")).await;
    // Only storey 2 is damaged. A class that groups the three lower storeys explains this less
    // well.
    let readout = "document.querySelector('#plot-classes .readout').textContent";
    browser
        .wait(
            "the plausibilities",
            &format!("/lower-two (9\\d|100) % · upper-two .*\\d %$/.test({readout})"),
        )
        .await;
    browser.screenshot("classes").await;
    browser
        .evaluate("location.hash = '#/structure/demo/sensors'")
        .await;
    browser.wait("outliers", &shown("outliers")).await;
    let rejected = "document.querySelector('#group-outliers .readout').textContent";
    let shape = r"/^.* · [\d.]+ % of the recent samples · \d+ rejected here$/";
    browser
        .wait("what was rejected", &format!("{shape}.test({rejected})"))
        .await;
    browser.screenshot("outliers").await;
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}

/// Runs a subcommand to its end.
fn tool(arguments: &[&str]) {
    let ended = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(arguments)
        .output()
        .unwrap();
    assert!(
        ended.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&ended.stderr)
    );
}

/// Runs the services of a structure with their page and without persistent state. Returns the
/// program and its endpoint.
fn run_in(folder: &Path, structure: &str) -> (Program, String) {
    let configuration = folder.join("spandrel.toml");
    std::fs::write(
        &configuration,
        "[history]\ndatabase = \"none\"\n[state]\nfolder = \"none\"\n",
    )
    .unwrap();
    let (configuration, endpoint) = (
        configuration.to_str().unwrap(),
        format!("tcp/{}", free_address()),
    );
    let run = [
        "run",
        structure,
        "--config",
        configuration,
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ];
    (Program::start(&run), endpoint)
}

/// Tests the TypeScript example without its types.
#[tokio::test(flavor = "multi_thread")]
async fn the_subscriber_of_the_docs_receives_parameters() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let demo = Program::start(&[
        "demo",
        "--speed",
        "1",
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/dashboard.md");
    let docs = std::fs::read_to_string(docs).unwrap();
    let typed = docs
        .split_once("```ts\n")
        .and_then(|(_, rest)| rest.split_once("```"))
        .expect("a subscriber")
        .0;
    let lines: Vec<&str> = typed
        .lines()
        .filter(|line| !line.starts_with("type "))
        .collect();
    let plain = lines
        .join("\n")
        .replace(" as Partial<News>", "")
        .replace(")!", ")");
    let script = plain
        .replace("ws://127.0.0.1:8080/", "ws://${location.host}/")
        .replace("\"ws:", "`ws:");
    let script = script.replace("structure=demo\"", "structure=demo`");
    assert!(
        script.contains("`ws://${location.host}/api/live?structure=demo`"),
        "{script}"
    );
    browser
        .evaluate(&format!(
            "{{ globalThis.told = []; const console = {{ log: (...words) => \
                            told.push(words.join(' ')) }};\n{script}\n}} true"
        ))
        .await;
    let shape = r"/^parameter\/storey-2 20\d\d-\d\d-\d\dT[\d:.]+Z [\d.]+ ± [\d.]+$/";
    browser
        .wait(
            "what the docs show",
            &format!("told.some((line) => {shape}.test(line))"),
        )
        .await;
}

async fn the_damage_appears(browser: &mut Browser, page: &str) {
    browser.open(page).await;
    let card = "document.querySelector('.structure-card[data-name=demo]')";
    browser
        .wait(
            "an alarm of the demo",
            &format!("{card}.dataset.level === 'alarm'"),
        )
        .await;
    let sentence = browser
        .evaluate(&format!("{card}.querySelector('.sentence').textContent"))
        .await;
    assert!(
        sentence.as_str().unwrap().starts_with("storey-2 has lost "),
        "{sentence}"
    );
    let worst = browser
        .evaluate(&format!(
            "{card}.querySelector('.fact-worst dd').textContent"
        ))
        .await;
    assert!(
        worst.as_str().unwrap().starts_with("storey-2: 0."),
        "{worst}"
    );
    assert_eq!(browser.evaluate("document.title").await, "▲ 1 – Spandrel");
    browser.screenshot("overview-light").await;
    browser.prefer("dark").await;
    browser.screenshot("overview-dark").await;
    browser.prefer("light").await;
}

async fn the_structure_is_drawn_and_plotted(browser: &mut Browser) {
    browser
        .evaluate("document.querySelector('.structure-card a').click()")
        .await;
    browser
        .wait(
            "storey 2 in the colour of a certain loss",
            "document.querySelector('.drawing [data-part=storey-2]').dataset.step === '3'",
        )
        .await;
    let sound = browser
        .evaluate("document.querySelectorAll('.drawing .part[data-step=\"0\"]').length")
        .await;
    assert_eq!(sound, 4, "the other storeys are sound");
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('.drawing .sensor').length")
            .await,
        6
    );
    browser
        .wait(
            "the plot of storey 2",
            "document.querySelector('#plot-worst canvas').width > 100",
        )
        .await;
    let readout = "document.querySelector('#plot-worst .readout').textContent";
    browser
        .wait(
            "its reading",
            &format!("/ UTC .*95 %: 0\\.8/.test({readout})"),
        )
        .await;
    browser.screenshot("structure-light").await;
    browser.prefer("dark").await;
    browser
        .wait(
            "the plot in other colours",
            "document.querySelector('#plot-worst canvas')",
        )
        .await;
    browser.screenshot("structure-dark").await;
    browser.prefer("light").await;
    // Innovations and noise levels have plots in another tab.
    browser
        .evaluate(
            "document.getElementById('tab-model').click(), \
                   document.querySelector('#group-innovations').scrollIntoView()",
        )
        .await;
    browser
        .wait(
            "innovations",
            "document.querySelectorAll('#group-innovations canvas').length > 0",
        )
        .await;
    browser
        .wait(
            "the plots below",
            "document.querySelector('#plot-noise-floors')",
        )
        .await;
    browser.screenshot("structure-plots").await;
    // The page fetches another span and keeps it.
    browser
        .evaluate(
            "[...document.querySelectorAll('.ranges button')].find((b) => b.textContent === \
                   '1 min').click()",
        )
        .await;
    browser
        .wait(
            "one minute",
            "document.querySelector('.ranges [aria-pressed=true]').textContent === '1 min'",
        )
        .await;
    browser
        .evaluate("document.getElementById('tab-parameters').click()")
        .await;
    browser
        .wait(
            "the plot of storey 2",
            "document.querySelector('#plot-parameter-storey-2 canvas')",
        )
        .await;
    let csv = "(async () => { const a = document.querySelector('#plot-parameter-storey-2 .files \
               a'); a.addEventListener('click', (e) => e.preventDefault()); a.click(); return \
               (await (await fetch(a.href)).text()).split('\\n'); })()";
    let lines = browser.evaluate(csv).await;
    assert!(
        lines[0]
            .as_str()
            .unwrap()
            .starts_with("time,parameter/storey-2.mean,"),
        "{}",
        lines[0]
    );
    assert!(
        lines.as_array().unwrap().len() > 100,
        "the points that are shown: {}",
        lines.as_array().unwrap().len()
    );
}

/// Checks the shared crosshair of all plots, and the keys that move it and the span.
async fn plots_are_read_and_zoomed_by_keyboard(browser: &mut Browser) {
    let readout = |plot: &str| {
        format!("document.querySelector('#plot-{plot} .readout').textContent.slice(0, 8)")
    };
    let (first, second) = (readout("parameter-storey-1"), readout("parameter-storey-2"));
    browser
        .evaluate("document.querySelector('#plot-parameter-storey-1').scrollIntoView()")
        .await;
    browser
        .wait(
            "both plots",
            "document.querySelector('#plot-parameter-storey-2 canvas')",
        )
        .await;
    browser
        .evaluate("document.querySelector('#plot-parameter-storey-1 .plot-holder').focus()")
        .await;
    // New data would move the span under the crosshair.
    browser
        .wait(
            "the end of the demo",
            "document.body.innerText.includes('record has ended')",
        )
        .await;
    browser.press("Home").await;
    browser.press("ArrowLeft").await;
    let newest = browser.evaluate(&first).await;
    for _ in 0..60 {
        browser.press("ArrowLeft").await;
    }
    browser
        .wait(
            "an earlier moment",
            &format!("{first} < '{}'", newest.as_str().unwrap()),
        )
        .await;
    // Refetched data with half as many rows has another number for the row under the crosshair.
    let refetched = "(async () => { \
        const read = () => document.querySelector('#plot-parameter-storey-1 \
        .readout').textContent.slice(0, 8); const before = read(); \
        const original = window.fetch; \
        const halved = new Promise((resolve) => { \
            window.fetch = async (address, options) => { \
                const response = await original(address, options); \
                if (!String(address).includes('parameter%2Fstorey-1')) return response; \
                const answer = await response.json(); \
                for (const one of answer.series) one.data = one.data.map((column) => \
                column.filter((_, row) => (column.length - row) % 2 === 1)); setTimeout(resolve, \
                100); return { ok: true, json: async () => answer }; \
            }; \
        }); \
        document.querySelector('#plot-parameter-storey-1 .plot-holder').dispatchEvent(new \
        KeyboardEvent('keydown', { key: 'Home' })); await halved; \
        window.fetch = original; \
        return [before, read()]; })()";
    let clock = |reading: &Value| {
        let text = reading.as_str().unwrap();
        text.split(':')
            .fold(0, |sum, part| 60 * sum + part.parse::<i64>().unwrap())
    };
    let readings = browser.evaluate(refetched).await;
    assert!(
        (clock(&readings[0]) - clock(&readings[1])).abs() <= 2,
        "the crosshair reads another moment after new data: {readings}"
    );
    // A busy machine drops display values, so that the nearest ones can be in different seconds.
    // The crosshair has moved by sixty values, which are six seconds.
    let time = |clock: &str| format!("Date.parse('1970-01-01T' + {clock})");
    let apart_ms = format!("Math.abs({} - {})", time(&first), time(&second));
    browser
        .wait(
            "the same moment in the other plot",
            &format!("{apart_ms} <= 2000"),
        )
        .await;

    browser.press("+").await;
    browser
        .wait(
            "a span that stays",
            "!document.querySelector('.ranges-bar .back').hidden",
        )
        .await;
    let text = "document.querySelector('.range-text').textContent";
    let zoomed = browser.evaluate(text).await;
    browser.press("-").await;
    browser
        .wait("a longer span", &format!("{text} !== {zoomed}"))
        .await;
    browser.press("Home").await;
    browser
        .wait(
            "the newest data",
            &format!("{text}.startsWith('newest data')"),
        )
        .await;
}

async fn what_is_seen_is_a_picture_to_take_away(browser: &mut Browser) {
    // Intercepts the file that the button saves.
    let picture = "(async () => { \
        const original = URL.createObjectURL; \
        let name = null; \
        HTMLAnchorElement.prototype.click = function () { name = this.download; }; \
        const bytes = await new Promise((resolve) => { \
            URL.createObjectURL = (blob) => { resolve(blob.arrayBuffer()); return original(blob); \
            }; document.querySelector('#plot-parameter-storey-2 .files button').dispatchEvent(new \
            MouseEvent('click')); }); \
        URL.createObjectURL = original; \
        delete HTMLAnchorElement.prototype.click; \
        return { name, head: [...new Uint8Array(bytes).slice(0, 4)], length: bytes.byteLength }; \
        })()";
    let file = browser.evaluate(picture).await;
    assert_eq!(file["name"], "demo-parameter-storey-2.png");
    assert_eq!(file["head"], json!([0x89, 0x50, 0x4e, 0x47]));
    assert!(file["length"].as_u64().unwrap() > 2_000, "{file}");
}

async fn a_phone_shows_it_without_scrolling_aside(browser: &mut Browser) {
    browser.resize(390, 844).await;
    for (address, name) in [
        ("#/", "phone-overview"),
        ("#/structure/demo", "phone-structure"),
        ("#/alerts", "phone-alerts"),
    ] {
        browser
            .evaluate(&format!("location.hash = '{address}'"))
            .await;
        browser
            .wait(
                "its content",
                "document.querySelector('main .card, main .attention .sentence')",
            )
            .await;
        browser.screenshot(name).await;
        let width = browser
            .evaluate("document.documentElement.scrollWidth")
            .await;
        assert_eq!(width, 390, "{address} is wider than the phone");
    }
    // Regression: the bars were out of line, because their numbers differ in length.
    browser.evaluate("location.hash = '#/structure/demo'").await;
    browser
        .wait(
            "the table of the parts",
            "document.querySelector('#panel-now .parameters .meter')",
        )
        .await;
    let places = "(() => { const bars = [...document.querySelectorAll('.parameters .meter')]; \
                  bars.forEach((bar, row) => { bar.hidden = false; \
                  bar.nextSibling.textContent = row === 0 ? '> 99.9 %' : '2.0 %'; }); \
                  return new Set(bars.map((bar) => bar.getBoundingClientRect().left)).size; })()";
    assert_eq!(browser.evaluate(places).await, 1, "bars out of line");
    browser.resize(1280, 900).await;
}

async fn the_alert_is_acknowledged_by_keyboard(browser: &mut Browser) {
    browser.evaluate("location.hash = '#/alerts'").await;
    browser
        .wait(
            "the alert",
            "document.querySelector('.alert[data-state=raised] .acknowledge')",
        )
        .await;
    browser.screenshot("alerts-light").await;
    // Regression: the change to raised looked like a second alarm.
    browser
        .wait(
            "a past change that does not look like an alarm",
            "(() => { const [now, past] = ['.alerts:not(.past)', '.past'].map((list) => \
             document.querySelector(`${list} > .alert[data-level=alarm]`)); return now && past && \
             getComputedStyle(now).backgroundColor !== getComputedStyle(past).backgroundColor; \
             })()",
        )
        .await;
    browser
        .evaluate("document.querySelector('.alert[data-state=raised] .acknowledge').focus()")
        .await;
    browser.press("Enter").await;
    browser
        .wait(
            "the dialog",
            "document.querySelector('dialog').open && document.activeElement.id === 'who'",
        )
        .await;
    browser.write("Ada <b>Lovelace</b>").await;
    browser.press("Tab").await;
    browser.write("on my way").await;
    browser.screenshot("acknowledge").await;
    browser.press("Tab").await;
    browser.press("Enter").await;
    browser
        .wait(
            "the answer of the alert service",
            "document.querySelector('.alerts:not(.past) .alert[data-state=acknowledged]')",
        )
        .await;
    let seen = browser
        .evaluate(
            "document.querySelector('.alerts:not(.past) .alert[data-state=acknowledged] \
                   .seen').textContent",
        )
        .await;
    // Regression: it had the time of the data. The sentence has the name and the note.
    let seen = seen.as_str().unwrap();
    assert!(
        seen.starts_with("Acknowledged 20") && seen.ends_with(" UTC"),
        "{seen}"
    );
    let sentence = "document.querySelector('.alerts:not(.past) .alert[data-state=acknowledged] \
                    .sentence').textContent";
    let sentence = browser.evaluate(sentence).await;
    let names = "acknowledged by Ada <b>Lovelace</b>: on my way";
    assert!(
        sentence.as_str().unwrap().contains(names),
        "names are text, not markup: {sentence}"
    );
    browser
        .wait(
            "the closed dialog",
            "!document.querySelector('dialog').open",
        )
        .await;
    browser
        .wait(
            "no alert is counted any more",
            "document.getElementById('alert-count').hidden",
        )
        .await;
    browser.screenshot("alerts-acknowledged").await;
    // The link leads to the time of the alert.
    browser
        .evaluate("document.querySelector('.alert[data-state=acknowledged] .actions a').click()")
        .await;
    browser
        .wait(
            "the moment",
            "!document.querySelector('.ranges-bar .back').hidden && \
             document.querySelector('.plot.is-chosen canvas')",
        )
        .await;
    browser.screenshot("moment").await;
}

async fn a_lost_connection_heals(browser: &mut Browser, endpoint: &str) {
    let structure = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let http = free_address();
    let arguments = [
        "dashboard",
        structure.to_str().unwrap(),
        "--connect",
        endpoint,
        "--http",
        &http,
    ];
    let first = Program::start(&arguments);
    browser.open(&first.page).await;
    browser
        .wait(
            "a page that is connected",
            "document.getElementById('link').dataset.state === 'open'",
        )
        .await;
    browser
        .wait(
            "the alert, asked for from the alert service",
            "document.querySelector('.structure-card')",
        )
        .await;
    drop(first);
    browser
        .wait(
            "the word that it is lost",
            "!document.getElementById('lost').hidden",
        )
        .await;
    let told = browser
        .evaluate("document.getElementById('lost').textContent")
        .await;
    assert!(
        told.as_str().unwrap().contains("No connection to Spandrel"),
        "{told}"
    );
    browser.screenshot("lost").await;
    let _second = Program::start(&arguments);
    browser
        .wait(
            "a page that is connected again",
            "document.getElementById('lost').hidden && \
             document.getElementById('link').dataset.state === 'open'",
        )
        .await;
    browser
        .wait(
            "its content",
            "document.querySelector('.structure-card[data-name=demo]')",
        )
        .await;
    browser.screenshot("healed").await;
}

/// Resource use of the page at one moment.
#[derive(Debug, Clone, Copy)]
struct Cost {
    /// Memory of the scripts after garbage collection (MB).
    heap_mb: f64,
    /// Number of elements of the document.
    nodes: f64,
    /// Processor time of the main thread since the start (s).
    worked_s: f64,
}

async fn cost(browser: &mut Browser) -> Cost {
    browser
        .call("HeapProfiler.collectGarbage", serde_json::json!({}))
        .await;
    let metrics = browser
        .call("Performance.getMetrics", serde_json::json!({}))
        .await;
    let metric = |name: &str| {
        let metrics = metrics["metrics"].as_array().unwrap();
        metrics
            .iter()
            .find(|metric| metric["name"] == name)
            .unwrap()["value"]
            .as_f64()
            .unwrap()
    };
    Cost {
        heap_mb: metric("JSHeapUsedSize") / 1e6,
        nodes: metric("Nodes"),
        worked_s: metric("ThreadTime"),
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes 20 minutes"]
async fn the_page_needs_no_more_resources_after_twenty_minutes_at_24_times_the_display_rate() {
    const MINUTES: usize = 20;
    // Until this minute, the span of ten minutes and its plots fill up.
    const SETTLED: usize = 4;
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let arguments = [
        "demo",
        "--speed",
        "24",
        "--duration",
        "32000",
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ];
    let demo = Program::start(&arguments);
    browser.resize(1280, 900).await;
    browser
        .call("Performance.enable", serde_json::json!({}))
        .await;
    browser
        .open(&format!("{}#/structure/demo/parameters", demo.page))
        .await;
    browser
        .wait(
            "the first plot",
            "document.querySelector('#plot-parameter-storey-1 canvas')",
        )
        .await;
    browser
        .evaluate("document.querySelector('.ranges').scrollIntoView()")
        .await;
    let mut costs = vec![cost(&mut browser).await];
    for minute in 1..=MINUTES {
        // This test measures time, so it must sleep.
        tokio::time::sleep(std::time::Duration::from_secs(60)).await;
        costs.push(cost(&mut browser).await);
        let (before, now) = (costs[minute - 1], costs[minute]);
        let share = 100.0 * (now.worked_s - before.worked_s) / 60.0;
        eprintln!(
            "{minute:2} min  heap {:6.2} MB  nodes {:5.0}  main thread {share:4.1} %",
            now.heap_mb, now.nodes
        );
    }
    let mean = |range: std::ops::Range<usize>, of: fn(&Cost) -> f64| {
        costs[range.clone()].iter().map(of).sum::<f64>() / range.len() as f64
    };
    let (early, late) = (SETTLED..SETTLED + 4, MINUTES - 3..MINUTES + 1);
    let [heap_early, heap_late] =
        [early.clone(), late.clone()].map(|range| mean(range, |cost| cost.heap_mb));
    // A leak of one point per series and message would be about 100 MB.
    assert!(
        heap_late < heap_early + 3.0,
        "heap from {heap_early:.1} to {heap_late:.1} MB"
    );
    let nodes = (costs[SETTLED].nodes, costs[MINUTES].nodes);
    assert!(
        nodes.1 < 1.2 * nodes.0,
        "elements from {} to {}",
        nodes.0,
        nodes.1
    );
    let worked =
        |range: std::ops::Range<usize>| costs[range.end - 1].worked_s - costs[range.start].worked_s;
    let (work_early, work_late) = (worked(early), worked(late));
    assert!(
        work_late < 1.5 * work_early,
        "work of the main thread from {work_early:.1} to {work_late:.1} s in 3 minutes"
    );
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}
