//! Reads the kinds `shear-building` and `bouc-wen` of `[model]`: floors joined by linear or
//! hysteretic storeys.

use super::check_unique;
use crate::diagnostics::counted;
use crate::hysteresis::{Drive, Hysteresis};
use crate::linear_system::{Damping, LARGEST_MODEL, LinearSystem, StoreyGroup};
use crate::section::{Allowed, Section};
use crate::shear_building::{ShearBuilding, with_single_storeys};
use toml::Spanned;

const DRIVES: [(&str, Drive); 2] = [("drift", Drive::Drift), ("floor", Drive::Floor)];

/// Reads floors and linear storeys.
pub(super) fn read_chain(section: &mut Section<'_>) -> Option<LinearSystem> {
    let building = read_shear_building(section);
    let groups = section.tables("group");
    let building = building?;
    let storeys = read_groups(section, groups, building.masses_kg.len())?;
    Some(LinearSystem {
        mass: building.mass(),
        substructures: building.substructures(&storeys),
        damping: Damping::NONE,
        degrees_of_freedom: building.degrees_of_freedom(),
        ground_directions: Vec::new(),
        storeys,
        hysteresis: None,
        skeleton: None,
    })
}

/// Reads floors and hysteretic storeys.
pub(super) fn read_hysteretic_chain(section: &mut Section<'_>) -> Option<LinearSystem> {
    let chain = read_chain(section);
    let drive = section
        .choice("drive", &DRIVES)
        .map_or(Drive::Drift, Spanned::into_inner);
    let a = section.number_or("a", Allowed::POSITIVE, 1.0);
    let mu = section.required_number("mu", Allowed::NOT_NEGATIVE);
    let kappa = section.required_number("kappa", Allowed::ANY);
    let eta = section.required_number("eta", Allowed::POSITIVE);
    if let (Some(mu), Some(kappa)) = (&mu, &kappa)
        && mu.get_ref() + kappa.get_ref() <= 0.0
    {
        let found = format!("is {} beside mu = {}", kappa.get_ref(), mu.get_ref());
        let allowed = "must add up to more than 0 with mu, or the force of a spring has no bound";
        section
            .diagnostics()
            .report(kappa.span(), section.key("kappa"), found, allowed);
        return None;
    }
    let [mu, kappa, eta] = [mu?, kappa?, eta?].map(Spanned::into_inner);
    Some(LinearSystem {
        hysteresis: Some(Hysteresis {
            drive,
            a,
            mu,
            kappa,
            eta,
        }),
        ..chain?
    })
}

/// Reads the groups of storeys. A storey without a group becomes a separate group.
fn read_groups(
    section: &Section<'_>,
    tables: Vec<Section<'_>>,
    storeys: usize,
) -> Option<Vec<StoreyGroup>> {
    let declared = tables.len();
    let mut names: Vec<Spanned<String>> = Vec::new();
    let mut groups: Vec<StoreyGroup> = Vec::new();
    for table in tables {
        let Some((name, group)) = read_group(table, storeys) else {
            continue;
        };
        let overlaps = |other: &StoreyGroup| {
            other.storeys.start < group.storeys.end && group.storeys.start < other.storeys.end
        };
        if let Some(other) = groups.iter().find(|other| overlaps(other)) {
            let found = format!("holds storeys of group \"{}\"", other.name);
            section.diagnostics().report(
                name.span(),
                section.key("group"),
                found,
                "must hold storeys of its own",
            );
            continue;
        }
        names.push(name);
        groups.push(group);
    }
    check_unique(section, &section.key("group.name"), &names);
    let complete = groups.len() == declared;
    let all = with_single_storeys(groups, storeys);
    for name in &names {
        if all
            .iter()
            .filter(|group| group.name == *name.get_ref())
            .count()
            > 1
        {
            let found = format!("is \"{}\", a storey outside of the group", name.get_ref());
            section.diagnostics().report(
                name.span(),
                section.key("group.name"),
                found,
                "must be another name",
            );
            return None;
        }
    }
    complete.then_some(all)
}

