pub fn run(_: crate::cli::CheckArguments) -> Result<(), crate::error::AppError> {
    Ok(())
}
