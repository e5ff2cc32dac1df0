//! `spandrel notify`: runs the notifications, or tests the receivers.

use super::print;
use super::run::{Services, one};
use crate::cli::NotifyArguments;
use crate::error::AppError;
use crate::services::{Share, read_structures};
use crate::settings::Settings;
use spandrel_notify::{Trial, try_receivers};

/// Runs the notifications, or sends one test notice to each receiver with `--test`.
///
/// # Errors
/// Returns an error if the configuration is not valid, the service fails, or a test notice was not
/// delivered.
pub fn run(arguments: &NotifyArguments) -> Result<(), AppError> {
    if !arguments.test {
        return one(&arguments.service, Services::NOTIFY, Share::ALL);
    }
    let settings = Settings::load(&arguments.service.bus)?;
    settings.notify.check()?;
    if settings.notify.is_empty() {
        return Err(AppError::NoRecipients);
    }
    let watched = read_structures(&settings, &arguments.service.structures)?;
    let structure = watched.first().ok_or(AppError::NoStructure)?;
    let trials = try_receivers(&settings.notify, structure.structure.name())?;
    let mut failed = 0;
    for Trial { receiver, result } in &trials {
        match result {
            Ok(taken) => print(&format!(
                "{receiver}: delivered in {} ms\n",
                taken.as_millis()
            ))?,
            Err(reason) => {
                failed += 1;
                print(&format!("{receiver}: failed: {reason}\n"))?;
            }
        }
    }
    match failed {
        0 => Ok(()),
        failed => Err(AppError::NotDelivered {
            failed,
            receivers: trials.len(),
        }),
    }
}
