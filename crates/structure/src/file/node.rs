//! Reads `[[node]]` with its channels.

use super::model::WITHOUT_A_MODEL;
use super::{check_unique, find_name};
use crate::diagnostics::{counted, one_of};
use crate::linear_system::LinearSystem;
use crate::node::{Channel, Direction, Node, Quantity};
use crate::section::{Allowed, NumberOrName, Section};
use toml::Spanned;

const DIRECTIONS: [(&str, Direction); 3] = [
    ("x", Direction::X),
    ("y", Direction::Y),
    ("z", Direction::Z),
];

/// Keys of a channel that only a model gives a meaning.
const OF_MODELS: [&str; 6] = [
    "dof",
    "dofs",
    "coefficients",
    "noise-std",
    "noise-group",
    "adapt-noise",
];

/// A channel, with the properties that noise levels need.
pub(super) struct ChannelRead {
    pub(super) channel: Channel,
    pub(super) name: Spanned<String>,
    pub(super) noise_group: Option<Spanned<String>>,
    pub(super) adapts_noise: bool,
}

/// All nodes, and all their channels in frame order.
pub(super) struct NodesRead {
    pub(super) nodes: Vec<Node>,
    pub(super) names: Vec<Spanned<String>>,
    pub(super) channels: Vec<ChannelRead>,
    /// `true` if some node or channel could not be read; positions in a frame are then unreliable.
    pub(super) incomplete: bool,
}

/// Reads every `[[node]]`; `rate_hz` is the sampling rate of the structure.
pub(super) fn read_nodes(
    file: &mut Section<'_>,
    rate_hz: Option<f64>,
    system: Option<&LinearSystem>,
) -> NodesRead {
    let sections = file.tables("node");
    if sections.is_empty() {
        file.require(
            "node",
            "must declare a sensor node: [[node]] with [[node.channel]]",
            None::<()>,
        );
    }
    let mut read = NodesRead {
        nodes: Vec::new(),
        names: Vec::new(),
        channels: Vec::new(),
        incomplete: false,
    };
    for mut section in sections {
        let name = section.required_name("name");
        let node_rate_hz = section.number("sampling-rate-hz", Allowed::POSITIVE);
        check_rate(&section, rate_hz, node_rate_hz.as_ref());
        let channel_sections = section.tables("channel");
        if channel_sections.is_empty() {
            section.require(
                "channel",
                "must declare a channel: [[node.channel]]",
                None::<()>,
            );
        }
        let declared = channel_sections.len();
        let channels: Vec<_> = channel_sections
            .into_iter()
            .filter_map(|channel| read_channel(channel, system))
            .collect();
        section.finish();
        let own = channels.iter().map(|read| read.channel.clone()).collect();
        read.incomplete |= channels.len() != declared || name.is_none();
        read.channels.extend(channels);
        if let Some(name) = name {
            let sampling_rate_hz = node_rate_hz.map(Spanned::into_inner);
            read.nodes.push(Node {
                name: name.get_ref().clone(),
                sampling_rate_hz,
                channels: own,
            });
            read.names.push(name);
        }
    }
    check_unique(file, "node.name", &read.names);
    let channel_names: Vec<_> = read.channels.iter().map(|read| read.name.clone()).collect();
    check_unique(file, "node.channel.name", &channel_names);
    read
}

/// Checks that a node delivers every first, second, third, ... frame, so that its samples coincide
/// with frames.
fn check_rate(section: &Section<'_>, rate_hz: Option<f64>, node_rate_hz: Option<&Spanned<f64>>) {
    let (Some(rate_hz), Some(node_rate_hz)) = (rate_hz, node_rate_hz) else {
        return;
    };
    let ratio = rate_hz / node_rate_hz.get_ref();
    if ratio.round() < 1.0 || (ratio - ratio.round()).abs() > 1e-9 * ratio {
        let found = format!("is {}", node_rate_hz.get_ref());
        let allowed =
            format!("must be {rate_hz} (the structure's) or that divided by a whole number");
        section.diagnostics().report(
            node_rate_hz.span(),
            section.key("sampling-rate-hz"),
            found,
            allowed,
        );
    }
}

