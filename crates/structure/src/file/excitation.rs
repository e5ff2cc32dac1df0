//! Reads `[[excitation]]`.

use super::check_unique;
use super::force_field::{KEYS as FIELD_KEYS, read_force_field};
use super::matrices::beside;
use super::node::{ChannelRead, degree_of_freedom};
use crate::diagnostics::{counted, one_of};
use crate::excitation::{Action, Excitation, Measured};
use crate::linear_system::LinearSystem;
use crate::matrix_file::{self, Unusable};
use crate::node::Quantity;
use crate::section::{Allowed, Section};
use toml::Spanned;

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Ground,
    Force,
    ForceField,
}

const KINDS: [(&str, Kind); 3] = [
    ("ground", Kind::Ground),
    ("force", Kind::Force),
    ("force-field", Kind::ForceField),
];

/// Objects to which the excitations refer.
pub(super) struct Context<'c> {
    /// Sampling rate of the structure (Hz), required to convert a spectral intensity.
    pub(super) rate_hz: Option<f64>,
    pub(super) system: Option<&'c LinearSystem>,
    /// `None` if some channel could not be read; channel names are then not resolved.
    pub(super) channels: Option<&'c [ChannelRead]>,
}

/// An excitation, with the position of its name in the file.
pub(super) struct ExcitationRead {
    pub(super) excitation: Excitation,
    pub(super) name: Spanned<String>,
}

/// Reads every `[[excitation]]`; also returns the number of declared excitations.
pub(super) fn read_excitations(
    file: &mut Section<'_>,
    context: &Context<'_>,
) -> (usize, Vec<ExcitationRead>) {
    let sections = file.tables("excitation");
    if sections.is_empty() {
        file.require(
            "excitation",
            "must declare an excitation: [[excitation]]",
            None::<()>,
        );
    }
    let declared = sections.len();
    let read: Vec<_> = sections
        .into_iter()
        .filter_map(|section| read_excitation(section, context))
        .collect();
    let names: Vec<_> = read.iter().map(|read| read.name.clone()).collect();
    check_unique(file, "excitation.name", &names);
    if let Some(channels) = context.channels.filter(|_| read.len() == declared) {
        check_each_channel_is_used_once(file, channels, &read);
    }
    (declared, read)
}

fn read_excitation(mut section: Section<'_>, context: &Context<'_>) -> Option<ExcitationRead> {
    let name = section.required_name("name");
    let kind = section
        .required_choice("kind", &KINDS)
        .map(Spanned::into_inner);
    let level = read_level(&mut section);
    if kind == Some(Kind::ForceField) {
        let std = section.number_or("level", Allowed::DEVIATION, 1.0);
        let field = read_force_field(&mut section, context.system);
        section.finish();
        let (name, action) = (name?, Action::ForceField(field?));
        let excitation = level.of(name.get_ref(), action, std, None);
        return Some(ExcitationRead { excitation, name });
    }
    let std = read_std(&mut section, context.rate_hz);
    let measured_on = section.name("measured-on");
    let action = match kind {
        Some(Kind::Ground) => read_ground(&mut section, context.system),
        Some(Kind::Force) => {
            let dof = section.number_or_name("dof");
            let dof = section.require(
                "dof",
                "must be the number or the name of a degree of freedom",
                dof,
            );
            dof.and_then(|dof| degree_of_freedom(&section, "dof", &dof, context.system))
                .map(|degree_of_freedom| Action::Force { degree_of_freedom })
        }
        Some(Kind::ForceField) | None => {
            section.leave_unread(&["dof", "influence", "direction"]);
            section.leave_unread(&FIELD_KEYS);
            None
        }
    };
    let measured =
        measured_on.and_then(|channel| read_measured(&section, kind, &channel, context.channels?));
    if section.contains("measured-on") && level.factor.is_some() {
        let allowed = "must not be given together with measured-on: the channel specifies the \
            level of a measured excitation";
        section.diagnostics().report(
            section.span(),
            section.key("level-factor"),
            "is given",
            allowed,
        );
    }
    section.finish();
    let name = name?;
    let excitation = level.of(name.get_ref(), action?, std?, measured);
    Some(ExcitationRead { excitation, name })
}

