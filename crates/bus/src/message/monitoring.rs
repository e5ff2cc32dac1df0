//! Whether the data reveal damage at present, per structure, parameter and channel.

use serde::{Deserialize, Serialize};

use super::text::check_text;
use super::{Format, MAX_CHANNELS, Malformed, Message, bounded, check_count, check_range};
use crate::name::Name;

/// Maximum number of reasons in a message. They are summaries, not lists of all parts.
const MAX_REASONS: usize = 64;

/// Reason of a parameter whose reference is being learnt.
pub const REFERENCE_IS_LEARNT: &str = "the reference is being learnt";

/// Whether damage of a part, or of a structure, would be noticed at present.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MonitoringState {
    /// The present data reveal damage of every part.
    Watching,
    /// Some sensors deliver little, or the data reveal damage of some parts only.
    Degraded,
    /// The present data reveal no damage.
    Blind,
}

impl MonitoringState {
    /// All states, from the best to the worst.
    pub const ALL: [Self; 3] = [Self::Watching, Self::Degraded, Self::Blind];

    /// Returns the name of the state, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Watching => "watching",
            Self::Degraded => "degraded",
            Self::Blind => "blind",
        }
    }
}

/// Whether a change of one parameter would be noticed at present.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterMonitoring {
    /// Name of the parameter.
    pub parameter: Name,
    /// The state.
    pub state: MonitoringState,
    /// The reason as a clause without a full stop. `None` while watching.
    pub why: Option<String>,
    /// Standard deviation, ratio to nominal, that the present learning rate sustains. `None` if it
    /// is not measured or if nothing is learnt.
    pub sustained_std: Option<f64>,
}

/// Whether the samples of one channel are used at present.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelMonitoring {
    /// Name of the channel.
    pub channel: Name,
    /// The state.
    pub state: MonitoringState,
    /// Share of the samples of the last 5 s of measurement that the filter has used, 0 to 1.
    pub used_share: f64,
}

/// State of the monitoring of one structure, published once per second.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MonitoringDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Wall-clock time, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Measurement time of the last estimate, ns since the Unix epoch, UTC. `None` before the first
    /// estimate.
    pub measured_ns: Option<i64>,
    /// The state.
    pub state: MonitoringState,
    /// Wall-clock time since which the state has lasted, ns since the Unix epoch, UTC.
    pub since_ns: i64,
    /// Reasons as clauses without a full stop, most important first. Empty while watching.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_REASONS>")]
    pub reasons: Vec<String>,
    /// The parameters, in state order.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub parameters: Vec<ParameterMonitoring>,
    /// The response channels in the order of the structure file, and then the channels that measure
    /// an excitation. Empty with distributed identification.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub channels: Vec<ChannelMonitoring>,
}

impl MonitoringDisplay {
    /// Returns `true` if the only reason is that references are being learnt, as after the first
    /// start.
    #[must_use]
    pub fn only_learns(&self) -> bool {
        let learns = |reason: &String| reason.ends_with(REFERENCE_IS_LEARNT);
        !self.reasons.is_empty() && self.reasons.iter().all(learns)
    }

    /// Returns state and reasons as a clause without a full stop, such as `blind: no samples`.
    #[must_use]
    pub fn words(&self) -> String {
        match self.reasons.is_empty() {
            true => self.state.as_str().to_owned(),
            false => format!("{}: {}", self.state.as_str(), self.reasons.join("; ")),
        }
    }
}

impl Message for MonitoringDisplay {
    const TYPE: &'static str = "monitoring";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_count("reasons", self.reasons.len(), 0, MAX_REASONS)?;
        for reason in &self.reasons {
            check_text("reason", reason)?;
        }
        check_count("parameters", self.parameters.len(), 0, MAX_CHANNELS)?;
        for parameter in &self.parameters {
            check_text("why", parameter.why.as_deref().unwrap_or_default())?;
            let std = parameter.sustained_std.unwrap_or(0.0);
            check_range("sustained std", std, 0.0, f64::MAX)?;
        }
        check_count("channels", self.channels.len(), 0, MAX_CHANNELS)?;
        for channel in &self.channels {
            check_range("used share", channel.used_share, 0.0, 1.0)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display() -> MonitoringDisplay {
        let name = |text: &str| Name::new(text).unwrap();
        MonitoringDisplay {
            structure: name("tower"),
            time_ns: 7,
            measured_ns: Some(5),
            state: MonitoringState::Degraded,
            since_ns: 6,
            reasons: vec!["33 % of the samples of roof are used".to_owned()],
            parameters: vec![ParameterMonitoring {
                parameter: name("storey-1"),
                state: MonitoringState::Watching,
                why: None,
                sustained_std: Some(0.01),
            }],
            channels: vec![ChannelMonitoring {
                channel: name("roof"),
                state: MonitoringState::Degraded,
                used_share: 0.33,
            }],
        }
    }

    #[test]
    fn states_are_words_in_json() {
        let text = String::from_utf8(display().encode().unwrap()).unwrap();
        assert!(text.contains(r#""state":"degraded""#), "{text}");
        assert_eq!(
            MonitoringDisplay::decode("application/json", text.as_bytes()).unwrap(),
            display()
        );
        for state in MonitoringState::ALL {
            let json = serde_json::to_string(&state).unwrap();
            assert_eq!(json, format!("\"{}\"", state.as_str()));
        }
    }

    #[test]
    fn shares_and_deviations_out_of_range_are_refused() {
        let mut wrong = display();
        wrong.channels[0].used_share = 1.5;
        assert!(matches!(wrong.check(), Err(Malformed::Range { .. })));
        let mut wrong = display();
        wrong.parameters[0].sustained_std = Some(-0.1);
        assert!(matches!(wrong.check(), Err(Malformed::Range { .. })));
    }

    #[test]
    fn learning_a_reference_is_distinguished_from_other_reasons() {
        let because = |reasons: &[&str]| MonitoringDisplay {
            reasons: reasons.iter().map(|reason| (*reason).to_owned()).collect(),
            ..display()
        };
        let of_some = format!("storey-1: {REFERENCE_IS_LEARNT}");
        assert!(because(&[REFERENCE_IS_LEARNT]).only_learns());
        assert!(because(&[&of_some]).only_learns());
        assert!(!because(&[&of_some, "no samples of roof are used"]).only_learns());
        assert!(!because(&[]).only_learns());
    }

    #[test]
    fn text_names_the_state_and_its_reasons() {
        assert_eq!(
            display().words(),
            "degraded: 33 % of the samples of roof are used"
        );
    }
}
