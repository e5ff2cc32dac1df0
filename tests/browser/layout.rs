//! Tests of the layout of the page: labels of marks, names in the drawing, and columns of a table.
//! Another test checks that the page shows its connection immediately.

use super::{browser, demo, example, run_in};
use serde_json::{Value, json};
use std::process::{Command, Stdio};

/// Regression test: a red "connecting …" was shown for a second although data had just arrived.
#[tokio::test(flavor = "multi_thread")]
async fn the_page_shows_that_it_is_connected_from_the_first_message_on() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let told = "(async () => {
        const { Connection } = await import('/connection.js');
        const connection = new Connection();
        let told = null;
        connection.on('state', () => (told = connection.isOpen));
        return await new Promise((done) => {
          connection.on('overview', () => done(told));
          connection.listen(null);
        });
      })()";
    assert_eq!(browser.evaluate(told).await, true);
}

/// Regression test: names broke at their hyphens on a phone, and units were on the line after their
/// number. Signs of the key were on the line before their word.
#[tokio::test(flavor = "multi_thread")]
async fn short_names_and_values_do_not_break_at_the_end_of_a_line() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait(
            "the end of the demo",
            "document.body.innerText.includes('record has ended')",
        )
        .await;
    let words = r"(() => {
        const walker = document.createTreeWalker(document.getElementById('main'), NodeFilter.SHOW_TEXT);
        const found = [];
        while (walker.nextNode()) {
          const { data, parentElement: parent } = walker.currentNode;
          if (!parent.checkVisibility() || parent.closest('svg, option')) continue;
          for (const { 0: word, index } of data.matchAll(/[\d.,]+ (?:%|± [\d.,]+|(?:ms|s|min|h|Hz)(?![\p{L}\d]))|[^\s-]\S*-\S+/gu)) {
            const range = document.createRange();
            range.setStart(walker.currentNode, index);
            range.setEnd(walker.currentNode, index + word.length);
            const lines = new Set([...range.getClientRects()].map(({ top }) => Math.round(top)));
            if (word.length <= 22) found.push({ word, isBroken: lines.size > 1 });
          }
        }
        return found;
      })()";
    for (tab, shown) in [
        ("", ".structure-card"),
        ("structure/demo", "#panel-now .parameters tbody tr"),
        (
            "structure/demo/compare",
            "#panel-compare .differences tbody tr",
        ),
        ("structure/demo/sensors", "#panel-sensors .levels tbody tr"),
        ("structure/demo/events", "#panel-events .events tbody tr"),
        ("structure/demo/settings", "#panel-settings .rules tbody tr"),
        ("alerts", ".alert"),
        ("report", ".report[data-state=complete]"),
    ] {
        browser
            .evaluate(&format!("location.hash = '#/{tab}'"))
            .await;
        let shown = format!(
            "document.querySelector('{shown}')?.checkVisibility() && {words}.some(({{ word }}) => \
             word.endsWith('storey-2'))"
        );
        browser.wait(tab, &shown).await;
        // Each width breaks the lines at other words.
        for width in (320..560).step_by(16) {
            browser.resize(width, 844).await;
            let broken =
                format!("{words}.filter(({{ isBroken }}) => isBroken).map(({{ word }}) => word)");
            let broken = browser.evaluate(&broken).await;
            assert_eq!(broken, json!([]), "{tab}, {width} pixels");
        }
    }
    // A copy contains the plain characters.
    let copied = "(() => { getSelection().selectAllChildren(document.getElementById('main')); \
                  return getSelection().toString(); })()";
    let copied = browser.evaluate(copied).await;
    let copied = copied.as_str().unwrap();
    assert!(
        copied.contains("storey-2 has lost") && copied.contains(" % of its stiffness"),
        "{copied}"
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the names of all sensors filled the card of a structure.
#[tokio::test(flavor = "multi_thread")]
async fn a_card_names_four_sensors_and_has_the_others_in_its_title() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    let link = "document.querySelector('.facts-line a')";
    browser.wait("the count of sensors", link).await;
    browser.evaluate(&format!("{link}.click()")).await;
    browser
        .wait(
            "the table of sensors",
            "document.querySelector('#panel-sensors:not([hidden]) #sensors tbody tr')",
        )
        .await;
    let card = "(async () => {
        const { OverviewPage } = await import('/overview.js');
        const page = new OverviewPage({ listen() {}, on: () => () => {} });
        const troubled = Array.from({ length: 26 }, (_, index) => `acceleration-${index + 1}`);
        page.show({ structures: [{ name: 'tower', description: '', sentence: '', level: \
        'warning', has_model: true, is_filtered: true, age_s: 0, sensors: { alive: 1, total: 27, \
        troubled } }] });
        const shown = page.element.querySelector('.fact-sensors dd');
        return [shown.textContent, shown.title === troubled.join(', ')];
      })()";
    let first: Vec<String> = (1..=4)
        .map(|number| format!("acceleration-{number}"))
        .collect();
    let text = format!("1 of 27 · check: {}; and 22 more", first.join(", "));
    assert_eq!(browser.evaluate(card).await, json!([text, true]));
}

