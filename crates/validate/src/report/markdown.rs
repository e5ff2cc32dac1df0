//! The report in Markdown.

use super::Report;
use super::page::{CONTENTS, contents_row, drawing_name, heads, introduction, row};
use crate::outcome::Table;
use std::fmt::Write as _;

pub(super) fn page(report: &Report) -> String {
    let cases = report.on_page();
    let mut page = "# Figures of the validation\n".to_owned();
    for paragraph in introduction(report) {
        // Writing to a `String` cannot fail.
        let _ = write!(page, "\n{paragraph}\n");
    }
    page.push('\n');
    let contents: Vec<Vec<String>> = cases
        .iter()
        .map(|case| {
            // The anchor of a heading is its text without full stops.
            let link = format!("[{}](#{})", case.name, case.name.replace('.', ""));
            std::iter::once(link).chain(contents_row(case)).collect()
        })
        .collect();
    table(&mut page, &CONTENTS.map(str::to_owned), &contents);
    for case in cases {
        let _ = write!(
            page,
            "\n## {}\n\n{} (`{}`, {})\n\n",
            case.name, case.title, case.name, case.source
        );
        for (seed, why) in &case.failures {
            let _ = write!(page, "Seed {seed} failed: {why}\n\n");
        }
        let rows: Vec<Vec<String>> = case.figures.iter().map(row).collect();
        table(&mut page, &heads(case), &rows);
        for Table {
            title,
            columns,
            rows,
        } in &case.tables
        {
            let _ = write!(page, "\n{title}\n\n");
            table(&mut page, columns, rows);
        }
        for (index, plot) in case.plots.iter().enumerate() {
            let _ = write!(page, "\n![{}]({})\n", plot.title, drawing_name(case, index));
        }
    }
    page
}

fn table(page: &mut String, columns: &[String], rows: &[Vec<String>]) {
    let cell = |text: &String| text.replace('\n', " ").replace('|', "\\|");
    let line = |cells: &[String]| {
        format!(
            "| {} |\n",
            cells.iter().map(cell).collect::<Vec<_>>().join(" | ")
        )
    };
    page.push_str(&line(columns));
    page.push_str(&line(&vec!["---".to_owned(); columns.len()]));
    for row in rows {
        page.push_str(&line(row));
    }
}
