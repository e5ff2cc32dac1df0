//! The stabilisation diagram and the singular-value spectrum as SVG.

use super::analysis::Analysis;
use plotters::prelude::*;
use spandrel_modal::Source;

const SIZE: (u32, u32) = (960, 480);
const POLE: RGBColor = RGBColor(165, 175, 190);
const STABLE: RGBColor = RGBColor(31, 119, 180);
const MODE: RGBColor = RGBColor(214, 39, 40);
const MACHINE: RGBColor = RGBColor(255, 127, 14);
const SPECTRUM: RGBColor = RGBColor(44, 120, 80);
const FAINT: RGBColor = RGBColor(190, 205, 195);
const GRID: RGBColor = RGBColor(232, 232, 232);
/// Share by which the frequency axis extends beyond the highest mode.
const BEYOND: f64 = 1.25;
/// Number of singular values in the spectrum.
const SINGULAR_VALUES: usize = 4;
/// Relative difference of the frequency of a pole from that of its mode.
const OF_MODE: f64 = 0.01;

type Error = Box<dyn std::error::Error>;

/// Returns the poles of all orders over frequency, for the last epoch.
///
/// # Errors
/// Returns an error if the diagram cannot be drawn.
pub fn stabilisation(analysis: &Analysis) -> Result<String, Error> {
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let highest_order = analysis.bands.first().map_or(2, |band| band.highest_order);
        let mut chart = ChartBuilder::on(&area)
            .caption(
                "Stabilisation diagram of the last epoch",
                ("sans-serif", 18),
            )
            .margin(10)
            .x_label_area_size(38)
            .y_label_area_size(52)
            .build_cartesian_2d(0.0..upper_end(analysis), 0.0..highest_order as f64 + 2.0)?;
        chart
            .configure_mesh()
            .x_desc("frequency (Hz)")
            .y_desc("order of the model")
            .max_light_lines(0)
            .bold_line_style(GRID)
            .draw()?;
        chart.draw_series(mode_lines(analysis, highest_order as f64 + 2.0))?;
        let poles = analysis
            .record
            .epochs()
            .last()
            .map(|epoch| &epoch.found.bands)
            .into_iter()
            .flatten()
            .flat_map(|band| &band.poles)
            .filter(|pole| pole.frequency_hz < upper_end(analysis));
        let (stable, other): (Vec<_>, Vec<_>) =
            poles.partition(|pole| is_of_mode(analysis, pole.frequency_hz));
        let circles = |poles: Vec<&spandrel_modal::Pole>, colour: RGBColor| {
            poles
                .into_iter()
                .map(|pole| (pole.frequency_hz, pole.order as f64))
                .map(|point| Circle::new(point, 3, colour.filled()))
                .collect::<Vec<_>>()
        };
        chart
            .draw_series(circles(other, POLE))?
            .label("pole")
            .legend(|(x, y)| Circle::new((x + 7, y), 3, POLE.filled()));
        chart
            .draw_series(circles(stable, STABLE))?
            .label("pole within 1 % of a mode")
            .legend(|(x, y)| Circle::new((x + 7, y), 3, STABLE.filled()));
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.85))
            .border_style(GRID)
            .draw()?;
        area.present()?;
    }
    Ok(text)
}

