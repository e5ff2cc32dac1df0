//! Mistakes of the page that a new user has found. Each test shows that one of them is mended.

use super::{browser, demo, example};
use serde_json::json;

/// Waits for the end of a demo, whose data then become stale.
const ENDED: &str = "document.body.innerText.includes('record has ended')";

/// Regression test: an acknowledged alarm turned into "No data" when its record ended. The
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
        const [first, second] = [...document.querySelectorAll('.attention .badge')].filter((one) \
        => !one.hidden).map((one) => one.getBoundingClientRect()); return first.right <= \
        second.left || first.bottom <= second.top; })()";
    assert_eq!(browser.evaluate(apart).await, true, "the badges overlap");
    let broken = "[...document.querySelectorAll('.whole, time')].filter((one) => \
                  one.getClientRects().length > 1).map((one) => one.textContent)";
    assert_eq!(browser.evaluate(broken).await, json!([]), "broken times");
    let times = "document.querySelectorAll('.attention .whole').length";
    assert!(browser.evaluate(times).await.as_u64().unwrap() >= 2);
    // Regression: the figures of the sentence had no date, and differed from those of the table.
    let dated = "(async () => { \
        const { time } = await import('/time.js'); \
        const { standing } = await (await fetch('/api/structures/demo')).json(); \
        const { time_ns } = standing.alerts.find(({ state }) => state === 'raised'); \
        const line = document.querySelector('.attention .dated'); \
        const text = `Figures as of ${time(time_ns / 1e9)}.`; \
        const tabs = [...document.querySelectorAll('[role=tab]')].toReversed(); \
        const without = tabs.filter((tab) => { tab.click(); \
        return !line.checkVisibility() || line.textContent !== text; }); \
        return [tabs.length, without.map(({ id }) => id)]; })()";
    assert_eq!(browser.evaluate(dated).await, json!([7, []]), "the tabs");
    let newest = "fetch('/api/structures').then((answer) => answer.json()).then(({ structures }) \
                  => structures[0].time_s - Date.now() / 1000)";
    let ahead = browser.evaluate(newest).await.as_f64().unwrap();
    assert!(ahead <= 0.0, "the newest sample is {ahead} s in the future");

    let seen = "fetch('/api/structures/demo/alerts/storey-2/acknowledge', { method: 'POST', \
                headers: { 'content-type': 'application/json' }, body: \
                '{\"who\": \"Ada\", \"note\": \"\"}' }).then(({ status }) => status)";
    assert_eq!(browser.evaluate(seen).await, 200);
    browser
        .wait(
            "a notice",
            "document.querySelector('.attention').dataset.level === 'notice'",
        )
        .await;
    let badges = "[...document.querySelectorAll('.attention .badge')].filter((one) => \
                  !one.hidden).map((one) => one.textContent)";
    assert_eq!(
        browser.evaluate(badges).await,
        json!(["● Acknowledged", "■ record has ended"])
    );
    browser.screenshot("acknowledged-without-data").await;
    // Regression: the state of an alarm filled the window of a phone on each tab.
    let folded = "(() => { const { open, firstChild } = document.querySelector('.attention \
                  .more'); return [open, firstChild.checkVisibility()]; })()";
    assert_eq!(browser.evaluate(folded).await, json!([true, false]));
    // Regression: after a zoom, the way back was beyond the edge of a phone.
    let moment = "fetch('/api/structures').then((answer) => answer.json()).then(({ structures }) \
                  => (location.hash = \
                  `#/structure/demo/parameters?parameter=storey-2&at=${structures[0].time_s - \
                  30}`))";
    browser.evaluate(moment).await;
    browser
        .wait(
            "a zoomed plot",
            "document.querySelector('.range-state .back')?.checkVisibility()",
        )
        .await;
    assert_eq!(browser.evaluate(folded).await, json!([false, true]));
    let back = "(() => { const { left, right } = document.querySelector('.range-state \
                .back').getBoundingClientRect(); return left >= 0 && right <= innerWidth; })()";
    assert_eq!(browser.evaluate(back).await, true);
    browser.screenshot("zoomed-phone").await;
    browser.evaluate("location.hash = '#/alerts'").await;
    browser
        .wait(
            "a sentence by the newest value",
            "[...document.querySelectorAll('.alerts:not(.past) .alert[data-state=normal] \
             .sentence')].some((one) => /^storey-\\d is normal by the newest value: loss \
             −?[\\d.]+ % /.test(one.textContent))",
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the parts and the fit of a structure without data kept their green ticks.
#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_normal_without_data() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    let rows = "document.querySelectorAll('#panel-now .parameters tbody tr[data-level=normal]')";
    browser
        .wait("a normal part", &format!("{rows}.length >= 4"))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    browser
        .wait("no normal part", &format!("{rows}.length === 0"))
        .await;
    let words = "[...document.querySelectorAll('#panel-now .parameters tbody tr')].filter((row) \
                 => row.children[1].textContent === '◌ blind' && \
                 row.children[4].textContent.startsWith('last known: ')).length";
    browser.wait("blind parts", &format!("{words} >= 4")).await;
    let ticks = "document.querySelector('.structure').innerText.includes('✓')";
    assert_eq!(browser.evaluate(ticks).await, false);
    let coloured = "document.querySelectorAll('.drawing .part[data-step=\"0\"]').length";
    assert_eq!(browser.evaluate(coloured).await, 0);
    browser.screenshot("without-data").await;
    browser
        .evaluate("location.hash = '#/structure/demo/model'")
        .await;
    browser
        .wait(
            "the last known fit",
            "document.querySelector('#panel-model .fit')?.textContent.includes('last known')",
        )
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelector('#panel-model .fit').dataset.level")
            .await,
        "learning"
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: a print left plots blank that had not been in the window. It left a page empty
/// before a long table, and printed tables as on a phone.
#[tokio::test(flavor = "multi_thread")]
async fn a_print_of_each_tab_is_complete() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 500).await;
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    for (tab, plots, table) in [
        ("now", 1, "parameters"),
        ("parameters", 6, ""),
        ("compare", 6, "differences"),
        ("model", 7, ""),
        ("sensors", 18, "sensors"),
        ("events", 0, "events"),
        ("settings", 0, "services"),
    ] {
        browser
            .evaluate(&format!("document.getElementById('tab-{tab}').click()"))
            .await;
        let all = format!("[...document.querySelectorAll('#panel-{tab} .plot')]");
        let fetched = format!(
            "(() => {{ dispatchEvent(new Event('beforeprint')); return {all}.length >= {plots} && \
             {all}.every((one) => one.querySelector('canvas') && \
             !one.classList.contains('is-empty')); }})()"
        );
        browser.wait(&format!("all plots of {tab}"), &fetched).await;
        // The width of A4 without its margins.
        browser.resize(680, 900).await;
        let print = json!({"media": "print"});
        browser.call("Emulation.setEmulatedMedia", print).await;
        let wide = format!(
            "[document.documentElement.scrollWidth, \
             ...[...document.querySelectorAll('#panel-{tab} canvas')].map((one) => \
             one.getBoundingClientRect().right)].filter((right) => right > 680)"
        );
        assert_eq!(browser.evaluate(&wide).await, json!([]), "{tab} is cut off");
        let columns = format!(
            "[...document.querySelectorAll('#panel-{tab} .plots')].filter((one) => \
             one.checkVisibility() && \
             getComputedStyle(one).gridTemplateColumns.split(' ').length !== 2).length"
        );
        assert_eq!(browser.evaluate(&columns).await, 0, "{tab} in print");
        // Regression test: tables were printed over what follows, and room was left below plots.
        let misfits = format!(
            "[...document.querySelectorAll('#panel-{tab} :is(.scroll, .plot-holder)')].filter((one) \
             => {{ const {{ maxHeight, minHeight }} = getComputedStyle(one); \
             return one.matches('.scroll') ? maxHeight !== 'none' : minHeight !== '0px'; }}).length"
        );
        assert_eq!(browser.evaluate(&misfits).await, 0, "{tab} in print");
        // Regression test: a print did not name its tab or its time, and contained controls. It lacked
        // the contact and the age of the data.
        let titled = format!(
            "[document.querySelector('h1').innerText === `demo – \
             ${{document.getElementById('tab-{tab}').textContent}}`, \
             [...document.querySelectorAll('#panel-{tab} :is(.check, select)')].filter((one) => \
             one.checkVisibility()).length, /printed 20..-..-.. /.test(document\
             .querySelector('p.printed').innerText), document.querySelector('.facts-line')\
             .checkVisibility()]"
        );
        assert_eq!(
            browser.evaluate(&titled).await,
            json!([true, 0, true, true]),
            "{tab} in print"
        );
        if !table.is_empty() {
            let kept = format!(
                "(() => {{ const table = document.querySelector('#panel-{tab} table.{table}'); \
                 return [getComputedStyle(table.querySelector('thead')).display, \
                 getComputedStyle(table.querySelector('tbody tr')).display, \
                 getComputedStyle(table.closest('.card')).breakInside]; }})()"
            );
            let expected = json!(["table-header-group", "table-row", "auto"]);
            assert_eq!(browser.evaluate(&kept).await, expected, "{tab}");
        }
        browser
            .call("Emulation.setEmulatedMedia", json!({"media": ""}))
            .await;
        browser.resize(1280, 500).await;
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the page said "no new data" and "sensors alive 0 of 6" after the end of a
/// record, its sentences began with small letters, and its origin was called a lag.
#[tokio::test(flavor = "multi_thread")]
async fn an_ended_record_is_called_ended_and_sentences_begin_with_capital_letters() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo/events", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    let badges = "[...document.querySelectorAll('.attention .badge')].filter((one) => \
                  !one.hidden).map((one) => one.textContent)";
    assert_eq!(
        browser.evaluate(badges).await,
        json!(["▲ Alarm", "■ record has ended"])
    );
    let sensors = "document.querySelector('.facts-line a').textContent";
    assert_eq!(browser.evaluate(sensors).await, "record has ended");
    let small = "[...document.querySelectorAll('.events :is(strong, .why)[lang=en]')].map((one) \
                 => one.textContent).filter((text) => /^\\p{Ll}/u.test(text) && \
                 !text.startsWith('storey-'))";
    assert_eq!(browser.evaluate(small).await, json!([]));
    let capitals = "import('/words.js').then(({ capitalised }) => ['no decision on storey-2: the \
                    filter is still learning', 'the node sends again', 'not used: floor-1', 'it \
                    was silent for 14 s', 'storey-2 has lost 15 %', 'middle has lost 12 %', \
                    'damping: the estimate is at its bound', 'deckA has lost 12 \
                    %'].map(capitalised))";
    assert_eq!(
        browser.evaluate(capitals).await,
        json!([
            "No decision on storey-2: the filter is still learning",
            "The node sends again",
            "Not used: floor-1",
            "It was silent for 14 s",
            // Names stay as they are.
            "storey-2 has lost 15 %",
            "middle has lost 12 %",
            "damping: the estimate is at its bound",
            "deckA has lost 12 %",
        ])
    );
    browser.evaluate("location.hash = '#/'").await;
    let card = "['sensors', 'lag'].map((fact) => document.querySelector(`.structure-card \
                .fact-${fact}`)?.innerText)";
    browser
        .wait(
            "the card",
            "document.querySelector('.structure-card .fact-lag')",
        )
        .await;
    assert_eq!(
        browser.evaluate(card).await,
        json!([
            "Sensors alive\nrecord has ended",
            "Origin\nreplayed or simulated"
        ])
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the list of events contained every change between normal and undecided.
#[tokio::test(flavor = "multi_thread")]
async fn events_are_limited_to_a_kind_that_the_address_keeps() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(390, 844).await;
    browser
        .open(&format!("{}#/structure/demo/events", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    let titles = "[...new Set([...document.querySelectorAll('.events strong')].map((one) => \
                  one.textContent))]";
    let all = browser.evaluate(titles).await;
    let all = all.as_array().unwrap().len();
    let choose = |kind: &str| {
        format!(
            "(() => {{ const select = document.querySelector('#panel-events select'); \
             select.value = '{kind}'; select.dispatchEvent(new Event('change')); return \
             location.hash; }})()"
        )
    };
    assert_eq!(
        browser.evaluate(&choose("urgent")).await,
        "#/structure/demo/events?show=urgent"
    );
    let urgent = json!(["▲ alert raised", "◆ alert pending"]);
    assert_eq!(browser.evaluate(titles).await, urgent);
    // The text of an event has the whole width of a phone.
    let narrow = "[...document.querySelectorAll('.events tbody tr')].filter((row) => \
                  row.children[2].clientWidth < row.clientWidth - 2 * \
                  parseFloat(getComputedStyle(row).paddingLeft) - 2).length";
    assert_eq!(browser.evaluate(narrow).await, 0);
    browser.reload().await;
    let kept = "document.querySelectorAll('.events tbody tr').length === 2";
    browser.wait("the same events after a reload", kept).await;
    assert_eq!(
        browser.evaluate(&choose("others")).await,
        "#/structure/demo/events?show=others"
    );
    let others = browser.evaluate(titles).await;
    let others = others.as_array().unwrap();
    assert!(!others.is_empty() && others.len() < all, "{others:?}");
    let signs = "[...document.querySelectorAll('.events strong')].filter((one) => /alert \
                 /.test(one.textContent)).length";
    assert_eq!(browser.evaluate(signs).await, 0);
    assert_eq!(
        browser.evaluate(&choose("all")).await,
        "#/structure/demo/events"
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the label of the threshold covered the estimates, which are above it.
#[tokio::test(flavor = "multi_thread")]
async fn the_label_of_a_threshold_is_below_its_line() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    let record = "(() => {
        globalThis.labels = new Map();
        const { setLineDash, moveTo, fillText } = CanvasRenderingContext2D.prototype;
        Object.assign(CanvasRenderingContext2D.prototype, {
          setLineDash(dash) { this.dash = dash.join(); return setLineDash.call(this, dash); },
          moveTo(x, y) { if (this.dash === '6,4') this.line = y; return moveTo.call(this, x, y); },
          fillText(text, x, y) { if (text.startsWith('threshold')) labels.set(this.canvas, y - 11 \
          - this.line); return fillText.call(this, text, x, y); },
        });
        document.getElementById('tab-parameters').click();
      })()";
    browser.evaluate(record).await;
    // The upper edge of each label is below the line. The first drawing has no common scale yet.
    let below = "labels.size >= 5 && [...labels.values()].every((distance) => distance > 0)";
    browser.wait("labels below their lines", below).await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: a part whose fit was contradicted had no decision, but was drawn as certain
/// damage.
#[tokio::test(flavor = "multi_thread")]
async fn a_part_without_a_decision_does_not_look_like_damage() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser
        .wait(
            "an alarm",
            "document.querySelector('.attention').dataset.level === 'alarm'",
        )
        .await;
    let shown = |state: &str| {
        format!(
            "(async () => {{
                const [{{ NowTab }}, {{ Points, Scale, Span }}, {{ parameterPlot }}] = await \
                Promise.all(['/now.js', '/span.js', '/plots.js'].map((file) => import(file)));
                const {{ about, standing }} = await (await fetch('/api/structures/demo')).json();
                standing.alerts.find(({{ parameter }}) => parameter === 'storey-2').state = \
                '{state}';
                Object.assign(standing.losses['storey-2'], {{ probability_of_loss: 1, reference: \
                1, loss: 0.25, interval: {{ level: 0.95, low: 0.125, high: 0.375 }} }});
                const span = new Span();
                const page = {{ name: 'demo', about, span, points: new Points('demo', span), \
                scale: new Scale(), standing: () => standing, choose() {{}} }};
                const tab = new NowTab(page);
                tab.update(standing);
                document.getElementById('main').replaceChildren(tab.element);
                const part = tab.element.querySelector('.drawing .part[data-part=storey-2]');
                const words = tab.element.querySelectorAll('.drawing .inside');
                const row = [...tab.element.querySelectorAll('.parameters tbody tr')].find(({{ \
                firstElementChild }}) => firstElementChild.textContent === 'storey-2');
                const readout = parameterPlot(about.parameters[1], page.standing, page.points, \
                span, null).plot.readout([[0], [0.85], [0], [0], [0.8], [0.9], [0], [0], [0.25], \
                [0.125], [0.375], [1]], 0);
                return [part.dataset.step ?? null, [...words].some((one) => one.textContent === \
                '? undecided'), row.children[4].textContent, row.querySelector('.meter').hidden, \
                readout, part.dataset.open ?? null, row.children[3].textContent === '0.625 to \
                0.875'];
            }})()"
        )
    };
    assert_eq!(
        browser.evaluate(&shown("raised")).await,
        json!([
            "3",
            false,
            "> 99.9 %",
            false,
            "0.850 · 95 %: 0.800 to 0.900 · P(loss > 5 %) > 99.9 %",
            null,
            false
        ])
    );
    assert_eq!(
        browser.evaluate(&shown("undecided")).await,
        json!([
            null,
            true,
            "undecided (> 99.9 %)",
            true,
            "0.750 · 95 %: 0.625 to 0.875 · P(loss > 5 %) undecided (> 99.9 %)",
            "undecided",
            true
        ])
    );
    // Regression test: an alert that the newest data do not confirm looked like certain damage.
    assert_eq!(
        browser.evaluate(&shown("unconfirmed")).await,
        json!([
            null,
            false,
            "unconfirmed (> 99.9 %)",
            true,
            "0.750 · 95 %: 0.625 to 0.875 · P(loss > 5 %) unconfirmed (> 99.9 %)",
            "unconfirmed",
            true
        ])
    );
    browser.screenshot("undecided").await;
    let card = "(async () => {
        const { OverviewPage } = await import('/overview.js');
        const { structures } = await (await fetch('/api/structures')).json();
        const page = new OverviewPage({ listen() {}, on: () => () => {} });
        structures[0].worst.undecided = true;
        page.show({ structures });
        return page.element.querySelector('.fact-probability dd').textContent;
      })()";
    assert_eq!(
        browser.evaluate(card).await,
        "undecided (> 99.9 %) for more than 5 %"
    );
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
        return [...document.querySelectorAll('.drawing .inside')].every((text) => \
        floors.every((floor) => floor.compareDocumentPosition(text) & \
        Node.DOCUMENT_POSITION_FOLLOWING)); })()";
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
            const texts = [...document.querySelectorAll('.drawing text:not(.sign)')].filter((one) \
            => one.textContent).map((one) => one.getBoundingClientRect()); return \
            texts.some((one, index) => texts.slice(index + 1).some((other) => one.left < \
            other.right && other.left < one.right && one.top + 2 < other.bottom - 2 && other.top \
            + 2 < one.bottom - 2)); })()";
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
            "document.querySelector('table.sensors \
             tr[data-channel=floor-2]')?.children[{column}].textContent ?? ''"
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
            &format!(
                "/^[\\d.]+ × their motion, (in step|\\d+ ms (earlier|later))$/.test({})",
                cell(5)
            ),
        )
        .await;
    browser
        .wait(
            "the probability of a fault",
            &format!("/ %$/.test({})", cell(6)),
        )
        .await;
    browser.screenshot("sensors").await;
    // Regression test: the names of a sensor and a node pushed the other columns out of sight.
    let named = "(() => { const row = document.querySelector('#sensors tbody tr'); \
                 for (const column of [0, 2]) row.children[column].textContent = \
                 'accelerometer-in-the-cellar-of-the-northern-abutment'; \
                 const { scrollWidth, clientWidth } = row.closest('.scroll'); \
                 return scrollWidth <= clientWidth; })()";
    assert_eq!(browser.evaluate(named).await, true, "columns out of sight");
    browser
        .evaluate("document.getElementById('tab-events').click()")
        .await;
    browser
        .wait(
            "the alarm among the events",
            "[...document.querySelectorAll('table.events tr[data-level=alarm]')].some((one) => \
             one.textContent.includes('▲ alert raised'))",
        )
        .await;
    browser.screenshot("events").await;
    browser
        .evaluate("document.querySelector('table.events tr[data-level=alarm] a').click()")
        .await;
    browser
        .wait(
            "the moment of the alarm",
            "document.querySelector('#plot-parameter-storey-2.is-chosen canvas') && \
             location.hash.includes('from=')",
        )
        .await;
    browser
        .evaluate("document.getElementById('tab-settings').click()")
        .await;
    let settings = "document.getElementById('panel-settings').textContent";
    for text in [
        "100 Hz",
        "Half-life of the memory10 s",
        "Contactnone",
        "more than 5 %",
        "99 %",
        "learnt in 30 s",
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
            // As soon as the panel is shown, when its plots still have the width of the last
            // window.
            let width_when_shown = format!(
                "new Promise((done) => {{ \
                 const shown = () => done(document.documentElement.scrollWidth); \
                 const panel = document.getElementById('panel-{tab}'); \
                 new MutationObserver(shown).observe(panel, {{ attributeFilter: ['hidden'] }}); \
                 document.getElementById('tab-{tab}').click(); }})"
            );
            assert_eq!(browser.evaluate(&width_when_shown).await, width, "{tab}");
            browser.screenshot(&format!("{tab}-{width}")).await;
        }
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