/// Regression test: a card without a plot was shown as an empty box.
#[tokio::test(flavor = "multi_thread")]
async fn a_card_without_a_plot_is_hidden() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let empty = "(async () => {
        const { NowTab } = await import('/now.js');
        const { about } = await (await fetch('/api/structures/demo')).json();
        const { element } = new NowTab({ name: 'demo', about, choose: () => {} });
        return [...element.querySelectorAll('.card')].filter((card) => !card.hidden && \
        card.childElementCount === 0).length;
      })()";
    assert_eq!(browser.evaluate(empty).await, 0);
}

/// Regression test: labels were at the line of another mark, or on the curve.
#[tokio::test(flavor = "multi_thread")]
async fn labels_of_marks_are_at_their_own_lines() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    for moments in [
        "[52, 50]",         // raised, and pending 5 s earlier
        "[97, 96]",         // the same at the newest data
        "[50, 50]",         // at the same time
        "[60, 62, 58, 99]", // acknowledged and cleared soon after
    ] {
        let script = format!(
            "(async () => {{
                const {{ flags }} = await import('/marks.js');
                const marks = {moments}.map((x, index) => ({{ x, text: `acknowledge${{index}}` }}));
                return flags(marks, {{ min: 0, max: 100 }}, 400, (text) => 6 * text.length);
            }})()"
        );
        let placed = browser.evaluate(&script).await;
        check_words(placed.as_array().unwrap(), moments);
    }
}

/// Regression test: four labels "pending" were stacked above one plot.
#[tokio::test(flavor = "multi_thread")]
async fn equal_marks_that_are_close_share_a_label_with_their_number() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let script = "(async () => {
        const { flags } = await import('/marks.js');
        const marks = [50, 51, 52, 90, 53].map((x) => ({ x, text: 'pending' }));
        const placed = flags(marks, { min: 0, max: 100 }, 400, (text) => 6 * text.length);
        return placed.filter(({ row }) => row >= 0).map(({ text }) => text);
      })()";
    let told = browser.evaluate(script).await;
    assert_eq!(told, serde_json::json!(["pending ×4", "pending"]));
}

/// Checks the labels of marks on 400 px. Each must be beside its own line, and on no other line or
/// label.
fn check_words(flags: &[Value], moments: &str) {
    const GAP: f64 = 4.0;
    let number = |flag: &Value, key: &str| flag[key].as_f64().unwrap();
    let words: Vec<&Value> = flags
        .iter()
        .filter(|flag| number(flag, "row") >= 0.0)
        .collect();
    assert!(words.len() >= 2, "{moments}: {words:?}");
    for word in words {
        let [at, from, to, row] = ["at", "from", "to", "row"].map(|key| number(word, key));
        assert!(
            from == at + GAP || to == at - GAP,
            "not at its line, {moments}: {word}"
        );
        assert!(from >= 0.0 && to <= 400.0, "outside, {moments}: {word}");
        for other in flags.iter().filter(|other| !std::ptr::eq(*other, word)) {
            // A line extends up to its label. Without a label, it ends at the plot.
            let is_crossed =
                number(other, "row") >= row && (from..to).contains(&number(other, "at"));
            assert!(
                !is_crossed,
                "on the line of another, {moments}: {word}, {other}"
            );
            let is_covered = number(other, "row") == row
                && from < number(other, "to")
                && number(other, "from") < to;
            assert!(
                !is_covered,
                "on the word of another, {moments}: {word}, {other}"
            );
        }
    }
}

