//! One structure on the screen: its parameters, noise levels and services.

use super::conditions::condition_spans;
use super::estimate_bar::{Axis, Marks};
use super::heard::{Heard, Origin, ParameterHeard};
use super::judgements::judgement_spans;
use super::modes::mode_spans;
use super::natural_name::in_order;
use super::nodes::panel_lines;
use super::trail::Trail;
use super::wording::{
    NO_MODEL, duration, estimate, lag, nothing_measured, printable, probability, share,
    significant, state_counts, state_style, time,
};
use super::wrap::flow;
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use spandrel_bus::{
    AlertMessage, AlertState, FitDisplay, FitVerdict, JudgementDisplay, Load, LossDisplay,
    ModelClassDisplay, MonitoringState, Name, NoiseDisplay, Service, Standing,
};
use spandrel_listener::{InstanceState, StructureState};

/// Gap between columns.
const GAP: &str = "  ";
/// Maximum length of a name that is shown in full.
const LONGEST_NAME: usize = 20;
/// Width of `acknowledged`, the longest state.
const STATE: usize = 12;
/// Widths of `0.858 ± 0.011` and `0.836 to 0.880`.
const ESTIMATE: usize = 13;
const INTERVAL: usize = 14;
/// Minimum width for showing a trend and the interval in numbers.
const WIDE: usize = 110;
/// Number of parameter rows with precedence over the services.
const ROWS_AT_LEAST: usize = 4;
/// Minimum width of a bar.
const NARROWEST_BAR: usize = 8;

/// Contents of the panel of one structure.
pub struct StructurePanel {
    pub title: Line<'static>,
    /// Measurement time at the right of the title, or a note that the data is stale.
    pub time: Line<'static>,
    /// Names of the columns. `None` for a structure without parameters, whose natural frequencies
    /// are followed.
    header: Option<Line<'static>>,
    rows: Vec<Line<'static>>,
    /// Noise levels, model classes, services and distributed nodes.
    footer: Vec<Line<'static>>,
    /// Text instead of the rows if there are none.
    nothing_measured: Line<'static>,
}

/// Widths of the columns. A column with width 0 is hidden.
#[derive(Debug, Clone, Copy)]
struct Columns {
    name: usize,
    trend: usize,
    bar: usize,
    interval: usize,
    loss: usize,
}

impl StructurePanel {
    /// Prepares the contents for lines of `width` characters.
    pub fn new(heard: &Heard, name: &Name, structure: &StructureState, width: usize) -> Self {
        let parameters = heard.parameters(name);
        let all_marks = parameters
            .iter()
            .map(|parameter| Marks::new(parameter.display, parameter.loss));
        let axis = Axis::around(all_marks.flat_map(|marks| marks.extent()));
        let losses = Losses::new(structure);
        let columns = Columns::new(structure, &losses, width);
        let is_stale = structure.stale_for().is_some();
        let rows = parameters.iter().map(|parameter| {
            let alert = match structure.alerts.get(&parameter.display.parameter) {
                Some(alert) if structure.is_alert_stale(&alert.parameter) => AlertCell::Stale,
                Some(alert) => match structure.unwatched(&alert.parameter) {
                    Some(unwatched) if alert.state == AlertState::Normal => {
                        AlertCell::Unwatched(unwatched.state)
                    }
                    _ => AlertCell::Of(alert),
                },
                None => AlertCell::Unheard,
            };
            let row = row(axis, columns, &losses, parameter, alert);
            if is_stale {
                row.patch_style(Modifier::DIM)
            } else {
                row
            }
        });
        Self {
            title: title(name, structure),
            time: time_of(structure),
            header: (!parameters.is_empty() || !structure.has_only_modes())
                .then(|| header(axis, columns, &losses)),
            rows: rows.collect(),
            footer: footer(heard, name, structure, width),
            nothing_measured: Line::from(if !structure.noise.is_empty() {
                "no parameters: motion and noise levels"
            } else if structure.has_only_modes() {
                NO_MODEL
            } else {
                nothing_measured(structure)
            }),
        }
    }

    /// Returns the preferred number of lines, without borders.
    pub fn len(&self) -> usize {
        1 + self.rows.len() + self.footer.len() // the header, or the text instead of it
    }

