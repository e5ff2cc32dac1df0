//! The ranked list of all reports in a folder: which structure needs an inspector first.

use super::page::{escape, head};
use super::report::KIND;
use crate::error::AppError;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use spandrel_bus::read_text_up_to;
use spandrel_earthquake::urgency::{Dated, ranking};
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Maximum size of a report (bytes). Larger JSON files are skipped.
const MOST_BYTES: u64 = 64 << 20;

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

impl Entry {
    /// Returns the time of the first sample (s since 1970-01-01 UTC). `None` if the recording has
    /// no dates.
    fn start_s(&self) -> Option<f64> {
        let start: Timestamp = self.start.as_deref()?.parse().ok()?;
        Some(start.as_second() as f64)
    }

    /// Returns the time for people, or the name of the recording.
    fn when(&self) -> String {
        let dated = |start: &str| start.replace('T', " ").replace('Z', " UTC");
        self.start
            .as_deref()
            .map_or_else(|| self.record.clone(), dated)
    }

    /// Returns the urgency for people.
    fn words(&self) -> String {
        self.urgency.replace('-', " ")
    }
}

/// Reads the reports of a folder. Other files are skipped.
///
/// # Errors
/// Returns an error if the folder cannot be read.
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
        let text = read_text_up_to(&path, MOST_BYTES).unwrap_or_default();
        let entry: Result<Entry, _> = serde_json::from_str(&text);
        entries.extend(entry.ok().filter(|entry| entry.kind == KIND));
    }
    Ok(entries)
}

/// The report that ranks a structure, and its latest one.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Ranked<'e> {
    urgent: &'e Entry,
    latest: &'e Entry,
}

/// Returns the report that ranks each structure, the most urgent first.
///
/// Reports of the same urgency are ordered by the amplitude.
fn ranked(entries: &[Entry]) -> Vec<Ranked<'_>> {
    let mut structures: BTreeMap<&str, Vec<&Entry>> = BTreeMap::new();
    for entry in entries {
        structures.entry(&entry.structure).or_default().push(entry);
    }
    let mut all: Vec<Ranked> = structures
        .into_values()
        .filter_map(|mut reports| {
            reports.sort_by(|a, b| later_first(a, b));
            of_structure(&reports)
        })
        .collect();
    all.sort_by(|a, b| {
        let by_rank = a.urgent.rank.cmp(&b.urgent.rank);
        by_rank.then(b.urgent.peak_m_per_s2.total_cmp(&a.urgent.peak_m_per_s2))
    });
    all
}

/// Returns what ranks a structure whose reports begin with the latest one.
///
/// Recordings without dates do not show how old their reports are, so only the latest one counts.
fn of_structure<'e>(reports: &[&'e Entry]) -> Option<Ranked<'e>> {
    let latest = *reports.first()?;
    let until_s = latest.start_s().unwrap_or(0.0);
    let dated = |entry: &&Entry| Dated {
        time_s: entry.start_s().unwrap_or(f64::MIN),
        rank: entry.rank,
        peak_m_per_s2: entry.peak_m_per_s2,
    };
    let all: Vec<Dated> = reports.iter().map(dated).collect();
    let position = ranking(&all, until_s).unwrap_or(0);
    let urgent = *reports.get(position)?;
    Some(Ranked { urgent, latest })
}

/// Orders two reports of a structure, the later one first: by the dates if both recordings have
/// one, otherwise by the order of the command.
fn later_first(a: &Entry, b: &Entry) -> Ordering {
    match (&a.start, &b.start) {
        (Some(of_a), Some(of_b)) if of_a != of_b => of_b.cmp(of_a),
        (Some(_) | None, Some(_) | None) => b.number.cmp(&a.number),
    }
}

