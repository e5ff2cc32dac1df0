//! Reads `[[parameter]]`.

use super::{check_unique, find_names};
use crate::hysteresis::Constant;
use crate::linear_system::{Damping, LinearSystem, Mass};
use crate::parameter::{Parameter, Scales};
use crate::section::{Allowed, Section};
use toml::Spanned;

#[derive(Clone, Copy, PartialEq)]
enum What {
    Stiffness,
    Mass,
    Damping,
    DampingAlpha,
    DampingBeta,
    Hysteresis(Constant),
}

const WHAT: [(&str, What); 9] = [
    ("stiffness", What::Stiffness),
    ("mass", What::Mass),
    ("damping-alpha", What::DampingAlpha),
    ("damping-beta", What::DampingBeta),
    ("damping", What::Damping),
    ("hysteresis-a", What::Hysteresis(Constant::A)),
    ("hysteresis-mu", What::Hysteresis(Constant::Mu)),
    ("hysteresis-kappa", What::Hysteresis(Constant::Kappa)),
    ("hysteresis-eta", What::Hysteresis(Constant::Eta)),
];

/// Default prior standard deviation of a stiffness or mass factor.
///
/// Drawings and material tests are rarely more precise.
const STD: f64 = 0.2;
/// Default prior standard deviation of a damping factor. Damping is a guess until it is measured.
const DAMPING_STD: f64 = 0.5;
/// Default bounds of a factor. A factor outside them indicates a wrong model, not a change of the
/// structure.
const BOUNDS: (f64, f64) = (0.05, 20.0);

/// A parameter, with the position of its name in the file.
pub(super) struct ParameterRead {
    pub(super) parameter: Parameter,
    pub(super) name: Spanned<String>,
}

/// Reads every `[[parameter]]`; also returns the number of declared parameters.
pub(super) fn read_parameters(
    file: &mut Section<'_>,
    system: Option<&LinearSystem>,
    damping: Option<&Damping>,
) -> (usize, Vec<ParameterRead>) {
    let sections = file.tables("parameter");
    let declared = sections.len();
    let mut read: Vec<ParameterRead> = Vec::new();
    for section in sections {
        if let Some(parameter) = read_parameter(section, system, damping, &read) {
            read.push(parameter);
        }
    }
    let names: Vec<_> = read.iter().map(|read| read.name.clone()).collect();
    check_unique(file, "parameter.name", &names);
    (declared, read)
}

fn read_parameter(
    mut section: Section<'_>,
    system: Option<&LinearSystem>,
    damping: Option<&Damping>,
    earlier: &[ParameterRead],
) -> Option<ParameterRead> {
    let name = section.required_name("name");
    let what = section.required_choice("scales", &WHAT);
    let mean = section.number_or("mean", Allowed::POSITIVE, 1.0);
    let std = section.number("std", Allowed::RATIO_DEVIATION);
    let bounds = read_bounds(&mut section, mean);
    let what = what.map(Spanned::into_inner);
    let default_std = match what {
        Some(What::Damping | What::DampingAlpha | What::DampingBeta) => DAMPING_STD,
        Some(What::Stiffness | What::Mass | What::Hysteresis(_)) | None => STD,
    };
    let scales = match what {
        Some(What::Stiffness) => read_stiffness(&mut section, system),
        Some(What::Mass) => read_mass(&mut section, system),
        Some(What::Damping) => read_damping_of(&mut section, damping),
        Some(What::Hysteresis(constant)) => read_constant(&section, constant, system),
        Some(damping_part) => read_damping_part(&section, damping_part, damping),
        None => {
            section.leave_unread(&["of"]);
            None
        }
    };
    if let Some(scales) = &scales {
        check_scaled_once(&section, scales, system, earlier);
    }
    section.finish();
    let name = name?;
    let std = std.map_or(default_std, Spanned::into_inner);
    let parameter = Parameter {
        name: name.get_ref().clone(),
        scales: scales?,
        mean,
        std,
        bounds,
    };
    Some(ParameterRead { parameter, name })
}

