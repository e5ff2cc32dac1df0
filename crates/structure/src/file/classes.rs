//! Reads `[classes]`, the model classes to compare.

use super::{check_unique, find_name, parameter::ParameterRead, read_time};
use crate::classes::ClassesPlan;
use crate::diagnostics::counted;
use crate::section::{Allowed, Section};
use spandrel_filter::{ClassPlan, FilterError, Grouping, PersistenceRule};
use std::ops::{Range, RangeInclusive};
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

const RULES: [(&str, PersistenceRule); 2] = [
    ("share", PersistenceRule::Share),
    ("consecutive", PersistenceRule::Consecutive),
];

/// Maximum number of classes. Each class gets a filter, and the message that shows them all grows
/// with their number.
const MOST_CLASSES: usize = 100;

/// Allowed number of steps of a persistence. The bank stores four times as many leading classes.
const PERSISTENCE: RangeInclusive<usize> = 1..=ClassesPlan::MOST_PERSISTENCE_STEPS;

/// Minimum number of substructures. With two, singling out one is the same as singling out the
/// other.
const LEAST_SUBSTRUCTURES: usize = 3;

/// Reads `[classes]`; without the table there is one model.
///
/// `parameters` are those of the file, or `None` if some could not be read. `rate_hz` is the
/// sampling rate of the structure.
pub(super) fn read_classes(
    section: Option<Section<'_>>,
    parameters: Option<&[ParameterRead]>,
    rate_hz: Option<f64>,
) -> Option<ClassesPlan> {
    let mut section = section?;
    let kind = section
        .required_choice("kind", &KINDS)
        .map(Spanned::into_inner);
    let floor = section.number("floor", Allowed::SHARE);
    let persistence_s = read_time(&mut section, "persistence-s", rate_hz, PERSISTENCE);
    let rule = section
        .choice("persistence", &RULES)
        .map(Spanned::into_inner)
        .unwrap_or_default();
    let reset_std = read_reset_std(&mut section, kind);
    let components: Option<Vec<&str>> = parameters.map(|parameters| {
        let stiffness = parameters
            .iter()
            .filter(|read| read.parameter.is_stiffness());
        stiffness.map(|read| read.parameter.name()).collect()
    });
    let tables = section.tables("class");
    if tables.len() > MOST_CLASSES {
        let allowed = format!("must have at most {MOST_CLASSES}");
        report(
            &section,
            section.span(),
            format!("has {} entries", tables.len()),
            &allowed,
        );
    }
    let read: Vec<Option<Class>> = tables
        .into_iter()
        .map(|class| read_class(class, kind, components.as_deref()))
        .collect();
    let plan = match (
        kind,
        components,
        read.into_iter().collect::<Option<Vec<_>>>(),
    ) {
        (Some(kind), Some(components), Some(classes)) => {
            make_plan(&section, kind, &components, classes)
        }
        _ => None,
    };
    if let (Some(floor), Some(NamedClasses { names, .. })) = (&floor, &plan) {
        let most = names.len() + 1;
        if *floor.get_ref() * most as f64 >= 1.0 {
            let (found, allowed) = (
                format!("is {}", floor.get_ref()),
                format!("must be below 1/{most}"),
            );
            section
                .diagnostics()
                .report(floor.span(), section.key("floor"), found, allowed);
        }
    }
    section.finish();
    let NamedClasses { names, plan } = plan?;
    let floor = floor.map(Spanned::into_inner);
    Some(ClassesPlan {
        names,
        plan,
        floor,
        persistence_s,
        persistence_rule: rule,
        reset_std,
    })
}

fn read_reset_std(section: &mut Section<'_>, kind: Option<Kind>) -> f64 {
    let reset_std = section.number_or(
        "reset-std",
        Allowed::RATIO_DEVIATION,
        ClassesPlan::RESET_STD,
    );
    if kind == Some(Kind::Predefined) && section.contains("reset-std") {
        let allowed = "must not be given for kind \"predefined\", which has no calibration";
        section.diagnostics().report(
            section.span_of("reset-std"),
            section.key("reset-std"),
            "is given",
            allowed,
        );
    }
    reset_std
}

/// Reports a mistake in one `[[classes.class]]`, or in all of them.
fn report(section: &Section<'_>, span: Range<usize>, found: String, allowed: &str) {
    section
        .diagnostics()
        .report(span, section.key("class"), found, allowed);
}