fn read_group(mut section: Section<'_>, storeys: usize) -> Option<(Spanned<String>, StoreyGroup)> {
    let name = section.required_name("name");
    let range = section.numbers("storeys", Allowed::POSITIVE);
    let allowed = format!("must be [lowest, highest], two whole numbers from 1 to {storeys}");
    let range = section.require("storeys", &allowed, range);
    let is_storey =
        |storey: f64| storey.fract() == 0.0 && storey >= 1.0 && storey <= storeys as f64;
    let storeys = range.and_then(|range| match range.get_ref()[..] {
        [low, high] if low <= high && is_storey(low) && is_storey(high) => {
            Some(low as usize - 1..high as usize)
        }
        _ => {
            let found = format!("is {:?}", range.get_ref());
            section
                .diagnostics()
                .report(range.span(), section.key("storeys"), found, allowed);
            None
        }
    });
    section.finish();
    let name = name?;
    Some((
        name.clone(),
        StoreyGroup {
            name: name.into_inner(),
            storeys: storeys?,
        },
    ))
}

/// Keys of a building with individual values per storey. `EQUAL` holds the keys for equal storeys.
const SINGLE: [&str; 2] = ["masses-kg", "stiffnesses-n-per-m"];
const EQUAL: [&str; 4] = [
    "storeys",
    "mass-kg",
    "stiffness-n-per-m",
    "first-frequency-hz",
];

fn read_shear_building(section: &mut Section<'_>) -> Option<ShearBuilding> {
    let given = |keys: &[&'static str]| keys.iter().copied().find(|key| section.contains(key));
    if let (Some(single), Some(equal)) = (given(&SINGLE), given(&EQUAL)) {
        let found = format!("is given together with {single}");
        let allowed = "must give either masses-kg and stiffnesses-n-per-m, one number per storey, \
                       or storeys and mass-kg with stiffness-n-per-m or first-frequency-hz, for \
                       equal storeys";
        section
            .diagnostics()
            .report(section.span_of(equal), section.key(equal), found, allowed);
        section.leave_unread(&SINGLE);
        section.leave_unread(&EQUAL);
        return None;
    }
    if section.contains("storeys") {
        return read_uniform_building(section);
    }
    let masses = section.numbers("masses-kg", Allowed::POSITIVE);
    let stiffnesses = section.numbers("stiffnesses-n-per-m", Allowed::POSITIVE);
    let allowed =
        "must list one number per storey from the bottom up (or give storeys for equal ones)";
    let masses = section.require("masses-kg", allowed, masses);
    let stiffnesses = section.require("stiffnesses-n-per-m", allowed, stiffnesses);
    let (masses, stiffnesses) = (masses?, stiffnesses?);
    let [floors, storeys] = [masses.get_ref().len(), stiffnesses.get_ref().len()];
    if floors == 0 || floors != storeys {
        let found = format!(
            "has {} for {}",
            counted(storeys, "entry", "entries"),
            counted(floors, "mass", "masses")
        );
        let key = section.key("stiffnesses-n-per-m");
        section.diagnostics().report(
            stiffnesses.span(),
            key,
            found,
            "must have one stiffness per mass",
        );
        return None;
    }
    if floors > LARGEST_MODEL {
        let found = format!("has {}", counted(floors, "entry", "entries"));
        let allowed = format!("must have at most {LARGEST_MODEL}");
        section
            .diagnostics()
            .report(masses.span(), section.key("masses-kg"), found, allowed);
        return None;
    }
    Some(ShearBuilding {
        masses_kg: masses.into_inner(),
        stiffnesses_n_per_m: stiffnesses.into_inner(),
    })
}

fn read_uniform_building(section: &mut Section<'_>) -> Option<ShearBuilding> {
    let storeys = section.whole("storeys", 1, LARGEST_MODEL);
    let mass = section.required_number("mass-kg", Allowed::POSITIVE);
    let frequency = section.number("first-frequency-hz", Allowed::POSITIVE);
    let stiffness = section.number("stiffness-n-per-m", Allowed::POSITIVE);
    if section.contains("first-frequency-hz") == section.contains("stiffness-n-per-m") {
        let (found, key) = if section.contains("stiffness-n-per-m") {
            (
                "is given together with stiffness-n-per-m",
                section.key("first-frequency-hz"),
            )
        } else {
            ("is missing", section.key("stiffness-n-per-m"))
        };
        let allowed = "must give either stiffness-n-per-m or first-frequency-hz";
        section
            .diagnostics()
            .report(section.span(), key, found, allowed);
        return None;
    }
    let (storeys, mass) = (storeys?.into_inner(), mass?.into_inner());
    match (stiffness, frequency) {
        (Some(stiffness), _) => Some(ShearBuilding {
            masses_kg: vec![mass; storeys],
            stiffnesses_n_per_m: vec![stiffness.into_inner(); storeys],
        }),
        (None, Some(frequency)) => Some(ShearBuilding::uniform(
            storeys,
            mass,
            frequency.into_inner(),
        )),
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests;