/// Regression test: storey 1 was in alarm, but was a strip of five pixels without a name.
#[tokio::test(flavor = "multi_thread")]
async fn a_small_part_with_a_probable_loss_is_named_beside_the_drawing() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&["--distributed"]);
    browser.resize(1280, 900).await;
    browser.prefer("light").await;
    browser
        .open(&format!("{}#/structure/demo-distributed", demo.page))
        .await;
    let callout =
        |storey: &str| format!("document.querySelector('.drawing [data-callout={storey}]')");
    let shown = format!(
        "{}?.getAttribute('visibility') !== 'hidden'",
        callout("storey-1")
    );
    browser
        .wait("the drawing", &format!("{} !== null", callout("storey-1")))
        .await;
    browser
        .wait(
            "the loss of storey 1",
            "document.querySelector('.attention').dataset.level === 'alarm'",
        )
        .await;
    browser.wait("its name beside the drawing", &shown).await;
    // Regression test: the other small parts had no name at all.
    let other = callout("storey-2");
    let named = format!(
        "{other}.getAttribute('visibility') !== 'hidden' && {other}.textContent === 'storey-2'"
    );
    browser.wait("the name of a sound part", &named).await;
    let text = browser
        .evaluate(&format!("{}.textContent", callout("storey-1")))
        .await;
    assert!(
        text.as_str()
            .is_some_and(|text| text.starts_with("storey-1") && text.ends_with(" %")),
        "{text}"
    );
    // The longest text that the value has with a usual rule.
    let inside = format!(
        "(() => {{
            {}.querySelector('.beside').textContent = '> 99.99 %';
            const drawing = document.querySelector('.drawing').getBoundingClientRect();
            const texts = [...{}.querySelectorAll('text')].map((one) => \
            one.getBoundingClientRect());
            return texts.every((one) => one.left >= drawing.left && one.right <= drawing.right && \
            one.bottom <= drawing.bottom);
          }})()",
        callout("storey-1"),
        callout("storey-1")
    );
    browser.screenshot("small-parts-light").await;
    assert_eq!(browser.evaluate(&inside).await, true, "it is cut off");
    browser.prefer("dark").await;
    browser.screenshot("small-parts-dark").await;
    browser.resize(390, 844).await;
    browser.screenshot("small-parts-phone").await;
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}

/// Regression test: the table beside the drawing was cut off and required horizontal scrolling.
#[tokio::test(flavor = "multi_thread")]
async fn the_table_of_parts_fits_on_a_small_screen() {
    let Some(mut browser) = browser().await else {
        return;
    };
    for name in ["three-pier-bridge", "dome-bars"] {
        let demo = demo(&[
            "--structure",
            &example(&format!("{name}.toml")),
            "--duration",
            "20",
        ]);
        browser
            .open(&format!("{}#/structure/{name}", demo.page))
            .await;
        browser
            .wait(
                "estimates",
                "/^\\d\\.\\d+ ± /.test(document.querySelector('.parameters \
                                td.number')?.textContent)",
            )
            .await;
        for width in [1280, 1100, 1000, 961, 800, 390] {
            browser.resize(width, 900).await;
            let cut = "(() => { const box = document.querySelector('.scroll:has(.parameters)'); \
                       return box.scrollWidth - box.clientWidth; })()";
            assert_eq!(browser.evaluate(cut).await, 0, "{name} at {width} px");
            if width == 1000 {
                browser.screenshot(&format!("table-{name}")).await;
            }
        }
    }
}

