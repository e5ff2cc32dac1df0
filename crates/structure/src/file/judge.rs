//! Reads `[judge]`.

use super::check_unique;
use crate::judge_plan::JudgePlan;
use crate::section::{Allowed, Section};
use spandrel_judge::{
    Condition, ConditionKind, Quantity, QuantityKind, Season, Settings, ThermometerMistake,
};
use std::ops::Range;
use toml::Spanned;

/// Values of `judge.quantity.is`.
const QUANTITIES: [(&str, QuantityKind); 2] = [
    ("frequency", QuantityKind::Frequency),
    ("stiffness", QuantityKind::Stiffness),
];

/// Values of `judge.condition.unit`.
const UNITS: [(&str, Unit); 5] = [
    ("degC", Unit::Celsius),
    ("K", Unit::Kelvin),
    ("degF", Unit::Fahrenheit),
    ("amplitude", Unit::Amplitude),
    ("other", Unit::Other),
];

/// Default of `judge.epoch-s`, and its range (s).
const EPOCH_S: u32 = 900;
const EPOCH_RANGE_S: (u32, u32) = (2, 86_400);

/// Default of `judge.time-column`.
const TIME_COLUMN: &str = "time";

#[derive(Debug, Clone, Copy)]
enum Unit {
    Celsius,
    Kelvin,
    Fahrenheit,
    Amplitude,
    Other,
}

/// A quantity or condition with its column.
struct Entry<T> {
    item: T,
    name: Spanned<String>,
    column: String,
}

/// Reads `[judge]`; without the table nothing is judged.
pub(super) fn read_judge(section: Option<Section<'_>>) -> Option<JudgePlan> {
    let mut section = section?;
    let false_alarms_per_year = section.number_or(
        "false-alarms-per-year",
        Allowed::POSITIVE,
        Settings::FALSE_ALARMS_PER_YEAR,
    );
    let loss = section.number_or("loss", Allowed::INSIDE_UNIT, Settings::LOSS);
    let (least, most) = Settings::COMMISSIONING_RANGE;
    let commissioning_days = section
        .whole("commissioning-days", least as usize, most as usize)
        .map_or(Settings::COMMISSIONING_DAYS, |days| {
            days.into_inner() as u32
        });
    let season = match section.flag_or("accept-short-commissioning", false) {
        true => Season::Waived,
        false => Season::Required,
    };
    let (shortest, longest) = EPOCH_RANGE_S;
    let epoch_s = section
        .whole("epoch-s", shortest as usize, longest as usize)
        .map_or(EPOCH_S, |seconds| seconds.into_inner() as u32);
    let time_column = section
        .text("time-column")
        .map_or_else(|| TIME_COLUMN.to_owned(), Spanned::into_inner);
    let tables = section.tables("quantity");
    if tables.is_empty() && (!section.contains("quantity") || section.is_list("quantity")) {
        section.diagnostics().report(
            section.span(),
            section.key("quantity"),
            "is missing",
            "must be given: [[judge.quantity]] names what is judged",
        );
    }
    let lists: Vec<Range<usize>> = tables
        .iter()
        .map(|table| table.span_of("thermometers"))
        .collect();
    let quantities: Vec<_> = tables.into_iter().map(read_quantity).collect();
    let tables = section.tables("condition");
    if tables.len() > Settings::MOST_CONDITIONS {
        section.diagnostics().report(
            section.span_of("condition"),
            section.key("condition"),
            format!("has {} tables", tables.len()),
            format!("must have at most {}", Settings::MOST_CONDITIONS),
        );
    }
    let conditions: Vec<_> = tables.into_iter().map(read_condition).collect();
    let of_quantities = quantities.iter().flatten().map(|entry| entry.name.clone());
    let of_conditions = conditions.iter().flatten().map(|entry| entry.name.clone());
    let names: Vec<Spanned<String>> = of_quantities.chain(of_conditions).collect();
    check_unique(&section, "judge", &names);
    let diagnostics = section.diagnostics();
    section.finish();
    let quantities: Vec<Entry<Quantity>> = quantities.into_iter().collect::<Option<_>>()?;
    let conditions: Vec<Entry<Condition>> = conditions.into_iter().collect::<Option<_>>()?;
    let plan = JudgePlan {
        quantity_columns: quantities
            .iter()
            .map(|entry| entry.column.clone())
            .collect(),
        condition_columns: conditions
            .iter()
            .map(|entry| entry.column.clone())
            .collect(),
        settings: Settings {
            false_alarms_per_year,
            loss,
            commissioning_days,
            season,
            quantities: quantities.into_iter().map(|entry| entry.item).collect(),
            conditions: conditions.into_iter().map(|entry| entry.item).collect(),
        },
        epoch_s,
        time_column,
    };
    for (quantity, list) in plan.settings.quantities.iter().zip(lists) {
        if let Some(mistake) = plan.settings.thermometer_mistake(quantity) {
            let ThermometerMistake { found, allowed } = mistake;
            diagnostics.report(list, "judge.quantity.thermometers", found, allowed);
        }
    }
    Some(plan)
}

fn read_quantity(mut table: Section<'_>) -> Option<Entry<Quantity>> {
    let name = table.required_name("name");
    let kind = table.required_choice("is", &QUANTITIES);
    let column = table.text("column");
    let thermometers = table.names("thermometers").map(Spanned::into_inner);
    let thermometers = thermometers.into_iter().flatten();
    table.finish();
    let (name, kind) = (name?, kind?.into_inner());
    Some(Entry {
        column: column.map_or_else(|| name.get_ref().clone(), Spanned::into_inner),
        item: Quantity {
            name: name.get_ref().clone(),
            kind,
            thermometers: thermometers.map(Spanned::into_inner).collect(),
        },
        name,
    })
}

fn read_condition(mut table: Section<'_>) -> Option<Entry<Condition>> {
    let name = table.required_name("name");
    let unit = table.required_choice("unit", &UNITS);
    let column = table.text("column");
    let slope_std = table.number("slope-std", Allowed::DEVIATION);
    let kind = unit.and_then(|unit| match (unit.get_ref(), slope_std) {
        (Unit::Other, Some(slope_std)) => Some(ConditionKind::Other {
            slope_std: slope_std.into_inner(),
        }),
        (Unit::Other, None) => {
            let allowed = "must be given: the standard deviation of the relative change of \
                stiffness per unit of the condition";
            table.require::<()>("slope-std", allowed, None);
            None
        }
        (_, Some(slope_std)) => {
            table.diagnostics().report(
                slope_std.span(),
                table.key("slope-std"),
                "is given",
                "must not be given, except with unit = \"other\"",
            );
            None
        }
        (Unit::Celsius, None) => Some(ConditionKind::Celsius),
        (Unit::Kelvin, None) => Some(ConditionKind::Kelvin),
        (Unit::Fahrenheit, None) => Some(ConditionKind::Fahrenheit),
        (Unit::Amplitude, None) => Some(ConditionKind::Amplitude),
    });
    table.finish();
    let (name, kind) = (name?, kind?);
    Some(Entry {
        column: column.map_or_else(|| name.get_ref().clone(), Spanned::into_inner),
        item: Condition {
            name: name.get_ref().clone(),
            kind,
        },
        name,
    })
}

#[cfg(test)]
mod tests;
