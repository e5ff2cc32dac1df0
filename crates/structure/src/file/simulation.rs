//! Reads `[simulation]`.

use super::find_name;
use super::parameter::ParameterRead;
use crate::node::Node;
use crate::noise_level::NoiseLevel;
use crate::section::{Allowed, Section};
use crate::simulation_plan::{Damage, Fault, FaultKind, Modulation, SimulationPlan, SpikeKind};
use toml::Spanned;

/// Largest seed that fits into a TOML integer.
const LARGEST_SEED: usize = i64::MAX as usize;

const SPIKE_KINDS: [(&str, SpikeKind); 2] = [
    ("added", SpikeKind::Added),
    ("replaced", SpikeKind::Replaced),
];

const FAULT_KINDS: [(&str, FaultKind); 2] =
    [("bias", FaultKind::Bias), ("silence", FaultKind::Silence)];

/// Objects to which a simulation refers; `None` if some could not be read.
pub(super) struct Context<'c> {
    pub(super) parameters: Option<&'c [ParameterRead]>,
    pub(super) nodes: Option<&'c [Node]>,
    pub(super) levels: Option<&'c [NoiseLevel]>,
}

/// Reads `[simulation]`; without the table the simulation has no events.
pub(super) fn read_simulation(
    section: Option<Section<'_>>,
    context: &Context<'_>,
) -> SimulationPlan {
    let node_count = context.nodes.map_or(0, <[_]>::len);
    let mut plan = SimulationPlan::uneventful(node_count);
    let Some(mut section) = section else {
        return plan;
    };
    plan.seed = section
        .whole("seed", 0, LARGEST_SEED)
        .map_or(0, |seed| seed.into_inner() as u64);
    plan.modulation = section.table("modulation").and_then(read_modulation);
    for damage in section.tables("damage") {
        let span = damage.span();
        if let Some(damage) = read_damage(damage, context) {
            plan.damage.push(damage);
            let same = plan
                .damage
                .iter()
                .filter(|other| other.parameter == damage.parameter);
            let lost: f64 = same.map(|other| other.loss).sum();
            if lost >= 1.0 {
                let found = format!("adds up to {lost} for this parameter");
                section.diagnostics().report(
                    span,
                    section.key("damage.loss"),
                    found,
                    "must stay below 1 in all",
                );
            }
        }
    }
    plan.dropped_share = section.number_or("dropped-share", Allowed::SHARE, 0.0);
    plan.spikes.share = section.number_or("spike-share", Allowed::SHARE, 0.0);
    plan.spikes.height = section.number_or(
        "spike-height",
        Allowed::POSITIVE,
        SimulationPlan::SPIKE_HEIGHT,
    );
    if let Some(kind) = section.choice("spike-kind", &SPIKE_KINDS) {
        plan.spikes.kind = kind.into_inner();
    }
    for (name, value) in section.entries("levels") {
        let std = section.entry_number("levels", &name, value, Allowed::DEVIATION);
        let index = context.levels.and_then(|levels| {
            find_name(
                &section,
                "levels",
                &name,
                levels.iter().map(|level| level.name.as_str()),
            )
        });
        plan.levels.extend(index.zip(std));
    }
    read_by_node(
        &mut section,
        "clock-offsets-s",
        Allowed::ANY,
        context,
        &mut plan.clock_offsets_s,
    );
    read_by_node(
        &mut section,
        "clock-drifts-ppm",
        Allowed::DRIFT,
        context,
        &mut plan.clock_drifts_ppm,
    );
    for fault in section.tables("fault") {
        plan.faults.extend(read_fault(fault, context));
    }
    section.finish();
    plan
}

/// Reads a table of numbers by node into `numbers`, which has one entry per node of the file.
fn read_by_node(
    section: &mut Section<'_>,
    key: &'static str,
    allowed: Allowed,
    context: &Context<'_>,
    numbers: &mut [f64],
) {
    for (node, value) in section.entries(key) {
        let number = section.entry_number(key, &node, value, allowed);
        let index = context
            .nodes
            .and_then(|nodes| find_name(section, key, &node, nodes.iter().map(Node::name)));
        if let (Some(index), Some(number)) = (index, number) {
            numbers[index] = number;
        }
    }
}

fn read_fault(mut section: Section<'_>, context: &Context<'_>) -> Option<Fault> {
    let node = section.required_name("node");
    let kind = section.required_choice("kind", &FAULT_KINDS);
    let from_s = section.number_or("from-s", Allowed::NOT_NEGATIVE, 0.0);
    let until = section.number("until-s", Allowed::POSITIVE);
    if let Some(until) = until.as_ref().filter(|until| *until.get_ref() <= from_s) {
        let (found, allowed) = (
            format!("is {}", until.get_ref()),
            format!("must be after from-s, {from_s}"),
        );
        section
            .diagnostics()
            .report(until.span(), section.key("until-s"), found, allowed);
    }
    let until_s = until.map_or(f64::INFINITY, Spanned::into_inner);
    let height = section.number("height", Allowed::ANY);
    let kind = kind.map(Spanned::into_inner);
    if let (Some(height), Some(FaultKind::Silence)) = (&height, kind) {
        section.diagnostics().report(
            height.span(),
            section.key("height"),
            "is given",
            "must be given together with kind = \"bias\"",
        );
    }
    let node = node.and_then(|name| {
        find_name(
            &section,
            "node",
            &name,
            context.nodes?.iter().map(Node::name),
        )
    });
    section.finish();
    let height = height.map_or(SimulationPlan::BIAS_HEIGHT, Spanned::into_inner);
    Some(Fault {
        node: node?,
        kind: kind?,
        from_s,
        until_s,
        height,
    })
}

fn read_modulation(mut section: Section<'_>) -> Option<Modulation> {
    let start_s = section.required_number("start-s", Allowed::NOT_NEGATIVE);
    let rise_s = section.required_number("rise-s", Allowed::POSITIVE);
    section.finish();
    Some(Modulation {
        start_s: start_s?.into_inner(),
        rise_s: rise_s?.into_inner(),
    })
}

fn read_damage(mut section: Section<'_>, context: &Context<'_>) -> Option<Damage> {
    let parameter = section.required_name("parameter");
    let at_s = section.required_number("at-s", Allowed::NOT_NEGATIVE);
    let loss = section.required_number("loss", Allowed::INSIDE_UNIT);
    let over_s = section
        .number("over-s", Allowed::NOT_NEGATIVE)
        .map_or(0.0, Spanned::into_inner);
    let parameter = parameter.and_then(|name| {
        find_name(
            &section,
            "parameter",
            &name,
            context.parameters?.iter().map(|read| read.parameter.name()),
        )
    });
    section.finish();
    Some(Damage {
        parameter: parameter?,
        at_s: at_s?.into_inner(),
        over_s,
        loss: loss?.into_inner(),
    })
}
