//! The diagrams of a report as SVG, for the screen and for paper.
//!
//! Every diagram is 720 units wide. The style sheet of the page sets colours and fonts, so that a
//! diagram needs no script.

use super::course::TWO_SIDED_95;
use super::page::escape;
use super::report::{EventReport, GroundSpectrum, ParameterReport};
use spandrel_earthquake::{CoursePoint, Phase, Window};
use std::fmt::Write as _;

const WIDTH: f64 = 720.0;
/// Left end of the plot, behind the labels of the axis.
const LEFT: f64 = 52.0;
const RIGHT: f64 = 708.0;
/// Largest number of points of a curve. Each is the smallest and largest of its samples.
const MOST_POINTS: usize = 656;

/// One axis: values and their places.
#[derive(Debug, Clone, Copy)]
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn at(&self, value: f64) -> f64 {
        let share = (value - self.low) / (self.high - self.low);
        self.from + share * (self.to - self.from)
    }

    /// Returns round values along the axis, about `count` of them, and their number of decimals.
    fn ticks(&self, count: f64) -> (Vec<f64>, usize) {
        let rough = (self.high - self.low) / count;
        let power = 10.0_f64.powf(rough.log10().floor());
        let factor = [1.0, 2.0, 5.0, 10.0]
            .into_iter()
            .find(|factor| factor * power >= rough)
            .unwrap_or(10.0);
        let step = factor * power;
        let decimals = (-step.log10().floor()).max(0.0) as usize;
        let first = (self.low / step).ceil();
        let mut ticks = Vec::new();
        let mut number = first;
        while number * step <= self.high + 1e-9 * step && ticks.len() < 50 {
            ticks.push(number * step);
            number += 1.0;
        }
        (ticks, decimals)
    }
}

/// Text that grows line by line. Writing to a string cannot fail.
struct Svg {
    text: String,
}

impl Svg {
    fn new(height: f64, label: &str) -> Self {
        Self {
            text: format!(
                "<svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" aria-label=\"{}\" \
                 xmlns=\"http://www.w3.org/2000/svg\">\n",
                escape(label)
            ),
        }
    }

    fn line(&mut self, class: &str, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        let _ = writeln!(
            self.text,
            "<line class=\"{class}\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>"
        );
    }

    /// Draws a rectangle between two corners.
    fn area(&mut self, class: &str, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        let (x, y) = (x1.min(x2), y1.min(y2));
        let (width, height) = ((x2 - x1).abs(), (y2 - y1).abs());
        let _ = writeln!(
            self.text,
            "<rect class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" \
             height=\"{height:.1}\"/>"
        );
    }

    fn circle(&mut self, class: &str, [x, y]: [f64; 2], radius: f64) {
        let _ = writeln!(
            self.text,
            "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\"/>"
        );
    }

    fn word(&mut self, class: &str, [x, y]: [f64; 2], text: &str) {
        let _ = writeln!(
            self.text,
            "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\">{}</text>",
            escape(text)
        );
    }

    fn path(&mut self, class: &str, points: &[[f64; 2]]) {
        if points.is_empty() {
            return;
        }
        let mut data = String::new();
        for (index, [x, y]) in points.iter().enumerate() {
            let letter = if index == 0 { 'M' } else { 'L' };
            let _ = write!(data, "{letter}{x:.1} {y:.1}");
        }
        let _ = writeln!(self.text, "<path class=\"{class}\" d=\"{data}\"/>");
    }

    fn finish(mut self) -> String {
        self.text.push_str("</svg>\n");
        self.text
    }

    /// Draws the lines and numbers of a vertical axis.
    fn vertical(&mut self, axis: &Axis, count: f64) {
        let (ticks, decimals) = axis.ticks(count);
        for tick in ticks {
            let y = axis.at(tick);
            self.line("grid", [LEFT, y], [RIGHT, y]);
            self.word("tick end", [LEFT - 6.0, y + 3.5], &number(tick, decimals));
        }
    }

    /// Draws the numbers of a time axis below `bottom`.
    fn seconds(&mut self, axis: &Axis, bottom: f64) {
        let (ticks, decimals) = axis.ticks(10.0);
        for tick in ticks {
            let x = axis.at(tick);
            self.line("mark", [x, bottom], [x, bottom + 4.0]);
            self.word("tick middle", [x, bottom + 16.0], &number(tick, decimals));
        }
        self.word(
            "tick end",
            [RIGHT, bottom + 30.0],
            "time since the start of the record (s)",
        );
    }

