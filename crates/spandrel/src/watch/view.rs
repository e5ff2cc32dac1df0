//! The choices of the user at the screen. Keys are the input, and actions are the output.

use super::form::{Form, Typed};
use super::heard::Heard;
use super::open_alert::{AlertId, OpenAlert};
use super::wording::nothing_heard;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use spandrel_bus::{AlertState, Name};
use spandrel_listener::StructureState;
use std::collections::BTreeSet;
use std::time::Duration;

/// Time for which a notice is shown in the last line.
const NOTICE_FOR: Duration = Duration::from_secs(8);
/// Time limit for a service to accept an acknowledgement.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// Number of parameters per page key.
const PAGE: usize = 5;

/// The received state, and the user's choices.
#[derive(Debug, Clone, Default)]
pub struct View {
    pub heard: Heard,
    /// Description of the subscribed part of the bus, shown until a message arrives.
    place: String,
    around: Around,
    /// Structures whose services or sensors run, apart from the one that is shown.
    others: BTreeSet<Name>,
    mode: Mode,
    /// Selection by name, so that a new structure or alert does not move it.
    structure: Option<Name>,
    alert: Option<AlertId>,
    first_parameter: usize,
    notice: Option<Notice>,
    /// Name of the last acknowledgement, the default for the next one.
    who: String,
    overwritten: u64,
    sent: Option<Sent>,
}

/// Surroundings of a view, fixed when it is opened.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Around {
    /// Address of the web page, if there is one.
    pub page: Option<String>,
    /// Reason why a router would drop an acknowledgement, if it would.
    pub cannot_acknowledge: Option<String>,
}

/// An acknowledgement without confirmation. The next state of the alert confirms it.
#[derive(Debug, Clone)]
struct Sent {
    alert: AlertId,
    state: AlertState,
    is_unseen: bool,
    until: Duration,
}

/// Meaning of the keys.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Mode {
    #[default]
    Watching,
    Help,
    Acknowledging {
        alert: AlertId,
        form: Form,
    },
}

/// Request of the user.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    Quit,
    Acknowledge {
        alert: AlertId,
        who: String,
        note: String,
    },
}

#[derive(Debug, Clone)]
struct Notice {
    text: String,
    until: Duration,
}

/// A step through a list.
#[derive(Debug, Clone, Copy)]
enum Step {
    Next,
    Previous,
}

impl View {
    /// Creates a view of `place` without any messages. `who` is the default name for
    /// acknowledgements.
    pub fn new(place: String, around: Around, who: String) -> Self {
        Self {
            place,
            around,
            who,
            ..Self::default()
        }
    }

    /// Sets the structures whose services or sensors run, apart from the one that is shown.
    pub fn set_others(&mut self, others: BTreeSet<Name>) {
        self.others = others;
    }

    /// Returns the text for a view without any messages.
    pub fn nothing_heard(&self) -> String {
        nothing_heard(&self.place, &self.others)
    }

    /// Processes a key and returns the resulting action.
    pub fn key(&mut self, key: KeyEvent) -> Option<Action> {
        if key.modifiers.contains(KeyModifiers::CONTROL) && key.code == KeyCode::Char('c') {
            return Some(Action::Quit);
        }
        match &mut self.mode {
            Mode::Watching => return self.watching_key(key.code),
            Mode::Help if key.code == KeyCode::Char('q') => return Some(Action::Quit),
            Mode::Help => self.mode = Mode::Watching,
            Mode::Acknowledging { alert, form } => match form.key(key) {
                Typed::On => {}
                Typed::Cancelled => self.mode = Mode::Watching,
                Typed::Done => {
                    let alert = alert.clone();
                    let (who, note) = (form.who.trim().to_owned(), form.note.trim().to_owned());
                    self.who.clone_from(&who);
                    self.mode = Mode::Watching;
                    return Some(Action::Acknowledge { alert, who, note });
                }
            },
        }
        None
    }