/// Regression test: on a phone, the report of natural frequencies printed a time over the share
/// beside it. The page showed the last 10 minutes, which hold two epochs. The names in a
/// spectrogram were white on white. The settings stated a filter that the structure does not have.
#[tokio::test(flavor = "multi_thread")]
async fn a_structure_of_natural_frequencies_is_readable_on_a_phone() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example("modes/stiffness.toml")).unwrap();
    let short = text
        .replace("epoch-s = 300", "epoch-s = 100")
        .replace("commissioning-epochs = 6", "commissioning-epochs = 2");
    assert_ne!(text, short);
    let structure = folder.path().join("stiffness.toml");
    std::fs::write(&structure, short).unwrap();
    let structure = structure.to_str().unwrap();
    let (run, endpoint) = run_in(folder.path(), structure);
    browser.resize(390, 844).await;
    browser.prefer("light").await;
    browser
        .open(&format!("{}#/structure/stiffness/sensors", run.page))
        .await;
    browser
        .wait(
            "the table of sensors",
            "document.querySelector('#sensors tbody tr')",
        )
        .await;
    let simulation = ["--duration", "420", "--speed", "60", "--connect", &endpoint];
    let simulate = [&["simulate", structure], &simulation[..]].concat();
    let mut simulation = Command::new(env!("CARGO_BIN_EXE_spandrel"))
        .args(simulate)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // The plates of the names are the only pixels of this colour.
    let plates = "(() => {
        const plot = document.querySelector('#plot-spectrogram-floor-2');
        plot?.scrollIntoView();
        const canvas = plot?.querySelector('canvas');
        if (!canvas) return 0;
        const ink = [0x14, 0x20, 0x2b];
        const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        let count = 0;
        for (let at = 0; at < data.length; at += 4) count += ink.every((one, colour) => data[at + \
        colour] === one);
        return count;
      })()";
    browser
        .wait("the names in a spectrogram", &format!("{plates} > 50"))
        .await;
    assert!(simulation.wait().unwrap().success());

    browser
        .evaluate("location.hash = '#/structure/stiffness'")
        .await;
    let pressed = "document.querySelector('.ranges [aria-pressed=true]')?.textContent === '1 day'";
    browser.wait("a span of a day", pressed).await;
    browser
        .evaluate("location.hash = '#/structure/stiffness/settings'")
        .await;
    browser
        .wait(
            "what identifies the structure",
            "(document.querySelector('#panel-settings')?.innerText ?? '').includes('model updated \
             from natural frequencies')",
        )
        .await;

    browser.evaluate("location.hash = '#/report'").await;
    browser
        .wait(
            "the report of the modes",
            "document.querySelector('.report[data-state=complete] .is-modes tbody tr')",
        )
        .await;
    let over =
        "[...document.querySelectorAll('.report-table :is(td, tbody th)')].filter((cell) => {
        const range = document.createRange();
        range.selectNodeContents(cell);
        return range.getBoundingClientRect().right > cell.getBoundingClientRect().right + 1;
      }).map((cell) => cell.textContent)";
    for width in [360, 390] {
        browser.resize(width, 844).await;
        let found = browser.evaluate(over).await;
        assert_eq!(found, json!([]), "{width} pixels");
    }
    browser.screenshot("natural-frequencies-phone").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// An alert says whom to call and who was notified.
#[tokio::test(flavor = "multi_thread")]
async fn an_alert_names_contact_runbook_and_the_last_notice_to_each_receiver() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let shown = |alerts: Value| {
        format!(
            "import('/alerts.js').then(({{ makeHelp, updateHelp }}) => {{
              const help = makeHelp();
              document.body.append(help.element);
              updateHelp(help, {alerts});
              const dialled = help.element.querySelector('a[href^=\"tel:\"]')?.getAttribute('href') ?? null;
              const told = [help.element.hidden ? [] : \
              help.element.innerText.split('\\n').filter(Boolean), \
              help.element.querySelector('.call > a:not([hidden])')?.href ?? null, dialled];
              help.element.remove();
              return told;
            }})"
        )
    };
    let notice = |receiver: &str, second: i64, failure: Value| json!({ "receiver": receiver, "time_ns": second * 1_000_000_000, "failure": failure });
    let alert = |state: &str, notices: Value| json!({ "state": state, "contact": "Ada, +41 44 123 45 67", "runbook": "https://site.example/alarm", "notices": notices });
    let notices = json!([
        notice("ada@site.example", 1_792_000_000, Value::Null),
        notice(
            "hooks.example",
            1_792_000_060,
            json!("replied with 503; retrying")
        ),
    ]);
    assert_eq!(
        browser
            .evaluate(&shown(json!([alert("raised", notices.clone())])))
            .await,
        json!([
            [
                "Contact: Ada, +41 44 123 45 67 · Runbook",
                "Notified: ada@site.example (2026-10-14 17:46:40 UTC)",
                "▲ Not notified: hooks.example (2026-10-14 17:47:40 UTC: replied with 503; \
                 retrying)",
            ],
            "https://site.example/alarm",
            "tel:+41441234567"
        ])
    );
    let nothing = browser
        .evaluate(&shown(json!([alert("normal", notices)])))
        .await;
    assert_eq!(nothing, json!([[], null, null]));
}

