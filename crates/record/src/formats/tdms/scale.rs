//! Scales that convert raw numbers to the unit of the channel: linear and polynomial, applied in
//! sequence.

use super::{Object, Property};
use crate::fault::Fault;

/// Input source of a scale that applies to the raw numbers.
const RAW: u32 = u32::MAX;

/// Applies the scales of a channel. Without scales, the numbers are the measured values.
pub(super) fn scaled(name: &str, object: &Object) -> Result<Vec<f64>, Fault> {
    let number = |key: &str| match object.properties.get(key) {
        Some(Property::Number(number)) => Some(*number),
        Some(Property::Text(_) | Property::Time(_) | Property::Other) | None => None,
    };
    let text = |key: &str| match object.properties.get(key) {
        Some(Property::Text(text)) => Some(text.as_str()),
        Some(Property::Number(_) | Property::Time(_) | Property::Other) | None => None,
    };
    let raw = |scale: u32| {
        object
            .samples
            .get(&scale)
            .or_else(|| object.samples.values().next())
    };
    let is_scaled = text("NI_Scaling_Status") != Some("scaled");
    let scales = number("NI_Number_Of_Scales")
        .filter(|_| is_scaled)
        .unwrap_or(0.0) as u32;

    // The chain leads from the last scale back to the raw numbers. Each scale names its input.
    let mut chain = Vec::new();
    let mut scale = scales.checked_sub(1).unwrap_or(RAW);
    while scale != RAW {
        let key = |setting: &str| format!("NI_Scale[{scale}]_{setting}");
        let Some(kind) = text(&key("Scale_Type")) else {
            break;
        }; // a scale without a type is a DAQmx scaler
        let coefficient = |setting: &str| {
            let found = || format!("without {setting}");
            number(&key(setting))
                .ok_or_else(|| Fault::of_file(format!("scale {scale} of {name}"), found(), "whole"))
        };
        let coefficients = match kind {
            "Linear" => vec![
                coefficient("Linear_Y_Intercept")?,
                coefficient("Linear_Slope")?,
            ],
            "Polynomial" => {
                let count = number(&key("Polynomial_Coefficients_Size")).unwrap_or(4.0) as u32;
                (0..count)
                    .map(|index| coefficient(&format!("Polynomial_Coefficients[{index}]")))
                    .collect::<Result<_, _>>()?
            }
            other => {
                return Err(Fault::of_file(
                    format!("scale {scale} of {name}"),
                    format!("`{other}`"),
                    "Linear or Polynomial",
                ));
            }
        };
        chain.push(coefficients);
        let input = number(&key(&format!("{kind}_Input_Source"))).map_or(RAW, |input| input as u32);
        if input != RAW && input >= scale {
            let allowed = format!("a scale before {scale}");
            return Err(Fault::of_file(
                format!("input of scale {scale} of {name}"),
                format!("scale {input}"),
                allowed,
            ));
        }
        scale = input;
    }
    let raw = raw(scale).cloned().unwrap_or_default();
    let polynomial = |coefficients: &Vec<f64>, value: f64| {
        coefficients
            .iter()
            .rev()
            .fold(0.0, |sum, c| sum * value + c)
    };
    Ok(raw
        .into_iter()
        .map(|value| {
            chain
                .iter()
                .rev()
                .fold(value, |value, coefficients| polynomial(coefficients, value))
        })
        .collect())
}
