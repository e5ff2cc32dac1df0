//! What all runs of a plan have shown.

mod drawing;
mod page;

use crate::cases::Case;
use crate::error::ValidateError;
use crate::figure::{Judgement, Required};
use crate::outcome::{Outcome, Plot, Table};
use crate::run::Length;
use serde::Serialize;
use std::path::Path;

/// One figure over all seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FigureReport {
    /// Name of the case.
    pub case: &'static str,
    /// What it is.
    pub figure: String,
    /// What the source printed.
    pub published: Option<f64>,
    /// What is required.
    pub required: Required,
    /// Of which seeds.
    pub judgement: Judgement,
    /// What came out, one for each seed; none where it could not be had.
    pub measured: Vec<Option<f64>>,
    /// Whether the requirement holds.
    #[serde(rename = "pass")]
    pub passed: bool,
}

/// One case over all seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct CaseReport {
    /// Its name.
    pub name: &'static str,
    /// What it is.
    pub title: &'static str,
    /// Where it was published.
    pub source: &'static str,
    /// Its figures.
    pub figures: Vec<FigureReport>,
    /// Tables of the first seed.
    pub tables: Vec<Table>,
    /// Diagrams of the first seed.
    pub plots: Vec<Plot>,
    /// Seeds without outcome, and why.
    pub failures: Vec<(u64, String)>,
}

/// All cases.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// How much was simulated.
    pub length: Length,
    /// The seeds.
    pub seeds: Vec<u64>,
    /// The cases, in order.
    pub cases: Vec<CaseReport>,
}

impl CaseReport {
    pub(crate) fn new(case: &Case, seeds: &[u64], outcomes: Vec<Result<Outcome, ValidateError>>) -> Self {
        let mut report = Self {
            name: case.name,
            title: case.title,
            source: case.source,
            figures: Vec::new(),
            tables: Vec::new(),
            plots: Vec::new(),
            failures: Vec::new(),
        };
        let count = outcomes.len();
        for (position, (seed, outcome)) in seeds.iter().zip(outcomes).enumerate() {
            match outcome {
                Ok(outcome) => report.take(position, count, outcome),
                Err(error) => report.failures.push((*seed, error.to_string())),
            }
        }
        for figure in &mut report.figures {
            figure.passed = holds(figure);
        }
        report
    }

    fn take(&mut self, position: usize, count: usize, outcome: Outcome) {
        for figure in outcome.figures {
            let known = self.figures.iter().position(|known| known.figure == figure.name);
            let at = known.unwrap_or_else(|| {
                self.figures.push(FigureReport {
                    case: self.name,
                    figure: figure.name,
                    published: figure.published,
                    required: figure.required,
                    judgement: figure.judgement,
                    measured: vec![None; count],
                    passed: false,
                });
                self.figures.len() - 1
            });
            self.figures[at].measured[position] = figure.measured;
        }
        if self.plots.is_empty() && self.tables.is_empty() {
            (self.plots, self.tables) = (outcome.plots, outcome.tables);
        }
    }

    /// Says whether every figure holds and every seed has an outcome.
    #[must_use]
    pub fn passed(&self) -> bool {
        self.failures.is_empty() && self.figures.iter().all(|figure| figure.passed)
    }
}

/// Says whether a figure holds over its seeds; a seed without the number does not hold it.
fn holds(figure: &FigureReport) -> bool {
    let FigureReport { required, judgement, measured, .. } = figure;
    if *required == Required::Reported {
        return true;
    }
    let holding = measured.iter().filter(|measured| measured.is_some_and(|value| required.holds(value))).count();
    match judgement {
        Judgement::Each => holding == measured.len(),
        Judgement::TwoThirds => 3 * holding >= 2 * measured.len(),
        Judgement::Mean => {
            let sum: Option<f64> = measured.iter().copied().sum();
            sum.is_some_and(|sum| required.holds(sum / measured.len() as f64))
        }
    }
}

impl Report {
    /// Says whether every case passed.
    #[must_use]
    pub fn passed(&self) -> bool {
        self.cases.iter().all(CaseReport::passed)
    }

    /// Returns all figures.
    pub fn figures(&self) -> impl Iterator<Item = &FigureReport> {
        self.cases.iter().flat_map(|case| &case.figures)
    }

    /// Returns one line for each figure of a case, to be read by people.
    #[must_use]
    pub fn text(&self) -> String {
        page::text(self)
    }

    /// Writes `index.html` and `figures.md` with their diagrams beside them into a directory.
    ///
    /// # Errors
    /// When a file cannot be written or a diagram cannot be drawn.
    pub fn write(&self, directory: &Path) -> Result<(), ValidateError> {
        page::write(self, directory)
    }
}