    /// Draws the phases of a record behind a diagram.
    fn phases(&mut self, windows: &[Window], time: &Axis, top: f64, bottom: f64) {
        let mut index = 0;
        while let Some(first) = windows.get(index) {
            let same = windows[index..]
                .iter()
                .take_while(|window| window.phase == first.phase)
                .count();
            let end_s = windows[index + same - 1].end_s;
            let (from, to) = (time.at(first.start_s), time.at(end_s));
            self.area(
                &format!("phase {}", class(first.phase)),
                [from, top],
                [to, bottom],
            );
            index += same;
        }
    }

    /// Names the phases above a diagram, where there is room for the word.
    fn phase_names(&mut self, windows: &[Window], time: &Axis, y: f64) {
        /// Width of a letter.
        const LETTER: f64 = 6.0;
        let mut index = 0;
        while let Some(first) = windows.get(index) {
            let same = windows[index..]
                .iter()
                .take_while(|window| window.phase == first.phase)
                .count();
            let (from, to) = (
                time.at(first.start_s),
                time.at(windows[index + same - 1].end_s),
            );
            let word = first.phase.as_str();
            if to - from > LETTER * word.len() as f64 {
                self.word("phase-name middle", [0.5 * (from + to), y], word);
            }
            index += same;
        }
    }
}

fn number(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(rest) if rest.chars().all(|c| c == '0' || c == '.') => rest.to_owned(),
        Some(rest) => format!("−{rest}"),
        None => text,
    }
}

fn class(phase: Phase) -> &'static str {
    match phase {
        Phase::Quiet => "quiet",
        Phase::Shaking => "shaking",
        Phase::Settling => "settling",
        Phase::Weak => "weak",
    }
}

fn time_axis(report: &EventReport) -> Axis {
    Axis {
        low: 0.0,
        high: report.length_s.max(1e-3),
        from: LEFT,
        to: RIGHT,
    }
}

/// Returns the accelerations of all sensors, one strip each, on one scale.
///
/// `channels` are the samples in the order of the report.
pub fn accelerations(report: &EventReport, channels: &[Vec<f64>]) -> String {
    const STRIP: f64 = 74.0;
    const GAP: f64 = 10.0;
    const TOP: f64 = 18.0;
    let shown: Vec<_> = report
        .sensors
        .iter()
        .zip(channels)
        .filter(|(sensor, _)| sensor.figures.intensity.is_some())
        .collect();
    let peaks = shown.iter().filter_map(|(sensor, _)| sensor.figures.motion);
    let scale = peaks.map(|motion| motion.peak).fold(1e-9, f64::max) * 1.05;
    let bottom = TOP + shown.len() as f64 * (STRIP + GAP) - GAP;
    let time = time_axis(report);
    let mut svg = Svg::new(bottom + 36.0, "accelerations of all sensors over time");
    svg.phases(&report.windows, &time, TOP, bottom);
    svg.phase_names(&report.windows, &time, TOP - 5.0);
    for (index, (sensor, samples)) in shown.iter().enumerate() {
        let top = TOP + index as f64 * (STRIP + GAP);
        let axis = Axis {
            low: -scale,
            high: scale,
            from: top + STRIP,
            to: top,
        };
        svg.vertical(&axis, 4.0);
        let mean = spandrel_earthquake::motion::mean(samples).unwrap_or(0.0);
        let curve = envelope(samples, mean);
        let points: Vec<[f64; 2]> = curve
            .iter()
            .map(|(frame, value)| [time.at(*frame / report.sampling_rate_hz), axis.at(*value)])
            .collect();
        svg.path("curve", &points);
        let peak = sensor.figures.motion.map_or(0.0, |motion| motion.peak);
        let label = format!("{}  peak {peak:.2} m/s²", sensor.figures.channel);
        svg.word("label", [LEFT + 6.0, top + 12.0], &label);
    }
    svg.word("tick", [2.0, TOP - 9.0], "m/s²");
    svg.seconds(&time, bottom);
    svg.finish()
}

/// Returns at most [`MOST_POINTS`] pairs of smallest and largest value, with the position of their
/// frames.
fn envelope(samples: &[f64], mean: f64) -> Vec<(f64, f64)> {
    let part = samples.len().div_ceil(MOST_POINTS).max(1);
    let mut points = Vec::new();
    for (index, chunk) in samples.chunks(part).enumerate() {
        let present = || chunk.iter().filter(|value| value.is_finite());
        let low = present().copied().fold(f64::INFINITY, f64::min);
        let high = present().copied().fold(f64::NEG_INFINITY, f64::max);
        if low > high {
            continue;
        }
        let at = (index * part) as f64;
        points.push((at, low - mean));
        if part > 1 {
            points.push((at + 0.5 * part as f64, high - mean));
        }
    }
    points
}

