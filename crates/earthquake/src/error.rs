//! Errors of settings.

/// A setting is outside its range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{setting} is {found}, must be {allowed}")]
pub struct EarthquakeError {
    /// The setting.
    pub setting: &'static str,
    /// The value found.
    pub found: f64,
    /// The allowed values.
    pub allowed: &'static str,
}

/// Returns an error unless a setting is in its range.
pub(crate) fn require(
    is_valid: bool,
    setting: &'static str,
    found: f64,
    allowed: &'static str,
) -> Result<(), EarthquakeError> {
    if is_valid {
        return Ok(());
    }
    Err(EarthquakeError {
        setting,
        found,
        allowed,
    })
}
