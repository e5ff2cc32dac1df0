//! Drawing of diagrams as SVG.

use super::thin::Pixels;
use crate::error::ValidateError;
use crate::outcome::{Plot, Series, SeriesKind};
use plotters::prelude::*;

const SIZE: (u32, u32) = (720, 300);
const TRUTH: RGBColor = RGBColor(60, 60, 60);
const BOUND: RGBColor = RGBColor(150, 150, 150);
/// Stroke of a bound as the plotting library writes it, and the same stroke with dashes.
const BOUND_STROKES: [&str; 2] = [
    "stroke=\"#969696\"",
    "stroke=\"#969696\" stroke-dasharray=\"4 3\"",
];
const POINTS: [RGBColor; 2] = [RGBColor(150, 175, 210), RGBColor(214, 39, 40)];
const ESTIMATES: [RGBColor; 7] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 39, 40),
    RGBColor(44, 160, 44),
    RGBColor(148, 103, 189),
    RGBColor(255, 127, 14),
    RGBColor(23, 150, 160),
    RGBColor(140, 86, 75),
];

/// Returns the diagram as SVG.
pub(super) fn svg(plot: &Plot) -> Result<String, ValidateError> {
    let mut text = String::new();
    draw(plot, &mut text).map_err(|error| ValidateError::Drawing {
        title: plot.title.clone(),
        reason: error.to_string(),
    })?;
    // The plotting library would write each dash and each point as a separate element, which would
    // make up most of the file.
    Ok(joined_points(&text).replace(BOUND_STROKES[0], BOUND_STROKES[1]))
}

/// Joins consecutive points of one colour into one path of dots.
fn joined_points(text: &str) -> String {
    let circle = |line: &str| -> Option<(String, String)> {
        let rest = line.strip_prefix("<circle cx=\"")?;
        let (x, rest) = rest.split_once("\" cy=\"")?;
        let (y, rest) = rest.split_once('"')?;
        let (_, rest) = rest.split_once("fill=\"")?;
        let (colour, _) = rest.split_once('"')?;
        Some((format!("M{x} {y}h0"), colour.to_owned()))
    };
    let mut joined = String::new();
    let mut open: Option<String> = None;
    for line in text.lines() {
        let found = circle(line);
        let colour = found.as_ref().map(|(_, colour)| colour);
        if open.as_ref() != colour {
            if open.is_some() {
                joined.push_str("\"/>\n");
            }
            if let Some(colour) = colour {
                let begin =
                    "<path fill=\"none\" stroke-width=\"2\" stroke-linecap=\"round\" stroke=\"";
                joined.push_str(&format!("{begin}{colour}\" d=\""));
            }
        }
        match found {
            Some((dot, colour)) => {
                joined.push_str(&dot);
                open = Some(colour);
            }
            None => {
                joined.push_str(line);
                joined.push('\n');
                open = None;
            }
        }
    }
    joined
}

fn draw(plot: &Plot, text: &mut String) -> Result<(), Box<dyn std::error::Error>> {
    let area = SVGBackend::with_string(text, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let (low, high) = plot.range.unwrap_or_else(|| range(plot, |point| point.1));
    let (left, right) = range(plot, |point| point.0);
    let mut chart = ChartBuilder::on(&area)
        .caption(&plot.title, ("sans-serif", 16))
        .margin(8)
        .x_label_area_size(34)
        .y_label_area_size(64)
        .build_cartesian_2d(left..right, low..high)?;
    chart
        .configure_mesh()
        .x_desc(&plot.abscissa)
        .y_desc(&plot.ordinate)
        .max_light_lines(0)
        .bold_line_style(RGBColor(228, 228, 228))
        // A tick at zero may have a rounding error.
        .y_label_formatter(&|value| match value.abs() < 1e-6 * (high - low) {
            true => "0".to_owned(),
            false => crate::figure::number(f64::from(*value)),
        })
        .draw()?;
    let (width, height) = chart.plotting_area().dim_in_pixel();
    let scale = (width as f32 / (right - left), height as f32 / (high - low));
    let pixels = Pixels { left, low, scale };
    let (mut estimates, mut clouds) = (0, 0);
    for Series {
        label,
        kind,
        points,
    } in &plot.series
    {
        let colour = match kind {
            SeriesKind::Truth => TRUTH,
            SeriesKind::Bound => BOUND,
            SeriesKind::Points => {
                clouds += 1;
                POINTS[(clouds - 1) % POINTS.len()]
            }
            SeriesKind::Estimate => {
                estimates += 1;
                ESTIMATES[(estimates - 1) % ESTIMATES.len()]
            }
        };
        // Clip here, because the library would draw outlying points over the labels.
        let finite = points
            .iter()
            .filter(|(x, y)| x.is_finite() && y.is_finite());
        let inside: Vec<(f32, f32)> = finite.map(|&(x, y)| (x, y.clamp(low, high))).collect();
        let drawn = match kind {
            SeriesKind::Points => {
                let circles = pixels
                    .cloud(&inside)
                    .into_iter()
                    .map(|point| Circle::new(point, 1, colour.filled()));
                chart.draw_series(circles)?
            }
            SeriesKind::Bound | SeriesKind::Truth | SeriesKind::Estimate => chart.draw_series(
                LineSeries::new(pixels.curve(&inside), colour.stroke_width(1)),
            )?,
        };
        if !label.is_empty() {
            drawn.label(label).legend(move |(x, y)| {
                PathElement::new([(x, y), (x + 14, y)], colour.stroke_width(2))
            });
        }
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.85))
        .border_style(RGBColor(200, 200, 200))
        .draw()?;
    area.present()?;
    Ok(())
}

/// Returns the range of a coordinate over all finite points, with a margin. The range is never
/// empty.
fn range(plot: &Plot, coordinate: impl Fn(&(f32, f32)) -> f32) -> (f32, f32) {
    let values = plot
        .series
        .iter()
        .flat_map(|series| &series.points)
        .map(coordinate)
        .filter(|value| value.is_finite());
    let (low, high) = values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    if low > high {
        return (0.0, 1.0);
    }
    let room = if high > low {
        0.03 * (high - low)
    } else {
        0.5 * high.abs().max(1.0)
    };
    (low - room, high + room)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_diagram_of_long_curves_is_a_small_file() {
        let curve = |of: &dyn Fn(f32) -> f32| {
            (0..100_000)
                .map(|i| (i as f32 * 0.002, of(i as f32)))
                .collect::<Vec<_>>()
        };
        let noise = |i: f32| (i * 12.9898).sin() * 43_758.547 % 1.0;
        let series = vec![
            Series::new(
                "bound",
                SeriesKind::Bound,
                curve(&|i| 1.5 + 0.1 * (i * 1e-3).sin()),
            ),
            Series::new("truth", SeriesKind::Truth, curve(&|_| 0.0)),
            Series::new("noisy", SeriesKind::Estimate, curve(&noise)),
            Series::new(
                "points",
                SeriesKind::Points,
                curve(&|i| 0.3 * noise(i))
                    .into_iter()
                    .step_by(200)
                    .collect(),
            ),
        ];
        let text = svg(&Plot::over_time("long curves", "value", series)).unwrap();
        assert!(text.len() < 40_000, "{} bytes", text.len());
        assert_eq!(
            text.matches("stroke-dasharray").count(),
            2,
            "the bound, and its line in the legend"
        );
        assert_eq!(text.matches("<path").count(), 1, "all points together");
        assert!(text.matches("h0").count() > 100 && !text.contains("<circle"));
    }
}
