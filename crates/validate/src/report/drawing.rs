//! Draws diagrams.

use crate::error::ValidateError;
use crate::outcome::{Plot, Series, SeriesKind};
use plotters::prelude::*;

const SIZE: (u32, u32) = (720, 300);
const TRUTH: RGBColor = RGBColor(60, 60, 60);
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
    draw(plot, &mut text)
        .map_err(|error| ValidateError::Drawing { title: plot.title.clone(), reason: error.to_string() })?;
    Ok(text)
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
        .light_line_style(WHITE)
        .bold_line_style(RGBColor(228, 228, 228))
        .y_label_formatter(&|value| crate::figure::number(f64::from(*value)))
        .draw()?;
    let mut estimates = 0;
    for Series { label, kind, points } in &plot.series {
        let colour = match kind {
            SeriesKind::Truth => TRUTH,
            SeriesKind::Bound => RGBColor(150, 150, 150),
            SeriesKind::Points => RGBColor(170, 190, 215),
            SeriesKind::Estimate => {
                estimates += 1;
                ESTIMATES[(estimates - 1) % ESTIMATES.len()]
            }
        };
        // clipped by hand: what lies outside would be drawn over the labels
        let inside = points.iter().map(|&(x, y)| (x, y.clamp(low, high)));
        let drawn = match kind {
            SeriesKind::Points => chart.draw_series(inside.map(|point| Circle::new(point, 1, colour.filled())))?,
            SeriesKind::Bound => chart.draw_series(DashedLineSeries::new(inside, 4, 3, colour.stroke_width(1)))?,
            SeriesKind::Truth | SeriesKind::Estimate => {
                chart.draw_series(LineSeries::new(inside, colour.stroke_width(1)))?
            }
        };
        if !label.is_empty() {
            drawn.label(label).legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], colour.stroke_width(2)));
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

/// Returns the range of a coordinate over all finite points, never empty, with some room.
fn range(plot: &Plot, coordinate: impl Fn(&(f32, f32)) -> f32) -> (f32, f32) {
    let values = plot.series.iter().flat_map(|series| &series.points).map(coordinate).filter(|value| value.is_finite());
    let (low, high) =
        values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    if low > high {
        return (0.0, 1.0);
    }
    let room = if high > low { 0.03 * (high - low) } else { 0.5 * high.abs().max(1.0) };
    (low - room, high + room)
}
