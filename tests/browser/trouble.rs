//! Trouble is first on the page and is not hidden: beside an alarm, among many parts and sensors, and
//! among repeated changes.

use super::{browser, demo};
use serde_json::json;

/// Regression test: an alarm hid a sensor that is not used and the age of the estimates, and the map was
/// above the card.
#[tokio::test(flavor = "multi_thread")]
async fn a_card_with_an_alarm_tells_what_else_is_wrong_and_how_late_the_estimates_are() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let card = "(async () => {
        const { OverviewPage } = await import('/overview.js');
        const page = new OverviewPage({ listen() {}, on: () => () => {} });
        const tower = { name: 'tower', description: 'steel', place: 'Bern', sentence: 'storey-2 is raised', also: 'floor-3 is silent', level: 'alarm', has_model: true, is_filtered: true, age_s: 0, lag_s: 100, sensors: { alive: 1, total: 2, troubled: ['floor-3'] } };
        const shown = () => ['.description', '.also', '.now', '.fact-age dd'].map((name) => { const one = page.element.querySelector(name); return one.hidden ? null : one.textContent; });
        page.show({ structures: [tower] });
        document.getElementById('main').replaceChildren(page.element);
        const first = shown();
        page.show({ structures: [{ ...tower, now: 'loss 10 %' }] });
        const facts = page.element.querySelector('.facts');
        const { top } = facts.getBoundingClientRect();
        page.show({ structures: [tower] });
        const isStill = facts.getBoundingClientRect().top === top;
        page.show({ structures: [{ ...tower, level: 'normal', also: '', lag_s: 1 }] });
        const order = [...page.element.children].map(({ className }) => className);
        return [first, isStill, shown(), order.indexOf('structures') < order.indexOf('card map')];
      })()";
    assert_eq!(
        browser.evaluate(card).await,
        json!([
            ["steel · Bern", "floor-3 is silent", null, "100 s behind"],
            true,
            ["steel · Bern", null, null, "new"],
            true
        ])
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the changes of one part whose alert flickered filled the page of alerts, and a sensor
/// that failed was hidden among the undecided alerts of all parts.
#[tokio::test(flavor = "multi_thread")]
async fn repeated_changes_of_a_part_and_equal_reasons_share_one_entry() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let alerts = "(async () => {
        const { AlertsPage } = await import('/alerts.js');
        const [original, change] = [window.fetch, (second, parameter, state) => ({ structure: 'tower', parameter, state, time_ns: 1.6e18 + second * 1e9, changed_ns: 1.6e18 + second * 1e9, acknowledged_ns: null, since_ns: null, revision: 0, why: `${parameter} is ${state}` })];
        const changes = [change(3, 'storey-2', 'raised'), change(2, 'storey-2', 'unconfirmed'), change(1, 'storey-1', 'raised'), change(0, 'storey-2', 'raised')];
        window.fetch = async () => ({ ok: true, json: async () => ({ standing: [], changes }) });
        const page = new AlertsPage({ listen() {} }, new URLSearchParams());
        document.getElementById('main').replaceChildren(page.element);
        await new Promise((done) => setTimeout(done));
        page.close();
        window.fetch = original;
        const cards = [...page.element.querySelectorAll('.alerts-page > .past > .alert')];
        return cards.map((card) => [card.querySelector('.who').textContent, card.querySelectorAll('details .alert').length, card.querySelector('summary').checkVisibility() ? card.querySelector('summary').textContent : null]);
      })()";
    assert_eq!(
        browser.evaluate(alerts).await,
        json!([
            [
                "tower / storey-2",
                2,
                "raised 2020-09-13 12:26:40 UTC, changed 2 times"
            ],
            ["tower / storey-1", 0, null]
        ])
    );
    let events = "(async () => {
        const { EventsTab } = await import('/events.js');
        const tab = new EventsTab({ name: 'tower', about: { earthquakes: false, parameters: [] } });
        const change = (ms, parameter) => ({ parameter, state: 'undecided', time_ns: 1.6e18 + ms * 1e6, changed_ns: 1.6e18 + ms * 1e6, acknowledged_ns: null, why: `${parameter} is undecided: no samples` });
        const unreported = { time_ns: 1.6e18, kind: 'earthquake-unreported', subject: '2026-11-28t00-30-06z', what: 'a report waits', why: 'no space' };
        tab.update({ changes: [change(1500, 'storey-1'), change(400, 'storey-10'), change(300, 'storey-2')], events: [unreported] });
        const of = [...tab.rows.children].map((row) => row.children[1].textContent);
        // Regression: a revision moved the time of an alert, an acknowledgement had the time of the data, and
        // an alert without a decision was called normal.
        const alert = { parameter: 'storey-2', changed_ns: 1.6e18, time_ns: 1.6e18, acknowledged_ns: null, why: 'storey-2' };
        const seen = { state: 'acknowledged', acknowledged_by: 'Ada', acknowledged_ns: 1.6e18 + 960e9, note: 'on my way', why: 'storey-2; acknowledged by Ada: on my way' };
        tab.update({ changes: [{ ...alert, ...seen }, { ...alert, state: 'normal' }, { ...alert, state: 'raised', time_ns: 1.6e18 + 200e9 }], events: [] });
        const cells = [...tab.rows.children].map(({ children: [time, , what] }) => [time.textContent, what.querySelector('strong').textContent, what.lastElementChild.hidden ? '' : what.lastElementChild.textContent]);
        const link = tab.rows.firstElementChild.querySelector('a.button').hash.split('at=')[1];
        // Regression: a lasting loss and its acknowledgement were also listed as events.
        const day = 86400e9;
        const loss = { kind: 'lasting-loss', parameter: 'storey-2', state: 'raised', changed_ns: 18000 * day, time_ns: 18000 * day, found_ns: 18000 * day, acknowledged_by: null, acknowledged_ns: null, note: null, why: 'storey-2 has lost 5.0 % of stiffness.' };
        const noted = { state: 'acknowledged', changed_ns: 18002 * day, time_ns: 18002 * day, acknowledged_by: 'Ada', acknowledged_ns: 18002 * day, note: 'crack' };
        const event = (of, kind, what, why) => ({ time_ns: of * day + 1e9, kind, subject: 'storey-2', what, why });
        const told = [event(18001, 'lasting-change', 'lasting-loss', `${loss.why} Configuration a.`), event(18002, 'annotation', 'inspection: acknowledged', 'Ada: crack')];
        const others = [event(18001, 'lasting-change', 'stiffer', 'storey-2 has gained'), event(18003, 'annotation', 'inspection', 'Ada: crack')];
        tab.update({ changes: [{ ...loss, ...noted }, loss], events: [...told, ...others] });
        const once = [...tab.rows.children].map((row) => row.querySelector('strong').textContent);
        return [of, cells, link, once];
      })()";
    assert_eq!(
        browser.evaluate(events).await,
        json!([
            ["storey-1", "storey-2, storey-10", "earthquake"],
            [
                ["2020-09-13 12:42:40 UTC", "● alert acknowledged", ""],
                ["2020-09-13 12:26:40 UTC", "✓ back to normal", ""],
                [
                    "2020-09-13 12:26:40 UTC",
                    "▲ alert raised",
                    "Figures as of 2020-09-13 12:30:00 UTC"
                ]
            ],
            "1600000000.000",
            [
                "Inspection",
                "● alert acknowledged (lasting loss)",
                "Stiffer",
                "▲ alert raised (lasting loss)"
            ]
        ])
    );
}