/// A `[[classes.class]]` table: its name and the components of its groups.
struct Class {
    name: Spanned<String>,
    groups: Vec<Vec<Spanned<usize>>>,
    span: Range<usize>,
}

impl Class {
    fn components(&self) -> impl Iterator<Item = &Spanned<usize>> {
        self.groups.iter().flatten()
    }

    fn grouping(&self, components: usize) -> Result<Grouping, FilterError> {
        let plain = |group: &Vec<Spanned<usize>>| {
            group.iter().map(|component| *component.get_ref()).collect()
        };
        Grouping::new(self.groups.iter().map(plain).collect(), components)
    }
}

fn read_class(
    mut section: Section<'_>,
    kind: Option<Kind>,
    components: Option<&[&str]>,
) -> Option<Class> {
    let name = section.required_name("name");
    let span = section.span();
    let key = if kind == Some(Kind::Predefined) {
        "groups"
    } else {
        "of"
    };
    let lists = match kind {
        Some(Kind::Predefined) => {
            let allowed =
                "must list groups of stiffness parameters; those in no group share one multiplier";
            let groups = section.name_lists("groups");
            section.require("groups", allowed, groups)
        }
        Some(Kind::SelfCalibrating | Kind::Hierarchical) => {
            let of = section.names("of");
            section
                .require(
                    "of",
                    "must list the stiffness parameters that it singles out",
                    of,
                )
                .map(|of| vec![of])
        }
        None => {
            section.leave_unread(&["groups", "of"]);
            None
        }
    };
    let groups = lists.and_then(|lists| read_groups(&section, key, &lists, components?));
    section.finish();
    Some(Class {
        name: name?,
        groups: groups?,
        span,
    })
}

/// Finds the components of each group; reports empty groups and components that occur twice.
fn read_groups(
    section: &Section<'_>,
    key: &str,
    lists: &[Spanned<Vec<Spanned<String>>>],
    components: &[&str],
) -> Option<Vec<Vec<Spanned<usize>>>> {
    let mut taken = vec![false; components.len()];
    let mut right = true;
    let mut groups = Vec::with_capacity(lists.len());
    for list in lists {
        if list.get_ref().is_empty() {
            let allowed = "must name at least one stiffness parameter";
            section.diagnostics().report(
                list.span(),
                section.key(key),
                "has an empty list",
                allowed,
            );
            right = false;
        }
        let mut group = Vec::with_capacity(list.get_ref().len());
        for name in list.get_ref() {
            match find_name(section, key, name, components.iter().copied()) {
                Some(component) if taken[component] => {
                    let (found, allowed) = (
                        format!("names \"{}\" twice", name.get_ref()),
                        "must name it at most once",
                    );
                    section
                        .diagnostics()
                        .report(name.span(), section.key(key), found, allowed);
                    right = false;
                }
                Some(component) => {
                    taken[component] = true;
                    group.push(Spanned::new(name.span(), component));
                }
                None => right = false,
            }
        }
        groups.push(group);
    }
    right.then_some(groups)
}

/// The classes to compare, and their names.
struct NamedClasses {
    names: Vec<String>,
    plan: ClassPlan,
}

fn make_plan(
    section: &Section<'_>,
    kind: Kind,
    components: &[&str],
    classes: Vec<Class>,
) -> Option<NamedClasses> {
    let count = components.len();
    if count < 2 {
        let found = format!(
            "has {} to group",
            counted(count, "stiffness parameter", "stiffness parameters")
        );
        report(
            section,
            section.span(),
            found,
            "must have at least 2: [[parameter]] with scales = \"stiffness\"",
        );
        return None;
    }
    let names: Vec<_> = classes.iter().map(|class| class.name.clone()).collect();
    check_unique(section, &section.key("class.name"), &names);
    if let Some(taken) = names
        .iter()
        .find(|name| kind != Kind::Predefined && name.get_ref() == "baseline")
    {
        let allowed = "must not be the name of the class without any exception";
        report(section, taken.span(), "is \"baseline\"".to_owned(), allowed);
        return None;
    }
    let mut names: Vec<String> = names.into_iter().map(Spanned::into_inner).collect();
    let plan = match kind {
        Kind::Predefined => {
            if classes.len() < 2 {
                let found = format!("has {}", counted(classes.len(), "entry", "entries"));
                let allowed = "must have at least 2: one class has nothing to be compared with";
                report(section, section.span(), found, allowed);
                return None;
            }
            ClassPlan::Predefined {
                classes: make_groupings(section, kind, count, &classes)?,
            }
        }
        Kind::SelfCalibrating if classes.is_empty() => {
            // With two components, singling out one is the same as singling out the other.
            let singled_out = if count == 2 { 1 } else { count };
            names = components
                .iter()
                .take(singled_out)
                .map(|name| (*name).to_owned())
                .collect();
            let alone =
                (0..singled_out).map(|component| Grouping::apart(vec![component], count).ok());
            ClassPlan::SelfCalibrating {
                classes: alone.collect::<Option<_>>()?,
            }
        }
        Kind::SelfCalibrating => ClassPlan::SelfCalibrating {
            classes: make_groupings(section, kind, count, &classes)?,
        },
        Kind::Hierarchical => ClassPlan::Hierarchical {
            substructures: make_hierarchy(section, components, &classes)?,
        },
    };
    Some(NamedClasses { names, plan })
}