/// The table of the last minute is sorted by mouse and keyboard, and says how it is sorted.
#[tokio::test(flavor = "multi_thread")]
async fn sensors_are_sorted_by_the_title_that_is_pressed() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo/sensors", demo.page))
        .await;
    browser
        .wait(
            "the end of the demo",
            "document.body.innerText.includes('record has ended') && \
             document.querySelectorAll('.levels tbody tr').length === 6",
        )
        .await;
    let names =
        "[...document.querySelectorAll('.levels tbody th')].map(({ textContent }) => textContent)";
    let rms = "[...document.querySelectorAll('.levels tbody tr')].map(({ children }) => \
               parseFloat(children[4].textContent))";
    let title = "[...document.querySelectorAll('.levels thead th')].find(({ textContent }) => \
                 textContent === 'RMS')";
    let order = format!("{title}.ariaSort");
    let usual = browser.evaluate(names).await;
    let is_sorted = |sign: i32| {
        format!("{rms}.every((one, at, all) => at === 0 || {sign} * (one - all[at - 1]) >= 0)")
    };
    assert_eq!(browser.evaluate(&is_sorted(1)).await, false, "{usual}");
    browser
        .evaluate(&format!("{title}.querySelector('button').click()"))
        .await;
    assert_eq!(browser.evaluate(&order).await, "ascending");
    assert_eq!(browser.evaluate(&is_sorted(1)).await, true);
    browser
        .evaluate(&format!("{title}.querySelector('button').focus()"))
        .await;
    browser.press("Enter").await;
    assert_eq!(browser.evaluate(&order).await, "descending");
    assert_eq!(browser.evaluate(&is_sorted(-1)).await, true);
    browser.press("Enter").await;
    assert_eq!(browser.evaluate(&order).await, Value::Null);
    assert_eq!(browser.evaluate(names).await, usual);
    // The names are in their natural order, and a state has an order of its own.
    for (column, sorted) in [
        ("Sensor", "#sensors"),
        ("State", "#sensors"),
        ("Quantity", "#sensors"),
    ] {
        let pressed = format!(
            "(() => {{ const title = [...document.querySelectorAll('{sorted} thead th')].find(({{ \
             textContent }}) => textContent === '{column}'); \
             title.querySelector('button').click(); return [title.ariaSort, \
             document.querySelectorAll('{sorted} [aria-sort]').length]; }})()"
        );
        assert_eq!(
            browser.evaluate(&pressed).await,
            json!(["ascending", 1]),
            "{column}"
        );
    }
    browser.screenshot("sensors-sorted").await;
    // Regression: a phone, which shows no titles, could not sort.
    browser.resize(390, 844).await;
    let choose = |order: &str| {
        format!(
            "(() => {{ const list = document.querySelector('#levels .sort-by select'); list.value \
             = '{order}'; list.dispatchEvent(new Event('change')); return list.checkVisibility(); \
             }})()"
        )
    };
    assert_eq!(browser.evaluate(&choose("5-descending")).await, true);
    assert_eq!(browser.evaluate(&is_sorted(-1)).await, true);
    // The orders of both tables are in the address. An order that does not exist has no effect.
    let address = "#/structure/demo/sensors?sort=2-ascending&sort-levels=5-descending";
    assert_eq!(browser.evaluate("location.hash").await, address);
    let go = |address: &str| {
        format!(
            "new Promise((done) => {{ addEventListener('hashchange', done, {{ once: true }}); \
             location.hash = '{address}'; }})"
        )
    };
    browser
        .evaluate(&go("#/structure/demo/sensors?sort-levels=99-up"))
        .await;
    assert_eq!(browser.evaluate(names).await, usual);
    browser
        .evaluate(&go("#/structure/demo/sensors?sort-levels=5-ascending"))
        .await;
    assert_eq!(browser.evaluate(&order).await, "ascending");
    assert_eq!(browser.evaluate(&is_sorted(1)).await, true);
    assert_eq!(browser.evaluate(&choose("")).await, true);
    assert_eq!(browser.evaluate(names).await, usual);
    browser.screenshot("sensors-sorted-phone").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