/// Regression test: a part with an alarm and a silent sensor were far down in their tables, and columns
/// without any value took the room of the others.
#[tokio::test(flavor = "multi_thread")]
async fn parts_and_sensors_with_trouble_are_first_and_empty_columns_are_hidden() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser
        .open(&format!("{}#/structure/demo", demo.page))
        .await;
    browser
        .wait(
            "an alarm",
            "document.querySelector('.attention').dataset.level === 'alarm'",
        )
        .await;
    let shown = "(async () => {
        const [{ NowTab }, { SensorsTab }, { noisePlot }, { Points, Scale, Span }] = await Promise.all(['/now.js', '/sensors.js', '/plots.js', '/span.js'].map((file) => import(file)));
        const { about, standing } = await (await fetch('/api/structures/demo')).json();
        const span = new Span();
        const page = { name: 'demo', about, span, points: new Points('demo', span), scale: new Scale(), standing: () => standing, choose() {} };
        standing.sensors.find(({ channel }) => channel === 'floor-4').health = 'silent';
        standing.sensors.forEach((sensor) => { sensor.clock = null; sensor.compared = null; });
        // Regression: a silent sensor was on time, and the excitation seemed to be unused.
        standing.sensors.find(({ channel }) => channel === 'ground').health = 'alive';
        standing.services = [{ service: 'ingest', status: {} }];
        const heard = new SensorsTab(page);
        heard.update(standing);
        const cellsOf = (channel) => [4, 7, 8].map((column) => heard.rows.querySelector(`[data-channel=${channel}]`).children[column].textContent);
        const [silent, excitation] = ['floor-4', 'ground'].map(cellsOf);
        // Regression: a part with a less probable loss was before a certain one.
        const loss = (name, probability_of_loss, loss) => (standing.losses[name] = { ...standing.losses['storey-2'], probability_of_loss, loss });
        const raised = standing.alerts.find(({ state }) => state === 'raised');
        standing.alerts = ['storey-2', 'storey-3', 'storey-4'].map((parameter) => ({ ...raised, parameter }));
        loss('storey-2', 0.91, 0.3), loss('storey-3', 0.99999, 0.1), loss('storey-4', 0.9999, 0.2);
        standing.services = [];
        const [now, sensors] = [new NowTab(page), new SensorsTab(page)];
        for (const tab of [now, sensors]) tab.update(standing);
        const noise = noisePlot({ name: 'sensors', unit: 'm/s2' }, page.points, span).plot;
        const [, mean, , , low] = noise.rows(new Map([['noise/sensors', [[0], [0.04], [0.1]]]]));
        return [
          [...now.rows.children].slice(0, 3).map((row) => row.firstElementChild.textContent),
          [silent.slice(1), excitation],
          sensors.rows.firstElementChild.firstElementChild.textContent,
          sensors.sorting.heads.filter(({ hidden }) => hidden).length > 0,
          sensors.sorting.heads.filter(({ hidden }) => hidden).every((head) => head !== sensors.sorting.heads[0]),
          now.element.querySelector('thead').textContent.includes('P(loss > 5 %)'),
          noise.unit, mean[0], low[0],
        ];
      })()";
    assert_eq!(
        browser.evaluate(shown).await,
        json!([
            ["storey-4", "storey-3", "storey-2"],
            [["–", "–"], ["used as excitation", "✓ on time", "✓ agrees"]],
            "floor-4",
            true,
            true,
            true,
            "standard deviation (m/s²)",
            0.2,
            0
        ])
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
