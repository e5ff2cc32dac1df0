//! A report of an earthquake, as a page and as numbers.

use serde::{Deserialize, Serialize};

use super::{Format, Malformed, Message};
use crate::name::Name;

/// Reply to a query for a report of an earthquake.
///
/// The size of the message limits both texts together.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportPage {
    /// Name of the structure.
    pub structure: Name,
    /// The report, or `index` for the list of all reports.
    pub report: Name,
    /// The page, HTML without scripts.
    pub html: String,
    /// The same numbers, JSON.
    pub json: String,
}

impl ReportPage {
    /// Name of the list of all reports.
    pub const INDEX: &'static str = "index";
    /// Start of the text of an event about a report. How soon an inspector is needed follows it.
    pub const EVENT: &'static str = "earthquake report: ";

    /// Returns the path of a report on the page of the services.
    ///
    /// ```
    /// use spandrel_bus::ReportPage;
    /// let path = ReportPage::path("tower", "2022-12-20t10-34-01z");
    /// assert_eq!(path, "/events/tower/2022-12-20t10-34-01z.html");
    /// ```
    #[must_use]
    pub fn path(structure: &str, report: &str) -> String {
        format!("/events/{structure}/{report}.html")
    }
}

impl Message for ReportPage {
    const TYPE: &'static str = "report-page";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        Ok(())
    }
}
