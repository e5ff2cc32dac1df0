//! Text of the page in either format, the lines on a terminal, and the files.

use super::{CaseReport, FigureReport, Program, Report, drawing, html, markdown};
use crate::cases::cases;
use crate::error::ValidateError;
use crate::figure::{Judgement, Required, measured_number, number};
use crate::run::Length;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

/// Folder of the diagrams, relative to the pages.
const DIAGRAMS: &str = "diagrams";

/// Returns a heading and one line per figure for each requested case.
pub(super) fn text(report: &Report) -> String {
    let mut text = String::new();
    for case in &report.cases {
        let _ = writeln!(text, "{}  {} ({})", case.name, case.title, case.source);
        for figure in &case.figures {
            let mark = verdict(figure);
            let known = known(figure);
            let published = figure.published.map_or(String::new(), |value| {
                format!(", published {}", number(value))
            });
            let _ = writeln!(
                text,
                "  {mark:<8} {}: {} (required {}{}{published}){known}",
                figure.figure,
                measured(figure).join(", "),
                figure.required,
                judged(figure.judgement, figure.measured.len()),
            );
        }
        for (seed, why) in &case.failures {
            let _ = writeln!(text, "  failed   seed {seed}: {why}");
        }
    }
    let Count {
        holds,
        missed,
        known,
        ..
    } = Count::of(report.cases.iter());
    let failed = report
        .cases
        .iter()
        .map(|case| case.failures.len())
        .sum::<usize>();
    let _ = writeln!(
        text,
        "{holds} of {} figures as required, {missed} missed ({known} of them known), {failed} \
         runs failed",
        holds + missed
    );
    text
}

/// Returns the reason of a figure that misses as expected, and an empty text for any other figure.
fn known(figure: &FigureReport) -> String {
    let reason = figure.known_miss.as_ref().filter(|_| !figure.passed);
    reason.map_or(String::new(), |reason| format!("; known: {reason}"))
}

/// Number of figures with each result.
#[derive(Debug, Clone, Copy, Default)]
struct Count {
    holds: usize,
    missed: usize,
    /// Missed figures with a known reason.
    known: usize,
    reported: usize,
}

impl Count {
    fn of<'a>(cases: impl Iterator<Item = &'a CaseReport>) -> Self {
        let mut count = Self::default();
        for figure in cases.flat_map(|case| &case.figures) {
            match (figure.required, figure.passed) {
                (Required::Reported, _) => count.reported += 1,
                (_, true) => count.holds += 1,
                (_, false) => {
                    count.missed += 1;
                    count.known += usize::from(figure.known_miss.is_some());
                }
            }
        }
        count
    }
}

fn verdict(figure: &FigureReport) -> &'static str {
    match (figure.required, figure.passed) {
        (Required::Reported, _) => "reported",
        (_, true) => "holds",
        (_, false) => "MISSED",
    }
}

fn measured(figure: &FigureReport) -> Vec<String> {
    let text = |value| measured_number(value, &figure.required);
    figure
        .measured
        .iter()
        .map(|value| value.map_or("none".to_owned(), text))
        .collect()
}

fn judged(judgement: Judgement, seeds: usize) -> &'static str {
    match judgement {
        _ if seeds == 1 => "",
        Judgement::Each => "",
        Judgement::Mean => ", in the mean",
        Judgement::TwoThirds => ", of two seeds in three",
    }
}

/// Writes the pages and the diagrams.
pub(super) fn write(report: &Report, directory: &Path) -> Result<(), ValidateError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |reason| ValidateError::File { path, reason }
    };
    let put = |name: &str, text: &str| {
        let path = directory.join(name);
        std::fs::write(&path, text).map_err(failed(&path))
    };
    let diagrams = directory.join(DIAGRAMS);
    std::fs::create_dir_all(&diagrams).map_err(failed(&diagrams))?;
    let mut drawn = BTreeSet::new();
    for case in report.on_page() {
        for (index, plot) in case.plots.iter().enumerate() {
            let name = drawing_name(case, index);
            put(&name, &drawing::svg(plot)?)?;
            drawn.insert(directory.join(name));
        }
    }
    // Only diagrams of an earlier report are deleted, recognised by their names. Other files stay.
    let ours = |name: &str| {
        name.ends_with(".svg") && cases().iter().any(|case| name.starts_with(case.name))
    };
    for entry in std::fs::read_dir(&diagrams)
        .map_err(failed(&diagrams))?
        .flatten()
    {
        if entry.file_name().to_str().is_some_and(ours) && !drawn.contains(&entry.path()) {
            std::fs::remove_file(entry.path()).map_err(failed(&entry.path()))?;
        }
    }
    put("index.html", &html::page(report))?;
    put("figures.md", &markdown::page(report))
}

