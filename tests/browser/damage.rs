//! The demo on the page, from its damage to a lost connection: the drawing and the plots, a picture
//! to save, a phone, and the acknowledgement of the alert.

use super::{Browser, Program, browser, free_address};
use serde_json::{Value, json};
use std::path::Path;

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
    let past = "document.querySelector('.past > .alert[data-level=alarm]') === null";
    assert_eq!(browser.evaluate(past).await, true);
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
                   .when').textContent",
        )
        .await;
    // Regression: it had the time of the data. The sentence has the name and the note.
    let seen = seen.as_str().unwrap();
    let (raised, seen) = seen.split_once(" · ").expect("both times");
    assert!(raised.starts_with("raised 20"), "{raised}");
    assert!(
        seen.starts_with("acknowledged 20") && seen.ends_with(" UTC"),
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