/// Stated knowledge of a level.
#[derive(Clone, Copy)]
struct Level {
    adapt: Option<bool>,
    factor: Option<f64>,
}

impl Level {
    /// Creates an excitation.
    ///
    /// By default, the filter adapts the level if no channel measures the excitation.
    fn of(self, name: &str, action: Action, std: f64, measured: Option<Measured>) -> Excitation {
        let adapts = self
            .adapt
            .unwrap_or(measured.is_none() && self.factor != Some(1.0));
        Excitation {
            name: name.to_owned(),
            action,
            std,
            measured,
            adapts,
            level_factor: self.factor,
        }
    }
}

fn read_level(section: &mut Section<'_>) -> Level {
    let adapt = section.flag("adapt");
    let factor = section
        .number("level-factor", Allowed::FACTOR)
        .map(Spanned::into_inner);
    if adapt == Some(true) && factor == Some(1.0) {
        let allowed = "must be above 1 with adapt = true: a known level needs no adaptation";
        section
            .diagnostics()
            .report(section.span(), section.key("level-factor"), "is 1", allowed);
    }
    Level { adapt, factor }
}

/// Reads the standard deviation of one sample: `std`, or the spectral intensity `S₀` of a white
/// process with `σ² = 2π S₀ / Δt`.
fn read_std(section: &mut Section<'_>, rate_hz: Option<f64>) -> Option<f64> {
    let std = section.number("std", Allowed::DEVIATION);
    let intensity = section.number("spectral-intensity", Allowed::DEVIATION);
    if section.contains("std") == section.contains("spectral-intensity") {
        let found = if section.contains("std") {
            "is given together with spectral-intensity"
        } else {
            "is missing"
        };
        let allowed = "must give either std (of one sample, m/s2 or N) or spectral-intensity (its \
                       square times s per rad)";
        section
            .diagnostics()
            .report(section.span(), section.key("std"), found, allowed);
        return None;
    }
    let of_intensity = |intensity: Spanned<f64>| {
        Some((2.0 * std::f64::consts::PI * intensity.into_inner() * rate_hz?).sqrt())
    };
    std.map(Spanned::into_inner)
        .or_else(|| intensity.and_then(of_intensity))
}

/// Reads the effect of a ground motion: its direction in a model with geometry, or an influence
/// vector.
fn read_ground(section: &mut Section<'_>, system: Option<&LinearSystem>) -> Option<Action> {
    let Some(direction) = section.text("direction") else {
        let geometry = system.is_some_and(|system| !system.ground_directions.is_empty());
        if geometry && !section.contains("influence") {
            let allowed = "must specify the direction of the ground motion (or give influence)";
            section.require("direction", allowed, None::<()>);
        }
        return read_influence(section, system);
    };
    if section.contains("influence") {
        let allowed = "must not be given together with direction, which specifies the same";
        section.diagnostics().report(
            section.span(),
            section.key("influence"),
            "is given",
            allowed,
        );
    }
    section.leave_unread(&["influence"]);
    let known = &system?.ground_directions;
    let found = known.iter().find(|known| known.name == direction.get_ref());
    if found.is_none() {
        let allowed = match known[..] {
            [] => "must not be given for a model without directions, see influence".to_owned(),
            _ => one_of(direction.get_ref(), known.iter().map(|known| known.name)),
        };
        let (key, found) = (
            section.key("direction"),
            format!("is \"{}\"", direction.get_ref()),
        );
        section
            .diagnostics()
            .report(direction.span(), key, found, allowed);
    }
    Some(Action::Ground {
        influence: found?.influence.clone(),
    })
}

