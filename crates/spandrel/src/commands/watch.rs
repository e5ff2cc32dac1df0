pub fn run(_: crate::cli::WatchArguments) -> Result<(), crate::error::AppError> {
    Ok(())
}
pub async fn show(
    _: &spandrel_bus::Bus,
    _: &spandrel_bus::Name,
    _: Option<&str>,
    stop: impl Future<Output = ()>,
) -> Result<(), crate::error::AppError> {
    stop.await;
    Ok(())
}
