//! Breaks text and lists of short items into lines.

use ratatui::text::{Line, Span};

/// Separator between items.
const SEPARATOR: &str = " · ";

/// Breaks a text between words. A word longer than a line is split.
pub fn wrap(text: &str, width: usize) -> Vec<String> {
    let width = width.max(1);
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let mut rest = word;
        while !rest.is_empty() {
            let used = lines
                .last()
                .map_or(0, |line| Span::raw(line.as_str()).width());
            let space = usize::from(used > 0);
            if used + space + Span::raw(rest).width() <= width {
                if let Some(line) = lines.last_mut() {
                    line.push_str(if space == 1 { " " } else { "" });
                    line.push_str(rest);
                }
                rest = "";
            } else if used > 0 {
                lines.push(String::new());
            } else {
                let (head, tail) = rest.split_at(fitting(rest, width));
                if let Some(line) = lines.last_mut() {
                    line.push_str(head);
                }
                rest = tail;
            }
        }
    }
    lines
}

/// Returns the length in bytes of the longest prefix that fits `width`, at least one character to
/// guarantee progress.
fn fitting(text: &str, width: usize) -> usize {
    let ends = text
        .char_indices()
        .map(|(at, letter)| at + letter.len_utf8());
    let fits = |end: &usize| Span::raw(&text[..*end]).width() <= width;
    let first = text.chars().next().map_or(0, char::len_utf8);
    ends.take_while(fits).last().unwrap_or(first)
}

/// Arranges items after a label. No item is split.
pub fn flow(label: &str, items: Vec<Span<'static>>, width: usize) -> Vec<Line<'static>> {
    let indent = Span::raw(label).width();
    let mut lines = vec![Line::from(label.to_owned())];
    for item in items {
        let used = lines.last().map_or(0, Line::width);
        let is_first = used <= indent;
        if !is_first && used + SEPARATOR.chars().count() + item.width() > width {
            lines.push(Line::from(" ".repeat(indent)));
        } else if !is_first && let Some(line) = lines.last_mut() {
            line.push_span(SEPARATOR);
        }
        if let Some(line) = lines.last_mut() {
            line.push_span(item);
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_breaks_between_words() {
        assert_eq!(
            wrap("storey-2 has lost 14 %", 10),
            ["storey-2", "has lost", "14 %"]
        );
        assert_eq!(wrap("", 10), [""]);
    }

    #[test]
    fn a_word_longer_than_a_line_is_cut() {
        assert_eq!(wrap("a bcdefgh i", 3), ["a", "bcd", "efg", "h i"]);
        assert_eq!(
            wrap("桁橋", 1),
            ["桁", "橋"],
            "a wide character is wider than the line"
        );
    }

    #[test]
    fn lines_break_only_between_items() {
        let items = ["ingest 0.1 s", "identify 0.2 s", "alert 0.3 s"]
            .map(Span::raw)
            .to_vec();
        let lines: Vec<String> = flow("lag  ", items, 36)
            .iter()
            .map(ToString::to_string)
            .collect();
        assert_eq!(
            lines,
            ["lag  ingest 0.1 s · identify 0.2 s", "     alert 0.3 s"]
        );
    }
}