fn read_channel(mut section: Section<'_>, system: Option<&LinearSystem>) -> Option<ChannelRead> {
    let name = section.required_name("name");
    let quantity = section.required_choice("quantity", &Quantity::WORDS);
    let unit = section.text("unit");
    let is_modal = system.is_some_and(LinearSystem::is_empty);
    let noise = match is_modal {
        true => {
            section.refuse_keys(&OF_MODELS, WITHOUT_A_MODEL);
            ChannelNoise::NOT_USED
        }
        false => read_noise(&mut section),
    };
    let range = section.number("range", Allowed::POSITIVE);
    let quantity = quantity.map(Spanned::into_inner);
    let unit_rule = quantity.map_or_else(
        || "must be the SI unit of the quantity".to_owned(),
        |quantity| format!("must be \"{}\", the SI unit of {quantity}", quantity.unit()),
    );
    let unit = section.require("unit", &unit_rule, unit);
    if let (Some(quantity), Some(unit)) = (quantity, unit)
        && unit.get_ref() != quantity.unit()
    {
        let found = format!("is \"{}\"", unit.get_ref());
        section
            .diagnostics()
            .report(unit.span(), section.key("unit"), found, unit_rule);
    }
    if let Some(quantity @ (Quantity::Displacement | Quantity::Strain)) = quantity
        && system.is_some_and(|system| system.hysteresis.is_some())
    {
        let allowed = "must be a velocity or an acceleration for the kind bouc-wen, which does \
                       not follow displacements";
        section.diagnostics().report(
            section.span(),
            section.key("quantity"),
            format!("is \"{quantity}\""),
            allowed,
        );
    }
    let place = match system.filter(|system| system.is_empty()) {
        Some(system) => read_place(&mut section, system),
        None => Some((None, None)),
    };
    let sensed = match is_modal {
        true => Some(Vec::new()),
        false => quantity.and_then(|quantity| read_sensed(&mut section, quantity, system)),
    };
    if quantity.is_none() {
        section.leave_unread(&["dof", "dofs", "coefficients"]);
    }
    if quantity.is_some_and(Quantity::is_excitation) {
        for key in ["noise-group", "adapt-noise"] {
            if section.contains(key) {
                let allowed =
                    "must be set with adapt in the [[excitation]] that this channel measures";
                section
                    .diagnostics()
                    .report(section.span(), section.key(key), "is given", allowed);
            }
        }
    }
    section.finish();
    let (name, quantity) = (name?, quantity?);
    let (point, direction) = place?;
    let channel = Channel {
        name: name.get_ref().clone(),
        quantity,
        sensed: sensed?,
        point,
        direction,
        noise_std: noise.std?,
        range: range.map_or_else(|| quantity.default_range(), Spanned::into_inner),
    };
    Some(ChannelRead {
        channel,
        name,
        noise_group: noise.group,
        adapts_noise: noise.adapts,
    })
}

/// What a filter must know of the noise of a channel.
struct ChannelNoise {
    /// `None` if it could not be read.
    std: Option<f64>,
    group: Option<Spanned<String>>,
    adapts: bool,
}

impl ChannelNoise {
    /// Without a filter, nothing needs to be known.
    const NOT_USED: Self = Self {
        std: Some(0.0),
        group: None,
        adapts: false,
    };
}

fn read_noise(section: &mut Section<'_>) -> ChannelNoise {
    let std = section.required_number("noise-std", Allowed::DEVIATION);
    ChannelNoise {
        std: std.map(Spanned::into_inner),
        group: section.name("noise-group"),
        adapts: section.flag_or("adapt-noise", false),
    }
}

