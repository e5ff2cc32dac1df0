//! What the page tells at a glance: the summary, the list after an earthquake, and the lists of
//! alerts and events. Another test checks that nothing is cut off on a phone.

use super::{Browser, browser, demo};
use serde_json::{Value, json};

/// Shows structures on an overview without a server: `level` and `earthquake` of each by its name.
const OVERVIEW: &str = "(async () => {
    const { OverviewPage } = await import('/overview.js');
    const page = new OverviewPage({ listen() {}, on: () => () => {} });
    const common = { description: '', sentence: 'why', has_model: true, is_filtered: true, age_s: \
    0, sensors: { alive: 1, total: 1, troubled: [] } };
    page.show({ structures: STRUCTURES.map((structure) => ({ ...common, ...structure })) });
    document.getElementById('main').replaceChildren(page.element);
    const [summary, reported] = ['.summary', '.reported'].map((name) => \
    page.element.querySelector(name));
    return {
      summary: summary.textContent,
      reported: [...reported.children].map((one) => [...one.querySelectorAll('.badge, a, \
      p:not([hidden])')].map(({ textContent }) => textContent)),
      links: [...reported.querySelectorAll('a')].map((link) => link.getAttribute('href')),
    };
  })()";

async fn overview(browser: &mut Browser, structures: &Value) -> Value {
    let script = OVERVIEW.replace("STRUCTURES", &structures.to_string());
    browser.evaluate(&script).await
}

fn report(urgency: &str, at_s: f64, later: Option<&Value>) -> Value {
    json!({"report": format!("at-{at_s}"), "time_s": 1.6e9 + at_s, "urgency": urgency, "result": "It shook.", "later": later})
}

/// Regression test: the urgency was plain English text. The report of a weak aftershock replaced
/// the one that asks for an inspector.
#[tokio::test(flavor = "multi_thread")]
async fn the_list_after_an_earthquake_begins_with_the_most_urgent_structure() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let later = report("no action", 60.0, None);
    let structures = json!([
        {"name": "school", "level": "normal", "earthquake": report("no action", 0.0, None)},
        {"name": "tower", "level": "normal", "earthquake": null},
        {"name": "bridge", "level": "normal", "earthquake": report("inspect", 0.0, Some(&later))},
        {"name": "dam", "level": "normal", "earthquake": report("inspect first", 0.0, None)},
    ]);
    let shown = overview(&mut browser, &structures).await;
    let expected = json!([
        ["▲ inspect first", "dam", "It shook."],
        [
            "◆ inspect",
            "bridge",
            "It shook.",
            "Latest report (2020-09-13 12:27:40 UTC): no action. It shook.",
            "Latest report"
        ],
        ["✓ no action", "school", "It shook."],
    ]);
    assert_eq!(shown["reported"], expected);
    assert_eq!(
        shown["summary"],
        "▲ 4 structures watched, no alert; an inspector is needed after the earthquake: dam, \
         bridge."
    );
    assert_eq!(
        shown["links"],
        json!([
            "/events/dam/at-0.html",
            "/events/bridge/at-0.html",
            "/events/bridge/at-60.html",
            "/events/school/at-0.html"
        ])
    );

    // The words of the urgency are in the language of the page.
    browser
        .evaluate("localStorage.setItem('spandrel-language', 'de')")
        .await;
    browser.reload().await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let shown = overview(&mut browser, &structures).await;
    assert_eq!(shown["reported"][0][0], "▲ zuerst prüfen", "{shown}");
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the summary said that nothing needs attention while no part had been judged,
/// and that a softening part was acknowledged. It named every one of many structures.
#[tokio::test(flavor = "multi_thread")]
async fn the_summary_says_what_is_undecided_and_counts_many_structures() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    for (levels, expected) in [
        (
            vec!["learning", "normal"],
            "… 2 structures watched, no alert; no decision yet on: s0.",
        ),
        (
            vec!["notice", "normal"],
            "● 2 structures watched, no new alarm; notices on: s0.",
        ),
        (
            vec!["normal", "normal"],
            "✓ 2 structures watched, nothing needs attention.",
        ),
        (
            vec!["stale"; 3],
            "✕ 3 of 3 structures need attention: s0, s1, s2.",
        ),
        (
            [vec!["alarm"; 2], vec!["stale"; 10]].concat(),
            "▲ 12 of 12 structures need attention: ▲ Alarm 2, ✕ No data 10.",
        ),
    ] {
        let structures: Vec<Value> = levels
            .iter()
            .enumerate()
            .map(|(index, level)| json!({"name": format!("s{index}"), "level": level}))
            .collect();
        let shown = overview(&mut browser, &json!(structures)).await;
        assert_eq!(shown["summary"], expected);
    }
    // A card names four sensors at most.
    let sensors = json!({"alive": 1, "total": 7, "troubled": ["a", "b", "c", "d", "e", "f"]});
    let many = json!([{"name": "s", "level": "warning", "sensors": sensors}]);
    overview(&mut browser, &many).await;
    let card = "document.querySelector('.structure-card').textContent.includes('check: a, b, c, \
                d; and 2 more')";
    assert_eq!(browser.evaluate(card).await, true);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the report of an earthquake was named by its file, and its sentence ended with
