//! The whole screen: structures, alerts, events, and the line of keys.

use super::form::{Field, Form};
use super::lists::{alert_lines, alerts_title, event_lines};
use super::open_alert::AlertId;
use super::structure_panel::StructurePanel;
use super::view::{Mode, View};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Borders, Clear, Padding, Paragraph, Wrap};
use spandrel_bus::Name;
use spandrel_listener::StructureState;

/// Minimum size of the window. A smaller one only shows that it is too small.
const SMALLEST: (u16, u16) = (40, 12);
/// Minimum heights of the lists, including their titles.
const ALERTS_AT_LEAST: u16 = 4;
const EVENTS_AT_LEAST: u16 = 2;
/// Number of lines of a panel that its borders take.
const BORDERS: u16 = 2;
/// Minimum height of a panel with a parameter row.
const PANEL_AT_LEAST: u16 = 7;
/// Number of columns of a panel that its borders take, with a space on each side.
const MARGINS: u16 = 4;

const KEYS: &str = "q quit   Tab structure   ↑↓ alert   a acknowledge   ? help";

const HELP: &str = "\
Tab, ← →      next or previous structure
↑ ↓           next or previous alert
PgUp, PgDn    scroll the parameters
a             acknowledge the chosen alert: name and note
q, Esc        quit

━━●━━  estimate with its 95 % interval, ratio to nominal
┊ ╋    threshold of the alert
│      reference of the loss
▁▄█    the last minutes, on the axis of the bars

–             no decision yet
stale         the alert service is gone
learning      the reference is being learnt
normal        no loss with the required credibility
pending       a loss, but not yet for the required time
raised        a loss for the required time
acknowledged  raised, and someone has seen it
cleared       was raised, the loss is gone

● ○ ✕ ■       a node is alive, silent, excluded, ended";

/// Draws the whole screen.
pub fn draw(view: &View, frame: &mut Frame<'_>) {
    let area = frame.area();
    if area.width < SMALLEST.0 || area.height < SMALLEST.1 {
        let (width, height) = SMALLEST;
        frame.render_widget(
            Paragraph::new(format!("window too small, needs {width} x {height}")),
            area,
        );
        return;
    }
    let [main, last] = Layout::vertical([Constraint::Fill(1), Constraint::Length(1)]).areas(area);
    draw_main(view, frame, main);
    match view.mode() {
        Mode::Watching => draw_keys(view, frame, last),
        Mode::Help => {
            draw_help(frame, main);
            frame.render_widget(
                Line::from("any key to continue, q to quit").style(Modifier::DIM),
                last,
            );
        }
        Mode::Acknowledging { alert, form } => draw_form(frame, last, alert, form),
    }
}

fn draw_main(view: &View, frame: &mut Frame<'_>, area: Rect) {
    if view.heard.structures().len() == 0 {
        frame.render_widget(
            Paragraph::new(view.nothing_heard()).wrap(Wrap { trim: true }),
            area,
        );
        return;
    }
    let structures: Vec<(&Name, &StructureState)> = view.heard.structures().collect();
    let selected = view.selected_structure().map(|(name, _)| name);
    let selected = structures
        .iter()
        .position(|(name, _)| Some(*name) == selected)
        .unwrap_or(0);
    let width = usize::from(area.width.saturating_sub(MARGINS));
    let panels: Vec<StructurePanel> = structures
        .iter()
        .map(|(name, structure)| StructurePanel::new(&view.heard, name, structure, width))
        .collect();
    let wanted: Vec<u16> = panels
        .iter()
        .map(|panel| {
            u16::try_from(panel.len())
                .unwrap_or(u16::MAX)
                .saturating_add(BORDERS)
        })
        .collect();
    let room = area
        .height
        .saturating_sub(ALERTS_AT_LEAST + EVENTS_AT_LEAST);
    let heights = share_out(room, &wanted, selected);
    let mut rest = area;
    for (index, (panel, height)) in panels.into_iter().zip(heights).enumerate() {
        let [here, below] =
            Layout::vertical([Constraint::Length(height), Constraint::Fill(1)]).areas(rest);
        rest = below;
        let choice = match (structures.len(), index == selected) {
            (1, _) => Choice::Only,
            (_, true) => Choice::Chosen,
            (_, false) => Choice::Other,
        };
        draw_panel(frame, here, panel, choice, view.first_parameter());
    }
    draw_lists(view, frame, rest);
}

/// Returns the height of each panel.
///
/// If there is room, every panel has its full height. Otherwise the selected panel takes the room
/// and the others have one line. Panels without room have height 0.
fn share_out(room: u16, wanted: &[u16], selected: usize) -> Vec<u16> {
    let total: u32 = wanted.iter().map(|height| u32::from(*height)).sum();
    if total <= u32::from(room) {
        return wanted.to_vec();
    }
    let mut heights = vec![0; wanted.len()];
    let own = wanted.get(selected).copied().unwrap_or(0);
    let lines_for_others = u16::try_from(wanted.len() - 1).unwrap_or(u16::MAX);
    let kept = room
        .saturating_sub(own.min(PANEL_AT_LEAST))
        .min(lines_for_others);
    heights[selected] = own.min(room - kept);
    let mut left = room - heights[selected];
    // Neighbours of the selected panel first, so that Tab selects a visible panel.
    let mut others: Vec<usize> = (0..wanted.len())
        .filter(|index| *index != selected)
        .collect();
    others.sort_by_key(|index| index.abs_diff(selected));
    for index in others {
        heights[index] = left.min(1);
        left -= left.min(1);
    }
    heights
}

