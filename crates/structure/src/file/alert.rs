//! Reads `[[alert]]`.

use super::find_names;
use super::parameter::ParameterRead;
use crate::alert_rule::{AlertRule, Reference};
use crate::modes::Modes;
use crate::section::{Allowed, Section};
use std::f64::consts::PI;
use toml::Spanned;

const CREDIBILITY: f64 = 0.99;
const SUSTAIN_S: f64 = 5.0;
/// Default probability below which an alert ends: the loss is as likely as not.
///
/// It is well below the credibility that raises an alert, so that the alert does not flap.
const CLEAR_CREDIBILITY: f64 = 0.5;

/// Learning time of a reference in half-lives of the filter.
///
/// After that time the initial state has a weight of one eighth.
const LEARN_HALF_LIVES: f64 = 3.0;
/// Minimum learning time in fundamental periods.
///
/// The motion of the first mode has about ten independent amplitudes in that time.
const LEARN_PERIODS: f64 = 30.0;

/// Objects to which the rules refer.
pub(super) struct Context<'c> {
    /// Parameters in state order; `None` if some could not be read.
    pub(super) parameters: Option<&'c [ParameterRead]>,
    /// Default learning time (s) of a reference.
    pub(super) learn_s: f64,
}

/// Returns the default learning time (s) of a reference.
pub(super) fn learning_s(half_life_s: f64, modes: &Modes) -> f64 {
    let first = modes
        .angular_frequencies
        .first()
        .filter(|omega| **omega > 0.0);
    let periods_s = first.map_or(0.0, |omega| LEARN_PERIODS * 2.0 * PI / omega);
    periods_s.max(LEARN_HALF_LIVES * half_life_s)
}

/// Reads every `[[alert]]`.
pub(super) fn read_alerts(file: &mut Section<'_>, context: &Context<'_>) -> Vec<AlertRule> {
    let sections = file.tables("alert");
    if context.parameters.is_some_and(<[_]>::is_empty) {
        for section in sections {
            let allowed = "must not be given without a [[parameter]]: an alert watches parameters";
            section
                .diagnostics()
                .report(section.span(), "alert", "is given", allowed);
        }
        return Vec::new();
    }
    sections
        .into_iter()
        .filter_map(|section| read_alert(section, context))
        .collect()
}

fn read_alert(mut section: Section<'_>, context: &Context<'_>) -> Option<AlertRule> {
    let watched = read_watched(&mut section, context.parameters);
    let loss = section.required_number("loss", Allowed::INSIDE_UNIT);
    let credibility = section.number_or("credibility", Allowed::INSIDE_UNIT, CREDIBILITY);
    let sustain_s = section.number_or("sustain-s", Allowed::NOT_NEGATIVE, SUSTAIN_S);
    let clear = section.number("clear-credibility", Allowed::INSIDE_UNIT);
    if let Some(clear) = &clear
        && *clear.get_ref() > credibility
    {
        let found = format!("is {}", clear.get_ref());
        let allowed = format!("must be at most the credibility {credibility}");
        section.diagnostics().report(
            clear.span(),
            section.key("clear-credibility"),
            found,
            allowed,
        );
    }
    let clear_credibility = clear.map_or(CLEAR_CREDIBILITY.min(credibility), Spanned::into_inner);
    let reference = read_reference(
        &mut section,
        watched.as_ref().map(Vec::len),
        context.learn_s,
    );
    section.finish();
    Some(AlertRule {
        parameters: watched?,
        loss: loss?.into_inner(),
        credibility,
        sustain_s,
        clear_credibility,
        reference: reference?,
    })
}