/// an address.
#[tokio::test(flavor = "multi_thread")]
async fn events_of_an_earthquake_have_a_name_a_level_and_a_button() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let script = "(async () => {
        const { EventsTab } = await import('/events.js');
        const tab = new EventsTab({ name: 'demo', about: { earthquakes: true, parameters: [] } });
        const path = '/events/demo/quake.html';
        const event = (second, kind, what, why) => ({ time_ns: 1.6e18 + second * 1e9, kind, \
        subject: 'quake', what, why });
        tab.update({ changes: [], events: [
          event(2, 'earthquake-report', 'earthquake report: inspect first', `It shook. ${path}`),
          event(1, 'earthquake', 'earthquake begins', `a report follows: ${path}`),
          event(0, 'note', 'something else', 'see the manual'),
          event(-1, 'monitoring', 'the monitoring changed from blind to watching', 'all is seen'),
        ] });
        return [...tab.rows.children].map((row) => [row.dataset.level, \
        row.children[1].textContent, row.querySelector('.why').textContent, \
        [...row.querySelectorAll('.button')].map((button) => \
        button.getAttribute('href').split('?')[0])]);
      })()";
    let shown = browser.evaluate(script).await;
    let place = "#/structure/demo";
    let links = |list: &Value| {
        list.as_array()
            .unwrap()
            .iter()
            .map(|link| link.as_str().unwrap().starts_with(place))
            .collect::<Vec<_>>()
    };
    let words = |row: usize| json!(shown[row].as_array().unwrap()[..3]);
    assert_eq!(words(0), json!(["alarm", "earthquake", "It shook."]));
    assert_eq!(shown[0][3][0], "/events/demo/quake.html");
    assert_eq!(links(&shown[0][3]), [false, true]);
    assert_eq!(
        words(1),
        json!(["learning", "earthquake", "A report follows"])
    );
    assert_eq!(words(2), json!(["learning", "quake", "See the manual"]));
    assert_eq!(words(3), json!(["learning", "Monitoring", "All is seen"]));
}

/// Regression test: normal parts filled the page of alerts. A filter still shows them.
#[tokio::test(flavor = "multi_thread")]
async fn parts_without_an_alert_are_folded_away() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&format!("{}#/alerts", demo.page)).await;
    browser
        .wait(
            "an alarm and four normal parts",
            "document.querySelector('.alerts-page > .alerts > [data-state=raised]') && \
             document.querySelectorAll('details.routine [data-state=normal]').length >= 4",
        )
        .await;
    let seen = "[...document.querySelectorAll('.alerts:not(.past) .alert')].filter((one) => \
                one.checkVisibility()).map((one) => one.dataset.state)";
    assert_eq!(browser.evaluate(seen).await, json!(["raised"]));
    let choose = "(() => {
        const state = document.getElementById('filter-state');
        state.value = 'normal';
        state.dispatchEvent(new Event('change'));
      })()";
    browser.evaluate(choose).await;
    assert_eq!(browser.evaluate(seen).await, json!(vec!["normal"; 4]));
    // Regression test: a reload forgot the filters.
    assert_eq!(
        browser.evaluate("location.hash").await,
        "#/alerts?state=normal"
    );
    browser.reload().await;
    browser
        .wait(
            "the same filter after a reload",
            &format!("{seen}.join() === 'normal,normal,normal,normal'"),
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: `-1.2e-4` was shown, and `−0.00 %`.
#[tokio::test(flavor = "multi_thread")]
async fn numbers_have_a_minus_sign_and_a_power_of_ten() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let script = "(async () => {
        const { comparedMeans, count, levelWords, number, withMinus } = await import('/words.js');
        const level = { mean: -4.53e-4, rms: 0.0505, peak: 0.2, last: 0.1, rate_hz: 100, last_s: 0 };
        const change = { difference: -1e-6, low: -1e-3, high: 1e-3 };
        return [number(-1.25e-4), number(3e6), number(-0.5), count(1234567), \
        comparedMeans(change, { mean: 1 }).difference, withMinus('storey-2 on 2026-11-26: -4.6 to \
        5.8 %, (-1)'), levelWords(level, 'm/s2')[1]];
      })()";
    assert_eq!(
        browser.evaluate(script).await,
        json!([
            "−1.25·10⁻⁴",
            "3.00·10⁶",
            "−0.5",
            "1\u{202f}234\u{202f}567",
            "0.00 %",
            "storey-2 on 2026-11-26: −4.6 to 5.8 %, (−1)",
            "−0.0005 m/s²"
        ])
    );
}

