//! Geographic location of a structure.

use serde::Serialize;

/// Geographic coordinates (WGS 84), for the map of the page.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Coordinates {
    /// Latitude (degrees), positive towards the north, from −90 to 90.
    pub latitude: f64,
    /// Longitude (degrees), positive towards the east, from −180 to 180.
    pub longitude: f64,
}
