//! The page of a structure as a workspace: tabs, the address, small plots, search, time zones, a
//! free time range, and access with assistive technology.

use super::{Browser, Program, STOREYS, browser, demo, example, run_in, tall_building, tool};
use crate::support::axe_or_skip;
use serde_json::{Value, json};

/// Opens a page of a structure and waits for a condition.
async fn open(browser: &mut Browser, demo: &Program, hash: &str, what: &str, condition: &str) {
    browser.open(&format!("{}{hash}", demo.page)).await;
    browser.wait(what, condition).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn tabs_are_operated_by_keyboard_and_kept_in_the_address() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    let selected = "document.querySelector('[role=tab][aria-selected=true]').id";
    open(
        &mut browser,
        &demo,
        "#/structure/demo",
        "the first tab",
        &format!("{selected} === 'tab-now'"),
    )
    .await;
    browser
        .evaluate("document.getElementById('tab-now').focus()")
        .await;
    browser.press("ArrowRight").await;
    let panels = "[...document.querySelectorAll('[role=tabpanel]')].filter((one) => \
                  !one.hidden).map((one) => one.id).join()";
    assert_eq!(browser.evaluate(panels).await, "panel-parameters");
    assert_eq!(
        browser.evaluate("document.activeElement.id").await,
        "tab-parameters"
    );
    assert_eq!(
        browser.evaluate("location.hash").await,
        "#/structure/demo/parameters"
    );
    browser.press("End").await;
    assert_eq!(browser.evaluate(panels).await, "panel-settings");
    browser.evaluate("history.back()").await;
    browser
        .wait(
            "the former tab",
            &format!("{selected} === 'tab-parameters'"),
        )
        .await;

    // The length of the span and the zoom survive a reload.
    browser
        .evaluate(
            "[...document.querySelectorAll('.ranges button')].find((one) => one.textContent \
                   === '1 h').click()",
        )
        .await;
    assert_eq!(
        browser.evaluate("location.hash").await,
        "#/structure/demo/parameters?span=3600"
    );
    browser.reload().await;
    browser
        .wait(
            "the same span",
            "document.querySelector('.ranges [aria-pressed=true]')?.textContent === '1 h'",
        )
        .await;
    assert_eq!(browser.evaluate(panels).await, "panel-parameters");
    browser
        .wait(
            "a plot",
            "document.querySelector('#plot-parameter-storey-1 canvas')",
        )
        .await;
    browser
        .evaluate("document.querySelector('#plot-parameter-storey-1 .plot-holder').focus()")
        .await;
    browser.press("+").await;
    let text = "document.querySelector('.range-text').textContent.split(' ·')[0]";
    browser
        .wait("a zoom", "location.hash.includes('from=')")
        .await;
    let zoomed = browser.evaluate(text).await;
    browser.reload().await;
    browser
        .wait("the same zoom", &format!("{text} === {zoomed}"))
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// The points of the live data still arrive, but no hidden plot is drawn.
#[tokio::test(flavor = "multi_thread")]
async fn plots_of_hidden_tabs_are_not_drawn() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&["--duration", "600"]);
    open(
        &mut browser,
        &demo,
        "#/structure/demo/parameters",
        "a plot",
        "document.querySelector('#plot-parameter-storey-1 canvas')",
    )
    .await;
    let drawn = |tab: &str| {
        format!(
            "(async () => {{
                document.getElementById('tab-{tab}').click();
                await new Promise((done) => requestAnimationFrame(() => \
                requestAnimationFrame(done)));
                const {{ Connection }} = await import('/connection.js');
                const connection = new Connection();
                const original = CanvasRenderingContext2D.prototype.stroke;
                let strokes = 0;
                CanvasRenderingContext2D.prototype.stroke = function (...path) {{ strokes += 1; \
                return original.apply(this, path); }};
                let messages = 0;
                await new Promise((done) => {{
                    connection.on('points', () => (messages += 1) === 20 && done());
                    connection.listen('demo');
                }});
                connection.close?.();
                CanvasRenderingContext2D.prototype.stroke = original;
                return strokes;
            }})()"
        )
    };
    assert_eq!(browser.evaluate(&drawn("settings")).await, 0);
    let visible = browser.evaluate(&drawn("parameters")).await;
    assert!(visible.as_u64().unwrap() > 0, "nothing was drawn at all");
}