/// Returns the path of a diagram relative to the page.
pub(super) fn drawing_name(case: &CaseReport, index: usize) -> String {
    format!("{DIAGRAMS}/{}-{}.svg", case.name, index + 1)
}

/// Returns the column headings of the table of figures of a case.
pub(super) fn heads(case: &CaseReport) -> Vec<String> {
    let mut heads: Vec<String> = ["figure", "published", "required"]
        .map(str::to_owned)
        .to_vec();
    heads.extend(case.seeds.iter().map(|seed| format!("seed {seed}")));
    heads.push("verdict".to_owned());
    heads
}

/// Returns a row of the table of figures.
pub(super) fn row(figure: &FigureReport) -> Vec<String> {
    let mut row = vec![
        figure.figure.clone(),
        figure.published.map_or("–".to_owned(), number),
        format!(
            "{}{}",
            figure.required,
            judged(figure.judgement, figure.measured.len())
        ),
    ];
    row.extend(measured(figure));
    row.push(format!("{}{}", verdict(figure), known(figure)));
    row
}

/// Returns the paragraphs above the contents.
pub(super) fn introduction(report: &Report) -> Vec<String> {
    let on_page = report.on_page();
    let Count {
        holds,
        missed,
        known,
        reported,
    } = Count::of(on_page.iter().copied());
    let (records, option) = match report.length {
        Length::Full => ("records of full length", ""),
        Length::Quick => ("shortened records", " --quick"),
    };
    let seeds = report
        .cases
        .first()
        .map_or(String::new(), |case| seed_options(&case.seeds));
    let mut paragraphs = vec![
        format!(
            "{holds} of {} figures are as required, {missed} are missed ({known} of them known), \
             {reported} more are reported; {records}. Written by spandrel {} with `spandrel \
             validate{option}{seeds} --report DIRECTORY`; the contents list the seeds of each \
             case.",
            holds + missed,
            env!("CARGO_PKG_VERSION"),
        ),
        "A figure *holds* if the number of every seed meets the requirement. Some requirements \
         apply to the mean or to two seeds in three instead. Any other figure is *MISSED*, and \
         docs/validation.md gives the reason. A *known* miss has been examined: its requirement is \
         that of the specification, and its reason follows. A *reported* figure is shown without a \
         verdict: it is a limit of the method, or a quantity of one record. *Published* is the \
         value in the source. Tables and diagrams are of the first seed. Seconds are wall time, \
         with other runs in parallel."
            .to_owned(),
    ];
    if on_page.iter().any(|case| case.program == Program::Another) {
        paragraphs.push("Another build of the program ran the cases marked with *.".to_owned());
    }
    let absent = cases()
        .iter()
        .filter(|case| !on_page.iter().any(|on_page| on_page.name == case.name));
    let absent: Vec<String> = absent.map(|case| format!("`{}`", case.name)).collect();
    if !absent.is_empty() {
        paragraphs.push(format!("No stored outcome of {}.", absent.join(", ")));
    }
    paragraphs
}

/// Returns the command line options that request these seeds.
fn seed_options(seeds: &[u64]) -> String {
    match seeds {
        [] => String::new(),
        [seed] => format!(" --seed {seed}"),
        [first, .., last] if seeds.windows(2).all(|pair| pair[0] + 1 == pair[1]) => {
            format!(" --seeds {first}..{last}")
        }
        _ => seeds.iter().map(|seed| format!(" --seed {seed}")).collect(),
    }
}

/// Column headings of the contents.
pub(super) const CONTENTS: [&str; 9] = [
    "case",
    "what",
    "source",
    "version",
    "holds",
    "missed",
    "reported",
    "seeds",
    "seconds of each",
];

/// Returns a row of the contents without the name of the case.
pub(super) fn contents_row(case: &CaseReport) -> [String; 8] {
    let Count {
        holds,
        missed,
        reported,
        ..
    } = Count::of(std::iter::once(case));
    let other = match case.program {
        Program::This => "",
        Program::Another => " *",
    };
    let each = |values: Vec<String>| values.join(", ");
    [
        case.title.to_owned(),
        case.source.to_owned(),
        format!("{}{other}", each(case.versions.clone())),
        holds.to_string(),
        missed.to_string(),
        reported.to_string(),
        each(case.seeds.iter().map(u64::to_string).collect()),
        each(
            case.seconds
                .iter()
                .map(|seconds| seconds.map_or("none".to_owned(), |s| format!("{s:.1}")))
                .collect(),
        ),
    ]
}
