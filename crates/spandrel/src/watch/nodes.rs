//! Lines for distributed nodes: their state by the station, and their network traffic.

use super::heard::NodeHeard;
use super::wording::time;
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use spandrel_bus::{Name, NodeDisplay, NodeHealth};

/// States, the most urgent first.
const ORDER: [NodeHealth; 4] = [
    NodeHealth::Excluded,
    NodeHealth::Silent,
    NodeHealth::Used,
    NodeHealth::Ended,
];

fn word(state: NodeHealth) -> &'static str {
    match state {
        NodeHealth::Used => "alive",
        NodeHealth::Silent => "silent",
        NodeHealth::Excluded => "excluded",
        NodeHealth::Ended => "ended",
    }
}

/// Returns a sign that distinguishes the states without colours.
fn sign(state: NodeHealth) -> &'static str {
    match state {
        NodeHealth::Used => "●",
        NodeHealth::Silent => "○",
        NodeHealth::Excluded => "✕",
        NodeHealth::Ended => "■",
    }
}

fn style(state: NodeHealth) -> Style {
    match state {
        NodeHealth::Used => Style::new().fg(Color::Green),
        NodeHealth::Silent => Style::new().fg(Color::Yellow),
        NodeHealth::Excluded => Style::new().fg(Color::Red).add_modifier(Modifier::BOLD),
        NodeHealth::Ended => Style::new().add_modifier(Modifier::DIM),
    }
}

/// Returns `alive`, `silent since TIME`, `excluded since TIME` or `ended`.
fn state(display: &NodeDisplay) -> String {
    let since_ns = match display.state {
        NodeHealth::Silent => display.silent_since_ns,
        NodeHealth::Excluded => display.excluded_since_ns,
        NodeHealth::Used | NodeHealth::Ended => None,
    };
    let word = word(display.state);
    since_ns.map_or_else(
        || word.to_owned(),
        |since_ns| format!("{word} since {}", time(since_ns)),
    )
}

/// Returns the distance and its limit, such as `distance 2.1 of 5.4`, with the weight of a
/// discounted node.
///
/// Without a detector there is no distance.
fn distance(display: &NodeDisplay) -> String {
    let distance = match (display.distance, display.distance_limit) {
        (Some(distance), Some(limit)) => format!("distance {distance:.1} of {limit:.1}"),
        (Some(distance), None) => format!("distance {distance:.1}"),
        (None, _) => "distance –".to_owned(),
    };
    match display
        .weight
        .filter(|weight| *weight > 0.0 && *weight < 1.0)
    {
        Some(weight) => format!("{distance}, counts {weight:.2}"),
        None => distance,
    }
}

/// Returns the payload per second from and to the node, as counted by the station.
fn rates(heard: &NodeHeard) -> String {
    match heard.bytes_per_s() {
        Some((from, to)) => format!("{from:.0} B/s from it, {to:.0} B/s to it"),
        None => "– B/s".to_owned(),
    }
}

/// Returns the plain line of a node: `TIME node STRUCTURE/NODE STATE, DISTANCE, RATES`.
pub fn plain_line(structure: &Name, heard: &NodeHeard) -> String {
    let display = heard.display();
    let NodeDisplay { node, time_ns, .. } = display;
    format!(
        "{} node {structure}/{node} {}, {}, {}",
        time(*time_ns),
        state(display),
        distance(display),
        rates(heard)
    )
}

