//! `spandrel token`: creates a token for the web page.

use super::print;
use crate::cli::{TokenArguments, TokenRole};
use crate::error::AppError;
use spandrel_bus::Name;
use spandrel_dashboard::{PageRole, Tokens};
use tracing::info;

/// Creates a token, prints it, and stores its hash.
///
/// # Errors
/// Returns an error if the name already has a token, or if the file cannot be read or written.
pub fn run(arguments: &TokenArguments) -> Result<(), AppError> {
    let role = match arguments.role {
        TokenRole::Viewer => PageRole::Viewer,
        TokenRole::Operator => PageRole::Operator,
    };
    let name = Name::new(&*arguments.name)?;
    let secret = Tokens::issue(&arguments.file, name, role, arguments.replace)?;
    info!(file = %arguments.file.display(), "stored the hash of the token; restart a running page \
                                             to apply it");
    print(&format!("{secret}\n"))
}
