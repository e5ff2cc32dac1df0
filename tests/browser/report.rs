//! Reports of a period.

use super::{browser, demo};
use serde_json::json;

/// Regression test: a report of one of a hundred structures needed ninety-nine clicks.
#[tokio::test(flavor = "multi_thread")]
async fn the_structures_of_a_report_are_found_and_chosen_together() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser
        .wait(
            "an estimate",
            "document.querySelector('#panel-now .parameters tbody tr')",
        )
        .await;
    // The page receives thirty copies of the structure.
    let copies = "(async () => {
        const load = globalThis.fetch;
        const asked = (address) => /structures\\/(tower-\\d+)/.exec(address)?.[1];
        globalThis.fetch = async (address, ...more) => {
          const name = asked(address);
          const answer = await (await load(name ? address.replace(name, 'demo') : address, \
          ...more)).json();
          if (address === '/api/structures') answer.structures = Array.from({ length: 30 }, (_, \
          index) => ({ ...answer.structures[0], name: `tower-${index + 1}` }));
          if (name && answer.about) answer.about.name = answer.overview.name = name;
          return { ok: true, json: async () => answer };
        };
        location.hash = '#/report';
      })()";
    browser.evaluate(copies).await;
    browser
        .wait(
            "the report",
            "document.querySelector('.report[data-state=complete]')",
        )
        .await;
    let chosen =
        "[...document.querySelectorAll('.choices input:checked')].map(({ value }) => value)";
    let count = format!("{chosen}.length");
    assert_eq!(browser.evaluate(&count).await, 30);
    let press = |place: usize| {
        format!("document.querySelectorAll('.report-form .tools button')[{place}].click()")
    };
    browser.evaluate(&press(1)).await;
    assert_eq!(browser.evaluate(chosen).await, json!([]));
    browser
        .evaluate(
            "const search = document.querySelector('.report-form .search'); search.value = \
                   'tower-2'; search.dispatchEvent(new Event('input'))",
        )
        .await;
    let shown = "[...document.querySelectorAll('.choices label')].filter((one) => \
                 one.checkVisibility()).length";
    assert_eq!(browser.evaluate(shown).await, 11, "tower-2, tower-20 to 29");
    browser.evaluate(&press(0)).await;
    assert_eq!(browser.evaluate(&count).await, 11);
    // The search is in the address, also beside chosen structures and a period.
    let address = "location.hash";
    assert_eq!(
        browser.evaluate(address).await,
        "#/report?find=tower-2",
        "the address after a search"
    );
    let link = "location.hash = '#/report?structures=tower-1&span=60&find=tower-30'";
    browser.evaluate(link).await;
    browser
        .wait(
            "the search of the link",
            "document.querySelector('.report[data-state=complete]') && \
             document.querySelector('.report-form .search')?.value === 'tower-30'",
        )
        .await;
    assert_eq!(browser.evaluate(shown).await, 1);
    assert_eq!(browser.evaluate(chosen).await, json!(["tower-1"]));
    let cleared = "(() => { const field = document.querySelector('.report-form .search'); \
                   field.value = ''; field.dispatchEvent(new Event('input')); })()";
    browser.evaluate(cleared).await;
    assert_eq!(
        browser.evaluate(address).await,
        "#/report?structures=tower-1&span=60"
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_report_contains_everything_about_a_period_and_prints() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser.prefer("dark").await;
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser
        .wait(
            "the end of the demo",
            "document.body.innerText.includes('record has ended')",
        )
        .await;
    // The last event is later than the last sample.
    browser
        .wait(
            "a later event",
            "document.querySelector('.facts-line').textContent.includes('monitoring: blind')",
        )
        .await;
    let happened = "fetch('/api/structures/demo').then((reply) => reply.json()).then(({ overview, \
                    standing }) => [standing.events[0].time_ns / 1e9 > overview.time_s, \
                    standing.events.length])";
    let happened = browser.evaluate(happened).await;
    assert_eq!(happened[0], true);
    browser
        .evaluate("document.getElementById('nav-report').click()")
        .await;
    let complete = "document.querySelector('.report[data-state=complete]')";
    browser.wait("the report", complete).await;
    browser.screenshot("report-dark").await;
    browser.prefer("light").await;
    browser.screenshot("report-light").await;

    // All plots are there, although most are outside the window.
    let lines = "[...document.querySelectorAll('.charts figure')].map((one) => \
                 [one.querySelector('figcaption').firstChild.textContent, \
                 one.querySelector('.line').getAttribute('d').split('L').length > 100])";
    let names = [
        "storey-1", "storey-2", "storey-3", "storey-4", "storey-5", "damping",
    ];
    assert_eq!(
        browser.evaluate(lines).await,
        json!(names.map(|name| json!([name, true])))
    );
    let rows = |table: &str| {
        format!(
            "[...document.querySelectorAll('.report-part [aria-label={table:?}] tbody \
             tr')].map((row) => [...row.children].map((cell) => cell.textContent))"
        )
    };
    // The estimates at the end are those of the history.
    let parameters = browser
        .evaluate(&rows("Parameters at the end of the period"))
        .await;
    let last = "fetch('/api/structures/demo/history?series=parameter/storey-2&points=20000').then((reply) => reply.json()).then(({ series }) => series[0].data.slice(1).map((column) => column.at(-1)))";
    let last = browser.evaluate(last).await;
    let (mean, std) = (last[0].as_f64().unwrap(), last[1].as_f64().unwrap());
    let storey = &parameters[1];
    assert_eq!(storey[0], "storey-2");
    assert_eq!(storey[1], "▲ raised");
    assert_eq!(storey[2], format!("{mean:.3} ± {std:.3}"));
    assert_eq!(parameters[5][1], "– no alert rule");
    let alerts = browser.evaluate(&rows("No alert.")).await;
    let raised = alerts.as_array().unwrap().last().unwrap();
    assert_eq!(raised[1], "storey-2");
    let words = raised[2].as_str().unwrap();
    assert!(words.starts_with("▲ raised storey-2 has lost 1"), "{words}");
    let sensors = browser.evaluate(&rows("Sensors")).await;
    assert_eq!(sensors.as_array().unwrap().len(), 6);
    let events = browser.evaluate(&rows("No events.")).await;
    let events = events.as_array().unwrap();
    // Regression: the report ended with the last sample, and lacked what happened then.
    assert!(events.len() as u64 >= happened[1].as_u64().unwrap());
    // Regression: changes of the monitoring were about "watching".
    let of_monitoring = "The monitoring changed from blind to watching";
    let changed = events
        .iter()
        .find(|event| event[2].as_str().unwrap().starts_with(of_monitoring));
    assert_eq!(changed.expect(of_monitoring)[1], "Monitoring");
    // Regression: the words of the threshold covered the estimates, which are above it.
    let below = "[...document.querySelectorAll('.bound-text')].map((words) => words.getBBox().y \
                 >= Number(words.previousSibling.getAttribute('y1')))";
    assert_eq!(browser.evaluate(below).await, json!(vec![true; 5]));

    // Regression: the last time was cut off at the edge of the paper.
    let beyond = "import('/chart.js').then(({ chart }) => {
        const [from_s, to_s] = [1599955200 - 2 * 86400, 1599955200];
        const columns = [[from_s, to_s], [1, 1], [0, 0]];
        const drawn = chart({ columns, from_s, to_s, range: [0, 2], label: '' });
        drawn.style.width = '360px';
        document.body.append(drawn);
        const right = (one) => one.getBoundingClientRect().right;
        const ends = [...drawn.querySelectorAll('.time')].map(right);
        const most = Math.max(...ends) - right(drawn);
        drawn.remove();
        return [ends.length >= 5, most <= 2];
      })";
    assert_eq!(browser.evaluate(beyond).await, json!([true, true]));

    // Regression test: long names of parts and sensors made the report wider than its sheet.
    let named = "(() => { for (const cell of ['is-parameters tbody th', 'is-events td:nth-child(2)', \
                 'is-sensors tbody th', 'is-sensors td:nth-child(3)']) \
                 document.querySelector(`.${cell}`).textContent = 'n'.repeat(60); \
                 return document.documentElement.scrollWidth <= innerWidth; })()";
    assert_eq!(browser.evaluate(named).await, true, "wider than the window");

    // In print, the form and the bar are hidden, and colours are those of paper.
    let print = json!({"media": "print"});
    browser.call("Emulation.setEmulatedMedia", print).await;
    let hidden = "['.bar', '.report-form'].map((one) => \
                  getComputedStyle(document.querySelector(one)).display)";
    assert_eq!(browser.evaluate(hidden).await, json!(["none", "none"]));
    let empty = "[...document.querySelectorAll('.chart')].filter((one) => \
                 one.getBoundingClientRect().height < 50).length";
    assert_eq!(browser.evaluate(empty).await, 0);
    let pdf = json!({"preferCSSPageSize": true});
    let pdf = browser.call("Page.printToPDF", pdf).await;
    assert!(
        pdf["data"].as_str().unwrap().starts_with("JVBERi0"),
        "no PDF"
    );
    browser
        .call("Emulation.setEmulatedMedia", json!({"media": ""}))
        .await;

    // An event selects the time around it, and the address keeps it.
    let choose = "(() => { const select = document.getElementById('report-event'); \
        const raised = [...select.options].find((one) => one.textContent.includes('storey-2 ▲ \
        raised')); select.value = raised.value; select.dispatchEvent(new Event('change')); return \
        Number(raised.value); })()";
    let at = browser.evaluate(choose).await.as_f64().unwrap();
    let hash = format!(
        "#/report?structures=demo&from={:.3}&to={:.3}",
        at - 60.0,
        at + 60.0
    );
    browser
        .wait("the address", &format!("location.hash === '{hash}'"))
        .await;
    let period =
        "document.querySelector('.report[data-state=complete] .period')?.textContent ?? ''";
    browser
        .wait("the period", &format!("{period}.endsWith('(2 min)')"))
        .await;
    browser.reload().await;
    browser
        .wait("the same period", &format!("{period}.endsWith('(2 min)')"))
        .await;
    browser.resize(390, 844).await;
    let width = "document.documentElement.scrollWidth";
    assert_eq!(browser.evaluate(width).await, 390);
    browser.screenshot("report-phone").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the report and the list of events knew only the newest events, and said of an