    fn watching_key(&mut self, code: KeyCode) -> Option<Action> {
        match code {
            KeyCode::Char('q') | KeyCode::Esc => return Some(Action::Quit),
            KeyCode::Char('?' | 'h') => self.mode = Mode::Help,
            KeyCode::Char('a') => self.acknowledge(),
            KeyCode::Tab | KeyCode::Right => self.choose_structure(Step::Next),
            KeyCode::BackTab | KeyCode::Left => self.choose_structure(Step::Previous),
            KeyCode::Down => self.choose_alert(Step::Next),
            KeyCode::Up => self.choose_alert(Step::Previous),
            KeyCode::PageDown => {
                let last = self
                    .selected_structure()
                    .map_or(0, |(_, heard)| heard.parameters.len().saturating_sub(1));
                self.first_parameter = (self.first_parameter + PAGE).min(last);
            }
            KeyCode::PageUp => self.first_parameter = self.first_parameter.saturating_sub(PAGE),
            _ => {}
        }
        None
    }

    fn choose_structure(&mut self, step: Step) {
        let names: Vec<&Name> = self.heard.structures().map(|(name, _)| name).collect();
        let at = self
            .selected_structure()
            .and_then(|(selected, _)| names.iter().position(|name| *name == selected));
        self.structure = step
            .around(at, names.len())
            .map(|index| names[index].clone());
        self.first_parameter = 0;
    }

    fn choose_alert(&mut self, step: Step) {
        let alerts = self.heard.open_alerts();
        let at = self.selected_alert_index(&alerts);
        let chosen = step.within(at, alerts.len()).map(|index| alerts[index]);
        self.alert = chosen.map(OpenAlert::id);
    }

    fn acknowledge(&mut self) {
        let Some(alert) = self.selected_alert() else {
            self.notify("no alert to acknowledge".to_owned());
            return;
        };
        let (id, state, is_unseen) = (alert.id(), alert.state(), alert.is_unseen());
        if self.heard.is_stale(alert) {
            let service = id.kind.service();
            self.notify(format!("cannot acknowledge {id}: its {service} is gone"));
            return;
        }
        if let Some(why) = &self.around.cannot_acknowledge {
            self.notify(format!("cannot acknowledge: {why}"));
            return;
        }
        match state {
            AlertState::Unconfirmed if !is_unseen => {
                self.notify(format!("{id} is already acknowledged"));
            }
            AlertState::Raised
            | AlertState::Unconfirmed
            | AlertState::Cleared
            | AlertState::Pending => {
                self.mode = Mode::Acknowledging {
                    alert: id,
                    form: Form::new(self.who.clone()),
                };
            }
            AlertState::Acknowledged
            | AlertState::Learning
            | AlertState::Normal
            | AlertState::SofteningInMotion
            | AlertState::Undecided => {
                let state = state.as_str();
                self.notify(format!("{id} is {state}; nothing to acknowledge"));
            }
        }
    }

    /// Shows a text in the last line for a limited time.
    pub fn notify(&mut self, text: String) {
        self.notice = Some(Notice {
            text,
            until: self.heard.now() + NOTICE_FOR,
        });
    }

    /// Records that an acknowledgement was sent, and shows this until it is accepted.
    pub fn sent(&mut self, id: AlertId) {
        let Some(alert) = self.heard.alert(&id) else {
            return;
        };
        let (state, is_unseen) = (alert.state(), alert.is_unseen());
        self.notify(format!("acknowledgement of {id} sent"));
        self.sent = Some(Sent {
            alert: id,
            state,
            is_unseen,
            until: self.heard.now() + ANSWER_WITHIN,
        });
    }

    /// Reports whether an acknowledgement was accepted, as soon as this is known or the time limit
    /// has passed.
    pub fn check_acknowledgement(&mut self) {
        let Some(Sent {
            alert: id,
            state,
            is_unseen,
            until,
        }) = &self.sent
        else {
            return;
        };
        let told = match self.heard.alert(id) {
            Some(now) if now.state() != *state => {
                format!("{id} is {}", now.state().as_str())
            }
            Some(now) if now.is_unseen() != *is_unseen => format!("{id} is acknowledged"),
            Some(_) | None if self.heard.now() < *until => return,
            Some(_) | None => {
                let service = id.kind.service();
                format!("no reply to the acknowledgement of {id}; is the {service} running?")
            }
        };
        self.sent = None;
        self.notify(told);
    }

