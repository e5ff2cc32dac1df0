//! `spandrel check`: reports what a structure and its sensors can identify, before any sensor is
//! bought, and whether the sensors of a recording agree with each other.

use super::{print, progress};
use crate::check_report::CheckPage;
use crate::cli::CheckArguments;
use crate::error::AppError;
use crate::modal_check::ModalCheckPage;
use crate::sensor_report::SensorPage;
use spandrel_structure::Structure;

/// Seed of the simulated data. It is fixed, so that the same file yields the same report.
const SEED: u64 = 1;

/// Number of steps of the progress bar.
const SHARES: u64 = 1000;

/// Checks a structure file and prints the report. Warnings do not change the exit code.
///
/// # Errors
/// The file is not valid.
pub fn run(arguments: CheckArguments) -> Result<(), AppError> {
    if !arguments.record.is_empty() {
        let structure = Structure::read_with_model(&arguments.structure)?;
        let page = SensorPage::of_records(&structure, &arguments.record)?;
        return print(&match arguments.json {
            true => page.json(),
            false => page.to_string(),
        });
    }
    let structure = Structure::read(&arguments.structure)?;
    if let (false, Some(plan)) = (structure.has_model(), structure.modal()) {
        let page = ModalCheckPage::new(&structure, plan)?;
        return print(&match arguments.json {
            true => page.json(),
            false => page.to_string(),
        });
    }
    let bar = progress::share_bar(SHARES).with_message("checking");
    let report = structure.check_with_progress(arguments.after, SEED, &|share| {
        bar.set_position((share * SHARES as f64) as u64);
    });
    bar.finish_and_clear();
    let page = CheckPage::new(&structure, report);
    print(&match arguments.json {
        true => page.json(),
        false => page.to_string(),
    })
}
