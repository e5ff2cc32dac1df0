//! `spandrel annotate`: notes what people know about a structure, for its judgement of lasting
//! change.

use super::watch::joining_by_default;
use super::{NO_NAME, own_name, print};
use crate::cli::AnnotateArguments;
use crate::error::AppError;
use crate::role_check::{Need, Work, check};
use crate::services::block_on;
use crate::settings::Settings;
use spandrel_bus::{
    Annotation, AnnotationEffect, Bus, Event, Message, Name, Service, Status, Subscription, TIMES,
    time_ns,
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
/// Returns an error if an argument is not valid, or if judge does not confirm the annotation in
/// time.
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
        heard(&events, |event| annotation.is_confirmed_by(event)).await?;
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
    let from_ns = time("--from", &arguments.from)?.unwrap_or(now_ns);
    let to_ns = time("--to", &arguments.to)?;
    let found = |text: &Option<String>| format!("{:?}", text.as_deref().unwrap_or("now"));
    if arguments.new_reference && from_ns > now_ns {
        let allowed = "a time that is not in the future, because --new-reference starts there";
        return Err(invalid("--from", found(&arguments.from), allowed));
    }
    if to_ns.is_some_and(|to_ns| to_ns < from_ns) {
        let allowed = "a time at or after the beginning (--from, or now)";
        return Err(invalid("--to", found(&arguments.to), allowed));
    }
    let who = own_name(arguments.who.as_deref())
        .ok_or_else(|| invalid("--who", NO_NAME.to_owned(), "your name"))?;
    let annotation = Annotation {
        structure: Name::new(&*arguments.structure)?,
        quantity: arguments.quantity.as_deref().map(Name::new).transpose()?,
        time_ns: now_ns,
        from_ns,
        to_ns,
        kind: arguments.kind,
        effect: match (arguments.seen, arguments.new_reference) {
            (true, _) => AnnotationEffect::Seen,
            (false, true) => AnnotationEffect::NewReference,
            (false, false) => AnnotationEffect::None,
        },
        who,
        text: arguments.text.clone(),
    };
    let allowed = "a text that is not empty, and a name without control characters";
    annotation
        .check()
        .map_err(|error| invalid("TEXT or --who", error.to_string(), allowed))?;
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
        let mut words = vec!["spandrel", "annotate", "bridge"];
        words.extend(options);
        if !options.contains(&"--who") {
            words.extend(["--who", "ada"]);
        }
        let arguments = Arguments::try_parse_from(words);
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
        let wrong: [(&[&str], &str); 10] = [
            (&["inspection"], "<TEXT>"),
            (&["party", "x"], "must be one of: inspection, repair"),
            (&["repair", " "], "length of the text"),
            (&["repair", "x", "--from", "soon"], "--from: \"soon\""),
            (
                &["repair", "x", "--new-reference", "--from", "2027-01-01"],
                "in the future",
            ),
            (
                &["repair", "x", "--from", "2026-11-02", "--to", "2026-11-01"],
                "--to: \"2026-11-01\", must be a time at or after the beginning",
            ),
            (
                &["repair", "x", "--from", "99999999999999"],
                "--from: \"99999999999999\", must be seconds since 1970",
            ),
            (&["repair", "x", "--from", "1e300"], "--from: \"1e300\""),
            (&["repair", "x", "--who", " "], "--who: no name is given"),
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
