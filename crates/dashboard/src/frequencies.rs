//! Whether a structure without a model needs attention: its natural frequencies, and what is judged
//! of them. Lasting changes concern every structure.

use crate::overview::Level;
use crate::store::Store;
use spandrel_bus::{AlertState, JudgementDisplay, JudgementState, ModeState};

/// Returns the level and the sentence of a structure without a model that gives no concern.
pub(crate) fn attention(store: &Store) -> (Level, String) {
    let state = &store.state;
    let followed = store.about.modes.len();
    let unjudged = state
        .judgements
        .values()
        .find(|judgement| judgement.state != JudgementState::Judged);
    let (level, sentence) = match unjudged {
        _ if state.silence().is_none() => (Level::Learning, "waiting for the first samples"),
        _ if followed == 0 => (
            Level::Undecided,
            "no natural frequency is declared; the events propose those that persist",
        ),
        _ if state.modes.is_empty() => (
            Level::Learning,
            "waiting for the end of the first epoch of natural frequencies",
        ),
        _ if store.about.judged.is_empty() => (
            Level::Undecided,
            "natural frequencies are followed, but not judged: the structure file has no quantity \
             in [judge]",
        ),
        _ if state.judgements.is_empty() => (Level::Learning, "no judgement yet"),
        Some(judgement) if judgement.state == JudgementState::Learning => {
            (Level::Learning, judgement.sentence.as_str())
        }
        Some(judgement) => (Level::Undecided, judgement.sentence.as_str()),
        None => (
            Level::Normal,
            "no lasting change found in the judged natural frequencies",
        ),
    };
    (level, sentence.to_owned())
}

/// Returns the sentence of the largest lasting loss that nobody has acknowledged.
pub(crate) fn alarm(store: &Store) -> Option<String> {
    let raised = lasting_losses(store, AlertState::Raised);
    let loss = |judgement: &JudgementDisplay| judgement.change.map_or(0.0, |change| change.loss);
    let largest = raised.max_by(|a, b| loss(a).total_cmp(&loss(b)))?;
    Some(lasting(store, largest))
}

/// Returns the judgements whose lasting loss is an alert in this state.
pub(crate) fn lasting_losses(
    store: &Store,
    state: AlertState,
) -> impl Iterator<Item = &JudgementDisplay> {
    let judgements = store.state.judgements.values();
    judgements.filter(move |judgement| judgement.alert_state() == Some(state))
}

/// Returns the lasting changes. Without a model, also the natural frequencies that are lost.
pub(crate) fn concerns(store: &Store) -> Vec<(Level, String)> {
    let changed = store.state.judgements.values();
    let changed = changed.filter(|judgement| judgement.change.is_some());
    let mut concerns: Vec<(Level, String)> = changed
        .map(|judgement| {
            let level = match judgement.seen {
                Some(_) => Level::Notice,
                None => Level::Warning,
            };
            (level, lasting(store, judgement))
        })
        .collect();
    if store.about.is_filtered {
        return concerns;
    }
    let modes = store.state.modes.values();
    let lost: Vec<&str> = modes
        .filter(|mode| mode.state == ModeState::Lost)
        .map(|mode| mode.mode.as_str())
        .collect();
    if !lost.is_empty() {
        let sentence = format!(
            "not found often enough for a statement: {}",
            lost.join(", ")
        );
        concerns.push((Level::Warning, sentence));
    }
    concerns
}

