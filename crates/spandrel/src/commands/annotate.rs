//! `spandrel annotate`: notes what people know about a structure, for its judgement of lasting change.

use super::print;
use super::watch::joining_by_default;
use crate::cli::AnnotateArguments;
use crate::error::AppError;
use crate::role_check::{Need, Work, check};
use crate::services::block_on;
use crate::settings::Settings;
use spandrel_bus::{
    Annotation, AnnotationEffect, Bus, Event, EventKind, Message, Name, Service, Status,
    Subscription, TIMES, time_ns,
};
use spandrel_service::Clock;
use std::time::Duration;

/// Time limit for a message of judge, which may judge years again before.
const ANSWER_WITHIN: Duration = Duration::from_secs(30);
/// Queue lengths for events, and for statuses, of which only the newest one counts.
const EVENTS_WAITING: usize = 256;
const STATUSES_WAITING: usize = 16;

/// Sends an annotation, and waits until judge has kept it.
///
/// # Errors
/// An argument is not valid, or judge does not confirm the annotation in time.
pub fn run(arguments: &AnnotateArguments) -> Result<(), AppError> {
    let config = joining_by_default(Settings::load(&arguments.bus)?.bus);
    let annotation = annotation(arguments, Clock::of_machine().now_ns())?;
    let keys = config.keys(&arguments.structure)?;
    block_on(async {
        let bus = Bus::open(&config).await?;
        let work = Work {
            subcommand: "annotate",
            needs: &[Need::ANNOTATE, Need::SEE_EVENTS],
            structures: Vec::new(),
            nodes: Vec::new(),
        };
        check(&bus, &config, &work).await?;
        let key = keys.statuses(Service::Judge);
        let statuses = bus.subscribe::<Status>(key, STATUSES_WAITING).await?;
        let events = bus.subscribe::<Event>(keys.event(), EVENTS_WAITING).await?;
        let publisher = bus.publish_display(keys.annotation()).await?;
        // The status shows that judge runs and is connected.
        heard(&statuses, |_| true).await?;
        publisher.put(&annotation).await?;
        let is_confirmed = |event: &Event| {
            event.kind == EventKind::Annotation
                && event.time_ns == annotation.from_ns
                && event.what == annotation.what()
        };
        heard(&events, is_confirmed).await?;
        bus.close().await?;
        let subject = annotation
            .quantity
            .as_ref()
            .unwrap_or(&annotation.structure);
        print(&format!(
            "{subject}: {}, {}\n",
            annotation.what(),
            annotation.why()
        ))
    })
}

/// Returns the annotation to send.
fn annotation(arguments: &AnnotateArguments, now_ns: i64) -> Result<Annotation, AppError> {
    let invalid = |option, found: String, allowed| AppError::Annotation {
        option,
        found,
        allowed,
    };
    let time = |option, text: &Option<String>| {
        let parse = |text: &String| {
            time_ns(text).ok_or_else(|| invalid(option, format!("{text:?}"), TIMES))
        };
        text.as_ref().map(parse).transpose()
    };
    let annotation = Annotation {
        structure: Name::new(&*arguments.structure)?,
        quantity: arguments.quantity.as_deref().map(Name::new).transpose()?,
        time_ns: now_ns,
        from_ns: time("--from", &arguments.from)?.unwrap_or(now_ns),
        to_ns: time("--to", &arguments.to)?,
        kind: arguments.kind,
        effect: match (arguments.seen, arguments.new_reference) {
            (true, _) => AnnotationEffect::Seen,
            (false, true) => AnnotationEffect::NewReference,
            (false, false) => AnnotationEffect::None,
        },
        who: arguments
            .who
            .clone()
            .unwrap_or_else(|| std::env::var("USER").unwrap_or_default()),
        text: arguments.text.clone(),
    };
    let allowed = "a name and a text that are not empty, an end after the beginning, and no new \
                   reference in the future";
    annotation
        .check()
        .map_err(|error| invalid("annotation", error.to_string(), allowed))?;
    Ok(annotation)
}

/// Waits for a message of judge for which `is_it` returns `true`.
async fn heard<M: Message + Send + 'static>(
    messages: &Subscription<M>,
    is_it: impl Fn(&M) -> bool,
) -> Result<(), AppError> {
    let found = async {
        while let Ok((_, message)) = messages.messages().recv_async().await {
            if is_it(&message) {
                return true;
            }
        }
        false
    };
    match tokio::time::timeout(ANSWER_WITHIN, found).await {
        Ok(true) => Ok(()),
        Ok(false) | Err(_) => Err(AppError::NoAnswerOfJudge {
            within_s: ANSWER_WITHIN.as_secs(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Arguments, Command};
    use clap::Parser as _;

    const NOW_NS: i64 = 1_795_220_273_000_000_000;

    fn of(options: &[&str]) -> Result<Annotation, String> {
        let arguments = ["spandrel", "annotate", "bridge", "--who", "ada"];
        let arguments = Arguments::try_parse_from(arguments.iter().chain(options));
        let Command::Annotate(arguments) = arguments.map_err(|error| error.to_string())?.command
        else {
            panic!("another command")
        };
        annotation(&arguments, NOW_NS).map_err(|error| error.report())
    }

    #[test]
    fn an_annotation_is_about_now_and_all_quantities_unless_it_says_otherwise() {
        let note = of(&["inspection", "bearings look sound"]).unwrap();
        assert_eq!(
            (note.from_ns, note.to_ns, &note.quantity, note.effect),
            (NOW_NS, None, &None, AnnotationEffect::None)
        );
        let repair = of(&[
            "repair",
            "new bearings",
            "--new-reference",
            "--quantity",
            "pier",
            "--from",
            "2026-11-01",
        ])
        .unwrap();
        assert_eq!(repair.effect, AnnotationEffect::NewReference);
        assert_eq!(repair.from_ns, time_ns("2026-11-01").unwrap());
        assert_eq!(repair.quantity, Some(Name::new("pier").unwrap()));
        let seen = of(&["inspection", "a crack", "--seen"]).unwrap();
        assert_eq!(seen.effect, AnnotationEffect::Seen);
    }

    #[test]
    fn mistakes_are_named() {
        let wrong: [(&[&str], &str); 6] = [
            (&["inspection"], "<TEXT>"),
            (&["party", "x"], "must be one of: inspection, repair"),
            (&["repair", " "], "length of the text"),
            (&["repair", "x", "--from", "soon"], "--from: \"soon\""),
            (
                &["repair", "x", "--new-reference", "--from", "2027-01-01"],
                "in the future",
            ),
            (
                &["repair", "x", "--new-reference", "--seen"],
                "cannot be used with",
            ),
        ];
        for (options, told) in wrong {
            let error = of(options).unwrap_err();
            assert!(error.contains(told), "{told}\n{error}");
        }
    }
}
