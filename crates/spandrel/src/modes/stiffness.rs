//! The stiffnesses that the declared modes of a recording update, as text and JSON.

use super::analysis::Analysis;
use super::table::Recordings;
use crate::error::AppError;
use serde_json::{Value, json};
use spandrel_modal::{StiffnessChange, UpdatePrecision, UpdateReference};
use spandrel_modes::{ModesError, Stiffnesses};
use spandrel_structure::{Parameter, Structure, UpdatePlan};
use std::fmt::Write as _;

/// Loss whose probability is stated for a parameter that no rule watches.
const LOSS: f64 = 0.1;
/// Correlation of two changes above which the modes hardly distinguish them.
const TRADE: f64 = 0.7;

/// The stiffnesses over all epochs.
#[derive(Debug)]
pub struct StiffnessCourse {
    parts: Vec<Part>,
    /// Number of epochs of the commissioning so far, and in all.
    commissioning: (usize, usize),
    /// For each epoch, the change since the commissioning.
    changes: Vec<Option<StiffnessChange>>,
    learnt: Option<(UpdateReference, UpdatePrecision)>,
}

/// A parameter, and the rule that watches it.
#[derive(Debug)]
struct Part {
    name: String,
    /// Prior mean (ratio to nominal).
    mean: f64,
    /// Loss and credibility of the rule.
    rule: Option<(f64, f64)>,
}

impl Part {
    fn loss(&self) -> f64 {
        self.rule.map_or(LOSS, |(loss, _)| loss)
    }

    fn is_raised(&self, probability: f64) -> bool {
        self.rule
            .is_some_and(|(_, credibility)| probability >= credibility)
    }
}

fn parts(structure: &Structure, plan: &UpdatePlan) -> Vec<Part> {
    let named = plan.parts.iter().zip(&plan.means);
    let part = |(name, mean): (&String, &f64)| {
        let of_state = structure.parameters().iter().map(Parameter::name);
        let position = of_state.into_iter().position(|known| known == name);
        let mut rules = structure.alert_rules().iter();
        let rule =
            rules.find(|rule| position.is_some_and(|index| rule.parameters.contains(&index)));
        Part {
            name: name.clone(),
            mean: *mean,
            rule: rule.map(|rule| (rule.loss, rule.credibility)),
        }
    };
    named.map(part).collect()
}

impl StiffnessCourse {
    /// Creates the history before the first epoch. `None` if natural frequencies update nothing.
    pub fn new(structure: &Structure) -> Option<Self> {
        let plan = structure.modal()?.update.as_ref()?;
        Some(Self {
            parts: parts(structure, plan),
            commissioning: (0, plan.settings.commissioning_epochs),
            changes: Vec::new(),
            learnt: None,
        })
    }

    /// Notes the stiffnesses after an epoch.
    pub fn note(&mut self, stiffnesses: &Stiffnesses) {
        self.changes.push(stiffnesses.last().cloned());
    }

    /// Notes what the commissioning has taught.
    ///
    /// # Errors
    /// Returns an error if a decomposition fails.
    pub fn finish(&mut self, stiffnesses: &Stiffnesses) -> Result<(), AppError> {
        self.commissioning = stiffnesses.commissioning();
        self.learnt = match stiffnesses.reference() {
            Some(reference) => {
                let precision = reference.precision(stiffnesses.model());
                Some((reference.clone(), precision.map_err(ModesError::from)?))
            }
            None => None,
        };
        Ok(())
    }
}

/// Returns the stiffnesses after the last epoch. Empty if natural frequencies update none.
pub fn text(analysis: &Analysis) -> String {
    let Some(course) = &analysis.stiffness else {
        return String::new();
    };
    let (done, all) = course.commissioning;
    let Some((reference, precision)) = &course.learnt else {
        return format!("\nstiffness: commissioning, {done} of {all} epochs with modes\n");
    };
    let used = reference.of_model().flatten().count();
    let mut text = format!(
        "\nstiffness: commissioned in {} epochs; {used} of {} declared modes are modes of the \
         model\n\
         scatter between these epochs: {:.2} % of a frequency, {:.1} % of a shape\n",
        reference.epochs,
        reference.of_model().count(),
        100.0 * reference.frequency_scatter(),
        100.0 * reference.shape_scatter(),
    );
    let names = course.parts.iter().map(|part| part.name.len());
    let width = names.max().unwrap_or(0).max("parameter".len());
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "\n{:width$}  commissioned      ±  change %    95 % interval  P(loss)     of  least seen  \
         state after epoch {}",
        "parameter",
        course.changes.len(),
    );
    let last = course.changes.last().and_then(Option::as_ref);
    for (index, part) in course.parts.iter().enumerate() {
        let ratio = part.mean * reference.ln_stiffness[index].exp();
        let std = ratio * reference.ln_stiffness_std[index];
        let (numbers, state) = match last {
            Some(change) => {
                let percent = |value: f64| 100.0 * (value.exp() - 1.0);
                let probability = change.probability_of_loss(index, part.loss());
                let numbers = format!(
                    "{:>+8.1}  {:>+6.1} to {:>+5.1}  {probability:>7.4}",
                    percent(change.mean(index)),
                    percent(change.quantile(index, 0.025)),
                    percent(change.quantile(index, 0.975)),
                );
                (
                    numbers,
                    if part.is_raised(probability) {
                        "loss"
                    } else {
                        "no loss shown"
                    },
                )
            }
            None => (
                format!("{:>8}  {:>15}  {:>7}", "–", "–", "–"),
                "no modes yet",
            ),
        };
        let _ = writeln!(
            text,
            "{:width$}  {ratio:>12.3}  {std:>5.3}  {numbers}  {:>3.0} %  {:>10}  {state}",
            part.name,
            100.0 * part.loss(),
            least_seen(precision, index),
        );
    }
    text + &trades(course, precision)
}

