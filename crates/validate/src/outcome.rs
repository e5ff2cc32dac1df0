//! What one run of a case leaves: figures, tables, and curves to be drawn.

use crate::figure::Figure;
use serde::{Deserialize, Serialize};

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SeriesKind {
    /// What is true, a solid line.
    Truth,
    /// An estimate, a coloured line.
    Estimate,
    /// One end of a credible interval, a dashed line.
    Bound,
    /// Single points.
    Points,
}

/// One curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Series {
    /// Its name in the legend; empty for none.
    pub label: String,
    /// How it is drawn.
    pub kind: SeriesKind,
    /// Abscissa and ordinate of each point.
    pub points: Vec<(f32, f32)>,
}

impl Series {
    /// Makes a series.
    #[must_use]
    pub fn new(label: impl Into<String>, kind: SeriesKind, points: Vec<(f32, f32)>) -> Self {
        Self {
            label: label.into(),
            kind,
            points,
        }
    }
}

/// One diagram.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plot {
    /// What it shows.
    pub title: String,
    /// Quantity and unit of the abscissa.
    pub abscissa: String,
    /// Quantity and unit of the ordinate.
    pub ordinate: String,
    /// Range of the ordinate where a start far off would hide the rest.
    pub range: Option<(f32, f32)>,
    /// The curves.
    pub series: Vec<Series>,
}

impl Plot {
    /// Makes a diagram over time.
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

    /// Makes a diagram of estimates over what is true, which lie on the line of 45° where they agree.
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

    /// Cuts the ordinate to a range.
    #[must_use]
    pub fn within(mut self, low: f32, high: f32) -> Self {
        self.range = Some((low, high));
        self
    }
}

/// A table of the source, published beside measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Table {
    /// What it holds.
    pub title: String,
    /// Heads of the columns.
    pub columns: Vec<String>,
    /// One row after the other.
    pub rows: Vec<Vec<String>>,
}

/// What one run of a case leaves.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Outcome {
    /// The measured numbers.
    pub figures: Vec<Figure>,
    /// The tables of the source.
    pub tables: Vec<Table>,
    /// The diagrams.
    pub plots: Vec<Plot>,
}
