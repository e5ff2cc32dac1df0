//! The ranked list of all reports in a folder: which structure needs an inspector first.

use super::page::{escape, head};
use super::report::KIND;
use crate::error::AppError;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::Path;

/// What the list shows of a report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    kind: String,
    structure: String,
    event: String,
    record: String,
    start: Option<String>,
    number: usize,
    rank: u8,
    urgency: String,
    headline: String,
    peak_m_per_s2: f64,
}

/// Reads the reports of a folder. Other files are skipped.
///
/// # Errors
/// The folder cannot be read.
pub fn entries(folder: &Path) -> Result<Vec<Entry>, AppError> {
    let unreadable = |source| AppError::Io {
        what: format!("cannot read {}", folder.display()),
        source,
    };
    let mut entries = Vec::new();
    for file in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = file.map_err(unreadable)?.path();
        if path.extension().is_none_or(|extension| extension != "json") {
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap_or_default();
        let entry: Result<Entry, _> = serde_json::from_str(&text);
        entries.extend(entry.ok().filter(|entry| entry.kind == KIND));
    }
    Ok(entries)
}

/// Returns the latest report of each structure, the most urgent first.
///
/// The latest report knows all earlier events of its structure. Reports of the same urgency are
/// ordered by the amplitude.
pub fn ranked(entries: &[Entry]) -> Vec<&Entry> {
    let mut latest: Vec<&Entry> = Vec::new();
    for entry in entries {
        let known = latest
            .iter_mut()
            .find(|one| one.structure == entry.structure);
        match known {
            Some(known) if is_later(entry, known) => *known = entry,
            Some(_) => {}
            None => latest.push(entry),
        }
    }
    latest.sort_by(|a, b| {
        let by_rank = a.rank.cmp(&b.rank);
        let by_peak = b.peak_m_per_s2.total_cmp(&a.peak_m_per_s2);
        by_rank.then(by_peak).then(a.structure.cmp(&b.structure))
    });
    latest
}

/// Returns `true` if one report is later than another: by the dates if both recordings have one,
/// otherwise by the order of the command.
fn is_later(a: &Entry, b: &Entry) -> bool {
    match (&a.start, &b.start) {
        (Some(a), Some(b)) if a != b => a > b,
        (Some(_) | None, Some(_) | None) => a.number > b.number,
    }
}

/// Returns the page of the list, with sentences about what waits.
pub fn html(entries: &[Entry], waiting: &[String]) -> String {
    let mut page = head("Earthquake reports");
    page += "<header>\n<p class=\"kicker\">Earthquake reports</p>\n<h1>Who needs an inspector first</h1>\n\
             </header>\n<section>\n<table class=\"list\">\n<thead><tr><th scope=\"col\"></th>\
             <th scope=\"col\">structure</th><th scope=\"col\">latest event</th>\
             <th scope=\"col\">result</th><th scope=\"col\" class=\"n\">peak (m/s²)</th></tr></thead>\n\
             <tbody>\n";
    for entry in ranked(entries) {
        page += &row(entry, true);
    }
    page += "</tbody>\n</table>\n<p class=\"note\">The latest report of each structure, the most urgent \
             first, then by the acceleration of the structure.</p>\n</section>\n\
             <section>\n<h2>All events, the latest first</h2>\n<table class=\"list\">\n<thead><tr>\
             <th scope=\"col\"></th><th scope=\"col\">structure</th><th scope=\"col\">event</th>\
             <th scope=\"col\">result at that time</th>\
             <th scope=\"col\" class=\"n\">peak (m/s²)</th></tr></thead>\n<tbody>\n";
    let mut all: Vec<&Entry> = entries.iter().collect();
    all.sort_by(|a, b| {
        let by_structure = a.structure.cmp(&b.structure);
        by_structure.then(b.number.cmp(&a.number))
    });
    for entry in all {
        page += &row(entry, false);
    }
    page += "</tbody>\n</table>\n</section>\n";
    if !waiting.is_empty() {
        page += "<section>\n<h2>What follows</h2>\n<ul>\n";
        for sentence in waiting {
            // Writing to a string cannot fail.
            let _ = writeln!(page, "<li>{}</li>", escape(sentence));
        }
        page += "</ul>\n</section>\n";
    }
    page + "</body>\n</html>\n"
}

fn row(entry: &Entry, is_main: bool) -> String {
    let when = entry.start.as_deref().map_or_else(
        || entry.record.clone(),
        |start| start.replace('T', " ").replace('Z', " UTC"),
    );
    let mut row = String::new();
    // Writing to a string cannot fail.
    let _ = writeln!(
        row,
        "<tr><td><span class=\"badge u{}\">{}</span></td><td>{}{}{}</td>\
         <td><a href=\"{}.html\">{}</a></td><td>{}</td><td class=\"n\">{:.2}</td></tr>",
        entry.rank,
        escape(&entry.urgency.replace('-', " ")),
        if is_main { "<strong>" } else { "" },
        escape(&entry.structure),
        if is_main { "</strong>" } else { "" },
        escape(&entry.event),
        escape(&when),
        escape(&entry.headline),
        entry.peak_m_per_s2
    );
    row
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(structure: &str, start: &str, rank: u8, peak: f64) -> Entry {
        Entry {
            kind: KIND.to_owned(),
            structure: structure.to_owned(),
            event: format!("{structure}_{start}"),
            record: "record.csv".to_owned(),
            start: Some(start.to_owned()),
            number: 1,
            rank,
            urgency: "watch".to_owned(),
            headline: "<b>".to_owned(),
            peak_m_per_s2: peak,
        }
    }

    #[test]
    fn latest_report_of_each_structure_ranks_it() {
        let entries = [
            entry("a", "2020-01-01", 1, 9.0),
            entry("a", "2021-01-01", 4, 0.1),
            entry("b", "2020-06-01", 2, 1.0),
            entry("c", "2020-06-01", 2, 3.0),
        ];
        let names: Vec<&str> = ranked(&entries)
            .iter()
            .map(|one| one.event.as_str())
            .collect();
        assert_eq!(names, ["c_2020-06-01", "b_2020-06-01", "a_2021-01-01"]);
    }

    #[test]
    fn texts_of_a_report_cannot_become_html() {
        let page = html(&[entry("a", "2020-01-01", 1, 9.0)], &["<b>".to_owned()]);
        assert!(
            page.contains("&lt;b&gt;") && !page.contains("<b>"),
            "{page}"
        );
    }
}