/// earlier period that there were none.
#[tokio::test(flavor = "multi_thread")]
async fn events_of_an_earlier_period_are_those_of_the_history() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    let period = "from=1600000000.000&to=1600086400.000";
    let list = format!("{}#/structure/demo/events?{period}", demo.page);
    browser.resize(1280, 900).await;
    browser.open(&list).await;
    let told = "document.querySelector('#panel-events').innerText";
    // No history service runs for the demo.
    browser
        .wait(
            "that no history was read",
            &format!(
                "{told}.includes('were not read') && {told}.includes('No history service runs')"
            ),
        )
        .await;
    assert_eq!(
        browser
            .evaluate(&format!("{told}.includes('No events.')"))
            .await,
        false
    );
    // The page receives the log of a history with 500 events in the period.
    let log = "(() => {
        const load = globalThis.fetch;
        const event = (index) => ({ time_ns: (1.6e9 + 100 * index) * 1e9, kind: 'restart', subject: \
        'identify', what: 'restarted', why: `number ${index}` });
        const log = { history: 'read', cut_at_s: null, changes: [], events: Array.from({ length: \
        500 }, (_, index) => event(500 - index)) };
        globalThis.fetch = async (address, ...more) => (/\\/log\\?/.test(address) ? { ok: true, \
        json: async () => structuredClone(log) } : load(address, ...more));
        location.hash = '#/structure/demo';
        location.hash = '#/structure/demo/events?PERIOD';
      })()";
    browser.evaluate(&log.replace("PERIOD", period)).await;
    let rows = "document.querySelectorAll('.events tbody tr').length";
    browser
        .wait("the newest 200 events", &format!("{rows} === 200"))
        .await;
    browser
        .wait(
            "the number of the others",
            &format!("{told}.includes('Show 200 more of 300')"),
        )
        .await;
    let more = "[...document.querySelectorAll('#panel-events button')].find((one) => \
                one.textContent.startsWith('Show 200 more')).click()";
    browser.evaluate(more).await;
    assert_eq!(browser.evaluate(rows).await, 400);
    let report = format!("location.hash = '#/report?structures=demo&{period}'");
    browser.evaluate(&report).await;
    browser
        .wait(
            "the report",
            "document.querySelector('.report[data-state=complete]')",
        )
        .await;
    let listed = "[...document.querySelectorAll('.report-table.is-events')].map((table) => \
                  [table.querySelectorAll('tbody tr').length, \
                  table.nextElementSibling.textContent])";
    assert_eq!(
        browser.evaluate(listed).await,
        json!([[300, "200 earlier ones of the period are not shown."]])
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
