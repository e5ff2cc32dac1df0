//! Effects of bad input of every kind, on the built binary or on running services.
//!
//! The test compares its results with the table of docs/reliability.md. To rewrite the table, run
//! `UPDATE_DOCS=1 cargo test --workspace --test program refused::`.

mod certificates;
mod files;
mod kept;
mod messages;
mod page;
mod table;

use table::Table;

#[tokio::test(flavor = "multi_thread")]
async fn every_bad_input_has_the_documented_effect() {
    let mut table = Table::default();
    files::structure_files(&mut table);
    files::configurations(&mut table);
    files::arguments(&mut table);
    files::records(&mut table);
    files::baselines_and_annotations(&mut table);
    certificates::all(&mut table);
    kept::all(&mut table).await;
    messages::all(&mut table).await;
    page::all(&mut table).await;
    table.compare_with_the_page(60);
}
