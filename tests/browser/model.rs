//! Plots of model classes and of rejected samples.

use super::{browser, run_in, tool};
use std::path::Path;

/// Plots that require additional tables in the structure file.
#[tokio::test(flavor = "multi_thread")]
async fn model_classes_and_rejected_samples_are_plotted() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (structure, record) = (
        folder.path().join("demo.toml"),
        folder.path().join("demo.csv"),
    );
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let text = std::fs::read_to_string(demo)
        .unwrap()
        .replace("seed = 1\n", "seed = 1\nspike-share = 0.01\n");
    let tables = "[outliers]\n[classes]\nkind = \"predefined\"\n\
                  [[classes.class]]\nname = \"lower-two\"\n\
                  groups = [[\"storey-1\"], [\"storey-2\"]]\n\
                  [[classes.class]]\nname = \"upper-two\"\n\
                  groups = [[\"storey-4\"], [\"storey-5\"]]\n[[alert]]";
    assert!(
        text.contains("spike-share") && text.contains("[[alert]]"),
        "the example has changed"
    );
    std::fs::write(&structure, text.replacen("[[alert]]", tables, 1)).unwrap();
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
    browser
        .open(&format!("{}#/structure/demo/model", run.page))
        .await;
    // A plot is filled only while it is visible.
    let shown = |group: &str| {
        format!(
            "!document.querySelector('#group-{group}').hidden && \
             (document.querySelector('#group-{group}').scrollIntoView(), true)"
        )
    };
    browser.wait("classes", &shown("classes")).await;
    // Only storey 2 is damaged. A class that groups the three lower storeys explains this less
    // well.
    let readout = "document.querySelector('#plot-classes .readout').textContent";
    browser
        .wait(
            "the plausibilities",
            &format!("/lower-two (9\\d|100) % · upper-two .*\\d %$/.test({readout})"),
        )
        .await;
    browser.screenshot("classes").await;
    browser
        .evaluate("location.hash = '#/structure/demo/sensors'")
        .await;
    browser.wait("outliers", &shown("outliers")).await;
    let rejected = "document.querySelector('#group-outliers .readout').textContent";
    let shape = r"/^.* · [\d.]+ % of the recent samples · \d+ rejected here$/";
    browser
        .wait("what was rejected", &format!("{shape}.test({rejected})"))
        .await;
    browser.screenshot("outliers").await;
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}