/// Returns the singular values of the spectral densities over frequency, as means of all epochs,
/// with the modes.
///
/// # Errors
/// Returns an error if the diagram cannot be drawn.
pub fn singular_values(analysis: &Analysis) -> Result<String, Error> {
    let curves = mean_singular_values(analysis);
    let end = upper_end(analysis);
    let shown = curves
        .iter()
        .flatten()
        .filter(|(frequency_hz, value)| *frequency_hz <= end && *value > 0.0)
        .map(|(_, value)| value.log10());
    let (low, high) = shown.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    let (low, high) = if low < high {
        (low, high + 0.2)
    } else {
        (-1.0, 1.0)
    };
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .caption(
                "Singular values of the spectral densities, channels scaled to unit variance",
                ("sans-serif", 18),
            )
            .margin(10)
            .x_label_area_size(38)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..end, low..high)?;
        chart
            .configure_mesh()
            .x_desc("frequency (Hz)")
            .y_desc("singular value (1/Hz)")
            .y_label_formatter(&|value| format!("1e{value:.0}"))
            .y_labels(decades(low, high))
            .max_light_lines(0)
            .bold_line_style(GRID)
            .draw()?;
        chart.draw_series(mode_lines_between(analysis, low, high))?;
        for (number, curve) in curves.iter().enumerate().rev() {
            let colour = if number == 0 { SPECTRUM } else { FAINT };
            let points = curve
                .iter()
                .filter(|(frequency_hz, value)| *frequency_hz <= end && *value > 0.0)
                .map(|(frequency_hz, value)| (*frequency_hz, value.log10()));
            chart.draw_series(LineSeries::new(points, colour.stroke_width(2)))?;
        }
        area.present()?;
    }
    Ok(text)
}

/// Returns the number of labels for an axis of decimal exponents, about one for each decade.
fn decades(low: f64, high: f64) -> usize {
    ((high - low).ceil() as usize + 1).clamp(2, 12)
}

/// Returns the upper end of the frequency axis (Hz).
fn upper_end(analysis: &Analysis) -> f64 {
    let band = analysis.bands.first().map_or(1.0, |band| band.highest_hz);
    let highest = analysis.modes.last().map(|mode| mode.frequency_hz * BEYOND);
    highest.map_or(band, |highest| highest.min(band))
}

fn is_of_mode(analysis: &Analysis, frequency_hz: f64) -> bool {
    analysis
        .modes
        .iter()
        .any(|mode| (mode.frequency_hz - frequency_hz).abs() < OF_MODE * mode.frequency_hz)
}

fn mode_lines(analysis: &Analysis, top: f64) -> Vec<PathElement<(f64, f64)>> {
    mode_lines_between(analysis, 0.0, top)
}

fn mode_lines_between(analysis: &Analysis, low: f64, high: f64) -> Vec<PathElement<(f64, f64)>> {
    let line = |mode: &spandrel_modal::ModeSummary| {
        let colour = match mode.source {
            Source::Mode => MODE,
            Source::Machine => MACHINE,
        };
        let f = mode.frequency_hz;
        PathElement::new([(f, low), (f, high)], colour.mix(0.55).stroke_width(1))
    };
    analysis.modes.iter().map(line).collect()
}

/// Returns the first singular values over frequency. Each band shows its own frequencies.
fn mean_singular_values(analysis: &Analysis) -> Vec<Vec<(f64, f64)>> {
    let mut curves: Vec<Vec<(f64, f64)>> = Vec::new();
    for (position, band) in analysis.bands.iter().enumerate().rev() {
        let lower_end = analysis
            .bands
            .get(position + 1)
            .map_or(0.0, |lower| lower.highest_hz);
        let spectra: Vec<_> = analysis
            .epochs
            .iter()
            .filter_map(|epoch| epoch.bands[position].spectrum.as_ref())
            .collect();
        let Some(step_hz) = spectra.first().map(|spectrum| spectrum.step_hz()) else {
            continue;
        };
        let values: Vec<Vec<Vec<f64>>> = spectra
            .iter()
            .map(|spectrum| spectrum.singular_values())
            .collect();
        let frequencies = values.iter().map(Vec::len).min().unwrap_or(0);
        // The values next to 0 Hz contain drift and the rest of the mean.
        for at in 2..frequencies {
            let frequency_hz = at as f64 * step_hz;
            if frequency_hz < lower_end || frequency_hz > band.highest_hz {
                continue;
            }
            for number in 0..SINGULAR_VALUES {
                let of_epochs: Vec<f64> = values
                    .iter()
                    .filter_map(|epoch| epoch[at].get(number).copied())
                    .collect();
                if of_epochs.is_empty() {
                    break;
                }
                if curves.len() <= number {
                    curves.push(Vec::new());
                }
                let mean = of_epochs.iter().sum::<f64>() / of_epochs.len() as f64;
                curves[number].push((frequency_hz, mean));
            }
        }
    }
    curves
}
