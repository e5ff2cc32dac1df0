//! `spandrel maintenance`: mutes the notices of a structure for a time.

use super::watch::joining_by_default;
use super::{NO_NAME, own_name, print};
use crate::cli::MaintenanceArguments;
use crate::error::AppError;
use crate::role_check::{Need, Work, check};
use crate::services::block_on;
use crate::settings::Settings;
use jiff::Timestamp;
use spandrel_bus::{Bus, Maintenance, Message as _, Name, Service, Status, Subscription, time_ns};
use spandrel_service::Clock;
use std::time::Duration;

/// Time limit for the status of notify, which it publishes each second and after a request.
const ANSWER_WITHIN: Duration = Duration::from_secs(10);
/// Queue length for statuses. Only the newest one counts.
const STATUSES_WAITING: usize = 16;

/// Begins, ends or lists the maintenance of a structure.
///
/// # Errors
/// Returns an error if an argument is not valid, or if notify does not confirm the request in time.
pub fn run(arguments: &MaintenanceArguments) -> Result<(), AppError> {
    let config = joining_by_default(Settings::load(&arguments.bus)?.bus);
    let request = request(arguments, Clock::of_machine().now_ns())?;
    let keys = config.keys(&arguments.structure)?;
    block_on(async {
        let bus = Bus::open(&config).await?;
        let needs: &[Need] = match request {
            Some(_) => &[Need::MAINTAIN],
            None => &[Need::SEE_STATUS],
        };
        let work = Work {
            subcommand: "maintenance",
            needs,
            structures: Vec::new(),
            nodes: Vec::new(),
        };
        check(&bus, &config, &work).await?;
        let statuses = bus
            .subscribe(keys.statuses(Service::Notify), STATUSES_WAITING)
            .await?;
        // The subscription to the status shows that notify runs.
        let mut present = status_where(&statuses, |_| true).await?.maintenance;
        if let Some(request) = request {
            let publisher = bus.publish_display(keys.maintenance()).await?;
            publisher.put(&request).await?;
            let is_confirmed = |status: &Status| {
                let mut periods = status.maintenance.iter();
                match request.is_end() {
                    true => !periods.any(|period| period.parameter == request.parameter),
                    false => periods.any(|period| {
                        (&period.parameter, period.time_ns) == (&request.parameter, request.time_ns)
                    }),
                }
            };
            present = status_where(&statuses, is_confirmed).await?.maintenance;
        }
        bus.close().await?;
        print(&listed(&arguments.structure, &present))
    })
}

/// Returns the message to send, or `None` to list the maintenance.
fn request(arguments: &MaintenanceArguments, now_ns: i64) -> Result<Option<Maintenance>, AppError> {
    let invalid = |option, found: String, allowed| AppError::Maintenance {
        option,
        found,
        allowed,
    };
    let until_ns = match (&arguments.until, arguments.end) {
        (None, false) => return Ok(None),
        (None, true) => now_ns,
        (Some(text), _) => {
            let until_ns = time_ns(text).filter(|until_ns| {
                let length_ns = until_ns.saturating_sub(now_ns);
                0 < length_ns && length_ns <= Maintenance::LONGEST_NS
            });
            let allowed = "a time in the next 30 days, in seconds since 1970 or like \
                           2026-03-01T12:00:00Z";
            until_ns.ok_or_else(|| invalid("--until", format!("{text:?}"), allowed))?
        }
    };
    let who = own_name(arguments.who.as_deref())
        .ok_or_else(|| invalid("--who", NO_NAME.to_owned(), "your name"))?;
    let reason = arguments.reason.clone();
    let request = Maintenance {
        structure: Name::new(&*arguments.structure)?,
        parameter: arguments.parameter.as_deref().map(Name::new).transpose()?,
        time_ns: now_ns,
        until_ns,
        who,
        reason: reason.unwrap_or_else(|| "ended".to_owned()),
    };
    let allowed = "a reason that is not empty, and names without control characters";
    request
        .check()
        .map_err(|error| invalid("--reason or --who", error.to_string(), allowed))?;
    Ok(Some(request))
}

/// Waits for a status of notify that satisfies a condition.
async fn status_where(
    statuses: &Subscription<Status>,
    holds: impl Fn(&Status) -> bool,
) -> Result<Status, AppError> {
    let found = async {
        while let Ok((_, status)) = statuses.messages().recv_async().await {
            if holds(&status) {
                return Some(status);
            }
        }
        None
    };
    match tokio::time::timeout(ANSWER_WITHIN, found).await {
        Ok(Some(status)) => Ok(status),
        Ok(None) | Err(_) => Err(AppError::NoAnswerOfNotify {
            within_s: ANSWER_WITHIN.as_secs(),
        }),
    }
}

fn listed(structure: &str, periods: &[Maintenance]) -> String {
    let time = |ns: i64| {
        let time = Timestamp::from_second(ns / 1_000_000_000);
        time.map_or_else(|_| ns.to_string(), |time| time.to_string())
    };
    let line = |period: &Maintenance| {
        let part = period.parameter.as_ref();
        let what = part.map_or_else(String::new, |part| format!("/{part}"));
        format!(
            "{structure}{what}: maintenance until {} by {}: {}\n",
            time(period.until_ns),
            period.who,
            period.reason
        )
    };
    match periods.is_empty() {
        true => format!("{structure}: no maintenance\n"),
        false => periods.iter().map(line).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Arguments, Command};
    use clap::Parser as _;

    const NOW_NS: i64 = 1_795_220_273_000_000_000;

    fn of(options: &[&str]) -> Result<Option<Maintenance>, String> {
        let name = ["--who", "ada"]
            .iter()
            .filter(|_| !options.contains(&"--who"));
        let arguments = ["spandrel", "maintenance", "bridge"].iter().chain(name);
        let arguments = Arguments::try_parse_from(arguments.chain(options));
        let Command::Maintenance(arguments) = arguments.map_err(|error| error.to_string())?.command
        else {
            panic!("another command")
        };
        request(&arguments, NOW_NS).map_err(|error| error.report())
    }

    #[test]
    fn help_of_until_names_the_required_reason() {
        use clap::CommandFactory as _;
        let mut command = Arguments::command();
        let maintenance = command.find_subcommand_mut("maintenance").unwrap();
        let until = maintenance
            .get_arguments()
            .find(|argument| argument.get_id() == "until")
            .unwrap();
        let help = until.get_long_help().unwrap().to_string();
        assert!(help.contains("Requires --reason"), "{help}");
    }

    #[test]
    fn maintenance_requires_an_end_within_thirty_days_and_a_reason() {
        let begins = of(&["--until", "1795220274", "--reason", "paint"])
            .unwrap()
            .unwrap();
        assert_eq!(
            (begins.until_ns - NOW_NS, &*begins.reason),
            (1_000_000_000, "paint")
        );
        for until in ["1795220272", "1797900000", "tomorrow"] {
            let error = of(&["--until", until, "--reason", "paint"]).unwrap_err();
            assert!(
                error.contains(until) && error.contains("30 days"),
                "{error}"
            );
        }
        assert!(
            of(&["--until", "1795220274"])
                .unwrap_err()
                .contains("--reason")
        );
        assert!(of(&["--until", "1795220274", "--reason", ""]).is_err());
        let blank = ["--until", "1795220274", "--reason", "paint", "--who", " "];
        let error = of(&blank).unwrap_err();
        assert!(error.contains("--who: no name is given"), "{error}");
        assert!(of(&["--end"]).unwrap().unwrap().is_end());
        assert_eq!(of(&[]), Ok(None));
    }
}
