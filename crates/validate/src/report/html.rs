//! The report as an HTML page.

use super::Report;
use super::page::{CONTENTS, contents_row, drawing_name, heads, introduction, row};
use crate::outcome::Table;
use std::fmt::Write as _;

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:64rem;margin:2rem \
                     auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse;margin:.6rem 0 1.2rem}td,th{border:1px solid #ccc;padding:.15rem \
.55rem;text-align:right}\
td:first-child,th:first-child{text-align:left}th{background:#f3f3f3}.missed{background:#fbdcdc}img{max-width:100%}\
code{background:#f3f3f3;padding:0 .2rem}";

/// One cell as HTML.
struct Cell(String);

pub(super) fn page(report: &Report) -> String {
    let cases = report.on_page();
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Spandrel: \
         validation</title><style>{STYLE}</style>\n\
         <h1>Spandrel: figures of the validation</h1>\n"
    );
    for paragraph in introduction(report) {
        // Writing to a `String` cannot fail.
        let _ = writeln!(page, "<p>{}</p>", marked(&paragraph));
    }
    let contents: Vec<(Vec<Cell>, bool)> = cases
        .iter()
        .map(|case| {
            let name = escaped(case.name);
            let link = Cell(format!("<a href=\"#{name}\">{name}</a>"));
            (
                std::iter::once(link)
                    .chain(plain(&contents_row(case)))
                    .collect(),
                !case.passed(),
            )
        })
        .collect();
    table(&mut page, &CONTENTS.map(str::to_owned), &contents);
    for case in cases {
        let (name, title, source) = (
            escaped(case.name),
            escaped(case.title),
            escaped(case.source),
        );
        let _ = writeln!(
            page,
            "<h2 id=\"{name}\">{title}</h2><p><code>{name}</code>, {source}</p>"
        );
        for (seed, why) in &case.failures {
            let _ = writeln!(
                page,
                "<p class=\"missed\">seed {seed} failed: {}</p>",
                escaped(why)
            );
        }
        let rows: Vec<_> = case
            .figures
            .iter()
            .map(|figure| (plain(&row(figure)), !figure.passed))
            .collect();
        table(&mut page, &heads(case), &rows);
        for Table {
            title,
            columns,
            rows,
        } in &case.tables
        {
            let _ = writeln!(page, "<h3>{}</h3>", escaped(title));
            let rows: Vec<_> = rows.iter().map(|row| (plain(row), false)).collect();
            table(&mut page, columns, &rows);
        }
        for (index, plot) in case.plots.iter().enumerate() {
            let (file, title) = (escaped(&drawing_name(case, index)), escaped(&plot.title));
            let _ = writeln!(
                page,
                "<p><img loading=\"lazy\" src=\"{file}\" alt=\"{title}\"></p>"
            );
        }
    }
    page.push_str("</html>\n");
    page
}

fn plain(cells: &[String]) -> Vec<Cell> {
    cells.iter().map(|cell| Cell(escaped(cell))).collect()
}

fn table(page: &mut String, columns: &[String], rows: &[(Vec<Cell>, bool)]) {
    let line = |cells: &[Cell], tag: &str| -> String {
        cells
            .iter()
            .map(|Cell(cell)| format!("<{tag}>{cell}</{tag}>"))
            .collect()
    };
    let _ = writeln!(page, "<table><tr>{}</tr>", line(&plain(columns), "th"));
    for (row, missed) in rows {
        let class = if *missed { " class=\"missed\"" } else { "" };
        let _ = writeln!(page, "<tr{class}>{}</tr>", line(row, "td"));
    }
    page.push_str("</table>\n");
}

/// Converts text with `code` and *emphasis* to HTML. A star before a blank or a full stop stays a
/// star.
fn marked(text: &str) -> String {
    let mut page = escaped(text);
    for (mark, tag) in [('`', "code"), ('*', "em")] {
        while let Some((begin, end)) = pair(&page, mark) {
            let inner = page[begin + 1..end].to_owned();
            page.replace_range(begin..=end, &format!("<{tag}>{inner}</{tag}>"));
        }
    }
    page
}

/// Returns the positions of a mark that opens a word and of the next mark.
fn pair(text: &str, mark: char) -> Option<(usize, usize)> {
    let opens = |at: &usize| text[at + 1..].starts_with(char::is_alphabetic);
    let begin = text.match_indices(mark).map(|(at, _)| at).find(opens)?;
    let end = begin + 1 + text[begin + 1..].find(mark)?;
    Some((begin, end))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