/// Returns the sentence of a lasting change, who has acknowledged it, and how old it is.
fn lasting(store: &Store, judgement: &JudgementDisplay) -> String {
    let sentence = judgement.sentence.trim_end_matches('.');
    let since_epoch = store
        .state
        .time_ns
        .zip(judgement.epoch_ns)
        .map(|(now_ns, epoch_ns)| {
            let minutes = now_ns.saturating_sub(epoch_ns).max(0) / 60_000_000_000;
            match minutes {
                0..120 => format!("; last epoch {minutes} min before the newest data"),
                _ => format!("; last epoch {} h before the newest data", minutes / 60),
            }
        });
    let seen = judgement.seen.as_ref().map(|seen| {
        let note = match seen.text.as_str() {
            "" => String::new(),
            text => format!(": {text}"),
        };
        format!("; acknowledged by {}{note}", seen.who)
    });
    let more = [seen, since_epoch].into_iter().flatten();
    sentence.to_owned() + &more.collect::<String>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::overview::overview;
    use crate::testing::{
        alert, at, demo_with_air, hear, lasting_loss, mode, present, sensors_only,
    };
    use crate::view::AlertKind;
    use spandrel_bus::{
        ChangeSeen, Header, JudgementDisplay, ModeDisplay, ModeEstimate, Name, Progress, Service,
        ShapeValue,
    };
    use spandrel_listener::Input;

    /// Returns the progress of ingest to the frame at `second`.
    fn ingested(second: i64) -> Input {
        let header = Header {
            source: "ingest".to_owned(),
            epoch: 1,
            sequence: 0,
            time_ns: second * 1_000_000_000,
        };
        let progress = Progress {
            header,
            done: 0,
            kept: 0,
        };
        Input::Ingested(Name::new("sensors-only").unwrap(), progress)
    }

    /// Returns the store after two messages of progress, without any estimate.
    fn measuring() -> Store {
        let mut store = sensors_only();
        let services = [(Service::Ingest, "ingest"), (Service::Modes, "modes")];
        store.handle(present(&services));
        for second in [1, 2] {
            store.handle(at(second as f64));
            store.handle(ingested(second));
        }
        store
    }

    /// Returns the sentence of a loss whose last epoch ended `minutes` before the newest data.
    fn told(quantity: &str, minutes: u32) -> String {
        format!(
            "{quantity} has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %); last epoch \
             {minutes} min before the newest data"
        )
    }

    fn found(store: &Store) -> (Level, String) {
        let overview = overview(store);
        (overview.level, overview.sentence)
    }

    #[test]
    fn frames_without_estimates_are_data() {
        let mut store = measuring();
        let (level, sentence) = found(&store);
        assert_eq!(level, Level::Learning, "{sentence}");
        assert!(sentence.contains("first epoch"), "{sentence}");
        // Ingest repeats its progress although no frame arrives.
        for second in [10, 60] {
            store.handle(at(second as f64));
            store.handle(ingested(2));
        }
        let (level, sentence) = found(&store);
        assert_eq!(level, Level::Stale, "{sentence}");
    }

    #[test]
    fn sensor_that_took_no_part_in_an_epoch_is_named() {
        let mut store = measuring();
        let shape = (1..5).map(|floor| ShapeValue {
            channel: format!("floor-{floor}"),
            value: [1.0, 0.0],
            std: 0.0,
        });
        let display = mode("sway-1", 600);
        let estimate = display.estimate.clone().map(|estimate| ModeEstimate {
            shape: shape.collect(),
            ..estimate
        });
        store.handle(Input::Mode(Box::new(ModeDisplay {
            estimate,
            ..display
        })));
        let overview = overview(&store);
        assert_eq!((overview.sensors.alive, overview.sensors.total), (4, 5));
        assert_eq!(
            overview.sentence,
            "not used: floor-5; the natural frequencies use the other sensors"
        );
    }

    /// Regression test: the page showed a structure with a model as normal.
    #[test]
    fn lasting_change_of_a_structure_with_a_model_is_told() {
        let mut store = demo_with_air();
        hear(&mut store, "storey-2", 580_000_000_000, 0.95, 0.0);
        let changed = lasting_loss("storey-2");
        store.handle(Input::Judgement(changed));
        assert_eq!(found(&store), (Level::Alarm, told("storey-2", 2)));
        let overview = overview(&store);
        assert_eq!((overview.raised, &*overview.also), (1, ""));
        let last = overview.last_alert.unwrap();
        assert_eq!(
            (last.kind, &*last.parameter, last.state),
            (AlertKind::LastingLoss, "storey-2", AlertState::Raised)
        );
        // The alert of a rule comes first, and the lasting loss remains visible.
        let raised = alert("storey-2", 580_000_000_000, AlertState::Raised);
        store.handle(Input::Alert(raised.clone()));
        let overview = crate::overview::overview(&store);
        assert_eq!((overview.raised, overview.sentence), (2, raised.why));
        assert_eq!(overview.also, told("storey-2", 2));
    }

    #[test]
    fn lasting_change_of_a_frequency_is_told_until_somebody_has_seen_it() {
        let mut store = measuring();
        store.handle(Input::Mode(Box::new(mode("sway-1", 600))));
        let changed = lasting_loss("sway-1");
        store.handle(Input::Judgement(changed.clone()));
        assert_eq!(found(&store), (Level::Alarm, told("sway-1", 0)));
        let seen = ChangeSeen {
            who: "Ada".to_owned(),
            text: "new asphalt".to_owned(),
            time_ns: 0,
        };
        store.handle(Input::Judgement(JudgementDisplay {
            seen: Some(seen),
            ..changed.clone()
        }));
        let seen = "; acknowledged by Ada: new asphalt; last epoch";
        let acknowledged = told("sway-1", 0).replace("; last epoch", seen);
        assert_eq!(found(&store), (Level::Notice, acknowledged));
        assert_eq!(overview(&store).acknowledged, 1);
        store.handle(Input::Judgement(JudgementDisplay {
            change: None,
            state: JudgementState::Judged,
            ..changed
        }));
        assert_eq!(found(&store).0, Level::Normal);
        store.handle(Input::Mode(Box::new(ModeDisplay {
            state: ModeState::Lost,
            estimate: None,
            ..mode("sway-1", 1200)
        })));
        let (level, sentence) = found(&store);
        assert_eq!(level, Level::Warning);
        assert!(sentence.ends_with("sway-1"), "{sentence}");
    }
}
