//! The subscriber in TypeScript that the docs show.

use super::{Program, browser, free_address};
use std::path::Path;

/// Tests the TypeScript example without its types.
#[tokio::test(flavor = "multi_thread")]
async fn the_subscriber_of_the_docs_receives_parameters() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let demo = Program::start(&[
        "demo",
        "--speed",
        "1",
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/dashboard.md");
    let docs = std::fs::read_to_string(docs).unwrap();
    let typed = docs
        .split_once("```ts\n")
        .and_then(|(_, rest)| rest.split_once("```"))
        .expect("a subscriber")
        .0;
    let lines: Vec<&str> = typed
        .lines()
        .filter(|line| !line.starts_with("type "))
        .collect();
    let plain = lines
        .join("\n")
        .replace(" as Partial<News>", "")
        .replace(")!", ")");
    let script = plain
        .replace("ws://127.0.0.1:8080/", "ws://${location.host}/")
        .replace("\"ws:", "`ws:");
    let script = script.replace("structure=demo\"", "structure=demo`");
    assert!(
        script.contains("`ws://${location.host}/api/live?structure=demo`"),
        "{script}"
    );
    browser
        .evaluate(&format!(
            "{{ globalThis.told = []; const console = {{ log: (...words) => \
                            told.push(words.join(' ')) }};\n{script}\n}} true"
        ))
        .await;
    let shape = r"/^parameter\/storey-2 20\d\d-\d\d-\d\dT[\d:.]+Z [\d.]+ ± [\d.]+$/";
    browser
        .wait(
            "what the docs show",
            &format!("told.some((line) => {shape}.test(line))"),
        )
        .await;
}
