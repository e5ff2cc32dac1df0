//! Mistakes of the page that a new user has found. Each test shows that one of them is mended.

use super::browser;
use super::layout::{demo, example};
use serde_json::json;

/// Waits for the end of a demo, whose data then become stale.
const ENDED: &str = "document.body.innerText.includes('no new data')";

/// Regression test: an acknowledged alarm turned into "No data", and its badge vanished. The
/// sentences of normal parts were those of the first decision. The times were in the future.
#[tokio::test(flavor = "multi_thread")]
async fn an_acknowledged_alert_keeps_its_badge_when_data_stop() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(390, 844).await;
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser
        .wait(
            "an alarm",
            "document.querySelector('.attention').dataset.level === 'alarm'",
        )
        .await;
    browser.wait("the end of the demo", ENDED).await;
    // The badges are beside or below each other.
    let apart = "(() => { \
        const [first, second] = [...document.querySelectorAll('.attention .badge')].filter((one) => !one.hidden).map((one) => one.getBoundingClientRect()); \
        return first.right <= second.left || first.bottom <= second.top; })()";
    assert_eq!(browser.evaluate(apart).await, true, "the badges overlap");
    let broken = "[...document.querySelectorAll('.whole, time')].filter((one) => one.getClientRects().length > 1).map((one) => one.textContent)";
    assert_eq!(browser.evaluate(broken).await, json!([]), "broken times");
    let times = "document.querySelectorAll('.attention .whole').length";
    assert!(browser.evaluate(times).await.as_u64().unwrap() >= 2);
    let newest = "fetch('/api/structures').then((answer) => answer.json()).then(({ structures }) => structures[0].time_s - Date.now() / 1000)";
    let ahead = browser.evaluate(newest).await.as_f64().unwrap();
    assert!(ahead <= 0.0, "the newest sample is {ahead} s in the future");

    let seen = "fetch('/api/structures/demo/alerts/storey-2/acknowledge', { method: 'POST', headers: { 'content-type': 'application/json' }, body: '{\"who\": \"Ada\", \"note\": \"\"}' }).then(({ status }) => status)";
    assert_eq!(browser.evaluate(seen).await, 200);
    browser
        .wait(
            "no data",
            "document.querySelector('.attention').dataset.level === 'stale'",
        )
        .await;
    let badges = "[...document.querySelectorAll('.attention .badge')].filter((one) => !one.hidden).map((one) => one.textContent)";
    assert_eq!(
        browser.evaluate(badges).await,
        json!(["✕ No data", "● alert acknowledged"])
    );
    browser.screenshot("acknowledged-without-data").await;
    browser.evaluate("location.hash = '#/alerts'").await;
    browser
        .wait(
            "a sentence by the newest value",
            "[...document.querySelectorAll('.alerts:not(.past) .alert[data-state=normal] .sentence')].some((one) => /^storey-\\d is normal by the newest value: loss −?[\\d.]+ % /.test(one.textContent))",
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: a print left plots blank that had not been in the window.
#[tokio::test(flavor = "multi_thread")]
async fn a_print_contains_all_plots() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 500).await;
    browser
        .open(&format!("{}#/structure/demo/parameters", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    let fetched = "(() => { dispatchEvent(new Event('beforeprint')); return [...document.querySelectorAll('#panel-parameters .plot')].every((one) => one.querySelector('canvas') && !one.classList.contains('is-empty')); })()";
    let count = "document.querySelectorAll('#panel-parameters .plot').length";
    assert_eq!(browser.evaluate(count).await, 6);
    browser.wait("all plots in the print", fetched).await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the drawing of a bridge named no sensor, floors crossed percentages, and each
/// plot had its own scale.
#[tokio::test(flavor = "multi_thread")]
async fn drawings_name_the_sensors_and_no_line_crosses_a_text() {
    let Some(mut browser) = browser().await else {
        return;
    };
    browser.resize(1280, 900).await;
    let building = demo(&[]);
    browser
        .open(&format!("{}#/structure/demo", building.page))
        .await;
    browser
        .wait("the drawing", "document.querySelector('.drawing .inside')")
        .await;
    let behind = "(() => { \
        const floors = [...document.querySelectorAll('.drawing .floor')]; \
        return [...document.querySelectorAll('.drawing .inside')].every((text) => floors.every((floor) => floor.compareDocumentPosition(text) & Node.DOCUMENT_POSITION_FOLLOWING)); })()";
    assert_eq!(browser.evaluate(behind).await, true);
    let filled = "(() => { \
        const drawing = document.querySelector('.drawing'); \
        const [own, card] = [drawing.getBBox(), drawing.closest('.card').getBoundingClientRect()]; \
        const scale = drawing.getBoundingClientRect().width / drawing.viewBox.baseVal.width; \
        return (own.width * scale) / card.width; })()";
    let filled = browser.evaluate(filled).await.as_f64().unwrap();
    assert!(filled > 0.8, "the drawing takes {filled} of its card");
    browser.open("about:blank").await;
    drop(building);

    let bridge = demo(&[
        "--structure",
        &example("three-pier-bridge.toml"),
        "--duration",
        "20",
    ]);
    for (width, least) in [(1280, 6), (390, 4)] {
        browser.resize(width, 900).await;
        browser.open("about:blank").await;
        browser
            .open(&format!("{}#/structure/three-pier-bridge", bridge.page))
            .await;
        browser
            .wait(
                "names of sensors",
                "document.querySelector('.drawing .sensor-name')",
            )
            .await;
        let named = "[...document.querySelectorAll('.drawing .sensor-name')].length";
        let named = browser.evaluate(named).await.as_u64().unwrap();
        assert!(named >= least, "{named} points are named at {width} px");
        let overlap = "(() => { \
            const texts = [...document.querySelectorAll('.drawing text:not(.sign)')].filter((one) => one.textContent).map((one) => one.getBoundingClientRect()); \
            return texts.some((one, index) => texts.slice(index + 1).some((other) => one.left < other.right && other.left < one.right && one.top + 2 < other.bottom - 2 && other.top + 2 < one.bottom - 2)); })()";
        assert_eq!(browser.evaluate(overlap).await, false, "at {width} px");
        browser.screenshot(&format!("bridge-{width}")).await;
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: sensors were prose without times.
#[tokio::test(flavor = "multi_thread")]
async fn sensors_events_and_settings_are_tables() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo/sensors", demo.page))
        .await;
    let cell = |column: usize| {
        format!(
            "document.querySelector('table.sensors tr[data-channel=floor-2]')?.children[{column}].textContent ?? ''"
        )
    };
    browser
        .wait(
            "the time of the last sample",
            &format!("/^20\\d\\d-.* UTC$/.test({})", cell(4)),
        )
        .await;
    browser
        .wait("its state", &format!("{} === '● delivers'", cell(3)))
        .await;
    browser
        .wait(
            "a comparison with the others",
            &format!("/^factor [\\d.]+, delay −?\\d+ ms$/.test({})", cell(5)),
        )
        .await;
    browser
        .wait(
            "the probability of a fault",
            &format!("/ %$/.test({})", cell(6)),
        )
        .await;
    browser.screenshot("sensors").await;
    browser
        .evaluate("document.getElementById('tab-events').click()")
        .await;
    browser
        .wait(
            "the alarm among the events",
            "[...document.querySelectorAll('table.events tr[data-level=alarm]')].some((one) => one.textContent.includes('▲ alert raised'))",
        )
        .await;
    browser.screenshot("events").await;
    browser
        .evaluate("document.querySelector('table.events tr[data-level=alarm] a').click()")
        .await;
    browser
        .wait(
            "the moment of the alarm",
            "document.querySelector('#plot-parameter-storey-2.is-chosen canvas') && location.hash.includes('from=')",
        )
        .await;
    browser
        .evaluate("document.getElementById('tab-settings').click()")
        .await;
    let settings = "document.getElementById('panel-settings').textContent";
    for text in [
        "100 Hz",
        "more than 5 %",
        "0.99",
        "Items processed",
        "ingest",
    ] {
        browser
            .wait(text, &format!("{settings}.includes({text:?})"))
            .await;
    }
    let words = "document.documentElement.textContent";
    for word in ["ratio (1)", "Done"] {
        let found = format!("{words}.includes({word:?})");
        assert_eq!(browser.evaluate(&found).await, false, "{word}");
    }
    for width in [1280, 390] {
        browser.resize(width, 844).await;
        for tab in [
            "now",
            "parameters",
            "model",
            "sensors",
            "events",
            "settings",
        ] {
            browser
                .evaluate(&format!("document.getElementById('tab-{tab}').click()"))
                .await;
            let wide = "document.documentElement.scrollWidth";
            assert_eq!(browser.evaluate(wide).await, width, "{tab}");
            browser.screenshot(&format!("{tab}-{width}")).await;
        }
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
