//! The table and the plot of the comparison.

use plotters::prelude::*;
use std::error::Error;
use std::fmt::Write;
use std::path::Path;

/// Measurements of one building (s per step). A value that was not measured is NaN.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Number of storeys, `N`.
    pub storeys: usize,
    /// Time per step of Spandrel's filter with fading memory and identified noise, in s.
    pub spandrel: f64,
    /// Time per step of Spandrel's filter with known noise, as in the other filters of this table,
    /// in s.
    pub spandrel_known: f64,
    /// Lower bound on the time per step, from the numbers of operations and bytes
    /// ([`crate::floor`]), in s.
    pub floor: f64,
    /// Time per step of a textbook filter with dense nalgebra matrices and a matrix exponential
    /// ([`crate::dense`]), in s.
    pub dense: f64,
    /// Time per step of the filter of the Python library filterpy, with SciPy's `expm`, in s.
    pub filterpy: f64,
    /// Time per step of a textbook filter with NumPy matrices and SciPy's `expm`, in s.
    pub numpy: f64,
}

/// Returns the rows as a Markdown table, in microseconds and ratios.
#[must_use]
pub fn markdown(rows: &[Row]) -> String {
    let mut text = String::from(
        "| storeys | states | Spandrel µs | noises known µs | floor µs | over floor | dense \
         nalgebra µs | times | filterpy µs | times | NumPy µs | times |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let peer = |time_s: f64| {
            if time_s.is_nan() {
                "| |".to_owned()
            } else {
                format!("{} | {:.1} |", microseconds(time_s), time_s / row.spandrel)
            }
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {:.1} | {} {} {}",
            row.storeys,
            3 * row.storeys + 2,
            microseconds(row.spandrel),
            microseconds(row.spandrel_known),
            microseconds(row.floor),
            row.spandrel / row.floor,
            peer(row.dense),
            peer(row.filterpy),
            peer(row.numpy),
        );
    }
    text
}

fn microseconds(time_s: f64) -> String {
    let time = time_s * 1e6;
    if time < 100.0 {
        format!("{time:.1}")
    } else {
        format!("{time:.0}")
    }
}

/// Plots the time of a step against the number of storeys, on logarithmic axes.
///
/// # Errors
/// Returns an error if the file cannot be written.
pub fn plot(rows: &[Row], path: &Path) -> Result<(), Box<dyn Error>> {
    type Line = (&'static str, fn(&Row) -> f64, RGBColor);
    const LINES: [Line; 5] = [
        ("filterpy", |row| row.filterpy, RGBColor(214, 39, 40)),
        ("NumPy", |row| row.numpy, RGBColor(255, 127, 14)),
        ("dense nalgebra", |row| row.dense, RGBColor(148, 103, 189)),
        ("Spandrel", |row| row.spandrel, RGBColor(31, 119, 180)),
        ("floor", |row| row.floor, RGBColor(127, 127, 127)),
    ];
    let root = SVGBackend::new(path, (760, 480)).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(64)
        .build_cartesian_2d((4.0..500.0_f64).log_scale(), (5e-8..20.0_f64).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("storeys")
        .y_desc("time of a step (s)")
        .y_label_formatter(&|y| format!("{y:.0e}"))
        .draw()?;
    for (name, time, colour) in LINES {
        let points: Vec<(f64, f64)> = rows
            .iter()
            .map(|row| (row.storeys as f64, time(row)))
            .filter(|(_, time)| time.is_finite())
            .collect();
        chart
            .draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
        chart.draw_series(
            points
                .iter()
                .map(|point| Circle::new(*point, 3, colour.filled())),
        )?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE)
        .draw()?;
    root.present()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row() -> Row {
        let unknown = f64::NAN;
        Row {
            storeys: 5,
            spandrel: 1e-5,
            spandrel_known: 8e-6,
            floor: 5e-6,
            dense: 1e-4,
            filterpy: 2e-4,
            numpy: unknown,
        }
    }

    #[test]
    fn table_has_ratios_and_omits_missing_measurements() {
        let table = markdown(&[row()]);
        assert_eq!(
            table.lines().last(),
            Some("| 5 | 17 | 10.0 | 8.0 | 5.0 | 2.0 | 100 | 10.0 | 200 | 20.0 | | |")
        );
    }

    #[test]
    fn plot_contains_every_line() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("scaling.svg");
        plot(
            &[
                row(),
                Row {
                    storeys: 10,
                    numpy: 3e-4,
                    ..row()
                },
            ],
            &path,
        )
        .unwrap();
        let drawing = std::fs::read_to_string(path).unwrap();
        for name in ["Spandrel", "filterpy", "NumPy", "dense nalgebra", "floor"] {
            assert!(drawing.contains(name), "{name}");
        }
    }
}
