//! A record without dates.

use super::{browser, run_in, tool};
use serde_json::json;
use std::path::Path;

/// Regression test: the plots and files of a record without dates showed dates in 1970.
#[tokio::test(flavor = "multi_thread")]
async fn a_record_without_dates_is_plotted_over_its_own_time() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        folder.path().join("demo.toml"),
        folder.path().join("demo.csv"),
    );
    std::fs::copy(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"),
        &structure,
    )
    .unwrap();
    let (structure, record) = (structure.to_str().unwrap(), record.to_str().unwrap());
    tool(&[
        "simulate",
        structure,
        "--record",
        record,
        "--duration",
        "120",
    ]);
    let (run, endpoint) = run_in(folder.path(), structure);
    tool(&[
        "replay",
        record,
        "--structure",
        structure,
        "--speed",
        "max",
        "--connect",
        &endpoint,
    ]);

    browser.resize(1280, 900).await;
    browser.open(&run.page).await;
    let age = "document.querySelector('.structure-card[data-name=demo] .fact-age dd').textContent";
    browser
        .wait(
            "the time of the record",
            &format!("/, measured 119\\.\\d\\d s$/.test({age})"),
        )
        .await;
    browser.evaluate("location.hash = '#/structure/demo'").await;
    let readout = "document.querySelector('#plot-worst .readout').textContent";
    browser
        .wait(
            "a reading at the end",
            &format!("/^119\\.\\d\\d s · 0\\.8/.test({readout})"),
        )
        .await;
    browser.screenshot("without-dates").await;
    let file = "(async () => (await (await \
                fetch('/api/structures/demo/history?series=parameter/storey-2&format=csv')).text()).split('\\n')[1])()";
    let row = browser.evaluate(file).await;
    assert!(row.as_str().unwrap().starts_with("0"), "{row}");
    // The axis is drawn on a canvas, so the test calls the function that formats its labels.
    let words = "(async () => { const { recordTime } = await import('/words.js'); return [0, \
                 59.9996, 90, 3725.25].map((time) => recordTime(time, time % 1 ? 2 : 0)); })()";
    assert_eq!(
        browser.evaluate(words).await,
        json!(["0:00:00", "0:01:00.00", "0:01:30", "1:02:05.25"])
    );
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}