/// Returns the lines of the nodes in a panel.
///
/// The first line counts the nodes in each state. Each further line is one node, the most urgent
/// first. There are no lines without nodes.
pub fn panel_lines<'h>(nodes: impl Iterator<Item = &'h NodeHeard>) -> Vec<Line<'static>> {
    let mut nodes: Vec<&NodeHeard> = nodes.collect();
    if nodes.is_empty() {
        return Vec::new();
    }
    nodes.sort_by_key(|heard| {
        ORDER
            .iter()
            .position(|state| *state == heard.display().state)
    });
    let count = |state: NodeHealth| {
        nodes
            .iter()
            .filter(|heard| heard.display().state == state)
            .count()
    };
    let counts = ORDER.into_iter().filter(|state| count(*state) > 0);
    let counts: Vec<String> = counts
        .map(|state| format!("{} {}", count(state), word(state)))
        .collect();
    let nodes = nodes.iter().copied();
    let widest = |of: fn(&NodeDisplay) -> String| {
        nodes
            .clone()
            .map(|heard| of(heard.display()).chars().count())
            .max()
    };
    let name = widest(|display| display.node.to_string()).unwrap_or(0);
    let (of_state, of_distance) = (widest(state).unwrap_or(0), widest(distance).unwrap_or(0));
    let line = |heard: &NodeHeard| {
        let display = heard.display();
        Line::from_iter([
            Span::raw(format!("node {:<name$}  ", display.node.as_str())),
            Span::styled(
                format!("{} {:<of_state$}", sign(display.state), state(display)),
                style(display.state),
            ),
            Span::raw(format!(
                "  {:<of_distance$}  {}",
                distance(display),
                rates(heard)
            )),
        ])
    };
    std::iter::once(Line::from(format!("nodes        {}", counts.join(" · "))))
        .chain(nodes.clone().map(line))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::testing::{heard, name, node};
    use super::*;
    use spandrel_listener::Input;

    fn lines(inputs: impl IntoIterator<Item = Input>) -> Vec<String> {
        let heard = heard(inputs);
        let tower = name("tower");
        let nodes = heard.nodes(&tower);
        nodes.map(|node| plain_line(&tower, node)).collect()
    }

    #[test]
    fn line_of_a_node_has_state_distance_and_traffic() {
        let mut silent = node("floor-8", 60, NodeHealth::Silent);
        (silent.silent_since_ns, silent.distance) = (Some(silent.time_ns - 12_000_000_000), None);
        let mut excluded = node("floor-20", 60, NodeHealth::Excluded);
        (excluded.excluded_since_ns, excluded.distance) =
            (Some(excluded.time_ns - 60_000_000_000), Some(21.13));
        let before = node("floor-20", 50, NodeHealth::Used);
        assert_eq!(
            lines([silent, before, excluded].map(Input::Node)),
            [
                "2024-02-29 12:01:00 UTC node tower/floor-8 silent since 2024-02-29 12:00:48 UTC, \
                 distance –, – B/s",
                "2024-02-29 12:01:00 UTC node tower/floor-20 excluded since 2024-02-29 12:00:00 \
                 UTC, distance 21.1 of 5.4, 500 B/s from it, 100 B/s to it",
            ]
        );
    }

    #[test]
    fn line_of_a_discounted_node_has_its_weight() {
        let mut discounted = node("floor-20", 60, NodeHealth::Used);
        (discounted.distance, discounted.weight) = (Some(7.2), Some(0.5625));
        assert_eq!(
            lines([Input::Node(discounted)]),
            [
                "2024-02-29 12:01:00 UTC node tower/floor-20 alive, distance 7.2 of 5.4, counts \
                 0.56, – B/s"
            ]
        );
    }

    #[test]
    fn traffic_covers_the_last_seconds_and_restarts_with_the_station() {
        let mut late = node("floor-1", 200, NodeHealth::Used);
        late.bytes_received += 1000;
        let told =
            lines((0..200).map(|second| Input::Node(node("floor-1", second, NodeHealth::Used))));
        assert!(
            told[0].ends_with("500 B/s from it, 100 B/s to it"),
            "{told:?}"
        );
        let told = lines([
            Input::Node(late),
            Input::Node(node("floor-1", 1, NodeHealth::Used)),
        ]);
        assert!(told[0].ends_with("– B/s"), "{told:?}");
    }
}
