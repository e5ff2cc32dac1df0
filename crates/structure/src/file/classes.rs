//! Reads `[classes]`: which models of the structure are compared.

use super::{check_unique, find_name, parameter::ParameterRead};
use crate::classes::ClassesPlan;
use crate::section::{Allowed, Section};
use spandrel_filter::{ClassPlan, FilterError, Grouping, PersistenceRule};
use toml::Spanned;

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Predefined,
    SelfCalibrating,
    Hierarchical,
}

const KINDS: [(&str, Kind); 3] = [
    ("predefined", Kind::Predefined),
    ("self-calibrating", Kind::SelfCalibrating),
    ("hierarchical", Kind::Hierarchical),
];

const RULES: [(&str, PersistenceRule); 2] =
    [("share", PersistenceRule::Share), ("consecutive", PersistenceRule::Consecutive)];

/// More classes than this would each get a filter, and a message that shows them all grows with them.
const MOST_CLASSES: usize = 100;

/// Reads `[classes]`; without the table there is one model. `parameters` are those of the file, if all could be read.
pub(super) fn read_classes(section: Option<Section<'_>>, parameters: Option<&[ParameterRead]>) -> Option<ClassesPlan> {
    let mut section = section?;
    let kind = section.required_choice("kind", &KINDS).map(Spanned::into_inner);
    let floor = section.number("floor", Allowed::INSIDE_UNIT);
    let persistence_s = section.number("persistence-s", Allowed::POSITIVE).map(Spanned::into_inner);
    let rule = section.choice("persistence", &RULES).map(Spanned::into_inner).unwrap_or_default();
    let reset_std = section.number_or("reset-std", Allowed::POSITIVE, ClassesPlan::RESET_STD);
    let components: Option<Vec<&str>> = parameters.map(|parameters| {
        let stiffness = parameters.iter().filter(|read| read.parameter.is_stiffness());
        stiffness.map(|read| read.parameter.name()).collect()
    });
    let classes = section.tables("class");
    let (declared, span) = (classes.len(), section.span());
    if declared > MOST_CLASSES {
        let found = format!("has {declared} entries");
        section.diagnostics().report(
            span.clone(),
            section.key("class"),
            found,
            format!("must have at most {MOST_CLASSES}"),
        );
    }
    let read: Vec<Option<Class>> =
        classes.into_iter().map(|class| read_class(class, kind, components.as_deref())).collect();
    let plan = match (kind, components, read.into_iter().collect::<Option<Vec<_>>>()) {
        (Some(kind), Some(components), Some(read)) => make_plan(&section, kind, &components, read),
        _ => None,
    };
    if let (Some(floor), Some((names, _))) = (&floor, &plan) {
        let most = names.len() + 1;
        if *floor.get_ref() * most as f64 >= 1.0 {
            let (found, allowed) = (format!("is {}", floor.get_ref()), format!("must be below 1/{most}"));
            section.diagnostics().report(floor.span(), section.key("floor"), found, allowed);
        }
    }
    section.finish();
    let (names, plan) = plan?;
    let floor = floor.map(Spanned::into_inner);
    Some(ClassesPlan { names, plan, floor, persistence_s, persistence_rule: rule, reset_std })
}

/// A `[[classes.class]]`: its name and the components of its groups.
struct Class {
    name: Spanned<String>,
    groups: Vec<Vec<usize>>,
    span: std::ops::Range<usize>,
}

fn read_class(mut section: Section<'_>, kind: Option<Kind>, components: Option<&[&str]>) -> Option<Class> {
    let name = section.required_name("name");
    let span = section.span();
    let lists = match kind {
        Some(Kind::Predefined) => {
            let allowed = "must list groups of stiffness parameters; those in no group share one multiplier";
            let groups = section.name_lists("groups");
            section.require("groups", allowed, groups)
        }
        Some(Kind::SelfCalibrating | Kind::Hierarchical) => {
            let of = section.names("of");
            section.require("of", "must list the stiffness parameters that it singles out", of).map(|of| vec![of])
        }
        None => {
            section.leave_unread(&["groups", "of"]);
            None
        }
    };
    let key = if kind == Some(Kind::Predefined) { "groups" } else { "of" };
    let groups = lists.and_then(|lists| {
        let components = components?;
        let find = |name: &Spanned<String>| find_name(&section, key, name, components.iter().copied());
        let found: Vec<Option<Vec<usize>>> =
            lists.iter().map(|list| list.get_ref().iter().map(find).collect()).collect();
        found.into_iter().collect::<Option<Vec<_>>>()
    });
    section.finish();
    Some(Class { name: name?, groups: groups?, span })
}