/// Returns the history of a stiffness over the record, with the interval of each window. A band
/// shows what the earlier events predict for weak motion.
pub fn stiffness(report: &EventReport, parameter: &ParameterReport) -> String {
    const TOP: f64 = 18.0;
    const BOTTOM: f64 = 218.0;
    let points = &parameter.course.points;
    let time = time_axis(report);
    let ends = |point: &CoursePoint| {
        let half = TWO_SIDED_95 * point.s;
        [(point.y - half).exp(), (point.y + half).exp()]
    };
    let expected = parameter.expected;
    let all = points
        .iter()
        .flat_map(ends)
        .chain(expected.iter().flat_map(|band| [band.low, band.high]));
    let axis = vertical_axis(all, BOTTOM, TOP);
    let mut svg = Svg::new(BOTTOM + 36.0, "course of the stiffness over the record");
    svg.phases(&report.windows, &time, TOP, BOTTOM);
    svg.phase_names(&report.windows, &time, TOP - 5.0);
    svg.vertical(&axis, 5.0);
    if let Some(band) = expected {
        svg.area(
            "expected",
            [LEFT, axis.at(band.low)],
            [RIGHT, axis.at(band.high)],
        );
        // Below the axis, where no interval of a window is.
        let key = [LEFT, BOTTOM + 22.0];
        svg.area("expected", key, [LEFT + 14.0, BOTTOM + 31.0]);
        svg.word(
            "tick",
            [LEFT + 20.0, BOTTOM + 30.0],
            "earlier events in weak motion, 95 %",
        );
    }
    for point in points {
        let [low, high] = ends(point);
        let (from, to) = (time.at(point.start_s), time.at(point.end_s));
        let class = if point.is_contradicted {
            "interval open"
        } else {
            "interval"
        };
        svg.area(class, [from, axis.at(low)], [to, axis.at(high)]);
        svg.line(
            if point.is_contradicted {
                "value open"
            } else {
                "value"
            },
            [from, axis.at(point.y.exp())],
            [to, axis.at(point.y.exp())],
        );
    }
    if points.is_empty() {
        svg.word(
            "label",
            [LEFT + 6.0, BOTTOM - 8.0],
            "no window with information",
        );
    }
    svg.word("tick", [2.0, TOP - 9.0], "ratio");
    svg.seconds(&time, BOTTOM);
    svg.finish()
}