/// Regression test: where a busy service published every tenth value, a curve had gaps.
#[tokio::test(flavor = "multi_thread")]
async fn a_curve_has_a_gap_only_where_more_than_every_tenth_value_is_missing() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    let script = "(async () => {
        const { pieces } = await import('/chart.js');
        const regular = Array.from({ length: 50 }, (_, index) => index / 10);
        const busy = [1, 2, 3].map((index) => 4.9 + index);
        const late = [14.9, 15];
        const lengths = (times) => pieces(times, times).map((rows) => rows.length);
        return [lengths([...regular, ...busy]), lengths([...regular, ...busy, ...late])];
      })()";
    assert_eq!(browser.evaluate(script).await, json!([[53], [53, 2]]));
}

/// Regression test: on a phone, a time covered the next fact, tables were cut off, and the bar had
/// a second row with a single dot. German words are the longest.
#[tokio::test(flavor = "multi_thread")]
async fn a_phone_cuts_nothing_off_in_german() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(390, 844).await;
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    browser
        .evaluate("localStorage.setItem('spandrel-language', 'de')")
        .await;
    browser.reload().await;
    browser
        .wait(
            "the end of the demo in German",
            "document.querySelector('.structure-card[data-level=alarm]') && \
             document.body.innerText.includes('Aufzeichnung beendet')",
        )
        .await;
    // Names and words are longer than their cells only if they are cut off or cover others.
    let cut = "[...document.querySelectorAll('.fact dd, .fact dt, .scroll, .plot-head, td, \
               th')].filter((one) => one.checkVisibility() && one.scrollWidth > one.clientWidth + \
               1 && getComputedStyle(one).display !== 'inline').map((one) => `${one.className} \
               ${one.textContent.slice(0, 60)}`)";
    for tab in [
        "",
        "structure/demo",
        "structure/demo/compare",
        "structure/demo/sensors",
        "structure/demo/events",
        "structure/demo/settings",
        "report",
    ] {
        browser
            .evaluate(&format!("location.hash = '#/{tab}'"))
            .await;
        browser
            .wait(
                tab,
                "document.querySelector('.fact dd, .attention .sentence, .report-state \
                 .sentence')?.textContent && \
                 [...document.querySelectorAll('table')].every((table) => \
                 !table.checkVisibility() || table.querySelector('tbody tr'))",
            )
            .await;
        assert_eq!(browser.evaluate(cut).await, json!([]), "{tab}");
        let size = "[document.querySelector('.bar').offsetHeight < 56, \
                    document.documentElement.scrollWidth]";
        assert_eq!(browser.evaluate(size).await, json!([true, 390]), "{tab}");
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: tables had the order of the alphabet here, and that of the structure file
/// there.
#[tokio::test(flavor = "multi_thread")]
async fn parameters_and_sensors_have_the_order_of_the_structure_file() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    let heads = |scope: &str| {
        format!("[...document.querySelectorAll('{scope}')].map((one) => one.textContent)")
    };
    let sensors = json!([
        "ground", "floor-1", "floor-2", "floor-3", "floor-4", "floor-5"
    ]);
    let parameters = json!([
        "storey-1", "storey-2", "storey-3", "storey-4", "storey-5", "damping"
    ]);
    for (hash, scope, expected) in [
        ("structure/demo/sensors", "#sensors tbody th", &sensors),
        ("structure/demo/sensors", "#levels tbody th", &sensors),
        ("structure/demo/sensors", "#group-waveforms h3", &sensors),
        (
            "structure/demo/compare",
            ".differences tbody th",
            &parameters,
        ),
        (
            "report",
            ".report-table.is-parameters tbody th",
            &parameters,
        ),
        ("report", ".report-table.is-sensors tbody th", &sensors),
    ] {
        browser.open(&format!("{}#/{hash}", demo.page)).await;
        let found = heads(scope);
        browser.wait(scope, &format!("{found}.length >= 6")).await;
        assert_eq!(&browser.evaluate(&found).await, expected, "{scope}");
    }
}
