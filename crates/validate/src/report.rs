//! Results of all runs of a plan.

mod drawing;
mod html;
mod markdown;
mod page;
mod thin;

use crate::cases::{Case, cases};
use crate::error::ValidateError;
use crate::figure::{Judgement, Required};
use crate::kept::Done;
use crate::outcome::{Outcome, Plot, Table};
use crate::run::Length;
use serde::Serialize;
use std::path::Path;

/// One figure over all seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FigureReport {
    /// Name of the case.
    pub case: &'static str,
    /// Name of the figure.
    pub figure: String,
    /// Published number.
    pub published: Option<f64>,
    /// Requirement on the measured number.
    pub required: Required,
    /// Number of seeds that must meet the requirement.
    pub judgement: Judgement,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Measured number for each seed, in the order of the seeds. An element is `None` if the number
    /// could not be determined.
    pub measured: Vec<Option<f64>>,
    /// Reason why a miss is expected, or `None` if a miss is a surprise.
    #[serde(rename = "known-miss")]
    pub known_miss: Option<String>,
    /// Whether the requirement holds.
    #[serde(rename = "pass")]
    pub passed: bool,
}

impl FigureReport {
    /// Returns `true` if the figure misses its requirement and no reason is known.
    #[must_use]
    pub fn is_surprise(&self) -> bool {
        !self.passed && self.known_miss.is_none()
    }
}

/// Program that made the outcomes of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Program {
    /// The program that writes the report.
    This,
    /// Another version or another build, at least for one of the seeds.
    Another,
}

/// One case over all seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct CaseReport {
    /// Name.
    pub name: &'static str,
    /// One-line description.
    pub title: &'static str,
    /// Publication and section.
    pub source: &'static str,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Elapsed time of each seed (s), including the effect of concurrent runs, or `None` without an
    /// outcome.
    pub seconds: Vec<Option<f64>>,
    /// Versions of the program that made the outcomes. Seeds may have different ones.
    pub versions: Vec<String>,
    /// Program that made the outcomes.
    pub program: Program,
    /// Figures.
    pub figures: Vec<FigureReport>,
    /// Tables of the first seed.
    pub tables: Vec<Table>,
    /// Diagrams of the first seed.
    pub plots: Vec<Plot>,
    /// Seeds without an outcome, each with the reason.
    pub failures: Vec<(u64, String)>,
}

/// Results of all cases.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Simulated length.
    pub length: Length,
    /// Requested cases in order.
    pub cases: Vec<CaseReport>,
    /// Other cases with stored outcomes, which appear only on the page.
    pub others: Vec<CaseReport>,
}

impl CaseReport {
    pub(crate) fn new(
        case: &Case,
        runs: Vec<(u64, Result<Done, ValidateError>)>,
        program: Program,
    ) -> Self {
        let mut report = Self {
            name: case.name,
            title: case.title,
            source: case.source,
            seeds: runs.iter().map(|(seed, _)| *seed).collect(),
            seconds: Vec::new(),
            versions: Vec::new(),
            program,
            figures: Vec::new(),
            tables: Vec::new(),
            plots: Vec::new(),
            failures: Vec::new(),
        };
        for (position, (seed, run)) in runs.into_iter().enumerate() {
            report
                .seconds
                .push(run.as_ref().ok().map(|done| done.seconds));
            match run {
                Ok(done) => {
                    if !report.versions.contains(&done.version) {
                        report.versions.push(done.version);
                    }
                    report.take(position, done.outcome);
                }
                Err(error) => report.failures.push((seed, error.to_string())),
            }
        }
        for figure in &mut report.figures {
            figure.passed = holds(figure);
        }
        report
    }

    fn take(&mut self, position: usize, outcome: Outcome) {
        for figure in outcome.figures {
            let known_miss = figure.known_miss.clone();
            let known = self
                .figures
                .iter()
                .position(|known| known.figure == figure.name);
            let at = known.unwrap_or_else(|| {
                self.figures.push(FigureReport {
                    case: self.name,
                    figure: figure.name,
                    published: figure.published,
                    required: figure.required,
                    judgement: figure.judgement,
                    known_miss: figure.known_miss,
                    measured: vec![None; self.seeds.len()],
                    seeds: self.seeds.clone(),
                    passed: false,
                });
                self.figures.len() - 1
            });
            let merged = &mut self.figures[at];
            merged.measured[position] = figure.measured;
            // A miss is known only if the misses of all seeds are known.
            merged.known_miss = merged.known_miss.take().and(known_miss);
        }
        if self.plots.is_empty() && self.tables.is_empty() {
            (self.plots, self.tables) = (outcome.plots, outcome.tables);
        }
    }

    /// Returns `true` if every figure holds or is a known miss, and every seed has an outcome.
    #[must_use]
    pub fn passed(&self) -> bool {
        self.failures.is_empty() && !self.figures.iter().any(FigureReport::is_surprise)
    }
}

/// Returns `true` if a figure holds over its seeds. A seed without a number does not meet the
/// requirement.
fn holds(figure: &FigureReport) -> bool {
    let FigureReport {
        required,
        judgement,
        measured,
        ..
    } = figure;
    if *required == Required::Reported {
        return true;
    }
    let holding = measured
        .iter()
        .filter(|measured| measured.is_some_and(|value| required.holds(value)))
        .count();
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
    /// Returns `true` if every requested case passed. See [`CaseReport::passed`].
    #[must_use]
    pub fn passed(&self) -> bool {
        self.cases.iter().all(CaseReport::passed)
    }

    /// Returns all figures of the requested cases.
    pub fn figures(&self) -> impl Iterator<Item = &FigureReport> {
        self.cases.iter().flat_map(|case| &case.figures)
    }

    /// Returns one line for each figure of a case, as text for a terminal.
    #[must_use]
    pub fn text(&self) -> String {
        page::text(self)
    }

    /// Returns the cases of the page in the order of their sources: the requested ones and those
    /// with stored outcomes.
    fn on_page(&self) -> Vec<&CaseReport> {
        let mut all: Vec<&CaseReport> = self.cases.iter().chain(&self.others).collect();
        all.sort_by_key(|report| cases().iter().position(|case| case.name == report.name));
        all
    }

    /// Writes `index.html` and `figures.md`, and their diagrams into `diagrams`.
    ///
    /// Deletes diagrams that a case no longer has.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written or a diagram cannot be drawn.
    pub fn write(&self, directory: &Path) -> Result<(), ValidateError> {
        page::write(self, directory)
    }
}
