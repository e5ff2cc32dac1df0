//! Reads `[modal]`.

use super::node::NodesRead;
use super::parameter::ParameterRead;
use super::{check_unique, find_name};
use crate::diagnostics::counted;
use crate::modal_plan::{DeclaredMode, ModalPlan, UpdatePlan};
use crate::node::Channel;
use crate::section::{Allowed, Section};
use spandrel_modal::{ModalError, ModalSettings, UpdateSettings};
use std::collections::BTreeSet;
use toml::Spanned;

/// Range of `modal.epoch-s` (s). The shortest epoch also depends on channels, band and rate.
const EPOCH_RANGE_S: (usize, usize) = (10, 86_400);
/// Range of `modal.highest-order`.
const ORDER_RANGE: (usize, usize) = (2, 200);
/// Range of `modal.commissioning-epochs`. The epochs are kept until the commissioning ends.
const COMMISSIONING_RANGE: (usize, usize) = (1, 2000);
/// Smallest number of channels from which shapes can be identified.
const LEAST_CHANNELS: usize = 2;

/// What natural frequencies could update.
pub(super) struct Updatable<'f> {
    /// Parameters in state order; `None` if some could not be read.
    pub(super) parameters: Option<&'f [ParameterRead]>,
    /// Whether there is a model of linear springs.
    pub(super) is_linear: bool,
    /// Whether the nodes have their own filters.
    pub(super) is_distributed: bool,
}

/// Reads `[modal]`; without the table no natural frequencies are followed.
pub(super) fn read_modal(
    section: Option<Section<'_>>,
    rate_hz: Option<f64>,
    nodes: &NodesRead,
    updatable: &Updatable<'_>,
) -> Option<ModalPlan> {
    let mut section = section?;
    let (shortest, longest) = EPOCH_RANGE_S;
    let epoch_s = section
        .whole("epoch-s", shortest, longest)
        .map_or(ModalSettings::EPOCH_S, |seconds| {
            seconds.into_inner() as f64
        });
    let overlap = section.number_or("overlap", Allowed::SHARE, 0.0);
    let (least, most) = ORDER_RANGE;
    let highest_order = section
        .whole("highest-order", least, most)
        .map_or(ModalSettings::HIGHEST_ORDER, Spanned::into_inner);
    let band_hz = read_band(&mut section);
    let update = read_update(&mut section, updatable);
    let without = section.names("without");
    let references = section.names("references");
    let tables = section.tables("mode");
    if tables.len() > ModalPlan::MOST_MODES {
        section.diagnostics().report(
            section.span_of("mode"),
            section.key("mode"),
            format!("has {} tables", tables.len()),
            format!("must have at most {}", ModalPlan::MOST_MODES),
        );
    }
    let modes: Vec<_> = tables.into_iter().map(read_mode).collect();
    let names: Vec<Spanned<String>> = modes.iter().flatten().map(|mode| mode.0.clone()).collect();
    check_unique(&section, "modal.mode.name", &names);
    let (rate_hz, false) = (rate_hz?, nodes.incomplete) else {
        section.finish();
        return None;
    };
    let chosen = choose(&section, nodes, rate_hz, without.as_ref())?;
    let mut settings = ModalSettings {
        epoch_s,
        overlap,
        highest_order,
        ..ModalSettings::new(chosen.len(), rate_hz)
    };
    if let Some(band_hz) = &band_hz {
        (settings.lowest_hz, settings.highest_hz) = *band_hz.get_ref();
    }
    if let Some(references) = &references {
        let known = || chosen.iter().map(|(_, channel)| channel.name());
        let positions = references.get_ref().iter();
        settings.references = positions
            .map(|name| find_name(&section, "references", name, known()))
            .collect::<Option<_>>()?;
    }
    let checked = settings
        .validate()
        .map_err(|error| report(&section, &error));
    for (_, frequency_hz, _) in modes.iter().flatten() {
        check_in_band(&section, &settings, frequency_hz);
    }
    section.finish();
    checked.ok()?;
    let modes = modes.into_iter().map(|mode| {
        let (name, frequency_hz, within) = mode?;
        Some(DeclaredMode {
            name: name.into_inner(),
            frequency_hz: frequency_hz.into_inner(),
            within,
        })
    });
    Some(ModalPlan {
        settings,
        has_band: band_hz.is_some(),
        channels: chosen.iter().map(|(position, _)| *position).collect(),
        names: chosen
            .iter()
            .map(|(_, channel)| channel.name().to_owned())
            .collect(),
        modes: modes.collect::<Option<_>>()?,
        update,
    })
}

/// Reports the frequency of a mode outside the band.
fn check_in_band(section: &Section<'_>, settings: &ModalSettings, frequency_hz: &Spanned<f64>) {
    let (low, high) = (settings.lowest_hz, settings.highest_hz);
    if !(low..high).contains(frequency_hz.get_ref()) {
        section.diagnostics().report(
            frequency_hz.span(),
            "modal.mode.frequency-hz",
            format!("is {}", frequency_hz.get_ref()),
            format!("must be within the band, {low} to {high} Hz"),
        );
    }
}