fn read_bounds(section: &mut Section<'_>, mean: f64) -> (f64, f64) {
    let Some(bounds) = section.numbers("bounds", Allowed::POSITIVE) else {
        return BOUNDS;
    };
    match bounds.get_ref()[..] {
        [low, high] if low < mean && mean < high => (low, high),
        _ => {
            let found = format!("is {:?}", bounds.get_ref());
            let allowed = format!("must be [low, high] around the mean {mean}");
            section
                .diagnostics()
                .report(bounds.span(), section.key("bounds"), found, allowed);
            BOUNDS
        }
    }
}

/// Reads the list of scaled objects; an empty list is a mistake.
fn read_of(section: &mut Section<'_>, allowed: &str) -> Option<Spanned<Vec<Spanned<String>>>> {
    let of = section.names("of");
    let of = section.require("of", allowed, of)?;
    if of.get_ref().is_empty() {
        section
            .diagnostics()
            .report(of.span(), section.key("of"), "scales nothing", allowed);
        return None;
    }
    check_unique(section, &section.key("of"), of.get_ref());
    Some(of)
}

fn read_stiffness(section: &mut Section<'_>, system: Option<&LinearSystem>) -> Option<Scales> {
    let of = read_of(
        section,
        "must list the substructures whose stiffness is scaled",
    )?;
    let parts = &system?.substructures;
    let names = parts.iter().map(|part| part.name.as_str());
    let indices = find_names(section, "of", of.get_ref(), names)?;
    let effect = indices.iter().any(|index| {
        parts[*index]
            .stiffness
            .values()
            .iter()
            .any(|value| *value != 0.0)
    });
    if !effect {
        let allowed = "must scale a substructure whose stiffness is not zero";
        section
            .diagnostics()
            .report(of.span(), section.key("of"), "has no effect", allowed);
        return None;
    }
    Some(Scales::Stiffness(indices))
}

fn read_mass(section: &mut Section<'_>, system: Option<&LinearSystem>) -> Option<Scales> {
    let of = read_of(
        section,
        "must list the degrees of freedom whose mass is scaled",
    )?;
    let system = system?;
    if let Mass::Consistent { .. } = system.mass {
        let allowed = "must not scale masses unless the mass matrix is diagonal";
        section
            .diagnostics()
            .report(of.span(), section.key("scales"), "is \"mass\"", allowed);
        return None;
    }
    let names = system.degrees_of_freedom.iter().map(String::as_str);
    find_names(section, "of", of.get_ref(), names).map(Scales::Mass)
}

/// Reads the scaled dashpots, or the word `all`.
fn read_damping_of(section: &mut Section<'_>, damping: Option<&Damping>) -> Option<Scales> {
    if section.is_text("of") {
        let word = section.text("of")?;
        if word.get_ref() != "all" {
            let found = format!("is \"{}\"", word.get_ref());
            let allowed = "must be \"all\", or a list of the storeys whose dashpots are scaled";
            section
                .diagnostics()
                .report(word.span(), section.key("of"), found, allowed);
            return None;
        }
        return read_all_damping(section, damping?);
    }
    let of = read_of(section, "must list the storeys whose dashpots are scaled")?;
    let Damping::Dashpots(parts) = damping? else {
        let allowed = "must not be scaled storey by storey unless damping.kind is \"dashpots\"";
        section
            .diagnostics()
            .report(of.span(), section.key("scales"), "is \"damping\"", allowed);
        return None;
    };
    let names = parts.iter().map(|part| part.name.as_str());
    find_names(section, "of", of.get_ref(), names).map(Scales::Dashpots)
}

