//! Natural order of names: `storey-2` before `storey-10`.

use spandrel_bus::Name;
use std::cmp::Ordering;

/// Returns the entries of a map in the natural order of their names.
pub fn in_order<'m, V>(map: impl IntoIterator<Item = (&'m Name, &'m V)>) -> Vec<(&'m Name, &'m V)> {
    let mut entries: Vec<(&Name, &V)> = map.into_iter().collect();
    entries.sort_by(|(a, _), (b, _)| compare(a, b));
    entries
}

/// Compares names by their words and numbers.
fn compare(a: &Name, b: &Name) -> Ordering {
    let (a, b) = (a.as_str(), b.as_str());
    let parts = pieces(a).map(Piece::new).cmp(pieces(b).map(Piece::new));
    parts.then_with(|| a.cmp(b)) // distinguishes `storey-02` and `storey-2`
}

/// A run of digits, or of other characters.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Piece<'n> {
    /// Digits without leading zeros, after their count. The shorter of two numbers is smaller.
    Number(usize, &'n str),
    Word(&'n str),
}

impl<'n> Piece<'n> {
    fn new(text: &'n str) -> Self {
        if !text.starts_with(|c: char| c.is_ascii_digit()) {
            return Self::Word(text);
        }
        let digits = text.trim_start_matches('0');
        Self::Number(digits.len(), digits)
    }
}

fn pieces(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = text;
    std::iter::from_fn(move || {
        let is_digit = rest.chars().next()?.is_ascii_digit();
        let end = rest
            .find(|c: char| c.is_ascii_digit() != is_digit)
            .unwrap_or(rest.len());
        let (piece, after) = rest.split_at(end);
        rest = after;
        Some(piece)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_are_ordered_by_value() {
        let sorted = [
            "alpha",
            "storey-1",
            "storey-02",
            "storey-2",
            "storey-2-a",
            "storey-10",
            "storey-99999999999999999999",
        ];
        let mut names: Vec<Name> = sorted
            .iter()
            .rev()
            .map(|text| Name::new(*text).unwrap())
            .collect();
        names.sort_by(compare);
        let found: Vec<&str> = names.iter().map(Name::as_str).collect();
        assert_eq!(found, sorted);
    }
}