/// Reads the influence vector `ι` of a ground motion: a list, a file, or all ones by default.
fn read_influence(section: &mut Section<'_>, system: Option<&LinearSystem>) -> Option<Action> {
    let key = "influence";
    let (span, influence) = if section.is_text(key) {
        let file = section.text(key)?;
        match matrix_file::read(&beside(section, file.get_ref())) {
            Ok(matrix) if matrix.ncols() == 1 => (
                file.span(),
                crate::linear_system::dense(&matrix).as_slice().to_vec(),
            ),
            Ok(matrix) => {
                let found = format!("is {} × {}", matrix.nrows(), matrix.ncols());
                section.diagnostics().report(
                    file.span(),
                    section.key(key),
                    found,
                    "must have one column",
                );
                return None;
            }
            Err(Unusable { found, allowed }) => {
                section
                    .diagnostics()
                    .report(file.span(), section.key(key), found, allowed);
                return None;
            }
        }
    } else {
        let Some(numbers) = section.numbers(key, Allowed::ANY) else {
            return Some(Action::Ground {
                influence: vec![1.0; system?.len()],
            });
        };
        (numbers.span(), numbers.into_inner())
    };
    let len = system?.len();
    if influence.len() != len || influence.iter().all(|entry| *entry == 0.0) {
        let found = format!("has {}", counted(influence.len(), "entry", "entries"));
        let allowed = format!("must have {len}, one per degree of freedom, not all zero");
        section
            .diagnostics()
            .report(span, section.key(key), found, allowed);
        return None;
    }
    Some(Action::Ground { influence })
}

fn read_measured(
    section: &Section<'_>,
    kind: Option<Kind>,
    channel: &Spanned<String>,
    channels: &[ChannelRead],
) -> Option<Measured> {
    let expected = match kind? {
        Kind::Ground => Quantity::GroundAcceleration,
        Kind::Force | Kind::ForceField => Quantity::Force,
    };
    let named = channels
        .iter()
        .position(|read| read.channel.name == *channel.get_ref());
    let measuring = named.map(|index| &channels[index].channel);
    match (named, measuring) {
        (Some(index), Some(measuring)) if measuring.quantity == expected => Some(Measured {
            channel: index,
            noise_std: measuring.noise_std,
        }),
        _ => {
            let of = measuring.map_or_else(String::new, |other| {
                format!(", a channel of {}", other.quantity)
            });
            let right = channels
                .iter()
                .filter(|read| read.channel.quantity == expected);
            let allowed = match &right
                .map(|read| read.channel.name.as_str())
                .collect::<Vec<_>>()[..]
            {
                [] => format!("must be a channel of {expected}, but none is declared"),
                right => format!("must be a channel of {expected}: {}", right.join(", ")),
            };
            let found = format!("is \"{}\"{of}", channel.get_ref());
            section.diagnostics().report(
                channel.span(),
                section.key("measured-on"),
                found,
                allowed,
            );
            None
        }
    }
}

/// Checks that each channel that measures an excitation belongs to exactly one excitation.
fn check_each_channel_is_used_once(
    file: &Section<'_>,
    channels: &[ChannelRead],
    read: &[ExcitationRead],
) {
    for (index, channel) in channels
        .iter()
        .enumerate()
        .filter(|(_, read)| read.channel.quantity.is_excitation())
    {
        let uses: Vec<_> = read
            .iter()
            .filter(|read| read.excitation.channel() == Some(index))
            .collect();
        match uses[..] {
            [_] => {}
            [] => file.diagnostics().report(
                channel.name.span(),
                "node.channel.name",
                format!(
                    "is \"{}\", which measures {} for no excitation",
                    channel.channel.name, channel.channel.quantity
                ),
                "must be named by measured-on of an [[excitation]]",
            ),
            [first, second, ..] => file.diagnostics().report(
                second.name.span(),
                "excitation.measured-on",
                format!(
                    "is \"{}\", which already measures {}",
                    channel.channel.name, first.excitation.name
                ),
                "must be a separate channel",
            ),
        }
    }
}