/// Returns the page of the list, with sentences about what waits.
pub fn html(entries: &[Entry], waiting: &[String]) -> String {
    let mut page = head("Earthquake reports");
    page += "<header>\n<p class=\"kicker\">Earthquake reports</p>\n<h1>Order of inspections</h1>\n\
             </header>\n<section>\n<table class=\"list\">\n\
             <thead><tr><th scope=\"col\">urgency</th>\
             <th scope=\"col\">structure</th><th scope=\"col\">event</th>\
             <th scope=\"col\">result</th><th scope=\"col\" class=\"n\">peak \
             (m/s²)</th></tr></thead>\n\
             <tbody>\n";
    for Ranked { urgent, latest } in ranked(entries) {
        page += &row(
            urgent,
            Some(latest).filter(|latest| *latest != urgent),
            true,
        );
    }
    page += "</tbody>\n</table>\n<p class=\"note\">The most urgent report of the last two days of \
             each structure. The most urgent structure is first, then the one with the largest \
             acceleration.</p>\n</section>\n\
             <section>\n<h2>All events, the latest first</h2>\n<table class=\"list\">\n<thead><tr>\
             <th scope=\"col\">urgency</th><th scope=\"col\">structure</th><th \
             scope=\"col\">event</th>\
             <th scope=\"col\">result at that time</th>\
             <th scope=\"col\" class=\"n\">peak (m/s²)</th></tr></thead>\n<tbody>\n";
    let mut all: Vec<&Entry> = entries.iter().collect();
    all.sort_by(|a, b| {
        let by_structure = a.structure.cmp(&b.structure);
        by_structure.then(b.number.cmp(&a.number))
    });
    for entry in all {
        page += &row(entry, None, false);
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
    page + "</main>\n</body>\n</html>\n"
}

/// Returns a row of a list. `latest` is a later, less urgent report of the same structure.
fn row(entry: &Entry, latest: Option<&Entry>, is_main: bool) -> String {
    let latest = latest.map_or_else(String::new, |latest| {
        format!(
            "<p class=\"note\"><a href=\"{}.html\">Latest report</a> ({}): {}. {}</p>",
            escape(&latest.event),
            escape(&latest.when()),
            escape(&latest.words()),
            escape(&latest.headline)
        )
    });
    let mut row = String::new();
    // Writing to a string cannot fail.
    let _ = writeln!(
        row,
        "<tr><td><span class=\"badge u{}\">{}</span></td><td>{}{}{}</td>\
         <td><a href=\"{}.html\">{}</a></td><td>{}{latest}</td><td class=\"n\">{:.2}</td></tr>",
        entry.rank,
        escape(&entry.words()),
        if is_main { "<strong>" } else { "" },
        escape(&entry.structure),
        if is_main { "</strong>" } else { "" },
        escape(&entry.event),
        escape(&entry.when()),
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
    fn a_weak_aftershock_does_not_replace_the_report_that_asks_for_an_inspector() {
        let entries = [
            entry("a", "2020-01-01T00:00:00Z", 1, 9.0),
            entry("a", "2021-01-01T00:00:00Z", 4, 0.1),
            entry("b", "2020-06-01T00:00:00Z", 2, 1.0),
            entry("b", "2020-06-02T12:00:00Z", 4, 0.1),
            entry("c", "2020-06-01T00:00:00Z", 2, 3.0),
        ];
        let names: Vec<&str> = ranked(&entries)
            .iter()
            .map(|one| one.urgent.event.as_str())
            .collect();
        let expected = [
            "c_2020-06-01T00:00:00Z",
            "b_2020-06-01T00:00:00Z",
            "a_2021-01-01T00:00:00Z",
        ];
        assert_eq!(names, expected);
        let page = html(&entries, &[]);
        let latest =
            "<a href=\"b_2020-06-02T12:00:00Z.html\">Latest report</a> (2020-06-02 12:00:00 UTC)";
        assert_eq!(page.matches("Latest report").count(), 1, "{page}");
        assert!(page.contains(latest), "{page}");
    }

    #[test]
    fn without_dates_the_last_report_of_the_command_ranks_a_structure() {
        let undated = |number: usize, rank: u8| Entry {
            start: None,
            number,
            ..entry("a", "", rank, 1.0)
        };
        let entries = [undated(2, 4), undated(1, 1)];
        assert_eq!(ranked(&entries)[0].urgent.number, 2);
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
