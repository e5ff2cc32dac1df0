//! Connects the view to the bus and the terminal.

use super::heard::Heard;
use super::nodes::plain_line;
use super::open_alert::{AlertId, AlertKind, Change};
use super::plain::structure_line;
use super::screen::Screen;
use super::view::{Action, Around, View};
use super::wording::nothing_heard;
use crate::error::AppError;
use ratatui::crossterm::event::{Event, KeyEventKind};
use spandrel_bus::{
    Acknowledgement, Annotation, Bus, KeyFamily, Keys, LiveWatch, Name, Service, parse_key,
};
use spandrel_listener::{DisplayTopic as T, Input, Listener, Needs};
use std::collections::BTreeSet;
use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};
use tokio::time::MissedTickBehavior;

/// The topics that the view shows.
const NEEDS: Needs = Needs {
    topics: &[
        T::Ingested,
        T::Statuses,
        T::Parameters,
        T::Losses,
        T::Noise,
        T::Conditions,
        T::Judgements,
        T::Modes,
        T::Classes,
        T::Fit,
        T::Monitoring,
        T::Nodes,
        T::Alerts,
        T::Events,
    ],
    services: &Service::ALL,
    logs: &[],
};
/// Interval at which the screen is redrawn and lines are checked, equal to the display rate.
const REDRAW_EVERY: Duration = Duration::from_millis(100);
/// Interval between the lines of a structure.
const LINE_EVERY: Duration = Duration::from_secs(1);

/// Shows one structure, or all below the root, until `stop` or until the user quits.
///
/// On a terminal it shows a screen with keys, otherwise it prints lines to standard output.
///
/// # Errors
/// Returns an error if the session is closed, or if the terminal has failed.
pub async fn show(
    bus: &Bus,
    root: &Name,
    structure: Option<&Name>,
    around: Around,
    stop: impl Future<Output = ()>,
) -> Result<(), AppError> {
    let listener = Listener::start(bus, root, structure, NEEDS).await?;
    // A view of all structures shows the others anyway.
    let others = match structure {
        Some(_) => Others::watch(bus, root).await?,
        None => Others::none(root),
    };
    let place = match structure {
        Some(structure) => format!("of {structure} below {root}"),
        None => format!("below {root}"),
    };
    if io::stdout().is_terminal() {
        let view = View::new(place, around, user());
        show_screen(bus, listener, others, view, stop).await
    } else {
        print_lines(listener, others, &place, stop).await
    }
}

async fn show_screen(
    bus: &Bus,
    mut listener: Listener,
    others: Others,
    mut view: View,
    stop: impl Future<Output = ()>,
) -> Result<(), AppError> {
    tokio::pin!(stop);
    let mut screen = Screen::open()?;
    let clock = Clock::start();
    let mut redraw = tokio::time::interval(REDRAW_EVERY);
    redraw.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        let event = tokio::select! {
            biased;
            () = &mut stop => return Ok(()),
            event = screen.event() => Some(event?),
            _ = redraw.tick() => None,
        };
        view.heard
            .handle(Input::Now(clock.elapsed()), &mut Vec::new());
        for input in listener.gather() {
            view.heard.handle(input, &mut Vec::new());
        }
        view.set_others(others.names());
        view.set_overwritten(listener.refused().values().sum());
        view.check_acknowledgement();
        let action = match event {
            Some(Event::Key(key)) if key.kind != KeyEventKind::Release => view.key(key),
            _ => None,
        };
        match action {
            Some(Action::Quit) => return Ok(()),
            Some(Action::Acknowledge { alert, who, note }) => {
                acknowledge(bus, &others.root, &alert, who, note).await?;
                view.sent(alert);
            }
            None => {}
        }
        screen.draw(&view)?;
    }
}

/// Returns the default name for acknowledgements.
fn user() -> String {
    std::env::var("USER").unwrap_or_default()
}

/// Publishes an acknowledgement. That of a lasting loss is an annotation, which the service judge
/// keeps.
async fn acknowledge(
    bus: &Bus,
    root: &Name,
    alert: &AlertId,
    who: String,
    note: String,
) -> Result<(), AppError> {
    let AlertId {
        kind,
        structure,
        part,
    } = alert.clone();
    let keys = Keys::new(root.clone(), structure.clone());
    let time_ns = spandrel_service::Clock::of_machine().now_ns();
    match kind {
        AlertKind::Rule => {
            let publisher = bus.publish_display(keys.acknowledge(&part)).await?;
            let acknowledgement = Acknowledgement {
                structure,
                parameter: part,
                time_ns,
                who,
                note,
            };
            Ok(publisher.put(&acknowledgement).await?)
        }
        AlertKind::LastingLoss => {
            let publisher = bus.publish_display(keys.annotation()).await?;
            let annotation = Annotation::acknowledging(structure, part, time_ns, who, note);
            Ok(publisher.put(&annotation).await?)
        }
    }
}