/// Whether the keys apply to a panel.
#[derive(Debug, Clone, Copy)]
enum Choice {
    Only,
    Chosen,
    Other,
}

fn draw_panel(
    frame: &mut Frame<'_>,
    area: Rect,
    panel: StructurePanel,
    choice: Choice,
    first: usize,
) {
    if area.height == 0 {
        return;
    }
    let (mark, first, style) = match choice {
        Choice::Only => (" ", first, Style::new()),
        Choice::Chosen => (" ▶ ", first, Style::new()),
        Choice::Other => ("   ", 0, Style::new().add_modifier(Modifier::DIM)),
    };
    let mut title = panel.title.clone();
    title.spans.insert(0, Span::raw(mark));
    title.push_span(" ");
    let mut time = panel.time.clone();
    time.spans.insert(0, Span::raw(" "));
    time.push_span(" ");
    let borders = if area.height > BORDERS {
        Borders::ALL
    } else {
        Borders::TOP
    };
    let block = Block::new()
        .borders(borders)
        .border_style(style)
        .padding(Padding::horizontal(1))
        .title(title)
        .title(time.right_aligned());
    let inner = block.inner(area);
    frame.render_widget(block, area);
    frame.render_widget(
        Paragraph::new(panel.into_lines(usize::from(inner.height), first)),
        inner,
    );
}

fn draw_lists(view: &View, frame: &mut Frame<'_>, area: Rect) {
    let width = usize::from(area.width);
    let events = event_lines(&view.heard, width);
    let with_title = |lines: usize| u16::try_from(lines + 1).unwrap_or(u16::MAX);
    let left_by_alerts = area
        .height
        .saturating_sub(with_title(alert_lines(view, width, usize::MAX).len()));
    let events_height =
        with_title(events.len()).min(left_by_alerts.max(area.height * 2 / 5).max(EVENTS_AT_LEAST));
    let [alerts_area, events_area] =
        Layout::vertical([Constraint::Fill(1), Constraint::Length(events_height)]).areas(area);
    let list = |title: Line<'static>| {
        let mut title = title;
        title.spans.insert(0, Span::raw(" "));
        title.push_span(" ");
        Block::new().borders(Borders::TOP).title(title)
    };
    let alerts = alert_lines(
        view,
        width,
        usize::from(alerts_area.height.saturating_sub(1)),
    );
    frame.render_widget(
        Paragraph::new(alerts).block(list(alerts_title(&view.heard))),
        alerts_area,
    );
    let title = Line::from(Span::styled("events", Modifier::BOLD));
    frame.render_widget(Paragraph::new(events).block(list(title)), events_area);
}

fn draw_keys(view: &View, frame: &mut Frame<'_>, area: Rect) {
    let line = match (view.notice(), view.page()) {
        (Some(notice), _) => Line::from(notice.to_owned()).style(Modifier::REVERSED),
        (None, Some(page)) => Line::from(format!("{KEYS}   page {page}")).style(Modifier::DIM),
        (None, None) => Line::from(KEYS).style(Modifier::DIM),
    };
    frame.render_widget(line, area);
    let unseen = view.overwritten() + view.heard.left_out();
    if unseen > 0 {
        let line = Line::from(format!(" {unseen} messages not shown")).right_aligned();
        let width = u16::try_from(line.width())
            .unwrap_or(u16::MAX)
            .min(area.width);
        let [_, right] =
            Layout::horizontal([Constraint::Fill(1), Constraint::Length(width)]).areas(area);
        frame.render_widget(line, right);
    }
}

fn draw_form(frame: &mut Frame<'_>, area: Rect, alert: &AlertId, form: &Form) {
    let mark = |field: Field| if form.field == field { "▏" } else { "" };
    let style = |field: Field| {
        if form.field == field {
            Style::new().add_modifier(Modifier::REVERSED)
        } else {
            Style::new()
        }
    };
    let mut line = Line::from_iter([
        Span::raw(format!("acknowledge {alert}  ")),
        Span::styled(
            format!(" who: {}{} ", form.who, mark(Field::Who)),
            style(Field::Who),
        ),
        Span::raw(" "),
        Span::styled(
            format!(" note: {}{} ", form.note, mark(Field::Note)),
            style(Field::Note),
        ),
    ]);
    let hint = "  Tab field, Enter send, Esc back";
    if line.width() + hint.len() <= usize::from(area.width) {
        line.push_span(Span::styled(hint, Modifier::DIM));
    }
    // Right-aligned, so that the end of a long note is visible while typing.
    let line = if line.width() > usize::from(area.width) {
        line.right_aligned()
    } else {
        line
    };
    frame.render_widget(line, area);
}

fn draw_help(frame: &mut Frame<'_>, area: Rect) {
    let width = HELP
        .lines()
        .map(|line| Line::from(line).width())
        .max()
        .unwrap_or(0)
        + usize::from(MARGINS);
    let height = HELP.lines().count() + usize::from(BORDERS);
    let fit = |wanted: usize, most: u16| u16::try_from(wanted).unwrap_or(most).min(most);
    let (width, height) = (fit(width, area.width), fit(height, area.height));
    let [column] = Layout::horizontal([Constraint::Length(width)])
        .flex(ratatui::layout::Flex::Center)
        .areas(area);
    let [help] = Layout::vertical([Constraint::Length(height)])
        .flex(ratatui::layout::Flex::Center)
        .areas(column);
    frame.render_widget(Clear, help);
    let block = Block::bordered()
        .padding(Padding::horizontal(1))
        .title(" spandrel watch ");
    frame.render_widget(Paragraph::new(HELP).block(block), help);
}

#[cfg(test)]
mod tests;