fn make_plan(
    section: &Section<'_>,
    kind: Kind,
    components: &[&str],
    classes: Vec<Class>,
) -> Option<(Vec<String>, ClassPlan)> {
    let count = components.len();
    let refuse = |span, found: String, allowed: &str| {
        section.diagnostics().report(span, section.key("class"), found, allowed);
        None::<()>
    };
    if count < 2 {
        let found = format!("has {count} stiffness parameters to group");
        refuse(section.span(), found, "must have at least 2: [[parameter]] with scales = \"stiffness\"")?;
    }
    let names: Vec<_> = classes.iter().map(|class| class.name.clone()).collect();
    check_unique(section, &section.key("class.name"), &names);
    if let Some(taken) = names.iter().find(|name| kind != Kind::Predefined && name.get_ref() == "baseline") {
        refuse(taken.span(), "is \"baseline\"".to_owned(), "must not be the name of the class without any exception")?;
    }
    let mut names: Vec<String> = names.into_iter().map(Spanned::into_inner).collect();
    let groupings = |classes: Vec<Class>| {
        let grouping = |class: Class| match Grouping::new(class.groups, count) {
            Ok(grouping) => Some(grouping),
            Err(error) => {
                refuse(class.span, describe(&error, components), "must name each stiffness parameter once at most");
                None
            }
        };
        let read: Vec<Option<Grouping>> = classes.into_iter().map(grouping).collect();
        read.into_iter().collect::<Option<Vec<_>>>()
    };
    let plan = match kind {
        Kind::Predefined => {
            if classes.len() < 2 {
                let found = format!("has {} entries", classes.len());
                refuse(section.span(), found, "must have at least 2: one class has nothing to be compared with")?;
            }
            ClassPlan::Predefined { classes: groupings(classes)? }
        }
        Kind::SelfCalibrating if classes.is_empty() => {
            // of two components, one alone is the other one alone
            let singled_out = if count == 2 { 1 } else { count };
            names = components.iter().take(singled_out).map(|name| (*name).to_owned()).collect();
            let alone = (0..singled_out).map(|component| Grouping::apart(vec![component], count).ok());
            ClassPlan::SelfCalibrating { classes: alone.collect::<Option<_>>()? }
        }
        Kind::SelfCalibrating => ClassPlan::SelfCalibrating { classes: groupings(classes)? },
        Kind::Hierarchical => {
            let listed: usize = classes.iter().flat_map(|class| &class.groups).map(Vec::len).sum();
            if classes.len() < 2 || listed != count {
                let found = format!("has {} substructures with {listed} stiffness parameters", classes.len());
                let allowed = format!("must have at least 2, with each of the {count} stiffness parameters in one");
                refuse(section.span(), found, &allowed)?;
            }
            let span = section.span();
            let groups = classes.into_iter().flat_map(|class| class.groups).collect();
            match Grouping::new(groups, count) {
                Ok(substructures) => ClassPlan::Hierarchical { substructures },
                Err(error) => {
                    refuse(span, describe(&error, components), "must name each stiffness parameter once")?;
                    return None;
                }
            }
        }
    };
    if let Err(FilterError::Setting { found: class, .. }) = plan.check(count) {
        let found = match (kind, names.get((class as usize).saturating_sub(usize::from(kind != Kind::Predefined)))) {
            (Kind::Predefined | Kind::SelfCalibrating, Some(name)) => format!("groups \"{name}\" as another class"),
            _ => "has classes that are the same".to_owned(),
        };
        let allowed = "must tell every class from the others, and from one multiplier for everything";
        refuse(section.span(), found, allowed)?;
    }
    Some((names, plan))
}

/// Says which component is at fault.
fn describe(error: &FilterError, components: &[&str]) -> String {
    match error {
        FilterError::Setting { found, what, .. } if what.starts_with("component") => {
            let name = components.get(*found as usize).copied().unwrap_or_default();
            format!("names \"{name}\" twice")
        }
        _ => "has an empty group".to_owned(),
    }
}