/// Reads `updates` and `commissioning-epochs`.
fn read_update(section: &mut Section<'_>, updatable: &Updatable<'_>) -> Option<UpdatePlan> {
    let span = section.span_of("updates");
    let updates = section.choice("updates", &[("none", false), ("stiffness", true)]);
    let (least, most) = COMMISSIONING_RANGE;
    let commissioning_epochs = section
        .whole("commissioning-epochs", least, most)
        .map_or(ModalPlan::COMMISSIONING_EPOCHS, Spanned::into_inner);
    if !updates?.into_inner() {
        return None;
    }
    let stiffnesses = updatable.parameters?.iter();
    let stiffnesses: Vec<_> = stiffnesses
        .map(|read| &read.parameter)
        .filter(|parameter| parameter.is_stiffness())
        .collect();
    let allowed = if updatable.is_distributed {
        "must be \"none\" with identification = \"distributed\""
    } else if !updatable.is_linear {
        "must be \"none\" without a model of linear springs"
    } else if stiffnesses.is_empty() {
        "must be \"none\" without a [[parameter]] that scales a stiffness"
    } else if !section.contains("mode") {
        "must be \"none\" without a [[modal.mode]]"
    } else {
        let relative = stiffnesses
            .iter()
            .map(|parameter| parameter.std() / parameter.mean());
        return Some(UpdatePlan {
            settings: UpdateSettings {
                commissioning_epochs,
                prior_std: relative.collect(),
            },
            parts: stiffnesses
                .iter()
                .map(|one| one.name().to_owned())
                .collect(),
            means: stiffnesses.iter().map(|one| one.mean()).collect(),
        });
    };
    let key = section.key("updates");
    section
        .diagnostics()
        .report(span, key, "is \"stiffness\"", allowed);
    None
}

fn read_band(section: &mut Section<'_>) -> Option<Spanned<(f64, f64)>> {
    let numbers = section.numbers("band-hz", Allowed::NOT_NEGATIVE)?;
    match numbers.get_ref()[..] {
        [low, high] if low < high => Some(Spanned::new(numbers.span(), (low, high))),
        _ => {
            section.diagnostics().report(
                numbers.span(),
                section.key("band-hz"),
                format!("is {:?}", numbers.get_ref()),
                "must be two increasing frequencies, such as [0.5, 12]",
            );
            None
        }
    }
}

fn read_mode(mut table: Section<'_>) -> Option<(Spanned<String>, Spanned<f64>, f64)> {
    let name = table.required_name("name");
    let frequency_hz = table.required_number("frequency-hz", Allowed::POSITIVE);
    let within = table.number_or("within", Allowed::INSIDE_UNIT, ModalPlan::WITHIN);
    table.finish();
    Some((name?, frequency_hz?, within))
}

/// Returns the channels that measure responses at the sampling rate of the structure, with their
/// positions in a frame.
fn choose<'n>(
    section: &Section<'_>,
    nodes: &'n NodesRead,
    rate_hz: f64,
    without: Option<&Spanned<Vec<Spanned<String>>>>,
) -> Option<Vec<(usize, &'n Channel)>> {
    let all = || nodes.channels.iter().map(|read| &read.channel);
    let left_out: BTreeSet<&str> = match without {
        Some(names) => names
            .get_ref()
            .iter()
            .map(|name| {
                find_name(section, "without", name, all().map(Channel::name))?;
                Some(name.get_ref().as_str())
            })
            .collect::<Option<_>>()?,
        None => BTreeSet::new(),
    };
    let is_slow = nodes.nodes.iter().flat_map(|node| {
        let is_slow = node
            .sampling_rate_hz()
            .is_some_and(|own_hz| own_hz < rate_hz);
        node.channels().iter().map(move |_| is_slow)
    });
    let chosen: Vec<(usize, &Channel)> = all()
        .zip(is_slow)
        .enumerate()
        .filter(|(_, (channel, is_slow))| {
            !is_slow && !channel.quantity().is_excitation() && !left_out.contains(channel.name())
        })
        .map(|(position, (channel, _))| (position, channel))
        .collect();
    let allowed = LEAST_CHANNELS..=ModalPlan::MOST_CHANNELS;
    if allowed.contains(&chosen.len()) {
        return Some(chosen);
    }
    section.diagnostics().report(
        without.map_or_else(|| section.span(), Spanned::span),
        section.key("without"),
        format!(
            "leaves {} that measure responses at the sampling rate of the structure",
            counted(chosen.len(), "channel", "channels")
        ),
        format!(
            "must leave {LEAST_CHANNELS} to {}",
            ModalPlan::MOST_CHANNELS
        ),
    );
    None
}

/// Reports settings that do not fit each other at the key that is most probably wrong.
fn report(section: &Section<'_>, error: &ModalError) {
    let key = match error {
        ModalError::Band { .. } => "band-hz",
        ModalError::Reference { .. } => "references",
        ModalError::Count { .. } => "highest-order",
        ModalError::Overlap { .. } => "overlap",
        ModalError::Epoch { .. }
        | ModalError::Channels { .. }
        | ModalError::Rate { .. }
        | ModalError::Frame { .. }
        | ModalError::Model
        | ModalError::NoModelMode
        | ModalError::NotConverged { .. } => "epoch-s",
    };
    let (found, allowed) = match error {
        ModalError::Epoch {
            found_s,
            at_least_s,
        } => (
            format!("is {found_s}"),
            format!(
                "must be at least {} with these channels, band and sampling rate",
                at_least_s.ceil()
            ),
        ),
        ModalError::Band { limit_hz, .. } => (
            "is too wide".to_owned(),
            format!("must end at most at {limit_hz} Hz, 0.4 of the sampling rate"),
        ),
        other => ("is wrong".to_owned(), other.to_string()),
    };
    section
        .diagnostics()
        .report(section.span_of(key), section.key(key), found, allowed);
}

#[cfg(test)]
mod tests;
