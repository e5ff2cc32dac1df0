//! One epoch of a judged quantity.

use serde::{Deserialize, Serialize};

use super::course::MOST_CONDITIONS;
use super::{Format, Malformed, Message, check_count, check_finite, check_label, check_range};
use crate::name::Name;

/// A condition in an epoch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochCondition {
    /// Name of the condition.
    pub name: Name,
    /// Unit of the value: `degC`, `log10` of an amplitude, or empty for any other condition; at
    /// most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES).
    pub unit: String,
    /// Value, in `unit`. `None` if it was not measured or is not plausible.
    pub value: Option<f64>,
}

/// An epoch of a quantity, as it is judged for lasting change.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// The quantity.
    pub quantity: Name,
    /// Middle of the epoch, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Length of the epoch, s.
    pub epoch_s: f64,
    /// Mean of ln(value), with the value in the unit of the quantity. `None` if no value counts.
    pub ln_mean: Option<f64>,
    /// Standard deviation of ln(value). `None` if no value counts.
    pub ln_std: Option<f64>,
    /// Logarithm of the rms response to base 10. `None` if no condition is an amplitude, or if it
    /// has no value.
    pub amplitude: Option<f64>,
    /// The conditions, in the order of the structure file.
    pub conditions: Vec<EpochCondition>,
    /// Whether all samples were measured, and not replayed or simulated.
    pub measured: bool,
}

impl Message for EpochDisplay {
    const TYPE: &'static str = "epoch";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_range("epoch_s", self.epoch_s, 0.0, f64::MAX)?;
        if let Some(ln_mean) = self.ln_mean {
            check_finite("ln_mean", ln_mean)?;
        }
        if let Some(ln_std) = self.ln_std {
            check_range("ln_std", ln_std, 0.0, f64::MAX)?;
        }
        if let Some(amplitude) = self.amplitude {
            check_finite("amplitude", amplitude)?;
        }
        check_count("conditions", self.conditions.len(), 0, MOST_CONDITIONS)?;
        for condition in &self.conditions {
            check_label("unit", &condition.unit)?;
            if let Some(value) = condition.value {
                check_finite("value", value)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display() -> EpochDisplay {
        EpochDisplay {
            structure: Name::new("bridge").unwrap(),
            quantity: Name::new("deck").unwrap(),
            time_ns: 450_000_000_000,
            epoch_s: 900.0,
            ln_mean: Some(0.8),
            ln_std: Some(0.002),
            amplitude: Some(-2.5),
            conditions: vec![EpochCondition {
                name: Name::new("air").unwrap(),
                unit: "degC".to_owned(),
                value: None,
            }],
            measured: true,
        }
    }

    #[test]
    fn an_epoch_is_decoded_as_it_was_encoded() {
        let text = display().encode().unwrap();
        let decoded = EpochDisplay::decode("application/json;spandrel.epoch.v1", &text).unwrap();
        assert_eq!(decoded, display());
    }

    #[test]
    fn numbers_out_of_range_and_too_many_conditions_are_refused() {
        let wrong = EpochDisplay {
            ln_std: Some(-0.1),
            ..display()
        };
        assert!(matches!(wrong.check(), Err(Malformed::Range { .. })));
        for (ln_mean, amplitude) in [(f64::NAN, 0.0), (0.0, f64::NEG_INFINITY)] {
            let wrong = EpochDisplay {
                ln_mean: Some(ln_mean),
                amplitude: Some(amplitude),
                ..display()
            };
            assert!(matches!(wrong.check(), Err(Malformed::NotFinite { .. })));
        }
        let mut wrong = display();
        wrong.conditions = vec![wrong.conditions[0].clone(); MOST_CONDITIONS + 1];
        assert!(matches!(wrong.check(), Err(Malformed::Count { .. })));
    }
}