async fn print_lines(
    mut listener: Listener,
    others: Others,
    place: &str,
    stop: impl Future<Output = ()>,
) -> Result<(), AppError> {
    tokio::pin!(stop);
    let mut heard = Heard::default();
    let clock = Clock::start();
    let mut look = tokio::time::interval(REDRAW_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut next_line = LINE_EVERY;
    let mut told_silence = String::new();
    loop {
        let is_last = tokio::select! {
            biased;
            () = &mut stop => true,
            _ = look.tick() => false,
        };
        let now = clock.elapsed();
        let mut changes = Vec::new();
        heard.handle(Input::Now(now), &mut changes);
        for input in listener.gather() {
            heard.handle(input, &mut changes);
        }
        let mut lines: Vec<String> = changes.iter().map(Change::line).collect();
        if is_last || now >= next_line {
            next_line = now + LINE_EVERY;
            for (name, structure) in heard.structures() {
                lines.push(structure_line(name, structure));
                lines.extend(heard.nodes(name).map(|node| plain_line(name, node)));
            }
            if lines.is_empty() {
                let silence = nothing_heard(place, &others.names());
                if silence != told_silence {
                    lines.push(silence.clone());
                    told_silence = silence;
                }
            }
        }
        if print(&lines)? == Reader::Gone || is_last {
            return Ok(());
        }
    }
}

/// The structures whose services or sensors run, for a view of a structure that no service knows.
struct Others {
    root: Name,
    live: Vec<LiveWatch>,
}

impl Others {
    fn none(root: &Name) -> Self {
        Self {
            root: root.clone(),
            live: Vec::new(),
        }
    }

    async fn watch(bus: &Bus, root: &Name) -> Result<Self, AppError> {
        let mut others = Self::none(root);
        for service in Service::ALL {
            let key = KeyFamily::Live(service).expression(root, None, None);
            others.live.push(bus.watch_live(key).await?);
        }
        Ok(others)
    }

    fn names(&self) -> BTreeSet<Name> {
        let keys = self.live.iter().flat_map(LiveWatch::present);
        keys.filter_map(|key| Some(parse_key(&self.root, &key)?.0))
            .collect()
    }
}

/// Whether standard output still has a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reader {
    There,
    /// The reader has closed the pipe, as with `| head`. This is not an error but ends the output.
    Gone,
}

fn print(lines: &[String]) -> Result<Reader, AppError> {
    let mut stdout = io::stdout().lock();
    let written = lines
        .iter()
        .try_for_each(|line| writeln!(stdout, "{line}"))
        .and_then(|()| stdout.flush());
    match written {
        Ok(()) => Ok(Reader::There),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(Reader::Gone),
        Err(source) => Err(AppError::Io {
            what: "cannot write to standard output".to_owned(),
            source,
        }),
    }
}

/// Time since the view was opened, on which staleness is measured.
struct Clock(Instant);

impl Clock {
    fn start() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "a view tells how long it has heard nothing"
        )]
        let now = Instant::now();
        Self(now)
    }

    fn elapsed(&self) -> Duration {
        self.0.elapsed()
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::name;
    use super::*;
    use spandrel_bus::{AnnotationEffect, BusConfig};

    /// Only ends a hang; no test takes a second.
    const DEADLINE: Duration = Duration::from_secs(30);

    #[tokio::test(flavor = "multi_thread")]
    async fn acknowledgement_is_published_for_the_service_of_the_alert() {
        let config = BusConfig {
            listen: vec!["tcp/127.0.0.1:0".into()],
            ..BusConfig::default()
        };
        let bus = Bus::open(&config).await.unwrap();
        let keys = config.keys("tower").unwrap();
        let acknowledgements = bus
            .subscribe::<Acknowledgement>(keys.all_acknowledgements(), 8)
            .await
            .unwrap();
        let annotations = bus
            .subscribe::<Annotation>(keys.annotation(), 8)
            .await
            .unwrap();
        for kind in [AlertKind::Rule, AlertKind::LastingLoss] {
            let alert = AlertId {
                kind,
                structure: name("tower"),
                part: name("storey-2"),
            };
            let (who, note) = ("anna".to_owned(), "seen".to_owned());
            acknowledge(&bus, keys.root(), &alert, who, note)
                .await
                .unwrap();
        }
        let acknowledged = tokio::time::timeout(DEADLINE, acknowledgements.messages().recv_async());
        let (key, sent) = acknowledged.await.unwrap().unwrap();
        assert_eq!(key, "spandrel/tower/alert/storey-2/acknowledge");
        assert_eq!(
            (sent.parameter, &*sent.who, &*sent.note),
            (name("storey-2"), "anna", "seen")
        );
        let noted = tokio::time::timeout(DEADLINE, annotations.messages().recv_async());
        let (_, sent) = noted.await.unwrap().unwrap();
        assert_eq!(sent.effect, AnnotationEffect::Seen);
        assert_eq!(sent.quantity, Some(name("storey-2")));
        assert_eq!(sent.why(), "anna: seen");
    }
}
