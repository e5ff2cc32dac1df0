//! Natural order of names: `storey-2` before `storey-10`.

use spandrel_bus::Name;
use std::cmp::Ordering;

/// A name ordered by its words and numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NaturalName(pub Name);

impl Ord for NaturalName {
    fn cmp(&self, other: &Self) -> Ordering {
        let (a, b) = (self.0.as_str(), other.0.as_str());
        let parts = pieces(a).map(Piece::new).cmp(pieces(b).map(Piece::new));
        parts.then_with(|| a.cmp(b)) // distinguishes `storey-02` and `storey-2`
    }
}

impl PartialOrd for NaturalName {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
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
        let mut names: Vec<NaturalName> = sorted
            .iter()
            .rev()
            .map(|text| NaturalName(Name::new(*text).unwrap()))
            .collect();
        names.sort();
        let found: Vec<&str> = names.iter().map(|name| name.0.as_str()).collect();
        assert_eq!(found, sorted);
    }
}
