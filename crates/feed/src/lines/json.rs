//! JSON objects with declared fields.

use serde_json::Value;
use spandrel_record::record_time::parse_time_ns;

use super::{LineFault, TIME, TimeField};
use crate::packet::Packet;

/// Maximum number of samples of a channel in one object.
const MAX_SAMPLES: usize = 65_536;

pub(super) fn parse(
    line: &str,
    time: Option<&TimeField>,
    fields: &[String],
) -> Result<Vec<Packet>, LineFault> {
    let object: Value = serde_json::from_str(line)
        .map_err(|error| LineFault::new("line", line, format!("must be JSON ({error})")))?;
    if !object.is_object() {
        return Err(LineFault::new("line", line, "must be a JSON object"));
    }
    let start_ns = time.map(|time| time_ns(&object, time)).transpose()?;
    let mut packets = Vec::new();
    for field in fields {
        // Objects may contain only some of the channels.
        let Some(value) = field_of(&object, field) else {
            continue;
        };
        packets.push(Packet {
            label: field.clone(),
            start_ns,
            rate_hz: None,
            values: samples(field, value)?,
            clock_quality: None,
        });
    }
    match packets.is_empty() {
        true => Err(LineFault::new(
            "fields",
            line,
            format!("must contain one of {}", fields.join(", ")),
        )),
        false => Ok(packets),
    }
}

/// Returns the value of a field. A dot separates nested names.
fn field_of<'v>(object: &'v Value, field: &str) -> Option<&'v Value> {
    object.get(field).or_else(|| {
        field
            .split('.')
            .try_fold(object, |inner, name| inner.get(name))
    })
}

fn time_ns(object: &Value, time: &TimeField) -> Result<i64, LineFault> {
    let fault = |found: &dyn std::fmt::Display| LineFault::new(&*time.name, found, TIME);
    // The shortest decimal text of a number is exact, unlike a product of floating-point numbers.
    let text = match field_of(object, &time.name) {
        Some(Value::Number(number)) => number.to_string(),
        Some(Value::String(text)) => text.clone(),
        Some(other) => return Err(fault(other)),
        None => return Err(fault(&"missing")),
    };
    parse_time_ns(&text, time.unit).ok_or_else(|| fault(&text))
}

fn samples(field: &str, value: &Value) -> Result<Vec<f64>, LineFault> {
    let number = |value: &Value| match value {
        Value::Null => Ok(f64::NAN),
        value => value
            .as_f64()
            .ok_or_else(|| LineFault::new(field, value, "must be a number or null")),
    };
    match value {
        Value::Array(items) if (1..=MAX_SAMPLES).contains(&items.len()) => {
            items.iter().map(number).collect()
        }
        Value::Array(items) => Err(LineFault::new(
            field,
            format!("{} samples", items.len()),
            format!("must be 1 to {MAX_SAMPLES} samples"),
        )),
        value => Ok(vec![number(value)?]),
    }
}