    /// Returns the address of the web page, if there is one.
    pub fn page(&self) -> Option<&str> {
        self.around.page.as_deref()
    }

    /// Sets the number of messages that were overwritten before they were shown.
    pub fn set_overwritten(&mut self, overwritten: u64) {
        self.overwritten = overwritten;
    }

    /// Returns the number of messages that were overwritten before they were shown.
    pub fn overwritten(&self) -> u64 {
        self.overwritten
    }

    /// Returns the current meaning of the keys.
    pub fn mode(&self) -> &Mode {
        &self.mode
    }

    /// Returns the current notice.
    pub fn notice(&self) -> Option<&str> {
        let notice = self
            .notice
            .as_ref()
            .filter(|notice| self.heard.now() <= notice.until);
        notice.map(|notice| notice.text.as_str())
    }

    /// Returns the selected structure, by default the first.
    pub fn selected_structure(&self) -> Option<(&Name, &StructureState)> {
        let chosen = self.structure.as_ref();
        let named = self
            .heard
            .structures()
            .find(|(name, _)| Some(*name) == chosen);
        named.or_else(|| self.heard.structures().next())
    }

    /// Returns the index of the first visible parameter row of the selected structure.
    pub fn first_parameter(&self) -> usize {
        self.first_parameter
    }

    /// Returns the selected alert, by default the newest.
    pub fn selected_alert(&self) -> Option<OpenAlert<'_>> {
        let alerts = self.heard.open_alerts();
        self.selected_alert_index(&alerts)
            .map(|index| alerts[index])
    }

    /// Returns the index of the selected alert in `alerts`, the open alerts.
    pub fn selected_alert_index(&self, alerts: &[OpenAlert<'_>]) -> Option<usize> {
        let chosen = self.alert.as_ref();
        let is_chosen = |alert: &OpenAlert<'_>| chosen == Some(&alert.id());
        alerts
            .iter()
            .position(is_chosen)
            .or((!alerts.is_empty()).then_some(0))
    }
}

impl Step {
    /// Returns the next index, with wrap-around.
    fn around(self, at: Option<usize>, len: usize) -> Option<usize> {
        let at = at.filter(|_| len > 0)?;
        Some(match self {
            Self::Next => (at + 1) % len,
            Self::Previous => (at + len - 1) % len,
        })
    }

