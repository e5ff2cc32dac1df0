//! The states that a receiver can request.

use serde::Deserialize;
use spandrel_bus::{AlertState, ChangeKind, MonitoringState};

/// A state of an alert, of the monitoring of a structure or of the clock of a node, or a lasting
/// change of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(try_from = "String")]
pub enum NoticeState {
    /// The reference of an alert is being learnt.
    Learning,
    /// There is no loss.
    Normal,
    /// A loss is credible, but not yet for the sustain time.
    Pending,
    /// An alert is raised.
    Raised,
    /// A person has acknowledged the alert.
    Acknowledged,
    /// The alert has ended.
    Cleared,
    /// No alert can be decided.
    Undecided,
    /// The alert is open, but the present data do not support a decision.
    Unconfirmed,
    /// A loss is credible in strong motion, which alone shows no damage.
    SofteningInMotion,
    /// The data of a structure reveal no damage.
    Blind,
    /// The data of a structure reveal damage of some parts only.
    Degraded,
    /// The data of a structure reveal damage of every part again.
    Watching,
    /// A quantity has permanently lost stiffness.
    LastingLoss,
    /// A quantity has permanently become stiffer.
    Stiffer,
    /// A report of an earthquake is ready.
    EarthquakeReport,
    /// The clock of a node differs from that of most nodes, or no majority of the nodes agrees.
    ClockWrong,
    /// The clock of such a node agrees again.
    ClockRight,
}

/// Name of [`NoticeState::EarthquakeReport`], as that of the event.
const EARTHQUAKE_REPORT: &str = "earthquake-report";
/// Name of [`NoticeState::ClockWrong`], as that of the event.
const CLOCK_WRONG: &str = "clock-wrong";
/// Name of [`NoticeState::ClockRight`], as that of the event.
const CLOCK_RIGHT: &str = "clock-right";

impl NoticeState {
    /// All states.
    pub const ALL: [Self; 17] = [
        Self::Learning,
        Self::Normal,
        Self::Pending,
        Self::Raised,
        Self::Acknowledged,
        Self::Cleared,
        Self::Undecided,
        Self::Unconfirmed,
        Self::SofteningInMotion,
        Self::Blind,
        Self::Degraded,
        Self::Watching,
        Self::LastingLoss,
        Self::Stiffer,
        Self::EarthquakeReport,
        Self::ClockWrong,
        Self::ClockRight,
    ];

    /// Returns the name of the state, as in the configuration.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Learning => AlertState::Learning.as_str(),
            Self::Normal => AlertState::Normal.as_str(),
            Self::Pending => AlertState::Pending.as_str(),
            Self::Raised => AlertState::Raised.as_str(),
            Self::Acknowledged => AlertState::Acknowledged.as_str(),
            Self::Cleared => AlertState::Cleared.as_str(),
            Self::Undecided => AlertState::Undecided.as_str(),
            Self::Unconfirmed => AlertState::Unconfirmed.as_str(),
            Self::SofteningInMotion => AlertState::SofteningInMotion.as_str(),
            Self::Blind => MonitoringState::Blind.as_str(),
            Self::Degraded => MonitoringState::Degraded.as_str(),
            Self::Watching => MonitoringState::Watching.as_str(),
            Self::LastingLoss => ChangeKind::LastingLoss.as_str(),
            Self::Stiffer => ChangeKind::Stiffer.as_str(),
            Self::EarthquakeReport => EARTHQUAKE_REPORT,
            Self::ClockWrong => CLOCK_WRONG,
            Self::ClockRight => CLOCK_RIGHT,
        }
    }

    /// Returns `true` if the state requires action. The other states end such a state.
    pub(crate) fn is_open(self) -> bool {
        match self {
            Self::Pending
            | Self::Raised
            | Self::Undecided
            | Self::Unconfirmed
            | Self::Blind
            | Self::Degraded
            | Self::LastingLoss
            | Self::ClockWrong => true,
            Self::Learning
            | Self::Normal
            | Self::Acknowledged
            | Self::Cleared
            | Self::SofteningInMotion
            | Self::Watching
            | Self::Stiffer
            | Self::EarthquakeReport
            | Self::ClockRight => false,
        }
    }
}

impl TryFrom<String> for NoticeState {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let named = Self::ALL.into_iter().find(|state| state.as_str() == text);
        named.ok_or_else(|| {
            let names = Self::ALL.map(Self::as_str).join(", ");
            format!("unknown state {text:?}, must be one of {names}")
        })
    }
}

impl From<ChangeKind> for NoticeState {
    fn from(kind: ChangeKind) -> Self {
        match kind {
            ChangeKind::LastingLoss | ChangeKind::LearnedAway => Self::LastingLoss,
            ChangeKind::Stiffer => Self::Stiffer,
        }
    }
}

impl From<AlertState> for NoticeState {
    fn from(state: AlertState) -> Self {
        match state {
            AlertState::Learning => Self::Learning,
            AlertState::Normal => Self::Normal,
            AlertState::Pending => Self::Pending,
            AlertState::Raised => Self::Raised,
            AlertState::Acknowledged => Self::Acknowledged,
            AlertState::Cleared => Self::Cleared,
            AlertState::Undecided => Self::Undecided,
            AlertState::Unconfirmed => Self::Unconfirmed,
            AlertState::SofteningInMotion => Self::SofteningInMotion,
        }
    }
}

impl From<MonitoringState> for NoticeState {
    fn from(state: MonitoringState) -> Self {
        match state {
            MonitoringState::Watching => Self::Watching,
            MonitoringState::Degraded => Self::Degraded,
            MonitoringState::Blind => Self::Blind,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_messages() {
        for state in AlertState::ALL {
            let read = NoticeState::try_from(state.as_str().to_owned());
            assert_eq!(read, Ok(state.into()));
        }
        for state in MonitoringState::ALL {
            let read = NoticeState::try_from(state.as_str().to_owned());
            assert_eq!(read, Ok(state.into()));
        }
        let error = NoticeState::try_from("blinded".to_owned()).unwrap_err();
        assert!(
            error.contains("blinded") && error.contains("degraded"),
            "{error}"
        );
    }
}
