//! The table of nodes with their own filters.

use super::{Program, browser, free_address};
use serde_json::Value;

/// Regression test: the page did not show which node was silent, excluded or alive.
#[tokio::test(flavor = "multi_thread")]
async fn nodes_with_their_own_filters_are_in_a_table() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let demo = Program::start(&[
        "demo",
        "--distributed",
        "--stay",
        "--speed",
        "4", // the browser may start within 7 s, before the node falls silent
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ]);
    browser.resize(1280, 900).await;
    browser.prefer("light").await;
    browser
        .open(&format!(
            "{}#/structure/demo-distributed/sensors",
            demo.page
        ))
        .await;
    let cell = |node: &str, column: u64| {
        format!(
            "document.querySelector('table.nodes \
             tr[data-node={node}]')?.children[{column}].textContent ?? ''"
        )
    };
    // The samples of floor 8 are missing from 30 to 45 s. Those of floor 20 have a permanent
    // offset.
    browser
        .wait(
            "a node that is silent",
            &format!("({}).startsWith('○ silent since ')", cell("floor-8", 1)),
        )
        .await;
    browser
        .wait(
            "a node that is left out",
            &format!("({}).startsWith('◆ excluded')", cell("floor-20", 1)),
        )
        .await;
    browser
        .evaluate("document.querySelector('#group-nodes').scrollIntoView()")
        .await;
    browser.screenshot("nodes-light").await;
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('table.nodes tbody tr').length")
            .await,
        16
    );
    let heads = browser
        .evaluate("[...document.querySelectorAll('table.nodes th[scope=col]')].length")
        .await;
    assert_eq!(heads, 7);
    // Regression: the table was cut through a row, although the page below was empty.
    let cut = "(() => { const { scrollHeight, clientHeight } = \
               document.querySelector('.scroll:has(.nodes)'); return scrollHeight - \
               clientHeight; })()";
    assert_eq!(browser.evaluate(cut).await, 0, "the table is cut off");
    // A station publishes nothing that the tab of the model shows.
    let model = browser
        .evaluate("document.getElementById('tab-model')")
        .await;
    assert_eq!(model, Value::Null);
    // Names must not break at hyphens, and the lines of different nodes must look different.
    let in_one_line = "(name) => { const text = document.createRange(); \
                       text.selectNodeContents(name); return new \
                       Set([...text.getClientRects()].map((part) => part.top)).size === 1; }";
    let names =
        format!("[...document.querySelectorAll('table.nodes th[scope=row]')].every({in_one_line})");
    assert_eq!(
        browser.evaluate(&names).await,
        true,
        "a name takes more than a line"
    );
    let looks = "[...document.querySelectorAll('#plot-nodes .key-line')].map((key) => \
                 key.style.getPropertyValue('--key') + \
                 key.firstChild.getAttribute('stroke-dasharray'))";
    assert_eq!(
        browser.evaluate(&format!("new Set({looks}).size")).await,
        16
    );
    browser
        .wait(
            "it is heard again",
            &format!("({}).startsWith('● alive')", cell("floor-8", 1)),
        )
        .await;
    for (column, shape) in [
        (2, r"^[\d.]+ \([\d.]+\)$"),
        (
            3,
            r"^\d{4}-\d\d-\d\d .* UTC \(in \d+ % of recent fusions\)$",
        ),
        (4, r"^\d{4}-\d\d-\d\d .* UTC$"),
        (5, r"^[\d.]+ kB$"),
        (6, r"^[\d.]+ kB$"),
    ] {
        let matches = format!("/{shape}/.test({})", cell("floor-20", column));
        browser
            .wait(
                &format!("column {column} of a node that is left out"),
                &matches,
            )
            .await;
    }
    browser.prefer("dark").await;
    browser.screenshot("nodes-dark").await;
    browser.resize(390, 844).await;
    browser
        .evaluate("document.querySelector('#group-nodes').scrollIntoView()")
        .await;
    browser.screenshot("nodes-phone").await;
    // Regression: the time of an exclusion was printed over that of the last message.
    let covered = "[...document.querySelectorAll('table.nodes tbody tr')].filter((row) => { \
                   const [since, last] = [3, 4].map((column) => { \
                   const text = document.createRange(); \
                   text.selectNodeContents(row.children[column]); \
                   return text.getBoundingClientRect(); }); \
                   return Math.max(since.right, last.right) > innerWidth || \
                   (since.right > last.left && since.bottom > last.top); }).length";
    assert_eq!(browser.evaluate(covered).await, 0, "a time is covered");
    let width = browser
        .evaluate("document.documentElement.scrollWidth")
        .await;
    assert_eq!(width, 390, "the page is wider than the phone");
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}
