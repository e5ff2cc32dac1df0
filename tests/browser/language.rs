//! The languages of the page.

use super::{browser, demo};
use serde_json::json;

/// Collects the English words on the page that German lacks, with the text that contains them.
///
/// It leaves out what services write (`lang="en"`), the description in the structure file, and
/// names.
const ENGLISH_LEFT: &str = "(async () => {
    const [{ english }, { german }] = await Promise.all([import('/english.js'), \
    import('/german.js')]);
    const { about, standing } = await (await fetch('/api/structures/demo')).json();
    const words = (text) => text.toLowerCase().match(/[a-zäöüß]{3,}/g) ?? [];
    const names = [about.parameters, about.noise, about.drawing.points].flatMap((list) => \
    list.map(({ name }) => name));
    names.push(...about.drawing.sensors.flatMap(({ channel, node }) => [channel, node]));
    names.push(...standing.services.flatMap(({ service, id, status }) => [service, id, \
    ...Object.keys(status?.drops ?? {})]), ...standing.events.map(({ subject }) => subject), \
    about.name);
    const known = new Set([...Object.values(german), ...names].flatMap(words));
    const foreign = new Set(Object.values(english).flatMap(words).filter((word) => \
    !known.has(word)));
    const found = [];
    const look = (element, text) => {
        if (element.closest('[lang=en], script, noscript, .description')) return;
        const left = words(text).filter((word) => foreign.has(word));
        if (left.length > 0) found.push(`${left.join(' ')}: ${text}`);
    };
    const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) look(texts.currentNode.parentElement, texts.currentNode.data);
    for (const name of ['aria-label', 'title', 'placeholder', 'data-head']) {
        for (const element of document.querySelectorAll(`[${name}]`)) look(element, \
        element.getAttribute(name));
    }
    return [foreign.size > 200, found];
  })()";

/// Collects the numbers with a decimal point and the dates in ISO 8601 that people read on the
/// page.
///
/// It leaves out what services write (`lang="en"`) and the description in the structure file.
const ENGLISH_NUMBERS: &str = "(() => {
    const found = [];
    const look = (element, text) => {
        if (element.closest('[lang=en], script, noscript, .description')) return;
        const rest = text.replaceAll(/\\d\\d\\.\\d\\d\\.\\d{4}/g, '');
        if (/\\d\\.\\d|\\d{4}-\\d\\d-\\d\\d/.test(rest)) found.push(text);
    };
    const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) look(texts.currentNode.parentElement, texts.currentNode.data);
    for (const element of document.querySelectorAll('[aria-label]')) look(element, \
    element.getAttribute('aria-label'));
    return found;
  })()";

#[tokio::test(flavor = "multi_thread")]
async fn the_page_is_in_german_for_a_german_browser() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    let agent = browser.evaluate("navigator.userAgent").await;
    let german = json!({"userAgent": agent, "acceptLanguage": "de-DE,de"});
    browser.call("Emulation.setUserAgentOverride", german).await;
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser
        .wait(
            "the end of the demo in German",
            "document.body.innerText.includes('Aufzeichnung beendet')",
        )
        .await;
    for (hash, content) in [
        ("#/structure/demo", ".parameters td"),
        (
            "#/structure/demo/parameters",
            "#plot-parameter-storey-1 canvas",
        ),
        ("#/structure/demo/compare", ".differences td"),
        ("#/structure/demo/model", "#group-agreement canvas"),
        ("#/structure/demo/sensors", "table.sensors td"),
        ("#/structure/demo/events", "table.events td"),
        ("#/structure/demo/settings", "table.services td"),
        ("#/alerts", ".alert"),
        ("#/report", ".report .chart"),
        ("#/", ".structure-card"),
    ] {
        browser.evaluate(&format!("location.hash = '{hash}'")).await;
        browser
            .wait(
                hash,
                &format!(
                    "document.querySelector('{content}') && \
                          (document.querySelector('{content}').scrollIntoView(), true)"
                ),
            )
            .await;
        assert_eq!(
            browser.evaluate(ENGLISH_LEFT).await,
            json!([true, []]),
            "{hash}"
        );
        assert_eq!(browser.evaluate(ENGLISH_NUMBERS).await, json!([]), "{hash}");
    }
    browser.evaluate("scrollTo(0, 0)").await;
    browser.screenshot("german").await;
    let language = "document.documentElement.lang";
    assert_eq!(browser.evaluate(language).await, "de");
    // Regression test: dates of services and of fields had another format, and counters had English
    // names.
    let told = "(async () => { const { fieldOf, setSentence, timeOfField } = \
                await import('/time.js'); \
                const { wordOf } = await import('/language.js'); \
                const line = document.createElement('p'); line.lang = 'en'; \
                setSentence(line, 'lost 12 % since 2026-11-29 12:30:14 UTC, found 05.09.2026, \
                file 2026-11-29T12'); \
                const times = ['29.11.2026 12:30:14', '2026-11-29 12:30:14 UTC', 'gestern', \
                '2026-02-31', '29.02.2026 12:30', '29.02.2028']; \
                return [line.textContent, wordOf('duplicate-items'), fieldOf(1795955414), \
                times.map(timeOfField)]; })()";
    assert_eq!(
        browser.evaluate(told).await,
        json!([
            "Lost 12 % since 29.11.2026 12:30:14 UTC, found 05.09.2026, file 2026-11-29T12",
            "doppelte Werte",
            "29.11.2026 12:30:14",
            [
                1_795_955_414,
                1_795_955_414,
                null,
                null,
                null,
                1_835_395_200
            ]
        ])
    );

    // The switch keeps the place, and the browser stores the choice.
    browser
        .evaluate("document.getElementById('language').click()")
        .await;
    browser
        .wait(
            "the structures in English",
            &format!(
                "{language} === 'en' && document.querySelector('h1')?.textContent === 'Structures'"
            ),
        )
        .await;
    browser.reload().await;
    browser
        .wait(
            "English after a reload",
            "document.querySelector('h1')?.textContent === 'Structures'",
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