/// Regression test: forty storeys took a page of 10,014 px, in the order 1, 10, 11, each plot with
/// its own scale.
#[tokio::test(flavor = "multi_thread")]
async fn forty_parameters_fit_a_screen_and_are_found() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tall.toml");
    std::fs::write(&file, tall_building()).unwrap();
    let demo = demo(&["--structure", file.to_str().unwrap(), "--duration", "20"]);
    browser.resize(1280, 900).await;
    open(
        &mut browser,
        &demo,
        "#/structure/tall/parameters",
        "drawn small plots",
        "document.getElementById('small-scale')?.textContent.startsWith('Common scale of all \
         stiffnesses: ')",
    )
    .await;
    let shown = "[...document.querySelectorAll('.small-plot')].filter((one) => !one.hidden)";
    assert_eq!(browser.evaluate(&format!("{shown}.length")).await, STOREYS);
    let lowest = format!("Math.max(...{shown}.map((one) => one.getBoundingClientRect().bottom))");
    let lowest = browser.evaluate(&lowest).await.as_f64().unwrap();
    assert!(lowest <= 900.0, "the small plots end at {lowest} px");
    let rows = format!(
        "new Set({shown}.map((one) => Math.round(one.getBoundingClientRect().top))).size * new \
         Set({shown}.map((one) => Math.round(one.getBoundingClientRect().left))).size"
    );
    assert_eq!(browser.evaluate(&rows).await, STOREYS, "empty places");
    let cut = format!(
        "{shown}.filter((one) => one.querySelector('.name').scrollWidth > \
         one.querySelector('.name').clientWidth).length"
    );
    assert_eq!(browser.evaluate(&cut).await, 0, "names are cut off");
    browser.screenshot("forty-parameters").await;
    // Regression test: where plots of the usual size did not fit, few columns made a long page.
    browser.resize(1280, 760).await;
    browser
        .wait(
            "smaller plots that fit a lower window",
            &format!(
                "document.querySelector('.smalls.is-dense') && \
                 Math.max(...{shown}.map((one) => one.getBoundingClientRect().bottom)) <= 760"
            ),
        )
        .await;
    browser.resize(1280, 900).await;
    // Regression test: nothing stated the time of the small plots, and a print distorted them.
    let times = "/ From left to right: .+ UTC to .+ \
                 UTC\\.$/.test(document.getElementById('small-scale').textContent)";
    assert_eq!(browser.evaluate(times).await, true);
    browser
        .evaluate("dispatchEvent(new Event('beforeprint'))")
        .await;
    browser.resize(680, 900).await;
    let print = json!({"media": "print"});
    browser.call("Emulation.setEmulatedMedia", print).await;
    let distorted = format!(
        "{shown}.map((one) => one.querySelector('canvas')).filter((one) => \
         Math.abs(one.clientWidth * one.height / (one.clientHeight * one.width) - 1) > 0.05).length"
    );
    assert_eq!(browser.evaluate(&distorted).await, 0, "distorted in print");
    browser
        .call("Emulation.setEmulatedMedia", json!({"media": ""}))
        .await;
    browser.resize(1280, 900).await;

    browser
        .evaluate(
            "const search = document.querySelector('#panel-parameters .search'); \
                   search.value = 'storey-4'; search.dispatchEvent(new Event('input'))",
        )
        .await;
    let names = format!("{shown}.map((one) => one.dataset.parameter)");
    assert_eq!(
        browser.evaluate(&names).await,
        json!(["storey-4", "storey-40"])
    );
    browser.evaluate(&format!("{shown}[1].click()")).await;
    browser
        .wait(
            "the details of storey 40",
            "document.querySelector('.detail #plot-parameter-storey-40 canvas')",
        )
        .await;
    assert_eq!(
        browser.evaluate("location.hash").await,
        "#/structure/tall/parameters?parameter=storey-40&find=storey-4"
    );
    browser.screenshot("forty-parameters-detail").await;
    // The search of a link replaces the former one, on this tab and in the table of the parts.
    let link = "location.hash = '#/structure/tall/parameters?find=storey-39'";
    browser.evaluate(link).await;
    let found = format!("JSON.stringify({names}) === '[\"storey-39\"]'");
    browser.wait("the search of the link", &found).await;
    let link = "location.hash = '#/structure/tall?find=storey-4'";
    browser.evaluate(link).await;
    let rows = "[...document.querySelectorAll('.parts tbody tr')].map((row) => \
                row.querySelector('th').textContent).toSorted().join()";
    let found = format!("{rows} === 'storey-4,storey-40'");
    browser.wait("the parts of the link", &found).await;

    browser
        .evaluate("document.getElementById('tab-model').click()")
        .await;
    browser
        .wait(
            "the innovations of all channels",
            "document.querySelectorAll('#group-innovations .plot').length === 40",
        )
        .await;
    let order = "[...document.querySelectorAll('#group-innovations .plot')].map((one) => \
                 Number(one.id.split('-').at(-1)))";
    let natural: Vec<usize> = (1..=STOREYS).collect();
    assert_eq!(browser.evaluate(order).await, json!(natural));
    // Regression: the first letter of a damaged storey was cut off, because its name is bold.
    browser.evaluate("location.hash = '#/structure/tall'").await;
    browser
        .wait(
            "the drawing",
            "document.querySelector('.drawing')?.checkVisibility()",
        )
        .await;
    let cut = "[...document.querySelectorAll('.drawing .callout:not(.beside)')].map((name) => { \
               name.parentElement.removeAttribute('visibility'); return [name.textContent, \
               name.getBBox().x]; })";
    let names = browser.evaluate(cut).await;
    let names = names.as_array().unwrap();
    assert_eq!(names.len(), STOREYS);
    for name in names {
        assert!(name[1].as_f64().unwrap() >= 0.0, "{name} is cut off");
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// The server sorts the structures by urgency. Here, the page receives five hundred copies of one.
#[tokio::test(flavor = "multi_thread")]
async fn five_hundred_structures_are_on_a_map_and_in_a_list_that_can_be_searched() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    open(
        &mut browser,
        &demo,
        "#/",
        "an alarm, and the values of the last day",
        "document.querySelector('.structure-card[data-level=alarm]') && \
         performance.getEntriesByType('resource').some(({ name }) => name.includes('points=96'))",
    )
    .await;
    // Regression: the line of two minutes was a stray dot.
    let shown = "document.querySelector('.trend').checkVisibility()";
    assert_eq!(browser.evaluate(shown).await, false);
    // The page receives the values of a whole day.
    let day = "(() => {
        const load = globalThis.fetch;
        globalThis.fetch = async (address, ...more) => {
          if (!/history\\?.*points=96/.test(address)) return load(address, ...more);
          const from_s = Number(new URLSearchParams(address.split('?')[1]).get('from'));
          const times = Array.from({ length: 96 }, (_, index) => from_s + 900 * (index + 1));
          const data = [times, times.map((_, index) => 1 - index / 1000)];
          return { ok: true, json: async () => ({ incomplete: false, series: [{ data }] }) };
        };
        location.hash = '#/alerts';
      })()";
    browser.evaluate(day).await;
    browser
        .wait("the alerts", "document.querySelector('.alerts-page')")
        .await;
    browser.evaluate("location.hash = '#/'").await;
    browser
        .wait(
            "the line of the last day",
            "document.querySelector('.structure-card[data-level=alarm] \
             .trend:not([hidden])')?.getAttribute('aria-label').includes('over the last day')",
        )
        .await;
    // Regression test: the line kept its light colours after a switch to dark.
    let colours = "(() => { const canvas = document.querySelector('.trend'); const { data } = \
                   canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height); const \
                   found = new Set(); for (let at = 0; at < data.length; at += 4) if (data[at + 3] \
                   === 255) found.add([...data.slice(at, at + 3)].join()); return \
                   [...found].toSorted(); })()";
    browser.prefer("light").await;
    let light = browser.evaluate(colours).await;
    browser.prefer("dark").await;
    browser
        .wait(
            "the colours of dark",
            &format!("!{colours}.includes({:?})", light[0].as_str().unwrap()),
        )
        .await;
    browser.prefer("light").await;
    let count = "document.querySelectorAll('.structure-card').length";
    assert_eq!(browser.evaluate(count).await, 1);
    assert_eq!(
        browser.evaluate("document.querySelector('.search')").await,
        json!(null)
    );
    let many = "(async () => {
        const { OverviewPage } = await import('/overview.js');
        const [one] = (await (await fetch('/api/structures')).json()).structures;
        let show = null;
        const page = new OverviewPage({ listen() {}, on: (_, listener) => { show = listener; \
        return () => {}; } });
        document.getElementById('main').replaceChildren(page.element);
        const at = (index) => ({ latitude: 47 + index / 250, longitude: 8 + (index % 25) / 10 });
        show({ structures: Array.from({ length: 500 }, (_, index) => ({ ...one, name: \
        `bridge-${index + 1}`, level: index === 49 ? 'alarm' : 'undecided', coordinates: at(index \
        === 49 ? 262 : index) })) });
        const shown = ['.structure-card', '.site'].map((name) => \
        document.querySelectorAll(name).length);
        // Regression: among many signs, that of an alarm had no name.
        const isNameless = document.querySelector('.site[data-name=bridge-50]').classList.contains('is-crowded');
        const search = document.querySelector('.overview .search');
        search.value = 'bridge-50';
        search.dispatchEvent(new Event('input'));
        return [shown, isNameless, ...['.structure-card', '.site'].map((name) => \
        [...document.querySelectorAll(name)].map((one) => one.dataset.name).toSorted())];
      })()";
    let found = json!(["bridge-50", "bridge-500"]);
    assert_eq!(
        browser.evaluate(many).await,
        json!([[500, 500], false, found, found])
    );
    browser.screenshot("many-structures").await;
    // The search is in the address.
    assert_eq!(browser.evaluate("location.hash").await, "#/?find=bridge-50");
    // Regression: the facts of an alarm covered each other, and a hundred cards took 6,428 px.
    let legible = "(() => {
        const [alarm, other] = ['bridge-50', 'bridge-500'].map((name) => \
        document.querySelector(`.structure-card[data-name=${name}]`));
        const parts = [...alarm.querySelectorAll('.badge, h2, .sentence, .fact, \
        .trend')].filter((one) => one.checkVisibility());
        const boxes = parts.map((one) => one.getBoundingClientRect());
        const overlap = (a, b) => a !== b && a.left < b.right - 1 && b.left < a.right - 1 && \
        a.top < b.bottom - 1 && b.top < a.bottom - 1;
        return [parts.map(({ className, tagName }) => className || tagName).filter((name) => name \
        !== 'badge'), boxes.filter((one) => boxes.some((two) => overlap(one, two))).length, \
        Math.max(alarm.offsetHeight, other.offsetHeight) <= LARGEST];
      })()";
    let shown = |facts: &[&str]| {
        let all = [&["H2", "trend", "sentence"][..], facts].concat();
        json!([all, 0, true])
    };
    assert_eq!(
        browser.evaluate(&legible.replace("LARGEST", "36")).await,
        shown(&["fact fact-sensors", "fact fact-fit"])
    );
    browser.resize(390, 844).await;
    // An alarm without new data takes three lines.
    assert_eq!(
        browser.evaluate(&legible.replace("LARGEST", "90")).await,
        shown(&["fact fact-sensors"]),
        "on a phone"
    );
    browser.screenshot("many-structures-phone").await;
    browser.resize(1280, 900).await;
    // Regression test: the order was bridge-1, bridge-10, bridge-100.
    let order = "(async () => {
        const { OverviewPage } = await import('/overview.js');
        const [one] = (await (await fetch('/api/structures')).json()).structures;
        const page = new OverviewPage({ listen() {}, on: () => () => {} });
        const of = (name, level) => ({ ...one, name, level });
        page.show({ structures: [of('bridge-2', 'alarm'), of('bridge-1', 'normal'), \
        of('bridge-10', 'normal'), of('bridge-3', 'normal')] });
        return [...page.element.querySelectorAll('.structure-card')].map(({ dataset }) => \
        dataset.name);
      })()";
    assert_eq!(
        browser.evaluate(order).await,
        json!(["bridge-2", "bridge-1", "bridge-3", "bridge-10"])
    );
    // Regression test: the line of the last day fell below the name, and left a gap beside it.
    browser.resize(390, 844).await;
    let fallen = "[...document.querySelectorAll('.is-many .card-head')].filter((head) => {
        const trend = head.querySelector('.trend');
        trend.hidden = false;
        return trend.getBoundingClientRect().top > \
        head.querySelector('.badge').getBoundingClientRect().bottom;
      }).length";
    assert_eq!(browser.evaluate(fallen).await, 0);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn times_are_shown_in_utc_or_in_the_zone_of_the_browser() {
    let Some(mut browser) = browser().await else {
        return;
    };
    browser.move_to("Asia/Kathmandu").await;
    let demo = demo(&[]);
    let facts = "document.querySelector('.facts-line').textContent";
    open(
        &mut browser,
        &demo,
        "#/structure/demo",
        "an alarm with its time",
        "/since .* UTC$/.test(document.querySelector('.attention .sentence')?.textContent)",
    )
    .await;
    browser
        .wait(
            "the end of the demo",
            "document.body.innerText.includes('record has ended')",
        )
        .await;
    let stamp = format!("{facts}.match(/measured (\\S+ \\S+) UTC/)[1]");
    let utc = browser.evaluate(&stamp).await;
    browser
        .evaluate("document.getElementById('zone').click()")
        .await;
    let local = format!("{facts}.match(/measured (\\S+ \\S+) UTC\\+5:45/)?.[1]");
    browser.wait("local times", &local).await;
    let difference = format!("(Date.parse({local} + 'Z') - Date.parse({utc} + 'Z')) / 60000");
    assert_eq!(browser.evaluate(&difference).await, 345.0);
    browser
        .wait(
            "the sentence of the server in local time",
            "/since .* UTC\\+5:45$/.test(document.querySelector('.attention \
             .sentence').textContent)",
        )
        .await;
    browser.reload().await;
    browser.wait("the zone after a reload", &local).await;
    browser
        .evaluate("document.getElementById('zone').click()")
        .await;
    browser
        .wait("UTC again", &format!("{stamp} === {utc}"))
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_free_range_is_shown_and_exported() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    open(
        &mut browser,
        &demo,
        "#/structure/demo/parameters",
        "the end of the demo",
        "document.body.innerText.includes('record has ended')",
    )
    .await;
    browser
        .evaluate("document.querySelector('.ranges .free').click()")
        .await;
    let set = "(() => { \
        const [from, to] = [document.getElementById('range-from'), \
        document.getElementById('range-to')]; const end = Date.parse(to.value + 'Z') / 1000; \
        const field = (seconds) => new Date(1000 * seconds).toISOString().slice(0, 19); \
        [from.value, to.value] = [field(end - 40), field(end - 20)]; \
        document.getElementById('free-range').requestSubmit(); \
        return end; })()";
    let end = browser.evaluate(set).await.as_f64().unwrap();
    browser
        .wait(
            "the range",
            "document.querySelector('.range-text').textContent.endsWith('(20 s)')",
        )
        .await;
    assert_eq!(
        browser.evaluate("location.hash").await,
        format!(
            "#/structure/demo/parameters?from={:.3}&to={:.3}",
            end - 40.0,
            end - 20.0
        )
    );
    let csv = "(async () => { const link = document.querySelector('#free-range a'); \
               HTMLAnchorElement.prototype.click = () => {}; \
               link.dispatchEvent(new MouseEvent('click', { cancelable: true })); \
               return (await (await fetch(link.href)).text()).trim().split('\\n'); })()";
    let lines = browser.evaluate(csv).await;
    let lines = lines.as_array().unwrap();
    for storey in 1..=5 {
        let column = format!("parameter/storey-{storey}.mean");
        assert!(lines[0].as_str().unwrap().contains(&column), "{}", lines[0]);
    }
    // Ten values of each parameter per second.
    assert!((195..=205).contains(&(lines.len() - 1)), "{}", lines.len());
    let swapped = "(() => { const [from, to] = [document.getElementById('range-from'), \
                   document.getElementById('range-to')]; [from.value, to.value] = [to.value, \
                   from.value]; document.getElementById('free-range').requestSubmit(); return \
                   document.querySelector('#free-range .told').textContent; })()";
    assert_eq!(
        browser.evaluate(swapped).await,
        "The end must be after the start."
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn axe_finds_no_obstacle_on_any_page() {
    let Some(axe) = axe_or_skip() else {
        return;
    };
    let Some(mut browser) = browser().await else {
        return;
    };
    let axe = std::fs::read_to_string(axe).unwrap();
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    for scheme in ["light", "dark"] {
        browser.prefer(scheme).await;
        open(
            &mut browser,
            &demo,
            "#/",
            "an alarm",
            "document.querySelector('.structure-card[data-level=alarm]')",
        )
        .await;
        browser.evaluate(&format!("{axe}; true")).await;
        for (hash, content) in [
            ("#/", ".structure-card"),
            ("#/alerts", ".alert"),
            ("#/structure/demo", ".drawing"),
            (
                "#/structure/demo/parameters",
                "#plot-parameter-storey-1 canvas",
            ),
            (
                "#/structure/demo/compare",
                "#plot-compare-parameter-storey-1 canvas",
            ),
            ("#/report", ".chart"),
            ("#/structure/demo/model", "#group-agreement canvas"),
            ("#/structure/demo/sensors", "table.sensors td"),
            ("#/structure/demo/events", "table.events td"),
            ("#/structure/demo/settings", "table.services td"),
        ] {
            browser.evaluate(&format!("location.hash = '{hash}'")).await;
            browser
                .wait(
                    hash,
                    &format!(
                        "document.querySelector('{content}') && \
                                      (document.querySelector('{content}').scrollIntoView(), \
                                      true)"
                    ),
                )
                .await;
            let found = obstacles(&mut browser).await;
            assert_eq!(found, json!([]), "{hash}, {scheme}");
        }
    }
    drop(demo);
    let lost = "document.body.classList.contains('is-lost')";
    browser.wait("a lost connection", lost).await;
    for scheme in ["dark", "light"] {
        browser.prefer(scheme).await;
        let found = obstacles(&mut browser).await;
        assert_eq!(found, json!([]), "without a connection, {scheme}");
    }
}

/// Returns what axe-core finds on the page.
async fn obstacles(browser: &mut Browser) -> Value {
    let found = "axe.run(document, { resultTypes: ['violations'] }).then(({ violations }) => \
                 violations.map(({ id, nodes }) => `${id}: ${nodes.map(({ target }) => \
                 target.join(' ')).join(', ')}`))";
    browser.evaluate(found).await
}

/// Regression test: before any data, the report had no heading, and the alerts had a fold without a
/// name. A structure without a model left half of the window empty, and its card had facts about a
/// model.
#[tokio::test(flavor = "multi_thread")]
async fn axe_finds_no_obstacle_without_data_without_a_model_and_in_a_report_of_an_earthquake() {
    let Some(axe) = axe_or_skip() else {
        return;
    };
    let Some(mut browser) = browser().await else {
        return;
    };
    let axe = format!("{}; true", std::fs::read_to_string(axe).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let (run, _) = run_in(folder.path(), &example("modes/sensors-only.toml"));
    browser.resize(1280, 900).await;
    browser.open(&run.page).await;
    browser
        .wait("the card", "document.querySelector('.structure-card')")
        .await;
    let facts = "[...document.querySelectorAll('.structure-card .fact')].filter((one) => \
                 one.checkVisibility()).map((one) => one.className.split('-').at(-1))";
    assert_eq!(
        browser.evaluate(facts).await,
        json!(["sensors", "monitoring", "lag", "age", "alert"])
    );
    // Regression test: the modes were prose, which spoke of 20 epochs after the first one.
    let mode = "import('/words.js').then(({ modeWords, COLUMNS }) => [modeWords({ mode: 'sway-1', \
                time_ns: 1504.78e9, state: 'tracked', partner: null, presence: 1, machine: null, \
                estimate: { frequency_hz: 1, frequency_std_hz: 0.01, damping: 0.02, damping_std: \
                0.001 } }), COLUMNS.modes.length])";
    assert_eq!(
        browser.evaluate(mode).await,
        json!([{"level": "normal", "cells": ["sway-1", "✓\u{a0}tracked", "1.0000 Hz", "0.9804 to 1.0196 Hz", "2.00 % ± 0.10 %", "1504.78 s", "100 %"]}, 7])
    );
    // Regression test: a dead thermometer, which ends the judgement, looked like learning.
    let judgements = "import('/words.js').then(({ judgementWords }) => ['judged', 'learning', \
                      'outside-experience', 'no-statement', 'not-ready'].map((word) => \
                      judgementWords({ word, sentence: '', change: null, seen: null, epoch_ns: \
                      null, measured: true }).level))";
    assert_eq!(
        browser.evaluate(judgements).await,
        json!(["normal", "learning", "learning", "warning", "warning"])
    );
    browser.evaluate(&axe).await;
    for (hash, content) in [
        ("#/", ".structure-card"),
        ("#/alerts", ".alerts-page .empty"),
        ("#/report", ".report[data-state=complete]"),
        ("#/structure/sensors-only", ".top #natural-frequencies"),
        ("#/structure/sensors-only/compare", ".two-ranges"),
        ("#/structure/sensors-only/lasting", ".judged"),
        ("#/structure/sensors-only/sensors", "table.sensors td"),
        ("#/structure/sensors-only/events", "#panel-events .card"),
        ("#/structure/sensors-only/settings", "table.services td"),
    ] {
        browser.evaluate(&format!("location.hash = '{hash}'")).await;
        browser
            .wait(hash, &format!("document.querySelector('{content}')"))
            .await;
        assert_eq!(obstacles(&mut browser).await, json!([]), "{hash}");
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());

    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (record, reports) = (file("quake.csv"), file("events"));
    let structure = example("demo.toml");
    tool(&[
        "simulate",
        &structure,
        "--record",
        &record,
        "--duration",
        "60",
    ]);
    tool(&["earthquake", &structure, &record, "--report", &reports]);
    for name in ["demo_quake", "index"] {
        browser.open(&format!("file://{reports}/{name}.html")).await;
        browser
            .wait(
                name,
                "document.readyState === 'complete' && document.querySelector('h1')",
            )
            .await;
        browser.evaluate(&axe).await;
        assert_eq!(obstacles(&mut browser).await, json!([]), "{name}");
    }
}
