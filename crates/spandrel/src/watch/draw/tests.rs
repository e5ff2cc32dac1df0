use super::super::heard::Heard;
use super::super::testing::{
    alert, at, damaged_tower, heard, loss, name, node, parameter, present, progress, status,
};
use super::super::view::Around;
use super::*;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{KeyCode, KeyEvent};
use ratatui::style::Color;
use spandrel_bus::{AlertState, NodeHealth, Service, Standing};
use spandrel_listener::Input;

fn view(heard: Heard) -> View {
    let mut view = View::new(
        "below spandrel".to_owned(),
        Around::default(),
        "anna".to_owned(),
    );
    view.heard = heard;
    view
}

fn press(view: &mut View, codes: impl IntoIterator<Item = KeyCode>) {
    for code in codes {
        view.key(KeyEvent::from(code));
    }
}

fn drawn(view: &View, (width, height): (u16, u16)) -> Terminal<TestBackend> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw(view, frame)).unwrap();
    terminal
}

/// Returns the rows of the screen as text.
fn rows(view: &View, size: (u16, u16)) -> Vec<String> {
    let terminal = drawn(view, size);
    let buffer = terminal.backend().buffer();
    let row = |y: u16| {
        (0..size.0)
            .map(|x| buffer[(x, y)].symbol())
            .collect::<String>()
            .trim_end()
            .to_owned()
    };
    (0..size.1).map(row).collect()
}

/// Returns the index and text of the only row that contains `part`.
fn row_with<'r>(rows: &'r [String], part: &str) -> (usize, &'r str) {
    let mut found = rows
        .iter()
        .enumerate()
        .filter(|(_, row)| row.contains(part));
    let first = found
        .next()
        .unwrap_or_else(|| panic!("no row with {part:?} in\n{}", rows.join("\n")));
    assert!(
        found.next().is_none(),
        "more than one row with {part:?} in\n{}",
        rows.join("\n")
    );
    (first.0, first.1)
}

/// Returns a view of two structures: the tower, and a bridge with sixteen parameters.
fn tower_and_bridge() -> View {
    let mut heard = damaged_tower();
    for number in 1..=16 {
        let mut display = parameter(&format!("span-{number}"), 0, 1.0, 0.02);
        display.structure = name("bridge");
        heard.handle(Input::Parameter(display), &mut Vec::new());
        let mut lost = loss(&format!("span-{number}"), 0, 1.0);
        lost.structure = name("bridge");
        heard.handle(Input::Loss(lost), &mut Vec::new());
    }
    view(heard)
}

#[test]
fn small_terminal_shows_parameters_noise_services_alerts_and_events_from_top_to_bottom() {
    let rows = rows(&view(damaged_tower()), (80, 24));
    let (title, text) = row_with(&rows, "┌ tower · 1 raised");
    assert!(text.contains("2024-02-29 12:00:59 UTC"), "{text}");
    assert_eq!(title, 0);
    let (header, text) = row_with(&rows, "parameter");
    assert!(
        text.contains("mean ± std") && text.contains("P(loss > 5 %)") && text.contains("alert"),
        "{text}"
    );
    let storey_2 = row_with(&rows, "0.858 ± 0.011");
    assert_eq!((header, storey_2.0), (1, 3));
    assert!(
        storey_2.1.contains("storey-2")
            && storey_2.1.contains("99.7 %")
            && storey_2.1.contains("raised"),
        "{}",
        storey_2.1
    );
    assert!(
        storey_2.1.contains('●') && storey_2.1.contains('┊'),
        "{}",
        storey_2.1
    );
    let (noise, text) = row_with(&rows, "noise (std)");
    assert!(
        text.contains("floors 0.00500 ± 2 % · ground 0.100 ± 2 %"),
        "{text}"
    );
    let (services, text) = row_with(&rows, "services");
    assert!(
        text.contains("3 sensor nodes · ingest lag 0.12 s"),
        "{text}"
    );
    row_with(
        &rows[services + 1..],
        "identify lag 0.21 s, 3 overwritten · alert lag 0.25 s",
    );
    let (alerts, _) = row_with(&rows, " alerts · 1 raised");
    let (sentence, text) = row_with(&rows, "storey-2 has lost 14.2 %");
    assert!(text.starts_with("▶ raised"), "{text}");
    let (events, _) = row_with(&rows, " events ");
    let (event, text) = row_with(&rows, "floor-3 is no longer waited for");
    assert!(text.starts_with("  2024-02-29 12:00:00 UTC"), "{text}");
    let (keys, _) = row_with(&rows, "q quit");
    let order = [
        storey_2.0, noise, services, alerts, sentence, events, event, keys,
    ];
    assert!(order.is_sorted_by(|a, b| a < b), "{order:?}");
    assert_eq!(keys, 23);
}

