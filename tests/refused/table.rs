//! The table of docs/reliability.md: the inputs, their expected effects and their observed effects.

use crate::support::Finished;
use std::fmt::Write as _;
use std::path::Path;

/// Lines of the page that enclose the table.
const BEGIN: &str = "<!-- table: written by the test of tests/refused -->\n";
const END: &str = "<!-- end of the table -->\n";
/// Maximum length of a shown text (characters).
const LONGEST: usize = 240;

/// All bad inputs that were tried.
#[derive(Default)]
pub struct Table {
    text: String,
    wrong: String,
    rows: usize,
}

impl Table {
    /// Begins the inputs of one kind.
    pub fn section(&mut self, heading: &str) {
        let _ = write!(
            self.text,
            "\n### {heading}\n\n| bad input | expected | observed |\n|---|---|---|\n"
        );
    }

    /// Adds an input. `is_right` states whether the observed effect is the expected one.
    pub fn add(&mut self, given: &str, expected: &str, observed: &str, is_right: bool) {
        let observed = one_line(observed);
        self.rows += 1;
        let _ = writeln!(
            self.text,
            "| {given} | {} | {} |",
            expected.replace('|', "\\|"),
            code(&observed)
        );
        if !is_right {
            let _ = writeln!(
                self.wrong,
                "{given}\n  expected {expected}\n  observed {observed}"
            );
        }
    }

    /// Adds an input that ends a command, with its exit code and what its error names.
    pub fn add_ended(
        &mut self,
        given: &str,
        (expected, told): (i32, &[String]),
        finished: &Finished,
    ) {
        let said = said(&finished.stderr);
        let is_told = told.iter().all(|part| said.contains(part.as_str()));
        let is_right =
            finished.code == Some(expected) && is_told && !finished.stderr.contains("panicked");
        let named: Vec<String> = told.iter().map(|part| code(part)).collect();
        let code = finished
            .code
            .map_or("a signal".to_owned(), |code| format!("{code}"));
        let observed = format!("{code}: {said}");
        self.add(
            given,
            &format!("code {expected}, naming {}", named.join(", ")),
            &observed,
            is_right,
        );
    }

    /// Fails if any effect differs from the expected one. Then compares the table with the page, or
    /// writes it.
    pub fn compare_with_the_page(&self, least: usize) {
        assert!(self.wrong.is_empty(), "\n{}", self.wrong);
        assert!(
            self.rows >= least,
            "{} bad inputs, expected at least {least}",
            self.rows
        );
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reliability.md");
        let page = std::fs::read_to_string(&path).unwrap();
        let (before, rest) = page.split_once(BEGIN).unwrap();
        let (kept, after) = rest.split_once(END).unwrap();
        let table = format!("{}\n", self.text);
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::write(&path, format!("{before}{BEGIN}{table}{END}{after}")).unwrap();
            return;
        }
        let differs = kept
            .lines()
            .zip(table.lines())
            .find(|(kept, seen)| kept != seen);
        assert!(
            kept == table,
            "docs/reliability.md differs from the observed effects ({differs:?}); UPDATE_DOCS=1 \
             rewrites it"
        );
    }
}

/// Returns the error of a program with its causes, without the text that follows.
fn said(stderr: &str) -> String {
    let from = stderr
        .find("error: ")
        .map_or(stderr, |at| &stderr[at + "error: ".len()..]);
    let usage = from
        .find("\n\nUsage:")
        .or_else(|| from.find("\n\nFor more"));
    from[..usage.unwrap_or(from.len())].to_owned()
}

fn one_line(text: &str) -> String {
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    match text.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

/// Formats a text as inline code in a table cell, even if it contains backticks.
pub fn code(text: &str) -> String {
    let text = text.replace('|', "\\|");
    if text.contains('`') {
        format!("`` {text} ``")
    } else {
        format!("`{text}`")
    }
}
