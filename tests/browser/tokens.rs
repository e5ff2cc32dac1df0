//! The entrance of a page whose visitors need a token.

use super::{Program, browser, free_address};
use std::path::Path;
use std::process::Command;

#[tokio::test(flavor = "multi_thread")]
async fn a_page_with_tokens_requires_one() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let tokens = folder.path().join("tokens.json");
    let mut token = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    let issued = token
        .args(["token", "grace", "--role", "operator", "--file"])
        .arg(&tokens)
        .output()
        .unwrap();
    let token = String::from_utf8(issued.stdout).unwrap().trim().to_owned();
    assert!(
        token.starts_with("spandrel-"),
        "{}",
        String::from_utf8_lossy(&issued.stderr)
    );
    let structure = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let configuration = folder.path().join("spandrel.toml");
    let text = format!(
        "structures = [{structure:?}]\n[bus]\nlisten = [\"tcp/{}\"]\n[dashboard]\n\
         listen = \"127.0.0.1:0\"\n\
         tokens = \"tokens.json\"\n[history]\ndatabase = \"none\"\n[state]\nfolder = \"none\"\n",
        free_address()
    );
    std::fs::write(&configuration, text).unwrap();
    let run = Program::start(&["run", "--config", configuration.to_str().unwrap()]);
    browser.open(&run.page).await;
    browser
        .wait(
            "a form for the token",
            "document.querySelector('#entrance #token') !== null",
        )
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('.structure-card').length")
            .await,
        0
    );
    browser.screenshot("entrance").await;
    let show = |token: &str| {
        format!(
            "document.querySelector('#token').value = {token:?}; \
             document.querySelector('#entrance').requestSubmit(); true"
        )
    };
    browser.evaluate(&show("spandrel-wrong")).await;
    let told = "document.querySelector('#entrance [role=alert]').textContent";
    browser
        .wait(
            "a word on the wrong token",
            &format!("{told}.includes('no valid token')"),
        )
        .await;
    browser.evaluate(&show(&token)).await;
    browser
        .wait(
            "the card of the demo",
            "document.querySelector('.structure-card[data-name=demo]') !== null",
        )
        .await;
    assert_eq!(
        browser.evaluate("document.cookie").await,
        "",
        "scripts cannot read the session"
    );
}