    /// Returns the lines that fit into `height`. If not all rows fit, it starts with row `first`.
    pub fn into_lines(self, height: usize, first: usize) -> Vec<Line<'static>> {
        let Self {
            header,
            rows,
            mut footer,
            nothing_measured,
            ..
        } = self;
        // In a small window, parameters have precedence over services.
        footer.truncate(height.saturating_sub(1 + rows.len().min(ROWS_AT_LEAST)));
        let room = height.saturating_sub(1 + footer.len());
        let mut lines: Vec<Line<'static>> = header.into_iter().collect();
        if rows.is_empty() {
            lines.push(nothing_measured.style(Modifier::DIM));
        } else if rows.len() <= room {
            lines.extend(rows);
        } else {
            let shown = room.saturating_sub(1);
            let first = first.min(rows.len().saturating_sub(shown));
            let hidden = rows.len() - shown;
            lines.extend(rows.into_iter().skip(first).take(shown));
            lines.push(Line::from(format!("… {hidden} more (PgUp, PgDn)")).style(Modifier::DIM));
        }
        lines.extend(footer);
        lines
    }
}

/// Known state of a parameter's alert.
#[derive(Debug, Clone, Copy)]
enum AlertCell<'a> {
    Unheard,
    /// The service of the alert has disappeared.
    Stale,
    /// The parameter was normal, and the present data do not reveal its damage.
    Unwatched(MonitoringState),
    Of(&'a AlertMessage),
}

/// Contents of the loss column: one loss for all parameters in the header, or one in each row.
struct Losses {
    common: Option<f64>,
    width: usize,
}

impl Losses {
    fn new(structure: &StructureState) -> Self {
        let mut losses = structure.losses.values().map(|loss| loss.rule_loss);
        let first = losses.next();
        let common = first.filter(|first| losses.all(|loss| loss == *first));
        let mut all = Self { common, width: 0 };
        let cells = structure.losses.values();
        let cells = cells.map(|loss| all.cell(Some(loss)).chars().count());
        all.width = cells.max().unwrap_or(0).max(all.header().chars().count());
        all
    }

    fn header(&self) -> String {
        self.common.map_or_else(
            || "P(loss)".to_owned(),
            |loss| format!("P(loss > {})", share(loss)),
        )
    }

    fn cell(&self, loss: Option<&LossDisplay>) -> String {
        let Some(loss) = loss else {
            return "–".to_owned();
        };
        let found = loss.shown_probability().percent();
        match self.common {
            Some(_) => found,
            None => format!("> {}: {found}", share(loss.rule_loss)),
        }
    }
}

impl Columns {
    fn new(structure: &StructureState, losses: &Losses, width: usize) -> Self {
        let longest = structure
            .parameters
            .keys()
            .map(|name| name.as_str().len())
            .max()
            .unwrap_or(0);
        let name = longest.clamp("parameter".len(), LONGEST_NAME);
        let column = |width: usize| GAP.len() + width;
        let taken = name + column(ESTIMATE) + column(STATE);
        let mut columns = Self {
            name,
            trend: 0,
            bar: 0,
            interval: 0,
            loss: losses.width,
        };
        let mut rest = width.saturating_sub(taken + column(losses.width));
        if width >= WIDE {
            columns.interval = INTERVAL;
            rest = rest.saturating_sub(column(INTERVAL));
            columns.trend = rest / 2 - GAP.len();
            rest -= column(columns.trend);
        }
        if rest >= column(NARROWEST_BAR) {
            columns.bar = rest - GAP.len();
        }
        if width < taken + column(losses.width) {
            columns.loss = 0;
        }
        columns
    }
}

fn cell(text: &str, width: usize) -> Option<Span<'static>> {
    (width > 0).then(|| Span::raw(format!("{GAP}{text:<width$}")))
}

fn right_cell(text: &str, width: usize) -> Option<Span<'static>> {
    (width > 0).then(|| Span::raw(format!("{GAP}{text:>width$}")))
}

fn header(axis: Axis, columns: Columns, losses: &Losses) -> Line<'static> {
    let (low, high) = axis.labels();
    let high_width = columns.bar.saturating_sub(low.len());
    let spans = [
        Some(Span::raw(format!(
            "{:<width$}",
            "parameter",
            width = columns.name
        ))),
        right_cell(
            &format!("last {:.0} s", Trail::span_s(columns.trend)),
            columns.trend,
        ),
        cell(&format!("{low}{high:>high_width$}"), columns.bar),
        right_cell("mean ± std", ESTIMATE),
        right_cell("95 % interval", columns.interval),
        right_cell(&losses.header(), columns.loss),
        cell("alert", STATE),
    ];
    Line::from_iter(spans.into_iter().flatten()).style(Modifier::DIM)
}

