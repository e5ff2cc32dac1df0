//! What bad input does: each kind of it, through the built binary or services that run.
//!
//! The table of docs/reliability.md is what this test has seen; `UPDATE_DOCS=1 cargo test --workspace --test refused` writes it anew.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

#[path = "../support/mod.rs"]
mod support;

mod certificates;
mod files;
mod kept;
mod messages;
mod page;
mod table;

use table::Table;

#[tokio::test(flavor = "multi_thread")]
async fn every_bad_input_is_refused_as_the_page_says() {
    let mut table = Table::default();
    files::structure_files(&mut table);
    files::configurations(&mut table);
    files::arguments(&mut table);
    files::records(&mut table);
    certificates::all(&mut table);
    kept::all(&mut table).await;
    messages::all(&mut table).await;
    page::all(&mut table).await;
    table.compare_with_the_page(60);
}
