//! The outcome of one run of a case: figures, tables, and curves for diagrams.

use crate::figure::Figure;
use serde::{Deserialize, Serialize};

/// Drawing style of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SeriesKind {
    /// True values, a solid line.
    Truth,
    /// Estimate, a coloured line.
    Estimate,
    /// One end of a credible interval, a dashed line.
    Bound,
    /// Single points.
    Points,
}

/// A curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Series {
    /// Name in the legend, or empty for none.
    pub label: String,
    /// Drawing style.
    pub kind: SeriesKind,
    /// Abscissa and ordinate of each point.
    pub points: Vec<(f32, f32)>,
}

impl Series {
    /// Creates a series.
    #[must_use]
    pub fn new(label: impl Into<String>, kind: SeriesKind, points: Vec<(f32, f32)>) -> Self {
        Self {
            label: label.into(),
            kind,
            points,
        }
    }
}

/// A diagram.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plot {
    /// Title.
    pub title: String,
    /// Quantity and unit of the abscissa.
    pub abscissa: String,
    /// Quantity and unit of the ordinate.
    pub ordinate: String,
    /// Lower and upper limit of the ordinate. `None` shows all points. A limit is useful if a
    /// distant start value would flatten the curves.
    pub range: Option<(f32, f32)>,
    /// Curves.
    pub series: Vec<Series>,
}

impl Plot {
    /// Creates a diagram over time.
    #[must_use]
    pub fn over_time(
        title: impl Into<String>,
        ordinate: impl Into<String>,
        series: Vec<Series>,
    ) -> Self {
        Self {
            title: title.into(),
            abscissa: "time (s)".to_owned(),
            ordinate: ordinate.into(),
            range: None,
            series,
        }
    }

    /// Creates a diagram of estimates against true values, with the 45° line on which both agree.
    #[must_use]
    pub fn against_truth(title: impl Into<String>, unit: &str, points: Vec<(f32, f32)>) -> Self {
        let all = || {
            points
                .iter()
                .flat_map(|&(truth, estimate)| [truth, estimate])
                .filter(|value| value.is_finite())
        };
        let (low, high) = (
            all().fold(f32::INFINITY, f32::min),
            all().fold(f32::NEG_INFINITY, f32::max),
        );
        let line = if low <= high {
            vec![(low, low), (high, high)]
        } else {
            Vec::new()
        };
        let series = vec![
            Series::new("estimated", SeriesKind::Points, points),
            Series::new("45°", SeriesKind::Truth, line),
        ];
        Self {
            title: title.into(),
            abscissa: format!("true ({unit})"),
            ordinate: format!("estimated ({unit})"),
            range: None,
            series,
        }
    }

    /// Limits the ordinate to a range.
    #[must_use]
    pub fn within(mut self, low: f32, high: f32) -> Self {
        self.range = Some((low, high));
        self
    }
}

/// A table of the source, with published and measured values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Table {
    /// Title.
    pub title: String,
    /// Column headings.
    pub columns: Vec<String>,
    /// Cells, row by row.
    pub rows: Vec<Vec<String>>,
}

/// Outcome of one run of a case.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Outcome {
    /// Measured figures.
    pub figures: Vec<Figure>,
    /// Tables of the source.
    pub tables: Vec<Table>,
    /// Diagrams.
    pub plots: Vec<Plot>,
}