/// Scales all damping of the structure; reports zero damping.
fn read_all_damping(section: &Section<'_>, damping: &Damping) -> Option<Scales> {
    match damping {
        Damping::Rayleigh {
            alpha_per_s,
            beta_s,
        } if *alpha_per_s == 0.0 && *beta_s == 0.0 => {
            let allowed = "must scale damping that is not zero";
            section.diagnostics().report(
                section.span(),
                section.key("scales"),
                "has no effect: there is none",
                allowed,
            );
            None
        }
        Damping::Rayleigh { .. } => Some(Scales::Damping),
        Damping::Dashpots(parts) => Some(Scales::Dashpots((0..parts.len()).collect())),
        Damping::Matrix(_) => Some(Scales::Dashpots(vec![0])),
    }
}

fn read_constant(
    section: &Section<'_>,
    constant: Constant,
    system: Option<&LinearSystem>,
) -> Option<Scales> {
    let law = system?.hysteresis;
    if law.is_none_or(|law| law.constant(constant) == 0.0) {
        let found = if law.is_none() {
            "has no effect: nothing is hysteretic"
        } else {
            "has no effect: it is 0"
        };
        let allowed = "must scale a constant of the kind bouc-wen that is not zero";
        section
            .diagnostics()
            .report(section.span(), section.key("scales"), found, allowed);
        return None;
    }
    Some(Scales::Hysteresis(constant))
}

fn read_damping_part(
    section: &Section<'_>,
    part: What,
    damping: Option<&Damping>,
) -> Option<Scales> {
    let (nominal, scales, coefficient) = match (damping?, part) {
        (Damping::Rayleigh { alpha_per_s, .. }, What::DampingAlpha) => {
            (*alpha_per_s, Scales::DampingAlpha, "alpha")
        }
        (Damping::Rayleigh { beta_s, .. }, _) => (*beta_s, Scales::DampingBeta, "beta"),
        (Damping::Dashpots(_) | Damping::Matrix(_), _) => {
            (0.0, Scales::DampingAlpha, "Rayleigh damping")
        }
    };
    if nominal == 0.0 {
        let found = format!("has no effect: there is no {coefficient}");
        let allowed = "must scale a damping coefficient of [damping] that is not zero";
        section
            .diagnostics()
            .report(section.span(), section.key("scales"), found, allowed);
        return None;
    }
    Some(scales)
}

/// Checks that no other parameter scales the same object, because two factors on one value cannot
/// be distinguished.
fn check_scaled_once(
    section: &Section<'_>,
    scales: &Scales,
    system: Option<&LinearSystem>,
    earlier: &[ParameterRead],
) {
    for other in earlier {
        let shared = match (scales, &other.parameter.scales) {
            (Scales::Stiffness(a), Scales::Stiffness(b)) => {
                let shared = a.iter().find(|index| b.contains(index));
                shared.and_then(|index| Some(system?.substructures[*index].name.clone()))
            }
            (Scales::Mass(a), Scales::Mass(b)) => {
                let shared = a.iter().find(|index| b.contains(index));
                shared.and_then(|index| Some(system?.degrees_of_freedom[*index].clone()))
            }
            (Scales::Dashpots(a), Scales::Dashpots(b)) => {
                let shared = a.iter().find(|index| b.contains(index));
                let name = |index: &usize| system.and_then(|system| system.storeys.get(*index));
                shared.map(|index| {
                    name(index).map_or("the damping".to_owned(), |storey| {
                        format!("the dashpot of {}", storey.name)
                    })
                })
            }
            (Scales::Hysteresis(a), Scales::Hysteresis(b)) if a == b => {
                Some("the same constant".to_owned())
            }
            (Scales::Damping | Scales::DampingAlpha, Scales::Damping | Scales::DampingAlpha) => {
                Some("alpha".to_owned())
            }
            (Scales::Damping | Scales::DampingBeta, Scales::Damping | Scales::DampingBeta) => {
                Some("beta".to_owned())
            }
            _ => None,
        };
        if let Some(shared) = shared {
            let found = format!(
                "scales {shared} as parameter \"{}\" does",
                other.parameter.name
            );
            let allowed = "must scale what no other parameter scales";
            section
                .diagnostics()
                .report(section.span(), section.key("of"), found, allowed);
        }
    }
}