#[test]
fn large_terminal_shows_the_trend_and_the_interval_in_numbers_too() {
    let rows = rows(&view(damaged_tower()), (140, 40));
    let (_, header) = row_with(&rows, "mean ± std   95 % interval");
    assert!(
        header.contains("last 62 s  0.80 ") && header.contains(" 1.05 "),
        "{header}"
    );
    let (_, storey_2) = row_with(&rows, "0.858 ± 0.011  0.836 to 0.880");
    assert!(
        storey_2.contains("▇▇▇▂▂▂"),
        "0.81 and 0.23 of the axis: {storey_2}"
    );
    assert!(
        storey_2.contains("0.858 ± 0.011") && storey_2.contains("raised"),
        "{storey_2}"
    );
    let (sentence, text) = row_with(&rows, "storey-2 has lost");
    assert!(
        text.contains("more than 5 % with probability 0.997"),
        "{text}"
    );
    assert_eq!(rows[sentence + 1].trim_start(), "2024-02-29 12:00:40 UTC");
    // The present loss agrees with the sentence, so it is not told again.
    assert!(
        !rows.iter().any(|row| row.contains("now: loss")),
        "{rows:?}"
    );
}

#[test]
fn bars_of_all_parameters_share_one_axis() {
    let rows = rows(&view(damaged_tower()), (140, 40));
    let limit = |part: &str| {
        row_with(&rows, part)
            .1
            .chars()
            .position(|letter| letter == '┊' || letter == '╋')
    };
    assert!(limit("storey-1").is_some());
    assert_eq!(limit("0.858 ± 0.011  0.836 to 0.880"), limit("storey-1"));
}

#[test]
fn raised_alert_is_red() {
    let terminal = drawn(&view(damaged_tower()), (80, 24));
    let buffer = terminal.backend().buffer();
    let word = (0..80).map(|x| buffer[(x, 3)].symbol()).collect::<String>();
    let at = word
        .chars()
        .collect::<Vec<_>>()
        .windows(6)
        .position(|letters| letters.iter().collect::<String>() == "raised");
    let cell = &buffer[(u16::try_from(at.unwrap()).unwrap(), 3)];
    assert_eq!(cell.fg, Color::Red);
}

#[test]
fn stale_data_are_marked_with_their_age() {
    let mut heard = damaged_tower();
    heard.handle(at(12), &mut Vec::new());
    let rows = rows(&view(heard), (80, 24));
    let (title, _) = row_with(&rows, "2024-02-29 12:00:59 UTC · stale 12 s");
    assert_eq!(title, 0);
    row_with(&rows, "ingest lag 0.12 s, stale 12 s");
}

#[test]
fn ended_service_is_marked() {
    let mut heard = damaged_tower();
    heard.handle(
        present(&[(Service::Ingest, "a"), (Service::Alert, "a")]),
        &mut Vec::new(),
    );
    row_with(
        &rows(&view(heard), (140, 40)),
        "identify lag 0.21 s, 3 overwritten, gone",
    );
}

#[test]
fn two_instances_of_a_service_are_distinguished() {
    let mut heard = damaged_tower();
    let mut second = status(Service::Identify, 4.0, &[]);
    second.id = name("b");
    second.restarts = 2;
    second.state = Some(Standing::StandingBy);
    heard.handle(Input::Status(second), &mut Vec::new());
    let rows = rows(&view(heard), (140, 40));
    row_with(&rows, "identify/a lag 0.21 s");
    row_with(&rows, "identify/b lag 4 s, standby, 2 restarts, gone");
}

#[test]
fn view_states_that_no_messages_have_arrived() {
    row_with(
        &rows(&view(Heard::default()), (80, 24)),
        "no messages yet below spandrel",
    );
    row_with(
        &rows(&view(heard([present(&[(Service::Ingest, "a")])])), (80, 24)),
        "┌ tower",
    );
}

#[test]
fn only_the_selected_structure_is_expanded_if_space_is_short() {
    let mut view = tower_and_bridge();
    let small = rows(&view, (80, 24));
    assert_eq!(row_with(&small, "▶ bridge").0, 0);
    row_with(&small, "span-1 ");
    row_with(&small, "more (PgUp, PgDn)");
    assert!(row_with(&small, " tower · 1 raised").0 > 0);
    assert!(
        !small.iter().any(|row| row.contains("0.858")),
        "the tower is a line only"
    );
    press(&mut view, [KeyCode::Tab]);
    let small = rows(&view, (80, 24));
    row_with(&small, "▶ tower");
    row_with(&small, "0.858 ± 0.011");
    row_with(&small, "tower: storey-2 has lost");
    let large = rows(&view, (140, 40));
    row_with(&large, "0.858 ± 0.011");
    row_with(&large, "span-16");
}

#[test]
fn page_keys_scroll_to_hidden_parameters() {
    let mut view = tower_and_bridge();
    press(&mut view, [KeyCode::PageDown, KeyCode::PageDown]);
    let small = rows(&view, (80, 24));
    row_with(&small, "span-16");
    assert!(!small.iter().any(|row| row.contains("span-1 ")));
}

#[test]
fn selected_alert_is_visible() {
    let mut heard = damaged_tower();
    for number in 6..30 {
        let raised = alert(
            &format!("storey-{number}"),
            i64::from(number),
            AlertState::Raised,
        );
        heard.handle(Input::Alert(raised), &mut Vec::new());
    }
    let mut view = view(heard);
    press(&mut view, std::iter::repeat_n(KeyCode::Down, 20));
    let rows = rows(&view, (80, 24));
    let (_, chosen) = row_with(&rows, "▶");
    assert!(chosen.contains("storey-10 has lost"), "{chosen}");
}

