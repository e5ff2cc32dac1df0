//! Reads `[[alert]]`.

use super::find_name;
use crate::alert_rule::{AlertRule, Reference};
use crate::section::{Allowed, Section};
use toml::Spanned;

const CREDIBILITY: f64 = 0.99;
const SUSTAIN_S: f64 = 5.0;
/// An alert ends when the loss is as likely as not: well below the credibility that raised it, so that it does not flap.
const CLEAR_CREDIBILITY: f64 = 0.5;

/// Reads every `[[alert]]`; `parameters` are the names in state order, `None` if some could not be read.
pub(super) fn read_alerts(file: &mut Section<'_>, parameters: Option<&[&str]>) -> Vec<AlertRule> {
    let sections = file.tables("alert");
    if parameters.is_some_and(<[&str]>::is_empty) {
        for section in sections {
            let allowed = "must not be given without a [[parameter]]: an alert watches parameters";
            section.diagnostics().report(section.span(), "alert", "is given", allowed);
        }
        return Vec::new();
    }
    sections.into_iter().filter_map(|section| read_alert(section, parameters)).collect()
}

fn read_alert(mut section: Section<'_>, parameters: Option<&[&str]>) -> Option<AlertRule> {
    let watched = read_watched(&mut section, parameters);
    let loss = section.required_number("loss", Allowed::INSIDE_UNIT);
    let credibility = section.number_or("credibility", Allowed::INSIDE_UNIT, CREDIBILITY);
    let sustain_s = section.number_or("sustain-s", Allowed::NOT_NEGATIVE, SUSTAIN_S);
    let clear = section.number("clear-credibility", Allowed::INSIDE_UNIT);
    if let Some(clear) = &clear
        && *clear.get_ref() > credibility
    {
        let found = format!("is {}", clear.get_ref());
        let allowed = format!("must be at most the credibility {credibility}");
        section.diagnostics().report(clear.span(), section.key("clear-credibility"), found, allowed);
    }
    let clear_credibility = clear.map_or(CLEAR_CREDIBILITY.min(credibility), Spanned::into_inner);
    let reference = read_reference(&mut section, watched.as_ref().map(Vec::len));
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

fn read_watched(section: &mut Section<'_>, parameters: Option<&[&str]>) -> Option<Vec<usize>> {
    let rule = "must be \"all\" or a list of parameters";
    let watched = if section.is_text("parameters") {
        let word = section.text("parameters")?;
        if word.get_ref() != "all" {
            let found = format!("is \"{}\"", word.get_ref());
            section.diagnostics().report(word.span(), section.key("parameters"), found, rule);
            return None;
        }
        return parameters.map(|parameters| (0..parameters.len()).collect());
    } else {
        section.names("parameters")
    };
    let watched = section.require("parameters", rule, watched)?;
    if watched.get_ref().is_empty() {
        section.diagnostics().report(watched.span(), section.key("parameters"), "watches nothing", rule);
        return None;
    }
    let parameters = parameters?;
    let find = |name| find_name(section, "parameters", name, parameters.iter().copied());
    let found: Vec<_> = watched.get_ref().iter().map(find).collect();
    found.into_iter().collect()
}

/// Reads `reference`: the word `design`, or a table that says how it is learnt or what it is.
fn read_reference(section: &mut Section<'_>, watched: Option<usize>) -> Option<Reference> {
    if !section.contains("reference") {
        return Some(Reference::Design);
    }
    if section.is_text("reference") {
        return section.choice("reference", &[("design", ())]).map(|_| Reference::Design);
    }
    let mut table = section.table("reference")?;
    let learn_s = table.number("learn-s", Allowed::POSITIVE);
    let mean = table.number_for_each("mean", Allowed::POSITIVE, watched.unwrap_or(1));
    let std = table.number_for_each("std", Allowed::NOT_NEGATIVE, watched.unwrap_or(1));
    let reference = if table.contains("learn-s") {
        if table.contains("mean") || table.contains("std") {
            let allowed = "must give either learn-s, or mean and std";
            table.diagnostics().report(table.span(), table.key("learn-s"), "is given beside mean or std", allowed);
        }
        learn_s.map(|learn_s| Reference::Baseline { learn_s: learn_s.into_inner() })
    } else {
        let mean = table.require("mean", "must be given (or learn-s)", mean);
        let std = table.require("std", "must be given beside mean", std);
        mean.zip(std).map(|(mean, std)| Reference::Given { mean, std })
    };
    table.finish();
    reference
}
