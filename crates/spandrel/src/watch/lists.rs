//! The lists below the structures: open alerts with their sentences, and the last events.

use super::heard::Heard;
use super::open_alert::{AlertKind, OpenAlert};
use super::view::View;
use super::wording::{printable, state_counts, state_style, time};
use super::wrap::wrap;
use ratatui::style::Modifier;
use ratatui::text::{Line, Span};
use spandrel_bus::{Event, Name};

/// Width of the mark and of `acknowledged`, the longest state.
const BEFORE_SENTENCE: usize = 2 + 12 + 2;
/// Indentation of the continuation lines of an event.
const EVENT_INDENT: usize = 2;

/// Whether entries must name their structure.
#[derive(Debug, Clone, Copy)]
enum Structures {
    One,
    Several,
}

impl Structures {
    fn of(heard: &Heard) -> Self {
        if heard.structures().len() > 1 {
            Self::Several
        } else {
            Self::One
        }
    }

    fn prefix(self, structure: &Name) -> String {
        match self {
            Self::One => String::new(),
            Self::Several => format!("{structure}: "),
        }
    }
}

/// Returns the title of the alert list, with the number of alerts in each state.
pub fn alerts_title(heard: &Heard) -> Line<'static> {
    let mut line = Line::from(Span::styled("alerts", Modifier::BOLD));
    let open = heard.open_alerts().into_iter();
    line.extend(state_counts(open.map(OpenAlert::state)));
    line
}

/// Returns the lines of the open alerts, newest first, such that the selected alert is visible.
pub fn alert_lines(view: &View, width: usize, height: usize) -> Vec<Line<'static>> {
    let alerts = view.heard.open_alerts();
    let Some(selected) = view.selected_alert_index(&alerts) else {
        return vec![Line::from("  none").style(Modifier::DIM)];
    };
    let structures = Structures::of(&view.heard);
    let mut entries: Vec<Vec<Line<'static>>> = alerts
        .iter()
        .map(|alert| alert_entry(&view.heard, *alert, structures, width))
        .collect();
    mark(&mut entries[selected]);
    let mut first = 0;
    while first < selected
        && entries[first..=selected]
            .iter()
            .map(Vec::len)
            .sum::<usize>()
            > height
    {
        first += 1;
    }
    entries.into_iter().skip(first).flatten().collect()
}

fn alert_entry(
    heard: &Heard,
    alert: OpenAlert<'_>,
    structures: Structures,
    width: usize,
) -> Vec<Line<'static>> {
    let kind = alert.id().kind;
    let stale = match heard.is_stale(alert) {
        true => format!("stale (the {} is gone): ", kind.service()),
        false => String::new(),
    };
    let kind = match kind {
        AlertKind::Rule => "",
        AlertKind::LastingLoss => "lasting loss: ",
    };
    let whose = structures.prefix(alert.structure());
    let sentence = printable(&format!("{stale}{whose}{kind}{}", alert.words()));
    let state = alert.state();
    let state = Span::styled(format!("{:<14}", state.as_str()), state_style(state));
    let mut lines = wrap(&sentence, width.saturating_sub(BEFORE_SENTENCE));
    // The sentence describes the time of the change, so add the current loss.
    let structure = heard.structure(alert.structure());
    let now = structure.and_then(|structure| match alert {
        OpenAlert::Rule(alert) => structure.present_loss(alert),
        OpenAlert::Lasting(..) => None,
    });
    if let Some(now) = now {
        let is_stale = structure.is_some_and(|of| of.stale_for().is_some());
        let when = if is_stale { "by the last value" } else { "now" };
        lines.extend(wrap(
            &format!("{when}: {now}"),
            width.saturating_sub(BEFORE_SENTENCE),
        ));
    }
    let with_head = lines
        .into_iter()
        .enumerate()
        .map(|(index, text)| match index {
            0 => Line::from_iter([Span::raw("  "), state.clone(), Span::raw(text)]),
            _ => Line::from(format!("{}{text}", " ".repeat(BEFORE_SENTENCE))),
        });
    with_head.collect()
}

/// Marks an entry as selected.
fn mark(entry: &mut [Line<'static>]) {
    if let Some(margin) = entry.first_mut().and_then(|line| line.spans.first_mut()) {
        *margin = Span::raw("▶ ");
    }
    for line in entry {
        line.style = line.style.add_modifier(Modifier::BOLD);
    }
}

/// Returns the lines of the last events, newest first.
pub fn event_lines(heard: &Heard, width: usize) -> Vec<Line<'static>> {
    let structures = Structures::of(heard);
    let lines: Vec<Line<'static>> = heard
        .events()
        .flat_map(|event| event_entry(event, structures, width))
        .collect();
    if lines.is_empty() {
        return vec![Line::from("  none").style(Modifier::DIM)];
    }
    lines
}

fn event_entry(event: &Event, structures: Structures, width: usize) -> Vec<Line<'static>> {
    let Event {
        structure,
        time_ns,
        subject,
        what,
        why,
        ..
    } = event;
    let whose = structures.prefix(structure);
    let subject = if what.contains(subject.as_str()) {
        String::new()
    } else {
        format!("{subject}: ")
    };
    let why = if why.is_empty() {
        String::new()
    } else {
        format!(" ({why})")
    };
    let text = printable(&format!("{}  {whose}{subject}{what}{why}", time(*time_ns)));
    let lines = wrap(&text, width.saturating_sub(EVENT_INDENT));
    lines
        .into_iter()
        .map(|text| Line::from(format!("{}{text}", " ".repeat(EVENT_INDENT))))
        .collect()
}