fn row(
    axis: Axis,
    columns: Columns,
    losses: &Losses,
    parameter: &ParameterHeard<'_>,
    alert: AlertCell<'_>,
) -> Line<'static> {
    let ParameterHeard {
        display,
        loss,
        trail,
    } = *parameter;
    let (state, style) = match alert {
        AlertCell::Unheard => ("–", Style::new()),
        AlertCell::Stale => ("stale", Style::new().add_modifier(Modifier::DIM)),
        AlertCell::Unwatched(state) => (state.as_str(), state_style(AlertState::Undecided)),
        AlertCell::Of(alert) => (alert.state.as_str(), state_style(alert.state)),
    };
    let bar = axis.bar(columns.bar, &Marks::new(display, loss));
    let interval = format!(
        "{:.3} to {:.3}",
        display.interval.low, display.interval.high
    );
    let spans = [
        Some(Span::raw(format!(
            "{:<width$}",
            shortened(display.parameter.as_str()),
            width = columns.name
        ))),
        cell(
            &axis.trend(columns.trend, trail.last(columns.trend)),
            columns.trend,
        ),
        cell(&bar, columns.bar).map(|span| span.style(style)),
        right_cell(&estimate(display.mean, display.std), ESTIMATE),
        right_cell(&interval, columns.interval),
        right_cell(&losses.cell(loss), columns.loss),
        cell(state, STATE).map(|span| span.style(style)),
    ];
    Line::from_iter(spans.into_iter().flatten())
}

/// Shortens a name to the width of the name column.
fn shortened(name: &str) -> String {
    if name.len() <= LONGEST_NAME {
        return name.to_owned();
    }
    let kept: String = name.chars().take(LONGEST_NAME - 1).collect();
    format!("{kept}…")
}

fn title(name: &Name, structure: &StructureState) -> Line<'static> {
    let mut line = Line::from(Span::styled(name.to_string(), Modifier::BOLD));
    let rules = structure.alerts.values().map(|alert| alert.state);
    let judgements = structure.judgements.values();
    let lasting = judgements.filter_map(JudgementDisplay::alert_state);
    line.extend(state_counts(rules.chain(lasting)));
    line
}

fn time_of(structure: &StructureState) -> Line<'static> {
    let origin = match Origin::of(structure) {
        Origin::Measured => "",
        Origin::Replayed => " · replayed or simulated",
        Origin::ReadAgain => " · read again from the recording",
    };
    let measured = structure
        .time_ns
        .map(|time_ns| format!("{}{origin}", time(time_ns)));
    match (measured, structure.stale_for()) {
        (Some(measured), None) => Line::from(measured),
        (Some(measured), Some(silence)) => {
            let warning = Style::new().fg(Color::Yellow).add_modifier(Modifier::BOLD);
            Line::from_iter([
                Span::raw(format!("{measured} · ")),
                Span::styled(format!("stale {}", duration(silence)), warning),
            ])
        }
        (None, _) => Line::from(nothing_measured(structure)),
    }
}

fn footer(
    heard: &Heard,
    name: &Name,
    structure: &StructureState,
    width: usize,
) -> Vec<Line<'static>> {
    let mut lines = Vec::new();
    if !structure.noise.is_empty() {
        let levels = in_order(&structure.noise).into_iter();
        let levels = levels.map(|(_, level)| Span::raw(noise_level(level)));
        lines.extend(flow("noise (std)  ", levels.collect(), width));
    }
    if !structure.conditions.is_empty() {
        lines.extend(flow("conditions   ", condition_spans(structure), width));
    }
    if !structure.modes.is_empty() {
        lines.extend(flow("modes        ", mode_spans(structure), width));
    }
    for judgement in judgement_spans(structure) {
        lines.extend(flow("lasting      ", vec![judgement], width));
    }
    if let Some(monitoring) = structure.monitoring() {
        let style = match monitoring.state {
            MonitoringState::Watching => Style::new(),
            MonitoringState::Degraded => Style::new().fg(Color::Yellow),
            MonitoringState::Blind => Style::new().fg(Color::Red),
        };
        lines.extend(flow(
            "monitoring   ",
            vec![Span::styled(monitoring.words(), style)],
            width,
        ));
    }
    if let Some(fit) = &structure.fit {
        let style = if fit.verdict == FitVerdict::Contradicted {
            Style::new().fg(Color::Yellow)
        } else {
            Style::new()
        };
        lines.extend(flow(
            "fit          ",
            vec![Span::styled(fit_words(fit), style)],
            width,
        ));
    }
    if let Some(classes) = &structure.classes {
        lines.extend(flow(
            "model class  ",
            vec![Span::raw(leading_class(classes))],
            width,
        ));
    }
    let items = service_spans(structure);
    if !items.is_empty() {
        lines.extend(flow("services     ", items, width));
    }
    lines.extend(panel_lines(heard.nodes(name)));
    lines
}

