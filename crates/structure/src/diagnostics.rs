//! Collects all mistakes in one structure file, so that one message reports them all.

use crate::error::Diagnostic;
use std::cell::RefCell;
use std::ops::Range;
use std::path::Path;

/// Maximum edit distance of a suggested name; more distant names are different words.
const CLOSEST_SUGGESTION: usize = 3;

/// Maximum number of names in a list of alternatives.
const MOST_LISTED: usize = 20;

/// A list of mistakes in a file, with the line starts that convert byte positions to line numbers.
///
/// The readers of all tables share it, hence the interior mutability.
pub(crate) struct Diagnostics<'t> {
    path: &'t Path,
    line_starts: Vec<usize>,
    found: RefCell<Vec<Diagnostic>>,
}

impl<'t> Diagnostics<'t> {
    pub(crate) fn new(path: &'t Path, text: &str) -> Self {
        let after_breaks = text
            .bytes()
            .enumerate()
            .filter(|(_, byte)| *byte == b'\n')
            .map(|(at, _)| at + 1);
        Self {
            path,
            line_starts: std::iter::once(0).chain(after_breaks).collect(),
            found: RefCell::default(),
        }
    }

    /// Adds one mistake at the bytes `span` of the file.
    pub(crate) fn report(
        &self,
        span: Range<usize>,
        key: impl Into<String>,
        found: impl Into<String>,
        allowed: impl Into<String>,
    ) {
        let line = self
            .line_starts
            .partition_point(|start| *start <= span.start);
        self.found
            .borrow_mut()
            .push(Diagnostic::new(self.path, line, key, found, allowed));
    }

    /// Returns the path of the structure file. Other files are relative to it.
    pub(crate) fn path(&self) -> &Path {
        self.path
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.found.borrow().is_empty()
    }

    /// Returns all mistakes in file order.
    pub(crate) fn into_sorted(self) -> Vec<Diagnostic> {
        let mut found = self.found.into_inner();
        found.sort_by_key(Diagnostic::line);
        found
    }
}

/// Returns the nearest of the `known` names as a suggestion, or the list of all names.
pub(crate) fn one_of<'k>(unknown: &str, known: impl Iterator<Item = &'k str> + Clone) -> String {
    match known
        .clone()
        .map(|name| (edit_distance(unknown, name), name))
        .min()
    {
        Some((distance, name))
            if distance <= CLOSEST_SUGGESTION
                && distance < unknown.len()
                && !differs_by_number(unknown, name) =>
        {
            format!("did you mean \"{name}\"?")
        }
        Some(_) => match &known.collect::<Vec<_>>()[..] {
            [one] => format!("must be {one}"),
            all @ [first, second, .., last] if all.len() > MOST_LISTED => {
                format!(
                    "must be one of {first}, {second}, …, {last} ({} in all)",
                    all.len()
                )
            }
            all => format!("must be one of {}", all.join(", ")),
        },
        None => "none is declared".to_owned(),
    }
}

/// Returns `true` if two names differ only in their digits.
///
/// An unknown storey number, for example, is not a misspelling of another storey.
fn differs_by_number(a: &str, b: &str) -> bool {
    let letters = |name: &str| {
        name.chars()
            .filter(|c| !c.is_ascii_digit())
            .collect::<String>()
    };
    a.bytes().any(|byte| byte.is_ascii_digit()) && letters(a) == letters(b)
}

/// Formats a count with its noun, in the singular for 1.
pub(crate) fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

/// Returns the Levenshtein distance: insertions, deletions and replacements that turn `a` into `b`.
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut diagonal = i;
        row[0] = i + 1;
        for (j, to) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(from != *to);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn similar_name_is_suggested_and_otherwise_the_names_are_listed() {
        let known = ["half-life-s", "noise-rule"];
        assert_eq!(
            one_of("half-live-s", known.into_iter()),
            "did you mean \"half-life-s\"?"
        );
        assert_eq!(
            one_of("colour", known.into_iter()),
            "must be one of half-life-s, noise-rule"
        );
    }

    #[test]
    fn names_are_listed_if_only_the_number_is_wrong() {
        let storeys: Vec<String> = (1..=40).map(|storey| format!("storey-{storey}")).collect();
        let known = |count: usize| storeys[..count].iter().map(String::as_str);
        assert_eq!(
            one_of("storey-4", known(3)),
            "must be one of storey-1, storey-2, storey-3"
        );
        assert_eq!(
            one_of("storey-41", known(40)),
            "must be one of storey-1, storey-2, …, storey-40 (40 in all)"
        );
        assert_eq!(one_of("story-4", known(40)), "did you mean \"storey-4\"?");
        assert_eq!(one_of("storey-2", known(1)), "must be storey-1");
    }

    #[test]
    fn count_of_one_is_in_the_singular() {
        assert_eq!(
            [1, 2].map(|count| counted(count, "entry", "entries")),
            ["1 entry", "2 entries"]
        );
    }

    #[test]
    fn position_is_converted_to_its_line() {
        let diagnostics = Diagnostics::new(Path::new("a.toml"), "a\nb\nc");
        for at in 0..5 {
            diagnostics.report(at..at, "k", "f", "a");
        }
        let lines: Vec<usize> = diagnostics
            .into_sorted()
            .iter()
            .map(Diagnostic::line)
            .collect();
        assert_eq!(lines, [1, 1, 2, 2, 3]);
    }
}
