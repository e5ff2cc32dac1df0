//! `spandrel check`: reports what a structure and its sensors can identify, before any sensor is
//! bought.

use super::print;
use crate::check_report::CheckPage;
use crate::cli::CheckArguments;
use crate::error::AppError;
use spandrel_structure::Structure;

/// Seed of the simulated data. It is fixed, so that the same file yields the same report.
const SEED: u64 = 1;

/// Checks a structure file and prints the report. Warnings do not change the exit code.
///
/// # Errors
/// The file is not valid.
pub fn run(arguments: CheckArguments) -> Result<(), AppError> {
    let structure = Structure::read(&arguments.structure)?;
    let page = CheckPage::new(&structure, structure.check(arguments.after, SEED));
    print(&match arguments.json {
        true => page.json(),
        false => page.to_string(),
    })
}
