//! The report as a page, as a table in Markdown, and as lines on a terminal.

use super::{CaseReport, FigureReport, Report, drawing};
use crate::error::ValidateError;
use crate::figure::{Judgement, Required, number};
use crate::outcome::Table;
use crate::run::Length;
use std::fmt::Write as _;
use std::path::Path;

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse;margin:.6rem 0 1.2rem}td,th{border:1px solid #ccc;padding:.15rem .55rem;text-align:right}\
td:first-child,th:first-child{text-align:left}th{background:#f3f3f3}.missed{background:#fbdcdc}img{max-width:100%}\
code{background:#f3f3f3;padding:0 .2rem}";

/// Returns a heading and one line for each figure of each case.
pub(super) fn text(report: &Report) -> String {
    let mut text = String::new();
    for case in &report.cases {
        let _ = writeln!(text, "{}  {} ({})", case.name, case.title, case.source);
        for figure in &case.figures {
            let mark = verdict(figure);
            let published = figure.published.map_or(String::new(), |value| format!(", published {}", number(value)));
            let _ = writeln!(
                text,
                "  {mark:<8} {}: {} (required {}{}{published})",
                figure.figure,
                measured(figure).join(", "),
                figure.required,
                judged(figure.judgement, figure.measured.len()),
            );
        }
        for (seed, why) in &case.failures {
            let _ = writeln!(text, "  failed   seed {seed}: {why}");
        }
    }
    let (passed, judged, missed) = count(report);
    let failed = report.cases.iter().map(|case| case.failures.len()).sum::<usize>();
    let _ = writeln!(text, "{passed} of {judged} figures as required, {missed} missed, {failed} runs failed");
    text
}

fn count(report: &Report) -> (usize, usize, usize) {
    let judged = report.figures().filter(|figure| figure.required != Required::Reported);
    let (passed, missed): (Vec<_>, Vec<_>) = judged.partition(|figure| figure.passed);
    (passed.len(), passed.len() + missed.len(), missed.len())
}

fn verdict(figure: &FigureReport) -> &'static str {
    match (figure.required, figure.passed) {
        (Required::Reported, _) => "reported",
        (_, true) => "holds",
        (_, false) => "MISSED",
    }
}

fn measured(figure: &FigureReport) -> Vec<String> {
    figure.measured.iter().map(|value| value.map_or("none".to_owned(), number)).collect()
}

fn judged(judgement: Judgement, seeds: usize) -> &'static str {
    match judgement {
        _ if seeds == 1 => "",
        Judgement::Each => "",
        Judgement::Mean => ", in the mean",
        Judgement::TwoThirds => ", of two seeds in three",
    }
}

/// Writes the pages and the diagrams.
pub(super) fn write(report: &Report, directory: &Path) -> Result<(), ValidateError> {
    let put = |name: &str, text: &str| {
        let path = directory.join(name);
        std::fs::write(&path, text).map_err(|source| ValidateError::File { path, source })
    };
    std::fs::create_dir_all(directory).map_err(|source| ValidateError::File { path: directory.to_owned(), source })?;
    for case in &report.cases {
        for (index, plot) in case.plots.iter().enumerate() {
            put(&drawing_name(case, index), &drawing::svg(plot)?)?;
        }
    }
    put("index.html", &html(report))?;
    put("figures.md", &markdown(report))
}

fn drawing_name(case: &CaseReport, index: usize) -> String {
    format!("{}-{}.svg", case.name, index + 1)
}

fn heads(report: &Report) -> Vec<String> {
    let mut heads: Vec<String> = ["figure", "published", "required"].map(str::to_owned).to_vec();
    heads.extend(report.seeds.iter().map(|seed| format!("seed {seed}")));
    heads.push("verdict".to_owned());
    heads
}

fn row(figure: &FigureReport) -> Vec<String> {
    let mut row = vec![
        figure.figure.clone(),
        figure.published.map_or("–".to_owned(), number),
        format!("{}{}", figure.required, judged(figure.judgement, figure.measured.len())),
    ];
    row.extend(measured(figure));
    row.push(verdict(figure).to_owned());
    row
}

fn introduction(report: &Report) -> String {
    let (passed, judged, missed) = count(report);
    let records = match report.length {
        Length::Full => "records of full length",
        Length::Quick => "shortened records",
    };
    let seeds = if report.seeds.len() == 1 { "one seed" } else { "several seeds" };
    format!("{passed} of {judged} figures are as required, {missed} are missed; {records}, {seeds}.")
}

fn html(report: &Report) -> String {
    let mut page = String::new();
    let _ = write!(
        page,
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Spandrel: validation</title><style>{STYLE}</style>\
         <h1>Spandrel: published examples, rebuilt</h1><p>{}</p>",
        introduction(report)
    );
    for case in &report.cases {
        let (name, title, source) = (escaped(case.name), escaped(case.title), escaped(case.source));
        let _ = write!(page, "<h2 id=\"{name}\">{title}</h2><p><code>{name}</code>, {source}</p>");
        for (seed, why) in &case.failures {
            let _ = write!(page, "<p class=\"missed\">seed {seed} failed: {}</p>", escaped(why));
        }
        let rows = case.figures.iter().map(|figure| (row(figure), !figure.passed)).collect::<Vec<_>>();
        html_table(&mut page, &heads(report), &rows);
        for Table { title, columns, rows } in &case.tables {
            let _ = write!(page, "<h3>{}</h3>", escaped(title));
            let rows = rows.iter().map(|row| (row.clone(), false)).collect::<Vec<_>>();
            html_table(&mut page, columns, &rows);
        }
        for (index, plot) in case.plots.iter().enumerate() {
            let _ = write!(
                page,
                "<p><img src=\"{}\" alt=\"{}\"></p>",
                escaped(&drawing_name(case, index)),
                escaped(&plot.title)
            );
        }
    }
    page.push_str("</html>\n");
    page
}

fn html_table(page: &mut String, columns: &[String], rows: &[(Vec<String>, bool)]) {
    let cells = |cells: &[String], tag: &str| -> String {
        cells.iter().map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell))).collect()
    };
    let _ = write!(page, "<table><tr>{}</tr>", cells(columns, "th"));
    for (row, missed) in rows {
        let class = if *missed { " class=\"missed\"" } else { "" };
        let _ = write!(page, "<tr{class}>{}</tr>", cells(row, "td"));
    }
    page.push_str("</table>");
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn markdown(report: &Report) -> String {
    let mut page = format!("# Published examples, rebuilt\n\n{}\n", introduction(report));
    for case in &report.cases {
        let _ = write!(page, "\n## {}\n\n`{}`, {}\n\n", case.title, case.name, case.source);
        for (seed, why) in &case.failures {
            let _ = write!(page, "Seed {seed} failed: {why}\n\n");
        }
        let rows: Vec<Vec<String>> = case.figures.iter().map(row).collect();
        markdown_table(&mut page, &heads(report), &rows);
        for Table { title, columns, rows } in &case.tables {
            let _ = write!(page, "\n{title}\n\n");
            markdown_table(&mut page, columns, rows);
        }
        for (index, plot) in case.plots.iter().enumerate() {
            let _ = write!(page, "\n![{}]({})\n", plot.title, drawing_name(case, index));
        }
    }
    page
}

fn markdown_table(page: &mut String, columns: &[String], rows: &[Vec<String>]) {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | ").replace('\n', " "));
    page.push_str(&line(columns));
    page.push_str(&line(&vec!["---".to_owned(); columns.len()]));
    for row in rows {
        page.push_str(&line(row));
    }
}
