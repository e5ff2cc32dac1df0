//! Reads `[record]`.

use super::find_name;
use crate::node::Channel;
use crate::record_map::{ColumnMap, RecordMap};
use crate::section::{Allowed, Section};
use toml::Spanned;

const DEFAULT_TIME_UNIT: &str = RecordMap::TIME_UNITS[0].1;

/// Reads `[record]`; `channels` are in frame order.
///
/// Without the table, a record has SI columns with the names of the channels.
pub(super) fn read_record(
    section: Option<Section<'_>>,
    channels: Option<&[&Channel]>,
) -> Option<RecordMap> {
    let Some(mut section) = section else {
        return channels.map(|channels| RecordMap {
            time_column: RecordMap::TIME_COLUMN.to_owned(),
            time_unit: DEFAULT_TIME_UNIT,
            resamples: false,
            remove_offset_s: 0.0,
            columns: channels.iter().map(|channel| own_column(channel)).collect(),
        });
    };
    let time_column = section.text("time-column");
    let time_unit = section
        .choice("time-unit", &RecordMap::TIME_UNITS)
        .map_or(DEFAULT_TIME_UNIT, Spanned::into_inner);
    let resamples = section.flag_or("resample", false);
    let remove_offset_s = section.number_or("remove-offset-s", Allowed::NOT_NEGATIVE, 0.0);
    let entries = section.entries("columns");
    let mut columns: Option<Vec<_>> =
        channels.map(|channels| channels.iter().map(|channel| own_column(channel)).collect());
    for (name, value) in entries {
        let Some(table) = section.open(&format!("columns.{}", name.get_ref()), value) else {
            continue;
        };
        let index = channels.and_then(|channels| {
            find_name(
                &section,
                "columns",
                &name,
                channels.iter().map(|channel| channel.name.as_str()),
            )
        });
        let channel = index.and_then(|index| channels?.get(index).copied());
        let column = read_column(table, &name, channel);
        if let (Some(index), Some(columns)) = (index, &mut columns) {
            columns[index] = column;
        }
    }
    section.finish();
    let time_column =
        time_column.map_or_else(|| RecordMap::TIME_COLUMN.to_owned(), Spanned::into_inner);
    Some(RecordMap {
        time_column,
        time_unit,
        resamples,
        remove_offset_s,
        columns: columns?,
    })
}

fn own_column(channel: &Channel) -> ColumnMap {
    ColumnMap {
        column: channel.name.clone(),
        factor: 1.0,
        offset: 0.0,
        states_unit: false,
    }
}

fn read_column(
    mut table: Section<'_>,
    name: &Spanned<String>,
    channel: Option<&Channel>,
) -> ColumnMap {
    let column = table.text("column");
    let unit = table.text("unit");
    let scale = table.number_or("scale", Allowed::ANY, 1.0);
    let offset = table.number_or("offset", Allowed::ANY, 0.0);
    let states_unit = unit.is_some();
    let size = match (unit, channel) {
        (Some(unit), Some(channel)) => {
            let units = channel.quantity.record_units();
            let known = units.iter().find(|(known, _)| known == unit.get_ref());
            if known.is_none() {
                let words: Vec<String> = units
                    .iter()
                    .map(|(unit, _)| format!("\"{unit}\""))
                    .collect();
                let allowed = format!(
                    "must be one of {} for {}",
                    words.join(", "),
                    channel.quantity
                );
                let found = format!("is \"{}\"", unit.get_ref());
                table
                    .diagnostics()
                    .report(unit.span(), table.key("unit"), found, allowed);
            }
            known.map_or(1.0, |(_, size)| *size)
        }
        _ => 1.0,
    };
    table.finish();
    let column = column.map_or_else(|| name.get_ref().clone(), Spanned::into_inner);
    ColumnMap {
        column,
        factor: size * scale,
        offset,
        states_unit,
    }
}