/// Returns the smallest loss that one epoch shows, in words.
pub fn least_seen(precision: &UpdatePrecision, part: usize) -> String {
    match precision.smallest_loss(part) {
        Some(loss) => format!("{:.0} %", 100.0 * loss),
        None => "none".to_owned(),
    }
}

/// Names the pairs of parts that the modes can hardly distinguish.
fn trades(course: &StiffnessCourse, precision: &UpdatePrecision) -> String {
    let names: Vec<&str> = course.parts.iter().map(|part| part.name.as_str()).collect();
    let lines = trading(precision, &names).into_iter();
    lines.map(|line| line + "\n").collect()
}

/// Returns a sentence for each pair of parts whose changes the modes can hardly distinguish.
pub fn trading(precision: &UpdatePrecision, names: &[&str]) -> Vec<String> {
    let mut all = Vec::new();
    for (one, name) in names.iter().enumerate() {
        for (other, partner) in names.iter().enumerate().skip(one + 1) {
            let correlation = precision.correlation(one, other);
            if correlation.abs() > TRADE {
                let together = if correlation < 0.0 {
                    "their sum"
                } else {
                    "their difference"
                };
                all.push(format!(
                    "the modes hardly distinguish {name} and {partner}, and mainly determine \
                     {together} (correlation {correlation:.2})"
                ));
            }
        }
    }
    all
}

/// Returns the stiffnesses of each epoch as JSON. Null if natural frequencies update none.
pub fn json(records: Recordings<'_>, analysis: &Analysis) -> Value {
    let Some(course) = &analysis.stiffness else {
        return Value::Null;
    };
    let ends = analysis.record.epochs().iter().zip(&analysis.recording);
    let epochs = course
        .changes
        .iter()
        .zip(ends)
        .filter_map(|(change, (epoch, position))| {
            let change = change.as_ref()?;
            let parameters: Vec<Value> = course
                .parts
                .iter()
                .enumerate()
                .map(|(index, part)| of_part(part, change, index))
                .collect();
            Some(json!({
                "recording": records.name(*position),
                "end_s": epoch.end as f64 / records.first.rate_hz,
                "parameters": parameters,
            }))
        });
    let epochs: Vec<Value> = epochs.collect();
    let reference = course.learnt.as_ref().map(|(reference, precision)| {
        let parameters: Vec<Value> = course
            .parts
            .iter()
            .enumerate()
            .map(|(index, part)| {
                let ratio = part.mean * reference.ln_stiffness[index].exp();
                json!({
                    "parameter": part.name,
                    "ratio": ratio,
                    "std": ratio * reference.ln_stiffness_std[index],
                    "smallest_loss": precision.smallest_loss(index),
                })
            })
            .collect();
        let of_model = reference.of_model().map(|mode| mode.map(|mode| mode + 1));
        json!({
            "epochs": reference.epochs,
            "modes_of_model": of_model.collect::<Vec<_>>(),
            "frequency_scatter": reference.frequency_scatter(),
            "shape_scatter": reference.shape_scatter(),
            "parameters": parameters,
        })
    });
    let (done, all) = course.commissioning;
    json!({
        "commissioning_epochs": all,
        "commissioned_epochs": done,
        "reference": reference,
        "epochs": epochs,
    })
}

fn of_part(part: &Part, change: &StiffnessChange, index: usize) -> Value {
    let probability = change.probability_of_loss(index, part.loss());
    let mean = change.mean(index).exp();
    json!({
        "parameter": part.name,
        "mean": mean,
        "std": mean * change.std(index),
        "low": change.quantile(index, 0.025).exp(),
        "high": change.quantile(index, 0.975).exp(),
        "loss": part.loss(),
        "probability_of_loss": probability,
        "raised": part.is_raised(probability),
    })
}
