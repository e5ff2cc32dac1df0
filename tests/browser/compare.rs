//! The tab that compares two time ranges.

use super::{browser, demo, example};
use serde_json::{Value, json};

/// Waits for the end of a demo.
const ENDED: &str = "document.body.innerText.includes('record has ended')";

/// Returns the cells of a quantity in the table of the differences.
fn cells(name: &str) -> String {
    format!(
        "[...([...document.querySelectorAll('.differences tbody tr')].find((row) => \
         row.children[0].textContent === '{name}')?.children ?? [])].slice(1).map((cell) => \
         cell.textContent)"
    )
}

/// Mean, and mean standard deviation, of a parameter from the reply of the history.
fn mean_of(reply: &Value) -> (f64, f64) {
    let data = reply["series"][0]["data"].as_array().unwrap();
    let mean = |column: usize| {
        let values = data[column].as_array().unwrap();
        values
            .iter()
            .map(|value| value.as_f64().unwrap())
            .sum::<f64>()
            / values.len() as f64
    };
    (mean(1), mean(2))
}

/// Storey 2 of the demo loses 15 % of its stiffness after a minute.
#[tokio::test(flavor = "multi_thread")]
async fn two_ranges_are_compared_in_words_and_in_the_address() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 1400).await;
    browser.prefer("light").await;
    browser
        .open(&format!("{}#/structure/demo/compare", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    // Without ranges in the address, usual ones are compared.
    browser
        .wait("a comparison", "location.hash.includes('first=')")
        .await;
    let end = "fetch('/api/structures').then((reply) => reply.json()).then(({ structures }) => \
               structures[0].time_s)";
    let end = browser.evaluate(end).await.as_f64().unwrap();
    let ranges = [(end - 85.0, end - 65.0), (end - 30.0, end)];
    let text = ranges.map(|(from, to)| format!("{from:.3}..{to:.3}"));
    let hash = format!(
        "#/structure/demo/compare?first={}&second={}",
        text[0], text[1]
    );
    browser.evaluate(&format!("location.hash = '{hash}'")).await;
    let sentence = "document.querySelector('#panel-compare .sentence').textContent";
    browser
        .wait(
            "the loss in words",
            &format!(
                "/^◆ storey-2 is 1[3-7]\\.\\d % lower in the second range \\(95 % interval \
                 1[3-7]\\.\\d to 1[3-7]\\.\\d % lower\\)/.test({sentence})"
            ),
        )
        .await;

    // The numbers are those of the history.
    let mut means = Vec::new();
    for (from, to) in ranges {
        let query = format!(
            "fetch('/api/structures/demo/history?series=parameter/storey-2&points=1000&from={from:.3}&to={to:.3}').then((reply) => reply.json())"
        );
        means.push(mean_of(&browser.evaluate(&query).await));
    }
    let [(first, first_std), (second, second_std)] = means[..] else {
        panic!("two ranges");
    };
    let half = 1.96 * first_std.hypot(second_std);
    let share = |value: f64| format!("−{:.2}", 100.0 * value.abs() / first);
    let difference = second - first;
    let expected = json!([
        format!("{first:.3}"),
        format!("{second:.3}"),
        format!("{} %", share(difference)),
        format!(
            "{} to {} %",
            share(difference - half),
            share(difference + half)
        ),
        "◆ lower in the second range",
    ]);
    assert_eq!(browser.evaluate(&cells("storey-2")).await, expected);
    let damping = browser.evaluate(&cells("damping")).await;
    assert_eq!(damping[4], "✓ no difference shown", "{damping}");

    // Both ranges are drawn over each other, by the time since their start.
    let readout = "document.querySelector('#plot-compare-parameter-storey-2 .readout').textContent";
    browser
        .wait(
            "a plot of both",
            &format!(
                "document.querySelector('#plot-compare-parameter-storey-2 canvas') && \
                 /^0:00:\\d\\d · first \\S+ · second 0\\.8\\d\\d$/.test({readout})"
            ),
        )
        .await;
    browser
        .evaluate("document.querySelector('#plot-compare-parameter-storey-2 .plot-holder').focus()")
        .await;
    browser.press("ArrowRight").await;
    browser
        .wait(
            "the start of both",
            &format!("/^0:00:00 · first (0\\.9|1\\.0)\\d+ · second 0\\.8\\d+$/.test({readout})"),
        )
        .await;
    for scheme in ["light", "dark"] {
        browser.prefer(scheme).await;
        browser.screenshot(&format!("compare-{scheme}")).await;
    }

    browser.reload().await;
    browser
        .wait(
            "the same comparison",
            &format!("{sentence}.startsWith('◆ storey-2 is 1')"),
        )
        .await;
    assert_eq!(browser.evaluate("location.hash").await, hash);
    let swapped = "(() => { \
        const [from, to] = ['first-from', 'first-to'].map((id) => document.getElementById(id)); \
        [from.value, to.value] = [to.value, from.value]; \
        document.querySelector('.two-ranges').requestSubmit(); \
        return document.querySelector('.two-ranges .told').textContent; })()";
    assert_eq!(
        browser.evaluate(swapped).await,
        "First range: the end must be after the start."
    );
    // Regression: two ranges after the alert showed a green check mark beside the alarm.
    let text = [(end - 30.0, end - 15.0), (end - 15.0, end)]
        .map(|(from, to)| format!("{from:.3}..{to:.3}"));
    let after = format!(
        "location.hash = '#/structure/demo/compare?first={}&second={}'",
        text[0], text[1]
    );
    browser.evaluate(&after).await;
    let hidden = "document.querySelector('.is-hidden-loss')";
    let told = format!(
        "/^◆ Both ranges are after .* storey-2 [(]/.test({hidden}.textContent) && \
         {hidden}.checkVisibility() && !{sentence}.startsWith('✓')"
    );
    browser.wait("a loss before both ranges", &told).await;
    let around = "[...document.querySelectorAll('.two-ranges button')].find(({ textContent }) => \
                  textContent === 'Before and since the alert').click()";
    browser.evaluate(around).await;
    browser
        .wait(
            "the ranges before and since the alert",
            &format!(
                "!{hidden}.checkVisibility() && \
                 /first=[0-9]+[.]...[.][.]([0-9]+[.]...)&second=\\1[.][.]/.test(location.hash)"
            ),
        )
        .await;
    browser.resize(390, 844).await;
    let width = "document.documentElement.scrollWidth";
    assert_eq!(browser.evaluate(width).await, 390);
    browser.screenshot("compare-phone").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Epochs of modes are independent, so that more of them narrow the interval. Estimates of a
/// parameter are not.
#[tokio::test(flavor = "multi_thread")]
async fn means_have_the_uncertainty_of_their_kind() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let of = |values: &str, independent: bool| {
        format!(
            "import('/compare.js').then(({{ meanOf }}) => meanOf([[0, 1, 2, 3], {values}], \
             {independent}))"
        )
    };
    let exact = "[2, 2, 2, 2], [0.4, 0.4, 0.4, 0.4]";
    assert_eq!(
        browser.evaluate(&of(exact, false)).await,
        json!({"mean": 2, "std": 0.4, "count": 4})
    );
    assert_eq!(
        browser.evaluate(&of(exact, true)).await,
        json!({"mean": 2, "std": 0.2, "count": 4})
    );
    // The epochs scatter more than they state: √(4/3)/√4 = 0.577.
    let scattered = browser
        .evaluate(&of("[1, 3, 1, 3], [0.1, 0.1, 0.1, 0.1]", true))
        .await;
    let std = scattered["std"].as_f64().unwrap();
    assert!((std - (1.0_f64 / 3.0).sqrt()).abs() < 1e-12, "{std}");
    assert_eq!(
        browser.evaluate(&of("[null], [null]", true)).await,
        json!(null)
    );
    let difference = "import('/compare.js').then(({ differenceOf }) => differenceOf({ mean: 1, \
                      std: 0.03 }, { mean: 0.5, std: 0.04 }))";
    let difference = browser.evaluate(difference).await;
    let half = difference["high"].as_f64().unwrap() + 0.5;
    assert!((half - 1.96 * 0.05).abs() < 1e-12, "{difference}");
    // Regression: of forty equal quantities, two seemed to have changed. 2.5 standard deviations
    // are clear alone. Among forty quantities, the limit is 3.23.
    let by_chance = "import('/compare.js').then(({ differenceOf }) => [[2.5, 1], [2.5, 40], [3.2, \
                     40], [3.26, 40], [1.9, 40]].map(([mean, count]) => differenceOf({ mean: 0, \
                     std: 0 }, { mean, std: 1 }, count).isByChance))";
    assert_eq!(
        browser.evaluate(by_chance).await,
        json!([false, true, true, false, false])
    );
}

/// Regression test: while the history did not answer, a comparison had "no difference", and plots
/// and reports had "no data".
#[tokio::test(flavor = "multi_thread")]
async fn a_late_history_is_neither_no_difference_nor_no_data() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&["--duration", "30"]);
    browser
        .open(&format!("{}#/structure/demo/compare", demo.page))
        .await;
    browser.wait("the end of the demo", ENDED).await;
    let sentence = "document.querySelector('#panel-compare .sentence')";
    let is_told = format!("{sentence}.checkVisibility() && {sentence}.textContent");
    browser.wait("a comparison", &is_told).await;
    let late = "(() => {
        const load = globalThis.fetch;
        globalThis.isLate = true;
        globalThis.fetch = async (address, ...more) => {
          const response = await load(address, ...more);
          if (!globalThis.isLate || !String(address).includes('/history?')) return response;
          const answer = await response.json();
          const series = answer.series.map((one) => ({ ...one, data: one.data.map(() => []) }));
          return { ok: true, json: async () => ({ ...answer, series, incomplete: true }) };
        };
      })()";
    browser.evaluate(late).await;
    browser
        .evaluate("document.querySelector('.two-ranges').requestSubmit()")
        .await;
    let notice = |place: &str| {
        format!(
            "[...document.querySelectorAll('{place} .told')].some((told) => \
             told.checkVisibility() && told.textContent.startsWith('The history did not answer'))"
        )
    };
    browser.wait("the reason", &notice("#panel-compare")).await;
    let ticks = "document.querySelector('#panel-compare').innerText.includes('✓')";
    assert_eq!(browser.evaluate(ticks).await, false);
    browser
        .evaluate("location.hash = '#/structure/demo/parameters'")
        .await;
    browser
        .wait("the reason at the plots", &notice(".ranges-bar"))
        .await;
    browser
        .wait(
            "the reason in an empty plot",
            "document.querySelector('#plot-parameter-storey-1 \
             .readout')?.textContent.startsWith('The history did not answer')",
        )
        .await;
    browser.evaluate("location.hash = '#/report'").await;
    browser
        .wait("the reason in a report", &notice(".report"))
        .await;
    let cells = "[...document.querySelectorAll('.is-parameters tbody tr')].map((row) => \
                 row.children[2].textContent)";
    assert_eq!(browser.evaluate(cells).await, json!(vec!["not read"; 6]));
    // Later, all of it arrives.
    browser
        .evaluate(
            "globalThis.isLate = false; document.querySelector('.report .told button').click()",
        )
        .await;
    browser
        .wait(
            "the whole report",
            &format!(
                "!({}) && document.querySelector('.charts .line')",
                notice(".report")
            ),
        )
        .await;
    browser
        .evaluate("location.hash = '#/structure/demo/parameters'")
        .await;
    browser
        .wait(
            "the plots",
            &format!(
                "!({}) && document.querySelector('#plot-parameter-storey-1 canvas')",
                notice(".ranges-bar")
            ),
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// A part without an alert rule has no decision, and no threshold.
#[tokio::test(flavor = "multi_thread")]
async fn structures_without_alert_rules_are_shown() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let text = std::fs::read_to_string(example("demo.toml")).unwrap();
    let (before, _) = text.split_once("[[alert]]").expect("an alert rule");
    let (_, simulation) = text.split_once("[simulation]").expect("a simulation");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("unwatched.toml");
    std::fs::write(&file, format!("{before}\n[simulation]{simulation}")).unwrap();
    let demo = demo(&["--structure", file.to_str().unwrap(), "--duration", "40"]);
    for (hash, condition) in [
        ("#/", "document.querySelector('.structure-card')"),
        (
            "#/structure/demo",
            "document.querySelector('.parameters tbody tr td')?.textContent === '– no alert rule'",
        ),
        // Regression: each part was crossed by a dash without a meaning.
        (
            "#/structure/demo",
            "document.querySelectorAll('.drawing .inside').length === 5 && \
             [...document.querySelectorAll('.drawing .inside')].every(({ textContent }) => \
             textContent === '')",
        ),
        (
            "#/structure/demo/parameters",
            "document.querySelector('#plot-parameter-storey-1 canvas')",
        ),
        (
            "#/structure/demo/compare",
            "document.querySelectorAll('.differences tbody tr').length === 6",
        ),
        (
            "#/report",
            "document.querySelectorAll('.report[data-state=complete] .chart .line').length === 6",
        ),
    ] {
        browser.open(&format!("{}{hash}", demo.page)).await;
        browser.wait(hash, condition).await;
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