#[test]
fn acknowledgement_form_is_on_the_last_line() {
    let mut view = view(damaged_tower());
    press(&mut view, [KeyCode::Char('a')]);
    press(&mut view, "seen".chars().map(KeyCode::Char));
    let (row, text) = (
        rows(&view, (80, 24)),
        "acknowledge tower/storey-2   who: anna   note: seen▏",
    );
    assert_eq!(row_with(&row, text).0, 23);
    press(
        &mut view,
        "x".repeat(150)
            .chars()
            .chain("!".chars())
            .map(KeyCode::Char),
    );
    assert!(
        rows(&view, (80, 24))[23].ends_with("x!▏"),
        "a long note is seen at its end"
    );
}

#[test]
fn help_explains_keys_signs_and_states() {
    let mut view = view(damaged_tower());
    press(&mut view, [KeyCode::Char('?')]);
    let rows = rows(&view, (80, 24));
    for part in [
        "next or previous alert",
        "95 % interval, ratio to nominal",
        "acknowledged  raised, and someone",
    ] {
        row_with(&rows, part);
    }
}

#[test]
fn messages_that_could_not_be_shown_are_counted_on_the_last_line() {
    let mut view = view(damaged_tower());
    view.set_overwritten(7);
    assert!(rows(&view, (80, 24))[23].ends_with(" 7 messages not shown"));
}

#[test]
fn control_characters_of_texts_are_removed() {
    let mut steering = alert("storey-2", 50, AlertState::Raised);
    steering.why = "\u{1b}[2Jgone\r\nhere".to_owned();
    let mut heard = damaged_tower();
    heard.handle(Input::Alert(steering), &mut Vec::new());
    row_with(&rows(&view(heard), (80, 24)), "[2Jgone here");
}

#[test]
fn small_window_shows_parameters_and_alerts() {
    let rows = rows(&view(damaged_tower()), (60, 16));
    row_with(&rows, "0.858 ± 0.011");
    row_with(&rows, "storey-2 has lost");
}

#[test]
fn every_size_can_be_drawn() {
    let mut one = view(damaged_tower());
    let mut two = tower_and_bridge();
    for mode in ["", "?", "?a"] {
        press(&mut one, mode.chars().map(KeyCode::Char));
        press(&mut two, mode.chars().map(KeyCode::Char));
        for size in (1..160)
            .step_by(7)
            .flat_map(|width| (1..50).step_by(3).map(move |height| (width, height)))
        {
            drawn(&one, size);
            drawn(&two, size);
        }
    }
}

#[test]
fn selected_panel_receives_most_of_the_height() {
    assert_eq!(share_out(30, &[10, 12], 0), [10, 12]);
    assert_eq!(share_out(18, &[10, 12], 0), [10, 1]);
    assert_eq!(share_out(18, &[10, 30], 1), [1, 17]);
    assert_eq!(share_out(9, &[12; 6], 3), [0, 0, 1, 7, 1, 0]);
    assert_eq!(share_out(3, &[12, 12], 0), [3, 0]);
    assert_eq!(share_out(0, &[12, 12], 1), [0, 0]);
}

#[test]
fn each_local_filter_has_a_line_and_faulty_nodes_are_first() {
    let mut tower = damaged_tower();
    let mut excluded = node("floor-20", 60, NodeHealth::Excluded);
    excluded.excluded_since_ns = Some(excluded.time_ns - 60_000_000_000);
    let (alive, silent) = (
        node("floor-1", 60, NodeHealth::Used),
        node("floor-8", 60, NodeHealth::Silent),
    );
    for display in [alive, silent, excluded] {
        tower.handle(Input::Node(display), &mut Vec::new());
    }
    let rows = rows(&view(tower), (140, 40));
    let (counts, _) = row_with(&rows, "nodes        1 excluded · 1 silent · 1 alive");
    let (excluded, text) = row_with(&rows, "node floor-20");
    assert!(
        text.contains("✕ excluded since 2024-02-29 12:00:00 UTC  distance 2.1 of 5.4"),
        "{text}"
    );
    let (silent, text) = row_with(&rows, "node floor-8");
    assert!(text.contains("○ silent"), "{text}");
    let (alive, text) = row_with(&rows, "node floor-1 ");
    assert!(text.contains("● alive"), "{text}");
    assert_eq!(
        [excluded, silent, alive],
        [counts + 1, counts + 2, counts + 3]
    );
}

#[test]
fn structure_without_a_model_has_no_columns_of_parameters() {
    let services = [(Service::Ingest, "a"), (Service::Modes, "a")];
    let frames = Input::Ingested(name("tower"), progress(7, 60));
    let rows = rows(&view(heard([present(&services), frames])), (80, 24));
    row_with(&rows, "no model: natural frequencies only");
    for word in ["parameter", "mean ± std", "P(loss)"] {
        assert!(!rows.iter().any(|row| row.contains(word)), "{rows:#?}");
    }
}