/// Returns the number of sensor nodes, and each of the other services.
fn service_spans(structure: &StructureState) -> Vec<Span<'static>> {
    let mut items = Vec::new();
    let is_node = |(service, _): &(Service, Name)| *service == Service::Sensor;
    let nodes = structure
        .instances
        .keys()
        .filter(|key| is_node(key))
        .count();
    if nodes > 0 {
        items.push(Span::raw(format!(
            "{nodes} sensor node{}",
            if nodes == 1 { "" } else { "s" }
        )));
    }
    for ((service, id), instance) in structure.instances.iter().filter(|(key, _)| !is_node(key)) {
        let alone = structure
            .instances
            .keys()
            .filter(|(other, _)| other == service)
            .count()
            == 1;
        let who = if alone {
            service.as_str().to_owned()
        } else {
            format!("{}/{id}", service.as_str())
        };
        items.push(service_item(structure, who, instance));
    }
    items
}

/// Returns the verdict on the fit: `doubtful: the innovations are correlated over time`.
pub fn fit_words(display: &FitDisplay) -> String {
    format!("{}: {}", display.verdict.as_str(), display.words())
}

/// Returns the most plausible class with its plausibility, and the number of calibrations. Adds the
/// last class with a lasting lead if it is a different one.
pub fn leading_class(display: &ModelClassDisplay) -> String {
    let ModelClassDisplay {
        leading,
        believed,
        classes,
        calibrations,
        ..
    } = display;
    let plausibility = classes
        .iter()
        .find(|class| class.class == *leading)
        .map_or(0.0, |class| class.plausibility);
    let mut text = format!(
        "{} leads with {}",
        printable(leading),
        probability(plausibility, None)
    );
    if believed != leading {
        text.push_str(&format!(", previously {}", printable(believed)));
    }
    match calibrations {
        0 => {}
        1 => text.push_str(", 1 calibration"),
        several => text.push_str(&format!(", {several} calibrations")),
    }
    text
}

/// Formats the standard deviation of a noise source. The message contains its variance.
fn noise_level(level: &NoiseDisplay) -> String {
    let NoiseDisplay {
        name, mean, std, ..
    } = level;
    if *mean <= 0.0 {
        return format!("{name} 0");
    }
    let relative_std = std / (2.0 * mean); // d√ψ / √ψ = dψ / 2ψ
    format!(
        "{name} {} ± {}",
        significant(mean.sqrt()),
        share(relative_std)
    )
}

fn service_item(
    structure: &StructureState,
    who: String,
    instance: &InstanceState,
) -> Span<'static> {
    let mut text = who;
    if let Some(status) = &instance.status {
        match status.lag_s {
            None => text.push_str(" waiting for data"),
            // the times are those of a record, or no service has published their origin
            Some(_) if !structure.has_lag() => {}
            Some(lag_s) => text.push_str(&format!(" {}", lag(lag_s))),
        }
        if let Some(load) = status.load.filter(|load| *load != Load::Normal) {
            text.push_str(&format!(
                ", {}, {} frames behind",
                load.as_str(),
                status.frames_behind.unwrap_or(0)
            ));
        }
        match status.state {
            None | Some(Standing::Leading) => {} // normal operation
            Some(Standing::StandingBy) => text.push_str(", standby"),
            Some(Standing::Joining) => text.push_str(", joining"),
        }
        for (reason, count) in status.drops.iter().filter(|(_, count)| **count > 0) {
            text.push_str(&format!(", {count} {}", printable(reason)));
        }
        match status.restarts {
            0 => {}
            1 => text.push_str(", 1 restart"),
            restarts => text.push_str(&format!(", {restarts} restarts")),
        }
    }
    if !instance.is_present {
        return Span::styled(
            format!("{text}, gone"),
            Style::new().fg(Color::Red).add_modifier(Modifier::BOLD),
        );
    }
    match structure.status_stale_for(instance) {
        Some(silence) => Span::styled(
            format!("{text}, stale {}", duration(silence)),
            Color::Yellow,
        ),
        None => Span::raw(text),
    }
}