/// Creates the partition of each class. Identical partitions are a mistake, because their classes
/// would alternate indefinitely.
fn make_groupings(
    section: &Section<'_>,
    kind: Kind,
    count: usize,
    classes: &[Class],
) -> Option<Vec<Grouping>> {
    let mut groupings: Vec<Grouping> = Vec::with_capacity(classes.len());
    let mut right = true;
    for class in classes {
        let grouping = class.grouping(count).ok()?;
        let name = class.name.get_ref();
        if kind == Kind::SelfCalibrating && grouping.is_same_partition(&Grouping::together(count)) {
            let found = format!("lists all {count} stiffness parameters for \"{name}\"");
            let allowed = "must leave out at least one: all of them together are the baseline";
            report(section, class.span.clone(), found, allowed);
            right = false;
        }
        if let Some(earlier) = groupings
            .iter()
            .position(|earlier| earlier.is_same_partition(&grouping))
        {
            let found = format!(
                "groups \"{name}\" as \"{}\" does",
                classes[earlier].name.get_ref()
            );
            let allowed = match kind {
                Kind::Predefined => "must distinguish every class from the others",
                Kind::SelfCalibrating | Kind::Hierarchical => {
                    "must distinguish every class from the others: singling out some parts is the \
                     same as singling out all others"
                }
            };
            report(section, class.span.clone(), found, allowed);
            right = false;
        }
        groupings.push(grouping);
    }
    right.then_some(groupings)
}

/// Creates the partition into substructures, each with separate components.
fn make_hierarchy(
    section: &Section<'_>,
    components: &[&str],
    classes: &[Class],
) -> Option<Grouping> {
    let mut substructure_of: Vec<Option<&str>> = vec![None; components.len()];
    let mut right = true;
    for class in classes {
        for component in class.components() {
            let entry = &mut substructure_of[*component.get_ref()];
            if let Some(other) = entry {
                let found = format!(
                    "names \"{}\", which \"{other}\" names too",
                    components[*component.get_ref()]
                );
                let allowed = "must be in one substructure only";
                section.diagnostics().report(
                    component.span(),
                    section.key("class.of"),
                    found,
                    allowed,
                );
                right = false;
            } else {
                *entry = Some(class.name.get_ref());
            }
        }
    }
    let alone = components
        .iter()
        .zip(&substructure_of)
        .filter(|(_, substructure)| substructure.is_none());
    let missing: Vec<String> = alone
        .map(|(component, _)| format!("\"{component}\""))
        .collect();
    if classes.len() < LEAST_SUBSTRUCTURES {
        let found = format!(
            "has {}",
            counted(classes.len(), "substructure", "substructures")
        );
        let allowed = format!(
            "must have at least {LEAST_SUBSTRUCTURES}: with two, both comparisons against the \
             rest are the same"
        );
        report(section, section.span(), found, &allowed);
        right = false;
    } else if !missing.is_empty() {
        let allowed = "must have each stiffness parameter in one substructure";
        report(
            section,
            section.span(),
            format!("leaves out {}", missing.join(", ")),
            allowed,
        );
        right = false;
    }
    let groups = classes.iter().map(|class| {
        class
            .components()
            .map(|component| *component.get_ref())
            .collect()
    });
    let substructures = right.then(|| Grouping::new(groups.collect(), components.len()))?;
    substructures.ok()
}

#[cfg(test)]
mod tests;