/// Reads the watched parameters: a list, all, or all that scale a stiffness.
fn read_watched(
    section: &mut Section<'_>,
    parameters: Option<&[ParameterRead]>,
) -> Option<Vec<usize>> {
    let rule = "must be \"stiffness\", \"all\" or a list of parameters";
    if section.is_text("parameters") {
        let word = section.text("parameters")?;
        let chosen: Option<Vec<usize>> = match word.get_ref().as_str() {
            "all" => Some((0..parameters?.len()).collect()),
            "stiffness" => Some(
                (0..parameters?.len())
                    .filter(|index| parameters.is_some_and(|p| p[*index].parameter.is_stiffness()))
                    .collect(),
            ),
            _ => None,
        };
        if chosen.as_ref().is_none_or(Vec::is_empty) {
            let found = format!("is \"{}\"", word.get_ref());
            let found = if chosen.is_some() {
                format!("{found}, and no parameter scales one")
            } else {
                found
            };
            section
                .diagnostics()
                .report(word.span(), section.key("parameters"), found, rule);
            return None;
        }
        return chosen;
    }
    let watched = section.names("parameters");
    let watched = section.require("parameters", rule, watched)?;
    if watched.get_ref().is_empty() {
        section.diagnostics().report(
            watched.span(),
            section.key("parameters"),
            "watches nothing",
            rule,
        );
        return None;
    }
    let parameters = parameters?;
    let known = parameters.iter().map(|read| read.parameter.name());
    find_names(section, "parameters", watched.get_ref(), known)
}

/// Allowed values of `reference`.
const REFERENCE_RULE: &str = "must be { learn-s = … }, { design-std = … } or { mean = …, std = … }";

/// Reads `reference`, a table with the learning time or the values of the reference.
fn read_reference(
    section: &mut Section<'_>,
    watched: Option<usize>,
    learn_s: f64,
) -> Option<Reference> {
    if !section.contains("reference") {
        return Some(Reference::Baseline { learn_s });
    }
    if section.is_text("reference") {
        let word = section.text("reference")?;
        let design = word.get_ref() == "design";
        let allowed = if design {
            "must state how far the design may be off: { design-std = 0.05 }, or { learn-s = … } \
             to learn the reference"
        } else {
            REFERENCE_RULE
        };
        let found = format!("is \"{}\"", word.get_ref());
        section
            .diagnostics()
            .report(word.span(), section.key("reference"), found, allowed);
        return None;
    }
    let mut table = section.table("reference")?;
    if table.contains("design-std") {
        return read_design(table, watched.unwrap_or(1));
    }
    let learn_s = table.number("learn-s", Allowed::POSITIVE);
    let mean = table.number_for_each("mean", Allowed::POSITIVE, watched.unwrap_or(1));
    let std = table.number_for_each("std", Allowed::NOT_NEGATIVE, watched.unwrap_or(1));
    let reference = if table.contains("learn-s") {
        if table.contains("mean") || table.contains("std") {
            let allowed = "must give either learn-s, or mean and std";
            table.diagnostics().report(
                table.span(),
                table.key("learn-s"),
                "is given together with mean or std",
                allowed,
            );
        }
        learn_s.map(|learn_s| Reference::Baseline {
            learn_s: learn_s.into_inner(),
        })
    } else {
        let mean = table.require("mean", "must be given (or learn-s, or design-std)", mean);
        let std = table.require("std", "must be given together with mean", std);
        mean.zip(std)
            .map(|(mean, std)| Reference::Given { mean, std })
    };
    table.finish();
    reference
}

/// Reads a design reference: the mean 1 with a stated standard deviation.
fn read_design(mut table: Section<'_>, watched: usize) -> Option<Reference> {
    let std = table.number_for_each("design-std", Allowed::RATIO_DEVIATION, watched);
    for other in ["learn-s", "mean", "std"] {
        if table.contains(other) {
            let allowed = "must be given alone: the mean is that of the design, 1";
            table.diagnostics().report(
                table.span(),
                table.key("design-std"),
                format!("is given together with {other}"),
                allowed,
            );
        }
    }
    table.leave_unread(&["learn-s", "mean", "std"]);
    table.finish();
    std.map(|std| Reference::Given {
        mean: vec![1.0; std.len()],
        std,
    })
}
