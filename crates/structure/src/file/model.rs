//! Reads `[model]`: the kind, and the shear building.

use super::matrices::read_matrices;
use super::mesh::{MeshKind, read_mesh};
use crate::linear_system::{Damping, LARGEST_MODEL, LinearSystem};
use crate::modes::Modes;
use crate::section::{Allowed, Section};
use crate::shear_building::ShearBuilding;

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    ShearBuilding,
    Frame,
    Truss,
    Matrices,
}

const KINDS: [(&str, Kind); 4] = [
    ("shear-building", Kind::ShearBuilding),
    ("frame", Kind::Frame),
    ("truss", Kind::Truss),
    ("matrices", Kind::Matrices),
];

/// Reads `[model]`; the damping of the result is still zero.
pub(super) fn read_model(mut section: Section<'_>) -> Option<LinearSystem> {
    let kind = section.required_choice("kind", &KINDS)?;
    let system = match kind.into_inner() {
        Kind::ShearBuilding => read_shear_building(&mut section).map(|building| LinearSystem {
            mass: building.mass(),
            substructures: building.substructures(),
            damping: Damping::NONE,
            degrees_of_freedom: building.degrees_of_freedom(),
            ground_directions: Vec::new(),
        }),
        Kind::Frame => read_mesh(&mut section, MeshKind::Frame),
        Kind::Truss => read_mesh(&mut section, MeshKind::Truss),
        Kind::Matrices => read_matrices(&mut section),
    };
    let system = system.filter(|system| check_frequencies(&section, system));
    section.finish();
    system
}

/// Numbers that are finite may still have frequencies that are not.
fn check_frequencies(section: &Section<'_>, system: &LinearSystem) -> bool {
    let modes = Modes::new(system.mass.to_dense(), system.nominal_stiffness());
    let sound = |modes: Modes| modes.angular_frequencies.iter().all(|omega| omega.is_normal());
    let sound = modes.is_some_and(sound);
    if !sound {
        let allowed = "must have masses and stiffnesses of real structures";
        section.diagnostics().report(section.span(), section.key("kind"), "has no natural frequencies", allowed);
    }
    sound
}

fn read_shear_building(section: &mut Section<'_>) -> Option<ShearBuilding> {
    if section.contains("storeys") {
        return read_uniform_building(section);
    }
    let masses = section.numbers("masses-kg", Allowed::POSITIVE);
    let stiffnesses = section.numbers("stiffnesses-n-per-m", Allowed::POSITIVE);
    let allowed = "must list one number per storey from the bottom up (or give storeys for equal ones)";
    let masses = section.require("masses-kg", allowed, masses);
    let stiffnesses = section.require("stiffnesses-n-per-m", allowed, stiffnesses);
    let (masses, stiffnesses) = (masses?, stiffnesses?);
    let [floors, storeys] = [masses.get_ref().len(), stiffnesses.get_ref().len()];
    if floors == 0 || floors != storeys {
        let found = format!("has {storeys} entries for {floors} masses");
        let key = section.key("stiffnesses-n-per-m");
        section.diagnostics().report(stiffnesses.span(), key, found, "must have one stiffness per mass");
        return None;
    }
    if floors > LARGEST_MODEL {
        let found = format!("has {floors} entries");
        let allowed = format!("must have at most {LARGEST_MODEL}");
        section.diagnostics().report(masses.span(), section.key("masses-kg"), found, allowed);
        return None;
    }
    Some(ShearBuilding { masses_kg: masses.into_inner(), stiffnesses_n_per_m: stiffnesses.into_inner() })
}

fn read_uniform_building(section: &mut Section<'_>) -> Option<ShearBuilding> {
    let storeys = section.whole("storeys", 1, LARGEST_MODEL);
    let mass = section.required_number("mass-kg", Allowed::POSITIVE);
    let frequency = section.number("first-frequency-hz", Allowed::POSITIVE);
    let stiffness = section.number("stiffness-n-per-m", Allowed::POSITIVE);
    if section.contains("first-frequency-hz") == section.contains("stiffness-n-per-m") {
        let (found, key) = if section.contains("stiffness-n-per-m") {
            ("is given beside stiffness-n-per-m", section.key("first-frequency-hz"))
        } else {
            ("is missing", section.key("stiffness-n-per-m"))
        };
        let allowed = "must give either stiffness-n-per-m or first-frequency-hz";
        section.diagnostics().report(section.span(), key, found, allowed);
        return None;
    }
    let (storeys, mass) = (storeys?.into_inner(), mass?.into_inner());
    match (stiffness, frequency) {
        (Some(stiffness), _) => Some(ShearBuilding {
            masses_kg: vec![mass; storeys],
            stiffnesses_n_per_m: vec![stiffness.into_inner(); storeys],
        }),
        (None, Some(frequency)) => Some(ShearBuilding::uniform(storeys, mass, frequency.into_inner())),
        (None, None) => None,
    }
}
