//! Natural frequency, damping ratio and shape of one mode.

use serde::{Deserialize, Serialize};

use super::{
    Format, MAX_CHANNELS, Malformed, Message, check_count, check_finite, check_label, check_range,
};
use crate::name::Name;

/// State of a mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModeState {
    /// The mode was found in the epoch.
    Tracked,
    /// The mode was not found in the epoch.
    Missing,
    /// The mode is found too rarely, so its values are not published.
    Lost,
    /// The mode cannot be told apart from another one. Only their mean frequency has a meaning.
    Paired,
}

impl ModeState {
    /// All states.
    pub const ALL: [Self; 4] = [Self::Tracked, Self::Missing, Self::Lost, Self::Paired];

    /// Returns the name of the state, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Tracked => "tracked",
            Self::Missing => "missing",
            Self::Lost => "lost",
            Self::Paired => "paired",
        }
    }
}

/// A mode at one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShapeValue {
    /// Name of the channel.
    pub channel: String,
    /// Real and imaginary part, relative to the channel with the largest amplitude.
    pub value: [f64; 2],
    /// Standard deviation of the real part, relative to the channel with the largest amplitude.
    pub std: f64,
}

/// A mode as it was found in one epoch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModeEstimate {
    /// Natural frequency, Hz.
    pub frequency_hz: f64,
    /// Standard deviation of the frequency, Hz.
    pub frequency_std_hz: f64,
    /// Damping ratio.
    pub damping: f64,
    /// Standard deviation of the damping ratio.
    pub damping_std: f64,
    /// Shape at the channels that take part in the epoch. The channel with the largest amplitude
    /// has the value 1.
    pub shape: Vec<ShapeValue>,
    /// Standard deviation of the samples in the band of the mode, at the channel with the largest
    /// amplitude, in the unit of the channel.
    pub amplitude: f64,
}

/// One declared mode after one epoch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModeDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the mode.
    pub mode: Name,
    /// Measurement time of the end of the epoch, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Length of the epoch, s.
    pub epoch_s: f64,
    /// Number of epochs so far.
    pub epochs: u64,
    /// State after the epoch.
    pub state: ModeState,
    /// The other mode of a pair whose two modes cannot be told apart. `None` if the mode is in no
    /// pair.
    pub partner: Option<Name>,
    /// Estimate of the mode in the epoch. `None` if the mode is missing or lost.
    pub estimate: Option<ModeEstimate>,
    /// Share of the last 20 epochs in which the mode was found, 0 to 1.
    pub presence: f64,
    /// Whether a machine runs at the frequency of the mode. The estimate is then not reliable.
    pub machine: bool,
    /// Frequency of the mode in the structure file, Hz.
    pub declared_hz: f64,
}

impl Message for ModeDisplay {
    const TYPE: &'static str = "mode";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_range("epoch", self.epoch_s, 0.0, f64::MAX)?;
        check_range("presence", self.presence, 0.0, 1.0)?;
        check_range("declared frequency", self.declared_hz, 0.0, f64::MAX)?;
        self.estimate.as_ref().map_or(Ok(()), ModeEstimate::check)
    }
}

impl ModeEstimate {
    /// Checks that all numbers are possible.
    ///
    /// # Errors
    /// Returns the first violation.
    pub fn check(&self) -> Result<(), Malformed> {
        check_range("frequency", self.frequency_hz, f64::MIN_POSITIVE, f64::MAX)?;
        check_range("frequency std", self.frequency_std_hz, 0.0, f64::MAX)?;
        check_range("damping", self.damping, -1.0, 1.0)?;
        check_range("damping std", self.damping_std, 0.0, f64::MAX)?;
        check_range("amplitude", self.amplitude, 0.0, f64::MAX)?;
        check_count("shape", self.shape.len(), 0, MAX_CHANNELS)?;
        for at in &self.shape {
            check_label("channel", &at.channel)?;
            check_finite("shape", at.value[0])?;
            check_finite("shape", at.value[1])?;
            check_range("shape std", at.std, 0.0, f64::MAX)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display() -> ModeDisplay {
        ModeDisplay {
            structure: Name::new("bridge").unwrap(),
            mode: Name::new("bending-1").unwrap(),
            time_ns: 600_000_000_000,
            epoch_s: 600.0,
            epochs: 1,
            state: ModeState::Paired,
            partner: Some(Name::new("torsion-1").unwrap()),
            estimate: Some(ModeEstimate {
                frequency_hz: 3.9,
                frequency_std_hz: 0.004,
                damping: 0.01,
                damping_std: 0.001,
                shape: vec![ShapeValue {
                    channel: "span-1".to_owned(),
                    value: [1.0, 0.0],
                    std: 0.0,
                }],
                amplitude: 0.02,
            }),
            presence: 1.0,
            machine: false,
            declared_hz: 3.9,
        }
    }

    #[test]
    fn words_are_those_of_the_json() {
        let text = String::from_utf8(display().encode().unwrap()).unwrap();
        assert!(text.contains(r#""state":"paired""#), "{text}");
        assert!(text.contains(r#""value":[1.0,0.0]"#), "{text}");
        let decoded = ModeDisplay::decode("application/json", text.as_bytes()).unwrap();
        assert_eq!(decoded, display());
        for state in ModeState::ALL {
            let json = serde_json::to_string(&state).unwrap();
            assert_eq!(json, format!("\"{}\"", state.as_str()));
        }
    }

    #[test]
    fn numbers_out_of_range_are_refused() {
        type Change = fn(&mut ModeEstimate);
        let changes: [Change; 6] = [
            |estimate| estimate.frequency_hz = 0.0,
            |estimate| estimate.frequency_std_hz = -1.0,
            |estimate| estimate.damping = 2.0,
            |estimate| estimate.damping_std = f64::INFINITY,
            |estimate| estimate.shape[0].value[1] = f64::NAN,
            |estimate| estimate.amplitude = f64::NAN,
        ];
        for change in changes {
            let mut wrong = display();
            change(wrong.estimate.as_mut().unwrap());
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
        let wrong = ModeDisplay {
            presence: 1.5,
            ..display()
        };
        assert!(matches!(wrong.check(), Err(Malformed::Range { .. })));
        assert_eq!(display().check(), Ok(()));
    }
}