    /// Returns the next index, without wrap-around.
    fn within(self, at: Option<usize>, len: usize) -> Option<usize> {
        let at = at.filter(|_| len > 0)?;
        Some(match self {
            Self::Next => (at + 1).min(len - 1),
            Self::Previous => at.saturating_sub(1),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::open_alert::AlertKind;
    use super::super::testing::{
        alert, at, damaged_tower, heard, lasting_loss, name, parameter, present,
    };
    use super::*;
    use spandrel_bus::{ChangeSeen, JudgementDisplay, Service};
    use spandrel_listener::Input;

    fn view(heard: Heard) -> View {
        View {
            heard,
            ..View::default()
        }
    }

    fn press(view: &mut View, codes: impl IntoIterator<Item = KeyCode>) -> Option<Action> {
        codes
            .into_iter()
            .filter_map(|code| view.key(KeyEvent::from(code)))
            .last()
    }

    fn letters(text: &str) -> impl Iterator<Item = KeyCode> + '_ {
        text.chars().map(KeyCode::Char)
    }

    fn selected(view: &View) -> &str {
        view.selected_structure().unwrap().0.as_str()
    }

    #[test]
    fn q_escape_and_control_c_quit() {
        for key in [
            KeyEvent::from(KeyCode::Char('q')),
            KeyEvent::from(KeyCode::Esc),
        ] {
            assert_eq!(View::default().key(key), Some(Action::Quit));
        }
        let mut acknowledging = view(damaged_tower());
        press(&mut acknowledging, [KeyCode::Char('a')]);
        assert_eq!(
            press(&mut acknowledging, [KeyCode::Char('q')]),
            None,
            "a letter of the name"
        );
        let control_c = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
        assert_eq!(acknowledging.key(control_c), Some(Action::Quit));
    }

    #[test]
    fn the_selected_alert_is_acknowledged_with_name_and_note() {
        let mut view = view(damaged_tower());
        press(&mut view, [KeyCode::Char('a')]);
        press(&mut view, letters("anna "));
        press(&mut view, [KeyCode::Tab]);
        press(&mut view, letters("seen"));
        let expected = Action::Acknowledge {
            alert: id(AlertKind::Rule),
            who: "anna".to_owned(),
            note: "seen".to_owned(),
        };
        assert_eq!(press(&mut view, [KeyCode::Enter]), Some(expected));
        assert_eq!(*view.mode(), Mode::Watching);
        press(&mut view, [KeyCode::Char('a')]);
        assert!(
            matches!(view.mode(), Mode::Acknowledging { form, .. } if form.who == "anna"),
            "{:?}",
            view.mode()
        );
    }

    /// Returns the alert of storey 2 of the tower.
    fn id(kind: AlertKind) -> AlertId {
        AlertId {
            kind,
            structure: name("tower"),
            part: name("storey-2"),
        }
    }

    #[test]
    fn a_lasting_loss_is_acknowledged_until_the_service_judge_confirms() {
        let loss = lasting_loss("storey-2");
        let mut view = view(heard([
            at(100),
            present(&[(Service::Judge, "a")]),
            Input::Judgement(loss.clone()),
        ]));
        press(&mut view, [KeyCode::Char('a')]);
        press(&mut view, letters("anna"));
        let expected = Action::Acknowledge {
            alert: id(AlertKind::LastingLoss),
            who: "anna".to_owned(),
            note: String::new(),
        };
        assert_eq!(press(&mut view, [KeyCode::Enter]), Some(expected));
        view.sent(id(AlertKind::LastingLoss));
        view.check_acknowledgement();
        let sent = "acknowledgement of tower/storey-2 (lasting loss) sent";
        assert_eq!(view.notice(), Some(sent));
        let seen = JudgementDisplay {
            seen: Some(ChangeSeen {
                who: "anna".to_owned(),
                text: "acknowledged".to_owned(),
                time_ns: 0,
            }),
            ..loss
        };
        view.heard.handle(Input::Judgement(seen), &mut Vec::new());
        view.check_acknowledgement();
        let taken = "tower/storey-2 (lasting loss) is acknowledged";
        assert_eq!(view.notice(), Some(taken));
        view.heard.handle(present(&[]), &mut Vec::new());
        press(&mut view, [KeyCode::Char('a')]);
        let gone = "cannot acknowledge tower/storey-2 (lasting loss): its service judge is gone";
        assert_eq!(view.notice(), Some(gone));
    }

    #[test]
    fn acknowledged_alert_opens_no_form() {
        let mut view = view(heard([Input::Alert(alert(
            "storey-2",
            1,
            AlertState::Acknowledged,
        ))]));
        press(&mut view, [KeyCode::Char('a')]);
        assert_eq!(*view.mode(), Mode::Watching);
        assert_eq!(
            view.notice(),
            Some("tower/storey-2 is acknowledged; nothing to acknowledge")
        );
    }

    #[test]
    fn a_stale_alert_cannot_be_acknowledged() {
        let mut view = view(damaged_tower());
        view.heard.handle(present(&[]), &mut Vec::new());
        press(&mut view, [KeyCode::Char('a')]);
        assert_eq!(*view.mode(), Mode::Watching);
        assert_eq!(
            view.notice(),
            Some("cannot acknowledge tower/storey-2: its alert service is gone")
        );
    }

    #[test]
    fn role_without_the_right_to_acknowledge_opens_no_form() {
        let why = "role viewer may not acknowledge; roles that may: server, operator";
        let around = Around {
            cannot_acknowledge: Some(why.to_owned()),
            ..Around::default()
        };
        let mut view = View {
            heard: damaged_tower(),
            around,
            ..View::default()
        };
        press(&mut view, [KeyCode::Char('a')]);
        assert_eq!(*view.mode(), Mode::Watching);
        assert_eq!(view.notice().unwrap(), format!("cannot acknowledge: {why}"));
    }

    /// Regression test: an acknowledgement that no service accepted was reported as sent, without
    /// any later notice.
    #[test]
    fn acceptance_or_loss_of_an_acknowledgement_is_shown() {
        let sent = || {
            let mut view = view(damaged_tower());
            view.heard.handle(at(100), &mut Vec::new());
            view.sent(id(AlertKind::Rule));
            view.check_acknowledgement();
            assert_eq!(
                view.notice(),
                Some("acknowledgement of tower/storey-2 sent")
            );
            view
        };
        let mut taken = sent();
        taken.heard.handle(
            Input::Alert(alert("storey-2", 46, AlertState::Acknowledged)),
            &mut Vec::new(),
        );
        taken.check_acknowledgement();
        assert_eq!(taken.notice(), Some("tower/storey-2 is acknowledged"));
        let mut lost = sent();
        lost.heard.handle(at(105), &mut Vec::new());
        lost.check_acknowledgement();
        let told =
            "no reply to the acknowledgement of tower/storey-2; is the alert service running?";
        assert_eq!(lost.notice(), Some(told));
    }

    #[test]
    fn notice_disappears_within_nine_seconds() {
        let mut view = view(heard([at(100)]));
        press(&mut view, [KeyCode::Char('a')]);
        assert_eq!(view.notice(), Some("no alert to acknowledge"));
        view.heard.handle(at(109), &mut Vec::new());
        assert_eq!(view.notice(), None);
    }

    #[test]
    fn new_alert_does_not_change_the_selection() {
        let mut view = view(heard([
            Input::Alert(alert("storey-1", 10, AlertState::Raised)),
            Input::Alert(alert("storey-2", 20, AlertState::Raised)),
        ]));
        assert_eq!(
            view.selected_alert().unwrap().part(),
            &name("storey-2"),
            "the newest until chosen"
        );
        press(&mut view, [KeyCode::Down, KeyCode::Down]);
        view.heard.handle(
            Input::Alert(alert("storey-3", 30, AlertState::Raised)),
            &mut Vec::new(),
        );
        assert_eq!(view.selected_alert().unwrap().part(), &name("storey-1"));
        press(&mut view, [KeyCode::Up, KeyCode::Up, KeyCode::Up]);
        assert_eq!(view.selected_alert().unwrap().part(), &name("storey-3"));
    }

    #[test]
    fn tab_cycles_through_the_structures() {
        let of = |structure: &str| {
            let mut display = parameter("storey-1", 0, 1.0, 0.1);
            display.structure = name(structure);
            Input::Parameter(display)
        };
        let mut view = view(heard([of("bridge"), of("mast"), of("tower")]));
        assert_eq!(selected(&view), "bridge");
        press(&mut view, [KeyCode::Tab]);
        assert_eq!(selected(&view), "mast");
        press(&mut view, [KeyCode::Right, KeyCode::Tab]);
        assert_eq!(selected(&view), "bridge");
        press(&mut view, [KeyCode::BackTab]);
        assert_eq!(selected(&view), "tower");
    }

    #[test]
    fn any_key_closes_the_help() {
        let mut view = View::default();
        press(&mut view, [KeyCode::Char('?')]);
        assert_eq!(*view.mode(), Mode::Help);
        assert_eq!(press(&mut view, [KeyCode::Esc]), None);
        assert_eq!(*view.mode(), Mode::Watching);
    }
}
