//! An alert that needs attention: that of a rule, or a lasting loss.

use super::wording::{printable, time};
use spandrel_bus::{AlertMessage, AlertState, JudgementDisplay, Name};
use std::fmt;

/// What has decided an alert.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AlertKind {
    /// A rule of the structure file, from the present estimates.
    Rule,
    /// The judgement of lasting change.
    LastingLoss,
}

impl AlertKind {
    /// Returns the service that publishes the alert and accepts its acknowledgement, in words.
    pub fn service(self) -> &'static str {
        match self {
            Self::Rule => "alert service",
            Self::LastingLoss => "service judge",
        }
    }
}

/// Identity of an alert. A judged quantity can have the name of a parameter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AlertId {
    pub kind: AlertKind,
    pub structure: Name,
    /// The parameter or quantity.
    pub part: Name,
}

impl fmt::Display for AlertId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            kind,
            structure,
            part,
        } = self;
        match kind {
            AlertKind::Rule => write!(f, "{structure}/{part}"),
            AlertKind::LastingLoss => write!(f, "{structure}/{part} (lasting loss)"),
        }
    }
}

/// The present state of an alert.
#[derive(Debug, Clone, Copy)]
pub enum OpenAlert<'h> {
    Rule(&'h AlertMessage),
    /// A judgement with a lasting loss, and its state as an alert.
    Lasting(&'h JudgementDisplay, AlertState),
}

/// A change of an alert.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    pub alert: AlertId,
    pub time_ns: i64,
    pub state: AlertState,
    pub why: String,
}

impl<'h> OpenAlert<'h> {
    /// Returns the lasting loss of a judgement. `None` if there is none.
    pub fn lasting(display: &'h JudgementDisplay) -> Option<Self> {
        Some(Self::Lasting(display, display.alert_state()?))
    }

    pub fn id(self) -> AlertId {
        let kind = match self {
            Self::Rule(_) => AlertKind::Rule,
            Self::Lasting(..) => AlertKind::LastingLoss,
        };
        AlertId {
            kind,
            structure: self.structure().clone(),
            part: self.part().clone(),
        }
    }

    pub fn structure(self) -> &'h Name {
        match self {
            Self::Rule(alert) => &alert.structure,
            Self::Lasting(display, _) => &display.structure,
        }
    }

    /// Returns the parameter or quantity.
    pub fn part(self) -> &'h Name {
        match self {
            Self::Rule(alert) => &alert.parameter,
            Self::Lasting(display, _) => &display.quantity,
        }
    }

    pub fn state(self) -> AlertState {
        match self {
            Self::Rule(alert) => alert.state,
            Self::Lasting(_, state) => state,
        }
    }

    /// Returns `true` if the alert is open and nobody has acknowledged it.
    pub fn is_unseen(self) -> bool {
        match self {
            Self::Rule(alert) => alert.is_unseen(),
            Self::Lasting(_, state) => state == AlertState::Raised,
        }
    }

    /// Returns the time of the change to the present state, ns since the Unix epoch, UTC. A lasting
    /// loss has the day on which it was found, or the time of its acknowledgement.
    pub fn time_ns(self) -> i64 {
        match self {
            Self::Rule(alert) => alert.time_ns,
            Self::Lasting(display, _) => match (&display.seen, &display.change) {
                (Some(seen), _) => seen.time_ns,
                (None, Some(change)) => change.found_ns,
                (None, None) => display.time_ns,
            },
        }
    }

    /// Returns the sentence of the alert.
    pub fn words(self) -> String {
        match self {
            Self::Rule(alert) => alert.why.clone(),
            Self::Lasting(display, _) => match &display.seen {
                Some(seen) => {
                    let (who, text) = (&seen.who, &seen.text);
                    format!("{} Acknowledged by {who}: {text}", display.sentence)
                }
                None => display.sentence.clone(),
            },
        }
    }

    pub fn change(self) -> Change {
        Change {
            alert: self.id(),
            time_ns: self.time_ns(),
            state: self.state(),
            why: self.words(),
        }
    }
}

impl Change {
    /// Returns the change of a judgement from `before`, if its lasting loss has changed: it was
    /// found, or found again, or somebody has seen it, or it is over.
    pub fn of_judgement(before: Option<&JudgementDisplay>, now: &JudgementDisplay) -> Option<Self> {
        let found_ns = |display: &JudgementDisplay| {
            let found = display.change.filter(|change| change.kind.is_alarm());
            found.map(|change| change.found_ns)
        };
        let standing = |display: &JudgementDisplay| (display.alert_state(), found_ns(display));
        if before.map_or((None, None), standing) == standing(now) {
            return None;
        }
        let over = || Self {
            alert: AlertId {
                kind: AlertKind::LastingLoss,
                structure: now.structure.clone(),
                part: now.quantity.clone(),
            },
            time_ns: now.time_ns,
            state: AlertState::Cleared,
            why: now.sentence.clone(),
        };
        Some(OpenAlert::lasting(now).map_or_else(over, OpenAlert::change))
    }

    /// Returns the change as a line: `TIME alert STRUCTURE/PART STATE: SENTENCE`.
    pub fn line(&self) -> String {
        let Self {
            alert,
            time_ns,
            state,
            why,
        } = self;
        format!(
            "{} alert {alert} {}: {}",
            time(*time_ns),
            state.as_str(),
            printable(why)
        )
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TIME_NS, alert, lasting_loss};
    use super::*;
    use spandrel_bus::ChangeSeen;

    #[test]
    fn a_change_of_an_alert_is_one_line() {
        let mut raised = alert("storey-2", 45, AlertState::Raised);
        raised.why = "storey-2 has lost\n14 %".to_owned();
        assert_eq!(
            OpenAlert::Rule(&raised).change().line(),
            "2024-02-29 12:00:45 UTC alert tower/storey-2 raised: storey-2 has lost 14 %"
        );
    }

    #[test]
    fn a_lasting_loss_has_a_line_when_it_is_found_seen_and_over() {
        let mut found = lasting_loss("storey-2");
        found.change.as_mut().unwrap().found_ns = TIME_NS;
        let seen = JudgementDisplay {
            seen: Some(ChangeSeen {
                who: "anna".to_owned(),
                text: "on my way".to_owned(),
                time_ns: TIME_NS + 1_000_000_000,
            }),
            ..found.clone()
        };
        let over = JudgementDisplay {
            change: None,
            sentence: "storey-2 is in its commissioning.".to_owned(),
            ..found.clone()
        };
        let mut before = None;
        let mut lines = Vec::new();
        for display in [&found, &found, &seen, &over, &over] {
            lines.extend(Change::of_judgement(before, display).map(|change| change.line()));
            before = Some(display);
        }
        assert_eq!(
            lines,
            [
                "2024-02-29 12:00:00 UTC alert tower/storey-2 (lasting loss) raised: storey-2 has \
                 lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %).",
                "2024-02-29 12:00:01 UTC alert tower/storey-2 (lasting loss) acknowledged: \
                 storey-2 has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %). Acknowledged \
                 by anna: on my way",
                "2024-02-29 12:00:00 UTC alert tower/storey-2 (lasting loss) cleared: storey-2 is \
                 in its commissioning.",
            ]
        );
    }
}