/// Reads point and direction of a sensor of a structure without a model.
fn read_place(
    section: &mut Section<'_>,
    system: &LinearSystem,
) -> Option<(Option<usize>, Option<Direction>)> {
    let at = section.number_or_name("at");
    let direction = section.choice("direction", &DIRECTIONS);
    let Some(at) = at else {
        return (!section.contains("at")).then_some((None, direction.map(Spanned::into_inner)));
    };
    let name = match at.get_ref() {
        NumberOrName::Number(number) => number.to_string(),
        NumberOrName::Name(name) => name.clone(),
    };
    let points = system.skeleton.iter().flat_map(|skeleton| &skeleton.points);
    let names = points.map(|(name, _)| name.as_str());
    let point = find_name(section, "at", &Spanned::new(at.span(), name), names)?;
    Some((Some(point), direction.map(Spanned::into_inner)))
}

/// Reads the degrees of freedom that a channel senses; empty if it measures an excitation.
pub(super) fn read_sensed(
    section: &mut Section<'_>,
    quantity: Quantity,
    system: Option<&LinearSystem>,
) -> Option<Vec<(usize, f64)>> {
    match quantity {
        Quantity::GroundAcceleration | Quantity::Force => Some(Vec::new()),
        Quantity::Strain => {
            let dofs = section.numbers_or_names("dofs");
            let dofs = section.require("dofs", "must list the degrees of freedom of the sum", dofs);
            let coefficients = section.numbers("coefficients", Allowed::ANY);
            let allowed = "must list the factor (1/m) of each degree of freedom";
            let coefficients = section.require("coefficients", allowed, coefficients);
            let (dofs, coefficients) = (dofs?, coefficients?);
            let [terms, factors] = [dofs.get_ref().len(), coefficients.get_ref().len()];
            if terms != factors || terms == 0 {
                let terms = counted(terms, "degree of freedom", "degrees of freedom");
                let found = format!("has {} for {terms}", counted(factors, "entry", "entries"));
                let key = section.key("coefficients");
                section.diagnostics().report(
                    coefficients.span(),
                    key,
                    found,
                    "must have one per degree of freedom",
                );
                return None;
            }
            let dofs: Vec<_> = dofs
                .get_ref()
                .iter()
                .map(|dof| degree_of_freedom(section, "dofs", dof, system))
                .collect();
            let dofs: Option<Vec<usize>> = dofs.into_iter().collect();
            Some(dofs?.into_iter().zip(coefficients.into_inner()).collect())
        }
        _ => {
            let dof = section.number_or_name("dof");
            let dof = section.require(
                "dof",
                "must be the number or the name of a degree of freedom",
                dof,
            )?;
            Some(vec![(
                degree_of_freedom(section, "dof", &dof, system)?,
                1.0,
            )])
        }
    }
}

/// Returns the index of a degree of freedom (from 0), given by number (from 1) or name.
pub(super) fn degree_of_freedom(
    section: &Section<'_>,
    key: &str,
    dof: &Spanned<NumberOrName>,
    system: Option<&LinearSystem>,
) -> Option<usize> {
    let names = &system?.degrees_of_freedom;
    let (index, found) = match dof.get_ref() {
        NumberOrName::Number(number) => {
            let index = usize::try_from(*number)
                .ok()
                .and_then(|number| number.checked_sub(1));
            (
                index.filter(|index| *index < names.len()),
                format!("is {number}"),
            )
        }
        NumberOrName::Name(name) => (
            names.iter().position(|known| known == name),
            format!("is \"{name}\""),
        ),
    };
    if index.is_none() {
        let hint = match dof.get_ref() {
            NumberOrName::Number(_) => format!("must be from 1 to {}", names.len()),
            NumberOrName::Name(name) => one_of(name, names.iter().map(String::as_str)),
        };
        section
            .diagnostics()
            .report(dof.span(), section.key(key), found, hint);
    }
    index
}