/// Returns an axis that contains these values with some room.
fn vertical_axis(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Axis {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    let (low, high) = if low <= high { (low, high) } else { (0.5, 1.5) };
    let room = (0.06 * (high - low)).max(0.02);
    Axis {
        low: (low - room).max(0.0),
        high: high + room,
        from,
        to,
    }
}

/// Returns the weak motion and the softest moment of this event and all earlier ones.
pub fn events(report: &EventReport, parameter: &ParameterReport) -> String {
    const TOP: f64 = 14.0;
    const BOTTOM: f64 = 190.0;
    /// Distance of an event from the ends.
    const ROOM: f64 = 34.0;
    let events = &parameter.events;
    let values = events.iter().flat_map(|event| {
        let interval = event.within.into_iter().flat_map(|one| [one.low, one.high]);
        interval.chain(event.softest)
    });
    let band = parameter
        .expected
        .into_iter()
        .flat_map(|one| [one.low, one.high]);
    let axis = vertical_axis(values.chain(band), BOTTOM, TOP);
    let order = Axis {
        low: 0.0,
        high: (events.len().max(2) - 1) as f64,
        from: LEFT + ROOM,
        to: RIGHT - ROOM,
    };
    let mut svg = Svg::new(BOTTOM + 98.0, "stiffness of all events so far");
    svg.vertical(&axis, 5.0);
    if let Some(band) = parameter.expected {
        svg.area(
            "expected",
            [LEFT, axis.at(band.low)],
            [RIGHT, axis.at(band.high)],
        );
    }
    for (index, event) in events.iter().enumerate() {
        let x = order.at(index as f64);
        let is_now = event.name.event == report.name.event;
        let now = if is_now { " now" } else { "" };
        if let (Some(value), Some(within)) = (event.stiffness, event.within) {
            svg.line(
                &format!("bar{now}"),
                [x, axis.at(within.low)],
                [x, axis.at(within.high)],
            );
            svg.circle(&format!("dot{now}"), [x, axis.at(value)], 3.5);
        }
        if let Some(softest) = event.softest {
            let (y, size) = (axis.at(softest), 4.0);
            svg.path(
                &format!("soft{now}"),
                &[
                    [x - size, y - size],
                    [x + size, y - size],
                    [x, y + size],
                    [x - size, y - size],
                ],
            );
        }
        // To the minute, because an aftershock may follow within an hour.
        let start = event.name.start.as_ref().and_then(|start| start.get(..16));
        let label = start.map_or_else(
            || event.name.record.chars().take(16).collect(),
            |start| start.replace('T', " "),
        );
        let _ = writeln!(
            svg.text,
            "<text class=\"tick end{now}\" transform=\"translate({:.1} {:.1}) \
             rotate(-50)\">{}</text>",
            x + 4.0,
            BOTTOM + 12.0,
            escape(&label)
        );
    }
    svg.word("tick", [2.0, TOP - 5.0], "ratio");
    svg.finish()
}

/// Returns the spectral accelerations of the ground over the period, on a logarithmic axis.
pub fn spectra(report: &EventReport) -> String {
    const TOP: f64 = 14.0;
    const BOTTOM: f64 = 194.0;
    let values = || report.ground_spectra.iter().flat_map(|one| &one.values);
    let highest = values().map(|one| one.sa_m_per_s2).fold(1e-9, f64::max);
    let (Some(first), Some(last)) = (values().next(), values().last()) else {
        return String::new();
    };
    let period = Axis {
        low: first.period_s.ln(),
        high: last.period_s.ln(),
        from: LEFT,
        to: RIGHT,
    };
    let axis = Axis {
        low: 0.0,
        high: 1.1 * highest,
        from: BOTTOM,
        to: TOP,
    };
    let mut svg = Svg::new(
        BOTTOM + 36.0,
        "spectral acceleration of the ground over the period",
    );
    svg.vertical(&axis, 4.0);
    for tick in [0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0_f64] {
        let x = period.at(tick.ln());
        svg.line("grid", [x, TOP], [x, BOTTOM]);
        svg.word("tick middle", [x, BOTTOM + 16.0], &format!("{tick}"));
    }
    svg.word("tick end", [RIGHT, BOTTOM + 30.0], "period (s)");
    svg.word("tick", [2.0, TOP - 5.0], "m/s²");
    let own = period.at(report.fundamental_hz.recip().ln());
    if (LEFT..RIGHT).contains(&own) {
        svg.line("own", [own, TOP], [own, BOTTOM]);
        svg.word("label", [own + 5.0, TOP + 12.0], "first mode as designed");
    }
    for (index, GroundSpectrum { channel, values }) in report.ground_spectra.iter().enumerate() {
        let points: Vec<[f64; 2]> = values
            .iter()
            .map(|one| [period.at(one.period_s.ln()), axis.at(one.sa_m_per_s2)])
            .collect();
        svg.path(&format!("spectrum s{}", index % 4), &points);
        let y = TOP + 12.0 + 14.0 * index as f64;
        svg.word(
            &format!("label end s{}", index % 4),
            [RIGHT - 4.0, y],
            channel,
        );
    }
    svg.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within_the_axis() {
        let axis = Axis {
            low: 0.63,
            high: 1.38,
            from: 0.0,
            to: 100.0,
        };
        let (ticks, decimals) = axis.ticks(5.0);
        let texts: Vec<String> = ticks.iter().map(|tick| number(*tick, decimals)).collect();
        assert_eq!(texts, ["0.8", "1.0", "1.2"]);
        assert_eq!([number(-0.0, 1), number(-2.0, 0)], ["0.0", "−2"]);
    }

    #[test]
    fn envelope_keeps_the_extremes_and_skips_missing_samples() {
        let mut samples: Vec<f64> = (0..10_000).map(|i| f64::from(i % 7)).collect();
        samples[5000] = 40.0;
        samples[6000] = -30.0;
        samples[100..200].fill(f64::NAN);
        let curve = envelope(&samples, 0.0);
        assert!(curve.len() <= 2 * MOST_POINTS);
        let values: Vec<f64> = curve.iter().map(|(_, value)| *value).collect();
        assert!(values.contains(&40.0) && values.contains(&-30.0));
        assert!(values.iter().all(|value| value.is_finite()));
    }
}
